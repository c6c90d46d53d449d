//! `toile chart`: bytes and milliseconds per frame against error, for every codec.

use std::fmt::Write;
use std::time::Instant;

use anyhow::{Context, Result};
use picture::Plot;
use serde_json::Value;

use crate::{args, codec, upsample};

/// Where no bytes at all are drawn on a logarithmic axis,
const LEAST_BYTES: f64 = 1.0;
/// and no error at all (mm).
const LEAST_MM: f64 = 0.1;
/// The cheap end: a mesh that its skin carries.
const SKINNING: &str = "plain-skinning";
/// The dear end: exact, without a byte, at a price in time.
const SIMULATION: &str = "full-simulation";
/// Pixels to a unit of the PNG files.
const SCALE: u32 = 2;

/// One codec, as far as the chart shows it.
#[derive(Debug, Clone)]
struct Point {
    name: String,
    bytes: f64,
    total_bytes: f64,
    decode_ms: f64,
    rms_mm: f64,
    max_mm: f64,
}

/// Measures, or reads what was measured, and draws.
pub fn run(a: &args::Chart) -> Result<()> {
    if explorer::upsample::scene::NAMES.contains(&a.store.as_str()) {
        return upsample::chart(&a.store, a);
    }
    let start = Instant::now();
    std::fs::create_dir_all(&a.out)
        .with_context(|| format!("the folder {} cannot be made", a.out.display()))?;
    let (measured, states) = match &a.bench {
        Some(file) => {
            let text = std::fs::read_to_string(file)
                .with_context(|| format!("reading {}", file.display()))?;
            let last = text.lines().last().unwrap_or_default();
            let json: Value = serde_json::from_str(last)
                .with_context(|| format!("{}: no output of codec bench --json", file.display()))?;
            read(&json).with_context(|| format!("{}: no codecs", file.display()))?
        }
        None => {
            let bench = args::CodecBench {
                store: a.store.clone(),
                work: a.work.clone(),
                bound_mm: Some(10.0),
                states: a.states,
                minutes: 60,
                generations: false,
                export: None,
                json: true,
            };
            let json = serde_json::to_value(codec::measure(&bench)?)?;
            read(&json).context("codecs were measured")?
        }
    };
    let file = |name: &str| a.out.join(name);
    std::fs::write(file("codecs.csv"), csv(&measured)).context("writing codecs.csv")?;
    type Axis = fn(&Point) -> f64;
    let bytes: Axis = |p| p.bytes.max(LEAST_BYTES);
    let share: Axis = |p| p.total_bytes.max(LEAST_BYTES);
    let time: Axis = |p| p.decode_ms;
    let charts = [
        ("bytes-rms", "bytes per frame", bytes, "rms error (mm)", (|p| p.rms_mm) as Axis),
        ("bytes-max", "bytes per frame", bytes, "largest error (mm)", |p| p.max_mm),
        ("total-rms", "bytes per frame, basis included", share, "rms error (mm)", |p| p.rms_mm),
        ("time-rms", "ms per frame", time, "rms error (mm)", |p| p.rms_mm),
        ("time-max", "ms per frame", time, "largest error (mm)", |p| p.max_mm),
    ];
    for (name, x_label, x, y_label, y) in charts {
        let plot = plot(&measured, states, (x_label, x), (y_label, y));
        for (ending, content) in [("svg", plot.svg().into_bytes()), ("png", plot.png(SCALE)?)] {
            let path = file(&format!("{name}.{ending}"));
            std::fs::write(&path, content)
                .with_context(|| format!("writing {}", path.display()))?;
            println!("{}", path.display());
        }
    }
    eprintln!("{:.1} s", start.elapsed().as_secs_f64());
    Ok(())
}

/// The codecs of a bench, and the states that share a basis.
fn read(json: &Value) -> Option<(Vec<Point>, f64)> {
    let states = json["states"].as_f64()?;
    let point = |row: &Value| {
        let number = |key: &str| row[key].as_f64();
        Some(Point {
            name: row["name"].as_str()?.into(),
            bytes: number("bytes_per_frame")?,
            total_bytes: number("total_bytes")? / states,
            decode_ms: number("decode_us")? / 1e3,
            rms_mm: number("rms_mm")?,
            max_mm: number("max_mm")?,
        })
    };
    let points: Option<Vec<Point>> = json["codecs"].as_array()?.iter().map(point).collect();
    points.filter(|points| !points.is_empty()).map(|points| (points, states))
}

fn csv(points: &[Point]) -> String {
    let mut out =
        "name,bytes_per_frame,total_bytes_per_frame,decode_ms,rms_mm,max_mm\n".to_string();
    for p in points {
        let _ = writeln!(
            out,
            "{},{:.1},{:.1},{:.5},{:.4},{:.3}",
            p.name, p.bytes, p.total_bytes, p.decode_ms, p.rms_mm, p.max_mm
        );
    }
    out
}

/// One curve per family, in order of bytes, and the line that nothing is below and left of.
fn plot(
    points: &[Point],
    states: f64,
    (x_label, x): (&str, fn(&Point) -> f64),
    (y_label, y): (&str, fn(&Point) -> f64),
) -> Plot {
    let title = format!("{y_label} over {x_label}, {} states", states as u64);
    let mut plot = Plot::new(&title, x_label, y_label).logarithmic().logarithmic_along();
    plot.size = [760, 440];
    let tier = |p: &Point| p.name.contains("-tier");
    let families: [(&str, &str, bool); 4] = [
        ("kim2013, rank 50 to 400", "kim2013", false),
        ("toile, by bound", "toile", false),
        ("toile, tiers of 16 to 128 columns", "toile", true),
        ("meshopt + zstd", "meshopt", false),
    ];
    let place = |p: &Point| [x(p), y(p).max(LEAST_MM)];
    // Simulating at run time has no place among bytes: it would beat all of them.
    let rivals = points.iter().filter(|p| p.name != SIMULATION || x_label.starts_with("ms"));
    let plot = plot.with("Pareto line", pareto(rivals.map(place)));
    let plot = families.into_iter().fold(plot, |plot, (family, prefix, tiers)| {
        let of_family = points.iter().filter(|p| p.name.starts_with(prefix) && tier(p) == tiers);
        let mut curve: Vec<[f64; 2]> = of_family.map(place).collect();
        curve.sort_by(|a, b| a[0].total_cmp(&b[0]));
        if let [only] = curve[..] {
            curve = diamond(only).to_vec();
        }
        plot.with(family, curve)
    });
    let ends = points.iter().filter(|p| [SKINNING, SIMULATION].contains(&p.name.as_str()));
    // A gap between the two.
    let ends = ends.flat_map(|p| diamond(place(p)).into_iter().chain([[f64::NAN; 2]]));
    plot.with("ends: plain skinning, full simulation", ends.collect())
}

/// A lone point, to be seen.
fn diamond([x, y]: [f64; 2]) -> [[f64; 2]; 5] {
    let (left, right, down, up) = (x / 1.06, x * 1.06, y / 1.06, y * 1.06);
    [[left, y], [x, up], [right, y], [x, down], [left, y]]
}

/// Points that no other beats in both, as stairs.
fn pareto(points: impl Iterator<Item = [f64; 2]>) -> Vec<[f64; 2]> {
    let mut sorted: Vec<[f64; 2]> = points.collect();
    sorted.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    let mut line: Vec<[f64; 2]> = Vec::new();
    for point in sorted {
        match line.last().copied() {
            Some(last) if point[1] >= last[1] => {}
            last => {
                line.extend(last.map(|last| [point[0], last[1]]));
                line.push(point);
            }
        }
    }
    line
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(bytes: f64, rms_mm: f64) -> Point {
        let (total_bytes, decode_ms, max_mm) = (bytes, 1.0, rms_mm);
        Point { name: "toile".into(), bytes, total_bytes, decode_ms, rms_mm, max_mm }
    }

    #[test]
    fn the_pareto_line_leaves_out_what_is_beaten() {
        let points = [point(10.0, 5.0), point(20.0, 6.0), point(30.0, 1.0), point(5.0, 9.0)];
        let line = pareto(points.iter().map(|p| [p.bytes, p.rms_mm]));
        assert_eq!(line, [[5.0, 9.0], [10.0, 9.0], [10.0, 5.0], [30.0, 5.0], [30.0, 1.0]]);
    }

    #[test]
    fn what_a_bench_printed_is_read() {
        let row = r#"{"name":"x","bytes_per_frame":1,"total_bytes":8,"decode_us":5,"rms_mm":2,"max_mm":3}"#;
        let json = format!("{{\"states\":4,\"codecs\":[{row}]}}");
        let (points, states) = read(&serde_json::from_str(&json).unwrap()).unwrap();
        assert_eq!((points[0].total_bytes, points[0].decode_ms, states), (2.0, 0.005, 4.0));
        assert!(read(&serde_json::json!({"states": 4, "codecs": []})).is_none());
    }
}

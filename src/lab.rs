//! `toile lab`: the test bench of the simulator.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Context, Result, bail};
use explorer::cloth::fabrics::{self, FABRICS};
use explorer::cloth::lab::{self, BENCHES, Bench, Limit, Report, Row, Settings};
use explorer::cpu::thread_cpu_s;
use serde::Serialize;

use crate::lab_record::Recorder;
use crate::{args, format, place};

/// Runs `toile lab ...`.
pub fn run(a: args::Lab) -> Result<()> {
    match a.command {
        args::LabCommand::List { json } => list(json),
        args::LabCommand::Run(a) => run_one(&a),
        args::LabCommand::Table { only, out, quick } => table(&only, out.as_deref(), quick),
    }
}

#[derive(Serialize)]
struct Listed {
    name: &'static str,
    about: &'static str,
    reference: &'static str,
    fast: bool,
    options: Vec<String>,
}

#[derive(Serialize)]
struct ListedFabric {
    name: &'static str,
    density: f32,
    warp: f32,
    weft: f32,
    bend: f32,
}

#[derive(Serialize)]
struct Everything {
    benches: Vec<Listed>,
    fabrics: Vec<ListedFabric>,
}

fn list(json: bool) -> Result<()> {
    if json {
        let benches = BENCHES.iter().map(|b| Listed {
            name: b.name,
            about: b.about,
            reference: b.reference,
            fast: b.fast,
            options: b.reads.iter().map(|s| format!("--{}", s.name())).collect(),
        });
        let fabrics = FABRICS.iter().map(|f| ListedFabric {
            name: f.name,
            density: f.density,
            warp: f.warp_mean(),
            weft: f.weft_mean(),
            bend: f.bend_mean(),
        });
        let everything = Everything { benches: benches.collect(), fabrics: fabrics.collect() };
        return format::print_json(&everything);
    }
    println!(
        "benches (toile lab run NAME), and which of --n, --vertices, --fabric and --dt they read:"
    );
    for b in BENCHES {
        println!("  {:<4} {}\n       {}", b.name, b.about, b.options());
    }
    println!("fabrics (--fabric NAME): kg/m2, warp and weft N/m, bending N m");
    for f in &FABRICS {
        let (warp, weft) = (f.warp_mean(), f.weft_mean());
        println!("  {:<18} {:.3} {warp:>5.0} {weft:>5.0} {:.1e}", f.name, f.density, f.bend_mean());
    }
    Ok(())
}

/// The promised keys, and more.
#[derive(Debug, Serialize)]
struct Summary<'a> {
    name: &'a str,
    fabric: &'a str,
    vertices: usize,
    frames: u64,
    simulated_s: f64,
    substeps: u64,
    iterations: u64,
    cpu_ms_per_frame: f64,
    stretch_p99_pct: f64,
    stretch_max_pct: f64,
    penetration_mm: Option<f64>,
    self_hits: Option<u64>,
    lowest_m: f64,
    speed_max_m_s: f64,
    pass: bool,
    figure: Option<f64>,
    unit: &'a str,
    threshold: f64,
    rows: Vec<SummaryRow<'a>>,
}

#[derive(Debug, Serialize)]
struct SummaryRow<'a> {
    what: &'a str,
    figure: Option<f64>,
    unit: &'a str,
    reference: &'a str,
    at_most: Option<f64>,
    at_least: Option<f64>,
    pass: bool,
}

impl<'a> Summary<'a> {
    fn new(report: &'a Report) -> Self {
        let (t, decisive) = (&report.tally, report.decisive());
        Self {
            name: report.name,
            fabric: report.fabric.unwrap_or("default"),
            vertices: t.vertices,
            frames: t.frames,
            simulated_s: t.simulated_s,
            substeps: t.substeps,
            iterations: t.iterations,
            cpu_ms_per_frame: t.cpu_ms_per_frame(),
            stretch_p99_pct: 100.0 * f64::from(t.stretch_p99),
            stretch_max_pct: 100.0 * f64::from(t.stretch_max),
            penetration_mm: t.penetration_m.map(format::mm),
            self_hits: t.self_hits,
            lowest_m: if t.lowest_m.is_finite() { f64::from(t.lowest_m) } else { 0.0 },
            speed_max_m_s: f64::from(t.speed_max_m_s),
            pass: report.pass(),
            figure: finite(decisive.figure),
            unit: decisive.unit,
            threshold: decisive.threshold(),
            rows: report.rows.iter().map(summary_row).collect(),
        }
    }
}

fn summary_row(row: &Row) -> SummaryRow<'_> {
    let (at_most, at_least) = match row.limit {
        Limit::AtMost(x) => (Some(x), None),
        Limit::AtLeast(x) => (None, Some(x)),
    };
    SummaryRow {
        what: &row.what,
        figure: finite(row.figure),
        unit: row.unit,
        reference: &row.reference,
        at_most,
        at_least,
        pass: row.passes(),
    }
}

/// JSON has no NaN and no infinity.
fn finite(x: f64) -> Option<f64> {
    x.is_finite().then_some(x)
}

fn run_one(a: &args::LabRun) -> Result<()> {
    let bench = lab::find(&a.name)?;
    let fabric = match &a.fabric {
        None => None,
        Some(name) => match fabrics::find(name) {
            Some(fabric) => Some(fabric),
            None => {
                bail!("--fabric {name}: there is no such fabric; there are {}", fabrics::names())
            }
        },
    };
    let dt_s = a.dt;
    let settings = Settings { n: a.n, vertices: a.vertices, fabric, dt_s, quick: a.quick };
    let mut recorder = Recorder::new(a.picture.clone(), a.export.clone())?;
    let watch = &mut |shot: &lab::Shot<'_>| {
        recorder.take(shot);
        true
    };
    let report = bench.run(settings, &mut thread_cpu_s, watch)?;
    recorder.finish(bench.name)?;
    if a.json {
        return format::print_json(&Summary::new(&report));
    }
    print(bench, &report);
    Ok(())
}

fn print(bench: &Bench, report: &Report) {
    println!("{}: {}", bench.name, bench.about);
    for row in &report.rows {
        println!("  {} {} (reference: {})", verdict(row.passes()), said(row), row.reference);
    }
    let t = &report.tally;
    println!(
        "  {} vertices, {} frames; {:.3} ms CPU per 1/60 s; stretch p99 {:.2} %, max {:.2} %",
        t.vertices,
        t.frames,
        t.cpu_ms_per_frame(),
        100.0 * t.stretch_p99,
        100.0 * t.stretch_max
    );
    println!(
        "  penetration {}, self hits {}, lowest {:.4} m",
        t.penetration_m.map_or("-".into(), |m| format!("{:.3} mm", format::mm(m))),
        t.self_hits.map_or("-".into(), |hits| hits.to_string()),
        t.lowest_m
    );
}

fn verdict(pass: bool) -> &'static str {
    if pass { "pass" } else { "MISS" }
}

/// `sag at span 0.5: 0.12 %, at most 1 %`.
fn said(row: &Row) -> String {
    let unit = if row.unit.is_empty() { String::new() } else { format!(" {}", row.unit) };
    let side = match row.limit {
        Limit::AtMost(_) => "at most",
        Limit::AtLeast(_) => "at least",
    };
    format!("{}: {}{unit}, {side} {}{unit}", row.what, number(row.figure), number(row.threshold()))
}

/// Four digits that matter.
fn number(x: f64) -> String {
    if x == 0.0 || !x.is_finite() {
        return x.to_string();
    }
    let digits = (3 - x.abs().log10().floor() as i32).clamp(0, 12) as usize;
    let text = if x.abs() < 1e-5 { format!("{x:.2e}") } else { format!("{x:.digits$}") };
    if text.contains('.') && !text.contains('e') {
        return text.trim_end_matches('0').trim_end_matches('.').to_owned();
    }
    text
}

/// The page's beginning, with the command that writes it again.
fn head(only: &[String], quick: bool) -> String {
    let names: String = only.iter().map(|name| format!("{name} ")).collect();
    let quick = if quick { "--quick " } else { "" };
    format!(
        "# Stability and accuracy of the simulator\n\n\
         Benches of `toile lab list` with their figures, misses included. This page was written by\n\
         `toile lab table {names}{quick}--out docs/results/stability.md` (without `--quick`: all\n\
         cases of each bench); a bench is run again by `toile lab run NAME`. CPU is\n\
         milliseconds per 1/60 s of simulated time on one core, all runs of the bench together.\n\n\
         | test | measured | reference | figure | threshold | |\n\
         | --- | --- | --- | --- | --- | --- |\n"
    )
}

/// Where the page's hand-written end begins; what stands there outlives a new table.
const REASONS: &str = "\n## Why figures miss\n";

/// Runs benches one after the other and writes the page.
fn table(only: &[String], out: Option<&Path>, quick: bool) -> Result<()> {
    let chosen: Vec<&Bench> = if only.is_empty() {
        BENCHES.iter().collect()
    } else {
        only.iter().map(|name| lab::find(name)).collect::<Result<_, _>>()?
    };
    if let Some(file) = out {
        place::ensure_writable(file)?;
    }
    let mut page = head(only, quick);
    let (mut passed, mut all) = (0, 0);
    for bench in chosen {
        let settings = Settings { quick, ..Settings::default() };
        eprintln!("{}: {}", bench.name, bench.about);
        let ran = bench.run(settings, &mut thread_cpu_s, &mut |_| true);
        let report = match ran {
            Ok(report) => report,
            Err(error) => {
                all += 1;
                writeln!(page, "| {} | {} | | {error} | | **miss** |", bench.name, bench.about)?;
                continue;
            }
        };
        for row in &report.rows {
            let (figure, limit) = (number(row.figure), number(row.threshold()));
            let side = if matches!(row.limit, Limit::AtMost(_)) { "<=" } else { ">=" };
            let verdict = if row.passes() { "pass" } else { "**miss**" };
            all += 1;
            passed += u32::from(row.passes());
            writeln!(
                page,
                "| {} | {} | {} | {figure} {} | {side} {limit} | {verdict} |",
                bench.name, row.what, row.reference, row.unit
            )?;
            eprintln!("  {} {}", self::verdict(row.passes()), said(row));
        }
        let ms = report.tally.cpu_ms_per_frame();
        let vertices = report.tally.vertices;
        writeln!(page, "| | {} ({vertices} vertices, CPU {ms:.2}) | | | | |", bench.about)?;
    }
    writeln!(page, "\n{passed} of {all} figures pass.")?;
    match out {
        Some(file) => {
            let old = std::fs::read_to_string(file).unwrap_or_default();
            page.push_str(old.find(REASONS).map_or("", |at| &old[at..]));
            std::fs::write(file, page).with_context(|| format!("writing {}", file.display()))?
        }
        None => print!("{page}"),
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_keep_four_digits() {
        for (x, text) in [
            (0.0, "0"),
            (1.0, "1"),
            (12.3456, "12.35"),
            (0.012_345_6, "0.01235"),
            (123_456.0, "123456"),
            (1e-6, "1.00e-6"),
            (f64::NAN, "NaN"),
        ] {
            assert_eq!(number(x), text);
        }
    }
}

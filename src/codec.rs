//! `toile codec bench`: codecs side by side on the states of an explored store.

use std::cell::Cell;
use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use explorer::cpu::CpuClock;
use explorer::pack::Bound;
use explorer::pack::bench::{Bench, Errors, Measured, Source, Steps};
use serde::Serialize;

pub(crate) mod contact;
mod growth;

use crate::{args, format, place, store};

/// States on which the codecs without a basis are measured, at most: each stands for itself.
const SAMPLE_STATES: usize = 384;
/// Level of zstd beside them.
const ZSTD_LEVEL: i32 = 12;
/// Of the largest error of `kim2013-r200`, what equal bytes are to reach.
const EQUAL_BYTES_SHARE: f32 = 0.4;
/// How often is said what is being done.
const PROGRESS: Duration = Duration::from_secs(10);

/// The promised keys.
#[derive(Debug, Serialize)]
pub struct Outcome {
    /// Where the exact states came from.
    pub source: &'static str,
    /// States measured.
    pub states: usize,
    /// Vertices of a state.
    pub vertices: usize,
    /// One row per codec.
    pub codecs: Vec<Row>,
    /// Whether columns hold unseen states better in the state frame or in skinned space.
    pub spaces: Vec<Space>,
    /// Rows that there was no time for.
    pub left_out: Vec<String>,
}

/// One codec.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    /// Which.
    pub name: String,
    /// Columns; 0 without a basis.
    pub rank: usize,
    /// Encoded states, over their number.
    pub bytes_per_frame: f64,
    /// Encoded basis.
    pub basis_bytes: u64,
    /// The basis as a client holds it.
    pub resident_bytes: u64,
    /// Both together, for all states.
    pub total_bytes: u64,
    /// Largest vertex error (mm).
    pub max_mm: f64,
    /// 99.9th percentile of vertex errors (mm).
    pub p999_mm: f64,
    /// Root mean square vertex error (mm).
    pub rms_mm: f64,
    /// Time to encode a state (ms).
    pub encode_ms: f64,
    /// Time to decode a state (us).
    pub decode_us: f64,
    /// Share of vertices with a fix of their own.
    pub fixed_share: f64,
}

impl Row {
    fn head() -> String {
        format!(
            "{:<39} {:>5} {:>9} {:>10} {:>10} {:>11} {:>8} {:>8} {:>7} {:>9} {:>9}",
            "codec",
            "rank",
            "B/frame",
            "basis B",
            "resident B",
            "total B",
            "max mm",
            "p999 mm",
            "rms mm",
            "encode ms",
            "decode us"
        )
    }

    fn line(&self) -> String {
        format!(
            "{:<39} {:>5} {:>9.1} {:>10} {:>10} {:>11} {:>8.2} {:>8.2} {:>7.3} {:>9.3} {:>9.1}",
            self.name,
            self.rank,
            self.bytes_per_frame,
            self.basis_bytes,
            self.resident_bytes,
            self.total_bytes,
            self.max_mm,
            self.p999_mm,
            self.rms_mm,
            self.encode_ms,
            self.decode_us
        )
    }
}

impl From<Measured> for Row {
    fn from(m: Measured) -> Self {
        Self {
            name: m.name,
            rank: m.rank,
            bytes_per_frame: m.bytes_per_frame,
            basis_bytes: m.basis_bytes,
            resident_bytes: m.resident_bytes,
            total_bytes: m.total_bytes,
            max_mm: 1e3 * m.max_m,
            p999_mm: 1e3 * m.p999_m,
            rms_mm: 1e3 * m.rms_m,
            encode_ms: 1e3 * m.encode_s,
            decode_us: 1e6 * m.decode_s,
            fixed_share: m.fixed_share,
        }
    }
}

/// How well columns of one half of the states hold the other half.
#[derive(Debug, Clone, Serialize)]
pub struct Space {
    /// `state frame` or `skinned`.
    pub space: &'static str,
    /// Columns.
    pub rank: usize,
    /// Root mean square vertex error of held-out states (mm).
    pub rms_mm: f64,
    /// Largest (mm).
    pub max_mm: f64,
}

/// Measures and prints.
pub fn bench(a: &args::CodecBench) -> Result<()> {
    if let Some(bound) = a.bound_mm {
        ensure!(bound.is_finite() && bound >= 0.01, "--bound-mm {bound}: at least 0.01");
    }
    if a.generations {
        return growth::run(a);
    }
    let outcome = measure(a)?;
    if a.json { format::print_json(&outcome) } else { Ok(()) }
}

/// Opens what is to be measured.
fn source(store: &str, work: Option<&PathBuf>, states: Option<usize>) -> Result<Source> {
    let opened = store::open_store(store)?;
    let work = place::work(&opened, work.cloned())?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    Ok(runtime.block_on(Source::open(&*opened.store, &work, states))?)
}

/// Says what is being done, every few seconds.
fn progress() -> impl Fn(&str) {
    let last = Cell::new(Instant::now());
    move |text: &str| {
        if last.get().elapsed() > PROGRESS {
            eprintln!("{text}");
            last.set(Instant::now());
        }
    }
}

/// Rows as they come, until the time is over.
struct Rows {
    rows: Vec<Row>,
    left_out: Vec<String>,
    end: Instant,
    json: bool,
}

impl Rows {
    /// Measures one row, or several that belong together, and prints it.
    fn add<T: Into<Row>, I: IntoIterator<Item = T>>(
        &mut self,
        name: &str,
        measure: impl FnOnce() -> Result<I>,
    ) -> Result<()> {
        if Instant::now() > self.end {
            eprintln!("{name}: left out, the time is over; --minutes gives more");
            self.left_out.push(name.into());
            return Ok(());
        }
        for row in measure()? {
            let row = row.into();
            let line = row.line();
            if self.json {
                eprintln!("{line}")
            } else {
                println!("{line}")
            }
            self.rows.push(row);
        }
        Ok(())
    }
}

/// Measures all codecs, row by row; each is printed as soon as it is there.
pub fn measure(a: &args::CodecBench) -> Result<Outcome> {
    let source = source(&a.store, a.work.as_ref(), a.states)?;
    let clock = CpuClock::start();
    let clock = || clock.elapsed_s();
    let say = progress();
    let end = Instant::now() + Duration::from_secs(60 * u64::from(a.minutes));
    let head = format!(
        "{} states of {} vertices, exact, from the work folder\n{}",
        source.states(),
        source.vertices(),
        Row::head()
    );
    if a.json {
        eprintln!("{head}")
    } else {
        println!("{head}")
    }
    let bench = Bench::new(&source, &clock, &say)?;
    let mut rows = Rows { rows: Vec::new(), left_out: Vec::new(), end, json: a.json };
    rows.add("plain-skinning", || Ok(bench.plain_skinning()?))?;
    let kim = bench.kim2013(200)?;
    rows.add("kim2013-r200", || Ok([kim.clone()]))?;
    let (max_m, rms_m) = (Some(kim.max_m as f32), Some(kim.rms_m as f32));
    let both = Bound { max_m, rms_m };
    let slack = Bound { max_m: max_m.map(|m| 1.02 * m), rms_m: rms_m.map(|m| 1.046 * m) };
    let bounds = [
        ("toile-equal-max-and-rms-r200", both),
        ("toile-equal-max-and-rms-r200-slack", slack),
        ("toile-equal-max-r200", Bound { rms_m: None, ..both }),
        ("toile-equal-rms-r200", Bound { max_m: None, ..both }),
    ];
    for (name, bound) in bounds {
        rows.add(name, || Ok([bench.toile(name, bound)?]))?;
    }
    let name = "toile-equal-bytes-r200";
    let within_m = max_m.map(|m| EQUAL_BYTES_SHARE * m);
    rows.add(name, || Ok([bench.toile_of_bytes(name, kim.total_bytes, within_m)?]))?;
    rows.add("toile-first-cloth", || Ok([bench.leading("toile-first-cloth", both)?]))?;
    let name = "toile-equal-max-and-rms-r200";
    rows.add("tiers", || Ok(bench.tiers(name, both)?))?;
    if let Some(bound_mm) = a.bound_mm {
        let bound = Bound { max_m: Some(bound_mm / 1e3), rms_m: None };
        let name = format!("toile-bound-{bound_mm}mm");
        rows.add(&name, || Ok([bench.toile(&name, bound)?]))?;
    }
    let grid_mm = a.bound_mm.map_or(1e3 * kim.max_m, f64::from);
    rows.add("raw-zstd and meshopt-zstd", || without_basis(&source, &clock, grid_mm))?;
    for rank in [50, 100, 400] {
        rows.add(&format!("kim2013-r{rank}"), || Ok([bench.kim2013(rank)?]))?;
    }
    rows.add("full-simulation", || Ok(bench.full_simulation()))?;
    let spaces: Vec<Space> = if Instant::now() > end { Vec::new() } else { spaces(&bench)? };
    if let Some(folder) = &a.export {
        export(folder, &source, &bench.steps(both)?)?;
    }
    let (states, vertices) = (source.states(), source.vertices());
    let Rows { rows, left_out, .. } = rows;
    Ok(Outcome { source: "work folder", states, vertices, codecs: rows, spaces, left_out })
}

/// In which space columns hold states best that they were not made from.
fn spaces(bench: &Bench<'_>) -> Result<Vec<Space>> {
    let spaces: Vec<Space> = bench
        .spaces()?
        .into_iter()
        .map(|found| Space {
            space: found.space,
            rank: found.rank,
            rms_mm: 1e3 * found.rms_m,
            max_mm: 1e3 * found.max_m,
        })
        .collect();
    for Space { space, rank, rms_mm, max_mm } in &spaces {
        eprintln!("held out, {space}, rank {rank}: rms {rms_mm:.3} mm, max {max_mm:.2} mm");
    }
    Ok(spaces)
}

/// `states.f32` (state after state, x y z), `steps.i32` (state after state) and `shape.json`.
fn export(folder: &Path, source: &Source, steps: &Steps) -> Result<()> {
    let at = |name: &str| folder.join(name);
    let failed = || format!("writing to {}", folder.display());
    std::fs::create_dir_all(folder).with_context(failed)?;
    let mut out = BufWriter::new(File::create(at("states.f32")).with_context(failed)?);
    let mut block = Vec::new();
    for region in 0..source.regions() {
        source.read(region, &mut block)?;
        block.iter().try_for_each(|x| out.write_all(&x.to_le_bytes())).with_context(failed)?;
    }
    out.flush().with_context(failed)?;
    let mut out = BufWriter::new(File::create(at("steps.i32")).with_context(failed)?);
    steps.steps.iter().try_for_each(|x| out.write_all(&x.to_le_bytes())).with_context(failed)?;
    out.flush().with_context(failed)?;
    let shape = serde_json::json!({
        "vertices": source.vertices(),
        "columns": steps.columns,
        "regions": steps.regions,
        "toile_bytes": steps.bytes,
    });
    std::fs::write(at("shape.json"), shape.to_string()).with_context(failed)
}

/// Raw floats and zstd; meshoptimizer's vertex codec on a grid within a bound, and zstd.
fn without_basis(source: &Source, clock: &dyn Fn() -> f64, bound_mm: f64) -> Result<Vec<Row>> {
    let every = source.states().div_ceil(SAMPLE_STATES);
    // The largest error of a grid is half its diagonal.
    let grid_m = (bound_mm / 1e3 * 2.0 / 3f64.sqrt() * 0.999) as f32;
    let mut raw = Sum::new("raw-zstd");
    let mut grid = Sum::new(&format!("meshopt-zstd-{bound_mm:.1}mm"));
    let mut exact = Vec::new();
    for region in (0..source.regions()).step_by(every) {
        source.read(region, &mut exact)?;
        let bytes: Vec<u8> = exact.iter().flat_map(|x| x.to_le_bytes()).collect();
        let start = clock();
        let packed = zstd::bulk::compress(&bytes, ZSTD_LEVEL)?;
        raw.encode_s += clock() - start;
        let start = clock();
        let unpacked = zstd::bulk::decompress(&packed, bytes.len())?;
        let floats: Vec<f32> =
            unpacked.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        raw.decode_s += clock() - start;
        raw.add(packed.len(), &exact, &floats);
        for state in exact.chunks_exact(3 * source.vertices()) {
            grid.meshopt(state, grid_m, clock)?;
        }
    }
    let states = source.states() as u64;
    Ok([raw, grid].into_iter().map(|sum| sum.row(source.vertices(), states)).collect())
}

struct Sum {
    name: String,
    bytes: usize,
    vertices: usize,
    encode_s: f64,
    decode_s: f64,
    errors: Errors,
}

impl Sum {
    fn new(name: &str) -> Self {
        let (encode_s, decode_s) = (0.0, 0.0);
        Self {
            name: name.into(),
            bytes: 0,
            vertices: 0,
            encode_s,
            decode_s,
            errors: Errors::default(),
        }
    }

    fn add(&mut self, bytes: usize, exact: &[f32], decoded: &[f32]) {
        self.bytes += bytes;
        self.vertices += exact.len() / 3;
        self.errors.compare(exact, decoded);
    }

    fn meshopt(&mut self, exact: &[f32], grid_m: f32, clock: &dyn Fn() -> f64) -> Result<()> {
        let start = clock();
        let quantised: Vec<[i16; 4]> = exact
            .chunks_exact(3)
            .map(|p| [0, 1, 2, 3].map(|i| p.get(i).map_or(0, |x| (x / grid_m).round() as i16)))
            .collect();
        let encoded = meshopt::encode_vertex_buffer(&quantised)?;
        let packed = zstd::bulk::compress(&encoded, ZSTD_LEVEL)?;
        self.encode_s += clock() - start;
        let start = clock();
        let encoded = zstd::bulk::decompress(&packed, encoded.len())?;
        let back: Vec<[i16; 4]> = meshopt::decode_vertex_buffer(&encoded, quantised.len())?;
        let decoded: Vec<f32> =
            back.iter().flat_map(|v| [v[0], v[1], v[2]].map(|q| f32::from(q) * grid_m)).collect();
        self.decode_s += clock() - start;
        self.add(packed.len(), exact, &decoded);
        Ok(())
    }

    fn row(self, vertices: usize, states: u64) -> Row {
        let measured = (self.vertices / vertices) as f64;
        let bytes_per_frame = self.bytes as f64 / measured;
        Row {
            name: self.name,
            rank: 0,
            bytes_per_frame,
            basis_bytes: 0,
            resident_bytes: 0,
            total_bytes: (bytes_per_frame * states as f64) as u64,
            max_mm: 1e3 * self.errors.max_m(),
            p999_mm: 1e3 * self.errors.quantile_m(0.999),
            rms_mm: 1e3 * self.errors.rms_m(),
            encode_ms: 1e3 * self.encode_s / measured,
            decode_us: 1e6 * self.decode_s / measured,
            fixed_share: 0.0,
        }
    }
}

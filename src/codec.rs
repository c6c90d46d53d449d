//! `toile codec bench`: codecs side by side on the states of an explored store.

use std::time::Instant;

use anyhow::{Context, Result, ensure};
use explorer::pack::Bound;
use explorer::pack::bench::{Bench, Errors, Measured, Source};
use serde::Serialize;

use crate::{args, format, place, store};

/// States on which the codecs without a basis are measured, at most: each stands for itself.
const SAMPLE_STATES: usize = 384;
/// Level of zstd beside them.
const ZSTD_LEVEL: i32 = 12;

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

/// Measures and prints.
pub fn bench(a: &args::CodecBench) -> Result<()> {
    let outcome = measure(a)?;
    if a.json {
        return format::print_json(&outcome);
    }
    println!(
        "{} states of {} vertices, exact, from the {}",
        outcome.states, outcome.vertices, outcome.source
    );
    println!(
        "{:<34} {:>5} {:>9} {:>10} {:>11} {:>8} {:>8} {:>7} {:>9} {:>9}",
        "codec",
        "rank",
        "B/frame",
        "basis B",
        "total B",
        "max mm",
        "p999 mm",
        "rms mm",
        "encode ms",
        "decode us"
    );
    for row in &outcome.codecs {
        println!(
            "{:<34} {:>5} {:>9.1} {:>10} {:>11} {:>8.2} {:>8.2} {:>7.3} {:>9.3} {:>9.1}",
            row.name,
            row.rank,
            row.bytes_per_frame,
            row.basis_bytes,
            row.total_bytes,
            row.max_mm,
            row.p999_mm,
            row.rms_mm,
            row.encode_ms,
            row.decode_us
        );
    }
    Ok(())
}

/// Measures all codecs, the slowest of which take a millisecond or two a state.
pub fn measure(a: &args::CodecBench) -> Result<Outcome> {
    if let Some(bound) = a.bound_mm {
        ensure!(bound.is_finite() && bound >= 0.01, "--bound-mm {bound}: at least 0.01");
    }
    let opened = store::open_store(&a.store)?;
    let work = place::work(&opened, a.work.clone())?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let source = runtime.block_on(Source::open(&*opened.store, &work, a.states))?;
    let start = Instant::now();
    let clock = || start.elapsed().as_secs_f64();
    let bench = Bench::new(&source, &clock)?;
    let said = |row: &Measured| {
        eprintln!(
            "{}: {:.1} B/frame, max {:.1} mm",
            row.name,
            row.bytes_per_frame,
            1e3 * row.max_m
        );
    };
    let mut codecs = Vec::new();
    let mut kim200 = None;
    for rank in [50, 100, 200, 400] {
        let row = bench.kim2013(rank)?;
        said(&row);
        if rank == 200 {
            kim200 = Some(row.clone());
        }
        codecs.push(row);
    }
    let kim = kim200.context("rank 200 is among the ranks")?;
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
        codecs.push(bench.toile(name, bound)?);
        codecs.last().into_iter().for_each(said);
    }
    codecs.push(bench.toile_of_bytes("toile-equal-bytes-r200", kim.total_bytes)?);
    codecs.push(bench.leading("toile-first-cloth", both)?);
    if let Some(bound_mm) = a.bound_mm {
        let bound = Bound { max_m: Some(bound_mm / 1e3), rms_m: None };
        codecs.push(bench.toile(&format!("toile-bound-{bound_mm}mm"), bound)?);
    }
    let grid_mm = a.bound_mm.map_or(1e3 * kim.max_m, f64::from);
    let mut rows = without_basis(&source, grid_mm)?;
    rows.extend(codecs.into_iter().map(Row::from));
    let (states, vertices) = (source.states(), source.vertices());
    Ok(Outcome { source: "work folder", states, vertices, codecs: rows })
}

/// Raw floats and zstd; meshoptimizer's vertex codec on a grid within a bound, and zstd.
fn without_basis(source: &Source, bound_mm: f64) -> Result<Vec<Row>> {
    let every = source.states().div_ceil(SAMPLE_STATES);
    // The largest error of a grid is half its diagonal.
    let grid_m = (bound_mm / 1e3 * 2.0 / 3f64.sqrt() * 0.999) as f32;
    let mut raw = Sum::new("raw-zstd");
    let mut grid = Sum::new(&format!("meshopt-zstd-{bound_mm:.1}mm"));
    let mut exact = Vec::new();
    for region in (0..source.regions()).step_by(every) {
        source.read(region, &mut exact)?;
        let bytes: Vec<u8> = exact.iter().flat_map(|x| x.to_le_bytes()).collect();
        let start = Instant::now();
        let packed = zstd::bulk::compress(&bytes, ZSTD_LEVEL)?;
        raw.encode_s += start.elapsed().as_secs_f64();
        let start = Instant::now();
        let unpacked = zstd::bulk::decompress(&packed, bytes.len())?;
        let floats: Vec<f32> =
            unpacked.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        raw.decode_s += start.elapsed().as_secs_f64();
        raw.add(packed.len(), &exact, &floats);
        for state in exact.chunks_exact(3 * source.vertices()) {
            grid.meshopt(state, grid_m)?;
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

    fn meshopt(&mut self, exact: &[f32], grid_m: f32) -> Result<()> {
        let start = Instant::now();
        let quantised: Vec<[i16; 4]> = exact
            .chunks_exact(3)
            .map(|p| [0, 1, 2, 3].map(|i| p.get(i).map_or(0, |x| (x / grid_m).round() as i16)))
            .collect();
        let encoded = meshopt::encode_vertex_buffer(&quantised)?;
        let packed = zstd::bulk::compress(&encoded, ZSTD_LEVEL)?;
        self.encode_s += start.elapsed().as_secs_f64();
        let start = Instant::now();
        let encoded = zstd::bulk::decompress(&packed, encoded.len())?;
        let back: Vec<[i16; 4]> = meshopt::decode_vertex_buffer(&encoded, quantised.len())?;
        let decoded: Vec<f32> =
            back.iter().flat_map(|v| [v[0], v[1], v[2]].map(|q| f32::from(q) * grid_m)).collect();
        self.decode_s += start.elapsed().as_secs_f64();
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

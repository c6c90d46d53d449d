//! `toile codec bench --generations`: a growing graph, and a new basis at its end.

use anyhow::Result;
use explorer::cpu::CpuClock;
use explorer::pack::Bound;
use explorer::pack::bench::{Batch, Growth, Rebase};
use serde::Serialize;

use crate::{args, format};

/// Appended versions.
const BATCHES: usize = 10;

/// The promised keys.
#[derive(Debug, Serialize)]
struct Outcome {
    /// The first version, then the appended ones.
    generations: Vec<Version>,
    /// Columns beyond those of a basis made at once.
    extra_rank: i64,
    rebase: Rebased,
}

#[derive(Debug, Serialize)]
struct Version {
    states: u64,
    columns: usize,
    generation_bytes: u64,
    region_bytes: u64,
    pushed_bytes: u64,
    max_mm: f64,
    rms_mm: f64,
    rebase_pays: bool,
}

#[derive(Debug, Serialize)]
struct Rebased {
    columns_before: usize,
    columns: usize,
    bytes_before: u64,
    bytes: u64,
    basis_bytes: u64,
    cpu_s: f64,
    max_mm_before: f64,
    max_mm: f64,
    rms_mm_before: f64,
    rms_mm: f64,
}

impl From<&Batch> for Version {
    fn from(batch: &Batch) -> Self {
        Self {
            states: batch.states,
            columns: batch.columns,
            generation_bytes: batch.generation_bytes,
            region_bytes: batch.region_bytes,
            pushed_bytes: batch.generation_bytes + batch.region_bytes,
            max_mm: 1e3 * batch.max_m,
            rms_mm: 1e3 * batch.rms_m,
            rebase_pays: batch.rebase_pays,
        }
    }
}

impl From<&Rebase> for Rebased {
    fn from(rebase: &Rebase) -> Self {
        Self {
            columns_before: rebase.columns_before,
            columns: rebase.columns,
            bytes_before: rebase.bytes_before,
            bytes: rebase.bytes,
            basis_bytes: rebase.basis_bytes,
            cpu_s: rebase.time_s,
            max_mm_before: 1e3 * rebase.max_m[0],
            max_mm: 1e3 * rebase.max_m[1],
            rms_mm_before: 1e3 * rebase.rms_m[0],
            rms_mm: 1e3 * rebase.rms_m[1],
        }
    }
}

/// Measures and prints.
pub(super) fn run(a: &args::CodecBench) -> Result<()> {
    let source = super::source(&a.store, a.work.as_ref(), a.states)?;
    let clock = CpuClock::start();
    let max_m = a.bound_mm.map_or(Bound::LIVE.max_m, |mm| Some(mm / 1e3));
    let bound = Bound { max_m, rms_m: None };
    let say = super::progress();
    let growth = Growth::measure(&source, bound, BATCHES, &|| clock.elapsed_s(), &say)?;
    let rebase = Rebased::from(&growth.rebase);
    let outcome = Outcome {
        generations: growth.versions.iter().map(Version::from).collect(),
        extra_rank: rebase.columns_before as i64 - rebase.columns as i64,
        rebase,
    };
    if a.json {
        return format::print_json(&outcome);
    }
    println!("states columns generation B   region B  max mm  rms mm  a new basis pays");
    for v in &outcome.generations {
        println!(
            "{:>6} {:>7} {:>12} {:>10} {:>7.2} {:>7.3}  {}",
            v.states,
            v.columns,
            v.generation_bytes,
            v.region_bytes,
            v.max_mm,
            v.rms_mm,
            if v.rebase_pays { "yes" } else { "no" }
        );
    }
    let r = &outcome.rebase;
    println!(
        "re-base: {} columns -> {}, {} B so far, {} B to fetch ({} B basis), {:.1} s of processor \
         time, max {:.2} -> {:.2} mm, rms {:.3} -> {:.3} mm",
        r.columns_before,
        r.columns,
        r.bytes_before,
        r.bytes,
        r.basis_bytes,
        r.cpu_s,
        r.max_mm_before,
        r.max_mm,
        r.rms_mm_before,
        r.rms_mm
    );
    Ok(())
}

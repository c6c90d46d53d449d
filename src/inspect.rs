//! `toile inspect`.

use anyhow::{Context, Result};
use explorer::pack::inspect::{GarmentInspection, inspect};
use serde::Serialize;

use crate::{args, format, store};

/// The promised keys.
#[derive(Debug, Serialize)]
struct Summary<'a> {
    garment: &'a str,
    version: u64,
    poses: usize,
    states: u64,
    regions: usize,
    merges: u64,
    worst_error_mm: f32,
    mean_error_mm: f64,
    total: bool,
    rank: usize,
    generations: usize,
    codec_max_error_mm: f32,
    codec_rms_error_mm: f32,
    basis_bytes: u64,
    region_bytes: u64,
    link_bytes: u64,
    raw_bytes: u64,
}

/// Verifies the head of a store and prints what is in it. A table that is not total is an error.
pub fn run(a: &args::Inspect) -> Result<()> {
    let opened = store::open_store(&a.store)?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let found = runtime
        .block_on(inspect(&*opened.store, None))
        .with_context(|| format!("store {}", a.store))?;
    for garment in &found.garments {
        let summary = summary(found.version.0, garment);
        if a.json {
            format::print_json(&summary)?;
        } else {
            print(&summary);
        }
        if let Some(reason) = &garment.not_total {
            anyhow::bail!("garment {}: not total: {reason}", garment.name);
        }
    }
    Ok(())
}

fn summary(version: u64, garment: &GarmentInspection) -> Summary<'_> {
    Summary {
        garment: &garment.name,
        version,
        poses: garment.poses,
        states: garment.states,
        regions: garment.regions,
        merges: garment.merges,
        worst_error_mm: garment.worst_error_mm,
        mean_error_mm: format::mm(garment.stats.mean_error_m),
        total: garment.total,
        rank: garment.rank,
        generations: garment.generations,
        codec_max_error_mm: garment.codec_max_error_mm,
        codec_rms_error_mm: garment.codec_rms_error_mm,
        basis_bytes: garment.basis_bytes,
        region_bytes: garment.region_bytes,
        link_bytes: garment.link_bytes,
        raw_bytes: garment.raw_bytes,
    }
}

fn print(s: &Summary<'_>) {
    println!("garment   {} (version {}, signature and every chunk verified)", s.garment, s.version);
    println!("graph     {} states over {} poses, {} merges", s.states, s.poses, s.merges);
    println!("total     {}", if s.total { "yes, checked" } else { "NO" });
    println!("merges    worst {:.1} mm, mean {:.1} mm", s.worst_error_mm, s.mean_error_mm);
    println!(
        "codec     rank {} in {} generations; max {:.1} mm, RMS {:.2} mm",
        s.rank, s.generations, s.codec_max_error_mm, s.codec_rms_error_mm
    );
    println!(
        "bytes     basis {}, {} regions {}, links {}; raw {}",
        format::bytes(s.basis_bytes),
        s.regions,
        format::bytes(s.region_bytes),
        format::bytes(s.link_bytes),
        format::bytes(s.raw_bytes)
    );
}

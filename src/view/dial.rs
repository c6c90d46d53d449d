//! The dial: how many columns of the basis a given error asks for, and what they cost.
//!
//! Every region states what its shorter lists of columns cost. A client that is allowed an error takes,
//! region by region, the shortest list that keeps within it.

use std::time::Instant;

use anyhow::Result;
use client_lib::{Character, Histogram, PoseId, TIERS};
use serde::Serialize;

/// States that stand for all, spread over the poses.
const SAMPLES: usize = 64;

/// What the tiers of a version state, and what they cost here.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Tiers {
    /// Columns of each tier, at last all.
    columns: Vec<usize>,
    /// Median time of decoding a frame with each (ms).
    decode_ms: Vec<f64>,
    /// Part of the basis that each reads at the scene's rate (MB/s).
    read_mb_s: Vec<f64>,
    /// Stated errors of each tier but the last, for states spread over the poses (mm).
    stated_mm: Vec<Vec<f32>>,
    /// Coefficients that are streamed for cloth never seen before (kB/s): regions come whole.
    kb_s: f64,
}

/// The tiers of a character's version; without any where its publisher states none.
///
/// Cost: 64 decodings for each of five tiers.
///
/// # Errors
/// A basis that cannot be applied; no version that was taken up has one.
pub fn tiers(character: &Character) -> Result<Tiers> {
    let version = character.version();
    let (basis, scene) = (version.basis(), version.scene());
    let (rows, all) = (basis.rows(), basis.columns());
    let poses = scene.pose_count();
    let count = TIERS.iter().filter(|columns| **columns < all).count();
    let mut spent_ms = vec![Histogram::default(); count + 1];
    let (mut coefficients, mut out) = (vec![0.0; all], vec![0.0f32; rows]);
    let mut stated_mm = Vec::new();
    for sample in 0..SAMPLES.min(poses) {
        let pose = PoseId((sample * poses / SAMPLES.min(poses)) as u32);
        let here = version.links().interior(pose).iter();
        let Some(state) = here.copied().find(|s| character.read(*s, &mut coefficients)) else {
            continue;
        };
        let mut stated = Vec::new();
        for (columns, spent_ms) in TIERS[..count].iter().zip(&mut spent_ms) {
            let Some(tier) = character.tier_of(state, *columns) else { break };
            stated.push(tier.error_m * 1e3);
            let mut columns = tier.columns.to_vec();
            columns.sort_unstable();
            let start = Instant::now();
            basis.reconstruct(&coefficients, 0..rows, &columns[..], &mut out)?;
            spent_ms.record(start.elapsed().as_secs_f64() * 1e3);
        }
        let start = Instant::now();
        basis.reconstruct(&coefficients, 0..rows, all, &mut out)?;
        spent_ms[count].record(start.elapsed().as_secs_f64() * 1e3);
        if stated.len() == count {
            stated_mm.push(stated);
        }
    }
    if stated_mm.is_empty() {
        return Ok(Tiers::default());
    }
    let stored: u64 = version.listing().regions.iter().map(|r| u64::from(r.chunk.bytes)).sum();
    let states: u64 = version.listing().regions.iter().map(|r| u64::from(r.state_count)).sum();
    let fps = f64::from(scene.fps());
    let columns: Vec<usize> = TIERS[..count].iter().copied().chain([all]).collect();
    let share = |columns: &usize| *columns as f64 / all.max(1) as f64;
    let read = basis.resident_bytes() as f64 * fps / 1e6;
    Ok(Tiers {
        read_mb_s: columns.iter().map(|columns| read * share(columns)).collect(),
        decode_ms: spent_ms.iter().map(|spent_ms| spent_ms.percentile(0.5)).collect(),
        kb_s: stored as f64 / states.max(1) as f64 * fps / 1e3,
        columns,
        stated_mm,
    })
}

//! The dial: how many columns of the basis a given error asks for, and what they cost.

use std::time::Instant;

use anyhow::Result;
use client_lib::{Character, Histogram, PoseId};
use serde::Serialize;

/// States on which the error of leaving columns out is measured, spread over the poses.
const SAMPLES: usize = 16;
/// Ranks that are tried beside all columns: a factor of about 1.4 apart.
const RANKS: [usize; 14] = [4, 6, 8, 12, 16, 24, 32, 50, 70, 100, 140, 200, 280, 400];

/// What a number of columns means, measured.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Point {
    /// Leading columns that are decoded.
    pub columns: usize,
    /// Largest distance of any vertex from all columns (mm).
    pub max_mm: f32,
    /// Root mean square of the same (mm).
    pub rms_mm: f32,
    /// Median time of decoding one frame (ms).
    pub decode_ms: f64,
    /// Coefficients as they are stored, at the scene's rate (kB/s).
    pub kb_s: f64,
}

/// The curve for a character's version, from few columns to all.
///
/// Cost: about 16 decodings for each of 15 points.
pub fn curve(character: &Character) -> Result<Vec<Point>> {
    let version = character.version();
    let (basis, scene) = (version.basis(), version.scene());
    let (rows, all) = (basis.rows(), basis.columns());
    let poses = scene.pose_count();
    let mut states = Vec::new();
    for sample in 0..SAMPLES {
        let pose = PoseId((sample * poses / SAMPLES) as u32);
        let mut coefficients = vec![0.0; all];
        let here = version.links().interior(pose).iter();
        if here.clone().any(|state| character.read(*state, &mut coefficients)) {
            states.push(coefficients);
        }
    }
    let stored: u64 = version.listing().regions.iter().map(|r| u64::from(r.chunk.bytes)).sum();
    let count: u64 = version.listing().regions.iter().map(|r| u64::from(r.state_count)).sum();
    let state_bytes = stored as f64 / count.max(1) as f64;
    let (mut full, mut part) = (vec![0.0f32; rows], vec![0.0f32; rows]);
    let mut points = Vec::new();
    for columns in RANKS.into_iter().filter(|rank| *rank < all).chain([all]) {
        let (mut max, mut sum, mut vertices) = (0.0f32, 0.0f64, 0usize);
        let mut spent_ms = Histogram::default();
        for coefficients in &states {
            basis.reconstruct(coefficients, 0..rows, all, &mut full)?;
            let start = Instant::now();
            basis.reconstruct(coefficients, 0..rows, columns, &mut part)?;
            spent_ms.record(start.elapsed().as_secs_f64() * 1e3);
            let ((full, _), (part, _)) = (full.as_chunks::<3>(), part.as_chunks::<3>());
            for (a, b) in full.iter().zip(part) {
                let square: f32 = a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum();
                max = max.max(square);
                sum += f64::from(square);
            }
            vertices += full.len();
        }
        let share = columns as f64 / all.max(1) as f64;
        points.push(Point {
            columns,
            max_mm: max.sqrt() * 1e3,
            rms_mm: (sum / vertices.max(1) as f64).sqrt() as f32 * 1e3,
            decode_ms: spent_ms.percentile(0.5),
            kb_s: state_bytes * share * f64::from(scene.fps()) / 1e3,
        });
    }
    Ok(points)
}

/// The fewest columns whose largest error stays below `mm`.
pub fn columns_for(curve: &[Point], mm: f32) -> usize {
    curve.iter().find(|point| point.max_mm <= mm).map_or(usize::MAX, |point| point.columns)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fewest_columns_that_are_good_enough() {
        let point =
            |columns, max_mm| Point { columns, max_mm, rms_mm: 0.0, decode_ms: 0.0, kb_s: 0.0 };
        let curve = [point(4, 90.0), point(8, 30.0), point(16, 5.0), point(20, 0.0)];
        assert_eq!([100.0, 30.0, 29.0, 0.0].map(|mm| columns_for(&curve, mm)), [4, 8, 16, 20]);
        assert_eq!(columns_for(&[], 1.0), usize::MAX);
    }
}

//! What was measured on a walk, added up.

use serde::Serialize;

use super::{Step, Straight};
use crate::simulator::FrameQuality;

/// Strains are counted in bins of this width, from the first to the second limit; what lies
/// beyond counts in the outermost bins.
const BIN: f32 = 1e-4;
const STRAINS: [f32; 2] = [-0.2, 0.3];
const BINS: usize = 5000;
/// A frame is slow beyond this many medians.
const SLOW: f64 = 10.0;

/// Adds up steps.
#[derive(Debug, Clone)]
pub struct Tally {
    quality: FrameQuality,
    cpu_s: Vec<f64>,
    strains: Vec<u64>,
}

/// The sum; the keys are those of `toile simulate --json`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Sum {
    /// Frames simulated, the drape apart.
    pub frames: u64,
    /// CPU time of all (s).
    pub cpu_s: f64,
    /// CPU time of a frame (s): median,
    pub cpu_s_median: f64,
    /// nine of ten are below,
    pub cpu_s_p90: f64,
    /// 99 of 100 are below,
    pub cpu_s_p99: f64,
    /// the longest.
    pub cpu_s_max: f64,
    /// Share of vertex-frames deeper than 1 mm in the body, those held between body parts apart,
    pub deep_1mm_share: f64,
    /// the same for 5 mm,
    pub deep_5mm_share: f64,
    /// and those that are held between two body parts and deeper than 1 mm.
    pub pinched_share: f64,
    /// Deepest vertex that is not held between body parts (mm).
    pub depth_max_mm: f32,
    /// Pairs of an edge and a triangle of the cloth that cut each other, in all frames,
    pub self_hits: u64,
    /// and the frames in which there are any.
    pub self_hit_frames: u64,
    /// 99 of 100 edges of all frames are strained less (%).
    pub stretch_p99_pct: f32,
    /// Largest strain of an edge (%).
    pub stretch_max_pct: f32,
    /// Fastest vertex (m/s).
    pub speed_max_m_s: f32,
    /// Frames that were simulated again at a finer step.
    pub frames_retried: u64,
    /// Frames that came out of bounds all the same.
    pub frames_flagged: u64,
    /// Frames that took more than ten times the median.
    pub frames_slow: u64,
    /// Substeps of a frame, on average.
    pub substeps_mean: f64,
    /// Iterations of conjugate gradients of a frame, on average.
    pub iterations_mean: f64,
}

impl Default for Tally {
    /// Of nothing.
    fn default() -> Self {
        Self { quality: FrameQuality::default(), cpu_s: Vec::new(), strains: vec![0; BINS] }
    }
}

impl Tally {
    /// Adds a step of a walk, just made.
    pub fn add(&mut self, step: &Step, walk: &Straight<'_>) {
        self.quality.add(&step.quality);
        self.cpu_s.push(step.cpu_s);
        for strain in walk.strains() {
            let bin = ((strain - STRAINS[0]) / BIN).max(0.0) as usize;
            self.strains[bin.min(BINS - 1)] += 1;
        }
    }

    /// Measures so far.
    pub fn quality(&self) -> &FrameQuality {
        &self.quality
    }

    /// The sum so far.
    pub fn sum(&self) -> Sum {
        let q = &self.quality;
        let mut sorted = self.cpu_s.clone();
        sorted.sort_unstable_by(f64::total_cmp);
        let share = |part: u64| part as f64 / q.vertex_frames.max(1) as f64;
        let mean = |sum: u64| sum as f64 / q.frames.max(1) as f64;
        let median = quantile(&sorted, 0.5);
        let slow = sorted.iter().filter(|s| **s > SLOW * median).count() as u64;
        Sum {
            frames: q.frames,
            cpu_s: sorted.iter().sum(),
            cpu_s_median: median,
            cpu_s_p90: quantile(&sorted, 0.9),
            cpu_s_p99: quantile(&sorted, 0.99),
            cpu_s_max: quantile(&sorted, 1.0),
            deep_1mm_share: share(q.inside_vertex_frames),
            deep_5mm_share: share(q.deep_vertex_frames),
            pinched_share: share(q.pinched_vertex_frames),
            depth_max_mm: q.depth_max_m * 1e3,
            self_hits: q.crossings,
            self_hit_frames: q.crossed_frames,
            stretch_p99_pct: self.strain_quantile(0.99) * 100.0,
            stretch_max_pct: q.stretch_max * 100.0,
            speed_max_m_s: q.speed_max_m_s,
            frames_retried: q.frames_retried,
            frames_flagged: q.frames_flagged,
            frames_slow: slow,
            substeps_mean: mean(q.substeps),
            iterations_mean: mean(q.iterations),
        }
    }

    /// The strain below which a share of all edges of all frames lies, to within a bin.
    fn strain_quantile(&self, share: f64) -> f32 {
        let all: u64 = self.strains.iter().sum();
        let wanted = (all as f64 * share).ceil() as u64;
        let mut below = 0;
        for (bin, count) in self.strains.iter().enumerate() {
            below += count;
            if below >= wanted && below > 0 {
                return STRAINS[0] + (bin + 1) as f32 * BIN;
            }
        }
        0.0
    }
}

/// The value below which a share of the sorted ones lies (nearest rank); 0 for none.
pub(super) fn quantile(sorted: &[f64], share: f64) -> f64 {
    let rank = (sorted.len() as f64 * share).ceil() as usize;
    sorted.get(rank.saturating_sub(1)).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_the_nearest_rank() {
        let values: Vec<f64> = (1..=200).map(f64::from).collect();
        let at = |share| quantile(&values, share) as u32;
        assert_eq!([at(0.5), at(0.9), at(0.99), at(1.0)], [100, 180, 198, 200]);
        assert_eq!((quantile(&[], 0.5) as u32, quantile(&[3.0], 0.01) as u32), (0, 3));
        let mut tally = Tally::default();
        tally.strains[2100] = 99;
        tally.strains[2900] = 1;
        assert!((tally.strain_quantile(0.99) - 0.0101).abs() < 1e-6);
        assert!((tally.strain_quantile(1.0) - 0.0901).abs() < 1e-6);
    }
}

//! U as a client holds it: rounded where the error allows, and what applying it takes.

use std::time::Instant;

use codec::kernel::operator::Operator;
use codec::upsample::Weights;
use faer::{Mat, MatRef};
use serde::Serialize;

use super::data::{Frames, narrow};
use super::learn::{LearnError, Lesson};
use super::modes::with_modes;
use super::report::{Method, rows};

/// Rounding may cost this share of what the operator is off by itself on the training motion.
const SHARE: f64 = 0.15;
/// Bits that are tried, fewest first.
const BITS: [u8; 4] = [8, 12, 14, 16];
/// Calls of the operator that are timed, with its weights in cache and out of it.
const CALLS: [usize; 2] = [200, 15];
/// Read between two calls so that nothing of the operator is left in a cache (bytes).
const EVICT_BYTES: usize = 128 << 20;

/// What a number of bits costs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Rounding {
    /// Bits of a weight.
    pub bits: u8,
    /// Whether weights were rounded along the training motion's coarse positions, or each by itself.
    pub along: bool,
    /// Root mean square distance from the unrounded operator on the training motion (mm).
    pub rms_mm: f64,
    /// Largest one (mm).
    pub max_mm: f64,
    /// Largest root mean square distance on another motion (mm).
    pub others_rms_mm: f64,
}

/// What an operator takes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cost {
    /// Bits of a weight.
    pub bits: u8,
    /// Time of U p with U in cache (us, median).
    pub hot_us: f64,
    /// With U in memory (us, median).
    pub cold_us: f64,
    /// Bytes as a client holds it.
    pub bytes: usize,
}

/// Sum over frames and axes of coarse positions times themselves (m^2), row after row.
pub fn products(frames: &Frames) -> Vec<f64> {
    let m = frames.coarse.nrows();
    let square = &frames.coarse * frames.coarse.transpose();
    (0..m * m).map(|at| square[(at / m, at % m)]).collect()
}

/// Rounded as few bits as the error allows.
///
/// # Errors
/// Weights that cannot be rounded.
pub fn stored(operator: MatRef<'_, f32>, frames: &Frames) -> Result<Weights, LearnError> {
    let gram = products(frames);
    let positions = narrow(frames.coarse.as_ref());
    let off = operator * &positions - &frames.fine;
    let allowed = SHARE * SHARE * f64::from(off.squared_norm_l2());
    let weights = rows(operator);
    let mut last = None;
    for bits in BITS {
        let rounded = Weights::round_along(operator.ncols(), &weights, bits, &gram)?;
        let lost = (unrounded(&rounded, operator) - operator) * &positions;
        let enough = f64::from(lost.squared_norm_l2()) <= allowed;
        last = Some(rounded);
        if enough {
            break;
        }
    }
    last.ok_or(LearnError::NoOperator)
}

fn unrounded(weights: &Weights, operator: MatRef<'_, f32>) -> Mat<f32> {
    let m = operator.ncols();
    Mat::from_fn(operator.nrows(), m, |i, j| f32::from(weights.steps[i * m + j]) * weights.units[i])
}

/// Root mean square and largest distance (mm) that differences of weights make.
fn distance(off: &Mat<f32>, frames: &Frames) -> [f64; 2] {
    let off = off * narrow(frames.coarse.as_ref());
    let (mut sum, mut most) = (0.0f64, 0.0f64);
    for c in (0..off.ncols()).step_by(3) {
        for i in 0..off.nrows() {
            let square: f64 = (c..c + 3).map(|c| f64::from(off[(i, c)]).powi(2)).sum();
            sum += square;
            most = most.max(square);
        }
    }
    [1e3 * (sum / (off.nrows() * off.ncols() / 3).max(1) as f64).sqrt(), 1e3 * most.sqrt()]
}

/// Median time of a call (us).
fn median<T>(mut call: impl FnMut() -> T) -> f64 {
    let one = |_| {
        let start = Instant::now();
        std::hint::black_box(call());
        1e6 * start.elapsed().as_secs_f64()
    };
    let mut times: Vec<f64> = (0..CALLS[0]).map(one).collect();
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

impl Lesson {
    /// Median time of a method on a frame (us), as a game would apply it.
    ///
    /// # Errors
    /// Weights that cannot be rounded.
    pub(super) fn time(&self, method: &Method) -> Result<f64, LearnError> {
        match method {
            Method::Linear(operator) | Method::History(operator) => Ok(self.cost(operator)?.hot_us),
            Method::Modes(operator, modes) => {
                let frame = operator * narrow(self.training().part(0, 1).coarse.as_ref());
                let triangles = self.scene.fine.mesh.triangles();
                Ok(self.cost(operator)?.hot_us + median(|| with_modes(&frame, modes, triangles)))
            }
            Method::Blended(blend) => {
                let mut sum = 0.0;
                for operator in blend.operators() {
                    sum += self.cost(operator)?.hot_us;
                }
                Ok(sum)
            }
        }
    }

    /// Time of U p hot and cold, and its bytes.
    pub(super) fn cost(&self, operator: &Mat<f32>) -> Result<Cost, LearnError> {
        let history = self.training().with_history();
        let whole = operator.ncols() > self.training().points;
        let frames = if whole { &history } else { self.training() };
        let weights = stored(operator.as_ref(), frames)?;
        let (bits, ones) = (weights.bits, vec![1.0; operator.nrows()]);
        let packed = Operator::from_steps(operator.ncols(), &weights.steps, weights.units, ones)?;
        let coarse: Vec<f32> =
            (0..3 * operator.ncols()).map(|at| frames.coarse[(at / 3, at % 3)] as f32).collect();
        let mut fine = vec![0.0; 3 * operator.nrows()];
        let other = vec![1u64; EVICT_BYTES / 8];
        let mut medians = [0.0; 2];
        for (cold, median) in medians.iter_mut().enumerate() {
            let mut times = Vec::new();
            for _ in 0..CALLS[cold] {
                if cold == 1 {
                    std::hint::black_box(other.iter().sum::<u64>());
                }
                let start = Instant::now();
                packed.apply(&coarse, &mut fine)?;
                times.push(start.elapsed().as_secs_f64());
            }
            times.sort_by(f64::total_cmp);
            *median = 1e6 * times[times.len() / 2];
        }
        let bytes = packed.resident_bytes();
        Ok(Cost { bits, hot_us: medians[0], cold_us: medians[1], bytes })
    }

    /// What numbers of bits cost, weights rounded by themselves and along the training motion.
    pub(super) fn rounding(&self, operator: &Mat<f32>) -> Result<Vec<Rounding>, LearnError> {
        let gram = products(self.training());
        let weights = rows(operator.as_ref());
        let m = operator.ncols();
        let mut out = Vec::new();
        for (bits, along) in [(8, false), (12, false), (16, false), (8, true), (12, true)] {
            let rounded = if along {
                Weights::round_along(m, &weights, bits, &gram)?
            } else {
                Weights::round(m, &weights, bits)?
            };
            let off = unrounded(&rounded, operator.as_ref()) - operator;
            let [rms_mm, max_mm] = distance(&off, self.training());
            let others = self.frames.iter().skip(1).map(|frames| distance(&off, frames)[0]);
            let others_rms_mm = others.fold(0.0, f64::max);
            out.push(Rounding { bits, along, rms_mm, max_mm, others_rms_mm });
        }
        Ok(out)
    }
}

//! How far upsampled cloth is from the fine simulation.

use faer::{Mat, MatRef};
use serde::Serialize;

use super::data::narrow;
use super::fit::functions;
use super::harmonics::Harmonics;

/// Errors over all vertices and frames of a motion.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Errors {
    /// Root mean square distance (mm).
    pub rms_mm: f64,
    /// Largest distance (mm).
    pub max_mm: f64,
    /// Root mean square of what is left of the error without its part in the lowest M harmonics, M
    /// being the number of coarse points (mm): detail finer than the coarse mesh can carry.
    pub high_frequency_mm: f64,
}

/// Judges positions against the fine ones.
#[derive(Debug, Clone)]
pub struct Judge {
    /// The lowest M harmonics, N x M, and the same weighted.
    low: Mat<f32>,
    weighted: Mat<f32>,
}

impl Judge {
    /// For a coarse mesh with `coarse` points.
    pub fn new(harmonics: &Harmonics, coarse: usize) -> Self {
        let low = narrow(functions(harmonics, coarse).as_ref());
        let weighted =
            Mat::from_fn(low.nrows(), low.ncols(), |i, j| low[(i, j)] * harmonics.weights[i]);
        Self { low, weighted }
    }

    /// Errors of `upsampled` against `fine`, both one column a frame and axis.
    pub fn judge(&self, upsampled: MatRef<'_, f32>, fine: MatRef<'_, f32>) -> Errors {
        let off = upsampled - fine;
        let (n, frames) = (fine.nrows(), fine.ncols() / 3);
        let mut most = 0.0f64;
        let mut sum = 0.0f64;
        for frame in 0..frames {
            for i in 0..n {
                let axis = |a: usize| f64::from(off[(i, 3 * frame + a)]);
                let square = axis(0).powi(2) + axis(1).powi(2) + axis(2).powi(2);
                sum += square;
                most = most.max(square);
            }
        }
        let high = &off - &self.low * (self.weighted.transpose() * &off);
        let mean = |sum: f64| 1e3 * (sum / (n * frames).max(1) as f64).sqrt();
        let squares: f64 =
            high.col_iter().map(|c| c.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>()).sum();
        Errors { rms_mm: mean(sum), max_mm: 1e3 * most.sqrt(), high_frequency_mm: mean(squares) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::upsample::harmonics::harmonics;
    use crate::upsample::patch::Patch;
    use cloth::Vec3;

    #[test]
    fn a_shift_is_a_low_error_and_a_checkerboard_a_high_one() {
        let at = |u: f32, v: f32| Vec3::new(u, -v, 0.0);
        let mesh = Patch::new([15, 15], false, at, |_, _| false).unwrap().mesh;
        let judge = Judge::new(&harmonics(&mesh, 30).unwrap(), 20);
        let fine = Mat::<f32>::zeros(256, 3);
        let shift = Mat::from_fn(256, 3, |_, c| if c == 1 { 0.01 } else { 0.0 });
        let found = judge.judge(shift.as_ref(), fine.as_ref());
        assert!((found.rms_mm - 10.0).abs() < 1e-3 && (found.max_mm - 10.0).abs() < 1e-3);
        assert!(found.high_frequency_mm < 0.05, "{found:?}");
        let chess = |i: usize| if (i / 16 + i % 16).is_multiple_of(2) { 0.01 } else { -0.01 };
        let rough = Mat::from_fn(256, 3, |i, c| if c == 2 { chess(i) } else { 0.0 });
        let found = judge.judge(rough.as_ref(), fine.as_ref());
        assert!(found.high_frequency_mm > 9.0, "{found:?}");
    }
}

//! Parameters of every method, by cross-validation over blocks of time of the training motion.
//! Nothing here ever sees another motion.
//!
//! Rows of a harmonic operator are independent, so one table of held-out errors, a row and a
//! penalty, prices every profile at once: trying one is a walk over the table.

use faer::{Mat, MatRef};

use super::data::{Frames, Normal, narrow, wide};
use super::fit::{FitError, Profile, functions};
use super::harmonics::Harmonics;

/// Blocks of time.
const BLOCKS: usize = 4;
/// Frames left out on both sides of the held-out block: neighbours in time are nearly the same.
const MARGIN: usize = 4;
/// Penalties of the table: powers of two from 2^-10 on.
const PENALTIES: usize = 36;

/// Held-out errors of each harmonic's row under each penalty.
#[derive(Debug, Clone)]
pub struct Table {
    fine: usize,
    /// Sum of squares (m^2), row after row; the last row is all that lies beyond the harmonics.
    errors: Vec<[f64; PENALTIES]>,
}

/// Right-hand sides of a fold, of all vertices and of their harmonics: what is beyond these is the
/// difference of their products.
struct Beyond<'a> {
    known: Mat<f32>,
    held: Mat<f32>,
    /// Of the harmonics: known and held out.
    low: [MatRef<'a, f64>; 2],
    /// Of the held-out frames beyond the harmonics (m^2).
    energy: f64,
}

impl Beyond<'_> {
    /// Sums over all rows of known times known, and of known times held out.
    fn products(&self, weights: &[f32]) -> [Mat<f64>; 2] {
        let weighted = Mat::from_fn(self.known.nrows(), self.known.ncols(), |i, j| {
            self.known[(i, j)] * weights[i]
        });
        let [known, held] = self.low;
        let own = wide((weighted.transpose() * &self.known).as_ref()) - known.transpose() * known;
        let cross = wide((weighted.transpose() * &self.held).as_ref()) - known.transpose() * held;
        [own, cross]
    }
}

fn weighted_energy(fine: &Mat<f32>, weights: &[f32]) -> f64 {
    let column = |c: usize| -> f64 {
        let one = |(i, w): (usize, &f32)| f64::from(*w) * f64::from(fine[(i, c)]).powi(2);
        weights.iter().enumerate().map(one).sum()
    };
    (0..fine.ncols()).map(column).sum()
}

fn penalty(step: usize) -> f64 {
    2f64.powi(step as i32 - 10)
}

impl Table {
    /// Of a training motion and the lowest `k` harmonics.
    ///
    /// # Errors
    /// No convergence.
    pub fn new(frames: &Frames, harmonics: &Harmonics, k: usize) -> Result<Self, FitError> {
        let functions = functions(harmonics, k);
        let fine = harmonics.count;
        let weighted = Mat::from_fn(fine, functions.ncols(), |i, j| {
            (functions[(i, j)] * f64::from(harmonics.weights[i])) as f32
        });
        let rows = wide((weighted.transpose() * &frames.fine).as_ref());
        let inside = frames.basis().transpose() * &frames.coarse;
        let count = frames.count();
        let part = |first: usize, last: usize| {
            let columns = 3 * (last - first);
            Normal::new(inside.subcols(3 * first, columns), rows.subcols(3 * first, columns))
        };
        let k = rows.nrows();
        let mut errors = vec![[0.0; PENALTIES]; k + 1];
        for block in 0..BLOCKS {
            let (first, last) = (block * count / BLOCKS, (block + 1) * count / BLOCKS);
            let (before, after) = (first.saturating_sub(MARGIN), (last + MARGIN).min(count));
            let held = part(first, last);
            let kept = part(0, before).plus(&part(after, count));
            let diagonal = kept.diagonal().ok_or(FitError::Numerical)?;
            let square = diagonal.turn.transpose() * &held.square * &diagonal.turn;
            let right = &held.right * &diagonal.turn;
            let whole = |first: usize, last: usize| {
                let columns = 3 * (last - first);
                let inside = diagonal.turn.transpose() * inside.subcols(3 * first, columns);
                frames.fine.subcols(3 * first, columns) * narrow(inside.transpose())
            };
            let beyond = Beyond {
                known: whole(0, before) + whole(after, count),
                held: whole(first, last),
                low: [diagonal.right.as_ref(), right.as_ref()],
                energy: weighted_energy(&frames.part(first, last).fine, &harmonics.weights)
                    - held.energy.iter().sum::<f64>(),
            };
            let [own, cross] = beyond.products(&harmonics.weights);
            for step in 0..PENALTIES {
                let guess = diagonal.solve(|_| penalty(step));
                let product = &guess * &square;
                for (row, errors) in errors[..k].iter_mut().enumerate() {
                    let cross: f64 = (0..guess.ncols())
                        .map(|j| guess[(row, j)] * (product[(row, j)] - 2.0 * right[(row, j)]))
                        .sum();
                    errors[step] += held.energy[row] + cross;
                }
                let share =
                    |j: usize| 1.0 / (diagonal.values[j] + penalty(step).powi(2)).max(1e-30);
                let mut sum = beyond.energy;
                for j in 0..square.ncols() {
                    sum -= 2.0 * share(j) * cross[(j, j)];
                    for i in 0..square.nrows() {
                        sum += share(i) * share(j) * square[(i, j)] * own[(i, j)];
                    }
                }
                errors[k][step] += sum;
            }
        }
        Ok(Self { fine, errors })
    }

    /// Held-out sum of squares of a row under any penalty, between those of the table.
    fn error(&self, row: usize, gamma: f64) -> f64 {
        let at = (gamma.max(1e-9).log2() + 10.0).clamp(0.0, (PENALTIES - 1) as f64);
        let step = (at as usize).min(PENALTIES - 2);
        let part = at - step as f64;
        self.errors[row][step] * (1.0 - part) + self.errors[row][step + 1] * part
    }

    /// Held-out sum of squares of penalties given for each row (m^2).
    pub fn total(&self, gamma: impl Fn(usize) -> f64) -> f64 {
        (0..self.errors.len()).map(|row| self.error(row, gamma(row))).sum()
    }

    /// The best profile of the paper's form.
    pub fn profile(&self) -> Profile {
        let mut best = (f64::INFINITY, Profile::USUAL);
        for first in (0..30).map(|i| 2f64.powf(0.5 * f64::from(i) - 9.0)) {
            for last in (0..30).map(|i| first * 2f64.powi(i)) {
                for exponent in [1.0, 2.0, 4.0, 8.0] {
                    let profile = Profile { first, last, exponent };
                    let total = self.total(|n| profile.gamma(n, self.fine));
                    if total < best.0 {
                        best = (total, profile);
                    }
                }
            }
        }
        best.1
    }

    /// The best penalty that is the same for all rows.
    pub fn tikhonov(&self) -> f64 {
        least((0..60).map(|i| 2f64.powf(0.5 * f64::from(i) - 9.0)), |alpha| self.total(|_| alpha))
    }

    /// The best factor of penalties that grow with the eigenvalues.
    pub fn laplacian(&self, harmonics: &Harmonics) -> f64 {
        least((0..60).map(|i| 2f64.powf(0.5 * f64::from(i) - 24.0)), |alpha| {
            // Beyond the harmonics, as if all were the last one.
            let last = harmonics.eigenvalues.len() - 1;
            self.total(|n| alpha * harmonics.eigenvalues[n.min(last)])
        })
    }
}

fn least(values: impl Iterator<Item = f64>, price: impl Fn(f64) -> f64) -> f64 {
    let best = |best: (f64, f64), value: f64| {
        let price = price(value);
        if price < best.0 { (price, value) } else { best }
    };
    values.fold((f64::INFINITY, 1.0), best).1
}

/// The best of `choices` on the last quarter of the frames, where the fit is any function of the
/// frames before, and its sum of squares there (m^2).
///
/// # Errors
/// Of the fit.
pub fn held_out<E>(
    frames: &Frames,
    choices: &[f64],
    fit: impl Fn(&Frames, f64) -> Result<Mat<f32>, E>,
) -> Result<(f64, f64), E> {
    let count = frames.count();
    let cut = count - count / BLOCKS;
    let (known, rest) = (frames.part(0, cut - MARGIN.min(cut - 1)), frames.part(cut, count));
    let positions = narrow(rest.coarse.as_ref());
    let mut best = (f64::INFINITY, choices[0]);
    for choice in choices {
        let off = fit(&known, *choice)? * &positions - &rest.fine;
        let error = f64::from(off.squared_norm_l2());
        if error < best.0 {
            best = (error, *choice);
        }
    }
    Ok((best.1, best.0))
}

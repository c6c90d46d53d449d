//! Rounding of U so that what is lost lies where coarse points do not go.
//!
//! Each weight by itself rounds to within half a step, and 8 bits would cost millimetres. But coarse
//! points move together: of the many rows of steps near a row of weights, one moves the fine vertex
//! nearly as the weights do. It is found as in optimal brain surgery (Hassibi and Stork 1993): weights
//! are rounded one after the other, and those still to come make up for the error, by the products of
//! the coarse positions; then each step is reconsidered in turn.

use super::{UpsampleError, Weights, check_count};
use crate::kernel::operator::{COARSE_MAX, OperatorError};

/// Ridge on the products, as a share of their mean diagonal: positions that training never showed
/// count this much.
const RIDGE: f64 = 1e-3;
/// Rounds of reconsidering.
const ROUNDS: usize = 2;

/// What an error costs.
struct Cost {
    m: usize,
    /// Products with ridge, row after row.
    matrix: Vec<f64>,
    /// R with R'R the inverse, row after row.
    upper: Vec<f64>,
}

impl Weights {
    /// As [`Weights::round`], but so that the error along coarse positions whose products are `gram` is
    /// small: the sum over frames and axes of `p p'`, positions being relative to their mean (m^2),
    /// `coarse` x `coarse` numbers.
    ///
    /// # Errors
    /// As for [`Weights::round`]; products of another size, or not finite.
    pub fn round_along(
        coarse: usize,
        weights: &[f32],
        bits: u8,
        gram: &[f64],
    ) -> Result<Self, UpsampleError> {
        let mut rounded = Self::round(coarse, weights, bits)?;
        check_count("coarse points", coarse, 1, COARSE_MAX)?;
        check_count("products", gram.len(), coarse * coarse, coarse * coarse)?;
        if let Some(index) = gram.iter().position(|g| !g.is_finite()) {
            return Err(UpsampleError::Invalid { what: "product", index });
        }
        let cost = Cost::new(coarse, gram);
        let most = f64::from((1i32 << (bits - 1)) - 1);
        let rows = weights.chunks(coarse).zip(rounded.steps.chunks_mut(coarse));
        for ((row, steps), unit) in rows.zip(&rounded.units) {
            let wanted: Vec<f64> = row.iter().map(|w| f64::from(*w) / f64::from(*unit)).collect();
            cost.round(&wanted, most, steps);
        }
        // What was moved may not take a row's sums out of 32 bits.
        for (row, steps) in rounded.steps.chunks(coarse).enumerate() {
            let sum: u64 = steps.iter().map(|s| u64::from(s.unsigned_abs())).sum();
            let most = crate::kernel::operator::ROW_STEPS_MAX;
            if sum > most {
                return Err(OperatorError::Headroom { row, sum, most }.into());
            }
        }
        Ok(rounded)
    }
}

impl Cost {
    fn new(m: usize, gram: &[f64]) -> Self {
        let mean = (0..m).map(|i| gram[i * m + i].max(0.0)).sum::<f64>() / m as f64;
        let mean = if mean > 0.0 { mean } else { 1.0 };
        let mut matrix: Vec<f64> = gram.iter().map(|g| g / mean + 1.0 / m as f64).collect();
        (0..m).for_each(|i| matrix[i * m + i] += RIDGE);
        let mut factor = matrix.clone();
        cholesky(&mut factor, m);
        let mut inverse = inverse(&factor, m);
        cholesky(&mut inverse, m);
        let upper = (0..m * m).map(|at| inverse[at % m * m + at / m]).collect();
        Self { m, matrix, upper }
    }

    fn round(&self, wanted: &[f64], most: f64, steps: &mut [i16]) {
        let m = self.m;
        let mut left = wanted.to_vec();
        for j in 0..m {
            let step = left[j].round_ties_even().clamp(-most, most);
            steps[j] = step as i16;
            // What is left of the inverse once the weights before are settled is the rest of the factor.
            let row = &self.upper[j * m..][..m];
            let error = (left[j] - step) / row[j];
            left.iter_mut().zip(row).skip(j).for_each(|(left, r)| *left -= error * r);
        }
        let off: Vec<f64> = steps.iter().zip(wanted).map(|(s, w)| f64::from(*s) - w).collect();
        let product = |row: &[f64]| row.iter().zip(&off).map(|(a, e)| a * e).sum::<f64>();
        let mut slopes: Vec<f64> = self.matrix.chunks(m).map(product).collect();
        for _ in 0..ROUNDS {
            for j in 0..m {
                let row = &self.matrix[j * m..][..m];
                let now = f64::from(steps[j]);
                let better = (now - slopes[j] / row[j]).round_ties_even().clamp(-most, most);
                let change = better - now;
                if change != 0.0 {
                    steps[j] = better as i16;
                    slopes.iter_mut().zip(row).for_each(|(s, a)| *s += change * a);
                }
            }
        }
    }
}

/// The lower factor, in place, row after row; what is above the diagonal becomes zero.
fn cholesky(a: &mut [f64], m: usize) {
    for i in 0..m {
        let (before, rest) = a.split_at_mut(i * m);
        let row = &mut rest[..m];
        for j in 0..i {
            let other = &before[j * m..][..=j];
            let known: f64 = row[..j].iter().zip(other).map(|(a, b)| a * b).sum();
            row[j] = (row[j] - known) / other[j];
        }
        let square: f64 = row[..i].iter().map(|x| x * x).sum();
        row[i] = (row[i] - square).max(1e-300).sqrt();
        row[i + 1..].fill(0.0);
    }
}

/// The inverse of a matrix from its lower factor.
fn inverse(factor: &[f64], m: usize) -> Vec<f64> {
    let mut inverse = vec![0.0; m * m];
    let mut x = vec![0.0; m];
    for column in 0..m {
        x.fill(0.0);
        x[column] = 1.0;
        for i in column..m {
            let known: f64 =
                factor[i * m..][column..i].iter().zip(&x[column..]).map(|(l, x)| l * x).sum();
            x[i] = (x[i] - known) / factor[i * m + i];
        }
        for i in (0..m).rev() {
            x[i] /= factor[i * m + i];
            let value = x[i];
            x[..i].iter_mut().zip(&factor[i * m..]).for_each(|(x, l)| *x -= l * value);
        }
        inverse.chunks_mut(m).zip(&x).for_each(|(row, x)| row[column] = *x);
    }
    inverse
}

//! What coefficients do: how large they get, and how one follows from the ones before.

use codec::toile::{Column, FrameKind};
use faer::MatRef;

/// Mean size over root mean square of what prediction leaves: between a normal (0.80) and a
/// Laplace distribution (0.71).
const MEAN_OF_RMS: f64 = 0.72;

/// Sums over one column; all of coefficients in metres.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    max_m: f64,
    square: f64,
    /// Squares of first states.
    first: f64,
    /// Second states `x` after first ones `y`: `xx`, `xy`, `yy`.
    second: [f64; 3],
    /// Later states `x` after `y` after `z`: `xx`, `xy`, `xz`, `yy`, `yz`, `zz`.
    later: [f64; 6],
}

/// Sums over all columns, region by region.
#[derive(Debug, Clone)]
pub(super) struct Statistics {
    sums: Vec<Sums>,
    /// States by kind.
    counts: [u64; 3],
    /// Sum of squares of all numbers of all states.
    energy: f64,
}

impl Statistics {
    pub(super) fn new(columns: usize) -> Self {
        Self { sums: vec![Sums::default(); columns], counts: [0; 3], energy: 0.0 }
    }

    /// Takes in a region: coefficients `columns x states`, and the squares of all its numbers.
    pub(super) fn push(&mut self, coefficients: MatRef<'_, f64>, energy: f64) {
        self.energy += energy;
        for state in 0..coefficients.ncols() {
            let kind = FrameKind::at(state);
            self.counts[kind as usize] += 1;
            for (c, sums) in self.sums.iter_mut().enumerate() {
                let at = |back: usize| coefficients[(c, state - back)];
                let x = at(0);
                sums.max_m = sums.max_m.max(x.abs());
                sums.square += x * x;
                match kind {
                    FrameKind::First => sums.first += x * x,
                    FrameKind::Second => {
                        let y = at(1);
                        add(&mut sums.second, [x * x, x * y, y * y]);
                    }
                    FrameKind::Later => {
                        let (y, z) = (at(1), at(2));
                        add(&mut sums.later, [x * x, x * y, x * z, y * y, y * z, z * z]);
                    }
                }
            }
        }
    }

    /// States taken in.
    pub(super) fn states(&self) -> u64 {
        self.counts.iter().sum()
    }

    /// Sum of squares of all numbers of all states (m^2).
    pub(super) fn energy_m2(&self) -> f64 {
        self.energy
    }

    /// Mean square coefficient (m^2).
    pub(super) fn power_m2(&self, column: usize) -> f64 {
        self.sums[column].square / self.states().max(1) as f64
    }

    /// Largest absolute coefficient (m).
    pub(super) fn max_m(&self, column: usize) -> f64 {
        self.sums[column].max_m
    }

    /// Mean size of what prediction leaves (m), over all states, nothing rounded.
    pub(super) fn size_m(&self, column: usize) -> f64 {
        let sizes = self.predicted(column, 0.0).1;
        let all: f64 = self.counts.iter().zip(sizes).map(|(n, size)| *n as f64 * size).sum();
        all / self.states().max(1) as f64
    }

    /// Prediction of a column whose coefficients are rounded to `step_m`.
    pub(super) fn column(&self, column: usize, headroom: f32, step_m: f64) -> Column {
        let ((after_one, after_two), sizes) = self.predicted(column, step_m);
        Column {
            maximum_m: (self.max_m(column) * f64::from(headroom)) as f32,
            multiple: 1,
            sizes: sizes.map(Column::size_code),
            after_one: Column::factor(after_one),
            after_two: after_two.map(Column::factor),
        }
    }

    /// Factors, and what they leave by kind (m).
    fn predicted(&self, column: usize, step_m: f64) -> ((f64, [f64; 2]), [f64; 3]) {
        let sums = &self.sums[column];
        let rounding = step_m * step_m / 12.0;
        let count = self.counts.map(|n| n.max(1) as f64);
        let [xx, xy, yy] = sums.second.map(|sum| sum / count[1]);
        let one = xy / (yy + rounding + f64::MIN_POSITIVE);
        let second = xx - 2.0 * one * xy + one * one * yy + rounding * (1.0 + one * one);
        let [lxx, lxy, lxz, lyy, lyz, lzz] = sums.later.map(|sum| sum / count[2]);
        // Rounding is added where it enters: the factors then do not amplify it.
        let (ry, rz) = (lyy + rounding, lzz + rounding);
        let determinant = ry * rz - lyz * lyz;
        let (a, b) = if determinant > 1e-12 * ry * rz {
            ((lxy * rz - lxz * lyz) / determinant, (lxz * ry - lxy * lyz) / determinant)
        } else {
            (lxy / (ry + f64::MIN_POSITIVE), 0.0)
        };
        let (a, b) = (a.clamp(-4.0, 4.0), b.clamp(-4.0, 4.0));
        let later = lxx - 2.0 * (a * lxy + b * lxz)
            + a * a * lyy
            + 2.0 * a * b * lyz
            + b * b * lzz
            + rounding * (1.0 + a * a + b * b);
        let first = sums.first / count[0] + rounding;
        // Without states of a kind, what is known of the ones before is the best guess.
        let second = if self.counts[1] == 0 { first } else { second };
        let later = if self.counts[2] == 0 { second } else { later };
        let size = |square: f64| MEAN_OF_RMS * square.max(0.0).sqrt();
        ((one.clamp(-4.0, 4.0), [a, b]), [first, second, later].map(size))
    }
}

fn add<const N: usize>(to: &mut [f64; N], values: [f64; N]) {
    to.iter_mut().zip(values).for_each(|(to, value)| *to += value);
}

#[cfg(test)]
mod tests {
    use faer::Mat;

    use super::*;

    #[test]
    fn a_wave_is_predicted_by_its_two_states_before() {
        let mut statistics = Statistics::new(1);
        for start in 0..40 {
            let wave = Mat::from_fn(1, 20, |_, t| (0.3 * (start * 7 + t) as f64).sin());
            let energy = wave.squared_norm_l2();
            statistics.push(wave.as_ref(), energy);
        }
        let column = statistics.column(0, 1.0, 1e-4);
        let exact = [2.0 * 0.3f64.cos(), -1.0].map(Column::factor);
        assert!((column.after_two[0] - exact[0]).abs() < 3, "{column:?}");
        assert!((column.after_two[1] - exact[1]).abs() < 3, "{column:?}");
        assert!(column.sizes[2] + 30 < column.sizes[0], "{column:?}");
        assert!((statistics.power_m2(0) - 0.5).abs() < 0.02);
    }
}

//! From a bound to a rank, a step of the coefficients and a share of the basis: the cheapest
//! whose mean square error is within it (reverse water-filling over all three).

use codec::toile;

/// What the error of encoded states must not exceed. Both hold where both are given.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Bound {
    /// Largest distance of any vertex of any state (m).
    pub max_m: Option<f32>,
    /// Root mean square distance over all vertices and states (m).
    pub rms_m: Option<f32>,
}

/// Tightest bound that can be asked for (m): below, 32-bit positions round as coarsely.
pub const BOUND_M_MIN: f32 = 1e-5;
/// A maximum alone asks for this root mean square error: the rest is left to fixes.
const RMS_OF_MAX: f64 = 0.3;
/// Steps of the rank that are tried.
const RANK_STEP: usize = 4;

impl Bound {
    /// What is published where nothing else is asked for: no vertex is further off than 15 mm.
    pub const LIVE: Self = Self { max_m: Some(0.015), rms_m: None };

    /// The root mean square error to design for (m).
    pub(super) fn design_rms_m(&self) -> f64 {
        let of_max = self.max_m.map(|max_m| RMS_OF_MAX * f64::from(max_m));
        let rms_m = self.rms_m.map(f64::from);
        match (rms_m, of_max) {
            (Some(rms_m), Some(of_max)) => rms_m.min(2.0 * of_max),
            (given, of_max) => given.or(of_max).unwrap_or(0.003),
        }
    }

    /// Whether it is one: positive, finite, not below what positions can hold.
    pub fn is_valid(&self) -> bool {
        let fits = |m: &f32| m.is_finite() && *m >= BOUND_M_MIN;
        self.max_m.iter().chain(&self.rms_m).all(fits)
    }
}

/// What is known of the states and of the columns that span them, before anything is rounded.
#[derive(Debug, Clone, Default)]
pub(super) struct Spectrum {
    pub(super) vertices: usize,
    /// States that will share the basis.
    pub(super) states: u64,
    /// Mean square distance of a vertex (m^2) that no column explains.
    pub(super) rest_m2: f64,
    /// By column: mean square coefficient (m^2).
    pub(super) power_m2: Vec<f64>,
    /// By column: mean size of what prediction in time leaves (m).
    pub(super) sizes_m: Vec<f64>,
    /// By column: mean size of what prediction in space leaves of an entry.
    pub(super) roughness: Vec<f64>,
}

/// Rank and steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Design {
    /// Leading columns to keep.
    pub(super) rank: usize,
    /// Code of the coefficients' step.
    pub(super) step: u8,
    /// Rounding of an entry times the root mean square of its column's coefficient (m).
    pub(super) share_m: f64,
    /// Bytes of the basis, as expected.
    pub(super) basis_bytes: f64,
    /// Bytes of a state, as expected.
    pub(super) state_bytes: f64,
    /// Root mean square error, as expected (m).
    pub(super) rms_m: f64,
}

impl Spectrum {
    /// Mean square error of a vertex with the first `rank` columns (m^2).
    fn truncation_m2(&self, rank: usize) -> f64 {
        self.rest_m2 + self.power_m2[rank..].iter().sum::<f64>() / self.vertices as f64
    }

    /// The cheapest design within `rms_m`; the finest there is where none is.
    pub(super) fn design(&self, rms_m: f64) -> Design {
        let ranks = self.power_m2.len();
        let mut best: Option<Design> = None;
        for rank in (1..=ranks).filter(|r| r.is_multiple_of(RANK_STEP) || *r == ranks) {
            let left_m2 = rms_m * rms_m - self.truncation_m2(rank);
            if left_m2 <= 0.0 {
                continue;
            }
            for part in 1..12 {
                let of_basis_m2 = left_m2 * f64::from(part) / 12.0;
                let design = self.with(rank, left_m2 - of_basis_m2, of_basis_m2);
                if best.is_none_or(|best| self.total(&design) < self.total(&best)) {
                    best = Some(design);
                }
            }
        }
        best.unwrap_or_else(|| {
            let rank = ranks.max(1);
            let rest_m2 = (0.1 * self.truncation_m2(ranks)).max(rms_m * rms_m / 4.0);
            self.with(rank, rest_m2 / 2.0, rest_m2 / 2.0)
        })
    }

    /// The finest design of about so many bytes in all.
    pub(super) fn design_of_bytes(&self, bytes: f64) -> Design {
        let (mut fine, mut coarse) = (1e-5f64, 0.5f64);
        for _ in 0..20 {
            let middle = (fine * coarse).sqrt();
            let design = self.design(middle);
            if self.total(&design) > bytes { fine = middle } else { coarse = middle }
        }
        self.design(coarse)
    }

    /// Bytes of everything.
    pub(super) fn total(&self, design: &Design) -> f64 {
        design.basis_bytes + design.state_bytes * self.states as f64
    }

    fn with(&self, rank: usize, coefficients_m2: f64, basis_m2: f64) -> Design {
        let (vertices, columns) = (self.vertices as f64, rank as f64);
        // Columns below the step are rounded to nothing and cost their own power.
        let mut step_m = (12.0 * coefficients_m2 * vertices / columns).sqrt();
        for _ in 0..8 {
            let noise: f64 =
                self.power_m2[..rank].iter().map(|p| p.min(step_m * step_m / 12.0)).sum();
            step_m *= (coefficients_m2 * vertices / noise.max(f64::MIN_POSITIVE)).sqrt().min(1.5);
        }
        let step = step_code(step_m);
        let step_m = f64::from(toile::step_m(step));
        let share_m = (4.0 * basis_m2 / columns).sqrt();
        let noise: f64 = self.power_m2[..rank].iter().map(|p| p.min(step_m * step_m / 12.0)).sum();
        let state_bits: f64 =
            self.sizes_m[..rank].iter().map(|size_m| laplace_bits(size_m / step_m + 0.12)).sum();
        let column_bits = |c: usize| {
            let size = self.roughness[c] * self.power_m2[c].sqrt() / share_m;
            0.93 * 3.0 * vertices * laplace_bits(size + 0.05)
        };
        let basis_bits: f64 = (0..rank).map(column_bits).sum();
        Design {
            rank,
            step,
            share_m,
            basis_bytes: basis_bits / 8.0 + 7.0 * vertices,
            state_bytes: state_bits / 8.0 + 2.0,
            rms_m: (self.truncation_m2(rank) + noise / vertices + basis_m2).sqrt(),
        }
    }
}

/// The code of the largest step that is not above `step_m`.
pub(super) fn step_code(step_m: f64) -> u8 {
    let fits = |code: &u8| f64::from(toile::step_m(*code)) <= step_m;
    (0..=120).rev().find(fits).unwrap_or(0)
}

/// Bits of a whole number from a Laplace distribution of this mean size.
fn laplace_bits(mean: f64) -> f64 {
    let ratio = (-1.0 / mean).exp();
    let zero = 1.0 - ratio.sqrt();
    let entropy = |p: f64| if p > 0.0 { -p * p.log2() } else { 0.0 };
    // Beyond zero: a sign, and a geometric distribution.
    let beyond = 1.0 - zero;
    let geometric = (entropy(ratio) + entropy(1.0 - ratio)) / (1.0 - ratio);
    entropy(zero) + entropy(beyond) + beyond * (1.0 + geometric)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spectrum() -> Spectrum {
        let power = |c: usize| 9.0 / (1.0 + c as f64).powi(2);
        Spectrum {
            vertices: 1000,
            states: 20_000,
            rest_m2: 1e-6,
            power_m2: (0..200).map(power).collect(),
            sizes_m: (0..200).map(|c| 0.2 * power(c).sqrt()).collect(),
            roughness: (0..200).map(|c| 0.001 + 0.0001 * c as f64).collect(),
        }
    }

    #[test]
    fn a_looser_bound_is_cheaper_and_each_is_kept() {
        let spectrum = spectrum();
        let mut before = f64::INFINITY;
        for rms_m in [0.002, 0.004, 0.008, 0.016] {
            let design = spectrum.design(rms_m);
            assert!(design.rms_m <= 1.001 * rms_m, "{design:?}");
            assert!(spectrum.total(&design) < before, "{design:?}");
            before = spectrum.total(&design);
        }
        let finest = spectrum.design(1e-4);
        assert_eq!(finest.rank, 200, "what no column explains cannot be designed away");
    }

    #[test]
    fn so_many_bytes_buy_a_design_of_so_many_bytes() {
        let spectrum = spectrum();
        let bytes = spectrum.total(&spectrum.design(0.005));
        let design = spectrum.design_of_bytes(bytes);
        assert!((0.9..=1.0).contains(&(spectrum.total(&design) / bytes)), "{design:?}");
    }

    #[test]
    fn bits_are_those_of_the_distribution() {
        for mean in [0.1, 0.7, 3.0, 40.0] {
            let ratio = f64::exp(-1.0 / mean);
            let of = |k: i32| {
                if k == 0 {
                    1.0 - ratio.sqrt()
                } else {
                    0.5 * ratio.sqrt() * (1.0 - ratio) * ratio.powi(k.abs() - 1)
                }
            };
            let exact: f64 =
                (-2000..=2000).map(of).filter(|p| *p > 0.0).map(|p| -p * p.log2()).sum();
            assert!((laplace_bits(mean) - exact).abs() < 1e-3, "{mean}");
        }
    }

    #[test]
    fn bounds_that_cannot_be_kept_are_none() {
        for wrong in [0.0, -1.0, f32::NAN, f32::INFINITY, 1e-6] {
            assert!(!Bound { max_m: Some(wrong), rms_m: None }.is_valid());
            assert!(!Bound { max_m: Some(0.01), rms_m: Some(wrong) }.is_valid());
        }
        assert!(Bound { max_m: Some(0.01), rms_m: Some(0.002) }.is_valid());
    }
}

//! Operators by least squares under the partition of unity (Kavan et al. 2011, section 3).

use faer::linalg::solvers::Solve;
use faer::sparse::linalg::solvers::{Llt, SymbolicLlt};
use faer::sparse::{SparseColMat, Triplet};
use faer::{Mat, MatRef, Side};

use super::data::{Diagonal, Frames, Normal, narrow, wide};
use super::harmonics::{Harmonics, Laplacian};

/// How hard each harmonic is held: gamma_n = a (1 + b (n - 1) / N)^c from gamma_1 and gamma_N.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Profile {
    /// Penalty of the first harmonic.
    pub first: f64,
    /// Penalty of the last one that the mesh has.
    pub last: f64,
    /// Exponent: larger lets more detail through.
    pub exponent: f64,
}

/// Why there is no operator.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum FitError {
    /// The iteration for eigenvalues did not end, or a matrix was not positive.
    #[error("the normal equations of the training frames could not be solved")]
    Numerical,
}

impl Profile {
    /// The paper's usual choice.
    pub const USUAL: Self = Self { first: 1.0, last: 1e5, exponent: 4.0 };

    /// Penalty of harmonic `n` (counted from 0) of a mesh with `count` vertices.
    pub fn gamma(&self, n: usize, count: usize) -> f64 {
        if self.exponent <= 0.0 || self.first <= 0.0 {
            return self.first;
        }
        let b = (self.last / self.first).powf(1.0 / self.exponent) - 1.0;
        self.first * (1.0 + b * n as f64 / (count as f64 - 1.0)).powf(self.exponent)
    }
}

/// A training motion, ready to be fitted again and again.
#[derive(Debug, Clone)]
pub struct Training {
    points: usize,
    /// What every coarse point has of every row: 1/M, or 0 for what is added to an operator.
    affine: f32,
    pub(super) fine: usize,
    /// Z, once or (with history) twice.
    pub(super) basis: Mat<f64>,
    /// N x k.
    functions: Mat<f64>,
    pub(super) weights: Vec<f64>,
    pub(super) normal: Normal,
    harmonic: Diagonal,
    /// What the harmonics do not span of the right-hand sides, turned like theirs.
    rest: Mat<f64>,
}

impl Training {
    /// Products of `frames` with the harmonics of the fine mesh; the first `k` are used.
    ///
    /// # Errors
    /// No convergence.
    pub fn new(frames: &Frames, harmonics: &Harmonics, k: usize) -> Result<Self, FitError> {
        let (points, fine) = (frames.points, frames.fine.nrows());
        let functions = functions(harmonics, k);
        let basis = frames.basis();
        let inside = basis.transpose() * &frames.coarse;
        let rows = frames.fine.as_ref();
        // The product with N rows is by far the largest: in f32.
        let right = wide((rows * narrow(inside.transpose())).as_ref());
        let square = &inside * inside.transpose();
        let normal = Normal { square, right, energy: Vec::new() };
        let weights: Vec<f64> = harmonics.weights.iter().map(|w| f64::from(*w)).collect();
        let weighted =
            Mat::from_fn(fine, normal.right.ncols(), |i, j| normal.right[(i, j)] * weights[i]);
        let projected = Normal {
            square: normal.square.clone(),
            right: functions.transpose() * &weighted,
            energy: Vec::new(),
        };
        let harmonic = projected.diagonal().ok_or(FitError::Numerical)?;
        let low = narrow(functions.as_ref()) * narrow(projected.right.as_ref());
        let beyond = narrow(normal.right.as_ref()) - low;
        let rest = wide((beyond * narrow(harmonic.turn.as_ref())).as_ref());
        Ok(Self {
            points,
            affine: 1.0 / points as f32,
            fine,
            basis,
            functions,
            weights,
            normal,
            harmonic,
            rest,
        })
    }

    /// Harmonic regularisation: rows of the transformed operator are independent. From the k-th
    /// harmonic on the profile is held constant: so what lies beyond needs no harmonics, and the whole
    /// space is solved for.
    pub fn harmonic(&self, profile: &Profile) -> Mat<f32> {
        let k = self.functions.ncols();
        let gammas: Vec<f64> = (0..=k).map(|n| profile.gamma(n, self.fine)).collect();
        let low = self.harmonic.solve(|n| gammas[n]);
        let rest = self.harmonic.with(self.rest.as_ref()).solve(|_| gammas[k]);
        let turned = narrow(self.functions.as_ref()) * narrow(low.as_ref()) + narrow(rest.as_ref());
        let back = self.harmonic.turn.transpose() * self.basis.transpose();
        self.whole((turned * narrow(back.as_ref())).as_ref())
    }

    /// Tikhonov's regularisation, each vertex by itself; a penalty of 0 is none.
    ///
    /// # Errors
    /// No convergence.
    pub fn tikhonov(&self, alpha: f64) -> Result<Mat<f32>, FitError> {
        let diagonal = self.normal.diagonal().ok_or(FitError::Numerical)?;
        let rows = diagonal.solve(|_| alpha) * diagonal.turn.transpose() * self.basis.transpose();
        Ok(self.whole(narrow(rows.as_ref()).as_ref()))
    }

    /// Laplacian regularisation, exactly: in the eigenbasis of the coarse points' products the
    /// aggregate system falls into one sparse system for each of them.
    ///
    /// # Errors
    /// No convergence, or a factor that fails.
    pub fn laplacian(&self, laplacian: &Laplacian, alpha: f64) -> Result<Mat<f32>, FitError> {
        let diagonal = self.normal.diagonal().ok_or(FitError::Numerical)?;
        let square = squared(laplacian);
        let n = self.fine;
        let scale = 1e-10 * diagonal.values.last().copied().unwrap_or(0.0);
        let mut solution = Mat::<f64>::zeros(n, diagonal.values.len());
        let mut symbolic: Option<SymbolicLlt<usize>> = None;
        for (j, value) in diagonal.values.iter().enumerate() {
            let entry = |(a, b, c): &(usize, usize, f64)| {
                let own = if a == b { value.max(scale) * self.weights[*a] } else { 0.0 };
                Triplet::new(*a, *b, alpha * alpha * c + own)
            };
            let triplets: Vec<_> = square.iter().map(entry).collect();
            let matrix = SparseColMat::try_new_from_triplets(n, n, &triplets)
                .map_err(|_| FitError::Numerical)?;
            if symbolic.is_none() {
                let made = SymbolicLlt::try_new(matrix.symbolic(), Side::Lower);
                symbolic = Some(made.map_err(|_| FitError::Numerical)?);
            }
            let Some(symbolic) = symbolic.clone() else { continue };
            let factor = Llt::try_new_with_symbolic(symbolic, matrix.as_ref(), Side::Lower)
                .map_err(|_| FitError::Numerical)?;
            let mut column = Mat::from_fn(n, 1, |i, _| diagonal.right[(i, j)] * self.weights[i]);
            factor.solve_in_place(column.as_mut());
            solution.col_mut(j).copy_from(column.col(0));
        }
        let rows = solution * diagonal.turn.transpose() * self.basis.transpose();
        Ok(self.whole(narrow(rows.as_ref()).as_ref()))
    }

    /// For frames from which an operator's part was taken: rows sum to 0.
    pub fn of_rest(mut self) -> Self {
        self.affine = 0.0;
        self
    }

    pub(super) fn whole(&self, rows: MatRef<'_, f32>) -> Mat<f32> {
        let mut whole = Mat::from_fn(self.fine, self.basis.nrows(), |i, j| {
            rows[(i, j)] + if j < self.points { self.affine } else { 0.0 }
        });
        // What rounding leaves: rows sum to 1 (or 0) as exactly as f32 can.
        let wanted = f64::from(self.affine) * self.points as f64;
        for i in 0..self.fine {
            let sum: f64 = (0..self.points).map(|j| f64::from(whole[(i, j)])).sum();
            let off = ((wanted.round() - sum) / self.points as f64) as f32;
            (0..self.points).for_each(|j| whole[(i, j)] += off);
        }
        whole
    }
}

/// The first `k` harmonics as columns.
pub fn functions(harmonics: &Harmonics, k: usize) -> Mat<f64> {
    let all = harmonics.eigenvalues.len();
    Mat::from_fn(harmonics.count, k.min(all), |i, j| f64::from(harmonics.functions[i * all + j]))
}

/// Lower triangle of C V^-1 C, with V over its mean.
pub(super) fn squared(laplacian: &Laplacian) -> Vec<(usize, usize, f64)> {
    let n = laplacian.areas.len();
    let mean: f64 = laplacian.areas.iter().sum::<f64>() / n as f64;
    let mut rows: Vec<Vec<(usize, f64)>> = vec![Vec::new(); n];
    for (a, b, value) in &laplacian.entries {
        rows[*a].push((*b, *value));
        if a != b {
            rows[*b].push((*a, *value));
        }
    }
    let mut sums = std::collections::BTreeMap::<(usize, usize), f64>::new();
    for (row, area) in rows.iter().zip(&laplacian.areas) {
        for (a, x) in row {
            for (b, y) in row.iter().filter(|(b, _)| b <= a) {
                *sums.entry((*a, *b)).or_default() += x * y * mean / area;
            }
        }
    }
    // Eigenvalues are per area; with areas over their mean they are those of C / mean.
    sums.into_iter().map(|((a, b), value)| (a, b, value / (mean * mean))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::upsample::data::sums_to_zero;
    use crate::upsample::harmonics::harmonics;
    use crate::upsample::patch::Patch;
    use crate::upsample::tune::Table;
    use cloth::Vec3;
    use cloth::lab::shapes::Chance;

    fn sheet(cells: usize) -> Patch {
        let at = |u: f32, v: f32| Vec3::new(u, -v, 0.0);
        Patch::new([cells, cells], false, at, |_, _| false).unwrap()
    }

    /// Frames of a cloth that moves by chance, lifted by `planted`, and with noise on top (m).
    fn frames(planted: &Mat<f32>, count: usize, noise: f32) -> Frames {
        let (n, m) = (planted.nrows(), planted.ncols());
        let mut chance = Chance::new(11);
        let z = sums_to_zero(m);
        let inside = Mat::from_fn(m - 1, 3 * count, |_, _| f64::from(chance.signed()));
        let coarse = z * inside;
        let mut fine = planted * narrow(coarse.as_ref());
        for c in 0..3 * count {
            (0..n).for_each(|i| fine[(i, c)] += noise * chance.signed());
        }
        Frames { coarse, fine, points: m, middles: vec![0.0; 3 * count] }
    }

    fn planted() -> (Patch, Mat<f32>, Harmonics) {
        let (coarse, fine) = (sheet(3), sheet(14));
        let rows = coarse.subdivision(&fine);
        let operator =
            Mat::from_fn(fine.count(), coarse.count(), |i, j| rows[i * coarse.count() + j]);
        let harmonics = harmonics(&fine.mesh, 60).unwrap();
        (fine, operator, harmonics)
    }

    fn apart(a: &Mat<f32>, b: &Mat<f32>) -> f32 {
        let off = a - b;
        off.col_iter().flat_map(|c| c.iter().copied()).fold(0.0f32, |m, x| m.max(x.abs()))
    }

    #[test]
    fn every_fit_recovers_an_operator_that_explains_all_frames() {
        let (fine, operator, harmonics) = planted();
        let training = Training::new(&frames(&operator, 60, 0.0), &harmonics, 60).unwrap();
        let weak = Profile { first: 1e-6, last: 1e-5, exponent: 2.0 };
        assert!(apart(&training.harmonic(&weak), &operator) < 1e-4);
        assert!(apart(&training.tikhonov(0.0).unwrap(), &operator) < 1e-4);
        let laplacian = Laplacian::new(&fine.mesh);
        assert!(apart(&training.laplacian(&laplacian, 1e-9).unwrap(), &operator) < 1e-3);
    }

    /// The system of all N x M unknowns at once, as the paper states it, against one system for each
    /// eigenvector.
    #[test]
    fn the_laplacian_is_that_of_the_aggregate_system() {
        let (coarse, fine) = (sheet(2), sheet(5));
        let rows = coarse.subdivision(&fine);
        let (m, n) = (coarse.count(), fine.count());
        let planted = Mat::from_fn(n, m, |i, j| rows[i * m + j]);
        let frames = frames(&planted, 20, 0.1);
        let laplacian = Laplacian::new(&fine.mesh);
        let harmonics = harmonics(&fine.mesh, 12).unwrap();
        let training = Training::new(&frames, &harmonics, 12).unwrap();
        let (alpha, width) = (0.02, m - 1);
        let normal = &training.normal;
        // Unknown (vertex, direction of Z) at vertex * width + direction.
        let mut whole = Mat::<f64>::zeros(n * width, n * width);
        for i in 0..n {
            for a in 0..width {
                for b in 0..width {
                    whole[(i * width + a, i * width + b)] +=
                        training.weights[i] * normal.square[(a, b)];
                }
            }
        }
        for (i, j, value) in squared(&laplacian) {
            for a in 0..width {
                let mut add = |p: usize, q: usize| {
                    whole[(p * width + a, q * width + a)] += alpha * alpha * value;
                };
                add(i, j);
                if i != j {
                    add(j, i);
                }
            }
        }
        let right = Mat::from_fn(n * width, 1, |at, _| {
            training.weights[at / width] * normal.right[(at / width, at % width)]
        });
        let solved = whole.llt(Side::Lower).unwrap().solve(&right);
        let y = Mat::from_fn(n, width, |i, a| solved[(i * width + a, 0)]);
        let aggregate = training.whole(narrow((y * training.basis.transpose()).as_ref()).as_ref());
        let apart = apart(&aggregate, &training.laplacian(&laplacian, alpha).unwrap());
        assert!(apart < 1e-4, "{apart}");
        // The same by conjugate gradients, which end where nothing is left.
        let mut last = 1.0;
        let iterated = training.aggregate(&laplacian, alpha, &mut |solve, _| {
            last = solve.residual;
            solve.iterations < 5_000
        });
        let apart = self::apart(&iterated, &aggregate);
        assert!(apart < 1e-4 && last < 1e-9, "{apart}, residual {last}");
    }

    #[test]
    fn an_even_profile_is_tikhonovs_so_nothing_is_lost_beyond_the_harmonics() {
        let (_, operator, harmonics) = planted();
        let training = Training::new(&frames(&operator, 20, 0.05), &harmonics, 30).unwrap();
        let even = Profile { first: 0.7, last: 0.7, exponent: 4.0 };
        let (a, b) = (training.harmonic(&even), training.tikhonov(0.7).unwrap());
        assert!(apart(&a, &b) < 1e-5, "{}", apart(&a, &b));
        let again = Training::new(&frames(&operator, 20, 0.05), &harmonics, 30).unwrap();
        assert!(apart(&a, &again.harmonic(&even)) <= 0.0, "equal inputs, equal bits");
    }

    #[test]
    fn rows_sum_to_one_and_affine_maps_go_through() {
        let (fine, operator, harmonics) = planted();
        let training = Training::new(&frames(&operator, 12, 0.1), &harmonics, 40).unwrap();
        let laplacian = Laplacian::new(&fine.mesh);
        let all = [
            training.harmonic(&Profile::USUAL),
            training.tikhonov(0.3).unwrap(),
            training.laplacian(&laplacian, 0.01).unwrap(),
        ];
        let mut chance = Chance::new(3);
        let m = operator.ncols();
        let points = Mat::from_fn(m, 3, |_, _| chance.signed());
        let turn = Mat::from_fn(3, 3, |_, _| chance.signed());
        for u in all {
            for i in 0..u.nrows() {
                let sum: f64 = (0..m).map(|j| f64::from(u[(i, j)])).sum();
                assert!((sum - 1.0).abs() < 1e-6, "row {i} sums to {sum}");
            }
            let shift = |a: &Mat<f32>| Mat::from_fn(a.nrows(), 3, |i, j| a[(i, j)] + 0.25);
            let before = &u * shift(&(&points * &turn));
            let after = shift(&(&u * &points * &turn));
            let size: f32 = (0..u.nrows())
                .map(|i| (0..m).map(|j| u[(i, j)].abs()).sum::<f32>())
                .fold(1.0, f32::max);
            assert!(apart(&before, &after) < 2e-6 * size, "{}", apart(&before, &after));
        }
    }

    #[test]
    fn the_profile_has_its_ends_and_rises() {
        let p = Profile { first: 2.0, last: 5e3, exponent: 4.0 };
        assert!((p.gamma(0, 100) - 2.0).abs() < 1e-9 && (p.gamma(99, 100) - 5e3).abs() < 1e-6);
        assert!((1..100).all(|n| p.gamma(n, 100) > p.gamma(n - 1, 100)));
    }

    #[test]
    fn tuning_holds_noise_down_and_lets_a_clean_operator_through() {
        let (_, operator, harmonics) = planted();
        let quiet = Table::new(&frames(&operator, 48, 1e-4), &harmonics, 40).unwrap();
        let noisy = Table::new(&frames(&operator, 48, 3.0), &harmonics, 40).unwrap();
        assert!(quiet.tikhonov() < 0.25, "{}", quiet.tikhonov());
        assert!(noisy.tikhonov() > 4.0 * quiet.tikhonov(), "{}", noisy.tikhonov());
        let profile = noisy.profile();
        let priced = |t: &Table, p: &Profile| t.total(|n| p.gamma(n, harmonics.count));
        assert!(priced(&noisy, &profile) <= priced(&noisy, &Profile::USUAL));
    }
}

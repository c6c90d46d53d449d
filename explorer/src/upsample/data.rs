//! Frames as matrices, and what every fit of one training motion shares.
//!
//! Positions enter relative to the middle of the coarse points of their frame: with rows that sum
//! to 1 this changes no fit. Then the partition of unity is not a constraint any more: with Z an
//! orthonormal basis of the vectors that sum to zero, U = 1 1'/M + Y Z', and any Y will do.

use faer::{Mat, MatRef, Side};

use super::run::Run;

/// A motion's frames: one column a frame and axis.
#[derive(Debug, Clone)]
pub struct Frames {
    /// Coarse positions from their middle (m), M rows.
    pub coarse: Mat<f64>,
    /// Fine positions from the same middle (m), N rows.
    pub fine: Mat<f32>,
    /// Coarse points: fewer than coarse rows where these hold changes besides.
    pub points: usize,
    /// The middle of the coarse points in each frame and axis, in the world (m).
    pub middles: Vec<f64>,
}

impl Frames {
    /// Of a simulated motion with `coarse` and `fine` points.
    pub fn new(run: &Run, coarse: usize, fine: usize) -> Self {
        let middles: Vec<f64> = (0..3 * run.frames)
            .map(|c| {
                let of = |i: usize| f64::from(run.coarse[(c / 3 * coarse + i) * 3 + c % 3]);
                (0..coarse).map(of).sum::<f64>() / coarse as f64
            })
            .collect();
        let at = |list: &[f32], count: usize, i: usize, c: usize| {
            f64::from(list[(c / 3 * count + i) * 3 + c % 3]) - middles[c]
        };
        let columns = 3 * run.frames;
        let fine = Mat::from_fn(fine, columns, |i, c| at(&run.fine, fine, i, c) as f32);
        let points = coarse;
        let coarse = Mat::from_fn(points, columns, |i, c| at(&run.coarse, points, i, c));
        Self { coarse, fine, points, middles }
    }

    /// The basis Z for these coarse rows: once, or block by block where there are changes.
    pub fn basis(&self) -> Mat<f64> {
        let z = sums_to_zero(self.points);
        let (m, c) = (z.nrows(), z.ncols());
        let blocks = self.coarse.nrows() / m;
        Mat::from_fn(
            blocks * m,
            blocks * c,
            |i, j| {
                if i / m == j / c { z[(i % m, j % c)] } else { 0.0 }
            },
        )
    }

    /// Number of frames.
    pub fn count(&self) -> usize {
        self.fine.ncols() / 3
    }

    /// Frames `first..last`.
    pub fn part(&self, first: usize, last: usize) -> Self {
        let columns = 3 * (last - first);
        Self {
            coarse: self.coarse.subcols(3 * first, columns).to_owned(),
            fine: self.fine.subcols(3 * first, columns).to_owned(),
            points: self.points,
            middles: self.middles[3 * first..3 * last].to_vec(),
        }
    }

    /// These frames, then others of the same meshes.
    pub fn and(&self, other: &Self) -> Self {
        let columns = self.fine.ncols();
        let all = columns + other.fine.ncols();
        let coarse = Mat::from_fn(self.coarse.nrows(), all, |i, c| {
            if c < columns { self.coarse[(i, c)] } else { other.coarse[(i, c - columns)] }
        });
        let fine = Mat::from_fn(self.fine.nrows(), all, |i, c| {
            if c < columns { self.fine[(i, c)] } else { other.fine[(i, c - columns)] }
        });
        let middles = self.middles.iter().chain(&other.middles).copied().collect();
        Self { coarse, fine, points: self.points, middles }
    }

    /// Each frame, and after it the same with each row in another's place: so a part of the time holds
    /// both.
    pub fn with_rows_of(&self, coarse: &[usize], fine: &[usize]) -> Self {
        let columns = 2 * self.fine.ncols();
        // Of three columns and their three twins: which column it is, and whether of a twin.
        let from = |c: usize| (3 * (c / 6) + c % 3, c % 6 >= 3);
        let row = |twins: &[usize], i: usize, turned: bool| if turned { twins[i] } else { i };
        let at = |list: &[usize], i: usize, c: usize| {
            let (column, turned) = from(c);
            (row(list, i, turned), column)
        };
        Self {
            coarse: Mat::from_fn(coarse.len(), columns, |i, c| self.coarse[at(coarse, i, c)]),
            fine: Mat::from_fn(fine.len(), columns, |i, c| self.fine[at(fine, i, c)]),
            points: self.points,
            middles: (0..columns).map(|c| self.middles[from(c).0]).collect(),
        }
    }

    /// The same frames with what `operator` (N x M) makes of the coarse points taken away.
    pub fn without(&self, operator: MatRef<'_, f32>) -> Self {
        let positions = self.coarse.subrows(0, operator.ncols());
        let fine = &self.fine - operator * narrow(positions);
        Self {
            coarse: self.coarse.clone(),
            fine,
            points: self.points,
            middles: self.middles.clone(),
        }
    }

    /// Twice as many coarse rows: positions, then by how much they changed in the last frame.
    pub fn with_history(&self) -> Self {
        let m = self.coarse.nrows();
        let at = |i: usize, c: usize| match (i.checked_sub(m), c.checked_sub(3)) {
            (None, _) => self.coarse[(i, c)],
            (Some(i), Some(before)) => self.coarse[(i, c)] - self.coarse[(i, before)],
            (Some(_), None) => 0.0,
        };
        let coarse = Mat::from_fn(2 * m, self.coarse.ncols(), at);
        Self { coarse, fine: self.fine.clone(), points: m, middles: self.middles.clone() }
    }
}

/// In f32.
pub fn narrow(a: MatRef<'_, f64>) -> Mat<f32> {
    Mat::from_fn(a.nrows(), a.ncols(), |i, j| a[(i, j)] as f32)
}

/// In f64.
pub fn wide(a: MatRef<'_, f32>) -> Mat<f64> {
    Mat::from_fn(a.nrows(), a.ncols(), |i, j| f64::from(a[(i, j)]))
}

/// An orthonormal basis of the vectors of `m` numbers that sum to zero: columns 2.. of the
/// reflection that turns the ones into an axis.
pub fn sums_to_zero(m: usize) -> Mat<f64> {
    let root = (m as f64).sqrt();
    let v = |i: usize| if i == 0 { 1.0 + root } else { 1.0 };
    let length2 = 2.0 * (m as f64 + root);
    Mat::from_fn(m, m - 1, |i, j| {
        let one = f64::from(u8::from(i == j + 1));
        one - 2.0 * v(i) * v(j + 1) / length2
    })
}

/// Normal equations of a set of frames: products with the coarse positions in the basis Z.
#[derive(Debug, Clone)]
pub struct Normal {
    /// Z' P P' Z.
    pub square: Mat<f64>,
    /// Projected fine positions times P' Z: one row an unknown function of the mesh.
    pub right: Mat<f64>,
    /// For each row the sum of its squares (m^2).
    pub energy: Vec<f64>,
}

impl Normal {
    /// Of fine rows `rows` (any linear combinations of the fine vertices) and coarse positions in Z.
    pub fn new(coarse: MatRef<'_, f64>, rows: MatRef<'_, f64>) -> Self {
        let energy = (0..rows.nrows()).map(|i| rows.row(i).squared_norm_l2()).collect();
        Self { square: coarse * coarse.transpose(), right: rows * coarse.transpose(), energy }
    }

    /// Both together.
    pub fn plus(&self, other: &Self) -> Self {
        Self {
            square: &self.square + &other.square,
            right: &self.right + &other.right,
            energy: self.energy.iter().zip(&other.energy).map(|(a, b)| a + b).collect(),
        }
    }

    /// In the eigenbasis of `square`: its eigenvalues, the basis, and `right` in it.
    pub fn diagonal(&self) -> Option<Diagonal> {
        let eigen = self.square.self_adjoint_eigen(Side::Lower).ok()?;
        let n = self.square.nrows();
        let most = eigen.S()[n - 1].max(0.0);
        // What rounding leaves of directions in which the points never moved.
        let values = (0..n).map(|i| eigen.S()[i].max(1e-14 * most)).collect();
        let turn = eigen.U().to_owned();
        Some(Diagonal { values, right: &self.right * &turn, turn })
    }
}

/// [`Normal`] equations where their matrix is diagonal.
#[derive(Debug, Clone)]
pub struct Diagonal {
    /// Eigenvalues (m^2), none below 0.
    pub values: Vec<f64>,
    /// The right-hand sides, turned.
    pub right: Mat<f64>,
    /// Columns are the eigenvectors.
    pub turn: Mat<f64>,
}

impl Diagonal {
    /// The same matrix with other right-hand sides, turned already.
    pub fn with(&self, right: MatRef<'_, f64>) -> Self {
        Self { values: self.values.clone(), right: right.to_owned(), turn: Mat::zeros(0, 0) }
    }

    /// Solutions with each row's own penalty `gamma`, still turned.
    pub fn solve(&self, gamma: impl Fn(usize) -> f64) -> Mat<f64> {
        let least = 1e-12 * self.values.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
        Mat::from_fn(self.right.nrows(), self.right.ncols(), |i, j| {
            let penalty = gamma(i) * gamma(i);
            self.right[(i, j)] / (self.values[j] + penalty).max(least)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_basis_is_orthonormal_and_sums_to_zero() {
        let z = sums_to_zero(7);
        let gram = z.transpose() * &z;
        for i in 0..6 {
            assert!((0..7).map(|k| z[(k, i)]).sum::<f64>().abs() < 1e-14);
            for j in 0..6 {
                assert!((gram[(i, j)] - f64::from(u8::from(i == j))).abs() < 1e-14);
            }
        }
    }
}

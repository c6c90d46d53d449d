//! The Laplacian operator as the paper states it: one sparse system of all N x M unknowns (Kavan et al.
//! 2011, section 3.2), the slow baseline.
//!
//! Each unknown is coupled to the M of its own row by the data term and to its vertex's neighbours
//! of neighbours by the Laplacian. A direct factor of that does not fit into memory, so it is
//! solved by conjugate gradients, preconditioned by its diagonal; [`Training::laplacian`] gives the same
//! operator from one sparse system for each eigenvector of the coarse points' products.

use faer::Mat;

use super::data::narrow;
use super::fit::{Training, squared};
use super::harmonics::Laplacian;

/// How a solve went.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Solve {
    /// Unknowns.
    pub unknowns: usize,
    /// Numbers of the system's lower triangle.
    pub entries: usize,
    /// Iterations.
    pub iterations: usize,
    /// Residual over the right-hand side, both measured by the diagonal's inverse.
    pub residual: f64,
}

struct System<'a> {
    training: &'a Training,
    /// Lower triangle of alpha^2 L V^-1 L.
    coupling: Vec<(usize, usize, f64)>,
    inverse_diagonal: Mat<f64>,
}

impl System<'_> {
    fn apply(&self, y: &Mat<f64>) -> Mat<f64> {
        let data = y * &self.training.normal.square;
        let weights = &self.training.weights;
        let mut out = Mat::from_fn(y.nrows(), y.ncols(), |i, j| weights[i] * data[(i, j)]);
        for j in 0..y.ncols() {
            let (from, to) = (y.col(j), out.col_mut(j));
            let (Some(from), Some(to)) = (from.try_as_col_major(), to.try_as_col_major_mut())
            else {
                continue;
            };
            let (from, to) = (from.as_slice(), to.as_slice_mut());
            for (a, b, value) in &self.coupling {
                to[*a] += value * from[*b];
                if a != b {
                    to[*b] += value * from[*a];
                }
            }
        }
        out
    }

    fn precondition(&self, r: &Mat<f64>) -> Mat<f64> {
        Mat::from_fn(r.nrows(), r.ncols(), |i, j| r[(i, j)] * self.inverse_diagonal[(i, j)])
    }
}

fn dot(a: &Mat<f64>, b: &Mat<f64>) -> f64 {
    let column = |(a, b): (faer::ColRef<'_, f64>, faer::ColRef<'_, f64>)| -> f64 {
        a.iter().zip(b.iter()).map(|(a, b)| a * b).sum()
    };
    a.col_iter().zip(b.col_iter()).map(column).sum()
}

impl Training {
    /// [`Training::laplacian`] by the aggregate system. `go_on` is asked every 50 iterations and at the
    /// end, with what there is.
    pub fn aggregate(
        &self,
        laplacian: &Laplacian,
        alpha: f64,
        go_on: &mut dyn FnMut(&Solve, &Mat<f32>) -> bool,
    ) -> Mat<f32> {
        let mut coupling = squared(laplacian);
        coupling.iter_mut().for_each(|(_, _, value)| *value *= alpha * alpha);
        let (n, width) = (self.fine, self.basis.ncols());
        let square = &self.normal.square;
        let mut diagonal =
            Mat::from_fn(n, width, |i, j| self.weights[i] * square[(j, j)].max(f64::MIN_POSITIVE));
        for (a, _, value) in coupling.iter().filter(|(a, b, _)| a == b) {
            (0..width).for_each(|j| diagonal[(*a, j)] += value);
        }
        let inverse_diagonal = Mat::from_fn(n, width, |i, j| 1.0 / diagonal[(i, j)]);
        let entries = n * width * (width + 1) / 2 + (coupling.len() - n) * width;
        let system = System { training: self, coupling, inverse_diagonal };
        let mut r = Mat::from_fn(n, width, |i, j| self.weights[i] * self.normal.right[(i, j)]);
        let mut y = Mat::<f64>::zeros(n, width);
        let mut z = system.precondition(&r);
        let mut p = z.clone();
        let (mut rz, first) = (dot(&r, &z), dot(&r, &z).max(f64::MIN_POSITIVE));
        let whole =
            |y: &Mat<f64>| self.whole(narrow((y * self.basis.transpose()).as_ref()).as_ref());
        let mut solve = Solve { unknowns: n * width, entries, iterations: 0, residual: 1.0 };
        loop {
            let q = system.apply(&p);
            let step = rz / dot(&p, &q);
            y += faer::Scale(step) * &p;
            r -= faer::Scale(step) * &q;
            z = system.precondition(&r);
            let next = dot(&r, &z);
            p = &z + faer::Scale(next / rz) * &p;
            rz = next;
            solve.iterations += 1;
            solve.residual = (rz / first).sqrt();
            // Nothing to solve for is 0 / 0.
            let done = solve.residual <= 1e-12 || solve.residual.is_nan();
            if done || solve.iterations.is_multiple_of(50) {
                let operator = whole(&y);
                if !go_on(&solve, &operator) || done {
                    return operator;
                }
            }
        }
    }
}

//! U by least squares, drawn to the barycentric lift, every row summing to 1.
//!
//! With `X` the coarse coordinates of all frames and `y` those of one fine vertex, a row is the least of
//! `|X u - y|^2 + s |u - b|^2` under `sum u = 1`, where `b` is the lift's row: one factorisation serves
//! all rows (Kavan et al. 2011, section 3.1, with the lift in place of zero, so that what the data do
//! not tell is interpolated). The strength `s` is the one that does best on states left out.

use cloth::{Mesh, Vec3};
use glam::Vec3A;

/// Strengths that are tried, relative to the mean square of a coarse point's coordinates.
const STRENGTHS: [f64; 7] = [1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0];
/// Of so many states one block is left out.
const BLOCKS: usize = 5;
/// Vertices by which strengths are compared.
const COMPARED: usize = 256;

/// Coarse and fine positions of the states, relative to the coarse points' mean in each: rows that
/// sum to 1 do not see the difference, and numbers stay small.
pub(super) struct Samples {
    coarse: usize,
    fine: usize,
    /// Frame after frame, axis after axis the coarse points (m).
    coarse_m: Vec<f32>,
    /// Likewise the fine vertices (m).
    fine_m: Vec<f32>,
}

/// A fitted operator.
pub(super) struct Fitted {
    /// Row after row.
    pub(super) weights: Vec<f32>,
    pub(super) strength: f32,
    pub(super) held_out_m: f32,
    pub(super) lift_m: f32,
}

impl Samples {
    pub(super) fn new<'a>(vertices: &[u32], states: impl Iterator<Item = &'a [f32]>) -> Self {
        let (mut coarse_m, mut fine_m, mut fine) = (Vec::new(), Vec::new(), 0);
        for state in states {
            fine = state.len() / 3;
            for axis in 0..3 {
                let at = |v: usize| state[3 * v + axis];
                let mean =
                    vertices.iter().map(|v| at(*v as usize)).sum::<f32>() / vertices.len() as f32;
                coarse_m.extend(vertices.iter().map(|v| at(*v as usize) - mean));
                fine_m.extend((0..fine).map(|v| at(v) - mean));
            }
        }
        Self { coarse: vertices.len(), fine, coarse_m, fine_m }
    }

    fn lines(&self) -> usize {
        self.coarse_m.len() / self.coarse
    }

    /// Whether a line (an axis of a frame) is in the block left out.
    fn is_out(&self, line: usize, block: usize) -> bool {
        (line / 3) * BLOCKS / (self.lines() / 3).max(1) == block
    }

    /// `X^T X`.
    pub(super) fn products(&self) -> Vec<f64> {
        self.gram(|_| true)
    }

    /// `X^T X` over the lines that `keep` names.
    fn gram(&self, keep: impl Fn(usize) -> bool) -> Vec<f64> {
        let m = self.coarse;
        let mut gram = vec![0.0f64; m * m];
        for (line, x) in self.coarse_m.chunks_exact(m).enumerate() {
            if !keep(line) {
                continue;
            }
            for (i, row) in gram.chunks_exact_mut(m).enumerate() {
                let xi = f64::from(x[i]);
                row.iter_mut().zip(x).for_each(|(g, xj)| *g += xi * f64::from(*xj));
            }
        }
        gram
    }

    /// `X^T y` of some vertices, row after row, over the lines that `keep` names.
    fn cross(&self, vertices: &[usize], keep: impl Fn(usize) -> bool) -> Vec<f64> {
        let m = self.coarse;
        let mut sums = vec![0.0f64; vertices.len() * m];
        let lines = self.coarse_m.chunks_exact(m).zip(self.fine_m.chunks_exact(self.fine));
        for (line, (x, y)) in lines.enumerate() {
            if keep(line) {
                for (row, v) in sums.chunks_exact_mut(m).zip(vertices) {
                    let y = f64::from(y[*v]);
                    row.iter_mut().zip(x).for_each(|(s, x)| *s += y * f64::from(*x));
                }
            }
        }
        sums
    }

    /// Sum of squares (m^2) of a row's error over the lines that `keep` names.
    fn error(&self, vertex: usize, row: &[f64], keep: impl Fn(usize) -> bool) -> f64 {
        let lines =
            self.coarse_m.chunks_exact(self.coarse).zip(self.fine_m.chunks_exact(self.fine));
        let error = |(x, y): (&[f32], &[f32])| {
            let made: f64 = row.iter().zip(x).map(|(u, x)| u * f64::from(*x)).sum();
            (made - f64::from(y[vertex])).powi(2)
        };
        lines.enumerate().filter(|(line, _)| keep(*line)).map(|(_, line)| error(line)).sum()
    }
}

/// Fits U; strengths are compared on vertices that are not left to the skin (`shares` below a half).
pub(super) fn fit(samples: &Samples, lift: &[f32], shares: &[f32]) -> Fitted {
    let m = samples.coarse;
    let free: Vec<usize> = (0..samples.fine).filter(|v| shares[*v] < 0.5).collect();
    let every = free.len().div_ceil(COMPARED).max(1);
    let compared: Vec<usize> = free.into_iter().step_by(every).collect();
    let prior = |v: usize| lift[v * m..][..m].iter().map(|b| f64::from(*b)).collect::<Vec<f64>>();
    let mut errors = [0.0f64; STRENGTHS.len()];
    let mut lift_error = 0.0;
    for block in 0..BLOCKS {
        let (inside, outside) =
            (|line| !samples.is_out(line, block), |line| samples.is_out(line, block));
        let gram = samples.gram(inside);
        let cross = samples.cross(&compared, inside);
        for (strength, error) in STRENGTHS.iter().zip(&mut errors) {
            let solver = Solver::new(&gram, m, *strength);
            for (v, cross) in compared.iter().zip(cross.chunks_exact(m)) {
                let row = solver.row(cross, &prior(*v));
                *error += samples.error(*v, &row, outside);
            }
        }
        let lifted = |v: &usize| samples.error(*v, &prior(*v), outside);
        lift_error += compared.iter().map(lifted).sum::<f64>();
    }
    let best = (0..STRENGTHS.len()).fold(0, |b, i| if errors[i] < errors[b] { i } else { b });
    let solver = Solver::new(&samples.gram(|_| true), m, STRENGTHS[best]);
    let mut weights = Vec::with_capacity(samples.fine * m);
    let all: Vec<usize> = (0..samples.fine).collect();
    for some in all.chunks(64) {
        let cross = samples.cross(some, |_| true);
        for (v, cross) in some.iter().zip(cross.chunks_exact(m)) {
            weights.extend(solver.row(cross, &prior(*v)).into_iter().map(|u| u as f32));
        }
    }
    // Three lines are one place.
    let places = (samples.lines() / 3 * compared.len()).max(1) as f64;
    let rms = |error: f64| (error / places).sqrt() as f32;
    Fitted {
        weights,
        strength: STRENGTHS[best] as f32,
        held_out_m: rms(errors[best]),
        lift_m: rms(lift_error),
    }
}

/// The factor of `X^T X + s I`, and its solution for a right-hand side of ones.
struct Solver {
    m: usize,
    strength: f64,
    factor: Vec<f64>,
    ones: Vec<f64>,
}

impl Solver {
    fn new(gram: &[f64], m: usize, relative: f64) -> Self {
        let mean = (0..m).map(|i| gram[i * m + i]).sum::<f64>() / m as f64;
        let strength = relative * mean.max(1e-12);
        let mut factor = gram.to_vec();
        (0..m).for_each(|i| factor[i * m + i] += strength);
        cholesky(&mut factor, m);
        let mut solver = Self { m, strength, factor, ones: vec![1.0; m] };
        let mut ones = vec![1.0; m];
        solver.solve(&mut ones);
        solver.ones = ones;
        solver
    }

    /// A row of U from its `X^T y` and the lift's row.
    fn row(&self, cross: &[f64], prior: &[f64]) -> Vec<f64> {
        let mut row: Vec<f64> =
            cross.iter().zip(prior).map(|(c, b)| c + self.strength * b).collect();
        self.solve(&mut row);
        let (sum, ones) = (row.iter().sum::<f64>(), self.ones.iter().sum::<f64>());
        let multiplier = (1.0 - sum) / ones;
        row.iter_mut().zip(&self.ones).for_each(|(u, one)| *u += multiplier * one);
        row
    }

    fn solve(&self, x: &mut [f64]) {
        let m = self.m;
        for i in 0..m {
            let (done, rest) = x.split_at_mut(i);
            let row = &self.factor[i * m..][..i];
            let known: f64 = row.iter().zip(done).map(|(l, x)| l * *x).sum();
            rest[0] = (rest[0] - known) / self.factor[i * m + i];
        }
        for i in (0..m).rev() {
            let (before, rest) = x.split_at_mut(i);
            rest[0] /= self.factor[i * m + i];
            let row = &self.factor[i * m..][..i];
            before.iter_mut().zip(row).for_each(|(x, l)| *x -= l * rest[0]);
        }
    }
}

/// The lower factor, in place; row after row.
fn cholesky(a: &mut [f64], m: usize) {
    for i in 0..m {
        let (before, rest) = a.split_at_mut(i * m);
        let row = &mut rest[..m];
        for j in 0..i {
            let other = &before[j * m..][..j];
            let known: f64 = row[..j].iter().zip(other).map(|(a, b)| a * b).sum();
            row[j] = (row[j] - known) / before[j * m + j];
        }
        let square: f64 = row[..i].iter().map(|x| x * x).sum();
        row[i] = (row[i] - square).max(f64::MIN_POSITIVE).sqrt();
    }
}

/// The barycentric lift: each fine vertex on the closest coarse triangle of the rest shape, row after
/// row (Kavan et al. 2011, section 4).
pub(super) fn lift(fine: &[Vec3], coarse: &Mesh) -> Vec<f32> {
    let m = coarse.vertex_count();
    let rest = coarse.rest_positions();
    let mut lift = vec![0.0; fine.len() * m];
    for (p, row) in fine.iter().zip(lift.chunks_exact_mut(m)) {
        let mut best = (f32::INFINITY, [0u32; 3], Vec3::X);
        for t in coarse.triangles() {
            let corners = t.map(|v| Vec3A::from(rest[v as usize]));
            let on = cloth::triangle::closest(&corners, Vec3A::from(*p));
            let (distance, weights) = (on.point.distance_squared(Vec3A::from(*p)), on.weights);
            if distance < best.0 {
                best = (distance, *t, weights);
            }
        }
        for (v, weight) in best.1.iter().zip(best.2.to_array()) {
            row[*v as usize] += weight;
        }
    }
    lift
}

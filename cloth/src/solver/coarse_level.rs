//! The coarse matrix of the two-level preconditioner, and its Cholesky factor.
//!
//! Galerkin's product `P^T A P` with the weights of [`super::aggregate`], factorised within its
//! skyline. What springs and inertia contribute is gathered once a frame; contact is added for
//! each solve, because its stiffness outweighs all else.

use glam::{Mat3A, Vec3A};

use super::aggregate::{SHARES, Shares};
use super::matrix::{Matrix, Pattern};
use super::simd::{self, Task};

/// Sums of a dot product that are kept apart, whatever the CPU.
const LANES: usize = 16;

/// Coarse matrix and factor; rows are node by node x, y, z.
#[derive(Debug, Clone, Default)]
pub(crate) struct CoarseLevel {
    /// First column and place of column 0 (which may lie before the row) of each row.
    first: Vec<usize>,
    starts: Vec<usize>,
    springs: Vec<f32>,
    factor: Vec<f32>,
    /// One over the factor's diagonal.
    inverse: Vec<f32>,
    x: Vec<f32>,
    nodes: Vec<Vec3A>,
    /// Whether `factor` serves.
    pub(crate) ready: bool,
}

impl CoarseLevel {
    /// Gathers a matrix without contacts.
    pub(crate) fn gather(&mut self, shares: &Shares, pattern: &Pattern, matrix: &Matrix) {
        self.ready = false;
        if shares.nodes == 0 {
            return;
        }
        self.shape(shares, pattern);
        let rows = &pattern.near_upper.rows;
        for (i, own) in shares.of.iter().enumerate() {
            let (first, starts) = (&self.first, &self.starts);
            add_diagonal(first, starts, &mut self.springs, own, &matrix.diagonal[i]);
            for slot in rows.row(i) {
                let block = Mat3A::from_cols_array(&matrix.upper[slot]);
                let other = &shares.of[rows.columns[slot] as usize];
                let turned = block.transpose();
                for (a, wa) in own.iter().filter(|s| s.1 != 0.0) {
                    for (b, wb) in other.iter().filter(|s| s.1 != 0.0) {
                        let w = wa * wb;
                        match a.cmp(b) {
                            std::cmp::Ordering::Greater => self.add(*a, *b, &block, w),
                            std::cmp::Ordering::Less => self.add(*b, *a, &turned, w),
                            std::cmp::Ordering::Equal => {
                                self.add(*a, *a, &(block + turned), w);
                            }
                        }
                    }
                }
            }
            for slot in pattern.far.row(i) {
                let column = pattern.far.columns[slot] as usize;
                if column < i {
                    continue;
                }
                let other = &shares.of[column];
                let scalar = matrix.far[slot];
                for (a, wa) in own.iter().filter(|s| s.1 != 0.0) {
                    for (b, wb) in other.iter().filter(|s| s.1 != 0.0) {
                        let twice = if a == b { 2.0 } else { 1.0 };
                        self.add_scalar(*a.max(b), *a.min(b), scalar * wa * wb * twice);
                    }
                }
            }
        }
        self.ready = true;
    }

    /// Factorises what was gathered with the contacts of `diagonal`, which `bare` is without.
    pub(crate) fn factorise(&mut self, shares: &Shares, bare: &[Mat3A], diagonal: &[Mat3A]) {
        if self.first.is_empty() || shares.nodes == 0 {
            return;
        }
        self.factor.clone_from(&self.springs);
        for ((own, bare), whole) in shares.of.iter().zip(bare).zip(diagonal) {
            let more = *whole - *bare;
            if more != Mat3A::ZERO {
                add_diagonal(&self.first, &self.starts, &mut self.factor, own, &more);
            }
        }
        self.inverse.resize(self.first.len(), 0.0);
        let Self { first, starts, factor, inverse, .. } = self;
        self.ready = simd::run(Cholesky { first, starts, factor, inverse });
    }

    /// `z += P Ac^-1 P^T r`; returns `r . z`.
    pub(crate) fn correct(&mut self, shares: &Shares, r: &[Vec3A], z: &mut [Vec3A]) -> f32 {
        self.x.resize(self.first.len(), 0.0);
        self.nodes.resize(shares.nodes, Vec3A::ZERO);
        let Self { first, starts, factor, inverse, x, nodes, .. } = self;
        simd::run(Restrict { shares, r, x });
        simd::run(Substitute { first, starts, factor, inverse, x });
        simd::run(Prolong { shares, x, nodes, r, z })
    }

    fn shape(&mut self, shares: &Shares, pattern: &Pattern) {
        let count = 3 * shares.nodes;
        if self.first.len() != count {
            self.first.clear();
            self.first.extend((0..count).map(|r| r / 3 * 3));
        }
        // The skyline: the lowest node that any block couples a node with.
        for (r, first) in self.first.iter_mut().enumerate() {
            *first = r / 3 * 3;
        }
        let mut couple = |i: usize, j: usize| {
            let lowest = |v: usize| shares.of[v].iter().filter(|s| s.1 != 0.0).map(|s| s.0).min();
            let Some(low) = lowest(i).into_iter().chain(lowest(j)).min() else { return };
            for (node, _) in shares.of[i].iter().chain(&shares.of[j]).filter(|s| s.1 != 0.0) {
                let at = 3 * *node as usize;
                for row in &mut self.first[at..at + 3] {
                    *row = (*row).min(3 * low as usize);
                }
            }
        };
        for rows in [&pattern.near_upper.rows, &pattern.far] {
            for i in 0..rows.count() {
                rows.row(i).for_each(|slot| couple(i, rows.columns[slot] as usize));
            }
        }
        self.starts.clear();
        let mut end = 0;
        for (r, first) in self.first.iter().enumerate() {
            self.starts.push(end);
            end += r + 1 - first;
        }
        self.springs.clear();
        self.springs.resize(end, 0.0);
    }

    fn add(&mut self, a: u32, b: u32, block: &Mat3A, w: f32) {
        add(&self.first, &self.starts, &mut self.springs, [a, b], block, w);
    }

    fn add_scalar(&mut self, a: u32, b: u32, w: f32) {
        for k in 0..3 {
            let row = 3 * a as usize + k;
            self.springs[self.starts[row] + 3 * b as usize + k - self.first[row]] += w;
        }
    }
}

fn add_diagonal(
    first: &[usize],
    starts: &[usize],
    sums: &mut [f32],
    own: &[(u32, f32); SHARES],
    block: &Mat3A,
) {
    for (a, wa) in own.iter().filter(|s| s.1 != 0.0) {
        for (b, wb) in own.iter().filter(|s| s.1 != 0.0 && s.0 <= *a) {
            add(first, starts, sums, [*a, *b], block, wa * wb);
        }
    }
}

/// Adds a block at node row `a` and node column `b <= a`; above the diagonal it is cut off.
fn add(
    first: &[usize],
    starts: &[usize],
    sums: &mut [f32],
    [a, b]: [u32; 2],
    block: &Mat3A,
    w: f32,
) {
    let (a, b) = (3 * a as usize, 3 * b as usize);
    let whole = block.to_cols_array();
    for k in 0..3 {
        let row = a + k;
        let at = starts[row] + b - first[row];
        let most = if a == b { k + 1 } else { 3 };
        for (l, sum) in sums[at..at + most].iter_mut().enumerate() {
            *sum += whole[3 * l + k] * w;
        }
    }
}

#[inline(always)]
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0f32; LANES];
    let (whole_a, rest_a) = a.as_chunks::<LANES>();
    let (whole_b, rest_b) = b.as_chunks::<LANES>();
    for (a, b) in whole_a.iter().zip(whole_b) {
        for k in 0..LANES {
            sums[k] += a[k] * b[k];
        }
    }
    for (k, (a, b)) in rest_a.iter().zip(rest_b).enumerate() {
        sums[k] += a * b;
    }
    let mut width = LANES / 2;
    while width > 0 {
        for k in 0..width {
            sums[k] += sums[k + width];
        }
        width /= 2;
    }
    sums[0]
}

/// Row by row, within the skyline; false where a pivot is not positive.
struct Cholesky<'a> {
    first: &'a [usize],
    starts: &'a [usize],
    factor: &'a mut [f32],
    inverse: &'a mut [f32],
}

impl Task for Cholesky<'_> {
    type Output = bool;

    #[inline(always)]
    fn run(self) -> bool {
        let Self { first, starts, factor, inverse } = self;
        for row in 0..first.len() {
            let (done, rest) = factor.split_at_mut(starts[row]);
            let own = &mut rest[..row + 1 - first[row]];
            let mut pivot = own[row - first[row]];
            let least = 1e-6 * pivot;
            for column in first[row]..row {
                let from = first[row].max(first[column]);
                let there = &done[starts[column] + from - first[column]..];
                let there = &there[..column - from];
                let here = &own[from - first[row]..column - first[row]];
                let value = (own[column - first[row]] - dot(here, there)) * inverse[column];
                own[column - first[row]] = value;
                pivot -= value * value;
            }
            if pivot.is_nan() || pivot <= least || pivot <= 0.0 {
                return false;
            }
            inverse[row] = 1.0 / pivot.sqrt();
        }
        true
    }
}

/// `x = P^T r`.
struct Restrict<'a> {
    shares: &'a Shares,
    r: &'a [Vec3A],
    x: &'a mut [f32],
}

impl Task for Restrict<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { shares, r, x } = self;
        for (node, x) in x.chunks_exact_mut(3).enumerate() {
            let list = shares.starts[node] as usize..shares.starts[node + 1] as usize;
            let sum: Vec3A = shares.by_node[list].iter().map(|(v, w)| r[*v as usize] * *w).sum();
            x.copy_from_slice(&sum.to_array());
        }
    }
}

/// `z += P x`; returns `r . z`.
struct Prolong<'a> {
    shares: &'a Shares,
    x: &'a [f32],
    nodes: &'a mut [Vec3A],
    r: &'a [Vec3A],
    z: &'a mut [Vec3A],
}

impl Task for Prolong<'_> {
    type Output = f32;

    #[inline(always)]
    fn run(self) -> f32 {
        let Self { shares, x, nodes, r, z } = self;
        for (node, x) in nodes.iter_mut().zip(x.chunks_exact(3)) {
            *node = Vec3A::from_slice(x);
        }
        let mut dot = Vec3A::ZERO;
        for ((own, z), r) in shares.of.iter().zip(z).zip(r) {
            let part = |k: usize| nodes[own[k].0 as usize] * own[k].1;
            *z += (part(0) + part(1)) + (part(2) + part(3));
            dot += *z * *r;
        }
        dot.element_sum()
    }
}

struct Substitute<'a> {
    first: &'a [usize],
    starts: &'a [usize],
    factor: &'a [f32],
    inverse: &'a [f32],
    x: &'a mut [f32],
}

impl Task for Substitute<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { first, starts, factor, inverse, x } = self;
        for row in 0..x.len() {
            let here = &factor[starts[row]..starts[row] + row - first[row]];
            x[row] = (x[row] - dot(here, &x[first[row]..row])) * inverse[row];
        }
        for row in (0..x.len()).rev() {
            let value = x[row] * inverse[row];
            x[row] = value;
            let here = &factor[starts[row]..starts[row] + row - first[row]];
            for (x, l) in x[first[row]..row].iter_mut().zip(here) {
                *x -= l * value;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::Mesh;
    use crate::solver::matrix::{Given, Scratch, Stop};
    use crate::{Environment, Material, Model, Vec3};

    /// Iterations until `A x = b` is solved for a stretched sheet's springs, and the answer.
    fn solve(with: bool) -> (u32, Vec<Vec3A>) {
        let n = 41u32;
        let at = |v: u32| Vec3::new((v % n) as f32 / 40.0, 0.0, (v / n) as f32 / 40.0);
        let cell = |v: u32| [[v, v + n, v + 1], [v + 1, v + n, v + n + 1]];
        let cells = (0..n * (n - 1)).filter(|v| v % n != n - 1);
        let mesh = Mesh::new((0..n * n).map(at).collect(), cells.flat_map(cell).collect()).unwrap();
        let held_vertices: Vec<u32> = (0..n).collect();
        let (material, air) = (Material::default(), Environment::default());
        let model = Model::new(mesh, material, air, None, &held_vertices).unwrap();
        let count = model.masses.len();
        let x: Vec<Vec3A> = (0..n * n).map(|v| Vec3A::from(at(v) * 1.01)).collect();
        let mut matrix = Matrix::default();
        matrix.size(&model.pattern);
        for (d, m) in matrix.diagonal.iter_mut().zip(&model.masses) {
            *d = Mat3A::from_diagonal(Vec3::splat(m * 120.0 * 120.0));
        }
        let mut forces = vec![Vec3A::ZERO; count];
        let constants = crate::solver::membrane::Constants::new(&material);
        let sums = crate::solver::membrane::Sums { forces: &mut forces, matrix: &mut matrix };
        let (mesh, pattern) = (&model.mesh, &model.pattern);
        crate::solver::membrane::assemble(mesh, pattern, constants, 1.0, &x, sums);
        matrix.mirror(pattern);
        let bare = matrix.diagonal.clone();
        for row in (0..count).step_by(7) {
            matrix.diagonal[row].y_axis.y += 1e4;
        }
        let residual = vec![Vec3A::new(0.1, -0.3, 0.2); count];
        let mut s = Scratch { residual, ..Scratch::default() };
        if with {
            s.coarse.gather(&model.shares, pattern, &matrix_of(&matrix, &bare));
            s.coarse.factorise(&model.shares, &bare, &matrix.diagonal);
            assert!(s.coarse.ready);
        }
        let held: Vec<bool> = (0..count).map(|v| v < n as usize).collect();
        let reference = vec![Vec3A::ZERO; count];
        let stop = Stop { tolerance: 1e-4, iterations: 1000 };
        let shares = &model.shares;
        let given = Given { pattern, held: &held, reference: &reference, shares, stop };
        let mut dx = vec![Vec3A::ZERO; count];
        (matrix.solve(given, &mut dx, &mut s), dx)
    }

    fn matrix_of(whole: &Matrix, bare: &[Mat3A]) -> Matrix {
        Matrix { diagonal: bare.to_vec(), ..whole.clone() }
    }

    #[test]
    fn the_coarse_level_saves_iterations_and_changes_no_answer() {
        let ((plain, wanted), (two, found)) = (solve(false), solve(true));
        assert!(2 * two < plain, "{two} against {plain}");
        let most = wanted.iter().map(|w| w.length()).fold(0.0, f32::max);
        let error = wanted.iter().zip(&found).map(|(w, f)| w.distance(*f)).fold(0.0, f32::max);
        assert!(error < 2e-3 * most, "{error} of {most}");
    }
}

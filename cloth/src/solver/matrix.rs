//! A symmetric block matrix over the garment's vertices, and conjugate gradients on it.

use std::ops::Range;

use glam::{Mat3A, Vec3A};

use crate::mesh::Mesh;
use crate::solver::self_contact::Rows as PairRows;

/// Where blocks stand: 3 x 3 blocks between vertices that share an edge, scalars between vertices
/// that are opposite each other across an edge (bending alone couples those).
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Pattern {
    pub(crate) near: Rows,
    pub(crate) far: Rows,
    /// For each triangle the slots of its corner pairs 01, 10, 02, 20, 12, 21.
    pub(crate) triangle_slots: Vec<[u32; 6]>,
}

/// Columns of each row, ascending, without the diagonal.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Rows {
    starts: Vec<u32>,
    pub(crate) columns: Vec<u32>,
}

/// The matrix's values.
#[derive(Debug, Clone, Default)]
pub(crate) struct Matrix {
    pub(crate) diagonal: Vec<Mat3A>,
    pub(crate) near: Vec<Mat3A>,
    pub(crate) far: Vec<f32>,
    /// What couples the vertices of pairs in contact; their diagonal blocks are in `diagonal`.
    pub(crate) pairs: PairRows,
}

/// Scratch of the solver.
#[derive(Debug, Clone, Default)]
pub(crate) struct Scratch {
    /// Before solving the right-hand side, after it what is left of it.
    pub(crate) residual: Vec<Vec3A>,
    inverse: Vec<Mat3A>,
    z: Vec<Vec3A>,
    p: Vec<Vec3A>,
    q: Vec<Vec3A>,
}

/// What a solve is told besides the matrix.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Given<'a> {
    pub(crate) pattern: &'a Pattern,
    /// Rows that keep their value.
    pub(crate) held: &'a [bool],
    /// A force per vertex that counts as large: residuals are measured against it, or against
    /// the first one if that is larger.
    pub(crate) reference: &'a [Vec3A],
    pub(crate) stop: Stop,
}

/// When to stop.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Stop {
    /// Relative residual, in the norm of the inverted diagonal blocks.
    pub(crate) tolerance: f32,
    /// Most iterations.
    pub(crate) iterations: u32,
}

impl Rows {
    fn new(count: usize, mut pairs: Vec<(u32, u32)>) -> Self {
        pairs.sort_unstable();
        pairs.dedup();
        let mut starts = vec![0u32; count + 1];
        for (row, _) in &pairs {
            starts[*row as usize + 1] += 1;
        }
        for row in 0..count {
            starts[row + 1] += starts[row];
        }
        Self { starts, columns: pairs.into_iter().map(|(_, column)| column).collect() }
    }

    /// Slots of a row.
    pub(crate) fn row(&self, row: usize) -> Range<usize> {
        self.starts[row] as usize..self.starts[row + 1] as usize
    }

    /// The slot of a pair.
    pub(crate) fn slot(&self, row: u32, column: u32) -> Option<usize> {
        let range = self.row(row as usize);
        let found = self.columns[range.clone()].binary_search(&column).ok()?;
        Some(range.start + found)
    }
}

impl Pattern {
    /// The pattern of a mesh.
    pub(crate) fn new(mesh: &Mesh) -> Self {
        let count = mesh.vertex_count();
        let both = |a: u32, b: u32| [(a, b), (b, a)];
        let near = Rows::new(count, mesh.edges().iter().flat_map(|e| both(e[0], e[1])).collect());
        let across = mesh.hinges().iter().map(|h| (h.vertices[2], h.vertices[3]));
        let apart = across.filter(|(a, b)| a != b && near.slot(*a, *b).is_none());
        let far = Rows::new(count, apart.flat_map(|(a, b)| both(a, b)).collect());
        let slot = |a, b| near.slot(a, b).map_or(0, |s| s as u32);
        let slots = |t: &[u32; 3]| {
            let [a, b, c] = *t;
            [slot(a, b), slot(b, a), slot(a, c), slot(c, a), slot(b, c), slot(c, b)]
        };
        let triangle_slots = mesh.triangles().iter().map(slots).collect();
        Self { near, far, triangle_slots }
    }
}

impl Matrix {
    /// `out = A x`.
    pub(crate) fn multiply(&self, pattern: &Pattern, x: &[Vec3A], out: &mut [Vec3A]) {
        for (row, out) in out.iter_mut().enumerate() {
            let mut sum = self.diagonal[row] * x[row];
            let near = pattern.near.row(row);
            let blocks = &self.near[near.clone()];
            for (block, column) in blocks.iter().zip(&pattern.near.columns[near]) {
                sum += *block * x[*column as usize];
            }
            let far = pattern.far.row(row);
            let scalars = &self.far[far.clone()];
            for (scalar, column) in scalars.iter().zip(&pattern.far.columns[far]) {
                sum += x[*column as usize] * *scalar;
            }
            *out = sum;
        }
        self.pairs.multiply(x, out);
    }

    /// Adds to `x` the solution of `A dx = s.residual` by conjugate gradients with the inverted
    /// diagonal blocks as preconditioner. Returns the iterations.
    pub(crate) fn solve(&self, given: Given<'_>, x: &mut [Vec3A], s: &mut Scratch) -> u32 {
        let Given { pattern, held, reference, stop } = given;
        s.size(x.len());
        let mut floor = 0.0;
        for (row, inverse) in s.inverse.iter_mut().enumerate() {
            *inverse = if held[row] { Mat3A::ZERO } else { self.diagonal[row].inverse() };
            floor += reference[row].dot(*inverse * reference[row]);
        }
        let mut rz = s.precondition();
        let enough = stop.tolerance * stop.tolerance * rz.max(floor);
        s.p.copy_from_slice(&s.z);
        let mut iterations = 0;
        while rz > enough && iterations < stop.iterations {
            self.multiply(pattern, &s.p, &mut s.q);
            let curvature = dot(&s.p, &s.q);
            if !curvature.is_normal() || curvature < 0.0 {
                break;
            }
            let alpha = rz / curvature;
            for (((x, r), p), q) in x.iter_mut().zip(&mut s.residual).zip(&s.p).zip(&s.q) {
                *x += *p * alpha;
                *r -= *q * alpha;
            }
            let next = s.precondition();
            let beta = next / rz;
            rz = next;
            for (p, z) in s.p.iter_mut().zip(&s.z) {
                *p = *z + *p * beta;
            }
            iterations += 1;
        }
        iterations
    }
}

impl Scratch {
    fn size(&mut self, count: usize) {
        self.inverse.resize(count, Mat3A::ZERO);
        for v in [&mut self.z, &mut self.p, &mut self.q] {
            v.resize(count, Vec3A::ZERO);
        }
    }

    /// `z = D^-1 r`; returns `r . z`. Held rows give z = 0, so that they never move. (The product
    /// of a held row in `q` is meaningless and meets only zeros.)
    fn precondition(&mut self) -> f32 {
        let mut sum = Vec3A::ZERO;
        for ((z, inverse), r) in self.z.iter_mut().zip(&self.inverse).zip(&self.residual) {
            *z = *inverse * *r;
            sum += *z * *r;
        }
        sum.element_sum()
    }
}

fn dot(a: &[Vec3A], b: &[Vec3A]) -> f32 {
    a.iter().zip(b).fold(Vec3A::ZERO, |sum, (a, b)| sum + *a * *b).element_sum()
}

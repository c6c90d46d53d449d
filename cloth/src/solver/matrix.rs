//! A symmetric block matrix over the garment's vertices, and conjugate gradients on it.

use std::ops::Range;

use glam::{Mat3A, Vec3A};

use super::aggregate::Shares;
use super::coarse_level::CoarseLevel;
use super::simd::{self, Set, Task};
use crate::mesh::Mesh;
use crate::solver::self_contact::Rows as PairRows;

/// Where blocks stand: 3 x 3 blocks between vertices that share an edge, scalars between vertices
/// that are opposite each other across an edge (bending alone couples those).
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Pattern {
    pub(crate) near: Rows,
    pub(crate) far: Rows,
    /// The part of `near` right of the diagonal, in which the matrix is assembled.
    pub(crate) near_upper: Upper,
    /// For each slot of `near` where its block is assembled.
    places: Vec<Place>,
    /// For each triangle the places of its corner pairs 01, 02, 12.
    pub(crate) triangle_places: Vec<[Place; 3]>,
}

/// The part right of the diagonal: the matrix is symmetric.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Upper {
    pub(crate) rows: Rows,
    /// For each slot of `rows` that of the whole rows.
    pub(crate) whole: Vec<u32>,
}

/// The block of a pair of vertices.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Place {
    pub(crate) slot: u32,
    /// Whether the transposed block is stored.
    pub(crate) turned: bool,
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
    /// Right of the diagonal, column by column: where blocks are assembled.
    pub(crate) upper: Vec<[f32; 9]>,
    /// Slot by slot, column by column, and [`simd::PADDING`] zeros; see [`Matrix::mirror`].
    pub(crate) near: Vec<f32>,
    /// Slot by slot.
    pub(crate) far: Vec<f32>,
    /// What couples the vertices of pairs in contact; their diagonal blocks are in `diagonal`.
    pub(crate) pairs: PairRows,
}

/// Scratch of the solver.
#[derive(Debug, Clone, Default)]
pub(crate) struct Scratch {
    /// Before solving the right-hand side, after it the residual.
    pub(crate) residual: Vec<Vec3A>,
    pub(crate) inverse: Vec<Mat3A>,
    pub(crate) z: Vec<Vec3A>,
    pub(crate) p: Vec<Vec3A>,
    pub(crate) coarse: CoarseLevel,
    pub(crate) q: Vec<Vec3A>,
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
    pub(crate) shares: &'a Shares,
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
        assert!(pairs.iter().all(|(a, b)| (*a as usize) < count && (*b as usize) < count));
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

    /// Number of rows.
    pub(crate) fn count(&self) -> usize {
        self.starts.len() - 1
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

impl Upper {
    fn new(whole: &Rows) -> Self {
        let mut starts = vec![0];
        let (mut columns, mut slots) = (Vec::new(), Vec::new());
        for row in 0..whole.count() {
            let right = whole.row(row).filter(|s| whole.columns[*s] as usize > row);
            for slot in right {
                columns.push(whole.columns[slot]);
                slots.push(slot as u32);
            }
            starts.push(columns.len() as u32);
        }
        Self { rows: Rows { starts, columns }, whole: slots }
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
        let near_upper = Upper::new(&near);
        let place = |a: u32, b: u32| {
            let slot = near_upper.rows.slot(a.min(b), a.max(b)).map_or(0, |s| s as u32);
            Place { slot, turned: a > b }
        };
        let places = |t: &[u32; 3]| [place(t[0], t[1]), place(t[0], t[2]), place(t[1], t[2])];
        let triangle_places = mesh.triangles().iter().map(places).collect();
        let rows = (0..count).flat_map(|row| near.row(row).map(move |slot| (row as u32, slot)));
        let places = rows.map(|(row, slot)| place(row, near.columns[slot])).collect();
        Self { near, far, near_upper, places, triangle_places }
    }
}

impl Matrix {
    /// Takes the size of a pattern; the values are whatever they were.
    pub(crate) fn size(&mut self, pattern: &Pattern) {
        self.diagonal.resize(pattern.near.count(), Mat3A::ZERO);
        self.upper.resize(pattern.near_upper.whole.len(), [0.0; 9]);
        self.near.resize(9 * pattern.near.columns.len() + simd::PADDING, 0.0);
        self.far.resize(pattern.far.columns.len(), 0.0);
    }

    /// Writes what was assembled right of the diagonal to both sides of it: a product that reads
    /// blocks in order is twice as fast as one that scatters.
    pub(crate) fn mirror(&mut self, pattern: &Pattern) {
        for (block, place) in self.near.chunks_exact_mut(9).zip(&pattern.places) {
            let from = &self.upper[place.slot as usize];
            if place.turned {
                for (k, value) in block.iter_mut().enumerate() {
                    *value = from[k % 3 * 3 + k / 3];
                }
            } else {
                block.copy_from_slice(from);
            }
        }
    }

    /// Adds a block, given as for the pair's first vertex.
    #[inline(always)]
    pub(crate) fn add(&mut self, place: Place, block: &Mat3A) {
        let whole = block.to_cols_array();
        let sum = &mut self.upper[place.slot as usize];
        for (k, sum) in sum.iter_mut().enumerate() {
            *sum += if place.turned { whole[k % 3 * 3 + k / 3] } else { whole[k] };
        }
    }

    /// `out = A x`; returns `x . out`.
    pub(crate) fn multiply(&self, pattern: &Pattern, x: &[Vec3A], out: &mut [Vec3A]) -> f32 {
        let dot = simd::multiply(Set::detect(), self, pattern, x, out);
        dot + self.pairs.multiply(x, out)
    }

    /// Improves `x` as a solution of `A x = b`, where `b` stands in `s.residual`, by conjugate
    /// gradients with the inverted diagonal blocks as preconditioner. Returns the iterations.
    pub(crate) fn solve(&self, given: Given<'_>, x: &mut [Vec3A], s: &mut Scratch) -> u32 {
        let Given { pattern, held, reference, shares, stop } = given;
        s.size(x.len());
        self.multiply(pattern, x, &mut s.q);
        let mut floor = 0.0;
        for (row, inverse) in s.inverse.iter_mut().enumerate() {
            *inverse = if held[row] { Mat3A::ZERO } else { self.diagonal[row].inverse() };
            floor += reference[row].dot(*inverse * reference[row]);
            s.residual[row] -= s.q[row];
        }
        let mut rz = s.precondition();
        let enough = stop.tolerance * stop.tolerance * rz.max(floor);
        // How much is left is told by the first level alone, which does not change.
        let mut left = rz;
        rz = s.correct(shares, rz);
        s.p.copy_from_slice(&s.z);
        let mut iterations = 0;
        while left > enough && iterations < stop.iterations {
            let curvature = self.multiply(pattern, &s.p, &mut s.q);
            if !curvature.is_normal() || curvature < 0.0 {
                break;
            }
            left = simd::run(Advance { alpha: rz / curvature, x, s });
            let next = s.correct(shares, left);
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

/// `x += alpha p`, `r -= alpha q`, `z = D^-1 r`; gives `r . z`. Held rows give z = 0, so that they
/// never move. (The product of a held row in `q` is meaningless and meets only zeros.)
struct Advance<'a> {
    alpha: f32,
    x: &'a mut [Vec3A],
    s: &'a mut Scratch,
}

impl Task for Advance<'_> {
    type Output = f32;

    #[inline(always)]
    fn run(self) -> f32 {
        let (alpha, s) = (self.alpha, self.s);
        let mut sum = Vec3A::ZERO;
        let ways = self.x.iter_mut().zip(&s.p).zip(&s.q);
        let ends = s.residual.iter_mut().zip(&mut s.z).zip(&s.inverse);
        for (((x, p), q), ((r, z), inverse)) in ways.zip(ends) {
            *x += *p * alpha;
            *r -= *q * alpha;
            *z = *inverse * *r;
            sum += *z * *r;
        }
        sum.element_sum()
    }
}

impl Scratch {
    fn size(&mut self, count: usize) {
        self.inverse.resize(count, Mat3A::ZERO);
        for v in [&mut self.z, &mut self.p, &mut self.q] {
            v.resize(count, Vec3A::ZERO);
        }
    }

    /// Adds the coarse level's part to `z`; returns `r . z`, which was `rz`.
    fn correct(&mut self, shares: &Shares, rz: f32) -> f32 {
        if !self.coarse.ready {
            return rz;
        }
        self.coarse.correct(shares, &self.residual, &mut self.z)
    }

    /// `z = D^-1 r`; returns `r . z`.
    fn precondition(&mut self) -> f32 {
        let mut sum = Vec3A::ZERO;
        for ((z, inverse), r) in self.z.iter_mut().zip(&self.inverse).zip(&self.residual) {
            *z = *inverse * *r;
            sum += *z * *r;
        }
        sum.element_sum()
    }
}

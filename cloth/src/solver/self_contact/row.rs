//! Repulsion and friction of near pairs as rows of the implicit system.

use glam::{Mat3A, Vec3A};

use super::pair::{Closest, Pair, mix};
use super::{FLOOR_M, SelfContact};
use crate::model::Model;
use crate::solver::matrix::Matrix;

/// Stiffness of a row (N/m): as stiff as the cloth itself.
const STIFFNESS: f32 = 1000.0;
/// What is too near parts no faster than this (m/s).
const CORRECTION_M_S: f32 = 0.25;
/// An outer layer on the wrong side of an inner one goes through it at this speed (m/s).
const REORDER_M_S: f32 = 0.5;
/// Slip at which Coulomb's force is reached (m/s).
const STICK_M_S: f32 = 1e-3;

/// A stiff row `shares . x`: along its normal, and with friction across it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Row {
    vertices: [u32; 4],
    shares: [f32; 4],
    normal: Vec3A,
    /// Across the normal (N/m).
    drag: f32,
}

/// The rows of a pass.
#[derive(Debug, Clone, Default)]
pub(crate) struct Rows(pub(crate) Vec<Row>);

/// Where a pass stands.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pass<'a> {
    /// Positions at the substep's beginning (m).
    pub(crate) x: &'a [Vec3A],
    /// Velocities there (m/s).
    pub(crate) v: &'a [Vec3A],
    /// Ways at which the rows are chosen (m).
    pub(crate) way: &'a [Vec3A],
    pub(crate) inverse_masses: &'a [f32],
    /// Substep (s).
    pub(crate) dt: f32,
}

impl SelfContact {
    /// Adds a row, with its force and its part of the matrix's diagonal, for each listed pair that
    /// is too near after `pass.way`.
    pub(crate) fn add_rows(
        &self,
        model: &Model,
        pass: Pass<'_>,
        matrix: &mut Matrix,
        force: &mut [Vec3A],
    ) {
        let repels = |p: &&Pair| p.wrong || !p.edges && !self.is_calm(p);
        for pair in self.pairs.iter().filter(repels) {
            let from = pass.x[pair.vertices[0] as usize];
            let start = pair.gather(from, pass.x);
            let way = pair.vertices.map(|v| pass.way[v as usize]);
            let end = std::array::from_fn(|k| start[k] + way[k]);
            let (shares, normal) = pair.side(&start, &end);
            let (normal, keep) = if pair.wrong {
                (-pair.normal, REORDER_M_S * pass.dt - pair.distance)
            } else {
                let most = pair.distance.max(FLOOR_M) + CORRECTION_M_S * pass.dt;
                (normal, pair.keep.min(most))
            };
            let gap = normal.dot(mix(&shares, &end)) - keep;
            if gap >= 0.0 {
                continue;
            }
            let weight =
                |k: usize| shares[k] * shares[k] * pass.inverse_masses[pair.vertices[k] as usize];
            let load = -gap / ((weight(0) + weight(1) + weight(2) + weight(3)) * pass.dt * pass.dt);
            let old = mix(&shares, &pair.vertices.map(|v| pass.v[v as usize] * pass.dt));
            let slip = (old - normal * normal.dot(old)).length().max(STICK_M_S * pass.dt);
            let load = load.min(-gap * STIFFNESS);
            let drag = (model.material.friction * load / slip).min(STIFFNESS);
            let row = Row { vertices: pair.vertices, shares, normal, drag };
            // The unknowns are whole ways: the force is that at none.
            let far = gap - normal.dot(mix(&shares, &way));
            row.add(far, &mut matrix.diagonal, force);
            matrix.pairs.0.push(row);
        }
    }
}

impl Pair {
    /// Shares and normal of the row that keeps the pair on the side where it began: those at the
    /// end where it has not passed, else those of the beginning.
    fn side(&self, start: &[Vec3A; 4], end: &[Vec3A; 4]) -> ([f32; 4], Vec3A) {
        if self.wrong {
            return (Closest::of(self.edges, start).shares, self.normal);
        }
        let there = Closest::of(self.edges, end);
        let distance = there.across.length();
        let same = self.normal.dot(there.across) > 0.0;
        if distance > FLOOR_M && (same || self.meeting(start, end, 0.1 * FLOOR_M).is_none()) {
            return (there.shares, there.across / distance);
        }
        (Closest::of(self.edges, start).shares, self.normal)
    }
}

impl Row {
    fn add(&self, gap: f32, diagonal: &mut [Mat3A], force: &mut [Vec3A]) {
        let n = self.normal;
        let normal = Mat3A::from_cols(n * n.x, n * n.y, n * n.z);
        let block =
            normal * (STIFFNESS - self.drag) + Mat3A::from_diagonal(glam::Vec3::splat(self.drag));
        let pull = n * (STIFFNESS * gap);
        for (v, c) in self.vertices.iter().zip(self.shares) {
            diagonal[*v as usize] += block * (c * c);
            force[*v as usize] -= pull * c;
        }
    }
}

impl Rows {
    /// `out += A x` for what couples different vertices; the diagonal is the matrix's. Returns what
    /// this adds to `x . out`.
    pub(crate) fn multiply(&self, x: &[Vec3A], out: &mut [Vec3A]) -> f32 {
        let mut dot = 0.0;
        for row in &self.0 {
            let at = row.vertices.map(|v| x[v as usize]);
            let sum = mix(&row.shares, &at);
            let n = row.normal;
            for k in 0..4 {
                let c = row.shares[k];
                let rest = sum - at[k] * c;
                let pull = n * (n.dot(rest) * (STIFFNESS - row.drag)) + rest * row.drag;
                out[row.vertices[k] as usize] += pull * c;
                dot += at[k].dot(pull) * c;
            }
        }
        dot
    }
}

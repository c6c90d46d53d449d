//! Bending: a quadratic energy of the positions, flat at rest.
//!
//! Over the two triangles of an inner edge, `K x` is edge length times dihedral angle, in the
//! direction of the normal (Bergou et al. 2006, section 4); the energy is
//! `bend |K x|^2 / (2 (A0 + A1))`. This factor gives a cylinder of curvature k its `bend k^2 / 2`
//! per area on a mesh of equilateral triangles in every direction, and on a grid of right
//! triangles along its axes. The Hessian is constant, positive, and the same for x, y and z.

use glam::{Vec3, Vec3A};

use super::matrix::Pattern;
use crate::mesh::{Hinge, Mesh};

/// The Hessian, as scalars: a block is its scalar times the identity.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Stiffness {
    pub(crate) diagonal: Vec<f32>,
    /// For each block of the pattern.
    pub(crate) near: Vec<f32>,
    /// For each far neighbour of the pattern: vertices opposite each other across an edge.
    pub(crate) far: Vec<f32>,
}

impl Stiffness {
    /// Sums the Hessians of all hinges.
    pub(crate) fn new(mesh: &Mesh, pattern: &Pattern, bend: f32) -> Self {
        let mut sum = Self {
            diagonal: vec![0.0; mesh.vertex_count()],
            near: vec![0.0; pattern.near.columns.len()],
            far: vec![0.0; pattern.far.columns.len()],
        };
        for hinge in mesh.hinges() {
            let (k, area) = coefficients(mesh.rest_positions(), hinge);
            for i in 0..4 {
                for j in 0..4 {
                    let value = bend * k[i] * k[j] / area;
                    let (row, column) = (hinge.vertices[i], hinge.vertices[j]);
                    if i == j {
                        sum.diagonal[row as usize] += value;
                    } else if let Some(slot) = pattern.near.slot(row, column) {
                        sum.near[slot] += value;
                    } else if let Some(slot) = pattern.far.slot(row, column) {
                        sum.far[slot] += value;
                    }
                }
            }
        }
        sum
    }

    /// Adds the forces `-Q x` at positions `x`.
    pub(crate) fn add_forces(&self, pattern: &Pattern, x: &[Vec3A], forces: &mut [Vec3A]) {
        for (row, force) in forces.iter_mut().enumerate() {
            // Relative to the row's own vertex (rows sum to zero), which keeps f32 exact enough.
            let own = x[row];
            let mut sum = Vec3A::ZERO;
            for slot in pattern.near.row(row) {
                sum += (x[pattern.near.columns[slot] as usize] - own) * self.near[slot];
            }
            for slot in pattern.far.row(row) {
                sum += (x[pattern.far.columns[slot] as usize] - own) * self.far[slot];
            }
            *force -= sum;
        }
    }
}

/// `K` and the area of both triangles.
fn coefficients(rest: &[Vec3], hinge: &Hinge) -> ([f32; 4], f32) {
    let [a, b, c, d] = hinge.vertices.map(|v| rest[v as usize]);
    let cot = |u: Vec3, v: Vec3| u.dot(v) / u.cross(v).length();
    let (at_a_c, at_b_c) = (cot(b - a, c - a), cot(a - b, c - b));
    let (at_a_d, at_b_d) = (cot(b - a, d - a), cot(a - b, d - b));
    let k = [at_b_c + at_b_d, at_a_c + at_a_d, -at_a_c - at_b_c, -at_a_d - at_b_d];
    let area = 0.5 * ((b - a).cross(c - a).length() + (b - a).cross(d - a).length());
    (k, area)
}

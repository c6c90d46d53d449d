//! Bending: a quadratic energy of the positions, flat at rest.
//!
//! Over the two triangles of an inner edge, `K x` is edge length times dihedral angle, in the
//! direction of the normal (Bergou et al. 2006, section 4); the energy is
//! `bend |K x|^2 / (2 (A0 + A1))`. This factor gives a cylinder of curvature k its `bend k^2 / 2`
//! per area on a mesh of equilateral triangles in every direction, and on a grid of right
//! triangles along its axes. (A sheet that may relax on its mesh is softer than its cylinder: a
//! cantilever on a grid with alternating diagonals sags by half as much again.) The Hessian is constant, positive, and the same for x, y and z.

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cylinder_has_half_its_squared_curvature_as_energy() {
        let (n, dx, curvature, bend) = (20u32, 0.01f32, 2.0f32, 1e-3f32);
        let at = |i: u32, j: u32| Vec3::new(i as f32 * dx, 0.0, j as f32 * dx);
        let v = |i: u32, j: u32| j * (n + 1) + i;
        let rest: Vec<Vec3> = (0..=n).flat_map(|j| (0..=n).map(move |i| at(i, j))).collect();
        let cell = |i, j| {
            [[v(i, j), v(i, j + 1), v(i + 1, j)], [v(i + 1, j), v(i, j + 1), v(i + 1, j + 1)]]
        };
        let triangles = (0..n).flat_map(|j| (0..n).flat_map(move |i| cell(i, j))).collect();
        let mesh = Mesh::new(rest.clone(), triangles).unwrap();
        let pattern = Pattern::new(&mesh);
        let stiffness = Stiffness::new(&mesh, &pattern, bend);
        let bent = |p: &Vec3| {
            let (s, c) = (p.z * curvature).sin_cos();
            Vec3A::new(p.x, (1.0 - c) / curvature, s / curvature)
        };
        let x: Vec<Vec3A> = rest.iter().map(bent).collect();
        let mut forces = vec![Vec3A::ZERO; x.len()];
        stiffness.add_forces(&pattern, &x, &mut forces);
        let energy: f32 = x.iter().zip(&forces).map(|(x, f)| -0.5 * x.dot(*f)).sum();
        // Rows of edges at both ends bend nothing.
        let area = (n as f32 * dx) * ((n - 1) as f32 * dx);
        let expected = 0.5 * bend * curvature * curvature * area;
        assert!((energy / expected - 1.0).abs() < 0.01, "{energy} {expected}");
        let net = forces.iter().fold(Vec3A::ZERO, |sum, f| sum + *f);
        let largest = forces.iter().map(|f| f.length()).fold(0.0, f32::max);
        assert!(net.length() < 1e-3 * largest, "{net}");
    }
}

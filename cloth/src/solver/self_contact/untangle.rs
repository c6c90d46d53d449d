//! Works out places where the cloth crosses itself, without history.
//!
//! Where an edge cuts a triangle, the line along which the two layers cut each other begins; it
//! gets shorter fastest when edge and triangle are shifted against each other along the gradient of
//! its length (Volino & Magnenat-Thalmann 2006, "Resolving surface collisions through intersection
//! contour minimization"). The pairs around are left alone meanwhile, so that nothing holds the
//! tangle together.

use glam::{Vec3, Vec3A};

use super::SelfContact;
use crate::model::Model;

/// Edge and triangle are shifted against each other by this in a substep (m).
const SHIFT_M: f32 = 2.5e-3;
/// Edges nearly in the triangle's plane count as this steep.
const STEEP: f32 = 0.1;

impl SelfContact {
    /// Shifts the vertices around crossings at `ends` by a bounded way.
    pub(crate) fn untangle(&mut self, model: &Model, inverse_masses: &[f32], ends: &mut [Vec3A]) {
        if self.crossings.is_empty() {
            return;
        }
        self.shifts.clear();
        self.shifts.resize(ends.len(), (Vec3A::ZERO, 0.0));
        for i in 0..self.crossings.len() {
            let c = self.crossings[i];
            let triangle = model.mesh.triangles()[c.triangle as usize];
            let layer = |v: u32| model.layers.get(v as usize).copied().unwrap_or(0);
            if self.sort_layers && layer(c.edge[0]) != layer(triangle[0]) {
                continue; // the layers' order tells more
            }
            let Some((along, shares)) = gradient(model, c.edge, triangle, ends) else { continue };
            let vertices = [c.edge[0], c.edge[1], triangle[0], triangle[1], triangle[2]];
            let weight = |k: usize| inverse_masses[vertices[k] as usize] * shares[k].abs();
            let sum: f32 = (0..5).map(|k| weight(k) * shares[k].abs()).sum();
            if sum <= 0.0 {
                continue;
            }
            for (k, v) in vertices.into_iter().enumerate() {
                let shift = &mut self.shifts[v as usize];
                shift.0 += along * (SHIFT_M * weight(k) * shares[k].signum() / sum);
                shift.1 += 1.0;
            }
        }
        for (end, (shift, count)) in ends.iter_mut().zip(&self.shifts) {
            if *count > 0.0 {
                *end += (*shift / *count).clamp_length_max(SHIFT_M);
            }
        }
    }
}

/// The direction in which the edge must go against the triangle, and the shares of the five
/// vertices at the point where they cut.
fn gradient(
    model: &Model,
    edge: [u32; 2],
    triangle: [u32; 3],
    x: &[Vec3A],
) -> Option<(Vec3A, [f32; 5])> {
    let at = |v: u32| x[v as usize];
    let (p, q) = (at(edge[0]), at(edge[1]));
    let [a, b, c] = triangle.map(at);
    let n = (b - a).cross(c - a).try_normalize()?;
    let e = (q - p).try_normalize()?;
    let steep = e.dot(n);
    let steep = if steep < 0.0 { steep.min(-STEEP) } else { steep.max(STEEP) };
    let mut sum = Vec3A::ZERO;
    for opposite in model.tree.opposites(&model.mesh, edge).into_iter().flatten() {
        let inward = at(opposite) - p;
        let face = e.cross(inward);
        let Some(line) = n.cross(face).try_normalize() else { continue };
        // Into the face, away from the edge.
        let line = if line.dot(inward - e * e.dot(inward)) < 0.0 { -line } else { line };
        sum += line - n * (e.dot(line) / steep);
    }
    let along = sum.try_normalize()?;
    let height = n.dot(q - p);
    let s = if height.abs() > 0.0 { (n.dot(a - p) / height).clamp(0.0, 1.0) } else { 0.5 };
    let w: Vec3 = crate::triangle::closest(&[a, b, c], p + (q - p) * s).weights;
    Some((along, [1.0 - s, s, -w.x, -w.y, -w.z]))
}

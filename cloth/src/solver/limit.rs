//! The last word on strain: edges that are still too long after the solve are shortened.

use glam::Vec3A;

use super::contact::{Kind, Row};
use crate::mesh::Mesh;

/// Largest strain that is left alone.
pub(crate) const STRAIN_MAX: f32 = 0.10;
/// Sweeps stop when no edge is over this.
const STRAIN_DONE: f32 = 0.115;
const SWEEPS: u32 = 60;

/// Gauss-Seidel over the edges in their order, each shortened to `STRAIN_MAX` (Provot 1995, with
/// masses), in turn with the contact planes. Returns the sweeps made: 0 in calm motion.
pub(crate) fn project(mesh: &Mesh, inverse_masses: &[f32], rows: &[Row], x: &mut [Vec3A]) -> u32 {
    for sweep in 0..SWEEPS {
        let worst = shorten(mesh, inverse_masses, x);
        if worst <= 1.0 + STRAIN_DONE {
            return sweep;
        }
        for ((x, row), w) in x.iter_mut().zip(rows).zip(inverse_masses) {
            if row.kind == Kind::Plane && *w > 0.0 {
                *x = row.push_out(*x);
            }
        }
    }
    SWEEPS
}

/// One sweep; returns the largest ratio of length to rest length that it met.
fn shorten(mesh: &Mesh, inverse_masses: &[f32], x: &mut [Vec3A]) -> f32 {
    let mut worst = 0.0f32;
    for (e, rest) in mesh.edges().iter().zip(mesh.rest_lengths()) {
        let (a, b) = (e[0] as usize, e[1] as usize);
        let d = x[b] - x[a];
        let most = rest * (1.0 + STRAIN_MAX);
        let length2 = d.length_squared();
        if length2 <= most * most {
            continue;
        }
        let (wa, wb) = (inverse_masses[a], inverse_masses[b]);
        if wa + wb <= 0.0 {
            continue;
        }
        let length = length2.sqrt();
        worst = worst.max(length / rest);
        let correction = d * ((length - most) / (length * (wa + wb)));
        x[a] += correction * wa;
        x[b] -= correction * wb;
    }
    worst
}

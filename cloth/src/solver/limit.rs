//! The last word on strain: edges that are still too long after the solve are shortened.

use glam::Vec3A;

use super::contact::{Kind, Row};
use crate::mesh::Mesh;

/// Edges are shortened to the first strain; sweeps stop when no edge is over the second.
const STRAIN: [f32; 2] = [0.10, 0.115];
const SWEEPS: u32 = 120;
/// The same where contact and held vertices are overruled: as much as the promise of 15 % leaves.
const LAST_STRAIN: [f32; 2] = [0.132, 0.14];
/// Sweeps without contact after that, at most.
const LAST_SWEEPS: u32 = 1000;

/// Between two sweeps over all edges, this many go over those near their limit alone.
const SHORT_SWEEPS: u32 = 15;
/// An edge is near its limit within this strain of it.
const NEAR: f32 = 0.03;

/// Edges that a sweep goes over: end vertices and rest length.
pub(crate) type Edge = ([u32; 2], f32);

/// Gauss-Seidel over the edges in their order, shortened where too long (Provot 1995, with
/// masses), in turn with the contact planes. Where planes, held vertices and edges contradict each
/// other, as between an arm and the chest, the edges have the last word: then every vertex is
/// `free` to move by its mass. Returns the sweeps made: 0 in calm motion.
pub(crate) fn project(
    mesh: &Mesh,
    inverse_masses: &[f32],
    free: &[f32],
    rows: &[Row],
    x: &mut [Vec3A],
    busy: &mut Vec<Edge>,
) -> u32 {
    for sweep in 0..SWEEPS {
        if shorten_in_turn(mesh, sweep, STRAIN, inverse_masses, x, busy) {
            return sweep;
        }
        for (x, row) in x.iter_mut().zip(rows) {
            if row.kind == Kind::Plane {
                *x = row.push_out(*x);
            }
        }
    }
    for sweep in 0..LAST_SWEEPS {
        if shorten_in_turn(mesh, sweep, LAST_STRAIN, free, x, busy) {
            return SWEEPS + sweep;
        }
    }
    SWEEPS + LAST_SWEEPS
}

/// One sweep over the edges that are longer than the last word allows; returns whether there are
/// none.
pub(crate) fn settle(mesh: &Mesh, inverse_masses: &[f32], x: &mut [Vec3A]) -> bool {
    let edges = mesh.edges().iter().copied().zip(mesh.rest_lengths().iter().copied());
    shorten(edges, LAST_STRAIN, inverse_masses, x)
}

/// A sweep over all edges, or one of those between over the busy ones; returns whether all edges
/// were found short enough.
fn shorten_in_turn(
    mesh: &Mesh,
    sweep: u32,
    strain: [f32; 2],
    inverse_masses: &[f32],
    x: &mut [Vec3A],
    busy: &mut Vec<Edge>,
) -> bool {
    let edges = mesh.edges().iter().copied().zip(mesh.rest_lengths().iter().copied());
    if !sweep.is_multiple_of(SHORT_SWEEPS + 1) {
        shorten(busy.iter().copied(), strain, inverse_masses, x);
        return false;
    }
    if shorten(edges.clone(), strain, inverse_masses, x) {
        return true;
    }
    busy.clear();
    let near = 1.0 + strain[0] - NEAR;
    busy.extend(edges.filter(|(e, rest)| {
        let most = rest * near;
        x[e[0] as usize].distance_squared(x[e[1] as usize]) > most * most
    }));
    false
}

/// Shortens edges between held vertices where the skin that leads them stretches too far.
pub(crate) fn tighten(edges: &[([u32; 2], f32)], inverse_masses: &[f32], x: &mut [Vec3A]) {
    for _ in 0..SWEEPS {
        if shorten(edges.iter().copied(), STRAIN, inverse_masses, x) {
            break;
        }
    }
}

/// One sweep; returns whether no edge was over the second strain.
fn shorten(
    edges: impl Iterator<Item = ([u32; 2], f32)>,
    strain: [f32; 2],
    inverse_masses: &[f32],
    x: &mut [Vec3A],
) -> bool {
    let mut worst = 0.0f32;
    for (e, rest) in edges {
        let (a, b) = (e[0] as usize, e[1] as usize);
        let d = x[b] - x[a];
        let most = rest * (1.0 + strain[0]);
        let length2 = d.length_squared();
        if length2 <= most * most {
            continue;
        }
        let (wa, wb) = (inverse_masses[a], inverse_masses[b]);
        // Between two held vertices nothing gives.
        if wa + wb <= 0.0 {
            continue;
        }
        let length = length2.sqrt();
        worst = worst.max(length / rest);
        let correction = d * ((length - most) / (length * (wa + wb)));
        x[a] += correction * wa;
        x[b] -= correction * wb;
    }
    worst <= 1.0 + strain[1]
}

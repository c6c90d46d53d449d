//! Contact between the points: places along the edges.

use glam::Vec3A;

use super::contact::nearest;
use super::{Coarse, NEAREST, Workspace};
use crate::mesh::Mesh;

/// A place on an edge.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    ends: [u32; 2],
    /// How far along it (0..=1).
    share: f32,
}

/// Places so close on every edge that no gap in the rest shape is wider than `spacing_m`; none for 0.
pub(super) fn samples(mesh: &Mesh, spacing_m: f32) -> Vec<Sample> {
    if spacing_m <= 0.0 {
        return Vec::new();
    }
    let edges = mesh.edges().iter().zip(mesh.rest_lengths());
    let along = |(ends, length): (&[u32; 2], &f32)| {
        let gaps = (length / spacing_m).ceil().clamp(1.0, 16.0) as u32;
        let ends = *ends;
        (1..gaps).map(move |place| Sample { ends, share: place as f32 / gaps as f32 })
    };
    edges.flat_map(along).collect()
}

impl Coarse {
    pub(super) fn find_near_between(&self, ws: &mut Workspace) {
        ws.near_between.clear();
        for sample in &self.samples {
            let [a, b] = sample.ends.map(|v| v as usize);
            let held = self.places[a] == usize::MAX && self.places[b] == usize::MAX;
            let x = ws.start[a].lerp(ws.start[b], sample.share);
            let aim = ws.aim[a].lerp(ws.aim[b], sample.share);
            let way = 2.0 * (aim - x).length() + 0.1;
            let near = if held { [u16::MAX; NEAREST] } else { nearest(&ws.swept, x, way) };
            ws.near_between.push(near);
        }
    }

    /// Leads places along edges out of colliders, by their ends: each goes by its share and mass.
    pub(super) fn push_out_between(&self, ws: &mut Workspace) {
        let weight =
            |i: usize| if self.places[i] == usize::MAX { 0.0 } else { 1.0 / self.masses[i] };
        for (sample, near) in self.samples.iter().zip(&ws.near_between) {
            let [a, b] = sample.ends.map(|v| v as usize);
            let (share_a, share_b) = (1.0 - sample.share, sample.share);
            for c in near.iter().take_while(|c| **c != u16::MAX) {
                let swept = &ws.swept[usize::from(*c)];
                let x0 = ws.start[a].lerp(ws.start[b], sample.share);
                let x = ws.x[a].lerp(ws.x[b], sample.share);
                let Some(hit) = swept.hit(x0, x) else { continue };
                let (wa, wb) = (share_a * weight(a), share_b * weight(b));
                let sum = share_a * wa + share_b * wb;
                // Beside a point that is led the other would have to go too far.
                let most = 2.0 / share_a.max(share_b);
                let out: Vec3A = hit.normal * hit.depth;
                let slip = x + out - x0 - hit.travel;
                let slip = slip - hit.normal * hit.normal.dot(slip);
                let friction = self.material.friction * hit.depth;
                let out = out - slip * (friction / slip.length().max(friction).max(1e-12));
                for (i, w) in [(a, wa), (b, wb)] {
                    ws.x[i] += out * (w / sum.max(f32::MIN_POSITIVE)).min(most);
                    if w > 0.0 && ws.contacts[i].is_none() {
                        ws.contacts[i] = Some((hit.normal, hit.travel));
                    }
                }
            }
        }
    }
}

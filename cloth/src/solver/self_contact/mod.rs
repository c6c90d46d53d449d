//! Contact of the cloth with itself.
//!
//! Each substep, where the first pass has led every vertex is known; `find` lists every pair of
//! a vertex and a face, or of two edges, that may come near on the straight way there. The second
//! pass solves with a stiff one-sided row for each vertex that came too near a face. `bound` has the
//! last word on positions, and the only one on two edges: vertices and faces of both layers hold
//! layers apart already, and in crumpled cloth rows of edges are three of four.
//!
//! # Why nothing passes
//!
//! Vertices move straight within a substep, so a cloth that begins without crossing can only cross
//! where a vertex passes through a face or an edge through an edge. A pair is missing from the list
//! only if its distance at the beginning less the largest difference of its vertices' predicted
//! ways exceeds the reach of the list, or if along its normal at the beginning it is predicted to end further
//! apart than that; so it stays apart as long as no vertex ends further from where it was
//! predicted than half of the reach, which `bound` checks at the end (and lists again if not). The
//! listed pairs are checked one by one for the way really gone: each has a direction in which its
//! parts are apart at both ends, hence always, or conservative advancement shows it. What fails is
//! pushed apart; what fails still moves on in pieces, each as a rigid body, which only grow. If
//! that does not end, all of the cloth is one piece. Only relative motion is ever bounded: what moves together goes as
//! far as it likes.
//!
//! Two triangles of a smooth patch are not compared (see `tree`). That holds for the ways for which pairs were listed, so triangles that end
//! turned from there are listed again.
//!
//! Where the cloth crosses itself already, the pairs all of whose vertices belong to edges and
//! triangles that cut each other may pass, and those with one such vertex do not repel, so that
//! `untangle` can work there and what is whole around stays so. Vertices that are held between
//! body parts keep off other cloth as all do: layers that are pressed between an arm
//! and the chest stay apart in the middle, and are in order when they come free. While a garment is draped
//! (`sort_layers`), of two layers in the wrong order the outer one is led through the inner one, at a bounded speed. In play an
//! order told by normals would be told wrong where cloth lies in folds: there nothing passes.

mod bound;
mod find;
pub(crate) mod pair;
mod row;
mod sieve;
mod untangle;

use glam::{Vec3, Vec3A};

use crate::crossings::{self, Crossing};
use crate::model::Model;
use crate::tree::Fit;
use pair::Pair;
pub(crate) use row::{Pass, Rows};
use sieve::Sieve;

/// Pairs are listed this much beyond the distance at which they act (m).
const MARGIN_M: f32 = 0.002;
/// What two parts always keep (m): more than the rounding of a state between frames takes.
const FLOOR_M: f32 = 2.5e-4;

/// Pairs of a substep and the scratch to find and treat them; nothing outlives a step.
#[derive(Debug, Clone, Default)]
pub(crate) struct SelfContact {
    fit: Fit,
    sieve: Sieve,
    pub(crate) pairs: Vec<Pair>,
    /// Vertices of edges and triangles that cut each other.
    off: Vec<bool>,
    /// The ways for which the pairs were listed (m).
    listed: Vec<Vec3A>,
    /// Vertices that ended far from where they were foreseen.
    strayed: Vec<bool>,
    positions: Vec<Vec3>,
    crossings: Vec<Crossing>,
    shifts: Vec<(Vec3A, f32)>,
    zones: bound::Zones,
    /// See [`crate::Span::sort_layers`].
    pub(crate) sort_layers: bool,
    moves: bound::Moves,
}

impl SelfContact {
    /// Looks for places where the cloth crosses itself at `x`.
    pub(crate) fn find_tangles(&mut self, model: &Model, x: &[Vec3A]) {
        self.positions.clear();
        self.positions.extend(x.iter().map(|p| Vec3::from(*p)));
        crossings::find(&model.tree, &mut self.fit, &self.positions, true, &mut self.crossings);
    }

    /// Whether the cloth crossed itself when it was looked at last.
    pub(crate) fn is_tangled(&self) -> bool {
        !self.crossings.is_empty()
    }

    /// Marks the vertices of edges and triangles that cut each other.
    pub(crate) fn mark_tangles(&mut self, model: &Model) {
        // Where crossings outnumber vertices no side is the right one: all may pass.
        let hopeless = self.crossings.len() > model.mesh.vertex_count();
        self.off.clear();
        self.off.resize(model.mesh.vertex_count(), hopeless);
        for c in &self.crossings {
            let triangle = model.mesh.triangles()[c.triangle as usize];
            for v in c.edge.iter().chain(&triangle) {
                self.off[*v as usize] = true;
            }
        }
    }

    /// Whether a pair is in the middle of a tangle: it may pass.
    fn may_pass(&self, pair: &Pair) -> bool {
        !pair.wrong && pair.vertices.iter().all(|v| self.off[*v as usize])
    }

    /// Whether a pair is near a tangle, where repulsion would not know its side.
    fn is_calm(&self, pair: &Pair) -> bool {
        pair.vertices.iter().any(|v| self.off[*v as usize])
    }

    /// Distance (m) within which pairs are listed.
    fn reach(model: &Model) -> f32 {
        model.material.offset + MARGIN_M
    }
}

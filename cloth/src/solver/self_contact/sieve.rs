//! Sorts out, eight at a time, what is too far apart to be listed.
//!
//! Of some two hundred thousand candidates a frame one in ten is listed. The sieve only leaves out
//! what is surely too far; what it lets pass is measured one by one, so that the list is what it would be
//! without.

use glam::Vec3A;

use crate::solver::simd::{self, Set};
use crate::wide::{Movers, WIDE};

/// How many candidates are looked at together.
const TOGETHER: usize = 512;
/// Most candidates between two slots: a vertex and a face both ways, and edges.
const OF_TWO: usize = 3 + 3 + 9;

/// A vertex and a face, or two edges.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Candidate {
    /// As a pair's.
    pub(super) vertices: [u32; 4],
    /// The face's slot; of two edges [`EDGES`].
    pub(super) face: u32,
}

/// No face, but two edges.
pub(super) const EDGES: u32 = u32::MAX;

/// Candidates that wait to be looked at, and the scratch for it.
#[derive(Debug, Clone)]
pub(super) struct Sieve {
    /// In the order in which they were met; only the first `count` are there.
    candidates: Vec<Candidate>,
    count: usize,
    /// Which of them are of faces, and of edges, and how many.
    kinds: [(Vec<u32>, usize); 2],
    /// Whether each of them may be near.
    near: Vec<bool>,
    movers: Movers,
}

impl Default for Sieve {
    fn default() -> Self {
        Self {
            candidates: Vec::new(),
            count: 0,
            kinds: Default::default(),
            near: Vec::new(),
            movers: Movers::NOWHERE,
        }
    }
}

impl Sieve {
    /// Makes room, and forgets what is there.
    pub(super) fn clear(&mut self) {
        self.candidates.resize(TOGETHER + OF_TWO, Candidate::default());
        self.near.resize(TOGETHER + OF_TWO, false);
        self.count = 0;
        for (list, count) in &mut self.kinds {
            list.resize(TOGETHER + OF_TWO, 0);
            *count = 0;
        }
    }

    /// Adds a candidate if it is `wanted`, which nothing here waits for.
    #[inline(always)]
    pub(super) fn push(&mut self, wanted: bool, candidate: Candidate) {
        let (list, count) = &mut self.kinds[usize::from(candidate.face == EDGES)];
        list[*count] = self.count as u32;
        *count += usize::from(wanted);
        self.candidates[self.count] = candidate;
        self.count += usize::from(wanted);
    }

    /// Whether there may be no room for the candidates of two more slots.
    #[inline(always)]
    pub(super) fn is_full(&self) -> bool {
        self.count >= TOGETHER
    }

    /// Looks which candidates may come within `reach` (m) of each other on their `way` from `x`.
    pub(super) fn look(&mut self, x: &[Vec3A], way: &[Vec3A], reach: f32) {
        let set = Set::detect();
        for (kind, (list, count)) in self.kinds.iter().enumerate() {
            for some in list[..*count].chunks(WIDE) {
                // Of what is not there the first stands.
                let mut vertices = [self.candidates[some[0] as usize].vertices; WIDE];
                for (four, place) in vertices.iter_mut().zip(some) {
                    *four = self.candidates[*place as usize].vertices;
                }
                self.movers.set(&vertices, x, way);
                let near = simd::may_meet(set, &self.movers, kind == 1, reach);
                for (lane, place) in some.iter().enumerate() {
                    self.near[*place as usize] = near >> lane & 1 == 1;
                }
            }
        }
    }

    /// Those that may be near, in the order in which they were met.
    pub(super) fn near(&self) -> impl Iterator<Item = Candidate> + '_ {
        let all = self.candidates[..self.count].iter().zip(&self.near);
        all.filter(|(_, near)| **near).map(|(candidate, _)| *candidate)
    }
}

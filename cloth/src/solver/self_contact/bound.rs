//! The last word on positions: no listed pair meets on its way.

use glam::Vec3A;

use super::pair::{Closest, Pair, mix};
use super::{FLOOR_M, SelfContact};
use crate::model::Model;
use crate::solver::limit;

/// Sweeps in which pairs are pushed apart one by one.
const SWEEPS: u32 = 16;
/// Rounds after that, in which what would still meet moves on as one piece.
const ROUNDS: u32 = 24;
/// Times the pairs are listed again because something moved further than foreseen.
const LISTINGS: u32 = 4;
/// Share of the way that lets pairs be listed again from which a vertex's pairs are among them.
const LITTLE: f32 = 0.5;
/// What a push asks for, against what must be kept.
const GENEROUS: f32 = 2.0;
/// Share of its slack that a pair's vertices are moved by before it is looked at again: the rest is
/// for rounding.
const TRUSTED: f32 = 0.9;

/// Vertices that move as one piece.
#[derive(Debug, Clone, Default)]
pub(crate) struct Zones {
    parent: Vec<u32>,
    members: Vec<u32>,
    inside: Vec<bool>,
    ways: Vec<(Vec3A, f32)>,
}

/// How far vertices' ends were moved in a substep.
#[derive(Debug, Clone, Default)]
pub(crate) struct Moves {
    /// Each vertex's moves, one after the other (m).
    travel: Vec<f32>,
    before: Vec<Vec3A>,
}

/// What the bound did.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Bounded {
    /// Whether any vertex was moved.
    pub(crate) moved: bool,
    /// Vertices that were moved on as pieces.
    pub(crate) pieces: u32,
    /// Pairs that could not be kept apart.
    pub(crate) lost: u32,
}

impl SelfContact {
    /// Changes `ends` where a listed pair would meet on the way there from `x`, or end nearer than
    /// it may. `inverse_masses` say how readily vertices give way.
    pub(crate) fn bound(
        &mut self,
        model: &Model,
        x: &[Vec3A],
        inverse_masses: &[f32],
        ends: &mut [Vec3A],
    ) -> Bounded {
        let mut done = Bounded::default();
        self.moves.travel.clear();
        self.moves.travel.resize(x.len(), 0.0);
        for _ in 0..LISTINGS {
            if self.has_strayed(model, x, ends) {
                self.find_strayed(model, x, ends);
            }
            if !self.push_apart(model, x, inverse_masses, ends, &mut done) {
                done.lost = self.move_as_pieces(x, inverse_masses, ends, &mut done);
            }
            if !self.has_strayed(model, x, ends) {
                break;
            }
        }
        done
    }

    /// Whether a vertex ends so far from where it was foreseen that unlisted pairs might meet.
    fn has_strayed(&mut self, model: &Model, x: &[Vec3A], ends: &[Vec3A]) -> bool {
        let most = 0.5 * (Self::reach(model) - FLOOR_M);
        let foreseen = || x.iter().zip(&self.listed).map(|(x, way)| *x + *way);
        let off = |(e, f): (&Vec3A, Vec3A), most: f32| e.distance_squared(f) > most * most;
        if !ends.iter().zip(foreseen()).any(|pair| off(pair, most)) {
            return false;
        }
        // What is a little off is listed again as well: it may have folded meanwhile.
        let little = |pair: (&Vec3A, Vec3A)| off(pair, LITTLE * most);
        self.strayed.clear();
        self.strayed.extend(ends.iter().zip(foreseen()).map(little));
        true
    }

    /// Gauss-Seidel over the pairs that would meet, in turn with the edges that this stretches too
    /// far; returns whether none of either is left. A pair that is clear is looked at again when its
    /// vertices have been moved so far that it may not be.
    fn push_apart(
        &mut self,
        model: &Model,
        x: &[Vec3A],
        inverse_masses: &[f32],
        ends: &mut [Vec3A],
        done: &mut Bounded,
    ) -> bool {
        let moves = &mut self.moves;
        for _ in 0..SWEEPS {
            let mut clear = true;
            if done.moved {
                moves.before.clear();
                moves.before.extend_from_slice(ends);
                clear = limit::settle(&model.mesh, inverse_masses, ends);
                moves.add_all(ends);
            }
            for pair in self.pairs.iter_mut().filter(|p| !p.wrong) {
                let Some((a, b)) = pair.unclear(x, ends, moves) else { continue };
                clear = false;
                let (shares, normal) = pair.side_of_meeting(&a, &b);
                let missing = GENEROUS * pair.floor() - normal.dot(mix(&shares, &b));
                let weight = |k: usize| inverse_masses[pair.vertices[k] as usize];
                let sum: f32 = (0..4).map(|k| shares[k] * shares[k] * weight(k)).sum();
                if missing > 0.0 && sum > 0.0 {
                    for (k, v) in pair.vertices.into_iter().enumerate() {
                        let push = normal * (shares[k] * weight(k) * missing / sum);
                        ends[v as usize] += push;
                        moves.travel[v as usize] += push.length();
                    }
                    done.moved = true;
                }
            }
            if clear {
                return true;
            }
        }
        false
    }

    /// Whatever would still meet moves on by its common mean way, in growing pieces. Returns how
    /// many pairs would meet still.
    fn move_as_pieces(
        &mut self,
        x: &[Vec3A],
        inverse_masses: &[f32],
        ends: &mut [Vec3A],
        done: &mut Bounded,
    ) -> u32 {
        let (zones, moves) = (&mut self.zones, &mut self.moves);
        zones.parent.clear();
        zones.parent.extend(0..x.len() as u32);
        zones.members.clear();
        zones.inside.clear();
        zones.inside.resize(x.len(), false);
        let mut lost = 0;
        for _ in 0..ROUNDS {
            lost = 0;
            for pair in self.pairs.iter_mut().filter(|p| !p.wrong) {
                if pair.unclear(x, ends, moves).is_some() {
                    lost += 1;
                    zones.join(&pair.vertices);
                }
            }
            if lost == 0 {
                break;
            }
            moves.before.clear();
            moves.before.extend_from_slice(ends);
            zones.go_on(x, inverse_masses, ends);
            moves.add_all(ends);
            done.moved = true;
        }
        done.pieces += zones.members.len() as u32;
        lost
    }
}

impl Moves {
    /// Adds the way of all vertices from where they were before.
    fn add_all(&mut self, ends: &[Vec3A]) {
        let ways = ends.iter().zip(&self.before).map(|(end, before)| end.distance(*before));
        self.travel.iter_mut().zip(ways).for_each(|(travel, way)| *travel += way);
    }
}

impl Pair {
    /// Where the pair begins and ends, if it may meet on its way; what is clear is not looked at again
    /// before it may have changed.
    #[inline(always)]
    fn unclear(
        &mut self,
        x: &[Vec3A],
        ends: &[Vec3A],
        moves: &Moves,
    ) -> Option<([Vec3A; 4], [Vec3A; 4])> {
        let gone = self.vertices.iter().map(|v| moves.travel[*v as usize]).sum::<f32>();
        if gone <= self.clear_until {
            return None;
        }
        let from = x[self.vertices[0] as usize];
        let (a, b) = (self.gather(from, x), self.gather(from, ends));
        match self.slack(&a, &b, self.floor()) {
            Some(slack) => {
                self.clear_until = gone + TRUSTED * slack;
                None
            }
            None => Some((a, b)),
        }
    }

    /// What this pair must keep (m): less where it has begun nearer.
    fn floor(&self) -> f32 {
        FLOOR_M.min(0.9 * self.distance)
    }

    /// Shares and normal by which to push: where the parts meet, or at the end.
    fn side_of_meeting(&self, a: &[Vec3A; 4], b: &[Vec3A; 4]) -> ([f32; 4], Vec3A) {
        let at = match self.meeting(a, b, 0.5 * self.floor()) {
            Some(t) => std::array::from_fn(|k| a[k] + (b[k] - a[k]) * t),
            None => *b,
        };
        let c = Closest::of(self.edges, &at);
        let length = c.across.length();
        let normal = if length > 0.1 * self.floor() { c.across / length } else { self.normal };
        (c.shares, normal)
    }
}

impl Zones {
    fn root(&mut self, mut v: u32) -> u32 {
        while self.parent[v as usize] != v {
            self.parent[v as usize] = self.parent[self.parent[v as usize] as usize];
            v = self.parent[v as usize];
        }
        v
    }

    fn join(&mut self, vertices: &[u32; 4]) {
        for v in vertices {
            if !std::mem::replace(&mut self.inside[*v as usize], true) {
                self.members.push(*v);
            }
            let (a, b) = (self.root(vertices[0]), self.root(*v));
            self.parent[a.max(b) as usize] = a.min(b);
        }
    }

    /// Every piece goes by the mean way of its vertices, weighted by mass.
    fn go_on(&mut self, x: &[Vec3A], inverse_masses: &[f32], ends: &mut [Vec3A]) {
        self.ways.clear();
        self.ways.resize(x.len(), (Vec3A::ZERO, 0.0));
        for i in 0..self.members.len() {
            let v = self.members[i] as usize;
            let mass = 1.0 / inverse_masses[v];
            let root = self.root(v as u32) as usize;
            self.ways[root].0 += (ends[v] - x[v]) * mass;
            self.ways[root].1 += mass;
        }
        for i in 0..self.members.len() {
            let v = self.members[i] as usize;
            let root = self.root(v as u32) as usize;
            let (way, mass) = self.ways[root];
            ends[v] = x[v] + way / mass;
        }
    }
}

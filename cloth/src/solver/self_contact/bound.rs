//! The last word on positions: no listed pair meets on its way.

use glam::{Mat3A, Quat, Vec3, Vec3A};

use super::pair::{Closest, Pair, mix};
use super::{FLOOR_M, SelfContact};
use crate::model::Model;
use crate::solver::limit;

/// Sweeps in which pairs are pushed apart one by one.
const SWEEPS: u32 = 16;
/// Rounds after that, in which what would still meet moves on as one piece.
const ROUNDS: u32 = 64;
/// Times the pairs are listed again because something moved further than foreseen.
const LISTINGS: u32 = 12;
/// Share of the way that lets pairs be listed again from which a vertex's pairs are among them.
const LITTLE: f32 = 0.5;
/// What a push asks for, against what must be kept.
const GENEROUS: f32 = 2.0;
/// Share of its slack that a pair's vertices are moved by before it is looked at again: the rest is
/// for rounding.
const TRUSTED: f32 = 0.9;
/// Share of a piece's polar moment that is added to its inertia, so that slender ones have an inverse.
const SLENDER: f32 = 1e-3;
/// A piece turns no further in a substep (rad): what is within it keeps 0.9 of its distance on the straight way.
const TURN_MAX: f32 = 0.8;

/// Vertices that move as one piece.
#[derive(Debug, Clone, Default)]
pub(crate) struct Zones {
    parent: Vec<u32>,
    members: Vec<u32>,
    inside: Vec<bool>,
    pieces: Vec<Piece>,
}

/// A piece that moves on as a rigid body (Bridson et al. 2002, "Robust treatment of collisions, contact and
/// friction for cloth animation", section 7.4), at the place of its root.
#[derive(Debug, Clone, Copy)]
struct Piece {
    /// Mass (kg).
    mass: f32,
    /// Sum of its vertices' places at the beginning, by mass (kg m).
    first_moment: Vec3A,
    /// Sum of their ways, by mass (kg m).
    momentum: Vec3A,
    /// Moment of their ways about its center, at the substep's beginning (kg m^2).
    spin: Vec3A,
    /// Moment of inertia about its center (kg m^2).
    inertia: Mat3A,
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
    /// Whether all of the cloth was moved on as one piece, for nothing else would do.
    pub(crate) whole: bool,
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
        self.zones.clear(x.len());
        for _ in 0..LISTINGS {
            if self.has_strayed(model, x, ends) {
                self.find_strayed(model, x, ends);
            }
            let clear = self.push_apart(model, x, inverse_masses, ends, &mut done)
                || self.move_as_pieces(x, inverse_masses, ends, &mut done);
            if !self.has_strayed(model, x, ends) && clear {
                return done;
            }
        }
        self.zones.join_all();
        self.zones.go_on(x, inverse_masses, ends);
        Bounded { moved: true, whole: true, ..done }
    }

    /// Whether a vertex ends so far from where it was foreseen that unlisted pairs might meet, or a triangle so
    /// turned.
    fn has_strayed(&mut self, model: &Model, x: &[Vec3A], ends: &[Vec3A]) -> bool {
        let most = 0.5 * (Self::reach(model) - FLOOR_M);
        let foreseen = || x.iter().zip(&self.listed).map(|(x, way)| *x + *way);
        let off = |(e, f): (&Vec3A, Vec3A), most: f32| e.distance_squared(f) > most * most;
        // What is a little off is listed again as well: it may have folded meanwhile.
        let far = ends.iter().zip(foreseen()).any(|pair| off(pair, most));
        let little = |pair: (&Vec3A, Vec3A)| far && off(pair, LITTLE * most);
        self.strayed.clear();
        self.strayed.extend(ends.iter().zip(foreseen()).map(little));
        let mut any = far;
        model.tree.turned(&self.fit, ends, |corners| {
            any = true;
            corners.iter().for_each(|v| self.strayed[*v as usize] = true);
        });
        any
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

    /// Whatever would still meet moves on in growing pieces, each as a rigid body. Returns whether no
    /// pair would meet any more.
    fn move_as_pieces(
        &mut self,
        x: &[Vec3A],
        inverse_masses: &[f32],
        ends: &mut [Vec3A],
        done: &mut Bounded,
    ) -> bool {
        let (zones, moves) = (&mut self.zones, &mut self.moves);
        let mut clear = false;
        for _ in 0..ROUNDS {
            clear = true;
            for pair in self.pairs.iter_mut().filter(|p| !p.wrong) {
                if pair.unclear(x, ends, moves).is_some() {
                    clear = false;
                    zones.join(&pair.vertices);
                }
            }
            if clear {
                break;
            }
            moves.before.clear();
            moves.before.extend_from_slice(ends);
            zones.go_on(x, inverse_masses, ends);
            moves.add_all(ends);
            done.moved = true;
        }
        done.pieces += zones.members.len() as u32;
        clear
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

    /// All vertices are one piece.
    fn join_all(&mut self) {
        self.parent.fill(0);
        self.members.clear();
        self.members.extend(0..self.parent.len() as u32);
    }

    /// Forgets all pieces.
    fn clear(&mut self, count: usize) {
        self.parent.clear();
        self.parent.extend(0..count as u32);
        self.members.clear();
        self.inside.clear();
        self.inside.resize(count, false);
    }

    /// Every piece goes on as a rigid body: with the momentum, and the angular momentum, of its vertices'
    /// ways. Nothing within it comes nearer than by the cosine of half its turn.
    fn go_on(&mut self, x: &[Vec3A], inverse_masses: &[f32], ends: &mut [Vec3A]) {
        self.pieces.resize(x.len(), Piece::NONE);
        for i in 0..self.members.len() {
            let root = self.root(self.members[i]) as usize;
            self.pieces[root] = Piece::NONE;
        }
        for i in 0..self.members.len() {
            let v = self.members[i] as usize;
            let mass = 1.0 / inverse_masses[v];
            let root = self.root(v as u32) as usize;
            let piece = &mut self.pieces[root];
            piece.mass += mass;
            piece.first_moment += x[v] * mass;
            piece.momentum += (ends[v] - x[v]) * mass;
        }
        for i in 0..self.members.len() {
            let v = self.members[i] as usize;
            let root = self.root(v as u32) as usize;
            self.pieces[root].add_turn(x[v], ends[v] - x[v], 1.0 / inverse_masses[v]);
        }
        for i in 0..self.members.len() {
            let v = self.members[i] as usize;
            let root = self.root(v as u32) as usize;
            ends[v] = self.pieces[root].end(x[v]);
        }
    }
}

impl Piece {
    const NONE: Self = Self {
        mass: 0.0,
        first_moment: Vec3A::ZERO,
        momentum: Vec3A::ZERO,
        spin: Vec3A::ZERO,
        inertia: Mat3A::ZERO,
    };

    /// Adds a vertex's share of what turns the piece.
    fn add_turn(&mut self, x: Vec3A, way: Vec3A, mass: f32) {
        let from = x - self.first_moment / self.mass;
        self.spin += from.cross(way) * mass;
        let outer = Mat3A::from_cols(from * from.x, from * from.y, from * from.z);
        let whole = Mat3A::from_diagonal(Vec3::splat(from.length_squared() * (1.0 + SLENDER)));
        self.inertia += (whole - outer) * mass;
    }

    /// Where a vertex of it that begins at `x` ends.
    fn end(&self, x: Vec3A) -> Vec3A {
        let (center, way) = (self.first_moment / self.mass, self.momentum / self.mass);
        // Near one, so that nothing of a small piece is lost to rounding.
        let unit = 1.0 / (self.inertia.x_axis.x + self.inertia.y_axis.y + self.inertia.z_axis.z);
        let turn = (self.inertia * unit).inverse() * (self.spin * unit);
        let turn = turn.clamp_length_max(TURN_MAX);
        if !turn.is_finite() {
            return x + way;
        }
        center + way + Quat::from_scaled_axis(turn.into()) * (x - center)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::crossings::Crossings;
    use crate::lab::shapes::{Chance, Cut, sheet};
    use crate::{Environment, Material, Mesh};

    #[test]
    fn a_piece_keeps_its_shape_its_momentum_and_its_spin() {
        let mut chance = Chance::new(5);
        let mut by_chance =
            |most: f32| Vec3A::from_array(std::array::from_fn(|_| most * chance.signed()));
        let x: Vec<Vec3A> = (0..10).map(|_| by_chance(0.1)).collect();
        let foreseen: Vec<Vec3A> = x.iter().map(|x| *x + by_chance(1e-3)).collect();
        let inverse_masses: Vec<f32> = (0..10).map(|v| 1e4 / (1.0 + v as f32)).collect();
        let mut zones = Zones::default();
        zones.clear(10);
        for vertices in [[0, 2, 4, 6], [6, 8, 2, 0], [1, 3, 5, 7]] {
            zones.join(&vertices);
        }
        let mut ends = foreseen.clone();
        zones.go_on(&x, &inverse_masses, &mut ends);
        assert_eq!(ends[9], foreseen[9], "it belongs to no piece");
        for piece in [&[0, 2, 4, 6, 8][..], &[1, 3, 5, 7]] {
            let sum = |of: &dyn Fn(usize) -> Vec3A| -> Vec3A {
                piece.iter().map(|v| of(*v) / inverse_masses[*v]).sum()
            };
            let momentum = |ends: &[Vec3A]| sum(&|v| ends[v] - x[v]);
            let spin = |ends: &[Vec3A]| sum(&|v| x[v].cross(ends[v] - x[v]));
            let off = momentum(&ends).distance(momentum(&foreseen));
            assert!(off < 1e-4 * momentum(&foreseen).length(), "{off}");
            // Of a turn of a hundredth, the chord is not the arc.
            let off = spin(&ends).distance(spin(&foreseen));
            assert!(off < 0.03 * spin(&foreseen).length(), "{off}");
            for (a, b) in piece.iter().zip(&piece[1..]) {
                let (before, after) = (x[*a].distance(x[*b]), ends[*a].distance(ends[*b]));
                assert!((before - after).abs() < 1e-5, "{before} {after}");
            }
        }
    }

    #[test]
    fn however_wild_the_ends_nothing_cuts_anything() {
        // Four sheets 5 mm apart. They were foreseen to stay, and are sent anywhere.
        let (mut p, mut t) = (Vec::new(), Vec::new());
        for layer in 0..4 {
            let flat = |u, v| Vec3::new(0.1 * u, 0.005 * layer as f32, 0.1 * v);
            let (one, first) = (sheet(6, 6, Cut::Alternating, flat).unwrap(), p.len() as u32);
            t.extend(one.triangles().iter().map(|t| t.map(|v| v + first)));
            p.extend_from_slice(one.rest_positions());
        }
        let mesh = Mesh::new(p.clone(), t).unwrap();
        let model =
            Model::new(mesh, Material::default(), Environment::default(), None, &[]).unwrap();
        let mut crossings = Crossings::new(model.mesh());
        let x: Vec<Vec3A> = p.iter().map(|p| Vec3A::from(*p)).collect();
        let mut inverse_masses: Vec<f32> = model.masses.iter().map(|m| 1.0 / m).collect();
        inverse_masses[0] *= 0.02;
        let mut chance = Chance::new(29);
        let (mut would_cut, mut pieces) = (0, 0);
        for round in 0..60 {
            let most = 0.01 * (1 + round % 15) as f32;
            let mut by_chance =
                |most: f32| Vec3A::from_array(std::array::from_fn(|_| most * chance.signed()));
            let mut ends: Vec<Vec3A> = x.iter().map(|x| *x + by_chance(most)).collect();
            let at = |x: &[Vec3A]| x.iter().map(|x| Vec3::from(*x)).collect::<Vec<_>>();
            would_cut += usize::from(!crossings.find(&at(&ends)).is_empty());
            let mut contact = SelfContact::default();
            contact.mark_tangles(&model);
            contact.find(&model, &x, &vec![Vec3A::ZERO; x.len()]);
            let bounded = contact.bound(&model, &x, &inverse_masses, &mut ends);
            pieces += usize::from(bounded.pieces > 0);
            assert!(crossings.find(&at(&ends)).is_empty(), "round {round}: {bounded:?}");
        }
        assert!(would_cut > 40 && pieces > 10, "{would_cut} {pieces}");
    }
}

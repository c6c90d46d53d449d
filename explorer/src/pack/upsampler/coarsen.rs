//! Decimation by collapsing edges, the shortest first; what is left are vertices of the mesh.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use cloth::Vec3;

/// A normal may turn by this much (cosine) when an edge is collapsed.
const TURN: f32 = 0.3;
/// Twice the area of a triangle over the square of its longest edge: thinner ones are not made.
const THINNEST: f32 = 0.1;
/// Triangles around a vertex, at most.
const FAN_MAX: usize = 12;

/// A mesh of fewer vertices.
pub(super) struct Coarsened {
    /// Which vertices are left, ascending.
    pub(super) vertices: Vec<u32>,
    /// Over places in `vertices`.
    pub(super) triangles: Vec<[u32; 3]>,
}

struct Collapse<'a> {
    positions: &'a [Vec3],
    triangles: Vec<[u32; 3]>,
    alive: Vec<bool>,
    /// Living triangles of each vertex.
    fans: Vec<Vec<u32>>,
}

/// Collapses edges until `points` vertices are left, or until no edge can go without changing the
/// surface's kind: it stays manifold, and its boundary stays a boundary.
pub(super) fn coarsen(positions: &[Vec3], triangles: &[[u32; 3]], points: usize) -> Coarsened {
    let mut fans = vec![Vec::new(); positions.len()];
    for (t, corners) in triangles.iter().enumerate() {
        corners.iter().for_each(|v| fans[*v as usize].push(t as u32));
    }
    let alive = vec![true; triangles.len()];
    let mut mesh = Collapse { positions, triangles: triangles.to_vec(), alive, fans };
    let mut left = mesh.fans.iter().filter(|fan| !fan.is_empty()).count();
    let mut queue = BinaryHeap::new();
    for t in triangles {
        (0..3).for_each(|i| queue.push(mesh.entry(t[i], t[(i + 1) % 3])));
    }
    while left > points {
        let Some(Reverse((_, a, b))) = queue.pop() else { break };
        let known = !mesh.fans[a as usize].is_empty() && !mesh.fans[b as usize].is_empty();
        if !known || !mesh.ring(a).contains(&b) {
            continue;
        }
        let (gone, kept) = if mesh.can_go(a, b) {
            (a, b)
        } else if mesh.can_go(b, a) {
            (b, a)
        } else {
            continue;
        };
        mesh.collapse(gone, kept);
        left -= 1;
        for other in mesh.ring(kept) {
            queue.push(mesh.entry(kept, other));
        }
    }
    mesh.finish()
}

impl Collapse<'_> {
    /// Place in the queue: by length, equal ones by number.
    fn entry(&self, a: u32, b: u32) -> Reverse<(u32, u32, u32)> {
        let length = self.positions[a as usize].distance(self.positions[b as usize]);
        Reverse((length.to_bits(), a.min(b), a.max(b)))
    }

    /// Neighbours, sorted.
    fn ring(&self, v: u32) -> Vec<u32> {
        let fan = self.fans[v as usize].iter();
        let corners = fan.flat_map(|t| self.triangles[*t as usize]);
        let mut ring: Vec<u32> = corners.filter(|w| *w != v).collect();
        ring.sort_unstable();
        ring.dedup();
        ring
    }

    fn shared(&self, a: u32, b: u32) -> usize {
        let has = |t: &&u32| self.triangles[**t as usize].contains(&b);
        self.fans[a as usize].iter().filter(has).count()
    }

    fn is_boundary(&self, v: u32) -> bool {
        self.ring(v).len() != self.fans[v as usize].len()
    }

    /// Whether `gone` can be drawn into `kept`.
    fn can_go(&self, gone: u32, kept: u32) -> bool {
        let shared = self.shared(gone, kept);
        if self.is_boundary(gone) && shared != 1 {
            return false;
        }
        let (ring, other) = (self.ring(gone), self.ring(kept));
        let common = ring.iter().filter(|v| other.binary_search(v).is_ok()).count();
        let fan = self.fans[gone as usize].len() + self.fans[kept as usize].len();
        if common != shared || fan > FAN_MAX + 2 * shared || ring.len() + other.len() <= 6 {
            return false;
        }
        let stays = |t: &&u32| !self.triangles[**t as usize].contains(&kept);
        self.fans[gone as usize].iter().filter(stays).all(|t| {
            let old = self.triangles[*t as usize];
            let new = old.map(|v| if v == gone { kept } else { v });
            let (n, m) = (self.normal(old), self.normal(new));
            let longest = (0..3)
                .map(|i| self.at(new[i]).distance_squared(self.at(new[(i + 1) % 3])))
                .fold(0.0, f32::max);
            m.length() > THINNEST * longest
                && n.normalize_or_zero().dot(m.normalize_or_zero()) > TURN
        })
    }

    fn collapse(&mut self, gone: u32, kept: u32) {
        for t in std::mem::take(&mut self.fans[gone as usize]) {
            let corners = self.triangles[t as usize];
            if corners.contains(&kept) {
                self.alive[t as usize] = false;
                for v in corners {
                    self.fans[v as usize].retain(|other| *other != t);
                }
            } else {
                self.triangles[t as usize] = corners.map(|v| if v == gone { kept } else { v });
                self.fans[kept as usize].push(t);
            }
        }
    }

    fn at(&self, v: u32) -> Vec3 {
        self.positions[v as usize]
    }

    fn normal(&self, [a, b, c]: [u32; 3]) -> Vec3 {
        (self.at(b) - self.at(a)).cross(self.at(c) - self.at(a))
    }

    fn finish(self) -> Coarsened {
        let vertices: Vec<u32> =
            (0..self.fans.len() as u32).filter(|v| !self.fans[*v as usize].is_empty()).collect();
        let place = |v: u32| vertices.partition_point(|w| *w < v) as u32;
        let living = self.triangles.iter().zip(&self.alive).filter(|(_, alive)| **alive);
        let triangles = living.map(|(t, _)| t.map(place)).collect();
        Coarsened { vertices, triangles }
    }
}

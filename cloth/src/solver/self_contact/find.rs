//! Lists the pairs that may come near in a substep.

use glam::Vec3A;

use super::SelfContact;
use super::pair::{Closest, Pair, slab};
use super::sieve::{Candidate, EDGES, Sieve};
use crate::model::Model;
use crate::tree::{Fit, Tree};

/// Share of a pair's distance in the rest shape at which it repels at most: parts of a smooth cloth
/// are no contact.
const REST_SHARE: f32 = 0.5;
/// Boxes that are this many times as far apart as matters are so beyond any rounding.
const FAR: f32 = 1.01;
/// An outer layer is on the wrong side where the cosine between the way to it and the inner one's
/// normal is less than this: what lies beside a rim is on neither.
const WRONG_SIDE: f32 = -0.3;

impl SelfContact {
    /// Lists the pairs whose distance at `x`, less their parts' relative `way`, is within reach.
    pub(crate) fn find(&mut self, model: &Model, x: &[Vec3A], way: &[Vec3A]) {
        self.listed.clear();
        self.listed.extend_from_slice(way);
        self.pairs.clear();
        self.strayed.clear();
        self.strayed.resize(x.len(), true);
        self.list(model, x, false);
    }

    /// Lists the pairs of strayed vertices anew, for the ways to `ends`.
    pub(crate) fn find_strayed(&mut self, model: &Model, x: &[Vec3A], ends: &[Vec3A]) {
        for (i, strayed) in self.strayed.iter().enumerate() {
            if *strayed {
                self.listed[i] = ends[i] - x[i];
            }
        }
        let strayed = &self.strayed;
        self.pairs.retain(|p| !p.vertices.iter().any(|v| strayed[*v as usize]));
        self.list(model, x, true);
    }

    /// Adds the pairs for the listed ways, or those of strayed vertices alone.
    fn list(&mut self, model: &Model, x: &[Vec3A], strayed: bool) {
        let (tree, reach) = (&model.tree, Self::reach(model));
        let mut pairs = std::mem::take(&mut self.pairs);
        let mut fit = std::mem::take(&mut self.fit);
        let mut sieve = std::mem::take(&mut self.sieve);
        sieve.clear();
        let way = &self.listed;
        tree.fit(|v| x[v as usize], |v| way[v as usize], &mut fit);
        if strayed {
            tree.restrict(&self.strayed, &mut fit);
        }
        let old = pairs.len();
        let (among, sort) = (&self.strayed[..], self.sort_layers);
        let search = Search { model, tree, x, way, among, reach, sort };
        tree.pairs(&mut fit, reach, true, |fit, i, j| {
            search.faces(i, j, &mut sieve);
            search.faces(j, i, &mut sieve);
            search.edges(i, j, &mut sieve);
            if sieve.is_full() {
                search.sift(fit, &mut sieve, &mut pairs);
            }
        });
        search.sift(&fit, &mut sieve, &mut pairs);
        self.fit = fit;
        self.sieve = sieve;
        let mut place = 0;
        pairs.retain(|p| {
            place += 1;
            place <= old || !self.may_pass(p)
        });
        self.pairs = pairs;
    }
}

struct Search<'a> {
    model: &'a Model,
    tree: &'a Tree,
    x: &'a [Vec3A],
    way: &'a [Vec3A],
    /// The vertices of which a pair must have one.
    among: &'a [bool],
    reach: f32,
    /// Whether to look for layers in the wrong order.
    sort: bool,
}

impl Search<'_> {
    /// The vertices that belong to slot `of` against the face of slot `against`.
    #[inline(always)]
    fn faces(&self, of: u32, against: u32, out: &mut Sieve) {
        let face = self.tree.corners[against as usize];
        let among = self.is_among(face[0]) | self.is_among(face[1]) | self.is_among(face[2]);
        for v in self.tree.own_vertices(of).iter().copied() {
            let apart = (v != face[0]) & (v != face[1]) & (v != face[2]);
            let vertices = [v, face[0], face[1], face[2]];
            out.push(apart & (among | self.is_among(v)), Candidate { vertices, face: against });
        }
    }

    /// The edges that belong to one slot against those that belong to the other.
    #[inline(always)]
    fn edges(&self, i: u32, j: u32, out: &mut Sieve) {
        for [a, b] in self.tree.own_sides(i) {
            let among = self.is_among(*a) | self.is_among(*b);
            for [c, d] in self.tree.own_sides(j) {
                let apart = (a != c) & (a != d) & (b != c) & (b != d);
                let wanted = apart & (among | self.is_among(*c) | self.is_among(*d));
                out.push(wanted, Candidate { vertices: [*a, *b, *c, *d], face: EDGES });
            }
        }
    }

    #[inline(always)]
    fn is_among(&self, vertex: u32) -> bool {
        self.among[vertex as usize]
    }

    /// Lists those of the candidates that are near, in their order, and forgets all.
    fn sift(&self, fit: &Fit, sieve: &mut Sieve, out: &mut Vec<Pair>) {
        sieve.look(self.x, self.way, self.reach);
        for candidate in sieve.near() {
            self.measure(fit, candidate, out);
        }
        sieve.clear();
    }

    fn measure(&self, fit: &Fit, Candidate { vertices, face }: Candidate, out: &mut Vec<Pair>) {
        let [a, b, c, d] = vertices;
        let apart = |u: u32, v: u32| (self.way[u as usize] - self.way[v as usize]).length_squared();
        let one = apart(a, c).max(apart(a, d));
        if face != EDGES {
            let most = self.reach + apart(a, b).max(one).sqrt();
            let normal = fit.normals[face as usize][0];
            if normal.dot(self.x[a as usize] - self.x[b as usize]).abs() <= most {
                self.add(fit, vertices, false, most, out);
            }
            return;
        }
        let most = self.reach + one.max(apart(b, c)).max(apart(b, d)).sqrt();
        let at = |v: u32| self.x[v as usize];
        let below = at(a).min(at(b)) - at(c).max(at(d));
        let above = at(c).min(at(d)) - at(a).max(at(b));
        if below.max(above).max_element() <= most {
            self.add(fit, vertices, true, most, out);
        }
    }

    fn add(&self, fit: &Fit, vertices: [u32; 4], edges: bool, most: f32, out: &mut Vec<Pair>) {
        let from = self.x[vertices[0] as usize];
        let start = vertices.map(|v| self.x[v as usize] - from);
        let c = Closest::of(edges, &start);
        let distance = c.across.length();
        if distance > most || distance <= f32::MIN_POSITIVE {
            return;
        }
        let normal = c.across / distance;
        let wrong =
            self.sort && distance <= self.reach && self.is_wrong(fit, &vertices, edges, normal);
        // What is apart along one direction at both ends is so on the way.
        let end = std::array::from_fn(|k| start[k] + self.way[vertices[k] as usize]);
        if !wrong && slab(edges, normal, &end) > self.reach {
            return;
        }
        let keep = self.keep(edges, &vertices);
        let clear_until = f32::NEG_INFINITY;
        out.push(Pair { vertices, edges, normal, distance, keep, wrong, clear_until });
    }

    /// Distance at which a pair begins to repel (m): the offset, or less for what is near in the rest shape.
    fn keep(&self, edges: bool, vertices: &[u32; 4]) -> f32 {
        let (rest, offset) = (self.model.mesh.rest_positions(), self.model.material.offset);
        let [a, b, c, d] = vertices.map(|v| Vec3A::from(rest[v as usize]));
        // Boxes that are far apart need no closer look.
        let (first, second) = if edges {
            ([a.min(b), a.max(b)], [c.min(d), c.max(d)])
        } else {
            ([a, a], [b.min(c).min(d), b.max(c).max(d)])
        };
        let gap = (second[0] - first[1]).max(first[0] - second[1]).max_element();
        if REST_SHARE * gap > FAR * offset {
            return offset;
        }
        let rest = Closest::of(edges, &[a, b, c, d]);
        offset.min(REST_SHARE * rest.across.length())
    }

    /// Whether the outer one of two layers lies inside the inner one.
    fn is_wrong(&self, fit: &Fit, vertices: &[u32; 4], edges: bool, normal: Vec3A) -> bool {
        let layer = |v: u32| self.model.layers.get(v as usize).copied().unwrap_or(0);
        let (first, second) = (layer(vertices[0]), layer(vertices[3]));
        if first == second {
            return false;
        }
        let (own, others) = vertices.split_at(if edges { 2 } else { 1 });
        let to_outer = if first > second { normal } else { -normal };
        // Both layers must face from the outer to the inner one: where they are folded together, the
        // next fold's inner layer turns its back on an outer one, that faces the other way.
        let is_behind = |part: &[u32]| {
            let outwards: Vec3A = part.iter().map(|v| Tree::vertex_normal(fit, *v)).sum();
            to_outer.dot(outwards.normalize_or_zero()) < WRONG_SIDE
        };
        is_behind(own) && is_behind(others)
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::lab::shapes::{Cut, sheet};
    use crate::{Environment, Material, Mesh};

    /// Two layers, one 1.5 mm over the other, folded together in pleats whose insides are 2 mm apart.
    fn pleats() -> (Mesh, Vec<Vec3A>) {
        let flat = |_: u8| {
            sheet(48, 4, Cut::Alternating, |u, v| Vec3::new(0.48 * u, 0.04 * v, 0.0)).unwrap()
        };
        let (mut p, mut t, mut x) = (Vec::new(), Vec::new(), Vec::new());
        for layer in 0..2u8 {
            let (one, first) = (flat(layer), p.len() as u32);
            t.extend(one.triangles().iter().map(|t| t.map(|v| v + first)));
            for q in one.rest_positions() {
                // Up and down, 6 cm each; the layers' order turns with them.
                let (pleat, along) = ((q.x / 0.06).floor(), q.x % 0.06);
                let down = pleat % 2.0 > 0.0;
                let height = if down { 0.06 - along } else { along };
                let over = 0.0015 * f32::from(layer) * if down { -1.0 } else { 1.0 };
                let place = 0.0045 * pleat - if down { 0.0025 } else { 0.0 };
                x.push(Vec3A::new(place - over, q.y, height));
                p.push(*q + Vec3::Z * f32::from(layer));
            }
        }
        (Mesh::new(p, t).unwrap(), x)
    }

    #[test]
    fn whatever_meets_on_its_way_is_listed() {
        let mut chance = crate::lab::shapes::Chance::new(17);
        let mut met = 0;
        for _ in 0..12 {
            // One sheet falls through another, turning; neither is as foreseen by up to the tolerance.
            let flat = |u, v| Vec3::new(0.1 * u, 0.0, 0.1 * v);
            let one = sheet(4, 4, Cut::Alternating, flat).unwrap();
            let count = one.vertex_count();
            let (mut p, mut t) = (one.rest_positions().to_vec(), one.triangles().to_vec());
            t.extend(one.triangles().iter().map(|t| t.map(|v| v + count as u32)));
            let lifted = one.rest_positions().iter().map(|p| *p + Vec3::new(0.013, 0.03, 0.017));
            p.extend(lifted);
            let x: Vec<Vec3A> = p.iter().map(|p| Vec3A::from(*p)).collect();
            let mut by_chance =
                |most: f32| Vec3A::from_array(std::array::from_fn(|_| most * chance.signed()));
            let fall = [by_chance(0.05), by_chance(0.05)];
            let way: Vec<Vec3A> =
                (0..2 * count).map(|v| fall[v / count] + by_chance(0.02)).collect();
            let (cloth, air) = (Material::default(), Environment::default());
            let model = Model::new(Mesh::new(p, t).unwrap(), cloth, air, None, &[]).unwrap();
            let mut contact = SelfContact::default();
            contact.off.resize(2 * count, false);
            contact.find(&model, &x, &way);
            let listed: std::collections::BTreeSet<_> =
                contact.pairs.iter().map(|p| (p.edges, p.vertices)).collect();
            let near = |edges: bool, vertices: [u32; 4]| {
                let stray = 0.5 * (SelfContact::reach(&model) - super::super::FLOOR_M);
                (0..=200).any(|k| {
                    let s = k as f32 / 200.0;
                    let at = vertices.map(|v| x[v as usize] + way[v as usize] * s);
                    let moved = super::super::FLOOR_M + 1.9 * stray * s;
                    Closest::of(edges, &at).across.length() < moved
                })
            };
            let other = |v: u32| v as usize >= count;
            for v in 0..2 * count as u32 {
                for t in model.mesh.triangles().iter().filter(|t| other(t[0]) != other(v)) {
                    let hit = near(false, [v, t[0], t[1], t[2]]);
                    met += u32::from(hit);
                    let is_listed = listed.iter().any(|(edges, f)| {
                        !edges && f[0] == v && t.iter().all(|corner| f[1..].contains(corner))
                    });
                    assert!(!hit || is_listed, "vertex {v} and face {t:?}");
                }
            }
            let edges = model.mesh.edges();
            for a in edges.iter().filter(|e| !other(e[0])) {
                for b in edges.iter().filter(|e| other(e[0])) {
                    let hit = near(true, [a[0], a[1], b[0], b[1]]);
                    met += u32::from(hit);
                    let is_listed = listed
                        .iter()
                        .any(|(edges, f)| *edges && a.iter().chain(b).all(|end| f.contains(end)));
                    assert!(!hit || is_listed, "edges {a:?} and {b:?}");
                }
            }
        }
        assert!(met > 500, "{met}");
    }

    #[test]
    fn layers_folded_together_are_in_order_and_swapped_ones_are_not() {
        let (mesh, x) = pleats();
        let half = mesh.vertex_count() / 2;
        let still = vec![Vec3A::ZERO; 2 * half];
        for (layers, is_wrong) in [([0, 1], false), ([1, 0], true)] {
            let of: Vec<u8> = (0..2 * half).map(|v| layers[v / half]).collect();
            let (cloth, air) = (Material::default(), Environment::default());
            let model = Model::new(mesh.clone(), cloth, air, None, &[]).unwrap();
            let model = model.with_layers(of).unwrap();
            let mut contact = SelfContact::default();
            contact.off.resize(2 * half, false);
            contact.sort_layers = true;
            contact.find(&model, &x, &still);
            // The turns are too sharp to tell.
            let middle = |v: &u32| (0.015..0.045).contains(&x[*v as usize].z);
            let near = contact.pairs.iter().filter(|p| p.vertices.iter().all(middle));
            let layer = |v: u32| v as usize / half;
            let between = near.filter(|p| layer(p.vertices[0]) != layer(p.vertices[3]));
            let [wrong, all] = between.fold([0, 0], |n, p| [n[0] + u32::from(p.wrong), n[1] + 1]);
            assert!(all > 100, "{all}");
            assert!(if is_wrong { wrong > all / 4 } else { wrong == 0 }, "{wrong} of {all}");
            contact.sort_layers = false;
            contact.find(&model, &x, &still);
            assert!(contact.pairs.iter().all(|p| !p.wrong), "in play nothing passes");
        }
    }
}

//! Lists the pairs that may come near in a substep.

use glam::Vec3A;

use super::SelfContact;
use super::pair::{Closest, Pair};
use crate::model::Model;
use crate::tree::{Fit, Tree};

/// Share of a pair's distance in the rest shape at which it repels at most: parts of a smooth cloth
/// are no contact.
const REST_SHARE: f32 = 0.5;
/// An outer layer is on the wrong side where the cosine between the way to it and the inner one's
/// normal is less than this: what lies beside a rim is on neither.
const WRONG_SIDE: f32 = -0.3;

impl SelfContact {
    /// Lists the pairs whose distance at `x`, less their parts' relative `way`, is within reach.
    pub(crate) fn find(&mut self, model: &Model, x: &[Vec3A], way: &[Vec3A]) {
        self.listed.clear();
        self.listed.extend_from_slice(way);
        self.pairs.clear();
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
        let way = &self.listed;
        tree.fit(|v| x[v as usize], |v| way[v as usize], &mut fit);
        if strayed {
            tree.restrict(&self.strayed, &mut fit);
        }
        let old = pairs.len();
        let search = Search { model, tree, x, way, reach };
        tree.pairs(&mut fit, reach, true, |fit, i, j| {
            search.faces(fit, i, j, &mut pairs);
            search.faces(fit, j, i, &mut pairs);
            search.edges(fit, i, j, &mut pairs);
        });
        self.fit = fit;
        let mut place = 0;
        pairs.retain(|p| {
            place += 1;
            let wanted = !strayed || p.vertices.iter().any(|v| self.strayed[*v as usize]);
            place <= old || wanted && !self.may_pass(p)
        });
        self.pairs = pairs;
    }
}

struct Search<'a> {
    model: &'a Model,
    tree: &'a Tree,
    x: &'a [Vec3A],
    way: &'a [Vec3A],
    reach: f32,
}

impl Search<'_> {
    /// The vertices that belong to slot `of` against the face of slot `against`.
    fn faces(&self, fit: &Fit, of: u32, against: u32, out: &mut Vec<Pair>) {
        let normal = fit.normals[against as usize][0];
        let face = self.tree.corners[against as usize];
        let owns = self.tree.owns[of as usize];
        for (k, v) in self.tree.corners[of as usize].into_iter().enumerate() {
            if owns >> k & 1 == 0 || face.contains(&v) {
                continue;
            }
            let vertices = [v, face[0], face[1], face[2]];
            let (p, way) = (self.x[v as usize], self.way[v as usize]);
            let apart = |f: u32| (way - self.way[f as usize]).length_squared();
            let relative = apart(face[0]).max(apart(face[1])).max(apart(face[2])).sqrt();
            let most = self.reach + relative;
            if normal.dot(p - self.x[face[0] as usize]).abs() <= most {
                self.add(fit, vertices, false, most, out);
            }
        }
    }

    /// The edges that belong to one slot against those that belong to the other.
    fn edges(&self, fit: &Fit, i: u32, j: u32, out: &mut Vec<Pair>) {
        let sides = |slot: u32| {
            let (corners, owns) = (self.tree.corners[slot as usize], self.tree.owns[slot as usize]);
            (0..3usize)
                .filter(move |k| owns >> (3 + k) & 1 == 1)
                .map(move |k| [corners[k], corners[(k + 1) % 3]])
        };
        let way = |v: u32| self.way[v as usize];
        let at = |v: u32| self.x[v as usize];
        for a in sides(i) {
            for b in sides(j) {
                if a.iter().any(|v| b.contains(v)) {
                    continue;
                }
                let apart = |u: u32, v: u32| (way(u) - way(v)).length_squared();
                let one = apart(a[0], b[0]).max(apart(a[0], b[1]));
                let relative = one.max(apart(a[1], b[0])).max(apart(a[1], b[1])).sqrt();
                let most = self.reach + relative;
                let (p, q) = (a.map(at), b.map(at));
                let below = p[0].min(p[1]) - q[0].max(q[1]);
                let above = q[0].min(q[1]) - p[0].max(p[1]);
                if below.max(above).max_element() > most {
                    continue;
                }
                self.add(fit, [a[0], a[1], b[0], b[1]], true, most, out);
            }
        }
    }

    fn add(&self, fit: &Fit, vertices: [u32; 4], edges: bool, most: f32, out: &mut Vec<Pair>) {
        let from = self.x[vertices[0] as usize];
        let c = Closest::of(edges, &vertices.map(|v| self.x[v as usize] - from));
        let distance = c.across.length();
        if distance > most || distance <= f32::MIN_POSITIVE {
            return;
        }
        let rest = self.model.mesh.rest_positions();
        let rest = Closest::of(edges, &vertices.map(|v| Vec3A::from(rest[v as usize])));
        let keep = self.model.material.offset.min(REST_SHARE * rest.across.length());
        let normal = c.across / distance;
        let wrong = distance <= self.reach && self.is_wrong(fit, &vertices, edges, normal);
        out.push(Pair { vertices, edges, normal, distance, keep, wrong });
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
            contact.find(&model, &x, &still);
            // The turns are too sharp to tell.
            let middle = |v: &u32| (0.015..0.045).contains(&x[*v as usize].z);
            let near = contact.pairs.iter().filter(|p| p.vertices.iter().all(middle));
            let layer = |v: u32| v as usize / half;
            let between = near.filter(|p| layer(p.vertices[0]) != layer(p.vertices[3]));
            let [wrong, all] = between.fold([0, 0], |n, p| [n[0] + u32::from(p.wrong), n[1] + 1]);
            assert!(all > 100, "{all}");
            assert!(if is_wrong { wrong > all / 4 } else { wrong == 0 }, "{wrong} of {all}");
        }
    }
}

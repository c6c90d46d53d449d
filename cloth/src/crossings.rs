//! Where a cloth cuts itself: an oracle that knows nothing of how contact is handled.

use glam::{Vec3, Vec3A};

use crate::mesh::Mesh;
use crate::tree::{self, Fit, Tree};

/// An edge that cuts a triangle with which it shares no vertex.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Crossing {
    /// Its ends.
    pub edge: [u32; 2],
    /// Triangle of the mesh.
    pub triangle: u32,
}

/// Every edge of `mesh` that cuts a triangle of it, at `positions` (m); ascending.
///
/// Orientations are taken in f64 of the f32 positions, which is exact but for points that are
/// coplanar to within 1e-15; such a touch counts or not, but always alike from both sides.
pub fn crossings(mesh: &Mesh, positions: &[Vec3]) -> Vec<Crossing> {
    Crossings::new(mesh).find(positions).to_vec()
}

/// As [`crossings`], with a tree that is made once.
#[derive(Debug, Clone)]
pub struct Crossings {
    tree: Tree,
    fit: Fit,
    found: Vec<Crossing>,
}

impl Crossings {
    /// A search over a mesh.
    pub fn new(mesh: &Mesh) -> Self {
        Self { tree: Tree::new(mesh), fit: Fit::default(), found: Vec::new() }
    }

    /// Every crossing at `positions` (m), ascending; allocates nothing once warm.
    pub fn find(&mut self, positions: &[Vec3]) -> &[Crossing] {
        find(&self.tree, &mut self.fit, positions, false, &mut self.found);
        &self.found
    }
}

/// With `smooth` without looking inside smooth patches; see [`Tree::pairs`].
pub(crate) fn find(
    tree: &Tree,
    fit: &mut Fit,
    positions: &[Vec3],
    smooth: bool,
    out: &mut Vec<Crossing>,
) {
    out.clear();
    tree.fit(tree::at(positions), |_| Vec3A::ZERO, fit);
    tree.pairs(fit, 0.0, smooth, |_, i, j| {
        for (of, against) in [(i, j), (j, i)] {
            let (sides, triangle) = (tree.corners[of as usize], tree.corners[against as usize]);
            for k in 0..3 {
                let edge = [sides[k], sides[(k + 1) % 3]];
                let own = tree.owns[of as usize] >> (3 + k) & 1 == 1;
                if own && crosses(edge, triangle, positions) {
                    let edge = [edge[0].min(edge[1]), edge[0].max(edge[1])];
                    out.push(Crossing { edge, triangle: tree.order[against as usize] });
                }
            }
        }
    });
    out.sort_unstable();
}

/// Whether an edge cuts a triangle with which it shares no vertex.
fn crosses(edge: [u32; 2], triangle: [u32; 3], positions: &[Vec3]) -> bool {
    if edge.iter().any(|v| triangle.contains(v)) {
        return false;
    }
    let at = |v: u32| positions[v as usize];
    cuts(edge.map(at), triangle.map(at))
}

/// Whether a segment cuts a triangle, by the signs of the volumes that their corners span.
pub(crate) fn cuts([p, q]: [Vec3; 2], [a, b, c]: [Vec3; 3]) -> bool {
    if (volume(a, b, c, p) >= 0.0) == (volume(a, b, c, q) >= 0.0) {
        return false;
    }
    let left = |u: Vec3, v: Vec3| volume(p, q, u, v) >= 0.0;
    let (x, y, z) = (left(a, b), left(b, c), left(c, a));
    x == y && y == z
}

/// Six times the signed volume of a tetrahedron (m^3).
fn volume(a: Vec3, b: Vec3, c: Vec3, d: Vec3) -> f64 {
    let from_a = |p: Vec3| {
        [
            f64::from(p.x) - f64::from(a.x),
            f64::from(p.y) - f64::from(a.y),
            f64::from(p.z) - f64::from(a.z),
        ]
    };
    let ([ux, uy, uz], [vx, vy, vz], [wx, wy, wz]) = (from_a(b), from_a(c), from_a(d));
    (uy * vz - uz * vy) * wx + (uz * vx - ux * vz) * wy + (ux * vy - uy * vx) * wz
}

#[cfg(test)]
mod tests {
    use super::*;

    fn strips(shift: Vec3) -> (Mesh, Vec<Vec3>) {
        // Two triangles that do not hang together, the second upright through the first.
        let mut p = vec![Vec3::ZERO, Vec3::X, Vec3::Y];
        p.extend([Vec3::new(0.2, 0.2, -0.5), Vec3::new(0.2, 0.3, 0.5), Vec3::new(0.3, 0.2, 0.5)]);
        for q in &mut p[3..] {
            *q += shift;
        }
        (Mesh::new(p.clone(), vec![[0, 1, 2], [3, 4, 5]]).unwrap(), p)
    }

    #[test]
    fn an_edge_through_a_triangle_is_found_and_one_beside_it_not() {
        let (mesh, p) = strips(Vec3::ZERO);
        let edges: Vec<[u32; 2]> = crossings(&mesh, &p).iter().map(|c| c.edge).collect();
        assert_eq!(edges, [[3, 4], [3, 5]]);
        let (mesh, p) = strips(Vec3::X);
        assert!(crossings(&mesh, &p).is_empty());
    }

    #[test]
    fn the_tree_finds_what_all_pairs_find() {
        // A crumpled sheet: every vertex displaced by hashed noise.
        let n = 14u32;
        let mut p = Vec::new();
        let mut t = Vec::new();
        for j in 0..=n {
            for i in 0..=n {
                let hash = |k: u32| (i + 31 * (j + 31 * k)).wrapping_mul(2_654_435_761);
                let noise = |k: u32| {
                    ((hash(k) ^ (hash(k) >> 15)).wrapping_mul(2_246_822_519) >> 16) as f32
                        / 65_536.0
                };
                p.push(Vec3::new(i as f32, j as f32, 0.0) * 0.01);
                let at = (j * (n + 1) + i) as usize;
                p[at] += 0.04 * Vec3::new(noise(1), noise(2), noise(3));
                if i < n && j < n {
                    let a = at as u32;
                    t.extend([[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]);
                }
            }
        }
        let mesh = Mesh::new(p.clone(), t.clone()).unwrap();
        let mut all = Vec::new();
        for e in mesh.edges() {
            for (triangle, corners) in t.iter().enumerate() {
                if crosses(*e, *corners, &p) {
                    all.push(Crossing { edge: *e, triangle: triangle as u32 });
                }
            }
        }
        all.sort_unstable();
        assert!(all.len() > 100);
        assert_eq!(crossings(&mesh, &p), all);
    }
}

//! A binary tree of boxes over the triangles of a moving mesh: built once, refitted per pose.

use glam::{Vec3, Vec3A};

use crate::solver::simd::{self, Set, Task};
use crate::triangle::{self, OnTriangle};
use crate::wide::{self, Boxes, Corners, WIDE};

/// Deep enough for 2^32 triangles halved at the median.
const STACK: usize = 64;
/// The same for the wide nodes: of each, all children but the one gone into may wait.
const WIDE_STACK: usize = 96;
/// In [`Wide::links`]: a leaf.
const LEAF: u32 = 1 << 31;

/// The tree's shape, which no pose changes. Nodes lie depth first: a left child follows its
/// parent.
#[derive(Debug, Clone, PartialEq)]
pub struct Bvh {
    nodes: Vec<Node>,
    /// Three levels of `nodes` in one; the first is the root.
    wide: Vec<Wide>,
    /// First triangle of each leaf in `order`, and how many it has.
    leaves: Vec<[u32; 2]>,
    /// Triangles in the order of the leaves.
    order: Vec<u32>,
    /// Vertices of the triangles in that order.
    corners: Vec<[u32; 3]>,
    /// Place of each triangle in that order.
    places: Vec<u32>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Node {
    /// Inner node: its right child. Leaf: its first triangle in `order`.
    pub(crate) link: u32,
    /// Triangles of a leaf; 0 for an inner node.
    pub(crate) count: u32,
}

/// A node of up to eight children.
#[derive(Debug, Clone, PartialEq)]
struct Wide {
    /// Its children among the binary nodes.
    nodes: [u32; WIDE],
    /// Where they are: wide nodes, or leaves with [`LEAF`].
    links: [u32; WIDE],
    /// Bit by bit the lanes in which there is one.
    lanes: u32,
}

/// The tree fitted to one pose.
#[derive(Debug, Clone, Default)]
pub struct Fit {
    boxes: Vec<[Vec3A; 2]>,
    corners: Vec<[Vec3A; 3]>,
    /// Children's boxes of each wide node.
    wide_boxes: Vec<Boxes>,
    /// Corners of each leaf.
    wide_corners: Vec<Corners>,
}

/// The closest point of a mesh.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Triangle.
    pub triangle: u32,
    /// Where on it.
    pub on: OnTriangle,
    /// Squared distance (m^2).
    pub distance2: f32,
}

impl Bvh {
    /// Splits at the median of the longer side of the centroids' box, until leaves are small.
    pub fn new(positions: &[Vec3], triangles: &[[u32; 3]]) -> Self {
        let (nodes, order) = split(positions, triangles, WIDE);
        let corners = order.iter().map(|t| triangles[*t as usize]).collect();
        let mut places = vec![0; order.len()];
        for (place, t) in order.iter().enumerate() {
            places[*t as usize] = place as u32;
        }
        let mut tree = Self { nodes, wide: Vec::new(), leaves: Vec::new(), order, corners, places };
        if !tree.nodes.is_empty() {
            tree.widen(0);
        }
        tree
    }

    /// Makes the wide node of a binary one and all below; returns its number.
    fn widen(&mut self, node: u32) -> u32 {
        let mut children = vec![node];
        for _ in 0..WIDE.ilog2() {
            let open = |n: &u32| match self.nodes[*n as usize] {
                Node { count: 0, link } => vec![*n + 1, link],
                _ => vec![*n],
            };
            children = children.iter().flat_map(open).collect();
        }
        let me = self.wide.len();
        self.wide.push(Wide { nodes: [0; WIDE], links: [0; WIDE], lanes: 0 });
        for (lane, child) in children.into_iter().enumerate() {
            let Node { link, count } = self.nodes[child as usize];
            self.wide[me].nodes[lane] = child;
            self.wide[me].lanes |= 1 << lane;
            self.wide[me].links[lane] = if count > 0 {
                self.leaves.push([link, count]);
                (self.leaves.len() - 1) as u32 | LEAF
            } else {
                self.widen(child)
            };
        }
        me as u32
    }

    /// Boxes and corners of the mesh in another pose; no allocation once `fit` is warm.
    pub fn refit(&self, positions: &[Vec3], fit: &mut Fit) {
        fit.corners.clear();
        let corner = |v: u32| Vec3A::from(positions[v as usize]);
        fit.corners.extend(self.corners.iter().map(|t| t.map(corner)));
        fit.boxes.resize(self.nodes.len(), [Vec3A::ZERO; 2]);
        for i in (0..self.nodes.len()).rev() {
            let node = self.nodes[i];
            fit.boxes[i] = if node.count == 0 {
                let (a, b) = (fit.boxes[i + 1], fit.boxes[node.link as usize]);
                [a[0].min(b[0]), a[1].max(b[1])]
            } else {
                let leaf = &fit.corners[node.link as usize..][..node.count as usize];
                let start = [leaf[0][0], leaf[0][0]];
                leaf.iter().flatten().fold(start, |b, p| [b[0].min(*p), b[1].max(*p)])
            };
        }
        fit.wide_boxes.resize(self.wide.len(), Boxes::NOWHERE);
        for (wide, boxes) in self.wide.iter().zip(&mut fit.wide_boxes) {
            for lane in (0..WIDE).filter(|lane| wide.lanes >> lane & 1 == 1) {
                boxes.set(lane, &fit.boxes[wide.nodes[lane] as usize]);
            }
        }
        fit.wide_corners.resize(self.leaves.len(), Corners::NOWHERE);
        for ([first, count], leaf) in self.leaves.iter().zip(&mut fit.wide_corners) {
            let there = &fit.corners[*first as usize..][..*count as usize];
            there.iter().enumerate().for_each(|(lane, corners)| leaf.set(lane, corners));
        }
    }

    /// The closest point nearer than `sqrt(limit2)`, if there is one. Of equals the one that
    /// the tree holds first.
    pub fn closest(&self, fit: &Fit, point: Vec3, limit2: f32) -> Option<Hit> {
        self.closest_from(fit, point, limit2, None)
    }

    /// The same, faster where `near` is a triangle that may be near. Of equals it is that one.
    pub fn closest_from(
        &self,
        fit: &Fit,
        point: Vec3,
        limit2: f32,
        near: Option<u32>,
    ) -> Option<Hit> {
        let (set, point) = (Set::detect(), point.into());
        simd::run(Search { tree: self, fit, point, limit2, near, set })
    }

    /// How many times a closed mesh winds around `point`: 0 outside, 1 inside, 2 where two parts
    /// of it overlap. Counts signed crossings of one ray in a direction no mesh is aligned with.
    pub fn winding(&self, fit: &Fit, point: Vec3) -> i32 {
        let point = Vec3A::from(point);
        let ray = Vec3A::new(0.307_83, 0.859_41, 0.408_17);
        let mut stack = [0u32; STACK];
        let mut depth = usize::from(!self.nodes.is_empty());
        let mut winding = 0;
        while depth > 0 {
            depth -= 1;
            let at = stack[depth] as usize;
            if !ray_meets(&fit.boxes[at], point, ray) {
                continue;
            }
            let node = self.nodes[at];
            if node.count > 0 {
                let leaf = &fit.corners[node.link as usize..][..node.count as usize];
                winding += leaf.iter().map(|t| triangle::crossing(t, point, ray)).sum::<i32>();
            } else {
                stack[depth] = at as u32 + 1;
                stack[depth + 1] = node.link;
                depth += 2;
            }
        }
        winding
    }
}

/// Looks for the closest point, nearest children first.
struct Search<'a> {
    tree: &'a Bvh,
    fit: &'a Fit,
    point: Vec3A,
    limit2: f32,
    near: Option<u32>,
    set: Set,
}

impl Task for Search<'_> {
    type Output = Option<Hit>;

    #[inline(always)]
    fn run(self) -> Option<Hit> {
        let mut found = Found { best: self.limit2, hit: None };
        if let Some(triangle) = self.near {
            self.look(self.tree.places[triangle as usize], &mut found);
        }
        let mut stack = [(0u32, 0.0f32); WIDE_STACK];
        let mut depth = usize::from(!self.tree.wide.is_empty());
        while depth > 0 {
            depth -= 1;
            let (link, distance2) = stack[depth];
            if distance2 >= found.best {
                continue;
            }
            if link & LEAF != 0 {
                self.look_at_leaf((link & !LEAF) as usize, &mut found);
                continue;
            }
            let at = link as usize;
            let to = simd::box_distances2(self.set, &self.fit.wide_boxes[at], self.point);
            let first = depth;
            let mut nearer = to.below(found.best) & self.tree.wide[at].lanes;
            while nearer != 0 {
                let lane = nearer.trailing_zeros() as usize;
                nearer &= nearer - 1;
                // The nearest one lies on top.
                let mut place = depth;
                while place > first && stack[place - 1].1 < to.0[lane] {
                    stack[place] = stack[place - 1];
                    place -= 1;
                }
                stack[place] = (self.tree.wide[at].links[lane], to.0[lane]);
                depth += 1;
            }
        }
        found.hit
    }
}

struct Found {
    /// Squared distance.
    best: f32,
    hit: Option<Hit>,
}

impl Search<'_> {
    /// Looks at one triangle, given by its place in the order of the leaves.
    #[inline(always)]
    fn look(&self, place: u32, found: &mut Found) {
        let on = triangle::closest(&self.fit.corners[place as usize], self.point);
        let distance2 = on.point.distance_squared(self.point);
        if distance2 < found.best {
            let triangle = self.tree.order[place as usize];
            *found = Found { best: distance2, hit: Some(Hit { triangle, on, distance2 }) };
        }
    }

    /// Looks at those triangles of a leaf that may be nearest, the one that seems so first.
    #[inline(always)]
    fn look_at_leaf(&self, leaf: usize, found: &mut Found) {
        let to = wide::triangle_distances2(&self.fit.wide_corners[leaf], self.point);
        let [first, count] = self.tree.leaves[leaf];
        let to = &to.0[..count as usize];
        let mut least = 0;
        for lane in 1..to.len() {
            if to[lane] < to[least] {
                least = lane;
            }
        }
        if !wide::may_be_nearer(to[least], found.best) {
            return;
        }
        self.look(first + least as u32, found);
        for (lane, to) in to.iter().enumerate() {
            if lane != least && wide::may_be_nearer(*to, found.best) {
                self.look(first + lane as u32, found);
            }
        }
    }
}

/// Nodes of a tree over triangles whose leaves hold up to `leaf` of them, and the triangles in the order of its leaves.
pub(crate) fn split(
    positions: &[Vec3],
    triangles: &[[u32; 3]],
    leaf: usize,
) -> (Vec<Node>, Vec<u32>) {
    let centroids: Vec<Vec3> =
        triangles.iter().map(|t| t.iter().map(|v| positions[*v as usize]).sum()).collect();
    let mut order: Vec<u32> = (0..triangles.len() as u32).collect();
    let mut nodes = Vec::new();
    if !order.is_empty() {
        build(&mut order, (0, leaf), &centroids, &mut nodes);
    }
    (nodes, order)
}

fn build(
    order: &mut [u32],
    (first, leaf): (usize, usize),
    centroids: &[Vec3],
    nodes: &mut Vec<Node>,
) {
    let me = nodes.len();
    if order.len() <= leaf {
        nodes.push(Node { link: first as u32, count: order.len() as u32 });
        return;
    }
    nodes.push(Node { link: 0, count: 0 });
    let at = |t: &u32| centroids[*t as usize];
    let low = order.iter().map(at).fold(Vec3::INFINITY, Vec3::min);
    let high = order.iter().map(at).fold(Vec3::NEG_INFINITY, Vec3::max);
    let axis = (high - low).max_position();
    let middle = order.len() / 2;
    order.select_nth_unstable_by(middle, |a, b| at(a)[axis].total_cmp(&at(b)[axis]).then(a.cmp(b)));
    let (left, right) = order.split_at_mut(middle);
    build(left, (first, leaf), centroids, nodes);
    nodes[me].link = nodes.len() as u32;
    build(right, (first + middle, leaf), centroids, nodes);
}

fn ray_meets(bounds: &[Vec3A; 2], from: Vec3A, ray: Vec3A) -> bool {
    let (a, b) = ((bounds[0] - from) / ray, (bounds[1] - from) / ray);
    let enter = a.min(b).max_element().max(0.0);
    enter <= a.max(b).min_element() + 1e-6
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lab::shapes::Chance;

    /// A closed, wavy ring of `n` by `m` quads.
    fn ring(n: usize, m: usize) -> (Vec<Vec3>, Vec<[u32; 3]>) {
        let angle = |i: usize, count: usize| std::f32::consts::TAU * i as f32 / count as f32;
        let (mut points, mut triangles) = (Vec::new(), Vec::new());
        let at = |i: usize, j: usize| (i % n * m + j % m) as u32;
        for (i, j) in (0..n).flat_map(|i| (0..m).map(move |j| (i, j))) {
            let (u, v) = (angle(i, n), angle(j, m));
            let thick = 0.15 + 0.03 * (5.0 * u).sin() * (3.0 * v).cos();
            let out = 0.4 + thick * v.cos();
            points.push(Vec3::new(out * u.cos(), 1.0 + thick * v.sin(), out * u.sin()));
            triangles.push([at(i, j), at(i + 1, j), at(i, j + 1)]);
            triangles.push([at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)]);
        }
        (points, triangles)
    }

    #[test]
    fn the_closest_point_is_that_of_asking_every_triangle() {
        let mut chance = Chance::new(5);
        // Also trees of one leaf, and of two.
        for (n, m) in [(24, 18), (3, 3), (1, 3), (1, 5)] {
            let (points, triangles) = ring(n, m);
            let tree = Bvh::new(&points, &triangles);
            let mut fit = Fit::default();
            let moved: Vec<Vec3> = points.iter().map(|p| *p * 1.1 + Vec3::Z).collect();
            tree.refit(&points, &mut fit);
            tree.refit(&moved, &mut fit);
            for round in 0..400 {
                let mut by_chance = || Vec3::from_array(std::array::from_fn(|_| chance.signed()));
                let point = moved[round * 7 % moved.len()] + by_chance() * 0.06;
                let limit2 = if round % 3 == 0 { 0.03f32.powi(2) } else { 4.0 };
                let near = (round % 2 == 0).then_some((round * 31 % triangles.len()) as u32);
                let to = |t: &[u32; 3]| {
                    let corners = t.map(|v| Vec3A::from(moved[v as usize]));
                    let on = triangle::closest(&corners, point.into());
                    on.point.distance_squared(point.into())
                };
                let least = triangles.iter().map(to).fold(f32::INFINITY, f32::min);
                let found = tree.closest_from(&fit, point, limit2, near);
                let wanted = (least < limit2).then_some(least);
                assert_eq!(found.map(|hit| hit.distance2), wanted, "{n} x {m}, round {round}");
                if let Some(hit) = found {
                    let of_triangle = to(&triangles[hit.triangle as usize]);
                    assert_eq!(of_triangle.to_bits(), hit.distance2.to_bits());
                }
            }
        }
    }
}

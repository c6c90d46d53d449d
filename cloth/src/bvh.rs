//! A binary tree of boxes over the triangles of a moving mesh: built once, refitted per pose.

use glam::{Vec3, Vec3A};

use crate::triangle::{self, OnTriangle};

const LEAF_TRIANGLES: usize = 4;
/// Deep enough for 2^32 triangles halved at the median.
const STACK: usize = 64;

/// The tree's shape, which no pose changes. Nodes lie depth first: a left child follows its
/// parent.
#[derive(Debug, Clone, PartialEq)]
pub struct Bvh {
    nodes: Vec<Node>,
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

/// The tree fitted to one pose.
#[derive(Debug, Clone, Default)]
pub struct Fit {
    boxes: Vec<[Vec3A; 2]>,
    corners: Vec<[Vec3A; 3]>,
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
        let (nodes, order) = split(positions, triangles);
        let corners = order.iter().map(|t| triangles[*t as usize]).collect();
        let mut places = vec![0; order.len()];
        for (place, t) in order.iter().enumerate() {
            places[*t as usize] = place as u32;
        }
        Self { nodes, order, corners, places }
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
        let point = Vec3A::from(point);
        let mut best = limit2;
        let mut hit = None;
        if let Some(triangle) = near {
            let on =
                triangle::closest(&fit.corners[self.places[triangle as usize] as usize], point);
            let distance2 = on.point.distance_squared(point);
            if distance2 < best {
                best = distance2;
                hit = Some(Hit { triangle, on, distance2 });
            }
        }
        let mut stack = [(0u32, 0.0f32); STACK];
        let mut depth = 0;
        if !self.nodes.is_empty() {
            stack[0] = (0, box_distance2(&fit.boxes[0], point));
            depth = 1;
        }
        while depth > 0 {
            depth -= 1;
            let (mut at, mut distance2) = stack[depth];
            while distance2 < best {
                let node = self.nodes[at as usize];
                if node.count > 0 {
                    for slot in node.link..node.link + node.count {
                        let on = triangle::closest(&fit.corners[slot as usize], point);
                        let d2 = on.point.distance_squared(point);
                        if d2 < best {
                            best = d2;
                            let triangle = self.order[slot as usize];
                            hit = Some(Hit { triangle, on, distance2: d2 });
                        }
                    }
                    break;
                }
                let (left, right) = (at + 1, node.link);
                let to_left = box_distance2(&fit.boxes[left as usize], point);
                let to_right = box_distance2(&fit.boxes[right as usize], point);
                let (near, far) = if to_left <= to_right {
                    ((left, to_left), (right, to_right))
                } else {
                    ((right, to_right), (left, to_left))
                };
                if far.1 < best {
                    stack[depth] = far;
                    depth += 1;
                }
                (at, distance2) = near;
            }
        }
        hit
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

/// Nodes of a tree over triangles, and the triangles in the order of its leaves.
pub(crate) fn split(positions: &[Vec3], triangles: &[[u32; 3]]) -> (Vec<Node>, Vec<u32>) {
    let centroids: Vec<Vec3> =
        triangles.iter().map(|t| t.iter().map(|v| positions[*v as usize]).sum()).collect();
    let mut order: Vec<u32> = (0..triangles.len() as u32).collect();
    let mut nodes = Vec::new();
    if !order.is_empty() {
        build(&mut order, 0, &centroids, &mut nodes);
    }
    (nodes, order)
}

fn build(order: &mut [u32], first: usize, centroids: &[Vec3], nodes: &mut Vec<Node>) {
    let me = nodes.len();
    if order.len() <= LEAF_TRIANGLES {
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
    build(left, first, centroids, nodes);
    nodes[me].link = nodes.len() as u32;
    build(right, first + middle, centroids, nodes);
}

fn box_distance2(bounds: &[Vec3A; 2], point: Vec3A) -> f32 {
    point.distance_squared(point.clamp(bounds[0], bounds[1]))
}

fn ray_meets(bounds: &[Vec3A; 2], from: Vec3A, ray: Vec3A) -> bool {
    let (a, b) = ((bounds[0] - from) / ray, (bounds[1] - from) / ray);
    let enter = a.min(b).max_element().max(0.0);
    enter <= a.max(b).min_element() + 1e-6
}

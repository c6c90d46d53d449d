//! The coarse space of the two-level preconditioner: a few hundred nodes spread over the garment,
//! and for each vertex the weights of the nodes around it.
//!
//! Nodes are chosen farthest first by distance along the cloth, so that a sleeve and the chest
//! that it lies on stay apart. Weights are moving least squares in the vertex's tangent plane: they
//! sum to one and give back linear functions, hence also turns, which cost a garment nothing and
//! which a block-diagonal preconditioner is slow to find.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use glam::{Mat3, Vec3};

use super::matrix::Pattern;
use crate::mesh::Mesh;

/// Nodes that a vertex may hang on.
pub(crate) const SHARES: usize = 4;
/// Vertices for each node, and the most nodes.
const VERTICES_PER_NODE: usize = 40;
/// At least so many nodes.
const NODES_MIN: usize = 16;
const NODES_MAX: usize = 160;
/// Smaller meshes do without.
const VERTICES_MIN: usize = 100;

/// Weights of nodes for each vertex; unused ones are zero.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Shares {
    /// Number of nodes; 0 where a garment is too small to gain by them.
    pub(crate) nodes: usize,
    pub(crate) of: Vec<[(u32, f32); SHARES]>,
    /// The same node by node: vertices and weights of node n are
    /// `by_node[starts[n]..starts[n + 1]]`.
    pub(crate) by_node: Vec<(u32, f32)>,
    pub(crate) starts: Vec<u32>,
}

impl Shares {
    /// Spreads nodes over a mesh. Held vertices hang on none.
    pub(crate) fn new(mesh: &Mesh, pattern: &Pattern, held: impl Fn(u32) -> bool) -> Self {
        let count = mesh.vertex_count();
        if count < VERTICES_MIN {
            return Self::default();
        }
        let wanted = (count / VERTICES_PER_NODE).clamp(NODES_MIN, NODES_MAX);
        let (seeds, radius) = spread(mesh, pattern, wanted);
        let order = along(mesh, &seeds);
        let seeds: Vec<u32> = order.iter().map(|i| seeds[*i]).collect();
        let mut near: Vec<Vec<(f32, u32)>> = vec![Vec::new(); count];
        let mut reached = vec![f32::INFINITY; count];
        for (node, seed) in seeds.iter().enumerate() {
            let mut visited = Vec::new();
            flood(mesh, pattern, *seed, &mut reached, 2.5 * radius, |v, d| visited.push((v, d)));
            for (v, d) in visited {
                reached[v as usize] = f32::INFINITY;
                near[v as usize].push((d, node as u32));
            }
        }
        let normals = normals(mesh);
        let one = |v: usize| {
            if held(v as u32) {
                return [(0, 0.0); SHARES];
            }
            near[v].sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            weigh(mesh, v, normals[v], &near[v], &seeds)
        };
        Self::turned(seeds.len(), (0..count).map(one).collect())
    }

    fn turned(nodes: usize, of: Vec<[(u32, f32); SHARES]>) -> Self {
        let mut lists = vec![Vec::new(); nodes];
        for (vertex, own) in of.iter().enumerate() {
            for (node, weight) in own.iter().filter(|s| s.1 != 0.0) {
                lists[*node as usize].push((vertex as u32, *weight));
            }
        }
        let mut starts = vec![0];
        let mut by_node = Vec::new();
        for list in lists {
            by_node.extend(list);
            starts.push(by_node.len() as u32);
        }
        Self { nodes, of, by_node, starts }
    }
}

/// Chooses up to `wanted` vertices far from each other, and the largest distance to one of them.
fn spread(mesh: &Mesh, pattern: &Pattern, wanted: usize) -> (Vec<u32>, f32) {
    let count = mesh.vertex_count();
    let mut distance = vec![f32::INFINITY; count];
    let mut seeds = Vec::new();
    let mut next = 0;
    loop {
        seeds.push(next);
        flood(mesh, pattern, next, &mut distance, f32::INFINITY, |_, _| {});
        let (far, most) = distance
            .iter()
            .enumerate()
            .fold((0, -1.0f32), |best, (v, d)| if *d > best.1 { (v, *d) } else { best });
        // Parts that hang together with nothing seen so far come first: they are infinitely far.
        if (seeds.len() >= wanted && most.is_finite()) || most <= 0.0 {
            return (seeds, most.max(0.0));
        }
        next = far as u32;
    }
}

/// Lowers `distance` to the distances from `from` along the edges where that is nearer, up to
/// `most`.
fn flood(
    mesh: &Mesh,
    pattern: &Pattern,
    from: u32,
    distance: &mut [f32],
    most: f32,
    mut visit: impl FnMut(u32, f32),
) {
    let mut queue = BinaryHeap::from([(Reverse(0u32), from)]);
    distance[from as usize] = 0.0;
    while let Some((Reverse(bits), v)) = queue.pop() {
        // Non-negative floats are ordered as their bits.
        let d = f32::from_bits(bits);
        if d > distance[v as usize] {
            continue;
        }
        visit(v, d);
        let at = mesh.rest_positions()[v as usize];
        for slot in pattern.near.row(v as usize) {
            let to = pattern.near.columns[slot];
            let further = d + at.distance(mesh.rest_positions()[to as usize]);
            if further < distance[to as usize] && further <= most {
                distance[to as usize] = further;
                queue.push((Reverse(further.to_bits()), to));
            }
        }
    }
}

/// Nodes in the order of their longest axis: what is near has near numbers, so that the coarse
/// matrix is narrow.
fn along(mesh: &Mesh, seeds: &[u32]) -> Vec<usize> {
    let at = |i: &usize| mesh.rest_positions()[seeds[*i] as usize];
    let mut order: Vec<usize> = (0..seeds.len()).collect();
    let low = order.iter().map(at).fold(Vec3::INFINITY, Vec3::min);
    let high = order.iter().map(at).fold(Vec3::NEG_INFINITY, Vec3::max);
    let axis = (high - low).max_position();
    order.sort_by(|a, b| at(a)[axis].total_cmp(&at(b)[axis]).then(a.cmp(b)));
    order
}

fn normals(mesh: &Mesh) -> Vec<Vec3> {
    let mut sums = vec![Vec3::ZERO; mesh.vertex_count()];
    for t in mesh.triangles() {
        let [a, b, c] = t.map(|v| mesh.rest_positions()[v as usize]);
        for v in t {
            sums[*v as usize] += (b - a).cross(c - a);
        }
    }
    sums.into_iter().map(|n| n.try_normalize().unwrap_or(Vec3::Y)).collect()
}

/// Weights of the nearest nodes, of which `near` holds (distance, node), nearest first.
fn weigh(
    mesh: &Mesh,
    vertex: usize,
    normal: Vec3,
    near: &[(f32, u32)],
    seeds: &[u32],
) -> [(u32, f32); SHARES] {
    let mut shares = [(0, 0.0); SHARES];
    let used = &near[..near.len().min(SHARES)];
    let Some(last) = used.last() else { return shares };
    // A node fades out before the next one takes its place.
    let radius = near.get(SHARES).map_or(1.2 * last.0, |n| n.0).max(1e-6) * 1.0001;
    let (axis, across) = normal.any_orthonormal_pair();
    let at = mesh.rest_positions()[vertex];
    let mut rows = [Vec3::ZERO; SHARES];
    let mut fades = [0.0f32; SHARES];
    let mut moments = Mat3::ZERO;
    for (k, (d, node)) in used.iter().enumerate() {
        let way = mesh.rest_positions()[seeds[*node as usize] as usize] - at;
        let flat = Vec3::new(0.0, way.dot(axis), way.dot(across));
        let flat = flat.normalize_or_zero() * (d / radius);
        let row = Vec3::new(1.0, flat.y, flat.z);
        let fade = (1.0 - d / radius).max(1e-3);
        (rows[k], fades[k]) = (row, fade * fade);
        moments += Mat3::from_cols(row * row.x, row * row.y, row * row.z) * fades[k];
    }
    let total: f32 = fades.iter().sum();
    // Where all nodes lie on a line or on one side, constants have to do.
    let moments = moments + Mat3::from_diagonal(Vec3::new(0.0, 2e-2, 2e-2) * total);
    let fit = moments.inverse() * Vec3::X;
    let linear = |k: usize| fades[k] * rows[k].dot(fit);
    let sum: f32 = (0..used.len()).map(linear).sum();
    let sound = fit.is_finite() && (0..used.len()).all(|k| linear(k).abs() < 1.5) && sum > 0.1;
    for (k, (_, node)) in used.iter().enumerate() {
        shares[k] = (*node, if sound { linear(k) / sum } else { fades[k] / total });
    }
    shares
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_sum_to_one_and_nearly_give_back_linear_functions() {
        let n = 41u32;
        let at = |v: u32| Vec3::new((v % n) as f32 / 40.0, 0.0, (v / n) as f32 / 40.0);
        let cell = |v: u32| [[v, v + n, v + 1], [v + 1, v + n, v + n + 1]];
        let cells = (0..n * (n - 1)).filter(|v| v % n != n - 1);
        let mesh = Mesh::new((0..n * n).map(at).collect(), cells.flat_map(cell).collect()).unwrap();
        let shares = Shares::new(&mesh, &Pattern::new(&mesh), |v| v == 0);
        assert_eq!(shares.nodes, 1681 / VERTICES_PER_NODE);
        assert!(shares.of[0].iter().all(|(_, w)| *w == 0.0), "held vertices hang on none");
        let mut error = 0.0;
        // Where each node is, is found from the vertex that hangs on it the most.
        let mut places = vec![(0.0, Vec3::ZERO); shares.nodes];
        for (v, own) in shares.of.iter().enumerate() {
            for (node, w) in own {
                let place = &mut places[*node as usize];
                if *w > place.0 {
                    *place = (*w, at(v as u32));
                }
            }
        }
        for (v, own) in shares.of.iter().enumerate().skip(1) {
            let sum: f32 = own.iter().map(|s| s.1).sum();
            assert!((sum - 1.0).abs() < 1e-4, "{v}: {sum}");
            let back: Vec3 = own.iter().map(|(node, w)| places[*node as usize].1 * *w).sum();
            error += back.distance(at(v as u32)) / shares.of.len() as f32;
        }
        // Nodes are 0.16 m apart.
        assert!(error < 0.03, "{error}");
    }
}

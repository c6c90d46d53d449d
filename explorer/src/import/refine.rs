//! Refines a triangle mesh until no edge is longer than asked for.
//!
//! The longest edge of the whole mesh is cut in the middle, again and again; being the longest it
//! is so in both triangles beside it, so each is cut in two and the mesh stays conforming and
//! manifold (longest-edge bisection, Rivara 1984, without propagation).

use std::collections::{BinaryHeap, HashMap};

use cloth::Vec3;

/// Refining would make too many vertices.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("refining makes more than {vertices_max} vertices; ask for longer edges")]
pub struct TooFine {
    /// The limit.
    pub vertices_max: usize,
}

/// A mesh cannot be made coarser.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the mesh has {has} vertices, and it can only be made finer; ask for at least as many")]
pub struct TooCoarse {
    /// Vertices it has.
    pub has: usize,
}

/// Cuts edges until none is longer than `edge_length_m`; old vertices keep their index.
///
/// Cost: O(n log n) in the number of new triangles. The mesh must be manifold.
///
/// # Errors
/// More than `vertices_max` vertices would be made.
pub fn refine(
    positions: &mut Vec<Vec3>,
    triangles: &mut Vec<[u32; 3]>,
    edge_length_m: f32,
    vertices_max: usize,
) -> Result<(), TooFine> {
    if vertices_needed(positions, triangles, edge_length_m) > vertices_max as f64 {
        return Err(TooFine { vertices_max });
    }
    let mut mesh = Mesh::new(positions, triangles, edge_length_m);
    while let Some(edge) = mesh.longest() {
        if mesh.positions.len() >= vertices_max {
            return Err(TooFine { vertices_max });
        }
        mesh.cut(edge);
    }
    Ok(())
}

/// Cuts the longest edge again and again until there are exactly `vertices`; old vertices keep
/// their index, and a finer mesh begins with the vertices of every coarser one.
///
/// # Errors
/// The mesh has more vertices already.
pub fn refine_to(
    positions: &mut Vec<Vec3>,
    triangles: &mut Vec<[u32; 3]>,
    vertices: usize,
) -> Result<(), TooCoarse> {
    if positions.len() > vertices {
        return Err(TooCoarse { has: positions.len() });
    }
    let mut mesh = Mesh::new(positions, triangles, 0.0);
    while mesh.positions.len() < vertices {
        let Some(edge) = mesh.longest() else { break };
        mesh.cut(edge);
    }
    Ok(())
}

/// A lower bound: no triangle with such edges is larger than the equilateral one, and a manifold
/// surface has at least half as many vertices as triangles.
fn vertices_needed(positions: &[Vec3], triangles: &[[u32; 3]], edge_length_m: f32) -> f64 {
    let area_m2: f64 = triangles
        .iter()
        .map(|t| {
            let [a, b, c] = t.map(|v| positions[v as usize]);
            f64::from((b - a).cross(c - a).length() * 0.5)
        })
        .sum();
    let largest_m2 = 3f64.sqrt() / 4.0 * f64::from(edge_length_m) * f64::from(edge_length_m);
    0.5 * area_m2 / largest_m2
}

type Edge = (u32, u32);

struct Mesh<'a> {
    positions: &'a mut Vec<Vec3>,
    triangles: &'a mut Vec<[u32; 3]>,
    /// Triangles beside each edge; looked up only, never walked.
    beside: HashMap<Edge, Vec<u32>>,
    /// Edges to cut by the bits of their squared length (non-negative floats sort like that).
    long: BinaryHeap<(u32, Edge)>,
    limit_m2: f32,
}

impl<'a> Mesh<'a> {
    fn new(
        positions: &'a mut Vec<Vec3>,
        triangles: &'a mut Vec<[u32; 3]>,
        edge_length_m: f32,
    ) -> Self {
        let limit_m2 = edge_length_m * edge_length_m;
        let (beside, long) = (HashMap::new(), BinaryHeap::new());
        let mut mesh = Self { positions, triangles, beside, long, limit_m2 };
        for t in 0..mesh.triangles.len() {
            for edge in edges(mesh.triangles[t]) {
                mesh.attach(edge, t as u32);
            }
        }
        mesh
    }

    fn attach(&mut self, edge: Edge, triangle: u32) {
        let beside = self.beside.entry(edge).or_default();
        beside.push(triangle);
        let first = beside.len() == 1;
        let [a, b] = [edge.0, edge.1].map(|v| self.positions[v as usize]);
        let length_m2 = a.distance_squared(b);
        if first && length_m2 > self.limit_m2 {
            self.long.push((length_m2.to_bits(), edge));
        }
    }

    fn longest(&mut self) -> Option<Edge> {
        loop {
            let (_, edge) = self.long.pop()?;
            if self.beside.get(&edge).is_some_and(|b| !b.is_empty()) {
                return Some(edge);
            }
        }
    }

    fn cut(&mut self, edge: Edge) {
        let middle = self.positions.len() as u32;
        let [a, b] = [edge.0, edge.1].map(|v| self.positions[v as usize]);
        self.positions.push((a + b) * 0.5);
        for triangle in self.beside.remove(&edge).unwrap_or_default() {
            let old = self.triangles[triangle as usize];
            for other in edges(old) {
                if let Some(beside) = self.beside.get_mut(&other) {
                    beside.retain(|t| *t != triangle);
                }
            }
            let with = |v: u32, new: u32| old.map(|o| if o == v { new } else { o });
            let (first, second) = (with(edge.1, middle), with(edge.0, middle));
            self.triangles[triangle as usize] = first;
            let added = self.triangles.len() as u32;
            self.triangles.push(second);
            for (index, corners) in [(triangle, first), (added, second)] {
                for other in edges(corners) {
                    self.attach(other, index);
                }
            }
        }
    }
}

/// The three edges, smaller index first.
fn edges(t: [u32; 3]) -> [Edge; 3] {
    [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])].map(|(a, b)| (a.min(b), a.max(b)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn area(positions: &[Vec3], t: [u32; 3]) -> Vec3 {
        let [a, b, c] = t.map(|v| positions[v as usize]);
        (b - a).cross(c - a) * 0.5
    }

    #[test]
    fn edges_get_short_the_mesh_stays_manifold_and_its_area_is_kept() {
        let mut positions = vec![Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.3, 0.0), Vec3::Y];
        let mut triangles = vec![[0, 1, 2], [0, 2, 3]];
        let before: Vec3 = triangles.iter().map(|t| area(&positions, *t)).sum();
        refine(&mut positions, &mut triangles, 0.11, 10_000).unwrap();
        let after: Vec3 = triangles.iter().map(|t| area(&positions, *t)).sum();
        assert!((before - after).length() < 1e-5);
        let mut count: HashMap<Edge, usize> = HashMap::new();
        for t in &triangles {
            assert!(area(&positions, *t).z > 1e-6, "triangles keep their side and stay open");
            for (a, b) in edges(*t) {
                let length = positions[a as usize].distance(positions[b as usize]);
                assert!(length <= 0.11);
                *count.entry((a, b)).or_default() += 1;
            }
        }
        assert!(count.values().all(|c| *c <= 2));
        // Euler: a disc.
        assert_eq!(positions.len() + triangles.len(), count.len() + 1);
    }

    #[test]
    fn any_number_of_vertices_is_met_and_finer_meshes_begin_with_coarser_ones() {
        let start = (vec![Vec3::ZERO, Vec3::X, Vec3::Y], vec![[0, 1, 2]]);
        let made = |vertices| {
            let (mut positions, mut triangles) = start.clone();
            refine_to(&mut positions, &mut triangles, vertices).map(|()| (positions, triangles))
        };
        let (fine, triangles) = made(517).unwrap();
        assert_eq!(fine.len(), 517);
        let (coarse, _) = made(90).unwrap();
        assert_eq!(coarse, fine[..90]);
        let sum: f32 = triangles.iter().map(|t| area(&fine, *t).z).sum();
        assert!((sum - 0.5).abs() < 1e-5, "{sum}");
        assert_eq!(made(2).unwrap_err(), TooCoarse { has: 3 });
    }

    #[test]
    fn too_fine_is_an_error() {
        let mut positions = vec![Vec3::ZERO, Vec3::X, Vec3::Y];
        let mut triangles = vec![[0, 1, 2]];
        // Foreseen by area, and found on the way.
        for edge_length_m in [0.001, 0.09] {
            let result = refine(&mut positions, &mut triangles, edge_length_m, 70);
            assert_eq!(result.unwrap_err(), TooFine { vertices_max: 70 });
        }
    }
}

//! Crossings of a cloth with itself, counted the way the peers were measured: pairs of an edge and
//! a triangle without a common vertex that cut each other.

use glam::Vec3;

use crate::mesh::Mesh;

/// Cuts nearer to a rim than this share are not counted: there, rounding decides.
const RIM: f64 = 1e-9;

/// Number of edges that cut a triangle, each pair once; 0 is clean.
pub fn count(mesh: &Mesh, positions: &[Vec3]) -> u64 {
    let at = |v: u32| positions[v as usize];
    let long = |e: &[u32; 2]| at(e[0]).distance(at(e[1]));
    let cell = 2.0 * (mesh.edges().iter().map(long).sum::<f32>() / mesh.edges().len() as f32);
    let grid = Grid::new(mesh, positions, cell.max(1e-6));
    let mut found = 0;
    let mut near = Vec::new();
    for edge in mesh.edges() {
        let (a, b) = (at(edge[0]), at(edge[1]));
        grid.near(a.min(b), a.max(b), &mut near);
        for triangle in &near {
            let t = mesh.triangles()[*triangle as usize];
            let shares = t.contains(&edge[0]) || t.contains(&edge[1]);
            found += u64::from(!shares && cuts(exact(a), exact(b), t.map(|v| exact(at(v)))));
        }
    }
    found
}

type Exact = [f64; 3];

fn exact(p: Vec3) -> Exact {
    p.to_array().map(f64::from)
}

fn minus(a: Exact, b: Exact) -> Exact {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

fn dot(a: Exact, b: Exact) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: Exact, b: Exact) -> Exact {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Whether the segment from `o` to `e` passes through the inside of a triangle.
fn cuts(o: Exact, e: Exact, t: [Exact; 3]) -> bool {
    let (d, u, v) = (minus(e, o), minus(t[1], t[0]), minus(t[2], t[0]));
    let h = cross(d, v);
    let det = dot(u, h);
    if det.abs() <= 1e-18 {
        return false;
    }
    let s = minus(o, t[0]);
    let bu = dot(s, h) / det;
    let q = cross(s, u);
    let (bv, along) = (dot(d, q) / det, dot(v, q) / det);
    bu > RIM && bv > RIM && bu + bv < 1.0 - RIM && along > RIM && along < 1.0 - RIM
}

/// Triangles by the cells of a grid that their boxes touch, as a sorted list.
struct Grid {
    cell: f32,
    entries: Vec<([i32; 3], u32)>,
}

impl Grid {
    fn new(mesh: &Mesh, positions: &[Vec3], cell: f32) -> Self {
        let mut entries = Vec::new();
        for (number, t) in mesh.triangles().iter().enumerate() {
            let [a, b, c] = t.map(|v| positions[v as usize]);
            for key in cells(a.min(b).min(c), a.max(b).max(c), cell) {
                entries.push((key, number as u32));
            }
        }
        entries.sort_unstable();
        Self { cell, entries }
    }

    /// Triangles whose boxes share a cell with the box from `low` to `high`, each once.
    fn near(&self, low: Vec3, high: Vec3, out: &mut Vec<u32>) {
        out.clear();
        for key in cells(low, high, self.cell) {
            let first = self.entries.partition_point(|(k, _)| *k < key);
            let of_cell = self.entries[first..].iter().take_while(|(k, _)| *k == key);
            out.extend(of_cell.map(|(_, triangle)| *triangle));
        }
        out.sort_unstable();
        out.dedup();
    }
}

/// Cells that a box touches; at most so many to a side that a torn cloth costs no more memory.
fn cells(low: Vec3, high: Vec3, cell: f32) -> impl Iterator<Item = [i32; 3]> {
    let axis = |k: usize| {
        let first = (low[k] / cell).floor() as i32;
        let last = (high[k] / cell).floor() as i32;
        first..=last.min(first.saturating_add(15))
    };
    let [x, y, z] = [axis(0), axis(1), axis(2)];
    x.flat_map(move |x| {
        let z = z.clone();
        y.clone().flat_map(move |y| z.clone().map(move |z| [x, y, z]))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lab::shapes::{Cut, sheet};

    #[test]
    fn a_flat_sheet_is_clean_and_a_folded_through_one_is_not() {
        let mesh = sheet(10, 10, Cut::Alternating, |u, v| Vec3::new(u, 0.0, v)).unwrap();
        assert_eq!(count(&mesh, mesh.rest_positions()), 0);
        // The last row is pulled through the sheet's middle.
        let mut p = mesh.rest_positions().to_vec();
        for v in p.iter_mut().filter(|v| v.z > 0.95) {
            *v = Vec3::new(v.x * 0.9 + 0.03, -0.1, 0.42);
        }
        for v in p.iter_mut().filter(|v| v.z > 0.85) {
            *v = Vec3::new(v.x * 0.9 + 0.03, 0.1, 0.42);
        }
        assert!(count(&mesh, &p) > 0);
    }

    #[test]
    fn every_crossing_of_two_triangles_is_found() {
        let p = vec![
            Vec3::ZERO,
            Vec3::X,
            Vec3::Z,
            Vec3::new(0.2, -0.5, 0.2),
            Vec3::new(0.3, 0.5, 0.2),
            Vec3::new(5.0, 0.5, 0.2),
        ];
        let mesh = Mesh::new(p.clone(), vec![[0, 1, 2], [3, 4, 5]]).unwrap();
        // Edge 3-4 cuts the first triangle; the diagonal 1-2 cuts the second.
        assert_eq!(count(&mesh, &p), 2);
    }
}

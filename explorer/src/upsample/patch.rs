//! Coarse and fine meshes of one surface, and what leads linearly from one to the other without
//! learning: barycentric lift and Loop subdivision.

use std::collections::BTreeMap;

use cloth::{Mesh, MeshError, Vec3};

/// Times that Loop's scheme is applied before positions are interpolated in its triangles.
const LOOP_LEVELS: usize = 3;

/// A rectangular grid of triangles with the parameters (0..=1) of its surface.
#[derive(Debug, Clone)]
pub struct Patch {
    /// The mesh in its rest shape.
    pub mesh: Mesh,
    /// Parameters of each vertex.
    pub uv: Vec<[f32; 2]>,
    /// Vertices that are led, ascending.
    pub pins: Vec<u32>,
    cells: [usize; 2],
    wraps: bool,
}

/// One fine vertex as a mean of coarse ones: indices and weights that sum to 1.
pub type Row = [(u32, f32); 3];

impl Patch {
    /// A grid of `cells` over the surface `at`; where it `wraps`, its last column is its first.
    /// `pinned` is asked with a vertex's column and row.
    ///
    /// # Errors
    /// A degenerate surface.
    pub fn new(
        cells: [usize; 2],
        wraps: bool,
        at: impl Fn(f32, f32) -> Vec3,
        pinned: impl Fn(usize, usize) -> bool,
    ) -> Result<Self, MeshError> {
        let [nx, ny] = cells;
        let columns = if wraps { nx } else { nx + 1 };
        let (mut points, mut uv, mut pins) = (Vec::new(), Vec::new(), Vec::new());
        for j in 0..=ny {
            for i in 0..columns {
                let [u, v] = [i as f32 / nx as f32, j as f32 / ny as f32];
                if pinned(i, j) {
                    pins.push(points.len() as u32);
                }
                points.push(at(u, v));
                uv.push([u, v]);
            }
        }
        let corner = |i: usize, j: usize| (j * columns + i % columns) as u32;
        let mut triangles = Vec::new();
        for j in 0..ny {
            for i in 0..nx {
                let [a, b] = [corner(i, j), corner(i + 1, j)];
                let [d, c] = [corner(i, j + 1), corner(i + 1, j + 1)];
                // Rows run downwards: this order turns the front to where u x (up) points.
                let pair =
                    if (i + j) % 2 == 0 { [[a, c, b], [a, d, c]] } else { [[a, d, b], [b, d, c]] };
                triangles.extend(pair);
            }
        }
        Ok(Self { mesh: Mesh::new(points, triangles)?, uv, pins, cells, wraps })
    }

    /// Number of vertices.
    pub fn count(&self) -> usize {
        self.uv.len()
    }

    /// Triangle over the parameters (u, v), and the barycentric weights of its corners.
    fn locate(&self, [u, v]: [f32; 2]) -> (usize, [f32; 3]) {
        let [nx, ny] = self.cells;
        let (x, y) = (u * nx as f32, v * ny as f32);
        let (i, j) = ((x as usize).min(nx - 1), (y as usize).min(ny - 1));
        let (s, t) = (x - i as f32, y - j as f32);
        let cell = 2 * (j * nx + i);
        match ((i + j) % 2 == 0, s > t, s + t < 1.0) {
            (true, true, _) => (cell, [1.0 - s, t, s - t]),
            (true, false, _) => (cell + 1, [1.0 - t, t - s, s]),
            (false, _, true) => (cell, [1.0 - s - t, t, s]),
            (false, _, false) => (cell + 1, [1.0 - t, 1.0 - s, s + t - 1.0]),
        }
    }

    /// The barycentric lift B: each of `fine`'s vertices as a mean of three of these (Kavan et al.
    /// 2011, section 4).
    pub fn lift(&self, fine: &Self) -> Vec<Row> {
        let row = |uv: &[f32; 2]| {
            let (triangle, weights) = self.locate(*uv);
            let corners = self.mesh.triangles()[triangle];
            std::array::from_fn(|k| (corners[k], weights[k]))
        };
        fine.uv.iter().map(row).collect()
    }

    /// Loop's subdivision (1987, creases along boundaries, sharp corners), read off at `fine`'s
    /// vertices: a dense matrix, row after row.
    pub fn subdivision(&self, fine: &Self) -> Vec<f32> {
        let count = self.count();
        let mut level = Level::of(&self.mesh);
        let mut places: Vec<(usize, [f32; 3])> =
            fine.uv.iter().map(|uv| self.locate(*uv)).collect();
        for _ in 0..LOOP_LEVELS {
            level = level.finer();
            places.iter_mut().for_each(|place| *place = child(*place));
        }
        let mut rows = vec![0.0; fine.count() * count];
        for (out, (triangle, weights)) in rows.chunks_mut(count).zip(places) {
            for (corner, weight) in level.triangles[triangle].iter().zip(weights) {
                let from = &level.rows[*corner as usize];
                out.iter_mut().zip(from).for_each(|(out, r)| *out += weight * r);
            }
        }
        rows
    }

    /// Whether the first and the last column are one.
    pub fn wraps(&self) -> bool {
        self.wraps
    }
}

/// The barycentric lift of coarse positions (m).
pub fn lifted(rows: &[Row], coarse: &[Vec3]) -> Vec<Vec3> {
    rows.iter().map(|row| row.iter().map(|(v, w)| coarse[*v as usize] * *w).sum()).collect()
}

/// The lift as a dense matrix, row after row.
pub fn dense(rows: &[Row], coarse: usize) -> Vec<f32> {
    let mut out = vec![0.0; rows.len() * coarse];
    for (out, row) in out.chunks_mut(coarse).zip(rows) {
        row.iter().for_each(|(v, w)| out[*v as usize] += w);
    }
    out
}

/// The child of a triangle in which a point lies: three at its corners, then the middle one.
fn child((triangle, [a, b, c]): (usize, [f32; 3])) -> (usize, [f32; 3]) {
    let first = 4 * triangle;
    if a >= 0.5 {
        (first, [2.0 * a - 1.0, 2.0 * b, 2.0 * c])
    } else if b >= 0.5 {
        (first + 1, [2.0 * a, 2.0 * b - 1.0, 2.0 * c])
    } else if c >= 0.5 {
        (first + 2, [2.0 * a, 2.0 * b, 2.0 * c - 1.0])
    } else {
        (first + 3, [1.0 - 2.0 * c, 1.0 - 2.0 * a, 1.0 - 2.0 * b])
    }
}

/// A mesh whose vertices are combinations of those of the coarsest.
struct Level {
    triangles: Vec<[u32; 3]>,
    rows: Vec<Vec<f32>>,
}

impl Level {
    fn of(mesh: &Mesh) -> Self {
        let count = mesh.vertex_count();
        let unit = |i| (0..count).map(|j| f32::from(u8::from(i == j))).collect();
        Self { triangles: mesh.triangles().to_vec(), rows: (0..count).map(unit).collect() }
    }

    fn finer(&self) -> Self {
        let count = self.rows.len();
        // For each edge its opposite vertices, then its own new vertex.
        let mut edges: BTreeMap<[u32; 2], Vec<u32>> = BTreeMap::new();
        for t in &self.triangles {
            for k in 0..3 {
                let (a, b) = (t[k], t[(k + 1) % 3]);
                edges.entry([a.min(b), a.max(b)]).or_default().push(t[(k + 2) % 3]);
            }
        }
        let mut rows: Vec<Vec<f32>> = (0..count).map(|v| self.even(v as u32, &edges)).collect();
        let mut middle = BTreeMap::new();
        for (edge, opposite) in &edges {
            middle.insert(*edge, rows.len() as u32);
            let [a, b] = *edge;
            rows.push(match opposite[..] {
                [c, d] => self.sum(&[(a, 0.375), (b, 0.375), (c, 0.125), (d, 0.125)]),
                _ => self.sum(&[(a, 0.5), (b, 0.5)]),
            });
        }
        let mut triangles = Vec::with_capacity(4 * self.triangles.len());
        for [a, b, c] in &self.triangles {
            let mid = |x: &u32, y: &u32| middle[&[*x.min(y), *x.max(y)]];
            let (ab, bc, ca) = (mid(a, b), mid(b, c), mid(c, a));
            triangles.extend([[*a, ab, ca], [ab, *b, bc], [ca, bc, *c], [ab, bc, ca]]);
        }
        Self { triangles, rows }
    }

    /// The new place of a vertex that was there before.
    fn even(&self, v: u32, edges: &BTreeMap<[u32; 2], Vec<u32>>) -> Vec<f32> {
        let around: Vec<(u32, bool)> = edges
            .iter()
            .filter(|(e, _)| e.contains(&v))
            .map(|(e, opposite)| (e[0] + e[1] - v, opposite.len() == 1))
            .collect();
        let border: Vec<u32> = around.iter().filter(|(_, b)| *b).map(|(w, _)| *w).collect();
        match border[..] {
            [] => {
                let n = around.len() as f32;
                let beta = if around.len() == 3 { 3.0 / 16.0 } else { 3.0 / (8.0 * n) };
                let mut parts: Vec<(u32, f32)> = around.iter().map(|(w, _)| (*w, beta)).collect();
                parts.push((v, 1.0 - n * beta));
                self.sum(&parts)
            }
            [a, b] if around.len() > 2 => self.sum(&[(v, 0.75), (a, 0.125), (b, 0.125)]),
            _ => self.sum(&[(v, 1.0)]),
        }
    }

    fn sum(&self, parts: &[(u32, f32)]) -> Vec<f32> {
        let mut sum = vec![0.0; self.rows[0].len()];
        for (v, weight) in parts {
            sum.iter_mut().zip(&self.rows[*v as usize]).for_each(|(s, r)| *s += weight * r);
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flat(cells: [usize; 2]) -> Patch {
        Patch::new(cells, false, |u, v| Vec3::new(u, -v, 0.0), |_, j| j == 0).unwrap()
    }

    fn tube(cells: [usize; 2]) -> Patch {
        let at = |u: f32, v: f32| {
            let (s, c) = (std::f32::consts::TAU * u).sin_cos();
            Vec3::new(s, -v, c)
        };
        Patch::new(cells, true, at, |_, j| j == 0).unwrap()
    }

    #[test]
    fn the_lift_reproduces_linear_functions_of_the_parameters() {
        let (coarse, fine) = (flat([5, 4]), flat([31, 17]));
        let rows = coarse.lift(&fine);
        let lifted = lifted(&rows, coarse.mesh.rest_positions());
        let far = lifted.iter().zip(fine.mesh.rest_positions()).map(|(a, b)| a.distance(*b));
        assert!(far.fold(0.0, f32::max) < 1e-6);
        assert_eq!(coarse.pins, [0, 1, 2, 3, 4, 5]);
    }

    #[test]
    fn subdivision_is_affine_and_smooth() {
        for (coarse, fine) in [(flat([5, 4]), flat([31, 17])), (tube([12, 4]), tube([60, 20]))] {
            let count = coarse.count();
            let rows = coarse.subdivision(&fine);
            for row in rows.chunks(count) {
                assert!((row.iter().sum::<f32>() - 1.0).abs() < 1e-5);
                assert!(row.iter().all(|w| *w > -1e-6), "Loop's weights are not negative");
            }
        }
        // In the middle of a flat grid linear functions are reproduced.
        let (coarse, fine) = (flat([8, 8]), flat([32, 32]));
        let rows = coarse.subdivision(&fine);
        let row = &rows[(16 * 33 + 14) * coarse.count()..][..coarse.count()];
        let x: f32 = row.iter().zip(coarse.mesh.rest_positions()).map(|(w, p)| w * p.x).sum();
        assert!((x - 14.0 / 32.0).abs() < 0.02, "{x}");
    }

    #[test]
    fn a_tube_has_no_seam() {
        let (coarse, fine) = (tube([12, 4]), tube([60, 20]));
        let rows = coarse.lift(&fine);
        let lifted = lifted(&rows, coarse.mesh.rest_positions());
        let far = lifted.iter().zip(fine.mesh.rest_positions()).map(|(a, b)| a.distance(*b));
        assert!(far.fold(0.0, f32::max) < 0.05, "a chord is near its arc");
        assert_eq!(fine.count(), 60 * 21);
    }
}

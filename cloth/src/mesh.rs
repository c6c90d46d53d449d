//! A garment's topology and rest shape, checked.

use glam::{Vec2, Vec3};

/// Smallest legal triangle: twice its area over its longest edge squared (1:1000 slivers go).
const SLIVER: f32 = 1e-3;
/// Smallest legal edge (m).
const EDGE_M_MIN: f32 = 1e-5;

/// An interior edge and the two vertices opposite to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Hinge {
    /// Ends of the shared edge, then the opposite vertex of the triangle that runs along it and
    /// of the one that runs against it.
    pub vertices: [u32; 4],
}

/// A manifold triangle mesh with boundary, and its rest shape.
#[derive(Debug, Clone, PartialEq)]
pub struct Mesh {
    rest_positions: Vec<Vec3>,
    triangles: Vec<[u32; 3]>,
    edges: Vec<[u32; 2]>,
    rest_lengths: Vec<f32>,
    hinges: Vec<Hinge>,
    rest_areas: Vec<f32>,
    /// Gradients of the three hat functions in each triangle's rest plane, along warp and weft
    /// [1/m].
    shape_gradients: Vec<[Vec2; 3]>,
    vertex_areas: Vec<f32>,
}

/// Why a mesh was refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum MeshError {
    /// Nothing to simulate.
    #[error("the mesh has no triangle")]
    Empty,
    /// A triangle names a vertex that does not exist, or one vertex twice.
    #[error("triangle {triangle} has vertices {vertices:?}: they must differ and be under {count}")]
    BadTriangle {
        /// Index of the triangle.
        triangle: usize,
        /// Its vertices.
        vertices: [u32; 3],
        /// Number of vertices.
        count: usize,
    },
    /// NaN or infinite coordinates.
    #[error("vertex {vertex} is at {position}: coordinates must be finite")]
    NotFinite {
        /// Index of the vertex.
        vertex: usize,
        /// Where it is.
        position: Vec3,
    },
    /// A triangle without area.
    #[error("triangle {triangle} is degenerate: area {area_m2} m^2, longest edge {edge_m} m")]
    Degenerate {
        /// Index of the triangle.
        triangle: usize,
        /// Its area.
        area_m2: f32,
        /// Its longest edge.
        edge_m: f32,
    },
    /// More than two triangles share an edge.
    #[error("edge {a}-{b} is not manifold: {triangles} triangles share it")]
    NonManifold {
        /// One end.
        a: u32,
        /// Other end.
        b: u32,
        /// How many.
        triangles: usize,
    },
    /// Two neighbours are wound in opposite senses.
    #[error("triangles {first} and {second} are wound inconsistently along edge {a}-{b}")]
    Inverted {
        /// One end of the shared edge.
        a: u32,
        /// Other end.
        b: u32,
        /// One triangle.
        first: usize,
        /// The other.
        second: usize,
    },
    /// No triangle uses a vertex.
    #[error("vertex {vertex} belongs to no triangle")]
    Isolated {
        /// Index of the vertex.
        vertex: usize,
    },
}

impl Mesh {
    /// Checks the mesh and derives edges, hinges and rest shape. Edges are sorted.
    ///
    /// * `positions`: rest positions (m).
    /// * `triangles`: counter-clockwise seen from outside.
    ///
    /// # Errors
    /// Non-finite coordinates, indices out of range, degenerate triangles, non-manifold edges,
    /// inconsistent winding, isolated vertices: the first one found is named.
    pub fn new(positions: Vec<Vec3>, triangles: Vec<[u32; 3]>) -> Result<Self, MeshError> {
        if triangles.is_empty() {
            return Err(MeshError::Empty);
        }
        if let Some(vertex) = positions.iter().position(|p| !p.is_finite()) {
            return Err(MeshError::NotFinite { vertex, position: positions[vertex] });
        }
        let count = positions.len();
        for (triangle, &vertices) in triangles.iter().enumerate() {
            let [a, b, c] = vertices;
            let known = vertices.iter().all(|v| (*v as usize) < count);
            if !known || a == b || b == c || c == a {
                return Err(MeshError::BadTriangle { triangle, vertices, count });
            }
        }
        let (edges, hinges) = edges_and_hinges(&triangles)?;
        let mut mesh = Self {
            rest_lengths: Vec::with_capacity(edges.len()),
            rest_positions: positions,
            triangles,
            edges,
            hinges,
            rest_areas: Vec::new(),
            shape_gradients: Vec::new(),
            vertex_areas: vec![0.0; count],
        };
        mesh.measure_rest_shape()?;
        if let Some(vertex) = mesh.vertex_areas.iter().position(|a| *a <= 0.0) {
            return Err(MeshError::Isolated { vertex });
        }
        Ok(mesh.with_grain(Vec3::Y))
    }

    /// The same mesh with its warp along `direction`, as seen from each rest triangle's plane. Where
    /// a triangle is nearly normal to it, the warp is along the next axis (x, then z for
    /// `direction` = x). [`Mesh::new`] takes y, as garments are cut; only an orthotropic
    /// material feels it.
    pub fn with_grain(self, direction: Vec3) -> Self {
        let direction = direction.try_normalize().unwrap_or(Vec3::Y);
        let count = self.triangles.len();
        self.with_grains((0..count).map(|_| direction))
    }

    /// The same mesh with a warp direction for each triangle, for example the direction in which u
    /// grows; missing ones stay as they are.
    pub fn with_grains(mut self, directions: impl IntoIterator<Item = Vec3>) -> Self {
        for (index, wanted) in directions.into_iter().take(self.triangles.len()).enumerate() {
            let [p, q, r] = self.triangles[index].map(|v| self.rest_positions[v as usize]);
            let axis = (q - p).normalize();
            let across = axis.cross(r - p).cross(axis).normalize();
            let other = if wanted.x.abs() > 0.9 { Vec3::Z } else { Vec3::X };
            let flat = |d: Vec3| Vec2::new(d.dot(axis), d.dot(across));
            let [first, second] = [flat(wanted), flat(other)];
            let steep = first.length_squared() > 0.01 * wanted.length_squared();
            let warp = if steep { first } else { second }.try_normalize().unwrap_or(Vec2::X);
            let (a, b) = ((q - p).length(), flat(r - p));
            // Rows of the inverse of [[a, b.x], [0, b.y]].
            let g1 = Vec2::new(1.0 / a, -b.x / (a * b.y));
            let g2 = Vec2::new(0.0, 1.0 / b.y);
            let turned = |g: Vec2| Vec2::new(g.dot(warp), g.dot(warp.perp()));
            self.shape_gradients[index] = [-g1 - g2, g1, g2].map(turned);
        }
        self
    }

    fn measure_rest_shape(&mut self) -> Result<(), MeshError> {
        let at = |v: u32| self.rest_positions[v as usize];
        self.rest_lengths.extend(self.edges.iter().map(|e| at(e[0]).distance(at(e[1]))));
        for (triangle, t) in self.triangles.iter().enumerate() {
            let (p, q, r) = (at(t[0]), at(t[1]), at(t[2]));
            let (d1, d2) = (q - p, r - p);
            let area_m2 = 0.5 * d1.cross(d2).length();
            let edge_m = d1.length().max(d2.length()).max(q.distance(r));
            let shortest = d1.length().min(d2.length()).min(q.distance(r));
            if 2.0 * area_m2 <= SLIVER * edge_m * edge_m || shortest < EDGE_M_MIN {
                return Err(MeshError::Degenerate { triangle, area_m2, edge_m });
            }
            self.rest_areas.push(area_m2);
            self.shape_gradients.push([Vec2::ZERO; 3]);
            for v in t {
                self.vertex_areas[*v as usize] += area_m2 / 3.0;
            }
        }
        Ok(())
    }

    /// Number of vertices.
    pub fn vertex_count(&self) -> usize {
        self.rest_positions.len()
    }

    /// Rest positions (m).
    pub fn rest_positions(&self) -> &[Vec3] {
        &self.rest_positions
    }

    /// Triangles, as given.
    pub fn triangles(&self) -> &[[u32; 3]] {
        &self.triangles
    }

    /// Unique edges, lower vertex first, sorted.
    pub fn edges(&self) -> &[[u32; 2]] {
        &self.edges
    }

    /// Rest length of each edge (m).
    pub fn rest_lengths(&self) -> &[f32] {
        &self.rest_lengths
    }

    /// Interior edges with their opposite vertices.
    pub fn hinges(&self) -> &[Hinge] {
        &self.hinges
    }

    /// Rest area of each triangle (m^2).
    pub fn rest_areas(&self) -> &[f32] {
        &self.rest_areas
    }

    /// Gradients of the three hat functions in each triangle's rest plane, along warp and weft
    /// [1/m].
    pub fn shape_gradients(&self) -> &[[Vec2; 3]] {
        &self.shape_gradients
    }

    /// A third of the area of the triangles around each vertex (m^2).
    pub fn vertex_areas(&self) -> &[f32] {
        &self.vertex_areas
    }
}

/// A triangle's side: its vertices in ascending order, whether the triangle runs that way, the
/// triangle, and the vertex opposite to the side.
type Side = (u32, u32, bool, usize, u32);

fn edges_and_hinges(triangles: &[[u32; 3]]) -> Result<(Vec<[u32; 2]>, Vec<Hinge>), MeshError> {
    let mut sides: Vec<Side> = Vec::with_capacity(3 * triangles.len());
    for (triangle, t) in triangles.iter().enumerate() {
        for k in 0..3 {
            let (a, b, opposite) = (t[k], t[(k + 1) % 3], t[(k + 2) % 3]);
            sides.push((a.min(b), a.max(b), a < b, triangle, opposite));
        }
    }
    sides.sort_unstable();
    let mut edges = Vec::new();
    let mut hinges = Vec::new();
    for group in sides.chunk_by(|x, y| (x.0, x.1) == (y.0, y.1)) {
        let (a, b) = (group[0].0, group[0].1);
        edges.push([a, b]);
        match group {
            [_] => {}
            [back, along] if !back.2 && along.2 => {
                hinges.push(Hinge { vertices: [a, b, along.4, back.4] });
            }
            [x, y] => return Err(MeshError::Inverted { a, b, first: x.3, second: y.3 }),
            more => return Err(MeshError::NonManifold { a, b, triangles: more.len() }),
        }
    }
    Ok((edges, hinges))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square() -> (Vec<Vec3>, Vec<[u32; 3]>) {
        let p = vec![Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y];
        (p, vec![[0, 1, 2], [0, 2, 3]])
    }

    #[test]
    fn a_square_has_five_edges_one_hinge_and_its_area() {
        let (p, t) = square();
        let mesh = Mesh::new(p, t).unwrap();
        assert_eq!(mesh.edges(), [[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]);
        assert_eq!(mesh.hinges(), [Hinge { vertices: [0, 2, 3, 1] }]);
        assert!((mesh.vertex_areas().iter().sum::<f32>() - 1.0).abs() < 1e-6);
        // Hat gradients sum to zero and reproduce a linear function.
        let g = mesh.shape_gradients()[0];
        assert!((g[0] + g[1] + g[2]).length() < 1e-6);
        assert!((g[1].length() - 2.0f32.sqrt()).abs() < 1e-6);
    }

    #[test]
    fn the_warp_is_the_grain_as_seen_from_each_triangle() {
        let (p, t) = square();
        let mesh = Mesh::new(p.clone(), t).unwrap();
        let slopes = |mesh: &Mesh, linear: Vec3| -> Vec<Vec2> {
            let value = |v: u32| p[v as usize].dot(linear);
            let shapes = mesh.triangles().iter().zip(mesh.shape_gradients());
            shapes.map(|(t, g)| t.iter().zip(g).map(|(v, g)| *g * value(*v)).sum()).collect()
        };
        let near = |found: Vec<Vec2>, wanted: Vec2| {
            assert!(found.iter().all(|f| (*f - wanted).length() < 1e-5), "{found:?} {wanted}");
        };
        near(slopes(&mesh, Vec3::Y), Vec2::X);
        let mesh = mesh.with_grain(Vec3::X);
        near(slopes(&mesh, Vec3::X), Vec2::X);
        near(slopes(&mesh, Vec3::Y), Vec2::Y);
        // Normal to the sheet: the next axis.
        near(slopes(&mesh.with_grain(Vec3::Z), Vec3::X), Vec2::X);
    }

    #[test]
    fn faults_are_refused_by_name() {
        let (p, t) = square();
        let mut five = p.clone();
        let with = |p: &[Vec3], t: &[[u32; 3]]| Mesh::new(p.to_vec(), t.to_vec()).unwrap_err();
        assert_eq!(with(&p, &[]), MeshError::Empty);
        assert!(matches!(with(&p, &[[0, 1, 9]]), MeshError::BadTriangle { triangle: 0, .. }));
        assert!(matches!(with(&p, &[t[0], [0, 0, 1]]), MeshError::BadTriangle { triangle: 1, .. }));
        let inverted = with(&p, &[t[0], [0, 3, 2]]);
        assert!(matches!(inverted, MeshError::Inverted { a: 0, b: 2, .. }), "{inverted}");
        five.push(Vec3::Z);
        assert_eq!(with(&five, &t), MeshError::Isolated { vertex: 4 });
        let fan = with(&five, &[t[0], t[1], [0, 2, 4]]);
        assert!(matches!(fan, MeshError::NonManifold { a: 0, b: 2, triangles: 3 }));
        five[4] = Vec3::new(0.5, 0.5, 0.0);
        assert!(matches!(with(&five, &[t[0], [0, 2, 4]]), MeshError::Degenerate { .. }));
        five[4].x = f32::NAN;
        assert!(matches!(with(&five, &t), MeshError::NotFinite { vertex: 4, .. }));
    }
}

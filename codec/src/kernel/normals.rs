//! Normals of vertices, by the area of the triangles around them.

/// A mesh's triangles, checked against its number of vertices.
#[derive(Debug, Clone)]
pub struct Faces {
    vertices: usize,
    triangles: Vec<[u32; 3]>,
}

/// Why faces or normals could not be made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NormalsError {
    /// A triangle names a vertex that does not exist.
    #[error("triangle {triangle} names vertex {vertex} of {vertices}")]
    Vertex {
        /// The triangle.
        triangle: usize,
        /// The vertex.
        vertex: u32,
        /// How many there are.
        vertices: usize,
    },
    /// A slice of another length.
    #[error("{actual} numbers for {vertices} vertices, three each")]
    Length {
        /// Its length.
        actual: usize,
        /// Vertices.
        vertices: usize,
    },
}

impl Faces {
    /// Checks that every triangle names existing vertices.
    ///
    /// # Errors
    /// Names the first that does not.
    pub fn new(vertices: usize, triangles: Vec<[u32; 3]>) -> Result<Self, NormalsError> {
        for (triangle, corners) in triangles.iter().enumerate() {
            if let Some(vertex) = corners.iter().copied().find(|v| *v as usize >= vertices) {
                return Err(NormalsError::Vertex { triangle, vertex, vertices });
            }
        }
        Ok(Self { vertices, triangles })
    }

    /// How many vertices there are.
    pub fn vertices(&self) -> usize {
        self.vertices
    }

    /// Unit normals of all vertices from their positions (m), both x0, y0, z0, x1, ...; (0, 0, 0)
    /// where the triangles around a vertex have no area. No allocation.
    ///
    /// # Errors
    /// Slices that are not three numbers a vertex.
    pub fn normals(&self, positions_m: &[f32], out: &mut [f32]) -> Result<(), NormalsError> {
        let vertices = self.vertices;
        for actual in [positions_m.len(), out.len()] {
            if actual != 3 * vertices {
                return Err(NormalsError::Length { actual, vertices });
            }
        }
        out.fill(0.0);
        let (points, _) = positions_m.as_chunks::<3>();
        let (normals, _) = out.as_chunks_mut::<3>();
        for corners in &self.triangles {
            let [i, j, k] = corners.map(|v| v as usize);
            let (a, b, c) = (points[i], points[j], points[k]);
            let u = [b[0] - a[0], b[1] - a[1], b[2] - a[2]];
            let v = [c[0] - a[0], c[1] - a[1], c[2] - a[2]];
            let n =
                [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
            for vertex in [i, j, k] {
                let sum = &mut normals[vertex];
                *sum = [sum[0] + n[0], sum[1] + n[1], sum[2] + n[2]];
            }
        }
        for n in normals {
            let square = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
            let scale = if square > 0.0 { 1.0 / square.sqrt() } else { 0.0 };
            *n = n.map(|x| x * scale);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bent_strip_has_the_normals_of_its_triangles_by_area() {
        let faces = Faces::new(5, vec![[0, 1, 2], [2, 1, 3]]).unwrap();
        // The first in the plane z = 0 with area 1/2, the second in the plane x + y = 1.
        let positions =
            [0., 0., 0., 1., 0., 0., 0., 1., 0., 0.5, 0.5, 2., 9., 9., 9.].map(|x: f32| x);
        let mut out = [7.0; 15];
        faces.normals(&positions, &mut out).unwrap();
        assert_eq!(out[..3].iter().map(|x| x.round() as i32).collect::<Vec<_>>(), [0, 0, 1]);
        let side = std::f32::consts::FRAC_1_SQRT_2;
        for (n, expected) in out[9..12].iter().zip([-side, -side, 0.0]) {
            assert!((n.abs() - expected.abs()).abs() < 1e-6, "{out:?}");
        }
        assert!(out[12..].iter().all(|n| *n == 0.0), "a vertex without triangles");
        let bad = Faces::new(2, vec![[0, 1, 2]]).unwrap_err();
        assert_eq!(bad, NormalsError::Vertex { triangle: 0, vertex: 2, vertices: 2 });
    }
}

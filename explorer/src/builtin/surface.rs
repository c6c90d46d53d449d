//! Triangle meshes from the zero set of a field: surface nets on a grid of cells.

use cloth::Vec3;

/// A triangle mesh; counter-clockwise seen from outside.
#[derive(Debug, Clone, Default)]
pub(crate) struct Mesh {
    pub positions: Vec<Vec3>,
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Directed edges that no other triangle runs the opposite way: the boundary.
    ///
    /// # Errors
    /// An edge that two triangles run the same way: not a manifold, or not oriented.
    pub fn boundary(&self) -> Result<Vec<[u32; 2]>, [u32; 2]> {
        let mut edges: Vec<[u32; 2]> = self.triangles.iter().flat_map(directed_edges).collect();
        edges.sort_unstable();
        if let Some(pair) = edges.windows(2).find(|pair| pair[0] == pair[1]) {
            return Err(pair[0]);
        }
        let twin = |e: &[u32; 2]| edges.binary_search(&[e[1], e[0]]).is_ok();
        Ok(edges.iter().filter(|e| !twin(e)).copied().collect())
    }

    /// Number of closed curves that the boundary consists of.
    ///
    /// # Errors
    /// As for `boundary`, and a vertex at which two curves meet.
    pub fn boundary_loops(&self) -> Result<usize, [u32; 2]> {
        let mut next = vec![u32::MAX; self.positions.len()];
        for [a, b] in self.boundary()? {
            if next[a as usize] != u32::MAX {
                return Err([a, b]);
            }
            next[a as usize] = b;
        }
        let mut loops = 0;
        for start in 0..next.len() {
            let mut at = start;
            loops += usize::from(next[at] != u32::MAX);
            while next[at] != u32::MAX {
                at = std::mem::replace(&mut next[at], u32::MAX) as usize;
            }
        }
        Ok(loops)
    }

    /// Drops vertices that no triangle names; returns the old index of each that is left.
    pub fn compact(&mut self) -> Vec<u32> {
        let mut new_index = vec![u32::MAX; self.positions.len()];
        let mut kept = Vec::new();
        for corner in self.triangles.iter_mut().flatten() {
            let slot = &mut new_index[*corner as usize];
            if *slot == u32::MAX {
                *slot = kept.len() as u32;
                kept.push(*corner);
            }
            *corner = *slot;
        }
        self.positions = kept.iter().map(|old| self.positions[*old as usize]).collect();
        kept
    }

    /// Normal of a triangle, twice its area long.
    pub fn normal(&self, triangle: &[u32; 3]) -> Vec3 {
        let [a, b, c] = triangle.map(|v| self.positions[v as usize]);
        (b - a).cross(c - a)
    }

    /// Unit normal at each vertex, weighted by area.
    pub fn vertex_normals(&self) -> Vec<Vec3> {
        let mut normals = vec![Vec3::ZERO; self.positions.len()];
        for triangle in &self.triangles {
            let normal = self.normal(triangle);
            triangle.iter().for_each(|v| normals[*v as usize] += normal);
        }
        normals.into_iter().map(Vec3::normalize_or_zero).collect()
    }
}

/// The three edges of a triangle in its winding.
pub(crate) fn directed_edges(t: &[u32; 3]) -> [[u32; 2]; 3] {
    [[t[0], t[1]], [t[1], t[2]], [t[2], t[0]]]
}

/// A box of cubic cells.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Grid {
    pub low: Vec3,
    pub high: Vec3,
    pub cell: f32,
}

impl Grid {
    /// Nodes along each axis.
    pub fn nodes(&self) -> [usize; 3] {
        let size = ((self.high - self.low) / self.cell).ceil();
        size.to_array().map(|s| s as usize + 1)
    }

    /// Where a node lies (m).
    pub fn place(&self, i: [usize; 3]) -> Vec3 {
        self.low + Vec3::new(i[0] as f32, i[1] as f32, i[2] as f32) * self.cell
    }
}

/// Surface nets (Gibson 1998): a vertex in every cell that the surface crosses, at the mean of the
/// crossings of its edges; a quad across every grid edge that it crosses. Manifold wherever no
/// cell holds two sheets, that is for features larger than two cells.
pub(crate) fn surface_nets(field: &dyn Fn(Vec3) -> f32, grid: Grid) -> Mesh {
    let values: Vec<f32> = nodes(grid.nodes()).map(|i| field(grid.place(i))).collect();
    nets_of(&values, grid)
}

/// All nodes of a grid, x fastest.
pub(crate) fn nodes(n: [usize; 3]) -> impl Iterator<Item = [usize; 3]> {
    (0..n[2]).flat_map(move |z| (0..n[1]).flat_map(move |y| (0..n[0]).map(move |x| [x, y, z])))
}

/// As [`surface_nets`], of the field's values at the nodes.
pub(crate) fn nets_of(values: &[f32], grid: Grid) -> Mesh {
    let n = grid.nodes();
    let at = |i: [usize; 3]| (i[2] * n[1] + i[1]) * n[0] + i[0];
    let place = |i: [usize; 3]| grid.place(i);
    let mut mesh = Mesh::default();
    let mut cell_vertex = vec![u32::MAX; values.len()];
    for i in nodes([n[0] - 1, n[1] - 1, n[2] - 1]) {
        if let Some(mean) = cell_crossing(|o| values[at([i[0] + o[0], i[1] + o[1], i[2] + o[2]])]) {
            cell_vertex[at(i)] = mesh.positions.len() as u32;
            mesh.positions.push(place(i) + mean * grid.cell);
        }
    }
    for i in nodes([n[0] - 1, n[1] - 1, n[2] - 1]) {
        for axis in 0..3 {
            let (b, c) = ((axis + 1) % 3, (axis + 2) % 3);
            let mut end = i;
            end[axis] += 1;
            let (inside, end_inside) = (values[at(i)] < 0.0, values[at(end)] < 0.0);
            if inside == end_inside || i[b] == 0 || i[c] == 0 {
                continue;
            }
            let around = [(1, 1), (0, 1), (0, 0), (1, 0)].map(|(down_b, down_c)| {
                let mut cell = i;
                cell[b] -= down_b;
                cell[c] -= down_c;
                cell_vertex[at(cell)]
            });
            let [p, q, r, s] = if inside { around } else { [3, 2, 1, 0].map(|k| around[k]) };
            mesh.triangles.extend([[p, q, r], [p, r, s]]);
        }
    }
    mesh
}

/// Mean of the crossings of a cell's twelve edges, in cell units; `None` without a crossing.
fn cell_crossing(value: impl Fn([usize; 3]) -> f32) -> Option<Vec3> {
    let (mut sum, mut count) = (Vec3::ZERO, 0.0);
    for axis in 0..3 {
        for side in 0..4 {
            let mut a = [0; 3];
            a[(axis + 1) % 3] = side & 1;
            a[(axis + 2) % 3] = side >> 1;
            let mut b = a;
            b[axis] = 1;
            let (va, vb) = (value(a), value(b));
            if (va < 0.0) != (vb < 0.0) {
                let mut crossing = [a[0] as f32, a[1] as f32, a[2] as f32];
                crossing[axis] = va / (va - vb);
                sum += Vec3::from_array(crossing);
                count += 1.0;
            }
        }
    }
    (count > 0.0).then(|| sum / count)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_net_of_a_ball_is_closed_and_faces_outward() {
        let grid = Grid { low: Vec3::splat(-1.3), high: Vec3::splat(1.3), cell: 0.21 };
        let mesh = surface_nets(&|p: Vec3| p.length() - 1.0, grid);
        assert_eq!(mesh.boundary().unwrap().len(), 0);
        let volume: f32 = mesh
            .triangles
            .iter()
            .map(|t| mesh.positions[t[0] as usize].dot(mesh.normal(t)) / 6.0)
            .sum();
        assert!((volume / (4.0 / 3.0 * std::f32::consts::PI) - 1.0).abs() < 0.06, "{volume}");
    }

    #[test]
    fn boundaries_are_counted() {
        let positions = vec![Vec3::ZERO; 6];
        let two = Mesh { positions: positions.clone(), triangles: vec![[0, 1, 2], [3, 4, 5]] };
        assert_eq!(two.boundary_loops(), Ok(2));
        let twisted = Mesh { positions, triangles: vec![[0, 1, 2], [0, 1, 3]] };
        assert!(twisted.boundary_loops().is_err());
    }
}

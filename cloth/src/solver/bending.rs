//! Bending: a quadratic energy of the positions, flat at rest, the same for x, y and z.
//!
//! The energy is a thin plate's with Poisson's ratio 0 ([`plate`]): `bend/2` times the squared
//! curvature per area, whatever the mesh. It is a sum over patches of up to twelve vertices around
//! each triangle. Forces are taken from it exactly. The implicit system has in its place the form
//! `sum w |K x|^2 / 2` over hinges (K x: edge length times dihedral angle; Bergou et al. 2006,
//! section 4), which couples only vertices of one edge or opposite each other across one: `w` are
//! [`SHARE`] of what bounds the energy from above, so that the form is nowhere less than half of
//! it (over 1/2 is what keeps a step stable), and one to three times as much for smooth bending.

mod plate;

use glam::Vec3A;

use super::matrix::Pattern;
use crate::mesh::Mesh;
use plate::Plate;

/// The system's form is this share of a bound of the energy's Hessian; it must be over a half.
const SHARE: f64 = 0.6;

/// The Hessian of the implicit system, and the exact one for forces. A block is its scalar times
/// the identity.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Stiffness {
    pub(crate) diagonal: Vec<f32>,
    /// For each block of the pattern.
    pub(crate) near: Vec<f32>,
    /// For each far neighbour of the pattern: vertices opposite each other across an edge.
    pub(crate) far: Vec<f32>,
    exact: Exact,
}

/// The exact Hessian without its diagonal (N/m): rows sum to zero with it.
#[derive(Debug, Clone, PartialEq)]
struct Exact {
    starts: Vec<u32>,
    columns: Vec<u32>,
    values: Vec<f32>,
}

impl Stiffness {
    /// Sums over all triangles and hinges.
    pub(crate) fn new(mesh: &Mesh, pattern: &Pattern, bend: f32) -> Self {
        let plate = Plate::new(mesh);
        let bend = f64::from(bend);
        let mut sum = Self {
            diagonal: vec![0.0; mesh.vertex_count()],
            near: vec![0.0; pattern.near.columns.len()],
            far: vec![0.0; pattern.far.columns.len()],
            exact: Exact::new(&plate, bend),
        };
        for (hinge, bound) in mesh.hinges().iter().zip(&plate.hinge_bounds) {
            let k = hinge_weights(mesh, hinge.vertices);
            for i in 0..4 {
                for j in 0..4 {
                    let value = (SHARE * bend * bound * k[i] * k[j]) as f32;
                    let (row, column) = (hinge.vertices[i], hinge.vertices[j]);
                    if i == j {
                        sum.diagonal[row as usize] += value;
                    } else if let Some(slot) = pattern.near.slot(row, column) {
                        sum.near[slot] += value;
                    } else if let Some(slot) = pattern.far.slot(row, column) {
                        sum.far[slot] += value;
                    }
                }
            }
        }
        sum
    }

    /// Adds the forces at positions `x`.
    pub(crate) fn add_forces(&self, _: &Pattern, x: &[Vec3A], forces: &mut [Vec3A]) {
        let exact = &self.exact;
        for (row, force) in forces.iter_mut().enumerate() {
            // Relative to the row's own vertex, which keeps f32 exact enough.
            let own = x[row];
            let mut sum = Vec3A::ZERO;
            let slots = exact.starts[row] as usize..exact.starts[row + 1] as usize;
            for (column, value) in exact.columns[slots.clone()].iter().zip(&exact.values[slots]) {
                sum += (x[*column as usize] - own) * *value;
            }
            *force -= sum;
        }
    }

    /// The energy at positions `x` (J).
    pub(crate) fn energy(&self, x: &[Vec3A]) -> f64 {
        let exact = &self.exact;
        let row = |row: usize| {
            let slots = exact.starts[row] as usize..exact.starts[row + 1] as usize;
            let pairs = exact.columns[slots.clone()].iter().zip(&exact.values[slots]);
            // For rows that sum to zero, x Q x is minus the sum of w |x_i - x_j|^2 over pairs.
            pairs.map(move |(column, w)| {
                -0.25 * f64::from(*w) * f64::from(x[row].distance_squared(x[*column as usize]))
            })
        };
        (0..x.len()).flat_map(row).sum()
    }
}

impl Exact {
    fn new(plate: &Plate, bend: f64) -> Self {
        let mut exact = Self { starts: vec![0], columns: Vec::new(), values: Vec::new() };
        for (row, sum) in plate.rows.iter().enumerate() {
            let largest = sum.iter().map(|(_, value)| value.abs()).fold(0.0, f64::max);
            // What cancels between triangles leaves rounding noise.
            let entries =
                sum.iter().filter(|(c, v)| *c as usize != row && v.abs() > 1e-9 * largest);
            for (column, value) in entries {
                exact.columns.push(*column);
                exact.values.push((bend * value) as f32);
            }
            exact.starts.push(exact.columns.len() as u32);
        }
        exact
    }
}

/// What each vertex of a hinge weighs in edge length times dihedral angle.
fn hinge_weights(mesh: &Mesh, vertices: [u32; 4]) -> [f64; 4] {
    let [a, b, c, d] = vertices.map(|v| mesh.rest_positions()[v as usize]);
    let cot = |u: glam::Vec3, v: glam::Vec3| f64::from(u.dot(v) / u.cross(v).length());
    let (at_a_c, at_b_c) = (cot(b - a, c - a), cot(a - b, c - b));
    let (at_a_d, at_b_d) = (cot(b - a, d - a), cot(a - b, d - b));
    [at_b_c + at_b_d, at_a_c + at_a_d, -at_a_c - at_b_c, -at_a_d - at_b_d]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Vec3;
    use crate::lab::shapes::{Cut, sheet};

    const CUTS: [Cut; 3] = [Cut::Alternating, Cut::Uniform, Cut::Irregular];

    fn stiffness(mesh: &Mesh, bend: f32) -> (Pattern, Stiffness) {
        let pattern = Pattern::new(mesh);
        let stiffness = Stiffness::new(mesh, &pattern, bend);
        (pattern, stiffness)
    }

    /// A sheet of 0.2 m, moved by `shape`.
    fn bent(cut: Cut, shape: impl Fn(f32, f32) -> Vec3) -> (Mesh, Vec<Vec3A>) {
        let mesh = sheet(20, 20, cut, |u, v| Vec3::new(0.2 * u, 0.0, 0.2 * v)).unwrap();
        let x = mesh.rest_positions().iter().map(|p| shape(p.x, p.z).into()).collect();
        (mesh, x)
    }

    #[test]
    fn a_cylinder_in_any_direction_on_any_mesh_has_half_its_squared_curvature_as_energy() {
        let (curvature, bend) = (2.0f32, 1e-3f32);
        for cut in CUTS {
            for turn in [0.0f32, 0.4, 0.785, 1.571, 2.2] {
                let (s, c) = turn.sin_cos();
                let (mesh, x) = bent(cut, |x, z| {
                    let (along, across) = (c * x + s * z, c * z - s * x);
                    let (sine, cosine) = (along * curvature).sin_cos();
                    Vec3::new(across, (1.0 - cosine) / curvature, sine / curvature)
                });
                let (_, stiffness) = stiffness(&mesh, bend);
                let expected = 0.5 * f64::from(bend * curvature * curvature) * 0.04;
                let ratio = stiffness.energy(&x) / expected;
                // Free sides hold no moment across them: a border of half a cell may be relaxed.
                assert!((0.93..1.01).contains(&ratio), "{cut:?} turned by {turn}: {ratio}");
            }
        }
    }

    #[test]
    fn constant_curvature_is_in_equilibrium_inside() {
        for cut in CUTS {
            for k in [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.5, -1.0, 2.0]] {
                let (mesh, x) = bent(cut, |x, z| {
                    Vec3::Y * (0.5 * (k[0] * x * x + k[1] * z * z) + k[2] * x * z)
                });
                let (pattern, stiffness) = stiffness(&mesh, 1.0);
                let mut forces = vec![Vec3A::ZERO; x.len()];
                stiffness.add_forces(&pattern, &x, &mut forces);
                let (mut inner, mut outer) = (0.0f32, 0.0f32);
                for (p, f) in mesh.rest_positions().iter().zip(&forces) {
                    let depth = (p.x.min(0.2 - p.x)).min(p.z.min(0.2 - p.z));
                    let most = if depth > 0.041 { &mut inner } else { &mut outer };
                    *most = most.max(f.length());
                }
                assert!(inner < 0.02 * outer, "{cut:?} {k:?}: {inner} {outer}");
            }
        }
    }

    #[test]
    fn the_systems_form_is_over_half_the_energys_and_near_it_for_smooth_bending() {
        let mut chance = crate::lab::shapes::Chance::new(5);
        for cut in CUTS {
            let (mesh, smooth) = bent(cut, |x, z| Vec3::Y * (20.0 * x + 9.0 * z).sin());
            let (pattern, stiffness) = stiffness(&mesh, 1.0);
            let matrix = |x: &[Vec3A]| -> f64 {
                let pairs = |rows: &super::super::matrix::Rows, values: &[f32]| -> f64 {
                    let row = |i: usize| {
                        rows.row(i).map(move |s| {
                            let d = x[i].distance_squared(x[rows.columns[s] as usize]);
                            -0.25 * f64::from(values[s]) * f64::from(d)
                        })
                    };
                    (0..x.len()).flat_map(row).sum()
                };
                pairs(&pattern.near, &stiffness.near) + pairs(&pattern.far, &stiffness.far)
            };
            let ratio = matrix(&smooth) / stiffness.energy(&smooth);
            assert!((0.9..3.0).contains(&ratio), "{cut:?}: {ratio}");
            for _ in 0..20 {
                let rough: Vec<Vec3A> = smooth.iter().map(|_| Vec3A::Y * chance.signed()).collect();
                assert!(matrix(&rough) > 0.5 * stiffness.energy(&rough), "{cut:?}");
            }
        }
    }

    #[test]
    fn a_flat_sheet_feels_nothing_and_forces_sum_to_zero() {
        for cut in CUTS {
            let turn = glam::Quat::from_rotation_x(0.8) * glam::Quat::from_rotation_z(0.3);
            let (mesh, x) = bent(cut, |x, z| turn * Vec3::new(x, 0.0, z) + Vec3::X);
            let (pattern, stiffness) = stiffness(&mesh, 1e-3);
            let mut forces = vec![Vec3A::ZERO; x.len()];
            stiffness.add_forces(&pattern, &x, &mut forces);
            let largest = forces.iter().map(|f| f.length()).fold(0.0, f32::max);
            // A millimetre off a vertex of this mesh is answered by some newtons.
            assert!(largest < 1e-4, "{cut:?}: {largest}");
            assert!(stiffness.energy(&x).abs() < 1e-7);
        }
    }
}

//! Meshes and bodies of the benches.

use std::sync::Arc;

use glam::{Quat, Vec3};

use crate::body::{Body, Pose, Skeleton};
use crate::mesh::{Mesh, MeshError};
use crate::rigid::Rigid;

/// How the cells of a grid are cut into triangles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cut {
    /// Diagonals in alternate directions.
    Alternating,
    /// All diagonals alike.
    Uniform,
    /// Vertices shifted by up to a quarter of a cell and diagonals by chance, but for the outer
    /// two rows on each side.
    Irregular,
}

/// A sheet of `nx` x `ny` cells; `at` places the unit square (0..=1, 0..=1).
///
/// # Errors
/// A degenerate placement.
pub fn sheet(nx: u32, ny: u32, cut: Cut, at: impl Fn(f32, f32) -> Vec3) -> Result<Mesh, MeshError> {
    let mut chance = Chance::new(u64::from(nx) << 32 | u64::from(ny));
    let mut p = Vec::new();
    for j in 0..=ny {
        for i in 0..=nx {
            let inner = i > 1 && j > 0 && i + 1 < nx && j < ny && cut == Cut::Irregular;
            let mut shift = || if inner { 0.25 * chance.signed() } else { 0.0 };
            let (u, v) = (i as f32 + shift(), j as f32 + shift());
            p.push(at(u / nx as f32, v / ny as f32));
        }
    }
    let v = |i: u32, j: u32| j * (nx + 1) + i;
    let mut t = Vec::new();
    for j in 0..ny {
        for i in 0..nx {
            let (a, b, c, d) = (v(i, j), v(i + 1, j), v(i + 1, j + 1), v(i, j + 1));
            let rising = match cut {
                Cut::Alternating => (i + j) % 2 == 0,
                Cut::Uniform => true,
                Cut::Irregular => chance.signed() > 0.0,
            };
            if rising {
                t.extend([[a, b, c], [a, c, d]]);
            } else {
                t.extend([[a, b, d], [b, c, d]]);
            }
        }
    }
    Mesh::new(p, t)
}

/// A disc in the plane y = 0: rings of triangles of about equal size, with one ring at `inner`.
///
/// # Errors
/// As [`Mesh::new`].
pub fn disc(outer: f32, inner: f32, rings: u32, turn: f32) -> Result<Mesh, MeshError> {
    let within = ((rings as f32 * inner / outer).round() as u32).clamp(1, rings - 1);
    let radius = |r: u32| {
        if r <= within {
            inner * r as f32 / within as f32
        } else {
            inner + (outer - inner) * (r - within) as f32 / (rings - within) as f32
        }
    };
    let mut p = vec![Vec3::ZERO];
    let mut first = vec![0u32];
    for r in 1..=rings {
        first.push(p.len() as u32);
        for k in 0..6 * r {
            let a = turn + std::f32::consts::TAU * k as f32 / (6 * r) as f32;
            p.push(radius(r) * Vec3::new(a.sin(), 0.0, a.cos()));
        }
    }
    let mut t = Vec::new();
    for r in 1..=rings {
        let (inner, outer) = (r - 1, r);
        let at =
            |ring: u32, k: u32| first[ring as usize] + if ring == 0 { 0 } else { k % (6 * ring) };
        for side in 0..6 {
            for k in 0..outer {
                let (i, o) = (side * inner + k, side * outer + k);
                t.push([at(inner, i), at(outer, o), at(outer, o + 1)]);
                if k < inner {
                    t.push([at(inner, i), at(outer, o + 1), at(inner, i + 1)]);
                }
            }
        }
    }
    Mesh::new(p, t)
}

/// Ellipsoids, one per joint, as one closed mesh: (joint's place, half axes).
pub fn ellipsoids(parts: &[(Vec3, Vec3)], rings: u32) -> Arc<Body> {
    let (mut p, mut t, mut joints) = (Vec::new(), Vec::new(), Vec::new());
    for (joint, (center, half)) in parts.iter().enumerate() {
        let first = p.len() as u32;
        let around = 2 * rings;
        p.push(*center + Vec3::Y * half.y);
        for i in 1..rings {
            for j in 0..around {
                let theta = std::f32::consts::PI * i as f32 / rings as f32;
                let phi = std::f32::consts::TAU * j as f32 / around as f32;
                let (s, c) = theta.sin_cos();
                p.push(*center + *half * Vec3::new(s * phi.sin(), c, s * phi.cos()));
            }
        }
        p.push(*center - Vec3::Y * half.y);
        let last = p.len() as u32 - 1;
        let at = |i: u32, j: u32| first + 1 + (i - 1) * around + j % around;
        for j in 0..around {
            t.push([first, at(1, j), at(1, j + 1)]);
            t.push([last, at(rings - 1, j + 1), at(rings - 1, j)]);
            for i in 1..rings - 1 {
                t.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
                t.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
            }
        }
        joints.resize(p.len(), [joint as u16, 0, 0, 0]);
    }
    let places: Vec<Vec3> = parts.iter().map(|(c, _)| *c).collect();
    jointed(&places, p, t, joints)
}

/// A box with its centre at `center`, one joint.
pub fn slab(center: Vec3, half: Vec3) -> Arc<Body> {
    let corner = |k: u32| {
        let side = |bit: u32| if k >> bit & 1 == 1 { 1.0 } else { -1.0 };
        center + half * Vec3::new(side(0), side(1), side(2))
    };
    let p: Vec<Vec3> = (0..8).map(corner).collect();
    let faces =
        [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
    let t = faces.iter().flat_map(|f| [[f[0], f[1], f[2]], [f[0], f[2], f[3]]]).collect();
    jointed(&[center], p, t, vec![[0, 0, 0, 0]; 8])
}

fn jointed(
    places: &[Vec3],
    rest_positions: Vec<Vec3>,
    triangles: Vec<[u32; 3]>,
    joints: Vec<[u16; 4]>,
) -> Arc<Body> {
    let still = |translation| Rigid { rotation: Quat::IDENTITY, translation };
    let skeleton = Skeleton {
        names: (0..places.len()).map(|i| format!("part{i}")).collect(),
        parents: (0..places.len()).map(|i| (i > 0).then_some(0)).collect(),
        offsets: places.iter().map(|c| *c - places[0]).collect(),
        rest: places.iter().map(|c| still(*c)).collect(),
    };
    let weights = vec![[1.0, 0.0, 0.0, 0.0]; rest_positions.len()];
    Arc::new(Body { skeleton, rest_positions, triangles, joints, weights })
}

/// The rest pose with the root at `root`.
pub fn pose_at(body: &Body, root: Vec3) -> Pose {
    Pose { root, ..body.skeleton.rest_pose() }
}

/// Even numbers by chance, the same everywhere (splitmix64).
#[derive(Debug, Clone)]
pub struct Chance(u64);

impl Chance {
    /// Starts a sequence.
    pub fn new(seed: u64) -> Self {
        Self(seed ^ 0x9e37_79b9_7f4a_7c15)
    }

    /// The next number in -1..1.
    pub fn signed(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^= z >> 31;
        (z >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sheets_of_every_cut_have_the_area_of_the_square() {
        for cut in [Cut::Alternating, Cut::Uniform, Cut::Irregular] {
            let mesh = sheet(8, 6, cut, |u, v| Vec3::new(u, 0.0, v)).unwrap();
            assert!((mesh.rest_areas().iter().sum::<f32>() - 1.0).abs() < 1e-5);
            assert_eq!(mesh.vertex_count(), 63);
        }
    }

    #[test]
    fn a_disc_has_its_area_and_a_ring_on_its_support() {
        let mesh = disc(0.15, 0.09, 26, 0.0).unwrap();
        let area: f32 = mesh.rest_areas().iter().sum();
        assert!((area / (std::f32::consts::PI * 0.0225) - 1.0).abs() < 2e-3, "{area}");
        let ring = mesh.rest_positions().iter().filter(|p| (p.length() - 0.09).abs() < 1e-6);
        assert!(ring.count() >= 90);
    }

    #[test]
    fn bodies_are_closed_and_turned_outwards() {
        for body in
            [slab(Vec3::ZERO, Vec3::new(1.0, 0.5, 2.0)), ellipsoids(&[(Vec3::ZERO, Vec3::ONE)], 8)]
        {
            let at = |v: u32| body.rest_positions[v as usize];
            let volume: f32 =
                body.triangles.iter().map(|t| at(t[0]).dot(at(t[1]).cross(at(t[2])))).sum();
            assert!(volume > 0.0);
            Mesh::new(body.rest_positions.clone(), body.triangles.clone()).unwrap();
        }
    }
}

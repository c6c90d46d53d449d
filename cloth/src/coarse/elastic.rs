//! Forces of the membrane, eight triangles at a time.
//!
//! The kernel's own energy (`solver::membrane`) without its strain limit: per rest area
//! `mu sum (s_i - 1)^2 + lambda/2 (s_1 + s_2 - 2)^2`, and springs along warp and weft. Forces need no
//! eigenvectors: with `S = sqrt(F^T F)`, which a 2 x 2 matrix has in closed form, they are `F h(S)`
//! for the function h that takes a stretch s to its tension over s.

use glam::{Mat4, Vec2, Vec3A, Vec4};

use crate::Material;
use crate::mesh::Mesh;
use crate::solver::simd::Task;

const LANES: usize = 8;
/// Over a half, or passes would overshoot and grow; less than 1, or they would creep where the cloth
/// is soft, as it is against being turned.
const SHARE: f32 = 0.6;
/// Smallest stretch that tension is divided by: a collapsed triangle has no direction.
const STRETCH_MIN: f32 = 0.1;

/// Constants of the energy (N/m).
#[derive(Debug, Clone, Copy)]
pub(super) struct Constants {
    mu: f32,
    lambda: f32,
    warp: f32,
    weft: f32,
    shear: f32,
    /// How much of its resistance the cloth has against being compressed.
    compression: f32,
}

/// Eight triangles; the last ones may have no area.
#[derive(Debug, Clone, Copy)]
pub(super) struct Group {
    corners: [[u32; LANES]; 3],
    gradients: [[[f32; LANES]; 2]; 3],
    areas: [f32; LANES],
}

impl Constants {
    pub(super) fn new(material: &Material, compression: f32) -> Self {
        let m = material.membrane();
        let (mu, lambda, warp, weft, shear) = (m.mu, m.lambda, m.warp, m.weft, m.shear);
        Self { mu, lambda, warp, weft, shear, compression }
    }

    /// What the constant matrix has per area (N/m): [`SHARE`] of a bound, since in no direction is
    /// the Hessian above `area * (2 mu + 2 lambda + ...) * g_a . g_b`.
    pub(super) fn stiffness(&self) -> f32 {
        SHARE * (2.0 * (self.mu + self.lambda) + self.warp.max(self.weft) + self.shear)
    }
}

/// Adds the forces (N) of all groups at positions `x` (m).
pub(super) struct Forces<'a> {
    pub(super) groups: &'a [Group],
    pub(super) constants: &'a Constants,
    pub(super) x: &'a [Vec3A],
    pub(super) forces: &'a mut [Vec3A],
}

impl Task for Forces<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        for group in self.groups {
            group.add_forces(self.constants, self.x, self.forces);
        }
    }
}

impl Group {
    pub(super) fn all(mesh: &Mesh) -> Vec<Self> {
        let count = mesh.triangles().len();
        let group = |first: usize| {
            let mut group = Self {
                corners: [[0; LANES]; 3],
                gradients: [[[0.0; LANES]; 2]; 3],
                areas: [0.0; LANES],
            };
            for (lane, t) in (first..count.min(first + LANES)).enumerate() {
                let gradients: [Vec2; 3] = mesh.shape_gradients()[t];
                group.areas[lane] = mesh.rest_areas()[t];
                for (corner, gradient) in gradients.iter().enumerate() {
                    group.corners[corner][lane] = mesh.triangles()[t][corner];
                    group.gradients[corner][0][lane] = gradient.x;
                    group.gradients[corner][1][lane] = gradient.y;
                }
            }
            group
        };
        (0..count.div_ceil(LANES)).map(|g| group(g * LANES)).collect()
    }

    /// Adds the forces (N) at positions `x` (m).
    #[inline(always)]
    fn add_forces(&self, c: &Constants, x: &[Vec3A], forces: &mut [Vec3A]) {
        let mut f = [[[0.0f32; LANES]; 3]; 2];
        for (corners, gradients) in self.corners.iter().zip(&self.gradients) {
            let mut at = [[0.0f32; LANES]; 3];
            for (half, four) in corners.as_chunks::<4>().0.iter().enumerate() {
                let [a, b, c, d] = four.map(|vertex| Vec4::from((x[vertex as usize], 0.0)));
                // Through registers: lanes written one by one could not be read as a vector at once.
                let turned = Mat4::from_cols(a, b, c, d).transpose();
                for (at, axis) in at.iter_mut().zip([turned.x_axis, turned.y_axis, turned.z_axis]) {
                    at[4 * half..][..4].copy_from_slice(&axis.to_array());
                }
            }
            for (f, gradient) in f.iter_mut().zip(gradients) {
                for (f, at) in f.iter_mut().zip(&at) {
                    for lane in 0..LANES {
                        f[lane] += at[lane] * gradient[lane];
                    }
                }
            }
        }
        let push = self.tensions(c, &f);
        for (corners, gradients) in self.corners.iter().zip(&self.gradients) {
            let mut force = [[0.0f32; LANES]; 3];
            for (force, (p1, p2)) in force.iter_mut().zip(push[0].iter().zip(&push[1])) {
                for lane in 0..LANES {
                    force[lane] = p1[lane] * gradients[0][lane] + p2[lane] * gradients[1][lane];
                }
            }
            for (half, four) in corners.as_chunks::<4>().0.iter().enumerate() {
                let axis = |axis: usize| Vec4::from_slice(&force[axis][4 * half..]);
                let turned = Mat4::from_cols(axis(0), axis(1), axis(2), Vec4::ZERO).transpose();
                let all = [turned.x_axis, turned.y_axis, turned.z_axis, turned.w_axis];
                for (vertex, force) in four.iter().zip(all) {
                    forces[*vertex as usize] -= Vec3A::from_vec4(force);
                }
            }
        }
    }

    /// Derivative of each triangle's energy by the columns of its deformation gradient (N m).
    #[inline(always)]
    fn tensions(&self, c: &Constants, f: &[[[f32; LANES]; 3]; 2]) -> [[[f32; LANES]; 3]; 2] {
        let mut push = [[[0.0f32; LANES]; 3]; 2];
        for lane in 0..LANES {
            let [a, b] = [0, 1].map(|i| [f[i][0][lane], f[i][1][lane], f[i][2][lane]]);
            let dot = |u: [f32; 3], v: [f32; 3]| u[0] * v[0] + u[1] * v[1] + u[2] * v[2];
            let (c11, c22, c12) = (dot(a, a), dot(b, b), dot(a, b));
            let root = (c11 * c22 - c12 * c12).max(0.0).sqrt();
            let trace = (c11 + c22 + 2.0 * root).max(1e-12).sqrt();
            let (s11, s22, s12) = ((c11 + root) / trace, (c22 + root) / trace, c12 / trace);
            let half = (0.25 * trace * trace - root).max(0.0).sqrt();
            let (s1, s2) = (0.5 * trace + half, 0.5 * trace - half);
            let softer = |strain: f32| strain.max(0.0) + c.compression * strain.min(0.0);
            let common = c.lambda * softer(s1 + s2 - 2.0);
            let (s1, s2) = (s1.max(STRETCH_MIN), s2.max(STRETCH_MIN));
            let h1 = (2.0 * c.mu * softer(s1 - 1.0) + common) / s1;
            let h2 = (2.0 * c.mu * softer(s2 - 1.0) + common) / s2;
            let apart = s1 - s2;
            let slope = if apart > 1e-3 { (h1 - h2) / apart.max(1e-3) } else { 0.0 };
            let base = h2 - slope * s2;
            // Springs along warp and weft, and the angle between both.
            let (w, v) = (c11.sqrt().max(STRETCH_MIN), c22.sqrt().max(STRETCH_MIN));
            let cosine = c12 / (w * v);
            let along = c.warp * softer(w - 1.0) / w - c.shear * cosine * cosine / (w * w);
            let across = c.weft * softer(v - 1.0) / v - c.shear * cosine * cosine / (v * v);
            let turn = slope * s12 + c.shear * cosine / (w * v);
            let (p11, p22) = (base + slope * s11 + along, base + slope * s22 + across);
            let area = self.areas[lane];
            for axis in 0..3 {
                push[0][axis][lane] = area * (a[axis] * p11 + b[axis] * turn);
                push[1][axis][lane] = area * (a[axis] * turn + b[axis] * p22);
            }
        }
        push
    }
}

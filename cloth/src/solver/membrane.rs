//! Stretch and shear: an isotropic energy of the two principal stretches of each triangle, and
//! what an orthotropic cloth has besides along warp and weft.
//!
//! Per rest area `mu sum (s_i - 1)^2 + lambda/2 (s_1 + s_2 - 2)^2`, and past `SOFT_STRAIN` a
//! stiffer term: the strain limit. The Hessian in the space of the deformation gradient has known
//! eigenvectors (Kim & Eberle 2022, "Dynamic Deformables", chapter 7, here for 3 x 2): scaling,
//! twist, flip, and two turns out of the plane. Negative eigenvalues are set to zero.
//!
//! The orthotropic part is `k1/2 (|w| - 1)^2 + k2/2 (|f| - 1)^2 + k12/2 cos^2(w, f)`, with w and f
//! the images of warp and weft: springs as in Baraff & Witkin 1998, section 4, with the shear by its
//! angle, so that it does not grow with stretch. Springs keep their tension's positive part, the
//! shear its Gauss-Newton part.

use glam::{Mat3A, Vec2, Vec3A};

use super::matrix::{Matrix, Pattern};
use crate::material::MembraneStiffness;
use crate::mesh::Mesh;

/// Principal strain from which a triangle stiffens.
pub(crate) const SOFT_STRAIN: f32 = 0.05;
/// How much stiffer than Young's modulus the limit is.
pub(crate) const LIMIT_FACTOR: f32 = 10.0;

/// Where forces and their slopes are summed.
pub(crate) struct Sums<'a> {
    pub(crate) forces: &'a mut [Vec3A],
    pub(crate) matrix: &'a mut Matrix,
}

/// Constants of the energy (N/m).
#[derive(Debug, Clone, Copy)]
pub(crate) struct Constants {
    sum: MembraneStiffness,
    orthotropic: bool,
    limit: f32,
}

impl Constants {
    /// From a material's stiffnesses.
    pub(crate) fn new(material: &crate::Material) -> Self {
        let sum = material.membrane();
        let stiffest = material.weft.map_or(material.stretch, |weft| weft.max(material.stretch));
        let orthotropic = sum.warp.max(sum.weft).max(sum.shear) > 0.0;
        Self { sum, orthotropic, limit: LIMIT_FACTOR * stiffest }
    }
}

/// Adds each triangle's forces, and its Hessian times `scale`.
pub(crate) fn assemble(
    mesh: &Mesh,
    pattern: &Pattern,
    constants: Constants,
    scale: f32,
    x: &[Vec3A],
    sums: Sums<'_>,
) {
    let Sums { forces, matrix } = sums;
    let shapes = mesh.shape_gradients().iter().zip(mesh.rest_areas());
    for ((t, (gradients, area)), places) in
        mesh.triangles().iter().zip(shapes).zip(&pattern.triangle_places)
    {
        let [i, j, k] = t.map(|v| v as usize);
        let e = Element::new([x[i], x[j], x[k]], gradients);
        let (push, modes) = e.respond(constants);
        let beta = gradients.map(|g| Vec2::new(e.v1.dot(g), e.v1.perp().dot(g)));
        for (v, b) in [i, j, k].into_iter().zip(&beta) {
            forces[v] -= (e.u1 * (push.x * b.x) + e.u2 * (push.y * b.y)) * *area;
        }
        let block = |a: usize, b: usize| e.block(&modes, beta[a], beta[b], area * scale);
        let (mut h01, mut h02, mut h12) = (block(0, 1), block(0, 2), block(1, 2));
        if constants.orthotropic {
            let axes = Axes::new([x[i], x[j], x[k]], gradients, &constants.sum);
            for (v, g) in [i, j, k].into_iter().zip(gradients) {
                forces[v] -= axes.push(*g) * *area;
            }
            let [g0, g1, g2] = *gradients;
            h01 += axes.block(g0, g1) * (area * scale);
            h02 += axes.block(g0, g2) * (area * scale);
            h12 += axes.block(g1, g2) * (area * scale);
        }
        for (place, h) in places.iter().zip([&h01, &h02, &h12]) {
            matrix.add(*place, h);
        }
        let (h10, h20, h21) = (h01.transpose(), h02.transpose(), h12.transpose());
        // A shift of the whole triangle costs nothing: rows sum to zero.
        matrix.diagonal[i] -= h01 + h02;
        matrix.diagonal[j] -= h10 + h12;
        matrix.diagonal[k] -= h20 + h21;
    }
}

/// A triangle's deformation: principal directions in space and in the rest plane, stretches.
struct Element {
    u1: Vec3A,
    u2: Vec3A,
    normal: Vec3A,
    v1: Vec2,
    stretch: Vec2,
}

/// Eigenvalues of the Hessian, in pairs of coordinates `g_ij = u_i . dF v_j`.
struct Modes {
    s11: f32,
    s22: f32,
    s12: f32,
    /// g12 and g21 with themselves, and with each other.
    same: f32,
    cross: f32,
    out: Vec2,
}

impl Element {
    fn new(x: [Vec3A; 3], g: &[Vec2; 3]) -> Self {
        let f1 = x[0] * g[0].x + x[1] * g[1].x + x[2] * g[2].x;
        let f2 = x[0] * g[0].y + x[1] * g[1].y + x[2] * g[2].y;
        let (c11, c22, c12) = (f1.dot(f1), f2.dot(f2), f1.dot(f2));
        let (mean, half) = (0.5 * (c11 + c22), 0.5 * (c11 - c22));
        let radius = (half * half + c12 * c12).sqrt();
        // The eigenvector of the larger eigenvalue, from whichever form does not cancel.
        let v1 =
            if half >= 0.0 { Vec2::new(radius + half, c12) } else { Vec2::new(c12, radius - half) };
        let v1 = v1.try_normalize().unwrap_or(Vec2::X);
        let s1 = (mean + radius).sqrt().max(1e-4);
        let cross = f1.cross(f2);
        let s2 = cross.length() / s1;
        let u1 = ((f1 * v1.x + f2 * v1.y) / s1).try_normalize().unwrap_or(Vec3A::X);
        // Collapsed to a line there is no normal; any will do.
        let across = cross - u1 * cross.dot(u1);
        let normal = across.try_normalize().unwrap_or_else(|| u1.any_orthonormal_vector());
        Self { u1, u2: normal.cross(u1), normal, v1, stretch: Vec2::new(s1, s2.max(1e-4)) }
    }

    /// Derivatives of the energy by the stretches, and the projected Hessian.
    fn respond(&self, c: Constants) -> (Vec2, Modes) {
        let s = self.stretch;
        let over = (s - Vec2::splat(1.0 + SOFT_STRAIN)).max(Vec2::ZERO);
        let (mu, lambda) = (c.sum.mu, c.sum.lambda);
        let trace = lambda * (s.x + s.y - 2.0);
        let push = (s - 1.0) * (2.0 * mu) + trace + over * c.limit;
        let stiff = |over: f32| if over > 0.0 { c.limit } else { 0.0 };
        let (k1, k2) = (stiff(over.x), stiff(over.y));
        let difference = s.x - s.y;
        let flip = if difference > 1e-4 {
            2.0 * mu + c.limit * (over.x - over.y) / difference
        } else {
            2.0 * mu + k1
        };
        let twist = ((push.x + push.y) / (s.x + s.y)).max(0.0);
        let modes = Modes {
            s11: 2.0 * mu + lambda + k1,
            s22: 2.0 * mu + lambda + k2,
            s12: lambda,
            same: 0.5 * (twist + flip),
            cross: 0.5 * (flip - twist),
            out: (push / s).max(Vec2::ZERO),
        };
        (push, modes)
    }

    fn block(&self, m: &Modes, a: Vec2, b: Vec2, scale: f32) -> Mat3A {
        let (a, xx, yy) = (a * scale, b.x, b.y);
        let h11 = m.s11 * a.x * xx + m.same * a.y * yy;
        let h22 = m.s22 * a.y * yy + m.same * a.x * xx;
        let h12 = m.s12 * a.x * yy + m.cross * a.y * xx;
        let h21 = m.s12 * a.y * xx + m.cross * a.x * yy;
        let hnn = m.out.x * a.x * xx + m.out.y * a.y * yy;
        let w1 = self.u1 * h11 + self.u2 * h12;
        let w2 = self.u1 * h21 + self.u2 * h22;
        let wn = self.normal * hnn;
        let column = |j: usize| self.u1 * w1[j] + self.u2 * w2[j] + self.normal * wn[j];
        Mat3A::from_cols(column(0), column(1), column(2))
    }
}

/// A triangle's orthotropic part: warp and weft in space, and their Hessians.
struct Axes {
    push: [Vec3A; 2],
    springs: [Mat3A; 2],
    /// Slopes of the cosine between warp and weft, times the root of the shear stiffness.
    slopes: [Vec3A; 2],
}

impl Axes {
    fn new(x: [Vec3A; 3], g: &[Vec2; 3], k: &MembraneStiffness) -> Self {
        let image = |of: fn(&Vec2) -> f32| {
            let f = x[0] * of(&g[0]) + x[1] * of(&g[1]) + x[2] * of(&g[2]);
            let length = f.length().max(1e-4);
            (f / length, length)
        };
        let (warp, weft) = (image(|g| g.x), image(|g| g.y));
        let spring = |(n, length): (Vec3A, f32), k: f32| {
            let along = Mat3A::from_cols(n * n.x, n * n.y, n * n.z);
            let turn = (1.0 - 1.0 / length).max(0.0);
            (n * (k * (length - 1.0)), along * (k * (1.0 - turn)) + Mat3A::IDENTITY * (k * turn))
        };
        let ((push1, spring1), (push2, spring2)) = (spring(warp, k.warp), spring(weft, k.weft));
        let (n1, n2) = (warp.0, weft.0);
        let cosine = n1.dot(n2);
        let root = k.shear.sqrt();
        // Where a side has collapsed, its angle says little.
        let slopes = [
            (n2 - n1 * cosine) * (root / warp.1.max(0.2)),
            (n1 - n2 * cosine) * (root / weft.1.max(0.2)),
        ];
        let shear = root * cosine;
        let push = [push1 + slopes[0] * shear, push2 + slopes[1] * shear];
        Self { push, springs: [spring1, spring2], slopes }
    }

    fn push(&self, g: Vec2) -> Vec3A {
        self.push[0] * g.x + self.push[1] * g.y
    }

    fn block(&self, a: Vec2, b: Vec2) -> Mat3A {
        let left = self.slopes[0] * a.x + self.slopes[1] * a.y;
        let right = self.slopes[0] * b.x + self.slopes[1] * b.y;
        self.springs[0] * (a.x * b.x)
            + self.springs[1] * (a.y * b.y)
            + Mat3A::from_cols(left * right.x, left * right.y, left * right.z)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Material, Vec3};

    fn triangle() -> Mesh {
        let rest = vec![Vec3::ZERO, Vec3::X, Vec3::new(0.3, 0.8, 0.0)];
        Mesh::new(rest, vec![[0, 1, 2]]).unwrap()
    }

    fn cloths() -> [Material; 2] {
        let plain = Material::default();
        [plain, Material { stretch: 300.0, weft: Some(1000.0), shear: 300.0, ..plain }]
    }

    fn at(mesh: &Mesh, x: &[Vec3A], material: &Material) -> (Vec<Vec3A>, Matrix) {
        let pattern = Pattern::new(mesh);
        let mut forces = vec![Vec3A::ZERO; 3];
        let mut matrix = Matrix::default();
        matrix.size(&pattern);
        let c = Constants::new(material);
        let sums = Sums { forces: &mut forces, matrix: &mut matrix };
        assemble(mesh, &pattern, c, 1.0, x, sums);
        matrix.mirror(&pattern);
        (forces, matrix)
    }

    #[test]
    fn the_hessian_is_the_slope_of_the_forces_where_it_is_positive() {
        // Stretched in both directions (no eigenvalue is cut off), once past the limit.
        for (grow, material) in [(1.03, &cloths()[0]), (1.2, &cloths()[0]), (1.03, &cloths()[1])] {
            let mesh = triangle();
            let pattern = Pattern::new(&mesh);
            let turn = glam::Quat::from_rotation_x(0.7);
            let x: Vec<Vec3A> =
                mesh.rest_positions().iter().map(|p| Vec3A::from(turn * (*p * grow))).collect();
            let (_, matrix) = at(&mesh, &x, material);
            let step = 1e-3;
            for axis in 0..9 {
                let mut d = vec![Vec3A::ZERO; 3];
                d[axis / 3][axis % 3] = step;
                let moved = |sign: f32| -> Vec<Vec3A> {
                    x.iter().zip(&d).map(|(x, d)| *x + *d * sign).collect()
                };
                let f1 = at(&mesh, &moved(1.0), material).0;
                let f0 = at(&mesh, &moved(-1.0), material).0;
                let mut predicted = vec![Vec3A::ZERO; 3];
                matrix.multiply(&pattern, &d, &mut predicted);
                for v in 0..3 {
                    let slope = (f0[v] - f1[v]) * 0.5;
                    let error = (slope - predicted[v]).length();
                    assert!(error < 0.02 * step * 1000.0, "{grow} {axis} {v}: {error}");
                }
            }
        }
    }

    #[test]
    fn warp_weft_and_shear_answer_each_with_their_own_stiffness() {
        let [_, material] = cloths();
        let material = Material { shear: 40.0, ..material };
        let rest = vec![Vec3::ZERO, Vec3::X, Vec3::X + Vec3::Y, Vec3::Y];
        let mesh = Mesh::new(rest, vec![[0, 1, 2], [0, 2, 3]]).unwrap().with_grain(Vec3::X);
        let strain = 1e-3f32;
        // Force on the side x = 1 (or y = 1), along the given axis, of a square deformed so.
        let force = |moved: fn(Vec3, f32) -> Vec3, side: [usize; 2], axis: usize| {
            let x: Vec<Vec3A> =
                mesh.rest_positions().iter().map(|p| moved(*p, strain).into()).collect();
            let pattern = Pattern::new(&mesh);
            let mut forces = vec![Vec3A::ZERO; 4];
            let mut matrix = Matrix::default();
            matrix.size(&pattern);
            let sums = Sums { forces: &mut forces, matrix: &mut matrix };
            assemble(&mesh, &pattern, Constants::new(&material), 1.0, &x, sums);
            -(forces[side[0]] + forces[side[1]])[axis] / strain
        };
        let warp = force(|p, s| p + Vec3::X * (p.x * s), [1, 2], 0);
        let weft = force(|p, s| p + Vec3::Y * (p.y * s), [2, 3], 1);
        let shear = force(|p, s| p + Vec3::X * (p.y * s), [2, 3], 0);
        for (found, wanted) in [(warp, 300.0), (weft, 1000.0), (shear, 40.0)] {
            assert!((found / wanted - 1.0).abs() < 0.01, "{found} for {wanted}");
        }
    }

    #[test]
    fn a_turned_or_shifted_triangle_feels_nothing() {
        let mesh = triangle();
        let turn = glam::Quat::from_rotation_z(2.0) * glam::Quat::from_rotation_x(1.0);
        let x: Vec<Vec3A> =
            mesh.rest_positions().iter().map(|p| Vec3A::from(turn * *p + Vec3::Y)).collect();
        for material in cloths() {
            assert!(at(&mesh, &x, &material).0.iter().all(|f| f.length() < 1e-3));
        }
    }

    #[test]
    fn any_shape_even_a_collapsed_one_has_a_positive_finite_hessian() {
        let mesh = triangle();
        let pattern = Pattern::new(&mesh);
        let shapes = [
            [Vec3A::ZERO, Vec3A::ZERO, Vec3A::ZERO],
            [Vec3A::ZERO, Vec3A::X, Vec3A::X * 0.5],
            [Vec3A::ZERO, Vec3A::X * 0.2, Vec3A::Y * 0.1],
            [Vec3A::ZERO, Vec3A::X * -3.0, Vec3A::Z * 2.0],
        ];
        for (x, material) in shapes.iter().flat_map(|x| cloths().map(|m| (x, m))) {
            let (forces, matrix) = at(&mesh, x, &material);
            assert!(forces.iter().all(|f| f.is_finite()));
            for i in 0..200 {
                let part = |k: i32| ((i * 37 + k * 11) % 17) as f32 - 8.0;
                let d: Vec<Vec3A> =
                    (0..3).map(|v| Vec3A::new(part(v), part(v + 5), part(v + 9))).collect();
                let mut ad = d.clone();
                matrix.multiply(&pattern, &d, &mut ad);
                let energy: f32 = d.iter().zip(&ad).map(|(a, b)| a.dot(*b)).sum();
                assert!(energy.is_finite() && energy > -0.1, "{energy}");
            }
        }
    }
}

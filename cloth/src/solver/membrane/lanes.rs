//! Eight triangles side by side: the same arithmetic as one by one, lane by lane, to the bit.

use glam::{Mat3A, Vec2, Vec3A};

use super::{Constants, PAIRS, SOFT_STRAIN};
use crate::solver::simd::Task;
use crate::wide::Lanes;

type Vectors = [Lanes; 3];

/// What eight triangles are told.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Eight {
    corners: [Vectors; 3],
    gradients: [[Lanes; 2]; 3],
    areas: Lanes,
}

/// What they answer.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Answer {
    /// What is taken from the corners' forces (N).
    pushes: [Vectors; 3],
    /// The Hessians between corners 0 and 1, 0 and 2, 1 and 2, column by column (N/m).
    blocks: [[Lanes; 9]; 3],
    /// Where a lane is no number, the triangle has collapsed, and is to be asked by itself.
    sound: Lanes,
}

impl Eight {
    pub(crate) const NONE: Self = Self {
        corners: [[Lanes::splat(0.0); 3]; 3],
        gradients: [[Lanes::splat(0.0); 2]; 3],
        areas: Lanes::splat(0.0),
    };

    pub(crate) fn set(&mut self, lane: usize, x: [Vec3A; 3], gradients: &[Vec2; 3], area: f32) {
        for corner in 0..3 {
            let (x, g) = (x[corner].to_array(), gradients[corner].to_array());
            (0..3).for_each(|k| self.corners[corner][k].0[lane] = x[k]);
            (0..2).for_each(|k| self.gradients[corner][k].0[lane] = g[k]);
        }
        self.areas.0[lane] = area;
    }
}

impl Answer {
    pub(crate) const NONE: Self = Self {
        pushes: [[Lanes::splat(0.0); 3]; 3],
        blocks: [[Lanes::splat(0.0); 9]; 3],
        sound: Lanes::splat(0.0),
    };

    pub(crate) fn is_sound(&self, lane: usize) -> bool {
        self.sound.0[lane].is_finite()
    }

    pub(crate) fn push(&self, corner: usize, lane: usize) -> Vec3A {
        Vec3A::from_array(self.pushes[corner].map(|part| part.0[lane]))
    }

    pub(crate) fn block(&self, pair: usize, lane: usize) -> Mat3A {
        Mat3A::from_cols_array(&self.blocks[pair].map(|part| part.0[lane]))
    }
}

/// Asks eight triangles at once.
pub(crate) struct Ask<'a> {
    pub(crate) eight: &'a Eight,
    pub(crate) constants: Constants,
    pub(crate) scale: f32,
    pub(crate) answer: &'a mut Answer,
}

impl Task for Ask<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { eight, constants, scale, answer } = self;
        let e = Element::new(eight);
        let m = e.respond(&constants);
        let beta = eight.gradients.map(|[x, y]| {
            [e.v1[0] * x + e.v1[1] * y, (Lanes::splat(0.0) - e.v1[1]) * x + e.v1[0] * y]
        });
        for (push, b) in answer.pushes.iter_mut().zip(&beta) {
            let (p, q) = (m.push[0] * b[0], m.push[1] * b[1]);
            *push = times(plus(times(e.u1, p), times(e.u2, q)), eight.areas);
        }
        let scale = eight.areas * Lanes::splat(scale);
        for (block, [a, b]) in answer.blocks.iter_mut().zip(PAIRS) {
            *block = e.block(&m, beta[a], beta[b], scale);
        }
        answer.sound = e.sound;
    }
}

/// As [`super::Element`].
struct Element {
    u1: Vectors,
    u2: Vectors,
    normal: Vectors,
    v1: [Lanes; 2],
    stretch: [Lanes; 2],
    sound: Lanes,
}

/// As [`super::Modes`], and the derivatives of the energy by the stretches.
struct Modes {
    push: [Lanes; 2],
    s11: Lanes,
    s22: Lanes,
    s12: Lanes,
    same: Lanes,
    cross: Lanes,
    out: [Lanes; 2],
}

impl Element {
    #[inline(always)]
    fn new(eight: &Eight) -> Self {
        let ([x0, x1, x2], [g0, g1, g2]) = (eight.corners, eight.gradients);
        let f = |k: usize| plus(plus(times(x0, g0[k]), times(x1, g1[k])), times(x2, g2[k]));
        let (f1, f2) = (f(0), f(1));
        let (c11, c22, c12) = (dot(f1, f1), dot(f2, f2), dot(f1, f2));
        let half_of = Lanes::splat(0.5);
        let (mean, half) = (half_of * (c11 + c22), half_of * (c11 - c22));
        let radius = (half * half + c12 * c12).sqrt();
        let v1 = [half.choose(radius + half, c12), half.choose(c12, radius - half)];
        let one = Lanes::splat(1.0);
        let over = one / (v1[0] * v1[0] + v1[1] * v1[1]).sqrt();
        let v1 = [v1[0] * over, v1[1] * over];
        let s1 = (mean + radius).sqrt().max(Lanes::splat(1e-4));
        let cross = cross(f1, f2);
        let s2 = dot(cross, cross).sqrt() / s1;
        let u1 = plus(times(f1, v1[0]), times(f2, v1[1])).map(|part| part / s1);
        let over1 = one / dot(u1, u1).sqrt();
        let u1 = times(u1, over1);
        let along = dot(cross, u1);
        let across = [0, 1, 2].map(|k| cross[k] - u1[k] * along);
        let over2 = one / dot(across, across).sqrt();
        let normal = times(across, over2);
        let u2 = self::cross(normal, u1);
        let stretch = [s1, s2.max(Lanes::splat(1e-4))];
        Self { u1, u2, normal, v1, stretch, sound: over + over1 + over2 }
    }

    #[inline(always)]
    fn respond(&self, c: &Constants) -> Modes {
        let zero = Lanes::splat(0.0);
        let [sx, sy] = self.stretch;
        let soft = Lanes::splat(1.0 + SOFT_STRAIN);
        let (ox, oy) = ((sx - soft).max(zero), (sy - soft).max(zero));
        let two_mu = Lanes::splat(2.0 * c.sum.mu);
        let (lambda, limit) = (Lanes::splat(c.sum.lambda), Lanes::splat(c.limit));
        let trace = lambda * (sx + sy - Lanes::splat(2.0));
        let push = |s: Lanes, over: Lanes| (s - Lanes::splat(1.0)) * two_mu + trace + over * limit;
        let (px, py) = (push(sx, ox), push(sy, oy));
        let (k1, k2) = (ox.choose_over(0.0, limit, zero), oy.choose_over(0.0, limit, zero));
        let difference = sx - sy;
        let apart = two_mu + limit * (ox - oy) / difference;
        let flip = difference.choose_over(1e-4, apart, two_mu + k1);
        let twist = ((px + py) / (sx + sy)).max(zero);
        let half = Lanes::splat(0.5);
        Modes {
            push: [px, py],
            s11: two_mu + lambda + k1,
            s22: two_mu + lambda + k2,
            s12: lambda,
            same: half * (twist + flip),
            cross: half * (flip - twist),
            out: [(px / sx).max(zero), (py / sy).max(zero)],
        }
    }

    #[inline(always)]
    fn block(&self, m: &Modes, a: [Lanes; 2], b: [Lanes; 2], scale: Lanes) -> [Lanes; 9] {
        let ([ax, ay], [xx, yy]) = (a.map(|a| a * scale), b);
        let h11 = m.s11 * ax * xx + m.same * ay * yy;
        let h22 = m.s22 * ay * yy + m.same * ax * xx;
        let h12 = m.s12 * ax * yy + m.cross * ay * xx;
        let h21 = m.s12 * ay * xx + m.cross * ax * yy;
        let hnn = m.out[0] * ax * xx + m.out[1] * ay * yy;
        let w1 = plus(times(self.u1, h11), times(self.u2, h12));
        let w2 = plus(times(self.u1, h21), times(self.u2, h22));
        let wn = times(self.normal, hnn);
        let mut block = [Lanes::splat(0.0); 9];
        for (j, column) in block.chunks_exact_mut(3).enumerate() {
            for (k, value) in column.iter_mut().enumerate() {
                *value = self.u1[k] * w1[j] + self.u2[k] * w2[j] + self.normal[k] * wn[j];
            }
        }
        block
    }
}

#[inline(always)]
fn plus(a: Vectors, b: Vectors) -> Vectors {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

#[inline(always)]
fn times(a: Vectors, b: Lanes) -> Vectors {
    [a[0] * b, a[1] * b, a[2] * b]
}

#[inline(always)]
fn dot(a: Vectors, b: Vectors) -> Lanes {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
fn cross(a: Vectors, b: Vectors) -> Vectors {
    [a[1] * b[2] - b[1] * a[2], a[2] * b[0] - b[2] * a[0], a[0] * b[1] - b[0] * a[1]]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Material;
    use crate::lab::shapes::Chance;
    use crate::solver::simd;
    use crate::wide::WIDE;

    #[test]
    fn eight_triangles_answer_as_each_by_itself_to_the_bit() {
        let mut chance = Chance::new(23);
        let constants = Constants::new(&Material::default());
        for round in 0..200 {
            let mut by_chance = || Vec3A::from_array(std::array::from_fn(|_| chance.signed()));
            let (mut eight, mut all) = (Eight::NONE, Vec::new());
            for lane in 0..WIDE {
                let mut x = [by_chance(), by_chance(), by_chance()];
                if lane == round % 20 {
                    x[2] = x[0];
                }
                let g = [by_chance(), by_chance()].map(|v| Vec2::new(v.x, v.y));
                let g = [g[0], g[1], -g[0] - g[1]];
                eight.set(lane, x, &g, 0.3);
                all.push((x, g));
            }
            let mut answer = Answer::NONE;
            let (eight, scale) = (&eight, 1.7);
            simd::run(Ask { eight, constants, scale, answer: &mut answer });
            for (lane, (x, g)) in all.into_iter().enumerate() {
                if !answer.is_sound(lane) {
                    assert_eq!(lane, round % 20, "only a collapsed triangle is unsound");
                    continue;
                }
                let e = super::super::Element::new(x, &g);
                let (push, modes) = e.respond(constants);
                let beta = g.map(|g| Vec2::new(e.v1.dot(g), e.v1.perp().dot(g)));
                for (corner, b) in beta.iter().enumerate() {
                    let wanted = (e.u1 * (push.x * b.x) + e.u2 * (push.y * b.y)) * 0.3;
                    assert_eq!(answer.push(corner, lane), wanted);
                }
                for (pair, [a, b]) in PAIRS.into_iter().enumerate() {
                    let wanted = e.block(&modes, beta[a], beta[b], 0.3 * 1.7);
                    assert_eq!(answer.block(pair, lane), wanted);
                }
            }
        }
    }
}

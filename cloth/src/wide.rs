//! Eight boxes, triangles or pairs of segments side by side: distances of all of them at once.
//!
//! Safe loops over lanes, which [`crate::solver::simd`] compiles for each instruction set; every
//! lane does the same operations in the same order, so all give the same bits.

use std::ops::{Add, Div, Mul, Sub};

use glam::{Mat4, Vec3A, Vec4};

/// How many lie side by side.
pub(crate) const WIDE: usize = 8;
/// What lanes hold that nothing was set in: far from everything (m).
const FAR_M: f32 = 1e15;
/// How much nearer a triangle may be than its lane says: a share of the squared distance, and m^2.
const DOUBT: (f32, f32) = (1e-3, 1e-8);
/// A triangle whose squared area is less than this share of that of its sides' square has no
/// inside worth a look.
const SLIVER: f32 = 1e-6;

/// A number for each lane. Each operation is a loop of its own over the lanes, which compilers
/// turn into one instruction.
#[derive(Debug, Clone, Copy)]
#[repr(align(32))]
pub(crate) struct Lanes(pub(crate) [f32; WIDE]);

/// Boxes: x, y, z of the low corners, then of the high ones (m).
#[derive(Debug, Clone, Copy)]
pub(crate) struct Boxes([Lanes; 6]);

/// Triangles: x, y, z of the first corners, the second and the third ones (m).
#[derive(Debug, Clone, Copy)]
pub(crate) struct Corners([Lanes; 9]);

/// A vector for each lane.
type Vectors = [Lanes; 3];

/// Vertices and faces, or two edges each, that move: four vertices side by side.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Movers {
    at: [Vectors; 4],
    way: [Vectors; 4],
}

impl Movers {
    /// All at the origin.
    pub(crate) const NOWHERE: Self =
        Self { at: [[Lanes::splat(0.0); 3]; 4], way: [[Lanes::splat(0.0); 3]; 4] };

    /// Sets all lanes, by the four vertices of each, that begin at `at` and go by `way` (m).
    pub(crate) fn set(&mut self, vertices: &[[u32; 4]; WIDE], at: &[Vec3A], way: &[Vec3A]) {
        for k in 0..4 {
            set_lanes(&mut self.at[k], vertices.map(|v| at[v[k] as usize]));
            set_lanes(&mut self.way[k], vertices.map(|v| way[v[k] as usize]));
        }
    }

    /// Bit by bit the lanes in which a vertex and a face, or two edges, may come within `reach` (m) of
    /// each other: as far as they are apart, less the largest difference of their ways.
    #[inline(always)]
    pub(crate) fn may_meet(&self, edges: bool, reach: f32) -> u32 {
        let ([p, q, r, s], [t, u, v, w]) = (self.at, self.way);
        let one = apart2(t, v).max(apart2(t, w));
        let (distance2, relative2) = if edges {
            let relative2 = one.max(apart2(u, v)).max(apart2(u, w));
            (segment_distances2([p, q], [r, s]), relative2)
        } else {
            (face_distances2([q, r, s], p), one.max(apart2(t, u)))
        };
        let most = Lanes::splat(reach) + relative2.sqrt();
        let most2 = most * most;
        let doubtless = most2 + (most2 * Lanes::splat(DOUBT.0) + Lanes::splat(DOUBT.1));
        (distance2 - doubtless).below(0.0)
    }
}

fn set_lanes(out: &mut Vectors, of: [Vec3A; WIDE]) {
    for (half, four) in of.chunks_exact(WIDE / 2).enumerate() {
        let column = |k: usize| Vec4::from((four[k], 0.0));
        let rows = Mat4::from_cols(column(0), column(1), column(2), column(3)).transpose();
        let rows = rows.to_cols_array_2d();
        for (out, row) in out.iter_mut().zip(rows) {
            out.0[half * WIDE / 2..][..WIDE / 2].copy_from_slice(&row);
        }
    }
}

impl Lanes {
    /// The same for all.
    #[inline(always)]
    pub(crate) const fn splat(value: f32) -> Self {
        Self([value; WIDE])
    }

    #[inline(always)]
    fn with(self, other: Self, op: impl Fn(f32, f32) -> f32) -> Self {
        Self(std::array::from_fn(|lane| op(self.0[lane], other.0[lane])))
    }

    /// The larger one, by one instruction, as `f32::max` is not: `other`'s where one is no number.
    #[inline(always)]
    pub(crate) fn max(self, other: Self) -> Self {
        self.with(other, |a, b| if a > b { a } else { b })
    }

    /// The other way.
    #[inline(always)]
    pub(crate) fn min(self, other: Self) -> Self {
        self.with(other, |a, b| if a < b { a } else { b })
    }

    /// `yes` where this is over `value`, else `no`.
    #[inline(always)]
    pub(crate) fn choose_over(self, value: f32, yes: Self, no: Self) -> Self {
        let of = |lane: usize| if self.0[lane] > value { yes.0[lane] } else { no.0[lane] };
        Self(std::array::from_fn(of))
    }

    /// The square root.
    #[inline(always)]
    pub(crate) fn sqrt(self) -> Self {
        Self(std::array::from_fn(|lane| self.0[lane].sqrt()))
    }

    /// Bit by bit the lanes that are less than `value`.
    #[inline(always)]
    pub(crate) fn below(self, value: f32) -> u32 {
        let mut bits = 0;
        for (lane, own) in self.0.iter().enumerate() {
            bits |= u32::from(*own < value) << lane;
        }
        bits
    }
}

impl Add for Lanes {
    type Output = Self;

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.with(other, |a, b| a + b)
    }
}

impl Sub for Lanes {
    type Output = Self;

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.with(other, |a, b| a - b)
    }
}

impl Mul for Lanes {
    type Output = Self;

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.with(other, |a, b| a * b)
    }
}

impl Div for Lanes {
    type Output = Self;

    #[inline(always)]
    fn div(self, other: Self) -> Self {
        self.with(other, |a, b| a / b)
    }
}

impl Boxes {
    /// No box at all.
    pub(crate) const NOWHERE: Self = Self([Lanes::splat(FAR_M); 6]);

    /// Sets one box, by its low and its high corner.
    pub(crate) fn set(&mut self, lane: usize, [low, high]: &[Vec3A; 2]) {
        for k in 0..3 {
            self.0[k].0[lane] = low[k];
            self.0[3 + k].0[lane] = high[k];
        }
    }
}

impl Corners {
    /// No triangle at all.
    pub(crate) const NOWHERE: Self = Self([Lanes::splat(FAR_M); 9]);

    /// Sets one triangle.
    pub(crate) fn set(&mut self, lane: usize, corners: &[Vec3A; 3]) {
        for (corner, at) in corners.iter().enumerate() {
            for k in 0..3 {
                self.0[3 * corner + k].0[lane] = at[k];
            }
        }
    }
}

/// Squared distances of `point` to the boxes (m^2); 0 inside.
#[inline(always)]
pub(crate) fn box_distances2(boxes: &Boxes, point: Vec3A) -> Lanes {
    let b = &boxes.0;
    let out2 = |k: usize| {
        let at = Lanes::splat(point[k]);
        let out = (b[k] - at).max(at - b[3 + k]).max(Lanes::splat(0.0));
        out * out
    };
    out2(0) + out2(1) + out2(2)
}

/// Squared distances of `point` to the triangles (m^2), near enough to tell which of them may be
/// nearest ([`may_be_nearer`]).
#[inline(always)]
pub(crate) fn triangle_distances2(corners: &Corners, point: Vec3A) -> Lanes {
    let c = &corners.0;
    let corners = [[c[0], c[1], c[2]], [c[3], c[4], c[5]], [c[6], c[7], c[8]]];
    face_distances2(corners, [point.x, point.y, point.z].map(Lanes::splat))
}

/// As [`triangle_distances2`], of a point of its own for each triangle.
#[inline(always)]
fn face_distances2([a, b, c]: [Vectors; 3], p: Vectors) -> Lanes {
    let (ab, ac, bc) = (minus(b, a), minus(c, a), minus(c, b));
    let (ap, bp) = (minus(p, a), minus(p, b));
    let (ab2, ac2, both) = (dot(ab, ab), dot(ac, ac), dot(ab, ac));
    let (d1, d2) = (dot(ap, ab), dot(ap, ac));
    let to_bc = to_side(bp, bc, dot(bp, bc), dot(bc, bc));
    let to_sides = to_side(ap, ab, d1, ab2).min(to_side(ap, ac, d2, ac2)).min(to_bc);
    let (v, w) = (ac2 * d1 - both * d2, ab2 * d2 - both * d1);
    let normal = [
        ab[1] * ac[2] - ab[2] * ac[1],
        ab[2] * ac[0] - ab[0] * ac[2],
        ab[0] * ac[1] - ab[1] * ac[0],
    ];
    let (height, normal2) = (dot(normal, ap), dot(normal, normal));
    let to_plane = height * height / normal2.max(Lanes::splat(f32::MIN_POSITIVE));
    let beyond = ab2 * ac2 - both * both - (v + w);
    let thin = normal2 - Lanes::splat(SLIVER) * (ab2 * ac2);
    let inside = v.min(w).min(beyond).min(thin);
    inside.choose_over(0.0, to_plane, to_sides)
}

/// Squared distances of pairs of segments (m^2), by the steps of [`crate::segment::closest`].
#[inline(always)]
fn segment_distances2([p, q]: [Vectors; 2], [r, s]: [Vectors; 2]) -> Lanes {
    let least = Lanes::splat(f32::MIN_POSITIVE);
    let (d1, d2, to) = (minus(q, p), minus(s, r), minus(p, r));
    let (a, e, f) = (dot(d1, d1).max(least), dot(d2, d2).max(least), dot(d2, to));
    let (b, c) = (dot(d1, d2), dot(d1, to));
    let determinant = a * e - b * b;
    let across = determinant - Lanes::splat(SLIVER) * (a * e);
    let start = share(b * f - c * e, determinant.max(least));
    let start = across.choose_over(0.0, start, Lanes::splat(0.5));
    let t = share(b * start + f, e);
    let s = share(b * t - c, a);
    let t = share(b * s + f, e);
    let (x, y, z) = (to[0] + d1[0] * s, to[1] + d1[1] * s, to[2] + d1[2] * s);
    let rest = [x - d2[0] * t, y - d2[1] * t, z - d2[2] * t];
    dot(rest, rest)
}

/// `part / whole`, within 0..=1.
#[inline(always)]
fn share(part: Lanes, whole: Lanes) -> Lanes {
    (part / whole).max(Lanes::splat(0.0)).min(Lanes::splat(1.0))
}

/// Squared lengths of the differences (m^2).
#[inline(always)]
fn apart2(a: Vectors, b: Vectors) -> Lanes {
    let way = minus(a, b);
    dot(way, way)
}

/// Whether a triangle at about `distance2` may be nearer than `best` (m^2).
#[inline(always)]
pub(crate) fn may_be_nearer(distance2: f32, best: f32) -> bool {
    distance2 < best + (best * DOUBT.0 + DOUBT.1)
}

/// Squared distance to the side `along` from its beginning's way `to` to the point.
#[inline(always)]
fn to_side(to: Vectors, along: Vectors, part: Lanes, whole: Lanes) -> Lanes {
    let t = share(part, whole.max(Lanes::splat(f32::MIN_POSITIVE)));
    let rest = [to[0] - along[0] * t, to[1] - along[1] * t, to[2] - along[2] * t];
    dot(rest, rest)
}

#[inline(always)]
fn minus(a: Vectors, b: Vectors) -> Vectors {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
fn dot(a: Vectors, b: Vectors) -> Lanes {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lab::shapes::Chance;
    use crate::triangle;

    #[test]
    fn lanes_tell_the_distance_of_a_point_to_any_triangle_also_a_sliver() {
        let mut chance = Chance::new(11);
        for round in 0..4000 {
            let mut by_chance = || Vec3A::from_array(std::array::from_fn(|_| chance.signed()));
            let (a, b) = (by_chance(), by_chance());
            let c = match round % 4 {
                0 => a + (b - a) * 0.3 + by_chance() * 1e-5,
                1 => a,
                2 => a + by_chance() * 0.01,
                _ => by_chance(),
            };
            let point = by_chance();
            let mut corners = Corners::NOWHERE;
            corners.set(round % WIDE, &[a, b, c]);
            let found = triangle_distances2(&corners, point).0[round % WIDE];
            let wanted = triangle::closest(&[a, b, c], point).point.distance_squared(point);
            assert!(may_be_nearer(found, wanted + f32::EPSILON * wanted), "{found} for {wanted}");
        }
    }

    #[test]
    fn lanes_let_pass_whatever_comes_within_reach_and_little_else() {
        let mut chance = Chance::new(5);
        let (mut passed, mut wanted) = ([0, 0], [0, 0]);
        for round in 0..4000 {
            let mut by_chance =
                |most: f32| Vec3A::from_array(std::array::from_fn(|_| most * chance.signed()));
            let mut at: [Vec3A; 4] = std::array::from_fn(|_| by_chance(1.0));
            if round % 5 == 0 {
                at[3] = at[2] + (at[1] - at[0]) * 0.7; // parallel edges, or a face like a needle
            }
            let way: [Vec3A; 4] = std::array::from_fn(|_| by_chance(0.1));
            let mut movers = Movers::NOWHERE;
            movers.set(&[[0, 1, 2, 3]; WIDE], &at, &way);
            let reach = 0.2;
            for edges in [false, true] {
                let (distance, second) = if edges {
                    let (s, t) = crate::segment::closest([at[0], at[1]], [at[2], at[3]]);
                    (at[0].lerp(at[1], s).distance(at[2].lerp(at[3], t)), 2)
                } else {
                    let face = [at[1], at[2], at[3]];
                    (triangle::closest(&face, at[0]).point.distance(at[0]), 1)
                };
                let mut relative = 0.0f32;
                for a in &way[..second] {
                    relative = way[second..].iter().fold(relative, |r, b| r.max(a.distance(*b)));
                }
                let near = movers.may_meet(edges, reach);
                assert!(near == 0 || near == 0xff);
                if distance <= reach + relative {
                    wanted[usize::from(edges)] += 1;
                    assert!(near != 0, "{distance} within {reach} and {relative}");
                }
                passed[usize::from(edges)] += usize::from(near != 0);
            }
        }
        for (passed, wanted) in passed.into_iter().zip(wanted) {
            assert!(wanted > 400 && passed < wanted + wanted / 50, "{passed} for {wanted}");
        }
    }

    #[test]
    fn an_empty_lane_is_far_from_everything() {
        let mut boxes = Boxes::NOWHERE;
        boxes.set(3, &[Vec3A::ZERO, Vec3A::ONE]);
        let to = box_distances2(&boxes, Vec3A::new(0.5, 0.5, 3.0)).0;
        assert!((to[3] - 4.0).abs() < 1e-6);
        assert!((0..WIDE).filter(|k| *k != 3).all(|k| to[k] > 1e20));
    }
}

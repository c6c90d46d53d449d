//! A closed, moving triangle surface: closest points, inside or outside.

use glam::Vec3;

use crate::bvh::{Bvh, Fit, Hit};
use crate::triangle::{Feature, OnTriangle};

const NONE: u32 = u32::MAX;

/// Topology of a closed surface. Where it is lies in a [`Posed`].
#[derive(Debug, Clone, PartialEq)]
pub struct Surface {
    triangles: Vec<[u32; 3]>,
    /// The triangle across each side, or `NONE`.
    across: Vec<[u32; 3]>,
    /// Triangles around vertex v: `around[first_around[v]..first_around[v + 1]]`.
    around: Vec<u32>,
    first_around: Vec<u32>,
    bvh: Bvh,
}

/// A surface in one pose.
#[derive(Debug, Clone, Default)]
pub struct Posed {
    /// Its vertices (m).
    pub positions: Vec<Vec3>,
    fit: Fit,
}

/// The closest point of a surface, with the side on which the asking point lies.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Contact {
    /// Triangle of the closest point.
    pub triangle: u32,
    /// Barycentric coordinates of the closest point.
    pub weights: Vec3,
    /// The closest point (m).
    pub point: Vec3,
    /// Unit vector that leads out of the surface there, through the asking point or away from it.
    pub normal: Vec3,
    /// Signed distance of the asking point (m): positive outside.
    pub distance: f32,
}

impl Surface {
    /// Adjacency and a tree of boxes; `positions` only guide how the tree is split.
    pub fn new(positions: &[Vec3], triangles: &[[u32; 3]]) -> Self {
        let mut first_around = vec![0u32; positions.len() + 1];
        for v in triangles.iter().flatten() {
            first_around[*v as usize + 1] += 1;
        }
        for v in 0..positions.len() {
            first_around[v + 1] += first_around[v];
        }
        let mut next = first_around.clone();
        let mut around = vec![0u32; 3 * triangles.len()];
        for (t, corners) in triangles.iter().enumerate() {
            for v in corners {
                around[next[*v as usize] as usize] = t as u32;
                next[*v as usize] += 1;
            }
        }
        let mut surface = Self {
            triangles: triangles.to_vec(),
            across: Vec::new(),
            around,
            first_around,
            bvh: Bvh::new(positions, triangles),
        };
        surface.across = (0..triangles.len()).map(|t| surface.find_across(t)).collect();
        surface
    }

    /// Triangles, as given.
    pub fn triangles(&self) -> &[[u32; 3]] {
        &self.triangles
    }

    /// Fits the tree to `posed.positions`, which the caller has set.
    pub fn refit(&self, posed: &mut Posed) {
        self.bvh.refit(&posed.positions, &mut posed.fit);
    }

    /// The surface in a pose.
    pub fn posed(&self, positions: &[Vec3]) -> Posed {
        let mut posed = Posed { positions: positions.to_vec(), fit: Fit::default() };
        self.refit(&mut posed);
        posed
    }

    /// The closest point within `reach` (m) of `point`, if any. The side is told by the
    /// angle-weighted pseudo-normal of the closest feature (Baerentzen & Aanaes 2005).
    pub fn closest(&self, posed: &Posed, point: Vec3, reach: f32) -> Option<Contact> {
        self.closest_from(posed, point, reach, None)
    }

    /// The same, faster where `near` is a triangle that may be near. Of equals it is that one.
    pub fn closest_from(
        &self,
        posed: &Posed,
        point: Vec3,
        reach: f32,
        near: Option<u32>,
    ) -> Option<Contact> {
        let hit = self.bvh.closest_from(&posed.fit, point, reach * reach, near)?;
        Some(self.contact(posed, point, &hit))
    }

    /// Signed distance (m), positive outside; at most `reach` where nothing is that near.
    pub fn signed_distance(&self, posed: &Posed, point: Vec3, reach: f32) -> f32 {
        self.closest(posed, point, reach).map_or(reach, |c| c.distance)
    }

    /// How many parts of the surface enclose `point`.
    pub fn winding(&self, posed: &Posed, point: Vec3) -> i32 {
        self.bvh.winding(&posed.fit, point)
    }

    /// Whether something that found itself in `contact` and left the surface by the shortest way,
    /// to `offset` outside, would then be inside another part of it: held between body parts.
    pub fn is_pinched(&self, posed: &Posed, contact: &Contact, offset: f32) -> bool {
        self.winding(posed, contact.point + contact.normal * offset) > 0
    }

    /// Unit normal of a triangle in a pose.
    pub fn face_normal(&self, posed: &Posed, triangle: u32) -> Vec3 {
        let [a, b, c] = self.corners(posed, triangle);
        (b - a).cross(c - a).normalize_or_zero()
    }

    /// A point of the surface by its triangle and barycentric coordinates.
    pub fn point(&self, posed: &Posed, triangle: u32, weights: Vec3) -> Vec3 {
        let [a, b, c] = self.corners(posed, triangle);
        a * weights.x + b * weights.y + c * weights.z
    }

    /// Two axes in a triangle's plane and its normal: a frame that is carried with the triangle.
    pub fn triangle_frame(&self, posed: &Posed, triangle: u32) -> [Vec3; 3] {
        let [a, b, c] = self.corners(posed, triangle);
        let normal = (b - a).cross(c - a).normalize_or_zero();
        let axis = (b - a).normalize_or_zero();
        [axis, normal.cross(axis), normal]
    }

    fn corners(&self, posed: &Posed, triangle: u32) -> [Vec3; 3] {
        self.triangles[triangle as usize].map(|v| posed.positions[v as usize])
    }

    fn contact(&self, posed: &Posed, point: Vec3, hit: &Hit) -> Contact {
        let pseudo = self.pseudo_normal(posed, hit.triangle, &hit.on);
        let nearest = Vec3::from(hit.on.point);
        let away = point - nearest;
        let length = hit.distance2.sqrt();
        let side = if away.dot(pseudo) < 0.0 { -1.0 } else { 1.0 };
        // Over a face, and very near, the surface's own normal is better: rounding leans the
        // direction, and what slides along a leaning plane is pushed off and pulled on by turns.
        let own = hit.on.feature == Feature::Face || length <= 1e-4;
        let normal = if own { pseudo } else { away * (side / length) };
        Contact {
            triangle: hit.triangle,
            weights: hit.on.weights,
            point: nearest,
            normal,
            distance: side * length,
        }
    }

    fn pseudo_normal(&self, posed: &Posed, triangle: u32, on: &OnTriangle) -> Vec3 {
        let own = self.face_normal(posed, triangle);
        let sum = match on.feature {
            Feature::Face => own,
            Feature::Edge(k) => match self.across[triangle as usize][k as usize] {
                NONE => own,
                other => own + self.face_normal(posed, other),
            },
            Feature::Vertex(k) => {
                let v = self.triangles[triangle as usize][k as usize];
                let range = self.first_around[v as usize]..self.first_around[v as usize + 1];
                let around = &self.around[range.start as usize..range.end as usize];
                around.iter().map(|t| self.weighted_normal(posed, *t, v)).sum()
            }
        };
        let unit = sum.normalize_or_zero();
        if unit == Vec3::ZERO { own } else { unit }
    }

    /// A triangle's normal times its angle at vertex `v`.
    fn weighted_normal(&self, posed: &Posed, triangle: u32, v: u32) -> Vec3 {
        let [a, b, c] = self.corners(posed, triangle);
        let (p, q, r) = match self.triangles[triangle as usize].iter().position(|u| *u == v) {
            Some(1) => (b, c, a),
            Some(2) => (c, a, b),
            _ => (a, b, c),
        };
        let (d1, d2) = (q - p, r - p);
        let cross = d1.cross(d2);
        let sine = cross.length();
        if sine <= 0.0 {
            return Vec3::ZERO;
        }
        cross * (sine.atan2(d1.dot(d2)) / sine)
    }

    fn find_across(&self, triangle: usize) -> [u32; 3] {
        std::array::from_fn(|k| {
            let corners = self.triangles[triangle];
            let (a, b) = (corners[k], corners[(k + 1) % 3]);
            let range = self.first_around[a as usize]..self.first_around[a as usize + 1];
            let around = &self.around[range.start as usize..range.end as usize];
            let shares = |t: &&u32| **t as usize != triangle && self.has(**t, b);
            around.iter().find(shares).copied().unwrap_or(NONE)
        })
    }

    fn has(&self, triangle: u32, vertex: u32) -> bool {
        self.triangles[triangle as usize].contains(&vertex)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A sphere of `rings` x `2 rings` faces.
    pub(crate) fn sphere(center: Vec3, radius: f32, rings: u32) -> (Vec<Vec3>, Vec<[u32; 3]>) {
        let around = 2 * rings;
        let mut p = vec![center + Vec3::Y * radius];
        for i in 1..rings {
            for j in 0..around {
                let theta = std::f32::consts::PI * i as f32 / rings as f32;
                let phi = std::f32::consts::TAU * j as f32 / around as f32;
                let (s, c) = theta.sin_cos();
                p.push(center + radius * Vec3::new(s * phi.sin(), c, s * phi.cos()));
            }
        }
        p.push(center - Vec3::Y * radius);
        let last = p.len() as u32 - 1;
        let at = |i: u32, j: u32| 1 + (i - 1) * around + j % around;
        let mut t = Vec::new();
        for j in 0..around {
            t.push([0, at(1, j), at(1, j + 1)]);
            t.push([last, at(rings - 1, j + 1), at(rings - 1, j)]);
            for i in 1..rings - 1 {
                t.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
                t.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
            }
        }
        (p, t)
    }

    #[test]
    fn distances_to_a_sphere_are_signed_and_exact_to_its_facets() {
        let center = Vec3::new(0.3, -0.2, 1.0);
        let (p, t) = sphere(center, 0.5, 24);
        let surface = Surface::new(&p, &t);
        let posed = surface.posed(&p);
        let golden = std::f32::consts::PI * (3.0 - 5.0f32.sqrt());
        for i in 0..500 {
            let y = 1.0 - 2.0 * (i as f32 + 0.5) / 500.0;
            let r = (1.0 - y * y).sqrt();
            let dir = Vec3::new(r * (golden * i as f32).cos(), y, r * (golden * i as f32).sin());
            for distance in [-0.2, -0.01, 0.01, 0.3] {
                let q = center + dir * (0.5 + distance);
                let c = surface.closest(&posed, q, 1.0).unwrap();
                assert!((c.distance - distance).abs() < 0.006, "{} {distance}", c.distance);
                assert!(c.normal.dot(dir) > 0.9);
                assert!(c.point.distance(surface.point(&posed, c.triangle, c.weights)) < 1e-5);
                assert_eq!(surface.winding(&posed, q), i32::from(distance < 0.0));
            }
        }
        assert!(surface.closest(&posed, center + Vec3::X * 2.0, 1.0).is_none());
    }

    #[test]
    fn only_the_overlap_of_two_parts_pinches() {
        let (mut p, mut t) = sphere(Vec3::ZERO, 0.1, 16);
        let (q, u) = sphere(Vec3::X * 0.16, 0.1, 16);
        let shift = p.len() as u32;
        p.extend(q);
        t.extend(u.iter().map(|t| t.map(|v| v + shift)));
        let surface = Surface::new(&p, &t);
        let posed = surface.posed(&p);
        let held = |x: Vec3| {
            let c = surface.closest(&posed, x, 1.0).unwrap();
            assert!(c.distance < 0.0);
            surface.is_pinched(&posed, &c, 0.004)
        };
        assert!(held(Vec3::X * 0.085));
        assert!(!held(Vec3::X * -0.085));
        assert!(!held(Vec3::Y * 0.085));
    }
}

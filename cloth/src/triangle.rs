//! A point and a triangle.

use glam::{Vec3, Vec3A};

/// A point of a triangle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OnTriangle {
    /// The point (m).
    pub point: Vec3A,
    /// Its barycentric coordinates.
    pub weights: Vec3,
    /// Face, edge or vertex on which it lies.
    pub feature: Feature,
}

/// A part of a triangle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Feature {
    /// Its inside.
    Face,
    /// The side from corner k to corner k + 1.
    Edge(u8),
    /// Corner k.
    Vertex(u8),
}

/// The closest point of triangle `t` to `p`, by Voronoi regions (Ericson 2005, section 5.1.5).
pub fn closest(t: &[Vec3A; 3], p: Vec3A) -> OnTriangle {
    let [a, b, c] = *t;
    let (ab, ac, ap) = (b - a, c - a, p - a);
    let (d1, d2) = (ab.dot(ap), ac.dot(ap));
    let corner = |k: u8| {
        let mut weights = Vec3::ZERO;
        weights[k as usize] = 1.0;
        OnTriangle { point: t[k as usize], weights, feature: Feature::Vertex(k) }
    };
    let side = |k: u8, s: f32| {
        let (i, j) = (k as usize, (k as usize + 1) % 3);
        let mut weights = Vec3::ZERO;
        weights[i] = 1.0 - s;
        weights[j] = s;
        OnTriangle { point: t[i] + (t[j] - t[i]) * s, weights, feature: Feature::Edge(k) }
    };
    if d1 <= 0.0 && d2 <= 0.0 {
        return corner(0);
    }
    let bp = p - b;
    let (d3, d4) = (ab.dot(bp), ac.dot(bp));
    if d3 >= 0.0 && d4 <= d3 {
        return corner(1);
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return side(0, ratio(d1, d1 - d3));
    }
    let cp = p - c;
    let (d5, d6) = (ab.dot(cp), ac.dot(cp));
    if d6 >= 0.0 && d5 <= d6 {
        return corner(2);
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return side(2, 1.0 - ratio(d2, d2 - d6));
    }
    let va = d3 * d6 - d5 * d4;
    let (to_c, to_b) = (d4 - d3, d5 - d6);
    if va <= 0.0 && to_c >= 0.0 && to_b >= 0.0 {
        return side(1, ratio(to_c, to_c + to_b));
    }
    let sum = va + vb + vc;
    if sum <= 0.0 {
        return corner(0);
    }
    let (v, w) = (vb / sum, vc / sum);
    OnTriangle {
        point: a + ab * v + ac * w,
        weights: Vec3::new(1.0 - v - w, v, w),
        feature: Feature::Face,
    }
}

/// +1 if the ray leaves through the triangle's front, -1 if through its back, 0 if it misses.
pub fn crossing(t: &[Vec3A; 3], from: Vec3A, ray: Vec3A) -> i32 {
    let (e1, e2) = (t[1] - t[0], t[2] - t[0]);
    let p = ray.cross(e2);
    let determinant = e1.dot(p);
    if determinant == 0.0 {
        return 0;
    }
    let to = from - t[0];
    let u = to.dot(p) / determinant;
    let q = to.cross(e1);
    let v = ray.dot(q) / determinant;
    if u < 0.0 || v < 0.0 || u + v > 1.0 || e2.dot(q) / determinant <= 0.0 {
        return 0;
    }
    // determinant = -ray . (e1 x e2): negative where the ray leaves through the front.
    if determinant < 0.0 { 1 } else { -1 }
}

fn ratio(part: f32, whole: f32) -> f32 {
    if whole > 0.0 { part / whole } else { 0.0 }
}

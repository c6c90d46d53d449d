//! Signed distance fields of round cones, joined smoothly: what body and robe are carved from.

use cloth::Vec3;

/// A cone with round ends: the hull of two balls. Tagged with the joint that moves it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RoundCone {
    pub joint: u16,
    pub a: Vec3,
    pub b: Vec3,
    pub radius_a: f32,
    pub radius_b: f32,
}

impl RoundCone {
    /// Distance of `p` from the surface (m), negative inside. The nearest ball on the axis is
    /// found in closed form: its parameter is the foot of `p`, moved along by the cone's slope.
    pub fn distance(&self, p: Vec3) -> f32 {
        let axis = self.b - self.a;
        let length = axis.length();
        let to_p = p - self.a;
        let along = to_p.dot(axis) / length;
        let across = (to_p.length_squared() - along * along).max(0.0).sqrt();
        let narrowing = self.radius_a - self.radius_b;
        let slope = narrowing / (length * length - narrowing * narrowing).max(1e-12).sqrt();
        let t = ((along - across * slope) / length).clamp(0.0, 1.0);
        let centre_along = along - t * length;
        (centre_along * centre_along + across * across).sqrt() - (self.radius_a - narrowing * t)
    }

    /// Middle and radius of a ball that holds the cone.
    fn ball(&self) -> (Vec3, f32) {
        let half = self.a.distance(self.b) / 2.0;
        (self.a.midpoint(self.b), half + self.radius_a.max(self.radius_b))
    }

    /// The same cone, thicker by `by` metres.
    pub fn inflated(&self, by: f32) -> Self {
        Self { radius_a: self.radius_a + by, radius_b: self.radius_b + by, ..*self }
    }
}

/// Union of two fields with a fillet of about `k` metres (quadratic blend).
pub(crate) fn join(a: f32, b: f32, k: f32) -> f32 {
    let h = (k - (a - b).abs()).max(0.0) / k;
    a.min(b) - h * h * k * 0.25
}

/// Union of many cones with a fillet of `fillet_m`.
pub(crate) struct Union {
    /// Each with a ball that holds it.
    cones: Vec<(RoundCone, Vec3, f32)>,
    fillet_m: f32,
}

impl Union {
    pub fn new(cones: &[RoundCone], fillet_m: f32) -> Self {
        let with_ball = |cone: &RoundCone| {
            let (middle, reach) = cone.ball();
            (*cone, middle, reach)
        };
        Self { cones: cones.iter().map(with_ball).collect(), fillet_m }
    }

    /// Distance of `p` (m); a few millimetres too small inside fillets. A cone whose ball is
    /// further than any fillet reaches is passed over, which changes nothing but the time.
    pub fn distance(&self, p: Vec3) -> f32 {
        self.cones.iter().fold(f32::MAX, |sum, (cone, middle, reach)| {
            let far = sum + self.fillet_m + reach;
            if far > 0.0 && p.distance_squared(*middle) > far * far {
                return sum;
            }
            join(sum, cone.distance(p), self.fillet_m)
        })
    }
}

/// Slope of a field, from its values at the corners of a tetrahedron half a millimetre around.
pub(crate) fn gradient(field: &dyn Fn(Vec3) -> f32, p: Vec3) -> Vec3 {
    const H: f32 = 5e-4;
    const CORNERS: [Vec3; 4] = [
        Vec3::new(1.0, 1.0, 1.0),
        Vec3::new(1.0, -1.0, -1.0),
        Vec3::new(-1.0, 1.0, -1.0),
        Vec3::new(-1.0, -1.0, 1.0),
    ];
    CORNERS.iter().map(|corner| *corner * field(p + *corner * H)).sum::<Vec3>() / (4.0 * H)
}

/// Moves `p` onto the zero set by at most four Newton steps.
pub(crate) fn project(field: &dyn Fn(Vec3) -> f32, mut p: Vec3) -> Vec3 {
    for _ in 0..4 {
        let value = field(p);
        if value.abs() < 1e-5 {
            break;
        }
        let slope = gradient(field, p);
        p -= slope * (value / slope.length_squared().max(0.05));
    }
    p
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_round_cone_measures_distance_from_the_hull_of_its_balls() {
        let cone = RoundCone { joint: 0, a: Vec3::ZERO, b: Vec3::Y, radius_a: 0.4, radius_b: 0.1 };
        assert!((cone.distance(Vec3::new(0.0, -1.0, 0.0)) - 0.6).abs() < 1e-6);
        assert!((cone.distance(Vec3::new(0.0, 1.5, 0.0)) - 0.4).abs() < 1e-6);
        for p in [Vec3::new(0.7, 0.4, 0.2), Vec3::new(0.1, 0.6, -0.9), Vec3::new(0.0, 0.2, 0.3)] {
            let ball = |t: f32| (p - Vec3::Y * t).length() - (0.4 - 0.3 * t);
            let nearest = (0..=10_000).map(|i| ball(i as f32 * 1e-4)).fold(f32::MAX, f32::min);
            assert!((cone.distance(p) - nearest).abs() < 1e-5, "at {p}");
        }
    }
}

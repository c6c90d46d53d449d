//! How far apart the parts of the body are in a pose.

use cloth::{Pose, Skeleton};

use super::character;
use super::field::RoundCone;

/// The body's cones in a pose.
pub(super) struct Placed(Vec<RoundCone>);

impl Placed {
    pub fn new(skeleton: &Skeleton, pose: &Pose) -> Self {
        let mut world = Vec::new();
        skeleton.world(pose, &mut world);
        let place = |cone: RoundCone| {
            let joint = cone.joint as usize;
            let moved = world[joint].after(&skeleton.rest[joint].inverse());
            RoundCone { a: moved.point(cone.a), b: moved.point(cone.b), ..cone }
        };
        Self(character::cones().into_iter().map(place).collect())
    }

    /// Least distance between the parts of two groups of joints (m), negative where they overlap.
    /// Exact to a few millimetres: one cone of each pair is sampled at nine balls.
    pub fn gap(&self, one: &[usize], other: &[usize]) -> f32 {
        let of = |group: &[usize], cone: &RoundCone| group.contains(&(cone.joint as usize));
        let balls = self.0.iter().filter(|cone| of(one, cone)).flat_map(|cone| {
            (0..=8).map(move |step| {
                let t = step as f32 / 8.0;
                (cone.a.lerp(cone.b, t), cone.radius_a + (cone.radius_b - cone.radius_a) * t)
            })
        });
        let mut least = f32::MAX;
        for (centre, radius) in balls {
            for cone in self.0.iter().filter(|cone| of(other, cone)) {
                least = least.min(cone.distance(centre) - radius);
            }
        }
        least
    }
}

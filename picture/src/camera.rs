//! Where a picture is taken from.

use glam::Vec3;

/// A perspective camera. World units are metres, y is up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Where the eye is, in metres.
    pub eye: Vec3,
    /// What it looks at: the middle of the picture, in metres.
    pub target: Vec3,
    /// Full vertical angle of view, in radians.
    pub angle: f32,
}

impl Camera {
    /// Vertical angle of view unless told otherwise, in radians: about 28 degrees. A long lens, as
    /// for portraits, so that a body's limbs keep their proportions.
    pub const ANGLE: f32 = 0.49;

    /// From the front (a character looks along +z), a little to its left and a little above;
    /// `distance` in metres.
    pub fn around(target: Vec3, distance: f32) -> Self {
        Self::orbit(target, distance, 0.45, 0.2)
    }

    /// From `distance` metres; `yaw` turns the eye about the vertical (0 looks from +z, a quarter
    /// turn from +x), `pitch` raises it. Both in radians.
    pub fn orbit(target: Vec3, distance: f32, yaw: f32, pitch: f32) -> Self {
        let level = Vec3::new(yaw.sin(), 0.0, yaw.cos());
        let eye = target + distance * (pitch.cos() * level + pitch.sin() * Vec3::Y);
        Self { eye, target, angle: Self::ANGLE }
    }

    /// As [`Camera::orbit`], at the distance from which every one of `points` is within a picture
    /// of this `aspect` (width / height), with a small margin. Points that are not finite are left
    /// out; without any, the origin is looked at from a metre.
    pub fn framing(points: &[Vec3], aspect: f32, yaw: f32, pitch: f32) -> Self {
        let Some((low, high)) = bounds(points) else {
            return Self::orbit(Vec3::ZERO, 1.0, yaw, pitch);
        };
        let centre = 0.5 * (low + high);
        let [right, up, back] = Self::orbit(centre, 1.0, yaw, pitch).axes();
        let tangent = 0.92 * (0.5 * Self::ANGLE).tan();
        let distance = points.iter().filter(|point| point.is_finite()).fold(0.01, |far, point| {
            let from_centre = *point - centre;
            let wide = from_centre.dot(right).abs() / (tangent * aspect);
            let high = from_centre.dot(up).abs() / tangent;
            f32::max(far, wide.max(high) + from_centre.dot(back))
        });
        Self::orbit(centre, distance, yaw, pitch)
    }

    /// The same camera, carried along so that it looks at `target`.
    pub fn following(&self, target: Vec3) -> Self {
        Self { eye: self.eye + (target - self.target), target, angle: self.angle }
    }

    /// Unit vectors to the right, up and back (from what is looked at to the eye).
    pub fn axes(&self) -> [Vec3; 3] {
        let back = (self.eye - self.target).try_normalize().unwrap_or(Vec3::Z);
        // Straight up or down, any direction serves as the right.
        let right = Vec3::Y.cross(back).try_normalize().unwrap_or(Vec3::X);
        [right, back.cross(right), back]
    }
}

/// Lowest and highest corner of the finite ones among `points`.
fn bounds(points: &[Vec3]) -> Option<(Vec3, Vec3)> {
    points
        .iter()
        .filter(|point| point.is_finite())
        .map(|&point| (point, point))
        .reduce(|(low, high), (point, _)| (low.min(point), high.max(point)))
}

//! Rigid transforms.

use glam::{Quat, Vec3};

/// A rotation followed by a translation: `x -> rotation * x + translation`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rigid {
    /// Unit quaternion.
    pub rotation: Quat,
    /// Metres.
    pub translation: Vec3,
}

impl Rigid {
    /// The transform that changes nothing.
    pub const IDENTITY: Self = Self { rotation: Quat::IDENTITY, translation: Vec3::ZERO };

    /// A turn by `yaw` radians about +y, then a shift.
    pub fn from_yaw(yaw: f32, translation: Vec3) -> Self {
        Self { rotation: Quat::from_rotation_y(yaw), translation }
    }

    /// Moves a point.
    pub fn point(&self, p: Vec3) -> Vec3 {
        self.rotation * p + self.translation
    }

    /// Turns a direction or a velocity.
    pub fn vector(&self, v: Vec3) -> Vec3 {
        self.rotation * v
    }

    /// `self` after `first`: `(self * first)(x) = self(first(x))`.
    pub fn after(&self, first: &Self) -> Self {
        Self {
            rotation: (self.rotation * first.rotation).normalize(),
            translation: self.point(first.translation),
        }
    }

    /// The transform that undoes this one.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.conjugate();
        Self { rotation, translation: -(rotation * self.translation) }
    }
}

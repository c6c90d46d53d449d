//! A pose as an animator thinks of it: where hips and feet are, how spine and arms are held.
//!
//! Legs follow from hips and feet by two-bone inverse kinematics, so that a foot that is told to
//! stand stands, and knees bend forward only.

use cloth::{Pose, Quat, Skeleton, Vec3};
use glam::Mat3;

use super::skeleton::joint;

/// Of the rest pose: how far the arms are from hanging down (rad).
const REST_LIFT: f32 = std::f32::consts::FRAC_PI_4;
/// A leg is never stretched beyond this part of its length: the knee would snap.
const REACH: f32 = 0.995;
/// From the ball of a foot back to where its heel touches the ground (m).
const HEEL_M: f32 = 0.165;

/// Turns about the axes of a part: `pitch` leans forward, `yaw` turns to the left, `roll` lifts
/// the left side (rad).
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Turn {
    pub pitch: f32,
    pub yaw: f32,
    pub roll: f32,
}

impl Turn {
    fn rotation(&self, part: f32) -> Quat {
        Quat::from_rotation_y(self.yaw * part)
            * Quat::from_rotation_x(self.pitch * part)
            * Quat::from_rotation_z(self.roll * part)
    }
}

/// An arm, from hanging straight down (rad): `swing` forward, `lift` outward, `twist` about itself
/// (inward), `elbow` bent.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Arm {
    pub swing: f32,
    pub lift: f32,
    pub twist: f32,
    pub elbow: f32,
}

/// A foot: where its ball is above the ground (m); `pitch` lifts the heel, or below zero the
/// toes (rad).
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Foot {
    pub x: f32,
    pub y: f32,
    pub z: f32,
    pub yaw: f32,
    pub pitch: f32,
}

/// A pose, to be placed by its carriage: a spot on the ground with a heading. Left is first.
#[derive(Debug, Clone, Copy)]
pub(super) struct Figure {
    /// On the ground (m), and its heading (rad); all else is told in its frame.
    pub carriage: Carriage,
    /// From where the hips are at rest (m).
    pub hips: Vec3,
    pub hips_turn: Turn,
    pub spine: Turn,
    pub head: Turn,
    pub arms: [Arm; 2],
    pub feet: [Foot; 2],
}

/// Where a figure is and where it looks.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Carriage {
    pub x: f32,
    pub z: f32,
    pub yaw: f32,
}

impl Carriage {
    /// A point in the carriage's frame, in the world.
    pub fn place(&self, p: Vec3) -> Vec3 {
        Quat::from_rotation_y(self.yaw) * p + Vec3::new(self.x, 0.0, self.z)
    }

    /// A foot in the world, as this carriage sees it.
    pub fn see(&self, foot: Foot) -> Foot {
        let from = Vec3::new(foot.x - self.x, foot.y, foot.z - self.z);
        let p = Quat::from_rotation_y(-self.yaw) * from;
        Foot { x: p.x, y: p.y, z: p.z, yaw: foot.yaw - self.yaw, pitch: foot.pitch }
    }
}

impl Default for Figure {
    /// Standing at ease, arms a little away from the body so that a sleeve fits.
    fn default() -> Self {
        let arm = Arm { swing: 0.05, lift: 0.36, twist: 0.0, elbow: 0.25 };
        let foot = Foot { x: 0.125, z: 0.095, yaw: 0.08, ..Foot::default() };
        Self {
            carriage: Carriage::default(),
            hips: Vec3::new(0.0, -0.02, 0.0),
            hips_turn: Turn::default(),
            spine: Turn::default(),
            head: Turn::default(),
            arms: [arm; 2],
            feet: [foot, Foot { x: -foot.x, yaw: -foot.yaw, ..foot }],
        }
    }
}

impl Figure {
    /// Shifts the carriage so that this foot stays where it is at ease: the figure turns on it.
    pub fn pivot(&mut self, side: usize) {
        let (foot, ease) = (self.feet[side], Self::default().feet[side]);
        let p = self.carriage.place(Vec3::new(foot.x, 0.0, foot.z));
        self.carriage.x += ease.x - p.x;
        self.carriage.z += ease.z - p.z;
    }

    /// The joints' rotations and the hips' place.
    pub fn pose(&self, skeleton: &Skeleton) -> Pose {
        let mut rotations = vec![Quat::IDENTITY; skeleton.joint_count()];
        let heading = Quat::from_rotation_y(self.carriage.yaw);
        let root = self.carriage.place(skeleton.offsets[joint::HIPS] + self.hips);
        rotations[joint::HIPS] = heading * self.hips_turn.rotation(1.0);
        rotations[joint::SPINE] = self.spine.rotation(0.45);
        rotations[joint::CHEST] = self.spine.rotation(0.55);
        rotations[joint::NECK] = self.head.rotation(0.4);
        rotations[joint::HEAD] = self.head.rotation(0.6);
        for side in 0..2 {
            self.pose_arm(side, &mut rotations);
            self.pose_leg(side, root, skeleton, &mut rotations);
        }
        rotations.iter_mut().for_each(|r| *r = r.normalize());
        Pose { root, rotations }
    }

    fn pose_arm(&self, side: usize, rotations: &mut [Quat]) {
        let Arm { swing, lift, twist, elbow } = self.arms[side];
        let (out, first) = if side == 0 { (1.0, 0) } else { (-1.0, joint::SIDE) };
        let along = Vec3::new(out * REST_LIFT.cos(), -REST_LIFT.sin(), 0.0);
        rotations[joint::SHOULDER + first] =
            Quat::from_rotation_z(out * 0.18 * (lift - REST_LIFT).max(0.0));
        rotations[joint::ARM + first] = Quat::from_rotation_x(-swing)
            * Quat::from_rotation_z(out * (lift - REST_LIFT))
            * Quat::from_axis_angle(along, -out * twist);
        rotations[joint::FOREARM + first] = Quat::from_axis_angle(along.cross(Vec3::Z), elbow);
        rotations[joint::HAND + first] = Quat::from_axis_angle(along.cross(Vec3::Z), 0.1);
    }

    fn pose_leg(&self, side: usize, root: Vec3, skeleton: &Skeleton, rotations: &mut [Quat]) {
        let first = if side == 0 { 0 } else { joint::SIDE };
        let [thigh, shin, ankle, toes] =
            [joint::THIGH, joint::SHIN, joint::FOOT, joint::TOES].map(|j| j + first);
        let foot = self.feet[side];
        let heading = Quat::from_rotation_y(self.carriage.yaw + foot.yaw);
        let flat_toes = (1.0 - foot.y / 0.08).clamp(0.0, 1.0) * foot.pitch.max(0.0);
        let foot_world = heading * Quat::from_rotation_x(foot.pitch);
        let toes_world = heading * Quat::from_rotation_x(foot.pitch - flat_toes);
        let sole = skeleton.rest[toes].translation.y;
        let on_heel = HEEL_M * (-foot.pitch).max(0.0).sin();
        let ball = self.carriage.place(Vec3::new(foot.x, foot.y + sole + on_heel, foot.z));
        let target = ball - foot_world * skeleton.offsets[toes];

        let hips = rotations[joint::HIPS];
        let hip = root + hips * skeleton.offsets[thigh];
        let (upper, lower) = (skeleton.offsets[shin].length(), skeleton.offsets[ankle].length());
        let reach = (target - hip).length().clamp(0.25, (upper + lower) * REACH);
        let towards = (target - hip).normalize_or_zero();
        // The knee turns about an axis between the hips' and the foot's left.
        let left = hips * Vec3::X + heading * Vec3::X;
        let axis = (left - towards * left.dot(towards)).normalize_or_zero();
        let cosine = (upper * upper + reach * reach - lower * lower) / (2.0 * upper * reach);
        let bend = cosine.clamp(-1.0, 1.0).acos();
        let thigh_along = Quat::from_axis_angle(axis, -bend) * towards;
        let shin_along = (towards * reach - thigh_along * upper).normalize_or_zero();
        let turned = |rest: Vec3, now: Vec3| frame(now, axis) * frame(rest, Vec3::X).conjugate();
        let thigh_world = turned(skeleton.offsets[shin], thigh_along);
        let shin_world = turned(skeleton.offsets[ankle], shin_along);
        rotations[thigh] = hips.conjugate() * thigh_world;
        rotations[shin] = thigh_world.conjugate() * shin_world;
        rotations[ankle] = shin_world.conjugate() * foot_world;
        rotations[toes] = foot_world.conjugate() * toes_world;
    }
}

/// The rotation whose y axis is `along` and whose x axis is as near to `left` as can be.
fn frame(along: Vec3, left: Vec3) -> Quat {
    let y = along.normalize_or_zero();
    let x = (left - y * left.dot(y)).normalize_or_zero();
    Quat::from_mat3(&Mat3::from_cols(x, y, x.cross(y)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::builtin::skeleton::skeleton;

    #[test]
    fn feet_stand_where_they_are_told_to() {
        let skeleton = skeleton();
        let mut figure = Figure { hips: Vec3::new(0.03, -0.15, 0.05), ..Figure::default() };
        figure.carriage = Carriage { x: 0.4, z: -1.0, yaw: 0.7 };
        figure.feet[0] = Foot { x: 0.2, y: 0.1, z: 0.3, yaw: 0.3, pitch: 0.4 };
        let mut world = Vec::new();
        skeleton.world(&figure.pose(&skeleton), &mut world);
        for side in 0..2 {
            let foot = figure.feet[side];
            let ball = world[joint::TOES + side * joint::SIDE].translation;
            let want = figure.carriage.place(Vec3::new(foot.x, foot.y + 0.025, foot.z));
            assert!(ball.distance(want) < 1e-4, "side {side}: {ball} for {want}");
            let knee = world[joint::SHIN + side * joint::SIDE].translation;
            let hip = world[joint::THIGH + side * joint::SIDE].translation;
            let ankle = world[joint::FOOT + side * joint::SIDE].translation;
            let forward = Quat::from_rotation_y(0.7) * Vec3::Z;
            assert!((knee - (hip + ankle) / 2.0).dot(forward) > 0.0, "knee bends backward");
        }
    }
}

//! Walking, running, turning on the spot: one formula with different numbers.
//!
//! Footprints are laid along the path first; a foot stands in its print without moving, then
//! swings to the next. So feet never slide, on a straight or on a turning path.

use std::f32::consts::{PI, TAU};

use cloth::Vec3;

use super::curve::Curve;
use super::figure::{Carriage, Figure, Foot};

/// A way of walking. Angles in radians, lengths in metres.
pub(super) struct Gait {
    /// Seconds of a cycle: one step of each foot.
    pub cycle_s: f32,
    /// Along the path (m/s).
    pub speed: f32,
    /// Of the path [rad/s].
    pub turn: f32,
    /// Part of the cycle for which a foot stands.
    pub duty: f32,
    /// Of a footprint from the path.
    pub width: f32,
    /// How high a swinging foot is lifted.
    pub lift: f32,
    /// Lift of the heel when the foot leaves, and of the toes when it lands.
    pub heel: f32,
    pub toes: f32,
    /// How far the hips are lowered, and how much they go up and down; highest over the standing
    /// foot when positive, in flight when negative.
    pub drop: f32,
    pub bounce: f32,
    /// Of the trunk, forward.
    pub lean: f32,
    /// Of the hips about the vertical; the spine turns against it.
    pub twist: f32,
    /// Of the arms, and how they are bent.
    pub swing: f32,
    pub elbow: f32,
}

impl Gait {
    /// The figure `time_s` seconds into the cycle.
    pub fn figure(&self, time_s: f32) -> Figure {
        let cycle = time_s / self.cycle_s;
        let carriage = self.carriage(time_s);
        let mut figure = Figure { carriage, ..Figure::default() };
        let over_left = TAU * (cycle - self.duty / 2.0);
        let stride = (TAU * cycle).cos();
        figure.hips = Vec3::new(
            0.022 * over_left.cos(),
            -self.drop + self.bounce * (2.0 * over_left).cos(),
            0.0,
        );
        figure.hips_turn.yaw = -self.twist * stride;
        figure.hips_turn.roll = 0.045 * over_left.cos();
        figure.hips_turn.pitch = self.lean * 0.4;
        figure.spine.yaw = 1.9 * self.twist * stride + 0.12 * self.turn;
        figure.spine.roll = -0.06 * over_left.cos();
        figure.spine.pitch = self.lean * 0.6;
        figure.head.yaw = -0.8 * self.twist * stride + 0.08 * self.turn;
        figure.head.pitch = -self.lean * 0.7;
        for (side, forward) in [(0, -stride), (1, stride)] {
            let arm = &mut figure.arms[side];
            arm.swing = self.swing * forward + 0.08 - self.lean * 0.5;
            arm.elbow = self.elbow + 0.35 * self.swing * (1.0 + forward);
            figure.feet[side] = carriage.see(self.foot(side, cycle));
        }
        figure
    }

    /// On the path after some seconds.
    pub fn carriage(&self, time_s: f32) -> Carriage {
        let yaw = self.turn * time_s;
        if self.turn.abs() < 1e-6 {
            return Carriage { x: 0.0, z: self.speed * time_s, yaw: 0.0 };
        }
        let radius = self.speed / self.turn;
        Carriage { x: radius * (1.0 - yaw.cos()), z: radius * yaw.sin(), yaw }
    }

    /// A foot in the world; the right one is half a cycle late.
    fn foot(&self, side: usize, cycle: f32) -> Foot {
        let late = 0.5 * side as f32;
        let step = (cycle + late).floor();
        let phase = cycle + late - step;
        let print = |step: f32| {
            let middle = self.carriage((step + self.duty / 2.0 - late) * self.cycle_s);
            let out = if side == 0 { 1.0 } else { -1.0 };
            let p = middle.place(Vec3::new(out * self.width, 0.0, 0.07));
            (p, middle.yaw + out * 0.06)
        };
        let swing = ((phase - self.duty) / (1.0 - self.duty)).max(0.0);
        let eased = swing * swing * (3.0 - 2.0 * swing);
        let ((from, from_yaw), (to, to_yaw)) = (print(step), print(step + 1.0));
        let p = from.lerp(to, eased);
        let height = self.lift * (PI * swing).sin().powi(2);
        let air = 1.0 - self.duty;
        let pitch_keys = [
            (0.0, -self.toes),
            (self.duty * 0.2, 0.0),
            (self.duty * 0.55, 0.0),
            (self.duty, self.heel),
            (self.duty + air * 0.25, self.heel * 0.9),
            (self.duty + air * 0.85, -self.toes),
            (1.0, -self.toes),
        ];
        let yaw = from_yaw + (to_yaw - from_yaw) * eased;
        Foot { x: p.x, y: height, z: p.z, yaw, pitch: Curve::new(&pitch_keys).at(phase) }
    }
}

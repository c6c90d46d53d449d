//! Points that something leaves some room: a largest distance, and a plane they do not get behind.

use glam::{Vec3, Vec3A};

use super::{Coarse, Workspace};

/// Where one point may be at the step's end.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tether {
    /// Which point; one that is pinned is not held.
    pub point: u32,
    /// The middle of its room (m).
    pub at: Vec3,
    /// How far from there it gets (m).
    pub reach_m: f32,
    /// Unit vector of the plane; zero for none.
    pub normal: Vec3,
    /// Along it from `at`, it never lies lower (m).
    pub floor_m: f32,
}

impl Tether {
    pub(super) fn is_sound(&self, points: usize, far: f32) -> bool {
        let placed = !self.at.is_nan() && self.at.abs().max_element() <= far;
        let turned = !self.normal.is_nan() && self.normal.length_squared() <= 1.1;
        let room = (0.0..=far).contains(&self.reach_m) && self.floor_m.abs() <= far;
        (self.point as usize) < points && placed && turned && room
    }
}

impl Coarse {
    pub(super) fn hold_tethers(&self, tethers: &[Tether], ws: &mut Workspace) {
        for tether in tethers.iter().filter(|t| self.places[t.point as usize] != usize::MAX) {
            let x = &mut ws.x[tether.point as usize];
            let (at, normal) = (Vec3A::from(tether.at), Vec3A::from(tether.normal));
            let mut off = *x - at;
            if normal != Vec3A::ZERO {
                off += normal * (tether.floor_m - normal.dot(off)).max(0.0);
            }
            *x = at + off.clamp_length_max(tether.reach_m);
        }
    }
}

//! What a simulated frame must look like. A frame that does not is simulated again at a finer
//! step; what cannot be healed is flagged, so that nobody merges into it.
//!
//! Verdicts depend on the frame alone: a frame gets the same one in every run.

use cloth::Vec3;
use cloth::measure::DEPTH_REACH_M;
use cloth::surface::{Posed, Surface};

use crate::simulator::FrameQuality;

/// By how much finer than usual a frame is simulated, attempt after attempt.
pub const REFINE: [u32; 3] = [1, 2, 4];
/// Longer edges are a fault: the strain limit promises less (`cloth::solver`), and cloth that is
/// longer is seen as rubber.
pub const STRAIN_MAX: f32 = 0.15;
/// Cloth may be faster than the body by this factor: the tip of a whip is, but where nothing
/// holds it, energy was made.
pub const SPEED_OVER_BODY: f32 = 2.0;
/// ... and this much faster on top (m/s): a second of free fall.
pub const SPEED_FREE_M_S: f32 = 9.81;
/// Vertices deeper than this, and not held between body parts, are counted as inside (m).
pub const INSIDE_M: f32 = 0.001;
/// As deep (m): skin would be seen through cloth.
pub const DEEP_M: f32 = 0.005;
/// A frame is at fault where a larger part of its vertices is deep: one in two hundred is a spot,
/// no tangle.
pub const DEEP_SHARE_MAX: f32 = 0.005;

/// Why a frame is out of bounds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Fault {
    /// An edge is longer than cloth can be: its strain.
    Strain(f32),
    /// A vertex is faster than the body could make it (m/s).
    Speed(f32),
    /// This part of the vertices is deep in the body.
    Deep(f32),
    /// The cloth cuts itself in more places than before: so many. A tangle that is not growing is
    /// being worked out, and no fault of this frame.
    Crossings(u64),
}

impl Fault {
    /// Whether a finer step has not even halved the fault: a still finer one is not worth its
    /// cost. So it is where skin, strain limit and contact contradict each other.
    pub fn resists(&self, before: &Self) -> bool {
        match (self, before) {
            (Self::Deep(now), Self::Deep(before)) => now * 2.0 > *before,
            (Self::Crossings(now), Self::Crossings(before)) => now * 2 > *before,
            _ => false,
        }
    }

    /// Whether this is the lesser of two: a fault that is looked for later, since those before it
    /// are gone, or less of the same.
    pub fn is_less_than(&self, other: &Self) -> bool {
        let rank = |fault: &Self| match *fault {
            Self::Crossings(count) => (0, count as f32),
            Self::Deep(share) => (1, share),
            Self::Speed(speed_m_s) => (2, speed_m_s),
            Self::Strain(strain) => (3, strain),
        };
        rank(self) < rank(other)
    }

    /// The first fault of one frame.
    ///
    /// * `body_speed_m_s`: speed of the body's fastest point.
    pub fn of(quality: &FrameQuality, body_speed_m_s: f32) -> Option<Self> {
        let deep = quality.deep_vertex_frames as f32 / quality.vertex_frames.max(1) as f32;
        let speed = quality.speed_max_m_s;
        if quality.stretch_max > STRAIN_MAX {
            Some(Self::Strain(quality.stretch_max))
        } else if speed > SPEED_OVER_BODY * body_speed_m_s + SPEED_FREE_M_S {
            Some(Self::Speed(speed))
        } else {
            (deep > DEEP_SHARE_MAX).then_some(Self::Deep(deep))
        }
    }
}

/// Counts the vertices that are inside the body, those held between two parts of it apart.
///
/// * `positions`: of the cloth in the world (m).
/// * `offset_m`: the distance that cloth keeps from the body.
pub fn measure_depth(
    surface: &Surface,
    posed: &Posed,
    positions: &[Vec3],
    offset_m: f32,
    quality: &mut FrameQuality,
) {
    for p in positions {
        let Some(contact) = surface.closest(posed, *p, DEPTH_REACH_M) else { continue };
        let depth = -contact.distance;
        if depth <= 0.0 {
            continue;
        }
        let matters = depth > INSIDE_M || depth > quality.depth_max_m;
        if matters && surface.is_pinched(posed, &contact, offset_m) {
            quality.pinched_vertex_frames += u64::from(depth > INSIDE_M);
            continue;
        }
        quality.inside_vertex_frames += u64::from(depth > INSIDE_M);
        quality.deep_vertex_frames += u64::from(depth > DEEP_M);
        quality.depth_max_m = quality.depth_max_m.max(depth);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn calm() -> FrameQuality {
        FrameQuality { frames: 1, vertex_frames: 1000, stretch_max: 0.1, ..FrameQuality::default() }
    }

    #[test]
    fn each_bound_is_watched() {
        assert_eq!(Fault::of(&calm(), 0.0), None);
        let long = FrameQuality { stretch_max: 0.16, ..calm() };
        assert_eq!(Fault::of(&long, 0.0), Some(Fault::Strain(0.16)));
        let fast = FrameQuality { speed_max_m_s: 20.0, ..calm() };
        assert_eq!(Fault::of(&fast, 4.0), Some(Fault::Speed(20.0)));
        assert_eq!(Fault::of(&fast, 6.0), None, "a fast body makes cloth fast");
        let deep = FrameQuality { deep_vertex_frames: 6, inside_vertex_frames: 9, ..calm() };
        assert_eq!(Fault::of(&deep, 0.0), Some(Fault::Deep(0.006)));
        assert!(Fault::Deep(0.006).resists(&Fault::Deep(0.01)));
        assert!(!Fault::Deep(0.006).resists(&Fault::Deep(0.02)));
        assert!(!Fault::Deep(0.006).resists(&Fault::Speed(20.0)), "another fault");
        assert!(Fault::Crossings(3).resists(&Fault::Crossings(4)));
        assert!(Fault::Deep(0.006).is_less_than(&Fault::Deep(0.007)));
        assert!(!Fault::Deep(0.007).is_less_than(&Fault::Deep(0.007)));
        assert!(Fault::Crossings(9).is_less_than(&Fault::Strain(0.2)), "it holds together again");
        assert!(!Fault::Speed(20.0).is_less_than(&Fault::Deep(0.5)));
        let spot = FrameQuality { deep_vertex_frames: 5, ..calm() };
        assert_eq!(Fault::of(&spot, 0.0), None);
    }
}

//! The distance by which transitions are found, and the alignment that minimises it.
//!
//! Kovar, Gleicher and Pighin 2002, section 3.1: the squared distance of corresponding points
//! over a window of frames, after the best turn about the vertical axis and the best horizontal
//! shift, both in closed form. Weights are uniform; points are joint positions.

use cloth::{Rigid, Skeleton, Vec3};

use super::character::Clip;

/// Frames before and after the cut that are compared: a window of 5 frames.
pub const WINDOW_REACH: usize = 2;
/// Frames of the window.
pub const WINDOW: usize = 2 * WINDOW_REACH + 1;

/// Joints that are compared: all but thumbs and finger bases, whose captured motion is noise.
pub fn compared_joints(skeleton: &Skeleton) -> Vec<usize> {
    let noise = |name: &str| name.contains("Thumb") || name.contains("FingerBase");
    (0..skeleton.joint_count()).filter(|j| !noise(&skeleton.names[*j])).collect()
}

/// World positions of the compared joints in every frame of a clip, with
/// [`WINDOW_REACH`] frames extrapolated linearly before it and one more after it, so that the
/// window around the frame that would follow the last one exists too.
#[derive(Debug, Clone)]
pub struct JointTrack {
    joints: usize,
    frames: usize,
    positions: Vec<Vec3>,
}

impl JointTrack {
    /// Positions of `joints` along `clip`, which has at least one frame.
    pub fn new(skeleton: &Skeleton, clip: &Clip, joints: &[usize]) -> Self {
        let frames = clip.poses.len();
        let mut world = Vec::new();
        let mut inside = Vec::with_capacity(frames * joints.len());
        for pose in &clip.poses {
            skeleton.world(pose, &mut world);
            inside.extend(joints.iter().map(|j| world[*j].translation));
        }
        let row = |frame: usize| &inside[frame * joints.len()..(frame + 1) * joints.len()];
        let beyond = |at: usize, before: usize, steps: usize| {
            let pairs = row(at).iter().zip(row(before));
            pairs.map(move |(a, b)| *a + (*a - *b) * steps as f32).collect::<Vec<_>>()
        };
        let mut positions = Vec::new();
        for steps in (1..=WINDOW_REACH).rev() {
            positions.extend(beyond(0, 1.min(frames - 1), steps));
        }
        positions.extend_from_slice(&inside);
        for steps in 1..=WINDOW_REACH + 1 {
            positions.extend(beyond(frames - 1, frames.saturating_sub(2), steps));
        }
        Self { joints: joints.len(), frames, positions }
    }

    /// Frames of the clip.
    pub fn frame_count(&self) -> usize {
        self.frames
    }

    /// Compared joints.
    pub fn joint_count(&self) -> usize {
        self.joints
    }

    /// Frames that are kept: those of the clip and the extrapolated ones.
    pub(super) fn stored_count(&self) -> usize {
        self.frames + WINDOW
    }

    /// Joint positions of a kept frame, the first being [`WINDOW_REACH`] before the clip's.
    pub(super) fn stored(&self, frame: usize) -> &[Vec3] {
        &self.positions[frame * self.joints..(frame + 1) * self.joints]
    }

    /// Joint positions of frames `frame - 2 ..= frame + 2`; `frame` may be one past the last.
    pub fn window(&self, frame: usize) -> &[Vec3] {
        &self.positions[frame * self.joints..(frame + WINDOW) * self.joints]
    }
}

/// How well two windows fit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fit {
    /// Turn of the target about +y (rad), before the shift.
    pub yaw: f32,
    /// Shift of the target along x and z (m).
    pub shift: [f32; 2],
    /// Root mean square of the distances that are left (m).
    pub distance_m: f32,
}

impl Fit {
    /// Moves the target into the world of the source.
    pub fn alignment(&self) -> Rigid {
        Rigid::from_yaw(self.yaw, Vec3::new(self.shift[0], 0.0, self.shift[1]))
    }
}

/// The turn and shift that bring `target` nearest to `source` (point by point, equal lengths).
///
/// Where all points lie on one vertical axis, any turn is as good; 0 is taken.
pub fn fit(source: &[Vec3], target: &[Vec3]) -> Fit {
    debug_assert_eq!(source.len(), target.len());
    let mut sums = Sums::default();
    for (p, q) in source.iter().zip(target) {
        sums.add(*p, *q);
    }
    sums.fit()
}

/// Sums over pairs of points, in f64 because large squares cancel.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    count: f64,
    source: [f64; 2],
    target: [f64; 2],
    cos: f64,
    sin: f64,
    squares: f64,
}

impl Sums {
    fn add(&mut self, p: Vec3, q: Vec3) {
        let [px, py, pz] = p.to_array().map(f64::from);
        let [qx, qy, qz] = q.to_array().map(f64::from);
        self.count += 1.0;
        self.source[0] += px;
        self.source[1] += pz;
        self.target[0] += qx;
        self.target[1] += qz;
        self.cos += px * qx + pz * qz;
        self.sin += px * qz - pz * qx;
        self.squares += px * px + pz * pz + qx * qx + qz * qz + (py - qy) * (py - qy);
    }

    fn fit(&self) -> Fit {
        let n = self.count.max(1.0);
        let [sx, sz] = self.source;
        let [tx, tz] = self.target;
        let cos = self.cos - (sx * tx + sz * tz) / n;
        let sin = self.sin - (sx * tz - sz * tx) / n;
        let squares = self.squares - (sx * sx + sz * sz + tx * tx + tz * tz) / n;
        let yaw = sin.atan2(cos);
        let left = (squares - 2.0 * cos.hypot(sin)).max(0.0);
        let (s, c) = yaw.sin_cos();
        Fit {
            yaw: yaw as f32,
            shift: [((sx - tx * c - tz * s) / n) as f32, ((sz + tx * s - tz * c) / n) as f32],
            distance_m: (left / n).sqrt() as f32,
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn cloud() -> Vec<Vec3> {
        (0..40)
            .map(|i| {
                let f = i as f32;
                Vec3::new((f * 1.7).sin(), (f * 0.3).cos(), (f * 0.9).cos() * 2.0)
            })
            .collect()
    }

    proptest! {
        #[test]
        fn a_known_motion_is_found(yaw in -3.1f32..3.1, x in -5.0f32..5.0, z in -5.0f32..5.0) {
            let target = cloud();
            let moved = Rigid::from_yaw(yaw, Vec3::new(x, 0.0, z));
            let source: Vec<_> = target.iter().map(|p| moved.point(*p)).collect();
            let fit = fit(&source, &target);
            prop_assert!((fit.yaw - yaw).abs() < 1e-4);
            prop_assert!((fit.shift[0] - x).abs() < 1e-3 && (fit.shift[1] - z).abs() < 1e-3);
            prop_assert!(fit.distance_m < 1e-3);
        }
    }

    #[test]
    fn the_fit_is_a_minimum() {
        let target = cloud();
        let source: Vec<_> =
            target.iter().rev().map(|p| *p * 1.1 + Vec3::new(0.3, 0.2, -1.0)).collect();
        let best = fit(&source, &target);
        let rms = |yaw: f32, x: f32, z: f32| {
            let moved = Rigid::from_yaw(yaw, Vec3::new(x, 0.0, z));
            let sum: f32 =
                source.iter().zip(&target).map(|(p, q)| p.distance_squared(moved.point(*q))).sum();
            (sum / source.len() as f32).sqrt()
        };
        let [x, z] = best.shift;
        assert!((rms(best.yaw, x, z) - best.distance_m).abs() < 1e-4);
        for (dy, dx, dz) in
            [(0.01, 0.0, 0.0), (-0.01, 0.0, 0.0), (0.0, 0.02, 0.0), (0.0, 0.0, -0.02)]
        {
            assert!(rms(best.yaw + dy, x + dx, z + dz) > best.distance_m);
        }
    }
}

//! Makes the poses of a transition: the target clip, with an offset to the source that decays.
//!
//! Inertialisation (Bollo, "Inertialization: high-performance animation transitions", GDC 2018),
//! here with one quintic per component of the offset, so that its value and velocity are met
//! where the source is left, and value, velocity and acceleration are zero where the target clip
//! is joined. Joint rotations and the root's position are treated alike.

use cloth::{Pose, Quat, Skeleton, Vec3};

use super::align::{self, Fit, JointTrack};
use super::character::Clip;

/// Frames of a transition (design decision 3), where the target clip has that many left.
pub const TRANSITION_FRAMES: usize = 10;
/// A transition must have this many frames of its target clip left.
pub const TRANSITION_FRAMES_MIN: usize = 4;

/// A transition: after `from_frame` of `from_clip` the target is played from `to_frame`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Transition {
    /// Index of the clip that is left.
    pub from_clip: usize,
    /// Its last frame that is shown.
    pub from_frame: usize,
    /// Index of the clip that is entered.
    pub to_clip: usize,
    /// Its first frame, shown with the full offset.
    pub to_frame: usize,
    /// Distance by which it was found (m) (see [`mod@super::align`]); not used to build it.
    pub distance_m: f32,
}

/// A transition as poses of its own.
#[derive(Debug, Clone, PartialEq)]
pub struct Run {
    /// Poses in the world of the target clip; the first follows `from_frame`.
    pub poses: Vec<Pose>,
    /// Where the target clip is joined after the last pose: a frame of it.
    pub joins: usize,
    /// Moves the target's world into the source's.
    pub fit: Fit,
}

/// How many poses of its own a transition into `to_frame` of a clip of `frames` frames has.
pub fn run_length(frames: usize, to_frame: usize) -> usize {
    TRANSITION_FRAMES.min((frames - 1).saturating_sub(to_frame))
}

/// Makes the poses of a transition. Frames must lie inside their clips.
pub fn run(clips: &[Clip], tracks: &[JointTrack], transition: &Transition) -> Run {
    let Transition { from_clip, from_frame, to_clip, to_frame, .. } = *transition;
    let source_window = tracks[from_clip].window(from_frame + 1);
    let fit = align::fit(source_window, tracks[to_clip].window(to_frame));
    let to_target = fit.alignment().inverse();
    let (source, target) = (&clips[from_clip].poses, &clips[to_clip].poses);
    let shown = source[from_frame].moved(&to_target);
    let follows = pose_at(source, from_frame as isize + 1).moved(&to_target);
    let before = pose_at(target, to_frame as isize - 1);
    let offset = Offset::between(&shown, &before, &follows, &target[to_frame]);
    let length = run_length(target.len(), to_frame);
    let poses = (0..length)
        .map(|k| offset.applied(&target[to_frame + k], k as f32 / length as f32, length as f32))
        .collect();
    Run { poses, joins: to_frame + length, fit }
}

/// Tracks of all clips, as [`run`] needs them.
pub fn tracks(skeleton: &Skeleton, clips: &[Clip]) -> Vec<JointTrack> {
    let joints = align::compared_joints(skeleton);
    clips.iter().map(|clip| JointTrack::new(skeleton, clip, &joints)).collect()
}

/// The pose of a frame; one before the first or after the last goes on as the clip began or ended.
fn pose_at(poses: &[Pose], frame: isize) -> Pose {
    let last = poses.len() as isize - 1;
    if (0..=last).contains(&frame) || last == 0 {
        return poses[frame.clamp(0, last) as usize].clone();
    }
    let (end, inner) = if frame < 0 { (0, 1) } else { (last, last - 1) };
    let (end, inner) = (&poses[end as usize], &poses[inner as usize]);
    let turn = |(e, i): (&Quat, &Quat)| (*e * (i.conjugate() * *e)).normalize();
    Pose {
        root: end.root * 2.0 - inner.root,
        rotations: end.rotations.iter().zip(&inner.rotations).map(turn).collect(),
    }
}

/// What separates the source from the target where the target is entered, and how fast it grows.
struct Offset {
    root: Vec3,
    root_per_frame: Vec3,
    /// Rotation vectors: source = exp(turn) * target.
    turns: Vec<Vec3>,
    turns_per_frame: Vec<Vec3>,
}

impl Offset {
    /// From source and target one frame before the cut and at the cut.
    fn between(source0: &Pose, target0: &Pose, source1: &Pose, target1: &Pose) -> Self {
        let root = source1.root - target1.root;
        let turn = |source: &Quat, target: &Quat| (*source * target.conjugate()).normalize();
        let mut turns = Vec::new();
        let mut turns_per_frame = Vec::new();
        for joint in 0..source1.rotations.len() {
            let now = short(turn(&source1.rotations[joint], &target1.rotations[joint]));
            let was = turn(&source0.rotations[joint], &target0.rotations[joint]);
            let was = if was.dot(now) < 0.0 { -was } else { was };
            turns.push(log(now));
            turns_per_frame.push(log(now) - log(was));
        }
        let root_per_frame = root - (source0.root - target0.root);
        Self { root, root_per_frame, turns, turns_per_frame }
    }

    /// `target` with what is left of the offset after the share `s` of `length` frames.
    fn applied(&self, target: &Pose, s: f32, length: f32) -> Pose {
        let (value, slope) = decay(s);
        let slope = slope * length;
        let left = self.turns.iter().zip(&self.turns_per_frame);
        let left = left.map(|(x, v)| Quat::from_scaled_axis(*x * value + *v * slope));
        let turned = left.zip(&target.rotations).map(|(turn, q)| (turn * *q).normalize());
        Pose {
            root: target.root + self.root * value + self.root_per_frame * slope,
            rotations: turned.collect(),
        }
    }
}

/// The quintics that start with value 1 and slope 0, or value 0 and slope 1 (and no
/// acceleration), and end at 1 with value, slope and acceleration 0.
fn decay(s: f32) -> (f32, f32) {
    let (s3, s4, s5) = (s.powi(3), s.powi(4), s.powi(5));
    (1.0 - 10.0 * s3 + 15.0 * s4 - 6.0 * s5, s - 6.0 * s3 + 8.0 * s4 - 3.0 * s5)
}

fn short(q: Quat) -> Quat {
    if q.w < 0.0 { -q } else { q }
}

/// Rotation vector of a unit quaternion, angle in 0..2 pi: continuous where w changes sign.
fn log(q: Quat) -> Vec3 {
    let v = Vec3::new(q.x, q.y, q.z);
    let sine = v.length();
    if sine < 1e-6 { v * 2.0 } else { v * (2.0 * sine.atan2(q.w) / sine) }
}

#[cfg(test)]
mod tests {
    use super::super::synthetic::{chain, walk};
    use super::*;

    #[test]
    fn the_first_pose_is_what_would_have_followed_and_the_last_leads_into_the_target() {
        let clips = [walk("walk", 40, 1.0, 0.1), walk("run", 40, 1.4, 0.5)];
        let skeleton = chain();
        let tracks = tracks(&skeleton, &clips);
        for (from_frame, to_frame) in [(20, 10), (39, 0), (39, 33)] {
            let transition =
                Transition { from_clip: 0, from_frame, to_clip: 1, to_frame, distance_m: 0.0 };
            let run = run(&clips, &tracks, &transition);
            assert_eq!(run.poses.len(), TRANSITION_FRAMES.min(39 - to_frame));
            assert_eq!(run.joins, to_frame + run.poses.len());
            let into_source = run.fit.alignment();
            let follows = pose_at(&clips[0].poses, from_frame as isize + 1);
            let first = run.poses[0].moved(&into_source);
            assert!(first.root.distance(follows.root) < 1e-5);
            for (a, b) in first.rotations.iter().zip(&follows.rotations) {
                assert!(a.dot(*b).abs() > 1.0 - 1e-6);
            }
            // Accelerations stay those of the clips and of a smooth decay.
            let mut path: Vec<Vec3> = vec![clips[0].poses[from_frame].root];
            path.extend(run.poses.iter().map(|p| into_source.point(p.root)));
            path.extend(
                clips[1].poses[run.joins..].iter().take(3).map(|p| into_source.point(p.root)),
            );
            for three in path.windows(3) {
                let bend = (three[2] - three[1] * 2.0 + three[0]).length();
                assert!(bend < 0.012, "a jump of {bend} m per frame^2");
            }
        }
    }

    #[test]
    fn quintics_start_and_end_as_said() {
        let h = 1e-3;
        let (value0, slope0) = decay(0.0);
        let (value_h, slope_h) = decay(h);
        assert_eq!((value0, slope0), (1.0, 0.0));
        assert!((value_h - 1.0).abs() < 1e-6 && (slope_h / h - 1.0).abs() < 1e-4);
        let (value1, slope1) = decay(1.0);
        let (value_e, slope_e) = decay(1.0 - h);
        assert!(value1.abs() < 1e-6 && slope1.abs() < 1e-6);
        assert!(value_e.abs() < 1e-6 && slope_e.abs() < 1e-6);
    }
}

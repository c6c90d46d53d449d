//! Small characters for tests.

use cloth::{Pose, Quat, Rigid, Skeleton, Vec3};

use super::character::Clip;

/// Hips, spine and head, one above the other.
pub(super) fn chain() -> Skeleton {
    let offsets = [Vec3::Y, Vec3::new(0.1, 0.3, 0.0), Vec3::new(0.0, 0.3, 0.1)];
    let mut at = Vec3::ZERO;
    let rest = offsets.map(|o| {
        at += o;
        Rigid { rotation: Quat::IDENTITY, translation: at }
    });
    Skeleton {
        names: ["Hips", "Spine", "Head"].map(String::from).to_vec(),
        parents: vec![None, Some(0), Some(1)],
        offsets: offsets.to_vec(),
        rest: rest.to_vec(),
    }
}

/// A clip of [`chain`] that walks straight on, swaying.
pub(super) fn walk(name: &str, frames: i32, speed: f32, bend: f32) -> Clip {
    let pose = |frame: i32| {
        let t = frame as f32 / 30.0;
        Pose {
            root: Vec3::new(0.0, 1.0 + bend * 0.1, speed * t),
            rotations: vec![
                Quat::from_rotation_y(0.1 * t),
                Quat::from_rotation_x(bend + bend * t),
                Quat::from_rotation_z(0.3 * bend * (4.0 * t).sin()),
            ],
        }
    };
    Clip { name: name.into(), poses: (0..frames).map(pose).collect() }
}

/// Two clips of 60 frames.
pub(super) fn two_walks() -> (Skeleton, Vec<Clip>) {
    (chain(), vec![walk("walk", 60, 1.0, 0.1), walk("run", 60, 1.2, 0.2)])
}

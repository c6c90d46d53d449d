//! Where a character is in the world: the alignments of all edges it walked, one after another.

use cloth::{Pose, Quat, Rigid, Vec3};
use protocol::{EdgeId, PoseId};

use crate::scene::Scene;

/// A pose, and the place of its clip in the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placement {
    pose: PoseId,
    /// Moves the pose's clip into the world.
    clip: Rigid,
}

impl Placement {
    /// `pose` where its clip has it.
    pub fn at(pose: PoseId) -> Self {
        Self { pose, clip: Rigid::IDENTITY }
    }

    /// The pose.
    pub fn pose(&self) -> PoseId {
        self.pose
    }

    /// The hips in the world: what moves a state frame into the world.
    pub fn hips(&self, scene: &Scene) -> Rigid {
        self.clip.after(&scene.hips(self.pose))
    }

    /// The whole pose in the world, for skinning.
    pub fn world_pose(&self, scene: &Scene) -> Pose {
        scene.pose(self.pose).moved(&self.clip)
    }

    /// As [`Placement::world_pose`], into a pose that keeps its memory.
    pub fn world_pose_into(&self, scene: &Scene, pose: &mut Pose) {
        scene.pose_into(self.pose, pose);
        pose.root = self.clip.point(pose.root);
        if let Some(hips) = pose.rotations.first_mut() {
            *hips = (self.clip.rotation * *hips).normalize();
        }
    }

    /// Walks along an edge: the target's clip is placed by the edge's alignment.
    pub fn walk(&mut self, scene: &Scene, edge: EdgeId) {
        self.clip = self.clip.after(&scene.alignment(edge));
        self.pose = scene.edges()[edge.index()].to;
    }

    /// Goes on at a pose that is no successor: its hips take the horizontal place of the hips
    /// before, and face the same way as nearly as a turn about +y can make them.
    pub fn jump(&mut self, scene: &Scene, pose: PoseId) {
        let before = self.hips(scene);
        let target = scene.hips(pose);
        let turn = before.rotation * target.rotation.conjugate();
        let yaw = twist_about_y(turn);
        let turned = Rigid::from_yaw(yaw, Vec3::ZERO).point(target.translation);
        let shift = before.translation - turned;
        self.clip = Rigid::from_yaw(yaw, Vec3::new(shift.x, 0.0, shift.z));
        self.pose = pose;
    }
}

/// The turn about +y (rad) nearest to a rotation; 0 where all turns are equally near.
fn twist_about_y(turn: Quat) -> f32 {
    if turn.y.abs() < 1e-6 && turn.w.abs() < 1e-6 { 0.0 } else { 2.0 * turn.y.atan2(turn.w) }
}

/// Between two placements: positions on a line, rotations on the short way. `phase` in 0..=1.
pub fn between(from: &Rigid, to: &Rigid, phase: f32) -> Rigid {
    Rigid {
        rotation: from.rotation.slerp(to.rotation, phase),
        translation: from.translation.lerp(to.translation, phase),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tiny;

    #[test]
    fn a_walk_is_continuous_in_the_world() {
        // Pose 1 -> 0 closes the tiny loop with an alignment that undoes the clip's own way, so
        // the hips go on evenly for ever, turning by the same angle each time.
        let scene = Scene::new(tiny::scene_chunk()).unwrap();
        let mut placement = Placement::at(PoseId(0));
        let mut before = placement.hips(&scene);
        let mut steps = Vec::new();
        for step in 0..40u32 {
            let next = PoseId((step + 1) % 2);
            let edge = scene.edge_between(placement.pose(), next).unwrap();
            placement.walk(&scene, edge);
            let hips = placement.hips(&scene);
            steps.push((hips.translation - before.translation).length());
            before = hips;
        }
        assert!(steps.iter().all(|step| (step - tiny::STRIDE_M).abs() < 1e-3), "{steps:?}");
        assert!(before.translation.length() > 20.0 * 0.5 * tiny::STRIDE_M, "it got somewhere");
    }

    #[test]
    fn a_jump_keeps_place_and_heading() {
        let scene = Scene::new(tiny::scene_chunk()).unwrap();
        let mut placement = Placement::at(PoseId(0));
        for next in [1, 0, 1, 0, 0, 1] {
            let edge = scene.edge_between(placement.pose(), PoseId(next)).unwrap();
            placement.walk(&scene, edge);
        }
        let before = placement.hips(&scene);
        placement.jump(&scene, PoseId(1));
        let after = placement.hips(&scene);
        assert!((after.translation - before.translation).length() < 1e-4);
        assert!(after.rotation.angle_between(before.rotation) < 1e-3);
    }
}

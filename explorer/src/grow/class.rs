//! Classes of states: hood up, hood down (Kim et al. 2013, section 3.3).
//!
//! A rule asks on which side of a plane, carried along by a joint, the mean place of a region of
//! the garment lies. A state's class holds one bit of each rule's answer. A merge that goes the
//! implausible way costs a penalty: it ranks the queue and steers merges, and is never part of an
//! error that is reported. One more bit is the watchdog's flag: merging into a flagged state costs
//! more than any error.

use cloth::{Rigid, Vec3};
use protocol::PoseId;

use crate::grid::{GridState, POSITION_STEP_M};
use crate::scene::{CLASS_RULES_MAX, ClassRule, Scene};
use crate::simulator::FrameQuality;

/// A state's class: bit `i` is set where the `i`th rule's value is its second.
pub type Class = u8;

/// The class bit of states whose frame came out of bounds (see [`crate::watchdog`]).
pub const FLAGGED: Class = 1 << CLASS_RULES_MAX;
/// What merging into a flagged state costs (m): more than any error, so that it is done only where
/// a pose has nothing better, and that such a merge is undone first.
const FLAGGED_M: f32 = 1000.0;

/// The class bit of a frame by its measures.
pub fn flag(quality: &FrameQuality) -> Class {
    if quality.frames_flagged > 0 { FLAGGED } else { 0 }
}

/// What merges between classes cost; see the module.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Penalties(Vec<([u8; 2], f32)>);

impl Penalties {
    /// Of a scene's rules.
    pub fn new(rules: &[ClassRule]) -> Self {
        Self(rules.iter().map(|rule| (rule.implausible, rule.penalty_m)).collect())
    }

    /// What it costs to merge a state of class `from` into one of class `to` (m).
    pub fn of(&self, from: Class, to: Class) -> f32 {
        let bit = |class: Class, rule: usize| class >> rule & 1;
        let crossed = |(rule, (way, _)): &(usize, &([u8; 2], f32))| {
            [bit(from, *rule), bit(to, *rule)] == *way && way[0] != way[1]
        };
        let crossed = self.0.iter().enumerate().filter(crossed);
        let crossed = crossed.map(|(_, (_, penalty_m))| penalty_m).sum::<f32>() + 0.0;
        if to & FLAGGED != 0 { crossed + FLAGGED_M } else { crossed }
    }
}

/// Tells the class of a scene's states.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Classifier {
    regions: Vec<Vec<u32>>,
    /// By pose, then rule: a direction in the state frame and an offset (m).
    planes: Vec<Vec<(Vec3, f32)>>,
}

impl Classifier {
    /// Of a scene; cheap where it has no rules.
    pub fn new(scene: &Scene) -> Self {
        let rules = &scene.metric.classes;
        assert!(rules.len() <= CLASS_RULES_MAX, "at most {CLASS_RULES_MAX} rules");
        if rules.is_empty() {
            return Self::default();
        }
        let skeleton = &scene.body.skeleton;
        let mut world = Vec::new();
        let mut of_pose = |pose: &crate::primary::PrimaryPose| {
            skeleton.world(&pose.pose, &mut world);
            let hips = pose.pose.hips();
            let plane = |rule: &ClassRule| {
                let joint = usize::from(rule.joint);
                plane(rule, &world[joint], &skeleton.rest[joint], &hips)
            };
            rules.iter().map(plane).collect()
        };
        let planes = scene.primary.poses().iter().map(&mut of_pose).collect();
        Self { regions: rules.iter().map(|rule| rule.vertices.clone()).collect(), planes }
    }

    /// The class of a state.
    pub fn class(&self, pose: PoseId, state: &GridState) -> Class {
        let sides = self.heights(pose, state).enumerate();
        sides.fold(0, |class, (rule, height_m)| class | u8::from(height_m > 0.0) << rule)
    }

    /// How far the mean place of each rule's region lies above its plane (m), in the rules' order.
    pub fn heights(&self, pose: PoseId, state: &GridState) -> impl Iterator<Item = f32> {
        self.regions.iter().enumerate().map(move |(rule, vertices)| {
            let mut sum = [0i64; 3];
            for vertex in vertices {
                let place = state.positions[*vertex as usize];
                sum = [0, 1, 2].map(|axis| sum[axis] + i64::from(place[axis]));
            }
            let mean = sum.map(|s| s as f32 / vertices.len().max(1) as f32 * POSITION_STEP_M);
            let (direction, offset_m) = self.planes[pose.index()][rule];
            direction.dot(Vec3::from_array(mean)) + offset_m
        })
    }
}

/// The rule's plane in a pose's state frame.
fn plane(rule: &ClassRule, joint: &Rigid, rest: &Rigid, hips: &Rigid) -> (Vec3, f32) {
    let carried = joint.rotation * rest.rotation.conjugate() * rule.axis;
    let direction = hips.rotation.conjugate() * carried;
    let offset_m = carried.dot(hips.translation - joint.translation) - rule.threshold_m;
    (direction, offset_m)
}

/// A class in words: `hood up, collar open`; empty without rules.
pub fn name(rules: &[ClassRule], class: Class) -> String {
    let value = |(i, rule): (usize, &ClassRule)| {
        format!("{} {}", rule.name, rule.values[usize::from(class >> i & 1)])
    };
    rules.iter().enumerate().map(value).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use cloth::Quat;

    use super::*;
    use crate::grow::toy;
    use crate::primary::PrimaryGraph;

    fn rule() -> ClassRule {
        ClassRule {
            name: "hood".into(),
            values: ["down".into(), "up".into()],
            joint: 0,
            vertices: vec![0, 2],
            axis: Vec3::Y,
            threshold_m: 0.25,
            implausible: [0, 1],
            penalty_m: 1.5,
        }
    }

    #[test]
    fn a_region_is_above_or_below_wherever_the_character_is() {
        let mut scene = toy::scene(toy::knot(), toy::settings());
        scene.metric.classes = vec![rule()];
        // The joint is the hips, so the class depends on the state alone, whatever the pose.
        let mut poses = scene.primary.poses().to_vec();
        for (i, pose) in poses.iter_mut().enumerate() {
            pose.pose.root = Vec3::new(i as f32, 0.3, -2.0);
            pose.pose.rotations[0] = Quat::from_rotation_z(0.7 * i as f32);
        }
        let edges = scene.primary.edges().to_vec();
        let primary = PrimaryGraph::new(30.0, vec!["toy".into()], poses, edges).unwrap();
        scene.primary = Arc::new(primary);
        let classifier = Classifier::new(&scene);
        let mut state = GridState { positions: vec![[0; 3]; 3], velocities: vec![[0; 3]; 3] };
        for pose in 0..6 {
            state.positions[2] = [0, 8_000, 0];
            assert_eq!(classifier.class(PoseId(pose), &state), 0, "mean at 0.244 m");
            state.positions[2] = [0, 8_400, 0];
            assert_eq!(classifier.class(PoseId(pose), &state), 1, "mean at 0.256 m");
        }
        assert_eq!(name(&scene.metric.classes, 1), "hood up");
    }

    #[test]
    fn only_the_implausible_way_costs() {
        let penalties = Penalties::new(&[rule()]);
        let costs: Vec<f32> =
            [(0, 1), (1, 0), (0, 0), (1, 1)].iter().map(|(a, b)| penalties.of(*a, *b)).collect();
        assert_eq!(costs, [1.5, 0.0, 0.0, 0.0]);
        assert!(Penalties::default().of(0, 1).abs() < 1e-9);
        assert!(penalties.of(0, FLAGGED) >= 1000.0 && penalties.of(FLAGGED, 1) < 2.0);
    }
}

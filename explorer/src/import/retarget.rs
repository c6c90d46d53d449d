//! Brings the motion of a BVH skeleton onto a character with the same joints.
//!
//! The world rotation of a joint is that of the BVH joint times a constant correction, which
//! turns the character's bone in its rest pose into the direction of the BVH's bone at zero
//! angles; corrections are chained along a limb, so that thigh and shin do not twist against each
//! other. The midpoint of the hip joints follows the BVH's, scaled by the length of the legs.

use cloth::{Pose, Quat, Skeleton, Vec3};
use protocol::limits::POSES_MAX;

use super::bvh::{Bvh, BvhError};
use super::character::Clip;

/// A bone that points down by this share of its length in the rest pose is part of a leg.
const DOWN: f32 = 0.7;
/// Joints whose bones are aligned, by what their names contain in small letters. The trunk is not:
/// there the places of joints differ between skeletons, not the pose.
const LIMBS: [&str; 6] = ["leg", "arm", "thigh", "calf", "shin", "elbow"];

/// Retargets a motion, sampled at `fps`.
///
/// # Errors
/// Joints that the other does not have, or a character without two legs to measure.
pub fn retarget(name: &str, bvh: &Bvh, skeleton: &Skeleton, fps: f32) -> Result<Clip, BvhError> {
    let map = joint_map(bvh, skeleton)?;
    let correction = corrections(bvh, skeleton, &map);
    let legs = Legs::find(skeleton)?;
    let scale = legs.length(|joint| skeleton.offsets[joint])
        / legs.length(|joint| map[joint].map_or(Vec3::ZERO, |source| bvh.joints[source].offset));
    let frames = ((bvh.duration_s() * fps).round() as usize).saturating_add(1);
    if frames > POSES_MAX || !scale.is_finite() {
        return Err(BvhError::Skeleton(format!(
            "{frames} frames and a scale of {scale}: at most {POSES_MAX} frames are allowed, and \
             the legs of both skeletons need a length"
        )));
    }
    let [hip_left, hip_right] = legs.hips;
    let mut poses = Vec::with_capacity(frames);
    let (mut rotations, mut positions) = (Vec::new(), Vec::new());
    for frame in 0..frames {
        bvh_world(bvh, frame as f32 / fps, &mut rotations, &mut positions);
        let mut world: Vec<Quat> = Vec::with_capacity(map.len());
        for (joint, correction) in correction.iter().enumerate() {
            let turned = match (map[joint], skeleton.parents[joint]) {
                (Some(source), _) => rotations[source] * *correction,
                (None, Some(parent)) => {
                    let parent = usize::from(parent);
                    let [above, own] = [parent, joint].map(|j| skeleton.rest[j].rotation);
                    world[parent] * above.conjugate() * own
                }
                (None, None) => Quat::IDENTITY,
            };
            world.push(turned.normalize());
        }
        let place = |joint: usize| map[joint].map_or(Vec3::ZERO, |source| positions[source]);
        let middle = (place(hip_left) + place(hip_right)) * 0.5 * scale;
        let of_hips =
            (reach(skeleton, &world, hip_left) + reach(skeleton, &world, hip_right)) * 0.5;
        let local = |(joint, rotation): (usize, &Quat)| match skeleton.parents[joint] {
            None => *rotation,
            Some(parent) => (world[usize::from(parent)].conjugate() * *rotation).normalize(),
        };
        poses.push(Pose {
            root: middle - of_hips,
            rotations: world.iter().enumerate().map(local).collect(),
        });
    }
    Ok(Clip { name: name.to_owned(), poses })
}

/// The BVH joint of each joint. One at the end of a limb (a finger) may be missing: it keeps its
/// place on its parent.
fn joint_map(bvh: &Bvh, skeleton: &Skeleton) -> Result<Vec<Option<usize>>, BvhError> {
    let map = skeleton.names.iter().enumerate().map(|(joint, name)| {
        let found = bvh.joints.iter().position(|j| j.name == *name);
        let has_child = skeleton.parents.contains(&Some(joint as u16));
        if found.is_none() && (has_child || joint == 0) {
            return Err(BvhError::Skeleton(format!(
                "the character's joint {name:?} is missing; give clips of its own skeleton"
            )));
        }
        Ok(found)
    });
    map.collect()
}

/// Per joint: from the character's rest pose to the BVH at zero angles.
fn corrections(bvh: &Bvh, skeleton: &Skeleton, map: &[Option<usize>]) -> Vec<Quat> {
    let mut all: Vec<Quat> = Vec::with_capacity(map.len());
    for joint in 0..map.len() {
        let name = &skeleton.names[joint];
        let inherited = skeleton.parents[joint].map_or(Quat::IDENTITY, |p| all[usize::from(p)]);
        let mut children = (0..map.len()).filter(|c| skeleton.parents[*c] == Some(joint as u16));
        let only = children.next().filter(|_| children.next().is_none());
        let bones = only.map(|child| {
            let rest = skeleton.rest[child].translation - skeleton.rest[joint].translation;
            (rest, map[child].map_or(Vec3::ZERO, |source| bvh.joints[source].offset))
        });
        let is_limb = LIMBS.iter().any(|word| name.to_lowercase().contains(word));
        let turned = match bones {
            Some((bone, zero)) if is_limb && bone.length() > 1e-4 && zero.length() > 1e-4 => {
                let (bone, zero) = (inherited * bone.normalize(), zero.normalize());
                Quat::from_rotation_arc(bone, zero) * inherited
            }
            _ => inherited,
        };
        all.push(turned);
    }
    all
}

pub(super) fn bvh_world(
    bvh: &Bvh,
    time_s: f32,
    rotations: &mut Vec<Quat>,
    positions: &mut Vec<Vec3>,
) {
    let frame = bvh.sample(time_s);
    rotations.clear();
    positions.clear();
    for (joint, local) in bvh.joints.iter().zip(&frame.rotations) {
        let (rotation, position) = match joint.parent {
            None => (*local, frame.root),
            Some(p) => (rotations[p] * *local, positions[p] + rotations[p] * joint.offset),
        };
        rotations.push(rotation);
        positions.push(position);
    }
}

/// From the root to a joint in the world, given the joints' world rotations.
fn reach(skeleton: &Skeleton, world: &[Quat], joint: usize) -> Vec3 {
    let mut sum = Vec3::ZERO;
    let mut at = joint;
    while let Some(parent) = skeleton.parents[at].map(usize::from) {
        sum += world[parent] * skeleton.offsets[at];
        at = parent;
    }
    sum
}

/// The two legs.
struct Legs {
    /// Where they begin.
    hips: [usize; 2],
    /// Joints at the lower ends of their bones (knees, ankles).
    ends: Vec<usize>,
}

impl Legs {
    /// The ways to the two lowest joints without children; their bones that point down.
    fn find(skeleton: &Skeleton) -> Result<Self, BvhError> {
        let joints = 0..skeleton.joint_count();
        let parent = |joint: &usize| skeleton.parents[*joint].map(usize::from);
        let is_leaf = |joint: &usize| !joints.clone().any(|j| parent(&j) == Some(*joint));
        let mut leaves: Vec<usize> = joints.clone().filter(is_leaf).collect();
        let height = |joint: &usize| skeleton.rest[*joint].translation.y;
        leaves.sort_by(|a, b| height(a).total_cmp(&height(b)));
        let leg = |leaf: &usize| {
            let mut bones = Vec::new();
            let mut at = *leaf;
            while let Some(above) = parent(&at) {
                let bone = skeleton.rest[at].translation - skeleton.rest[above].translation;
                if -bone.y > DOWN * bone.length() {
                    bones.push(at);
                }
                at = above;
            }
            bones.reverse();
            bones
        };
        let mut legs: Vec<Vec<usize>> = leaves.iter().take(2).map(leg).collect();
        let (Some(a), Some(b)) = (legs.pop(), legs.pop()) else { return Err(no_legs()) };
        let hip = |leg: &Vec<usize>| leg.first().and_then(parent);
        match (hip(&a), hip(&b)) {
            (Some(left), Some(right)) if left != right => {
                Ok(Self { hips: [left, right], ends: a.into_iter().chain(b).collect() })
            }
            _ => Err(no_legs()),
        }
    }

    /// Length of all their bones, whose offsets are given by their lower ends.
    fn length(&self, offset: impl Fn(usize) -> Vec3) -> f32 {
        self.ends.iter().map(|joint| offset(*joint).length()).sum()
    }
}

fn no_legs() -> BvhError {
    BvhError::Skeleton(
        "the character's skeleton has no two legs by which motion could be scaled; give clips as \
         animations of its glTF file"
            .to_owned(),
    )
}

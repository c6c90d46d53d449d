//! The character under the cloth: skeleton, poses, linear-blend skinning.
//!
//! Between two poses joint rotations are interpolated and the body is skinned; vertices are never
//! interpolated, because an arm may turn by 90 degrees in one frame.

use glam::{Quat, Vec3};

use crate::rigid::Rigid;

/// A tree of joints. Parents come before their children; joint 0 is the root (the hips).
#[derive(Debug, Clone, PartialEq)]
pub struct Skeleton {
    /// One name per joint.
    pub names: Vec<String>,
    /// Parent of each joint; `None` for joint 0 only.
    pub parents: Vec<Option<u16>>,
    /// Translation of each joint in its parent's frame (m). Joint 0: in the rest pose.
    pub offsets: Vec<Vec3>,
    /// World transform of each joint in the rest pose in which the body was bound.
    pub rest: Vec<Rigid>,
}

/// One pose: the root's place in the world and a rotation per joint.
#[derive(Debug, Clone, PartialEq)]
pub struct Pose {
    /// World position of joint 0 (m).
    pub root: Vec3,
    /// Rotation of each joint in its parent's frame (joint 0: in the world), unit quaternions.
    pub rotations: Vec<Quat>,
}

impl Pose {
    /// Joint rotations by spherical interpolation on the short way, root position linearly.
    /// `t` in 0..=1; exact at both ends.
    pub fn interpolate(&self, to: &Self, t: f32) -> Self {
        if t <= 0.0 {
            return self.clone();
        }
        if t >= 1.0 {
            return to.clone();
        }
        let rotations = self.rotations.iter().zip(&to.rotations).map(|(a, b)| a.slerp(*b, t));
        Self { root: self.root.lerp(to.root, t), rotations: rotations.collect() }
    }

    /// As [`Pose::interpolate`], into `self`, which keeps its memory.
    pub fn interpolate_into(&mut self, from: &Self, to: &Self, t: f32) {
        self.rotations.clear();
        if t <= 0.0 || t >= 1.0 {
            let end = if t <= 0.0 { from } else { to };
            self.rotations.extend_from_slice(&end.rotations);
            self.root = end.root;
            return;
        }
        let pairs = from.rotations.iter().zip(&to.rotations);
        self.rotations.extend(pairs.map(|(a, b)| a.slerp(*b, t)));
        self.root = from.root.lerp(to.root, t);
    }

    /// The same pose moved rigidly through the world.
    pub fn moved(&self, by: &Rigid) -> Self {
        let mut moved = self.clone();
        moved.root = by.point(self.root);
        moved.rotations[0] = (by.rotation * self.rotations[0]).normalize();
        moved
    }

    /// The state frame: the full rigid transform of the hips (design decision 1).
    pub fn hips(&self) -> Rigid {
        Rigid { rotation: self.rotations[0], translation: self.root }
    }
}

impl Skeleton {
    /// Number of joints.
    pub fn joint_count(&self) -> usize {
        self.parents.len()
    }

    /// World transforms of all joints in `pose`, into `out` (cleared first).
    pub fn world(&self, pose: &Pose, out: &mut Vec<Rigid>) {
        out.clear();
        for (joint, parent) in self.parents.iter().enumerate() {
            let rotation = pose.rotations[joint];
            let transform = match parent {
                None => Rigid { rotation, translation: pose.root },
                Some(parent) => out[*parent as usize]
                    .after(&Rigid { rotation, translation: self.offsets[joint] }),
            };
            out.push(transform);
        }
    }

    /// The pose in which the body was bound.
    pub fn rest_pose(&self) -> Pose {
        let rotations = self.parents.iter().enumerate().map(|(joint, parent)| match parent {
            None => self.rest[joint].rotation,
            Some(p) => self.rest[*p as usize].rotation.conjugate() * self.rest[joint].rotation,
        });
        Pose { root: self.rest[0].translation, rotations: rotations.map(Quat::normalize).collect() }
    }

    /// Index of a joint by name.
    pub fn joint(&self, name: &str) -> Option<usize> {
        self.names.iter().position(|n| n == name)
    }
}

/// A closed triangle mesh bound to a skeleton.
#[derive(Debug, Clone, PartialEq)]
pub struct Body {
    /// The joints that move it.
    pub skeleton: Skeleton,
    /// Vertices in the rest pose (m).
    pub rest_positions: Vec<Vec3>,
    /// Counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Up to four joints per vertex.
    pub joints: Vec<[u16; 4]>,
    /// Their weights; each vertex sums to 1.
    pub weights: Vec<[f32; 4]>,
}

impl Body {
    /// Skinned vertices (m) in the world, into `out` (resized). `scratch` keeps the joints'
    /// transforms, so that a warm call allocates nothing.
    pub fn skin(&self, pose: &Pose, scratch: &mut Vec<Rigid>, out: &mut Vec<Vec3>) {
        self.skeleton.world(pose, scratch);
        for (world, rest) in scratch.iter_mut().zip(&self.skeleton.rest) {
            *world = world.after(&rest.inverse());
        }
        out.clear();
        for ((p, joints), weights) in
            self.rest_positions.iter().zip(&self.joints).zip(&self.weights)
        {
            let mut q = Vec3::ZERO;
            for (joint, weight) in joints.iter().zip(weights) {
                if *weight > 0.0 {
                    q += scratch[*joint as usize].point(*p) * *weight;
                }
            }
            out.push(q);
        }
    }
}

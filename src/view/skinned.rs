//! Plain skinning of the cloth, for comparison: each vertex follows the body it lies on.

use client_lib::{Rigid, Scene};
use glam::Vec3;

/// A cloth bound to the joints as it lay in one state.
#[derive(Debug)]
pub struct Skinned {
    /// In the rest pose's world, per vertex.
    bound: Vec<Vec3>,
    joints: Vec<[u16; 4]>,
    weights: Vec<[f32; 4]>,
}

impl Skinned {
    /// Binds the cloth at `positions` (state frame, m) to the nearest vertex of the body in the pose
    /// whose joints are `world`; `None` where the scene has no body.
    ///
    /// Cost: vertices of the cloth times vertices of the body, once.
    pub fn bind(scene: &Scene, hips: &Rigid, world: &[Rigid], positions: &[f32]) -> Option<Self> {
        let body = scene.body()?;
        let rest = &scene.skeleton().rest;
        let moved: Vec<Rigid> =
            world.iter().zip(rest).map(|(world, rest)| world.after(&rest.inverse())).collect();
        let skin: Vec<Vec3> = body
            .rest_positions
            .iter()
            .zip(body.joints.iter().zip(&body.weights))
            .map(|(p, (joints, weights))| blend(&moved, joints, weights, *p))
            .collect();
        let mut skinned = Self { bound: Vec::new(), joints: Vec::new(), weights: Vec::new() };
        let (vertices, _) = positions.as_chunks::<3>();
        for p in vertices {
            let p = hips.point(Vec3::from_array(*p));
            let distance = |q: &Vec3| p.distance_squared(*q);
            let by_distance =
                |a: &usize, b: &usize| distance(&skin[*a]).total_cmp(&distance(&skin[*b]));
            let nearest = (0..skin.len()).min_by(by_distance)?;
            let (joints, weights) = (body.joints[nearest], body.weights[nearest]);
            // Undoing each joint and mixing the results is what skinning will mix again.
            let back: Vec<Rigid> =
                joints.iter().map(|j| moved[usize::from(*j)].inverse()).collect();
            let rest = back.iter().zip(weights).map(|(back, weight)| back.point(p) * weight).sum();
            skinned.bound.push(rest);
            skinned.joints.push(joints);
            skinned.weights.push(weights);
        }
        Some(skinned)
    }

    /// The cloth in the state frame (m) of the pose whose joints, each after the inverse of its rest
    /// transform, are `moved`.
    pub fn positions(&self, hips: &Rigid, moved: &[Rigid], out: &mut [f32]) {
        let back = hips.inverse();
        let (out, _) = out.as_chunks_mut::<3>();
        let binding = self.joints.iter().zip(&self.weights);
        for (out, (bound, (joints, weights))) in out.iter_mut().zip(self.bound.iter().zip(binding))
        {
            *out = back.point(blend(moved, joints, weights, *bound)).to_array();
        }
    }
}

fn blend(moved: &[Rigid], joints: &[u16; 4], weights: &[f32; 4], p: Vec3) -> Vec3 {
    let parts = joints.iter().zip(weights).filter(|(_, weight)| **weight > 0.0);
    parts.map(|(joint, weight)| moved[usize::from(*joint)].point(p) * *weight).sum()
}

//! Plain skinning of the cloth, for comparison: each vertex follows the body it lies on.

use client_lib::{Rigid, Scene};
use glam::{Mat3, Vec3};

/// How often weights are averaged with those of the vertices beside: without it neighbours that lie
/// nearest to two limbs would be torn apart.
const SMOOTHINGS: usize = 24;
/// Weights below this are left out.
const WEIGHT_MIN: f32 = 0.01;

/// A cloth bound to the joints as it lay in one state.
#[derive(Debug)]
pub struct Skinned {
    /// In the rest pose's world, per vertex.
    bound: Vec<Vec3>,
    /// Joints that move it, with their weights, which sum to 1.
    weights: Vec<Vec<(u16, f32)>>,
}

impl Skinned {
    /// Binds the cloth at `positions` (state frame, m) to the nearest vertices of the body in the pose
    /// whose joints are `world`; `None` where the scene has no body.
    ///
    /// Cost: vertices of the cloth times vertices of the body, once.
    pub fn bind(
        scene: &Scene,
        (hips, world): (&Rigid, &[Rigid]),
        positions: &[f32],
        triangles: &[[u32; 3]],
    ) -> Option<Self> {
        let body = scene.body()?;
        let rest = &scene.skeleton().rest;
        let moved: Vec<Rigid> =
            world.iter().zip(rest).map(|(world, rest)| world.after(&rest.inverse())).collect();
        let of_body = |v: usize| body.joints[v].iter().copied().zip(body.weights[v]);
        let skin: Vec<Vec3> = (0..body.rest_positions.len())
            .map(|v| {
                of_body(v)
                    .map(|(j, w)| w * moved[usize::from(j)].point(body.rest_positions[v]))
                    .sum()
            })
            .collect();
        let (vertices, _) = positions.as_chunks::<3>();
        let placed: Vec<Vec3> = vertices.iter().map(|p| hips.point(Vec3::from_array(*p))).collect();
        let mut dense = vec![vec![0.0f32; world.len()]; placed.len()];
        for (p, row) in placed.iter().zip(&mut dense) {
            let distance = |v: &usize| p.distance_squared(skin[*v]);
            let nearest = (0..skin.len()).min_by(|a, b| distance(a).total_cmp(&distance(b)))?;
            of_body(nearest).for_each(|(joint, weight)| row[usize::from(joint)] += weight);
        }
        for _ in 0..SMOOTHINGS {
            dense = smoothed(&dense, triangles);
        }
        let weights: Vec<Vec<(u16, f32)>> = dense.iter().map(|row| sparse(row)).collect();
        let bound = placed.iter().zip(&weights).map(|(p, weights)| unblend(&moved, weights, *p));
        Some(Self { bound: bound.collect(), weights })
    }

    /// The cloth in the state frame (m) of the pose whose joints, each after the inverse of its rest
    /// transform, are `moved`.
    pub fn positions(&self, hips: &Rigid, moved: &[Rigid], out: &mut [f32]) {
        let back = hips.inverse();
        let (out, _) = out.as_chunks_mut::<3>();
        for (out, (bound, weights)) in out.iter_mut().zip(self.bound.iter().zip(&self.weights)) {
            let parts = weights.iter().map(|(j, w)| moved[usize::from(*j)].point(*bound) * *w);
            *out = back.point(parts.sum()).to_array();
        }
    }
}

/// Each row with the mean of the rows beside it, half and half.
fn smoothed(rows: &[Vec<f32>], triangles: &[[u32; 3]]) -> Vec<Vec<f32>> {
    let mut sums = rows.to_vec();
    let mut counts = vec![1.0f32; rows.len()];
    for [a, b, c] in triangles {
        for (to, from) in [(a, b), (b, c), (c, a), (b, a), (c, b), (a, c)] {
            counts[*to as usize] += 1.0;
            for (sum, weight) in sums[*to as usize].iter_mut().zip(&rows[*from as usize]) {
                *sum += weight;
            }
        }
    }
    for (sum, count) in sums.iter_mut().zip(counts) {
        sum.iter_mut().for_each(|weight| *weight /= count);
    }
    sums
}

fn sparse(row: &[f32]) -> Vec<(u16, f32)> {
    let kept = || row.iter().enumerate().filter(|(_, weight)| **weight >= WEIGHT_MIN);
    let sum: f32 = kept().map(|(_, weight)| weight).sum();
    kept().map(|(joint, weight)| (joint as u16, weight / sum.max(WEIGHT_MIN))).collect()
}

/// The point that these joints, mixed, move to `p`.
fn unblend(moved: &[Rigid], weights: &[(u16, f32)], p: Vec3) -> Vec3 {
    let (mut turn, mut shift) = (Mat3::ZERO, Vec3::ZERO);
    for (joint, weight) in weights {
        let joint = &moved[usize::from(*joint)];
        turn += Mat3::from_quat(joint.rotation) * *weight;
        shift += joint.translation * *weight;
    }
    // Opposite turns may cancel each other; then the point stays where it is.
    if turn.determinant().abs() < 1e-3 { p } else { turn.inverse() * (p - shift) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unblending_undoes_blending() {
        let joints = [
            Rigid::from_yaw(0.4, Vec3::new(1.0, 0.0, 2.0)),
            Rigid::from_yaw(-0.9, Vec3::new(0.0, 0.5, 0.0)),
        ];
        let weights = [(0, 0.3), (1, 0.7)];
        let rest = Vec3::new(0.1, 1.2, -0.4);
        let p = weights.iter().map(|(j, w)| joints[usize::from(*j)].point(rest) * *w).sum();
        assert!(unblend(&joints, &weights, p).distance(rest) < 1e-5);
    }

    #[test]
    fn smoothing_keeps_weights_whole_and_small_ones_go() {
        let rows = vec![vec![1.0, 0.0], vec![0.0, 1.0], vec![0.0, 1.0], vec![0.0, 1.0]];
        let smooth = smoothed(&rows, &[[0, 1, 2], [1, 3, 2]]);
        for row in &smooth {
            assert!((row.iter().sum::<f32>() - 1.0).abs() < 1e-6, "{row:?}");
        }
        assert!(smooth[0][0] < 1.0 && smooth[1][0] > 0.0 && smooth[3][0] < 1e-6);
        assert_eq!(sparse(&[0.001, 0.5, 0.499]).len(), 2);
    }
}

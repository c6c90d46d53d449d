//! Meshes and bodies for the tests.
#![allow(dead_code, missing_docs)] // each test file uses its own part

use std::sync::Arc;

use cloth::{Body, Environment, Material, Mesh, Model, Pose, Quat, Rigid, Skeleton, Vec3};

/// A sheet of `nx` x `ny` cells with alternating diagonals; `at` places (0..=1, 0..=1).
pub fn sheet(nx: u32, ny: u32, at: impl Fn(f32, f32) -> Vec3) -> Mesh {
    let mut p = Vec::new();
    for j in 0..=ny {
        for i in 0..=nx {
            p.push(at(i as f32 / nx as f32, j as f32 / ny as f32));
        }
    }
    let v = |i: u32, j: u32| j * (nx + 1) + i;
    let mut t = Vec::new();
    for j in 0..ny {
        for i in 0..nx {
            let (a, b, c, d) = (v(i, j), v(i + 1, j), v(i + 1, j + 1), v(i, j + 1));
            if (i + j) % 2 == 0 {
                t.extend([[a, b, c], [a, c, d]]);
            } else {
                t.extend([[a, b, d], [b, c, d]]);
            }
        }
    }
    Mesh::new(p, t).unwrap()
}

/// Ellipsoids, one per joint, as one closed mesh: (joint's place, half axes).
pub fn ellipsoids(parts: &[(Vec3, Vec3)], rings: u32) -> Arc<Body> {
    let (mut p, mut t, mut joints) = (Vec::new(), Vec::new(), Vec::new());
    for (joint, (center, half)) in parts.iter().enumerate() {
        let first = p.len() as u32;
        let around = 2 * rings;
        p.push(*center + Vec3::Y * half.y);
        for i in 1..rings {
            for j in 0..around {
                let theta = std::f32::consts::PI * i as f32 / rings as f32;
                let phi = std::f32::consts::TAU * j as f32 / around as f32;
                let (s, c) = theta.sin_cos();
                p.push(*center + *half * Vec3::new(s * phi.sin(), c, s * phi.cos()));
            }
        }
        p.push(*center - Vec3::Y * half.y);
        let last = p.len() as u32 - 1;
        let at = |i: u32, j: u32| first + 1 + (i - 1) * around + j % around;
        for j in 0..around {
            t.push([first, at(1, j), at(1, j + 1)]);
            t.push([last, at(rings - 1, j + 1), at(rings - 1, j)]);
            for i in 1..rings - 1 {
                t.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
                t.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
            }
        }
        joints.resize(p.len(), [joint as u16, 0, 0, 0]);
    }
    let still = |translation| Rigid { rotation: Quat::IDENTITY, translation };
    let skeleton = Skeleton {
        names: (0..parts.len()).map(|i| format!("part{i}")).collect(),
        parents: (0..parts.len()).map(|i| (i > 0).then_some(0)).collect(),
        offsets: parts.iter().map(|(c, _)| *c - parts[0].0).collect(),
        rest: parts.iter().map(|(c, _)| still(*c)).collect(),
    };
    let weights = vec![[1.0, 0.0, 0.0, 0.0]; p.len()];
    Arc::new(Body { skeleton, rest_positions: p, triangles: t, joints, weights })
}

/// The rest pose with the root at `root`.
pub fn pose_at(body: &Body, root: Vec3) -> Pose {
    Pose { root, ..body.skeleton.rest_pose() }
}

pub fn free(mesh: Mesh, material: Material, environment: Environment, held: &[u32]) -> Model {
    Model::new(mesh, material, environment, None, held).unwrap()
}

//! A scene as clients get it: boundary types made from the explorer's own.

use cloth::{Body, Vec3};
use protocol::scene::{BodyMesh, Capsule, Edge, GarmentChunk, Joint, Pose, SceneChunk};

use crate::primary::PrimaryPose;
use crate::scene::Scene;

/// A joint moves a collider of its own from this many vertices on.
const CAPSULE_VERTICES_MIN: usize = 8;

/// What a client needs to walk: skeleton, primary graph, colliders, body.
pub fn scene_chunk(scene: &Scene) -> SceneChunk {
    let (body, primary) = (&*scene.body, &*scene.primary);
    let edges = primary.edges().iter();
    SceneChunk {
        fps: primary.fps(),
        joints: joints(body),
        clips: primary.clips().to_vec(),
        poses: primary.poses().iter().map(pose).collect(),
        edges: edges.map(|e| Edge { from: e.from, to: e.to, yaw: e.yaw, shift: e.shift }).collect(),
        colliders: capsules(body),
        body: Some(BodyMesh {
            positions: body.rest_positions.iter().map(Vec3::to_array).collect(),
            triangles: body.triangles.clone(),
            joints: body.joints.clone(),
            weights: body.weights.clone(),
        }),
    }
}

/// What a renderer needs of the garment beside positions.
pub fn garment_chunk(scene: &Scene) -> GarmentChunk {
    let garment = &scene.garment;
    GarmentChunk {
        name: garment.name.clone(),
        vertex_count: garment.positions.len() as u32,
        triangles: garment.triangles.clone(),
    }
}

fn joints(body: &Body) -> Vec<Joint> {
    let skeleton = &body.skeleton;
    let joint = |j: usize| Joint {
        name: skeleton.names[j].clone(),
        parent: skeleton.parents[j],
        offset: skeleton.offsets[j].to_array(),
        rest_translation: skeleton.rest[j].translation.to_array(),
        rest_rotation: skeleton.rest[j].rotation.to_array(),
    };
    (0..skeleton.joint_count()).map(joint).collect()
}

fn pose(pose: &PrimaryPose) -> Pose {
    let steps = |x: f32| (x * f32::from(i16::MAX)).round() as i16;
    let rotations = pose.pose.rotations.iter();
    Pose {
        clip: pose.clip,
        frame: pose.frame,
        transition: pose.transition,
        root: pose.pose.root.to_array(),
        rotations: rotations.map(|q| q.normalize().to_array().map(steps)).collect(),
    }
}

/// One capsule per joint that moves enough vertices (those whose largest weight it has): along
/// their main axis, as wide as three quarters of them lie from it.
fn capsules(body: &Body) -> Vec<Capsule> {
    let mut moved = vec![Vec::new(); body.skeleton.joint_count()];
    for ((p, joints), weights) in body.rest_positions.iter().zip(&body.joints).zip(&body.weights) {
        let heaviest = (0..4).fold(0, |best, i| if weights[i] > weights[best] { i } else { best });
        let joint = usize::from(joints[heaviest]);
        moved[joint].push(body.skeleton.rest[joint].inverse().point(*p));
    }
    let enough =
        moved.iter().enumerate().filter(|(_, points)| points.len() >= CAPSULE_VERTICES_MIN);
    enough.map(|(joint, points)| capsule(joint as u16, points)).collect()
}

fn capsule(joint: u16, points: &[Vec3]) -> Capsule {
    let centre = points.iter().sum::<Vec3>() / points.len() as f32;
    let axis = main_axis(points, centre);
    let along = |p: &Vec3| (*p - centre).dot(axis);
    let mut lengths: Vec<f32> = points.iter().map(along).collect();
    let mut distances: Vec<f32> =
        points.iter().map(|p| (*p - centre - axis * along(p)).length()).collect();
    lengths.sort_by(f32::total_cmp);
    distances.sort_by(f32::total_cmp);
    let radius = distances[distances.len() * 3 / 4];
    let (low, high) = (lengths[0] + radius, lengths[lengths.len() - 1] - radius);
    // A stout part is a ball.
    let (low, high) = if low < high { (low, high) } else { (0.0, 0.0) };
    let end = |t: f32| (centre + axis * t).to_array();
    Capsule { joint, a: end(low), b: end(high), radius }
}

/// Direction of largest extent, by power iteration on the covariance.
pub(super) fn main_axis(points: &[Vec3], centre: Vec3) -> Vec3 {
    let mut axis = Vec3::new(0.6, 0.7, 0.4).normalize();
    for _ in 0..50 {
        let turned = points.iter().map(|p| (*p - centre) * (*p - centre).dot(axis)).sum::<Vec3>();
        axis = turned.try_normalize().unwrap_or(axis);
    }
    axis
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tube_gets_its_own_capsule() {
        let ring = |i: usize| {
            let (angle, y) = ((i % 12) as f32 / 12.0 * std::f32::consts::TAU, (i / 12) as f32);
            Vec3::new(0.05 * angle.cos(), 0.1 + 0.4 * y / 9.0, 0.05 * angle.sin())
        };
        let points: Vec<Vec3> = (0..120).map(ring).collect();
        let fitted = capsule(3, &points);
        assert!((fitted.radius - 0.05).abs() < 1e-4);
        let mut ends = [fitted.a[1], fitted.b[1]];
        ends.sort_by(f32::total_cmp);
        assert!((ends[0] - 0.15).abs() < 1e-3 && (ends[1] - 0.45).abs() < 1e-3, "{ends:?}");
    }

    #[test]
    fn points_in_one_place_make_a_ball_without_extent() {
        let fitted = capsule(0, &[Vec3::ONE; 9]);
        assert!(fitted.radius.abs() < 1e-6 && Vec3::from(fitted.a).distance(Vec3::ONE) < 1e-6);
    }
}

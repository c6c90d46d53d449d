//! The scene as a whole.

use cloth::{Rigid, Vec3};
use protocol::EdgeId;

use super::clearance::Placed;
use super::skeleton::joint;
use super::surface::Mesh;
use super::*;
use crate::primary::PrimaryGraph;

/// Fastest that any joint may move along any edge (m/s): a hand thrown up in a jump, a foot in a
/// kick. Beyond, the motion would have a jump in it.
const JOINT_SPEED_MAX_M_S: f32 = 11.0;
/// Largest change of any joint's velocity from one edge to the next (m/s).
const JOINT_JERK_MAX_M_S: f32 = 7.0;

fn scene() -> &'static Scene {
    static SCENE: std::sync::OnceLock<Scene> = std::sync::OnceLock::new();
    SCENE.get_or_init(|| robe(None).unwrap())
}

fn body_mesh() -> Mesh {
    let body = &scene().body;
    Mesh { positions: body.rest_positions.clone(), triangles: body.triangles.clone() }
}

fn robe_mesh() -> Mesh {
    let garment = &scene().garment;
    Mesh { positions: garment.positions.clone(), triangles: garment.triangles.clone() }
}

#[test]
fn the_body_is_closed_stands_on_the_ground_and_is_as_tall_as_said() {
    let mesh = body_mesh();
    assert_eq!(mesh.boundary(), Ok(vec![]));
    let volume: f32 = mesh
        .triangles
        .iter()
        .map(|t| mesh.positions[t[0] as usize].dot(mesh.normal(t)) / 6.0)
        .sum();
    assert!((0.045..0.09).contains(&volume), "{volume} m^3, facing outward");
    let heights = mesh.positions.iter().map(|p| p.y);
    let (low, high) = heights.fold((9.0f32, -9.0f32), |(l, h), y| (l.min(y), h.max(y)));
    assert!(low.abs() < 0.004 && (high - 1.7).abs() < 0.015, "from {low} to {high}");
    assert!((2000..3500).contains(&mesh.positions.len()), "{}", mesh.positions.len());
}

#[test]
fn skin_weights_sum_to_one_and_hold_the_rest_pose() {
    let body = &scene().body;
    assert_eq!(body.skeleton.joint_count(), joint::COUNT);
    assert!(body.weights.iter().all(|w| (w.iter().sum::<f32>() - 1.0).abs() < 1e-5));
    let (mut scratch, mut skinned) = (Vec::new(), Vec::new());
    body.skin(&body.skeleton.rest_pose(), &mut scratch, &mut skinned);
    let off = skinned.iter().zip(&body.rest_positions).map(|(a, b)| a.distance(*b));
    assert!(off.fold(0.0, f32::max) < 1e-5);
    // No skin of one leg follows the other.
    let left_leg = joint::THIGH as u16..=joint::TOES as u16;
    for ((p, joints), weights) in body.rest_positions.iter().zip(&body.joints).zip(&body.weights) {
        let left: f32 =
            joints.iter().zip(weights).filter(|(j, _)| left_leg.contains(j)).map(|(_, w)| w).sum();
        assert!(p.x > -0.06 || left < 0.05, "at {p}: {left} of the left leg");
    }
}

#[test]
fn the_robe_is_one_piece_with_four_openings() {
    let mesh = robe_mesh();
    assert_eq!(mesh.boundary_loops(), Ok(4));
    let simulated = cloth::mesh::Mesh::new(mesh.positions.clone(), mesh.triangles.clone());
    assert!(simulated.is_ok(), "{simulated:?}");
    assert!((3000..3400).contains(&mesh.positions.len()), "{}", mesh.positions.len());
    // A sphere with four holes: Euler's number is 2 - 4.
    let halves = 3 * mesh.triangles.len() + mesh.boundary().unwrap().len();
    assert_eq!(mesh.positions.len() + mesh.triangles.len() + 2, halves / 2);
}

#[test]
fn the_robe_has_regular_triangles_and_straight_hems() {
    let mesh = robe_mesh();
    let mut slim = 0;
    for t in &mesh.triangles {
        let p = t.map(|v| mesh.positions[v as usize]);
        let angle = |k: usize| (p[(k + 1) % 3] - p[k]).angle_between(p[(k + 2) % 3] - p[k]);
        let least = (0..3).map(angle).fold(9.0, f32::min).to_degrees();
        assert!(least > 15.0, "an angle of {least} degrees");
        slim += usize::from(least < 30.0);
        let longest = (0..3).map(|k| p[k].distance(p[(k + 1) % 3])).fold(0.0, f32::max);
        assert!(longest < 0.055, "an edge of {longest} m");
    }
    assert!(slim * 50 < mesh.triangles.len(), "{slim} slim triangles");
    let low: Vec<_> = mesh.boundary().unwrap().into_iter().flatten().collect();
    let hem = low.iter().map(|v| mesh.positions[*v as usize].y).filter(|y| *y < 0.6);
    assert!(hem.clone().count() > 80);
    let lowest = mesh.positions.iter().map(|p| p.y).fold(9.0, f32::min);
    assert!(hem.into_iter().all(|y| y - lowest < 1e-3));
}

#[test]
fn the_robe_keeps_clear_of_the_body_at_rest() {
    let body = body_mesh();
    let robe = robe_mesh();
    for p in &robe.positions {
        let (mut nearest, mut inside) = (f32::MAX, false);
        for t in &body.triangles {
            let [a, b, c] = t.map(|v| body.positions[v as usize]);
            if a.distance_squared(*p) > 0.02 {
                continue;
            }
            let q = nearest_on_triangle(*p, a, b, c);
            if p.distance(q) < nearest {
                nearest = p.distance(q);
                inside = (*p - q).dot(body.normal(t)) < 0.0;
            }
        }
        assert!(nearest > 0.005 && !inside, "{p} is {nearest} m from the body");
    }
    let pinned = &scene().garment.attached;
    assert!(pinned.len() >= 4 && pinned.is_sorted());
}

#[test]
fn the_graph_is_small_strongly_connected_and_has_dead_ends_enough() {
    let graph = &scene().primary;
    let (poses, edges) = (graph.poses().len(), graph.edges().len());
    assert!(edges <= 650, "{edges} edges");
    assert!(edges + 1 >= poses + 20, "{} dead ends", edges + 1 - poses);
    for backward in [false, true] {
        assert_eq!(reached(graph, backward), poses, "backward: {backward}");
    }
    assert_eq!(graph.clips(), ["walk", "run", "turn", "jump", "kick", "spin"]);
}

fn reached(graph: &PrimaryGraph, backward: bool) -> usize {
    let mut seen = vec![false; graph.poses().len()];
    let mut open = vec![0usize];
    while let Some(at) = open.pop() {
        if std::mem::replace(&mut seen[at], true) {
            continue;
        }
        for e in graph.edges() {
            let (from, to) = if backward { (e.to, e.from) } else { (e.from, e.to) };
            if from.index() == at {
                open.push(to.index());
            }
        }
    }
    seen.iter().filter(|s| **s).count()
}

/// Joint positions of an edge's target in the world of its source.
fn after(edge: EdgeId) -> Vec<Vec3> {
    let graph = &scene().primary;
    let edge = graph.edge(edge);
    places(&graph.pose(edge.to).pose.moved(&edge.alignment()))
}

fn places(pose: &cloth::Pose) -> Vec<Vec3> {
    let mut world = Vec::new();
    scene().body.skeleton.world(pose, &mut world);
    world.iter().map(|joint: &Rigid| joint.translation).collect()
}

#[test]
fn no_joint_jumps_along_any_walk() {
    let graph = &scene().primary;
    let names = &scene().body.skeleton.names;
    for first in 0..graph.edges().len() as u32 {
        let edge = graph.edge(EdgeId(first));
        let (a, b) = (places(&graph.pose(edge.from).pose), after(EdgeId(first)));
        for second in graph.out_edges(edge.to) {
            let c: Vec<_> = after(second).iter().map(|p| edge.alignment().point(*p)).collect();
            for joint in 0..a.len() {
                let (v, w) = ((b[joint] - a[joint]) * 30.0, (c[joint] - b[joint]) * 30.0);
                let from = graph.pose(edge.from);
                let at = || {
                    format!(
                        "{} at {first} (clip {} frame {} transition {})",
                        names[joint], from.clip, from.frame, from.transition
                    )
                };
                assert!(v.length() < JOINT_SPEED_MAX_M_S, "{}: {} m/s", at(), v.length());
                let change = v.distance(w);
                assert!(change < JOINT_JERK_MAX_M_S, "{}: {change} m/s in a frame", at());
            }
        }
    }
}

#[test]
fn standing_feet_do_not_slide() {
    let graph = &scene().primary;
    for (id, edge) in graph.edges().iter().enumerate() {
        let (from, to) = (graph.pose(edge.from), graph.pose(edge.to));
        if from.transition || to.transition {
            continue;
        }
        let (a, b) = (places(&from.pose), after(EdgeId(id as u32)));
        for toes in [joint::TOES, joint::TOES + joint::SIDE] {
            let stands = a[toes].y < 0.027 && b[toes].y < 0.027;
            let slid = a[toes].distance(b[toes]);
            assert!(!stands || slid < 0.012, "clip {} frame {}: {slid} m", from.clip, from.frame);
        }
    }
}

#[test]
fn two_builds_are_equal_bit_for_bit() {
    let digest = |scene: &Scene| {
        let mut hash = blake3::Hasher::new();
        let mut add = |v: Vec3| {
            v.to_array().iter().for_each(|x| {
                hash.update(&x.to_bits().to_le_bytes());
            })
        };
        scene.garment.positions.iter().for_each(|p| add(*p));
        scene.body.rest_positions.iter().for_each(|p| add(*p));
        for pose in scene.primary.poses() {
            add(pose.pose.root);
            pose.pose.rotations.iter().for_each(|q| add(q.xyz() * q.w.signum()));
        }
        for edge in scene.primary.edges() {
            add(Vec3::new(edge.yaw, edge.shift[0], edge.shift[1]));
        }
        hash.finalize()
    };
    let again = robe(None).unwrap();
    assert_eq!(digest(scene()), digest(&again));
    assert_eq!(scene().garment, again.garment);
    assert_eq!(scene().primary, again.primary);
}

/// Nearest point of a triangle (Ericson 2005, section 5.1.5).
fn nearest_on_triangle(p: Vec3, a: Vec3, b: Vec3, c: Vec3) -> Vec3 {
    let on_edge = |a: Vec3, b: Vec3| {
        a + (b - a) * ((p - a).dot(b - a) / (b - a).length_squared()).clamp(0.0, 1.0)
    };
    let n = (b - a).cross(c - a);
    let inside = |a: Vec3, b: Vec3| n.dot((b - a).cross(p - a)) >= 0.0;
    if inside(a, b) && inside(b, c) && inside(c, a) {
        return p - n * ((p - a).dot(n) / n.length_squared());
    }
    let edges = [on_edge(a, b), on_edge(b, c), on_edge(c, a)];
    edges.into_iter().min_by(|x, y| p.distance(*x).total_cmp(&p.distance(*y))).unwrap()
}

#[test]
fn limbs_keep_clear_of_the_body_and_of_each_other() {
    let trunk = [joint::HIPS, joint::SPINE, joint::CHEST, joint::HEAD];
    let arm = [joint::FOREARM, joint::HAND];
    let leg = [joint::SHIN, joint::FOOT, joint::TOES];
    let right = |left: &[usize]| left.iter().map(|j| j + joint::SIDE).collect::<Vec<_>>();
    for (id, pose) in scene().primary.poses().iter().enumerate() {
        let placed = Placed::new(&scene().body.skeleton, &pose.pose);
        let at = format!("pose {id}, {} of clip {}", pose.frame, pose.clip);
        for arm in [arm.to_vec(), right(&arm)] {
            let gap = placed.gap(&arm, &trunk);
            assert!(gap > 0.03, "arm {gap} m from the trunk, {at}");
        }
        let gap = placed.gap(&leg, &right(&leg));
        assert!(gap > 0.01, "shins {gap} m apart, {at}");
    }
}

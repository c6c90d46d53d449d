//! Which vertices follow the body, how closely, and by which joints.

use cloth::{Body, Pose, Rigid, Surface, Vec3};
use codec::upsample::{Binding, Transform};
use protocol::PoseId;

use crate::scene::Scene;

/// A vertex that skinning predicts to within this (m, root mean square over the states) is left to it;
/// one that is off by the second is not at all.
const FOLLOWS_M: [f32; 2] = [0.01, 0.03];
/// Of its distances from where the skin leads it, a tether leaves room for this share of the states', and
/// some more (m): with room for all of them the robe's sleeves slid up the arms.
const REACHED: (f32, f32) = (0.5, 0.03);
/// A point that strays further than this (m) hangs freely.
const FREE_M: f32 = 0.4;
/// A floor lies where this share of the states is below it, but this far outside the skin (m) at least.
const LOW: f32 = 0.05;
const OUTSIDE_M: f32 = 0.004;
/// Rounds of smoothing over the mesh, so that the hand-over is gradual.
const ROUNDS: usize = 6;

/// Of every garment vertex.
pub(super) struct Bound {
    /// How much of it follows the skin (0..=1).
    pub(super) shares: Vec<f32>,
    /// By which joints.
    pub(super) bindings: Vec<Binding>,
    /// What the skin leaves each of them.
    pub(super) rooms: Vec<Room>,
}

/// How far a vertex strays from where the skin leads it, and how it stays outside the body.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Room {
    /// (m); infinite where it hangs freely.
    pub(super) reach_m: f32,
    /// Out of the body, in the rest pose.
    pub(super) normal: Vec3,
    /// Along it from where the skin leads the vertex (m).
    pub(super) floor_m: f32,
}

/// Binds a garment to its scene's body, as its states tell.
pub(super) fn bind(scene: &Scene, states: &[(PoseId, Vec<f32>)]) -> Bound {
    let (body, garment) = (&scene.body, &scene.garment);
    let (bindings, outward) = bindings(body, &garment.positions);
    let mut squares = vec![0.0f64; garment.positions.len()];
    for (pose, positions) in states {
        let joints = transforms(body, &scene.primary.poses()[pose.index()].pose);
        for (v, (square, binding)) in squares.iter_mut().zip(&bindings).enumerate() {
            let at = skinned(binding, &joints, garment.positions[v]);
            let shown = Vec3::from_slice(&positions[3 * v..][..3]);
            *square += f64::from(at.distance_squared(shown));
        }
    }
    let count = states.len().max(1) as f64;
    let mut shares: Vec<f32> = squares
        .iter()
        .map(|square| {
            let off = (square / count).sqrt() as f32;
            let t = ((FOLLOWS_M[1] - off) / (FOLLOWS_M[1] - FOLLOWS_M[0])).clamp(0.0, 1.0);
            t * t * (3.0 - 2.0 * t)
        })
        .collect();
    let attached = |shares: &mut [f32]| {
        garment.attached.iter().for_each(|v| shares[*v as usize] = 1.0);
    };
    attached(&mut shares);
    for _ in 0..ROUNDS {
        shares = smoothed(&shares, &garment.triangles);
        attached(&mut shares);
    }
    let rooms = rooms(scene, states, &bindings, &outward);
    Bound { shares, bindings, rooms }
}

/// What the states' distances from the skin tell.
fn rooms(
    scene: &Scene,
    states: &[(PoseId, Vec<f32>)],
    bindings: &[Binding],
    outward: &[(Vec3, f32)],
) -> Vec<Room> {
    let joints: Vec<Vec<Transform>> = states
        .iter()
        .map(|(pose, _)| transforms(&scene.body, &scene.primary.poses()[pose.index()].pose))
        .collect();
    let (mut far, mut high) = (Vec::new(), Vec::new());
    let one = |(v, (binding, (normal, height))): (usize, (&Binding, &(Vec3, f32)))| {
        far.clear();
        high.clear();
        for (joints, (_, positions)) in joints.iter().zip(states) {
            let off = Vec3::from_slice(&positions[3 * v..][..3])
                - skinned(binding, joints, scene.garment.positions[v]);
            far.push(off.length());
            high.push(turned(binding, joints, *normal).dot(off));
        }
        far.sort_by(f32::total_cmp);
        high.sort_by(f32::total_cmp);
        let at = |list: &[f32], share: f32| {
            list.get((list.len() as f32 * share) as usize).copied().unwrap_or(f32::INFINITY)
        };
        let reach_m = at(&far, REACHED.0) + REACHED.1;
        let reach_m = if reach_m <= FREE_M { reach_m } else { f32::INFINITY };
        let floor_m = at(&high, LOW).max(OUTSIDE_M - height);
        Room { reach_m, normal: *normal, floor_m }
    };
    bindings.iter().zip(outward).enumerate().map(one).collect()
}

/// Mean over each vertex and its neighbours.
fn smoothed(shares: &[f32], triangles: &[[u32; 3]]) -> Vec<f32> {
    let mut sums: Vec<(f32, f32)> = shares.iter().map(|share| (*share, 1.0)).collect();
    for t in triangles {
        for i in 0..3 {
            let (a, b) = (t[i] as usize, t[(i + 1) % 3] as usize);
            // Interior edges count twice, once from each side.
            sums[a] = (sums[a].0 + 0.5 * shares[b], sums[a].1 + 0.5);
            sums[b] = (sums[b].0 + 0.5 * shares[a], sums[b].1 + 0.5);
        }
    }
    sums.into_iter().map(|(sum, weight)| sum / weight).collect()
}

/// Each vertex by the joints of the closest place on the body in the rest pose.
/// Also the direction out of the body there, and how far out the vertex lies (m).
fn bindings(body: &Body, positions: &[Vec3]) -> (Vec<Binding>, Vec<(Vec3, f32)>) {
    let surface = Surface::new(&body.rest_positions, &body.triangles);
    let posed = surface.posed(&body.rest_positions);
    let one = |p: &Vec3| {
        let Some(contact) = surface.closest(&posed, *p, f32::INFINITY) else {
            return (Binding::of(0), (Vec3::ZERO, 0.0));
        };
        let mut weights: Vec<(f32, u16)> = Vec::new();
        let corners = body.triangles[contact.triangle as usize];
        for (corner, weight) in corners.into_iter().zip(contact.weights.to_array()) {
            let v = corner as usize;
            for (joint, own) in body.joints[v].iter().zip(body.weights[v]) {
                match weights.iter_mut().find(|(_, known)| known == joint) {
                    Some(known) => known.0 += weight * own,
                    None => weights.push((weight * own, *joint)),
                }
            }
        }
        // The four heaviest; of equals the first joint.
        weights.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        weights.resize(4, (0.0, 0));
        let place = |i: usize| weights[i];
        let binding =
            Binding::new([0, 1, 2, 3].map(|i| place(i).1), [0, 1, 2, 3].map(|i| place(i).0));
        (binding, (contact.normal, contact.distance))
    };
    positions.iter().map(one).unzip()
}

/// For each joint what moves a point of the rest pose into the pose's state frame.
pub(super) fn transforms(body: &Body, pose: &Pose) -> Vec<Transform> {
    let mut world = Vec::new();
    body.skeleton.world(pose, &mut world);
    let to_frame = pose.hips().inverse();
    let joint = |(world, rest): (&Rigid, &Rigid)| {
        let moved = to_frame.after(&world.after(&rest.inverse()));
        let [x, y, z] = [Vec3::X, Vec3::Y, Vec3::Z].map(|axis| moved.vector(axis));
        let t = moved.translation;
        [[x.x, y.x, z.x, t.x], [x.y, y.y, z.y, t.y], [x.z, y.z, z.z, t.z]]
    };
    world.iter().zip(&body.skeleton.rest).map(joint).collect()
}

fn skinned(binding: &Binding, joints: &[Transform], p: Vec3) -> Vec3 {
    let mut sum = Vec3::ZERO;
    for (joint, share) in binding.joints.iter().zip(binding.shares) {
        let weight = f32::from(share) / f32::from(codec::upsample::WHOLE);
        let row = |[x, y, z, t]: [f32; 4]| x * p.x + y * p.y + z * p.z + t;
        sum += Vec3::from_array(joints[usize::from(*joint)].map(row)) * weight;
    }
    sum
}

/// A unit vector of the rest pose, carried along.
fn turned(binding: &Binding, joints: &[Transform], n: Vec3) -> Vec3 {
    let mut sum = Vec3::ZERO;
    for (joint, share) in binding.joints.iter().zip(binding.shares) {
        let weight = f32::from(share) / f32::from(codec::upsample::WHOLE);
        let row = |[x, y, z, _]: [f32; 4]| x * n.x + y * n.y + z * n.z;
        sum += Vec3::from_array(joints[usize::from(*joint)].map(row)) * weight;
    }
    sum.normalize_or_zero()
}

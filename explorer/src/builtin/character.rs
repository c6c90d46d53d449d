//! The character's body: round cones on the skeleton, meshed and bound.

use cloth::{Body, Skeleton, Vec3};

use super::field::{RoundCone, Union};
use super::remesh::{INSIDE, Target, remesh};
use super::skeleton::{joint, skeleton};
use super::surface::{Grid, Mesh, directed_edges, surface_nets};
use super::{BuiltinError, check};

/// Fillet between the cones (m).
pub(super) const FILLET_M: f32 = 0.025;
/// Length of the body's edges (m).
const EDGE_M: f32 = 0.027;
/// Reach of a joint's hold on the skin beyond its own cones (m).
const HOLD_M: f32 = 0.022;
/// Passes that even out the weights over the skin.
const WEIGHT_PASSES: usize = 6;

/// Joint, both ends (m), both radii (m).
type Row = (usize, [f32; 3], [f32; 3], f32, f32);

/// Cones of the left half and the middle.
const CONES: [Row; 32] = [
    (joint::HIPS, [0.065, 0.945, -0.005], [0.055, 1.000, 0.000], 0.098, 0.092),
    (joint::SPINE, [0.055, 1.000, 0.000], [0.045, 1.090, 0.005], 0.092, 0.083),
    (joint::CHEST, [0.045, 1.090, 0.005], [0.068, 1.220, 0.000], 0.083, 0.097),
    (joint::CHEST, [0.068, 1.220, 0.000], [0.080, 1.300, 0.000], 0.097, 0.095),
    (joint::HIPS, [0.0, 0.945, -0.010], [0.0, 1.040, 0.000], 0.093, 0.086),
    (joint::SPINE, [0.0, 1.040, 0.000], [0.0, 1.110, 0.005], 0.086, 0.082),
    (joint::CHEST, [0.0, 1.110, 0.005], [0.0, 1.300, 0.000], 0.082, 0.096),
    (joint::CHEST, [-0.100, 1.375, -0.015], [0.100, 1.375, -0.015], 0.058, 0.058),
    (joint::NECK, [0.0, 1.38, -0.020], [0.0, 1.52, 0.0], 0.058, 0.050),
    (joint::HEAD, [0.0, 1.530, 0.040], [0.0, 1.600, 0.005], 0.046, 0.082),
    (joint::HEAD, [0.0, 1.600, 0.005], [0.0, 1.610, -0.020], 0.084, 0.090),
    (joint::HEAD, [0.0, 1.585, 0.088], [0.0, 1.562, 0.100], 0.009, 0.015),
    (joint::SHOULDER, [0.060, 1.385, -0.015], [0.150, 1.378, -0.015], 0.060, 0.056),
    (joint::ARM, [0.165, 1.370, -0.015], [0.230, 1.310, -0.015], 0.056, 0.050),
    (joint::ARM, [0.230, 1.310, -0.015], [0.358, 1.182, -0.015], 0.050, 0.037),
    (joint::FOREARM, [0.360, 1.180, -0.015], [0.415, 1.125, -0.013], 0.038, 0.041),
    (joint::FOREARM, [0.415, 1.125, -0.013], [0.537, 1.003, -0.013], 0.041, 0.027),
    (joint::HAND, [0.545, 0.995, -0.030], [0.590, 0.950, -0.034], 0.023, 0.024),
    (joint::HAND, [0.545, 0.995, 0.000], [0.590, 0.950, 0.006], 0.023, 0.023),
    (joint::HAND, [0.590, 0.950, -0.034], [0.638, 0.902, -0.026], 0.023, 0.018),
    (joint::HAND, [0.590, 0.950, 0.006], [0.640, 0.900, 0.000], 0.023, 0.018),
    (joint::HAND, [0.558, 0.978, 0.012], [0.590, 0.955, 0.045], 0.018, 0.015),
    (joint::HIPS, [0.070, 0.915, -0.045], [0.075, 0.905, -0.045], 0.088, 0.085),
    (joint::THIGH, [0.092, 0.870, 0.0], [0.100, 0.690, 0.004], 0.086, 0.070),
    (joint::THIGH, [0.100, 0.690, 0.004], [0.105, 0.490, 0.006], 0.070, 0.051),
    (joint::SHIN, [0.105, 0.490, 0.006], [0.110, 0.390, -0.012], 0.050, 0.054),
    (joint::SHIN, [0.110, 0.390, -0.012], [0.120, 0.110, -0.012], 0.054, 0.034),
    (joint::FOOT, [0.120, 0.093, -0.014], [0.120, 0.046, -0.032], 0.035, 0.038),
    (joint::FOOT, [0.120, 0.083, 0.000], [0.124, 0.040, 0.095], 0.036, 0.032),
    (joint::FOOT, [0.120, 0.044, -0.025], [0.140, 0.036, 0.095], 0.036, 0.028),
    (joint::TOES, [0.112, 0.036, 0.105], [0.116, 0.032, 0.160], 0.028, 0.024),
    (joint::TOES, [0.140, 0.034, 0.105], [0.138, 0.030, 0.145], 0.026, 0.022),
];

/// All cones of the body, both sides.
pub(super) fn cones() -> Vec<RoundCone> {
    let mut cones = Vec::new();
    for (index, a, b, radius_a, radius_b) in CONES {
        let (a, b) = (Vec3::from_array(a), Vec3::from_array(b));
        cones.push(RoundCone { joint: index as u16, a, b, radius_a, radius_b });
        let middle = a.x < 0.0 || (a.x.abs() < 1e-6 && b.x.abs() < 1e-6);
        if !middle {
            let side = if index >= joint::SHOULDER { joint::SIDE } else { 0 };
            let mirror = Vec3::new(-1.0, 1.0, 1.0);
            let joint = (index + side) as u16;
            cones.push(RoundCone { joint, a: a * mirror, b: b * mirror, radius_a, radius_b });
        }
    }
    cones
}

/// The body in its rest pose with its skin.
///
/// # Errors
/// The mesh is not closed.
pub(super) fn body() -> Result<Body, BuiltinError> {
    let cones = cones();
    let skin = Union::new(&cones, FILLET_M);
    let surface = |p: Vec3| skin.distance(p);
    let grid =
        Grid { low: Vec3::new(-0.72, -0.05, -0.22), high: Vec3::new(0.72, 1.76, 0.25), cell: 0.02 };
    let mut mesh = surface_nets(&surface, grid);
    let mut cut_of = vec![INSIDE; mesh.positions.len()];
    let target = Target { surface: &surface, cuts: &[], edge_m: EDGE_M, passes: 9 };
    remesh(&mut mesh, &mut cut_of, &target);
    check(&mesh, "body", 0)?;
    let skeleton = skeleton();
    let (joints, weights) = bind(&mesh, &skeleton, &cones);
    Ok(Body {
        skeleton,
        rest_positions: mesh.positions,
        triangles: mesh.triangles,
        joints,
        weights,
    })
}

/// Weights that fall off with the distance from a joint's own cones, evened out over the skin.
fn bind(mesh: &Mesh, skeleton: &Skeleton, cones: &[RoundCone]) -> (Vec<[u16; 4]>, Vec<[f32; 4]>) {
    let mut weights: Vec<[f32; joint::COUNT]> =
        mesh.positions.iter().map(|p| hold(*p, skeleton, cones)).collect();
    let mut edges: Vec<[u32; 2]> = mesh.triangles.iter().flat_map(directed_edges).collect();
    edges.sort_unstable();
    for _ in 0..WEIGHT_PASSES {
        let mut sums = weights.clone();
        let mut counts = vec![1.0f32; weights.len()];
        for [a, b] in &edges {
            counts[*a as usize] += 1.0;
            for (sum, w) in sums[*a as usize].iter_mut().zip(&weights[*b as usize]) {
                *sum += w;
            }
        }
        for (sum, count) in sums.iter_mut().zip(counts) {
            sum.iter_mut().for_each(|w| *w /= count);
        }
        weights = sums;
    }
    weights.iter().map(strongest).unzip()
}

/// How strongly each joint holds a point of the skin. Only the nearest joint and those within two
/// steps of it in the tree count, so that one leg does not pull at the other.
fn hold(p: Vec3, skeleton: &Skeleton, cones: &[RoundCone]) -> [f32; joint::COUNT] {
    let mut distance = [f32::MAX; joint::COUNT];
    for cone in cones {
        let d = &mut distance[cone.joint as usize];
        *d = d.min(cone.distance(p));
    }
    let nearest = (0..joint::COUNT).min_by(|a, b| distance[*a].total_cmp(&distance[*b]));
    let up = |j: usize| skeleton.parents[j].map_or(j, usize::from);
    let kin = |a: usize, b: usize| up(a) == b || up(up(a)) == b;
    let nearest = nearest.unwrap_or(joint::HIPS);
    std::array::from_fn(|j| {
        let counts = j == nearest || kin(j, nearest) || kin(nearest, j);
        if counts { (-(distance[j] - distance[nearest]) / HOLD_M).exp() } else { 0.0 }
    })
}

fn strongest(weights: &[f32; joint::COUNT]) -> ([u16; 4], [f32; 4]) {
    let mut order: [u16; joint::COUNT] = std::array::from_fn(|j| j as u16);
    order.sort_by(|a, b| weights[*b as usize].total_cmp(&weights[*a as usize]));
    let joints = [order[0], order[1], order[2], order[3]];
    let kept = joints.map(|j| weights[j as usize]);
    let sum: f32 = kept.iter().sum();
    (joints, kept.map(|w| w / sum))
}

//! The primary graph of the built-in scene: every clip is a ring, and transitions lead from ring
//! to ring where the two motions fit best.

use std::ops::Range;

use cloth::{Pose, Rigid, Skeleton, Vec3};
use protocol::PoseId;

use super::clearance::Placed;
use super::clips::{Cycle, FPS};
use super::skeleton::joint;
use crate::import::align;
use crate::import::character::Clip;
use crate::import::transition::{self, Transition};
use crate::primary::{PrimaryEdge, PrimaryError, PrimaryGraph, PrimaryPose};

/// Clip names and the frames between which a transition may leave the one and enter the other.
/// Actions are left near their end and entered near their start. Gaits are left about every eight
/// frames: whoever steers gets from one to another within half a second, the transition included.
const TRANSITIONS: [(&str, Range<usize>, &str, Range<usize>); 38] = [
    ("walk", 0..8, "run", 0..22),
    ("walk", 8..16, "run", 0..22),
    ("walk", 16..24, "run", 0..22),
    ("walk", 24..32, "run", 0..22),
    ("run", 0..7, "walk", 0..32),
    ("run", 7..14, "walk", 0..32),
    ("run", 14..22, "walk", 0..32),
    ("walk", 0..8, "turn", 0..28),
    ("walk", 8..16, "turn", 0..28),
    ("walk", 16..24, "turn", 0..28),
    ("walk", 24..32, "turn", 0..28),
    ("turn", 0..7, "walk", 0..32),
    ("turn", 7..14, "walk", 0..32),
    ("turn", 14..21, "walk", 0..32),
    ("turn", 21..28, "walk", 0..32),
    ("run", 0..7, "turn", 0..28),
    ("run", 7..14, "turn", 0..28),
    ("run", 14..22, "turn", 0..28),
    ("turn", 0..7, "run", 0..22),
    ("turn", 7..14, "run", 0..22),
    ("turn", 14..21, "run", 0..22),
    ("turn", 21..28, "run", 0..22),
    ("walk", 0..32, "jump", 0..5),
    ("walk", 0..32, "kick", 0..4),
    ("walk", 0..32, "spin", 0..5),
    ("jump", 35..44, "walk", 0..32),
    ("kick", 32..44, "walk", 0..32),
    ("spin", 35..44, "walk", 0..32),
    ("turn", 0..28, "jump", 0..5),
    ("turn", 0..28, "kick", 0..4),
    ("turn", 0..28, "spin", 0..5),
    ("jump", 35..44, "turn", 0..28),
    ("kick", 32..44, "turn", 0..28),
    ("run", 0..22, "jump", 0..8),
    ("jump", 30..44, "run", 0..22),
    ("jump", 38..44, "kick", 0..4),
    ("kick", 36..44, "spin", 0..4),
    ("spin", 38..44, "jump", 0..4),
];

/// Under the heel, from the ankle, and under the tip of the toes, from their joint (m).
const HEEL: Vec3 = Vec3::new(0.0, -0.08, -0.03);
const TIP: Vec3 = Vec3::new(0.0, -0.025, 0.06);

/// Builds the graph; every pose can be reached from every other.
///
/// # Errors
/// A transition that names a clip that is not there, or a graph that does not hold together.
pub(super) fn primary_graph(
    skeleton: &Skeleton,
    cycles: &[Cycle],
) -> Result<PrimaryGraph, PrimaryError> {
    let unrolled: Vec<Clip> = cycles.iter().map(unroll).collect();
    let tracks = transition::tracks(skeleton, &unrolled);
    let mut first_node = Vec::new();
    let (mut poses, mut edges) = (Vec::new(), Vec::new());
    for (clip, cycle) in cycles.iter().enumerate() {
        let first = poses.len();
        first_node.push(first);
        for (frame, pose) in cycle.poses.iter().enumerate() {
            poses.push(node(clip, frame, false, pose.clone()));
            let next = (frame + 1) % cycle.poses.len();
            let moved = if next == 0 { cycle.round } else { Rigid::IDENTITY };
            edges.push(edge(first + frame, first + next, &moved));
        }
    }
    for link in links(skeleton, cycles, &unrolled, &tracks) {
        let (from, to) = (link.from_clip, link.to_clip);
        let frames = cycles[to].poses.len();
        let run = transition::run(&unrolled, &tracks, &link);
        let mut last = first_node[from] + link.from_frame - cycles[from].poses.len();
        let mut moved = run.fit.alignment();
        for (step, pose) in run.poses.into_iter().enumerate() {
            edges.push(edge(last, poses.len(), &moved));
            last = poses.len();
            moved = Rigid::IDENTITY;
            let pose = raised(skeleton, pose);
            poses.push(node(to, (link.to_frame + step) % frames, true, pose));
        }
        // Where a transition runs over the end of the ring, it is joined one round later.
        let joins = run.joins - frames;
        let around = if joins >= frames { cycles[to].round } else { Rigid::IDENTITY };
        edges.push(edge(last, first_node[to] + joins % frames, &around));
    }
    let names = cycles.iter().map(|cycle| cycle.name.to_owned()).collect();
    PrimaryGraph::new(FPS, names, poses, edges)
}

/// Blended joint rotations may push a foot into the ground; then the figure is raised as much.
fn raised(skeleton: &Skeleton, mut pose: Pose) -> Pose {
    let mut world = Vec::new();
    skeleton.world(&pose, &mut world);
    let height = |foot: usize, toes: usize| {
        let heel = world[foot].point(HEEL).y;
        let tip = world[toes].point(TIP).y;
        heel.min(tip).min(world[toes].translation.y - skeleton.rest[toes].translation.y)
    };
    let right = joint::SIDE;
    let left_height = height(joint::FOOT, joint::TOES);
    let lowest = left_height.min(height(joint::FOOT + right, joint::TOES + right));
    pose.root.y += (-lowest).max(0.0);
    pose
}

fn node(clip: usize, frame: usize, transition: bool, pose: Pose) -> PrimaryPose {
    PrimaryPose { clip: clip as u16, frame: frame as u32, transition, pose }
}

fn edge(from: usize, to: usize, moved: &Rigid) -> PrimaryEdge {
    let [yaw, _, _] = moved.rotation.to_euler(glam::EulerRot::YXZ).into();
    let shift = [moved.translation.x, moved.translation.z];
    PrimaryEdge { from: PoseId(from as u32), to: PoseId(to as u32), yaw, shift }
}

/// Three rounds of a ring, the middle one in the world of the ring, so that a window around any
/// frame of it and a run from any frame of it lie inside.
fn unroll(cycle: &Cycle) -> Clip {
    let rounds = [cycle.round.inverse(), Rigid::IDENTITY, cycle.round];
    let round = |by: &Rigid| cycle.poses.iter().map(|pose| pose.moved(by)).collect::<Vec<_>>();
    Clip { name: cycle.name.to_owned(), poses: rounds.iter().flat_map(round).collect() }
}

/// Fits of one transition that are looked at, best first.
const CANDIDATES: usize = 64;
/// Gap between the legs that a transition shall keep (m).
const LEGS_GAP_M: f32 = 0.012;

/// The best fit of each transition in which the legs do not cross; the best of all where there is
/// none. Of equals the earliest.
fn links(
    skeleton: &Skeleton,
    cycles: &[Cycle],
    unrolled: &[Clip],
    tracks: &[align::JointTrack],
) -> Vec<Transition> {
    let clip = |name: &str| cycles.iter().position(|cycle| cycle.name == name);
    let mut links = Vec::new();
    for (from_name, leave, to_name, enter) in TRANSITIONS {
        let (Some(from_clip), Some(to_clip)) = (clip(from_name), clip(to_name)) else { continue };
        let (before_from, before_to) = (cycles[from_clip].poses.len(), cycles[to_clip].poses.len());
        let mut fits = Vec::new();
        for from_frame in leave.start + before_from..leave.end + before_from {
            let source = tracks[from_clip].window(from_frame + 1);
            for to_frame in enter.start + before_to..enter.end + before_to {
                let distance_m = align::fit(source, tracks[to_clip].window(to_frame)).distance_m;
                fits.push(Transition { from_clip, from_frame, to_clip, to_frame, distance_m });
            }
        }
        fits.sort_by(|a, b| a.distance_m.total_cmp(&b.distance_m));
        let clear = |t: &&Transition| {
            let poses = transition::run(unrolled, tracks, t).poses;
            poses.iter().all(|pose| legs_gap_m(skeleton, pose) > LEGS_GAP_M)
        };
        links.extend(fits.iter().take(CANDIDATES).find(clear).or(fits.first()).copied());
    }
    links
}

fn legs_gap_m(skeleton: &Skeleton, pose: &Pose) -> f32 {
    let left = [joint::SHIN, joint::FOOT, joint::TOES];
    Placed::new(skeleton, pose).gap(&left, &left.map(|j| j + joint::SIDE))
}

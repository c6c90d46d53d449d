//! Small graphs and simulators for tests: deterministic maps on a few vertices, no cloth.

use std::sync::Arc;

use cloth::{Body, Pose, Quat, Rigid, Skeleton, Vec3};
use proptest::prelude::*;
use protocol::{EdgeId, PoseId};

use crate::grid::GridState;
use crate::primary::{PrimaryEdge, PrimaryGraph, PrimaryPose};
use crate::scene::{ExplorationSettings, Fabric, Garment, MetricSettings, Scene};
use crate::simulator::{Frame, FrameQuality, SimulateError, Simulator, SimulatorFactory};

pub fn primary(poses: u32, edges: &[(u32, u32)]) -> PrimaryGraph {
    let pose = Pose { root: Vec3::Y, rotations: vec![Quat::IDENTITY] };
    let node = |frame| PrimaryPose { clip: 0, frame, transition: false, pose: pose.clone() };
    let edge = |&(from, to): &(u32, u32)| PrimaryEdge {
        from: PoseId(from),
        to: PoseId(to),
        yaw: 0.0,
        shift: [0.0; 2],
    };
    let nodes = (0..poses).map(node).collect();
    let edges = edges.iter().map(edge).collect();
    PrimaryGraph::new(30.0, vec!["toy".into()], nodes, edges).unwrap()
}

/// A ring with chords: every pose can be reached from every other.
pub fn any_primary(poses_max: u32) -> impl Strategy<Value = PrimaryGraph> {
    (1..=poses_max)
        .prop_flat_map(|poses| {
            let chords = proptest::collection::btree_set((0..poses, 0..poses), 0..12);
            (Just(poses), chords)
        })
        .prop_map(|(poses, mut edges)| {
            edges.extend((0..poses).map(|p| (p, (p + 1) % poses)));
            primary(poses, &edges.into_iter().collect::<Vec<_>>())
        })
}

/// The graph of the paper's Figure 4: two ways from p1, which meet again in p2.
pub fn figure_4() -> PrimaryGraph {
    let edges = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 0), (1, 5), (5, 6), (6, 7), (7, 2)];
    primary(8, &edges)
}

/// Branches and a few chords: dead ends of very different errors.
pub fn knot() -> PrimaryGraph {
    let edges = [(0, 1), (1, 2), (2, 0), (2, 3), (3, 4), (4, 1), (4, 5), (5, 0), (1, 1), (3, 0)];
    primary(6, &edges)
}

pub fn scene(primary: PrimaryGraph, exploration: ExplorationSettings) -> Scene {
    let skeleton = Skeleton {
        names: vec!["hips".into()],
        parents: vec![None],
        offsets: vec![Vec3::ZERO],
        rest: vec![Rigid::IDENTITY],
    };
    let body = Body {
        skeleton,
        rest_positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
        triangles: vec![[0, 1, 2]],
        joints: vec![[0; 4]; 3],
        weights: vec![[1.0, 0.0, 0.0, 0.0]; 3],
    };
    let garment = Garment {
        name: "toy".into(),
        positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
        triangles: vec![[0, 1, 2]],
        layers: vec![],
        attached: vec![],
        fabric: Fabric::default(),
    };
    Scene {
        name: "toy".into(),
        body: Arc::new(body),
        primary: Arc::new(primary),
        start: PoseId(0),
        garment,
        exploration,
        metric: MetricSettings::default(),
        simulator: None,
    }
}

pub fn settings() -> ExplorationSettings {
    ExplorationSettings {
        tolerance_m: 0.004,
        depth_frames: 6,
        round_jobs: 3,
        publish_every_frames: 40,
        ..ExplorationSettings::default()
    }
}

/// Three vertices on a chaotic map which every edge kicks in its own way; `shrink` of 0..=255
/// says how fast the past is forgotten (0: at once).
#[derive(Debug, Clone)]
pub struct Toy {
    pub shrink: i32,
    /// Steps along this edge fail.
    pub broken: Option<EdgeId>,
    /// Steps along this edge are flagged where the first vertex comes out on an odd place.
    pub doubtful: Option<EdgeId>,
}

impl Toy {
    pub fn new(shrink: i32) -> Self {
        Self { shrink, broken: None, doubtful: None }
    }
}

fn noise(seed: u32) -> i32 {
    let mixed = seed.wrapping_mul(0x9e37_79b9) ^ (seed >> 7);
    ((mixed.wrapping_mul(0x85eb_ca6b) >> 16) & 0x0fff) as i32 - 2048
}

impl Toy {
    fn kick(&self, before: i16, edge: u32, component: u32) -> i16 {
        let old = i32::from(before);
        // A wrinkle that depends on the past: what is near may part.
        let wrinkle = noise((old / 256) as u32 ^ 77) * self.shrink / 1024;
        let new = old * self.shrink / 256 + wrinkle + noise(edge * 31 + component);
        new.clamp(-32_000, 32_000) as i16
    }
}

impl Simulator for Toy {
    fn step(&mut self, state: &GridState, edge: EdgeId) -> Result<Frame, SimulateError> {
        if self.broken == Some(edge) {
            return Err(SimulateError(format!("edge {edge} is broken")));
        }
        let mut next = state.clone();
        for (vertex, row) in next.positions.iter_mut().chain(&mut next.velocities).enumerate() {
            for (axis, value) in row.iter_mut().enumerate() {
                *value = self.kick(*value, edge.0, (vertex * 3 + axis) as u32);
            }
        }
        let quality = FrameQuality {
            frames: 1,
            vertex_frames: 3,
            stretch_max: f32::from(next.positions[0][0].unsigned_abs()) * 1e-5,
            frames_flagged: u64::from(self.doubtful == Some(edge) && next.positions[0][0] & 1 == 1),
            ..FrameQuality::default()
        };
        Ok(Frame { state: next, quality })
    }

    fn drape(&mut self, should_stop: &dyn Fn() -> bool) -> Result<Frame, SimulateError> {
        if should_stop() {
            return Err(SimulateError("stopped".into()));
        }
        let positions = vec![[0, 0, 0], [16_384, 0, 0], [0, 16_384, 0]];
        let state = GridState { positions, velocities: vec![[0; 3]; 3] };
        Ok(Frame { state, quality: FrameQuality::default() })
    }
}

impl SimulatorFactory for Toy {
    fn simulator(&self) -> Box<dyn Simulator> {
        Box::new(self.clone())
    }
}

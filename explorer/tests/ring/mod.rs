//! A scene and a graph that nobody simulated, for tests of publishing.

pub mod full;

use std::sync::Arc;

use cloth::{Body, Pose, Quat, Rigid, Skeleton, Vec3};
use explorer::primary::{PrimaryEdge, PrimaryGraph, PrimaryPose};
use explorer::scene::{ExplorationSettings, Fabric, Garment, MetricSettings, Scene};
use explorer::view::{GraphView, Run};
use protocol::links::LinkEntry;
use protocol::manifest::VersionStats;
use protocol::{PoseId, SigningKey, StateId};

pub const VERTICES: usize = 60;
pub const ROWS: usize = 3 * VERTICES;
pub const POSES: u32 = 40;

/// A ring of poses, and trajectories round it: each ends in a dead end, merged into the first.
pub struct Ring {
    pub runs: Vec<Run>,
    /// Job from which on states have a shape that earlier ones lack.
    pub odd_from: u64,
}

impl Ring {
    pub fn new(jobs: u64) -> Self {
        let mut runs = vec![Run { first: StateId(0), count: POSES + 1, job: 0, initial: true }];
        for job in 1..jobs {
            let last = runs.last().unwrap();
            let first = StateId(last.first.0 + u64::from(last.count));
            runs.push(Run { first, count: 10 + 7 * job as u32, job, initial: false });
        }
        Self { runs, odd_from: u64::MAX }
    }

    pub fn states(&self) -> u64 {
        self.runs.last().map_or(0, |last| last.first.0 + u64::from(last.count))
    }

    pub fn state(&self, state: StateId) -> Vec<f32> {
        let run = self.runs.iter().rev().find(|run| run.first <= state).unwrap();
        let t = (state.0 as f32) * 0.2;
        let odd = if run.job >= self.odd_from { 0.1 } else { 0.0 };
        let row = |row: usize| {
            let x = row as f32 / ROWS as f32;
            let shapes = (1..9).map(|k| k as f32).map(|k| {
                0.3 / (k * k) * (k * t + 0.3 * run.job as f32).sin() * (7.0 * k * x + k).cos()
            });
            0.5 * (9.0 * x).sin() + shapes.sum::<f32>() + odd * (t + 90.0 * x * x).sin()
        };
        (0..ROWS).map(row).collect()
    }
}

impl GraphView for Ring {
    fn vertex_count(&self) -> usize {
        VERTICES
    }

    fn runs(&self) -> &[Run] {
        &self.runs
    }

    fn positions(&self, state: StateId, out: &mut [f32]) -> std::io::Result<()> {
        out.copy_from_slice(&self.state(state));
        Ok(())
    }

    fn links(&self) -> Vec<LinkEntry> {
        let entry = |run: &Run, i: u32| {
            let pose = PoseId(i % POSES);
            if i + 1 == run.count {
                return LinkEntry::DeadEnd { pose, target: StateId(pose.0.into()), error_m: 0.01 };
            }
            LinkEntry::Interior { pose, next: vec![StateId(run.first.0 + u64::from(i) + 1)] }
        };
        self.runs.iter().flat_map(|run| (0..run.count).map(move |i| entry(run, i))).collect()
    }

    fn stats(&self) -> VersionStats {
        let merges = self.runs.len() as u64;
        VersionStats {
            poses: POSES,
            edges: POSES,
            states: self.states(),
            merges,
            worst_error_m: 0.01,
            mean_error_m: 0.01,
            ..VersionStats::default()
        }
    }
}

pub fn scene() -> Scene {
    let skeleton = Skeleton {
        names: vec!["hips".into()],
        parents: vec![None],
        offsets: vec![Vec3::ZERO],
        rest: vec![Rigid::IDENTITY],
    };
    let at = |i: usize| Vec3::new((i as f32).sin(), (i as f32).cos(), i as f32 / 9.0);
    let body = Body {
        skeleton,
        rest_positions: (0..9).map(at).collect(),
        triangles: vec![[0, 1, 2]],
        joints: vec![[0; 4]; 9],
        weights: vec![[1.0, 0.0, 0.0, 0.0]; 9],
    };
    let pose = |frame| PrimaryPose {
        clip: 0,
        frame,
        transition: false,
        pose: Pose { root: Vec3::Y, rotations: vec![Quat::IDENTITY] },
    };
    let edge = |from: u32| PrimaryEdge {
        from: PoseId(from),
        to: PoseId((from + 1) % POSES),
        yaw: 0.0,
        shift: [0.0; 2],
    };
    let poses = (0..POSES).map(pose).collect();
    let edges = (0..POSES).map(edge).collect();
    let primary = PrimaryGraph::new(30.0, vec!["ring".into()], poses, edges).unwrap();
    let garment = Garment {
        name: "sheet".into(),
        positions: (0..VERTICES).map(at).collect(),
        triangles: (0..VERTICES as u32 - 2).map(|i| [i, i + 1, i + 2]).collect(),
        layers: vec![],
        attached: vec![],
        fabric: Fabric::default(),
    };
    Scene {
        name: "ring".into(),
        body: Arc::new(body),
        primary: Arc::new(primary),
        start: PoseId(0),
        garment,
        exploration: ExplorationSettings::default(),
        metric: MetricSettings::default(),
        simulator: None,
    }
}

pub fn key() -> SigningKey {
    SigningKey::from_seed(&[7; 32])
}

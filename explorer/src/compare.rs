//! Ground truth: what a graph plays against what the simulator does on walks that were never
//! simulated as such.
//!
//! Every walk starts at a state of the initial pass, which all stages share, and takes uniformly
//! random edges. Rows: `graph` follows the links of a stage; `skinning` moves the garment with the
//! body and simulates nothing; `floor` is the simulator against itself, its start moved by 1 mm: no
//! graph can be expected to do better for long.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use cloth::{Rigid, Vec3};
use protocol::{EdgeId, PoseId, StateId};
use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde::Serialize;

use crate::grid::{GridState, POSITION_STEP_M};
use crate::grow::archive::Archive;
use crate::scene::Scene;
use crate::simulator::{SimulateError, Simulator, SimulatorFactory};

/// Horizons (s) of the rows, as far as the walks are long enough.
pub const HORIZONS_S: [f32; 4] = [0.5, 1.0, 2.0, 5.0];
/// How far the floor's start is moved (m).
pub const NUDGE_M: f32 = 1e-3;
/// States of the stages of Kim et al. 2013 (slides 26 to 28).
pub const PAPER_STAGES: [u64; 3] = [4_906, 36_073, 99_352];

/// What is compared.
#[derive(Debug, Clone)]
pub struct Settings {
    /// Walks.
    pub walks: u64,
    /// Frames of each.
    pub frames: usize,
    /// Seed of the walks.
    pub seed: u64,
    /// States of the stages after the first; those that the graph does not have are left out.
    pub stages: Vec<u64>,
    /// Threads.
    pub workers: usize,
}

/// One row.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// `graph`, `skinning` or `floor`.
    pub what: &'static str,
    /// States of the graph; 0 for what needs no graph.
    pub stage: u64,
    /// Time since the start of the walk (s).
    pub horizon_s: f32,
    /// Root mean square of all vertices' distances at that time (mm).
    pub rms_mm: f64,
    /// 95th percentile of them (mm).
    pub p95_mm: f64,
    /// The largest (mm).
    pub max_mm: f64,
    /// Kinetic energy up to that time, as a share of the simulation's.
    pub energy_ratio: f64,
    /// 95th percentile of vertex speeds up to that time, as a share of the simulation's.
    pub speed_p95_ratio: f64,
    /// Share of the frames up to that time whose state is of the simulation's class.
    pub same_class: f64,
}

/// Why nothing could be compared.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CompareError {
    /// A frame could not be simulated.
    #[error("simulating a walk: {0}")]
    Simulate(#[from] SimulateError),
    /// A state could not be read.
    #[error("reading a state: {0}")]
    Read(#[from] std::io::Error),
    /// Walks shorter than the first horizon.
    #[error("{0} frames are {1:.2} s, the first horizon is {h} s; give more", h = HORIZONS_S[0])]
    Short(usize, f32),
}

/// States of the stages of a graph: after initialisation, those asked for, and the one shown.
pub fn stages(archive: &Archive, asked: &[u64]) -> Vec<(u64, u64)> {
    let graph = archive.graph();
    let first = graph.initialised().unwrap_or(0);
    let states = |commit: u64| graph.moments()[commit as usize].states;
    let last = archive.shown();
    let mut commits = vec![first];
    for &wanted in asked {
        let at = graph.moments().partition_point(|moment| moment.states < wanted) as u64;
        if at > first && at < last {
            commits.push(at);
        }
    }
    commits.push(last);
    commits.sort_unstable();
    commits.dedup();
    commits.into_iter().map(|commit| (commit, states(commit))).collect()
}

/// Walks and compares; `each` is told how many walks are done.
///
/// # Errors
/// A walk cannot be simulated, or is too short.
pub fn compare(
    archive: &Archive,
    scene: &Scene,
    simulators: &dyn SimulatorFactory,
    settings: &Settings,
    each: &(dyn Fn(u64) + Sync),
) -> Result<Vec<Row>, CompareError> {
    let seconds = settings.frames as f32 / scene.primary.fps();
    let horizons: Vec<f32> = HORIZONS_S.into_iter().filter(|h| *h <= seconds + 1e-4).collect();
    if horizons.is_empty() {
        return Err(CompareError::Short(settings.frames, seconds));
    }
    let bench = Bench {
        archive,
        scene,
        stages: stages(archive, &settings.stages),
        ends: horizons.iter().map(|h| (h * scene.primary.fps()).round() as usize).collect(),
        bind: bind(scene),
    };
    let next = AtomicUsize::new(0);
    let results: Mutex<Vec<(usize, Result<Walked, CompareError>)>> = Mutex::default();
    let work = || {
        let mut simulator = simulators.simulator();
        loop {
            let walk = next.fetch_add(1, Ordering::Relaxed);
            if walk as u64 >= settings.walks {
                return;
            }
            let seed = settings.seed.wrapping_add(walk as u64);
            let walked = bench.walk(simulator.as_mut(), seed, settings.frames);
            let failed = walked.is_err();
            let mut results = results.lock().expect("no worker panics holding it");
            results.push((walk, walked));
            each(results.len() as u64);
            if failed {
                next.store(usize::MAX / 2, Ordering::Relaxed);
            }
        }
    };
    std::thread::scope(|scope| {
        (0..settings.workers.max(1)).for_each(|_| drop(scope.spawn(work)));
    });
    let mut results = results.into_inner().expect("no worker panics holding it");
    results.sort_by_key(|(walk, _)| *walk);
    let walks: Vec<Walked> =
        results.into_iter().map(|(_, walked)| walked).collect::<Result<_, _>>()?;
    Ok(bench.rows(&horizons, &walks))
}

/// A player's cloth along a walk, against the simulator's.
#[derive(Debug, Default, Clone)]
struct Player {
    /// At every horizon: the vertices' distances (m).
    distances: Vec<Vec<f32>>,
    /// By frame: the sum of squared speeds (m^2/s^2).
    energy: Vec<f64>,
    /// By frame: whether the class is the simulator's.
    same: Vec<bool>,
    /// By frame: speeds of some vertices (m/s).
    speeds: Vec<Vec<f32>>,
}

/// What one walk gave: the simulator, skinning, the floor, then every stage.
struct Walked {
    truth: Player,
    others: Vec<Player>,
}

struct Bench<'a> {
    archive: &'a Archive,
    scene: &'a Scene,
    /// Commit and states.
    stages: Vec<(u64, u64)>,
    /// Frames of the horizons.
    ends: Vec<usize>,
    /// The joints that carry each vertex, and their weights.
    bind: Vec<([u16; 4], [f32; 4])>,
}

impl Bench<'_> {
    fn walk(
        &self,
        simulator: &mut dyn Simulator,
        seed: u64,
        frames: usize,
    ) -> Result<Walked, CompareError> {
        let graph = self.archive.graph();
        let primary = graph.primary();
        let mut random = Pcg64Mcg::seed_from_u64(seed);
        let mut pick = |count: usize| (random.next_u64() % count as u64) as usize;
        let first = graph.initialised().unwrap_or(0);
        let pose = PoseId(pick(primary.poses().len()) as u32);
        // Every pose has exactly one interior state when the initial pass ends.
        let start = graph.interior_at(pose, first)[0];
        let mut truth = self.archive.state(start)?;
        let mut floor = nudged(&truth);
        let mut playing: Vec<StateId> = vec![start; self.stages.len()];
        let mut walked = Walked {
            truth: Player::default(),
            others: vec![Player::default(); 2 + self.stages.len()],
        };
        let mut at = pose;
        let last = *self.ends.last().expect("there is a horizon");
        for frame in 1..=frames.min(last) {
            let edge = EdgeId(
                primary.out_edges(at).next().map_or(0, |e| e.0)
                    + pick(primary.out_degree(at)) as u32,
            );
            truth = simulator.step(&truth, edge)?.state;
            floor = simulator.step(&floor, edge)?.state;
            at = primary.edge(edge).to;
            let class = self.archive.classifier().class(at, &truth);
            let skinned = self.skinned(edge);
            let horizon = self.ends.iter().position(|end| *end == frame);
            let note = |player: &mut Player, state: &GridState| {
                let same = self.archive.classifier().class(at, state) == class;
                player.note(state, &truth, same, horizon);
            };
            note(&mut walked.truth, &truth.clone());
            note(&mut walked.others[0], &skinned);
            note(&mut walked.others[1], &floor);
            for (stage, (commit, _)) in self.stages.iter().enumerate() {
                let next = self.archive.view(*commit).follow(playing[stage], edge);
                playing[stage] = next;
                let state = self.archive.state(next)?;
                note(&mut walked.others[2 + stage], &state);
            }
        }
        Ok(walked)
    }

    /// The garment moved with the body along an edge, as a state at its end.
    fn skinned(&self, edge: EdgeId) -> GridState {
        let primary = &self.scene.primary;
        let edge = primary.edge(edge);
        let from = primary.pose(edge.from).pose.clone();
        let to = primary.pose(edge.to).pose.moved(&edge.alignment());
        let [before, after] = [&from, &to].map(|pose| self.skin(pose));
        let inverse = to.hips().inverse();
        let fps = primary.fps();
        let positions: Vec<Vec3> = after.iter().map(|p| inverse.point(*p)).collect();
        let velocities: Vec<Vec3> =
            before.iter().zip(&after).map(|(a, b)| inverse.vector((*b - *a) * fps)).collect();
        let none = || GridState {
            positions: vec![[0; 3]; positions.len()],
            velocities: vec![[0; 3]; positions.len()],
        };
        GridState::round(&positions, &velocities).unwrap_or_else(|_| none())
    }

    fn skin(&self, pose: &cloth::Pose) -> Vec<Vec3> {
        let skeleton = &self.scene.body.skeleton;
        let mut world = Vec::new();
        skeleton.world(pose, &mut world);
        let moved: Vec<Rigid> =
            world.iter().zip(&skeleton.rest).map(|(w, rest)| w.after(&rest.inverse())).collect();
        let place = |(p, (joints, weights)): (&Vec3, &([u16; 4], [f32; 4]))| {
            let pairs = joints.iter().zip(weights);
            pairs.map(|(joint, weight)| moved[usize::from(*joint)].point(*p) * *weight).sum()
        };
        self.scene.garment.positions.iter().zip(&self.bind).map(place).collect()
    }

    fn rows(&self, horizons: &[f32], walks: &[Walked]) -> Vec<Row> {
        let mut rows = Vec::new();
        let mut kinds: Vec<(&'static str, Vec<(usize, u64)>)> = Vec::new();
        let stages = self.stages.iter().enumerate().map(|(i, (_, states))| (2 + i, *states));
        kinds.push(("graph", stages.collect()));
        kinds.push(("skinning", vec![(0, 0)]));
        kinds.push(("floor", vec![(1, 0)]));
        for (what, players) in kinds {
            for (horizon, horizon_s) in horizons.iter().enumerate() {
                for &(player, stage) in &players {
                    let pairs: Vec<_> =
                        walks.iter().map(|w| (&w.others[player], &w.truth)).collect();
                    rows.push(row(what, stage, (horizon, *horizon_s), self.ends[horizon], &pairs));
                }
            }
        }
        rows
    }
}

fn row(
    what: &'static str,
    stage: u64,
    (horizon, horizon_s): (usize, f32),
    frames: usize,
    pairs: &[(&Player, &Player)],
) -> Row {
    let mut all: Vec<f32> =
        pairs.iter().flat_map(|(player, _)| player.distances[horizon].iter().copied()).collect();
    all.sort_unstable_by(f32::total_cmp);
    let squares: f64 = all.iter().map(|d| f64::from(*d).powi(2)).sum();
    let sum = |of: &dyn Fn(&Player) -> f64| {
        let [player, truth]: [f64; 2] = [
            pairs.iter().map(|(player, _)| of(player)).sum(),
            pairs.iter().map(|(_, truth)| of(truth)).sum(),
        ];
        player / truth.max(1e-300)
    };
    let speed_p95 = |which: &dyn Fn(&(&Player, &Player)) -> Vec<f32>| {
        let mut speeds: Vec<f32> = pairs.iter().flat_map(which).collect();
        speeds.sort_unstable_by(f32::total_cmp);
        quantile(&speeds, 0.95)
    };
    let until = |player: &Player| player.speeds[..frames].concat();
    let same = pairs.iter().flat_map(|(player, _)| &player.same[..frames]).filter(|s| **s).count();
    Row {
        what,
        stage,
        horizon_s,
        rms_mm: 1e3 * (squares / all.len().max(1) as f64).sqrt(),
        p95_mm: 1e3 * quantile(&all, 0.95),
        max_mm: 1e3 * quantile(&all, 1.0),
        energy_ratio: sum(&|player| player.energy[..frames].iter().sum()),
        speed_p95_ratio: speed_p95(&|pair| until(pair.0))
            / speed_p95(&|pair| until(pair.1)).max(1e-9),
        same_class: same as f64 / (pairs.len() * frames).max(1) as f64,
    }
}

fn quantile(sorted: &[f32], share: f64) -> f64 {
    let place = (sorted.len().saturating_sub(1) as f64 * share).round() as usize;
    sorted.get(place).map_or(0.0, |value| f64::from(*value))
}

impl Player {
    fn note(&mut self, state: &GridState, truth: &GridState, same: bool, horizon: Option<usize>) {
        // Every 16th vertex's speed is enough for a percentile.
        let speed = |v: usize| state.velocity(v).length();
        self.speeds.push((0..state.vertex_count()).step_by(16).map(speed).collect());
        let squared = |v: usize| f64::from(state.velocity(v).length_squared());
        self.energy.push((0..state.vertex_count()).map(squared).sum());
        self.same.push(same);
        if horizon.is_some() {
            let apart = |v: usize| state.position(v).distance(truth.position(v));
            self.distances.push((0..state.vertex_count()).map(apart).collect());
        }
    }
}

/// The state moved as a whole by [`NUDGE_M`] along x.
fn nudged(state: &GridState) -> GridState {
    let steps = (NUDGE_M / POSITION_STEP_M).round() as i16;
    let mut state = state.clone();
    state.positions.iter_mut().for_each(|p| p[0] = p[0].saturating_add(steps));
    state
}

/// Each vertex of the garment is carried by the joints of the nearest vertex of the body.
fn bind(scene: &Scene) -> Vec<([u16; 4], [f32; 4])> {
    let body = &scene.body;
    let nearest = |p: &Vec3| {
        let far = body.rest_positions.iter().map(|q| q.distance_squared(*p));
        let best = far.enumerate().min_by(|a, b| a.1.total_cmp(&b.1)).map_or(0, |(v, _)| v);
        (body.joints[best], body.weights[best])
    };
    scene.garment.positions.iter().map(nearest).collect()
}

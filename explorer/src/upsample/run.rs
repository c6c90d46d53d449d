//! Training data: a coarse simulation, and a fine one that is tracked by it.

use std::time::Instant;

use cloth::coarse::{self, Coarse, CoarseError, Input, Moving};
use cloth::solver::track::{Guide, TrackError, Tracker, step_tracked};
use cloth::{Model, ModelError, State, Vec3, Workspace};

use super::cache::{Cache, Key};
use super::patch::{Row, lifted};
use super::scene::{Moment, Motion, Scene};

/// Longest step of the fine simulation (s).
const SUBSTEP_S: f32 = 1.0 / 90.0;
/// Frames that are kept together; a run that was killed goes on after the last whole chunk.
const CHUNK: usize = 40;

/// A motion, simulated on both meshes.
#[derive(Debug, Clone)]
pub struct Run {
    /// Frames that count.
    pub frames: usize,
    /// Frame after frame the coarse positions x0, y0, z0, x1, ... (m).
    pub coarse: Vec<f32>,
    /// Frame after frame the fine positions (m).
    pub fine: Vec<f32>,
    /// Largest difference between a test function's sum and its goal, over all frames (m).
    pub residual_m: f64,
}

/// Why a motion could not be simulated.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RunError {
    /// The coarse cloth was refused.
    #[error(transparent)]
    Coarse(#[from] CoarseError),
    /// The fine cloth was refused.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The fine cloth could not be tracked.
    #[error("{motion}, frame {frame}: {source}")]
    Track {
        /// Which motion.
        motion: &'static str,
        /// Counted from the lead-in's begin.
        frame: usize,
        /// What happened.
        source: TrackError,
    },
    /// Results could not be kept.
    #[error("writing to the work folder: {0}")]
    Write(#[from] std::io::Error),
}

/// Both simulations of a scene, ready for any of its motions.
pub struct Simulation<'a> {
    scene: &'a Scene,
    coarse: Coarse,
    model: Model,
    tracker: Tracker,
    lift: Vec<Row>,
    functions: Vec<f32>,
}

/// What a chunk of frames begins with and ends with.
struct Fine {
    state: State,
    residual_m: f64,
}

impl<'a> Simulation<'a> {
    /// With test functions given vertex after vertex (`scene.tests` values each).
    ///
    /// # Errors
    /// Constants out of range, functions that depend on each other.
    pub fn new(scene: &'a Scene, functions: Vec<f32>) -> Result<Self, RunError> {
        let (patch, fine) = (&scene.coarse, &scene.fine);
        let coarse = Coarse::new(
            patch.mesh.clone(),
            scene.coarse_material,
            scene.environment,
            &patch.pins,
            scene.settings,
        )?;
        let (mesh, environment) = (fine.mesh.clone(), scene.environment);
        let model = Model::new(mesh, scene.material, environment, None, &fine.pins)?;
        let tracker = Tracker::new(&model, &functions, scene.tests);
        let tracker = tracker.map_err(|source| RunError::Track {
            motion: "test functions",
            frame: 0,
            source,
        })?;
        Ok(Self { scene, coarse, model, tracker, lift: patch.lift(fine), functions })
    }

    /// The coarse cloth.
    pub fn coarse(&self) -> &Coarse {
        &self.coarse
    }

    /// Surroundings of frame `frame`, counted from the lead-in's begin, or `part` of a frame on.
    fn moment(&self, motion: &Motion, frame: usize, part: f32) -> Moment {
        let at = frame as f32 - motion.lead_in as f32 + part;
        motion.moment(at * self.scene.frame_s, self.scene.frame_s)
    }

    /// Coarse positions of all frames, the lead-in included, one a frame.
    ///
    /// # Errors
    /// Surroundings out of range.
    pub fn run_coarse(&self, motion: &Motion) -> Result<Vec<Vec<Vec3>>, CoarseError> {
        self.step_coarse(motion, &mut |_| ())
    }

    /// Median time of a coarse step of a motion (us).
    ///
    /// # Errors
    /// Surroundings out of range.
    pub fn time_coarse(&self, motion: &Motion) -> Result<f64, CoarseError> {
        let mut times = Vec::new();
        self.step_coarse(motion, &mut |s| times.push(s))?;
        times.sort_by(f64::total_cmp);
        Ok(1e6 * times[times.len() / 2])
    }

    /// `timed` is told how long each step took (s).
    fn step_coarse(
        &self,
        motion: &Motion,
        timed: &mut dyn FnMut(f64),
    ) -> Result<Vec<Vec<Vec3>>, CoarseError> {
        let mut state = self.coarse.rest_state();
        let mut ws = coarse::Workspace::default();
        let rest = self.scene.coarse.mesh.rest_positions();
        let mut before = self.moment(motion, 0, 0.0);
        let mut frames = vec![state.positions.clone()];
        for frame in 1..motion.lead_in + motion.frames {
            let now = self.moment(motion, frame, 0.0);
            let pins: Vec<Vec3> =
                self.coarse.pinned().iter().map(|v| now.place(rest[*v as usize])).collect();
            let colliders = moving(&before, &now);
            let input = Input {
                pins: &pins,
                colliders: &colliders,
                wind: now.wind,
                push: &[],
                tethers: &[],
                seconds: self.scene.frame_s,
            };
            let start = Instant::now();
            self.coarse.step(&input, &mut state, &mut ws)?;
            timed(start.elapsed().as_secs_f64());
            frames.push(state.positions.clone());
            before = now;
        }
        Ok(frames)
    }

    /// Simulates a motion on both meshes, or takes from `cache` what is there already. `progress`
    /// is told after each frame how many of how many are done.
    ///
    /// # Errors
    /// A cloth that came apart; a work folder that cannot be written.
    pub fn run(
        &self,
        motion: &Motion,
        cache: &Cache,
        progress: &mut dyn FnMut(usize, usize),
    ) -> Result<Run, RunError> {
        let coarse = self.run_coarse(motion)?;
        let goals: Vec<Vec<[f64; 3]>> =
            coarse.iter().map(|p| self.tracker.measure(&lifted(&self.lift, p))).collect();
        let key = self.key(motion, &coarse);
        let all = coarse.len();
        let mut now = Fine { state: self.model.rest_state(), residual_m: 0.0 };
        let mut fine = Vec::with_capacity(motion.frames * 3 * self.lift.len());
        let mut ws = Workspace::default();
        for first in (0..all).step_by(CHUNK) {
            let key = key.clone().with_words(&[first as u32]);
            let last = (first + CHUNK).min(all);
            let shown = last.saturating_sub(motion.lead_in.max(first));
            let numbers = match cache.load(&key).filter(|n| n.len() == self.chunk_length(shown)) {
                Some(numbers) => numbers,
                None => {
                    let mut numbers = Vec::new();
                    for frame in first..last {
                        if frame > 0 {
                            self.frame(motion, frame, &goals, &mut now, &mut ws)?;
                        }
                        if frame >= motion.lead_in {
                            push(&mut numbers, &now.state.positions);
                        }
                        progress(frame + 1, all);
                    }
                    push(&mut numbers, &now.state.positions);
                    push(&mut numbers, &now.state.velocities);
                    numbers.push(now.residual_m as f32);
                    cache.keep(&key, &numbers)?;
                    numbers
                }
            };
            self.resume(&numbers, &mut now);
            fine.extend_from_slice(&numbers[..3 * self.lift.len() * shown]);
            progress(last, all);
        }
        let shown = &coarse[motion.lead_in..];
        let flat = shown.iter().flatten().flat_map(|p| p.to_array()).collect();
        Ok(Run { frames: motion.frames, coarse: flat, fine, residual_m: now.residual_m })
    }

    fn chunk_length(&self, shown: usize) -> usize {
        3 * self.lift.len() * (shown + 2) + 1
    }

    /// Goes on from the end of a chunk: also right after it was simulated, so that a run that was
    /// killed and one that was not are the same.
    fn resume(&self, numbers: &[f32], now: &mut Fine) {
        let count = 3 * self.lift.len();
        let end = numbers.len() - 1 - 2 * count;
        let list = |from: usize| -> Vec<Vec3> {
            numbers[from..from + count]
                .as_chunks::<3>()
                .0
                .iter()
                .map(|p| Vec3::from_array(*p))
                .collect()
        };
        now.state = State { positions: list(end), velocities: list(end + count) };
        now.residual_m = f64::from(numbers[numbers.len() - 1]);
    }

    /// One frame of the fine cloth. Goals run along a cubic through those of the frames, so that they
    /// have no jump in speed.
    fn frame(
        &self,
        motion: &Motion,
        frame: usize,
        goals: &[Vec<[f64; 3]>],
        now: &mut Fine,
        ws: &mut Workspace,
    ) -> Result<(), RunError> {
        let steps = steps_of(self.scene);
        let seconds = self.scene.frame_s / steps as f32;
        let at = |f: usize| &goals[f.min(goals.len() - 1)];
        let four = [at(frame.saturating_sub(2)), at(frame - 1), at(frame), at(frame + 1)];
        let rest = self.scene.fine.mesh.rest_positions();
        let mut before = self.moment(motion, frame - 1, 0.0);
        for step in 1..=steps {
            let part = step as f32 / steps as f32;
            let then = self.moment(motion, frame - 1, part);
            let goal = cubic(four, f64::from(part));
            let held: Vec<Vec3> =
                self.scene.fine.pins.iter().map(|v| then.place(rest[*v as usize])).collect();
            let colliders = moving(&before, &then);
            let guide =
                Guide { goal: &goal, held: &held, colliders: &colliders, wind: then.wind, seconds };
            let done = step_tracked(&self.model, &self.tracker, &guide, &mut now.state, ws);
            let done =
                done.map_err(|source| RunError::Track { motion: motion.name, frame, source })?;
            now.residual_m = now.residual_m.max(done.residual_m);
            before = then;
        }
        Ok(())
    }

    /// Everything that a fine run depends on.
    fn key(&self, motion: &Motion, coarse: &[Vec<Vec3>]) -> Key {
        let scene = self.scene;
        let mut key = Key::new("fine frames").with(&self.functions).with(&[scene.frame_s]);
        let m = scene.material;
        let weft = m.weft.unwrap_or(-1.0);
        key = key.with(&[m.density, m.stretch, weft, m.shear, m.bend, m.friction, m.drag]);
        key = key.with(&[m.damping_s, m.offset, scene.environment.air_density]);
        key = key.with(&scene.environment.gravity.to_array());
        for patch in [&scene.coarse, &scene.fine] {
            let points: Vec<f32> =
                patch.mesh.rest_positions().iter().flat_map(|p| p.to_array()).collect();
            key = key.with(&points).with_words(patch.mesh.triangles().as_flattened());
            key = key.with_words(&patch.pins);
        }
        for (frame, positions) in coarse.iter().enumerate() {
            let flat: Vec<f32> = positions.iter().flat_map(|p| p.to_array()).collect();
            key = key.with(&flat);
            for part in [0.0, 0.5] {
                key = key.with(&self.moment(motion, frame, part).numbers());
            }
        }
        key.with_words(&[motion.lead_in as u32, steps_of(scene) as u32])
    }
}

impl Moment {
    /// All its numbers.
    fn numbers(&self) -> Vec<f32> {
        let Self { carrier, gather, colliders, wind } = self;
        let mut all = vec![*gather];
        all.extend(carrier.rotation.to_array());
        all.extend(carrier.translation.to_array());
        all.extend(wind.to_array());
        for c in colliders {
            all.extend(c.ends.iter().flat_map(|e| e.to_array()));
            all.push(c.radius);
        }
        all
    }
}

/// Steps of the fine simulation in a frame.
fn steps_of(scene: &Scene) -> usize {
    (scene.frame_s / SUBSTEP_S - 1e-3).ceil().max(1.0) as usize
}

fn push(numbers: &mut Vec<f32>, list: &[Vec3]) {
    numbers.extend(list.iter().flat_map(|p| p.to_array()));
}

/// Colliders on their way; one that was not there before, or came from elsewhere, stands still.
fn moving(before: &Moment, now: &Moment) -> Vec<Moving> {
    let one = |(i, to): (usize, &cloth::coarse::Capsule)| match before.colliders.get(i) {
        Some(from) if from.ends[0].distance(to.ends[0]) < 1.0 => Moving { from: *from, to: *to },
        _ => Moving::resting(*to),
    };
    now.colliders.iter().enumerate().map(one).collect()
}

/// Catmull and Rom's cubic between the second and the third of four points.
fn cubic(four: [&Vec<[f64; 3]>; 4], t: f64) -> Vec<[f64; 3]> {
    let weights = [
        -0.5 * t + t * t - 0.5 * t * t * t,
        1.0 - 2.5 * t * t + 1.5 * t * t * t,
        0.5 * t + 2.0 * t * t - 1.5 * t * t * t,
        -0.5 * t * t + 0.5 * t * t * t,
    ];
    let one = |i: usize| {
        std::array::from_fn(|axis| weights.iter().zip(four).map(|(w, p)| w * p[i][axis]).sum())
    };
    (0..four[0].len()).map(one).collect()
}

/// Test functions by groups of vertices (Bergou et al. 2007, in the spirit of): each vertex belongs
/// to the nearest of `tests` centres, chosen so that each next one is farthest from those before.
pub fn clustered(points: &[Vec3], tests: usize) -> Vec<f32> {
    let mut nearest = vec![(f32::INFINITY, 0usize); points.len()];
    let mut centre = 0;
    for group in 0..tests {
        for (near, p) in nearest.iter_mut().zip(points) {
            let d = p.distance_squared(points[centre]);
            if d < near.0 {
                *near = (d, group);
            }
        }
        let farthest =
            |best: usize, i: usize| if nearest[i].0 > nearest[best].0 { i } else { best };
        centre = (0..points.len()).fold(0, farthest);
    }
    let mut functions = vec![0.0; points.len() * tests];
    for (row, (_, group)) in functions.chunks_mut(tests).zip(&nearest) {
        row[*group] = 1.0;
    }
    functions
}

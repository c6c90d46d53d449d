//! Where an exploration stands, and what came of it.

use std::collections::BTreeMap;
use std::time::Instant;

use protocol::VersionNumber;
use serde::Serialize;

use super::Setup;
use crate::cpu::process_cpu_s;
use crate::disk::free_bytes;
use crate::grow::class;
use crate::grow::graph::Kind;
use crate::grow::job::JobError;
use crate::grow::ledger::Phase;
use crate::grow::policy::{Policy, visits};
use crate::grow::work::Work;
use crate::simulator::FrameQuality;

/// Where an exploration stands; given after every job.
#[derive(Debug, Clone, PartialEq)]
pub struct Progress {
    /// What is being done.
    pub phase: Phase,
    /// Frames simulated, drape apart.
    pub simulated_frames: u64,
    /// Frames of the initial pass.
    pub initial_frames: u64,
    /// States, dead ends included.
    pub states: u64,
    /// Dead ends in the queue.
    pub queued: u64,
    /// Largest merge error (m).
    pub worst_error_m: f32,
    /// Worst merge error of the best prefix, the one whose worst merge costs least (m), once there is
    /// a whole graph.
    pub best_worst_error_m: Option<f32>,
    /// Mean merge error (m).
    pub mean_error_m: f32,
    /// The newest version published from this work folder.
    pub version: Option<VersionNumber>,
    /// Jobs given up over all runs; their dead ends are set aside.
    pub failed_jobs: u64,
    /// Measures of all frames, the drape's included.
    pub quality: FrameQuality,
    /// CPU seconds of jobs, dropped ones and a foreign program's included (wall seconds where the
    /// system does not tell), over all runs.
    pub simulate_cpu_s: f64,
    /// What players see of merges in a second of play, by the counts that had arrived when the newest version
    /// of this run was published (mm): the errors of the merges that they pass, summed.
    pub seen_mm_per_s: Option<f64>,
    /// Why the job that ended just now was given up.
    pub failure: Option<String>,
    /// What a frame costs, as far as is known.
    pub cost: FrameCost,
}

/// What a simulated frame costs.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct FrameCost {
    /// CPU seconds, measured: over all frames so far, or on the drape while there are none. 0
    /// before the drape.
    pub cpu_s: f64,
    /// Bytes in the work folder.
    pub work_bytes: u64,
    /// Bytes left on the disk of the work folder; `None` where the system does not tell.
    pub free_bytes: Option<u64>,
}

/// Why an exploration ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum End {
    /// `should_stop` said so.
    Stopped,
    /// The number of frames was reached.
    Frames,
    /// The error was reached.
    Error,
    /// No dead end is left that could be expanded.
    Exhausted,
    /// The disk is nearly full.
    Disk,
}

/// What is known at the end. The keys are those of `toile explore --json`; the graph is the
/// newest, of which the head may show a prefix.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Poses of the primary graph.
    pub poses: u64,
    /// Edges of the primary graph.
    pub edges: u64,
    /// States, dead ends included.
    pub states: u64,
    /// Trajectories.
    pub trajectories: u64,
    /// Dead ends, each merged.
    pub merges: u64,
    /// Largest merge error (mm).
    pub worst_error_mm: f64,
    /// Worst merge error of the best prefix, the one whose worst merge costs least (mm).
    pub best_worst_error_mm: f64,
    /// The least that the worst merge ever cost since the initial pass (mm): its error, and the
    /// penalty where it crosses classes or leads into a flagged state. What `--error` goes by.
    pub best_worst_cost_mm: f64,
    /// Mean merge error (mm).
    pub mean_error_mm: f64,
    /// Frames simulated, drape apart.
    pub simulated_frames: u64,
    /// CPU seconds of jobs, dropped ones and a foreign program's included (wall seconds where the
    /// system does not tell), over all runs.
    pub simulate_cpu_s: f64,
    /// The newest version published; 0 for none.
    pub version: u64,
    /// Jobs given up over all runs.
    pub failed_jobs: u64,
    /// Dead ends that stay merged since the last job from them was given up.
    pub set_aside: u64,
    /// Frames that were simulated again at a finer step.
    pub frames_retried: u64,
    /// Frames that came out of bounds all the same.
    pub frames_flagged: u64,
    /// Merges into flagged states: their poses have no other state yet, and are simulated first.
    pub merges_into_flagged: u64,
    /// The policy.
    pub policy: Policy,
    /// Classes of states found, with how many states each has; one nameless class without rules.
    pub classes: Vec<ClassCount>,
    /// Merges that lead from one class into another.
    pub merges_across_classes: u64,
    /// Of these, the ones that are implausible by the scene's rules.
    pub implausible_merges: u64,
    /// CPU seconds so far of this process (wall seconds where the system does not tell) and of the
    /// programs that simulated for it.
    pub cpu_s: f64,
    /// Frames simulated in this run, by second of its wall time.
    pub frames_per_wall_s: f64,
    /// 95th percentile of the errors of merges, each weighted by how often a player passes it (mm).
    pub visited_p95_mm: f64,
    /// Mean of the same (mm).
    pub visited_mean_mm: f64,
    /// How many merges a player passes in a second of play: times the mean, what is seen of them.
    pub visited_merges_per_s: f64,
    /// Measures of all frames, the drape's included.
    pub quality: FrameQuality,
    /// Why it ended.
    pub end: End,
}

/// A class, and how often it was found.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ClassCount {
    /// In words, e.g. `hood down`; empty where the scene has no rules.
    pub class: String,
    /// States of it, dead ends included.
    pub states: u64,
}

/// What is known of the run in this process.
pub(super) struct Run {
    pub start: Instant,
    /// Id of the first state that it will make.
    pub first: u64,
    /// CPU seconds of the drape; 0 where it was made before.
    pub drape_cpu_s: f64,
    /// See [`Progress::seen_mm_per_s`].
    pub seen_mm_per_s: Option<f64>,
    /// CPU seconds of programs that simulate.
    pub program_cpu_s: f64,
}

impl Run {
    /// One that begins now, where there are so many states.
    pub fn new(states: u64) -> Self {
        let start = Instant::now();
        Self { start, first: states, drape_cpu_s: 0.0, seen_mm_per_s: None, program_cpu_s: 0.0 }
    }

    /// Looks at what players see, for a version that was just published.
    pub fn published(&mut self, work: &Work) {
        let [_, mean_mm, merges_per_s] = visited(work);
        self.seen_mm_per_s = Some(mean_mm * merges_per_s);
    }

    pub fn progress(&self, setup: &Setup<'_>, work: &Work, failure: Option<&JobError>) -> Progress {
        let (ledger, graph) = (work.ledger(), work.graph());
        Progress {
            phase: ledger.phase(),
            simulated_frames: graph.simulated_frames(),
            initial_frames: ledger.plan().frames(),
            states: graph.next_id().0,
            queued: graph.queue().len() as u64,
            worst_error_m: graph.worst_error_m(),
            best_worst_error_m: graph.best_worst_error_m(),
            mean_error_m: graph.mean_error_m(),
            version: ledger.published().map(|last| last.number),
            failed_jobs: ledger.failed_jobs(),
            quality: *ledger.quality(),
            simulate_cpu_s: work.simulate_cpu_s(),
            seen_mm_per_s: self.seen_mm_per_s,
            failure: failure.map(ToString::to_string),
            cost: self.cost(setup, work),
        }
    }

    fn cost(&self, setup: &Setup<'_>, work: &Work) -> FrameCost {
        let frames = work.graph().simulated_frames();
        let drape_frames = setup.scene.exploration.drape_frames.max(1).saturating_mul(2);
        let cpu_s = match frames {
            0 => self.drape_cpu_s / f64::from(drape_frames),
            frames => work.simulate_cpu_s() / frames as f64,
        };
        FrameCost { cpu_s, work_bytes: work.state_bytes(), free_bytes: free_bytes(setup.work) }
    }

    pub fn summary(&self, setup: &Setup<'_>, work: &Work, end: End) -> Summary {
        let (ledger, graph) = (work.ledger(), work.graph());
        let millimetres = |m: f32| f64::from(m) * 1000.0;
        let wall_s = self.start.elapsed().as_secs_f64();
        let frames = graph.next_id().0 - self.first;
        let unflagged = |class: class::Class| class & !class::FLAGGED;
        let crossed = |state: &crate::grow::graph::State| match state.kind {
            Kind::DeadEnd { target, .. } => {
                unflagged(graph.state(target).class) != unflagged(state.class)
            }
            _ => false,
        };
        let into_flagged = |state: &crate::grow::graph::State| match state.kind {
            Kind::DeadEnd { target, .. } => graph.state(target).class & class::FLAGGED != 0,
            _ => false,
        };
        let penalties = class::Penalties::new(&setup.scene.metric.classes);
        let implausible = |state: &crate::grow::graph::State| match state.kind {
            Kind::DeadEnd { target, .. } => {
                penalties.of(state.class, unflagged(graph.state(target).class)) > 0.0
            }
            _ => false,
        };
        let merges_into_flagged = graph.states().filter(|s| into_flagged(s)).count() as u64;
        let [visited_p95_mm, visited_mean_mm, visited_merges_per_s] = visited(work);
        Summary {
            poses: graph.primary().poses().len() as u64,
            edges: graph.primary().edges().len() as u64,
            states: graph.next_id().0,
            trajectories: graph.runs().len() as u64,
            merges: graph.queue().len() as u64,
            worst_error_mm: millimetres(graph.worst_error_m()),
            best_worst_error_mm: millimetres(graph.best_worst_error_m().unwrap_or(0.0)),
            best_worst_cost_mm: millimetres(graph.best_worst_cost_m().unwrap_or(0.0)),
            mean_error_mm: millimetres(graph.mean_error_m()),
            simulated_frames: graph.simulated_frames(),
            simulate_cpu_s: work.simulate_cpu_s(),
            version: ledger.published().map_or(0, |last| last.number.0),
            failed_jobs: ledger.failed_jobs(),
            set_aside: ledger.set_aside().len() as u64,
            frames_retried: ledger.quality().frames_retried,
            frames_flagged: ledger.quality().frames_flagged,
            policy: setup.options.policy,
            classes: classes(setup, work),
            merges_across_classes: graph.states().filter(|s| crossed(s)).count() as u64,
            implausible_merges: graph.states().filter(|s| implausible(s)).count() as u64,
            merges_into_flagged,
            cpu_s: process_cpu_s().unwrap_or(wall_s) + self.program_cpu_s,
            frames_per_wall_s: frames as f64 / wall_s.max(1e-9),
            visited_p95_mm,
            visited_mean_mm,
            visited_merges_per_s,
            quality: *ledger.quality(),
            end,
        }
    }
}

fn classes(setup: &Setup<'_>, work: &Work) -> Vec<ClassCount> {
    let mut counts = BTreeMap::<class::Class, u64>::new();
    for state in work.graph().states() {
        *counts.entry(state.class & !class::FLAGGED).or_default() += 1;
    }
    let rules = &setup.scene.metric.classes;
    let named = |(class, states)| ClassCount { class: class::name(rules, class), states };
    counts.into_iter().map(named).collect()
}

/// 95th percentile and mean of merge errors weighted by visits (mm), and how many are passed in a second.
fn visited(work: &Work) -> [f64; 3] {
    let graph = work.graph();
    if graph.initialised().is_none() {
        return [0.0; 3];
    }
    let visits = visits(graph, work.ledger().steering().model(), &[]);
    // Largest first.
    let errors: Vec<(f64, f64)> = graph
        .queue()
        .iter()
        .map(|(state, error_m)| (f64::from(error_m), visits[state.index()]))
        .collect();
    let all: f64 = errors.iter().map(|(_, visits)| visits).sum();
    let mean = errors.iter().map(|(error_m, visits)| error_m * visits).sum::<f64>();
    let mut above = 0.0;
    let at = errors.iter().find(|(_, visits)| {
        above += visits;
        above >= 0.05 * all
    });
    let merges_per_s = all * f64::from(graph.primary().fps());
    [at.map_or(0.0, |(error_m, _)| 1e3 * error_m), 1e3 * mean / all.max(1e-300), merges_per_s]
}

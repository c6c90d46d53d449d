//! Explores a scene: the initial pass, then rounds of expansion for ever, publishing on the way
//! (Kim et al. 2013, section 3.2).

use std::path::{Path, PathBuf};
use std::sync::Arc;

use object_store::ObjectStore;
use protocol::{SigningKey, VersionNumber};
use serde::Serialize;

use crate::grow::graph::Graph;
use crate::grow::job::JobError;
use crate::grow::ledger::Phase;
use crate::grow::record::PublishRecord;
use crate::grow::round::{self, Ended, RoundError};
use crate::grow::work::{Work, WorkError};
use crate::pack::{EncodeSettings, PublishError, Publisher, collect_leftovers};
use crate::scene::Scene;
use crate::simulator::{FrameQuality, SimulateError, Simulator, SimulatorFactory};
use crate::view::GraphView;

/// Most workers of one process.
pub const WORKERS_MAX: usize = 1024;

/// How to explore, and when to end.
#[derive(Clone)]
pub struct ExploreOptions {
    /// Threads that simulate, at least 1. The outcome does not depend on it.
    pub workers: usize,
    /// Ends once the store's graph has this many simulated frames, the drape apart (checked at
    /// the end of a round, so that a few more may be simulated).
    pub frames: Option<u64>,
    /// Ends once the best prefix's worst merge error is at most this (m).
    pub error_m: Option<f32>,
    /// As in the paper: neither early stop nor re-merging.
    pub paper: bool,
    /// Whether an exploration that ends by `frames` or `error_m` leaves the best prefix as head
    /// (design decision 6). One that is stopped never does.
    pub best_prefix_at_end: bool,
    /// Asked often, also in the middle of a round: true drops the jobs in flight and returns.
    pub should_stop: Arc<dyn Fn() -> bool + Send + Sync>,
}

impl Default for ExploreOptions {
    /// One worker, for ever.
    fn default() -> Self {
        Self {
            workers: 1,
            frames: None,
            error_m: None,
            paper: false,
            best_prefix_at_end: true,
            should_stop: Arc::new(|| false),
        }
    }
}

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
    /// Lowest worst merge error so far (m), once there is a whole graph.
    pub best_worst_error_m: Option<f32>,
    /// Mean merge error (m).
    pub mean_error_m: f32,
    /// The newest version published from this work folder.
    pub version: Option<VersionNumber>,
    /// Jobs given up; their dead ends are set aside.
    pub failed_jobs: u64,
    /// Measures of all frames, the drape's included.
    pub quality: FrameQuality,
    /// CPU seconds of jobs (wall seconds where the system does not tell), over all runs.
    pub simulate_cpu_s: f64,
    /// Why the job that ended just now was given up.
    pub failure: Option<String>,
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
    /// Lowest worst merge error since the initial pass (mm).
    pub best_worst_error_mm: f64,
    /// Mean merge error (mm).
    pub mean_error_mm: f64,
    /// Frames simulated, drape apart.
    pub simulated_frames: u64,
    /// CPU seconds of jobs (wall seconds where the system does not tell), over all runs.
    pub simulate_cpu_s: f64,
    /// The newest version published; 0 for none.
    pub version: u64,
    /// Jobs given up.
    pub failed_jobs: u64,
    /// Frames that were simulated again at a finer step.
    pub frames_retried: u64,
    /// Frames that came out of bounds all the same.
    pub frames_flagged: u64,
    /// Measures of all frames, the drape's included.
    pub quality: FrameQuality,
    /// Why it ended.
    pub end: End,
}

/// Why an exploration could not go on. What was reported as done is safe.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExploreError {
    /// The work folder.
    #[error("the work folder: {0}")]
    Work(#[from] WorkError),
    /// A round of jobs.
    #[error("exploring: {0}")]
    Round(#[from] RoundError),
    /// The garment could not be draped on the start pose.
    #[error("draping the garment: {0}")]
    Drape(SimulateError),
    /// A version could not be published.
    #[error("publishing: {0}")]
    Publish(#[from] PublishError),
    /// Half-written files in the store could not be removed.
    #[error("half-written files in {} cannot be removed: {source}", .folder.display())]
    Leftovers {
        /// The store's folder.
        folder: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The store holds states that the work folder does not know.
    #[error(
        "the store holds {stored} states of this garment, the work folder {} only {known}: give \
         the work folder that the store was grown in, or another store", .folder.display()
    )]
    StoreAhead {
        /// States in the store.
        stored: u64,
        /// The work folder.
        folder: PathBuf,
        /// States in it.
        known: u64,
    },
}

/// Where an exploration reads and writes.
#[derive(Clone)]
pub struct Place {
    /// Where versions are published.
    pub store: Arc<dyn ObjectStore>,
    /// Its folder, where it is one on this machine: cleared of what a killed run left half-written.
    pub folder: Option<PathBuf>,
    /// Signs them; the same for every run on a store.
    pub key: SigningKey,
    /// The work folder: exact states and the journal. Made if it is missing.
    pub work: PathBuf,
}

/// Explores a scene until `options` say otherwise, from wherever the work folder stands:
///
/// 1. drapes the garment on the start pose and simulates every primary edge once;
/// 2. merges the dead ends and publishes the first version;
/// 3. for ever: expands the dead ends with the largest errors, round after round, and publishes
///    at fixed counts of simulated frames.
///
/// Killed at any instant and called again, it ends with the same work folder and the same store as
/// if it had not been. The future blocks its thread while it simulates and is not `Send`: give it
/// a thread of its own, e.g. with a current-thread runtime.
///
/// # Errors
/// The work folder or the store refuses, or the initial pass cannot be simulated. A job of an
/// expansion that cannot be simulated is no error: see [`Progress::failure`].
pub async fn explore(
    scene: &Scene,
    simulators: &dyn SimulatorFactory,
    place: &Place,
    options: &ExploreOptions,
    progress: &mut dyn FnMut(&Progress),
) -> Result<Summary, ExploreError> {
    let work = Work::open(&place.work, scene, options.paper)?;
    let settings = EncodeSettings::for_rank(usize::from(scene.exploration.rank_max));
    let (store, key) = (Arc::clone(&place.store), place.key.clone());
    let publisher = Publisher::open(store, scene, key, settings).await?;
    // Only now: the folder is locked and the store is ours, so that nobody else is writing there.
    if let Some(folder) = &place.folder {
        collect_leftovers(folder)
            .map_err(|source| ExploreError::Leftovers { folder: folder.clone(), source })?;
    }
    let mut publisher = Garment(publisher, &scene.garment.name);
    let setup = Setup { scene, simulators, work: &place.work, options };
    run(setup, work, &mut publisher, progress).await
}

/// Where versions go. Publishing what the head shows already makes no version.
trait Publish {
    /// The head's number, and how many states of this garment the store holds.
    fn head(&self) -> (Option<VersionNumber>, u64);

    /// Makes the graph the head; says its number.
    async fn publish(&mut self, view: &dyn GraphView) -> Result<VersionNumber, PublishError>;
}

/// The store's publisher, for the garment of this name.
struct Garment<'a>(Publisher, &'a str);

impl Publish for Garment<'_> {
    fn head(&self) -> (Option<VersionNumber>, u64) {
        let Some(head) = self.0.head() else { return (None, 0) };
        let last = head.garment(self.1).and_then(|garment| garment.regions.last());
        let stored = last.map_or(0, |last| last.first_state.0 + u64::from(last.state_count));
        (Some(head.number), stored)
    }

    async fn publish(&mut self, view: &dyn GraphView) -> Result<VersionNumber, PublishError> {
        Ok(self.0.publish(view).await?.number)
    }
}

/// What is explored, and from what.
struct Setup<'a> {
    scene: &'a Scene,
    simulators: &'a dyn SimulatorFactory,
    work: &'a Path,
    options: &'a ExploreOptions,
}

/// The exploration, whatever the store.
async fn run(
    setup: Setup<'_>,
    mut work: Work,
    publisher: &mut impl Publish,
    progress: &mut dyn FnMut(&Progress),
) -> Result<Summary, ExploreError> {
    let Setup { scene, options, .. } = setup;
    let (head, stored) = publisher.head();
    let known = work.graph().next_id().0;
    if stored > known {
        let folder = setup.work.to_owned();
        return Err(ExploreError::StoreAhead { stored, folder, known });
    }
    let workers = options.workers.clamp(1, WORKERS_MAX);
    let mut simulators: Vec<Box<dyn Simulator>> =
        (0..workers).map(|_| setup.simulators.simulator()).collect();
    let every = scene.exploration.publish_every_frames.max(1);
    // A store that lost versions, or a new one for an old folder, is brought up to date at once.
    let mut behind = work.ledger().published().is_some_and(|p| head < Some(p.number));
    let stop = || (options.should_stop)();
    progress(&progress_of(&work, None));
    loop {
        if work.ledger().round().is_done() {
            if work.ledger().phase() == Phase::Drape {
                let frame = simulators[0].drape().map_err(ExploreError::Drape)?;
                work.drape(&frame)?;
            }
            if work.ledger().phase() == Phase::Merge {
                work.merge_initial()?;
            }
            if work.ledger().phase() == Phase::Expansion {
                if behind || due(&work, every) {
                    let newest = work.graph().commit();
                    publish(&mut work, publisher, newest).await?;
                    behind = false;
                    progress(&progress_of(&work, None));
                }
                if let Some(end) = reached(work.graph(), options) {
                    return finish(work, publisher, options, end).await;
                }
            }
            if stop() {
                return Ok(summary(&work, End::Stopped));
            }
            if !work.open_round() {
                return finish(work, publisher, options, End::Exhausted).await;
            }
        }
        let mut each = |work: &Work, failure: Option<&JobError>| {
            progress(&progress_of(work, failure));
        };
        if round::run(&mut work, &mut simulators, &stop, &mut each)? == Ended::Stopped {
            return Ok(summary(&work, End::Stopped));
        }
    }
}

/// Whether a multiple of `every` frames was passed since the last version.
fn due(work: &Work, every: u64) -> bool {
    let frames_at = |commit: u64| work.graph().moments()[commit as usize].states - 1;
    match work.ledger().published() {
        None => true,
        Some(last) => work.graph().simulated_frames() / every > frames_at(last.commit) / every,
    }
}

fn reached(graph: &Graph, options: &ExploreOptions) -> Option<End> {
    if options.frames.is_some_and(|frames| graph.simulated_frames() >= frames) {
        return Some(End::Frames);
    }
    let best_m = graph.best_worst_error_m()?;
    options.error_m.is_some_and(|error_m| best_m <= error_m).then_some(End::Error)
}

async fn publish(
    work: &mut Work,
    publisher: &mut impl Publish,
    shown: u64,
) -> Result<(), ExploreError> {
    let number = publisher.publish(&work.view(shown)).await?;
    let commit = work.graph().commit();
    Ok(work.published(PublishRecord { number, commit, shown })?)
}

/// Leaves the best prefix, or else the newest graph, as the head.
async fn finish(
    mut work: Work,
    publisher: &mut impl Publish,
    options: &ExploreOptions,
    end: End,
) -> Result<Summary, ExploreError> {
    let newest = work.graph().commit();
    let best = work.graph().best_commit().filter(|_| options.best_prefix_at_end);
    let shown = best.unwrap_or(newest);
    if work.ledger().published().map(|last| last.shown) != Some(shown) {
        publish(&mut work, publisher, shown).await?;
    }
    Ok(summary(&work, end))
}

fn progress_of(work: &Work, failure: Option<&JobError>) -> Progress {
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
        failed_jobs: ledger.set_aside().len() as u64,
        quality: *ledger.quality(),
        simulate_cpu_s: work.simulate_cpu_s(),
        failure: failure.map(ToString::to_string),
    }
}

fn summary(work: &Work, end: End) -> Summary {
    let (ledger, graph) = (work.ledger(), work.graph());
    let millimetres = |m: f32| f64::from(m) * 1000.0;
    Summary {
        poses: graph.primary().poses().len() as u64,
        edges: graph.primary().edges().len() as u64,
        states: graph.next_id().0,
        trajectories: graph.runs().len() as u64,
        merges: graph.queue().len() as u64,
        worst_error_mm: millimetres(graph.worst_error_m()),
        best_worst_error_mm: millimetres(graph.best_worst_error_m().unwrap_or(0.0)),
        mean_error_mm: millimetres(graph.mean_error_m()),
        simulated_frames: graph.simulated_frames(),
        simulate_cpu_s: work.simulate_cpu_s(),
        version: ledger.published().map_or(0, |last| last.number.0),
        failed_jobs: ledger.set_aside().len() as u64,
        frames_retried: ledger.quality().frames_retried,
        frames_flagged: ledger.quality().frames_flagged,
        quality: *ledger.quality(),
        end,
    }
}

#[cfg(test)]
#[path = "explore_tests.rs"]
mod tests;

//! Explores a scene: the initial pass, then rounds of expansion for ever, publishing on the way
//! (Kim et al. 2013, section 3.2).

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use object_store::ObjectStore;
use protocol::manifest::GarmentVersion;
use protocol::{SigningKey, StateId, VersionNumber};

use crate::cpu::CpuClock;
use crate::disk::free_bytes;
use crate::grow::graph::Graph;
use crate::grow::job::{JOB_STATES_MAX, JobError};
use crate::grow::journal;
use crate::grow::ledger::Phase;
use crate::grow::policy::Policy;
use crate::grow::record::{PublishRecord, SteerRecord, TagRecord};
use crate::grow::round::{self, Crew, Ended, RoundError};
use crate::grow::work::{Work, WorkError};
use crate::pack::publish::codec_of;
use crate::pack::upsampler::{self, UpsamplerSettings};
use crate::pack::{Bound, EncodeSettings, Profile, PublishError, Publisher, collect_leftovers};
use crate::scene::Scene;
use crate::simulator::{SimulateError, SimulatorFactory};
use crate::tags::{Tagged, tagged_since};
use crate::telemetry::{Walked, walked_since};
use crate::view::GraphView;

#[path = "explore_physics.rs"]
mod physics;
#[path = "explore_report.rs"]
mod report;

pub use physics::OLDER;
use physics::older;
use report::Run;
pub use report::{ClassCount, End, FrameCost, Progress, Summary};

/// Most workers of one process.
pub const WORKERS_MAX: usize = 1024;

/// How to explore, and when to end.
#[derive(Clone)]
pub struct ExploreOptions {
    /// Threads that simulate, at least 1. The outcome does not depend on it.
    pub workers: usize,
    /// Ends after the job with which the store's graph has this many simulated frames, the drape
    /// apart, once the initial pass is over.
    pub frames: Option<u64>,
    /// Ends once the best prefix's worst merge costs at most this (m): its error, and the penalty
    /// where it crosses classes or leads into a flagged state.
    pub error_m: Option<f32>,
    /// Which dead ends are simulated first. Taken up at the next round, whatever it was before.
    pub policy: Policy,
    /// Names of clips: only dead ends in these are simulated; none: in all.
    pub clips: Vec<String>,
    /// Ends before less than this much is left on the disk of the work folder or of a local store,
    /// beside what a round may need (bytes).
    pub keep_free_bytes: u64,
    /// How states are encoded: the profile that the store has, else `toile`, where this is `None`.
    pub codec: Option<Profile>,
    /// What profile `toile` keeps to, for states encoded from now on.
    pub bound: Bound,
    /// Whether a version after the first gets an upsampler, where the garment has none yet: learned from
    /// the initial graph. A garment that can have none goes on without.
    pub upsampler: Option<UpsamplerSettings>,
    /// As in the paper: neither early stop nor re-merging.
    pub paper: bool,
    /// Whether an exploration that ends by `frames` or `error_m` leaves the best prefix as head
    /// (design decision 6). One that is stopped never does.
    pub best_prefix_at_end: bool,
    /// The journal is compacted when it has more than so many bytes that are not (about 9 a state).
    pub journal_tail_bytes: u64,
    /// How often to look for tags while jobs run (each look costs a request to the store).
    pub tags_every: Duration,
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
            policy: Policy::Greedy,
            clips: Vec::new(),
            keep_free_bytes: 256 << 20,
            codec: None,
            bound: Bound::LIVE,
            upsampler: None,
            paper: false,
            best_prefix_at_end: true,
            journal_tail_bytes: journal::TAIL_BYTES,
            tags_every: Duration::from_millis(500),
            should_stop: Arc::new(|| false),
        }
    }
}

/// Why an exploration could not go on. What was reported as done is safe.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExploreError {
    /// The work folder.
    #[error("the work folder: {0}{older}", older = older(.0))]
    Work(#[from] WorkError),
    /// A round of jobs.
    #[error("exploring: {0}")]
    Round(#[from] RoundError),
    /// A clip that is not there.
    #[error("there is no clip {0:?} to explore in; the scene has {1}")]
    NoClip(String, String),
    /// What was simulated before does not come out again.
    #[error(
        "the work folder {}: state {state}, simulated again, comes out {apart_mm:.3} mm from the one on \
         record: another simulator made this folder; take that one, or another work folder and store",
        .folder.display()
    )]
    OtherPhysics {
        /// The work folder.
        folder: PathBuf,
        /// The state at the frame's end.
        state: StateId,
        /// How far the two are apart by the scene's metric (mm).
        apart_mm: f32,
    },
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
///    at fixed counts of simulated frames. What people tag comes first: a round that is under way waits, and a
///    version follows at once.
///
/// Killed at any instant and called again, it ends with the same work folder and the same store as
/// if it had not been. The future blocks its thread while it simulates and is not `Send`: give it
/// a thread of its own, e.g. with a current-thread runtime.
///
/// # Errors
/// The work folder or the store refuses, or the initial pass cannot be simulated. A job of an
/// expansion that cannot be simulated is no error (see [`Progress::failure`]), unless nothing can be
/// any more. Another simulator than the one that made the folder is refused.
pub async fn explore(
    scene: &Scene,
    simulators: &dyn SimulatorFactory,
    place: &Place,
    options: &ExploreOptions,
    progress: &mut dyn FnMut(&Progress),
) -> Result<Summary, ExploreError> {
    let tail_bytes = options.journal_tail_bytes;
    let work = Work::open_with(&place.work, scene, options.paper, tail_bytes)?;
    let (store, key) = (Arc::clone(&place.store), place.key.clone());
    let stored = codec_of(&*store, &scene.garment.name).await.map_err(PublishError::from)?;
    let settings = match options.codec.or(stored).unwrap_or_default() {
        Profile::Kim2013 => EncodeSettings::for_rank(usize::from(scene.exploration.rank_max)),
        Profile::Toile => EncodeSettings::for_bound(options.bound),
    };
    let publisher = Publisher::open(store, scene, key, settings).await?;
    // Only now: the folder is locked and the store is ours, so that nobody else is writing there.
    if let Some(folder) = &place.folder {
        collect_leftovers(folder)
            .map_err(|source| ExploreError::Leftovers { folder: folder.clone(), source })?;
    }
    let mut publisher =
        Garment { publisher, scene, store: &*place.store, upsampler: options.upsampler };
    let folder = place.folder.as_deref();
    let setup = Setup { scene, simulators, work: &place.work, folder, options };
    run(setup, work, &mut publisher, progress).await
}

/// Where versions go. Publishing what the head shows already makes no version.
trait Publish {
    /// The head's number, and how many states of this garment the store holds.
    fn head(&self) -> (Option<VersionNumber>, u64);

    /// Makes the graph the head; says its number. `soon`: somebody waits, so nothing but the new
    /// states is worked on.
    async fn publish(
        &mut self,
        view: &dyn GraphView,
        soon: bool,
    ) -> Result<VersionNumber, PublishError>;

    /// Whether the head should have an upsampler and has none.
    fn lacks_upsampler(&self) -> bool {
        false
    }

    /// What players walked since this batch of telemetry.
    async fn walked(&self, after: u64) -> Result<Walked, object_store::Error>;

    /// What people pointed at since this tag.
    async fn tagged(&self, after: u64) -> Result<Tagged, object_store::Error>;
}

/// The store's publisher, for a scene's garment.
struct Garment<'a> {
    publisher: Publisher,
    scene: &'a Scene,
    store: &'a dyn ObjectStore,
    /// How to make an upsampler; `None` where none is wanted or can be had.
    upsampler: Option<UpsamplerSettings>,
}

impl Garment<'_> {
    fn listed(&self) -> Option<&GarmentVersion> {
        self.publisher.head()?.garment(&self.scene.garment.name)
    }

    /// Gives the next version an upsampler, if it is to have one.
    fn learn(&mut self, view: &dyn GraphView) -> Result<(), PublishError> {
        let Some(settings) = self.upsampler.filter(|_| self.lacks_upsampler()) else {
            return Ok(());
        };
        match upsampler::learn(self.scene, view, &settings) {
            Ok((bytes, learned)) => {
                tracing::info!(?learned, bytes = bytes.len(), "an upsampler was learned");
                self.publisher.set_upsampler(bytes)
            }
            Err(error) => {
                tracing::warn!(%error, "published without an upsampler");
                self.upsampler = None;
                Ok(())
            }
        }
    }
}

impl Publish for Garment<'_> {
    fn head(&self) -> (Option<VersionNumber>, u64) {
        let Some(head) = self.publisher.head() else { return (None, 0) };
        let last = self.listed().and_then(|garment| garment.regions.last());
        let stored = last.map_or(0, |last| last.first_state.0 + u64::from(last.state_count));
        (Some(head.number), stored)
    }

    async fn publish(
        &mut self,
        view: &dyn GraphView,
        soon: bool,
    ) -> Result<VersionNumber, PublishError> {
        if soon {
            return Ok(self.publisher.publish_soon(view).await?.number);
        }
        self.learn(view)?;
        Ok(self.publisher.publish(view).await?.number)
    }

    fn lacks_upsampler(&self) -> bool {
        let lacking = self.listed().is_some_and(|garment| garment.upsampler.is_none());
        lacking && self.upsampler.is_some()
    }

    async fn walked(&self, after: u64) -> Result<Walked, object_store::Error> {
        match self.listed() {
            Some(garment) => walked_since(self.store, garment.id, after).await,
            None => Ok(Walked { newest: after, ..Walked::default() }),
        }
    }

    async fn tagged(&self, after: u64) -> Result<Tagged, object_store::Error> {
        match self.listed() {
            Some(garment) => tagged_since(self.store, garment.id, after).await,
            None => Ok(Tagged { newest: after, ..Tagged::default() }),
        }
    }
}

/// What is explored, and from what.
struct Setup<'a> {
    scene: &'a Scene,
    simulators: &'a dyn SimulatorFactory,
    work: &'a Path,
    /// The store's folder, where it is one.
    folder: Option<&'a Path>,
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
        return Err(ExploreError::StoreAhead { stored, folder: setup.work.to_owned(), known });
    }
    let clips = clips(scene, &options.clips)?;
    let mut run = Run::new(known);
    let workers = options.workers.clamp(1, WORKERS_MAX);
    let mut crew = Crew::new((0..workers).map(|_| setup.simulators.simulator()).collect());
    // A store that lost versions, or a new one for an old folder, is brought up to date at once.
    let mut behind = work.ledger().published().is_some_and(|p| head < Some(p.number))
        || publisher.lacks_upsampler();
    physics::check(&setup, &work, crew.first())?;
    let stop = || (options.should_stop)();
    let mut second_chance = true;
    progress(&run.progress(&setup, &work, None));
    loop {
        if frames_reached_in_round(&work, options) {
            return finish_round(&setup, work, &run, (publisher, behind)).await;
        }
        if work.ledger().round().is_done() {
            let ended = between_rounds(
                &setup,
                (&mut work, &mut run),
                (publisher, &mut behind),
                &mut crew,
                progress,
            );
            if let Some(end) = ended.await? {
                return finish(&setup, work, &run, publisher, end).await;
            }
            if let Some(end) = must_end(&setup, &work) {
                return Ok(run.summary(&setup, &work, end));
            }
            steer(&mut work, publisher, options.policy, &clips).await?;
            if !open_round(&mut work, &mut second_chance)? {
                return finish(&setup, work, &run, publisher, End::Exhausted).await;
            }
        }
        let mut each = |work: &Work, failure: Option<&JobError>| {
            progress(&run.progress(&setup, work, failure));
        };
        let tags = looks(&*publisher, work.ledger().newest_tag(), options.tags_every);
        let asks = (&stop as &dyn Fn() -> bool, tags);
        let ended = round::run(&mut work, &mut crew, asks, options.frames, &mut each).await?;
        run.program_cpu_s = crew.program_cpu_s();
        match ended {
            // The next look ends it.
            Ended::Done | Ended::Frames => {}
            Ended::Stopped => return Ok(run.summary(&setup, &work, End::Stopped)),
            Ended::Interrupted(tags) => {
                tracing::info!(newest = tags.newest, "the round waits: something was tagged");
                work.interrupt(tags)?;
            }
        }
    }
}

/// Looks for tags of this garment in the store, every so often.
fn looks(
    publisher: &impl Publish,
    mut known: u64,
    every: Duration,
) -> impl AsyncFnMut() -> Option<TagRecord> {
    let mut looked = Instant::now();
    async move || {
        if looked.elapsed() < every {
            return None;
        }
        looked = Instant::now();
        // A store that cannot be read is spoken of between rounds.
        let Tagged { newest, states } = publisher.tagged(known).await.ok()?;
        known = newest;
        (!states.is_empty()).then_some(TagRecord { newest, states })
    }
}

/// Drapes, ends the initial pass, publishes what is due, and says whether an end was reached.
async fn between_rounds(
    setup: &Setup<'_>,
    (work, run): (&mut Work, &mut Run),
    (publisher, behind): (&mut impl Publish, &mut bool),
    crew: &mut Crew,
    progress: &mut dyn FnMut(&Progress),
) -> Result<Option<End>, ExploreError> {
    if work.ledger().phase() == Phase::Drape {
        let stop = || (setup.options.should_stop)();
        let simulator = crew.first();
        let clock = CpuClock::start();
        let mut frame = simulator.drape(&stop);
        if frame.is_err() && simulator.may_recover() && !stop() {
            frame = simulator.drape(&stop);
        }
        run.program_cpu_s = simulator.program_cpu_s();
        let frame = match frame {
            // The next look ends it.
            Err(_) if stop() => return Ok(None),
            frame => frame.map_err(ExploreError::Drape)?,
        };
        run.drape_cpu_s = clock.elapsed_s() + run.program_cpu_s;
        work.drape(&frame)?;
        progress(&run.progress(setup, work, None));
    }
    if work.ledger().phase() == Phase::Merge {
        work.merge_initial()?;
    }
    // Whoever tagged waits for the next round, and for the version that follows on it.
    if work.ledger().phase() != Phase::Expansion || work.ledger().tags_wait() {
        return Ok(None);
    }
    let every = setup.scene.exploration.publish_every_frames.max(1);
    if *behind || due(work, every) {
        let newest = work.graph().commit();
        let soon = work.ledger().is_round_of_tags();
        // Encoding has one thread.
        let workers = round::run_ahead(work, crew);
        let published = publish(work, publisher, (newest, soon)).await;
        workers.join(work, crew)?;
        published?;
        *behind = false;
        run.published(work);
        progress(&run.progress(setup, work, None));
    }
    Ok(reached(work.graph(), setup.options))
}

/// Places of clips by name.
fn clips(scene: &Scene, names: &[String]) -> Result<Vec<u16>, ExploreError> {
    let all = scene.primary.clips();
    let place = |name: &String| {
        let found = all.iter().position(|clip| clip == name).map(|clip| clip as u16);
        found.ok_or_else(|| ExploreError::NoClip(name.clone(), all.join(", ")))
    };
    names.iter().map(place).collect()
}

/// Records what jobs are chosen by from here on, where that has changed.
async fn steer(
    work: &mut Work,
    publisher: &impl Publish,
    policy: Policy,
    clips: &[u16],
) -> Result<(), ExploreError> {
    if work.ledger().phase() != Phase::Expansion {
        return Ok(());
    }
    let steering = work.ledger().steering();
    let after = steering.telemetry();
    // Whatever the policy: errors are reported as players see them.
    let walked = publisher.walked(after).await.unwrap_or_else(|error| {
        tracing::warn!(%error, "what players walked cannot be read; exploring goes on");
        Walked { newest: after, ..Walked::default() }
    });
    if steering.policy() != policy || steering.clips() != clips || walked.newest != after {
        let (clips, telemetry) = (clips.to_vec(), walked.newest);
        let counts = walked.counts.into_iter().collect();
        work.steer(SteerRecord { policy, clips, telemetry, counts })?;
    }
    let known = work.ledger().newest_tag();
    let Tagged { newest, states } = publisher.tagged(known).await.unwrap_or_else(|error| {
        tracing::warn!(%error, "tags cannot be read; exploring goes on");
        Tagged { newest: known, states: Vec::new() }
    });
    if newest != known {
        work.tag(TagRecord { newest, states })?;
    }
    Ok(())
}

/// Whether to end without another round, and without a version.
fn must_end(setup: &Setup<'_>, work: &Work) -> Option<End> {
    if (setup.options.should_stop)() {
        return Some(End::Stopped);
    }
    disk_is_nearly_full(setup, work).then_some(End::Disk)
}

/// Opens the next round. Once in a run that may be of dead ends that were set aside: a program that was
/// mended meanwhile does what it could not.
fn open_round(work: &mut Work, second_chance: &mut bool) -> Result<bool, WorkError> {
    Ok(work.open_round() || std::mem::take(second_chance) && work.reconsider()?)
}

fn disk_is_nearly_full(setup: &Setup<'_>, work: &Work) -> bool {
    let states = u64::from(setup.scene.exploration.round_jobs.max(1)) * JOB_STATES_MAX as u64;
    // A store's chunks of them, with a basis, are smaller than the exact states.
    let needed =
        (states.min(100_000) * work.state_bytes()).saturating_add(setup.options.keep_free_bytes);
    let short = |folder: &Path| free_bytes(folder).is_some_and(|free| free < needed);
    short(setup.work) || setup.folder.is_some_and(short)
}

/// Whether a multiple of `every` frames was passed since the last version.
fn due(work: &Work, every: u64) -> bool {
    let frames_at = |commit: u64| work.graph().moments()[commit as usize].states - 1;
    match work.ledger().published() {
        None => true,
        // Whoever tagged a merge waits for what came of it.
        Some(last) if work.ledger().is_round_of_tags() => last.commit != work.graph().commit(),
        Some(last) => work.graph().simulated_frames() / every > frames_at(last.commit) / every,
    }
}

/// Whether a whole graph has as many frames as were asked for, in the middle of a round.
fn frames_reached_in_round(work: &Work, options: &ExploreOptions) -> bool {
    let graph = work.graph();
    !work.ledger().round().is_done()
        && work.ledger().phase() == Phase::Expansion
        && options.frames.is_some_and(|frames| graph.simulated_frames() >= frames)
}

/// Ends in the middle of a round; what is left of it is done by whoever goes on.
async fn finish_round(
    setup: &Setup<'_>,
    mut work: Work,
    run: &Run,
    (publisher, behind): (&mut impl Publish, bool),
) -> Result<Summary, ExploreError> {
    if behind {
        let newest = work.graph().commit();
        publish(&mut work, publisher, (newest, false)).await?;
    }
    finish(setup, work, run, publisher, End::Frames).await
}

fn reached(graph: &Graph, options: &ExploreOptions) -> Option<End> {
    if options.frames.is_some_and(|frames| graph.simulated_frames() >= frames) {
        return Some(End::Frames);
    }
    let best_m = graph.best_worst_cost_m()?;
    options.error_m.is_some_and(|error_m| best_m <= error_m).then_some(End::Error)
}

async fn publish(
    work: &mut Work,
    publisher: &mut impl Publish,
    (shown, soon): (u64, bool),
) -> Result<(), ExploreError> {
    tracing::info!(soon, states = work.graph().next_id().0, "publishing");
    let number = publisher.publish(&work.view(shown), soon).await?;
    let commit = work.graph().commit();
    Ok(work.published(PublishRecord { number, commit, shown })?)
}

/// Leaves the best prefix, or else the newest graph, as the head.
async fn finish(
    setup: &Setup<'_>,
    mut work: Work,
    run: &Run,
    publisher: &mut impl Publish,
    end: End,
) -> Result<Summary, ExploreError> {
    let newest = work.graph().commit();
    let best = work.graph().best_commit().filter(|_| setup.options.best_prefix_at_end);
    let shown = best.unwrap_or(newest);
    let shows = work.ledger().published().map(|last| last.shown);
    if shows != Some(shown) || publisher.lacks_upsampler() {
        publish(&mut work, publisher, (shown, false)).await?;
    }
    Ok(run.summary(setup, &work, end))
}

#[cfg(test)]
#[path = "explore_tests.rs"]
mod tests;

//! One round of jobs on any number of workers, committed in the order in which it was chosen.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use protocol::{EdgeId, PoseId, StateId};

use super::ahead::{Ahead, Use};
use super::aim::Aims;
use super::class::Classifier;
use super::job::{
    self, Context, Expansion, JOB_STATES_MAX, JobError, Outcome, Rules, TAGGED_STATES_MAX,
};
use super::ledger::{Job, Phase};
use super::plan::Plan;
use super::record::TagRecord;
use super::similar::Similar;
use super::states::StateFile;
use super::work::{Work, WorkError};
use crate::cpu::CpuClock;
use crate::primary::PrimaryGraph;
use crate::simulator::Simulator;

/// How often a running round looks whether it is to stop.
const POLL: Duration = Duration::from_millis(50);
/// How long to wait before a program that is out of order is tried again (ms), time after time.
const PAUSES_MS: [u64; 4] = [250, 500, 1000, 2000];
/// Room for so many frames is asked for before a job is run ahead of its turn: two seconds of cloth.
const AHEAD_FRAMES: usize = 64;
/// How many frames that were simulated before it is tried on.
const TRIALS: u64 = 4;

/// How a round ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Ended {
    /// All its jobs are done.
    Done,
    /// It was asked to stop: jobs in flight were dropped, the others are done.
    Stopped,
    /// People pointed at something: what is not committed waits with the crew.
    Interrupted(TagRecord),
    /// There are as many simulated frames as were asked for: jobs in flight were dropped.
    Frames,
}

/// Why a round could not go on.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RoundError {
    /// The work folder.
    #[error(transparent)]
    Work(#[from] WorkError),
    /// The initial pass needs every edge once, so it cannot do without this one.
    #[error("the initial pass: {0}")]
    Initial(JobError),
    /// The simulator can do nothing at all.
    #[error(
        "the simulator is out of order: {0}. No job was given up for it: mend it, and run the same \
         command again"
    )]
    OutOfOrder(JobError),
    /// A state could not be read.
    #[error("the state file: {0}; mend this and run again")]
    Read(std::io::Error),
}

/// Who simulates, and what is kept from round to round. What it keeps lives in memory alone: where that is
/// lost, the same is simulated once more.
pub struct Crew {
    /// One for each worker; none while they work.
    simulators: Vec<Box<dyn Simulator>>,
    paused: Paused,
    ahead: Arc<Ahead>,
}

impl Crew {
    /// Workers with a simulator each, at least one.
    pub fn new(simulators: Vec<Box<dyn Simulator>>) -> Self {
        assert!(!simulators.is_empty(), "somebody has to simulate");
        Self { simulators, paused: Paused::default(), ahead: Arc::default() }
    }

    /// The first worker's simulator.
    pub fn first(&mut self) -> &mut dyn Simulator {
        self.simulators[0].as_mut()
    }

    /// What all programs took that simulate for this process (s).
    pub fn program_cpu_s(&self) -> f64 {
        self.simulators.iter().map(|simulator| simulator.program_cpu_s()).sum()
    }
}

/// What was simulated of a round that was interrupted.
#[derive(Default)]
struct Paused {
    round: u64,
    ended: BTreeMap<StateId, Result<Outcome, JobError>>,
    under_way: BTreeMap<StateId, Expansion>,
}

/// Runs what is left of the open round. `tags` is asked again and again once the initial pass is over,
/// unless the round is one of tags itself: what people pointed at interrupts it between two frames of its
/// jobs. An expansion round ends after the job with which there are `frames` simulated frames. `each` is called after every job that was committed, or given up (with the reason).
///
/// # Errors
/// The work folder cannot be read or written, or a frame of the initial pass cannot be simulated.
pub async fn run(
    work: &mut Work,
    crew: &mut Crew,
    (should_stop, tags): (&dyn Fn() -> bool, impl AsyncFnMut() -> Option<TagRecord>),
    frames: Option<u64>,
    each: &mut dyn FnMut(&Work, Option<&JobError>),
) -> Result<Ended, RoundError> {
    let round = work.ledger().round().number;
    let Paused { mut ended, under_way, .. } = if crew.paused.round == round {
        std::mem::take(&mut crew.paused)
    } else {
        Paused::default()
    };
    let starts = starts(work);
    let mut early = Early::new();
    let mut left = vec![None; starts.len()];
    for (place, (start, left)) in starts.iter().zip(&mut left).enumerate() {
        match start.and_then(|(_, state, _)| ended.remove(&state)) {
            Some(outcome) => _ = early.insert(place, outcome),
            None => *left = *start,
        }
    }
    let shared = Arc::new(Shared::new(work, crew, left, under_way));
    let workers = Workers::start(&shared, &mut crew.simulators);
    let ended = collect(work, &workers, &mut early, (should_stop, tags), frames, each).await;
    // Also on an error: workers still running are not waited for longer than a frame.
    let rest = workers.join(&mut crew.simulators);
    // Also of what is dropped: it was simulated.
    let dropped: f64 = rest.iter().map(|done| done.cpu_s).sum();
    let counted = work.add_cpu_s(dropped + shared.ahead_cpu_s());
    if ended.is_ok() {
        counted?;
    }
    if matches!(ended, Ok(Ended::Interrupted(_))) {
        // What no worker had taken up again, and what they leave now.
        crew.paused = Paused { round, under_way: shared.under_way(), ..Paused::default() };
        crew.paused.keep(&starts, early, rest);
    }
    ended
}

/// Workers that run ahead of the next round while something else is done.
pub struct RunningAhead(Workers);

/// Lets workers run ahead until [`RunningAhead::join`], if there are several.
pub fn run_ahead(work: &Work, crew: &mut Crew) -> RunningAhead {
    let shared = Arc::new(Shared::new(work, crew, Vec::new(), BTreeMap::new()));
    RunningAhead(Workers::start(&shared, &mut crew.simulators))
}

impl RunningAhead {
    /// Ends it, within a frame.
    ///
    /// # Errors
    /// The work folder cannot be written.
    pub fn join(self, work: &mut Work, crew: &mut Crew) -> Result<(), WorkError> {
        let shared = Arc::clone(&self.0.shared);
        self.0.join(&mut crew.simulators);
        work.add_cpu_s(shared.ahead_cpu_s())
    }
}

impl Paused {
    fn keep(&mut self, starts: &[Option<Start>], mut early: Early, rest: Vec<Done>) {
        let state = |place: usize| starts[place].map(|(_, state, _)| state);
        for Done { place, outcome, expansion, .. } in rest {
            match expansion {
                Some(expansion) => self.under_way.extend(state(place).zip(Some(expansion))),
                None => _ = early.insert(place, outcome),
            }
        }
        early.retain(|_, outcome| !matches!(outcome, Err(JobError::Abandoned)));
        self.ended.extend(early.into_iter().filter_map(|(place, o)| state(place).zip(Some(o))));
    }
}

/// A job with the state and pose it starts from.
type Start = (Job, StateId, PoseId);
/// Outcomes whose turn has not come, by their place in the round.
type Early = BTreeMap<usize, Result<Outcome, JobError>>;

/// What a worker says of a job.
struct Done {
    /// Its place in the round.
    place: usize,
    outcome: Result<Outcome, JobError>,
    /// An expansion that was left between two frames.
    expansion: Option<Expansion>,
    cpu_s: f64,
}

/// What the workers of a round share.
struct Shared {
    primary: Arc<PrimaryGraph>,
    plan: Arc<Plan>,
    states: Arc<StateFile>,
    similar: Arc<Similar>,
    classifier: Arc<Classifier>,
    known: Vec<Arc<Vec<StateId>>>,
    rules: Rules,
    aims: Arc<Aims>,
    states_max: usize,
    retries: bool,
    /// Frames that were simulated before.
    trials: Vec<(StateId, EdgeId, StateId)>,
    starts: Vec<Option<Start>>,
    next: AtomicUsize,
    abandon: AtomicBool,
    under_way: Mutex<BTreeMap<StateId, Expansion>>,
    ahead: Arc<Ahead>,
    likely: Likely,
}

/// What a worker does when there are no jobs left.
#[derive(Default)]
struct Likely {
    starts: Vec<(StateId, PoseId)>,
    aims: Aims,
    next: AtomicUsize,
    cpu_s: Mutex<f64>,
}

impl Shared {
    fn new(
        work: &Work,
        crew: &Crew,
        starts: Vec<Option<Start>>,
        under_way: BTreeMap<StateId, Expansion>,
    ) -> Self {
        let ledger = work.ledger();
        let tagged = ledger.is_round_of_tags();
        let retries = crew.simulators.iter().any(|simulator| simulator.may_recover());
        // One worker never waits, and a program's failures are for those who asked.
        let likely = if crew.simulators.len() > 1 && !retries {
            ledger.likely()
        } else {
            Default::default()
        };
        crew.ahead.make_room(work.states().state_bytes() as usize);
        let round = ledger.round();
        let snapshot = if round.is_done() { ledger.graph().commit() } else { round.snapshot };
        Self {
            primary: Arc::clone(work.graph().primary()),
            plan: Arc::clone(ledger.plan()),
            states: Arc::clone(work.states()),
            similar: Arc::clone(work.similar()),
            classifier: Arc::clone(work.classifier()),
            known: ledger.interior_at(snapshot),
            rules: *work.rules(),
            aims: Arc::clone(&ledger.round().aims),
            states_max: if tagged { TAGGED_STATES_MAX } else { JOB_STATES_MAX },
            retries,
            trials: work.graph().some_frames(TRIALS),
            starts,
            next: AtomicUsize::new(ledger.round().done),
            abandon: AtomicBool::new(false),
            under_way: Mutex::new(under_way),
            ahead: Arc::clone(&crew.ahead),
            likely: Likely { starts: likely.0, aims: likely.1, ..Likely::default() },
        }
    }

    fn context(&self) -> Context<'_> {
        Context {
            primary: &self.primary,
            plan: &self.plan,
            states: &self.states,
            similar: &self.similar,
            classifier: &self.classifier,
            known: &self.known,
            rules: &self.rules,
            aims: &self.aims,
            states_max: self.states_max,
            abandon: &self.abandon,
            ahead: Use::Take(&self.ahead),
        }
    }

    /// Simulates what the next round is likely to ask for, until jobs are to be left or there is no room.
    fn run_ahead(&self, simulator: &mut dyn Simulator) {
        let clock = CpuClock::start();
        let (aims, ahead) = (&self.likely.aims, Use::Keep(&self.ahead));
        let context = Context { aims, ahead, ..self.context() };
        let state_bytes = self.states.state_bytes() as usize;
        let next = || self.likely.next.fetch_add(1, Ordering::Relaxed);
        while let Some(&(state, pose)) = self.likely.starts.get(next()) {
            let room = self.ahead.has_room(AHEAD_FRAMES, state_bytes);
            let Ok(mut expansion) = Expansion::new(&context, state, pose) else { break };
            // Whatever fails is found again by the job itself.
            if !room || expansion.run(&context, simulator).is_err() {
                break;
            }
        }
        *self.likely.cpu_s.lock().unwrap_or_else(PoisonError::into_inner) += clock.elapsed_s();
    }

    /// What running ahead took, since this was asked last (s).
    fn ahead_cpu_s(&self) -> f64 {
        std::mem::take(&mut *self.likely.cpu_s.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Takes the expansions that wait to be gone on with.
    fn under_way(&self) -> BTreeMap<StateId, Expansion> {
        std::mem::take(&mut *self.under_way.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// One job, from where it stands to its end or until it is to be left.
    fn job(&self, simulator: &mut dyn Simulator, place: usize, start: Start) -> Done {
        let (clock, program_cpu_s) = (CpuClock::start(), simulator.program_cpu_s());
        let context = self.context();
        let (outcome, expansion) = match start {
            (Job::Initial(planned), state, _) => {
                let planned = &self.plan.jobs()[planned];
                let run = |simulator: &mut dyn Simulator| {
                    job::initial(&context, simulator, planned, state)
                };
                (self.again(simulator, run), None)
            }
            (Job::Expand(_), state, pose) => self.expand(&context, simulator, (state, pose)),
        };
        let cpu_s = clock.elapsed_s() + simulator.program_cpu_s() - program_cpu_s;
        Done { place, outcome, expansion, cpu_s }
    }

    fn expand(
        &self,
        context: &Context<'_>,
        simulator: &mut dyn Simulator,
        (state, pose): (StateId, PoseId),
    ) -> (Result<Outcome, JobError>, Option<Expansion>) {
        let held = self.under_way.lock().unwrap_or_else(PoisonError::into_inner).remove(&state);
        let expansion = held.map_or_else(|| Expansion::new(context, state, pose), Ok);
        let mut expansion = match expansion {
            Ok(expansion) => expansion,
            Err(error) => return (Err(error.into()), None),
        };
        let outcome = self.again(simulator, |simulator| expansion.run(context, simulator));
        let left = matches!(outcome, Err(JobError::Abandoned));
        (outcome, left.then_some(expansion))
    }

    /// Runs a job, once more where the simulator may have recovered, and again after each of a few
    /// pauses where it is out of order.
    fn again(
        &self,
        simulator: &mut dyn Simulator,
        mut run: impl FnMut(&mut dyn Simulator) -> Result<Outcome, JobError>,
    ) -> Result<Outcome, JobError> {
        match run(simulator) {
            Err(JobError::Simulate { .. }) if self.retries => {}
            outcome => return outcome,
        }
        let mut pauses = PAUSES_MS.iter().copied().map(Duration::from_millis);
        loop {
            match run(simulator) {
                Err(JobError::Simulate { source, .. }) if simulator.is_out_of_order() => {
                    if !self.fails_at_all(simulator) {
                        // It is this job's step, unless the program was mended just now.
                        return run(simulator);
                    }
                    let pause = pauses.next().ok_or(JobError::OutOfOrder(source))?;
                    self.wait(pause)?;
                }
                outcome => return outcome,
            }
        }
    }

    /// Whether nothing can be simulated. A program may end at one step and be sound at others, so it
    /// is tried on a few that it did before.
    fn fails_at_all(&self, simulator: &mut dyn Simulator) -> bool {
        let mut fails = |&(state, edge, _): &(StateId, EdgeId, StateId)| {
            let Ok(state) = self.states.read(state) else { return false };
            simulator.step(&state, edge).is_err() && simulator.is_out_of_order()
        };
        self.trials.iter().all(&mut fails)
    }

    fn wait(&self, pause: Duration) -> Result<(), JobError> {
        let clock = Instant::now();
        while clock.elapsed() < pause {
            if self.abandon.load(Ordering::Relaxed) {
                return Err(JobError::Abandoned);
            }
            std::thread::sleep(POLL.min(pause));
        }
        Ok(())
    }
}

/// The jobs of the round that are not done, by their place (`None`: done before).
fn starts(work: &Work) -> Vec<Option<Start>> {
    let ledger = work.ledger();
    let round = ledger.round();
    let start = |(place, job): (usize, &Job)| match *job {
        _ if place < round.done => None,
        Job::Expand(state) => Some((*job, state, ledger.graph().state(state).pose)),
        Job::Initial(planned) => {
            let pose = ledger.plan().jobs()[planned].start;
            let state = ledger.placed(pose).expect("a job is chosen once its start is known");
            Some((*job, state, pose))
        }
    };
    round.jobs.iter().enumerate().map(start).collect()
}

/// The threads of a round. Dropped, they end within a frame.
struct Workers {
    shared: Arc<Shared>,
    receiver: mpsc::Receiver<Done>,
    threads: Vec<JoinHandle<Box<dyn Simulator>>>,
}

impl Workers {
    fn start(shared: &Arc<Shared>, simulators: &mut Vec<Box<dyn Simulator>>) -> Self {
        let (sender, receiver) = mpsc::channel();
        let thread = |mut simulator: Box<dyn Simulator>| {
            let (shared, sender) = (Arc::clone(shared), sender.clone());
            std::thread::spawn(move || {
                worker(&shared, simulator.as_mut(), &sender);
                simulator
            })
        };
        let threads = simulators.drain(..).map(thread).collect();
        Self { shared: Arc::clone(shared), receiver, threads }
    }

    /// Has jobs in flight left, and says what the workers had not told yet.
    fn join(mut self, simulators: &mut Vec<Box<dyn Simulator>>) -> Vec<Done> {
        self.shared.abandon.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            match thread.join() {
                Ok(simulator) => simulators.push(simulator),
                Err(panic) => std::panic::resume_unwind(panic),
            }
        }
        self.receiver.try_iter().collect()
    }
}

impl Drop for Workers {
    fn drop(&mut self) {
        self.shared.abandon.store(true, Ordering::Relaxed);
    }
}

fn worker(shared: &Shared, simulator: &mut dyn Simulator, sender: &mpsc::Sender<Done>) {
    while !shared.abandon.load(Ordering::Relaxed) {
        let place = shared.next.fetch_add(1, Ordering::Relaxed);
        let Some(start) = shared.starts.get(place) else {
            return shared.run_ahead(simulator);
        };
        let Some(start) = *start else { continue };
        if sender.send(shared.job(simulator, place, start)).is_err() {
            return;
        }
    }
}

/// Commits outcomes in order as they come.
async fn collect(
    work: &mut Work,
    workers: &Workers,
    early: &mut Early,
    (should_stop, mut tags): (&dyn Fn() -> bool, impl AsyncFnMut() -> Option<TagRecord>),
    frames: Option<u64>,
    each: &mut dyn FnMut(&Work, Option<&JobError>),
) -> Result<Ended, RoundError> {
    let ledger = work.ledger();
    let may_wait = ledger.phase() == Phase::Expansion && !ledger.is_round_of_tags();
    loop {
        while let Some(outcome) = early.remove(&work.ledger().round().done) {
            match outcome {
                Ok(outcome) => {
                    work.commit(&outcome)?;
                    each(work, None);
                    if work.ledger().round().is_done() || enough(work, frames) {
                        break;
                    }
                }
                Err(error) => match give_up(work, error)? {
                    Some(error) => each(work, Some(&error)),
                    None => return Ok(Ended::Stopped),
                },
            }
        }
        if work.ledger().round().is_done() {
            return Ok(Ended::Done);
        }
        if enough(work, frames) {
            return Ok(Ended::Frames);
        }
        if may_wait && let Some(tags) = tags().await {
            return Ok(Ended::Interrupted(tags));
        }
        match workers.receiver.recv_timeout(POLL) {
            Ok(Done { place, outcome, cpu_s, .. }) => {
                early.insert(place, outcome);
                work.add_cpu_s(cpu_s)?;
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return Ok(Ended::Stopped),
        }
        if should_stop() {
            workers.shared.abandon.store(true, Ordering::Relaxed);
        }
    }
}

/// Whether there are as many frames as were asked for, in a whole graph.
fn enough(work: &Work, frames: Option<u64>) -> bool {
    let reached = frames.is_some_and(|frames| work.graph().simulated_frames() >= frames);
    reached && work.ledger().phase() == Phase::Expansion
}

/// Records a job that failed; `None` where it was only dropped.
fn give_up(work: &mut Work, error: JobError) -> Result<Option<JobError>, RoundError> {
    match error {
        JobError::Abandoned => Ok(None),
        JobError::Io(error) => Err(RoundError::Read(error)),
        error @ JobError::OutOfOrder(_) => Err(RoundError::OutOfOrder(error)),
        error if work.ledger().phase() == Phase::Initial => Err(RoundError::Initial(error)),
        error => {
            work.fail()?;
            Ok(Some(error))
        }
    }
}

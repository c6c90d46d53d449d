//! One round of jobs on any number of workers, committed in the order in which it was chosen.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::Duration;

use super::job::{self, Context, JobError, Outcome};
use super::ledger::{Job, Phase};
use super::work::{Work, WorkError};
use crate::cpu::CpuClock;
use crate::simulator::Simulator;

/// How often a running round looks whether it is to stop.
const POLL: Duration = Duration::from_millis(50);

/// How a round ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    /// All its jobs are done.
    Done,
    /// It was asked to stop: jobs in flight were dropped, the others are done.
    Stopped,
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
    /// A state could not be read.
    #[error("the state file: {0}; mend this and run again")]
    Read(std::io::Error),
}

/// Runs what is left of the open round. `each` is called after every job that was committed, or
/// given up (with the reason).
///
/// # Errors
/// The work folder cannot be read or written, or a frame of the initial pass cannot be simulated.
pub fn run(
    work: &mut Work,
    simulators: &mut [Box<dyn Simulator>],
    should_stop: &dyn Fn() -> bool,
    each: &mut dyn FnMut(&Work, Option<&JobError>),
) -> Result<Ended, RoundError> {
    let round = work.ledger().round().clone();
    let states = Arc::clone(work.states());
    let rules = *work.rules();
    let (similar, classifier) = (Arc::clone(work.similar()), Arc::clone(work.classifier()));
    let plan = Arc::clone(work.ledger().plan());
    let primary = Arc::clone(work.graph().primary());
    let known = work.ledger().interior_at(round.snapshot);
    let abandon = AtomicBool::new(false);
    let context = Context {
        primary: &primary,
        plan: &plan,
        states: &states,
        similar: &similar,
        classifier: &classifier,
        known: &known,
        rules: &rules,
        abandon: &abandon,
        retries: simulators.iter().any(|simulator| simulator.may_recover()),
    };
    let starts = starts(work);
    let next = AtomicUsize::new(round.done);
    std::thread::scope(|scope| {
        let (sender, receiver) = mpsc::channel();
        for simulator in simulators.iter_mut() {
            let sender = sender.clone();
            let (next, starts) = (&next, &starts);
            scope.spawn(move || worker(&context, simulator.as_mut(), (next, starts), &sender));
        }
        drop(sender);
        let ended = collect(work, &receiver, (&abandon, should_stop), each);
        // Also on an error: workers still running are not waited for longer than a frame.
        abandon.store(true, Ordering::Relaxed);
        ended
    })
}

/// A job with the state and pose it starts from.
type Start = (Job, protocol::StateId, protocol::PoseId);
/// A job's place in the round, what came of it, and its CPU seconds.
type Done = (usize, Result<Outcome, JobError>, f64);

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

fn worker(
    context: &Context<'_>,
    simulator: &mut dyn Simulator,
    (next, starts): (&AtomicUsize, &[Option<Start>]),
    sender: &mpsc::Sender<Done>,
) {
    while !context.abandon.load(Ordering::Relaxed) {
        let place = next.fetch_add(1, Ordering::Relaxed);
        let Some(Some((job, state, pose))) = starts.get(place) else { return };
        let clock = CpuClock::start();
        let mut run = || match job {
            Job::Initial(planned) => {
                job::initial(context, simulator, &context.plan.jobs()[*planned], *state)
            }
            Job::Expand(_) => job::expand(context, simulator, *state, *pose),
        };
        let mut outcome = run();
        if matches!(outcome, Err(JobError::Simulate { .. })) && context.retries {
            outcome = run();
        }
        if sender.send((place, outcome, clock.elapsed_s())).is_err() {
            return;
        }
    }
}

/// Commits outcomes in order as they come.
fn collect(
    work: &mut Work,
    receiver: &mpsc::Receiver<Done>,
    (abandon, should_stop): (&AtomicBool, &dyn Fn() -> bool),
    each: &mut dyn FnMut(&Work, Option<&JobError>),
) -> Result<Ended, RoundError> {
    let mut early = BTreeMap::new();
    while !work.ledger().round().is_done() {
        match receiver.recv_timeout(POLL) {
            Ok((place, outcome, cpu_s)) => {
                early.insert(place, outcome);
                work.add_cpu_s(cpu_s)?;
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return Ok(Ended::Stopped),
        }
        while let Some(outcome) = early.remove(&work.ledger().round().done) {
            match outcome {
                Ok(outcome) => {
                    work.commit(&outcome)?;
                    each(work, None);
                }
                Err(error) => match give_up(work, error)? {
                    Some(error) => each(work, Some(&error)),
                    None => return Ok(Ended::Stopped),
                },
            }
        }
        if should_stop() {
            abandon.store(true, Ordering::Relaxed);
        }
    }
    Ok(Ended::Done)
}

/// Records a job that failed; `None` where it was only dropped.
fn give_up(work: &mut Work, error: JobError) -> Result<Option<JobError>, RoundError> {
    match error {
        JobError::Abandoned => Ok(None),
        JobError::Io(error) => Err(RoundError::Read(error)),
        error if work.ledger().phase() == Phase::Initial => Err(RoundError::Initial(error)),
        error => {
            work.fail()?;
            Ok(Some(error))
        }
    }
}

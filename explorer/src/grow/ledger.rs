//! The graph and all bookkeeping of an exploration, as a pure function of the records.
//!
//! The same [`Ledger::apply`] serves a running exploration and the replay of its journal, so a
//! resumed run knows exactly what an uninterrupted one knows, half-finished rounds included.

use std::cmp::Reverse;
use std::collections::BTreeSet;
use std::sync::Arc;

use protocol::{PoseId, StateId};

use super::aim::Aims;
use super::class::Penalties;
use super::graph::{Graph, GraphError, Kind};
use super::plan::Plan;
use super::policy::Steering;
use super::record::{FailedRecord, JobRecord, MergeRecord, PublishRecord, Record, TagRecord};
use super::view::KindAt;
use crate::primary::PrimaryGraph;
use crate::scene::Scene;
use crate::simulator::FrameQuality;

/// A job of a round.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Job {
    /// A job of the initial pass, by its place in the plan.
    Initial(usize),
    /// Undo the merge of this dead end and simulate on from it.
    Expand(StateId),
}

/// Jobs chosen from one snapshot of the graph.
#[derive(Debug, Clone, PartialEq)]
pub struct Round {
    /// Counted from 0.
    pub number: u64,
    /// The commit it was chosen at.
    pub snapshot: u64,
    /// In the order in which they are committed.
    pub jobs: Vec<Job>,
    /// How far expansions go.
    pub aims: Arc<Aims>,
    /// How many of them were committed or given up.
    pub done: usize,
}

impl Round {
    /// Without a job.
    fn empty(number: u64, snapshot: u64) -> Self {
        Self { number, snapshot, jobs: Vec::new(), aims: Arc::default(), done: 0 }
    }

    /// Whether all its jobs are done.
    pub fn is_done(&self) -> bool {
        self.done == self.jobs.len()
    }
}

/// What comes next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// State 0 is to be draped.
    Drape,
    /// Edges of the primary graph are to be simulated for the first time.
    Initial,
    /// The initial dead ends are to be merged.
    Merge,
    /// Dead ends are to be expanded.
    Expansion,
}

/// A record that does not follow from those before it.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum LedgerError {
    /// The graph refuses it.
    #[error(transparent)]
    Graph(#[from] GraphError),
    /// It is out of turn.
    #[error("a record of {0} is out of turn")]
    OutOfTurn(&'static str),
}

/// See the module.
#[derive(Debug, Clone, PartialEq)]
pub struct Ledger {
    graph: Graph,
    plan: Arc<Plan>,
    round_jobs: usize,
    draped: bool,
    /// The state of each pose that the initial pass keeps interior.
    placed: Vec<Option<StateId>>,
    planned_done: Vec<bool>,
    /// Rounds that were opened.
    rounds: u64,
    round: Round,
    /// A round that tags interrupted; what is left of it comes after theirs.
    parked: Option<Round>,
    set_aside: BTreeSet<StateId>,
    failed_jobs: u64,
    quality: FrameQuality,
    published: Option<PublishRecord>,
    steering: Steering,
    tags: Tags,
}

/// Dead ends that people pointed at.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
struct Tags {
    /// The newest tag that was read.
    newest: u64,
    /// Those whose turn has not come yet.
    waiting: Vec<StateId>,
    /// Whether the open round, or the last that was, is theirs.
    have_round: bool,
}

impl Tags {
    fn add(&mut self, tagged: &TagRecord) {
        self.newest = tagged.newest;
        self.waiting.extend(&tagged.states);
    }
}

impl Ledger {
    /// Of a folder in which nothing was recorded yet.
    pub fn new(scene: &Scene) -> Self {
        let primary: &Arc<PrimaryGraph> = &scene.primary;
        let plan = Plan::new(primary, scene.start);
        let mut placed = vec![None; primary.poses().len()];
        placed[scene.start.index()] = Some(StateId(0));
        Self {
            graph: Graph::with_penalties(
                Arc::clone(primary),
                scene.start,
                Penalties::new(&scene.metric.classes),
            ),
            planned_done: vec![false; plan.jobs().len()],
            plan: Arc::new(plan),
            round_jobs: scene.exploration.round_jobs.max(1) as usize,
            draped: false,
            placed,
            rounds: 0,
            round: Round::empty(0, 0),
            parked: None,
            set_aside: BTreeSet::new(),
            failed_jobs: 0,
            quality: FrameQuality::default(),
            published: None,
            steering: Steering::new(primary),
            tags: Tags::default(),
        }
    }

    /// The secondary graph.
    pub fn graph(&self) -> &Graph {
        &self.graph
    }

    /// The plan of the initial pass.
    pub fn plan(&self) -> &Arc<Plan> {
        &self.plan
    }

    /// The round that is open, or the last that was.
    pub fn round(&self) -> &Round {
        &self.round
    }

    /// Measures of all frames so far, the drape's included.
    pub fn quality(&self) -> &FrameQuality {
        &self.quality
    }

    /// Dead ends whose job was given up: they stay merged, and are not chosen again before they are
    /// reconsidered.
    pub fn set_aside(&self) -> &BTreeSet<StateId> {
        &self.set_aside
    }

    /// Jobs that were given up; one dead end may have cost several.
    pub fn failed_jobs(&self) -> u64 {
        self.failed_jobs
    }

    /// What jobs are chosen by.
    pub fn steering(&self) -> &Steering {
        &self.steering
    }

    /// The newest tag that was read; 0 for none.
    pub fn newest_tag(&self) -> u64 {
        self.tags.newest
    }

    /// Whether the open round, or the last that was, simulates what people pointed at: they are
    /// shown what came of it at once.
    pub fn is_round_of_tags(&self) -> bool {
        self.tags.have_round
    }

    /// Whether there are tags whose turn has not come yet.
    pub fn tags_wait(&self) -> bool {
        !self.tags.waiting.is_empty()
    }

    /// The last version known to be in the store.
    pub fn published(&self) -> Option<PublishRecord> {
        self.published
    }

    /// What comes next.
    pub fn phase(&self) -> Phase {
        if !self.draped {
            Phase::Drape
        } else if self.planned_done.contains(&false) {
            Phase::Initial
        } else if self.graph.initialised().is_none() {
            Phase::Merge
        } else {
            Phase::Expansion
        }
    }

    /// The interior state of a pose of the initial pass, once simulated.
    pub fn placed(&self, pose: PoseId) -> Option<StateId> {
        self.placed[pose.index()]
    }

    /// Interior states by pose, as they were at a commit; the lists are shared where nothing was added since.
    pub fn interior_at(&self, commit: u64) -> Vec<Arc<Vec<StateId>>> {
        let at = |pose: u32| {
            let (all, then) = (self.graph.interior(PoseId(pose)), PoseId(pose));
            match self.graph.interior_at(then, commit) {
                part if part.len() == all.len() => Arc::clone(all),
                part => Arc::new(part.to_vec()),
            }
        };
        (0..self.placed.len() as u32).map(at).collect()
    }

    /// Chooses the jobs of the next round; false where there is nothing to do.
    pub fn open_round(&mut self) -> bool {
        assert!(self.round.is_done(), "the round before is not done");
        let mut aims = Arc::default();
        let jobs = match self.phase() {
            Phase::Initial => self.ready(),
            Phase::Expansion => {
                let tagged = self.tagged();
                if tagged.is_empty() && self.unpark() {
                    return true;
                }
                if tagged.is_empty() {
                    let chosen = self.expansions();
                    aims = Arc::new(self.steering.aims(&self.graph, &chosen));
                    chosen.into_iter().map(Job::Expand).collect()
                } else {
                    tagged
                }
            }
            Phase::Drape | Phase::Merge => Vec::new(),
        };
        if jobs.is_empty() {
            return false;
        }
        let number = self.rounds;
        self.rounds += 1;
        self.round = Round { jobs, aims, ..Round::empty(number, self.graph.commit()) };
        true
    }

    /// Takes up what is left of a round that tags interrupted; false where nothing is.
    fn unpark(&mut self) -> bool {
        let Some(mut round) = self.parked.take() else { return false };
        let mut left = round.jobs.split_off(round.done);
        left.retain(|job| match job {
            Job::Initial(_) => true,
            Job::Expand(state) => {
                is_dead_end(&self.graph, *state) && !self.set_aside.contains(state)
            }
        });
        round.jobs.append(&mut left);
        let goes_on = !round.is_done();
        if goes_on {
            self.round = round;
        }
        goes_on
    }

    /// The open round waits, and none is open.
    fn park(&mut self) {
        let Round { number, snapshot, .. } = self.round;
        let none = Round::empty(number, snapshot);
        self.parked = Some(std::mem::replace(&mut self.round, none));
    }

    /// Applies one record.
    ///
    /// # Errors
    /// The record does not follow from those before it; the ledger is of no use any more.
    pub fn apply(&mut self, record: &Record) -> Result<(), LedgerError> {
        match record {
            Record::Header(_) => Err(LedgerError::OutOfTurn("the header")),
            Record::Compacted(_) => Err(LedgerError::OutOfTurn("packed records")),
            Record::Drape(drape) if !self.draped => {
                self.draped = true;
                self.graph.classify_drape(drape.class);
                self.quality.add(&drape.quality);
                Ok(())
            }
            Record::Drape(_) => Err(LedgerError::OutOfTurn("the drape")),
            Record::Job(job) => self.apply_job(job),
            Record::Failed(failed) => self.apply_failure(failed),
            Record::Initialised(merges) => self.apply_initial_merges(merges),
            Record::Published(version) => {
                self.published = Some(*version);
                Ok(())
            }
            Record::Steer(_) if !self.round.is_done() => Err(LedgerError::OutOfTurn("a policy")),
            Record::Steer(steer) => {
                self.steering.steer(steer);
                Ok(())
            }
            Record::Tagged(_) if !self.round.is_done() => Err(LedgerError::OutOfTurn("a tag")),
            Record::Tagged(tagged) => {
                self.tags.add(tagged);
                Ok(())
            }
            Record::Interrupted(tagged) => self.apply_interruption(tagged),
            Record::Reconsidered if !self.round.is_done() => {
                Err(LedgerError::OutOfTurn("another chance"))
            }
            Record::Reconsidered => {
                self.set_aside.clear();
                Ok(())
            }
        }
    }

    /// Initial jobs whose start is known, the most urgent first.
    fn ready(&self) -> Vec<Job> {
        let jobs = self.plan.jobs();
        let ready = |job: &usize| {
            !self.planned_done[*job] && self.placed[jobs[*job].start.index()].is_some()
        };
        let mut ready: Vec<usize> = (0..jobs.len()).filter(ready).collect();
        ready.sort_by_key(|job| (Reverse(jobs[*job].height), *job));
        ready.into_iter().take(self.round_jobs).map(Job::Initial).collect()
    }

    /// Dead ends to be expanded because people pointed at them.
    fn tagged(&mut self) -> Vec<Job> {
        let set_aside = &self.set_aside;
        let free = |state: StateId| !set_aside.contains(&state);
        let tagged = tagged(&self.graph, &mut self.tags.waiting, self.round_jobs, &free);
        self.tags.have_round = !tagged.is_empty();
        tagged.into_iter().map(Job::Expand).collect()
    }

    /// Dead ends to be expanded, by the policy.
    fn expansions(&mut self) -> Vec<StateId> {
        let set_aside = &self.set_aside;
        let free = |state: StateId| !set_aside.contains(&state);
        self.steering.choose(&self.graph, self.round_jobs, &free)
    }

    /// Dead ends that the next round is likely to take, as far as can be told now, and how far they go.
    pub fn likely(&self) -> (Vec<(StateId, PoseId)>, Aims) {
        if self.phase() != Phase::Expansion {
            return Default::default();
        }
        let taken = |state: StateId| self.round.jobs.contains(&Job::Expand(state));
        let free = |state: StateId| !self.set_aside.contains(&state) && !taken(state);
        let states = self.steering.rank(&self.graph, self.round_jobs, &free);
        let aims = self.steering.aims(&self.graph, &states);
        (states.into_iter().map(|s| (s, self.graph.state(s).pose)).collect(), aims)
    }

    fn apply_interruption(&mut self, tagged: &TagRecord) -> Result<(), LedgerError> {
        // The round may have been interrupted before the first record of it.
        if self.round.is_done() {
            self.open_round();
        }
        let expands = self.phase() == Phase::Expansion && !self.tags.have_round;
        if !expands || self.round.is_done() {
            return Err(LedgerError::OutOfTurn("an interruption"));
        }
        self.park();
        self.tags.add(tagged);
        Ok(())
    }

    /// The job whose turn it is, if it is the one that was recorded.
    fn turn(&mut self, round: u64, index: u32, start: StateId) -> Result<Job, LedgerError> {
        if self.round.is_done() {
            self.open_round();
        }
        let at_turn = self.round.number == round && self.round.done == index as usize;
        let job = self.round.jobs.get(self.round.done).copied();
        let expected = match job {
            Some(Job::Initial(job)) => self.placed[self.plan.jobs()[job].start.index()],
            Some(Job::Expand(state)) => Some(state),
            None => None,
        };
        match job {
            Some(job) if at_turn && expected == Some(start) => Ok(job),
            _ => Err(LedgerError::OutOfTurn("a job")),
        }
    }

    fn apply_job(&mut self, record: &JobRecord) -> Result<(), LedgerError> {
        match self.turn(record.round, record.index, record.start)? {
            Job::Initial(job) => self.apply_initial(job, record)?,
            Job::Expand(start) => self.apply_expansion(start, record)?,
        }
        self.quality.add(&record.quality);
        self.round.done += 1;
        Ok(())
    }

    fn apply_initial(&mut self, job: usize, record: &JobRecord) -> Result<(), LedgerError> {
        let plan = Arc::clone(&self.plan);
        let planned = &plan.jobs()[job].edges;
        if !planned.iter().eq(record.frames.iter().map(|frame| &frame.edge)) {
            return Err(LedgerError::OutOfTurn("other edges than planned"));
        }
        for frame in &record.frames {
            let state = self.graph.attach_class(frame.parent, frame.edge, frame.class)?;
            if plan.is_tree(frame.edge) {
                self.placed[self.graph.state(state).pose.index()] = Some(state);
            }
        }
        let parents: BTreeSet<StateId> = record.frames.iter().map(|frame| frame.parent).collect();
        for parent in parents {
            let is_open = self.graph.state(parent).kind == Kind::Open;
            if is_open && self.graph.next(parent).is_whole() {
                self.graph.close(parent)?;
            }
        }
        self.graph.end_commit();
        self.planned_done[job] = true;
        Ok(())
    }

    fn apply_expansion(&mut self, start: StateId, job: &JobRecord) -> Result<(), LedgerError> {
        let undone = self.graph.revert(start)?;
        if let Some(future_m) = job.future_m {
            let pose = self.graph.state(start).pose;
            self.steering.learn(&self.graph, pose, undone.error_m, future_m);
        }
        let first = self.graph.next_id().0;
        for frame in &job.frames {
            self.graph.attach_class(frame.parent, frame.edge, frame.class)?;
        }
        let new = || job.frames.iter().zip(first..).map(|(frame, id)| (frame, StateId(id)));
        self.graph.close(start)?;
        for (_, state) in new().filter(|(frame, _)| frame.merge.is_none()) {
            self.graph.close(state)?;
        }
        for (frame, state) in new() {
            if let Some((target, error_m)) = frame.merge {
                self.graph.merge(state, target, error_m)?;
            }
        }
        for merge in &job.remerges {
            self.graph.remerge(merge.state, merge.target, merge.error_m)?;
        }
        self.graph.check_total()?;
        self.graph.end_commit();
        Ok(())
    }

    fn apply_failure(&mut self, failed: &FailedRecord) -> Result<(), LedgerError> {
        match self.turn(failed.round, failed.index, failed.start)? {
            Job::Initial(_) => Err(LedgerError::OutOfTurn("a failure of the initial pass")),
            Job::Expand(start) => {
                self.set_aside.insert(start);
                self.failed_jobs += 1;
                self.round.done += 1;
                Ok(())
            }
        }
    }

    fn apply_initial_merges(&mut self, merges: &[MergeRecord]) -> Result<(), LedgerError> {
        if self.phase() != Phase::Merge {
            return Err(LedgerError::OutOfTurn("the end of the initial pass"));
        }
        for merge in merges {
            self.graph.merge(merge.state, merge.target, merge.error_m)?;
        }
        Ok(self.graph.end_initial_pass()?)
    }
}

/// Takes the first tagged states off the list that are dead ends still and free.
fn tagged(
    graph: &Graph,
    waiting: &mut Vec<StateId>,
    most: usize,
    free: &dyn Fn(StateId) -> bool,
) -> Vec<StateId> {
    let mut chosen = Vec::new();
    while let Some(state) = waiting.first().copied().filter(|_| chosen.len() < most) {
        waiting.remove(0);
        if is_dead_end(graph, state) && free(state) && !chosen.contains(&state) {
            chosen.push(state);
        }
    }
    chosen
}

fn is_dead_end(graph: &Graph, state: StateId) -> bool {
    state.0 < graph.next_id().0
        && matches!(graph.kind_at(state, graph.commit()), KindAt::DeadEnd(..))
}

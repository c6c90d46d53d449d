//! The secondary graph: which state follows which on every primary edge.
//!
//! Only the links live here; states themselves lie in [`super::states`]. Operations are pure,
//! check what they are given before they change anything, and are those of Kim et al. 2013,
//! section 3.2: merge a dead end, revert a merge, attach what was simulated.
//!
//! Between two commits the graph is **total** once it was initialised: every state is interior
//! (all its out-edges were simulated) or a dead end that is merged into an interior state of its
//! pose. An interior state's link names the state simulated next even where that one is a dead
//! end, so that undoing a merge moves only the edge that leads to that dead end.

use std::collections::BTreeSet;
use std::sync::Arc;

use protocol::{EdgeId, PoseId, StateId};

use super::class::{Class, Penalties};
use super::nodes::{Next, Nodes, STATES_MAX};
use super::queue::Queue;
use crate::primary::PrimaryGraph;
use crate::view::Run;

/// What a state is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Kind {
    /// Its out-edges are being simulated; only inside a commit or the initial pass.
    Open,
    /// All its out-edges were simulated.
    Interior,
    /// Simulated, merged into another.
    DeadEnd {
        /// An interior state of the same pose.
        target: StateId,
        /// The metric's distance between the two (m).
        error_m: f32,
    },
}

/// A merge as it was made; kept for ever, also when it was undone.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Merge {
    /// The commit that made it.
    pub commit: u64,
    /// Into which interior state.
    pub target: StateId,
    /// At which distance (m).
    pub error_m: f32,
}

/// A node of the secondary graph; what was simulated on from it is told by [`Graph::next`], the merges it went
/// through by [`Graph::merges`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct State {
    /// Its pose.
    pub pose: PoseId,
    /// Its class; 0 where the scene has no rules.
    pub class: Class,
    /// The state it was simulated from, and along which edge; `None` for the drape.
    pub parent: Option<(StateId, EdgeId)>,
    /// What it is now.
    pub kind: Kind,
    /// The commit since which it is interior.
    pub interior_since: Option<u64>,
}

/// The graph after one commit; commits are numbered from 0 (the drape).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moment {
    /// States created so far.
    pub states: u64,
    /// Runs created so far.
    pub runs: usize,
    /// Largest merge error (m).
    pub worst_error_m: f32,
    /// Largest merge error with the penalty for crossing classes (m).
    pub worst_cost_m: f32,
}

/// An operation that does not fit the graph.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum GraphError {
    /// No such state.
    #[error("there is no state {0}")]
    NoState(StateId),
    /// The state is not of the kind that the operation needs.
    #[error("state {0} is {1}, but {2} is needed")]
    WrongKind(StateId, &'static str, &'static str),
    /// The edge does not leave the state's pose, or was simulated before.
    #[error("edge {1} cannot be attached to state {0}")]
    WrongEdge(StateId, EdgeId),
    /// A merge into another pose.
    #[error("state {0} cannot merge into {1}: another pose")]
    WrongPose(StateId, StateId),
    /// A distance that is none.
    #[error("state {0} cannot merge at a distance of {1} m")]
    WrongError(StateId, f32),
    /// A state was left open at the end of a commit.
    #[error("state {0} was left without a successor on some edge")]
    NotTotal(StateId),
    /// There are as many states as there can be.
    #[error("a graph holds at most {STATES_MAX} states; begin another one")]
    Full,
    /// Two tables disagree.
    #[error("state {0}: {1}")]
    Broken(StateId, &'static str),
}

/// The secondary graph.
#[derive(Debug, Clone, PartialEq)]
pub struct Graph {
    primary: Arc<PrimaryGraph>,
    nodes: Nodes,
    runs: Vec<Run>,
    /// Shared with the jobs of a round, who look at them while states are added.
    interior: Vec<Arc<Vec<StateId>>>,
    dead_ends: Vec<BTreeSet<StateId>>,
    queue: Queue,
    /// Merges that carry a penalty, by cost.
    crossing: Queue,
    penalties: Penalties,
    open: BTreeSet<StateId>,
    moments: Vec<Moment>,
    initialised: Option<u64>,
}

impl Graph {
    /// The graph of the drape alone, which is state 0 and commit 0.
    pub fn new(primary: Arc<PrimaryGraph>, start: PoseId) -> Self {
        Self::with_penalties(primary, start, Penalties::default())
    }

    /// As [`Graph::new`], where merges between classes cost something.
    pub fn with_penalties(primary: Arc<PrimaryGraph>, start: PoseId, penalties: Penalties) -> Self {
        let poses = primary.poses().len();
        let mut graph = Self {
            primary,
            nodes: Nodes::default(),
            runs: Vec::new(),
            interior: vec![Arc::default(); poses],
            dead_ends: vec![BTreeSet::new(); poses],
            queue: Queue::default(),
            crossing: Queue::default(),
            penalties,
            open: BTreeSet::new(),
            moments: Vec::new(),
            initialised: None,
        };
        graph.push(start, None, 0);
        graph.end_commit();
        graph
    }

    /// The primary graph below.
    pub fn primary(&self) -> &Arc<PrimaryGraph> {
        &self.primary
    }

    /// All states, by id.
    pub fn states(&self) -> impl ExactSizeIterator<Item = State> {
        (0..self.nodes.count()).map(|id| self.nodes.get(StateId(id as u64)))
    }

    /// A state by id.
    pub fn state(&self, state: StateId) -> State {
        self.nodes.get(state)
    }

    /// What was simulated on each out-edge of a state's pose.
    pub fn next(&self, state: StateId) -> Next<'_> {
        self.nodes.next(&self.primary, state)
    }

    /// Every merge that a state went through, oldest first.
    pub fn merges(&self, state: StateId) -> &[Merge] {
        self.nodes.merges(state)
    }

    /// Id of the next state to be created.
    pub fn next_id(&self) -> StateId {
        StateId(self.nodes.count() as u64)
    }

    /// Runs of consecutive states, in order of creation.
    pub fn runs(&self) -> &[Run] {
        &self.runs
    }

    /// Interior states of a pose, in the order in which they became interior.
    pub fn interior(&self, pose: PoseId) -> &Arc<Vec<StateId>> {
        &self.interior[pose.index()]
    }

    /// Dead ends of a pose, by id.
    pub fn dead_ends(&self, pose: PoseId) -> &BTreeSet<StateId> {
        &self.dead_ends[pose.index()]
    }

    /// All dead ends, largest merge error first.
    pub fn queue(&self) -> &Queue {
        &self.queue
    }

    /// States that are neither interior nor merged: none between commits once initialised.
    pub fn open(&self) -> &BTreeSet<StateId> {
        &self.open
    }

    /// The graph's figures after each commit, by its number.
    pub fn moments(&self) -> &[Moment] {
        &self.moments
    }

    /// Number of the last commit.
    pub fn commit(&self) -> u64 {
        self.moments.len() as u64 - 1
    }

    /// The commit that ended the initial pass, once it did.
    pub fn initialised(&self) -> Option<u64> {
        self.initialised
    }

    /// Frames simulated so far, drape apart: every one of them is a state.
    pub fn simulated_frames(&self) -> u64 {
        self.nodes.count() as u64 - 1
    }

    /// Largest merge error (m).
    pub fn worst_error_m(&self) -> f32 {
        self.queue.worst_m()
    }

    /// Mean merge error (m); 0 without dead ends.
    pub fn mean_error_m(&self) -> f32 {
        let sum: f64 = self.queue.iter().map(|(_, error_m)| f64::from(error_m)).sum();
        // The sum of nothing is -0.
        ((sum + 0.0) / self.queue.len().max(1) as f64) as f32
    }

    /// What a dead end's merge costs (m): its error, and the penalty for crossing classes. 0 for
    /// any other state.
    pub fn cost_m(&self, state: StateId) -> f32 {
        match self.state(state).kind {
            Kind::DeadEnd { target, error_m } => error_m + self.penalty_m(state, target),
            _ => 0.0,
        }
    }

    /// The penalty for merging `state` into `target` (m).
    pub fn penalty_m(&self, state: StateId, target: StateId) -> f32 {
        self.penalties.of(self.state(state).class, self.state(target).class)
    }

    /// Merges that carry a penalty.
    pub fn crossings(&self) -> usize {
        self.crossing.len()
    }

    /// The commit with the lowest worst error, penalties included, since the initial pass, of
    /// equals the last (the paper's Figure 7); `None` before the end of that pass.
    pub fn best_commit(&self) -> Option<u64> {
        let first = self.initialised?;
        let since = &self.moments[first as usize..];
        let key = |m: &Moment| m.worst_cost_m;
        let least = since.iter().map(key).fold(f32::INFINITY, f32::min);
        let last = since.iter().rposition(|m| m.worst_cost_m <= least)?;
        Some(first + last as u64)
    }

    /// The paper's transition table C(c, edge): the interior state that follows `state` on the
    /// `edge`, merges applied. `None` where `state` is not interior or `edge` leaves another pose.
    pub fn follow(&self, state: StateId, edge: EdgeId) -> Option<StateId> {
        if self.known(state).ok()?.kind != Kind::Interior {
            return None;
        }
        let next = self.next(state).get(self.slot(state, edge)?)?;
        match self.state(next).kind {
            Kind::DeadEnd { target, .. } => Some(target),
            _ => Some(next),
        }
    }

    /// Worst merge error of the best prefix (m); `None` before the end of the initial pass.
    pub fn best_worst_error_m(&self) -> Option<f32> {
        Some(self.moments[self.best_commit()? as usize].worst_error_m)
    }

    /// The same with the penalty for crossing classes (m): what the stop rule goes by.
    pub fn best_worst_cost_m(&self) -> Option<f32> {
        Some(self.moments[self.best_commit()? as usize].worst_cost_m)
    }

    /// Adds the state simulated from `parent` along `edge`; it is open.
    ///
    /// # Errors
    /// `parent` is not open, or the edge is not one of its pose or was simulated before.
    pub fn attach(&mut self, parent: StateId, edge: EdgeId) -> Result<StateId, GraphError> {
        self.attach_class(parent, edge, 0)
    }

    /// As [`Graph::attach`], of a state of this class.
    ///
    /// # Errors
    /// As for [`Graph::attach`].
    pub fn attach_class(
        &mut self,
        parent: StateId,
        edge: EdgeId,
        class: Class,
    ) -> Result<StateId, GraphError> {
        let slot = match self.known(parent)?.kind {
            Kind::Open => self.slot(parent, edge),
            other => return Err(GraphError::WrongKind(parent, other.name(), "an open state")),
        };
        let slot = slot.filter(|slot| self.next(parent).get(*slot).is_none());
        let slot = slot.ok_or(GraphError::WrongEdge(parent, edge))?;
        if self.next_id().0 >= STATES_MAX {
            return Err(GraphError::Full);
        }
        let child = self.push(self.primary.edge(edge).to, Some((parent, edge)), class);
        self.nodes.set_next(&self.primary, (parent, slot), child);
        Ok(child)
    }

    /// Says the class of the drape, which is known once it was simulated.
    pub fn classify_drape(&mut self, class: Class) {
        self.nodes.set_class(StateId(0), class);
    }

    /// Makes an open state interior: all its edges were simulated.
    ///
    /// # Errors
    /// It is not open, or an edge is missing.
    pub fn close(&mut self, state: StateId) -> Result<(), GraphError> {
        let State { kind, pose, .. } = self.known(state)?;
        if kind != Kind::Open {
            return Err(GraphError::WrongKind(state, kind.name(), "an open state"));
        }
        if !self.next(state).is_whole() {
            return Err(GraphError::NotTotal(state));
        }
        self.nodes.close(state, self.moments.len() as u64);
        Arc::make_mut(&mut self.interior[pose.index()]).push(state);
        self.open.remove(&state);
        Ok(())
    }

    /// Removes a dead end: merges an open state without successors into an interior one.
    ///
    /// # Errors
    /// `state` is not open or has successors, `target` is not an interior state of the same pose,
    /// or the error is not a distance.
    pub fn merge(
        &mut self,
        state: StateId,
        target: StateId,
        error_m: f32,
    ) -> Result<(), GraphError> {
        let bare = self.known(state)?.kind == Kind::Open && self.next(state).is_bare();
        if !bare {
            let is = self.state(state).kind.name();
            return Err(GraphError::WrongKind(state, is, "an open state without successors"));
        }
        self.check_target(state, target, error_m)?;
        self.open.remove(&state);
        let pose = self.state(state).pose;
        self.dead_ends[pose.index()].insert(state);
        self.set_merge(state, target, error_m);
        Ok(())
    }

    /// Undoes the merge of a dead end, which is open again; says what it was. Nothing else moves.
    ///
    /// # Errors
    /// `state` is not a dead end.
    pub fn revert(&mut self, state: StateId) -> Result<Merge, GraphError> {
        let Kind::DeadEnd { error_m, .. } = self.known(state)?.kind else {
            let is = self.state(state).kind.name();
            return Err(GraphError::WrongKind(state, is, "a dead end"));
        };
        let pose = self.state(state).pose;
        self.forget(state, error_m);
        self.dead_ends[pose.index()].remove(&state);
        self.open.insert(state);
        self.nodes.reopen(state);
        Ok(*self.merges(state).last().expect("a dead end was merged"))
    }

    /// Moves a dead end to a nearer interior state, penalties included.
    ///
    /// # Errors
    /// `state` is not a dead end, `target` is not an interior state of its pose, or is not nearer.
    pub fn remerge(
        &mut self,
        state: StateId,
        target: StateId,
        error_m: f32,
    ) -> Result<(), GraphError> {
        let Kind::DeadEnd { error_m: before_m, .. } = self.known(state)?.kind else {
            let is = self.state(state).kind.name();
            return Err(GraphError::WrongKind(state, is, "a dead end"));
        };
        self.check_target(state, target, error_m)?;
        if error_m + self.penalty_m(state, target) >= self.cost_m(state) {
            return Err(GraphError::WrongError(state, error_m));
        }
        self.forget(state, before_m);
        self.set_merge(state, target, error_m);
        Ok(())
    }

    /// Ends a commit: what was done since the last is one step of the graph's history.
    pub fn end_commit(&mut self) {
        self.moments.push(Moment {
            states: self.nodes.count() as u64,
            runs: self.runs.len(),
            worst_error_m: self.queue.worst_m(),
            worst_cost_m: self.queue.worst_m().max(self.crossing.worst_m()),
        });
    }

    /// Ends the initial pass: from here on the graph is total after every commit.
    ///
    /// # Errors
    /// A state was left open.
    pub fn end_initial_pass(&mut self) -> Result<(), GraphError> {
        self.check_total()?;
        self.initialised = Some(self.moments.len() as u64);
        self.end_commit();
        Ok(())
    }

    /// No state is open. Cheap: for every commit.
    ///
    /// # Errors
    /// The first open state.
    pub fn check_total(&self) -> Result<(), GraphError> {
        self.open.first().map_or(Ok(()), |state| Err(GraphError::NotTotal(*state)))
    }

    fn push(&mut self, pose: PoseId, parent: Option<(StateId, EdgeId)>, class: Class) -> StateId {
        let id = self.next_id();
        self.nodes.push(pose, parent, class);
        self.open.insert(id);
        let job = self.moments.len() as u64;
        match self.runs.last_mut() {
            Some(run) if run.job == job && parent.is_some_and(|(p, _)| p.0 + 1 == id.0) => {
                run.count += 1;
            }
            _ => {
                let initial = self.initialised.is_none();
                self.runs.push(Run { first: id, count: 1, job, initial });
            }
        }
        id
    }

    fn set_merge(&mut self, state: StateId, target: StateId, error_m: f32) {
        let commit = self.moments.len() as u64;
        self.queue.insert(state, error_m);
        let penalty_m = self.penalty_m(state, target);
        if penalty_m > 0.0 {
            self.crossing.insert(state, error_m + penalty_m);
        }
        self.nodes.merge(state, Merge { commit, target, error_m });
    }

    /// Takes a dead end, which must still be one, off both queues.
    fn forget(&mut self, state: StateId, error_m: f32) {
        self.queue.remove(state, error_m);
        let cost_m = self.cost_m(state);
        if cost_m > error_m {
            self.crossing.remove(state, cost_m);
        }
    }

    fn known(&self, state: StateId) -> Result<State, GraphError> {
        let exists = state.0 < self.nodes.count() as u64;
        exists.then(|| self.state(state)).ok_or(GraphError::NoState(state))
    }

    fn check_target(
        &self,
        state: StateId,
        target: StateId,
        error_m: f32,
    ) -> Result<(), GraphError> {
        let other = self.known(target)?;
        if other.kind != Kind::Interior {
            return Err(GraphError::WrongKind(target, other.kind.name(), "an interior state"));
        }
        if other.pose != self.state(state).pose {
            return Err(GraphError::WrongPose(state, target));
        }
        if !(error_m.is_finite() && error_m >= 0.0) {
            return Err(GraphError::WrongError(state, error_m));
        }
        Ok(())
    }

    /// Which out-edge of the state's pose `edge` is.
    pub(super) fn slot(&self, state: StateId, edge: EdgeId) -> Option<usize> {
        let first = self.primary.out_edges(self.state(state).pose).next()?;
        let slot = edge.0.checked_sub(first.0)? as usize;
        (slot < self.primary.out_degree(self.state(state).pose)).then_some(slot)
    }
}

impl Kind {
    /// In words, for messages.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Open => "open",
            Self::Interior => "interior",
            Self::DeadEnd { .. } => "a dead end",
        }
    }
}

#[cfg(test)]
#[path = "graph_tests.rs"]
pub(crate) mod tests;

//! The graph as it was after a given commit, as publishing sees it.
//!
//! States of later commits are retired in such a version: whoever plays one goes on where a
//! player of this version would be, had it walked the same edges.

use std::io;

use protocol::links::LinkEntry;
use protocol::manifest::VersionStats;
use protocol::{EdgeId, StateId};

use super::graph::{Graph, Kind};
use super::nodes::Next;
use super::states::StateFile;
use crate::view::{GraphView, Run};

/// What a state was at a commit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum KindAt<'a> {
    /// Not yet created.
    Later,
    /// Interior, with the state simulated on each out-edge.
    Interior(Next<'a>),
    /// Merged into a state, at a distance (m).
    DeadEnd(StateId, f32),
}

/// The graph at one commit at or after the end of the initial pass.
#[derive(Debug, Clone, Copy)]
pub struct View<'a> {
    graph: &'a Graph,
    states: &'a StateFile,
    commit: u64,
}

impl Graph {
    /// What a state was at a commit at or after the end of the initial pass.
    pub fn kind_at(&self, state: StateId, commit: u64) -> KindAt<'_> {
        if state.0 >= self.moments()[commit as usize].states {
            return KindAt::Later;
        }
        let entry = self.state(state);
        if entry.interior_since.is_some_and(|since| since <= commit) && entry.kind == Kind::Interior
        {
            return KindAt::Interior(self.next(state));
        }
        let merge = self.merges(state).iter().rev().find(|merge| merge.commit <= commit);
        let merge = merge.expect("a state of a total graph is interior or merged");
        KindAt::DeadEnd(merge.target, merge.error_m)
    }

    /// Interior states of a pose at a commit.
    pub fn interior_at(&self, pose: protocol::PoseId, commit: u64) -> &[StateId] {
        let all = self.interior(pose);
        let since = |id: &StateId| self.state(*id).interior_since;
        &all[..all.partition_point(|id| since(id).is_some_and(|since| since <= commit))]
    }

    /// At most `count` frames that were simulated, by what they started from, their edge and the
    /// state at their end; spread evenly, the first of all among them.
    pub fn some_frames(&self, count: u64) -> Vec<(StateId, EdgeId, StateId)> {
        let frames = self.simulated_frames();
        let count = count.min(frames);
        let ids = (0..count).map(|place| StateId(1 + place * frames / count));
        let frame = |id: StateId| {
            let (parent, edge) = self.state(id).parent?;
            Some((parent, edge, id))
        };
        ids.filter_map(frame).collect()
    }

    /// The job that made a state, as the commit that recorded it.
    pub fn commit_of(&self, state: StateId) -> u64 {
        self.moments().partition_point(|moment| moment.states <= state.0) as u64
    }
}

impl<'a> View<'a> {
    /// The graph as it was after `commit`, which must not lie before the end of the initial pass.
    pub fn new(graph: &'a Graph, states: &'a StateFile, commit: u64) -> Self {
        let initialised = graph.initialised().expect("the initial pass is over");
        assert!((initialised..=graph.commit()).contains(&commit), "no total graph at {commit}");
        Self { graph, states, commit }
    }

    /// What a state was at that commit.
    pub fn kind(&self, state: StateId) -> KindAt<'a> {
        self.graph.kind_at(state, self.commit)
    }

    /// The graph, whose later states do not exist yet here.
    pub fn graph(&self) -> &'a Graph {
        self.graph
    }

    /// The commit.
    pub fn commit(&self) -> u64 {
        self.commit
    }

    /// How many states there were.
    pub fn state_count(&self) -> u64 {
        self.graph.moments()[self.commit as usize].states
    }

    /// The interior state that followed an interior one at that commit.
    pub fn follow(&self, state: StateId, edge: EdgeId) -> StateId {
        let KindAt::Interior(next) = self.kind(state) else {
            unreachable!("state {state} is interior")
        };
        let slot = self.graph.slot(state, edge).expect("an edge of the state's pose");
        let next = next.get(slot).expect("an interior state has all its successors");
        match self.kind(next) {
            KindAt::DeadEnd(target, _) => target,
            KindAt::Interior(_) | KindAt::Later => next,
        }
    }

    /// Where players of later states go on, by id from the first later state on.
    fn successors(&self) -> Vec<StateId> {
        let first = self.graph.moments()[self.commit as usize].states;
        let mut successors: Vec<StateId> = Vec::new();
        for state in self.graph.states().skip(first as usize) {
            let (parent, edge) = state.parent.expect("only the drape has no parent");
            let base = match self.kind(parent) {
                KindAt::Later => successors[(parent.0 - first) as usize],
                KindAt::DeadEnd(target, _) => target,
                KindAt::Interior(_) => parent,
            };
            successors.push(self.follow(base, edge));
        }
        successors
    }
}

impl GraphView for View<'_> {
    fn vertex_count(&self) -> usize {
        self.states.vertex_count()
    }

    fn runs(&self) -> &[Run] {
        self.graph.runs()
    }

    fn positions(&self, state: StateId, out: &mut [f32]) -> io::Result<()> {
        let state = self.states.read(state)?;
        assert_eq!(out.len(), 3 * state.vertex_count(), "three numbers a vertex");
        for (vertex, out) in out.chunks_exact_mut(3).enumerate() {
            out.copy_from_slice(&state.position(vertex).to_array());
        }
        Ok(())
    }

    fn links(&self) -> Vec<LinkEntry> {
        let first_later = self.graph.moments()[self.commit as usize].states;
        let successors = self.successors();
        let entry = |(id, state): (u64, super::graph::State)| match self.kind(StateId(id)) {
            KindAt::Interior(next) => {
                LinkEntry::Interior { pose: state.pose, next: next.iter().collect() }
            }
            KindAt::DeadEnd(target, error_m) => {
                LinkEntry::DeadEnd { pose: state.pose, target, error_m }
            }
            KindAt::Later => LinkEntry::Retired {
                pose: state.pose,
                successor: successors[(id - first_later) as usize],
            },
        };
        (0..).zip(self.graph.states()).map(entry).collect()
    }

    fn stats(&self) -> VersionStats {
        let moment = &self.graph.moments()[self.commit as usize];
        let (mut merges, mut sum, mut worst_error_m) = (0u64, 0f64, 0f32);
        for id in 0..moment.states {
            if let KindAt::DeadEnd(_, error_m) = self.kind(StateId(id)) {
                merges += 1;
                sum += f64::from(error_m);
                worst_error_m = worst_error_m.max(error_m);
            }
        }
        VersionStats {
            poses: self.graph.primary().poses().len() as u32,
            edges: self.graph.primary().edges().len() as u32,
            states: moment.states,
            trajectories: moment.runs as u64,
            merges,
            simulated_frames: self.graph.simulated_frames(),
            worst_error_m,
            mean_error_m: (sum / merges.max(1) as f64) as f32,
            raw_bytes: moment.states * self.states.vertex_count() as u64 * 12,
            ..VersionStats::default()
        }
    }
}

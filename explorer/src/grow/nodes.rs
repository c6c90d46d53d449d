//! The states of the graph, packed: 24 bytes each, whatever their number. Merges and branches, which few states
//! have, lie apart.

use std::collections::BTreeMap;

use protocol::{EdgeId, PoseId, StateId};

use super::class::Class;
use super::graph::{Kind, Merge, State};
use crate::primary::PrimaryGraph;

/// Most states of a graph: 12 bytes a vertex of each lie on the disk, so that the disk is full long before.
pub const STATES_MAX: u64 = u32::MAX as u64 - 1;

const NONE: u32 = u32::MAX;

/// What is kept of a state.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Node {
    pose: u32,
    /// `NONE` for the drape.
    parent: u32,
    edge: u32,
    /// The state simulated next; of a pose with several out-edges: where they begin in `branches`.
    next: u32,
    /// The commit since which it is interior, or `NONE`.
    interior_since: u32,
    class: Class,
    stage: Stage,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Stage {
    Open,
    Interior,
    DeadEnd,
}

/// See the module.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Nodes {
    nodes: Vec<Node>,
    branches: Vec<u32>,
    merges: BTreeMap<u32, Vec<Merge>>,
}

/// The states simulated on each out-edge of a state's pose, as far as they were.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Next<'a>(&'a [u32]);

impl<'a> Next<'a> {
    /// On the `slot`th out-edge of the pose.
    pub fn get(self, slot: usize) -> Option<StateId> {
        self.0.get(slot).and_then(|id| known(*id))
    }

    /// One for each out-edge, in order.
    pub fn each(self) -> impl Iterator<Item = Option<StateId>> + 'a {
        self.0.iter().map(|id| known(*id))
    }

    /// Those that were simulated, in the order of their edges: all of an interior state's.
    pub fn iter(self) -> impl Iterator<Item = StateId> + 'a {
        self.each().flatten()
    }

    /// Whether all out-edges were simulated.
    pub fn is_whole(self) -> bool {
        !self.0.contains(&NONE)
    }

    /// Whether none was.
    pub fn is_bare(self) -> bool {
        self.0.iter().all(|id| *id == NONE)
    }
}

fn known(id: u32) -> Option<StateId> {
    (id != NONE).then_some(StateId(u64::from(id)))
}

impl Nodes {
    /// How many.
    pub fn count(&self) -> usize {
        self.nodes.len()
    }

    /// A state that exists.
    pub fn get(&self, state: StateId) -> State {
        let node = &self.nodes[state.index()];
        let kind = match node.stage {
            Stage::Open => Kind::Open,
            Stage::Interior => Kind::Interior,
            Stage::DeadEnd => {
                let merge = self.merges(state).last().expect("a dead end was merged");
                Kind::DeadEnd { target: merge.target, error_m: merge.error_m }
            }
        };
        State {
            pose: PoseId(node.pose),
            class: node.class,
            parent: known(node.parent).map(|parent| (parent, EdgeId(node.edge))),
            kind,
            interior_since: (node.interior_since != NONE).then_some(u64::from(node.interior_since)),
        }
    }

    /// Every merge that a state went through, oldest first.
    pub fn merges(&self, state: StateId) -> &[Merge] {
        self.merges.get(&(state.0 as u32)).map_or(&[], |merges| merges)
    }

    /// What was simulated on from a state.
    pub fn next(&self, primary: &PrimaryGraph, state: StateId) -> Next<'_> {
        let node = &self.nodes[state.index()];
        let degree = primary.out_degree(PoseId(node.pose));
        if node.stage == Stage::DeadEnd {
            return Next(&[]);
        }
        match degree {
            1 => Next(std::slice::from_ref(&node.next)),
            _ if node.next == NONE => Next(&[NONE; 1][..degree.min(1)]),
            _ => Next(&self.branches[node.next as usize..][..degree]),
        }
    }

    /// Adds an open state.
    pub fn push(&mut self, pose: PoseId, parent: Option<(StateId, EdgeId)>, class: Class) {
        self.nodes.push(Node {
            pose: pose.0,
            parent: parent.map_or(NONE, |(parent, _)| parent.0 as u32),
            edge: parent.map_or(NONE, |(_, edge)| edge.0),
            next: NONE,
            interior_since: NONE,
            class,
            stage: Stage::Open,
        });
    }

    /// Says what was simulated on a free out-edge of an open state.
    pub fn set_next(
        &mut self,
        primary: &PrimaryGraph,
        (state, slot): (StateId, usize),
        to: StateId,
    ) {
        let node = &mut self.nodes[state.index()];
        let degree = primary.out_degree(PoseId(node.pose));
        if degree == 1 {
            node.next = to.0 as u32;
            return;
        }
        if node.next == NONE {
            node.next = self.branches.len() as u32;
            self.branches.resize(self.branches.len() + degree, NONE);
        }
        self.branches[node.next as usize + slot] = to.0 as u32;
    }

    /// Changes a state's class.
    pub fn set_class(&mut self, state: StateId, class: Class) {
        self.nodes[state.index()].class = class;
    }

    /// An open state is interior since a commit.
    pub fn close(&mut self, state: StateId, commit: u64) {
        let node = &mut self.nodes[state.index()];
        (node.stage, node.interior_since) = (Stage::Interior, commit as u32);
    }

    /// A state is merged.
    pub fn merge(&mut self, state: StateId, merge: Merge) {
        self.nodes[state.index()].stage = Stage::DeadEnd;
        self.merges.entry(state.0 as u32).or_default().push(merge);
    }

    /// A dead end is open again.
    pub fn reopen(&mut self, state: StateId) {
        self.nodes[state.index()].stage = Stage::Open;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_state_takes_24_bytes() {
        assert_eq!(size_of::<Node>(), 24);
    }
}

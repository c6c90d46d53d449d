//! The whole transition table of one version, proved total.

use crate::ids::{PoseId, StateId};
use crate::limits;
use crate::links::{LinkEntry, LinkPage};
use crate::scene::Edge;

/// Why a table is not total: what, and where.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum NotTotal {
    /// A page is not where the page before it ended.
    #[error("link page {page} begins at state {found}, not {expected}; a page is missing")]
    PageGap {
        /// Its index.
        page: usize,
        /// Its first state.
        found: StateId,
        /// What it should be.
        expected: u64,
    },
    /// More states than can be tabulated here.
    #[error("{0} states and links are more than a table holds")]
    TooMany(usize),
    /// A state at a pose that does not exist.
    #[error("state {state} is at pose {pose}, but the graph has {poses} poses")]
    UnknownPose {
        /// The state.
        state: StateId,
        /// Its pose.
        pose: PoseId,
        /// Poses of the primary graph.
        poses: usize,
    },
    /// Fewer or more links than out-edges.
    #[error("state {state} at pose {pose} has {links} links for {edges} out-edges")]
    LinkCount {
        /// The state.
        state: StateId,
        /// Its pose.
        pose: PoseId,
        /// Links it has.
        links: usize,
        /// Out-edges of its pose.
        edges: usize,
    },
    /// A link to a state that does not exist or was retired.
    #[error("state {state} leads to state {to}, which this version does not have")]
    UnknownState {
        /// The state.
        state: StateId,
        /// Where it leads.
        to: StateId,
    },
    /// A link to a state of another pose.
    #[error("state {state} leads to state {to} of pose {found}, where pose {expected} belongs")]
    WrongPose {
        /// The state.
        state: StateId,
        /// Where it leads.
        to: StateId,
        /// That state's pose.
        found: PoseId,
        /// The pose that the edge (or the merge) asks for.
        expected: PoseId,
    },
    /// A dead end merged into, or a retired state succeeded by, a state that cannot be played on.
    #[error("state {state} goes on at state {to}, which is not interior")]
    NotInterior {
        /// The dead end or retired state.
        state: StateId,
        /// Its target or successor.
        to: StateId,
    },
    /// A pose at which nothing can be played.
    #[error("pose {0} has no interior state")]
    EmptyPose(PoseId),
}

/// Where a step leads.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Follow {
    /// The interior state to play next.
    pub state: StateId,
    /// The dead end that was merged into it and the error of the merge (m); `None` where `state`
    /// itself was simulated next. The dead end's own coefficients start the blend.
    pub via: Option<(StateId, f32)>,
}

/// What the table knows of a state; see [`LinkEntry`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Entry<'a> {
    /// Playable: the state simulated next per out-edge.
    Interior(&'a [StateId]),
    /// Merged into `target` with an error (m).
    DeadEnd {
        /// Where playing goes on.
        target: StateId,
        /// Merge error (m).
        error_m: f32,
    },
    /// Not of this version.
    Retired {
        /// Where playing goes on.
        successor: StateId,
    },
}

/// All links of a version. Constructed only from pages that are total: from every interior state,
/// every out-edge leads to a state of the edge's target pose.
#[derive(Debug, Clone, PartialEq)]
pub struct LinkTable {
    slots: Vec<Slot>,
    next: Vec<StateId>,
    /// Interior states of pose p: `by_pose[pose_first[p]..pose_first[p + 1]]`, in order of id.
    by_pose: Vec<StateId>,
    pose_first: Vec<u32>,
}

/// Links of an interior state: `links` consecutive entries of `LinkTable::next`.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Slot {
    pose: PoseId,
    kind: Kind,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Kind {
    Interior { first: u32, links: u32 },
    DeadEnd { target: StateId, error_m: f32 },
    Retired { successor: StateId },
}

impl LinkTable {
    /// Builds the table and proves it total.
    ///
    /// * `pages`: all of them, in order.
    /// * `pose_count`, `edges`: of the primary graph; edges sorted by `from`, then by `to`.
    ///
    /// Cost: linear in states and links.
    ///
    /// # Errors
    /// The first place where it is not total.
    pub fn new(pages: &[LinkPage], pose_count: usize, edges: &[Edge]) -> Result<Self, NotTotal> {
        let mut table = Self::tabulate(pages)?;
        table.index_poses(pose_count)?;
        let first_edge = first_edges(pose_count, edges);
        for state in 0..table.slots.len() as u64 {
            table.check_state(StateId(state), &first_edge, edges)?;
        }
        Ok(table)
    }

    /// Number of states, dead ends and retired ones included.
    pub fn state_count(&self) -> usize {
        self.slots.len()
    }

    /// What is known of a state; `None` past the end.
    pub fn entry(&self, state: StateId) -> Option<Entry<'_>> {
        self.slots.get(state.index()).map(|slot| match slot.kind {
            Kind::Interior { first, links } => {
                Entry::Interior(&self.next[first as usize..(first + links) as usize])
            }
            Kind::DeadEnd { target, error_m } => Entry::DeadEnd { target, error_m },
            Kind::Retired { successor } => Entry::Retired { successor },
        })
    }

    /// The pose of a state; `None` past the end.
    pub fn pose(&self, state: StateId) -> Option<PoseId> {
        self.slots.get(state.index()).map(|slot| slot.pose)
    }

    /// One step from an interior state along the `edge_index`-th out-edge of its pose; `None`
    /// where the state is not interior or has no such edge.
    pub fn follow(&self, state: StateId, edge_index: usize) -> Option<Follow> {
        let Entry::Interior(next) = self.entry(state)? else { return None };
        let next = *next.get(edge_index)?;
        match self.entry(next)? {
            Entry::DeadEnd { target, error_m } => {
                Some(Follow { state: target, via: Some((next, error_m)) })
            }
            Entry::Interior(_) | Entry::Retired { .. } => Some(Follow { state: next, via: None }),
        }
    }

    /// Where someone who plays `state` (of this or another version) goes on: itself if interior,
    /// else its target or successor; `None` past the end.
    pub fn resume(&self, state: StateId) -> Option<StateId> {
        Some(match self.entry(state)? {
            Entry::Interior(_) => state,
            Entry::DeadEnd { target, .. } => target,
            Entry::Retired { successor } => successor,
        })
    }

    /// Interior states of a pose, in order of id; never empty for a pose of the graph.
    pub fn interior(&self, pose: PoseId) -> &[StateId] {
        let Some(&end) = self.pose_first.get(pose.index() + 1) else { return &[] };
        &self.by_pose[self.pose_first[pose.index()] as usize..end as usize]
    }

    fn tabulate(pages: &[LinkPage]) -> Result<Self, NotTotal> {
        let mut slots = Vec::new();
        let mut next_states = Vec::new();
        for (page, links) in pages.iter().enumerate() {
            let expected = (page * limits::LINK_PAGE_STATES) as u64;
            if links.first_state.0 != expected || slots.len() as u64 != expected {
                return Err(NotTotal::PageGap { page, found: links.first_state, expected });
            }
            for entry in &links.entries {
                let kind = match entry {
                    LinkEntry::Interior { next, .. } => {
                        let first = next_states.len();
                        next_states.extend_from_slice(next);
                        if next_states.len() > u32::MAX as usize {
                            return Err(NotTotal::TooMany(next_states.len()));
                        }
                        Kind::Interior { first: first as u32, links: next.len() as u32 }
                    }
                    &LinkEntry::DeadEnd { target, error_m, .. } => {
                        Kind::DeadEnd { target, error_m }
                    }
                    &LinkEntry::Retired { successor, .. } => Kind::Retired { successor },
                };
                slots.push(Slot { pose: entry.pose(), kind });
            }
        }
        Ok(Self { slots, next: next_states, by_pose: Vec::new(), pose_first: Vec::new() })
    }

    fn index_poses(&mut self, pose_count: usize) -> Result<(), NotTotal> {
        let interior = |slot: &Slot| matches!(slot.kind, Kind::Interior { .. });
        let mut first = vec![0u32; pose_count + 1];
        for (slot, id) in self.slots.iter().zip(0..) {
            let (state, pose) = (StateId(id), slot.pose);
            if pose.index() >= pose_count {
                return Err(NotTotal::UnknownPose { state, pose, poses: pose_count });
            }
            first[pose.index() + 1] += u32::from(interior(slot));
        }
        if let Some(empty) = first[1..].iter().position(|count| *count == 0) {
            return Err(NotTotal::EmptyPose(PoseId(empty as u32)));
        }
        for pose in 0..pose_count {
            first[pose + 1] += first[pose];
        }
        let mut free = first.clone();
        self.by_pose = vec![StateId(0); first[pose_count] as usize];
        for (slot, id) in self.slots.iter().zip(0..).filter(|(slot, _)| interior(slot)) {
            let place = &mut free[slot.pose.index()];
            self.by_pose[*place as usize] = StateId(id);
            *place += 1;
        }
        self.pose_first = first;
        Ok(())
    }

    fn check_state(
        &self,
        state: StateId,
        first_edge: &[usize],
        edges: &[Edge],
    ) -> Result<(), NotTotal> {
        let Slot { pose, kind } = self.slots[state.index()];
        let to = match kind {
            Kind::DeadEnd { target, .. } => target,
            Kind::Retired { successor } => successor,
            Kind::Interior { first, links } => {
                let next = &self.next[first as usize..(first + links) as usize];
                let out = &edges[first_edge[pose.index()]..first_edge[pose.index() + 1]];
                if next.len() != out.len() {
                    let (links, edges) = (next.len(), out.len());
                    return Err(NotTotal::LinkCount { state, pose, links, edges });
                }
                for (&to, edge) in next.iter().zip(out) {
                    let there = self.expect_pose(state, to, edge.to)?;
                    if matches!(there, Kind::Retired { .. }) {
                        return Err(NotTotal::UnknownState { state, to });
                    }
                }
                return Ok(());
            }
        };
        match self.expect_pose(state, to, pose)? {
            Kind::Interior { .. } => Ok(()),
            Kind::DeadEnd { .. } | Kind::Retired { .. } => Err(NotTotal::NotInterior { state, to }),
        }
    }

    fn expect_pose(&self, state: StateId, to: StateId, pose: PoseId) -> Result<Kind, NotTotal> {
        let there = self.slots.get(to.index()).ok_or(NotTotal::UnknownState { state, to })?;
        if there.pose != pose {
            return Err(NotTotal::WrongPose { state, to, found: there.pose, expected: pose });
        }
        Ok(there.kind)
    }
}

/// `first[p]..first[p + 1]` are the out-edges of pose p.
fn first_edges(pose_count: usize, edges: &[Edge]) -> Vec<usize> {
    (0..=pose_count).map(|pose| edges.partition_point(|edge| edge.from.index() < pose)).collect()
}

//! Which state follows which on each primary edge.
//!
//! Every state ever created has one entry, at its id. The link of an interior state names the
//! state that was simulated next, even where that one is a dead end: then the dead end's own
//! entry says where it was merged. So undoing a merge changes one entry and nothing else.

use serde::{Deserialize, Serialize};

use crate::ids::{PoseId, StateId};

/// What a version knows of one state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum LinkEntry {
    /// Playable: one successor per out-edge of its pose, in the order of the edges.
    Interior {
        /// Its pose.
        pose: PoseId,
        /// The state simulated next on each out-edge; an interior state or a dead end.
        next: Vec<StateId>,
    },
    /// Simulated, but its out-edges were not: playing goes on at `target`.
    DeadEnd {
        /// Its pose, which is the target's pose too.
        pose: PoseId,
        /// The interior state that it was merged into.
        target: StateId,
        /// The metric's distance between the two [m].
        error_m: f32,
    },
    /// Not part of this version (of an earlier or a later one): who plays it goes on at
    /// `successor`, an interior state of the same pose.
    Retired {
        /// Its pose.
        pose: PoseId,
        /// Where to go on.
        successor: StateId,
    },
}

/// Entries of `LINK_PAGE_STATES` consecutive states (the last page may be shorter): one chunk.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LinkPage {
    /// Id of the first entry's state; a multiple of `LINK_PAGE_STATES`.
    pub first_state: StateId,
    /// One entry per state.
    pub entries: Vec<LinkEntry>,
}

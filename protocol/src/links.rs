//! Which state follows which on each primary edge.
//!
//! Every state ever created has one entry, at its id. The link of an interior state names the
//! state that was simulated next, even where that one is a dead end: then the dead end's own
//! entry says where it was merged. So undoing a merge changes one entry and nothing else.

use serde::{Deserialize, Serialize};

use crate::ids::{PoseId, StateId};
use crate::limits;
use crate::wire::{DecodeError, Format, at_most, ensure};

const PAGE: Format =
    Format { what: "link page", magic: *b"TLNK", version: 1, bytes_max: limits::CHUNK_BYTES_MAX };

/// What a version knows of one state.
#[derive(Debug, Clone, PartialEq)]
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
        /// The metric's distance between the two (m).
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
#[derive(Debug, Clone, PartialEq)]
pub struct LinkPage {
    /// Id of the first entry's state; a multiple of `LINK_PAGE_STATES`.
    pub first_state: StateId,
    /// One entry per state.
    pub entries: Vec<LinkEntry>,
}

impl LinkEntry {
    /// The pose of its state.
    pub fn pose(&self) -> PoseId {
        match self {
            Self::Interior { pose, .. }
            | Self::DeadEnd { pose, .. }
            | Self::Retired { pose, .. } => *pose,
        }
    }
}

impl LinkPage {
    /// Splits the entries of states 0, 1, 2, ... into pages of `LINK_PAGE_STATES`.
    pub fn split(entries: &[LinkEntry]) -> Vec<LinkPage> {
        let pages = entries.chunks(limits::LINK_PAGE_STATES).enumerate();
        pages
            .map(|(page, entries)| LinkPage {
                first_state: StateId((page * limits::LINK_PAGE_STATES) as u64),
                entries: entries.to_vec(),
            })
            .collect()
    }

    /// Bytes to store. Ids are written relative to the entry's own id, poses to the entry before:
    /// both are small numbers along a trajectory, so that most entries take four bytes.
    ///
    /// # Panics
    /// If [`LinkPage::check`] fails.
    pub fn encode(&self) -> Vec<u8> {
        self.check().expect("a link page is checked before it is written");
        let mut pose_before = 0;
        let entries = self.entries.iter().zip(self.first_state.0..).map(|(entry, own)| {
            let pose = i64::from(entry.pose().0) - pose_before;
            pose_before += pose;
            let relative = |id: &StateId| (id.0 as i64).wrapping_sub(own as i64);
            match entry {
                LinkEntry::Interior { next, .. } => {
                    PackedEntry::Interior { pose, next: next.iter().map(relative).collect() }
                }
                LinkEntry::DeadEnd { target, error_m, .. } => {
                    PackedEntry::DeadEnd { pose, target: relative(target), error_m: *error_m }
                }
                LinkEntry::Retired { successor, .. } => {
                    PackedEntry::Retired { pose, successor: relative(successor) }
                }
            }
        });
        let entries = entries.collect();
        PAGE.encode(&PackedPage { first_state: self.first_state.0, entries })
    }

    /// Reads and checks.
    ///
    /// # Errors
    /// Damaged bytes, or a page that breaks a rule of [`LinkPage::check`].
    pub fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
        let packed: PackedPage = PAGE.decode(bytes)?;
        let page = packed.expand().ok_or_else(|| PAGE.invalid("an id overflows".into()))?;
        page.check()?;
        Ok(page)
    }

    /// Full alignment and length of the page, ids within `STATES_MAX`, poses within `POSES_MAX`,
    /// errors finite. Whether all pages together are total is [`LinkTable`](crate::LinkTable)'s.
    ///
    /// # Errors
    /// The first rule that is broken, with its place.
    pub fn check(&self) -> Result<(), DecodeError> {
        self.check_entries().map_err(|why| PAGE.invalid(why))
    }

    fn check_entries(&self) -> Result<(), String> {
        let first = self.first_state.0;
        let page_states = limits::LINK_PAGE_STATES as u64;
        ensure(first.is_multiple_of(page_states) && first < limits::STATES_MAX, || {
            format!("it begins at state {first}, which is not a multiple of {page_states} in range")
        })?;
        at_most("states in a link page", self.entries.len(), limits::LINK_PAGE_STATES)?;
        ensure(!self.entries.is_empty(), || "no entry".into())?;
        for (entry, state) in self.entries.iter().zip(first..) {
            ensure(entry.pose().index() < limits::POSES_MAX, || {
                format!("state {state} is at pose {}", entry.pose())
            })?;
            let ids_fit = match entry {
                LinkEntry::Interior { next, .. } => {
                    at_most("links of a state", next.len(), limits::EDGES_MAX)?;
                    next.iter().all(in_range)
                }
                LinkEntry::DeadEnd { target, error_m, .. } => {
                    ensure(error_m.is_finite() && *error_m >= 0.0, || {
                        format!("dead end {state} claims an error of {error_m} m")
                    })?;
                    in_range(target)
                }
                LinkEntry::Retired { successor, .. } => in_range(successor),
            };
            ensure(ids_fit, || format!("state {state} names a state out of range"))?;
        }
        Ok(())
    }
}

fn in_range(id: &StateId) -> bool {
    id.0 < limits::STATES_MAX
}

/// The wire form of a page: ids relative to the entry's own, poses to the entry before.
#[derive(Serialize, Deserialize)]
struct PackedPage {
    first_state: u64,
    entries: Vec<PackedEntry>,
}

#[derive(Serialize, Deserialize)]
enum PackedEntry {
    Interior { pose: i64, next: Vec<i64> },
    DeadEnd { pose: i64, target: i64, error_m: f32 },
    Retired { pose: i64, successor: i64 },
}

impl PackedPage {
    /// `None` when an id leaves its type's range.
    fn expand(&self) -> Option<LinkPage> {
        let mut pose_before = 0i64;
        let mut entries = Vec::with_capacity(self.entries.len());
        for (index, entry) in self.entries.iter().enumerate() {
            let own = self.first_state.checked_add(index as u64)?;
            let absolute = |delta: &i64| own.checked_add_signed(*delta).map(StateId);
            let (PackedEntry::Interior { pose, .. }
            | PackedEntry::DeadEnd { pose, .. }
            | PackedEntry::Retired { pose, .. }) = entry;
            pose_before = pose_before.checked_add(*pose)?;
            let pose = PoseId(u32::try_from(pose_before).ok()?);
            entries.push(match entry {
                PackedEntry::Interior { next, .. } => LinkEntry::Interior {
                    pose,
                    next: next.iter().map(absolute).collect::<Option<_>>()?,
                },
                PackedEntry::DeadEnd { target, error_m, .. } => {
                    LinkEntry::DeadEnd { pose, target: absolute(target)?, error_m: *error_m }
                }
                PackedEntry::Retired { successor, .. } => {
                    LinkEntry::Retired { pose, successor: absolute(successor)? }
                }
            });
        }
        Some(LinkPage { first_state: StateId(self.first_state), entries })
    }
}

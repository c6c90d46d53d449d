//! What a client wants and what it has asked for.

use std::collections::{BTreeMap, BTreeSet};

use crate::ids::ChunkHash;
use crate::limits;
use crate::manifest::ChunkRef;
use crate::message::Priority;

#[derive(Debug, Default)]
pub(super) struct Wants {
    chunks: BTreeMap<ChunkHash, Want>,
    /// Not yet asked for, most urgent first, then in the order wanted.
    queue: BTreeSet<(Priority, u64, ChunkHash)>,
    orders: u64,
    asked: usize,
    asked_bytes: u64,
}

#[derive(Debug, Clone, Copy)]
struct Want {
    bytes: u32,
    priority: Priority,
    order: u64,
    asked: bool,
}

/// What a new want changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Change {
    /// It waits in the queue, or nothing changed.
    Queued,
    /// It is under way and must be asked for again with its new priority.
    AskAgain,
    /// There is no room.
    Full,
}

impl Wants {
    pub fn want(&mut self, chunk: ChunkRef, priority: Priority) -> Change {
        if let Some(want) = self.chunks.get_mut(&chunk.hash) {
            if want.priority == priority {
                return Change::Queued;
            }
            let before = (want.priority, want.order, chunk.hash);
            want.priority = priority;
            if want.asked {
                return Change::AskAgain;
            }
            self.queue.remove(&before);
            self.queue.insert((priority, before.1, chunk.hash));
            return Change::Queued;
        }
        if self.chunks.len() >= limits::WANTS_MAX {
            return Change::Full;
        }
        let order = self.orders;
        self.orders += 1;
        let want = Want { bytes: chunk.bytes, priority, order, asked: false };
        self.chunks.insert(chunk.hash, want);
        self.queue.insert((priority, order, chunk.hash));
        Change::Queued
    }

    /// Whether [`Wants::ask`] would give something.
    pub fn is_ready(&self) -> bool {
        self.queue.first().is_some_and(|(priority, ..)| self.has_room(*priority))
    }

    /// The next chunk to ask for.
    pub fn ask(&mut self) -> Option<(ChunkHash, Priority)> {
        let &(priority, _, hash) = self.queue.first().filter(|(p, ..)| self.has_room(*p))?;
        self.queue.pop_first();
        let want = self.chunks.get_mut(&hash).expect("what is queued is wanted");
        want.asked = true;
        self.asked += 1;
        self.asked_bytes += u64::from(want.bytes);
        Some((hash, priority))
    }

    /// The size of a chunk that was asked for.
    pub fn asked_bytes_of(&self, hash: &ChunkHash) -> Option<u32> {
        self.chunks.get(hash).filter(|want| want.asked).map(|want| want.bytes)
    }

    /// Forgets a chunk; says whether it had been asked for.
    pub fn forget(&mut self, hash: &ChunkHash) -> bool {
        let Some(want) = self.chunks.remove(hash) else { return false };
        if want.asked {
            self.asked -= 1;
            self.asked_bytes -= u64::from(want.bytes);
        } else {
            self.queue.remove(&(want.priority, want.order, *hash));
        }
        want.asked
    }

    /// Queues one chunk again, as its stream was cut.
    pub fn ask_again(&mut self, hash: &ChunkHash) {
        let Some(want) = self.chunks.get_mut(hash).filter(|want| want.asked) else { return };
        want.asked = false;
        self.asked -= 1;
        self.asked_bytes -= u64::from(want.bytes);
        self.queue.insert((want.priority, want.order, *hash));
    }

    /// Queues everything again, as the connection was lost.
    pub fn ask_all_again(&mut self) {
        for (hash, want) in &mut self.chunks {
            want.asked = false;
            self.queue.insert((want.priority, want.order, *hash));
        }
        (self.asked, self.asked_bytes) = (0, 0);
    }

    pub fn len(&self) -> usize {
        self.chunks.len()
    }

    /// Lesser priorities may fill only part of the window, so that what is urgent never waits
    /// behind a full one.
    fn has_room(&self, priority: Priority) -> bool {
        let share = match priority {
            Priority::Scene | Priority::Urgent => 4,
            Priority::Soon => 3,
            Priority::Background => 1,
        };
        self.asked == 0
            || self.asked < limits::CLIENT_FETCHES_MAX * share / 4
                && self.asked_bytes < limits::CLIENT_FETCH_BYTES_MAX * share as u64 / 4
    }
}

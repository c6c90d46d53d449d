//! Counts of what was walked, drained in batches. Counts only: no player, no order, no time.

use std::collections::BTreeMap;
use std::sync::Mutex;

use protocol::EdgeId;

/// What the cursors of one garment walked since the last batch.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Batch {
    /// How often each primary edge was walked.
    pub edges: BTreeMap<EdgeId, u32>,
    /// Frames that were exact.
    pub exact: u64,
    /// Frames that were substituted.
    pub substituted: u64,
    /// Frames that were missed.
    pub missed: u64,
    /// Poses that were no successor of the one before.
    pub jumps: u64,
    /// Of the substituted frames, those outside the graph.
    pub outside: u64,
}

impl Batch {
    /// Whether nothing was counted.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Adds another one's counts.
    pub fn merge(&mut self, other: &Self) {
        for (key, count) in &other.edges {
            let sum = self.edges.entry(*key).or_default();
            *sum = sum.saturating_add(*count);
        }
        self.exact += other.exact;
        self.substituted += other.substituted;
        self.missed += other.missed;
        self.jumps += other.jumps;
        self.outside += other.outside;
    }
}

/// Where characters leave their counts and the driver fetches them.
///
/// A character never waits: when the driver is fetching in that instant, it keeps its counts for
/// the next time.
#[derive(Debug, Default)]
pub struct Mailbox(Mutex<Batch>);

impl Mailbox {
    /// Moves the counts of `batch` over, or leaves them where they are.
    pub fn try_post(&self, batch: &mut Batch) -> bool {
        let Ok(mut held) = self.0.try_lock() else { return false };
        held.merge(batch);
        *batch = Batch::default();
        true
    }

    /// Takes everything that was posted.
    pub fn drain(&self) -> Batch {
        let mut held = self.0.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        std::mem::take(&mut held)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_lost_or_counted_twice() {
        let mailbox = Mailbox::default();
        let mut batch = Batch { exact: 3, ..Batch::default() };
        batch.edges.insert(EdgeId(7), 3);
        let held = mailbox.0.lock().unwrap();
        assert!(!mailbox.try_post(&mut batch), "the mailbox is in use");
        assert_eq!(batch.exact, 3, "kept for the next time");
        drop(held);
        assert!(mailbox.try_post(&mut batch));
        assert!(batch.is_empty());
        assert!(mailbox.try_post(&mut batch));
        let drained = mailbox.drain();
        assert_eq!(drained.edges[&EdgeId(7)], 3);
        assert_eq!(drained.exact, 3);
        assert!(mailbox.drain().is_empty());
    }
}

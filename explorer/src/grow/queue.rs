//! Which dead end is simulated next: the largest merge error first.

use std::cmp::Reverse;
use std::collections::BTreeSet;

use protocol::StateId;

/// Dead ends by merge error, largest first; of equal errors the lowest id.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Queue {
    // A finite, non-negative f32 sorts like its bits.
    entries: BTreeSet<(Reverse<u32>, StateId)>,
}

impl Queue {
    /// Adds a dead end; `error_m` (m) is finite and not negative.
    pub fn insert(&mut self, state: StateId, error_m: f32) {
        let added = self.entries.insert(key(state, error_m));
        assert!(added, "state {state} is queued already");
    }

    /// Removes a dead end that was queued with this error.
    pub fn remove(&mut self, state: StateId, error_m: f32) {
        let removed = self.entries.remove(&key(state, error_m));
        assert!(removed, "state {state} is not queued with that error");
    }

    /// Dead ends with their errors (m), largest first.
    pub fn iter(&self) -> impl Iterator<Item = (StateId, f32)> {
        self.entries.iter().map(|(Reverse(bits), state)| (*state, f32::from_bits(*bits)))
    }

    /// The largest error (m); 0 for an empty queue.
    pub fn worst_m(&self) -> f32 {
        self.iter().next().map_or(0.0, |(_, error_m)| error_m)
    }

    /// How many dead ends are queued.
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }
}

fn key(state: StateId, error_m: f32) -> (Reverse<u32>, StateId) {
    assert!(error_m.is_finite() && error_m >= 0.0, "merge error {error_m}");
    // + 0.0 turns -0.0 into 0.0.
    (Reverse((error_m + 0.0).to_bits()), state)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn largest_error_first_then_lowest_id() {
        let mut queue = Queue::default();
        for (state, error_m) in [(4, 0.5), (9, 0.0), (2, 0.5), (1, 0.25), (7, 3.0)] {
            queue.insert(StateId(state), error_m);
        }
        let order: Vec<u64> = queue.iter().map(|(state, _)| state.0).collect();
        assert_eq!(order, [7, 2, 4, 1, 9]);
        queue.remove(StateId(7), 3.0);
        queue.remove(StateId(9), -0.0);
        assert_eq!((queue.worst_m().to_bits(), queue.len()), (0.5f32.to_bits(), 3));
    }
}

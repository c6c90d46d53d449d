//! Frames that are simulated before their turn, where a worker would wait.
//!
//! At the end of a round, and while a version is published, workers go on with the dead ends that the next
//! round is likely to take. Only frames are kept, by what they were simulated from: a frame is a function
//! of its state and its edge, so whoever finds one here has what would have been simulated, and what is
//! recorded is the same for any number of workers.

use std::collections::HashMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use protocol::EdgeId;

use crate::grid::GridState;
use crate::simulator::Frame;

/// Most memory that frames take here (bytes).
const BYTES_MAX: usize = 64 << 20;

type Key = (blake3::Hash, EdgeId);

/// Frames simulated before their turn.
#[derive(Debug, Default)]
pub struct Ahead {
    frames: Mutex<HashMap<Key, Frame>>,
    count: AtomicUsize,
}

/// What a job does with frames that were simulated ahead.
#[derive(Debug, Clone, Copy)]
pub enum Use<'a> {
    /// It is recorded: a frame is wanted once.
    Take(&'a Ahead),
    /// It runs ahead itself: what it simulates is kept.
    Keep(&'a Ahead),
}

impl Ahead {
    fn frames(&self) -> MutexGuard<'_, HashMap<Key, Frame>> {
        self.frames.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether so many more frames of states of so many bytes fit in.
    pub fn has_room(&self, frames: usize, state_bytes: usize) -> bool {
        (self.count.load(Ordering::Relaxed) + frames).saturating_mul(state_bytes) <= BYTES_MAX
    }

    /// Forgets what nobody has taken once half of the room is full.
    pub fn make_room(&self, state_bytes: usize) {
        if 2 * self.count.load(Ordering::Relaxed) * state_bytes > BYTES_MAX {
            self.frames().clear();
            self.count.store(0, Ordering::Relaxed);
        }
    }
}

impl Use<'_> {
    /// The frame from `state` along `edge`: one that is here, or else what `simulate` makes.
    ///
    /// # Errors
    /// Those of `simulate`.
    pub fn frame<E>(
        self,
        (state, edge): (&GridState, EdgeId),
        simulate: impl FnOnce() -> Result<Frame, E>,
    ) -> Result<Frame, E> {
        let (Self::Take(ahead) | Self::Keep(ahead)) = self;
        let keeps = matches!(self, Self::Keep(_));
        if !keeps && ahead.count.load(Ordering::Relaxed) == 0 {
            return simulate();
        }
        let key = (hash(state), edge);
        let known = match self {
            Self::Take(_) => ahead.frames().remove(&key),
            Self::Keep(_) => ahead.frames().get(&key).cloned(),
        };
        let frame = match known {
            Some(frame) => frame,
            None => {
                let frame = simulate()?;
                if keeps {
                    ahead.frames().insert(key, frame.clone());
                }
                frame
            }
        };
        ahead.count.store(ahead.frames().len(), Ordering::Relaxed);
        Ok(frame)
    }
}

fn hash(state: &GridState) -> blake3::Hash {
    let mut hasher = blake3::Hasher::new();
    for part in [&state.positions, &state.velocities] {
        let bytes: Vec<u8> = part.iter().flatten().flat_map(|n| n.to_le_bytes()).collect();
        hasher.update(&bytes);
    }
    hasher.finalize()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulator::FrameQuality;

    #[test]
    fn a_frame_is_simulated_once_and_taken_once() {
        let ahead = Ahead::default();
        let state = |mark: i16| GridState { positions: vec![[mark; 3]], velocities: vec![[0; 3]] };
        let mut simulated = 0;
        let mut ask = |how: Use<'_>, mark: i16, edge: u32| {
            let frame = how.frame((&state(mark), EdgeId(edge)), || {
                simulated += 1;
                let state = state(100 * mark + edge as i16);
                Ok::<_, ()>(Frame { state, quality: FrameQuality::default() })
            });
            (frame.unwrap().state.positions[0][0], simulated)
        };
        assert_eq!(ask(Use::Take(&ahead), 1, 2), (102, 1));
        assert_eq!(ask(Use::Keep(&ahead), 1, 2), (102, 2), "what is recorded is not kept");
        assert_eq!(ask(Use::Keep(&ahead), 1, 3), (103, 3), "another edge");
        assert_eq!(ask(Use::Keep(&ahead), 1, 2), (102, 3));
        assert_eq!(ask(Use::Take(&ahead), 2, 2), (202, 4), "another state");
        assert_eq!(ask(Use::Take(&ahead), 1, 2), (102, 4));
        assert_eq!(ask(Use::Take(&ahead), 1, 2), (102, 5), "it was taken");
        assert!(ahead.has_room(1, BYTES_MAX / 2) && !ahead.has_room(2, BYTES_MAX / 2));
        ahead.make_room(BYTES_MAX);
        assert_eq!(ask(Use::Take(&ahead), 1, 3), (103, 6), "room was made");
    }
}

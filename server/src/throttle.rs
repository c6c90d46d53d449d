//! Log lines that outsiders can cause: however often they do, one a second of a kind.

use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

const PAUSE: Duration = Duration::from_secs(1);

/// A pause after each line of a kind.
#[derive(Debug, Default)]
pub(crate) struct Throttle(Mutex<Lines>);

#[derive(Debug, Default)]
struct Lines {
    written: Option<Instant>,
    held_back: u64,
}

impl Throttle {
    /// Whether a line may be written now; then how many were held back since the one before.
    pub fn may_write(&self) -> Option<u64> {
        self.may_write_at(Instant::now())
    }

    fn may_write_at(&self, now: Instant) -> Option<u64> {
        // Plain numbers: a panic elsewhere does not make them wrong.
        let mut lines = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if lines.written.is_some_and(|at| now.saturating_duration_since(at) < PAUSE) {
            lines.held_back += 1;
            return None;
        }
        lines.written = Some(now);
        Some(std::mem::take(&mut lines.held_back))
    }
}

/// What may be said, by kind.
#[derive(Debug, Default)]
pub(crate) struct Logs {
    /// A connection that never became a session.
    pub handshakes: Throttle,
    /// A session that was refused, or broke a rule.
    pub sessions: Throttle,
    /// A chunk that is there, but was not served.
    pub chunks: Throttle,
    /// The HTTP port.
    pub http: Throttle,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_brings_one_line_and_the_count_of_the_others() {
        let (throttle, start) = (Throttle::default(), Instant::now());
        let at = |ms| throttle.may_write_at(start + Duration::from_millis(ms));
        assert_eq!(
            [at(0), at(1), at(999), at(1000), at(1001)],
            [Some(0), None, None, Some(2), None]
        );
        assert_eq!([at(5000), at(9000)], [Some(1), Some(0)]);
    }
}

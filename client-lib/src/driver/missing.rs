//! Chunks that the server did not have: when to ask again.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use protocol::ChunkHash;

/// First pause before a chunk is asked for again; doubled each time it is still not there.
const PAUSE_MIN: Duration = Duration::from_secs(2);
/// Longest pause.
const PAUSE_MAX: Duration = Duration::from_secs(60);

/// What a server did not have. A store may be behind, or be mended.
#[derive(Debug, Default)]
pub struct Missing(BTreeMap<ChunkHash, Absence>);

#[derive(Debug)]
struct Absence {
    pause: Duration,
    /// `None`: it is being asked for again.
    due: Option<Instant>,
}

impl Missing {
    /// The server does not have it.
    pub fn note(&mut self, chunk: ChunkHash, now: Instant) {
        let known = self.0.get(&chunk).map(|absence| (2 * absence.pause).min(PAUSE_MAX));
        let pause = known.unwrap_or(PAUSE_MIN);
        self.0.insert(chunk, Absence { pause, due: Some(now + pause) });
    }

    /// What is to be asked for again now, each once.
    pub fn due(&mut self, now: Instant) -> Vec<ChunkHash> {
        let is_due = |absence: &Absence| absence.due.is_some_and(|due| due <= now);
        let mut found = Vec::new();
        for (chunk, absence) in self.0.iter_mut().filter(|(_, absence)| is_due(absence)) {
            absence.due = None;
            found.push(*chunk);
        }
        found
    }

    /// It is here; says whether it was missing.
    pub fn forget(&mut self, chunk: &ChunkHash) -> bool {
        self.0.remove(chunk).is_some()
    }

    /// Another version is wanted: what it needs is asked for anew.
    pub fn clear(&mut self) {
        self.0.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_double_until_the_chunk_is_there() {
        let (mut missing, start) = (Missing::default(), Instant::now());
        let chunk = ChunkHash::of(b"late");
        let mut now = start;
        let mut pauses = Vec::new();
        for _ in 0..8 {
            missing.note(chunk, now);
            let noted = now;
            while missing.due(now).is_empty() {
                now += Duration::from_millis(500);
            }
            assert!(missing.due(now).is_empty(), "asked for once");
            pauses.push((now - noted).as_secs());
        }
        assert_eq!(pauses, [2, 4, 8, 16, 32, 60, 60, 60]);
        assert!(missing.forget(&chunk) && !missing.forget(&chunk));
        missing.note(chunk, now);
        assert_eq!(missing.due(now + PAUSE_MIN), [chunk], "from the beginning");
    }
}

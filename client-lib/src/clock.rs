//! How long a call took, preemption by the system apart.

use std::time::{Duration, Instant};

/// A running measurement on the calling thread.
///
/// On Linux it counts the thread's own processor time, so that a thread that was preempted is not
/// blamed. That also leaves out waiting for locks and I/O, of which `step` has none: it only ever
/// tries a lock. Elsewhere wall time is taken, preemption included.
#[derive(Debug)]
pub struct Stopwatch {
    wall: Instant,
    processor: Option<Duration>,
}

impl Stopwatch {
    /// Starts.
    pub fn start() -> Self {
        Self { wall: Instant::now(), processor: thread_time() }
    }

    /// Whether more than `limit` went by. Reads only the wall clock where that is enough.
    pub fn exceeds(&self, limit: Duration) -> bool {
        if self.wall.elapsed() <= limit {
            return false;
        }
        match (self.processor, thread_time()) {
            (Some(start), Some(now)) => now.saturating_sub(start) > limit,
            _ => true,
        }
    }
}

#[cfg(target_os = "linux")]
fn thread_time() -> Option<Duration> {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    Some(Duration::new(time.tv_sec.try_into().ok()?, time.tv_nsec.try_into().ok()?))
}

#[cfg(not(target_os = "linux"))]
fn thread_time() -> Option<Duration> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_counts_and_on_linux_sleep_does_not() {
        let limit = Duration::from_millis(5);
        let watch = Stopwatch::start();
        assert!(!watch.exceeds(limit));
        std::thread::sleep(Duration::from_millis(20));
        assert_eq!(watch.exceeds(limit), !cfg!(target_os = "linux"));
        let mut spins = 0u64;
        let began = Instant::now();
        while !watch.exceeds(limit) {
            spins = std::hint::black_box(spins + 1);
            assert!(began.elapsed() < Duration::from_secs(30), "work is never counted");
        }
    }
}

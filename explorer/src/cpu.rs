//! CPU time of the calling thread.

use std::time::Instant;

/// CPU time of this thread where the system tells it, else time passed.
#[derive(Debug, Clone, Copy)]
pub struct CpuClock {
    started: Instant,
    cpu_ns: Option<u64>,
}

impl CpuClock {
    /// Starts counting; to be read on the same thread.
    pub fn start() -> Self {
        Self { started: Instant::now(), cpu_ns: thread_cpu_ns() }
    }

    /// Since the start (s).
    pub fn elapsed_s(&self) -> f64 {
        match (self.cpu_ns, thread_cpu_ns()) {
            (Some(before), Some(now)) => now.saturating_sub(before) as f64 * 1e-9,
            _ => self.started.elapsed().as_secs_f64(),
        }
    }
}

/// Linux tells the nanoseconds that a thread spent on a CPU in the first field of this file.
fn thread_cpu_ns() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    text.split_whitespace().next()?.parse().ok().filter(|ns| *ns > 0)
}

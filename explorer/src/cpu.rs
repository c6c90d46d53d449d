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

/// CPU time of this thread so far, or, where the system does not tell it, time since it was first
/// asked for (s): for those who take differences.
pub fn thread_cpu_s() -> f64 {
    static START: std::sync::OnceLock<Instant> = std::sync::OnceLock::new();
    match thread_cpu_ns() {
        Some(ns) => ns as f64 * 1e-9,
        None => START.get_or_init(Instant::now).elapsed().as_secs_f64(),
    }
}

/// CPU time of the whole process so far, where the system tells it (s).
pub fn process_cpu_s() -> Option<f64> {
    process_cpu_ns().map(|ns| ns as f64 * 1e-9)
}

#[cfg(unix)]
fn thread_cpu_ns() -> Option<u64> {
    nanoseconds(rustix::time::ClockId::ThreadCPUTime)
}

#[cfg(unix)]
fn process_cpu_ns() -> Option<u64> {
    nanoseconds(rustix::time::ClockId::ProcessCPUTime)
}

#[cfg(unix)]
fn nanoseconds(clock: rustix::time::ClockId) -> Option<u64> {
    let time = rustix::time::clock_gettime(clock);
    let seconds = u64::try_from(time.tv_sec).ok()?;
    Some(seconds * 1_000_000_000 + u64::try_from(time.tv_nsec).ok()?)
}

#[cfg(not(unix))]
fn thread_cpu_ns() -> Option<u64> {
    None
}

#[cfg(not(unix))]
fn process_cpu_ns() -> Option<u64> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_takes_time_and_sleep_takes_none() {
        let start = thread_cpu_s();
        let mut sum = 0.0f64;
        while thread_cpu_s() - start < 1e-3 {
            sum += sum.sin() + 1.0;
        }
        assert!(sum > 0.0);
        let before = thread_cpu_s();
        std::thread::sleep(std::time::Duration::from_millis(30));
        #[cfg(unix)]
        assert!(thread_cpu_s() - before < 0.02);
        assert!(thread_cpu_s() >= before);
    }
}

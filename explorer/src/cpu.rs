//! CPU time of the calling thread, of this process, and of programs that it started.

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

/// CPU time that a process took so far, with that of its own children that ended and were waited
/// for, where the system tells it (s): in steps of 10 ms.
pub fn program_cpu_s(id: u32) -> Option<f64> {
    #[cfg(target_os = "linux")]
    {
        // The second field is the program's name, which may hold anything; ticks are in the 14th
        // to the 17th, a hundred a second on every architecture that Rust knows.
        let text = std::fs::read_to_string(format!("/proc/{id}/stat")).ok()?;
        let rest = &text[text.rfind(')')? + 1..];
        let ticks = rest.split_whitespace().skip(11).take(4);
        let ticks: Option<Vec<u64>> = ticks.map(|field| field.parse().ok()).collect();
        ticks.filter(|four| four.len() == 4).map(|four| four.iter().sum::<u64>() as f64 / 100.0)
    }
    #[cfg(not(target_os = "linux"))]
    {
        let _ = id;
        None
    }
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

    #[cfg(target_os = "linux")]
    #[test]
    fn another_process_is_asked_by_its_number() {
        let own = |_| (program_cpu_s(std::process::id()).unwrap(), process_cpu_s().unwrap());
        let (mut sum, start) = (0.0f64, own(()));
        while own(()).1 - start.1 < 0.05 {
            sum += sum.sin() + 1.0;
        }
        let end = own(());
        let apart_s = ((end.0 - start.0) - (end.1 - start.1)).abs();
        assert!(sum > 0.0 && apart_s < 0.045, "{start:?} to {end:?}");
        assert_eq!(program_cpu_s(u32::MAX), None);
    }

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

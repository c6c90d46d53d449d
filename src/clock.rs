//! The processor's time, for costs that other processes on the machine do not blur.

/// Processor time used by the calling thread (s); where the system does not say, the time of day.
#[cfg(unix)]
pub fn thread_cpu_s() -> f64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    t.tv_sec as f64 + t.tv_nsec as f64 * 1e-9
}

/// Time since the program first asked (s).
#[cfg(not(unix))]
pub fn thread_cpu_s() -> f64 {
    static START: std::sync::OnceLock<std::time::Instant> = std::sync::OnceLock::new();
    START.get_or_init(std::time::Instant::now).elapsed().as_secs_f64()
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

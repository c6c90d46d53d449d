//! The conversation between a client and a server as two state machines, in the manner of
//! quinn-proto: `handle_*` takes what happened, `poll_*` says what to do, time is an argument.
//!
//! Whoever drives a machine (quinn in the real world, a simulated link in tests) does this after
//! every input, until all answer `None`:
//!
//! 1. `poll_transmit(now)`: write these bytes to the control stream. Do not call it again before
//!    the stream has taken them; that is how a slow line holds the machine back.
//! 2. `poll_event()`: act on it.
//! 3. `poll_timeout()`: call `handle_timeout(now)` at that time if nothing else happened before.
//!
//! `now` never goes backwards. All queues are bounded by [`limits`](crate::limits).

mod client;
mod deliveries;
mod error;
mod server;
mod wants;

pub use client::{Client, ClientConfig, ClientEvent};
pub use deliveries::Deliveries;
pub use error::SessionError;
pub use server::{Server, ServerConfig, ServerEvent};

/// Microseconds since any fixed moment.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Time(pub u64);

impl Time {
    /// This much later.
    pub fn after_us(self, microseconds: u64) -> Self {
        Self(self.0.saturating_add(microseconds))
    }
}

/// A bucket of tokens that fills at a steady rate.
#[derive(Debug, Clone)]
struct Allowance {
    per_second: u32,
    burst: u32,
    /// Tokens times a million.
    filled: u64,
    at: Time,
}

const MICRO: u64 = 1_000_000;

impl Allowance {
    fn new(per_second: u32, burst: u32) -> Self {
        Self { per_second, burst, filled: u64::from(burst) * MICRO, at: Time(0) }
    }

    fn fill(&mut self, now: Time) {
        let elapsed_us = now.0.saturating_sub(self.at.0);
        let added = elapsed_us.saturating_mul(u64::from(self.per_second));
        self.filled = self.filled.saturating_add(added).min(u64::from(self.burst) * MICRO);
        self.at = self.at.max(now);
    }

    /// Takes up to `wanted` tokens and says how many.
    fn take(&mut self, now: Time, wanted: u32) -> u32 {
        self.fill(now);
        let taken = (self.filled / MICRO).min(u64::from(wanted));
        self.filled -= taken * MICRO;
        taken as u32
    }

    /// When there will be a token.
    fn ready_at(&self) -> Time {
        let lacking = MICRO.saturating_sub(self.filled);
        self.at.after_us(lacking.div_ceil(u64::from(self.per_second)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_allowance_gives_its_burst_then_its_rate() {
        let mut allowance = Allowance::new(10, 5);
        assert_eq!(allowance.take(Time(0), 7), 5);
        assert_eq!(allowance.take(Time(0), 1), 0);
        assert_eq!(allowance.ready_at(), Time(100_000));
        assert_eq!(allowance.take(Time(99_999), 1), 0);
        assert_eq!(allowance.take(Time(100_000), 1), 1);
        assert_eq!(allowance.take(Time(u64::MAX), 100), 5);
    }
}

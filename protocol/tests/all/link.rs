//! A simulated link in virtual time: delay, jitter, loss, rate and disconnections from one seed.
//!
//! Streams keep their order and lose nothing, as QUIC's do: a lost packet comes later, and holds
//! back the rest of its own stream only. So streams overtake each other.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

use protocol::session::Time;

pub struct Random(pub u64);

impl Random {
    pub fn below(&mut self, bound: u64) -> u64 {
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % bound
    }
}

#[derive(Debug, Clone, Copy)]
pub struct Faults {
    pub delay_us: u64,
    pub jitter_us: u64,
    pub loss_percent: u64,
    pub bytes_per_second: u64,
}

/// Where bytes arrive. Stream 0 is the control stream; others are chunk streams.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum To {
    Client(u64),
    Server,
}

#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Packet {
    pub to: To,
    pub bytes: Vec<u8>,
    pub end: bool,
}

pub struct Link {
    faults: Faults,
    random: Random,
    packets: BinaryHeap<Reverse<(Time, u64, Packet)>>,
    sent: u64,
    /// When the line towards the client is free again.
    free_at: Time,
    in_order: BTreeMap<To, Time>,
}

impl Link {
    pub fn new(faults: Faults, seed: u64) -> Self {
        Self {
            faults,
            random: Random(seed),
            packets: BinaryHeap::new(),
            sent: 0,
            free_at: Time(0),
            in_order: BTreeMap::new(),
        }
    }

    pub fn send(&mut self, now: Time, to: To, bytes: &[u8], end: bool) {
        let count = bytes.chunks(1200).len();
        for (index, piece) in bytes.chunks(1200).enumerate() {
            let took_us = piece.len() as u64 * 1_000_000 / self.faults.bytes_per_second;
            self.free_at = self.free_at.max(now).after_us(took_us);
            let jitter_us = self.random.below(self.faults.jitter_us + 1);
            let mut arrival = self.free_at.after_us(self.faults.delay_us + jitter_us);
            while self.random.below(100) < self.faults.loss_percent {
                arrival = arrival.after_us(3 * self.faults.delay_us + 1000);
            }
            let before = self.in_order.entry(to).or_default();
            *before = arrival.max(*before);
            let packet = Packet { to, bytes: piece.to_vec(), end: end && index + 1 == count };
            self.packets.push(Reverse((*before, self.sent, packet)));
            self.sent += 1;
        }
    }

    pub fn next_arrival(&self) -> Option<Time> {
        self.packets.peek().map(|Reverse((time, ..))| *time)
    }

    pub fn receive(&mut self, now: Time) -> Option<Packet> {
        let due = self.next_arrival()? <= now;
        due.then(|| self.packets.pop().expect("peeked").0.2)
    }

    /// Everything under way is lost.
    pub fn cut(&mut self) {
        self.packets.clear();
        self.in_order.clear();
    }
}

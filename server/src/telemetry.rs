//! Traversals of all players together, left in the store in batches.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::AtomicU64;
use std::time::Duration;

use protocol::message::Telemetry;
use protocol::telemetry::{GarmentCounts, TelemetryBatch};
use protocol::{EdgeId, GarmentId};

use crate::shared::{Shared, lock};

type Edges = BTreeMap<GarmentId, BTreeMap<EdgeId, u64>>;

/// Traversals by player, garment and edge.
#[derive(Debug, Default)]
pub(crate) struct Counts {
    players: BTreeMap<u64, Edges>,
    /// Weighed already, but refused by the store.
    kept: Edges,
    /// Batches that the store may have under these numbers, though it did not say so.
    unsure: Vec<(u64, TelemetryBatch)>,
}

impl Counts {
    /// Adds a player's report; says how many traversals were counted, and how many were dropped
    /// because the garment does not have their edge. So memory is bounded by the number of players
    /// and the primary graphs.
    pub fn add(
        &mut self,
        player: u64,
        telemetry: &Telemetry,
        edge_count: Option<u32>,
    ) -> (u64, u64) {
        let (mut counted, mut dropped) = (0, 0);
        for &(edge, count) in &telemetry.edges {
            if edge.0 >= edge_count.unwrap_or(0) {
                dropped += u64::from(count);
                continue;
            }
            counted += u64::from(count);
            let edges = self.players.entry(player).or_default();
            *edges.entry(telemetry.garment).or_default().entry(edge).or_default() +=
                u64::from(count);
        }
        (counted, dropped)
    }

    /// All counts since the last time. A player weighs at most as much as the median player: one
    /// who reports more counts in proportion, so that nobody steers the exploration alone.
    fn take(&mut self) -> Option<TelemetryBatch> {
        let players = std::mem::take(&mut self.players);
        let total = |edges: &Edges| edges.values().flat_map(BTreeMap::values).sum::<u64>();
        let mut totals: Vec<u64> = players.values().map(total).collect();
        totals.sort_unstable();
        let median = totals.get(totals.len().saturating_sub(1) / 2).copied().unwrap_or(0);
        let mut taken = std::mem::take(&mut self.kept);
        for edges in players.values() {
            let own = total(edges).max(1);
            for (garment, counts) in edges {
                let sums = taken.entry(*garment).or_default();
                for (edge, count) in counts {
                    // Both factors are at most a player's counts of one interval: u128 holds them.
                    let weighed =
                        u128::from(*count) * u128::from(median.min(own)) / u128::from(own);
                    if weighed > 0 {
                        *sums.entry(*edge).or_default() += weighed as u64;
                    }
                }
            }
        }
        let garments = taken.into_iter().filter(|(_, edges)| !edges.is_empty());
        let garments = garments.map(|(garment, edges)| {
            let edges = edges.into_iter().collect();
            GarmentCounts { garment, edges }
        });
        let garments: Vec<_> = garments.collect();
        (!garments.is_empty()).then_some(TelemetryBatch { garments })
    }

    fn put_back(&mut self, batch: TelemetryBatch) {
        for counts in batch.garments {
            let edges = self.kept.entry(counts.garment).or_default();
            for (edge, count) in counts.edges {
                *edges.entry(edge).or_default() += count;
            }
        }
    }
}

/// Writes a batch every `interval`, until the end.
pub(crate) async fn keep_writing(shared: &Shared, interval: Duration) {
    let mut stop = shared.stop.subscribe();
    loop {
        tokio::select! {
            _ = stop.wait_for(|stop| *stop) => break,
            () = tokio::time::sleep(interval) => {}
        }
        write(shared).await;
    }
}

/// Writes what was counted, if anything, under the next free number. What the store refuses, or does
/// not take before this is dropped, is kept for the next time. A batch that the store may have taken
/// without saying so is first put under the same number again, so that it counts once.
pub(crate) async fn write(shared: &Shared) {
    let failed = |error| {
        tracing::warn!(%error, "telemetry is kept for later");
        shared.metrics.store_failures.inc();
    };
    loop {
        let Some((number, batch)) = lock(&shared.counts).unsure.pop() else { break };
        let bytes = batch.encode();
        let mut taken = Taken::new(&shared.counts, batch, number);
        match shared.source.settle_telemetry(number, &bytes).await {
            Ok(true) => taken.batch = None,
            // Another server has the number: the store never took it from this one.
            Ok(false) => taken.tried = AtomicU64::new(0),
            Err(error) => return failed(error),
        }
    }
    let Some(batch) = lock(&shared.counts).take() else { return };
    let bytes = batch.encode();
    let mut taken = Taken::new(&shared.counts, batch, 0);
    match shared.source.add_telemetry(&bytes, &taken.tried).await {
        Ok(Some(_)) => taken.batch = None,
        Ok(None) => tracing::warn!("telemetry is kept for later: others took every number tried"),
        Err(error) => failed(error),
    }
}

/// A batch that goes back where it came from unless it was written.
struct Taken<'a> {
    counts: &'a Mutex<Counts>,
    batch: Option<TelemetryBatch>,
    /// The number under which the store may have it; 0 for none.
    tried: AtomicU64,
}

impl<'a> Taken<'a> {
    fn new(counts: &'a Mutex<Counts>, batch: TelemetryBatch, tried: u64) -> Self {
        Self { counts, batch: Some(batch), tried: AtomicU64::new(tried) }
    }
}

impl Drop for Taken<'_> {
    fn drop(&mut self) {
        let Some(batch) = self.batch.take() else { return };
        match *self.tried.get_mut() {
            0 => lock(self.counts).put_back(batch),
            number => lock(self.counts).unsure.push((number, batch)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(edges: &[(u32, u32)]) -> Telemetry {
        let edges = edges.iter().map(|(edge, count)| (EdgeId(*edge), *count)).collect();
        let garment = GarmentId(0);
        let version = protocol::VersionNumber(1);
        Telemetry { garment, version, edges, exact: 0, substituted: 0, missed: 0, jumps: 0 }
    }

    #[test]
    fn one_player_weighs_no_more_than_the_median() {
        let mut counts = Counts::default();
        for player in 0..4 {
            assert_eq!(counts.add(player, &report(&[(0, 200), (1, 100)]), Some(9)), (300, 0));
        }
        counts.add(9, &report(&[(5, 4_000_000_000), (6, 400_000_000)]), Some(9));
        counts.add(9, &report(&[(70, 3)]), Some(9));
        let batch = counts.take().unwrap();
        let edges = |batch: &TelemetryBatch| batch.garments[0].edges.clone();
        let expected = [(0, 800), (1, 400), (5, 272), (6, 27)];
        assert_eq!(edges(&batch), expected.map(|(edge, count)| (EdgeId(edge), count)));
        // What the store refused is weighed once only.
        counts.put_back(batch.clone());
        assert_eq!(counts.take(), Some(batch));
        assert_eq!(counts.take(), None);
        // A player alone counts in full.
        counts.add(3, &report(&[(2, 7)]), Some(9));
        assert_eq!(edges(&counts.take().unwrap()), [(EdgeId(2), 7)]);
    }

    #[test]
    fn what_was_taken_goes_back_unless_it_was_written() {
        let counts = Mutex::new(Counts::default());
        lock(&counts).add(1, &report(&[(0, 7)]), Some(9));
        for _ in 0..3 {
            let batch = lock(&counts).take();
            assert_eq!(batch.as_ref().unwrap().garments[0].edges, [(EdgeId(0), 7)]);
            drop(Taken::new(&counts, batch.unwrap(), 0));
        }
        // What the store may have is kept apart: it is not counted again with what comes next.
        let batch = lock(&counts).take().unwrap();
        drop(Taken::new(&counts, batch.clone(), 4));
        assert_eq!(lock(&counts).take(), None);
        assert_eq!(lock(&counts).unsure.pop(), Some((4, batch.clone())));
        let mut taken = Taken::new(&counts, batch, 0);
        taken.batch = None;
        drop(taken);
        assert!(lock(&counts).take().is_none() && lock(&counts).unsure.is_empty());
    }
}

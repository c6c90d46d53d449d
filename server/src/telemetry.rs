//! Traversals of all players together, left in the store in batches.

use std::collections::BTreeMap;
use std::time::Duration;

use protocol::message::Telemetry;
use protocol::telemetry::{GarmentCounts, TelemetryBatch};
use protocol::{EdgeId, GarmentId};

use crate::shared::{Shared, lock};

/// Traversals by garment and edge.
#[derive(Debug, Default)]
pub(crate) struct Counts(BTreeMap<GarmentId, BTreeMap<EdgeId, u64>>);

impl Counts {
    /// Adds a report; says how many traversals were counted, and how many were dropped because the
    /// garment does not have their edge. So memory is bounded by the primary graphs.
    pub fn add(&mut self, telemetry: &Telemetry, edge_count: Option<u32>) -> (u64, u64) {
        let (mut counted, mut dropped) = (0, 0);
        for &(edge, count) in &telemetry.edges {
            if edge.0 >= edge_count.unwrap_or(0) {
                dropped += u64::from(count);
                continue;
            }
            counted += u64::from(count);
            let edges = self.0.entry(telemetry.garment).or_default();
            *edges.entry(edge).or_default() += u64::from(count);
        }
        (counted, dropped)
    }

    fn take(&mut self) -> Option<TelemetryBatch> {
        let taken = std::mem::take(&mut self.0);
        let garments = taken.into_iter().map(|(garment, edges)| {
            let edges = edges.into_iter().collect();
            GarmentCounts { garment, edges }
        });
        let garments: Vec<_> = garments.collect();
        (!garments.is_empty()).then_some(TelemetryBatch { garments })
    }

    fn put_back(&mut self, batch: TelemetryBatch) {
        for counts in batch.garments {
            let edges = self.0.entry(counts.garment).or_default();
            for (edge, count) in counts.edges {
                *edges.entry(edge).or_default() += count;
            }
        }
    }
}

/// Writes a batch every `interval`, until the end.
pub(crate) async fn keep_writing(shared: &Shared, interval: Duration) {
    let mut stop = shared.stop.subscribe();
    let mut number = 0;
    loop {
        tokio::select! {
            _ = stop.wait_for(|stop| *stop) => break,
            () = tokio::time::sleep(interval) => {}
        }
        write(shared, &mut number).await;
    }
}

/// Writes what was counted, if anything, under the next free number. What the store refuses is
/// kept for the next time.
pub(crate) async fn write(shared: &Shared, number: &mut u64) {
    let Some(batch) = lock(&shared.counts).take() else { return };
    let bytes = batch.encode();
    loop {
        if *number == 0 {
            match shared.source.newest_telemetry().await {
                Ok(newest) => *number = newest + 1,
                Err(error) => return keep(shared, batch, &error),
            }
        }
        match shared.source.create_telemetry(*number, bytes.clone()).await {
            Ok(true) => {
                *number += 1;
                return;
            }
            // Another server of this store was faster.
            Ok(false) => *number = 0,
            Err(error) => return keep(shared, batch, &error),
        }
    }
}

fn keep(shared: &Shared, batch: TelemetryBatch, error: &crate::store::ReadError) {
    tracing::warn!(%error, "telemetry is kept for later");
    shared.metrics.store_failures.inc();
    lock(&shared.counts).put_back(batch);
}

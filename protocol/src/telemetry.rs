//! What players walked, as servers leave it in the store for the explorer: counts only.

use serde::{Deserialize, Serialize};

use crate::ids::{EdgeId, GarmentId};
use crate::limits;
use crate::wire::{DecodeError, Format, at_most, ensure};

const BATCH: Format = Format {
    what: "telemetry batch",
    magic: *b"TTEL",
    version: 1,
    bytes_max: limits::CHUNK_BYTES_MAX,
};

/// Traversals that one server counted since its batch before.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TelemetryBatch {
    /// By garment, sorted.
    pub garments: Vec<GarmentCounts>,
}

/// Traversals of one garment's primary edges.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct GarmentCounts {
    /// The garment.
    pub garment: GarmentId,
    /// How often each edge was walked; sorted by edge, edges that nobody walked left out.
    pub edges: Vec<(EdgeId, u64)>,
}

impl TelemetryBatch {
    /// Bytes to store at `store::telemetry_path(number)`.
    ///
    /// # Panics
    /// If [`TelemetryBatch::check`] fails.
    pub fn encode(&self) -> Vec<u8> {
        self.check().expect("a telemetry batch is checked before it is written");
        BATCH.encode(self)
    }

    /// Reads and checks.
    ///
    /// # Errors
    /// Damaged bytes, or a batch that breaks a rule of [`TelemetryBatch::check`].
    pub fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
        let batch: Self = BATCH.decode(bytes)?;
        batch.check()?;
        Ok(batch)
    }

    /// Garments and edges sorted, in range, once each.
    ///
    /// # Errors
    /// The first rule that is broken, with its place.
    pub fn check(&self) -> Result<(), DecodeError> {
        self.check_counts().map_err(|why| BATCH.invalid(why))
    }

    fn check_counts(&self) -> Result<(), String> {
        at_most("garments", self.garments.len(), limits::GARMENTS_MAX)?;
        let sorted = self.garments.is_sorted_by(|a, b| a.garment < b.garment);
        ensure(sorted, || "garments are out of order".into())?;
        for counts in &self.garments {
            at_most("edges", counts.edges.len(), limits::EDGES_MAX)?;
            let in_range = counts.edges.last().is_none_or(|e| e.0.index() < limits::EDGES_MAX);
            ensure(counts.edges.is_sorted_by(|a, b| a.0 < b.0) && in_range, || {
                format!("edges of garment {} are out of order or range", counts.garment)
            })?;
        }
        Ok(())
    }
}

//! What a server tells about itself: `/status`, and [`Server::stats`](crate::Server::stats).

use std::collections::BTreeMap;

use protocol::manifest::GarmentVersion;
use serde::Serialize;

use crate::shared::mm;

/// A server at one moment. Counts are since its start.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Stats {
    /// Number of the head version; 0 while there is none.
    pub version: u64,
    /// The publisher's key in hexadecimal, once known.
    pub publisher: Option<String>,
    /// SHA-256 of the server's certificate in hexadecimal.
    pub fingerprint: String,
    /// Seconds since its start.
    pub uptime_s: f64,
    /// Players connected and let in.
    pub players: u64,
    /// How many of them play each version.
    pub applied: BTreeMap<u64, u64>,
    /// Payload bytes sent over QUIC.
    pub bytes_sent: u64,
    /// Chunks sent over QUIC.
    pub chunks_sent: u64,
    /// Outcomes of all steps that players have reported.
    pub outcomes: Outcomes,
    /// Traversals counted.
    pub traversals: u64,
    /// Traversals dropped, above the cap of one client or out of range.
    pub traversals_dropped: u64,
    /// Datagrams that are not QUIC.
    pub stray_datagrams: u64,
    /// QUIC or TLS handshakes that failed.
    pub failed_handshakes: u64,
    /// Clients refused for their token.
    pub refused_tokens: u64,
    /// Sessions ended for breaking a rule.
    pub broken_sessions: u64,
    /// Connections above the limit.
    pub refused_connections: u64,
    /// Chunks asked for that the store lacks.
    pub chunks_missing: u64,
    /// Chunks not served, as they are damaged in the store.
    pub chunks_corrupted: u64,
    /// Versions not served, as they are damaged or forged.
    pub bad_manifests: u64,
    /// Failed accesses to the store.
    pub store_failures: u64,
    /// The garments of the head.
    pub garments: Vec<GarmentStats>,
    /// Versions seen since the start, at most the newest 2,000.
    pub history: Vec<VersionPoint>,
}

/// What became of the steps that players have reported (design decision 11).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Outcomes {
    /// Showed what the links name.
    pub exact: u64,
    /// Showed another state of the same pose.
    pub substituted: u64,
    /// Showed nothing.
    pub missed: u64,
    /// Went to a pose that is no successor.
    pub jumps: u64,
}

/// A garment of the head.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct GarmentStats {
    /// Its name.
    pub name: String,
    /// Poses of its primary graph.
    pub poses: u32,
    /// Edges of its primary graph.
    pub edges: u32,
    /// States of its secondary graph.
    pub states: u64,
    /// Dead ends, each merged.
    pub merges: u64,
    /// Frames simulated so far.
    pub simulated_frames: u64,
    /// Largest merge error (mm).
    pub worst_error_mm: f64,
    /// Mean merge error (mm).
    pub mean_error_mm: f64,
    /// Largest vertex error of the encoded states (mm).
    pub codec_max_error_mm: f64,
}

/// One version in the history.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct VersionPoint {
    /// Its number.
    pub version: u64,
    /// States of all garments.
    pub states: u64,
    /// Largest merge error of any garment (mm).
    pub worst_error_mm: f64,
}

impl GarmentStats {
    pub(crate) fn new(garment: &GarmentVersion) -> Self {
        let stats = &garment.stats;
        Self {
            name: garment.name.clone(),
            poses: stats.poses,
            edges: stats.edges,
            states: stats.states,
            merges: stats.merges,
            simulated_frames: stats.simulated_frames,
            worst_error_mm: mm(stats.worst_error_m),
            mean_error_mm: mm(stats.mean_error_m),
            codec_max_error_mm: mm(stats.codec_max_error_m),
        }
    }
}

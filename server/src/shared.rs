//! What all tasks of a server share.

use std::collections::{BTreeMap, HashSet};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use bytes::Bytes;
use protocol::session::{Deliveries, Time};
use protocol::{ChunkHash, GarmentId, PublisherKey, SignedManifest, StateId, VersionNumber};
use std::sync::Arc;
use tokio::sync::{Notify, Semaphore, watch};

use crate::metrics::Metrics;
use crate::stats::{GarmentStats, Outcomes, Stats, VersionPoint};
use crate::store::{ReadError, Source};
use crate::telemetry::Counts;
use crate::throttle::Logs;

/// Versions that the live page plots.
const HISTORY_MAX: usize = 2000;
/// Chunks that no known version lists and that are looked up at the same time.
pub(crate) const UNLISTED_MAX: usize = 8;
/// How long one of these that is not there keeps its place: with [`UNLISTED_MAX`], the store is asked for
/// at most 160 names a second that it does not have.
const UNLISTED_PAUSE: Duration = Duration::from_millis(50);

#[derive(Debug)]
pub(crate) struct Shared {
    pub token: Option<String>,
    pub tag_token: Option<String>,
    pub players_max: usize,
    pub fingerprint: String,
    pub started: Instant,
    pub source: Source,
    pub metrics: Metrics,
    pub head: watch::Sender<Head>,
    pub stop: watch::Sender<bool>,
    /// Look for a new version now.
    pub look: Notify,
    pub counts: Mutex<Counts>,
    pub players: Mutex<BTreeMap<u64, Option<VersionNumber>>>,
    pub history: Mutex<Vec<VersionPoint>>,
    pub deliveries: Arc<Deliveries>,
    pub logs: Logs,
    /// Places for looking up what no known version lists.
    pub unlisted: Semaphore,
    /// Why the last look for new versions failed.
    pub failing: Mutex<Option<String>>,
}

/// What is served.
#[derive(Debug, Clone, Default)]
pub(crate) struct Head {
    pub publisher: Option<PublisherKey>,
    pub signed: Option<Arc<SignedManifest>>,
    /// All chunks that it lists.
    pub listed: Arc<HashSet<ChunkHash>>,
}

impl Shared {
    pub fn now(&self) -> Time {
        Time(self.started.elapsed().as_micros() as u64)
    }

    /// A new head for everybody.
    pub fn publish(&self, signed: Arc<SignedManifest>) {
        let manifest = &signed.manifest;
        let number = manifest.number;
        self.metrics.version.set(number.0 as i64);
        let mut history = lock(&self.history);
        if history.len() >= HISTORY_MAX {
            history.remove(0);
        }
        let worst_m = manifest.garments.iter().map(|g| g.stats.worst_error_m).fold(0.0, f32::max);
        history.push(VersionPoint {
            version: number.0,
            states: manifest.garments.iter().map(|garment| garment.stats.states).sum(),
            worst_error_mm: mm(worst_m),
        });
        drop(history);
        tracing::info!(version = number.0, "a new head");
        let listed = Arc::new(listed(&signed));
        self.head.send_modify(|head| {
            head.signed = Some(signed);
            head.listed = listed;
        });
    }

    /// A chunk, verified. Anybody may ask for any hash: what neither the head nor a version that
    /// somebody wanted lately lists may still be of an old one, and is looked up, but few at a time.
    pub async fn chunk(&self, hash: &ChunkHash) -> Result<Bytes, ReadError> {
        if let Some(bytes) = self.source.cached(hash) {
            return Ok(bytes);
        }
        if self.head.borrow().listed.contains(hash) || self.source.lists(hash) {
            return self.source.chunk(hash).await;
        }
        // Never closed; without a place it would be read all the same.
        let _place = self.unlisted.acquire().await;
        let read = self.source.chunk(hash).await;
        if read.is_err() {
            tokio::time::sleep(UNLISTED_PAUSE).await;
        }
        read
    }

    /// Why no player could play now.
    pub fn lacks(&self) -> Option<String> {
        if *self.stop.borrow() {
            return Some("the server is going down".into());
        }
        if let Some(why) = &*lock(&self.failing) {
            return Some(format!("the store cannot be read: {why}"));
        }
        let head = self.head.borrow();
        head.signed.is_none().then(|| "the store has no version to serve".into())
    }

    /// Edges of a garment's primary graph in the head, if it is there.
    pub fn edge_count(&self, garment: GarmentId) -> Option<u32> {
        let head = self.head.borrow();
        let garments = &head.signed.as_ref()?.manifest.garments;
        garments.iter().find(|known| known.id == garment).map(|known| known.stats.edges)
    }

    /// Whether the head has a garment with such a state, and the head's number.
    pub fn has_state(&self, garment: GarmentId, state: StateId) -> Option<VersionNumber> {
        let head = self.head.borrow();
        let manifest = &head.signed.as_ref()?.manifest;
        let found = manifest.garments.iter().find(|known| known.id == garment)?;
        (state.0 < found.stats.states).then_some(manifest.number)
    }

    pub fn stats(&self) -> Stats {
        let head = self.head.borrow().clone();
        let mut applied = BTreeMap::new();
        let players = lock(&self.players);
        for version in players.values().flatten() {
            *applied.entry(version.0).or_insert(0u64) += 1;
        }
        let metrics = &self.metrics;
        let garments = head.signed.iter().flat_map(|signed| &signed.manifest.garments);
        Stats {
            version: head.signed.as_ref().map_or(0, |signed| signed.manifest.number.0),
            publisher: head.publisher.map(|key| key.to_string()),
            fingerprint: self.fingerprint.clone(),
            uptime_s: self.started.elapsed().as_secs_f64(),
            players: players.len() as u64,
            applied,
            bytes_sent: metrics.bytes_sent.get(),
            chunks_sent: metrics.chunks_sent.get(),
            outcomes: Outcomes {
                exact: metrics.exact.get(),
                substituted: metrics.substituted.get(),
                missed: metrics.missed.get(),
                jumps: metrics.jumps.get(),
            },
            traversals: metrics.traversals.get(),
            traversals_dropped: metrics.traversals_dropped.get(),
            stray_datagrams: metrics.stray_datagrams.get(),
            failed_handshakes: metrics.failed_handshakes.get(),
            refused_tokens: metrics.refused_tokens.get(),
            broken_sessions: metrics.broken_sessions.get(),
            refused_connections: metrics.refused_connections.get(),
            chunks_missing: metrics.chunks_missing.get(),
            chunks_corrupted: metrics.chunks_corrupted.get(),
            bad_manifests: metrics.bad_manifests.get(),
            store_failures: metrics.store_failures.get(),
            garments: garments.map(GarmentStats::new).collect(),
            history: lock(&self.history).clone(),
        }
    }
}

/// All chunks of a version.
pub(crate) fn listed(signed: &SignedManifest) -> HashSet<ChunkHash> {
    let garments = signed.manifest.garments.iter();
    garments.flat_map(|garment| garment.chunks()).map(|chunk| chunk.hash).collect()
}

/// A panic of another task while it held the lock leaves plain numbers behind: go on with them.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Errors are printed in millimetres.
pub(crate) fn mm(metres: f32) -> f64 {
    f64::from(metres) * 1000.0
}

//! Everything that is counted, for `/metrics` and for [`Stats`](crate::Stats).

use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::{Registry, Unit};

/// Counters, shared by all tasks.
#[derive(Debug, Clone, Default)]
pub(crate) struct Metrics {
    pub bytes_sent: Counter,
    pub chunks_sent: Counter,
    pub chunks_missing: Counter,
    pub chunks_corrupted: Counter,
    pub store_failures: Counter,
    pub bad_manifests: Counter,
    pub stray_datagrams: Counter,
    pub failed_handshakes: Counter,
    pub refused_tokens: Counter,
    pub broken_sessions: Counter,
    pub refused_connections: Counter,
    pub exact: Counter,
    pub substituted: Counter,
    pub outside: Counter,
    pub missed: Counter,
    pub jumps: Counter,
    pub traversals: Counter,
    pub traversals_dropped: Counter,
    pub version: Gauge,
    pub players: Gauge,
}

impl Metrics {
    /// In the text format that Prometheus reads.
    pub fn text(&self) -> String {
        let mut registry = Registry::with_prefix("toile");
        let bytes_sent = self.bytes_sent.clone();
        registry.register_with_unit("sent", "Payload sent to players", Unit::Bytes, bytes_sent);
        let counters = [
            ("chunks_sent", "Chunks sent whole", &self.chunks_sent),
            ("chunks_missing", "Chunks asked for that the store lacks", &self.chunks_missing),
            ("chunks_corrupted", "Chunks not served: damaged in the store", &self.chunks_corrupted),
            ("store_failures", "Failed accesses to the store", &self.store_failures),
            ("bad_manifests", "Versions not served: damaged or forged", &self.bad_manifests),
            ("stray_datagrams", "Datagrams that are not QUIC", &self.stray_datagrams),
            ("failed_handshakes", "QUIC or TLS handshakes failed", &self.failed_handshakes),
            ("refused_tokens", "Clients with a wrong token", &self.refused_tokens),
            ("broken_sessions", "Sessions ended for breaking a rule", &self.broken_sessions),
            ("refused_connections", "Connections above the limit", &self.refused_connections),
            ("steps_exact", "Reported steps that were exact", &self.exact),
            ("steps_substituted", "Reported steps with a substitute", &self.substituted),
            ("steps_outside", "Of these, outside the graph", &self.outside),
            ("steps_missed", "Reported steps without a state", &self.missed),
            ("jumps", "Reported jumps", &self.jumps),
            ("traversals", "Reported traversals of edges, counted", &self.traversals),
            ("traversals_dropped", "Traversals above a client's cap", &self.traversals_dropped),
        ];
        for (name, help, counter) in counters {
            registry.register(name, help, counter.clone());
        }
        registry.register("version", "Head version, 0 for none", self.version.clone());
        registry.register("players", "Players connected", self.players.clone());
        let mut text = String::new();
        prometheus_client::encoding::text::encode(&mut text, &registry)
            .expect("writing to a string does not fail");
        text
    }
}

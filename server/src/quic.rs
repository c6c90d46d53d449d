//! The QUIC endpoint: who may connect, and how much of the machine one connection may take.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Weak};
use std::time::Duration;

use prometheus_client::metrics::counter::Counter;
use protocol::limits;
use protocol::message::ALPN;
use quinn::crypto::rustls::QuicServerConfig;
use quinn::{Endpoint, EndpointConfig, Incoming, Runtime, TokioRuntime, TransportConfig, VarInt};
use tokio::task::JoinSet;

use crate::identity::Identity;
use crate::session;
use crate::shared::Shared;
use crate::socket::CountingSocket;

/// A connection that says nothing for so long is dropped; keep-alives are sent twice in that time.
const IDLE: Duration = Duration::from_secs(15);
const KEEP_ALIVE: Duration = Duration::from_secs(6);
/// Unsent bytes that one connection may hold.
const SEND_WINDOW_BYTES: u64 = 8 << 20;
/// Connections above the limit that are still told why.
const TOLD_WHY_MAX: usize = 64;

/// Handshakes under way from which on a client must show that it can be reached where it says it is:
/// whoever sends from addresses of others gets no further than these.
const TRUSTED_HANDSHAKES_MAX: usize = 64;
/// Handshakes under way, whoever they are with.
const HANDSHAKES_MAX: usize = 1024;

/// Opens the port; the second tells by its end that the port is free again.
pub(crate) fn open(
    listen: SocketAddr,
    identity: &Identity,
    stray: Counter,
) -> std::io::Result<(Endpoint, Weak<CountingSocket>)> {
    let config = Some(server_config(identity).map_err(std::io::Error::other)?);
    let runtime = Arc::new(TokioRuntime);
    let inner = runtime.wrap_udp_socket(std::net::UdpSocket::bind(listen)?)?;
    let socket = Arc::new(CountingSocket { inner, stray });
    let watched = Arc::downgrade(&socket);
    let mut limits = EndpointConfig::default();
    // A peer may clear the fixed bit only where we allow it (RFC 9287). We do not, so that a
    // datagram without it is known to be stray.
    limits.grease_quic_bit(false);
    Ok((Endpoint::new_with_abstract_socket(limits, config, socket, runtime)?, watched))
}

/// Takes connections until the end; every session ends before this returns.
pub(crate) async fn accept(shared: Arc<Shared>, endpoint: Endpoint) {
    let mut stop = shared.stop.subscribe();
    let mut sessions = JoinSet::new();
    let handshakes = Arc::new(AtomicUsize::new(0));
    loop {
        tokio::select! {
            _ = stop.wait_for(|stop| *stop) => break,
            Some(_) = sessions.join_next(), if !sessions.is_empty() => {}
            incoming = endpoint.accept() => {
                let Some(incoming) = incoming else { break };
                let unfinished = handshakes.load(Ordering::Relaxed);
                let connected = sessions.len().saturating_sub(unfinished);
                if connected >= shared.players_max + TOLD_WHY_MAX || unfinished >= HANDSHAKES_MAX {
                    shared.metrics.refused_connections.inc();
                    incoming.refuse();
                } else if unfinished >= TRUSTED_HANDSHAKES_MAX
                    && !incoming.remote_address_validated()
                {
                    // Costs an honest client a round trip, and us nothing. It fails only for those
                    // who were asked already.
                    let _ = incoming.retry();
                } else {
                    let handshake = Counted::new(&handshakes);
                    sessions.spawn(connect(shared.clone(), incoming, handshake));
                }
            }
        }
    }
    while sessions.join_next().await.is_some() {}
}

/// Counted as long as it lives.
struct Counted(Arc<AtomicUsize>);

impl Counted {
    fn new(count: &Arc<AtomicUsize>) -> Self {
        count.fetch_add(1, Ordering::Relaxed);
        Self(count.clone())
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

async fn connect(shared: Arc<Shared>, incoming: Incoming, unfinished: Counted) {
    let from = incoming.remote_address();
    let handshake = async { incoming.accept()?.await };
    let limit = Duration::from_micros(limits::HANDSHAKE_US_MAX);
    let connected = tokio::time::timeout(limit, handshake).await;
    drop(unfinished);
    let why = match connected {
        Ok(Ok(connection)) => return session::serve(shared, connection).await,
        Ok(Err(error)) => error.to_string(),
        Err(_) => "it took too long".into(),
    };
    shared.metrics.failed_handshakes.inc();
    if let Some(more) = shared.logs.handshakes.may_write() {
        tracing::warn!(%from, more, "handshake failed: {why}");
    }
}

fn server_config(
    identity: &Identity,
) -> Result<quinn::ServerConfig, Box<dyn std::error::Error + Send + Sync>> {
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let certified = rustls::sign::SingleCertAndKey::from(identity.certified.clone());
    let mut tls = rustls::ServerConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])?
        .with_no_client_auth()
        .with_cert_resolver(Arc::new(certified));
    tls.alpn_protocols = vec![ALPN.to_vec()];
    let mut config = quinn::ServerConfig::with_crypto(Arc::new(QuicServerConfig::try_from(tls)?));
    let mut transport = TransportConfig::default();
    transport
        .max_concurrent_bidi_streams(VarInt::from_u32(1))
        .max_concurrent_uni_streams(VarInt::from_u32(0))
        .max_idle_timeout(Some(IDLE.try_into()?))
        .keep_alive_interval(Some(KEEP_ALIVE))
        .stream_receive_window(VarInt::from_u32(4 * limits::MESSAGE_BYTES_MAX as u32))
        .receive_window(VarInt::from_u32(4 * limits::MESSAGE_BYTES_MAX as u32))
        .send_window(SEND_WINDOW_BYTES)
        .datagram_receive_buffer_size(None);
    config.transport_config(Arc::new(transport));
    Ok(config)
}

//! The QUIC endpoint: who may connect, and how much of the machine one connection may take.

use std::net::SocketAddr;
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
    loop {
        tokio::select! {
            _ = stop.wait_for(|stop| *stop) => break,
            Some(_) = sessions.join_next(), if !sessions.is_empty() => {}
            incoming = endpoint.accept() => {
                let Some(incoming) = incoming else { break };
                if sessions.len() >= shared.players_max + TOLD_WHY_MAX {
                    shared.metrics.refused_connections.inc();
                    incoming.refuse();
                    continue;
                }
                sessions.spawn(connect(shared.clone(), incoming));
            }
        }
    }
    while sessions.join_next().await.is_some() {}
}

async fn connect(shared: Arc<Shared>, incoming: Incoming) {
    let from = incoming.remote_address();
    let handshake = async { incoming.accept()?.await };
    let limit = Duration::from_micros(limits::HANDSHAKE_US_MAX);
    match tokio::time::timeout(limit, handshake).await {
        Ok(Ok(connection)) => session::serve(shared, connection).await,
        Ok(Err(error)) => {
            shared.metrics.failed_handshakes.inc();
            tracing::warn!(%from, %error, "handshake failed");
        }
        Err(_) => {
            shared.metrics.failed_handshakes.inc();
            tracing::warn!(%from, "handshake took too long");
        }
    }
}

fn server_config(
    identity: &Identity,
) -> Result<quinn::ServerConfig, Box<dyn std::error::Error + Send + Sync>> {
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let mut tls = rustls::ServerConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])?
        .with_no_client_auth()
        .with_single_cert(vec![identity.certificate.clone()], identity.key.clone_key())?;
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

//! Sockets: dials, reads and writes in small tasks, and tells the driver what happened.

use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use protocol::limits;
use protocol::message::ALPN;
use quinn::crypto::rustls::QuicClientConfig;
use quinn::{Connection, ConnectionError, Endpoint, RecvStream, SendStream, VarInt};
use tokio::sync::mpsc;

use super::tls::{Fingerprint, Pin};

/// Bytes read from a stream at once.
const READ_BYTES: usize = 64 << 10;
/// A line that says nothing for this long is lost. Default 10 s: longer than a phone's handover.
const IDLE: Duration = Duration::from_secs(10);
/// How often an idle line is kept alive.
const KEEP_ALIVE: Duration = Duration::from_secs(3);
/// How long one of several addresses of a server may take to answer.
const ATTEMPT: Duration = Duration::from_secs(3);
/// Name in the TLS handshake; servers are known by their fingerprint, not by it.
const SERVER_NAME: &str = "toile";

/// Something that happened on a connection.
#[derive(Debug)]
pub struct Input {
    /// Which connection.
    pub epoch: u64,
    /// What.
    pub what: Happened,
}

/// What happened.
#[derive(Debug)]
pub enum Happened {
    /// The connection stands, its control stream is open.
    Connected(Link),
    /// It could not be made, or is gone.
    Lost {
        /// Code and text of the server's close, if it closed.
        close: Option<(u64, String)>,
        /// For people.
        why: String,
    },
    /// Bytes of the control stream.
    Control(bytes::Bytes),
    /// Bytes of a chunk stream.
    Chunk {
        /// Which stream.
        stream: u64,
        /// The bytes.
        bytes: bytes::Bytes,
        /// Whether the stream ends here.
        end: bool,
    },
    /// A chunk stream was cut.
    ChunkReset {
        /// Which stream.
        stream: u64,
    },
    /// The control stream has taken what was sent, and takes more.
    Written,
}

/// Makes connections.
pub struct Dialer {
    address: String,
    pin: Arc<Pin>,
    config: Result<quinn::ClientConfig, String>,
    inputs: mpsc::Sender<Input>,
    endpoints: Endpoints,
    failures: Arc<AtomicUsize>,
}

impl Dialer {
    /// `pin`: the certificate to insist on.
    pub fn new(address: String, pin: Option<Fingerprint>, inputs: mpsc::Sender<Input>) -> Self {
        let (pin, config) = client_config(pin);
        let (endpoints, failures) = (Endpoints::default(), Arc::default());
        Self { address, pin, config, inputs, endpoints, failures }
    }

    /// The sentence for people, if the server showed another certificate than the pinned one.
    pub fn mismatch(&self) -> Option<String> {
        self.pin.mismatch()
    }

    /// Starts a connection; what comes of it arrives as inputs of this epoch.
    pub fn dial(&self, epoch: u64) {
        let name = self.address.clone();
        self.dial_any(epoch, async move {
            let found = tokio::net::lookup_host(&name).await;
            let found: Vec<SocketAddr> = found
                .map_err(|e| format!("\"{name}\" is no address ({e}); write host:port"))?
                .collect();
            if found.is_empty() {
                Err(format!("\"{name}\" leads to no address"))
            } else {
                Ok(found)
            }
        });
    }

    /// Dials one of the addresses that are found: after each failure the next.
    fn dial_any(
        &self,
        epoch: u64,
        addresses: impl Future<Output = Result<Vec<SocketAddr>, String>> + Send + 'static,
    ) {
        let inputs = Inputs { epoch, sender: self.inputs.clone() };
        let (config, endpoints) = (self.config.clone(), self.endpoints.clone());
        let failures = Arc::clone(&self.failures);
        tokio::spawn(async move {
            let connected = async {
                let (config, addresses) =
                    (config.map_err(lost_for)?, addresses.await.map_err(lost_for)?);
                let turn = failures.load(Ordering::Relaxed) % addresses.len();
                let connecting = endpoints.connect(config, addresses[turn]).map_err(lost_for)?;
                // Where there is another way, nobody waits long for one that leads nowhere.
                let limit = if addresses.len() > 1 { ATTEMPT } else { Duration::MAX };
                let connected = tokio::time::timeout(limit, connecting).await;
                let silent = |_| lost_for(format!("{} does not answer", addresses[turn]));
                let connection = connected.map_err(silent)?.map_err(|error| lost(&error))?;
                let control = connection.open_bi().await.map_err(|error| lost(&error))?;
                Ok((connection, control))
            };
            match connected.await {
                Ok((connection, control)) => converse(connection, control, inputs).await,
                Err(lost) => {
                    failures.fetch_add(1, Ordering::Relaxed);
                    inputs.send(lost).await;
                }
            }
        });
    }

    /// Lets the last packets out.
    pub async fn end(self, within: Duration) {
        let endpoints = std::mem::take(&mut *self.endpoints.lock());
        for endpoint in endpoints.into_iter().flatten() {
            let _ = tokio::time::timeout(within, endpoint.wait_idle()).await;
        }
    }
}

/// One per address family, made when first needed.
#[derive(Clone, Default)]
struct Endpoints(Arc<Mutex<[Option<Endpoint>; 2]>>);

impl Endpoints {
    fn connect(
        &self,
        config: quinn::ClientConfig,
        address: SocketAddr,
    ) -> Result<quinn::Connecting, String> {
        let (slot, local) = match address {
            SocketAddr::V4(_) => (0, SocketAddr::from((Ipv4Addr::UNSPECIFIED, 0))),
            SocketAddr::V6(_) => (1, SocketAddr::from((Ipv6Addr::UNSPECIFIED, 0))),
        };
        let mut endpoints = self.lock();
        let endpoint = match &mut endpoints[slot] {
            Some(endpoint) => endpoint,
            none => {
                let made = Endpoint::client(local);
                none.insert(made.map_err(|e| format!("no UDP socket could be opened: {e}"))?)
            }
        };
        endpoint.connect_with(config, address, SERVER_NAME).map_err(|e| e.to_string())
    }

    /// A panic elsewhere leaves whole endpoints behind.
    fn lock(&self) -> std::sync::MutexGuard<'_, [Option<Endpoint>; 2]> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// How a client speaks QUIC with a server whose certificate is pinned. For tools that open
/// connections of their own; `None` trusts the first certificate.
///
/// # Errors
/// A sentence: TLS 1.3 is not to be had.
pub fn quic_config(pin: Option<Fingerprint>) -> Result<quinn::ClientConfig, String> {
    client_config(pin).1
}

fn client_config(pin: Option<Fingerprint>) -> (Arc<Pin>, Result<quinn::ClientConfig, String>) {
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let pin = Arc::new(Pin::new(pin, Arc::clone(&provider)));
    let config = pinned_config(Arc::clone(&pin), provider);
    (pin, config)
}

fn pinned_config(
    pin: Arc<Pin>,
    provider: Arc<rustls::crypto::CryptoProvider>,
) -> Result<quinn::ClientConfig, String> {
    let mut tls = rustls::ClientConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])
        .map_err(|e| format!("TLS 1.3 is not available: {e}"))?
        .dangerous()
        .with_custom_certificate_verifier(pin)
        .with_no_client_auth();
    tls.alpn_protocols = vec![ALPN.to_vec()];
    let tls = QuicClientConfig::try_from(tls).map_err(|e| format!("no QUIC cipher suite: {e}"))?;
    let mut transport = quinn::TransportConfig::default();
    transport
        .max_concurrent_uni_streams(VarInt::from_u32(limits::FETCHES_MAX as u32))
        .max_concurrent_bidi_streams(VarInt::from_u32(0))
        .max_idle_timeout(IDLE.try_into().ok())
        .keep_alive_interval(Some(KEEP_ALIVE));
    let mut config = quinn::ClientConfig::new(Arc::new(tls));
    config.transport_config(Arc::new(transport));
    Ok(config)
}

/// A connection that stands.
#[derive(Debug)]
pub struct Link {
    connection: Connection,
    /// Room for one message: the next is made when the stream has taken the one before.
    writer: mpsc::Sender<Vec<u8>>,
}

/// Room for one message.
pub struct Slot(mpsc::OwnedPermit<Vec<u8>>);

impl Slot {
    /// Hands the message to the stream.
    pub fn send(self, bytes: Vec<u8>) {
        self.0.send(bytes);
    }
}

impl Link {
    /// Room for one message, if the stream has taken the one before.
    pub fn room(&self) -> Option<Slot> {
        self.writer.clone().try_reserve_owned().ok().map(Slot)
    }

    /// UDP payload received.
    pub fn bytes_received(&self) -> u64 {
        self.connection.stats().udp_rx.bytes
    }

    /// Ends the connection once what was written is out.
    pub fn close(self, code: u32) {
        let Self { connection, writer } = self;
        drop(writer);
        tokio::spawn(async move {
            // The writer finishes the stream; the server closes when it has read the goodbye.
            let _ = tokio::time::timeout(super::GOODBYE / 4, connection.closed()).await;
            connection.close(VarInt::from_u32(code), b"");
        });
    }
}

/// Where the tasks of one connection tell what happened.
#[derive(Debug, Clone)]
struct Inputs {
    epoch: u64,
    sender: mpsc::Sender<Input>,
}

impl Inputs {
    /// Waits for room; a driver that is gone needs no news.
    async fn send(&self, what: Happened) {
        let _ = self.sender.send(Input { epoch: self.epoch, what }).await;
    }
}

/// One connection to its end.
async fn converse(connection: Connection, control: (SendStream, RecvStream), inputs: Inputs) {
    let (writer, messages) = mpsc::channel(1);
    let (send, receive) = control;
    tokio::spawn(write_control(send, messages, inputs.clone()));
    tokio::spawn(read_control(receive, inputs.clone()));
    tokio::spawn(accept_chunks(connection.clone(), inputs.clone()));
    let link = Link { connection: connection.clone(), writer };
    inputs.send(Happened::Connected(link)).await;
    let error = connection.closed().await;
    inputs.send(lost(&error)).await;
}

fn lost_for(why: String) -> Happened {
    Happened::Lost { close: None, why }
}

fn lost(error: &ConnectionError) -> Happened {
    let close = match error {
        ConnectionError::ApplicationClosed(close) => {
            let text = String::from_utf8_lossy(&close.reason).into_owned();
            Some((close.error_code.into_inner(), text))
        }
        _ => None,
    };
    Happened::Lost { close, why: error.to_string() }
}

async fn write_control(
    mut stream: SendStream,
    mut messages: mpsc::Receiver<Vec<u8>>,
    inputs: Inputs,
) {
    while let Some(bytes) = messages.recv().await {
        if stream.write_all(&bytes).await.is_err() {
            return;
        }
        inputs.send(Happened::Written).await;
    }
    let _ = stream.finish();
    // The stream is kept until the other side has it all.
    let _ = stream.stopped().await;
}

async fn read_control(mut stream: RecvStream, inputs: Inputs) {
    while let Ok(Some(chunk)) = stream.read_chunk(READ_BYTES, true).await {
        inputs.send(Happened::Control(chunk.bytes)).await;
    }
}

async fn accept_chunks(connection: Connection, inputs: Inputs) {
    while let Ok(stream) = connection.accept_uni().await {
        tokio::spawn(read_chunk(stream, inputs.clone()));
    }
}

async fn read_chunk(mut stream: RecvStream, inputs: Inputs) {
    let id = stream.id().index();
    loop {
        match stream.read_chunk(READ_BYTES, true).await {
            Ok(Some(chunk)) => {
                let bytes = chunk.bytes;
                inputs.send(Happened::Chunk { stream: id, bytes, end: false }).await;
            }
            Ok(None) => {
                let bytes = bytes::Bytes::new();
                return inputs.send(Happened::Chunk { stream: id, bytes, end: true }).await;
            }
            Err(_) => return inputs.send(Happened::ChunkReset { stream: id }).await,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_name_with_several_addresses_is_tried_at_each_in_turn() {
        let (sender, mut inputs) = mpsc::channel(8);
        let dialer = Dialer::new("unused:1".into(), None, sender);
        // Ports of ours at which nobody ever answers.
        let bind = || std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
        let (one, two) = (bind(), bind());
        let addresses = [&one, &two].map(|socket| socket.local_addr().unwrap());
        let mut tried = Vec::new();
        for epoch in 0..3 {
            dialer.dial_any(epoch, std::future::ready(Ok(addresses.to_vec())));
            let Some(Input { what: Happened::Lost { why, .. }, .. }) = inputs.recv().await else {
                panic!("nobody is there")
            };
            let named = addresses.iter().position(|address| why.contains(&address.to_string()));
            tried.push(named.expect("the address is named"));
        }
        assert_eq!(tried, [0, 1, 0]);
    }
}

//! Sockets: dials, reads and writes in small tasks, and tells the driver what happened.

use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;
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
    /// One per address family, made when first needed.
    endpoints: [Option<Endpoint>; 2],
}

impl Dialer {
    /// `pin`: the certificate to insist on.
    pub fn new(address: String, pin: Option<Fingerprint>, inputs: mpsc::Sender<Input>) -> Self {
        let (pin, config) = client_config(pin);
        Self { address, pin, config, inputs, endpoints: [None, None] }
    }

    /// The sentence for people, if the server showed another certificate than the pinned one.
    pub fn mismatch(&self) -> Option<String> {
        self.pin.mismatch()
    }

    /// Starts a connection; what comes of it arrives as inputs of this epoch.
    pub fn dial(&mut self, epoch: u64) {
        let connecting = self.begin();
        let inputs = Inputs { epoch, sender: self.inputs.clone() };
        tokio::spawn(async move {
            match connecting {
                Ok(connecting) => converse(connecting, inputs).await,
                Err(why) => inputs.send(Happened::Lost { close: None, why }).await,
            }
        });
    }

    /// Lets the last packets out.
    pub async fn end(self, within: Duration) {
        for endpoint in self.endpoints.into_iter().flatten() {
            let _ = tokio::time::timeout(within, endpoint.wait_idle()).await;
        }
    }

    fn begin(&mut self) -> Result<quinn::Connecting, String> {
        let config = self.config.clone()?;
        let mut found = std::net::ToSocketAddrs::to_socket_addrs(&self.address)
            .map_err(|e| format!("\"{}\" is no address ({e}); write host:port", self.address))?;
        let address =
            found.next().ok_or_else(|| format!("\"{}\" leads to no address", self.address))?;
        let (slot, local) = match address {
            SocketAddr::V4(_) => (0, SocketAddr::from((Ipv4Addr::UNSPECIFIED, 0))),
            SocketAddr::V6(_) => (1, SocketAddr::from((Ipv6Addr::UNSPECIFIED, 0))),
        };
        let endpoint = match &mut self.endpoints[slot] {
            Some(endpoint) => endpoint,
            none => {
                let made = Endpoint::client(local);
                none.insert(made.map_err(|e| format!("no UDP socket could be opened: {e}"))?)
            }
        };
        endpoint.connect_with(config, address, SERVER_NAME).map_err(|e| e.to_string())
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

/// One connection from dialling to its end.
async fn converse(connecting: quinn::Connecting, inputs: Inputs) {
    let opened = async {
        let connection = connecting.await?;
        let control = connection.open_bi().await?;
        Ok::<_, ConnectionError>((connection, control))
    };
    match opened.await {
        Err(error) => inputs.send(lost(&error)).await,
        Ok((connection, (send, receive))) => {
            let (writer, messages) = mpsc::channel(1);
            tokio::spawn(write_control(send, messages, inputs.clone()));
            tokio::spawn(read_control(receive, inputs.clone()));
            tokio::spawn(accept_chunks(connection.clone(), inputs.clone()));
            let link = Link { connection: connection.clone(), writer };
            inputs.send(Happened::Connected(link)).await;
            let error = connection.closed().await;
            inputs.send(lost(&error)).await;
        }
    }
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

//! The session machine of `protocol`, driven over quinn as simply as possible.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use protocol::message::{ALPN, Priority, TagOutcome};
use protocol::session::{Client, ClientConfig, ClientEvent, SessionError, Time};
use protocol::{ChunkHash, StateId, VersionNumber};
use quinn::crypto::rustls::QuicClientConfig;
use quinn::{Connection, Endpoint, RecvStream, SendStream};
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::{DigitallySignedStruct, SignatureScheme};
use sha2::{Digest, Sha256};
use tokio::sync::mpsc;

pub struct Player {
    pub machine: Client,
    pub chunks: BTreeMap<ChunkHash, Vec<u8>>,
    pub versions: Vec<VersionNumber>,
    pub missing: Vec<ChunkHash>,
    pub ended: Option<SessionError>,
    pub tagged: Vec<(StateId, TagOutcome)>,
    pub connections: u32,
    server: SocketAddr,
    endpoint: Endpoint,
    started: Instant,
    line: Option<Line>,
}

struct Line {
    connection: Connection,
    control: SendStream,
    messages: RecvStream,
    chunks: mpsc::Receiver<(u64, Vec<u8>)>,
}

impl Player {
    pub fn new(server: &server::Server, token: Option<&str>) -> Self {
        Self::pinned(server, token, None)
    }

    /// One that wants a version and no other.
    pub fn pinned(
        server: &server::Server,
        token: Option<&str>,
        pin: Option<VersionNumber>,
    ) -> Self {
        let token = token.map(String::from);
        let config = ClientConfig { token, pin, ..ClientConfig::default() };
        Self {
            machine: Client::new(config),
            chunks: BTreeMap::new(),
            versions: Vec::new(),
            missing: Vec::new(),
            ended: None,
            tagged: Vec::new(),
            connections: 0,
            server: server.quic_addr(),
            endpoint: endpoint(server.fingerprint(), ALPN),
            started: Instant::now(),
            line: None,
        }
    }

    /// Plays until `is_so`.
    pub async fn until(&mut self, what: &str, is_so: impl Fn(&Self) -> bool) {
        let deadline = Instant::now() + Duration::from_secs(15);
        while !is_so(self) {
            assert!(Instant::now() < deadline, "{what} did not come about");
            self.turn().await;
        }
    }

    fn now(&self) -> Time {
        Time(self.started.elapsed().as_micros() as u64)
    }

    async fn turn(&mut self) {
        let now = self.now();
        self.machine.handle_timeout(now);
        while let Some(bytes) = self.machine.poll_transmit(now) {
            if let Some(line) = &mut self.line {
                let _ = line.control.write_all(&bytes).await;
            }
        }
        while let Some(event) = self.machine.poll_event() {
            self.act(event).await;
        }
        let Some(line) = &mut self.line else {
            return tokio::time::sleep(Duration::from_millis(5)).await;
        };
        let started = self.started;
        let now = || Time(started.elapsed().as_micros() as u64);
        tokio::select! {
            read = line.messages.read_chunk(1 << 16, true) => match read {
                Ok(Some(chunk)) => self.machine.handle_control(now(), &chunk.bytes),
                other => {
                    let reason = line.connection.closed().await;
                    let close = match &reason {
                        quinn::ConnectionError::ApplicationClosed(close) => {
                            let text = String::from_utf8_lossy(&close.reason).into_owned();
                            Some((u64::from(close.error_code), text))
                        }
                        _ => None,
                    };
                    let close = close.as_ref().map(|(code, text)| (*code, &text[..]));
                    let why = format!("{other:?}");
                    self.machine.handle_disconnected(now(), close, &why);
                }
            },
            Some((stream, bytes)) = line.chunks.recv() => {
                self.machine.handle_chunk(now(), stream, &bytes, true);
            }
            () = tokio::time::sleep(Duration::from_millis(5)) => {}
        }
        while let Some(event) = self.machine.poll_event() {
            self.act(event).await;
        }
    }

    async fn act(&mut self, event: ClientEvent) {
        match event {
            ClientEvent::Connect => {
                self.connections += 1;
                match dial(&self.endpoint, self.server).await {
                    Ok(line) => {
                        self.line = Some(line);
                        self.machine.handle_connected(self.now());
                    }
                    Err(error) => {
                        self.machine.handle_disconnected(self.now(), None, &error.to_string());
                    }
                }
            }
            ClientEvent::Version(signed) => {
                self.versions.push(signed.manifest.number);
                for chunk in signed.manifest.garments.iter().flat_map(|g| g.chunks()) {
                    if !self.chunks.contains_key(&chunk.hash) {
                        assert!(self.machine.want(chunk, Priority::Scene));
                    }
                }
                self.machine.applied(signed.manifest.number);
            }
            ClientEvent::Chunk { hash, bytes } => drop(self.chunks.insert(hash, bytes)),
            ClientEvent::Missing { hash } => self.missing.push(hash),
            ClientEvent::Disconnect { reason } => {
                self.ended = Some(reason);
                self.line = None;
            }
            ClientEvent::Welcome => {}
            ClientEvent::Tagged { state, outcome, .. } => self.tagged.push((state, outcome)),
        }
    }
}

async fn dial(endpoint: &Endpoint, server: SocketAddr) -> Result<Line, quinn::ConnectionError> {
    let connection = endpoint.connect(server, "toile").unwrap().await?;
    let (control, messages) = connection.open_bi().await?;
    let (arrived, chunks) = mpsc::channel(16);
    let streams = connection.clone();
    tokio::spawn(async move {
        for stream in 0.. {
            let Ok(mut receive) = streams.accept_uni().await else { return };
            let arrived = arrived.clone();
            tokio::spawn(async move {
                if let Ok(bytes) = receive.read_to_end(1 << 24).await {
                    let _ = arrived.send((stream, bytes)).await;
                }
            });
        }
    });
    Ok(Line { connection, control, messages, chunks })
}

/// A client's end that accepts only the certificate with this fingerprint.
pub fn endpoint(fingerprint: &str, alpn: &[u8]) -> Endpoint {
    let mut endpoint = Endpoint::client("127.0.0.1:0".parse().unwrap()).unwrap();
    endpoint.set_default_client_config(config(fingerprint, alpn));
    endpoint
}

/// How it speaks.
pub fn config(fingerprint: &str, alpn: &[u8]) -> quinn::ClientConfig {
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let pinned = Arc::new(Pinned { fingerprint: fingerprint.into(), provider: provider.clone() });
    let mut tls = rustls::ClientConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])
        .unwrap()
        .dangerous()
        .with_custom_certificate_verifier(pinned)
        .with_no_client_auth();
    tls.alpn_protocols = vec![alpn.to_vec()];
    quinn::ClientConfig::new(Arc::new(QuicClientConfig::try_from(tls).unwrap()))
}

#[derive(Debug)]
struct Pinned {
    fingerprint: String,
    provider: Arc<rustls::crypto::CryptoProvider>,
}

impl ServerCertVerifier for Pinned {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _: &[CertificateDer<'_>],
        _: &ServerName<'_>,
        _: &[u8],
        _: UnixTime,
    ) -> Result<ServerCertVerified, rustls::Error> {
        let found = Sha256::digest(end_entity);
        let found: String = found.iter().map(|byte| format!("{byte:02x}")).collect();
        if found == self.fingerprint {
            return Ok(ServerCertVerified::assertion());
        }
        Err(rustls::Error::General(format!("fingerprint {found}")))
    }

    fn verify_tls12_signature(
        &self,
        _: &[u8],
        _: &CertificateDer<'_>,
        _: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        Err(rustls::Error::General("TLS 1.3 only".into()))
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        let algorithms = &self.provider.signature_verification_algorithms;
        rustls::crypto::verify_tls13_signature(message, certificate, signed, algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.provider.signature_verification_algorithms.supported_schemes()
    }
}

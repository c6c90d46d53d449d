//! The driver against a small server on a real socket: the server's session machine over quinn,
//! with chunks in memory.

use std::net::SocketAddr;
use std::sync::Mutex;

use protocol::frame::chunk_head;
use protocol::session::{Server, ServerConfig, ServerEvent};
use protocol::{Manifest, SigningKey, VersionNumber};
use protocol::{PoseId, StateId};
use quinn::crypto::rustls::QuicServerConfig;
use rustls::pki_types::{CertificateDer, PrivatePkcs8KeyDer};
use tokio::sync::watch;

use super::*;
use crate::character::StepOutcome;
use crate::client::Client;
use crate::tiny;

const SOON: Duration = Duration::from_secs(10);

/// What the server serves; shared by its connections.
#[derive(Default)]
struct World {
    chunks: BTreeMap<ChunkHash, Vec<u8>>,
    walked: u64,
    reports: u64,
    applied: Vec<VersionNumber>,
}

struct TestServer {
    address: SocketAddr,
    fingerprint: Fingerprint,
    world: Arc<Mutex<World>>,
    head: watch::Sender<Option<Arc<SignedManifest>>>,
    runtime: tokio::runtime::Runtime,
    endpoint: quinn::Endpoint,
}

/// A self-signed certificate and its key.
struct Identity {
    certificate: Vec<u8>,
    key: Vec<u8>,
}

impl Identity {
    fn make() -> Self {
        let made = rcgen::generate_simple_self_signed(vec!["toile".to_owned()]).unwrap();
        let certificate = made.cert.der().to_vec();
        Self { certificate, key: made.signing_key.serialize_der() }
    }
}

impl TestServer {
    fn start(token: Option<&str>) -> Self {
        Self::start_at(([127, 0, 0, 1], 0).into(), &Identity::make(), token)
    }

    fn start_at(address: SocketAddr, identity: &Identity, token: Option<&str>) -> Self {
        let certificate = CertificateDer::from(identity.certificate.clone());
        let key = PrivatePkcs8KeyDer::from(identity.key.clone());
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let fingerprint = Fingerprint::of(&certificate);
        let mut tls = rustls::ServerConfig::builder_with_provider(provider)
            .with_protocol_versions(&[&rustls::version::TLS13])
            .unwrap()
            .with_no_client_auth()
            .with_single_cert(vec![certificate], key.into())
            .unwrap();
        tls.alpn_protocols = vec![protocol::message::ALPN.to_vec()];
        let crypto = QuicServerConfig::try_from(tls).unwrap();
        let config = quinn::ServerConfig::with_crypto(Arc::new(crypto));
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let inside = runtime.enter();
        let endpoint = quinn::Endpoint::server(config, address).unwrap();
        drop(inside);
        let world = Arc::<Mutex<World>>::default();
        let (head, heads) = watch::channel(None);
        let address = endpoint.local_addr().unwrap();
        let token = token.map(str::to_owned);
        let (accepting, served) = (endpoint.clone(), Arc::clone(&world));
        runtime.spawn(async move {
            while let Some(incoming) = accepting.accept().await {
                let config = ServerConfig { token: token.clone(), tag_token: None };
                tokio::spawn(serve(incoming, config, Arc::clone(&served), heads.clone()));
            }
        });
        Self { address, fingerprint, world, head, runtime, endpoint }
    }

    fn publish(&self, number: u64, links: Vec<protocol::links::LinkEntry>) {
        let (garment, chunks) = tiny::published(links);
        self.world.lock().unwrap().chunks.extend(chunks);
        let number = VersionNumber(number);
        let manifest = Manifest { number, previous: None, garments: vec![garment] };
        let signed = manifest.sign(&SigningKey::from_seed(&[7; 32]));
        self.head.send_replace(Some(Arc::new(signed)));
    }

    fn client(&self, change: impl FnOnce(&mut ClientConfig)) -> Client {
        let mut config = ClientConfig::new(self.address.to_string());
        config.fingerprint = Some(self.fingerprint.to_string());
        change(&mut config);
        Client::connect(config).unwrap()
    }

    /// Closes all connections and its socket.
    fn stop(self) {
        let Self { endpoint, runtime, .. } = self;
        endpoint.close(protocol::message::CloseCode::ShuttingDown.number().into(), b"restart");
        runtime.block_on(endpoint.wait_idle());
        drop(endpoint);
        runtime.shutdown_timeout(Duration::from_millis(200));
    }
}

async fn serve(
    incoming: quinn::Incoming,
    config: ServerConfig,
    world: Arc<Mutex<World>>,
    mut heads: watch::Receiver<Option<Arc<SignedManifest>>>,
) {
    let Ok(connection) = incoming.await else { return };
    let Ok((mut send, mut receive)) = connection.accept_bi().await else { return };
    let mut session = Server::new(config, Time(0));
    session.handle_publisher(SigningKey::from_seed(&[7; 32]).public());
    loop {
        if let Some(head) = heads.borrow_and_update().as_ref() {
            session.handle_head(head);
        }
        while let Some(event) = session.poll_event() {
            match event {
                ServerEvent::Send { hash, .. } => {
                    let bytes = world.lock().unwrap().chunks.get(&hash).cloned();
                    let Some(bytes) = bytes else {
                        session.handle_missing(&hash);
                        continue;
                    };
                    let mut stream = connection.open_uni().await.unwrap();
                    let _ = stream.write_all(&chunk_head(&hash, bytes.len() as u32)).await;
                    let _ = stream.write_all(&bytes).await;
                    let _ = stream.finish();
                    session.handle_sent(&hash);
                }
                ServerEvent::Base(_) => session.handle_base(None),
                ServerEvent::Applied(version) => world.lock().unwrap().applied.push(version),
                ServerEvent::Telemetry { telemetry, .. } => {
                    let walked: u32 = telemetry.edges.iter().map(|(_, count)| count).sum();
                    let mut world = world.lock().unwrap();
                    world.walked += u64::from(walked);
                    world.reports += 1;
                }
                ServerEvent::Closed { code, message } => {
                    while let Some(bytes) = session.poll_transmit() {
                        let _ = send.write_all(&bytes).await;
                    }
                    let _ = send.finish();
                    return connection.close(code.number().into(), message.as_bytes());
                }
                ServerEvent::Cancel { .. }
                | ServerEvent::Open { .. }
                | ServerEvent::Pin(_)
                | ServerEvent::Outside { .. }
                | ServerEvent::Tag { .. } => {}
            }
        }
        while let Some(bytes) = session.poll_transmit() {
            let _ = send.write_all(&bytes).await;
        }
        tokio::select! {
            read = receive.read_chunk(1 << 16, true) => match read {
                Ok(Some(chunk)) => session.handle_control(Time(0), &chunk.bytes),
                _ => return,
            },
            changed = heads.changed() => if changed.is_err() { return },
        }
    }
}

#[test]
fn a_client_plays_takes_up_versions_and_reports() {
    let server = TestServer::start(Some("let me in"));
    let client = server.client(|config| config.token = Some("let me in".into()));
    let error = client.wait_ready(Duration::from_millis(300)).unwrap_err();
    assert!(error.to_string().contains("no version"), "{error}");
    server.publish(1, tiny::initial_links());
    client.wait_ready(SOON).unwrap();
    assert_eq!(client.garments(), ["speck"]);
    assert!(client.character(Some("cloak")).unwrap_err().to_string().contains("speck"));
    let mut character = client.character(None).unwrap();
    for frame in 0..60u32 {
        assert_eq!(character.step(PoseId((frame + 1) % 2)), StepOutcome::Exact);
    }
    server.publish(2, tiny::grown_links());
    assert!(client.wait_version(VersionNumber(2), SOON), "{:?}", client.status());
    assert!(client.wait_ahead(SOON));
    for pose in [1, 0, 1] {
        assert_eq!(character.step(PoseId(pose)), StepOutcome::Exact);
    }
    assert_eq!(character.version().number(), VersionNumber(2));
    assert_eq!(character.state(), StateId(5));
    let status = client.status();
    assert!(status.connected && status.error.is_none(), "{status:?}");
    assert_eq!(status.versions_applied, 2);
    assert!(status.bytes_received > 1000 && status.resident_bytes() > 0, "{status:?}");
    drop(character);
    client.close();
    let deadline = Instant::now() + SOON;
    while server.world.lock().unwrap().walked < 63 && Instant::now() < deadline {
        std::thread::sleep(Duration::from_millis(10));
    }
    let world = server.world.lock().unwrap();
    assert_eq!(world.walked, 63, "every walked edge is reported, the last ones at the goodbye");
    assert_eq!(world.applied, [VersionNumber(1), VersionNumber(2)]);
}

#[test]
fn a_wrong_fingerprint_is_refused_with_both_names() {
    let server = TestServer::start(None);
    server.publish(1, tiny::initial_links());
    let wrong = "ab".repeat(32);
    let client = server.client(|config| config.fingerprint = Some(wrong.clone()));
    let error = client.wait_ready(SOON).unwrap_err().to_string();
    assert!(error.contains(&wrong), "{error}");
    assert!(error.contains(&server.fingerprint.to_string()), "{error}");
    let config = ClientConfig { fingerprint: Some("xyz".into()), ..ClientConfig::new("a:1") };
    assert!(Client::connect(config).unwrap_err().to_string().contains("\"xyz\""));
}

#[test]
fn a_wrong_token_and_another_publisher_are_refused_at_once() {
    let server = TestServer::start(Some("let me in"));
    server.publish(1, tiny::initial_links());
    let client = server.client(|config| config.token = Some("open sesame".into()));
    let error = client.wait_ready(SOON).unwrap_err().to_string();
    assert!(error.contains("token"), "{error}");
    let other = SigningKey::from_seed(&[8; 32]).public();
    let client = server.client(|config| {
        config.token = Some("let me in".into());
        config.publisher = Some(other);
    });
    let error = client.wait_ready(SOON).unwrap_err().to_string();
    assert!(error.contains("publisher") && error.contains("pinned"), "{error}");
}

/// Waits until the client has seen that its server is gone.
fn wait_until_alone(client: &Client) {
    let deadline = Instant::now() + SOON;
    while client.status().connected && Instant::now() < deadline {
        std::thread::sleep(Duration::from_millis(10));
    }
    assert!(!client.status().connected);
}

#[test]
fn a_client_plays_on_while_its_server_is_gone_and_comes_back_to_it() {
    let identity = Identity::make();
    let server = TestServer::start_at(([127, 0, 0, 1], 0).into(), &identity, None);
    server.publish(1, tiny::initial_links());
    let address = server.address;
    let client = server.client(|_| {});
    client.wait_ready(SOON).unwrap();
    let mut character = client.character(None).unwrap();
    server.stop();
    wait_until_alone(&client);
    for frame in 0..30u32 {
        assert_eq!(character.step(PoseId((frame + 1) % 2)), StepOutcome::Exact);
    }
    let again = TestServer::start_at(address, &identity, None);
    again.publish(2, tiny::grown_links());
    assert!(client.wait_version(VersionNumber(2), SOON), "{:?}", client.status());
    assert_eq!(character.step(PoseId(1)), StepOutcome::Exact);
    assert_eq!(character.version().number(), VersionNumber(2));
}

#[test]
fn nobody_there_is_an_error_that_says_so_and_the_end_comes_quickly() {
    let client = Client::connect(ClientConfig::new("127.0.0.1:9")).unwrap();
    let error = client.wait_ready(Duration::from_millis(200)).unwrap_err().to_string();
    assert!(error.contains("no version to play"), "{error}");
    let began = Instant::now();
    client.close();
    assert!(began.elapsed() < Duration::from_secs(3), "{:?}", began.elapsed());
    let client = Client::connect(ClientConfig::new("nowhere")).unwrap();
    let error = client.wait_ready(Duration::from_millis(200)).unwrap_err().to_string();
    assert!(error.contains("host:port"), "{error}");
}

#[test]
fn a_chunk_that_the_server_gets_later_is_asked_for_again() {
    let server = TestServer::start(None);
    let (garment, _) = tiny::published(tiny::initial_links());
    server.publish(1, tiny::initial_links());
    let late = garment.scene.hash;
    let bytes = server.world.lock().unwrap().chunks.remove(&late).unwrap();
    let client = server.client(|_| {});
    let error = client.wait_ready(Duration::from_millis(500)).unwrap_err().to_string();
    assert!(error.contains(&late.to_string()), "{error}");
    server.world.lock().unwrap().chunks.insert(late, bytes);
    client.wait_ready(Duration::MAX).unwrap();
    assert_eq!(client.status().error, None, "it is mended");
}

#[test]
fn a_garment_that_cannot_be_read_keeps_nobody_from_the_others() {
    let server = TestServer::start(None);
    let (garment, chunks) = tiny::published(tiny::initial_links());
    let mut other = garment.clone();
    (other.id, other.name) = (GarmentId(1), "cloak".into());
    other.codec = "h.266".into();
    server.world.lock().unwrap().chunks.extend(chunks);
    let manifest =
        Manifest { number: VersionNumber(1), previous: None, garments: vec![garment, other] };
    server.head.send_replace(Some(Arc::new(manifest.sign(&SigningKey::from_seed(&[7; 32])))));
    let client = server.client(|_| {});
    client.wait_ready(SOON).unwrap();
    let status = client.status();
    assert_eq!(status.version, Some(VersionNumber(1)));
    assert!(status.error.is_some_and(|error| error.contains("h.266")));
    assert_eq!(client.garments(), ["speck"]);
}

#[test]
fn what_is_walked_while_the_line_is_down_is_added_up_and_told_once() {
    let identity = Identity::make();
    let server = TestServer::start_at(([127, 0, 0, 1], 0).into(), &identity, None);
    server.publish(1, tiny::initial_links());
    let address = server.address;
    let client = server.client(|_| {});
    client.wait_ready(SOON).unwrap();
    let mut character = client.character(None).unwrap();
    server.stop();
    wait_until_alone(&client);
    // Longer than counts take to be reported, twice.
    for frame in 0..50u32 {
        character.step(PoseId((frame + 1) % 2));
        std::thread::sleep(REPORT / 20);
    }
    let again = TestServer::start_at(address, &identity, None);
    again.publish(1, tiny::initial_links());
    let deadline = Instant::now() + SOON;
    while again.world.lock().unwrap().walked < 50 && Instant::now() < deadline {
        character.step(PoseId(0));
        std::thread::sleep(Duration::from_millis(20));
    }
    let world = again.world.lock().unwrap();
    assert!(world.walked >= 50, "{} of 50", world.walked);
    assert_eq!(world.reports, 1, "in one report");
}

//! Publishes versions to players over QUIC and HTTP.
//!
//! A server watches an object store, streams opaque chunks by priority, tells connected players of
//! every new version, and leaves what they walked in the store. It keeps nothing else: any number
//! of servers may stand before one store.
//!
//! Non-goals: it knows nothing of what chunks hold (neither codec nor cloth is linked), and
//! nothing of the explorer; they meet in the store.
//!
//! Map: `store` reading, verified; `versions` notices new ones; `quic` the endpoint; `session` one
//! player; `http` health, metrics, status, chunks, the live page; `telemetry` counts into the
//! store; `tags` too; `identity` the certificate; `socket` counts stray datagrams; `throttle` keeps the
//! log short.
//!
//! ```no_run
//! # async fn run() -> Result<(), Box<dyn std::error::Error>> {
//! use std::sync::Arc;
//!
//! let store = Arc::new(object_store::local::LocalFileSystem::new_with_prefix("world")?);
//! let listen = "0.0.0.0:4433".parse()?;
//! let config = server::ServerConfig::new(store, listen, "state".into());
//! let server = server::Server::start(config).await?;
//! println!("{} {}", server.quic_addr(), server.fingerprint());
//! server.shutdown().await;
//! # Ok(())
//! # }
//! ```

mod http;
mod identity;
mod metrics;
mod quic;
mod session;
mod shared;
mod socket;
mod stats;
mod store;
mod tags;
mod telemetry;
mod throttle;
mod versions;

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, Weak};
use std::time::{Duration, Instant};

use object_store::ObjectStore;
use tokio::net::TcpListener;
use tokio::sync::{Notify, Semaphore, watch};
use tokio::task::JoinSet;

pub use identity::IdentityError;
pub use stats::{GarmentStats, Outcomes, Stats, VersionPoint};

use metrics::Metrics;
use shared::{Head, Shared};
use socket::CountingSocket;

/// How a server is set up.
#[derive(Debug, Clone)]
pub struct ServerConfig {
    /// The world. The publisher's key is read from it (`publisher.pub`).
    pub store: Arc<dyn ObjectStore>,
    /// Where QUIC listens (UDP); port 0 takes a free one.
    pub listen: SocketAddr,
    /// Where HTTP listens (TCP); `None`: nowhere.
    pub http: Option<SocketAddr>,
    /// What every client must show; `None`: nothing.
    pub token: Option<String>,
    /// What a client shows instead to be allowed to set tags; `None`: nobody may.
    pub tag_token: Option<String>,
    /// Folder of the certificate, made on first start.
    pub identity_dir: PathBuf,
    /// Players at the same time. Default 1,000: at a few hundred kilobytes of buffers each they
    /// fit into a small machine's memory.
    pub players_max: usize,
    /// Bytes of chunks kept in memory. Default 256 MiB: the hot part of a world.
    pub cache_bytes_max: usize,
    /// How often the store is asked for a new version. Default 250 ms, below what a player
    /// notices; one small read each time.
    pub poll_interval: Duration,
    /// How often counts are written to the store. Default 10 s.
    pub telemetry_interval: Duration,
}

impl ServerConfig {
    /// With defaults: no HTTP, no token.
    pub fn new(store: Arc<dyn ObjectStore>, listen: SocketAddr, identity_dir: PathBuf) -> Self {
        Self {
            store,
            listen,
            http: None,
            token: None,
            tag_token: None,
            identity_dir,
            players_max: 1000,
            cache_bytes_max: 256 << 20,
            poll_interval: Duration::from_millis(250),
            telemetry_interval: Duration::from_secs(10),
        }
    }
}

/// Why a server did not start.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StartError {
    /// No certificate.
    #[error(transparent)]
    Identity(#[from] IdentityError),
    /// A port is taken or not allowed.
    #[error("cannot listen on {address} ({what}): {source}; choose another address or port")]
    Listen {
        /// `QUIC` or `HTTP`.
        what: &'static str,
        /// The address.
        address: SocketAddr,
        /// Why.
        source: std::io::Error,
    },
}

/// A running server. Dropping it stops it at once; [`Server::shutdown`] says goodbye first.
#[derive(Debug)]
pub struct Server {
    shared: Arc<Shared>,
    endpoint: quinn::Endpoint,
    /// Gone once the port is free.
    socket: Weak<CountingSocket>,
    quic_addr: SocketAddr,
    http_addr: Option<SocketAddr>,
    tasks: JoinSet<()>,
}

impl Server {
    /// Opens the ports and starts serving. An empty store is a normal state: players wait for the
    /// first version. Needs a tokio runtime.
    ///
    /// # Errors
    /// No certificate could be read or made, or a port is taken.
    pub async fn start(config: ServerConfig) -> Result<Self, StartError> {
        let identity = identity::Identity::load_or_make(&config.identity_dir)?;
        let metrics = Metrics::default();
        let failed = |what, address| move |source| StartError::Listen { what, address, source };
        let listen = config.listen;
        let (endpoint, socket) = quic::open(listen, &identity, metrics.stray_datagrams.clone())
            .map_err(failed("QUIC", listen))?;
        let quic_addr = endpoint.local_addr().map_err(failed("QUIC", listen))?;
        let listener = match config.http {
            Some(http) => Some(TcpListener::bind(http).await.map_err(failed("HTTP", http))?),
            None => None,
        };
        let http_addr = listener.as_ref().and_then(|listener| listener.local_addr().ok());
        let shared = Arc::new(Shared {
            token: config.token,
            tag_token: config.tag_token,
            players_max: config.players_max,
            fingerprint: identity.fingerprint(),
            started: Instant::now(),
            source: store::Source::new(config.store, config.cache_bytes_max),
            metrics,
            head: watch::Sender::new(Head::default()),
            stop: watch::Sender::new(false),
            look: Notify::new(),
            counts: Mutex::default(),
            players: Mutex::new(BTreeMap::new()),
            history: Mutex::default(),
            deliveries: Arc::default(),
            logs: throttle::Logs::default(),
            unlisted: Semaphore::new(shared::UNLISTED_MAX),
            failing: Mutex::default(),
        });
        let mut tasks = JoinSet::new();
        if let Some(listener) = listener {
            tasks.spawn(http::serve(shared.clone(), listener));
        }
        tasks.spawn(quic::accept(shared.clone(), endpoint.clone()));
        let (watching, poll_interval) = (shared.clone(), config.poll_interval);
        tasks.spawn(async move { versions::watch(&watching, poll_interval).await });
        let (writing, interval) = (shared.clone(), config.telemetry_interval);
        tasks.spawn(async move { telemetry::keep_writing(&writing, interval).await });
        let watched = shared.clone();
        tasks.spawn(async move { warn_of_strays(&watched).await });
        Ok(Self { shared, endpoint, socket, quic_addr, http_addr, tasks })
    }

    /// Where QUIC listens.
    pub fn quic_addr(&self) -> SocketAddr {
        self.quic_addr
    }

    /// Where HTTP listens, if it does.
    pub fn http_addr(&self) -> Option<SocketAddr> {
        self.http_addr
    }

    /// SHA-256 of the certificate, 64 hexadecimal digits: what clients pin.
    pub fn fingerprint(&self) -> &str {
        &self.shared.fingerprint
    }

    /// What it serves and has counted so far.
    pub fn stats(&self) -> Stats {
        self.shared.stats()
    }

    /// Looks for a new version now, for a publisher in the same process.
    pub fn notify(&self) {
        self.shared.look.notify_one();
    }

    /// Tells every player, writes what was counted, closes the ports. Takes at most about ten seconds,
    /// whatever players and the store do.
    pub async fn shutdown(mut self) {
        const PATIENCE: Duration = Duration::from_secs(3);
        self.shared.stop.send_replace(true);
        let ended = async { while self.tasks.join_next().await.is_some() {} };
        if tokio::time::timeout(PATIENCE, ended).await.is_err() {
            tracing::warn!("some connections did not end in time");
            self.tasks.shutdown().await;
        }
        let code = protocol::message::CloseCode::ShuttingDown.number();
        self.endpoint.close(quinn::VarInt::from_u32(code), b"the server is going down");
        if tokio::time::timeout(PATIENCE, telemetry::write(&self.shared)).await.is_err() {
            tracing::warn!("the store did not take the last counts in time: they are lost");
        }
        let port_freed = async {
            self.endpoint.wait_idle().await;
            drop(self.endpoint);
            while self.socket.strong_count() > 0 {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        };
        if tokio::time::timeout(PATIENCE, port_freed).await.is_err() {
            tracing::warn!("the QUIC port is still in use");
        }
    }
}

/// One line a second at most, however many datagrams there are.
async fn warn_of_strays(shared: &Shared) {
    let mut stop = shared.stop.subscribe();
    let mut known = 0;
    loop {
        tokio::select! {
            _ = stop.wait_for(|stop| *stop) => return,
            () = tokio::time::sleep(Duration::from_secs(1)) => {}
        }
        let count = shared.metrics.stray_datagrams.get();
        if count > known {
            tracing::warn!("{} datagrams on the QUIC port were not QUIC", count - known);
            known = count;
        }
    }
}

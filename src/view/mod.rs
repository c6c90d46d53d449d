//! `toile view`: a real player whose cloth a local page shows, and by which it is steered.
//!
//! The page holds no cloth of its own: it asks for a frame, gets positions as they are decoded,
//! quantised to 16 bits, and draws them.

mod actor;
mod air;
pub mod answers;
mod app;
mod crowd;
mod dial;
mod http;
mod session;
mod show;
mod skinned;
mod stand_in;
mod steering;
mod stills;
mod survey;
mod wire;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use client_lib::ClientConfig;
use server::{Server, ServerConfig};
use tokio::net::TcpListener;
use tokio::sync::watch;

use crate::explore::Stop;
use crate::{args, place, store};
use app::App;
pub use stand_in::Bare;

/// Between two looks at whether to stop.
const POLL: Duration = Duration::from_millis(100);
/// How long the pages' server may take to end.
const END_MAX: Duration = Duration::from_secs(2);

/// The page, served until this is dropped.
#[derive(Debug)]
pub struct View {
    app: Arc<App>,
    address: SocketAddr,
    stop: watch::Sender<bool>,
    runtime: Option<tokio::runtime::Runtime>,
}

impl View {
    /// Connects to a server and serves the page at `listen`. With a token for tags the page may set
    /// some; until there is a version, `bare` walks on it.
    ///
    /// # Errors
    /// An address that is not this machine's own, or is taken; a fingerprint that cannot be read.
    pub fn start(
        client: ClientConfig,
        tag_token: Option<String>,
        listen: SocketAddr,
        server_page: Option<String>,
        bare: Option<Bare>,
    ) -> Result<Self> {
        ensure!(
            listen.ip().is_loopback(),
            "{listen} can be reached from other machines; the page steers whoever opens it, so it \
             listens on 127.0.0.1 or [::1] only"
        );
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .thread_name("toile-view")
            .enable_all()
            .build()?;
        let listener = runtime
            .block_on(TcpListener::bind(listen))
            .with_context(|| format!("the page cannot listen on {listen}; choose another port"))?;
        let address = listener.local_addr()?;
        let may_tag = tag_token.is_some();
        let token = tag_token.or(client.token.clone());
        let app = App::new(ClientConfig { token, ..client }, server_page, may_tag, bare)?;
        let app = Arc::new(app);
        let (stop, mut stopped) = watch::channel(false);
        let stops = async move { drop(stopped.wait_for(|stop| *stop).await) };
        runtime.spawn(http::serve(Arc::clone(&app), listener, stops));
        Ok(Self { app, address, stop, runtime: Some(runtime) })
    }

    /// Where the page is.
    pub fn url(&self) -> String {
        format!("http://{}/", self.address)
    }

    /// Tells pages that wait for a first version how far the explorer is.
    pub fn tell(&self, exploring: String) {
        self.app.set_exploring(exploring);
    }
}

impl Drop for View {
    fn drop(&mut self) {
        self.stop.send_replace(true);
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_timeout(END_MAX);
        }
    }
}

/// Shows a served world, or a store by serving it, until Ctrl-C.
pub fn run(a: &args::View) -> Result<()> {
    let stop = Stop::on_signals()?;
    let mut tag_token = a.tag_token.clone();
    let (config, serving) = match (&a.connect, &a.store) {
        (Some(address), _) => {
            let config = ClientConfig {
                fingerprint: a.fingerprint.clone(),
                token: a.token.clone(),
                ..ClientConfig::new(address.clone())
            };
            (config, None)
        }
        (None, Some(text)) => {
            let own = tag_token.get_or_insert_with(secret).clone();
            let serving = Serving::start(text, own)?;
            (serving.client(), Some(serving))
        }
        (None, None) => anyhow::bail!("name a server (--connect ADDRESS) or a store to show"),
    };
    let server_page = serving.as_ref().and_then(Serving::page);
    let view = View::start(config, tag_token, a.listen, server_page, None)?;
    println!("{}", view.url());
    let mut pages = 0;
    while !stop.is_asked() {
        std::thread::sleep(POLL);
        if view.app.pages() != pages {
            pages = view.app.pages();
            tracing::info!(pages, "pages open");
        }
    }
    drop(view);
    if let Some(serving) = serving {
        serving.end();
    }
    Ok(())
}

/// A token that nobody outside this process knows.
pub fn secret() -> String {
    use std::hash::{BuildHasher, RandomState};
    // Each state is keyed by the system's randomness.
    (0..4u8).map(|part| format!("{:016x}", RandomState::new().hash_one(part))).collect()
}

/// A server of our own, for a store.
struct Serving {
    server: Server,
    runtime: tokio::runtime::Runtime,
}

impl Serving {
    fn start(text: &str, tag_token: String) -> Result<Self> {
        let opened = store::open_store(text)?;
        let identity = place::identity(&opened, None)?;
        let any: SocketAddr = ([127, 0, 0, 1], 0).into();
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .context("starting the server's runtime")?;
        let config = ServerConfig {
            http: Some(any),
            tag_token: Some(tag_token),
            ..ServerConfig::new(opened.store, any, identity)
        };
        let server = runtime.block_on(Server::start(config)).context("starting the server")?;
        Ok(Self { server, runtime })
    }

    fn client(&self) -> ClientConfig {
        ClientConfig {
            fingerprint: Some(self.server.fingerprint().to_string()),
            ..ClientConfig::new(self.server.quic_addr().to_string())
        }
    }

    fn page(&self) -> Option<String> {
        self.server.http_addr().map(|http| format!("http://{http}/"))
    }

    fn end(self) {
        self.runtime.block_on(self.server.shutdown());
    }
}

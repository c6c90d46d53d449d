//! `toile serve`.

use std::time::Duration;

use anyhow::{Context, Result};
use server::{Server, ServerConfig};

use crate::explore::Stop;
use crate::live::Live;
use crate::{args, format, place, store};

/// Between two looks at whether to stop.
const POLL: Duration = Duration::from_millis(100);

/// Serves until Ctrl-C.
pub fn run(a: args::Serve) -> Result<()> {
    let opened = store::open_store(&a.store)?;
    let identity = place::identity(&opened, a.identity)?;
    let stop = Stop::on_signals()?;
    let config = ServerConfig {
        http: Some(a.http),
        token: a.token,
        tag_token: a.tag_token,
        players_max: a.players_max as usize,
        cache_bytes_max: (a.cache_mb as usize) << 20,
        poll_interval: a.poll,
        telemetry_interval: a.telemetry,
        ..ServerConfig::new(opened.store, a.listen, identity)
    };
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    runtime.block_on(async {
        let server = Server::start(config).await.context("starting the server")?;
        announce(&server);
        let mut live = Live::new(None);
        while !stop.is_asked() {
            tokio::time::sleep(POLL).await;
            let stats = server.stats();
            live.tell(stats.version, || {
                format!(
                    "version {}, {} players, {} sent",
                    stats.version,
                    stats.players,
                    format::bytes(stats.bytes_sent)
                )
            });
        }
        live.done();
        server.shutdown().await;
        Ok(())
    })
}

/// Where a server is to be found, one thing a line.
fn announce(server: &Server) {
    println!("quic        {}", server.quic_addr());
    if let Some(http) = server.http_addr() {
        println!("http        http://{http}");
    }
    println!("fingerprint {}", server.fingerprint());
}

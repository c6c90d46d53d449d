//! `toile up`: explorer, server and players in one process, over real loopback QUIC.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow};
use client_lib::{ClientConfig, WalkSpec};
use explorer::explore::{ExploreOptions, Progress, Summary};
use explorer::grow::policy::Policy;
use explorer::pack::upsampler::UpsamplerSettings;
use explorer::scene::Scene;
use loadtest::{Players, PlayersConfig, Totals};
use serde::Serialize;
use server::{Server, ServerConfig};

use crate::explore::{Stop, explore_blocking, line};
use crate::live::Live;
use crate::recall::Named;
use crate::store::Opened;
use crate::view::{self, View};
use crate::{args, format, place, scene, simulate, store};

/// Between two looks at how it goes.
const POLL: Duration = Duration::from_millis(100);

/// The promised keys.
#[derive(Debug, Serialize)]
struct Outcome {
    states: u64,
    worst_error_mm: f64,
    versions: u64,
    players: usize,
    frames_played: u64,
    frames_exact: u64,
    frames_substituted: u64,
    frames_missed: u64,
    shown_error_mm_p99: f64,
    bytes_sent: u64,
    versions_applied: Vec<u64>,
    first_version_s: Option<f64>,
    policy: Policy,
    visited_p95_mm: f64,
    visited_mean_mm: f64,
    visited_merges_per_s: f64,
    decode_us_p50: f64,
    resident_bytes_max: usize,
}

/// Runs the whole line until Ctrl-C or the time is over.
pub fn run(a: &args::Up) -> Result<()> {
    let start = Instant::now();
    let scene = scene::load_with(&a.scene, a.vertices)?;
    let walks = walks(a, &scene)?;
    let store_place = a.store.clone().unwrap_or_else(|| format!("store/{}", scene.name));
    let opened = store::create_store(&store_place)?;
    let work = place::work(&opened, a.work.clone())?;
    let identity = place::identity(&opened, None).unwrap_or_else(|_| work.join("server"));
    let stop = Stop::on_signals()?.after(a.time);
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .context("starting the server's runtime")?;
    // Whoever sees the page of this process may tag, nobody else.
    let tag_token = view::secret();
    let config = ServerConfig {
        http: Some(a.http),
        tag_token: Some(tag_token.clone()),
        ..ServerConfig::new(Arc::clone(&opened.store), a.listen, identity)
    };
    let server = runtime.block_on(Server::start(config)).context("starting the server")?;
    eprintln!("scene {} into {store_place}", scene.name);
    let options = ExploreOptions {
        codec: a.codec,
        bound: place::bound(a.bound_mm)?,
        workers: place::workers(a.workers)?,
        policy: a.policy,
        upsampler: Some(UpsamplerSettings::default()),
        best_prefix_at_end: false,
        should_stop: stop.asked(),
        ..ExploreOptions::default()
    };
    let named = Named::new(&a.scene, a.vertices);
    let bare = view::Bare::new(&scene);
    let explorer = Explorer::start((scene, named), opened, work, options)?;
    let config = PlayersConfig { walks, ..PlayersConfig::new(client(&server)) };
    let players = Players::start(a.players as usize, &config).context("starting the players")?;
    let server_page = server.http_addr().map(|http| format!("http://{http}/"));
    let view = View::start(client(&server), Some(tag_token), a.page, server_page, bare)?;
    if !a.json {
        println!("{}", view.url());
    }
    let watched = watch(&explorer, &server, &players, &view, &stop, start);
    stop.stop();
    drop(view);
    let totals = players.stop();
    let explored = explorer.join();
    let sent = server.stats().bytes_sent;
    runtime.block_on(server.shutdown());
    let summary = explored?;
    let outcome = outcome(&summary, totals, sent, watched.first_version);
    if a.json {
        return format::print_json(&outcome);
    }
    print(&outcome);
    Ok(())
}

/// The explorer on a thread of its own, and what it said last.
struct Explorer {
    thread: JoinHandle<Result<Summary>>,
    progress: Arc<Mutex<Option<Progress>>>,
}

impl Explorer {
    fn start(
        (scene, named): (Scene, Named),
        opened: Opened,
        work: PathBuf,
        options: ExploreOptions,
    ) -> Result<Self> {
        let progress = Arc::new(Mutex::new(None));
        let shared = Arc::clone(&progress);
        let body = move || {
            explore_blocking(&scene, &named, &opened, &work, &options, &mut |now| {
                *shared.lock().unwrap_or_else(PoisonError::into_inner) = Some(now.clone());
            })
        };
        let thread = std::thread::Builder::new().name("explorer".into()).spawn(body)?;
        Ok(Self { thread, progress })
    }

    fn progress(&self) -> Option<Progress> {
        self.progress.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn join(self) -> Result<Summary> {
        self.thread.join().map_err(|_| anyhow!("the explorer panicked; its journal is safe"))?
    }
}

/// How a player of this process reaches the server.
fn client(server: &Server) -> ClientConfig {
    ClientConfig {
        fingerprint: Some(server.fingerprint().to_string()),
        ..ClientConfig::new(server.quic_addr().to_string())
    }
}

/// How players walk, by time. A walk that this scene does not have is told now, not when its time comes.
fn walks(a: &args::Up, scene: &Scene) -> Result<Vec<(Duration, WalkSpec)>> {
    let mut walks = vec![(Duration::ZERO, WalkSpec::parse(&a.walk)?)];
    for (from, text) in &a.then {
        walks.push((*from, WalkSpec::parse(text)?));
    }
    walks.sort_by_key(|(from, _)| *from);
    for (_, spec) in &walks {
        simulate::walk(scene, spec)?;
    }
    Ok(walks)
}

struct Watched {
    first_version: Option<Duration>,
}

/// Shows how it goes until it is time to stop, or the explorer ends.
fn watch(
    explorer: &Explorer,
    server: &Server,
    players: &Players,
    view: &View,
    stop: &Stop,
    start: Instant,
) -> Watched {
    let mut live = Live::new(None);
    let mut watched = Watched { first_version: None };
    let mut version = 0;
    while !stop.is_asked() && !explorer.thread.is_finished() {
        std::thread::sleep(POLL);
        let stats = server.stats();
        let progress = explorer.progress();
        if version == 0 {
            view.tell(progress.as_ref().map_or("starting".into(), line));
        }
        if stats.version > version {
            version = stats.version;
            watched.first_version.get_or_insert(start.elapsed());
            let said = progress.as_ref().map_or("is in the store already".into(), version_line);
            live.note(&format!(
                "{:6.1} s  version {version}: {said}",
                start.elapsed().as_secs_f64()
            ));
        }
        live.tell(version, || {
            let said = progress.as_ref().map_or("starting".into(), line);
            format!("{said}\n{}", players_line(&players.totals(), stats.bytes_sent))
        });
    }
    live.done();
    watched
}

/// A version, and what players see of its merges.
fn version_line(p: &Progress) -> String {
    let seen = |mm| format!("; players pass {mm:.0} mm of merges a second");
    line(p) + &p.seen_mm_per_s.map_or(String::new(), seen)
}

fn players_line(t: &Totals, bytes_sent: u64) -> String {
    format!(
        "{} players, {} sent; {} exact, {} substituted, {} missed",
        t.connected,
        format::bytes(bytes_sent),
        t.frames_exact,
        t.frames_substituted,
        t.frames_missed
    )
}

fn outcome(s: &Summary, t: Totals, bytes_sent: u64, first: Option<Duration>) -> Outcome {
    Outcome {
        states: s.states,
        worst_error_mm: s.worst_error_mm,
        versions: s.version,
        players: t.players,
        frames_played: t.frames_played,
        frames_exact: t.frames_exact,
        frames_substituted: t.frames_substituted,
        frames_missed: t.frames_missed,
        shown_error_mm_p99: t.shown_error_mm_p99,
        bytes_sent,
        versions_applied: t.versions_applied,
        first_version_s: first.map(|d| d.as_secs_f64()),
        policy: s.policy,
        visited_p95_mm: s.visited_p95_mm,
        visited_mean_mm: s.visited_mean_mm,
        visited_merges_per_s: s.visited_merges_per_s,
        decode_us_p50: t.decode_us_p50,
        resident_bytes_max: t.resident_bytes_max,
    }
}

fn print(o: &Outcome) {
    println!(
        "{} states, worst merge {:.1} mm, {} versions",
        o.states, o.worst_error_mm, o.versions
    );
    println!(
        "{} players: {} frames, {} exact, {} substituted, {} missed; shown error p99 {:.1} mm; {}",
        o.players,
        o.frames_played,
        o.frames_exact,
        o.frames_substituted,
        o.frames_missed,
        o.shown_error_mm_p99,
        format::bytes(o.bytes_sent)
    );
    println!(
        "policy {}; merges as players pass them: mean {:.1} mm, {:.2} a second",
        o.policy, o.visited_mean_mm, o.visited_merges_per_s
    );
    println!("the same command goes on from here");
}

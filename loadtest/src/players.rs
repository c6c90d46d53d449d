//! Players that connect, walk at random and keep count.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::Context;
use client_lib::{Client, ClientConfig, Histogram, PlayStats, Scene, Walk, WalkSpec, decode};
use protocol::PoseId;
use serde::Serialize;

/// A player this far behind its clock does not try to catch up.
const LATE_MAX: Duration = Duration::from_secs(1);
/// How often a player that waits looks whether it should stop.
const PATIENCE: Duration = Duration::from_millis(200);
/// How long a player that plays faster than real time waits for what lies ahead.
const AHEAD_MAX: Duration = Duration::from_secs(5);
/// Frames between two such waits: well within the default horizon.
const AHEAD_FRAMES: u64 = 15;

/// How fast players play.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pace {
    /// At the scene's frame rate, as a game does.
    RealTime,
    /// As fast as possible, waiting for what lies ahead to be resident.
    Fast,
}

/// What all players have in common.
#[derive(Debug, Clone)]
pub struct PlayersConfig {
    /// Where they connect. Each player gets its own jitter seed.
    pub client: ClientConfig,
    /// What they wear; `None`: the first garment by name.
    pub garment: Option<String>,
    /// How fast they play.
    pub pace: Pace,
    /// How they walk, each walk from so long after their start on; the first from the start. A random
    /// walk's seed is raised by the player's number. One that ends is the end of the player.
    pub walks: Vec<(Duration, WalkSpec)>,
    /// Whether every frame is decoded, as a game would.
    pub decodes: bool,
}

impl PlayersConfig {
    /// Real time, at random, every frame decoded.
    pub fn new(client: ClientConfig) -> Self {
        let walks = vec![(Duration::ZERO, WalkSpec::Random(1))];
        Self { client, garment: None, pace: Pace::RealTime, walks, decodes: true }
    }
}

/// What one player did so far.
#[derive(Debug, Clone, Default)]
pub struct Report {
    /// What was shown.
    pub play: PlayStats,
    /// Microseconds per decoded frame.
    pub decode_us: Histogram,
    /// Versions taken up.
    pub versions_applied: u64,
    /// The newest of them; 0 before the first.
    pub version: u64,
    /// UDP payload received.
    pub bytes_received: u64,
    /// Decoded regions in memory, now.
    pub resident_bytes: usize,
    /// The last failure, if it was not mended.
    pub error: Option<String>,
    /// Whether the line is up.
    pub connected: bool,
}

/// What all players did so far.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Totals {
    /// Players that were started.
    pub players: usize,
    /// Of these, connected now.
    pub connected: usize,
    /// Frames played.
    pub frames_played: u64,
    /// Of these, exact.
    pub frames_exact: u64,
    /// Of these, substituted.
    pub frames_substituted: u64,
    /// Of these, missed.
    pub frames_missed: u64,
    /// Poses that were no successor.
    pub jumps: u64,
    /// 99th percentile of the error shown in millimetres.
    pub shown_error_mm_p99: f64,
    /// Median of decoding a frame, in microseconds.
    pub decode_us_p50: f64,
    /// 99th percentile of the same.
    pub decode_us_p99: f64,
    /// Versions taken up, per player.
    pub versions_applied: Vec<u64>,
    /// The newest version, per player; 0 before the first.
    pub versions: Vec<u64>,
    /// UDP payload received by all.
    pub bytes_received: u64,
    /// The most that any player holds in decoded regions.
    pub resident_bytes_max: usize,
    /// Failures that were not mended, with the player's number.
    pub errors: Vec<String>,
}

impl Totals {
    fn of(reports: &[Report]) -> Self {
        let mut play = PlayStats::default();
        let mut decode_us = Histogram::default();
        let mut totals = Self { players: reports.len(), ..Self::default() };
        for (player, report) in reports.iter().enumerate() {
            play.merge(&report.play);
            decode_us.merge(&report.decode_us);
            totals.connected += usize::from(report.connected);
            totals.versions_applied.push(report.versions_applied);
            totals.versions.push(report.version);
            totals.bytes_received += report.bytes_received;
            totals.resident_bytes_max = totals.resident_bytes_max.max(report.resident_bytes);
            totals.errors.extend(report.error.as_ref().map(|e| format!("player {player}: {e}")));
        }
        totals.frames_played = play.frames;
        totals.frames_exact = play.exact;
        totals.frames_substituted = play.substituted;
        totals.frames_missed = play.missed;
        totals.jumps = play.jumps;
        totals.shown_error_mm_p99 = play.shown_error_m.percentile(0.99) * 1e3;
        totals.decode_us_p50 = decode_us.percentile(0.5);
        totals.decode_us_p99 = decode_us.percentile(0.99);
        totals
    }
}

/// Players at work, each with a client and a thread of its own. They stop with this handle.
#[derive(Debug)]
pub struct Players {
    stop: Arc<AtomicBool>,
    players: Vec<Player>,
}

#[derive(Debug)]
struct Player {
    thread: Option<JoinHandle<()>>,
    report: Arc<Mutex<Report>>,
}

impl Players {
    /// Starts `count` players. They wait for a server and for a first version by themselves.
    ///
    /// # Errors
    /// Threads that the system does not give.
    pub fn start(count: usize, config: &PlayersConfig) -> anyhow::Result<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let mut players = Vec::with_capacity(count);
        for number in 0..count as u64 {
            let report = Arc::new(Mutex::new(Report::default()));
            let mut config = config.clone();
            for (_, walk) in &mut config.walks {
                if let WalkSpec::Random(seed) = walk {
                    *seed = seed.wrapping_add(number);
                }
            }
            config.client.jitter_seed = config.client.jitter_seed.wrapping_add(number);
            let (stop, for_thread) = (Arc::clone(&stop), Arc::clone(&report));
            let thread = std::thread::Builder::new()
                .name(format!("player-{number}"))
                .spawn(move || {
                    if let Err(error) = play(&config, &stop, &for_thread) {
                        lock(&for_thread).error = Some(format!("{error:#}"));
                    }
                })
                .with_context(|| format!("player {number} could not be started"))?;
            players.push(Player { thread: Some(thread), report });
        }
        Ok(Self { stop, players })
    }

    /// What each of them did so far.
    pub fn reports(&self) -> Vec<Report> {
        self.players.iter().map(|player| lock(&player.report).clone()).collect()
    }

    /// What all of them did so far.
    pub fn totals(&self) -> Totals {
        Totals::of(&self.reports())
    }

    /// Lets them say goodbye, and waits for it; at most about a second.
    pub fn stop(mut self) -> Totals {
        self.end();
        self.totals()
    }

    fn end(&mut self) {
        self.stop.store(true, Ordering::SeqCst);
        for (number, player) in self.players.iter_mut().enumerate() {
            if player.thread.take().is_some_and(|thread| thread.join().is_err()) {
                lock(&player.report).error =
                    Some(format!("the thread of player {number} panicked"));
            }
        }
    }
}

impl Drop for Players {
    fn drop(&mut self) {
        self.end();
    }
}

fn lock(report: &Mutex<Report>) -> std::sync::MutexGuard<'_, Report> {
    report.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A player's walks, one after another.
struct Walks<'a> {
    begun: Instant,
    walks: &'a [(Duration, WalkSpec)],
    current: Option<Walk>,
}

impl<'a> Walks<'a> {
    fn new(walks: &'a [(Duration, WalkSpec)]) -> Self {
        Self { begun: Instant::now(), walks, current: None }
    }

    /// The next pose after `pose`; none at a walk's end.
    fn next(&mut self, scene: &Arc<Scene>, pose: PoseId) -> anyhow::Result<Option<PoseId>> {
        if let [(from, spec), later @ ..] = self.walks
            && (self.current.is_none() || *from <= self.begun.elapsed())
        {
            self.current = Some(Walk::new(spec, scene, pose)?);
            self.walks = later;
        }
        Ok(self.current.as_mut().and_then(Walk::next))
    }
}

/// One player's life.
fn play(config: &PlayersConfig, stop: &AtomicBool, report: &Mutex<Report>) -> anyhow::Result<()> {
    let client = Client::connect(config.client.clone())?;
    while let Err(error) = client.wait_ready(PATIENCE) {
        tell(&client, report);
        if stop.load(Ordering::SeqCst) {
            return Ok(());
        }
        if client.status().is_final {
            return Err(error.into());
        }
    }
    let garment = config.garment.as_deref();
    let mut character = client.character(garment)?;
    let scene = client.scene(garment)?;
    let mut walks = Walks::new(&config.walks);
    let frame = Duration::from_secs_f32(1.0 / scene.fps());
    let mut positions = vec![0.0; character.version().basis().rows()];
    let mut next_tick = Instant::now();
    while !stop.load(Ordering::SeqCst) {
        if config.pace == Pace::Fast && character.stats().frames.is_multiple_of(AHEAD_FRAMES) {
            client.wait_ahead(AHEAD_MAX);
        }
        let Some(pose) = walks.next(&scene, character.pose())? else { break };
        character.step(pose);
        if config.decodes {
            let began = Instant::now();
            let rows = 0..positions.len();
            decode(&[&character], rows, usize::MAX, &mut positions)?;
            let us = began.elapsed().as_secs_f64() * 1e6;
            lock(report).decode_us.record(us);
        }
        lock(report).play.clone_from(character.stats());
        if character.stats().frames.is_multiple_of(10) {
            tell(&client, report);
        }
        if config.pace == Pace::RealTime {
            next_tick += frame;
            let now = Instant::now();
            if now > next_tick + LATE_MAX {
                next_tick = now;
            }
            std::thread::sleep(next_tick.saturating_duration_since(now));
        }
    }
    tell(&client, report);
    drop(character);
    client.close();
    Ok(())
}

/// Brings the report up to date with the client.
fn tell(client: &Client, report: &Mutex<Report>) {
    let status = client.status();
    let mut report = lock(report);
    report.versions_applied = status.versions_applied;
    report.version = status.version.map_or(0, |version| version.0);
    report.bytes_received = status.bytes_received;
    report.resident_bytes = status.resident_bytes();
    report.connected = status.connected;
    report.error = status.error;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn players_without_a_server_say_so_and_stop() {
        let config = PlayersConfig::new(ClientConfig::new("nowhere"));
        let players = Players::start(2, &config).unwrap();
        std::thread::sleep(PATIENCE * 2);
        let began = Instant::now();
        let totals = players.stop();
        assert!(began.elapsed() < Duration::from_secs(3), "{:?}", began.elapsed());
        assert_eq!((totals.players, totals.connected, totals.frames_played), (2, 0, 0));
        assert_eq!(totals.errors.len(), 2, "{totals:?}");
        assert!(totals.errors[1].contains("player 1") && totals.errors[1].contains("host:port"));
    }
}

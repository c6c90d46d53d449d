//! `toile play`: a player without a window.

use std::time::{Duration, Instant};

use anyhow::{Result, bail, ensure};
use client_lib::{Character, Client, ClientConfig, ClientError, Histogram, Status, Walk, WalkSpec};
use glam::Vec3;
use serde::Serialize;

use crate::live::Live;
use crate::play_forces::{self, Forces, Seams};
use crate::record::Recorder;
use crate::{args, format};

/// How long a player waits for a server that does not answer,
const ANSWER_TIMEOUT: Duration = Duration::from_secs(10);
/// and, once it has answered, for the first version and for what it needs to begin.
const READY_TIMEOUT: Duration = Duration::from_secs(120);
/// A player that keeps no time waits this often for what lies ahead of it,
const AHEAD_FRAMES: u64 = 15;
/// and at most this long.
const AHEAD_TIMEOUT: Duration = Duration::from_secs(2);

/// The promised keys.
#[derive(Debug, Serialize)]
struct Summary {
    frames: u64,
    exact: u64,
    substituted: u64,
    missed: u64,
    shown_error_mm_p99: f64,
    shown_error_mm_max: f64,
    version: u64,
    decode_us_p50: f64,
    decode_us_p99: f64,
    bytes_received: u64,
    resident_bytes: u64,
    basis_bytes: u64,
    /// Bytes of basis that the first cloth took, and its largest error, where it came before the
    /// basis was whole.
    first_cloth_basis_bytes: Option<u64>,
    first_cloth_error_mm: Option<f32>,
    max_vertex_speed_m_s: f32,
    #[serde(flatten)]
    seams: Seams,
}

/// Plays a walk and prints what was shown.
pub fn run(a: &args::Play) -> Result<()> {
    let spec = WalkSpec::parse(&a.walk)?;
    let mut recorder = Recorder::new(a.export.clone(), a.picture.clone(), a.frames, a.shots)?;
    let client = Client::connect(ClientConfig {
        fingerprint: a.fingerprint.clone(),
        token: a.token.clone(),
        ..ClientConfig::new(a.connect.clone())
    })?;
    wait_ready(&client, &a.connect)?;
    let mut character = client.character(None)?;
    let scene = character.version().scene().clone();
    let mut walk = Walk::new(&spec, &scene, character.pose())?;
    let mut live = Live::new(Some(a.frames));
    let mut measures = Measures::new(&character);
    let mut forces = Forces::new(a);
    forces.wait(&mut character, READY_TIMEOUT)?;
    let tick = Duration::from_secs_f32(1.0 / scene.fps());
    let start = Instant::now();
    for frame in 0..a.frames {
        let Some(next) = walk.next() else {
            live.note(&format!("the walk ends after {frame} of {} frames", a.frames));
            break;
        };
        if a.realtime {
            let due = start + tick * u32::try_from(frame).unwrap_or(u32::MAX);
            std::thread::sleep(due.saturating_duration_since(Instant::now()));
        } else if frame % AHEAD_FRAMES == 0 {
            client.wait_ahead(AHEAD_TIMEOUT);
        }
        forces.act(&mut character, frame);
        character.step(next);
        measures.decode(&mut character)?;
        forces.see(&character, &measures.rows);
        recorder.frame(&character, &measures.world)?;
        live.tell(frame + 1, || {
            let stats = character.stats();
            let (exact, substituted) = (stats.exact, stats.substituted);
            format!("{} frames: {exact} exact, {substituted} substituted", frame + 1)
        });
    }
    live.done();
    let status = client.status();
    let summary = summary(&character, &measures, &status, forces.seams(&character));
    recorder.finish(&character)?;
    if a.json {
        return format::print_json(&summary);
    }
    print(&summary);
    Ok(())
}

/// Waits for the first version: long where a server is there, not where nobody answers.
fn wait_ready(client: &Client, address: &str) -> Result<()> {
    let start = Instant::now();
    let mut answered = false;
    loop {
        let limit = if answered { READY_TIMEOUT } else { ANSWER_TIMEOUT };
        let left = limit.saturating_sub(start.elapsed());
        match client.wait_ready(left.min(Duration::from_millis(500))) {
            Err(ClientError::NotReady { .. }) => answered |= client.status().connected,
            ended => return Ok(ended?),
        }
        if start.elapsed() >= limit {
            let why = client.status().error;
            ensure!(
                answered,
                "no toile server answers at {address} (QUIC, UDP): {}; is `toile serve` or \
                 `toile up` running, and is this its quic address?",
                why.unwrap_or(format!("nothing came in {limit:?}"))
            );
            let why = why.unwrap_or("it has no whole version yet".into());
            bail!("the server at {address} gave nothing to play in {limit:?}: {why}");
        }
    }
}

/// What is measured on each frame.
struct Measures {
    rows: Vec<f32>,
    world: Vec<Vec3>,
    before: Vec<Vec3>,
    decode_us: Histogram,
    speed_max_m_s: f32,
    fps: f32,
}

impl Measures {
    fn new(character: &Character) -> Self {
        let version = character.version();
        let vertices = version.mesh().vertex_count as usize;
        Self {
            rows: vec![0.0; 3 * vertices],
            world: Vec::with_capacity(vertices),
            before: Vec::with_capacity(vertices),
            decode_us: Histogram::default(),
            speed_max_m_s: 0.0,
            fps: version.scene().fps(),
        }
    }

    /// Decodes the character's cloth, timed, and moves it into the world, not timed.
    fn decode(&mut self, character: &mut Character) -> Result<()> {
        character.sample(1.0);
        let rows = 0..self.rows.len();
        let start = Instant::now();
        client_lib::decode(&[character], rows, usize::MAX, &mut self.rows)?;
        self.decode_us.record(start.elapsed().as_secs_f64() * 1e6);
        std::mem::swap(&mut self.before, &mut self.world);
        let placement = character.placement();
        self.world.clear();
        self.world.extend(self.rows.chunks_exact(3).map(|p| placement.point(Vec3::from_slice(p))));
        for (now, before) in self.world.iter().zip(&self.before) {
            self.speed_max_m_s = self.speed_max_m_s.max(now.distance(*before) * self.fps);
        }
        Ok(())
    }
}

fn summary(character: &Character, measures: &Measures, status: &Status, seams: Seams) -> Summary {
    let (stats, memory) = (character.stats(), &status.memory);
    Summary {
        frames: stats.frames,
        exact: stats.exact,
        substituted: stats.substituted,
        missed: stats.missed,
        shown_error_mm_p99: stats.shown_error_m.percentile(0.99) * 1000.0,
        shown_error_mm_max: stats.shown_error_m.max() * 1000.0,
        version: character.version().number().0,
        decode_us_p50: measures.decode_us.percentile(0.5),
        decode_us_p99: measures.decode_us.percentile(0.99),
        bytes_received: status.bytes_received,
        resident_bytes: (memory.regions + memory.links + memory.scene) as u64,
        basis_bytes: memory.basis as u64,
        first_cloth_basis_bytes: status.first_cloth.map(|first| first.basis_bytes),
        first_cloth_error_mm: status.first_cloth.map(|first| 1e3 * first.error_m),
        max_vertex_speed_m_s: measures.speed_max_m_s,
        seams,
    }
}

fn print(s: &Summary) {
    println!(
        "{} frames of version {}: {} exact, {} substituted, {} missed",
        s.frames, s.version, s.exact, s.substituted, s.missed
    );
    println!(
        "shown error p99 {:.1} mm, max {:.1} mm; fastest vertex {:.1} m/s",
        s.shown_error_mm_p99, s.shown_error_mm_max, s.max_vertex_speed_m_s
    );
    println!(
        "decode p50 {:.0} us, p99 {:.0} us; received {}, resident {} beside the basis",
        s.decode_us_p50,
        s.decode_us_p99,
        format::bytes(s.bytes_received),
        format::bytes(s.resident_bytes)
    );
    play_forces::print(&s.seams);
}

//! `toile explore`.

use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use explorer::explore::{End, ExploreOptions, Place, Progress, Summary, explore};
use explorer::grow::ledger::Phase;
use explorer::pack::upsampler::UpsamplerSettings;
use explorer::pipe::simulators;
use explorer::scene::Scene;

use crate::live::Live;
use crate::recall::Named;
use crate::store::Opened;
use crate::{args, format, place, scene, store};

/// Frames from which on what they cost is worth another forecast.
const JUDGED_FRAMES: u64 = 100;
/// A forecast is told again when frames cost this many times as much, or as little, as was told.
const NEWS: f64 = 1.5;

/// Explores until told otherwise.
pub fn run(a: args::Explore) -> Result<()> {
    if let Some(error) = a.error {
        ensure!(error.is_finite() && error >= 0.0, "--error {error}: millimetres, at least 0");
    }
    let scene = scene::load_with(&a.scene, a.vertices)?;
    let named = Named::new(&a.scene, a.vertices);
    let opened = store::create_store(&a.store)?;
    let work = place::work(&opened, a.work)?;
    let stop = Stop::on_signals()?.after(a.time);
    let options = ExploreOptions {
        codec: a.codec,
        bound: place::bound(a.bound_mm)?,
        workers: place::workers(a.workers)?,
        frames: a.frames,
        error_m: a.error.map(|mm| mm / 1000.0),
        policy: a.policy,
        clips: a.clips,
        keep_free_bytes: a.keep_free.saturating_mul(1_000_000),
        upsampler: a.upsampler.then(UpsamplerSettings::default),
        paper: a.paper,
        best_prefix_at_end: true,
        should_stop: stop.asked(),
        ..ExploreOptions::default()
    };
    let otherwise_ended = a.error.is_some() || a.time.is_some();
    let mut live = Live::new(a.frames);
    let mut told = None;
    let mut version = None;
    let summary = explore_blocking(&scene, &named, &opened, &work, &options, &mut |progress| {
        if let Some(failure) = &progress.failure {
            live.note(&format!("a job was given up: {failure}"));
        }
        if progress.phase != Phase::Drape && is_news(told, progress) {
            told = Some(progress.cost.cpu_s);
            live.note(&forecast(progress, a.frames, otherwise_ended));
        }
        if progress.version != version {
            version = progress.version;
            live.note(&line(progress));
        }
        live.tell(progress.simulated_frames, || line(progress));
    });
    live.done();
    let summary = summary?;
    if a.json {
        return format::print_json(&summary);
    }
    print(&summary);
    Ok(())
}

/// Explores on this thread until it ends.
pub fn explore_blocking(
    scene: &Scene,
    named: &Named,
    opened: &Opened,
    work: &std::path::Path,
    options: &ExploreOptions,
    progress: &mut dyn FnMut(&Progress),
) -> Result<Summary> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let key_file = work.join("publisher.key");
    if !key_file.exists() {
        let owner = runtime.block_on(explorer::pack::publisher(&*opened.store))?;
        // Nothing is made yet, so that the true folder can still be put into this place.
        ensure!(
            owner.is_none(),
            "the store was published from another work folder than {}, which has no \
             publisher.key: give its own with --work, or take another store",
            work.display()
        );
    }
    std::fs::create_dir_all(work)
        .with_context(|| format!("the work folder {} cannot be made", work.display()))?;
    let inside = |store: &std::path::PathBuf| {
        std::fs::canonicalize(work).is_ok_and(|work| work.starts_with(store))
    };
    if opened.folder.as_ref().is_some_and(inside) {
        tracing::warn!(
            "the work folder {} lies in the store: whoever is given a copy of the store is given the key \
             that signs its versions; take a folder beside it (--work)",
            work.display()
        );
    }
    let key = explorer::pack::load_or_make_key(&key_file)?;
    let simulators = simulators(scene).context("setting up the simulation")?;
    let (store, folder) = (Arc::clone(&opened.store), opened.folder.clone());
    let place = Place { store, folder, key, work: work.to_owned() };
    // Only once the folder is known to be of this scene: a slip must not spoil what it says.
    let mut left = None;
    let mut told = |now: &Progress| {
        left.get_or_insert_with(|| named.leave(work));
        progress(now);
    };
    let summary = runtime.block_on(explore(scene, &*simulators, &place, options, &mut told))?;
    left.unwrap_or(Ok(()))?;
    named.leave(work)?;
    Ok(summary)
}

/// Whether a frame costs so much more or less than was told that the forecast should be told again. Calm
/// motion comes first: crumpled cloth costs ten times as much.
fn is_news(told: Option<f64>, p: &Progress) -> bool {
    told.is_none_or(|told| {
        let ratio = p.cost.cpu_s / told;
        p.simulated_frames >= JUDGED_FRAMES && !(1.0 / NEWS..=NEWS).contains(&ratio)
    })
}

/// What the run will cost, by what a frame cost so far.
fn forecast(p: &Progress, frames: Option<u64>, otherwise_ended: bool) -> String {
    // The initial pass is made whole, however few frames are asked for.
    let end = frames.unwrap_or(1000).max(p.initial_frames);
    let left = end.saturating_sub(p.simulated_frames);
    let what = match frames {
        Some(_) => format!("up to {end} frames, {left} are left: "),
        None if otherwise_ended => format!("{left} more frames: "),
        None => format!("no end was given; {left} more frames: "),
    };
    let free = p
        .cost
        .free_bytes
        .map_or(String::new(), |free| format!(" ({} are free)", format::bytes(free)));
    let cpu_s = left as f64 * p.cost.cpu_s;
    let cpu = match cpu_s {
        s if s < 600.0 => format!("{s:.0} CPU s"),
        s => format!("{:.1} CPU h", s / 3600.0),
    };
    let judged = match p.simulated_frames {
        0 => "still cloth",
        _ => "the frames so far",
    };
    format!(
        "{what}by {judged} about {cpu} and {} in the work folder{free}",
        format::bytes(left * p.cost.work_bytes)
    )
}

/// One line about an exploration.
pub fn line(p: &Progress) -> String {
    let version = p.version.map_or("no version yet".into(), |v| format!("version {v}"));
    if p.phase == Phase::Drape {
        return "draping the garment".into();
    }
    if p.best_worst_error_m.is_none() {
        return format!("initial pass: {} of {} frames", p.simulated_frames, p.initial_frames);
    }
    format!(
        "{} frames, worst merge {:.1} mm, mean {:.1} mm, {version}",
        p.simulated_frames,
        format::mm(p.worst_error_m),
        format::mm(p.mean_error_m),
    )
}

fn print(s: &Summary) {
    println!(
        "{} states in {} trajectories over {} poses and {} edges; {} merges",
        s.states, s.trajectories, s.poses, s.edges, s.merges
    );
    println!(
        "worst merge {:.1} mm (best prefix {:.1} mm), mean {:.1} mm; version {}",
        s.worst_error_mm, s.best_worst_error_mm, s.mean_error_mm, s.version
    );
    println!(
        "{} frames simulated in {:.1} CPU s, {:.4} s a frame",
        s.simulated_frames,
        s.simulate_cpu_s,
        s.simulate_cpu_s / (s.simulated_frames.max(1)) as f64
    );
    println!(
        "policy {}; merges as players pass them: mean {:.1} mm, 95 % below {:.1} mm",
        s.policy, s.visited_mean_mm, s.visited_p95_mm
    );
    for class in s.classes.iter().filter(|class| !class.class.is_empty()) {
        println!("class {}: {} states", class.class, class.states);
    }
    if s.classes.len() > 1 {
        println!(
            "{} merges across classes, {} of them implausible",
            s.merges_across_classes, s.implausible_merges
        );
    }
    let q = &s.quality;
    println!(
        "simulated cloth: largest strain {:.1} %; {} of {} vertex-frames deeper than 5 mm \
         ({} more pinched); deepest {:.1} mm",
        100.0 * q.stretch_max,
        q.deep_vertex_frames,
        q.vertex_frames,
        q.pinched_vertex_frames,
        format::mm(q.depth_max_m)
    );
    println!(
        "{} frames simulated again at a finer step, {} flagged",
        q.frames_retried, q.frames_flagged
    );
    match s.end {
        End::Stopped => println!("stopped; the same command goes on from here"),
        End::Frames | End::Error => {}
        End::Disk => println!(
            "stopped short of a full disk (--keep-free); make room, and the same command goes on"
        ),
        End::Exhausted => println!("no dead end is left to expand"),
    }
}

/// When to stop: Ctrl-C or SIGTERM, or a time limit. A second Ctrl-C ends the process at once.
#[derive(Clone)]
pub struct Stop {
    flag: Arc<AtomicBool>,
    deadline: Option<Instant>,
}

impl Stop {
    /// Listens for signals on a thread of its own.
    pub fn on_signals() -> Result<Self> {
        let flag = Arc::new(AtomicBool::new(false));
        let asked = Arc::clone(&flag);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let listen = move || {
            runtime.block_on(async {
                wait_for_signal().await;
                asked.store(true, Ordering::Relaxed);
                if std::io::stderr().is_terminal() {
                    eprintln!("stopping; once more to stop at once");
                }
                wait_for_signal().await;
                std::process::exit(130);
            });
        };
        std::thread::Builder::new().name("signals".into()).spawn(listen)?;
        Ok(Self { flag, deadline: None })
    }

    /// Also stops this long from now.
    pub fn after(mut self, time: Option<Duration>) -> Self {
        // A time that no clock reaches is none.
        self.deadline = time.and_then(|time| Instant::now().checked_add(time));
        self
    }

    /// Whether it is time.
    pub fn is_asked(&self) -> bool {
        self.flag.load(Ordering::Relaxed) || self.deadline.is_some_and(|d| Instant::now() >= d)
    }

    /// Stops without a signal.
    pub fn stop(&self) {
        self.flag.store(true, Ordering::Relaxed);
    }

    /// The same question, for whoever asks often.
    pub fn asked(&self) -> Arc<dyn Fn() -> bool + Send + Sync> {
        let stop = self.clone();
        Arc::new(move || stop.is_asked())
    }
}

async fn wait_for_signal() {
    #[cfg(unix)]
    {
        use tokio::signal::unix::{SignalKind, signal};
        if let Ok(mut terminate) = signal(SignalKind::terminate()) {
            tokio::select! {
                _ = tokio::signal::ctrl_c() => {}
                _ = terminate.recv() => {}
            }
            return;
        }
    }
    let _ = tokio::signal::ctrl_c().await;
}

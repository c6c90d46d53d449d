//! `toile compare`: playback against continuous simulation.

use std::sync::Mutex;

use anyhow::{Context, Result};
use explorer::compare::{PAPER_STAGES, Row, Settings, compare};
use explorer::pipe::simulators;
use serde::Serialize;

use crate::live::Live;
use crate::recall::recall;
use crate::{args, format, place, store};

/// The promised keys.
#[derive(Debug, Serialize)]
struct Comparison {
    walks: u64,
    frames: usize,
    rows: Vec<Row>,
}

/// Walks, simulates and compares.
pub fn run(a: args::Compare) -> Result<()> {
    let opened = store::open_store(&a.store)?;
    let explored = recall(&opened, &a.explored)?;
    let simulators = simulators(&explored.scene).context("setting up the simulation")?;
    let settings = Settings {
        walks: a.walks,
        frames: a.frames,
        seed: a.seed,
        stages: a.stages.unwrap_or_else(|| PAPER_STAGES.to_vec()),
        workers: place::workers(a.workers)?,
    };
    let live = Mutex::new(Live::new(Some(a.walks)));
    let tell = |done: u64| {
        if let Ok(mut live) = live.lock() {
            live.tell(done, || format!("{done} of {} walks", settings.walks));
        }
    };
    let rows = compare(&explored.archive, &explored.scene, &*simulators, &settings, &tell)?;
    if let Ok(live) = live.lock() {
        live.done();
    }
    let found = Comparison { walks: settings.walks, frames: settings.frames, rows };
    if a.json {
        return format::print_json(&found);
    }
    println!("what      states  after (s)  RMS (mm)  95 % (mm)  max (mm)  energy  speed  class");
    for r in &found.rows {
        println!(
            "{:<9} {:>6}  {:>9.1}  {:>8.1}  {:>9.1}  {:>8.1}  {:>6.2}  {:>5.2}  {:>5.2}",
            r.what,
            r.stage,
            r.horizon_s,
            r.rms_mm,
            r.p95_mm,
            r.max_mm,
            r.energy_ratio,
            r.speed_p95_ratio,
            r.same_class
        );
    }
    Ok(())
}

//! `toile inspect`.

use std::path::Path;

use anyhow::{Context, Result, ensure};
use explorer::certificate::{Bifurcation, Certificate, Replay, certify, replay};
use explorer::faults::{Flagged, flagged};
use explorer::pack::inspect::{GarmentInspection, inspect};
use explorer::pipe::simulators;
use explorer::telemetry::walked_ever;
use serde::Serialize;

use crate::live::Live;
use crate::recall::{Explored, recall};
use crate::{args, format, place, store};

/// The promised keys.
#[derive(Debug, Serialize)]
struct Summary<'a> {
    garment: &'a str,
    version: u64,
    poses: usize,
    states: u64,
    regions: usize,
    merges: u64,
    worst_error_mm: f32,
    mean_error_mm: f64,
    total: bool,
    rank: usize,
    generations: usize,
    codec_max_error_mm: f32,
    codec_rms_error_mm: f32,
    basis_bytes: u64,
    region_bytes: u64,
    link_bytes: u64,
    raw_bytes: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    bifurcations: Option<Vec<Bifurcation>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    flagged: Option<Flagged>,
    #[serde(flatten)]
    replay: Option<Replay>,
}

/// Verifies the head of a store and prints what is in it. A table that is not total is an error.
pub fn run(a: &args::Inspect) -> Result<()> {
    a.certificate.as_deref().map(place::ensure_writable).transpose()?;
    let opened = store::open_store(&a.store)?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let found = runtime
        .block_on(inspect(&*opened.store, None))
        .with_context(|| format!("store {}", a.store))?;
    let wanted = a.certificate.is_some() || a.replay.is_some();
    ensure!(
        !wanted || found.garments.len() == 1,
        "the store holds {} garments; certificates are made of stores with one",
        found.garments.len()
    );
    for garment in &found.garments {
        let mut summary = summary(found.version.0, garment);
        if wanted {
            let explored = recall(&opened, &a.explored)?;
            let walked =
                runtime.block_on(walked_ever(&*opened.store, explorer::FIRST_GARMENT))?.counts;
            let archive = &explored.archive;
            let certificate = certify(archive, &explored.scene, archive.shown(), &walked);
            agree(&explored, &certificate, found.version.0, garment)?;
            if let Some(file) = &a.certificate {
                write(file, found.version.0, &certificate)?;
            }
            let proof = a.replay.map(|count| replayed(&explored, &certificate, count, a));
            summary.replay = proof.transpose()?;
            // A foreign program's frames have the bounds that it gives them.
            if explored.scene.simulator.is_none() {
                summary.flagged = Some(flagged(archive, &explored.scene)?);
            }
            summary.bifurcations = Some(certificate.bifurcations);
        }
        if a.json {
            format::print_json(&summary)?;
        } else {
            print(&summary);
        }
        if let Some(replay) = summary.replay.as_ref().filter(|replay| !replay.is_exact()) {
            anyhow::bail!(
                "replaying gave other frames than are on record ({} states differ): the work folder's states are \
                 damaged, or another version of the simulator made them",
                replay.states_differing
            );
        }
        if let Some(reason) = &garment.not_total {
            anyhow::bail!("garment {}: not total: {reason}", garment.name);
        }
    }
    Ok(())
}

fn summary(version: u64, garment: &GarmentInspection) -> Summary<'_> {
    Summary {
        garment: &garment.name,
        version,
        poses: garment.poses,
        states: garment.states,
        regions: garment.regions,
        merges: garment.merges,
        worst_error_mm: garment.worst_error_mm,
        mean_error_mm: format::mm(garment.stats.mean_error_m),
        total: garment.total,
        rank: garment.rank,
        generations: garment.generations,
        codec_max_error_mm: garment.codec_max_error_mm,
        codec_rms_error_mm: garment.codec_rms_error_mm,
        basis_bytes: garment.basis_bytes,
        region_bytes: garment.region_bytes,
        link_bytes: garment.link_bytes,
        raw_bytes: garment.raw_bytes,
        bifurcations: None,
        flagged: None,
        replay: None,
    }
}

/// The certificate of the work folder is that of the store's head.
fn agree(
    explored: &Explored,
    certificate: &Certificate,
    version: u64,
    garment: &GarmentInspection,
) -> Result<()> {
    let published = explored.archive.ledger().published().map_or(0, |last| last.number.0);
    ensure!(
        published == version,
        "the work folder {} last published version {published}, but the store's head is {version}: \
         name the folder that the store was grown in (--work), or run the explorer once more",
        explored.work.display()
    );
    let found = (certificate.merges.len() as u64, certificate.states);
    let same = found == (garment.merges, garment.states)
        && (certificate.worst_error_mm - f64::from(garment.worst_error_mm)).abs() < 1e-3;
    ensure!(same, "the work folder and the store disagree about the graph of version {version}");
    Ok(())
}

fn write(file: &Path, version: u64, certificate: &Certificate) -> Result<()> {
    #[derive(Serialize)]
    struct Page<'a> {
        version: u64,
        #[serde(flatten)]
        certificate: &'a Certificate,
    }
    let write = || {
        let mut out = std::io::BufWriter::new(std::fs::File::create(file)?);
        serde_json::to_writer(&mut out, &Page { version, certificate })?;
        std::io::Write::flush(&mut out)
    };
    write().with_context(|| format!("writing {}", file.display()))
}

fn replayed(
    explored: &Explored,
    certificate: &Certificate,
    count: usize,
    a: &args::Inspect,
) -> Result<Replay> {
    let simulators = simulators(&explored.scene).context("setting up the simulation")?;
    let workers = place::workers(a.workers)?;
    let total = count.min(certificate.merges.len());
    let live = std::sync::Mutex::new(Live::new(Some(total as u64)));
    let tell = |done: usize| {
        if let Ok(mut live) = live.lock() {
            live.tell(done as u64, || format!("{done} of {total} merges replayed"));
        }
    };
    let found = replay(&explored.archive, certificate, (&*simulators, workers), count, &tell)?;
    if let Ok(live) = live.lock() {
        live.done();
    }
    Ok(found)
}

fn print(s: &Summary<'_>) {
    println!("garment   {} (version {}, signature and every chunk verified)", s.garment, s.version);
    println!("graph     {} states over {} poses, {} merges", s.states, s.poses, s.merges);
    println!("total     {}", if s.total { "yes, checked" } else { "NO" });
    println!("merges    worst {:.1} mm, mean {:.1} mm", s.worst_error_mm, s.mean_error_mm);
    println!(
        "codec     rank {} in {} generations; max {:.1} mm, RMS {:.2} mm",
        s.rank, s.generations, s.codec_max_error_mm, s.codec_rms_error_mm
    );
    println!(
        "bytes     basis {}, {} regions {}, links {}; raw {}",
        format::bytes(s.basis_bytes),
        s.regions,
        format::bytes(s.region_bytes),
        format::bytes(s.link_bytes),
        format::bytes(s.raw_bytes)
    );
    for b in s.bifurcations.iter().flatten() {
        println!(
            "classes   {} to {}: {} simulated crossings by {} different walks, {} merges{}",
            b.from,
            b.to,
            b.crossings,
            b.walks.len(),
            b.merges.len(),
            if b.implausible { ", implausible" } else { "" }
        );
    }
    if let Some(f) = &s.flagged {
        println!(
            "flagged   {} frames: {} by strain, {} by speed, {} deep in the body, {} by crossings",
            f.frames, f.strain, f.speed, f.deep, f.crossings
        );
    }
    if let Some(r) = &s.replay {
        println!(
            "replayed  {} merges, {} frames: largest difference of an error {} mm, {} states differ",
            r.replayed, r.frames, r.largest_difference_mm, r.states_differing
        );
    }
}

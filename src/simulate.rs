//! `toile simulate`: a garment along a walk, simulated frame after frame.

mod converge;
mod table;

use std::sync::Arc;

use anyhow::{Result, bail};
use client_lib::{Walk, WalkSpec};
use explorer::pack::scene_chunk::scene_chunk;
use explorer::scene::Scene;
use explorer::simulate::{Options, Step, Straight, Sum, Tally};
use serde::Serialize;

use self::table::Table;
use crate::explore::Stop;
use crate::live::Live;
use crate::record::{Meshes, Recorder, SHOTS, Shown};
use crate::{args, format, scene};

/// Frames where the user does not say.
const FRAMES: u64 = 300;
/// The same of a soak.
const SOAK_FRAMES: u64 = 100_000;

/// What is printed with `--json`.
#[derive(Debug, Serialize)]
struct Summary<'a> {
    scene: &'a str,
    garment: &'a str,
    vertices: usize,
    walk: &'a str,
    refine: u32,
    nudge_microns: f32,
    /// Frames at which the walk was to end.
    frames_asked: u64,
    /// Frames that could not be simulated; only of a soak, else this is an error.
    frames_failed: u64,
    #[serde(flatten)]
    sum: Sum,
}

/// Simulates a walk and prints what was measured.
pub fn run(a: &args::Simulate) -> Result<()> {
    let spec = WalkSpec::parse(&a.walk)?;
    if a.converge {
        return converge::run(a, &spec);
    }
    let frames = a.frames.unwrap_or(if a.soak { SOAK_FRAMES } else { FRAMES });
    let recorder = Recorder::new(a.export.clone(), a.picture.clone(), frames, SHOTS)?;
    let mut scene = scene::load_with(&a.scene, a.vertices)?;
    let table = a.table.clone().map(|file| Table::new(file, &scene)).transpose()?;
    start_at_clip(&mut scene, &spec);
    let (tally, failed) = simulate(a, (&spec, frames), &scene, (recorder, table))?;
    let sum = tally.sum();
    if sum.frames == 0 {
        bail!("not one frame was simulated");
    }
    let (garment, vertices) = (&scene.garment.name, scene.garment.positions.len());
    if !a.json {
        print(garment, vertices, &sum);
        if a.soak {
            let slow = sum.frames_slow;
            println!("{failed} frames failed, {slow} took more than ten times the median");
        }
        return Ok(());
    }
    format::print_json(&Summary {
        scene: &scene.name,
        garment,
        vertices,
        walk: &a.walk,
        refine: a.refine,
        nudge_microns: a.nudge,
        frames_asked: frames,
        frames_failed: failed,
        sum,
    })
}

/// Walks, and writes the files; also says how many frames failed.
fn simulate(
    a: &args::Simulate,
    (spec, frames): (&WalkSpec, u64),
    scene: &Scene,
    (mut recorder, mut table): (Recorder, Option<Table>),
) -> Result<(Tally, u64)> {
    let mut walk = walk(scene, spec)?;
    let stop = Stop::on_signals()?.after(a.time);
    let mut live = Live::new(Some(frames));
    live.tell(0, || "draping the garment".into());
    let options = Options { refine: a.refine, nudge_m: a.nudge * 1e-6 };
    let start = Straight::new(scene, options)?;
    let mut straight = start.again(options)?;
    let (mut tally, mut failed) = (Tally::default(), 0);
    for frame in 0..frames {
        let Some(next) = walk.next().filter(|_| !stop.is_asked()) else {
            live.note(&format!("the walk ends after {frame} of {frames} frames"));
            break;
        };
        let step = match straight.step(next) {
            Err(error) if a.soak => {
                failed += 1;
                live.note(&format!("frame {frame}, begun anew: {error}"));
                walk = again(scene, spec, failed)?;
                straight = start.again(options)?;
                continue;
            }
            step => step?,
        };
        tally.add(&step, &straight);
        record(&mut recorder, &straight, scene, &step)?;
        if let Some(table) = &mut table {
            table.row(frame, &name(&straight, scene), &step, &straight)?;
        }
        live.tell(frame + 1, || line(&tally.sum()));
    }
    live.done();
    let title =
        format!("{}, {} vertices, {}", scene.garment.name, scene.garment.positions.len(), a.walk);
    recorder.write(&meshes(scene), title)?;
    table.map_or(Ok(()), Table::write)?;
    Ok((tally, failed))
}

/// A walk through clips starts at the first one's first pose, so that its frames are not spent on
/// the way there.
fn start_at_clip(scene: &mut Scene, spec: &WalkSpec) {
    let WalkSpec::Clips(names) = spec else { return };
    let primary = Arc::clone(&scene.primary);
    let clip = primary.clips().iter().position(|clip| Some(clip) == names.first());
    let poses = primary.poses().iter().enumerate();
    let of_clip = poses.filter(|(_, p)| !p.transition && Some(usize::from(p.clip)) == clip);
    if let Some((first, _)) = of_clip.min_by_key(|(_, pose)| pose.frame) {
        let ids = primary.edges().iter().flat_map(|e| [e.from, e.to]);
        scene.start = ids.into_iter().find(|id| id.index() == first).unwrap_or(scene.start);
    }
}

/// The walk that `toile play` would take from the scene's start.
pub fn walk(scene: &Scene, spec: &WalkSpec) -> Result<Walk> {
    let walked = Arc::new(client_lib::Scene::new(scene_chunk(scene))?);
    Ok(Walk::new(spec, &walked, scene.start)?)
}

/// A walk from the start again; a random one takes another way each time.
fn again(scene: &Scene, spec: &WalkSpec, times: u64) -> Result<Walk> {
    match spec {
        WalkSpec::Random(seed) => walk(scene, &WalkSpec::Random(seed.wrapping_add(times << 32))),
        other => walk(scene, other),
    }
}

fn record(
    recorder: &mut Recorder,
    straight: &Straight<'_>,
    scene: &Scene,
    step: &Step,
) -> Result<()> {
    if !recorder.wants() {
        return Ok(());
    }
    let pose = straight.world_pose();
    let (mut joints, mut body) = (Vec::new(), Vec::new());
    scene.body.skin(&pose, &mut joints, &mut body);
    let flag = if step.quality.frames_flagged > 0 { " FLAGGED" } else { "" };
    let class = straight.class();
    let comma = if class.is_empty() { "" } else { ", " };
    let caption = format!("{}{comma}{class}{flag}", name(straight, scene));
    let cloth = straight.world();
    recorder.keep(&meshes(scene), Shown { body, cloth: &cloth, hips: pose.root, caption })
}

/// Clip and frame where a walk stands; `>` before a transition.
fn name(straight: &Straight<'_>, scene: &Scene) -> String {
    let pose = scene.primary.pose(straight.pose());
    let arrow = if pose.transition { "> " } else { "" };
    format!("{arrow}{} {}", scene.primary.clips()[usize::from(pose.clip)], pose.frame)
}

fn meshes(scene: &Scene) -> Meshes<'_> {
    Meshes {
        body: &scene.body.triangles,
        cloth: &scene.garment.triangles,
        garment: &scene.garment.name,
        fps: scene.primary.fps(),
    }
}

fn line(sum: &Sum) -> String {
    format!(
        "{} frames: {:.3} CPU s a frame, p99 {:.3}; stretch p99 {:.1} %, max {:.1} %; {} retried, \
         {} flagged",
        sum.frames,
        sum.cpu_s_median,
        sum.cpu_s_p99,
        sum.stretch_p99_pct,
        sum.stretch_max_pct,
        sum.frames_retried,
        sum.frames_flagged
    )
}

fn print(garment: &str, vertices: usize, s: &Sum) {
    println!("{garment}, {vertices} vertices: {} frames in {:.1} CPU s", s.frames, s.cpu_s);
    println!(
        "CPU s a frame: median {:.3}, p90 {:.3}, p99 {:.3}, max {:.3}; {:.1} substeps, {:.0} \
         iterations",
        s.cpu_s_median, s.cpu_s_p90, s.cpu_s_p99, s.cpu_s_max, s.substeps_mean, s.iterations_mean
    );
    println!("stretch: p99 {:.2} %, max {:.2} %", s.stretch_p99_pct, s.stretch_max_pct);
    println!(
        "in the body: {:.2e} of the vertex-frames deeper than 1 mm, {:.2e} deeper than 5 mm \
         ({:.2e} more pinched); deepest {:.1} mm",
        s.deep_1mm_share, s.deep_5mm_share, s.pinched_share, s.depth_max_mm
    );
    println!("{} crossings of the cloth with itself, in {} frames", s.self_hits, s.self_hit_frames);
    println!(
        "fastest vertex {:.1} m/s; {} frames retried, {} flagged",
        s.speed_max_m_s, s.frames_retried, s.frames_flagged
    );
}

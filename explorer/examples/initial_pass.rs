//! Simulates the initial pass of a scene, one frame per primary edge, breadth first from the
//! draped start, and prints what was measured:
//!
//! ```text
//! cargo run --release -p explorer --example initial_pass -- dress (frames) [clip ...]
//! ```
//!
//! `robe` is built in; anything else is `dress` or a scene file. With clips named, only edges into
//! these are simulated: from a state that came there, else from the drape put there with a jump.
//! Exits with failure if a frame failed, an edge is over 15 % long, or over 0.1 % of the
//! vertex-frames are deeper than 5 mm in the body.

use std::collections::VecDeque;
use std::process::ExitCode;
use std::time::Instant;

use explorer::cloth_simulator::ClothSimulator;
use explorer::grid::GridState;
use explorer::import;
use explorer::scene::Scene;
use explorer::simulator::{FrameQuality, Simulator};
use protocol::EdgeId;

fn main() -> ExitCode {
    match run() {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(e) => {
            eprintln!("{e}");
            ExitCode::FAILURE
        }
    }
}

/// What the pass has measured so far.
#[derive(Default)]
struct Pass {
    total: FrameQuality,
    seconds: Vec<f32>,
    failed: usize,
    worst: Vec<(FrameQuality, EdgeId)>,
}

/// Whether all frames were within bounds.
fn run() -> Result<bool, String> {
    let mut arguments = std::env::args().skip(1);
    let name = arguments.next().unwrap_or_else(|| "robe".into());
    let limit = arguments.next().and_then(|n| n.parse().ok()).unwrap_or(usize::MAX);
    let clips: Vec<String> = arguments.collect();
    let scene = import::load_scene(&name, import::data_dir().as_deref());
    let scene = scene.map_err(|e| e.to_string())?;
    let mut simulator = ClothSimulator::new(&scene).map_err(|e| e.0)?;
    let begun = Instant::now();
    let draped = simulator.drape(&|| false).map_err(|e| e.0)?;
    println!("drape {:.1} s, {:?}", begun.elapsed().as_secs_f32(), draped.quality);
    let mut pass = Pass::default();
    walk(&scene, &mut simulator, &draped.state, (limit, &clips), &mut pass);
    report(&scene, &mut pass.worst, &mut pass.seconds);
    let (total, failed) = (&pass.total, pass.failed);
    let share = |part: u64| part as f64 / total.vertex_frames.max(1) as f64;
    let deep = share(total.deep_vertex_frames);
    println!(
        "frames {} of {} edges, failed {failed}, stretch_max {:.4}, deep {:.5} %, pinched {:.4} %, \
         depth_max {:.1} mm",
        total.frames,
        scene.primary.edges().len(),
        total.stretch_max,
        deep * 100.0,
        share(total.pinched_vertex_frames) * 100.0,
        total.depth_max_m * 1e3
    );
    Ok(failed == 0 && total.stretch_max <= 0.15 && deep <= 0.001)
}

/// Simulates every edge that is wanted once, breadth first.
fn walk(
    scene: &Scene,
    simulator: &mut ClothSimulator,
    draped: &GridState,
    (limit, clips): (usize, &[String]),
    pass: &mut Pass,
) {
    let poses = scene.primary.poses();
    let wanted = |pose: usize| {
        let clip = &scene.primary.clips()[poses[pose].clip as usize];
        clips.is_empty() || clips.contains(clip)
    };
    let mut starts = vec![scene.start.index()];
    if !clips.is_empty() {
        starts = (0..poses.len()).filter(|p| wanted(*p) && poses[*p].frame == 0).collect();
    }
    let mut first: Vec<Option<GridState>> = vec![None; poses.len()];
    let mut seen = vec![false; poses.len()];
    for start in &starts {
        seen[*start] = true;
        first[*start] = Some(draped.clone());
    }
    let mut queue = VecDeque::from(starts);
    while let Some(pose) = queue.pop_front() {
        let Some(state) = first[pose].take() else { continue };
        for edge in scene.primary.out_edges(protocol::PoseId(pose as u32)) {
            let to = scene.primary.edge(edge).to.index();
            if pass.seconds.len() >= limit || !wanted(to) {
                continue;
            }
            let begun = Instant::now();
            let frame = match simulator.step(&state, edge) {
                Ok(frame) => frame,
                Err(e) => {
                    pass.failed += 1;
                    eprintln!("{e}");
                    continue;
                }
            };
            pass.seconds.push(begun.elapsed().as_secs_f32());
            pass.total.add(&frame.quality);
            pass.worst.push((frame.quality, edge));
            if !std::mem::replace(&mut seen[to], true) {
                first[to] = Some(frame.state);
                queue.push_back(to);
            }
        }
    }
}

/// Times, and the frames with the longest edges and the most deep vertices.
fn report(scene: &Scene, worst: &mut [(FrameQuality, EdgeId)], seconds: &mut [f32]) {
    let name = |edge: &EdgeId| {
        let pose = scene.primary.pose(scene.primary.edge(*edge).to);
        let made = if pose.transition { " (transition)" } else { "" };
        format!("{} {}{made}", scene.primary.clips()[pose.clip as usize], pose.frame)
    };
    worst.sort_by(|a, b| b.0.stretch_max.total_cmp(&a.0.stretch_max));
    for (q, edge) in worst.iter().take(8) {
        println!("  stretch {:.3} at {}", q.stretch_max, name(edge));
    }
    worst.sort_by_key(|(q, _)| std::cmp::Reverse(q.deep_vertex_frames));
    for (q, edge) in worst.iter().take(12) {
        let (deep, pinched) = (q.deep_vertex_frames, q.pinched_vertex_frames);
        println!(
            "  {deep} deep, {pinched} pinched, {:.1} mm at {}",
            q.depth_max_m * 1e3,
            name(edge)
        );
    }
    seconds.sort_unstable_by(f32::total_cmp);
    let at = |q: f32| seconds.get((seconds.len() as f32 * q) as usize).copied().unwrap_or(0.0);
    let mean = seconds.iter().sum::<f32>() / seconds.len().max(1) as f32;
    println!("s/frame mean {mean:.3}, p50 {:.3}, p99 {:.3}", at(0.5), at(0.99));
}

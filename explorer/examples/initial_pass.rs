//! Simulates the initial pass of a scene, one frame per primary edge, breadth first from the
//! draped start, and prints what was measured:
//!
//! ```text
//! cargo run --release -p toile-explorer --example initial_pass -- dress (frames) [clip ...]
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
use explorer::simulator::{FrameQuality, Simulator};
use explorer::{builtin, import};
use protocol::EdgeId;

fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let name = arguments.next().unwrap_or_else(|| "robe".into());
    let rest: Vec<String> = arguments.collect();
    let limit = rest.first().and_then(|n| n.parse().ok()).unwrap_or(usize::MAX);
    let clips: Vec<&str> = rest.iter().skip(1).map(String::as_str).collect();
    let scene = if name == "robe" {
        builtin::robe().map_err(|e| e.to_string())
    } else {
        import::load_scene(&name, import::data_dir().as_deref()).map_err(|e| e.to_string())
    };
    let (scene, mut simulator) = match scene
        .and_then(|scene| ClothSimulator::new(&scene).map(|s| (scene, s)).map_err(|e| e.0))
    {
        Ok(both) => both,
        Err(e) => {
            eprintln!("{e}");
            return ExitCode::FAILURE;
        }
    };
    let wanted = |pose: usize| {
        let clip = scene.primary.poses()[pose].clip as usize;
        clips.is_empty() || clips.contains(&scene.primary.clips()[clip].as_str())
    };
    let begun = Instant::now();
    let draped = match simulator.drape() {
        Ok(frame) => frame,
        Err(e) => {
            eprintln!("{e}");
            return ExitCode::FAILURE;
        }
    };
    println!("drape {:.1} s, {:?}", begun.elapsed().as_secs_f32(), draped.quality);
    let poses = scene.primary.poses().len();
    let mut first: Vec<Option<GridState>> = vec![None; poses];
    let mut seen = vec![false; poses];
    let mut starts = vec![scene.start.index()];
    if !clips.is_empty() {
        starts =
            (0..poses).filter(|p| wanted(*p) && scene.primary.poses()[*p].frame == 0).collect();
    }
    let mut queue = VecDeque::new();
    for start in starts {
        seen[start] = true;
        first[start] = Some(draped.state.clone());
        queue.push_back(start);
    }
    let mut total = FrameQuality::default();
    let (mut seconds, mut failed) = (Vec::new(), 0);
    let mut worst: Vec<(FrameQuality, EdgeId)> = Vec::new();
    while let Some(pose) = queue.pop_front() {
        let state = first[pose].take().expect("a pose in the queue has a state");
        for edge in scene.primary.out_edges(protocol::PoseId(pose as u32)) {
            let to = scene.primary.edge(edge).to.index();
            if seconds.len() >= limit || !wanted(to) {
                continue;
            }
            let begun = Instant::now();
            match simulator.step(&state, edge) {
                Ok(frame) => {
                    seconds.push(begun.elapsed().as_secs_f32());
                    total.add(&frame.quality);
                    worst.push((frame.quality, edge));
                    if seconds.len() % 100 == 0 {
                        eprintln!("{} frames, stretch_max {:.3}", seconds.len(), total.stretch_max);
                    }
                    if !seen[to] {
                        seen[to] = true;
                        first[to] = Some(frame.state);
                        queue.push_back(to);
                    }
                }
                Err(e) => {
                    failed += 1;
                    eprintln!("{e}");
                }
            }
        }
    }
    report(&scene, &mut worst, &mut seconds);
    let deep = total.deep_vertex_frames as f64 / total.vertex_frames.max(1) as f64;
    println!(
        "frames {} of {} edges, failed {failed}, stretch_max {:.4}, deep {:.5} %, pinched {:.4} %, \
         depth_max {:.1} mm",
        total.frames,
        scene.primary.edges().len(),
        total.stretch_max,
        deep * 100.0,
        total.pinched_vertex_frames as f64 / total.vertex_frames.max(1) as f64 * 100.0,
        total.depth_max_m * 1e3
    );
    let kept = failed == 0 && total.stretch_max <= 0.15 && deep <= 0.001;
    if kept { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Times, and the frames with the longest edges and the most deep vertices.
fn report(
    scene: &explorer::scene::Scene,
    worst: &mut [(FrameQuality, EdgeId)],
    seconds: &mut [f32],
) {
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

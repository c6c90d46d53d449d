//! `toile codec contact`: how deep shown cloth is in the body, what hides it, and blends at merges.

use std::path::Path;

use anyhow::{Context, Result};
use client_lib::blend::{BLEND_FRAMES, Blend};
use client_lib::{BlendMode, StateId};
use explorer::cpu::CpuClock;
use explorer::pack::Bound;
use explorer::pack::bench::{Bench, Cleaned, Inside, Skin, Source};
use serde::Serialize;

use crate::{args, format};

/// Columns looked at.
const RANK_MAX: usize = 400;
/// Frames before a merge whose accelerations are counted with it.
const BEFORE: usize = 2;

/// The promised keys.
#[derive(Debug, Serialize)]
struct Outcome {
    bound_mm: f32,
    states: usize,
    exact: Depths,
    decoded: Depths,
    shrunk: Depths,
    shrunk_and_offset: Depths,
    shrink_mm_max: f32,
    depth_offset_mm_max: f32,
    merges: usize,
    blends: Vec<Blended>,
}

#[derive(Debug, Serialize)]
struct Depths {
    inside_share: f64,
    deeper_than_2mm_share: f64,
    max_mm: f32,
}

/// One way to blend. Accelerations are the largest of any vertex in a frame, in the state frame.
#[derive(Debug, Serialize)]
struct Blended {
    name: &'static str,
    /// Largest over the frames of a merge: median over merges (m/s^2).
    acceleration_p50_m_s2: f64,
    acceleration_p99_m_s2: f64,
    /// What the blend itself adds to the acceleration, the largest of any vertex and frame of a
    /// merge: median over merges (m/s^2).
    jump_p50_m_s2: f64,
    jump_p99_m_s2: f64,
    inside_share: f64,
    deeper_than_2mm_share: f64,
    max_mm: f32,
}

impl From<&Inside> for Depths {
    fn from(inside: &Inside) -> Self {
        let share = |count: u64| count as f64 / inside.vertices.max(1) as f64;
        Self {
            inside_share: share(inside.inside),
            deeper_than_2mm_share: share(inside.deep),
            max_mm: 1e3 * inside.max_m,
        }
    }
}

/// Measures and prints.
pub(crate) fn run(a: &args::CodecContact) -> Result<()> {
    let source = super::source(&a.store, a.work.as_ref(), Some(a.states))?;
    let clock = CpuClock::start();
    let (clock, say) = (|| clock.elapsed_s(), super::progress());
    let bench = Bench::with_rank(&source, RANK_MAX, &clock, &say)?;
    let bound = Bound { max_m: Some(a.bound_mm / 1e3), rms_m: None };
    let cleaned = bench.cleanup(bound)?.context("the store gives no body away")?;
    if let Some(file) = &a.out {
        write(file, &cleaned)?;
    }
    let (merges, blends) = blends(&source, a.merges)?;
    let most = |of: &[f32]| 1e3 * of.iter().copied().fold(0.0, f32::max);
    let outcome = Outcome {
        bound_mm: a.bound_mm,
        states: cleaned.states,
        exact: Depths::from(&cleaned.exact),
        decoded: Depths::from(&cleaned.decoded),
        shrunk: Depths::from(&cleaned.shrunk),
        shrunk_and_offset: Depths::from(&cleaned.offset),
        shrink_mm_max: most(&cleaned.cleanup.shrink_m),
        depth_offset_mm_max: most(&cleaned.cleanup.depth_offset_m),
        merges,
        blends,
    };
    if a.json {
        return format::print_json(&outcome);
    }
    println!(
        "{} held-out states, within {} mm   in the body  deeper than 2 mm   deepest",
        outcome.states, outcome.bound_mm
    );
    for (name, depths) in [
        ("as simulated", &outcome.exact),
        ("decoded", &outcome.decoded),
        ("... and a thinner body", &outcome.shrunk),
        ("... and a depth offset", &outcome.shrunk_and_offset),
    ] {
        let Depths { inside_share, deeper_than_2mm_share, max_mm } = depths;
        println!(
            "{name:<36} {:>10.3} % {:>15.3} % {max_mm:>6.2} mm",
            100.0 * inside_share,
            100.0 * deeper_than_2mm_share
        );
    }
    println!(
        "{merges} merges      acceleration p50, p99 (m/s^2)   jump p50, p99 (m/s^2)  in the body   > 2 mm"
    );
    for b in &outcome.blends {
        println!(
            "{:<22} {:>10.1} {:>10.1} {:>10.1} {:>10.1} {:>11.3} % {:>7.3} %",
            b.name,
            b.acceleration_p50_m_s2,
            b.acceleration_p99_m_s2,
            b.jump_p50_m_s2,
            b.jump_p99_m_s2,
            100.0 * b.inside_share,
            100.0 * b.deeper_than_2mm_share
        );
    }
    Ok(())
}

/// Two counts (u32), then the body's and the garment's numbers (f32, m), little-endian.
fn write(file: &Path, cleaned: &Cleaned) -> Result<()> {
    let (shrink, offset) = (&cleaned.cleanup.shrink_m, &cleaned.cleanup.depth_offset_m);
    let mut bytes = Vec::new();
    for count in [shrink.len(), offset.len()] {
        bytes.extend_from_slice(&(count as u32).to_le_bytes());
    }
    shrink.iter().chain(offset).for_each(|x| bytes.extend_from_slice(&x.to_le_bytes()));
    std::fs::write(file, bytes).with_context(|| format!("writing {}", file.display()))
}

/// A merge that can be followed for as long as its blend takes.
struct Merge {
    /// The states before the dead end, oldest first, and the dead end.
    before: Vec<StateId>,
    /// The state before the target, the target, and what follows it.
    target: Vec<StateId>,
}

/// The merge at a dead end, where its neighbours are of the same trajectories.
fn merge(source: &Source, dead_end: StateId) -> Option<Merge> {
    let target = source.merged_into(dead_end)?;
    let first = dead_end.0.checked_sub(BEFORE as u64)?;
    let before: Vec<StateId> = (first..=dead_end.0).map(StateId).collect();
    let mut walk = vec![StateId(target.0.checked_sub(1)?), target];
    while walk.len() < BLEND_FRAMES + 3 {
        walk.push(source.next_playable(*walk.last()?)?);
    }
    let straight = |run: &[StateId]| run.windows(2).all(|w| source.leads(w[0], w[1]));
    (straight(&before) && straight(&walk)).then_some(Merge { before, target: walk })
}

/// Plays merges spread over the graph with every way to blend.
fn blends(source: &Source, wanted: usize) -> Result<(usize, Vec<Blended>)> {
    let all: Vec<Merge> =
        (0..source.linked_states()).filter_map(|state| merge(source, StateId(state))).collect();
    let every = all.len().div_ceil(wanted.max(1)).max(1);
    let merges: Vec<&Merge> = all.iter().step_by(every).collect();
    let scene = source.scene().context("a store has a scene")?;
    let skin = Skin::new(scene).context("the store gives no body away")?;
    let ways = [
        ("no blend", BlendMode::Off, false),
        ("linear", BlendMode::Linear, false),
        ("smooth, offset alone", BlendMode::Smooth, false),
        ("inertialised", BlendMode::Smooth, true),
    ];
    let mut found: Vec<Played> = ways.iter().map(|_| Played::default()).collect();
    let fps = f64::from(scene.fps);
    for merge in &merges {
        let read = |states: &[StateId]| -> Result<Vec<Vec<f32>>> {
            let one = |state: &StateId| {
                let mut out = vec![0.0; 3 * source.vertices()];
                source.read_state(*state, &mut out).map(|()| out)
            };
            Ok(states.iter().map(one).collect::<std::io::Result<_>>()?)
        };
        let (before, target) = (read(&merge.before)?, read(&merge.target)?);
        let bodies: Vec<_> = merge.target[2..]
            .iter()
            .filter_map(|state| Some(skin.posed(source.pose(*state)?)))
            .collect();
        for ((_, mode, moving), played) in ways.iter().zip(&mut found) {
            let shown = play(&before, &target, *mode, *moving);
            played.largest.push(acceleration(&shown, fps));
            played.jumps.push(acceleration(&offsets(&shown, &target), fps));
            for (shown, body) in shown[BEFORE + 1..].iter().zip(&bodies) {
                skin.inside(body, shown, &mut played.inside);
            }
        }
    }
    let rows = ways.iter().zip(found).map(|((name, ..), played)| played.row(name));
    Ok((merges.len(), rows.collect()))
}

/// What is shown: the states before, the dead end (the target and all of the offset), and on.
fn play(before: &[Vec<f32>], target: &[Vec<f32>], mode: BlendMode, moving: bool) -> Vec<Vec<f32>> {
    let dead_end = &before[BEFORE];
    let mut blend = Blend::new(dead_end.len());
    blend.set_mode(mode);
    blend.add(dead_end, &target[1]);
    if moving {
        let own = dead_end.iter().zip(&before[BEFORE - 1]).map(|(now, then)| now - then);
        let its = target[1].iter().zip(&target[0]).map(|(now, then)| now - then);
        blend.add_velocity(own.zip(its).map(|(a, b)| a - b));
    }
    let mut shown = before[..BEFORE].to_vec();
    for state in &target[1..] {
        let mut state = state.clone();
        blend.apply(&mut state);
        blend.advance();
        shown.push(state);
    }
    shown
}

/// What shown cloth is off the trajectory that it is merged into, from the frame before the merge
/// on: its acceleration is what the merge adds to that of the cloth.
fn offsets(shown: &[Vec<f32>], target: &[Vec<f32>]) -> Vec<Vec<f32>> {
    let frames = shown[BEFORE - 1..].iter().zip(target);
    frames.map(|(shown, own)| shown.iter().zip(own).map(|(a, b)| a - b).collect()).collect()
}

/// The largest acceleration (m/s^2) of any vertex between the first frame and the last.
fn acceleration(frames: &[Vec<f32>], fps: f64) -> f64 {
    let mut largest = 0.0f64;
    for frames in frames.windows(3) {
        let [a, b, c] = [&frames[0], &frames[1], &frames[2]].map(|f| f.as_chunks::<3>().0);
        for ((a, b), c) in a.iter().zip(b).zip(c) {
            let square: f64 = (0..3)
                .map(|i| f64::from(a[i]) - 2.0 * f64::from(b[i]) + f64::from(c[i]))
                .map(|x| (x * fps * fps).powi(2))
                .sum();
            largest = largest.max(square);
        }
    }
    largest.sqrt()
}

#[derive(Default)]
struct Played {
    largest: Vec<f64>,
    jumps: Vec<f64>,
    inside: Inside,
}

impl Played {
    fn row(mut self, name: &'static str) -> Blended {
        let depths = Depths::from(&self.inside);
        let [p50, p99] = percentiles(&mut self.largest);
        let [jump_p50_m_s2, jump_p99_m_s2] = percentiles(&mut self.jumps);
        Blended {
            name,
            acceleration_p50_m_s2: p50,
            acceleration_p99_m_s2: p99,
            jump_p50_m_s2,
            jump_p99_m_s2,
            inside_share: depths.inside_share,
            deeper_than_2mm_share: depths.deeper_than_2mm_share,
            max_mm: depths.max_mm,
        }
    }
}

/// The median and the 99th percentile.
fn percentiles(of: &mut [f64]) -> [f64; 2] {
    of.sort_by(f64::total_cmp);
    let last = of.len().saturating_sub(1) as f64;
    [0.5, 0.99].map(|share| of.get((share * last).round() as usize).copied().unwrap_or(0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two straight trajectories, the second at rest, 1 m apart and 0.03 m a frame.
    fn shown(mode: BlendMode, moving: bool) -> Vec<Vec<f32>> {
        let before: Vec<Vec<f32>> =
            (0..=BEFORE).map(|k| vec![1.0 + 0.03 * (k as f32 - BEFORE as f32), 0.0, 0.0]).collect();
        let target = vec![vec![0.0; 3]; BLEND_FRAMES + 3];
        let shown = play(&before, &target, mode, moving);
        if mode != BlendMode::Off {
            assert_eq!(shown[BEFORE], before[BEFORE], "the dead end itself comes first");
        }
        assert_eq!(shown.last(), target.last());
        offsets(&shown, &target)
    }

    #[test]
    fn a_velocity_taken_up_makes_the_jump_smaller() {
        let jump = |mode, moving| acceleration(&shown(mode, moving), 1.0);
        let none = jump(BlendMode::Off, false);
        let linear = jump(BlendMode::Linear, false);
        let smooth = jump(BlendMode::Smooth, false);
        let inertialised = jump(BlendMode::Smooth, true);
        assert!((linear - 0.13).abs() < 1e-4, "{linear}");
        assert!(inertialised < linear && smooth < linear && linear < none);
        // At the merge itself, where the others bend at once.
        let first = |mode, moving| acceleration(&shown(mode, moving)[..3], 1.0);
        assert!(first(BlendMode::Smooth, true) < 0.5 * first(BlendMode::Smooth, false));
    }
}

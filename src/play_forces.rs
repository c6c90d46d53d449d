//! What `toile play` does to the cloth beside walking, and how that is seen: pushes, wind, and the
//! steps of vertices where the graph is left and entered.

use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use client_lib::{Character, Histogram, Push};
use glam::Vec3;
use serde::Serialize;

use crate::args;

/// A push: a gust of this acceleration (m/s^2) for this many frames.
const PUSH_M_S2: f32 = 30.0;
const PUSH_FRAMES: u32 = 4;
/// It reaches this far around the hips (m).
const PUSH_RADIUS_M: f32 = 1.2;

/// Forces of a walk, and what came of them.
pub struct Forces {
    push_every: u64,
    wind: Option<Vec3>,
    frames: u64,
    before: Vec<f32>,
    was_outside: bool,
    graph: Histogram,
    outside: Histogram,
    left_m: f32,
    entered_m: f32,
}

/// Frames outside the graph, and the largest way of a vertex from frame to frame, seen from the hips:
/// in the graph, outside, and where one goes over into the other.
#[derive(Debug, Serialize)]
pub struct Seams {
    outside: u64,
    left: u64,
    entered: u64,
    step_graph_mm_max: f64,
    step_outside_mm_max: f64,
    step_leaving_mm: f32,
    step_entering_mm: f32,
}

impl Forces {
    /// As asked for on the command line; none at all is fine.
    pub fn new(a: &args::Play) -> Self {
        Self {
            push_every: a.push_every.unwrap_or(0),
            wind: a.wind.map(|m_s| Vec3::new(m_s, 0.0, 0.0)),
            frames: a.frames,
            before: Vec::new(),
            was_outside: false,
            graph: Histogram::default(),
            outside: Histogram::default(),
            left_m: 0.0,
            entered_m: 0.0,
        }
    }

    /// Waits for the upsampler, where forces are asked for.
    ///
    /// # Errors
    /// The garment has none.
    pub fn wait(&self, character: &mut Character, limit: Duration) -> Result<()> {
        if self.push_every == 0 && self.wind.is_none() {
            return Ok(());
        }
        let start = Instant::now();
        while !character.can_leave() {
            let listed = character.version().listing().upsampler.is_some();
            ensure!(
                listed && start.elapsed() < limit,
                "this version of garment \"{}\" has no upsampler, so no force moves its cloth; \
                 publish one with `toile explore --upsampler`",
                character.version().listing().name
            );
            std::thread::sleep(Duration::from_millis(20));
            character.refresh();
        }
        Ok(())
    }

    /// Before a step: the wind blows in the middle third of the walk, pushes come from changing sides.
    pub fn act(&self, character: &mut Character, frame: u64) {
        if let Some(wind) = self.wind {
            let blows = (self.frames / 3..2 * self.frames / 3).contains(&frame);
            character.set_wind(if blows { wind.to_array() } else { [0.0; 3] });
        }
        if self.push_every > 0 && frame % self.push_every == self.push_every / 2 {
            let turn = 2.4 * (frame / self.push_every) as f32;
            let acceleration = Vec3::new(turn.cos(), 0.2, turn.sin()) * PUSH_M_S2;
            let at = character.placement().translation;
            let (radius_m, frames) = (PUSH_RADIUS_M, PUSH_FRAMES);
            character.push(Push { at, radius_m, acceleration, frames });
        }
    }

    /// After a step: what was shown, in the state frame (m).
    pub fn see(&mut self, character: &Character, rows: &[f32]) {
        let is_outside = character.outside().is_some();
        if self.before.len() == rows.len() {
            let square = |(a, b): (&[f32], &[f32])| {
                a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f32>()
            };
            let pairs = rows.chunks_exact(3).zip(self.before.chunks_exact(3));
            let step_m = pairs.map(square).fold(0.0, f32::max).sqrt();
            match (self.was_outside, is_outside) {
                (false, false) => self.graph.record(f64::from(step_m)),
                (true, true) => self.outside.record(f64::from(step_m)),
                (false, true) => self.left_m = self.left_m.max(step_m),
                (true, false) => self.entered_m = self.entered_m.max(step_m),
            }
        }
        self.before.clear();
        self.before.extend_from_slice(rows);
        self.was_outside = is_outside;
    }

    /// In figures.
    pub fn seams(&self, character: &Character) -> Seams {
        let stats = character.stats();
        Seams {
            outside: stats.outside,
            left: stats.left,
            entered: stats.entered,
            step_graph_mm_max: self.graph.max() * 1e3,
            step_outside_mm_max: self.outside.max() * 1e3,
            step_leaving_mm: self.left_m * 1e3,
            step_entering_mm: self.entered_m * 1e3,
        }
    }
}

/// For people; nothing where the graph was never left.
pub fn print(s: &Seams) {
    if s.left > 0 {
        println!(
            "outside the graph {} frames: left {} times, back {}; a vertex goes at most {:.1} mm in \
             the frame of leaving, {:.1} mm in that of entering, {:.1} mm in frames of the graph",
            s.outside,
            s.left,
            s.entered,
            s.step_leaving_mm,
            s.step_entering_mm,
            s.step_graph_mm_max
        );
    }
}

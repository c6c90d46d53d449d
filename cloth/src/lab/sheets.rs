//! S1 and S2, the scenes on which other simulators were measured, and what refinement does to S1.

use glam::Vec3;

use super::shapes::{Cut, ellipsoids, sheet};
use super::{Bench, LabError, Limit, Setting, Sim, Stage};
use crate::body::Pose;
use crate::material::Material;
use crate::measure;
use crate::model::{Environment, Model};

pub(crate) const S1: Bench = Bench {
    name: "S1",
    about: "sheet of 1 m x 1 m, 0.2 kg/m2, 1000 N/m, two corners pinned, released flat, 2 s",
    reference: "other simulators: docs/results/peers.md",
    fast: false,
    reads: Setting::ALL,
    run: pinned,
};

pub(crate) const S2: Bench = Bench {
    name: "S2",
    about: "the same sheet dropped 5 cm onto a ball of 0.25 m, friction 0.3, 2 s",
    reference: "other simulators: docs/results/peers.md",
    fast: false,
    reads: Setting::ALL,
    run: on_ball,
};

pub(crate) const B1: Bench = Bench {
    name: "B1",
    about: "S1 at 32 x 32 with the step halved twice, first 0.6 s",
    reference: "the same run at a quarter of the finest step",
    fast: false,
    reads: &[Setting::N, Setting::Vertices, Setting::Fabric],
    run: halved_steps,
};

pub(crate) const B2: Bench = Bench {
    name: "B2",
    about: "S1 on 10 x 10 to 173 x 173 vertices",
    reference: "the finest mesh",
    fast: false,
    reads: &[Setting::Fabric, Setting::Dt],
    run: finer_meshes,
};

const FRAME_S: f32 = 1.0 / 60.0;
const FRAMES: u32 = 120;
const BALL_M: f32 = 0.25;
const DROP_M: f32 = 0.05;

/// The peers' sheet has no air and no damping of its own.
pub(crate) fn material() -> Material {
    Material { drag: 0.0, damping_s: 0.0, shear: 385.0, bend: 1e-4, ..Material::default() }
}

/// S1 with `n` vertices a side, on the stage.
pub(crate) fn pinned_sheet(
    stage: &mut Stage<'_>,
    n: u32,
    material: Material,
    frame_s: f32,
) -> Result<Sim, LabError> {
    let mesh = sheet(n - 1, n - 1, Cut::Alternating, |u, v| Vec3::new(u, 0.0, v))?;
    let model = Model::new(mesh, material, Environment::default(), None, &[0, n - 1])?;
    Ok(stage.sim(model, frame_s))
}

/// S1's material, or the fabric that was asked for.
pub(crate) fn pinned_material(stage: &Stage<'_>) -> Material {
    stage.material(material())
}

/// Stretch is that of the frame in which the sheet is lowest, as the peers were measured.
struct Lowest {
    lowest_m: f32,
    p99: f32,
    max: f32,
}

impl Lowest {
    fn new() -> Self {
        Self { lowest_m: f32::INFINITY, p99: 0.0, max: 0.0 }
    }

    fn look(&mut self, sim: &Sim) {
        let (mesh, at) = (sim.model.mesh(), &sim.state.positions);
        let low = at.iter().map(|p| p.y).fold(f32::INFINITY, f32::min);
        if low < self.lowest_m {
            self.lowest_m = low;
            self.p99 = measure::stretch_quantile(mesh, at, 0.99);
            self.max = measure::stretch_max(mesh, at);
        }
    }
}

fn pinned(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let n = stage.side(32);
    let material = pinned_material(stage);
    let mut sim = pinned_sheet(stage, n, material, FRAME_S)?;
    sim.hits_every = 30;
    let mut lowest = Lowest::new();
    for _ in 0..FRAMES {
        stage.step(&mut sim, None)?;
        lowest.look(&sim);
    }
    stage.tally.stretch_p99 = lowest.p99;
    stage.tally.stretch_max = lowest.max;
    let p99 = 100.0 * f64::from(lowest.p99);
    let law = "converged: 1.3 to 1.9 %";
    stage.row("p99 stretch where it is lowest", p99, "%", law, Limit::AtMost(2.0));
    let speed = f64::from(stage.tally.speed_max_m_s);
    stage.row("fastest vertex", speed, "m/s", "2 sqrt(2 g h)", Limit::AtMost(8.86));
    Ok(())
}

/// S2 with `n` vertices a side, on the stage, and the pose in which the ball stays.
pub(crate) fn ball_sheet(stage: &mut Stage<'_>, n: u32) -> Result<(Sim, Pose), LabError> {
    let top = DROP_M + BALL_M;
    let place = |u: f32, v: f32| Vec3::new(u - 0.5, top, v - 0.5);
    let mesh = sheet(n - 1, n - 1, Cut::Alternating, place)?;
    let body = ellipsoids(&[(Vec3::ZERO, Vec3::splat(BALL_M))], 48);
    let pose = body.skeleton.rest_pose();
    let material = stage.material(material());
    let model = Model::new(mesh, material, Environment::default(), Some(body), &[])?;
    Ok((stage.sim(model, FRAME_S), pose))
}

fn on_ball(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let n = stage.side(32);
    let (mut sim, pose) = ball_sheet(stage, n)?;
    sim.hits_every = 10;
    let mut lowest = Lowest::new();
    for _ in 0..FRAMES {
        stage.step(&mut sim, Some((&pose, &pose)))?;
        lowest.look(&sim);
        // The true ball, not its facets.
        let depth = sim.state.positions.iter().map(|p| BALL_M - p.length()).fold(0.0, f32::max);
        stage.tally.penetration_m = Some(stage.tally.penetration_m.map_or(depth, |m| m.max(depth)));
    }
    // Heights count from the release, as the peers' do.
    stage.tally.lowest_m -= DROP_M + BALL_M;
    stage.tally.stretch_p99 = lowest.p99;
    stage.tally.stretch_max = lowest.max;
    let t = stage.tally;
    let reference = "0";
    stage.row("self hits", t.self_hits.unwrap_or(0) as f64, "", reference, Limit::AtMost(0.0));
    let depth = 1e3 * f64::from(t.penetration_m.unwrap_or(0.0));
    stage.row("penetration", depth, "mm", reference, Limit::AtMost(0.0));
    let p99 = 100.0 * f64::from(t.stretch_p99);
    stage.row("p99 stretch where it is lowest", p99, "%", "about 1 %", Limit::AtMost(2.0));
    Ok(())
}

/// S1 at one step: positions after each 1/60 s, and the largest p99 stretch.
fn trace(
    stage: &mut Stage<'_>,
    n: u32,
    dt_s: f32,
    frames: u32,
) -> Result<(Vec<Vec3>, f32), LabError> {
    let material = pinned_material(stage);
    let mut sim = pinned_sheet(stage, n, material, FRAME_S)?;
    sim.dt_s = dt_s;
    let (mut all, mut p99) = (Vec::new(), 0.0f32);
    for _ in 0..frames {
        stage.step(&mut sim, None)?;
        all.extend_from_slice(&sim.state.positions);
        let now = measure::stretch_quantile(sim.model.mesh(), &sim.state.positions, 0.99);
        p99 = p99.max(now);
    }
    Ok((all, p99))
}

fn rms_mm(a: &[Vec3], b: &[Vec3]) -> f64 {
    let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a.distance_squared(*b))).sum();
    1e3 * (sum / a.len() as f64).sqrt()
}

fn halved_steps(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let n = stage.side(32);
    let frames = 36;
    let (exact, fine_p99) = trace(stage, n, 1.0 / 960.0, frames)?;
    let (half, half_p99) = trace(stage, n, 1.0 / 240.0, frames)?;
    let (full, full_p99) = trace(stage, n, 1.0 / 120.0, frames)?;
    let (coarse, fine) = (rms_mm(&full, &exact), rms_mm(&half, &exact));
    let reference = "own run at dt 1.04 ms";
    stage.row("rms at dt 8.3 ms", coarse, "mm", reference, Limit::AtMost(40.0));
    stage.row("rms at dt 4.2 ms", fine, "mm", reference, Limit::AtMost(12.0));
    let ratio = if fine > 0.0 { coarse / fine } else { f64::INFINITY };
    stage.row("error ratio per halving", ratio, "", "2 at first order", Limit::AtLeast(1.6));
    let moved = (full_p99 - fine_p99).abs().max((half_p99 - fine_p99).abs());
    let moved = 100.0 * f64::from(moved);
    stage.row("p99 stretch moves by", moved, "points", reference, Limit::AtMost(0.5));
    Ok(())
}

fn finer_meshes(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let sizes: &[u32] = if stage.quick() { &[10, 20, 40] } else { &[10, 32, 100, 173] };
    let mut found = Vec::new();
    for &n in sizes {
        let material = pinned_material(stage);
        let mut sim = pinned_sheet(stage, n, material, FRAME_S)?;
        let mut lowest = Lowest::new();
        // It is lowest after about 0.55 s.
        for _ in 0..48 {
            stage.step(&mut sim, None)?;
            lowest.look(&sim);
        }
        found.push(f64::from(lowest.p99));
    }
    let finest = found[found.len() - 1];
    let reference = format!("{:.2} % at n = {}", 100.0 * finest, sizes[sizes.len() - 1]);
    for (n, p99) in sizes.iter().zip(&found) {
        let apart = (p99 / finest).max(finest / p99);
        let what = format!("p99 against the finest, n = {n}");
        stage.row(what, apart, "", reference.clone(), Limit::AtMost(1.5));
    }
    let speed = f64::from(stage.tally.speed_max_m_s);
    stage.row("fastest vertex", speed, "m/s", "2 sqrt(2 g h)", Limit::AtMost(8.86));
    Ok(())
}

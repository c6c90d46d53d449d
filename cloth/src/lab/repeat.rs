//! D2 and D3: what a graph of states depends on. A state restarts bit for bit, and nothing but
//! the inputs decides.

use glam::Vec3;

use super::shapes::{Cut, ellipsoids, pose_at, sheet};
use super::{Bench, LabError, Limit, Setting, Sim, Stage};
use crate::material::Material;
use crate::model::{Environment, Model, State};

pub(crate) const D2: Bench = Bench {
    name: "D2",
    about: "sheet swept by a ball, stopped after each frame and restarted from its state",
    reference: "the uninterrupted run, bit for bit",
    fast: true,
    reads: Setting::ALL,
    run: restart,
};

pub(crate) const D3: Bench = Bench {
    name: "D3",
    about: "the same input twice, after other work in the same memory",
    reference: "bit-identical (on two threads: cargo test -p cloth)",
    fast: true,
    reads: Setting::ALL,
    run: repeat,
};

const FRAMES: u32 = 20;

fn stage_sheet(stage: &mut Stage<'_>) -> Result<Sim, LabError> {
    let n = stage.side(31) - 1;
    let mesh = sheet(n, n, Cut::Alternating, |u, v| Vec3::new(u - 0.5, 1.0 - v, 0.0))?;
    let body = ellipsoids(&[(Vec3::new(0.0, 0.4, -0.3), Vec3::splat(0.1))], 16);
    let held: Vec<u32> = (0..=n).collect();
    let material = stage.material(Material::default());
    let model = Model::new(mesh, material, Environment::default(), Some(body), &held)?;
    Ok(stage.sim(model, 1.0 / 30.0))
}

/// Lets frame number `frame` pass: the ball flies through the sheet at 3 m/s.
fn frame(stage: &mut Stage<'_>, sim: &mut Sim, frame: u32) -> Result<(), LabError> {
    let body = ellipsoids(&[(Vec3::new(0.0, 0.4, -0.3), Vec3::splat(0.1))], 16);
    let at = |f: u32| pose_at(&body, Vec3::new(0.0, 0.4, -0.3 + 0.1 * f as f32));
    stage.step(sim, Some((&at(frame), &at(frame + 1))))
}

fn through(stage: &mut Stage<'_>, fresh: bool) -> Result<State, LabError> {
    let mut sim = stage_sheet(stage)?;
    for f in 0..FRAMES {
        frame(stage, &mut sim, f)?;
        if fresh {
            // All that goes on is positions and velocities.
            let state = sim.state.clone();
            sim = stage_sheet(stage)?;
            sim.state = state;
        }
    }
    Ok(sim.state)
}

fn different(a: &State, b: &State) -> f64 {
    let bits = |s: &State| -> Vec<u32> {
        let all = s.positions.iter().chain(&s.velocities);
        all.flat_map(|v| v.to_array().map(f32::to_bits)).collect()
    };
    bits(a).iter().zip(&bits(b)).filter(|(x, y)| x != y).count() as f64
}

fn restart(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let (whole, cut) = (through(stage, false)?, through(stage, true)?);
    let figure = different(&whole, &cut);
    stage.row("numbers that differ", figure, "", "bit-identical", Limit::AtMost(0.0));
    Ok(())
}

fn repeat(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let first = through(stage, false)?;
    let mut sim = stage_sheet(stage)?;
    for f in (0..FRAMES).rev() {
        frame(stage, &mut sim, f)?;
    }
    sim.state = sim.model.rest_state();
    for f in 0..FRAMES {
        frame(stage, &mut sim, f)?;
    }
    let figure = different(&first, &sim.state);
    stage.row("numbers that differ", figure, "", "bit-identical", Limit::AtMost(0.0));
    Ok(())
}

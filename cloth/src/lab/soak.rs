//! D1: a long walk without anybody watching.

use glam::Vec3;

use super::shapes::{Chance, Cut, ellipsoids, pose_at, sheet};
use super::{Bench, LabError, Limit, Setting, Stage};
use crate::material::Material;
use crate::measure;
use crate::model::{Environment, Model};

pub(crate) const D1: Bench = Bench {
    name: "D1",
    about: "soak: a hanging sheet of 2,025 vertices, 2,000 frames among two balls moving by chance",
    reference: "the whole size: toile simulate --soak",
    fast: false,
    reads: &[Setting::N, Setting::Vertices, Setting::Fabric],
    run: soak,
};

/// A frame over this strain (an edge) or speed is taken back and tried at half the step.
const STRAIN_MAX: f32 = 0.15;
const SPEED_MAX_M_S: f32 = 30.0;

fn soak(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let n = stage.side(45) - 1;
    let frames = if stage.quick() { 300 } else { 2000 };
    let mesh = sheet(n, n, Cut::Alternating, |u, v| Vec3::new(u - 0.5, 1.2 - v, 0.0))?;
    let parts = [
        (Vec3::new(0.0, 0.6, 0.4), Vec3::splat(0.15)),
        (Vec3::new(0.35, 0.6, 0.4), Vec3::splat(0.1)),
    ];
    let body = ellipsoids(&parts, 16);
    let held: Vec<u32> = (0..=n).collect();
    let material = stage.material(Material::default());
    let environment = Environment { ground: true, ..Environment::default() };
    let model = Model::new(mesh, material, environment, Some(body.clone()), &held)?;
    let mut sim = stage.sim(model, 1.0 / 30.0);
    sim.hits_every = 10;
    let mut chance = Chance::new(1);
    let (mut at, mut way) = (parts[0].0, Vec3::ZERO);
    let (mut costs, mut retried, mut flagged, mut crossed) = (Vec::new(), 0u32, 0u32, 0u32);
    for _ in 0..frames {
        let push = Vec3::new(chance.signed(), chance.signed(), chance.signed());
        way = (way * 0.9 + push * 0.03 - (at - Vec3::Y * 0.6) * 0.02).clamp_length_max(0.12);
        let (from, to) = (pose_at(&body, at), pose_at(&body, at + way));
        at += way;
        let start = sim.state.clone();
        let cost = stage.tally.cpu_s;
        let mut good = false;
        for (tries, dt_s) in [(0, 1.0 / 120.0), (1, 1.0 / 240.0), (2, 1.0 / 480.0)] {
            sim.dt_s = dt_s;
            retried += u32::from(tries == 1);
            let done = stage.step(&mut sim, Some((&from, &to)));
            if matches!(done, Err(LabError::Stopped)) {
                return done;
            }
            let fastest = sim.state.velocities.iter().map(|v| v.length()).fold(0.0, f32::max);
            let long = measure::stretch_max(sim.model.mesh(), &sim.state.positions);
            good = done.is_ok() && fastest < SPEED_MAX_M_S && long < STRAIN_MAX;
            if good {
                break;
            }
            sim.state.clone_from(&start);
        }
        flagged += u32::from(!good);
        costs.push(stage.tally.cpu_s - cost);
        crossed += u32::from(std::mem::take(&mut stage.hits) > 0);
    }
    costs.sort_by(f64::total_cmp);
    let median = costs[costs.len() / 2].max(1e-9);
    let slow = costs.iter().filter(|c| **c > 10.0 * median).count();
    let share = f64::from(flagged) / f64::from(frames);
    let of = format!("of {frames} frames");
    stage.row("frames over 10 times the median time", slow as f64, "", &of[..], Limit::AtMost(0.0));
    stage.row(
        "frames retried",
        f64::from(retried),
        "",
        &of[..],
        Limit::AtMost(0.01 * f64::from(frames)),
    );
    stage.row("share of frames flagged", share, "", "1 in 100,000", Limit::AtMost(1e-5));
    let looked = format!("of {} frames looked at", frames / 10);
    stage.row("frames with crossings", f64::from(crossed), "", looked, Limit::AtMost(0.0));
    Ok(())
}

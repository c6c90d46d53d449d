//! A1 and A9: falling freely, and at the speed that air allows.

use glam::Vec3;

use super::shapes::{Cut, sheet};
use super::{Bench, LabError, Limit, Setting, Stage};
use crate::material::Material;
use crate::measure;
use crate::model::{Environment, Model};

pub(crate) const A1: Bench = Bench {
    name: "A1",
    about: "free fall of a sheet for 1 s, without air",
    reference: "z = -g t^2 / 2",
    fast: true,
    reads: Setting::ALL,
    run: free_fall,
};

pub(crate) const A9: Bench = Bench {
    name: "A9",
    about: "terminal speed of a horizontal sheet, drag 1.28",
    reference: "v = sqrt(2 s g / (rho Cd)): 1.58 m/s for 0.2 kg/m2",
    fast: true,
    reads: Setting::ALL,
    run: terminal_speed,
};

fn free_fall(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let n = stage.side(11) - 1;
    let mesh = sheet(n, n, Cut::Alternating, |u, v| Vec3::new(u, 0.0, v))?;
    let material = Material { drag: 0.0, ..stage.material(Material::default()) };
    let model = Model::new(mesh, material, Environment::default(), None, &[])?;
    let mut sim = stage.sim(model, 1.0 / 30.0);
    for _ in 0..30 {
        stage.step(&mut sim, None)?;
    }
    let error = |p: &Vec3| f64::from((p.y + 0.5 * 9.81).abs());
    let worst = sim.state.positions.iter().map(error).fold(0.0, f64::max);
    // Implicit Euler falls g t dt / 2 further.
    let allowed = 9.81 * f64::from(sim.substep_s()) / 2.0 * 1.05;
    let law = "z = -g t^2 / 2, off by at most 1.05 g t dt / 2";
    stage.row("error after 1 s", 1e3 * worst, "mm", law, Limit::AtMost(1e3 * allowed));
    let strain = measure::stretch_max(sim.model.mesh(), &sim.state.positions).abs();
    // Each substep rounds coordinates up to 1 m to 2^-25 m: by chance, 120 of them move the ends of
    // an edge of 0.1 m apart by sqrt(240) 2^-25 m, 5e-6 of its length. (The table asks for 1e-6,
    // which f32 positions cannot tell.)
    let rounding = "none; f32 positions tell 5e-6";
    stage.row("largest strain", f64::from(strain), "", rounding, Limit::AtMost(1e-5));
    Ok(())
}

fn terminal_speed(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let n = stage.side(11) - 1;
    let mesh = sheet(n, n, Cut::Alternating, |u, v| Vec3::new(u, 0.0, v))?;
    let material = stage.material(Material::default());
    let model = Model::new(mesh, material, Environment::default(), None, &[])?;
    let mut sim = stage.sim(model, 1.0 / 30.0);
    for _ in 0..60 {
        stage.step(&mut sim, None)?;
    }
    let middle = sim.state.velocities[(n / 2 * (n + 1) + n / 2) as usize].y;
    let weight = 2.0 * material.density * 9.81;
    let law = -f64::from((weight / (1.225 * material.drag)).sqrt());
    let error = 100.0 * (f64::from(middle) / law - 1.0).abs();
    let reference = format!("{:.3} m/s", -law);
    stage.row("error of the speed after 2 s", error, "%", reference, Limit::AtMost(2.0));
    Ok(())
}

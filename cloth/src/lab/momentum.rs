//! A12: a crumpled sheet that drifts and spins in empty space keeps its momentum.

use std::f32::consts::TAU;

use glam::Vec3;

use super::shapes::{Cut, sheet};
use super::{Bench, LabError, Limit, Setting, Sim, Stage};
use crate::material::Material;
use crate::model::{Environment, Model};

pub(crate) const A12: Bench = Bench {
    name: "A12",
    about: "crumpled sheet without gravity, drifting, spinning at 3 and 6.28 rad/s, 5 s",
    reference: "linear momentum exact; backward Euler loses W^2 dt / 2 of the angular per s",
    fast: true,
    reads: Setting::ALL,
    run: drifting,
};

fn drifting(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let n = stage.side(17) - 1;
    let seconds = if stage.quick() { 2.0 } else { 5.0 };
    let damped = Material::default().damping_s;
    for (spin, damping_s) in [(3.0f32, 0.0), (TAU, 0.0), (TAU, damped)] {
        let mut sim = crumpled(stage, n, spin, damping_s)?;
        let with = if damping_s > 0.0 { ", default damping" } else { "" };
        let (linear, angular) = momenta(&sim);
        while sim.time_s < seconds - 1e-3 {
            stage.step(&mut sim, None)?;
        }
        let (linear_after, angular_after) = momenta(&sim);
        let apart = length(minus(linear_after, linear)) / length(linear);
        let what = format!("linear momentum lost per s at {spin:.2} rad/s{with}");
        let figure = apart / f64::from(seconds);
        stage.row(what, figure, "", "exact", Limit::AtMost(1e-6));
        let lost = 100.0
            * (1.0 - (length(angular_after) / length(angular)).powf(1.0 / f64::from(seconds)));
        let euler = 50.0 * f64::from(spin * spin * sim.substep_s());
        let what = format!("angular momentum lost per s at {spin:.2} rad/s{with}");
        let reference = format!("backward Euler: {euler:.2} %");
        stage.row(what, lost.abs(), "%", reference, Limit::AtMost(1.2 * euler));
    }
    Ok(())
}

/// A sheet laid in waves in both directions and rolled, drifting at 1 m/s.
fn crumpled(stage: &mut Stage<'_>, n: u32, spin: f32, damping_s: f32) -> Result<Sim, LabError> {
    let mesh = sheet(n, n, Cut::Alternating, |u, v| Vec3::new(0.5 * u, 0.0, 0.5 * v))?;
    let material = Material { drag: 0.0, damping_s, ..stage.material(Material::default()) };
    let environment = Environment { gravity: Vec3::ZERO, ..Environment::default() };
    let model = Model::new(mesh, material, environment, None, &[])?;
    let mut sim = stage.sim(model, 1.0 / 30.0);
    // An isometric roll: arc length goes round a spiral of 8 to 14 cm.
    for p in &mut sim.state.positions {
        let radius = 0.08 + 0.12 * p.x;
        let angle = ((0.08 + 0.12 * p.x) / 0.08).ln() / 0.12;
        *p = Vec3::new(radius * angle.cos(), radius * angle.sin(), p.z);
    }
    let count = sim.state.positions.len() as f32;
    let centre = sim.state.positions.iter().copied().sum::<Vec3>() / count;
    let axis = Vec3::new(0.36, 0.48, 0.8) * spin;
    for (v, p) in sim.state.velocities.iter_mut().zip(&sim.state.positions) {
        *v = Vec3::X + axis.cross(*p - centre);
    }
    Ok(sim)
}

fn momenta(sim: &Sim) -> ([f64; 3], [f64; 3]) {
    let masses = sim.model.mesh().vertex_areas().iter().map(|a| f64::from(*a));
    let (mut mass, mut at, mut linear) = (0.0, [0.0; 3], [0.0; 3]);
    let state = || sim.state.positions.iter().zip(&sim.state.velocities);
    for (m, (p, v)) in masses.clone().zip(state()) {
        mass += m;
        for k in 0..3 {
            at[k] += m * f64::from(p[k]);
            linear[k] += m * f64::from(v[k]);
        }
    }
    let centre = at.map(|x| x / mass);
    let mut angular = [0.0; 3];
    for (m, (p, v)) in masses.zip(state()) {
        let r = minus(p.to_array().map(f64::from), centre);
        let v = v.to_array().map(f64::from);
        angular[0] += m * (r[1] * v[2] - r[2] * v[1]);
        angular[1] += m * (r[2] * v[0] - r[0] * v[2]);
        angular[2] += m * (r[0] * v[1] - r[1] * v[0]);
    }
    (linear, angular)
}

fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

fn length(a: [f64; 3]) -> f64 {
    (a[0] * a[0] + a[1] * a[1] + a[2] * a[2]).sqrt()
}

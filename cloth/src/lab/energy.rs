//! A13: the energy of S1, which may only fall, and by no more than integration takes.

use glam::{Vec2, Vec3A};

use super::sheets::{pinned_material, pinned_sheet};
use super::{Bench, LabError, Limit, Setting, Sim, Stage};
use crate::solver::membrane::{LIMIT_FACTOR, SOFT_STRAIN};

pub(crate) const A13: Bench = Bench {
    name: "A13",
    about: "total energy of S1 during its first fall (0.84 s), at two steps",
    reference: "never rises; backward Euler loses 1 - exp(-w^2 dt t), w = 3.76 rad/s",
    fast: true,
    reads: &[Setting::N, Setting::Vertices, Setting::Fabric],
    run: falling_energy,
};

/// Motion (J), height (J) and cloth (J) together.
pub(crate) fn total(sim: &Sim) -> f64 {
    let m = sim.model.material();
    let areas = sim.model.mesh().vertex_areas();
    let state = sim.state.positions.iter().zip(&sim.state.velocities);
    let free: f64 = areas
        .iter()
        .zip(state)
        .map(|(area, (p, v))| {
            let mass = f64::from(*area) * f64::from(m.density);
            mass * (0.5 * f64::from(v.length_squared()) + 9.81 * f64::from(p.y))
        })
        .sum();
    free + membrane(sim) + sim.model.bending.energy(&wide(sim))
}

fn wide(sim: &Sim) -> Vec<Vec3A> {
    sim.state.positions.iter().map(|p| Vec3A::from(*p)).collect()
}

/// The energy whose forces `solver/membrane.rs` takes, from its principal stretches, in f64.
fn membrane(sim: &Sim) -> f64 {
    let mesh = sim.model.mesh();
    let material = sim.model.material();
    let k = material.membrane();
    let stiffest = material.weft.map_or(material.stretch, |weft| weft.max(material.stretch));
    let [mu, lambda, warp, weft, shear, limit] =
        [k.mu, k.lambda, k.warp, k.weft, k.shear, LIMIT_FACTOR * stiffest].map(f64::from);
    let soft = 1.0 + f64::from(SOFT_STRAIN);
    let shapes = mesh.shape_gradients().iter().zip(mesh.rest_areas());
    let of_triangle = |(t, (gradients, area)): (&[u32; 3], (&[Vec2; 3], &f32))| {
        let image = |part: fn(&Vec2) -> f32| -> [f64; 3] {
            std::array::from_fn(|axis| {
                let corners = t.iter().zip(gradients);
                corners
                    .map(|(v, g)| {
                        f64::from(sim.state.positions[*v as usize][axis]) * f64::from(part(g))
                    })
                    .sum()
            })
        };
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let (w, f) = (image(|g| g.x), image(|g| g.y));
        let (ww, ff, wf) = (dot(w, w), dot(f, f), dot(w, f));
        let (mean, radius) = (0.5 * (ww + ff), (0.25 * (ww - ff) * (ww - ff) + wf * wf).sqrt());
        let s = [(mean + radius).sqrt(), (mean - radius).max(0.0).sqrt()];
        let over = s.map(|s| (s - soft).max(0.0).powi(2)).iter().sum::<f64>();
        let stretch = s.map(|s| (s - 1.0).powi(2)).iter().sum::<f64>();
        let plain = mu * stretch + 0.5 * lambda * (s[0] + s[1] - 2.0).powi(2) + 0.5 * limit * over;
        let spring = |k: f64, squared: f64| 0.5 * k * (squared.sqrt() - 1.0).powi(2);
        let cosine = wf / (ww * ff).sqrt().max(1e-12);
        f64::from(*area)
            * (plain + spring(warp, ww) + spring(weft, ff) + 0.5 * shear * cosine * cosine)
    };
    mesh.triangles().iter().zip(shapes).map(of_triangle).sum()
}

fn falling_energy(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let n = stage.side(32);
    let mut lost = Vec::new();
    for dt_s in [1.0 / 120.0, 1.0 / 240.0] {
        let material = pinned_material(stage);
        let weight = 9.81 * f64::from(material.density);
        let mut sim = pinned_sheet(stage, n, material, 1.0 / 60.0)?;
        sim.dt_s = dt_s;
        let start = total(&sim);
        let (mut before, mut rise) = (start, 0.0f64);
        for _ in 0..50 {
            stage.step(&mut sim, None)?;
            let now = total(&sim);
            rise = rise.max(now - before);
            before = now;
        }
        let seconds = f64::from(sim.time_s);
        let step = f64::from(sim.substep_s());
        let rise = 100.0 * rise * 60.0 / weight;
        let what = format!("fastest rise per s at dt {:.1} ms", 1e3 * step);
        stage.row(what, rise, "% of m g L", "none", Limit::AtMost(0.1));
        // The fall's depth, about 0.5 m for the centre, is what there is to lose.
        let share = 100.0 * (start - before) / weight;
        let euler = 100.0 * (1.0 - (-3.76f64.powi(2) * step * seconds).exp());
        let what = format!("lost in {seconds:.2} s at dt {:.1} ms", 1e3 * step);
        let reference = format!("backward Euler: {euler:.1} %");
        stage.row(what, share, "% of m g L", reference, Limit::AtMost(1.2 * euler));
        lost.push(share);
    }
    let ratio = lost[0] / lost[1].max(1e-9);
    stage.row("loss per halving of dt", ratio, "", "2", Limit::AtLeast(1.6));
    Ok(())
}

//! B3: any stiffness, any weight, any step.

use super::energy::total;
use super::sheets::{material, pinned_sheet};
use super::{Bench, LabError, Limit, Setting, Stage};
use crate::material::Material;

pub(crate) const B3: Bench = Bench {
    name: "B3",
    about: "S1 over Eh 10 to 1e5 N/m, B 0 to 1e-3 N m, 0.05 to 0.6 kg/m2, frames 1/30 to 1/480 s",
    reference: "no NaN, no vertex over 2 sqrt(2 g h), no rise of energy",
    fast: false,
    reads: &[Setting::N, Setting::Vertices, Setting::Dt],
    run: stiffnesses,
};

fn stiffnesses(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let n = stage.side(12);
    let quick = stage.quick();
    let pick = |all: &[f32]| -> Vec<f32> {
        if quick { vec![all[0], all[all.len() - 1]] } else { all.to_vec() }
    };
    let (mut failed, mut fastest, mut rise, mut cases) = (0u32, 0.0f32, 0.0f64, 0u32);
    for &stretch in &pick(&[10.0, 100.0, 1e3, 1e4, 1e5]) {
        for &bend in &pick(&[0.0, 1e-6, 1e-4, 1e-3]) {
            for &density in &pick(&[0.05, 0.2, 0.6]) {
                for &frame_s in &pick(&[1.0 / 30.0, 1.0 / 60.0, 1.0 / 120.0, 1.0 / 480.0]) {
                    cases += 1;
                    let base = material();
                    let shear = 0.385 * stretch;
                    let material = Material { stretch, shear, bend, density, ..base };
                    match swing(stage, n, material, frame_s) {
                        Ok((speed, rose)) => {
                            fastest = fastest.max(speed);
                            rise = rise.max(rose);
                        }
                        Err(LabError::Step(_)) => failed += 1,
                        Err(other) => return Err(other),
                    }
                }
            }
        }
    }
    let reference = format!("of {cases}");
    stage.row(
        "runs that left the finite numbers",
        f64::from(failed),
        "",
        reference,
        Limit::AtMost(0.0),
    );
    let law = "2 sqrt(2 g h)";
    stage.row("fastest vertex of all", f64::from(fastest), "m/s", law, Limit::AtMost(8.86));
    let law = "none";
    stage.row("fastest rise of energy per s", 100.0 * rise, "% of m g L", law, Limit::AtMost(0.1));
    Ok(())
}

/// One second; returns the fastest vertex (m/s) and the steepest rise of energy (m g L per s).
fn swing(
    stage: &mut Stage<'_>,
    n: u32,
    material: Material,
    frame_s: f32,
) -> Result<(f32, f64), LabError> {
    let mut sim = pinned_sheet(stage, n, material, frame_s)?;
    let weight = 9.81 * f64::from(material.density);
    let (mut before, mut fastest, mut rise) = (total(&sim), 0.0f32, 0.0f64);
    let mut marked = 0.0f32;
    while sim.time_s < 1.0 - 1e-4 {
        stage.step(&mut sim, None)?;
        let speeds = sim.state.velocities.iter().map(|v| v.length());
        fastest = speeds.fold(fastest, f32::max);
        // Over a thirtieth of a second, whatever the frame.
        if sim.time_s - marked > 1.0 / 30.0 - 1e-4 {
            let now = total(&sim);
            rise = rise.max((now - before) / f64::from(sim.time_s - marked));
            (before, marked) = (now, sim.time_s);
        }
    }
    Ok((fastest, rise / weight))
}

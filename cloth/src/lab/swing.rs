//! A3 and A4: strips and panels that swing.

use glam::Vec3;

use super::shapes::{Cut, sheet};
use super::{Bench, LabError, Limit, Setting, Sim, Stage};
use crate::material::Material;
use crate::model::{Environment, Model};

pub(crate) const A3: Bench = Bench {
    name: "A3",
    about: "hanging strip of 1 m swinging by 5 deg in its first three modes",
    reference: "hanging chain: periods 5.2255, 2.2765, 1.4521 sqrt(L/g)",
    fast: true,
    reads: Setting::ALL,
    run: modes,
};

pub(crate) const A4: Bench = Bench {
    name: "A4",
    about: "stiff panel of 0.3 m as a pendulum from 10, 30 and 90 deg",
    reference: "rigid pendulum: 2 pi sqrt(2L/3g) times 1.0019, 1.0174, 1.1803",
    fast: true,
    reads: &[Setting::N, Setting::Vertices, Setting::Dt],
    run: panel,
};

/// Zeros of J0.
const ZEROS: [f64; 3] = [2.404_825_557_7, 5.520_078_110_3, 8.653_727_912_9];

/// Bessel's J0, by its integral.
fn j0(x: f64) -> f64 {
    let n = 200;
    let angle = |k: i32| std::f64::consts::PI * (f64::from(k) + 0.5) / f64::from(n);
    (0..n).map(|k| (x * angle(k).sin()).cos()).sum::<f64>() / f64::from(n)
}

fn modes(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let n = stage.edges(40, 4..=200, |n| (across(n) + 1) * (n + 1))?;
    // The tip's way: 5 degrees of the length in the first mode, less in the others.
    let cases = [(0, 0.087, 1.0), (1, 0.02, 3.0), (2, 0.01, 3.0)];
    for (mode, tip, most) in cases {
        let shape = |s: f64| j0(ZEROS[mode] * s.sqrt());
        let mut sim = chain(stage, n, |s| tip * shape(s))?;
        let period = 4.0 * std::f64::consts::PI / ZEROS[mode] / 9.81f64.sqrt();
        let frames = (2.3 * period / f64::from(sim.frame_s)).ceil() as u32;
        let mut crossings = Vec::new();
        let project = |sim: &Sim| -> f64 {
            let rows = sim.state.positions.chunks(across(n) as usize + 1).enumerate();
            // The mode's weight is even along the strip.
            rows.map(|(j, row)| f64::from(row[0].x) * shape(1.0 - j as f64 / f64::from(n))).sum()
        };
        let (mut before, mut time) = (project(&sim), 0.0);
        for _ in 0..frames {
            stage.step(&mut sim, None)?;
            let now = project(&sim);
            let dt = f64::from(sim.frame_s);
            if before * now < 0.0 {
                crossings.push(time + dt * before / (before - now));
            }
            (before, time) = (now, time + dt);
        }
        let halves = crossings.len().saturating_sub(1) as f64;
        let found = match (crossings.first(), crossings.last()) {
            (Some(first), Some(last)) if halves > 0.0 => 2.0 * (last - first) / halves,
            _ => f64::NAN,
        };
        let what = format!("error of the period, mode {}", mode + 1);
        let error = 100.0 * (found / period - 1.0).abs();
        stage.row(what, error, "%", format!("{period:.4} s"), Limit::AtMost(most));
    }
    Ok(())
}

/// Edges across the strip.
fn across(n: u32) -> u32 {
    (n / 10).max(1)
}

/// A limp strip hanging from y = 0, `offset` (m) off the vertical by height over its lower end.
fn chain(stage: &mut Stage<'_>, n: u32, offset: impl Fn(f64) -> f64) -> Result<Sim, LabError> {
    let wide = across(n);
    let mesh = sheet(wide, n, Cut::Alternating, |u, v| Vec3::new(0.0, -v, 0.1 * u))?;
    // A chain does not stretch: only weight and bending are the fabric's.
    let plain = Material::default();
    let (density, bend) =
        stage.fabric().map_or((plain.density, 1e-9), |f| (f.density, f.bend_mean()));
    let material = Material {
        density,
        stretch: 5000.0,
        shear: 2500.0,
        bend,
        drag: 0.0,
        damping_s: 0.0,
        ..plain
    };
    let held: Vec<u32> = (0..=wide).collect();
    let model = Model::new(mesh, material, Environment::default(), None, &held)?;
    let mut sim = stage.sim(model, 1.0 / 120.0);
    let h = 1.0 / f64::from(n);
    let mut y = 0.0;
    for (j, row) in sim.state.positions.chunks_mut(wide as usize + 1).enumerate() {
        let s = 1.0 - j as f64 * h;
        let x = offset(s);
        if j > 0 {
            let along = x - offset(s + h);
            // Each row hangs below the one above by what is left of its length.
            y -= (h * h - along * along).max(0.0).sqrt();
        }
        row.iter_mut().for_each(|p| *p = Vec3::new(x as f32, y as f32, p.z));
    }
    Ok(sim)
}

fn panel(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let n = stage.edges(12, 2..=200, |n| (n + 1) * (n + 1))?;
    let (length, g) = (0.3f32, 9.81f64);
    let small = std::f64::consts::TAU * (2.0 * f64::from(length) / (3.0 * g)).sqrt();
    for (degrees, factor) in [(10.0f32, 1.0019), (30.0, 1.0174), (90.0, 1.1803)] {
        let mesh = sheet(n, n, Cut::Alternating, |u, v| Vec3::new(0.0, -length * v, length * u))?;
        let material = Material {
            stretch: 1e4,
            shear: 5e3,
            // Its slowest bending is ten times faster than the swing.
            bend: 0.05,
            drag: 0.0,
            damping_s: 0.0,
            ..Material::default()
        };
        let held: Vec<u32> = (0..=n).collect();
        let model = Model::new(mesh, material, Environment::default(), None, &held)?;
        let mut sim = stage.sim(model, 1.0 / 120.0);
        let (s, c) = degrees.to_radians().sin_cos();
        for p in &mut sim.state.positions {
            *p = Vec3::new(-p.y * s, p.y * c, p.z);
        }
        // From the turning point to the lowest is a quarter of a period.
        let (mut before, mut time, mut found) = (1.0, 0.0, f64::NAN);
        for _ in 0..120 {
            stage.step(&mut sim, None)?;
            let now = f64::from(sim.state.positions[sim.state.positions.len() - 1].x);
            let dt = f64::from(sim.frame_s);
            if now <= 0.0 {
                found = 4.0 * (time + dt * before / (before - now));
                break;
            }
            (before, time) = (now, time + dt);
        }
        let error = 100.0 * (found / (small * factor) - 1.0).abs();
        let what = format!("error of the period from {degrees} deg");
        let reference = format!("{:.4} s", small * factor);
        stage.row(what, error, "%", reference, Limit::AtMost(1.0));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_modes_vanish_where_the_strip_is_held() {
        assert!((j0(0.0) - 1.0).abs() < 1e-9);
        assert!((j0(1.0) - 0.765_197_686_6).abs() < 1e-9);
        assert!(ZEROS.iter().all(|z| j0(*z).abs() < 1e-9));
    }
}

//! A6 and A7: strips that bend under their own weight.

use glam::Vec3;

use super::shapes::{Cut, sheet};
use super::{Bench, LabError, Limit, Setting, Sim, Stage};
use crate::fabrics::Fabric;
use crate::material::Material;
use crate::model::{Environment, Model};

pub(crate) const A6: Bench = Bench {
    name: "A6",
    about: "clamped strip of 0.2 m bending under its weight, G = w L^3 / B = 1 to 100",
    reference: "exact elastica: tip drop and reach",
    fast: true,
    reads: Setting::ALL,
    run: cantilevers,
};

pub(crate) const A7: Bench = Bench {
    name: "A7",
    about: "overhang at which the chord is 41.5 deg, B = 7e-6 to 3e-4 N m",
    reference: "exact elastica: G = 8.004 there",
    fast: true,
    reads: Setting::ALL,
    run: fixed_angle,
};

/// G, tip drop / L, tip reach / L of the inextensible elastica.
const ELASTICA: [(f32, f64, f64); 7] = [
    (1.0, 0.1235, 0.9912),
    (2.0, 0.2385, 0.9669),
    (5.0, 0.4959, 0.8467),
    (10.0, 0.7002, 0.6564),
    (20.0, 0.8299, 0.4452),
    (50.0, 0.9079, 0.2450),
    (100.0, 0.9375, 0.1592),
];
const LENGTH: f32 = 0.2;
const DENSITY: f32 = 0.2;
const GRAVITY: f32 = 9.81;

/// What of a fabric an elastica knows; it does not stretch.
#[derive(Clone, Copy)]
struct Cloth {
    /// Areal density (kg/m^2).
    density: f32,
    /// Bending stiffness (N m).
    bend: f32,
}

impl Cloth {
    fn of(fabric: &Fabric) -> Self {
        Self { density: fabric.density, bend: fabric.bend_mean() }
    }
}

/// Edges across a strip.
fn across(edges: u32) -> u32 {
    (edges / 4).max(2)
}

fn cantilevers(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let n = stage.edges(20, 4..=100, |n| (across(n) + 1) * (n + 1))?;
    let quick = stage.quick();
    for (edges, most) in [(n, 3.0), (4 * n, 1.0)] {
        if quick && edges != n {
            break;
        }
        let (mut worst, mut apart) = (0.0f64, 0.0f64);
        for (g, drop, reach) in ELASTICA {
            let even = tip(stage, g, edges, Cut::Alternating)?;
            worst = worst.max((even.0 / drop - 1.0).abs()).max((even.1 / reach - 1.0).abs());
            for cut in [Cut::Uniform, Cut::Irregular] {
                let other = tip(stage, g, edges, cut)?;
                apart = apart.max((other.0 / even.0 - 1.0).abs());
                apart = apart.max((other.1 / even.1 - 1.0).abs());
            }
        }
        let what = format!("worst tip error at {edges} edges per length");
        stage.row(what, 100.0 * worst, "%", "exact elastica", Limit::AtMost(most));
        let what = format!("uniform and irregular mesh apart from alternating, {edges} edges");
        stage.row(what, 100.0 * apart, "%", "no mesh bias", Limit::AtMost(5.0));
    }
    Ok(())
}

/// A strip along x, clamped between its first two rows (at x = 0), free at x = `length`.
fn strip(
    stage: &mut Stage<'_>,
    length: f32,
    cloth: Cloth,
    edges: u32,
    cut: Cut,
    gravity: f32,
) -> Result<Sim, LabError> {
    let wide = across(edges);
    let h = length / (edges as f32 - 0.5);
    let place = |u: f32, v: f32| Vec3::new(h * (u * edges as f32 - 0.5), 0.0, v * h * wide as f32);
    let mesh = sheet(edges, wide, cut, place)?;
    let held: Vec<u32> = (0..=wide).flat_map(|j| [j * (edges + 1), j * (edges + 1) + 1]).collect();
    let material = Material {
        density: cloth.density,
        stretch: 1000.0,
        shear: 500.0,
        bend: cloth.bend,
        drag: 0.0,
        damping_s: 0.0,
        ..Material::default()
    };
    let environment = Environment { gravity: Vec3::Y * -gravity, ..Environment::default() };
    let model = Model::new(mesh, material, environment, None, &held)?;
    Ok(stage.sim(model, 1.0 / 30.0))
}

/// Drop and reach of the tip's middle (m).
fn tip_of(sim: &Sim, edges: u32) -> (f64, f64) {
    let p = &sim.state.positions;
    let rows = p.len() / (edges as usize + 1);
    let tips = (1..=rows).map(|j| p[j * (edges as usize + 1) - 1]);
    let sum = tips.fold((0.0, 0.0), |s, p| (s.0 - f64::from(p.y), s.1 + f64::from(p.x)));
    (sum.0 / rows as f64, sum.1 / rows as f64)
}

/// Drop and reach over the length.
fn tip(stage: &mut Stage<'_>, g: f32, edges: u32, cut: Cut) -> Result<(f64, f64), LabError> {
    // A fabric has its stiffness: then the length is what belongs to G.
    let (length, cloth) = match stage.fabric().map(Cloth::of) {
        Some(cloth) => ((g * cloth.bend / (cloth.density * GRAVITY)).cbrt(), cloth),
        None => {
            let bend = DENSITY * GRAVITY * LENGTH.powi(3) / g;
            (LENGTH, Cloth { density: DENSITY, bend })
        }
    };
    let mut sim = strip(stage, length, cloth, edges, cut, GRAVITY)?;
    stage.settle(&mut sim, None, 2e-4, 400)?;
    let (drop, reach) = tip_of(&sim, edges);
    Ok((drop / f64::from(length), reach / f64::from(length)))
}

fn fixed_angle(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let edges = stage.edges(20, 4..=200, |n| (across(n) + 1) * (n + 1))?;
    let stiff: &[f32] = if stage.quick() { &[5e-5] } else { &[7e-6, 2e-5, 5e-5, 1e-4, 3e-4] };
    let plain = || stiff.iter().map(|&bend| Cloth { density: DENSITY, bend }).collect();
    let cloths: Vec<Cloth> = stage.fabric().map_or_else(plain, |fabric| vec![Cloth::of(fabric)]);
    for cloth in cloths {
        let w = f64::from(cloth.density * GRAVITY);
        let bend = cloth.bend;
        // The overhang that belongs to this stiffness; then the load at which the chord hangs at
        // 41.5 degrees is searched for (angle and load are about in proportion).
        let length = 2.0003 * (f64::from(bend) / w).cbrt();
        let mut factor = 1.0f64;
        let mut tried: Vec<(f64, f64)> = Vec::new();
        for _ in 0..4 {
            let gravity = GRAVITY * factor as f32;
            let mut sim = strip(stage, length as f32, cloth, edges, Cut::Alternating, gravity)?;
            stage.settle(&mut sim, None, 2e-4, 400)?;
            let (drop, reach) = tip_of(&sim, edges);
            let off = drop.atan2(reach).to_degrees() - 41.5;
            factor = match tried.last() {
                None => factor * (1.0 - off / 41.5),
                Some((before, was)) => factor - off * (factor - before) / (off - was),
            };
            tried.push((gravity as f64 / f64::from(GRAVITY), off));
            if off.abs() < 0.02 {
                break;
            }
        }
        // Load and stiffness are in proportion: what hangs at 41.5 degrees under a load of
        // `factor` would have been taken for a stiffness of 1 / factor.
        let error = 100.0 * (1.0 / factor - 1.0).abs();
        let what = format!("recovered B off {bend:.0e} N m by");
        stage.row(what, error, "%", "exact elastica", Limit::AtMost(5.0));
    }
    Ok(())
}

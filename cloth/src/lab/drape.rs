//! A8: Cusick's drape of the ten measured fabrics.

use glam::Vec3;

use super::shapes::{Chance, disc};
use super::{Bench, LabError, Limit, Setting, Stage};
use crate::fabrics::{FABRICS, Fabric, find};
use crate::material::Material;
use crate::model::{Environment, Model};

pub(crate) const A8: Bench = Bench {
    name: "A8",
    about: "Cusick drape: disc of 30 cm over a support of 18 cm, ten fabrics",
    reference: "own run at 4 times the vertices; drape rises with B / w",
    fast: false,
    reads: Setting::ALL,
    run: drapes,
};

const OUTER_M: f32 = 0.15;
const INNER_M: f32 = 0.09;
/// Cells of the shadow's grid (m).
const CELL_M: f32 = 5e-4;
/// What a drape coefficient is good for (points).
const REPEATS: f64 = 3.0;

fn drapes(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let rings = stage.edges(26, 4..=120, |rings| 1 + 3 * rings * (rings + 1))?;
    let asked = stage.fabric().copied();
    let mut fabrics: Vec<Fabric> = asked.map_or(FABRICS.to_vec(), |f| vec![f]);
    fabrics.sort_by(|a, b| stiffness(a).total_cmp(&stiffness(b)));
    let chosen = if stage.quick() { 4 } else { 1 };
    let plain = Material::default();
    for own in [true, false] {
        let mut found: Vec<f64> = Vec::new();
        for fabric in fabrics.iter().step_by(chosen) {
            let mut material = fabric.material();
            if !own {
                let Material { stretch, weft, shear, .. } = plain;
                material = Material { stretch, weft, shear, ..material };
            }
            found.push(drape(stage, material, rings, 0.0)?);
        }
        let falls = found.windows(2).map(|w| w[0] - w[1]).fold(0.0f64, f64::max);
        let said: Vec<String> = found.iter().map(|d| format!("{d:.1}")).collect();
        let reference = format!("by B/w: {}", said.join(", "));
        let membrane = if own { "own membranes" } else { "one membrane for all" };
        let what = format!("largest fall with rising B / w, {membrane}");
        // Fabrics differ in their membranes too, and fold in whole numbers: what a drape test
        // repeats to within counts as level.
        stage.row(what, falls, "points", reference, Limit::AtMost(REPEATS));
    }
    if stage.quick() {
        return Ok(());
    }
    let one = asked.or(find("denim").copied()).unwrap_or(FABRICS[0]);
    let (name, one) = (one.name, one.material());
    let plain = drape(stage, one, rings, 0.0)?;
    let turned = drape(stage, one, rings, std::f32::consts::FRAC_PI_4)?;
    let reference = format!("{plain:.1}");
    let moved = (turned - plain).abs();
    stage.row(
        format!("mesh turned by 45 deg, {name}"),
        moved,
        "points",
        reference,
        Limit::AtMost(REPEATS),
    );
    let fine = drape(stage, one, 2 * rings, 0.0)?;
    let moved = (fine - plain).abs();
    let reference = format!("{fine:.1} at 4 times the vertices");
    let what = format!("against 4 times the vertices, {name}");
    stage.row(what, moved, "points", reference, Limit::AtMost(REPEATS));
    Ok(())
}

fn stiffness(f: &Fabric) -> f32 {
    f.bend_mean() / f.density
}

/// Drape coefficient (%): how much of the ring's area is in shadow.
fn drape(
    stage: &mut Stage<'_>,
    material: Material,
    rings: u32,
    turn: f32,
) -> Result<f64, LabError> {
    let mesh = disc(OUTER_M, INNER_M, rings, turn)?.with_grain(Vec3::Z);
    let held: Vec<u32> = (0..mesh.vertex_count() as u32)
        .filter(|v| mesh.rest_positions()[*v as usize].length() < INNER_M + 1e-5)
        .collect();
    let material = Material { drag: 0.0, damping_s: 0.0, ..material };
    let model = Model::new(mesh, material, Environment::default(), None, &held)?;
    let mut sim = stage.sim(model, 1.0 / 30.0);
    // A flat disc cannot choose its folds.
    let mut chance = Chance::new(8);
    for p in &mut sim.state.positions {
        if p.length() > INNER_M + 1e-5 {
            p.y += 1e-4 * chance.signed();
        }
    }
    stage.settle(&mut sim, None, 5e-3, 150)?;
    let shadow = shadow(&sim.state.positions, sim.model.mesh().triangles());
    let area = |r: f32| std::f64::consts::PI * f64::from(r) * f64::from(r);
    let (support, whole) = (area(INNER_M), area(OUTER_M));
    Ok(100.0 * (shadow - support) / (whole - support))
}

/// Area (m^2) covered as seen from above.
fn shadow(positions: &[Vec3], triangles: &[[u32; 3]]) -> f64 {
    let half = (1.1 * OUTER_M / CELL_M) as i32;
    let side = 2 * half as usize;
    let mut dark = vec![false; side * side];
    for t in triangles {
        let [a, b, c] = t.map(|v| positions[v as usize] / CELL_M);
        let low = a.min(b).min(c).floor();
        let high = a.max(b).max(c).ceil();
        let twice =
            |p: Vec3, q: Vec3, x: f32, z: f32| (q.x - p.x) * (z - p.z) - (q.z - p.z) * (x - p.x);
        let rows = (low.z as i32).max(-half)..(high.z as i32).min(half);
        for j in rows {
            for i in (low.x as i32).max(-half)..(high.x as i32).min(half) {
                let (x, z) = (i as f32 + 0.5, j as f32 + 0.5);
                let w = [twice(a, b, x, z), twice(b, c, x, z), twice(c, a, x, z)];
                if w.iter().all(|w| *w >= 0.0) || w.iter().all(|w| *w <= 0.0) {
                    dark[(j + half) as usize * side + (i + half) as usize] = true;
                }
            }
        }
    }
    let cells = dark.iter().filter(|d| **d).count() as f64;
    cells * f64::from(CELL_M) * f64::from(CELL_M)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flat_disc_shades_its_area() {
        let mesh = disc(OUTER_M, INNER_M, 26, 0.3).unwrap();
        let area = shadow(mesh.rest_positions(), mesh.triangles());
        let expected: f64 = mesh.rest_areas().iter().map(|a| f64::from(*a)).sum();
        assert!((area / expected - 1.0).abs() < 2e-3, "{area} {expected}");
    }
}

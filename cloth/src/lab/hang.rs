//! A2 and A5: strips that hang still, by one end and by both.

use glam::Vec3;

use super::shapes::{Cut, sheet};
use super::{Bench, LabError, Limit, Setting, Sim, Stage};
use crate::fabrics::Fabric;
use crate::material::Material;
use crate::model::{Environment, Model};

pub(crate) const A2: Bench = Bench {
    name: "A2",
    about: "strip of 1 m hanging by its top, membrane 100, 1000, 10000 N/m, three meshes",
    reference: "elongation w L^2 / (2 Eh), strain at the top w L / Eh",
    fast: true,
    reads: Setting::ALL,
    run: hanging,
};

pub(crate) const A5: Bench = Bench {
    name: "A5",
    about: "strip of 1 m hung by both ends, 0.5, 0.8 and 0.95 m apart",
    reference: "elastic catenary (sag 0.3982, 0.2654, 0.1359 without stretch)",
    fast: true,
    reads: Setting::ALL,
    run: catenaries,
};

/// What decides how a strip hangs.
#[derive(Clone, Copy)]
struct Cloth {
    /// Areal density (kg/m^2).
    density: f32,
    /// Membrane stiffness along the strip (N/m).
    stretch: f32,
}

impl Cloth {
    fn default(stretch: f32) -> Self {
        Self { density: 0.2, stretch }
    }

    fn of(fabric: &Fabric) -> Self {
        Self { density: fabric.density, stretch: fabric.warp_mean() }
    }

    /// Load (N/m^2).
    fn weight(self) -> f64 {
        // In whole milligrams, so that 0.2 kg is 0.2 kg.
        (1e6 * f64::from(self.density)).round() * 1e-6 * 9.81
    }

    /// Poisson's ratio 0, so that the clamp does not matter.
    fn material(self) -> Material {
        let Self { density, stretch } = self;
        let shear = 0.5 * stretch;
        Material { density, stretch, shear, drag: 0.0, damping_s: 0.0, ..Material::default() }
    }
}

/// Edges across a strip that is `share` times as long as wide.
fn across(n: u32, share: u32) -> u32 {
    (n / share).max(1)
}

fn hanging(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let n = stage.edges(10, 2..=100, |n| (across(n, 5) + 1) * (n + 1))?;
    let (mut long, mut top) = (0.0f64, 0.0f64);
    let stiff: &[f32] = if stage.quick() { &[100.0, 10_000.0] } else { &[1e2, 1e3, 1e4] };
    let plain = || stiff.iter().copied().map(Cloth::default).collect();
    let cloths: Vec<Cloth> = stage.fabric().map_or_else(plain, |fabric| vec![Cloth::of(fabric)]);
    for cloth in cloths {
        let strain_max = cloth.weight() / f64::from(cloth.stretch);
        for n in [n, 2 * n, 4 * n] {
            let sim = hang(stage, cloth, n)?;
            let low = sim.state.positions.iter().map(|p| p.y).fold(0.0, f32::min);
            let expected = 0.5 * strain_max;
            long = long.max(((-1.0 - f64::from(low)) / expected - 1.0).abs());
            // The first row of edges sees the load from its middle on.
            let wide = across(n, 5) + 1;
            let h = 1.0 / f64::from(n);
            let strain = (0..wide).map(|i| {
                let (a, b) = (i as usize, (i + wide) as usize);
                let p = &sim.state.positions;
                f64::from(p[a].distance(p[b])) / h - 1.0
            });
            let mean = strain.sum::<f64>() / f64::from(wide);
            let expected = strain_max * (1.0 - 0.5 * h);
            top = top.max((mean / expected - 1.0).abs());
        }
    }
    let law = "w L^2 / (2 Eh)";
    stage.row("worst error of the elongation", 100.0 * long, "%", law, Limit::AtMost(2.0));
    let law = "w L / Eh";
    stage.row("worst error of the strain at the top", 100.0 * top, "%", law, Limit::AtMost(2.0));
    Ok(())
}

fn hang(stage: &mut Stage<'_>, cloth: Cloth, n: u32) -> Result<Sim, LabError> {
    let wide = across(n, 5);
    let mesh = sheet(wide, n, Cut::Alternating, |u, v| Vec3::new(0.2 * u, -v, 0.0))?;
    let held: Vec<u32> = (0..=wide).collect();
    let model = Model::new(mesh, cloth.material(), Environment::default(), None, &held)?;
    let mut sim = stage.sim(model, 1.0 / 30.0);
    stage.settle(&mut sim, None, 1e-4, 240)?;
    Ok(sim)
}

fn catenaries(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let n = stage.edges(40, 4..=200, |n| (across(n, 10) + 1) * (n + 1))?;
    let cloth = stage.fabric().map_or(Cloth::default(2000.0), Cloth::of);
    let (weight, stretch) = (cloth.weight(), f64::from(cloth.stretch));
    for span in [0.5, 0.8, 0.95] {
        let (sag, tension) = catenary(span, stretch, weight);
        let sim = hang_between(stage, span, cloth, n)?;
        let wide = across(n, 10) + 1;
        let row = |j: u32| &sim.state.positions[(j * wide) as usize..((j + 1) * wide) as usize];
        let y = |j: u32| row(j).iter().map(|p| f64::from(p.y)).sum::<f64>() / f64::from(wide);
        // Of an odd number of edges, the middle one's ends.
        let found = -0.5 * (y(n / 2) + y(n.div_ceil(2)));
        let reference = format!("{sag:.4} m");
        let error = 100.0 * (found / sag - 1.0).abs();
        stage.row(format!("sag at span {span}"), error, "%", reference, Limit::AtMost(1.0));
        let h = 1.0 / f64::from(n);
        let pull = |a: u32, b: u32| {
            let pairs = row(a).iter().zip(row(b));
            let strains = pairs.map(|(p, q)| f64::from(p.distance(*q)) / h - 1.0);
            stretch * strains.sum::<f64>() / f64::from(wide)
        };
        // Tension at the middle of the end edges; half an edge of weight hangs on above.
        let found = 0.5 * (pull(0, 1) + pull(n - 1, n));
        let rise = (tension * tension - (0.5 * weight).powi(2)).sqrt();
        let expected = rise.hypot(0.5 * weight * (1.0 - h));
        let error = 100.0 * (found / expected - 1.0).abs();
        let reference = format!("{:.4} w L", tension / weight);
        stage.row(format!("tension at span {span}"), error, "%", reference, Limit::AtMost(3.0));
    }
    Ok(())
}

fn hang_between(stage: &mut Stage<'_>, span: f64, cloth: Cloth, n: u32) -> Result<Sim, LabError> {
    let wide = across(n, 10);
    let mesh = sheet(wide, n, Cut::Alternating, |u, v| Vec3::new(v, 0.0, 0.1 * u))?;
    let material = Material { bend: 1e-9, ..cloth.material() };
    let last = n * (wide + 1);
    let held: Vec<u32> = (0..=wide).chain(last..=last + wide).collect();
    let model = Model::new(mesh, material, Environment::default(), None, &held)?;
    let mut sim = stage.sim(model, 1.0 / 30.0);
    // A V with sides of half the length.
    let half = 0.5 * span as f32;
    let depth = (0.25 - half * half).sqrt();
    for p in &mut sim.state.positions {
        let down = 1.0 - (2.0 * p.x - 1.0).abs();
        *p = Vec3::new(p.x * 2.0 * half, -depth * down, p.z);
    }
    stage.settle(&mut sim, None, 1e-4, 600)?;
    Ok(sim)
}

/// Sag (m) and tension at the ends (N/m) of an elastic catenary of length 1 (Irvine 1981, "Cable
/// Structures", section 1.3) under a load of `weight` (N/m^2).
fn catenary(span: f64, stretch: f64, weight: f64) -> (f64, f64) {
    let rise = 0.5 * weight;
    let width = |h: f64| h / stretch + 2.0 * h / weight * (rise / h).asinh();
    let (mut low, mut high) = (1e-6, 100.0);
    for _ in 0..200 {
        let middle = 0.5 * (low + high);
        if width(middle) < span { low = middle } else { high = middle }
    }
    let h = 0.5 * (low + high);
    let sag = rise / (4.0 * stretch) + (h.hypot(rise) - h) / weight;
    (sag, h.hypot(rise))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stiff_catenary_has_the_known_sag_and_tension() {
        let known = [(0.5, 0.3982, 0.5130), (0.8, 0.2654, 0.6036), (0.95, 0.1359, 0.9878)];
        for (span, sag, tension) in known {
            let (s, t) = catenary(span, 1e9, 2.0);
            assert!((s - sag).abs() < 1e-4, "{s}");
            assert!((t / 2.0 - tension).abs() < 1e-4, "{t}");
        }
    }
}

//! B4: meshes that are bad but legal stay finite, and those that are not legal are refused.

use glam::Vec3;

use super::shapes::{Chance, Cut, sheet};
use super::{Bench, LabError, Limit, Setting, Stage};
use crate::material::Material;
use crate::mesh::{Mesh, MeshError};
use crate::model::{Environment, Model};

pub(crate) const B4: Bench = Bench {
    name: "B4",
    about: "slivers 1:20, a vertex of 12 neighbours, areas x100; non-manifold refused",
    reference: "finite, energy falls; refused by name",
    fast: true,
    reads: &[Setting::Fabric, Setting::Dt],
    run: bad_meshes,
};

fn bad_meshes(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let flat = |u: f32, v: f32| Vec3::new(u, 0.0, v);
    let slivers = sheet(60, 3, Cut::Irregular, |u, v| flat(u, v * 1.0))?;
    let cases = [
        ("slivers 1:20", slivers),
        ("a vertex of 12 neighbours", fan(12)?),
        ("areas x100", sheet(16, 16, Cut::Alternating, |u, v| flat(u.powf(1.8), v.powf(1.8)))?),
        ("areas by chance", by_chance()?),
    ];
    for (what, mesh) in cases {
        let corner = mesh.vertex_count() as u32 - 1;
        let material = stage.material(Material::default());
        let model = Model::new(mesh, material, Environment::default(), None, &[0, corner])?;
        let mut sim = stage.sim(model, 1.0 / 30.0);
        let mut fastest = 0.0f32;
        for _ in 0..60 {
            stage.step(&mut sim, None)?;
            let speeds = sim.state.velocities.iter().map(|v| v.length());
            fastest = speeds.fold(fastest, f32::max);
        }
        let what = format!("fastest vertex, {what}");
        stage.row(what, f64::from(fastest), "m/s", "2 sqrt(2 g h)", Limit::AtMost(8.86));
    }
    let refused = [
        matches!(three_on_an_edge(), Err(MeshError::NonManifold { .. })),
        matches!(sheet(4, 4, Cut::Uniform, |u, _| flat(u, 0.0)), Err(MeshError::Degenerate { .. })),
        matches!(
            sheet(4, 4, Cut::Uniform, |u, v| flat(u / (u - 0.5), v)),
            Err(MeshError::NotFinite { .. })
        ),
    ];
    let passed = refused.iter().filter(|r| !**r).count() as f64;
    stage.row("faulty meshes let through", passed, "of 3", "none", Limit::AtMost(0.0));
    Ok(())
}

/// A disc of `count` triangles around one vertex, each cut once more.
fn fan(count: u32) -> Result<Mesh, MeshError> {
    let mut p = vec![Vec3::ZERO];
    for ring in 1..=2 {
        p.extend((0..count).map(|k| {
            let a = std::f32::consts::TAU * k as f32 / count as f32;
            Vec3::new(a.sin(), 0.0, a.cos()) * (0.5 * ring as f32)
        }));
    }
    let t = (0..count).flat_map(|k| {
        let (a, b) = (1 + k, 1 + (k + 1) % count);
        [[0, a, b], [a, a + count, b + count], [a, b + count, b]]
    });
    Mesh::new(p, t.collect())
}

/// A sheet whose rows and columns lie where chance has put them.
fn by_chance() -> Result<Mesh, MeshError> {
    let mut chance = Chance::new(3);
    let mut lines = || {
        let steps: Vec<f32> = (0..16).map(|_| 1.1 + chance.signed()).collect();
        let whole: f32 = steps.iter().sum();
        let mut at = 0.0;
        let ends = steps.iter().map(move |s| {
            at += s / whole;
            at
        });
        std::iter::once(0.0).chain(ends).collect::<Vec<f32>>()
    };
    let (x, z) = (lines(), lines());
    let at = |lines: &[f32], u: f32| lines[(u * 16.0).round() as usize];
    sheet(16, 16, Cut::Alternating, |u, v| Vec3::new(at(&x, u), 0.0, at(&z, v)))
}

fn three_on_an_edge() -> Result<Mesh, MeshError> {
    let p = vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z, -Vec3::Y];
    Mesh::new(p, vec![[0, 1, 2], [1, 0, 3], [0, 1, 4]])
}

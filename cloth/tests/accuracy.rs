//! Against analytic values: free fall, a hanging strip, terminal speed.

mod common;

use cloth::{Environment, Material, Span, Vec3, Workspace, measure, step};
use common::{free, sheet};

const FRAME: Span<'static> =
    Span { motion: None, seconds: 1.0 / 30.0, refine: 1, sort_layers: false };

#[test]
fn free_fall_follows_the_parabola_without_strain() {
    let material = Material { drag: 0.0, ..Material::default() };
    let mesh = sheet(10, 10, |u, v| Vec3::new(u, 0.0, v));
    let model = free(mesh, material, Environment::default(), &[]);
    let (mut state, mut ws) = (model.rest_state(), Workspace::default());
    for _ in 0..30 {
        step(&model, &FRAME, &mut state, &mut ws).unwrap();
    }
    let dt = 1.0 / 120.0;
    for p in &state.positions {
        // Implicit Euler falls g t dt / 2 further.
        assert!((p.y + 4.905).abs() < 9.81 * dt / 2.0 * 1.05, "{}", p.y);
    }
    assert!(measure::stretch_max(model.mesh(), &state.positions) < 1e-5);
}

#[test]
fn a_hanging_strip_lengthens_by_its_weight() {
    for stretch in [100.0, 1000.0, 10_000.0] {
        for n in [10, 20, 40] {
            let shear = 0.5 * stretch; // Poisson's ratio 0: the clamp does not matter
            let material =
                Material { stretch, shear, drag: 0.0, damping_s: 0.05, ..Material::default() };
            let mesh = sheet(n / 5, n, |u, v| Vec3::new(0.2 * u, -v, 0.0));
            let held: Vec<u32> = (0..=n / 5).collect();
            let model = free(mesh, material, Environment::default(), &held);
            let (mut state, mut ws) = (model.rest_state(), Workspace::default());
            for _ in 0..60 {
                step(&model, &FRAME, &mut state, &mut ws).unwrap();
            }
            let low = state.positions.iter().map(|p| p.y).fold(0.0, f32::min);
            let expected = 0.2 * 9.81 / (2.0 * stretch);
            let error = (-1.0 - low) / expected - 1.0;
            assert!(error.abs() < 0.02, "E h {stretch}, n {n}: {error}");
        }
    }
}

#[test]
fn a_horizontal_sheet_sinks_at_its_terminal_speed() {
    let mesh = sheet(10, 10, |u, v| Vec3::new(u, 0.0, v));
    let model = free(mesh, Material::default(), Environment::default(), &[]);
    let (mut state, mut ws) = (model.rest_state(), Workspace::default());
    for _ in 0..60 {
        step(&model, &FRAME, &mut state, &mut ws).unwrap();
    }
    let middle = state.velocities[60].y;
    let expected = (2.0f32 * 0.2 * 9.81 / (1.225 * 1.28)).sqrt();
    assert!((middle / -expected - 1.0).abs() < 0.02, "{middle} {expected}");
}

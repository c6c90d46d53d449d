//! The cloth and itself: folds, rolls, drops; what starts tangled comes apart.

mod common;

use cloth::{Crossings, Environment, Material, Mesh, Model, Span, State, Vec3, Workspace, step};
use common::{ellipsoids, sheet};

const FRAME: f32 = 1.0 / 30.0;

/// Runs `frames`; returns the crossings after each.
fn run(model: &Model, state: &mut State, frames: usize) -> Vec<usize> {
    let mut ws = Workspace::default();
    let mut crossings = Crossings::new(model.mesh());
    let span = Span { motion: None, seconds: FRAME, refine: 1, sort_layers: false };
    let mut all = Vec::new();
    for _ in 0..frames {
        step(model, &span, state, &mut ws).unwrap();
        assert!(cloth::measure::stretch_max(model.mesh(), &state.positions) < 0.15);
        all.push(crossings.find(&state.positions).len());
    }
    all
}

fn on_ground() -> Environment {
    Environment { ground: true, ..Environment::default() }
}

#[test]
fn a_ribbon_that_falls_on_the_ground_piles_up_without_crossing() {
    let mesh = sheet(4, 80, |u, v| Vec3::new(0.06 * u, 0.05 + 1.2 * v, 0.02 * (9.0 * v).sin()));
    let model = Model::new(mesh, Material::default(), on_ground(), None, &[]).unwrap();
    let mut state = model.rest_state();
    let crossings = run(&model, &mut state, 60);
    assert_eq!(crossings.iter().max(), Some(&0), "{crossings:?}");
    let high = state.positions.iter().map(|p| p.y).fold(0.0, f32::max);
    assert!(high < 0.3, "{high}");
}

#[test]
fn a_sheet_dropped_on_a_ball_folds_without_crossing() {
    let mesh = sheet(40, 40, |u, v| Vec3::new(u - 0.5, 0.80, v - 0.5));
    let body = ellipsoids(&[(Vec3::Y * 0.5, Vec3::splat(0.25))], 32);
    let model =
        Model::new(mesh, Material::default(), on_ground(), Some(body.clone()), &[]).unwrap();
    let (mut state, mut ws) = (model.rest_state(), Workspace::default());
    let pose = body.skeleton.rest_pose();
    let span = Span { motion: Some((&pose, &pose)), seconds: FRAME, refine: 1, sort_layers: false };
    let mut crossings = Crossings::new(model.mesh());
    for frame in 0..60 {
        step(&model, &span, &mut state, &mut ws).unwrap();
        assert_eq!(crossings.find(&state.positions).len(), 0, "frame {frame}");
    }
}

#[test]
fn two_sheets_that_cross_when_they_start_come_apart() {
    // The second sheet's rim is poked through the first.
    let n = 16u32;
    let one = sheet(n, n, |u, v| Vec3::new(0.3 * u, 0.0, 0.3 * v));
    let count = one.vertex_count() as u32;
    let mut p = one.rest_positions().to_vec();
    let mut t = one.triangles().to_vec();
    let shift = |p: &Vec3| Vec3::new(p.x + 0.25, 0.02 - 0.3 * (0.05 - p.x).max(0.0), p.z + 0.003);
    p.extend(one.rest_positions().iter().map(shift));
    t.extend(one.triangles().iter().map(|t| t.map(|v| v + count)));
    let flat = |i: usize| if i < count as usize { p[i] } else { p[i] + Vec3::Y };
    let mesh = Mesh::new((0..p.len()).map(flat).collect(), t).unwrap();
    let calm = Environment { gravity: Vec3::ZERO, ..Environment::default() };
    let model = Model::new(mesh, Material::default(), calm, None, &[]).unwrap();
    let mut state = State { velocities: vec![Vec3::ZERO; p.len()], positions: p };
    for q in &mut state.positions[count as usize..] {
        q.y -= 0.012;
    }
    let before = cloth::crossings(model.mesh(), &state.positions).len();
    assert!(before > 10, "{before}");
    let crossings = run(&model, &mut state, 60);
    assert_eq!(crossings.last(), Some(&0), "{crossings:?}");
}

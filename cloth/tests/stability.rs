//! Contact and determinism: nothing passes through a fast body, nothing is hidden between steps.

mod common;

use cloth::{Environment, Material, Mesh, Model, Span, State, Vec3, Workspace, measure, step};
use common::{ellipsoids, pose_at, sheet};

fn hanging() -> (Mesh, Vec<u32>) {
    let mesh = sheet(30, 30, |u, v| Vec3::new(u - 0.5, 1.0 - v, 0.0));
    (mesh, (0..=30).collect())
}

/// A rod sweeps through a sheet that floats before it.
fn sweep(speed: f32) -> (Model, State, f32, f32) {
    let (mesh, _) = hanging();
    let half = Vec3::new(0.7, 0.04, 0.04);
    let start = Vec3::new(0.0, 0.45, -0.2);
    let body = ellipsoids(&[(start, half)], 24);
    let environment = Environment { gravity: Vec3::ZERO, ..Environment::default() };
    let model = Model::new(mesh, Material::default(), environment, Some(body.clone()), &[]);
    let model = model.unwrap();
    let (mut state, mut ws) = (model.rest_state(), Workspace::default());
    let (mut depth, mut stretch) = (0.0f32, 0.0f32);
    let surface = model.surface().unwrap();
    for frame in 0..10 {
        let at = |f: u32| pose_at(&body, start + Vec3::Z * (speed * f as f32 / 30.0));
        let (from, to) = (at(frame), at(frame + 1));
        let span =
            Span { motion: Some((&from, &to)), seconds: 1.0 / 30.0, refine: 1, sort_layers: false };
        step(&model, &span, &mut state, &mut ws).unwrap();
        let found = measure::penetration(surface, ws.body(), &state.positions, 0.005, 0.004);
        depth = depth.max(found.depth_max_m);
        stretch = stretch.max(measure::stretch_max(model.mesh(), &state.positions));
        // The row that the rod met is still before it.
        let rod = to.root.z;
        if rod > 0.0 {
            let row = 17 * 31 + 15;
            assert!(state.positions[row].z > rod, "{speed} m/s: passed through in frame {frame}");
        }
    }
    (model, state, depth, stretch)
}

#[test]
fn a_rod_at_any_speed_takes_the_sheet_along() {
    for speed in [1.0, 2.0, 5.0, 10.0, 20.0] {
        let (_, state, depth, stretch) = sweep(speed);
        // At 20 m/s a substep takes the rod half its thickness on.
        assert!(depth < if speed > 10.0 { 0.010 } else { 0.004 }, "{speed} m/s: {depth} m deep");
        assert!(stretch < 0.15, "{speed} m/s: strain {stretch}");
        let fastest = state.velocities.iter().map(|v| v.length()).fold(0.0, f32::max);
        assert!(fastest < 2.0 * speed + 5.0, "{speed} m/s: {fastest} m/s");
    }
}

#[test]
fn a_sheet_comes_to_rest_on_a_ball_and_on_the_ground() {
    let mesh = sheet(30, 30, |u, v| Vec3::new(u - 0.5, 0.52, v - 0.5));
    let body = ellipsoids(&[(Vec3::Y * 0.3, Vec3::splat(0.2))], 32);
    let environment = Environment { ground: true, ..Environment::default() };
    let model =
        Model::new(mesh, Material::default(), environment, Some(body.clone()), &[]).unwrap();
    let (mut state, mut ws) = (model.rest_state(), Workspace::default());
    let pose = body.skeleton.rest_pose();
    let span =
        Span { motion: Some((&pose, &pose)), seconds: 1.0 / 30.0, refine: 1, sort_layers: false };
    for _ in 0..120 {
        step(&model, &span, &mut state, &mut ws).unwrap();
    }
    let surface = model.surface().unwrap();
    let found = measure::penetration(surface, ws.body(), &state.positions, 0.005, 0.004);
    assert!(found.depth_max_m < 1e-3, "{found:?}");
    assert!(state.positions.iter().all(|p| p.y > 0.002));
    let low = state.positions.iter().map(|p| p.y).fold(1.0, f32::min);
    assert!(low < 0.05, "the corners hang to the ground: {low}");
    let fastest = state.velocities.iter().map(|v| v.length()).fold(0.0, f32::max);
    assert!(fastest < 0.3, "{fastest}");
}

#[test]
fn a_sheet_between_two_closing_balls_is_held_and_comes_free() {
    let parts = [(Vec3::Z * -0.15, Vec3::splat(0.1)), (Vec3::Z * 0.15, Vec3::splat(0.1))];
    let body = ellipsoids(&parts, 24);
    let (mesh, _) = hanging();
    let move_down = mesh.rest_positions().iter().map(|p| *p - Vec3::Y * 0.5).collect();
    let mesh = Mesh::new(move_down, mesh.triangles().to_vec()).unwrap();
    let environment = Environment { gravity: Vec3::ZERO, ..Environment::default() };
    let model =
        Model::new(mesh, Material::default(), environment, Some(body.clone()), &[]).unwrap();
    let (mut state, mut ws) = (model.rest_state(), Workspace::default());
    // The second ball turns about the first: here only the closing matters, so the root carries
    // one ball and the other is moved by hand.
    let rest = body.skeleton.rest_pose();
    let mut last = 0.0;
    let close = |t: f32| 0.11 * t;
    let mut bodies = Vec::new();
    for t in (0..=15).map(|f| f as f32 / 15.0).chain((0..=15).rev().map(|f| f as f32 / 15.0)) {
        bodies.push(close(t));
    }
    for pair in bodies.windows(2) {
        let mut shifted = (*body).clone();
        for (p, j) in shifted.rest_positions.iter_mut().zip(&body.joints) {
            p.z += if j[0] == 0 { pair[1] } else { -pair[1] };
        }
        let closing = Model::new(
            model.mesh().clone(),
            Material::default(),
            environment,
            Some(std::sync::Arc::new(shifted)),
            &[],
        )
        .unwrap();
        let span = Span {
            motion: Some((&rest, &rest)),
            seconds: 1.0 / 30.0,
            refine: 1,
            sort_layers: false,
        };
        step(&closing, &span, &mut state, &mut ws).unwrap();
        last = measure::stretch_max(model.mesh(), &state.positions);
        assert!(last < 0.15, "{last}");
        let fastest = state.velocities.iter().map(|v| v.length()).fold(0.0, f32::max);
        assert!(fastest < 5.0, "{fastest}");
    }
    let surface = model.surface().unwrap();
    let posed = surface.posed(&body.rest_positions);
    let found = measure::penetration(surface, &posed, &state.positions, 0.005, 0.004);
    assert_eq!((found.deep, found.pinched), (0, 0));
    assert!(last < 0.15);
}

#[test]
fn restarts_and_repeats_are_equal_bit_for_bit() {
    let run = |workspaces: usize| {
        let (mesh, held) = hanging();
        let body = ellipsoids(&[(Vec3::new(0.0, 0.4, -0.2), Vec3::splat(0.1))], 16);
        let model = Model::new(
            mesh,
            Material::default(),
            Environment::default(),
            Some(body.clone()),
            &held,
        );
        let model = model.unwrap();
        let mut state = model.rest_state();
        let mut pool = vec![Workspace::default(); workspaces];
        for frame in 0..12 {
            let at = |f: usize| pose_at(&body, Vec3::new(0.0, 0.4, -0.2 + 0.05 * f as f32));
            let (from, to) = (at(frame), at(frame + 1));
            let span = Span {
                motion: Some((&from, &to)),
                seconds: 1.0 / 30.0,
                refine: 1,
                sort_layers: false,
            };
            step(&model, &span, &mut state, &mut pool[frame % workspaces]).unwrap();
        }
        state
    };
    // One workspace all along, and another at every frame.
    assert_eq!(run(1), run(12));
}

#[test]
fn a_wild_start_stays_finite() {
    let (mesh, held) = hanging();
    let model = Model::new(mesh, Material::default(), Environment::default(), None, &held).unwrap();
    let (mut state, mut ws) = (model.rest_state(), Workspace::default());
    let moving = state.positions.iter_mut().zip(&mut state.velocities).enumerate();
    for (i, (p, v)) in moving.skip(held.len()) {
        let noise = |k: usize| ((i * 7919 + k * 104_729) % 1000) as f32 / 1000.0 - 0.5;
        *p += 0.3 * Vec3::new(noise(1), noise(2), noise(3));
        *v += 40.0 * Vec3::new(noise(4), noise(5), noise(6));
    }
    for _ in 0..60 {
        let span = Span { motion: None, seconds: 1.0 / 30.0, refine: 1, sort_layers: false };
        step(&model, &span, &mut state, &mut ws).unwrap();
    }
    assert!(measure::stretch_max(model.mesh(), &state.positions) < 0.15);
    assert!(state.velocities.iter().all(|v| v.length() < 5.0));
}

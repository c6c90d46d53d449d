//! Prints what a step of the run-time face costs: `cargo run --release -p cloth --example
//! coarse_time`. A sheet of 14 x 14 points, pinned along one edge, swings over a figure of 16
//! capsules.

use std::time::Instant;

use cloth::coarse::{Capsule, Coarse, Input, Moving, Settings, Workspace};
use cloth::{Environment, Material, Mesh, Vec3};

fn main() {
    const N: u32 = 14;
    let at = |i: u32| {
        let (x, z) = ((i % N) as f32 / (N - 1) as f32, (i / N) as f32 / (N - 1) as f32);
        Vec3::new(x - 0.5, 1.0, z)
    };
    let cell = |i: u32| [[i, i + N, i + 1], [i + 1, i + N, i + N + 1]];
    let cells = (0..N * (N - 1)).filter(|i| i % N + 1 < N);
    let mesh = Mesh::new((0..N * N).map(at).collect(), cells.flat_map(cell).collect())
        .expect("a plain sheet");
    let pinned: Vec<u32> = (0..N).collect();
    let pins: Vec<Vec3> = pinned.iter().map(|v| at(*v)).collect();
    for passes in [4, 6, 8] {
        let settings = Settings { passes, ..Settings::default() };
        let model = Coarse::new(
            mesh.clone(),
            Material::default(),
            Environment::default(),
            &pinned,
            settings,
        )
        .expect("a plain sheet");
        let mut state = model.rest_state();
        let mut workspace = Workspace::default();
        let mut times_us = Vec::new();
        let limb = |c: usize, t: f32| {
            let swing = (6.0 * t + c as f32).sin() * 0.1;
            let y = 0.1 + 0.1 * (c / 2) as f32;
            let low = Vec3::new(0.2 * (c % 2) as f32 - 0.1, y, 0.15 + swing);
            Capsule { ends: [low, low + Vec3::Y * 0.1], radius: 0.06 }
        };
        for step in 0..2000 {
            let t = step as f32 / 60.0;
            let colliders: Vec<Moving> =
                (0..16).map(|c| Moving { from: limb(c, t), to: limb(c, t + 1.0 / 60.0) }).collect();
            let wind = Vec3::new(0.0, 0.0, 4.0 * (1.3 * t).sin());
            let (pins, seconds) = (&pins[..], 1.0 / 60.0);
            let input =
                Input { pins, colliders: &colliders, wind, push: &[], tethers: &[], seconds };
            let start = Instant::now();
            model.step(&input, &mut state, &mut workspace).expect("finite input");
            times_us.push(start.elapsed().as_secs_f64() * 1e6);
        }
        let first = times_us[0];
        times_us.sort_by(f64::total_cmp);
        println!(
            "{} points, 16 capsules, {passes} passes: p50 {:.0} us, p90 {:.0} us a step; the first, with \
             its factorisation, {first:.0} us",
            N * N,
            times_us[1000],
            times_us[1800],
        );
    }
}

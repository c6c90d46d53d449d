//! C1 to C6: cloth on shapes, swept, pinched, around a turning figure, against itself, in layers.

use std::sync::Arc;

use glam::{Quat, Vec3};

use super::shapes::{Cut, ellipsoids, pose_at, sheet, slab};
use super::{Bench, LabError, Limit, Setting, Sim, Stage};
use crate::body::{Body, Pose};
use crate::material::Material;
use crate::measure;
use crate::mesh::Mesh;
use crate::model::{Environment, Model};

pub(crate) const C1: Bench = Bench {
    name: "C1",
    about: "sheet dropped on a ball, on the edge of a box and on a spike, 5 s each",
    reference: "no vertex inside, no crossing, rest",
    fast: false,
    reads: Setting::ALL,
    run: on_shapes,
};

pub(crate) const C2: Bench = Bench {
    name: "C2",
    about: "rod of 4 cm swept through a floating sheet at 1, 2, 5, 10 and 20 m/s, at 30 frames/s",
    reference: "no vertex on the wrong side",
    fast: false,
    reads: Setting::ALL,
    run: swept,
};

pub(crate) const C3: Bench = Bench {
    name: "C3",
    about: "two balls close on a hanging sheet until they overlap by 10 mm, hold it 1 s, open",
    reference: "finite, calm and clean soon after",
    fast: false,
    reads: Setting::ALL,
    run: pinched,
};

pub(crate) const C4: Bench = Bench {
    name: "C4",
    about: "a figure of ellipsoids in a skirt turns cartwheels at one turn a second",
    reference: "no lasting tangle, no vertex deep inside",
    fast: false,
    reads: &[Setting::Fabric, Setting::Dt],
    run: cartwheel,
};

pub(crate) const C5: Bench = Bench {
    name: "C5",
    about: "sheet folded in eight, ribbon dropped on its end, tube twisted, and two sheets that \
            cross when they start",
    reference: "no crossing in any frame; none after 60 frames where it starts with some",
    fast: false,
    reads: &[Setting::Fabric, Setting::Dt],
    run: against_itself,
};

pub(crate) const C6: Bench = Bench {
    name: "C6",
    about: "three skirts over each other on a walking figure for 5 s, and started in wrong order",
    reference: "the order of the layers",
    fast: false,
    reads: &[Setting::Fabric, Setting::Dt],
    run: layers,
};

const FRAME_S: f32 = 1.0 / 30.0;

fn fastest(sim: &Sim) -> f32 {
    sim.state.velocities.iter().map(|v| v.length_squared()).fold(0.0, f32::max).sqrt()
}

fn ground() -> Environment {
    Environment { ground: true, ..Environment::default() }
}

fn on_shapes(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let n = stage.side(41);
    let spike = [(Vec3::Y * 0.35, Vec3::new(0.012, 0.25, 0.012))];
    let shapes: [(&str, Arc<Body>); 3] = [
        ("ball", ellipsoids(&[(Vec3::Y * 0.35, Vec3::splat(0.25))], 32)),
        ("box edge", slab(Vec3::new(0.3, 0.3, 0.0), Vec3::new(0.3, 0.3, 0.8))),
        ("spike", ellipsoids(&spike, 24)),
    ];
    let frames = if stage.quick() { 60 } else { 150 };
    for (name, body) in shapes {
        let mesh =
            sheet(n - 1, n - 1, Cut::Alternating, |u, v| Vec3::new(u - 0.45, 0.65, v - 0.5))?;
        let material = stage.material(Material::default());
        let model = Model::new(mesh, material, ground(), Some(body.clone()), &[])?;
        let mut sim = stage.sim(model, FRAME_S);
        sim.hits_every = 1;
        let pose = body.skeleton.rest_pose();
        let mut deepest = 0.0f32;
        for _ in 0..frames {
            stage.step(&mut sim, Some((&pose, &pose)))?;
            deepest = deepest.max(sim.depth_m);
        }
        let what = format!("{name}: deepest vertex");
        stage.row(what, f64::from(deepest) * 1e3, "mm", "0", Limit::AtMost(0.4));
        let end = f64::from(fastest(&sim));
        stage.row(format!("{name}: speed at the end"), end, "m/s", "rest", Limit::AtMost(0.05));
    }
    stage.row("crossings", stage.hits as f64, "", "0", Limit::AtMost(0.0));
    Ok(())
}

fn swept(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let n = stage.side(31);
    let start = Vec3::new(0.0, 0.45, 0.0);
    let body = ellipsoids(&[(start, Vec3::new(0.7, 0.04, 0.04))], 24);
    let calm = Environment { gravity: Vec3::ZERO, ..Environment::default() };
    for speed in [1.0f32, 2.0, 5.0, 10.0, 20.0] {
        let (mut passed, mut deep, mut strain, mut end) = (0, 0.0f32, 0.0f32, 0.0f32);
        // Where in a substep the rod meets the sheet is chance: three beginnings.
        for from_z in [-0.20, -0.17, -0.14] {
            let mesh =
                sheet(n - 1, n - 1, Cut::Alternating, |u, v| Vec3::new(u - 0.5, 1.0 - v, 0.0))?;
            let material = stage.material(Material::default());
            let model = Model::new(mesh, material, calm, Some(body.clone()), &[])?;
            let mut sim = stage.sim(model, FRAME_S);
            sim.hits_every = 1;
            let pose =
                |f: u32| pose_at(&body, start + Vec3::Z * (from_z + speed * f as f32 / 30.0));
            // The sheet's vertices at the height of the rod.
            let row = ((1.0 - start.y) * (n - 1) as f32).round() as u32;
            for f in 0..10 {
                stage.step(&mut sim, Some((&pose(f), &pose(f + 1))))?;
                let rod = pose(f + 1).root.z;
                let met = (row * n..(row + 1) * n).map(|v| sim.state.positions[v as usize]);
                passed += met.filter(|p| rod > 0.0 && p.z < rod).count();
                deep = deep.max(sim.depth_m);
                let mesh = sim.model.mesh();
                strain = strain.max(measure::stretch_quantile(mesh, &sim.state.positions, 0.99));
            }
            end = end.max(fastest(&sim));
        }
        let at = |what: &str| format!("{speed} m/s: {what}");
        let passed = passed as f64;
        stage.row(at("vertices that passed"), passed, "", "0", Limit::AtMost(0.0));
        let deep = f64::from(deep) * 1e3;
        stage.row(at("deepest vertex"), deep, "mm", "0", Limit::AtMost(4.0));
        let strain = f64::from(strain) * 100.0;
        stage.row(at("strain of 99 % of the edges"), strain, "%", "small", Limit::AtMost(10.0));
        let times = f64::from(end / speed);
        stage.row(at("fastest vertex at the end"), times, "x", "1", Limit::AtMost(2.0));
    }
    Ok(())
}

fn pinched(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let n = stage.side(31);
    let parts = [(Vec3::Z * -0.15, Vec3::splat(0.1)), (Vec3::Z * 0.15, Vec3::splat(0.1))];
    let mut body = (*ellipsoids(&parts, 24)).clone();
    // The second ball hangs on a joint a metre below, whose turning moves it.
    let pivot = Vec3::new(0.0, -1.0, 0.15);
    body.skeleton.rest[1].translation = pivot;
    body.skeleton.offsets[1] = pivot - body.skeleton.rest[0].translation;
    let body = Arc::new(body);
    let mesh = sheet(n - 1, n - 1, Cut::Alternating, |u, v| Vec3::new(u - 0.5, 0.5 - v, -0.04))?;
    let calm = Environment { gravity: Vec3::ZERO, ..Environment::default() };
    let material = stage.material(Material::default());
    let model = Model::new(mesh, material, calm, Some(body.clone()), &[])?;
    let mut sim = stage.sim(model, FRAME_S);
    let pose = |close: f32| {
        let mut pose = body.skeleton.rest_pose();
        pose.rotations[1] = Quat::from_rotation_x(-(0.11 * close).asin());
        pose
    };
    // Half a second to close and to open, one between.
    let close = |f: u32| match f {
        0..15 => f as f32 / 15.0,
        15..45 => 1.0,
        _ => (1.0 - (f as f32 - 45.0) / 15.0).max(0.0),
    };
    let driver = 0.11 / 0.5;
    let (mut speed, mut strain) = (0.0f32, 0.0f32);
    for f in 0..75 {
        sim.hits_every = u64::from(f == 74);
        stage.step(&mut sim, Some((&pose(close(f)), &pose(close(f + 1)))))?;
        speed = speed.max(fastest(&sim));
        strain =
            strain.max(measure::stretch_quantile(sim.model.mesh(), &sim.state.positions, 0.99));
    }
    let times = f64::from(speed / driver);
    stage.row("fastest vertex against the ball", times, "x", "1", Limit::AtMost(2.0));
    let strain = f64::from(strain) * 100.0;
    stage.row("strain of 99 % of the edges", strain, "%", "small", Limit::AtMost(15.0));
    let hits = stage.hits as f64;
    stage.row("crossings 15 frames after", hits, "", "0", Limit::AtMost(0.0));
    let deep = f64::from(sim.depth_m) * 1e3;
    stage.row("deepest vertex 15 frames after", deep, "mm", "0", Limit::AtMost(0.4));
    Ok(())
}

/// An open tube around the y axis, flared downwards.
fn tube(top: (f32, f32), bottom: (f32, f32), around: u32, down: u32) -> Result<Mesh, LabError> {
    let (mut p, mut t) = (Vec::new(), Vec::new());
    for j in 0..=down {
        let s = j as f32 / down as f32;
        let (y, r) = (top.0 + (bottom.0 - top.0) * s, top.1 + (bottom.1 - top.1) * s);
        for i in 0..around {
            let a = std::f32::consts::TAU * (i as f32 + 0.5 * (j % 2) as f32) / around as f32;
            p.push(Vec3::new(r * a.sin(), y, r * a.cos()));
        }
    }
    for j in 0..down {
        for i in 0..around {
            let at = |j: u32, i: u32| j * around + i % around;
            let (a, b, c, d) = (at(j, i), at(j, i + 1), at(j + 1, i), at(j + 1, i + 1));
            if j % 2 == 0 {
                t.extend([[a, c, b], [b, c, d]]);
            } else {
                t.extend([[a, c, d], [a, d, b]]);
            }
        }
    }
    Ok(Mesh::new(p, t)?)
}

/// Trunk and two legs; the legs' joints are at the hips.
fn figure() -> Arc<Body> {
    let leg = |x: f32| (Vec3::new(x, 0.5, 0.0), Vec3::new(0.07, 0.46, 0.07));
    let parts = [(Vec3::Y * 1.1, Vec3::new(0.16, 0.3, 0.12)), leg(0.09), leg(-0.09)];
    let mut body = (*ellipsoids(&parts, 20)).clone();
    for (joint, x) in [(1, 0.09), (2, -0.09)] {
        let hip = Vec3::new(x, 0.9, 0.0);
        body.skeleton.rest[joint].translation = hip;
        body.skeleton.offsets[joint] = hip - body.skeleton.rest[0].translation;
    }
    Arc::new(body)
}

/// The legs swing by `stride` radians, in step with the phase.
fn stride(body: &Body, phase: f32, stride: f32) -> Pose {
    let mut pose = body.skeleton.rest_pose();
    pose.rotations[1] = Quat::from_rotation_x(stride * phase.sin());
    pose.rotations[2] = Quat::from_rotation_x(-stride * phase.sin());
    pose
}

fn cartwheel(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let body = figure();
    let skirt = tube((1.1, 0.19), (0.5, 0.34), 56, 26)?;
    let held: Vec<u32> = (0..56).collect();
    let material = stage.material(Material::default());
    let model = Model::new(skirt, material, Environment::default(), Some(body.clone()), &held)?;
    let mut sim = stage.sim(model, FRAME_S);
    sim.hits_every = 1;
    let turns = if stage.quick() { 3 } else { 20 };
    let pose = |f: u32| {
        // One turn a second, after a second of rest; in the last turn one frame is a jump.
        let turn = (f as f32 - 30.0).max(0.0) / 30.0 + if f > 30 * turns { 0.1 } else { 0.0 };
        let angle = std::f32::consts::TAU * turn;
        let mut pose = stride(&body, angle, 0.5);
        pose.rotations[0] = Quat::from_rotation_z(-angle);
        pose.root = Vec3::new(0.0, 1.1, 0.0);
        pose
    };
    let (mut deep, mut frames, mut tangled, mut longest) = (0u32, 0u32, 0u32, 0u32);
    for f in 0..30 * (turns + 1) {
        stage.hits = 0;
        stage.step(&mut sim, Some((&pose(f), &pose(f + 1))))?;
        tangled = if stage.hits > 0 { tangled + 1 } else { 0 };
        longest = longest.max(tangled);
        frames += 1;
        deep += u32::from(sim.depth_m > 5e-3);
    }
    let share = f64::from(deep) / f64::from(frames) * 100.0;
    stage.row("frames with a vertex over 5 mm deep", share, "%", "0", Limit::AtMost(0.1));
    let longest = f64::from(longest);
    stage.row("longest tangle", longest, "frames", "0", Limit::AtMost(60.0));
    Ok(())
}

fn against_itself(stage: &mut Stage<'_>) -> Result<(), LabError> {
    folded(stage)?;
    let hits = stage.hits as f64;
    stage.row("crossings, folded sheet", hits, "", "0", Limit::AtMost(0.0));
    stage.hits = 0;
    let ribbon = sheet(4, 80, Cut::Alternating, |u, v| {
        Vec3::new(0.06 * u, 0.05 + 1.2 * v, 0.02 * (9.0 * v).sin())
    })?;
    let material = stage.material(Material::default());
    let mut sim = stage.sim(Model::new(ribbon, material, ground(), None, &[])?, FRAME_S);
    sim.hits_every = 1;
    for _ in 0..if stage.quick() { 45 } else { 120 } {
        stage.step(&mut sim, None)?;
    }
    let hits = stage.hits as f64;
    stage.row("crossings, dropped ribbon", hits, "", "0", Limit::AtMost(0.0));
    stage.hits = 0;
    twisted(stage)?;
    let hits = stage.hits as f64;
    stage.row("crossings, twisted tube", hits, "", "0", Limit::AtMost(0.0));
    stage.hits = 0;
    tangled(stage)?;
    let hits = stage.hits as f64;
    stage.row("crossings left after 60 frames", hits, "", "0", Limit::AtMost(0.0));
    Ok(())
}

/// A sheet laid in eight layers, which falls flat.
fn folded(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let (across, along) = (12, 96);
    let mesh = sheet(across, along, Cut::Alternating, |u, v| Vec3::new(0.15 * u, 0.0, 1.2 * v))?;
    let material = stage.material(Material::default());
    let mut sim = stage.sim(Model::new(mesh, material, ground(), None, &[])?, FRAME_S);
    let (layer, rise) = (0.15f32, 0.012f32);
    for p in &mut sim.state.positions {
        let s = p.z / layer;
        let (k, t) = (s.floor().min(7.0), s - s.floor().min(7.0));
        // There and back, each layer above the last; the turns are rounded by the rise.
        let there = if k % 2.0 < 1.0 { t } else { 1.0 - t };
        p.y = 0.02 + rise * (k + t);
        p.z = there * (layer - rise);
    }
    sim.hits_every = 1;
    for _ in 0..if stage.quick() { 30 } else { 90 } {
        stage.step(&mut sim, None)?;
    }
    Ok(())
}

/// A tube between two discs, of which one turns twice.
fn twisted(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let disc = Vec3::new(0.095, 0.03, 0.095);
    let body = ellipsoids(&[(Vec3::Y * 0.35, disc), (Vec3::Y * -0.35, disc)], 16);
    let mesh = tube((0.35, 0.1), (-0.35, 0.1), 40, 44)?;
    let count = mesh.vertex_count() as u32;
    let held: Vec<u32> = (0..40).chain(count - 40..count).collect();
    let calm = Environment { gravity: Vec3::ZERO, ..Environment::default() };
    let material = stage.material(Material::default());
    let model = Model::new(mesh, material, calm, Some(body.clone()), &held)?;
    let mut sim = stage.sim(model, FRAME_S);
    sim.hits_every = 1;
    let frames = if stage.quick() { 40 } else { 120 };
    let turns = 2.0 * frames as f32 / 120.0;
    let pose = |f: u32| {
        let mut pose = body.skeleton.rest_pose();
        let angle = std::f32::consts::TAU * turns * f as f32 / frames as f32;
        pose.rotations[1] = Quat::from_rotation_y(angle);
        pose
    };
    for f in 0..frames {
        stage.step(&mut sim, Some((&pose(f), &pose(f + 1))))?;
    }
    Ok(())
}

/// Two sheets, the rim of one poked through the other.
fn tangled(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let one = sheet(16, 16, Cut::Alternating, |u, v| Vec3::new(0.3 * u, 0.0, 0.3 * v))?;
    let count = one.vertex_count();
    let (mut p, mut t) = (one.rest_positions().to_vec(), one.triangles().to_vec());
    p.extend(one.rest_positions().iter().map(|p| *p + Vec3::new(0.25, 1.0, 0.003)));
    t.extend(one.triangles().iter().map(|t| t.map(|v| v + count as u32)));
    let calm = Environment { gravity: Vec3::ZERO, ..Environment::default() };
    let material = stage.material(Material::default());
    let mut sim = stage.sim(Model::new(Mesh::new(p, t)?, material, calm, None, &[])?, FRAME_S);
    for p in &mut sim.state.positions[count..] {
        p.y -= 0.992 + 0.3 * (0.3 - p.x).max(0.0);
    }
    for frame in 0..60 {
        sim.hits_every = u64::from(frame == 59);
        stage.step(&mut sim, None)?;
    }
    Ok(())
}

/// Vertices of an outer skirt that are nearer to the axis of the figure's body than the inner one
/// is there: by 100 rays outwards at five heights.
fn layers(stage: &mut Stage<'_>) -> Result<(), LabError> {
    for wrong in [false, true] {
        let body = figure();
        let (mut p, mut t, mut layers, mut held) = (vec![], vec![], vec![], vec![]);
        for layer in 0..3u8 {
            let out = 0.008 * f32::from(layer);
            let one = tube((1.1, 0.17 + out), (0.55, 0.30 + out), 56, 24)?;
            let first = p.len() as u32;
            held.extend(first..first + 56);
            layers.extend(std::iter::repeat_n(layer, one.vertex_count()));
            p.extend_from_slice(one.rest_positions());
            t.extend(one.triangles().iter().map(|t| t.map(|v| v + first)));
        }
        let material = stage.material(Material::default());
        let mesh = Mesh::new(p, t)?;
        let model = Model::new(mesh, material, Environment::default(), Some(body.clone()), &held)?;
        let mut sim = stage.sim(model.with_layers(layers)?, FRAME_S);
        if wrong {
            sim.sort_layers = true;
            // The hem of the second skirt begins inside the first.
            let count = sim.state.positions.len() / 3;
            for p in &mut sim.state.positions[count..2 * count] {
                let in_by = 0.012 * ((0.8 - p.y) / 0.2).clamp(0.0, 1.0);
                let r = Vec3::new(p.x, 0.0, p.z);
                *p -= r.normalize_or_zero() * in_by;
            }
        }
        walk(stage, &mut sim, &body)?;
        let (name, lost) = (if wrong { "started wrong" } else { "in order" }, disorder(&sim));
        let what = format!("{name}: rays on which the order is wrong at the end");
        stage.row(what, f64::from(lost), "", "0", Limit::AtMost(0.0));
        let hits = stage.hits as f64;
        stage.row(format!("{name}: crossings at the end"), hits, "", "0", Limit::AtMost(0.0));
    }
    Ok(())
}

fn walk(stage: &mut Stage<'_>, sim: &mut Sim, body: &Body) -> Result<(), LabError> {
    let frames = if stage.quick() { 60 } else { 150 };
    let pose = |f: u32| {
        let phase = std::f32::consts::TAU * f as f32 / 30.0;
        let mut pose = stride(body, phase, 0.4 * (f as f32 / 20.0).min(1.0));
        pose.root += Vec3::Z * (1.2 * f as f32 / 30.0);
        pose
    };
    for f in 0..frames {
        stage.hits = 0;
        sim.hits_every = 1;
        stage.step(sim, Some((&pose(f), &pose(f + 1))))?;
    }
    Ok(())
}

/// Of 100 rays from the axis outwards, those that meet an outer skirt before an inner one.
fn disorder(sim: &Sim) -> u32 {
    let count = sim.state.positions.len() / 3;
    let at = &sim.state.positions;
    let middle = sim.body().iter().copied().sum::<Vec3>() / sim.body().len() as f32;
    let mut wrong = 0;
    for ray in 0..100 {
        let angle = std::f32::consts::TAU * (ray as f32 + 0.13) / 20.0;
        let way = Vec3::new(angle.sin(), 0.0, angle.cos());
        let from = Vec3::new(middle.x, 0.65 + 0.08 * (ray / 20) as f32, middle.z);
        let mut last = [0.0f32; 3];
        for t in sim.model.mesh().triangles() {
            let far = meets(from, way, t.map(|v| at[v as usize]));
            let layer = t[0] as usize / count;
            last[layer] = last[layer].max(far.unwrap_or(0.0));
        }
        wrong += u32::from(last[1] > 0.0 && last[1] < last[0]);
        wrong += u32::from(last[2] > 0.0 && last[2] < last[1]);
    }
    wrong
}

/// How far along a ray it meets a triangle (m).
fn meets(from: Vec3, way: Vec3, [a, b, c]: [Vec3; 3]) -> Option<f32> {
    let (e1, e2) = (b - a, c - a);
    let p = way.cross(e2);
    let determinant = e1.dot(p);
    if determinant.abs() < 1e-12 {
        return None;
    }
    let to = from - a;
    let u = to.dot(p) / determinant;
    let q = to.cross(e1);
    let v = way.dot(q) / determinant;
    let t = e2.dot(q) / determinant;
    (u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t > 0.0).then_some(t)
}

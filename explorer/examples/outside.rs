//! What a garment's upsampler makes of wind, without server and client: learned from a work folder's
//! initial graph, it runs as a client runs it, and is measured and drawn against the body.
//!
//! ```text
//! cargo run --release -p explorer --example outside -- SCENE WORK [WIND [PICTURE.png]]
//! ```
//!
//! After 0.5, 1, 2 and 4 s of walking in the wind (m/s, along x) it prints which share of the fine
//! vertices is more than 5 mm inside the body and how deep, how often coarse and fine cloth cut
//! themselves, and how large the coarse cloth is; the state that it began with first. One thread.
//!
//! What leads the coarse cloth is that of `client_lib::free`, written once more: the explorer does not
//! link the client (ARCHITECTURE.md, "Arrows").

use std::path::Path;
use std::time::Instant;

use cloth::coarse::{self, Coarse, Input, Moving, Settings, Tether};
use cloth::crossings::crossings;
use cloth::{Environment, Material, Mesh, Pose, Rigid, State, Surface, Vec3};
use codec::kernel::normals::Faces;
use codec::upsample::{Drive, Transform, Upsampler};
use explorer::grow::archive::Archive;
use explorer::import;
use explorer::pack::upsampler::{self, UpsamplerSettings};
use explorer::scene::Scene;
use explorer::view::GraphView;
use picture::{Camera, Layer, Paint, Sheet, View, render};
use protocol::StateId;
use protocol::links::LinkEntry;

type Failed = Box<dyn std::error::Error>;

/// When it is looked at (frames of 1/30 s).
const LOOKS: [usize; 5] = [0, 15, 30, 60, 120];
/// A vertex deeper than this is inside (m).
const DEEP_M: f32 = 0.005;

fn main() -> Result<(), Failed> {
    let mut arguments = std::env::args().skip(1);
    let name = arguments.next().ok_or("SCENE WORK [WIND [PICTURE.png]]")?;
    let work = arguments.next().ok_or("the work folder")?;
    let wind = arguments.next().map_or(Ok(4.0), |w| w.parse::<f32>())?;
    let picture = arguments.next();
    let scene = import::load_scene(&name, import::data_dir().as_deref())?;
    let archive = Archive::open(Path::new(&work), &scene)?;
    let view = archive.view(archive.shown());
    let (bytes, learned) = upsampler::learn(&scene, &view, &UpsamplerSettings::default())?;
    println!("{learned:?}");
    let upsampler = Upsampler::decode(&bytes)?;
    let p = upsampler.parts();
    println!(
        "{} capsules, {} tethers, {} floors, {} bytes",
        p.capsules.len(),
        p.tethers.len(),
        p.skins.iter().filter(|s| s.is_guarded()).count(),
        bytes.len()
    );
    let mut run = Run::new(&scene, &upsampler, &view)?;
    let mut sheet = Sheet::new(2 * LOOKS.len() as u32).titled(format!("{name}, wind {wind} m/s"));
    for frame in 0..=LOOKS[LOOKS.len() - 1] {
        if frame > 0 {
            run.frame(Vec3::new(wind, 0.0, 0.0))?;
        }
        if LOOKS.contains(&frame) {
            run.look(frame, &mut sheet)?;
        }
    }
    run.times_us.sort_by(f64::total_cmp);
    println!("coarse step p50 {:.0} us", run.times_us[run.times_us.len() / 2]);
    if let Some(file) = picture {
        std::fs::write(&file, sheet.image()?.png()?)?;
    }
    Ok(())
}

struct Run<'a> {
    scene: &'a Scene,
    upsampler: &'a Upsampler,
    coarse: Coarse,
    faces: Faces,
    fine: Mesh,
    state: State,
    workspace: coarse::Workspace,
    /// Where the character is in the primary graph, and its clip's world in ours.
    pose: protocol::PoseId,
    place: Rigid,
    chance: u32,
    residual: Vec<f32>,
    frames: usize,
    times_us: Vec<f64>,
}

impl<'a> Run<'a> {
    fn new(
        scene: &'a Scene,
        upsampler: &'a Upsampler,
        view: &dyn GraphView,
    ) -> Result<Self, Failed> {
        let coarse = model(upsampler)?;
        let links = view.links();
        let first = links
            .iter()
            .position(|l| matches!(l, LinkEntry::Interior { pose, .. } if *pose == scene.start));
        let mut rows = vec![0.0; 3 * upsampler.fine()];
        view.positions(StateId(first.ok_or("no state of the start pose")? as u64), &mut rows)?;
        let hips = scene.primary.pose(scene.start).pose.hips();
        let mut coarse_m = vec![0.0; 3 * upsampler.coarse()];
        upsampler.restrict(&rows, &mut coarse_m)?;
        let positions: Vec<Vec3> =
            coarse_m.chunks_exact(3).map(|p| hips.point(Vec3::from_slice(p))).collect();
        let velocities = vec![Vec3::ZERO; positions.len()];
        let mut run = Self {
            scene,
            upsampler,
            coarse,
            faces: Faces::new(upsampler.fine(), scene.garment.triangles.clone())?,
            fine: Mesh::new(scene.garment.positions.clone(), scene.garment.triangles.clone())?,
            state: State { positions, velocities },
            workspace: coarse::Workspace::default(),
            pose: scene.start,
            place: Rigid::IDENTITY,
            chance: 1,
            residual: Vec::new(),
            frames: 0,
            times_us: Vec::new(),
        };
        let made = run.fine_m()?;
        run.residual = rows.iter().zip(&made).map(|(x, m)| x - m).collect();
        Ok(run)
    }

    fn world(&self) -> Pose {
        self.scene.primary.pose(self.pose).pose.moved(&self.place)
    }

    /// One frame on, along an edge taken by chance.
    fn frame(&mut self, wind: Vec3) -> Result<(), Failed> {
        let from = self.world();
        let edges: Vec<_> = self.scene.primary.out_edges(self.pose).collect();
        self.chance = self.chance.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let edge = self.scene.primary.edge(edges[(self.chance >> 8) as usize % edges.len()]);
        self.place = self.place.after(&edge.alignment());
        self.pose = edge.to;
        let to = self.world();
        let parts = self.upsampler.parts();
        let steps = parts.stepping.steps;
        let mut before = joints(self.scene, &from);
        for step in 1..=steps {
            let between = from.interpolate(&to, f32::from(step) / f32::from(steps));
            let now = joints(self.scene, &between);
            let mut pins = Vec::new();
            self.upsampler.pins(&transforms(self.scene, &now, &Rigid::IDENTITY), &mut pins);
            let pins: Vec<Vec3> = pins.into_iter().map(Vec3::from_array).collect();
            let colliders: Vec<Moving> = parts
                .capsules
                .iter()
                .map(|c| {
                    let at = |joints: &[Rigid]| coarse::Capsule {
                        ends: c
                            .ends
                            .map(|e| joints[usize::from(c.joint)].point(Vec3::from_array(e))),
                        radius: c.radius,
                    };
                    Moving { from: at(&before), to: at(&now) }
                })
                .collect();
            let seconds = 1.0 / (self.scene.primary.fps() * f32::from(steps));
            let mut held = Vec::new();
            self.upsampler.tethers(&transforms(self.scene, &now, &Rigid::IDENTITY), &mut held);
            let tethers: Vec<Tether> = parts
                .tethers
                .iter()
                .zip(&held)
                .map(|(t, held)| Tether {
                    point: t.point.into(),
                    at: Vec3::from_array(held.at),
                    reach_m: t.reach_m,
                    normal: Vec3::from_array(held.normal),
                    floor_m: t.floor_m,
                })
                .collect();
            let (pins, colliders, tethers) = (&pins[..], &colliders[..], &tethers[..]);
            let input = Input { pins, colliders, wind, push: &[], tethers, seconds };
            let start = Instant::now();
            self.coarse.step(&input, &mut self.state, &mut self.workspace)?;
            self.times_us.push(1e6 * start.elapsed().as_secs_f64());
            before = now;
        }
        self.frames += 1;
        Ok(())
    }

    /// Fine rows (m) in the state frame.
    fn fine_m(&self) -> Result<Vec<f32>, Failed> {
        let pose = self.world();
        let to_frame = pose.hips().inverse();
        let points = self.state.positions.iter();
        let coarse_m: Vec<f32> = points.flat_map(|x| to_frame.point(*x).to_array()).collect();
        let joints = transforms(self.scene, &joints(self.scene, &pose), &to_frame);
        let drive = Drive { coarse_m: &coarse_m, joints: &joints };
        let mut made = vec![0.0; 3 * self.upsampler.fine()];
        let mut workspace = codec::upsample::Workspace::default();
        self.upsampler.apply(&drive, &self.faces, &mut workspace, &mut made, &mut [])?;
        let left = (1.0 - self.frames as f32 / 10.0).max(0.0);
        made.iter_mut().zip(&self.residual).for_each(|(x, r)| *x += left * r);
        Ok(made)
    }

    fn look(&self, frame: usize, sheet: &mut Sheet) -> Result<(), Failed> {
        let pose = self.world();
        let hips = pose.hips();
        let rows = self.fine_m()?;
        let fine: Vec<Vec3> =
            rows.chunks_exact(3).map(|p| hips.point(Vec3::from_slice(p))).collect();
        let body = &self.scene.body;
        let mut skin = Vec::new();
        body.skin(&pose, &mut Vec::new(), &mut skin);
        let surface = Surface::new(&body.rest_positions, &body.triangles);
        let posed = surface.posed(&skin);
        let mut depths: Vec<f32> =
            fine.iter().map(|p| -surface.signed_distance(&posed, *p, 0.5)).collect();
        depths.sort_by(f32::total_cmp);
        let inside = depths.iter().filter(|d| **d > DEEP_M).count();
        let mesh = self.coarse.mesh();
        let area: f32 = mesh
            .triangles()
            .iter()
            .map(|t| {
                let [a, b, c] = t.map(|v| self.state.positions[v as usize]);
                0.5 * (b - a).cross(c - a).length()
            })
            .sum();
        let rest: f32 = mesh.rest_areas().iter().sum();
        let coarse_cuts = crossings(mesh, &self.state.positions).len();
        println!(
            "{:.1} s: {:.2} % of vertices inside, p99 {:.1} mm, deepest {:.1} mm; cuts coarse {coarse_cuts}, \
             fine {}; area {:.2} of rest",
            frame as f32 / 30.0,
            100.0 * inside as f32 / fine.len() as f32,
            1e3 * depths[depths.len() * 99 / 100].max(0.0),
            1e3 * depths[depths.len() - 1].max(0.0),
            crossings(&self.fine, &fine).len(),
            area / rest,
        );
        let target = Vec3::new(hips.translation.x, 0.85, hips.translation.z);
        for (positions, triangles, what) in [
            (&fine[..], &self.scene.garment.triangles[..], "fine"),
            (&self.state.positions[..], mesh.triangles(), "coarse"),
        ] {
            let layers = [
                Layer { positions: &skin, triangles: &body.triangles, paint: Paint::BODY },
                Layer { positions, triangles, paint: Paint::CLOTH },
            ];
            let view = View::new(Camera::around(target, 4.4), 300, 380);
            sheet.push(render(&view, &layers)?, format!("{what}, {:.1} s", frame as f32 / 30.0));
        }
        Ok(())
    }
}

fn joints(scene: &Scene, pose: &Pose) -> Vec<Rigid> {
    let mut world = Vec::new();
    scene.body.skeleton.world(pose, &mut world);
    world
}

/// From the rest pose to where the joints are, followed by `then`.
fn transforms(scene: &Scene, joints: &[Rigid], then: &Rigid) -> Vec<Transform> {
    let one = |(joint, rest): (&Rigid, &Rigid)| {
        let moved = then.after(&joint.after(&rest.inverse()));
        let [x, y, z] = [Vec3::X, Vec3::Y, Vec3::Z].map(|axis| moved.vector(axis));
        let t = moved.translation;
        [[x.x, y.x, z.x, t.x], [x.y, y.y, z.y, t.y], [x.z, y.z, z.z, t.z]]
    };
    joints.iter().zip(&scene.body.skeleton.rest).map(one).collect()
}

/// The coarse cloth as a client makes it.
fn model(upsampler: &Upsampler) -> Result<Coarse, Failed> {
    let parts = upsampler.parts();
    let points = parts.points.iter().map(|p| Vec3::from_array(*p)).collect();
    let triangles = parts.triangles.iter().map(|t| t.map(u32::from)).collect();
    let (f, s) = (&parts.fabric, &parts.stepping);
    let material = Material {
        density: f.density,
        stretch: f.stretch,
        weft: f.weft,
        shear: f.shear,
        bend: f.bend,
        friction: f.friction,
        drag: f.drag,
        damping_s: f.damping_s,
        offset: f.offset,
    };
    let environment = Environment { ground: s.ground, ..Environment::default() };
    let pinned: Vec<u32> = parts.pins.iter().map(|pin| pin.point.into()).collect();
    let settings = Settings {
        passes: s.passes.into(),
        sweeps: s.sweeps.into(),
        compression: s.compression,
        damping_per_s: s.damping_per_s,
        expansion_m: s.expansion_m,
        spacing_m: s.spacing_m,
        apart_m: s.apart_m,
    };
    Ok(Coarse::new(Mesh::new(points, triangles)?, material, environment, &pinned, settings)?)
}

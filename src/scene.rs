//! `toile scene`: check, compute a motion graph, draw.

use std::path::Path;

use anyhow::{Context, Result, ensure};
use explorer::import::check::check_scene;
use explorer::import::compute::Density;
use explorer::import::{LoadOptions, data_dir, scene_graph};
use explorer::scene::Scene;
use glam::Vec3;
use picture::{Camera, Layer, Paint, Sheet, View};

use crate::{args, format, place};

/// Runs `toile scene ...`.
pub fn run(a: args::Scene) -> Result<()> {
    match a.command {
        args::SceneCommand::Check { file, json } => check(&file, json),
        args::SceneCommand::Graph { file, density, to, out } => graph(&file, density, &to, &out),
        args::SceneCommand::Answers { file, presses, seed, json } => {
            answers(&file, presses as usize, seed, json)
        }
        args::SceneCommand::Picture { file, out } => {
            place::ensure_writable(&out)?;
            let scene = load(&file)?;
            std::fs::write(&out, sheet(&scene)?)
                .with_context(|| format!("writing {}", out.display()))
        }
    }
}

/// Plays seeded presses through the scene's graph.
fn answers(file: &str, presses: usize, seed: u64, json: bool) -> Result<()> {
    let chunk = explorer::pack::scene_chunk::scene_chunk(&load(file)?);
    let scene = std::sync::Arc::new(client_lib::Scene::new(chunk)?);
    let answers = crate::view::answers::rehearse(&scene, presses, seed);
    if json {
        return format::print_json(&answers);
    }
    for (what, times) in [("any clip", answers.all), ("locomotion", answers.locomotion)] {
        println!(
            "{what:10}  {} presses: median {:.2} s, 90 % within {:.2} s; begins after {:.2} s (median)",
            times.presses, times.median_s, times.p90_s, times.begins_median_s
        );
    }
    Ok(())
}

/// Loads a scene by name or file.
pub fn load(name_or_file: &str) -> Result<Scene> {
    load_with(name_or_file, None)
}

/// Loads a scene by name or file; `vertices` of its garment, where given.
pub fn load_with(name_or_file: &str, vertices: Option<usize>) -> Result<Scene> {
    let options = LoadOptions { vertices };
    Ok(explorer::import::load_with(name_or_file, data_dir().as_deref(), options)?.scene)
}

/// The garment in the rest pose from four sides, then poses of every clip.
fn sheet(scene: &Scene) -> Result<Vec<u8>> {
    let poses_per_clip = 8;
    let mut sheet = Sheet::new(poses_per_clip).titled(format!("scene {}", scene.name));
    let (mut joints, mut body) = (Vec::new(), Vec::new());
    scene.body.skin(&scene.body.skeleton.rest_pose(), &mut joints, &mut body);
    for (name, turn) in [("front", 0.0), ("left", 0.25), ("back", 0.5), ("right", 0.75)] {
        for (what, cloth) in [("body", false), ("garment", true)] {
            let mut layers = vec![layer(&body, &scene.body.triangles, Paint::BODY)];
            if cloth {
                layers.push(layer(
                    &scene.garment.positions,
                    &scene.garment.triangles,
                    Paint::CLOTH,
                ));
            }
            let view = View::new(
                Camera::framing(&body, 0.75, turn * std::f32::consts::TAU, 0.1),
                210,
                280,
            );
            sheet.push(picture::render(&view, &layers)?, format!("{what} {name}"));
        }
    }
    for (clip, name) in scene.primary.clips().iter().enumerate() {
        let of_clip: Vec<_> = scene
            .primary
            .poses()
            .iter()
            .filter(|p| p.clip as usize == clip && !p.transition)
            .collect();
        for shot in 0..poses_per_clip as usize {
            let Some(pose) = of_clip.get(shot * of_clip.len() / poses_per_clip as usize) else {
                continue;
            };
            scene.body.skin(&pose.pose, &mut joints, &mut body);
            let centre = Vec3::new(pose.pose.root.x, 0.85, pose.pose.root.z);
            let view = View::new(Camera::around(centre, 4.6), 210, 280);
            let layers = [layer(&body, &scene.body.triangles, Paint::BODY)];
            sheet.push(picture::render(&view, &layers)?, format!("{name} {}", pose.frame));
        }
    }
    Ok(sheet.image()?.png()?)
}

fn layer<'a>(positions: &'a [Vec3], triangles: &'a [[u32; 3]], paint: Paint<'a>) -> Layer<'a> {
    Layer { positions, triangles, paint }
}

fn check(file: &str, json: bool) -> Result<()> {
    let report = check_scene(file, data_dir().as_deref())?;
    if json {
        return format::print_json(&report);
    }
    print!("{report}");
    Ok(())
}

fn graph(file: &str, seconds: Option<f32>, to: &[String], out: &Path) -> Result<()> {
    ensure!(file != "robe", "robe is built in with its own motion graph: there is none to compute");
    let sensible = seconds.is_none_or(|s| s.is_finite() && s > 0.0);
    ensure!(sensible, "--density {}: seconds, above 0", seconds.unwrap_or_default());
    place::ensure_writable(out)?;
    let density = seconds.map(Density::Reach);
    let graph = scene_graph(file, data_dir().as_deref(), density, to)?;
    std::fs::write(out, graph.to_json()).with_context(|| format!("writing {}", out.display()))?;
    let mut fits: Vec<f32> = graph.transitions.iter().map(|t| t.distance_m * 1e3).collect();
    fits.sort_by(f32::total_cmp);
    let at = |share: usize| fits.get(fits.len().saturating_sub(1) * share / 10).copied();
    println!(
        "{}: {} transitions; joints {:.0} mm apart where they leave (median; {:.0} at nine tenths)",
        out.display(),
        fits.len(),
        at(5).unwrap_or_default(),
        at(9).unwrap_or_default()
    );
    Ok(())
}

//! `toile simulate --converge`.

use anyhow::Result;
use client_lib::WalkSpec;
use explorer::simulate::converge::{Row, converge, markdown};
use serde::Serialize;

use super::{start_at_clip, walk};
use crate::live::Live;
use crate::{args, format, scene};

/// When answers are compared (s).
const HORIZONS_S: [f32; 4] = [0.0, 0.5, 1.0, 3.0];
/// Vertices of the coarsest mesh where the user does not say.
const VERTICES: usize = 5000;

/// What is printed with `--json`.
#[derive(Debug, Serialize)]
struct Report<'a> {
    scene: &'a str,
    walk: &'a str,
    vertices: [usize; 3],
    rows: &'a [Row],
}

/// Compares, and prints the table.
pub fn run(a: &args::Simulate, spec: &WalkSpec) -> Result<()> {
    let vertices = a.vertices.unwrap_or(VERTICES);
    let vertices = [vertices, 2 * vertices, 4 * vertices];
    let mut scenes = Vec::new();
    for count in vertices {
        let mut scene = scene::load_with(&a.scene, Some(count))?;
        start_at_clip(&mut scene, spec);
        scenes.push(scene);
    }
    let first = &scenes[0];
    let horizons = HORIZONS_S.map(|s| (s * first.primary.fps()).round() as usize);
    let walk: Vec<_> = walk(first, spec)?.take(horizons[HORIZONS_S.len() - 1]).collect();
    let mut live = Live::new(None);
    let rows = converge(&scenes, &walk, &horizons, &mut |what| live.tell(0, || what.into()));
    live.done();
    let rows = rows?;
    if a.json {
        let report = Report { scene: &first.name, walk: &a.walk, vertices, rows: &rows };
        return format::print_json(&report);
    }
    println!("distance in mm: RMS / p95 / max; {} vertices, {}\n", vertices[0], a.walk);
    print!("{}", markdown(&rows));
    Ok(())
}

//! What `toile lab run` writes for people who look: a contact sheet, an animated glTF file.

use std::path::PathBuf;

use anyhow::{Context, Result};
use explorer::cloth::lab::Shot;
use glam::Vec3;
use picture::glb::{Clip, ClipMesh, FRAMES_MAX};
use picture::{Camera, Layer, Paint, Sheet, View};

use crate::place;

/// Pictures of a contact sheet, about.
const SHOTS: usize = 24;
const BODY: picture::Rgb = [196, 176, 160];
const CLOTH: picture::Rgb = [72, 118, 196];

struct Kept {
    run: u32,
    time_s: f32,
    cloth: Vec<Vec3>,
    triangles: Vec<[u32; 3]>,
    body: Vec<Vec3>,
    body_triangles: Vec<[u32; 3]>,
}

/// Keeps what was shown, as much of it as was asked for.
pub struct Recorder {
    picture: Option<PathBuf>,
    export: Option<PathBuf>,
    shots: Vec<Kept>,
    /// Every so many frames one is kept; doubled when there are too many.
    every: u64,
    seen: u64,
    /// All frames of the first run.
    frames: Vec<Kept>,
    seconds: f32,
}

impl Recorder {
    /// Refuses files that could not be written, before anything is simulated.
    pub fn new(picture: Option<PathBuf>, export: Option<PathBuf>) -> Result<Self> {
        for file in [&picture, &export].into_iter().flatten() {
            place::ensure_writable(file)?;
        }
        let (shots, frames) = (Vec::new(), Vec::new());
        Ok(Self { picture, export, shots, every: 1, seen: 0, frames, seconds: 0.0 })
    }

    /// Takes a frame.
    pub fn take(&mut self, shot: &Shot<'_>) {
        if self.picture.is_some() {
            if self.seen.is_multiple_of(self.every) {
                self.shots.push(keep(shot));
            }
            if self.shots.len() == 2 * SHOTS {
                let mut odd = false;
                self.shots.retain(|_| {
                    odd = !odd;
                    odd
                });
                self.every *= 2;
            }
        }
        if self.export.is_some() && shot.run == 0 && self.frames.len() < FRAMES_MAX {
            self.seconds = shot.time_s;
            self.frames.push(keep(shot));
        }
        self.seen += 1;
    }

    /// Writes the files.
    pub fn finish(self, name: &str) -> Result<()> {
        if let Some(file) = &self.picture {
            let bytes = self.sheet(name)?;
            std::fs::write(file, bytes).with_context(|| format!("writing {}", file.display()))?;
        }
        let Some(file) = &self.export else { return Ok(()) };
        let Some(first) = self.frames.first() else { return Ok(()) };
        let cloth: Vec<Vec<Vec3>> = self.frames.iter().map(|f| f.cloth.clone()).collect();
        let body: Vec<Vec<Vec3>> = self.frames.iter().map(|f| f.body.clone()).collect();
        let mesh = |name, triangles, frames, colour, two_sided| ClipMesh {
            name,
            triangles,
            frames,
            colour,
            two_sided,
        };
        let mut meshes = vec![mesh("cloth", &first.triangles[..], &cloth[..], CLOTH, true)];
        if !first.body.is_empty() {
            meshes.push(mesh("body", &first.body_triangles[..], &body[..], BODY, false));
        }
        let rate = self.frames.len() as f32 / self.seconds.max(1e-3);
        let bytes = picture::glb::glb(&Clip { rate, normals: true, meshes: &meshes })?;
        std::fs::write(file, bytes).with_context(|| format!("writing {}", file.display()))
    }

    /// Each run is looked at from one place, from which all its kept frames can be seen.
    fn sheet(&self, name: &str) -> Result<Vec<u8>> {
        let mut sheet = Sheet::new(8).titled(format!("toile lab run {name}"));
        for kept in &self.shots {
            let run = self.shots.iter().filter(|s| s.run == kept.run);
            let points: Vec<Vec3> = run
                .flat_map(|s| s.cloth.iter().step_by(1 + s.cloth.len() / 500))
                .copied()
                .collect();
            let camera = Camera::framing(&points, 1.0, 0.6, 0.25);
            let view = View { ground: None, ..View::new(camera, 240, 240) };
            let layers = [
                Layer {
                    positions: &kept.body,
                    triangles: &kept.body_triangles,
                    paint: Paint::BODY,
                },
                Layer { positions: &kept.cloth, triangles: &kept.triangles, paint: Paint::CLOTH },
            ];
            let layers = if kept.body.is_empty() { &layers[1..] } else { &layers[..] };
            let caption = format!("run {}, {:.3} s", kept.run + 1, kept.time_s);
            sheet.push(picture::render(&view, layers)?, caption);
        }
        Ok(sheet.image()?.png()?)
    }
}

fn keep(shot: &Shot<'_>) -> Kept {
    let (body, body_triangles) = shot.body.unwrap_or((&[], &[]));
    Kept {
        run: shot.run,
        time_s: shot.time_s,
        cloth: shot.positions.to_vec(),
        triangles: shot.triangles.to_vec(),
        body: body.to_vec(),
        body_triangles: body_triangles.to_vec(),
    }
}

//! What `toile play` and `toile simulate` write for people who look: an animated glTF file, a contact sheet.

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use crate::place;
use anyhow::{Context, Result, ensure};
use client_lib::Character;
use glam::Vec3;
use picture::glb::{Clip, ClipMesh};
use picture::{Camera, Layer, Paint, Sheet, View};

/// Pictures of a contact sheet.
pub const SHOTS: u64 = 40;
const SHEET_COLUMNS: u32 = 8;
/// Under cloth the body is drawn this much thinner than it was simulated against (m). Merging, blending and
/// lossy coding move cloth by more than the gap that contact keeps, and skin that pokes through by
/// a hair is seen at once, while a thinner body under cloth is not (Kim et al. 2013, section 4).
const BODY_INSET_M: f32 = 0.005;
/// What is further from any cloth than about this, face and hands, keeps its shape (m).
const COVERED_M: f32 = 0.03;
const BODY: picture::Rgb = [196, 176, 160];
const CLOTH: picture::Rgb = [72, 118, 196];

/// Keeps what was shown, as much of it as was asked for.
pub struct Recorder {
    export: Option<PathBuf>,
    picture: Option<PathBuf>,
    frames: u64,
    shots: u64,
    played: u64,
    body: Vec<Vec<Vec3>>,
    cloth: Vec<Vec<Vec3>>,
    sheet: Sheet,
    joints: Vec<client_lib::Rigid>,
}

/// A frame as it is drawn.
pub struct Shown<'a> {
    /// The body in the world (m); empty where there is none.
    pub body: Vec<Vec3>,
    /// The cloth in the world (m).
    pub cloth: &'a [Vec3],
    /// Where the hips are (m).
    pub hips: Vec3,
    /// What stands under the picture.
    pub caption: String,
}

/// What stays the same from frame to frame.
#[derive(Clone, Copy)]
pub struct Meshes<'a> {
    /// Triangles of the body.
    pub body: &'a [[u32; 3]],
    /// Triangles of the cloth.
    pub cloth: &'a [[u32; 3]],
    /// Name of the garment.
    pub garment: &'a str,
    /// Frames per second.
    pub fps: f32,
}

impl Recorder {
    /// Refuses files that could not be written, before anything is played. `shots` frames, evenly spaced,
    /// are drawn.
    pub fn new(
        export: Option<PathBuf>,
        picture: Option<PathBuf>,
        frames: u64,
        shots: u64,
    ) -> Result<Self> {
        for file in [&export, &picture].into_iter().flatten() {
            place::ensure_writable(file)?;
        }
        let most = picture::glb::FRAMES_MAX as u64;
        ensure!(
            export.is_none() || frames <= most,
            "--export holds at most {most} frames; ask for fewer with --frames"
        );
        let sheet = Sheet::new(SHEET_COLUMNS);
        let (body, cloth, joints) = (Vec::new(), Vec::new(), Vec::new());
        Ok(Self { export, picture, frames, shots, played: 0, body, cloth, sheet, joints })
    }

    /// Takes a frame: the character, and its cloth in the world.
    pub fn frame(&mut self, character: &Character, cloth: &[Vec3]) -> Result<()> {
        let number = self.played;
        if !self.wants() {
            return Ok(());
        }
        let version = character.version();
        let pose = character.world_pose();
        let mut body = Vec::new();
        if let Some(mesh) = version.scene().body() {
            mesh.skin(&pose, &mut self.joints, &mut body);
        }
        let caption = caption(character, number);
        self.keep(&meshes(version), Shown { body, cloth, hips: pose.root, caption })
    }

    /// Counts a frame; whether [`Recorder::keep`] is to be called for it.
    pub fn wants(&mut self) -> bool {
        self.played += 1;
        self.shoots() || self.export.is_some()
    }

    /// Whether the frame counted last is drawn.
    fn shoots(&self) -> bool {
        let (number, shots) = (self.played - 1, self.shots.min(self.frames));
        self.picture.is_some() && (number * shots) % self.frames < shots
    }

    /// Takes the frame counted last.
    pub fn keep(&mut self, meshes: &Meshes<'_>, mut shown: Shown<'_>) -> Result<()> {
        inset(&mut shown.body, meshes.body, shown.cloth);
        if self.shoots() {
            self.sheet.push(shot(meshes, &shown)?, shown.caption);
        }
        if self.export.is_some() {
            self.body.push(shown.body);
            self.cloth.push(shown.cloth.to_vec());
        }
        Ok(())
    }

    /// Writes the files.
    pub fn finish(self, character: &Character) -> Result<()> {
        let version = character.version();
        let title = format!("{}, version {}", version.mesh().name, version.number());
        self.write(&meshes(version), title)
    }

    /// Writes the files; the title stands above the contact sheet.
    pub fn write(self, meshes: &Meshes<'_>, title: String) -> Result<()> {
        if let Some(file) = &self.picture {
            write(file, &self.sheet.titled(title).image()?.png()?)?;
        }
        let Some(file) = &self.export else { return Ok(()) };
        let mut clip = Vec::new();
        if !meshes.body.is_empty() {
            clip.push(ClipMesh {
                name: "body",
                triangles: meshes.body,
                frames: &self.body,
                colour: BODY,
                two_sided: false,
            });
        }
        clip.push(ClipMesh {
            name: meshes.garment,
            triangles: meshes.cloth,
            frames: &self.cloth,
            colour: CLOTH,
            two_sided: true,
        });
        let clip = Clip { rate: meshes.fps, normals: true, meshes: &clip };
        write(file, &picture::glb::glb(&clip)?)
    }
}

fn meshes(version: &client_lib::version::Version) -> Meshes<'_> {
    Meshes {
        body: version.scene().body().map_or(&[], |body| &body.triangles),
        cloth: &version.mesh().triangles,
        garment: &version.mesh().name,
        fps: version.scene().fps(),
    }
}

/// Draws the body inwards where it is near cloth: vertices whose cell of a grid, or one beside it,
/// holds a vertex of the cloth.
fn inset(body: &mut [Vec3], triangles: &[[u32; 3]], cloth: &[Vec3]) {
    let cell = |p: &Vec3| (*p / COVERED_M).to_array().map(|c| c.floor() as i32);
    let covered: HashSet<[i32; 3]> = cloth.iter().map(cell).collect();
    let beside = |at: i32| at.saturating_sub(1)..=at.saturating_add(1);
    let near_cloth = |[x, y, z]: [i32; 3]| {
        beside(x).any(|x| beside(y).any(|y| beside(z).any(|z| covered.contains(&[x, y, z]))))
    };
    let normals = picture::raster::normals(body, triangles);
    for (p, n) in body.iter_mut().zip(normals) {
        if near_cloth(cell(p)) {
            *p -= BODY_INSET_M * n;
        }
    }
}

fn shot(meshes: &Meshes<'_>, shown: &Shown<'_>) -> Result<picture::Image> {
    let layer = |positions, triangles, paint| Layer { positions, triangles, paint };
    let mut layers = Vec::new();
    if !shown.body.is_empty() {
        layers.push(layer(&shown.body, meshes.body, Paint::BODY));
    }
    layers.push(layer(shown.cloth, meshes.cloth, Paint::CLOTH));
    // The camera keeps its height while the character is on the ground, so that a jump shows.
    let hips = shown.hips;
    let target = Vec3::new(hips.x, 0.85_f32.max(hips.y - 0.15), hips.z);
    let view = View::new(Camera::around(target, 4.4), 300, 380);
    Ok(picture::render(&view, &layers)?)
}

fn caption(character: &Character, number: u64) -> String {
    let scene = character.version().scene();
    let pose = character.pose();
    let clip = &scene.clips()[usize::from(scene.clip_of(pose))];
    let arrow = if scene.is_transition(pose) { "> " } else { "" };
    format!("{number}: {arrow}{clip} {}", scene.frame_of(pose))
}

fn write(file: &Path, bytes: &[u8]) -> Result<()> {
    std::fs::write(file, bytes).with_context(|| format!("writing {}", file.display()))
}

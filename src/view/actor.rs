//! A character on the page: how it looks, and its bytes for a frame.

use std::time::Instant;

use anyhow::Result;
use client_lib::{BlendMode, Character, Histogram, Rigid, StateId, decode};
use glam::Vec3;
use serde::Deserialize;

use super::skinned::Skinned;
use super::wire::{Figure, FrameWriter};

/// How cloth is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Blending {
    /// The jump is seen.
    Off,
    /// As the paper has it.
    #[default]
    Linear,
    /// Without a jump in velocity of the offset.
    Smooth,
}

impl From<Blending> for BlendMode {
    fn from(blending: Blending) -> Self {
        match blending {
            Blending::Off => Self::Off,
            Blending::Linear => Self::Linear,
            Blending::Smooth => Self::Smooth,
        }
    }
}

/// What colours the cloth of a character by distance.
#[derive(Debug, Clone, Default)]
pub struct Tint {
    /// Distance of each vertex between a dead end and its target, as a share of the largest.
    pub shares: Vec<f32>,
    /// How much of it shows now.
    pub weight: f32,
}

/// A state that stands still.
#[derive(Debug, Clone)]
pub struct Still {
    /// Which.
    pub state: StateId,
    /// Its cloth (m, 3 a vertex, in the state frame); empty until it is resident.
    pub positions: Vec<f32>,
}

/// A character on the page.
#[derive(Debug)]
pub struct Actor {
    /// What walks.
    pub character: Character,
    /// The pane it is drawn in.
    pub pane: u32,
    /// Columns of the basis that are decoded; more than there are: all.
    pub columns: usize,
    /// Where it stands, instead of where it walks (m); `None`: where it walks.
    pub spot: Option<Vec3>,
    /// Cloth by plain skinning instead.
    pub plain: Option<Skinned>,
    /// A state that is shown instead of the walk.
    pub still: Option<Still>,
    /// Colours.
    pub tint: Tint,
    positions: Vec<f32>,
    joints: Vec<Rigid>,
}

impl Actor {
    /// A character in a pane.
    pub fn new(character: Character, pane: u32) -> Self {
        Self {
            character,
            pane,
            columns: usize::MAX,
            spot: None,
            plain: None,
            still: None,
            tint: Tint::default(),
            positions: Vec::new(),
            joints: Vec::new(),
        }
    }

    /// Binds the cloth as it is now to the body, and skins it from now on.
    pub fn be_plain(&mut self) -> Result<()> {
        self.character.sample(1.0);
        self.decode()?;
        let character = &self.character;
        let scene = character.version().scene();
        scene.skeleton().world(&character.world_pose(), &mut self.joints);
        let hips = character.placement();
        let triangles = &character.version().mesh().triangles;
        self.plain = Skinned::bind(scene, (&hips, &self.joints), &self.positions, triangles);
        Ok(())
    }

    /// Writes the cloth at `phase` between the last frame and this one; the time of decoding goes
    /// into `decode_us`.
    pub fn write(
        &mut self,
        phase: f32,
        decode_us: &mut Histogram,
        writer: &mut FrameWriter,
    ) -> Result<()> {
        self.character.sample(phase);
        let start = Instant::now();
        self.decode()?;
        decode_us.record(start.elapsed().as_secs_f64() * 1e6);
        self.put(writer);
        Ok(())
    }

    /// Writes cloth that was decoded together with others'.
    pub fn write_decoded(&mut self, positions: &[f32], writer: &mut FrameWriter) {
        self.positions.clear();
        self.positions.extend_from_slice(positions);
        self.put(writer);
    }

    fn put(&mut self, writer: &mut FrameWriter) {
        let character = &self.character;
        let scene = character.version().scene();
        scene.skeleton().world(&character.world_pose(), &mut self.joints);
        for (joint, rest) in self.joints.iter_mut().zip(&scene.skeleton().rest) {
            *joint = joint.after(&rest.inverse());
        }
        let mut placement = character.placement();
        if let Some(skinned) = &self.plain {
            skinned.positions(&placement, &self.joints, &mut self.positions);
        }
        if let Some(spot) = self.spot {
            let level = Vec3::new(placement.translation.x, 0.0, placement.translation.z);
            placement.translation += spot - level;
            self.joints.iter_mut().for_each(|joint| joint.translation += spot - level);
        }
        let distances: Vec<f32> =
            self.tint.shares.iter().map(|share| share * self.tint.weight).collect();
        let joints = if scene.body().is_some() { &self.joints[..] } else { &[] };
        writer.add(&Figure {
            pane: self.pane,
            placement,
            positions: &self.positions,
            triangles: &character.version().mesh().triangles,
            joints,
            distances: &distances,
        });
    }

    fn decode(&mut self) -> Result<()> {
        let version = self.character.version();
        let (rows, columns) = (version.basis().rows(), version.basis().columns());
        self.positions.resize(rows, 0.0);
        let used = self.columns.min(columns);
        match &self.still {
            Some(still) if still.positions.len() == rows => {
                self.positions.copy_from_slice(&still.positions);
            }
            _ => decode(&[&self.character], 0..rows, used, &mut self.positions)?,
        }
        Ok(())
    }
}

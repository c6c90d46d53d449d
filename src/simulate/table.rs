//! The measures of every frame, for a spreadsheet.

use std::fmt::Write as _;
use std::path::PathBuf;

use anyhow::{Context, Result};
use explorer::scene::Scene;
use explorer::simulate::{Step, Straight};

use crate::place;

/// A table that is written at the end.
pub struct Table {
    file: PathBuf,
    text: String,
}

impl Table {
    /// Refuses a file that could not be written. Each class rule of the scene has a column: how far
    /// its region lies above the threshold (mm).
    pub fn new(file: PathBuf, scene: &Scene) -> Result<Self> {
        place::ensure_writable(&file)?;
        let mut text = String::from(
            "frame,pose,cpu_s,substeps,iterations,deep_1mm,deep_5mm,pinched,depth_max_mm,\
             stretch_max_pct,speed_max_m_s,crossings,retried,flagged",
        );
        for rule in &scene.metric.classes {
            write!(text, ",{}_above_mm", rule.name)?;
        }
        text.push('\n');
        Ok(Self { file, text })
    }

    /// Adds a frame.
    pub fn row(&mut self, frame: u64, name: &str, step: &Step, at: &Straight<'_>) -> Result<()> {
        let q = &step.quality;
        write!(
            self.text,
            "{frame},{name},{:.6},{},{},{},{},{},{:.3},{:.3},{:.3},{},{},{}",
            step.cpu_s,
            q.substeps,
            q.iterations,
            q.inside_vertex_frames,
            q.deep_vertex_frames,
            q.pinched_vertex_frames,
            q.depth_max_m * 1e3,
            q.stretch_max * 100.0,
            q.speed_max_m_s,
            q.crossings,
            q.frames_retried,
            q.frames_flagged
        )?;
        for height_m in at.class_heights() {
            write!(self.text, ",{:.1}", height_m * 1e3)?;
        }
        self.text.push('\n');
        Ok(())
    }

    /// Writes the file.
    pub fn write(self) -> Result<()> {
        let context = || format!("writing {}", self.file.display());
        std::fs::write(&self.file, &self.text).with_context(context)
    }
}

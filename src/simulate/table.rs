//! The measures of every frame, for a spreadsheet.

use std::fmt::Write as _;
use std::path::PathBuf;

use anyhow::{Context, Result};
use explorer::simulate::Step;

use crate::place;

/// A table that is written at the end.
pub struct Table {
    file: PathBuf,
    text: String,
}

impl Table {
    /// Refuses a file that could not be written.
    pub fn new(file: PathBuf) -> Result<Self> {
        place::ensure_writable(&file)?;
        let text = "frame,pose,cpu_s,substeps,iterations,deep_1mm,deep_5mm,pinched,depth_max_mm,\
                    stretch_max_pct,speed_max_m_s,crossings,retried,flagged\n";
        Ok(Self { file, text: text.into() })
    }

    /// Adds a frame.
    pub fn row(&mut self, frame: u64, name: &str, step: &Step) -> Result<()> {
        let q = &step.quality;
        writeln!(
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
        Ok(())
    }

    /// Writes the file.
    pub fn write(self) -> Result<()> {
        let context = || format!("writing {}", self.file.display());
        std::fs::write(&self.file, &self.text).with_context(context)
    }
}

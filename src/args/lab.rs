//! `toile lab`: what the user typed.

use std::path::PathBuf;

use clap::{Args, Subcommand};

/// `toile lab`.
#[derive(Debug, Args)]
pub struct Lab {
    /// What to do.
    #[command(subcommand)]
    pub command: LabCommand,
}

/// The commands of `toile lab`.
#[derive(Debug, Subcommand)]
pub enum LabCommand {
    /// Name all benches and fabrics.
    List {
        /// One JSON object on the last line of stdout.
        #[arg(long)]
        json: bool,
    },
    /// Run one bench. The exit code is 0 when it ran; whether it passed is printed.
    Run(LabRun),
    /// Run all benches and write the page of their figures, misses included.
    Table {
        /// Only these [default: all].
        only: Vec<String>,
        /// Where to write it [default: stdout].
        #[arg(long, value_name = "FILE.md")]
        out: Option<PathBuf>,
        /// Fewer cases.
        #[arg(long)]
        quick: bool,
    },
}

/// `toile lab run`.
#[derive(Debug, Args)]
pub struct LabRun {
    /// Name of the bench, in either case.
    pub name: String,
    /// Size of the mesh: vertices a side of a sheet, edges along a strip, rings of a disc. An option
    /// that a bench does not read is refused; `toile lab list` says which it reads.
    #[arg(long, conflicts_with = "vertices")]
    pub n: Option<u32>,
    /// The same as a number of vertices, about; where a bench compares meshes, of the coarsest.
    #[arg(long)]
    pub vertices: Option<u32>,
    /// One of the fabrics of `toile lab list` [default: the bench's own material]. Where the answer is
    /// of cloth that cannot stretch or bend, only its weight and the other stiffness count.
    #[arg(long)]
    pub fabric: Option<String>,
    /// Longest substep (s) [default: the solver's own, 1/120].
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    pub dt: Option<f32>,
    /// Fewer cases.
    #[arg(long)]
    pub quick: bool,
    /// One JSON object on the last line of stdout.
    #[arg(long)]
    pub json: bool,
    /// Write a contact sheet.
    #[arg(long, value_name = "FILE.png")]
    pub picture: Option<PathBuf>,
    /// Write the first run as an animated glTF file.
    #[arg(long, value_name = "FILE.glb")]
    pub export: Option<PathBuf>,
}

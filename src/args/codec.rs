//! `toile codec`: what to measure.

use std::path::PathBuf;

use clap::{Args, Subcommand};

/// `toile codec`.
#[derive(Debug, Args)]
pub struct Codec {
    /// What to measure.
    #[command(subcommand)]
    pub command: CodecCommand,
}

/// The commands of `toile codec`.
#[derive(Debug, Subcommand)]
pub enum CodecCommand {
    /// Time decoding at the papers' dimensions beside the speed of this machine's memory.
    DecodeBench(DecodeBench),
    /// Encode the states of an explored store with every codec: bytes, errors, times.
    Bench(CodecBench),
    /// How deep shown cloth is in the body, what a renderer does about it, and blends at merges.
    Contact(CodecContact),
}

/// `toile codec contact`.
#[derive(Debug, Args)]
pub struct CodecContact {
    /// Object store: a folder or a URL.
    #[arg(value_name = "STORE")]
    pub store: String,
    /// Work folder that it was explored in [default: beside a local store].
    #[arg(long, value_name = "DIR")]
    pub work: Option<PathBuf>,
    /// Within which cloth is decoded (mm).
    #[arg(long, value_name = "MM", default_value_t = 15.0)]
    pub bound_mm: f32,
    /// At most so many states, whole regions spread evenly.
    #[arg(long, default_value_t = 2000)]
    pub states: usize,
    /// At most so many merges.
    #[arg(long, default_value_t = 200)]
    pub merges: usize,
    /// Write the data: counts of body and garment vertices (u32), then a number each (f32, m).
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// One JSON object on the last line of stdout.
    #[arg(long)]
    pub json: bool,
}

/// `toile codec bench`.
#[derive(Debug, Args)]
pub struct CodecBench {
    /// Object store: a folder or a URL.
    #[arg(value_name = "STORE")]
    pub store: String,
    /// Work folder that it was explored in, which holds the exact states [default: beside a local
    /// store].
    #[arg(long, value_name = "DIR")]
    pub work: Option<PathBuf>,
    /// Also a codec that keeps every vertex within this distance (mm).
    #[arg(long, value_name = "MM", allow_negative_numbers = true)]
    pub bound_mm: Option<f32>,
    /// At most so many states, whole regions spread evenly [default: all].
    #[arg(long)]
    pub states: Option<usize>,
    /// Rows that have not begun after so many minutes are left out, and named.
    #[arg(long, value_name = "MINUTES", default_value_t = 60)]
    pub minutes: u32,
    /// Instead: grow a graph in ten appended versions, and make a new basis at the end.
    #[arg(long)]
    pub generations: bool,
    /// Also write the exact states, and the rounded coefficients, for other programs to code.
    #[arg(long, value_name = "DIR")]
    pub export: Option<PathBuf>,
    /// One JSON object on the last line of stdout.
    #[arg(long)]
    pub json: bool,
}

/// `toile codec decode-bench`.
#[derive(Debug, Args)]
pub struct DecodeBench {
    /// Other memory read between cold frames, and for the read bandwidth (MiB).
    #[arg(long, default_value_t = 256, value_parser = clap::value_parser!(u32).range(256..=65536))]
    pub other_mb: u32,
    /// One JSON object on the last line of stdout.
    #[arg(long)]
    pub json: bool,
}

//! Profile `toile`: an orthonormal basis coded by its share of a bound, one step for all
//! coefficients, prediction in time, entropy coding, and sparse fixes.
//!
//! * A column is predicted vertex by vertex from coarser vertices ([`Tree`]); what is left is
//!   rounded by the column's share of the bound and range-coded ([`crate::entropy`]).
//! * A coefficient is `step * q` over an orthonormal column: one step for all of them is the
//!   reverse water-filling allocation for the mean square. `q` is predicted from the two states
//!   before, per column, and range-coded at the size that column and activity let expect.
//! * A vertex that is still too far off gets a fix of its own.
//!
//! Decoded, a generation is one of [`crate::kim2013`] and a region holds coefficients in fractions
//! of full scale: reconstruction does not know which profile it serves.

mod generation;
mod model;
mod region;
mod tree;

pub use generation::{
    Generation, GenerationError, GenerationParts, encode_generation, parse_generation,
};
pub use model::{COLUMN_BYTES, Column, FrameKind, Model};
pub use region::{
    Fix, Region, RegionError, RegionParts, TIERS, encode_region, parse_region, step_m,
};
pub use tree::{PARENTS, Tree, TreeError};

/// Name of the profile in a manifest.
pub const PROFILE: &str = "toile";
/// Entries of one generation, at most: what is unpacked stays within 256 MiB.
pub const ENTRIES_MAX: usize = 1 << 27;
/// Fixes of one region, at most.
pub const FIXES_MAX: usize = 1 << 20;
/// Lengths in headers count quarter octaves of this (m): 2^-20.
pub const UNIT_M: f32 = 1.0 / (1 << 20) as f32;

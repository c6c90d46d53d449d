//! Profile `kim2013`: Kim et al. 2013, section 4, in its live form.
//!
//! `D ~ B C` with orthonormal columns `B`. With `M` the largest absolute coefficient of each
//! column (extended by a headroom), `B' = B M` is in metres and is rounded to steps of 300
//! micrometres, kept in 8 or 16 bits a column; `C' = M^-1 C` lies in -1..=1 and is rounded to
//! 16 bits. No mean, no prediction, no entropy coding. What falls outside opens a generation of
//! appended columns with maxima of their own, so older bytes stay valid.

mod generation;
mod region;

pub use generation::{
    Generation, GenerationError, QuantiseError, Width, encode_generation, quantise_column,
};
pub use region::{
    FULL_SCALE, Region, RegionError, encode_region, quantise_coefficient, quantise_coefficients,
};

/// Name of the profile in a manifest.
pub const PROFILE: &str = "kim2013";
/// Step to which rescaled columns are rounded (m): the coarsest without visible artefacts
/// according to the paper.
pub const STEP_M: f32 = 300e-6;

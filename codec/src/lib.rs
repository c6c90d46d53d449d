//! Cloth states to bytes and back.
//!
//! Goals: a stated bitstream per profile, encoder and decoder side by side; decoders that survive
//! any bytes; reconstruction of positions on one core in a fraction of a millisecond, without
//! allocating.
//!
//! Non-goals: which columns or coefficients are worth keeping (policy, in `explorer`), files,
//! networks, threads, clocks.
//!
//! ```
//! use codec::{Basis, kim2013};
//!
//! // Encoder: two rows, one column whose largest contribution is 30 mm, one state at half of it.
//! let mut entries = [0i16; 2];
//! kim2013::quantise_column(&[0.03, -0.015], kim2013::STEP_M, &mut entries)?;
//! let mut generation = Vec::new();
//! kim2013::encode_generation(2, kim2013::STEP_M, &[1.0], &entries, &mut generation)?;
//! let mut steps = [0i16; 1];
//! kim2013::quantise_coefficients(&[0.5], &mut steps)?;
//! let mut region = Vec::new();
//! kim2013::encode_region(1, &steps, &mut region)?;
//!
//! // Decoder.
//! let mut basis = Basis::new();
//! basis.append(&kim2013::Generation::parse(&generation)?)?;
//! let mut coefficients = [0.0; 1];
//! kim2013::Region::parse(&region)?.state(0, &mut coefficients);
//! let mut positions = [0.0; 2];
//! basis.reconstruct(&coefficients, 0..2, 1, &mut positions)?;
//! assert!((positions[0] - 0.015).abs() < 1e-5);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! Map: [`kim2013`] the first profile's bitstream; [`toile`] the bounded one, over [`entropy`];
//! [`basis`] the resident columns; [`upsample`] a learned upsampler; [`kernel`] the SIMD room. The
//! byte tables stand in docs/formats.md.

pub mod basis;
pub mod decoder;
pub mod entropy;
pub mod kernel;
pub mod kim2013;
pub mod toile;
pub mod upsample;

pub use basis::{AppendError, Basis, ReconstructError};
pub use decoder::{DecodedRegion, Decoder, DecoderError, VertexFix};

/// Rows of a basis: three per vertex.
pub const ROWS_MAX: usize = 3 << 20;
/// Columns of a basis, all generations together.
pub const COLUMNS_MAX: usize = 2048;
/// States in one region.
pub const REGION_STATES_MAX: usize = 32;

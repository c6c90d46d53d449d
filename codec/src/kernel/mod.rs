//! The SIMD room: dense products of quantised columns with a few coefficients, panel by panel.
//!
//! A panel is 64 rows. Columns lie in pairs, row by row: entry of the first column, entry of the
//! second; so one instruction (`vpdpwssd`, `vpmaddwd`, `smlal`) multiplies a pair's entries with a
//! pair of 16-bit coefficients and adds both to an i32 sum, and a panel is one sequential stream.
//!
//! Sums of integers are exact: [`Panels`] proves once, when columns come in, that no sum of a
//! block can leave 32 bits, whatever the coefficients, and divides the columns into more blocks
//! where one could. So the scalar twin and every instruction set give the same bits.
//!
//! Map: [`panels`] columns in panel layout; [`decode`] positions of one or many characters;
//! [`operator`] upsampling; [`normals`] normals of vertices; [`read`] how fast memory can be read
//! at all, to compare with.

mod decode;
mod memory;
#[cfg(target_arch = "aarch64")]
mod neon;
pub mod normals;
pub mod operator;
mod pairs;
pub mod panels;
pub mod read;
#[cfg(target_arch = "x86_64")]
mod x86;

pub use decode::{Batch, Select, decode};
pub use panels::{Column, Entries, Panels, PanelsError};

/// Rows of a panel.
pub const PANEL_ROWS: usize = 64;

/// An instruction set that the kernels are written for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Set {
    /// Whatever the target has for sure.
    Scalar,
    /// AVX2: `vpmaddwd`.
    Avx2,
    /// AVX-512 F and BW with VNNI: `vpdpwssd`.
    Avx512Vnni,
    /// NEON: `smlal`.
    Neon,
}

impl Set {
    /// The best one that this CPU has.
    pub fn detect() -> Self {
        Self::available().last().copied().unwrap_or(Self::Scalar)
    }

    /// All that this CPU has, slowest first.
    pub fn available() -> &'static [Self] {
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx2") {
                let avx512 = is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512bw")
                    && is_x86_feature_detected!("avx512vnni");
                return if avx512 {
                    &[Self::Scalar, Self::Avx2, Self::Avx512Vnni]
                } else {
                    &[Self::Scalar, Self::Avx2]
                };
            }
        }
        #[cfg(target_arch = "aarch64")]
        {
            if std::arch::is_aarch64_feature_detected!("neon") {
                return &[Self::Scalar, Self::Neon];
            }
        }
        &[Self::Scalar]
    }

    /// This set where the CPU has it, else the scalar twin: what makes calling it sound.
    fn checked(self) -> Self {
        if Self::available().contains(&self) { self } else { Self::Scalar }
    }
}

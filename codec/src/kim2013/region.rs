//! A region in bytes: 16-bit coefficients of consecutive states.

use super::generation::QuantiseError;
use crate::{COLUMNS_MAX, REGION_STATES_MAX};

const VERSION: u16 = 1;
const HEADER_BYTES: usize = 6;

/// Steps from 0 to full scale of a coefficient.
pub const FULL_SCALE: f32 = 32_767.0;

/// Why a region could not be encoded or decoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RegionError {
    /// More or fewer bytes than the header asks for.
    #[error("region of {actual} bytes, but its header asks for {expected}")]
    Length {
        /// Bytes that the header asks for.
        expected: usize,
        /// Bytes given.
        actual: usize,
    },
    /// A version that this build does not know.
    #[error("kim2013 region of version {0}; this build reads version {VERSION}")]
    Version(u16),
    /// Outside the limits.
    #[error(
        "region of {states} states and {columns} columns; allowed are 1..={REGION_STATES_MAX} \
             states and 1..={COLUMNS_MAX} columns"
    )]
    Shape {
        /// States.
        states: usize,
        /// Columns.
        columns: usize,
    },
}

/// Rounds coefficients `C'` (-1..=1, fractions of their column's maximum) to 16 bits.
///
/// # Errors
/// A coefficient that is not finite, or beyond its headroom; slices of different lengths.
pub fn quantise_coefficients(coefficients: &[f32], out: &mut [i16]) -> Result<(), QuantiseError> {
    if coefficients.len() != out.len() {
        return Err(QuantiseError::Lengths { input: coefficients.len(), output: out.len() });
    }
    for (index, (&value, out)) in coefficients.iter().zip(out).enumerate() {
        if !value.is_finite() {
            return Err(QuantiseError::NotFinite { index, value });
        }
        *out = quantise_coefficient(value).ok_or(QuantiseError::OutOfRange {
            index,
            value,
            full_scale: 1.0,
        })?;
    }
    Ok(())
}

/// Rounds one coefficient to 16 bits; `None` when it is NaN or beyond full scale.
pub fn quantise_coefficient(value: f32) -> Option<i16> {
    let steps = (value * FULL_SCALE).round();
    (steps.abs() <= FULL_SCALE).then_some(steps as i16)
}

/// Writes a region to the end of `out`: `coefficients` has `columns` numbers per state, state
/// after state.
///
/// # Errors
/// A shape outside the limits, or numbers that are not a whole count of states. `out` is then as
/// before.
pub fn encode_region(
    columns: usize,
    coefficients: &[i16],
    out: &mut Vec<u8>,
) -> Result<(), RegionError> {
    let states = coefficients.len().checked_div(columns).unwrap_or(0);
    check_shape(states, columns)?;
    if coefficients.len() != states * columns {
        let (expected, actual) = (states * columns, coefficients.len());
        return Err(RegionError::Length { expected, actual });
    }
    out.extend_from_slice(&VERSION.to_le_bytes());
    out.extend_from_slice(&(columns as u16).to_le_bytes());
    out.extend_from_slice(&(states as u16).to_le_bytes());
    out.extend(coefficients.iter().flat_map(|c| c.to_le_bytes()));
    Ok(())
}

/// A checked region that still lies in its bytes.
#[derive(Debug, Clone, Copy)]
pub struct Region<'a> {
    states: usize,
    columns: usize,
    coefficients: &'a [u8],
}

impl<'a> Region<'a> {
    /// Checks everything that can be wrong; takes no memory.
    ///
    /// # Errors
    /// Bytes that are not exactly one region of this version.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, RegionError> {
        let (header, coefficients) = bytes
            .split_first_chunk::<HEADER_BYTES>()
            .ok_or(RegionError::Length { expected: HEADER_BYTES, actual: bytes.len() })?;
        let number = |at: usize| u16::from_le_bytes([header[at], header[at + 1]]);
        if number(0) != VERSION {
            return Err(RegionError::Version(number(0)));
        }
        let (columns, states) = (usize::from(number(2)), usize::from(number(4)));
        check_shape(states, columns)?;
        let expected = HEADER_BYTES + 2 * states * columns;
        if bytes.len() != expected {
            return Err(RegionError::Length { expected, actual: bytes.len() });
        }
        Ok(Self { states, columns, coefficients })
    }

    /// How many states.
    pub fn states(&self) -> usize {
        self.states
    }

    /// Coefficients of each state: columns of all generations up to the region's.
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// All coefficients, state after state, in steps of 1/32,767 of full scale.
    pub fn coefficients(&self) -> impl Iterator<Item = i16> + use<'a> {
        self.coefficients.chunks_exact(2).map(|c| i16::from_le_bytes([c[0], c[1]]))
    }

    /// Coefficients of one state in fractions of full scale (-1..=1, or a hair beyond for bytes
    /// that no encoder writes), into the first `columns` places of `out`; the rest become 0.
    ///
    /// # Panics
    /// `state` must be below `states`, `out` at least `columns` long.
    pub fn state(&self, state: usize, out: &mut [f32]) {
        let bytes = &self.coefficients[2 * self.columns * state..][..2 * self.columns];
        let (head, tail) = out.split_at_mut(self.columns);
        for (out, c) in head.iter_mut().zip(bytes.chunks_exact(2)) {
            *out = f32::from(i16::from_le_bytes([c[0], c[1]])) * (1.0 / FULL_SCALE);
        }
        tail.fill(0.0);
    }
}

fn check_shape(states: usize, columns: usize) -> Result<(), RegionError> {
    if (1..=REGION_STATES_MAX).contains(&states) && (1..=COLUMNS_MAX).contains(&columns) {
        return Ok(());
    }
    Err(RegionError::Shape { states, columns })
}

//! A basis generation in bytes: quantised columns and their maxima.

use crate::{COLUMNS_MAX, ROWS_MAX};

const MAGIC: [u8; 4] = *b"TkBg";
const VERSION: u16 = 1;
const COLUMNS_AT: usize = MAGIC.len() + 2;
const ROWS_AT: usize = COLUMNS_AT + 2;
const STEP_AT: usize = ROWS_AT + 4;
const MAXIMA_AT: usize = STEP_AT + 4;

/// Bits of a column's entries.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Width {
    /// Every entry within -127..=127 steps.
    Bits8,
    /// Every entry within -32,767..=32,767 steps.
    Bits16,
}

impl Width {
    /// The narrowest width that holds these entries.
    pub fn of(entries: &[i16]) -> Self {
        if entries.iter().all(|e| (-127..=127).contains(e)) { Self::Bits8 } else { Self::Bits16 }
    }

    /// Bytes of one entry.
    pub fn bytes(self) -> usize {
        match self {
            Self::Bits8 => 1,
            Self::Bits16 => 2,
        }
    }
}

/// Why numbers could not be rounded to steps.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum QuantiseError {
    /// Not a number, or infinite.
    #[error("number {index} is {value}; only finite numbers can be encoded")]
    NotFinite {
        /// Its place in the slice.
        index: usize,
        /// What stands there.
        value: f32,
    },
    /// Outside of what 16 bits hold at this step.
    #[error("number {index} is {value}, outside of +-{full_scale}")]
    OutOfRange {
        /// Its place in the slice.
        index: usize,
        /// What stands there.
        value: f32,
        /// The largest absolute value that fits.
        full_scale: f32,
    },
    /// The slices differ in length.
    #[error("{input} numbers for {output} places")]
    Lengths {
        /// Numbers given.
        input: usize,
        /// Places to write to.
        output: usize,
    },
    /// A step that is not a positive finite number.
    #[error("a step of {0} m; it must be positive and finite")]
    Step(f32),
}

/// Rounds a rescaled column `B' = B M` (m) to steps of `step_m` metres.
///
/// The error is at most half a step an entry. Cost: one pass, no allocation.
///
/// # Errors
/// An entry that is not finite or beyond 32,767 steps; slices of different lengths.
pub fn quantise_column(
    column_m: &[f32],
    step_m: f32,
    out: &mut [i16],
) -> Result<Width, QuantiseError> {
    if column_m.len() != out.len() {
        return Err(QuantiseError::Lengths { input: column_m.len(), output: out.len() });
    }
    if !(step_m.is_finite() && step_m > 0.0) {
        return Err(QuantiseError::Step(step_m));
    }
    let full_scale = f32::from(i16::MAX);
    for (index, (&value, out)) in column_m.iter().zip(out.iter_mut()).enumerate() {
        if !value.is_finite() {
            return Err(QuantiseError::NotFinite { index, value });
        }
        let steps = (value / step_m).round();
        if steps.abs() > full_scale {
            let full_scale = full_scale * step_m;
            return Err(QuantiseError::OutOfRange { index, value, full_scale });
        }
        *out = steps as i16;
    }
    Ok(Width::of(out))
}

/// Why a generation could not be encoded or decoded.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum GenerationError {
    /// Fewer bytes than the header asks for.
    #[error("basis generation of {actual} bytes, but its header asks for {expected}")]
    Length {
        /// Bytes that the header asks for.
        expected: u64,
        /// Bytes given.
        actual: u64,
    },
    /// Not a basis generation.
    #[error("not a kim2013 basis generation: it begins with {0:02x?}")]
    Magic([u8; 4]),
    /// A version that this build does not know.
    #[error("basis generation of version {0}; this build reads version {VERSION}")]
    Version(u16),
    /// Rows or columns outside the limits.
    #[error(
        "basis generation of {rows} rows and {columns} columns; allowed are 1..={ROWS_MAX} \
             rows and 1..={COLUMNS_MAX} columns"
    )]
    Shape {
        /// Rows.
        rows: u64,
        /// Columns.
        columns: u64,
    },
    /// A step that is not positive and finite.
    #[error("basis generation with a step of {0} m")]
    Step(f32),
    /// A maximum that is not positive and finite.
    #[error("column {column} has the maximum {maximum}; it must be positive and finite")]
    Maximum {
        /// Which column.
        column: usize,
        /// Its maximum.
        maximum: f32,
    },
    /// A width other than 8 or 16 bits, or wider than its entries need.
    #[error("column {column} has a width of {bits} bits")]
    Width {
        /// Which column.
        column: usize,
        /// Its width.
        bits: u8,
    },
}

/// Writes a generation to the end of `out`.
///
/// * `maxima`: per column the coefficient that `C' = 1` stands for (metres, since `B` is
///   orthonormal), headroom included.
/// * `entries`: `maxima.len()` columns of `rows` entries, column after column, in steps.
///
/// # Errors
/// A shape outside the limits, entries that do not match it, a step or maximum that is not
/// positive and finite. `out` is then as before.
pub fn encode_generation(
    rows: u32,
    step_m: f32,
    maxima: &[f32],
    entries: &[i16],
    out: &mut Vec<u8>,
) -> Result<(), GenerationError> {
    let rows_usize = rows as usize;
    check_shape(rows_usize, maxima.len())?;
    check_scales(step_m, maxima.iter().copied())?;
    if entries.len() != rows_usize * maxima.len() {
        let (expected, actual) = ((rows_usize * maxima.len()) as u64, entries.len() as u64);
        return Err(GenerationError::Length { expected, actual });
    }
    out.extend_from_slice(&MAGIC);
    out.extend_from_slice(&VERSION.to_le_bytes());
    out.extend_from_slice(&(maxima.len() as u16).to_le_bytes());
    out.extend_from_slice(&rows.to_le_bytes());
    out.extend_from_slice(&step_m.to_le_bytes());
    for maximum in maxima {
        out.extend_from_slice(&maximum.to_le_bytes());
    }
    for column in entries.chunks_exact(rows_usize) {
        out.push(8 * Width::of(column).bytes() as u8);
    }
    for column in entries.chunks_exact(rows_usize) {
        match Width::of(column) {
            Width::Bits8 => out.extend(column.iter().map(|e| *e as u8)),
            Width::Bits16 => out.extend(column.iter().flat_map(|e| e.to_le_bytes())),
        }
    }
    Ok(())
}

/// A checked generation that still lies in its bytes.
#[derive(Debug, Clone, Copy)]
pub struct Generation<'a> {
    rows: usize,
    columns: usize,
    step_m: f32,
    maxima: &'a [u8],
    widths: &'a [u8],
    entries: &'a [u8],
}

impl<'a> Generation<'a> {
    /// Checks everything that can be wrong; takes no memory.
    ///
    /// # Errors
    /// Bytes that are not exactly one generation of this version.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, GenerationError> {
        let actual = bytes.len() as u64;
        let header = bytes
            .first_chunk::<MAXIMA_AT>()
            .ok_or(GenerationError::Length { expected: MAXIMA_AT as u64, actual })?;
        let magic: [u8; 4] = field(header, 0);
        if magic != MAGIC {
            return Err(GenerationError::Magic(magic));
        }
        let version = u16::from_le_bytes(field(header, MAGIC.len()));
        if version != VERSION {
            return Err(GenerationError::Version(version));
        }
        let columns = usize::from(u16::from_le_bytes(field(header, COLUMNS_AT)));
        let rows = u32::from_le_bytes(field(header, ROWS_AT)) as usize;
        let step_m = f32::from_le_bytes(field(header, STEP_AT));
        check_shape(rows, columns)?;
        let entries_at = MAXIMA_AT + 5 * columns;
        if bytes.len() < entries_at {
            return Err(GenerationError::Length { expected: entries_at as u64, actual });
        }
        let (maxima, rest) = bytes[MAXIMA_AT..].split_at(4 * columns);
        let (widths, entries) = rest.split_at(columns);
        if let Some(column) = widths.iter().position(|w| !matches!(w, 8 | 16)) {
            return Err(GenerationError::Width { column, bits: widths[column] });
        }
        let entry_bytes: u64 = widths.iter().map(|w| rows as u64 * u64::from(w / 8)).sum();
        let expected = entries_at as u64 + entry_bytes;
        if expected != actual {
            return Err(GenerationError::Length { expected, actual });
        }
        let generation = Self { rows, columns, step_m, maxima, widths, entries };
        check_scales(step_m, (0..columns).map(|column| generation.maximum(column)))?;
        Ok(generation)
    }

    /// Rows: three per vertex.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Columns.
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// Metres of one step.
    pub fn step_m(&self) -> f32 {
        self.step_m
    }

    /// The coefficient (m) over the orthonormal column that `C' = 1` stands for.
    ///
    /// # Panics
    /// `column` must be below `columns`.
    pub fn maximum(&self, column: usize) -> f32 {
        f32::from_le_bytes(field(self.maxima, 4 * column))
    }

    /// Width of a column.
    ///
    /// # Panics
    /// `column` must be below `columns`.
    pub fn width(&self, column: usize) -> Width {
        if self.widths[column] == 8 { Width::Bits8 } else { Width::Bits16 }
    }

    /// The columns with their entries' little-endian bytes, in order.
    pub fn entries(&self) -> impl Iterator<Item = (Width, &'a [u8])> + use<'a> {
        let (widths, rows, mut rest) = (self.widths, self.rows, self.entries);
        widths.iter().map(move |bits| {
            let width = if *bits == 8 { Width::Bits8 } else { Width::Bits16 };
            let (column, after) = rest.split_at(rows * width.bytes());
            rest = after;
            (width, column)
        })
    }
}

fn field<const N: usize>(bytes: &[u8], at: usize) -> [u8; N] {
    let mut out = [0; N];
    out.copy_from_slice(&bytes[at..at + N]);
    out
}

fn check_shape(rows: usize, columns: usize) -> Result<(), GenerationError> {
    if (1..=ROWS_MAX).contains(&rows) && (1..=COLUMNS_MAX).contains(&columns) {
        return Ok(());
    }
    Err(GenerationError::Shape { rows: rows as u64, columns: columns as u64 })
}

fn check_scales(step_m: f32, maxima: impl Iterator<Item = f32>) -> Result<(), GenerationError> {
    if !(step_m.is_finite() && step_m > 0.0) {
        return Err(GenerationError::Step(step_m));
    }
    for (column, maximum) in maxima.enumerate() {
        if !(maximum.is_finite() && maximum > 0.0) {
            return Err(GenerationError::Maximum { column, maximum });
        }
    }
    Ok(())
}

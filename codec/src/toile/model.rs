//! What is known of each column: how large its coefficients get and how they move.

use super::UNIT_M;
use crate::COLUMNS_MAX;
use crate::entropy;

/// Bytes of a column in a generation's header.
pub const COLUMN_BYTES: usize = 14;
/// One in the fixed-point numbers of a prediction.
const ONE_BITS: u32 = 12;

/// How many states of a region lie before one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameKind {
    /// None: nothing to predict from.
    First,
    /// One.
    Second,
    /// Two or more.
    Later,
}

impl FrameKind {
    /// Of the state at this place of a region.
    pub fn at(state: usize) -> Self {
        match state {
            0 => Self::First,
            1 => Self::Second,
            _ => Self::Later,
        }
    }
}

/// One column of the basis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Column {
    /// The coefficient (m) that full scale stands for, headroom included.
    pub maximum_m: f32,
    /// Entries are rounded to this many steps; at least 1.
    pub multiple: u8,
    /// Mean size of what prediction leaves, by [`FrameKind`]: quarter octaves of 2^-20 m.
    pub sizes: [u8; 3],
    /// The second state of a region is this times the first, in 4,096ths.
    pub after_one: i16,
    /// A later state is this much of the state before and of the one before that, in 4,096ths.
    pub after_two: [i16; 2],
}

impl Column {
    /// The nearest code for a mean size (m).
    pub fn size_code(mean_m: f64) -> u8 {
        let units = (mean_m / f64::from(UNIT_M)).clamp(1.0, f64::from(u32::MAX));
        entropy::quarter_octaves(units as u32) as u8
    }

    /// The nearest factor of a prediction.
    pub fn factor(exact: f64) -> i16 {
        (exact * f64::from(1 << ONE_BITS)).round().clamp(-32_767.0, 32_767.0) as i16
    }

    pub(super) fn to_bytes(self) -> [u8; COLUMN_BYTES] {
        let mut out = [0; COLUMN_BYTES];
        out[..4].copy_from_slice(&self.maximum_m.to_le_bytes());
        out[4] = self.multiple;
        out[5..8].copy_from_slice(&self.sizes);
        out[8..10].copy_from_slice(&self.after_one.to_le_bytes());
        out[10..12].copy_from_slice(&self.after_two[0].to_le_bytes());
        out[12..14].copy_from_slice(&self.after_two[1].to_le_bytes());
        out
    }

    pub(super) fn from_bytes(b: &[u8; COLUMN_BYTES]) -> Self {
        let factor = |at: usize| i16::from_le_bytes([b[at], b[at + 1]]);
        Self {
            maximum_m: f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
            multiple: b[4],
            sizes: [b[5], b[6], b[7]],
            after_one: factor(8),
            after_two: [factor(10), factor(12)],
        }
    }

    /// A coefficient from the ones before it in the region, the newest first.
    pub(super) fn predict(&self, kind: FrameKind, before: [i32; 2]) -> i32 {
        let [one, two] = before.map(i64::from);
        let sum = match kind {
            FrameKind::First => return 0,
            FrameKind::Second => i64::from(self.after_one) * one,
            FrameKind::Later => {
                i64::from(self.after_two[0]) * one + i64::from(self.after_two[1]) * two
            }
        };
        ((sum + (1 << (ONE_BITS - 1))) >> ONE_BITS) as i32
    }
}

/// The columns of all generations so far, and the vertices of the garment.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Model {
    vertices: usize,
    columns: Vec<Column>,
}

impl Model {
    /// Without columns.
    pub fn new(vertices: usize) -> Self {
        Self { vertices, columns: Vec::new() }
    }

    /// Vertices of the garment.
    pub fn vertices(&self) -> usize {
        self.vertices
    }

    /// Columns of all generations.
    pub fn columns(&self) -> &[Column] {
        &self.columns
    }

    /// Appends a generation's columns. Returns false, and appends none, where they would be more
    /// than `COLUMNS_MAX`.
    pub fn append(&mut self, columns: &[Column]) -> bool {
        let fits = self.columns.len() + columns.len() <= COLUMNS_MAX;
        if fits {
            self.columns.extend_from_slice(columns);
        }
        fits
    }
}

//! Columns in panel layout, with the proof that their sums fit 32 bits.

use super::PANEL_ROWS;
use super::memory::with_huge_pages;
use super::pairs::{Chunk, Entry};
use crate::{COLUMNS_MAX, ROWS_MAX};

/// Largest coefficient after rounding.
const COEFFICIENT_MAX: f64 = 32_767.0;
/// Pairs of a block, at most: so that a few blocks at a time fit the decoder's own scratch.
pub(crate) const BLOCK_PAIRS_MAX: usize = 128;
/// Stands for the missing partner of a pair's first column.
pub(crate) const NO_COLUMN: u16 = u16::MAX;

/// A column's entries, one a row.
#[derive(Debug, Clone, Copy)]
pub enum Entries<'a> {
    /// Bytes, each an 8-bit two's complement number.
    Narrow(&'a [u8]),
    /// Bytes, each two of them a 16-bit little-endian number.
    WideBytes(&'a [u8]),
    /// 16-bit numbers.
    Wide(&'a [i16]),
}

/// A quantised column: it adds `entry * scale_m * coefficient` (m) to a row.
#[derive(Debug, Clone, Copy)]
pub struct Column<'a> {
    /// Its entries.
    pub entries: Entries<'a>,
    /// What an entry of 1 stands for at a coefficient of 1 (m).
    pub scale_m: f32,
    /// Coefficients lie within `-limit..=limit`: that range gets the 16 bits that a coefficient is
    /// rounded to. What lies outside is decoded too, in steps that are coarser by a power of two.
    pub limit: f32,
}

/// Why columns could not be laid out.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PanelsError {
    /// A column of another length.
    #[error("column {column} has {actual} rows; all must have {expected}, at most {ROWS_MAX}")]
    Rows {
        /// Number of the column.
        column: usize,
        /// Its rows.
        actual: usize,
        /// Rows asked for.
        expected: usize,
    },
    /// Too many columns.
    #[error("{0} columns; at most {COLUMNS_MAX} are allowed")]
    Columns(usize),
    /// A scale or a limit that is no positive finite number.
    #[error("column {column} has scale {scale_m} m and limit {limit}; both must be positive")]
    Scale {
        /// Number of the column.
        column: usize,
        /// Its scale (m).
        scale_m: f32,
        /// Its limit.
        limit: f32,
    },
}

/// Columns of one generation: 16-bit ones, then 8-bit ones, each in blocks.
#[derive(Debug, Clone)]
pub struct Panels {
    rows: usize,
    columns: usize,
    pub(crate) wide: Width<i16>,
    pub(crate) narrow: Width<i8>,
}

/// All columns of one width.
#[derive(Debug, Clone)]
pub(crate) struct Width<T> {
    /// What a product of 1 stands for (m).
    pub(crate) unit_m: f32,
    /// Two numbers of columns a pair, counted from the generation's first.
    pub(crate) numbers: Vec<[u16; 2]>,
    /// From a coefficient to what it is rounded to.
    pub(crate) gains: Vec<[f32; 2]>,
    /// Largest value after rounding, for which the headroom is proven.
    pub(crate) limits: Vec<[f32; 2]>,
    /// One past the last pair of each block.
    pub(crate) ends: Vec<usize>,
    /// Panel after panel the chunks of all pairs; rows past the end are 0.
    pub(crate) chunks: Vec<Chunk<T>>,
}

impl Panels {
    /// Lays columns out. Cost: two passes over the entries.
    ///
    /// # Errors
    /// Columns of different lengths, too many of them, or scales that are not positive.
    pub fn new(rows: usize, columns: &[Column<'_>]) -> Result<Self, PanelsError> {
        if columns.len() > COLUMNS_MAX {
            return Err(PanelsError::Columns(columns.len()));
        }
        for (number, column) in columns.iter().enumerate() {
            let actual = column.entries.rows();
            if actual != rows || rows > ROWS_MAX {
                return Err(PanelsError::Rows { column: number, actual, expected: rows });
            }
            let Column { scale_m, limit, .. } = *column;
            let full = scale_m * limit;
            if !(scale_m > 0.0 && limit > 0.0 && full.is_finite() && full > f32::MIN_POSITIVE) {
                return Err(PanelsError::Scale { column: number, scale_m, limit });
            }
        }
        let wide = Width::new(rows, columns, |e| !matches!(e, Entries::Narrow(_)));
        let narrow = Width::new(rows, columns, |e| matches!(e, Entries::Narrow(_)));
        Ok(Self { rows, columns: columns.len(), wide, narrow })
    }

    /// Rows: three per vertex.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Columns.
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// Memory held by the entries (bytes).
    pub fn resident_bytes(&self) -> usize {
        size_of_val(&self.wide.chunks[..]) + size_of_val(&self.narrow.chunks[..])
    }
}

impl Entries<'_> {
    fn rows(&self) -> usize {
        match self {
            Self::Narrow(bytes) => bytes.len(),
            Self::WideBytes(bytes) => bytes.len() / 2,
            Self::Wide(entries) => entries.len(),
        }
    }

    fn get(&self, row: usize) -> i16 {
        match self {
            Self::Narrow(bytes) => i16::from(bytes[row] as i8),
            Self::WideBytes(bytes) => i16::from_le_bytes([bytes[2 * row], bytes[2 * row + 1]]),
            Self::Wide(entries) => entries[row],
        }
    }
}

/// An entry of either width from the 16 bits that hold both.
pub(crate) trait Narrowed: Entry {
    fn narrowed(entry: i16) -> Self;
}

impl Narrowed for i8 {
    fn narrowed(entry: i16) -> Self {
        entry as i8
    }
}

impl Narrowed for i16 {
    fn narrowed(entry: i16) -> Self {
        entry
    }
}

impl<T: Narrowed> Width<T> {
    fn new(rows: usize, columns: &[Column<'_>], of_width: impl Fn(&Entries<'_>) -> bool) -> Self {
        let chosen: Vec<(u16, &Column<'_>)> =
            (0..).zip(columns).filter(|(_, c)| of_width(&c.entries)).collect();
        let full = |c: &Column<'_>| f64::from(c.scale_m) * f64::from(c.limit);
        let unit = chosen.iter().map(|(_, c)| full(c)).fold(0.0, f64::max) / COEFFICIENT_MAX;
        let unit = if chosen.is_empty() { 1.0 } else { unit };
        let mut width = Self {
            unit_m: unit as f32,
            numbers: Vec::new(),
            gains: Vec::new(),
            limits: Vec::new(),
            ends: Vec::new(),
            chunks: Vec::new(),
        };
        let gain = |c: &Column<'_>| (f64::from(c.scale_m) / unit) as f32;
        let limit = |c: &Column<'_>| (full(c) / unit).round().clamp(1.0, COEFFICIENT_MAX) as f32;
        for pair in chosen.chunks(2) {
            let second = pair.get(1).map(|(_, c)| *c);
            width.numbers.push([pair[0].0, pair.get(1).map_or(NO_COLUMN, |p| p.0)]);
            width.gains.push([gain(pair[0].1), second.map_or(0.0, gain)]);
            width.limits.push([limit(pair[0].1), second.map_or(1.0, limit)]);
        }
        width.divide(rows, &chosen);
        width.gather(rows, &chosen);
        width
    }

    /// Ends a block where the next pair could take a row's sum out of 32 bits.
    fn divide(&mut self, rows: usize, chosen: &[(u16, &Column<'_>)]) {
        let mut sums = vec![0u64; rows];
        let mut alone = vec![0u64; rows];
        let mut start = 0;
        for (pair, (columns, limits)) in chosen.chunks(2).zip(&self.limits).enumerate() {
            alone.fill(0);
            for ((_, column), limit) in columns.iter().zip(limits) {
                for (row, sum) in alone.iter_mut().enumerate() {
                    let entry = column.entries.get(row).unsigned_abs();
                    *sum += u64::from(entry) * *limit as u64;
                }
            }
            let most = sums.iter().zip(&alone).map(|(a, b)| a + b).max().unwrap_or(0);
            // One pair always fits: 2 * 32,768 * 32,767 < 2^31.
            if pair - start >= BLOCK_PAIRS_MAX || (most > i32::MAX as u64 && pair > start) {
                self.ends.push(pair);
                start = pair;
                sums.copy_from_slice(&alone);
            } else {
                sums.iter_mut().zip(&alone).for_each(|(sum, more)| *sum += more);
            }
        }
        if !self.numbers.is_empty() {
            self.ends.push(self.numbers.len());
        }
    }

    fn gather(&mut self, rows: usize, chosen: &[(u16, &Column<'_>)]) {
        let panels = rows.div_ceil(PANEL_ROWS);
        self.chunks = with_huge_pages(panels * self.numbers.len());
        for panel in 0..panels {
            let first = panel * PANEL_ROWS;
            let count = PANEL_ROWS.min(rows - first);
            for pair in chosen.chunks(2) {
                let mut chunk = Chunk([T::default(); 2 * PANEL_ROWS]);
                for (side, (_, column)) in pair.iter().enumerate() {
                    for row in 0..count {
                        let entry = column.entries.get(first + row);
                        chunk.0[2 * row + side] = T::narrowed(entry);
                    }
                }
                self.chunks.push(chunk);
            }
        }
    }

    /// All chunks of one panel.
    pub(crate) fn panel(&self, panel: usize) -> &[Chunk<T>] {
        let pairs = self.numbers.len();
        &self.chunks[panel * pairs..][..pairs]
    }
}

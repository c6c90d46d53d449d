//! The resident basis: columns as they came (8 or 16 bits), in panels of 64 rows, column after
//! column inside a panel, so that reconstruction reads one sequential stream.

use std::ops::Range;
use std::sync::Arc;

use crate::COLUMNS_MAX;
use crate::kernel::{self, PANEL_ROWS};
use crate::kim2013::{Generation, Width};

/// Columns of all generations so far. Appending changes nothing of what is there; a clone shares it.
#[derive(Debug, Clone, Default)]
pub struct Basis {
    rows: usize,
    columns: usize,
    maxima: Vec<f32>,
    generations: Vec<Arc<Panels>>,
}

/// One generation in panel layout.
#[derive(Debug, Clone)]
struct Panels {
    step_m: f32,
    narrow: Entries<i8>,
    wide: Entries<i16>,
}

/// Columns of one width: `numbers.len()` times `PANEL_ROWS` entries a panel.
#[derive(Debug, Clone)]
struct Entries<T> {
    /// Number of each column in the whole basis, ascending.
    numbers: Vec<u16>,
    /// Panel after panel; rows past the end are 0.
    panels: Vec<T>,
}

/// Why a generation could not be appended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum AppendError {
    /// Rows differ from those of the first generation.
    #[error("a generation of {actual} rows cannot extend a basis of {expected} rows")]
    Rows {
        /// Rows of the basis.
        expected: usize,
        /// Rows of the generation.
        actual: usize,
    },
    /// Too many columns.
    #[error("{0} columns in all; at most {COLUMNS_MAX} are allowed")]
    Columns(usize),
}

/// Why positions could not be reconstructed: a mistake of the caller.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ReconstructError {
    /// Rows that the basis does not have.
    #[error("rows {from}..{to} of a basis of {rows} rows")]
    Rows {
        /// First row asked for.
        from: usize,
        /// One past the last.
        to: usize,
        /// Rows of the basis.
        rows: usize,
    },
    /// More columns than the basis or the coefficients have.
    #[error(
        "{asked} columns asked for, but the basis has {basis} and there are {given} \
             coefficients"
    )]
    Columns {
        /// Columns asked for.
        asked: usize,
        /// Columns of the basis.
        basis: usize,
        /// Coefficients given per character.
        given: usize,
    },
    /// The output does not fit.
    #[error("{actual} numbers of output for {expected}")]
    Output {
        /// Numbers that will be written.
        expected: usize,
        /// Length of the output.
        actual: usize,
    },
}

impl Basis {
    /// Without columns; the first generation sets the rows.
    pub fn new() -> Self {
        Self::default()
    }

    /// Rows: three per vertex; 0 before the first generation.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Columns of all generations.
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// Per column the coefficient (m) over the orthonormal column that `C' = 1` stands for.
    pub fn maxima(&self) -> &[f32] {
        &self.maxima
    }

    /// Memory held by the columns.
    pub fn resident_bytes(&self) -> usize {
        self.generations.iter().map(|g| g.narrow.panels.len() + 2 * g.wide.panels.len()).sum()
    }

    /// Appends a generation's columns.
    ///
    /// # Errors
    /// Other rows than before, or more than `COLUMNS_MAX` columns in all.
    pub fn append(&mut self, generation: &Generation<'_>) -> Result<(), AppendError> {
        let (expected, actual) = (self.rows, generation.rows());
        if self.columns > 0 && expected != actual {
            return Err(AppendError::Rows { expected, actual });
        }
        let columns = self.columns + generation.columns();
        if columns > COLUMNS_MAX {
            return Err(AppendError::Columns(columns));
        }
        let narrow = Entries::gather(generation, Width::Bits8, self.columns, |b| b[0] as i8);
        let wide = Entries::gather(generation, Width::Bits16, self.columns, |b| {
            i16::from_le_bytes([b[0], b[1]])
        });
        self.maxima.extend((0..generation.columns()).map(|c| generation.maximum(c)));
        let step_m = generation.step_m();
        self.generations.push(Arc::new(Panels { step_m, narrow, wide }));
        (self.rows, self.columns) = (actual, columns);
        Ok(())
    }

    /// Positions (m) of `rows` (x0, y0, z0, x1, ...) from the first `columns` coefficients, in
    /// fractions of full scale (`C'` of the paper).
    ///
    /// Any prefix of columns is a coarser state; any range of rows gives the same numbers as the
    /// whole. Results are equal bit for bit on every CPU. No allocation. Cost: one pass over the
    /// entries of these rows and columns.
    ///
    /// # Errors
    /// Rows, columns or an output that do not fit the basis or each other.
    pub fn reconstruct(
        &self,
        coefficients: &[f32],
        rows: Range<usize>,
        columns: usize,
        out: &mut [f32],
    ) -> Result<(), ReconstructError> {
        self.reconstruct_batch(coefficients, coefficients.len(), rows, columns, out)
    }

    /// As [`Basis::reconstruct`], for several characters that share the basis: `stride`
    /// coefficients each, one after the other; `out` likewise, `rows.len()` numbers each. Every
    /// panel is read from memory once for all of them.
    ///
    /// # Errors
    /// As for `reconstruct`.
    pub fn reconstruct_batch(
        &self,
        coefficients: &[f32],
        stride: usize,
        rows: Range<usize>,
        columns: usize,
        out: &mut [f32],
    ) -> Result<(), ReconstructError> {
        if rows.start > rows.end || rows.end > self.rows {
            let (from, to) = (rows.start, rows.end);
            return Err(ReconstructError::Rows { from, to, rows: self.rows });
        }
        if columns > self.columns || columns > stride {
            let (asked, basis) = (columns, self.columns);
            return Err(ReconstructError::Columns { asked, basis, given: stride });
        }
        let characters = coefficients.len().checked_div(stride).unwrap_or(1);
        let expected = characters * rows.len();
        if out.len() != expected {
            return Err(ReconstructError::Output { expected, actual: out.len() });
        }
        for panel in rows.start / PANEL_ROWS..rows.end.div_ceil(PANEL_ROWS) {
            let first = panel * PANEL_ROWS;
            let from = rows.start.max(first);
            let to = rows.end.min(first + PANEL_ROWS);
            for character in 0..characters {
                let coefficients = &coefficients[character * stride..][..columns];
                let sums = self.panel(panel, coefficients);
                let at = character * rows.len() + from - rows.start;
                out[at..at + to - from].copy_from_slice(&sums[from - first..to - first]);
            }
        }
        Ok(())
    }

    fn panel(&self, panel: usize, coefficients: &[f32]) -> [f32; PANEL_ROWS] {
        let mut sums = [0.0; PANEL_ROWS];
        for generation in &self.generations {
            let wide = generation.wide.prefix(panel, coefficients.len());
            kernel::add_wide(wide, coefficients, generation.step_m, &mut sums);
            let narrow = generation.narrow.prefix(panel, coefficients.len());
            kernel::add_narrow(narrow, coefficients, generation.step_m, &mut sums);
        }
        sums
    }
}

impl<T: Copy + Default> Entries<T> {
    /// The columns of `generation` that have this width, rearranged.
    fn gather(
        generation: &Generation<'_>,
        width: Width,
        first_number: usize,
        entry: impl Fn(&[u8]) -> T,
    ) -> Self {
        let of_width = |(_, (w, _)): &(usize, (Width, &[u8]))| *w == width;
        let count = generation.entries().enumerate().filter(of_width).count();
        let mut numbers = Vec::with_capacity(count);
        let panel_count = generation.rows().div_ceil(PANEL_ROWS);
        let mut panels = vec![T::default(); panel_count * count * PANEL_ROWS];
        for (column, (_, bytes)) in generation.entries().enumerate().filter(of_width) {
            let place = numbers.len() * PANEL_ROWS;
            numbers.push((first_number + column) as u16);
            for (panel, bytes) in bytes.chunks(PANEL_ROWS * width.bytes()).enumerate() {
                let out = &mut panels[panel * count * PANEL_ROWS + place..];
                for (out, bytes) in out.iter_mut().zip(bytes.chunks_exact(width.bytes())) {
                    *out = entry(bytes);
                }
            }
        }
        Self { numbers, panels }
    }

    /// Entries of one panel for those columns that are among the first `columns` of the basis.
    fn prefix(&self, panel: usize, columns: usize) -> (&[u16], &[T]) {
        let count = self.numbers.partition_point(|n| usize::from(*n) < columns);
        let stride = self.numbers.len() * PANEL_ROWS;
        (&self.numbers[..count], &self.panels[panel * stride..][..count * PANEL_ROWS])
    }
}

//! The resident basis: columns as they came (8 or 16 bits), in panels of 64 rows, so that
//! reconstruction reads one sequential stream.

use std::ops::Range;
use std::sync::Arc;

use crate::COLUMNS_MAX;
use crate::kernel::{self, Batch, Column, Entries, Panels, PanelsError, Select, Set};
use crate::kim2013::{Generation, Width};

/// Columns of all generations so far, and the mean if the profile has one. Appending changes
/// nothing of what is there; a clone shares it.
#[derive(Debug, Clone, Default)]
pub struct Basis {
    rows: usize,
    columns: usize,
    maxima: Vec<f32>,
    mean: Option<Arc<[f32]>>,
    generations: Vec<Arc<Panels>>,
}

/// Why a generation could not be appended.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
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
    /// Columns that cannot be laid out.
    #[error(transparent)]
    Panels(#[from] PanelsError),
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

    /// Memory held by the columns and the mean (bytes).
    pub fn resident_bytes(&self) -> usize {
        let mean = self.mean.as_ref().map_or(0, |m| size_of_val(&m[..]));
        mean + self.generations.iter().map(|g| g.resident_bytes()).sum::<usize>()
    }

    /// Without columns, with the positions (m) that all coefficients at 0 stand for.
    pub fn with_mean(mean_m: &[f32]) -> Self {
        // A negative zero would show whether anything was added to it.
        let mean: Arc<[f32]> = mean_m.iter().map(|m| m + 0.0).collect();
        Self { rows: mean.len(), mean: Some(mean), ..Self::default() }
    }

    /// Appends a generation's columns.
    ///
    /// # Errors
    /// Other rows than before, or more than `COLUMNS_MAX` columns in all.
    pub fn append(&mut self, generation: &Generation<'_>) -> Result<(), AppendError> {
        let scale_m = generation.step_m();
        let column = |(width, bytes): (Width, _)| {
            let entries = match width {
                Width::Bits8 => Entries::Narrow(bytes),
                Width::Bits16 => Entries::WideBytes(bytes),
            };
            Column { entries, scale_m, limit: 1.0 }
        };
        let columns: Vec<Column<'_>> = generation.entries().map(column).collect();
        let maxima = (0..generation.columns()).map(|c| generation.maximum(c));
        self.append_columns(generation.rows(), &columns, maxima)
    }

    /// Appends the columns of a generation of any profile.
    ///
    /// * `maxima`: for each column, what [`Basis::maxima`] is to say of it.
    ///
    /// # Errors
    /// Other rows than before, more than `COLUMNS_MAX` columns in all, or columns that differ in
    /// length or scale nothing.
    pub fn append_columns(
        &mut self,
        rows: usize,
        columns: &[Column<'_>],
        maxima: impl Iterator<Item = f32>,
    ) -> Result<(), AppendError> {
        if (self.columns > 0 || self.mean.is_some()) && self.rows != rows {
            return Err(AppendError::Rows { expected: self.rows, actual: rows });
        }
        let total = self.columns + columns.len();
        if total > COLUMNS_MAX {
            return Err(AppendError::Columns(total));
        }
        self.generations.push(Arc::new(Panels::new(rows, columns)?));
        self.maxima.extend(maxima);
        self.maxima.resize(total, 1.0);
        (self.rows, self.columns) = (rows, total);
        Ok(())
    }

    /// Positions (m) of `rows` (x0, y0, z0, x1, ...) from the first `columns` coefficients, in
    /// fractions of full scale (`C'` of the paper).
    ///
    /// `columns` is how many of the first, or a [`Select`] of any. Any range of rows gives the same
    /// numbers as the whole; a column left out is one whose coefficient is 0. Results are equal bit
    /// for bit on every CPU: a coefficient is rounded to 16 bits of its column's range, products are
    /// summed as integers. No allocation. Cost: one pass over the entries of these rows and columns.
    ///
    /// # Errors
    /// Rows, columns or an output that do not fit the basis or each other.
    pub fn reconstruct<'a>(
        &self,
        coefficients: &[f32],
        rows: Range<usize>,
        columns: impl Into<Select<'a>>,
        out: &mut [f32],
    ) -> Result<(), ReconstructError> {
        self.reconstruct_batch(coefficients, coefficients.len(), rows, columns, out)
    }

    /// As [`Basis::reconstruct`], for several characters that share the basis: `stride`
    /// coefficients each, one after the other; `out` likewise, `rows.len()` numbers each. Every
    /// panel is read from memory once for each 16 of them.
    ///
    /// # Errors
    /// As for `reconstruct`.
    pub fn reconstruct_batch<'a>(
        &self,
        coefficients: &[f32],
        stride: usize,
        rows: Range<usize>,
        columns: impl Into<Select<'a>>,
        out: &mut [f32],
    ) -> Result<(), ReconstructError> {
        if rows.start > rows.end || rows.end > self.rows {
            let (from, to) = (rows.start, rows.end);
            return Err(ReconstructError::Rows { from, to, rows: self.rows });
        }
        let select = columns.into();
        let asked = match select {
            Select::First(columns) => columns,
            Select::Only(numbers) => numbers.last().map_or(0, |n| usize::from(*n) + 1),
        };
        if asked > self.columns || asked > stride {
            let basis = self.columns;
            return Err(ReconstructError::Columns { asked, basis, given: stride });
        }
        let characters = coefficients.len().checked_div(stride).unwrap_or(1);
        let expected = characters * rows.len();
        if out.len() != expected {
            return Err(ReconstructError::Output { expected, actual: out.len() });
        }
        let batch = Batch { coefficients, stride, rows, select };
        kernel::decode(Set::detect(), &self.generations, self.mean.as_deref(), &batch, out);
        Ok(())
    }
}

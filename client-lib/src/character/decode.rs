//! From characters to positions.

use std::ops::Range;
use std::sync::Arc;

use codec::kernel::Select;
use codec::{Basis, ReconstructError};

use super::Character;

/// Positions of the sampled cloth of many characters, each in its own state frame.
///
/// * `rows`: which rows (x0, y0, z0, x1, ...; three per vertex).
/// * `columns`: how many leading columns; fewer make a coarser state. More than there are means
///   all of them. A character with a tier ([`Character::set_tier`]) decodes that tier's instead.
/// * `out`: `rows.len()` numbers (metres) per character, one after another.
///
/// A host calls this on its own threads. Characters that share a basis read it once for every sixteen;
/// each gets the numbers that it would get alone, bit for bit. Where a host has many characters, a
/// [`Group`] does the same and keeps its memory.
///
/// # Errors
/// Rows that a basis does not have, or an output of the wrong size.
pub fn decode(
    instances: &[&Character],
    rows: Range<usize>,
    columns: usize,
    out: &mut [f32],
) -> Result<(), ReconstructError> {
    Group::default().decode(instances, rows, columns, out)
}

/// Decodes characters together, again and again: what it needs for that is kept between calls.
#[derive(Debug, Default)]
pub struct Group {
    /// Of those that share a basis: their coefficients, 0 where a column is left out.
    coefficients: Vec<f32>,
}

impl Group {
    /// As [`decode`]. Allocates only where a call has more characters or columns than any before it.
    ///
    /// # Errors
    /// As for [`decode`].
    pub fn decode(
        &mut self,
        instances: &[&Character],
        rows: Range<usize>,
        columns: usize,
        out: &mut [f32],
    ) -> Result<(), ReconstructError> {
        let expected = instances.len() * rows.len();
        if out.len() != expected {
            return Err(ReconstructError::Output { expected, actual: out.len() });
        }
        let each = rows.len().max(1);
        let (mut instances, mut out) = (instances, out);
        while let Some(first) = instances.first() {
            let together = instances.iter().take_while(|c| c.shares(first, columns)).count().max(1);
            let (now, later) = instances.split_at(together);
            let (into, rest) = out.split_at_mut((each * together).min(out.len()));
            if together > 1 {
                self.batch(first.view.version.basis(), now, (rows.clone(), columns), into)?;
            } else {
                first.decode_alone(rows.clone(), columns, into)?;
            }
            (instances, out) = (later, rest);
        }
        Ok(())
    }

    /// Several on one basis, in the graph.
    fn batch(
        &mut self,
        basis: &Basis,
        instances: &[&Character],
        (rows, columns): (Range<usize>, usize),
        out: &mut [f32],
    ) -> Result<(), ReconstructError> {
        self.coefficients.clear();
        for character in instances {
            let start = self.coefficients.len();
            match character.select(columns) {
                Select::First(_) => self.coefficients.extend_from_slice(&character.sampled),
                Select::Only(numbers) => {
                    self.coefficients.resize(start + character.sampled.len(), 0.0);
                    for number in numbers.iter().map(|number| usize::from(*number)) {
                        self.coefficients[start + number] = character.sampled[number];
                    }
                }
            }
        }
        let stride = instances[0].sampled.len();
        let tiers = instances.iter().any(|c| matches!(c.select(columns), Select::Only(_)));
        // Columns of a tier may lie anywhere; leading ones are cut off for all alike.
        let columns = if tiers { basis.columns() } else { columns.min(basis.columns()) };
        basis.reconstruct_batch(&self.coefficients, stride, rows.clone(), columns, out)?;
        for (character, out) in instances.iter().zip(out.chunks_exact_mut(rows.len().max(1))) {
            character.overlay.add_to(rows.clone(), out);
        }
        Ok(())
    }
}

impl Character {
    fn is_in_graph(&self) -> bool {
        !self.free.run.shows_now && !self.free.run.shows_before
    }

    /// Whether both can be decoded in one pass: a tier beside as many leading columns as there are, too.
    fn shares(&self, other: &Self, columns: usize) -> bool {
        let has_tier = |c: &Self| matches!(c.select(usize::MAX), Select::Only(_));
        Arc::ptr_eq(self.view.version.basis(), other.view.version.basis())
            && self.sampled.len() == other.sampled.len()
            && (columns >= self.view.version.basis().columns() || has_tier(self) == has_tier(other))
            && self.is_in_graph()
            && other.is_in_graph()
    }

    fn decode_alone(
        &self,
        rows: Range<usize>,
        columns: usize,
        out: &mut [f32],
    ) -> Result<(), ReconstructError> {
        if let Some(made) = self.sample_outside(rows.clone(), columns, out) {
            made?;
        } else {
            let select = self.select(columns);
            let basis = self.view.version.basis();
            basis.reconstruct(&self.sampled, rows.clone(), select, out)?;
        }
        if self.is_in_graph() {
            self.overlay.add_to(rows, out);
        }
        Ok(())
    }
}

//! From characters to positions.

use std::ops::Range;
use std::sync::Arc;

use codec::ReconstructError;
use codec::kernel::Select;

use super::Character;

/// Positions of the sampled cloth of many characters, each in its own state frame.
///
/// * `rows`: which rows (x0, y0, z0, x1, ...; three per vertex).
/// * `columns`: how many leading columns; fewer make a coarser state. More than there are means
///   all of them. A character with a tier ([`Character::set_tier`]) decodes that tier's instead.
/// * `out`: `rows.len()` numbers (metres) per character, one after another.
///
/// A host calls this on its own threads. Characters that share a basis read it once for all.
///
/// # Errors
/// Rows that a basis does not have, or an output of the wrong size.
pub fn decode(
    instances: &[&Character],
    rows: Range<usize>,
    columns: usize,
    out: &mut [f32],
) -> Result<(), ReconstructError> {
    let Some(first) = instances.first() else { return Ok(()) };
    let basis = first.view.version.basis();
    let expected = instances.len() * rows.len();
    if out.len() != expected {
        return Err(ReconstructError::Output { expected, actual: out.len() });
    }
    let in_graph = |c: &&Character| !c.free.run.shows_now && !c.free.run.shows_before;
    if instances.len() > 1 && instances.iter().all(|c| c.shares(first) && in_graph(c)) {
        let stride = first.sampled.len();
        let all: Vec<f32> = instances.iter().flat_map(|c| c.sampled.iter().copied()).collect();
        let columns = columns.min(basis.columns());
        basis.reconstruct_batch(&all, stride, rows.clone(), columns, out)?;
    } else {
        for (character, out) in instances.iter().zip(out.chunks_exact_mut(rows.len().max(1))) {
            if let Some(made) = character.sample_outside(rows.clone(), columns, out) {
                made?;
                continue;
            }
            let basis = character.view.version.basis();
            let select = character.select(columns);
            basis.reconstruct(&character.sampled, rows.clone(), select, out)?;
        }
    }
    for (character, out) in instances.iter().zip(out.chunks_exact_mut(rows.len().max(1))) {
        if in_graph(character) {
            character.overlay.add_to(rows.clone(), out);
        }
    }
    Ok(())
}

impl Character {
    /// Whether both can be decoded in one pass.
    fn shares(&self, other: &Self) -> bool {
        Arc::ptr_eq(self.view.version.basis(), other.view.version.basis())
            && self.sampled.len() == other.sampled.len()
            && matches!(self.select(usize::MAX), Select::First(_))
    }
}

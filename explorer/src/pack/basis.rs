//! The basis of a garment: the leading left singular vectors of all its states, found in one pass.

use faer::{Mat, MatRef, Par};

/// States taken in at a time.
const BLOCK_STATES: usize = 128;
/// Singular values below this fraction of the largest are rounding noise.
const NOISE: f64 = 1e-10;

/// Why no basis could be made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum BasisError {
    /// A state with another number of rows.
    #[error("a state of {actual} numbers for a basis of {expected} rows")]
    Rows {
        /// Rows of the basis.
        expected: usize,
        /// Numbers given.
        actual: usize,
    },
    /// NaN or infinity.
    #[error("state {state} of the input has a number that is not finite, in row {row}")]
    NotFinite {
        /// Counted in the order given.
        state: usize,
        /// Which row.
        row: usize,
    },
    /// The iteration for the singular values did not end.
    #[error("the singular value decomposition did not converge")]
    NoConvergence,
}

/// Incremental singular value decomposition over blocks of states, as in Brand 2002 (Kim et al.
/// 2013, section 4, use an out-of-core SVD for the same purpose). No mean is subtracted.
///
/// Memory: `rows * (1.25 * rank + 2 * BLOCK_STATES)` numbers of 64 bits, whatever the number of
/// states. In f64: in f32 the small singular values are lost. A quarter more columns than asked
/// for is carried along, so that what a block drops hardly ever matters later.
pub struct StreamingSvd {
    rank: usize,
    keep: usize,
    columns: Mat<f64>,
    singular: Vec<f64>,
    block: Mat<f64>,
    filled: usize,
    states: usize,
}

/// Orthonormal columns, by falling singular value.
pub struct Columns {
    /// `rows x rank`.
    pub columns: Mat<f64>,
    /// One per column (m).
    pub singular_values: Vec<f64>,
}

impl StreamingSvd {
    /// For states of `rows` numbers, and at most `rank` columns.
    pub fn new(rows: usize, rank: usize) -> Self {
        stay_on_this_thread();
        Self {
            rank,
            keep: rank + rank.div_ceil(4),
            columns: Mat::zeros(rows, 0),
            singular: Vec::new(),
            block: Mat::zeros(rows, BLOCK_STATES),
            filled: 0,
            states: 0,
        }
    }

    /// Goes on where another one finished: what it took in weighs as much as ever. At most `rank`
    /// columns.
    pub fn resume(known: Columns, rank: usize) -> Self {
        let states = Self::new(known.columns.nrows(), rank);
        Self { columns: known.columns, singular: known.singular_values, ..states }
    }

    /// Takes in one state.
    ///
    /// # Errors
    /// A state of other length, or with a number that is not finite.
    pub fn push(&mut self, state: &[f32]) -> Result<(), BasisError> {
        let (expected, actual) = (self.block.nrows(), state.len());
        if expected != actual {
            return Err(BasisError::Rows { expected, actual });
        }
        if let Some(row) = state.iter().position(|x| !x.is_finite()) {
            return Err(BasisError::NotFinite { state: self.states, row });
        }
        let column = self.block.col_as_slice_mut(self.filled);
        column.iter_mut().zip(state).for_each(|(out, x)| *out = f64::from(*x));
        self.filled += 1;
        self.states += 1;
        if self.filled == BLOCK_STATES { self.absorb() } else { Ok(()) }
    }

    /// The columns: at most `rank`, fewer where the states span less.
    ///
    /// # Errors
    /// No convergence.
    pub fn finish(mut self) -> Result<Columns, BasisError> {
        self.absorb()?;
        let rank = self.rank.min(self.singular.len());
        self.singular.truncate(rank);
        let mut columns = self.columns.subcols(0, rank).to_owned();
        if rank > 0 {
            // Rounding has tilted the columns a little from block to block.
            let qr = columns.qr();
            let upper = qr.thin_R();
            let mut straight = qr.compute_thin_Q();
            for c in (0..rank).filter(|c| upper[(*c, *c)] < 0.0) {
                straight.col_as_slice_mut(c).iter_mut().for_each(|x| *x = -*x);
            }
            columns = straight;
        }
        Ok(Columns { columns, singular_values: self.singular })
    }

    /// Merges the block into the columns.
    fn absorb(&mut self) -> Result<(), BasisError> {
        if self.filled == 0 {
            return Ok(());
        }
        let block = self.block.as_ref().subcols(0, self.filled);
        let known = self.singular.len();
        // What the columns span already, in two passes: one leaves the rest not quite orthogonal.
        let mut inside = self.columns.transpose() * block;
        let mut outside = block - &self.columns * &inside;
        let correction = self.columns.transpose() * &outside;
        outside -= &self.columns * &correction;
        inside += correction;
        let qr = outside.qr();
        let fresh = qr.compute_thin_Q();
        let core = core(&self.singular, inside.as_ref(), qr.thin_R());
        let svd = core.thin_svd().map_err(|_| BasisError::NoConvergence)?;
        let values = svd.S().column_vector();
        let values: Vec<f64> = (0..values.nrows()).map(|i| values[i]).collect();
        let noise = values.first().copied().unwrap_or(0.0) * NOISE;
        let kept = values.partition_point(|s| *s > noise).min(self.keep);
        let turn = svd.U().subcols(0, kept);
        let columns =
            &self.columns * turn.subrows(0, known) + &fresh * turn.subrows(known, fresh.ncols());
        self.columns = columns;
        self.singular = values[..kept].to_vec();
        self.filled = 0;
        Ok(())
    }
}

/// All linear algebra here runs on the caller's thread: jobs are the unit of parallelism.
pub(super) fn stay_on_this_thread() {
    faer::set_global_parallelism(Par::Seq);
}

/// `[diag(singular), inside; 0, upper]`
fn core(singular: &[f64], inside: MatRef<'_, f64>, upper: MatRef<'_, f64>) -> Mat<f64> {
    let known = singular.len();
    Mat::from_fn(known + upper.nrows(), known + upper.ncols(), |row, column| {
        match (row < known, column < known) {
            (true, true) if row == column => singular[row],
            (true, false) => inside[(row, column - known)],
            // Below the diagonal of a factor lie the reflectors that made it.
            (false, false) if row <= column => upper[(row - known, column - known)],
            _ => 0.0,
        }
    })
}

#[cfg(test)]
mod tests {
    use rand_core::Rng;
    use rand_pcg::Pcg64Mcg;

    use super::*;

    /// `states` combinations of `rank` fixed shapes of falling size, plus noise.
    fn states(rows: usize, states: usize, rank: usize, noise: f32) -> Vec<Vec<f32>> {
        let mut rng = Pcg64Mcg::new(7);
        let mut unit = move || (rng.next_u32() >> 8) as f32 / (1 << 23) as f32 - 1.0;
        let shapes: Vec<Vec<f32>> = (0..rank)
            .map(|r| (0..rows).map(|_| unit() / (1.0 + r as f32).powi(2)).collect())
            .collect();
        let state = |_| {
            let weights: Vec<f32> = (0..rank).map(|_| unit()).collect();
            let row = |row: usize| shapes.iter().zip(&weights).map(|(s, w)| s[row] * w).sum();
            let mut state: Vec<f32> = (0..rows).map(row).collect();
            state.iter_mut().for_each(|x: &mut f32| *x += noise * unit());
            state
        };
        (0..states).map(state).collect()
    }

    fn columns(states: &[Vec<f32>], rank: usize) -> Columns {
        let mut svd = StreamingSvd::new(states[0].len(), rank);
        states.iter().for_each(|state| svd.push(state).unwrap());
        svd.finish().unwrap()
    }

    fn residual(states: &[Vec<f32>], columns: MatRef<'_, f64>) -> f64 {
        let data = Mat::from_fn(states[0].len(), states.len(), |row, s| f64::from(states[s][row]));
        (&data - columns * (columns.transpose() * &data)).norm_l2()
    }

    #[test]
    fn the_residual_is_near_that_of_the_whole_decomposition() {
        let states = states(300, 500, 60, 0.002);
        let found = columns(&states, 30);
        let data = Mat::from_fn(300, 500, |row, s| f64::from(states[s][row]));
        let best = data.thin_svd().unwrap();
        let best_residual = residual(&states, best.U().subcols(0, 30));
        let ratio = residual(&states, found.columns.as_ref()) / best_residual;
        assert!((0.999_999..1.02).contains(&ratio), "{ratio}");
        let value = found.singular_values[0] / best.S().column_vector()[0];
        assert!((value - 1.0).abs() < 1e-6, "{value}");
    }

    #[test]
    fn what_is_appended_weighs_as_if_it_had_been_there_at_once() {
        let states = states(300, 600, 60, 0.002);
        let at_once = columns(&states, 30);
        let mut svd = StreamingSvd::resume(columns(&states[..560], 30), 30);
        states[560..].iter().for_each(|state| svd.push(state).unwrap());
        let appended = svd.finish().unwrap();
        let ratio = residual(&states, appended.columns.as_ref())
            / residual(&states, at_once.columns.as_ref());
        assert!((0.99..1.05).contains(&ratio), "{ratio}");
    }

    #[test]
    fn columns_are_orthonormal() {
        let found = columns(&states(90, 1000, 40, 0.01), 50);
        assert_eq!(found.columns.ncols(), 50);
        let gram = found.columns.transpose() * &found.columns;
        let off = (gram - Mat::<f64>::identity(50, 50)).norm_max();
        assert!(off < 1e-12, "{off}");
    }

    #[test]
    fn the_rank_is_no_more_than_the_states_span() {
        let few = columns(&states(120, 3, 3, 0.0), 20);
        assert_eq!(few.columns.ncols(), 3);
        let same = vec![vec![0.5f32; 12]; 300];
        assert_eq!(columns(&same, 20).columns.ncols(), 1);
        assert_eq!(columns(&[vec![0.0f32; 12]], 20).columns.ncols(), 0);
        let wide = columns(&states(9, 700, 9, 0.01), 20);
        assert_eq!(wide.columns.ncols(), 9);
        assert!(residual(&states(9, 700, 9, 0.01), wide.columns.as_ref()) < 1e-9);
    }

    #[test]
    fn what_is_not_finite_is_named() {
        let mut svd = StreamingSvd::new(3, 2);
        svd.push(&[0.0; 3]).unwrap();
        let refused = svd.push(&[0.0, f32::NAN, 0.0]);
        assert_eq!(refused, Err(BasisError::NotFinite { state: 1, row: 1 }));
        assert_eq!(svd.push(&[0.0]), Err(BasisError::Rows { expected: 3, actual: 1 }));
    }
}

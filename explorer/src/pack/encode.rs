//! Encoding with profile `kim2013`: what is worth keeping, and how far off it is.
//!
//! Every region is decoded again as a client decodes it, and every vertex of every state compared.

use std::sync::Arc;

use codec::kim2013::{self, FULL_SCALE, Generation, GenerationError, QuantiseError, Region};
use codec::{AppendError, Basis};
use faer::linalg::solvers::{Llt, Solve};
use faer::{Mat, Side};

use super::basis::{BasisError, Columns, StreamingSvd, stay_on_this_thread};

/// Policy of the encoder.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EncodeSettings {
    /// Columns of the basis frozen at the first version, at most.
    pub rank_max: usize,
    /// Columns that one later generation appends, at most: 32 of 8 bits cost a client about half
    /// a megabyte per 5,000 vertices.
    pub generation_columns_max: usize,
    /// Columns of all generations, at most. Twice the first rank keeps decoding within twice its
    /// cost; what comes later is encoded as well as these columns can, its error stated.
    pub columns_max: usize,
    /// Full scale of a coefficient over the largest one seen when its column was made.
    pub headroom: f32,
    /// A region is said to fall outside once its error is this many times that of the first
    /// version.
    pub error_factor: f32,
    /// ... and above this (m): below, no one sees it, and the first version may be tiny.
    pub error_floor_m: f32,
}

impl EncodeSettings {
    /// The defaults for a basis of `rank_max` columns.
    pub fn for_rank(rank_max: usize) -> Self {
        Self {
            rank_max,
            generation_columns_max: 32,
            columns_max: (2 * rank_max).min(codec::COLUMNS_MAX),
            headroom: 1.5,
            error_factor: 1.5,
            error_floor_m: 0.002,
        }
    }
}

/// Why states could not be encoded.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// No basis.
    #[error("basis: {0}")]
    Basis(#[from] BasisError),
    /// A column that does not fit its bits.
    #[error("column {column}: {source}")]
    Column {
        /// Which one.
        column: usize,
        /// Why.
        source: QuantiseError,
    },
    /// Columns that do not make a generation.
    #[error(transparent)]
    Generation(#[from] GenerationError),
    /// A generation that does not extend the basis.
    #[error(transparent)]
    Append(#[from] AppendError),
    /// Columns of a generation that depend on one another.
    #[error("generation {0} has columns that depend on one another")]
    Dependent(usize),
    /// States without extent: every vertex is at the hips.
    #[error("the states span nothing that a step of 300 micrometres can hold")]
    Nothing,
    /// Not whole states of the basis' rows, none, or more than a region holds.
    #[error(
        "{numbers} numbers do not make 1 to {} states of {rows} rows",
        codec::REGION_STATES_MAX
    )]
    States {
        /// Numbers given.
        numbers: usize,
        /// Rows of the basis.
        rows: usize,
    },
    /// The states could not be read.
    #[error("reading states: {0}")]
    Read(#[from] std::io::Error),
}

/// A region in bytes, and how far off it is.
#[derive(Debug, Clone, PartialEq)]
pub struct EncodedRegion {
    /// `kim2013` region.
    pub bytes: Vec<u8>,
    /// Largest vertex error of its states, decoded as a client decodes them (m); rounded up.
    pub max_error_m: f32,
    /// Sum of squared vertex errors over all its states and vertices (m^2).
    pub square_sum_m2: f64,
    /// A coefficient was beyond its column's headroom and was held there.
    pub overflowed: bool,
}

/// Columns of all generations, as the encoder needs them. Made from encoded generations only, so
/// that a publisher that was resumed encodes as one that never stopped. Clones share them.
#[derive(Clone)]
pub struct Encoder {
    basis: Basis,
    layers: Vec<Arc<Layer>>,
}

/// One generation: `C' -> metres`, and the factor of its normal equations.
struct Layer {
    columns: Mat<f64>,
    normal: Llt<f64>,
}

/// Shows every state to a visitor, in order; called twice.
pub type Visit<'a> =
    dyn FnMut(&mut dyn FnMut(&[f32]) -> Result<(), EncodeError>) -> Result<(), EncodeError> + 'a;

impl Encoder {
    /// Without columns.
    pub fn new() -> Self {
        stay_on_this_thread();
        Self { basis: Basis::new(), layers: Vec::new() }
    }

    /// The basis as a client has it.
    pub fn basis(&self) -> &Basis {
        &self.basis
    }

    /// Appends an encoded generation.
    ///
    /// # Errors
    /// Bytes that are no generation, or one that does not extend this basis.
    pub fn append(&mut self, generation: &[u8]) -> Result<(), EncodeError> {
        let generation = Generation::parse(generation)?;
        self.basis.append(&generation)?;
        let mut columns = Mat::zeros(generation.rows(), generation.columns());
        let step = f64::from(generation.step_m());
        for (c, (width, bytes)) in generation.entries().enumerate() {
            let entry = |b: &[u8]| match width {
                kim2013::Width::Bits8 => i16::from(b[0] as i8),
                kim2013::Width::Bits16 => i16::from_le_bytes([b[0], b[1]]),
            };
            let out = columns.col_as_slice_mut(c).iter_mut();
            out.zip(bytes.chunks_exact(width.bytes()))
                .for_each(|(out, b)| *out = step * f64::from(entry(b)));
        }
        let mut gram = columns.transpose() * &columns;
        for c in 0..gram.ncols() {
            gram[(c, c)] *= 1.0 + 1e-9; // quantised columns may all but depend on one another
        }
        let normal =
            gram.llt(Side::Lower).map_err(|_| EncodeError::Dependent(self.layers.len()))?;
        self.layers.push(Arc::new(Layer { columns, normal }));
        Ok(())
    }

    /// Encodes 1 to 32 states: least squares against the decoded columns of each generation in
    /// turn, each taking what the ones before left.
    ///
    /// * `positions`: state after state, the basis' rows each (m).
    ///
    /// # Errors
    /// Numbers that are not such states, or not finite.
    pub fn region(&self, positions: &[f32]) -> Result<EncodedRegion, EncodeError> {
        let (rows, columns) = (self.basis.rows(), self.basis.columns());
        let numbers = positions.len();
        let states = numbers.checked_div(rows).unwrap_or(0);
        let fits = (1..=codec::REGION_STATES_MAX).contains(&states) && states * rows == numbers;
        if !fits {
            return Err(EncodeError::States { numbers, rows });
        }
        if let Some(at) = positions.iter().position(|x| !x.is_finite()) {
            return Err(BasisError::NotFinite { state: at / rows, row: at % rows }.into());
        }
        let mut steps = vec![0i16; states * columns];
        let overflowed = self.fit(positions, &mut steps);
        let mut bytes = Vec::new();
        kim2013::encode_region(columns, &steps, &mut bytes).expect("the shape was just checked");
        let mut decoded = Vec::new();
        self.decode(&bytes, &mut decoded);
        let mut max = 0.0f64;
        let mut square_sum_m2 = 0.0;
        for (exact, decoded) in positions.chunks_exact(3).zip(decoded.chunks_exact(3)) {
            let square: f64 =
                (0..3).map(|i| (f64::from(exact[i]) - f64::from(decoded[i])).powi(2)).sum();
            square_sum_m2 += square;
            max = max.max(square);
        }
        Ok(EncodedRegion { bytes, max_error_m: round_up(max.sqrt()), square_sum_m2, overflowed })
    }

    /// Positions (m) of all states of a region that this encoder made, as a client decodes them;
    /// `out` is resized.
    ///
    /// # Panics
    /// Bytes that this encoder did not make.
    pub fn decode(&self, region: &[u8], out: &mut Vec<f32>) {
        let (rows, columns) = (self.basis.rows(), self.basis.columns());
        let region = Region::parse(region).expect("a region of this encoder");
        let mut coefficients = vec![0.0; columns];
        out.resize(region.states() * rows, 0.0);
        for (state, out) in out.chunks_exact_mut(rows).enumerate() {
            region.state(state, &mut coefficients);
            self.basis
                .reconstruct(&coefficients, 0..rows, columns, out)
                .expect("lengths are those of the basis");
        }
    }

    /// Rounded coefficients of each state into `steps`; whether one was beyond its headroom.
    fn fit(&self, positions: &[f32], steps: &mut [i16]) -> bool {
        let (rows, columns) = (self.basis.rows(), self.basis.columns());
        let states = positions.len() / rows;
        let mut rest = Mat::from_fn(rows, states, |row, s| f64::from(positions[s * rows + row]));
        let mut overflowed = false;
        let mut first = 0;
        for layer in &self.layers {
            let mut coefficients = layer.columns.transpose() * &rest;
            layer.normal.solve_in_place(coefficients.as_mut());
            for state in 0..states {
                let out = &mut steps[state * columns + first..];
                for (c, out) in coefficients.col_as_slice_mut(state).iter_mut().zip(out) {
                    let held = c.clamp(-1.0, 1.0);
                    overflowed |= held.to_bits() != c.to_bits();
                    *out = kim2013::quantise_coefficient(held as f32).unwrap_or(0);
                    *c = f64::from(*out) / f64::from(FULL_SCALE);
                }
            }
            rest -= &layer.columns * &coefficients;
            first += layer.columns.ncols();
        }
        overflowed
    }
}

impl Default for Encoder {
    fn default() -> Self {
        Self::new()
    }
}

/// A generation in bytes that spans the states shown by `visit`: at most `columns_max` columns,
/// those alone that move some vertex by a step or more. `None` when none does.
///
/// # Errors
/// No basis, or a column that does not fit its bits; whatever `visit` returns.
pub fn generation(
    rows: usize,
    columns_max: usize,
    headroom: f32,
    visit: &mut Visit<'_>,
) -> Result<Option<Vec<u8>>, EncodeError> {
    let mut svd = StreamingSvd::new(rows, columns_max);
    visit(&mut |state| Ok(svd.push(state)?))?;
    let Columns { columns, .. } = svd.finish()?;
    let mut maxima = Maxima::new(&columns);
    visit(&mut |state| {
        maxima.push(state);
        Ok(())
    })?;
    let mut scales = Vec::new();
    let mut entries = Vec::new();
    let mut rescaled = vec![0.0f32; rows];
    for (column, maximum) in maxima.finish().into_iter().enumerate() {
        let scale = (maximum * f64::from(headroom)) as f32;
        let source = columns.col_as_slice(column);
        rescaled.iter_mut().zip(source).for_each(|(out, b)| *out = (b * f64::from(scale)) as f32);
        if rescaled.iter().all(|b| b.abs() < kim2013::STEP_M) {
            continue;
        }
        let at = entries.len();
        entries.resize(at + rows, 0);
        kim2013::quantise_column(&rescaled, kim2013::STEP_M, &mut entries[at..])
            .map_err(|source| EncodeError::Column { column, source })?;
        scales.push(scale);
    }
    if scales.is_empty() {
        return Ok(None);
    }
    let mut bytes = Vec::new();
    kim2013::encode_generation(rows as u32, kim2013::STEP_M, &scales, &entries, &mut bytes)?;
    Ok(Some(bytes))
}

/// Largest absolute coefficient of each orthonormal column over the states shown.
struct Maxima<'a> {
    columns: &'a Mat<f64>,
    block: Mat<f64>,
    filled: usize,
    maxima: Vec<f64>,
}

impl<'a> Maxima<'a> {
    fn new(columns: &'a Mat<f64>) -> Self {
        let block = Mat::zeros(columns.nrows(), codec::REGION_STATES_MAX);
        Self { columns, block, filled: 0, maxima: vec![0.0; columns.ncols()] }
    }

    fn push(&mut self, state: &[f32]) {
        let column = self.block.col_as_slice_mut(self.filled);
        column.iter_mut().zip(state).for_each(|(out, x)| *out = f64::from(*x));
        self.filled += 1;
        if self.filled == self.block.ncols() {
            self.absorb();
        }
    }

    fn absorb(&mut self) {
        let coefficients = self.columns.transpose() * self.block.as_ref().subcols(0, self.filled);
        for state in 0..self.filled {
            let state = coefficients.col_as_slice(state);
            self.maxima.iter_mut().zip(state).for_each(|(max, c)| *max = max.max(c.abs()));
        }
        self.filled = 0;
    }

    fn finish(mut self) -> Vec<f64> {
        self.absorb();
        self.maxima
    }
}

/// The smallest f32 that is not below `x`.
fn round_up(x: f64) -> f32 {
    let nearest = x as f32;
    if f64::from(nearest) < x { nearest.next_up() } else { nearest }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROWS: usize = 300;

    /// Smooth states over six shapes; `odd` adds a seventh.
    fn state(t: usize, odd: f32) -> Vec<f32> {
        let t = t as f32 * 0.1;
        let row = |row: usize| {
            let x = row as f32 / ROWS as f32;
            let shapes = (1..6).map(|k| {
                let k = k as f32;
                (k * t).sin() * (9.0 * k * x + k).sin() * 0.2 / (k * k)
            });
            0.4 * (7.0 * x).cos() + shapes.sum::<f32>() + odd * (40.0 * x * x).sin()
        };
        (0..ROWS).map(row).collect()
    }

    fn encoder(rank: usize) -> Encoder {
        let mut visit = |show: &mut dyn FnMut(&[f32]) -> Result<(), EncodeError>| {
            (0..200).try_for_each(|t| show(&state(t, 0.0)))
        };
        let bytes = generation(ROWS, rank, 1.5, &mut visit).unwrap().unwrap();
        let mut encoder = Encoder::new();
        encoder.append(&bytes).unwrap();
        encoder
    }

    fn region(from: usize, odd: f32) -> Vec<f32> {
        (from..from + 20).flat_map(|t| state(t, odd)).collect()
    }

    #[test]
    fn enough_columns_come_within_two_quanta() {
        let encoder = encoder(20);
        assert_eq!(encoder.basis().columns(), 6);
        let encoded = encoder.region(&region(50, 0.0)).unwrap();
        assert!(encoded.max_error_m < 5e-4, "{}", encoded.max_error_m);
        assert!(!encoded.overflowed);
    }

    #[test]
    fn the_error_is_the_largest_of_all_vertices_and_states() {
        let encoder = encoder(3);
        let states = region(50, 0.0);
        let encoded = encoder.region(&states).unwrap();
        let mut decoded = Vec::new();
        encoder.decode(&encoded.bytes, &mut decoded);
        let errors: Vec<f64> = states
            .chunks(3)
            .zip(decoded.chunks(3))
            .map(|(a, b)| (0..3).map(|i| f64::from(a[i] - b[i]).powi(2)).sum::<f64>().sqrt())
            .collect();
        let max = errors.iter().copied().fold(0.0, f64::max);
        assert!((f64::from(encoded.max_error_m) - max).abs() < 1e-7);
        let squares: f64 = errors.iter().map(|e| e * e).sum();
        assert!((encoded.square_sum_m2 - squares).abs() < 1e-6);
        assert!(max > 0.005, "three columns cannot do");
    }

    #[test]
    fn what_falls_outside_fits_an_appended_generation_and_old_bytes_stay() {
        let mut encoder = encoder(20);
        let old = encoder.region(&region(0, 0.0)).unwrap();
        let states = region(70, 0.1);
        let before = encoder.region(&states).unwrap();
        assert!(before.max_error_m > 0.05, "{}", before.max_error_m);
        let mut decoded = Vec::new();
        encoder.decode(&before.bytes, &mut decoded);
        let rest: Vec<f32> = states.iter().zip(&decoded).map(|(a, b)| a - b).collect();
        let mut visit = |show: &mut dyn FnMut(&[f32]) -> Result<(), EncodeError>| {
            rest.chunks(ROWS).try_for_each(show)
        };
        let bytes = generation(ROWS, 8, 1.5, &mut visit).unwrap().unwrap();
        encoder.append(&bytes).unwrap();
        let after = encoder.region(&states).unwrap();
        assert!(after.max_error_m < 5e-4, "{}", after.max_error_m);
        let mut same = vec![0.0; encoder.basis().columns()];
        Region::parse(&old.bytes).unwrap().state(3, &mut same);
        let mut out = vec![0.0; ROWS];
        encoder.basis().reconstruct(&same, 0..ROWS, same.len(), &mut out).unwrap();
        let exact = state(3, 0.0);
        assert!(out.iter().zip(&exact).all(|(a, b)| (a - b).abs() <= old.max_error_m));
    }

    #[test]
    fn a_coefficient_beyond_its_headroom_is_held_and_reported() {
        let encoder = encoder(20);
        let far: Vec<f32> = state(3, 0.0).iter().map(|x| 4.0 * x).collect();
        let encoded = encoder.region(&far).unwrap();
        assert!(encoded.overflowed && encoded.max_error_m > 0.1);
    }

    #[test]
    fn what_is_no_state_is_refused() {
        let encoder = encoder(4);
        assert!(matches!(encoder.region(&[]), Err(EncodeError::States { .. })));
        assert!(matches!(encoder.region(&[0.0; ROWS + 1]), Err(EncodeError::States { .. })));
        let many = vec![0.0; 33 * ROWS];
        assert!(matches!(encoder.region(&many), Err(EncodeError::States { .. })));
        let mut nan = state(0, 0.0);
        nan[7] = f32::NAN;
        assert!(matches!(encoder.region(&nan), Err(EncodeError::Basis(_))));
    }
}

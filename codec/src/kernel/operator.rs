//! The upsampling operator: fine positions = U x coarse positions (Kavan et al. 2011, section 3).
//!
//! The same pair loops as for a basis: weights are 8- or 16-bit integers, each row with a unit of its
//! own; pairs of columns that are zero in a whole panel are left out, so that compact support is worth
//! its bytes; coarse positions are rounded to 16 bits of their bounding box. Positions enter relative to the
//! middle of that box, and the middle times the row's true sum of weights is added back in f32, so
//! that a cloth far from the origin loses nothing. The f32 form is the reference, at twice the bytes.

use super::memory::{Huge, with_huge_pages};
use super::pairs::{Chunk, Pair, Sums, packed};
use super::panels::Narrowed;
use super::{PANEL_ROWS, Set};
use crate::ROWS_MAX;

/// Coarse points of an operator, at most.
pub const COARSE_MAX: usize = 1024;
/// Fine points of an operator, at most.
pub const FINE_MAX: usize = ROWS_MAX / 3;
/// Largest step that a byte holds, both ways.
const NARROW_MAX: u16 = 127;
/// Largest rounded position.
const STEPS: f32 = 32_767.0;

/// A dense upsampling operator in panel layout.
#[derive(Debug, Clone)]
pub struct Operator {
    fine: usize,
    coarse: usize,
    /// Of each row, the sum of its weights; none where all are a partition of unity.
    row_sums: Vec<f32>,
    weights: Weights,
}

#[derive(Debug, Clone)]
enum Weights {
    /// 16-bit steps; what a step stands for, a row.
    Wide(Steps<i16>, Vec<f32>),
    /// 8-bit steps likewise.
    Narrow(Steps<i8>, Vec<f32>),
    /// Panel after panel the columns.
    Float(Vec<Sums>),
}

/// Steps, panel after panel: of each panel the pairs of columns that are not all zero in it.
#[derive(Debug, Clone)]
struct Steps<T: Copy> {
    chunks: Huge<Chunk<T>>,
    /// Which pair of columns each chunk holds.
    pairs: Vec<u16>,
    /// One past each panel's last chunk.
    ends: Vec<u32>,
}

impl<T: Narrowed> Steps<T> {
    /// From steps row after row.
    fn new(coarse: usize, steps: &[i16]) -> Self {
        let (mut chunks, mut pairs, mut ends) = (Vec::new(), Vec::new(), Vec::new());
        for rows in steps.chunks(PANEL_ROWS * coarse) {
            for pair in 0..coarse.div_ceil(2) {
                let mut chunk = Chunk([T::default(); 2 * PANEL_ROWS]);
                let mut empty = true;
                for (row, steps) in rows.chunks(coarse).enumerate() {
                    for (side, step) in steps[2 * pair..].iter().take(2).enumerate() {
                        chunk.0[2 * row + side] = T::narrowed(*step);
                        empty &= *step == 0;
                    }
                }
                if !empty {
                    chunks.push(chunk);
                    pairs.push(pair as u16);
                }
            }
            ends.push(chunks.len() as u32);
        }
        let chunks = Huge::new(&chunks, Chunk([T::default(); 2 * PANEL_ROWS]));
        Self { chunks, pairs, ends }
    }

    fn bytes(&self) -> usize {
        size_of_val(&self.chunks[..]) + size_of_val(&self.pairs[..]) + size_of_val(&self.ends[..])
    }
}

/// Why an operator could not be made or applied.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum OperatorError {
    /// Too large, or empty.
    #[error("{fine} x {coarse} operator; allowed are 1..={FINE_MAX} x 1..={COARSE_MAX}")]
    Shape {
        /// Fine points.
        fine: usize,
        /// Coarse points.
        coarse: usize,
    },
    /// A slice of another length.
    #[error("{actual} numbers in {what} where {expected} are needed")]
    Length {
        /// Which slice.
        what: &'static str,
        /// Its length.
        actual: usize,
        /// What it must be.
        expected: usize,
    },
    /// NaN or infinite.
    #[error("number {index} of {what} is {value}; only finite numbers will do")]
    NotFinite {
        /// Which slice.
        what: &'static str,
        /// Place.
        index: usize,
        /// What stands there.
        value: f32,
    },
    /// A row whose sums could leave 32 bits.
    #[error("the weights of row {row} sum to {sum} steps in absolute value; at most {most} fit")]
    Headroom {
        /// The row.
        row: usize,
        /// Sum of absolute weights (steps).
        sum: u64,
        /// What fits.
        most: u64,
    },
}

/// Largest sum of absolute weights (steps) of a row.
pub(crate) const ROW_STEPS_MAX: u64 = i32::MAX as u64 / 32_767;

/// Rounds one row of weights to 16 bits and returns what a step stands for: the smallest unit at
/// which each weight fits and the row's sums fit 32 bits. The error is at most half a unit a weight.
///
/// # Errors
/// A weight that is not finite, or slices of different lengths.
pub fn quantise_row(weights: &[f32], out: &mut [i16]) -> Result<f32, OperatorError> {
    length("weights", weights.len(), out.len())?;
    finite("weights", weights)?;
    let largest = weights.iter().fold(0.0f32, |m, w| m.max(w.abs()));
    let sum: f64 = weights.iter().map(|w| f64::from(w.abs())).sum();
    // Half a step a weight may come on top by rounding.
    let room = ROW_STEPS_MAX as f64 - 0.5 * weights.len() as f64;
    let unit = (f64::from(largest) / 32_767.0).max(sum / room).max(1e-30) as f32;
    let unit = f32::from_bits(unit.to_bits() + 1);
    for (out, weight) in out.iter_mut().zip(weights) {
        *out = (weight / unit).round_ties_even() as i16;
    }
    Ok(unit)
}

impl Operator {
    /// With 16-bit weights, rounded by [`quantise_row`] from `weights`: `coarse` numbers for each
    /// fine point, one row after the other.
    ///
    /// # Errors
    /// A shape outside the limits, a wrong length, a weight that is not finite.
    pub fn quantised(fine: usize, coarse: usize, weights: &[f32]) -> Result<Self, OperatorError> {
        shape(fine, coarse)?;
        length("weights", weights.len(), fine * coarse)?;
        let mut steps = vec![0i16; weights.len()];
        let mut units = Vec::with_capacity(fine);
        for (weights, steps) in weights.chunks(coarse).zip(steps.chunks_mut(coarse)) {
            units.push(quantise_row(weights, steps)?);
        }
        let row_sums = weights.chunks(coarse).map(row_sum).collect();
        Self::from_steps(coarse, &steps, units, row_sums)
    }

    /// From weights that were rounded before: row after row `coarse` steps; for each row what a
    /// step stands for, and the true sum of its weights. Steps within -127..=127 take a byte each.
    ///
    /// # Errors
    /// As for [`Operator::quantised`], and a row whose sums could leave 32 bits.
    pub fn from_steps(
        coarse: usize,
        steps: &[i16],
        units: Vec<f32>,
        row_sums: Vec<f32>,
    ) -> Result<Self, OperatorError> {
        let fine = units.len();
        shape(fine, coarse)?;
        length("steps", steps.len(), fine * coarse)?;
        length("row sums", row_sums.len(), fine)?;
        finite("units", &units)?;
        finite("row sums", &row_sums)?;
        for (row, steps) in steps.chunks(coarse).enumerate() {
            let sum = steps.iter().map(|s| u64::from(s.unsigned_abs())).sum();
            if sum > ROW_STEPS_MAX {
                return Err(OperatorError::Headroom { row, sum, most: ROW_STEPS_MAX });
            }
        }
        let partition = row_sums.iter().all(|sum| sum.to_bits() == 1.0f32.to_bits());
        let row_sums = if partition { Vec::new() } else { row_sums };
        let narrow = steps.iter().all(|step| step.unsigned_abs() <= NARROW_MAX);
        let weights = if narrow {
            Weights::Narrow(Steps::new(coarse, steps), units)
        } else {
            Weights::Wide(Steps::new(coarse, steps), units)
        };
        Ok(Self { fine, coarse, row_sums, weights })
    }

    /// With the f32 weights as they are.
    ///
    /// # Errors
    /// A shape outside the limits, a wrong length, a weight that is not finite.
    pub fn float(fine: usize, coarse: usize, weights: &[f32]) -> Result<Self, OperatorError> {
        shape(fine, coarse)?;
        length("weights", weights.len(), fine * coarse)?;
        finite("weights", weights)?;
        let panels = fine.div_ceil(PANEL_ROWS);
        let mut columns = with_huge_pages(panels * coarse);
        for panel in 0..panels {
            for column in 0..coarse {
                let at = |i| weights.get((panel * PANEL_ROWS + i) * coarse + column).copied();
                columns.push(Sums(std::array::from_fn(|i| at(i).unwrap_or(0.0))));
            }
        }
        let row_sums = weights.chunks(coarse).map(row_sum).collect();
        Ok(Self { fine, coarse, row_sums, weights: Weights::Float(columns) })
    }

    /// Fine points.
    pub fn fine(&self) -> usize {
        self.fine
    }

    /// Coarse points.
    pub fn coarse(&self) -> usize {
        self.coarse
    }

    /// Memory held by weights, units and sums (bytes).
    pub fn resident_bytes(&self) -> usize {
        let weights = match &self.weights {
            Weights::Wide(steps, units) => steps.bytes() + size_of_val(&units[..]),
            Weights::Narrow(steps, units) => steps.bytes() + size_of_val(&units[..]),
            Weights::Float(columns) => size_of_val(&columns[..]),
        };
        weights + size_of_val(&self.row_sums[..])
    }

    /// Fine positions (m) from coarse ones (m), both x0, y0, z0, x1, ... Equal bit for bit on every
    /// CPU; no allocation. Cost: one pass over the weights.
    ///
    /// # Errors
    /// Slices of other lengths; a coarse position that is not finite.
    pub fn apply(&self, coarse_m: &[f32], fine_m: &mut [f32]) -> Result<(), OperatorError> {
        self.apply_with(Set::detect(), coarse_m, fine_m)
    }

    /// As [`Operator::apply`], with a given instruction set; with the scalar twin where the CPU
    /// lacks it.
    ///
    /// # Errors
    /// As for `apply`.
    pub fn apply_with(
        &self,
        set: Set,
        coarse_m: &[f32],
        fine_m: &mut [f32],
    ) -> Result<(), OperatorError> {
        length("coarse positions", coarse_m.len(), 3 * self.coarse)?;
        length("fine positions", fine_m.len(), 3 * self.fine)?;
        finite("coarse positions", coarse_m)?;
        let set = set.checked();
        match &self.weights {
            Weights::Wide(steps, units) => self.whole(set, steps, units, coarse_m, fine_m),
            Weights::Narrow(steps, units) => self.whole(set, steps, units, coarse_m, fine_m),
            Weights::Float(columns) => self.floats(set, columns, coarse_m, fine_m),
        }
        Ok(())
    }

    fn whole<T: Narrowed>(
        &self,
        set: Set,
        steps: &Steps<T>,
        units: &[f32],
        coarse_m: &[f32],
        fine_m: &mut [f32],
    ) {
        let (middle, half) = box_of(coarse_m);
        let factors = half.map(|h| h / STEPS);
        let mut pairs = [Pair::<3>::ZERO; COARSE_MAX / 2];
        let pairs = &mut pairs[..self.coarse.div_ceil(2)];
        round_positions(coarse_m, middle, half, pairs);
        let mut own = [Pair::<3>::ZERO; COARSE_MAX / 2];
        ask_for_pages(fine_m);
        ask_for_pages(units);
        ask_for_pages(&self.row_sums);
        let panels = steps.ends.iter().zip(fine_m.chunks_mut(3 * PANEL_ROWS));
        let mut first = 0;
        for ((panel, (end, fine)), units) in (0..).zip(panels).zip(units.chunks(PANEL_ROWS)) {
            let these = panel * PANEL_ROWS..panel * PANEL_ROWS + units.len();
            let row_sums = self.row_sums.get(these).unwrap_or(&[1.0; PANEL_ROWS][..units.len()]);
            let range = first..*end as usize;
            first = range.end;
            let mut sums = [Sums([0.0; PANEL_ROWS]); 3];
            let chunks = &steps.chunks[range.clone()];
            if chunks.len() == pairs.len() {
                T::add(set, chunks, pairs, &factors, &mut sums);
            } else {
                let own = &mut own[..chunks.len()];
                for ((at, own), pair) in (0..).zip(own.iter_mut()).zip(&steps.pairs[range]) {
                    *own = Pair { at, ..pairs[usize::from(*pair)] };
                }
                T::add(set, chunks, own, &factors, &mut sums);
            }
            finish(set, &sums, middle, (units, row_sums), fine);
        }
    }

    fn floats(&self, set: Set, columns: &[Sums], coarse_m: &[f32], fine_m: &mut [f32]) {
        let panels = columns.chunks(self.coarse).zip(fine_m.chunks_mut(3 * PANEL_ROWS));
        for (columns, fine) in panels {
            let mut sums = [Sums([0.0; PANEL_ROWS]); 3];
            add_floats(set, columns, coarse_m, &mut sums);
            for (row, fine) in fine.chunks_exact_mut(3).enumerate() {
                for (fine, sums) in fine.iter_mut().zip(&sums) {
                    *fine = sums.0[row];
                }
            }
        }
    }
}

#[allow(unsafe_code)] // calls of functions compiled for a detected instruction set
fn finish(
    set: Set,
    sums: &[Sums; 3],
    middle: [f32; 3],
    rows: (&[f32], &[f32]),
    fine_m: &mut [f32],
) {
    match set {
        // SAFETY: `Set::checked` gave these sets because this CPU has them; the body is safe code.
        #[cfg(target_arch = "x86_64")]
        Set::Avx512Vnni => unsafe { finished_avx512(sums, middle, rows, fine_m) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Set::Avx2 => unsafe { finished_avx2(sums, middle, rows, fine_m) },
        _ => finished(sums, middle, rows, fine_m),
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn finished_avx512(sums: &[Sums; 3], middle: [f32; 3], rows: (&[f32], &[f32]), fine_m: &mut [f32]) {
    finished(sums, middle, rows, fine_m);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn finished_avx2(sums: &[Sums; 3], middle: [f32; 3], rows: (&[f32], &[f32]), fine_m: &mut [f32]) {
    finished(sums, middle, rows, fine_m);
}

/// Units and middle of a panel's sums, and its points in their places.
#[inline(always)]
fn finished(
    sums: &[Sums; 3],
    middle: [f32; 3],
    (units, row_sums): (&[f32], &[f32]),
    fine_m: &mut [f32],
) {
    // Lengths known beforehand let the compiler write whole vectors.
    let whole: (Result<&[f32; PANEL_ROWS], _>, Result<&[f32; PANEL_ROWS], _>) =
        (units.try_into(), row_sums.try_into());
    if let (Ok(units), Ok(row_sums)) = whole
        && let Ok(fine_m) = <&mut [f32; 3 * PANEL_ROWS]>::try_from(&mut *fine_m)
    {
        for row in 0..PANEL_ROWS {
            for axis in 0..3 {
                fine_m[3 * row + axis] =
                    sums[axis].0[row] * units[row] + middle[axis] * row_sums[row];
            }
        }
        return;
    }
    for (row, (p, (unit, row_sum))) in
        fine_m.chunks_exact_mut(3).zip(units.iter().zip(row_sums)).enumerate()
    {
        for (p, (sums, middle)) in p.iter_mut().zip(sums.iter().zip(middle)) {
            *p = sums.0[row] * unit + middle * row_sum;
        }
    }
}

#[allow(unsafe_code)] // calls of functions compiled for a detected instruction set
fn add_floats(set: Set, columns: &[Sums], coarse_m: &[f32], sums: &mut [Sums; 3]) {
    match set {
        // SAFETY: `Set::checked` gave these sets because this CPU has them; the body is safe code.
        #[cfg(target_arch = "x86_64")]
        Set::Avx512Vnni => unsafe { floats_avx512(columns, coarse_m, sums) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Set::Avx2 => unsafe { floats_avx2(columns, coarse_m, sums) },
        _ => floats(columns, coarse_m, sums),
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn floats_avx512(columns: &[Sums], coarse_m: &[f32], sums: &mut [Sums; 3]) {
    floats(columns, coarse_m, sums);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn floats_avx2(columns: &[Sums], coarse_m: &[f32], sums: &mut [Sums; 3]) {
    floats(columns, coarse_m, sums);
}

/// Products and sums are rounded one by one, so every instruction set gives the same bits.
#[inline(always)]
fn floats(columns: &[Sums], coarse_m: &[f32], sums: &mut [Sums; 3]) {
    const TILE: usize = 32;
    for tile in 0..PANEL_ROWS / TILE {
        let mut local = [[0.0f32; TILE]; 3];
        let (points, _) = coarse_m.as_chunks::<3>();
        for (column, point) in columns.iter().zip(points) {
            let (tiles, _) = column.0.as_chunks::<TILE>();
            for (local, p) in local.iter_mut().zip(point) {
                for (sum, weight) in local.iter_mut().zip(&tiles[tile]) {
                    *sum += weight * p;
                }
            }
        }
        for (sums, local) in sums.iter_mut().zip(&local) {
            sums.0[tile * TILE..][..TILE].copy_from_slice(local);
        }
    }
}

/// Has addresses looked up before they are come to, where that is known to help.
fn ask_for_pages(list: &[f32]) {
    #[cfg(target_arch = "x86_64")]
    super::x86::ask_for_pages(list);
    #[cfg(not(target_arch = "x86_64"))]
    let _ = list;
}

/// Rounds positions to 16 bits of their box, two points a pair.
fn round_positions(points: &[f32], middle: [f32; 3], half: [f32; 3], pairs: &mut [Pair<3>]) {
    let gains = half.map(|h| STEPS / h);
    for (at, (pair, points)) in pairs.iter_mut().zip(points.chunks(6)).enumerate() {
        pair.at = at as u32;
        for (axis, both) in pair.coefficients.iter_mut().enumerate() {
            let rounded = |i: usize| {
                let steps = points.get(i).map_or(0.0, |p| (p - middle[axis]) * gains[axis]);
                steps.round_ties_even().clamp(-STEPS, STEPS) as i16
            };
            *both = packed(rounded(axis), rounded(3 + axis));
        }
    }
}

/// Middle and half extent (m) of the points' bounding box; never a half extent of 0.
fn box_of(points: &[f32]) -> ([f32; 3], [f32; 3]) {
    let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for p in points.chunks_exact(3) {
        for axis in 0..3 {
            low[axis] = low[axis].min(p[axis]);
            high[axis] = high[axis].max(p[axis]);
        }
    }
    let middle = std::array::from_fn(|a| 0.5 * low[a] + 0.5 * high[a]);
    let half = std::array::from_fn(|a| (0.5 * high[a] - 0.5 * low[a]).max(1e-20));
    (middle, half)
}

fn row_sum(weights: &[f32]) -> f32 {
    weights.iter().map(|w| f64::from(*w)).sum::<f64>() as f32
}

fn shape(fine: usize, coarse: usize) -> Result<(), OperatorError> {
    let fits = (1..=FINE_MAX).contains(&fine) && (1..=COARSE_MAX).contains(&coarse);
    if fits { Ok(()) } else { Err(OperatorError::Shape { fine, coarse }) }
}

fn length(what: &'static str, actual: usize, expected: usize) -> Result<(), OperatorError> {
    if actual == expected {
        return Ok(());
    }
    Err(OperatorError::Length { what, actual, expected })
}

fn finite(what: &'static str, numbers: &[f32]) -> Result<(), OperatorError> {
    match numbers.iter().position(|n| !n.is_finite()) {
        Some(index) => Err(OperatorError::NotFinite { what, index, value: numbers[index] }),
        None => Ok(()),
    }
}

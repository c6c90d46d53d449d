//! Positions of one or many characters from their coefficients.

use std::ops::Range;
use std::sync::Arc;

use super::pairs::{Entry, Pair, Sums, packed};
use super::panels::{BLOCK_PAIRS_MAX, NO_COLUMN, Width};
use super::{PANEL_ROWS, Panels, Set};

/// Pairs of one pass over the output: 512 columns.
const PASS_PAIRS: usize = 2 * BLOCK_PAIRS_MAX;
/// Blocks of one pass.
const PASS_BLOCKS: usize = 32;
/// Characters whose sums are in registers together.
const TOGETHER: usize = 4;
/// Groups of characters that share one walk over memory.
const GROUPS: usize = 4;

/// Which columns enter.
#[derive(Debug, Clone, Copy)]
pub enum Select<'a> {
    /// The first so many.
    First(usize),
    /// These numbers, ascending.
    Only(&'a [u16]),
}

impl From<usize> for Select<'_> {
    fn from(columns: usize) -> Self {
        Self::First(columns)
    }
}

impl<'a> From<&'a [u16]> for Select<'a> {
    fn from(numbers: &'a [u16]) -> Self {
        Self::Only(numbers)
    }
}

impl Select<'_> {
    fn has(&self, number: usize) -> bool {
        match self {
            Self::First(columns) => number < *columns,
            Self::Only(numbers) => {
                u16::try_from(number).is_ok_and(|n| numbers.binary_search(&n).is_ok())
            }
        }
    }
}

/// What to decode; all of it checked by the caller.
#[derive(Debug, Clone)]
pub struct Batch<'a> {
    /// `stride` numbers for each character, one after the other.
    pub coefficients: &'a [f32],
    /// Coefficients of a character.
    pub stride: usize,
    /// Rows wanted.
    pub rows: Range<usize>,
    /// Columns wanted.
    pub select: Select<'a>,
}

/// Positions (m): `mean + sum over columns`, `rows.len()` numbers a character, into `out`.
///
/// A coefficient is rounded to 16 bits of its column's range; sums of products are exact. A column
/// that is not selected, or whose coefficient is 0 for a whole group of characters, costs nothing. A
/// coefficient that is not finite counts as 0. Nothing is allocated.
///
/// # Panics
/// Rows must be those of the panels (and of the mean), numbers of columns below `stride`, `out` must
/// hold `rows.len()` numbers for each whole `stride` of coefficients.
pub fn decode(
    set: Set,
    parts: &[Arc<Panels>],
    mean: Option<&[f32]>,
    batch: &Batch<'_>,
    out: &mut [f32],
) {
    let set = set.checked();
    let count = batch.rows.len();
    if count == 0 || out.is_empty() {
        return;
    }
    assert_eq!(out.len() % count, 0, "whole characters of {count} numbers");
    let call = Call { set, parts, mean, batch };
    let (mut coefficients, mut out) = (batch.coefficients, out);
    while !out.is_empty() {
        let characters = (out.len() / count).min(GROUPS * TOGETHER);
        let (now, after) = out.split_at_mut(characters * count);
        let (of_now, rest) = coefficients.split_at(characters * batch.stride);
        match characters {
            1 => call.run::<1, 1>(of_now, now),
            2..=TOGETHER => call.run::<TOGETHER, 1>(of_now, now),
            _ => call.run::<TOGETHER, GROUPS>(of_now, now),
        }
        (coefficients, out) = (rest, after);
    }
}

struct Call<'a> {
    set: Set,
    parts: &'a [Arc<Panels>],
    mean: Option<&'a [f32]>,
    batch: &'a Batch<'a>,
}

/// A block of one generation.
#[derive(Debug, Clone, Copy, Default)]
struct BlockAt {
    part: usize,
    wide: bool,
    block: usize,
    /// Number of the generation's first column.
    first: usize,
}

/// Rounded coefficients of up to `K` characters for the blocks of one pass.
struct Prepared<const K: usize> {
    pairs: [Pair<K>; PASS_PAIRS],
    used: usize,
    ends: [usize; PASS_BLOCKS],
    factors: [[f32; K]; PASS_BLOCKS],
}

impl<const K: usize> Prepared<K> {
    const EMPTY: Self = Self {
        pairs: [Pair::ZERO; PASS_PAIRS],
        used: 0,
        ends: [0; PASS_BLOCKS],
        factors: [[0.0; K]; PASS_BLOCKS],
    };
}

impl Call<'_> {
    /// Up to `K * G` characters.
    fn run<const K: usize, const G: usize>(&self, coefficients: &[f32], out: &mut [f32]) {
        let mut blocks = [BlockAt::default(); PASS_BLOCKS];
        let mut next = BlockAt { wide: true, ..BlockAt::default() };
        let mut prepared = [const { Prepared::<K>::EMPTY }; G];
        let mut first_pass = true;
        loop {
            let count = self.next_pass(&mut next, &mut blocks);
            if count == 0 && !first_pass {
                return;
            }
            let group = coefficients.chunks((K * self.batch.stride).max(1));
            for (prepared, coefficients) in prepared.iter_mut().zip(group) {
                self.prepare(&blocks[..count], coefficients, prepared);
            }
            self.pass(&blocks[..count], &prepared, first_pass, out);
            first_pass = false;
        }
    }

    /// As many whole blocks as fit; where to cut does not depend on coefficients.
    fn next_pass(&self, next: &mut BlockAt, blocks: &mut [BlockAt; PASS_BLOCKS]) -> usize {
        let (mut count, mut pairs) = (0, 0);
        while let Some(part) = self.parts.get(next.part) {
            let ends = if next.wide { &part.wide.ends } else { &part.narrow.ends };
            let Some(end) = ends.get(next.block) else {
                next.block = 0;
                if !next.wide {
                    next.part += 1;
                    next.first += part.columns();
                }
                next.wide = !next.wide;
                continue;
            };
            let start = if next.block == 0 { 0 } else { ends[next.block - 1] };
            if count == PASS_BLOCKS || pairs + end - start > PASS_PAIRS {
                break;
            }
            pairs += end - start;
            blocks[count] = *next;
            count += 1;
            next.block += 1;
        }
        count
    }

    fn prepare<const K: usize>(
        &self,
        blocks: &[BlockAt],
        coefficients: &[f32],
        prepared: &mut Prepared<K>,
    ) {
        prepared.used = 0;
        for (i, at) in blocks.iter().enumerate() {
            let part = &self.parts[at.part];
            prepared.factors[i] = if at.wide {
                self.prepare_block(&part.wide, at, coefficients, prepared)
            } else {
                self.prepare_block(&part.narrow, at, coefficients, prepared)
            };
            prepared.ends[i] = prepared.used;
        }
    }

    /// Appends the block's pairs that have a coefficient other than 0; returns the metres of a
    /// product of 1 for each character.
    fn prepare_block<T: Entry, const K: usize>(
        &self,
        width: &Width<T>,
        at: &BlockAt,
        coefficients: &[f32],
        prepared: &mut Prepared<K>,
    ) -> [f32; K] {
        let start = if at.block == 0 { 0 } else { width.ends[at.block - 1] };
        let pairs = start..width.ends[at.block];
        let value = |k: usize, pair: usize, side: usize| {
            let number = width.numbers[pair][side];
            let global = at.first + usize::from(number);
            let wanted = number != NO_COLUMN && self.batch.select.has(global);
            let place = k * self.batch.stride + global;
            let c = if wanted { coefficients.get(place).copied().unwrap_or(0.0) } else { 0.0 };
            let value = c * width.gains[pair][side];
            if value.is_finite() { value } else { 0.0 }
        };
        let mut shrink = [1.0f32; K];
        for (k, shrink) in shrink.iter_mut().enumerate() {
            for pair in pairs.clone() {
                for side in [0, 1] {
                    let value = value(k, pair, side).abs();
                    while (value * *shrink).round_ties_even() > width.limits[pair][side] {
                        *shrink *= 0.5;
                    }
                }
            }
        }
        for pair in pairs {
            let both = std::array::from_fn(|k| {
                let rounded = |side| (value(k, pair, side) * shrink[k]).round_ties_even() as i16;
                packed(rounded(0), rounded(1))
            });
            if both != [0; K] {
                prepared.pairs[prepared.used] = Pair { at: pair as u32, coefficients: both };
                prepared.used += 1;
            }
        }
        shrink.map(|s| width.unit_m / s)
    }

    fn pass<const K: usize, const G: usize>(
        &self,
        blocks: &[BlockAt],
        prepared: &[Prepared<K>; G],
        first_pass: bool,
        out: &mut [f32],
    ) {
        let rows = &self.batch.rows;
        let count = rows.len();
        for panel in rows.start / PANEL_ROWS..rows.end.div_ceil(PANEL_ROWS) {
            let first = panel * PANEL_ROWS;
            let from = rows.start.max(first);
            let to = rows.end.min(first + PANEL_ROWS);
            let (inside, places) = (from - first..to - first, from - rows.start..to - rows.start);
            for (prepared, out) in prepared.iter().zip(out.chunks_mut(K * count)) {
                let mut sums = [Sums([0.0; PANEL_ROWS]); K];
                for (sums, out) in sums.iter_mut().zip(out.chunks(count)) {
                    if !first_pass {
                        sums.0[inside.clone()].copy_from_slice(&out[places.clone()]);
                    } else if let Some(mean) = self.mean {
                        sums.0[inside.clone()].copy_from_slice(&mean[from..to]);
                    }
                }
                self.panel(panel, blocks, prepared, &mut sums);
                for (sums, out) in sums.iter().zip(out.chunks_mut(count)) {
                    out[places.clone()].copy_from_slice(&sums.0[inside.clone()]);
                }
            }
        }
    }

    fn panel<const K: usize>(
        &self,
        panel: usize,
        blocks: &[BlockAt],
        prepared: &Prepared<K>,
        sums: &mut [Sums; K],
    ) {
        let mut start = 0;
        for ((at, end), factors) in blocks.iter().zip(prepared.ends).zip(&prepared.factors) {
            let pairs = &prepared.pairs[start..end];
            start = end;
            if pairs.is_empty() {
                continue;
            }
            let part = &self.parts[at.part];
            if at.wide {
                i16::add(self.set, part.wide.panel(panel), pairs, factors, sums);
            } else {
                i8::add(self.set, part.narrow.panel(panel), pairs, factors, sums);
            }
        }
    }
}

//! Regions of profile `toile`: one step for all coefficients, fixes where a vertex is beyond the
//! bound, and the price of shorter lists of columns.

use std::sync::Arc;

use codec::kernel::Select;
use codec::kim2013::FULL_SCALE;
use codec::toile::{self, Fix, Model, Region, RegionParts, TIERS};

use super::design::step_code;
use super::encode::{Bounded, EncodeError, EncodedRegion, Encoder, errors, round_up};

/// Of the bound, what rounding a fix may leave: the rest is room for rounding positions.
const FIX_SHARE: f64 = 0.9;

impl Bounded {
    /// Appends a generation; returns its resident form.
    pub(super) fn append(&mut self, bytes: &[u8]) -> Result<Vec<u8>, EncodeError> {
        let generation = toile::parse_generation(bytes, self.tree.as_deref())?;
        if let Some(tree) = generation.tree() {
            self.tree = Some(Arc::new(tree.clone()));
            self.model = Model::new(tree.vertices());
            self.made = (generation.states(), generation.rms_m());
            self.first_generations = 0;
            self.leading = generation.columns().len();
        }
        // Generations of one moment were made from equally many states, and follow each other.
        let of_first =
            self.first_generations == self.generations && generation.states() == self.made.0;
        self.first_generations += usize::from(of_first);
        self.generations += 1;
        self.step = generation.step();
        self.model.append(generation.columns());
        Ok(generation.to_resident())
    }
}

/// Encodes states whose shape was checked.
pub(super) fn region(
    encoder: &Encoder,
    bounded: &Bounded,
    positions: &[f32],
) -> Result<EncodedRegion, EncodeError> {
    let (rows, columns) = (encoder.basis.rows(), encoder.basis.columns());
    let step_m = f64::from(toile::step_m(bounded.step));
    let mut steps = vec![0i32; positions.len() / rows * columns];
    let known = bounded.model.columns();
    let overflowed = encoder.fit(positions, |column, state, c| {
        let maximum_m = f64::from(known[column].maximum_m);
        let rounded = (c * maximum_m / step_m).round() as i32;
        steps[state * columns + column] = rounded;
        let full = (f64::from(rounded) * step_m * f64::from(FULL_SCALE) / maximum_m).round();
        full.clamp(-f64::from(FULL_SCALE), f64::from(FULL_SCALE)) / f64::from(FULL_SCALE)
    });
    let mut parts = RegionParts {
        columns,
        step: bounded.step,
        coefficients: &steps,
        fix_step: 0,
        fixes: &[],
        tier_errors_m: [0.0; TIERS.len()],
        leading_error_m: 0.0,
    };
    let mut bytes = Vec::new();
    toile::encode_region(&bounded.model, &parts, &mut bytes)?;
    let plain = toile::parse_region(&bytes, &bounded.model)?;
    let mut decoded = Vec::new();
    encoder.reconstruct(plain.coefficients(), Select::First(columns), &mut decoded);
    parts.tier_errors_m = tier_errors(encoder, &plain, positions, &decoded);
    parts.leading_error_m = leading_error(encoder, &plain, bounded.leading, positions);
    let fixes = match bounded.max_m {
        Some(max_m) => {
            parts.fix_step = fix_step(max_m);
            fixes(positions, &decoded, rows, max_m, parts.fix_step)
        }
        None => Vec::new(),
    };
    parts.fixes = &fixes;
    bytes.clear();
    toile::encode_region(&bounded.model, &parts, &mut bytes)?;
    let region = toile::parse_region(&bytes, &bounded.model)?;
    debug_assert_eq!(region.coefficients(), plain.coefficients());
    decoded.chunks_exact_mut(rows).enumerate().for_each(|(state, out)| region.fix(state, out));
    let (max_error_m, square_sum_m2) = errors(positions, &decoded);
    Ok(EncodedRegion { bytes, max_error_m, square_sum_m2, overflowed, fixes: fixes.len() })
}

/// Positions (m) of all states, as a client decodes them.
pub(super) fn decode(encoder: &Encoder, bounded: &Bounded, region: &[u8], out: &mut Vec<f32>) {
    let region = decode_columns(encoder, bounded, region, out);
    let rows = encoder.basis.rows();
    out.chunks_exact_mut(rows).enumerate().for_each(|(state, out)| region.fix(state, out));
}

/// The same without fixes.
pub(super) fn decode_columns(
    encoder: &Encoder,
    bounded: &Bounded,
    region: &[u8],
    out: &mut Vec<f32>,
) -> Region {
    let region = toile::parse_region(region, &bounded.model).expect("a region of this encoder");
    // A region of an older generation knows fewer columns.
    let (known, columns) = (region.columns(), encoder.basis.columns());
    let widened = |state: &[i16]| {
        let mut wide = state.to_vec();
        wide.resize(columns, 0);
        wide
    };
    let coefficients: Vec<i16> =
        region.coefficients().chunks_exact(known).flat_map(widened).collect();
    encoder.reconstruct(&coefficients, Select::First(columns), out);
    region
}

/// The code of the largest step whose rounding leaves a fixed vertex within the bound.
fn fix_step(max_m: f32) -> u8 {
    step_code(FIX_SHARE * f64::from(max_m) * 2.0 / 3f64.sqrt())
}

/// Fixes for all vertices that are further off than `max_m`.
fn fixes(exact: &[f32], decoded: &[f32], rows: usize, max_m: f32, step: u8) -> Vec<Fix> {
    let step_m = f64::from(toile::step_m(step));
    let mut fixes = Vec::new();
    let vertices = exact.chunks_exact(3).zip(decoded.chunks_exact(3)).enumerate();
    for (index, (exact, decoded)) in vertices {
        let off: [f64; 3] = [0, 1, 2].map(|i| f64::from(exact[i]) - f64::from(decoded[i]));
        let distance = off.iter().map(|x| x * x).sum::<f64>().sqrt();
        if round_up(distance) > max_m {
            let (state, vertex) = (3 * index / rows, 3 * index % rows / 3);
            let steps = off.map(|x| (x / step_m).round() as i32);
            fixes.push(Fix { state: state as u16, vertex: vertex as u32, steps });
        }
    }
    fixes
}

/// Largest vertex error (m) with the first generation's columns alone.
fn leading_error(encoder: &Encoder, region: &Region, leading: usize, exact: &[f32]) -> f32 {
    let mut decoded = Vec::new();
    let select = Select::First(leading.min(region.columns()));
    encoder.reconstruct(region.coefficients(), select, &mut decoded);
    errors(exact, &decoded).0
}

/// Largest vertex error (m) with the columns of each tier alone.
fn tier_errors(
    encoder: &Encoder,
    region: &Region,
    exact: &[f32],
    whole: &[f32],
) -> [f32; TIERS.len()] {
    let mut decoded = Vec::new();
    let mut of_whole = None;
    TIERS.map(|count| {
        if count >= region.by_energy().len() {
            return *of_whole.get_or_insert_with(|| errors(exact, whole).0);
        }
        let mut active = region.by_energy()[..count].to_vec();
        active.sort_unstable();
        encoder.reconstruct(region.coefficients(), Select::Only(&active), &mut decoded);
        errors(exact, &decoded).0
    })
}

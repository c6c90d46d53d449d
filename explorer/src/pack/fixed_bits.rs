//! Regions and generations of profile `kim2013`.

use codec::kernel::Select;
use codec::kim2013::{self, FULL_SCALE, Region};
use faer::MatRef;

use super::encode::{EncodeError, EncodedRegion, Encoder, errors};

/// Encodes states whose shape was checked.
pub(super) fn region(encoder: &Encoder, positions: &[f32]) -> EncodedRegion {
    let (rows, columns) = (encoder.basis.rows(), encoder.basis.columns());
    let mut steps = vec![0i16; positions.len() / rows * columns];
    let overflowed = encoder.fit(positions, |column, state, c| {
        let rounded = kim2013::quantise_coefficient(c as f32).unwrap_or(0);
        steps[state * columns + column] = rounded;
        f64::from(rounded) / f64::from(FULL_SCALE)
    });
    let mut bytes = Vec::new();
    kim2013::encode_region(columns, &steps, &mut bytes).expect("the shape was checked");
    let mut decoded = Vec::new();
    decode(encoder, &bytes, &mut decoded);
    let (max_error_m, square_sum_m2) = errors(positions, &decoded);
    EncodedRegion { bytes, max_error_m, square_sum_m2, overflowed, fixes: 0 }
}

/// Positions (m) of all states.
pub(super) fn decode(encoder: &Encoder, region: &[u8], out: &mut Vec<f32>) {
    let region = Region::parse(region).expect("a region of this encoder");
    let coefficients: Vec<i16> = region.coefficients().collect();
    encoder.reconstruct(&coefficients, Select::First(encoder.basis.columns()), out);
}

/// A generation of orthonormal columns whose coefficients reach `maxima_m`: those alone that move
/// some vertex by a step or more. `None` when none does.
///
/// # Errors
/// A column that does not fit its bits.
pub(super) fn generation(
    columns: MatRef<'_, f64>,
    maxima_m: &[f64],
    headroom: f32,
) -> Result<Option<Vec<u8>>, EncodeError> {
    let rows = columns.nrows();
    let mut scales = Vec::new();
    let mut entries = Vec::new();
    let mut rescaled = vec![0.0f32; rows];
    for (column, maximum) in maxima_m.iter().enumerate() {
        let scale = (maximum * f64::from(headroom)) as f32;
        let source = (0..rows).map(|row| columns[(row, column)]);
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

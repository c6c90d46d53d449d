//! Many columns at once, from states that can be read several times.

use faer::{Mat, Side};
use rand_core::Rng;
use rand_pcg::Pcg64Mcg;

use super::basis::{BasisError, Columns, stay_on_this_thread};
use super::encode::{EncodeError, Visit};

/// Columns carried beyond those asked for: an eighth of them, and at least so many.
const SPARE_MIN: usize = 24;
/// Squared singular values below this fraction of the largest are rounding noise of f32.
const NOISE: f64 = 1e-13;
/// Numbers of one set of columns, at most (512 MiB); three such sets are held.
const NUMBERS_MAX: usize = 1 << 26;

/// The leading left singular vectors, by a randomised range finder with one power iteration and a
/// last step within the range (Halko, Martinsson & Tropp 2011, algorithms 4.4 and 5.1).
///
/// Where a block-by-block decomposition costs `columns^2` a block of states, this costs four
/// products with all states; and `visit` is called four times. Products are in f32, which only
/// turns the range a little; what makes columns orthonormal is in f64. Deterministic: the
/// directions come from a fixed seed. Memory: three sets of `rows * 1.125 * rank` numbers of 64
/// bits, whatever the number of states; the rank is cut where a set would exceed 512 MiB.
///
/// # Errors
/// Whatever `visit` returns, numbers that are not finite, no convergence.
pub(super) fn wide_columns(
    rows: usize,
    rank: usize,
    visit: &mut Visit<'_>,
) -> Result<Columns, EncodeError> {
    stay_on_this_thread();
    let rank = rank.min(NUMBERS_MAX / rows.max(1)).max(1);
    let mut states = 0;
    visit(&mut |region| {
        check(region, rows, states)?;
        states += region.len() / rows;
        Ok(())
    })?;
    let carried = (rank + (rank / 8).max(SPARE_MIN)).min(rows).min(states);
    let mut rng = Pcg64Mcg::new(0x746f_696c_6521);
    let mut unit = move || (rng.next_u32() >> 8) as f32 / (1 << 23) as f32 - 1.0;
    let mut range = Mat::<f32>::zeros(rows, carried);
    visit(&mut |region| {
        let block = block(region, rows);
        let directions = Mat::from_fn(block.ncols(), carried, |_, _| unit());
        range += &block * &directions;
        Ok(())
    })?;
    let range = narrow(&wide(&range).qr().compute_thin_Q());
    let mut turned = Mat::<f32>::zeros(rows, carried);
    visit(&mut |region| {
        let block = block(region, rows);
        turned += &block * (block.transpose() * &range);
        Ok(())
    })?;
    drop(range);
    let range = wide(&turned).qr().compute_thin_Q();
    drop(turned);
    let mut inside = Mat::<f64>::zeros(carried, carried);
    let short = narrow(&range);
    visit(&mut |region| {
        let seen = wide(&(short.transpose() * block(region, rows)));
        inside += &seen * seen.transpose();
        Ok(())
    })?;
    drop(short);
    let eigen = inside.self_adjoint_eigen(Side::Lower).map_err(|_| BasisError::NoConvergence)?;
    // Ascending; the largest come first here.
    let squares = eigen.S().column_vector();
    let square = |at: usize| squares[carried - 1 - at];
    let largest = if carried > 0 { square(0) } else { 0.0 };
    let kept = (0..carried).take_while(|at| square(*at) > largest * NOISE).count().min(rank);
    let turn = Mat::from_fn(carried, kept, |r, c| eigen.U()[(r, carried - 1 - c)]);
    let singular_values = (0..kept).map(|at| square(at).sqrt()).collect();
    Ok(Columns { columns: &range * &turn, singular_values })
}

fn block(region: &[f32], rows: usize) -> Mat<f32> {
    Mat::from_fn(rows, region.len() / rows, |row, s| region[s * rows + row])
}

fn wide(of: &Mat<f32>) -> Mat<f64> {
    Mat::from_fn(of.nrows(), of.ncols(), |r, c| f64::from(of[(r, c)]))
}

fn narrow(of: &Mat<f64>) -> Mat<f32> {
    Mat::from_fn(of.nrows(), of.ncols(), |r, c| of[(r, c)] as f32)
}

fn check(region: &[f32], rows: usize, before: usize) -> Result<(), BasisError> {
    match region.iter().position(|x| !x.is_finite()) {
        Some(at) => Err(BasisError::NotFinite { state: before + at / rows, row: at % rows }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pack::basis::StreamingSvd;

    /// Waves of slowly falling size: the hard case for a randomised finder.
    fn states(rows: usize, count: usize) -> Vec<f32> {
        let state = move |t: usize| {
            (0..rows).map(move |row| {
                let wave = |k: usize| {
                    let (t, x, k) = (t as f32, row as f32 / rows as f32, k as f32);
                    ((0.37 + 0.11 * k) * t + k * k).sin() * (k * 3.1 * x).cos() / (1.0 + k)
                };
                (0..60).map(wave).sum::<f32>()
            })
        };
        (0..count).flat_map(state).collect()
    }

    fn left(states: &[f32], rows: usize, columns: &Mat<f64>) -> f64 {
        let all = wide(&block(states, rows));
        (&all - columns * (columns.transpose() * &all)).norm_l2()
    }

    #[test]
    fn wide_columns_are_nearly_the_best_orthonormal_and_repeatable() {
        let (rows, states) = (240, states(240, 300));
        let mut visit = |show: &mut dyn FnMut(&[f32]) -> Result<(), EncodeError>| {
            states.chunks(20 * rows).try_for_each(show)
        };
        let found = wide_columns(rows, 24, &mut visit).unwrap();
        let again = wide_columns(rows, 24, &mut visit).unwrap();
        assert_eq!(found.columns, again.columns);
        let best = wide(&block(&states, rows)).thin_svd().unwrap();
        let best = best.U().subcols(0, 24).to_owned();
        let ratio = left(&states, rows, &found.columns) / left(&states, rows, &best);
        assert!((0.999_999..1.03).contains(&ratio), "{ratio}");
        let gram = found.columns.transpose() * &found.columns;
        assert!((gram - Mat::<f64>::identity(24, 24)).norm_max() < 1e-10);
        let mut svd = StreamingSvd::new(rows, 24);
        states.chunks(rows).for_each(|state| svd.push(state).unwrap());
        let streamed = svd.finish().unwrap().singular_values[0];
        assert!((found.singular_values[0] / streamed - 1.0).abs() < 1e-6);
    }

    #[test]
    fn few_or_equal_states_give_few_columns_and_nan_is_named() {
        let mut same = |show: &mut dyn FnMut(&[f32]) -> Result<(), EncodeError>| show(&[0.5; 36]);
        assert_eq!(wide_columns(12, 8, &mut same).unwrap().columns.ncols(), 1);
        let mut none = |show: &mut dyn FnMut(&[f32]) -> Result<(), EncodeError>| show(&[0.0; 12]);
        assert_eq!(wide_columns(12, 8, &mut none).unwrap().columns.ncols(), 0);
        let mut nan = |show: &mut dyn FnMut(&[f32]) -> Result<(), EncodeError>| {
            show(&[0.0, 0.0, 0.0, 1.0, f32::NAN, 0.0])
        };
        let refused = wide_columns(3, 2, &mut nan).err().map(|e| e.to_string()).unwrap();
        assert!(refused.contains("state 1") && refused.contains("row 1"), "{refused}");
    }
}

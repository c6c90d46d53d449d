//! The kernels: every instruction set gives the scalar twin's bits, integer sums are exact whatever
//! the entries and coefficients, parts equal the whole, and nothing is allocated per frame.

use std::sync::Arc;

use allocation_counter::measure;
use codec::Basis;
use codec::kernel::normals::Faces;
use codec::kernel::operator::{Operator, OperatorError, quantise_row};
use codec::kernel::{Batch, Column, Entries, Panels, PanelsError, Select, Set, decode};
use proptest::prelude::*;
use rand_core::Rng;
use rand_pcg::Pcg64Mcg;

/// Numbers in -1..1, the same on every machine.
fn noise(seed: u64, count: usize) -> Vec<f32> {
    let mut rng = Pcg64Mcg::new(u128::from(seed) | 1);
    (0..count).map(|_| (rng.next_u32() >> 8) as f32 / (1 << 23) as f32 - 1.0).collect()
}

/// Coefficients as a region holds them: fractions of 32,767.
fn stored(coefficients: &[f32]) -> Vec<f32> {
    coefficients.iter().map(|c| (c * 32_767.0).round() / 32_767.0).collect()
}

/// Entries over all of 16 bits, or over all of 8 bits, extremes included.
fn entries(seed: u64, rows: usize, wide: bool) -> Vec<i16> {
    let full = if wide { 40_000.0 } else { 150.0 };
    let (least, most) = if wide { (-32_768.0, 32_767.0) } else { (-128.0, 127.0) };
    noise(seed, rows).iter().map(|x| (x * full).clamp(least, most) as i16).collect()
}

/// Generations of a few columns of both widths, with what each column holds.
struct Sample {
    parts: Vec<Arc<Panels>>,
    columns: Vec<(Vec<i16>, f32)>,
    mean: Vec<f32>,
}

fn sample(seed: u64, rows: usize, counts: &[usize]) -> Sample {
    let (mut parts, mut columns) = (Vec::new(), Vec::new());
    for (generation, count) in counts.iter().enumerate() {
        let step = 3e-4 / (1 + generation) as f32;
        let own: Vec<(Vec<i16>, f32, bool)> = (0..*count)
            .map(|c| {
                let wide = (c * 7 + seed as usize).is_multiple_of(3);
                let seed = seed * 1000 + (generation * 100 + c) as u64;
                (entries(seed, rows, wide), step, wide)
            })
            .collect();
        let bytes: Vec<Vec<u8>> =
            own.iter().map(|(e, _, _)| e.iter().map(|e| *e as u8).collect()).collect();
        let list: Vec<Column<'_>> = own
            .iter()
            .zip(&bytes)
            .map(|((e, scale_m, wide), b)| {
                let entries = if *wide { Entries::Wide(e) } else { Entries::Narrow(b) };
                Column { entries, scale_m: *scale_m, limit: 1.0 }
            })
            .collect();
        parts.push(Arc::new(Panels::new(rows, &list).unwrap()));
        columns.extend(own.into_iter().map(|(e, scale, _)| (e, scale)));
    }
    Sample { parts, columns, mean: noise(seed + 77, rows) }
}

impl Sample {
    /// In f64, with coefficients rounded to 16 bits as they are stored.
    fn expected(&self, coefficients: &[f32], row: usize) -> f64 {
        let term = |((entries, scale), c): (&(Vec<i16>, f32), &f32)| {
            let stored = (f64::from(*c) * 32_767.0).round() / 32_767.0;
            f64::from(entries[row]) * f64::from(*scale) * stored
        };
        f64::from(self.mean[row]) + self.columns.iter().zip(coefficients).map(term).sum::<f64>()
    }

    fn decode(&self, set: Set, coefficients: &[f32], characters: usize) -> Vec<f32> {
        let rows = self.mean.len();
        let mut out = vec![9.0; rows * characters];
        let stride = self.columns.len();
        let select = Select::First(stride);
        let batch = Batch { coefficients, stride, rows: 0..rows, select };
        decode(set, &self.parts, Some(&self.mean), &batch, &mut out);
        out
    }
}

fn bits(numbers: &[f32]) -> Vec<u32> {
    numbers.iter().map(|n| n.to_bits()).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn every_set_gives_the_twins_bits_and_sums_are_exact(
        seed in 0u64..1000, rows in 1usize..300, first in 1usize..90, second in 0usize..40,
        characters in 1usize..22,
    ) {
        let sample = sample(seed, rows, &[first, second]);
        let coefficients = stored(&noise(seed + 5, (first + second) * characters));
        let twin = sample.decode(Set::Scalar, &coefficients, characters);
        for set in Set::available() {
            let out = sample.decode(*set, &coefficients, characters);
            prop_assert_eq!(bits(&out), bits(&twin), "{:?}", set);
        }
        for (character, c) in coefficients.chunks(first + second).enumerate() {
            let alone = sample.decode(Set::detect(), c, 1);
            let part = &twin[character * rows..][..rows];
            prop_assert_eq!(bits(&alone), bits(part), "alone or in a batch");
            for (row, out) in alone.iter().enumerate() {
                let expected = sample.expected(c, row);
                // Four additions of f32; up to 90 m at these entries.
                let error = (f64::from(*out) - expected).abs();
                prop_assert!(error < 3e-5, "{} {} {}", row, out, expected);
            }
        }
    }

    #[test]
    fn the_operators_sets_give_the_twins_bits(
        seed in 0u64..1000, fine in 1usize..200, coarse in 1usize..60,
    ) {
        let weights = noise(seed, fine * coarse);
        let points = noise(seed + 1, 3 * coarse);
        // Bytes, and bytes of which most are zero: panels then lack pairs of columns.
        let bytes: Vec<i16> = weights.iter().map(|w| (127.0 * w) as i16).collect();
        let near = |i: usize| (i % coarse).abs_diff(i / coarse * coarse / fine) < 3;
        let sparse: Vec<i16> =
            (0..bytes.len()).map(|i| if near(i) { bytes[i] } else { 0 }).collect();
        let ones = || vec![1.0; fine];
        for operator in [
            Operator::quantised(fine, coarse, &weights).unwrap(),
            Operator::float(fine, coarse, &weights).unwrap(),
            Operator::from_steps(coarse, &bytes, ones(), ones()).unwrap(),
            Operator::from_steps(coarse, &sparse, ones(), ones()).unwrap(),
        ] {
            let mut twin = vec![0.0; 3 * fine];
            operator.apply_with(Set::Scalar, &points, &mut twin).unwrap();
            for set in Set::available() {
                let mut out = vec![0.0; 3 * fine];
                operator.apply_with(*set, &points, &mut out).unwrap();
                prop_assert_eq!(bits(&out), bits(&twin), "{:?}", set);
            }
        }
    }
}

#[test]
fn sums_at_the_edge_of_32_bits_do_not_wrap() {
    // All entries and all coefficients at their extremes: 240 columns would sum to 2^38.
    let rows = 65;
    for entry in [i16::MIN, i16::MAX] {
        let entries = vec![entry; rows];
        let parts = [Arc::new(Panels::new(rows, &[wide(&entries, 3e-4); 240]).unwrap())];
        for c in [1.0, -1.0] {
            let coefficients = [c; 240];
            let select = Select::First(240);
            let batch = Batch { coefficients: &coefficients, stride: 240, rows: 0..rows, select };
            let expected = 240.0 * f64::from(entry) * 3e-4 * f64::from(c);
            for set in Set::available() {
                let mut out = vec![0.0; rows];
                decode(*set, &parts, None, &batch, &mut out);
                for x in &out {
                    assert!(
                        (f64::from(*x) / expected - 1.0).abs() < 1e-5,
                        "{set:?} {x} {expected}"
                    );
                }
            }
        }
    }
}

#[test]
fn coefficients_beyond_their_range_get_coarser_steps_not_another_value() {
    let sample = sample(3, 100, &[30]);
    let coefficients: Vec<f32> = noise(4, 30).iter().map(|c| c * 5.5).collect();
    let out = sample.decode(Set::detect(), &coefficients, 1);
    let largest: f64 =
        (0..100).map(|r| sample.expected(&coefficients, r).abs()).fold(0.0, f64::max);
    for (row, out) in out.iter().enumerate() {
        // Eight times a coefficient's step of 1/32,767, over 10 m of entries, for 10 wide columns.
        let error = (f64::from(*out) - sample.expected(&coefficients, row)).abs();
        assert!(error < 5e-3 && largest > 20.0, "{row}: {error}");
    }
    let mut odd = coefficients;
    (odd[3], odd[7]) = (f32::NAN, f32::INFINITY);
    assert!(sample.decode(Set::detect(), &odd, 1).iter().all(|x| x.is_finite()));
}

#[test]
fn any_rows_and_any_columns_equal_the_whole() {
    let sample = sample(8, 333, &[50, 13]);
    let mut basis = Basis::with_mean(&sample.mean);
    for (part, scale) in [(0..50, 3e-4), (50..63, 1.5e-4)] {
        let own = &sample.columns[part];
        let columns: Vec<Column<'_>> = own.iter().map(|(e, _)| wide(e, scale)).collect();
        basis.append_columns(333, &columns, std::iter::empty()).unwrap();
    }
    let coefficients = noise(9, 63);
    let mut whole = vec![0.0; 333];
    basis.reconstruct(&coefficients, 0..333, 63, &mut whole).unwrap();
    for rows in [0..1, 5..64, 63..65, 100..333, 332..333, 7..7] {
        let mut part = vec![0.0; rows.len()];
        basis.reconstruct(&coefficients, rows.clone(), 63, &mut part).unwrap();
        assert_eq!(bits(&part), bits(&whole[rows]));
    }
    let chosen = [0u16, 3, 4, 31, 49, 50, 62];
    let mut zeroed = vec![0.0; 63];
    chosen.iter().for_each(|c| zeroed[usize::from(*c)] = coefficients[usize::from(*c)]);
    let (mut some, mut expected) = (vec![0.0; 333], vec![0.0; 333]);
    basis.reconstruct(&coefficients, 0..333, Select::Only(&chosen), &mut some).unwrap();
    basis.reconstruct(&zeroed, 0..333, 63, &mut expected).unwrap();
    assert_eq!(bits(&some), bits(&expected));
    basis.reconstruct(&coefficients, 0..333, 0, &mut some).unwrap();
    assert_eq!(bits(&some), bits(&sample.mean), "without columns the mean");
}

fn wide(entries: &[i16], scale_m: f32) -> Column<'_> {
    Column { entries: Entries::Wide(entries), scale_m, limit: 1.0 }
}

#[test]
fn many_columns_go_in_several_passes() {
    let sample = sample(21, 70, &[700, 300]);
    let tenths: Vec<f32> = noise(22, 1000).iter().map(|c| c * 0.1).collect();
    let coefficients = stored(&tenths);
    let twin = sample.decode(Set::Scalar, &coefficients, 1);
    assert_eq!(bits(&sample.decode(Set::detect(), &coefficients, 1)), bits(&twin));
    for (row, out) in twin.iter().enumerate() {
        let error = (f64::from(*out) - sample.expected(&coefficients, row)).abs();
        assert!(error < 1e-3, "{row}: {error}");
    }
}

#[test]
fn what_cannot_be_laid_out_is_refused() {
    let entries = [1i16; 4];
    let column = |scale_m, limit| Column { entries: Entries::Wide(&entries), scale_m, limit };
    let bad = Panels::new(5, &[column(1.0, 1.0)]).unwrap_err();
    assert_eq!(bad, PanelsError::Rows { column: 0, actual: 4, expected: 5 });
    for (scale, limit) in [(0.0, 1.0), (1.0, -1.0), (f32::NAN, 1.0), (1e38, 1e38), (1e-38, 1e-7)] {
        let bad = Panels::new(4, &[column(1.0, 1.0), column(scale, limit)]).unwrap_err();
        assert!(matches!(bad, PanelsError::Scale { column: 1, .. }), "{bad}");
    }
    let many = vec![column(1.0, 1.0); codec::COLUMNS_MAX + 1];
    assert!(matches!(Panels::new(4, &many), Err(PanelsError::Columns(_))));
}

/// Rows that sum to 1, as an upsampling operator's do.
fn operator_weights(fine: usize, coarse: usize) -> Vec<f32> {
    let mut weights = noise(31, fine * coarse);
    for row in weights.chunks_mut(coarse) {
        row.iter_mut().for_each(|w| *w = *w * *w * *w * 0.3);
        let more = (1.0 - row.iter().sum::<f32>()) / coarse as f32;
        row.iter_mut().for_each(|w| *w += more);
    }
    weights
}

#[test]
fn the_operator_is_close_to_f64_and_moves_with_the_cloth() {
    let (fine, coarse) = (301, 97);
    let weights = operator_weights(fine, coarse);
    let points = noise(32, 3 * coarse);
    let far: Vec<f32> = points.iter().map(|p| p + 128.0).collect();
    let whole = Operator::quantised(fine, coarse, &weights).unwrap();
    let float = Operator::float(fine, coarse, &weights).unwrap();
    for (operator, most, most_far) in [(&whole, 1e-3, 1e-3), (&float, 1e-5, 2e-3)] {
        let (mut out, mut moved) = (vec![0.0; 3 * fine], vec![0.0; 3 * fine]);
        operator.apply(&points, &mut out).unwrap();
        operator.apply(&far, &mut moved).unwrap();
        for (i, (out, moved)) in out.iter().zip(&moved).enumerate() {
            let (row, axis) = (i / 3, i % 3);
            let terms = (0..coarse)
                .map(|j| f64::from(weights[row * coarse + j]) * f64::from(points[3 * j + axis]));
            let expected: f64 = terms.sum();
            assert!((f64::from(*out) - expected).abs() < most, "{i}: {out} {expected}");
            assert!((moved - 128.0 - out).abs() < most_far, "{i}: {moved} {out}");
        }
    }
}

#[test]
fn bytes_and_absent_pairs_are_the_same_operator_in_less_memory() {
    let (fine, coarse) = (500, 60);
    let near = |i: usize| (i % coarse).abs_diff(i / coarse * coarse / fine) < 6;
    let all = noise(51, fine * coarse);
    let step = |i: usize| if near(i) { (127.0 * all[i]) as i16 } else { 0 };
    let steps: Vec<i16> = (0..fine * coarse).map(step).collect();
    let (units, sums) = (vec![0.01; fine], vec![1.0; fine]);
    let narrow = Operator::from_steps(coarse, &steps, units.clone(), sums.clone()).unwrap();
    // Ten times the steps at a tenth of the unit do not fit a byte.
    let tenfold: Vec<i16> = steps.iter().map(|s| 10 * s).collect();
    let wide = Operator::from_steps(coarse, &tenfold, vec![0.001; fine], sums.clone()).unwrap();
    let dense: Vec<i16> = all.iter().map(|w| (127.0 * w) as i16).collect();
    let dense = Operator::from_steps(coarse, &dense, units, sums).unwrap();
    let [small, large, full] = [&narrow, &wide, &dense].map(Operator::resident_bytes);
    assert!(2 * small < large + 4 * fine + 4096, "{small} {large}");
    assert!(2 * small < full, "{small} {full}");
    let points = noise(52, 3 * coarse);
    let (mut a, mut b) = (vec![0.0; 3 * fine], vec![0.0; 3 * fine]);
    narrow.apply(&points, &mut a).unwrap();
    wide.apply(&points, &mut b).unwrap();
    assert!(a.iter().zip(&b).all(|(a, b)| (a - b).abs() < 1e-4));
    assert!(a.iter().any(|x| x.abs() > 0.1));
}

#[test]
fn an_operator_without_headroom_is_refused() {
    // 4 weights of 1 that each take all 16 bits sum to twice what 32 bits hold.
    let steps = [i16::MAX; 4];
    let bad = Operator::from_steps(4, &steps, vec![1.0], vec![1.0]).unwrap_err();
    assert!(matches!(bad, OperatorError::Headroom { row: 0, .. }), "{bad}");
    let mut rounded = [0i16; 4];
    let unit = quantise_row(&[1.0; 4], &mut rounded).unwrap();
    assert!(Operator::from_steps(4, &rounded, vec![unit], vec![4.0]).is_ok());
    assert!((f32::from(rounded[0]) * unit - 1.0).abs() < 1e-4);
    let operator = Operator::quantised(1, 1, &[1.0]).unwrap();
    let bad = operator.apply(&[0.0, f32::NAN, 0.0], &mut [0.0; 3]).unwrap_err();
    assert!(matches!(bad, OperatorError::NotFinite { index: 1, .. }), "{bad}");
    assert!(matches!(operator.apply(&[0.0; 3], &mut [0.0; 2]), Err(OperatorError::Length { .. })));
    assert!(matches!(Operator::float(0, 3, &[]), Err(OperatorError::Shape { .. })));
}

#[test]
fn nothing_is_allocated_per_frame() {
    let sample = sample(40, 999, &[60]);
    let coefficients = noise(41, 60 * 5);
    let mut out = vec![0.0; 999 * 5];
    let batch =
        Batch { coefficients: &coefficients, stride: 60, rows: 0..999, select: Select::First(60) };
    let operator = Operator::quantised(333, 40, &operator_weights(333, 40)).unwrap();
    let points = noise(42, 120);
    let faces = Faces::new(333, (0..331).map(|i| [i, i + 1, i + 2]).collect()).unwrap();
    let (mut fine, mut normals) = (vec![0.0; 999], vec![0.0; 999]);
    let mut frame = || {
        for set in Set::available() {
            decode(*set, &sample.parts, Some(&sample.mean), &batch, &mut out);
        }
        operator.apply(&points, &mut fine).unwrap();
        faces.normals(&fine, &mut normals).unwrap();
    };
    frame();
    assert_eq!(measure(frame).count_total, 0);
}

//! The `kim2013` bitstream: golden bytes, faults, and what decoding promises.

use codec::kim2013::{
    self, Generation, GenerationError, QuantiseError, Region, RegionError, STEP_M, Width,
};
use codec::{AppendError, Basis, COLUMNS_MAX, ReconstructError};
use proptest::prelude::*;
use rand_core::Rng;
use rand_pcg::Pcg64Mcg;

/// Numbers in -1..1, the same on every machine.
fn noise(seed: u64, count: usize) -> Vec<f32> {
    let mut rng = Pcg64Mcg::new(u128::from(seed) | 1);
    (0..count).map(|_| (rng.next_u32() >> 8) as f32 / (1 << 23) as f32 - 1.0).collect()
}

/// Columns of which every third is wide.
fn generation(seed: u64, rows: usize, columns: usize) -> (Vec<f32>, Vec<u8>) {
    let mut entries = vec![0i16; rows * columns];
    let mut column_m = noise(seed, rows * columns);
    for (c, (column, out)) in column_m.chunks_mut(rows).zip(entries.chunks_mut(rows)).enumerate() {
        let scale = if c % 3 == 0 { 0.9 } else { 0.03 };
        column.iter_mut().for_each(|v| *v *= scale);
        kim2013::quantise_column(column, STEP_M, out).unwrap();
    }
    let maxima: Vec<f32> = (0..columns).map(|c| 1.0 + c as f32).collect();
    let mut bytes = Vec::new();
    kim2013::encode_generation(rows as u32, STEP_M, &maxima, &entries, &mut bytes).unwrap();
    (column_m, bytes)
}

fn region(seed: u64, columns: usize, states: usize) -> (Vec<f32>, Vec<u8>) {
    let coefficients = noise(seed, columns * states);
    let mut steps = vec![0i16; coefficients.len()];
    kim2013::quantise_coefficients(&coefficients, &mut steps).unwrap();
    let mut bytes = Vec::new();
    kim2013::encode_region(columns, &steps, &mut bytes).unwrap();
    (coefficients, bytes)
}

#[test]
fn generation_bytes_are_golden() {
    let mut bytes = Vec::new();
    let entries = [1, -127, 128, -2];
    kim2013::encode_generation(2, 0.5, &[1.0, 2.0], &entries, &mut bytes).unwrap();
    #[rustfmt::skip]
    let golden = [
        b'T', b'k', b'B', b'g', 1, 0, 2, 0, 2, 0, 0, 0, 0, 0, 0, 0x3f,
        0, 0, 0x80, 0x3f, 0, 0, 0, 0x40, 8, 16,
        1, 0x81, 0x80, 0, 0xfe, 0xff,
    ];
    assert_eq!(bytes, golden);
    let parsed = Generation::parse(&golden).unwrap();
    assert_eq!((parsed.rows(), parsed.columns()), (2, 2));
    assert_eq!((parsed.width(0), parsed.width(1)), (Width::Bits8, Width::Bits16));
    assert_eq!(
        (parsed.maximum(1).to_bits(), parsed.step_m().to_bits()),
        (2f32.to_bits(), 0x3f00_0000)
    );
}

#[test]
fn region_bytes_are_golden() {
    let mut bytes = Vec::new();
    kim2013::encode_region(2, &[32_767, -1, 0, -32_767], &mut bytes).unwrap();
    let golden = [1, 0, 2, 0, 2, 0, 0xff, 0x7f, 0xff, 0xff, 0, 0, 1, 0x80];
    assert_eq!(bytes, golden);
    let mut out = [9.0; 3];
    Region::parse(&golden).unwrap().state(1, &mut out);
    assert_eq!(out.map(f32::to_bits), [0.0f32, -1.0, 0.0].map(f32::to_bits));
}

#[test]
fn every_truncation_is_refused() {
    let (_, bytes) = generation(1, 70, 5);
    for end in 0..bytes.len() {
        assert!(Generation::parse(&bytes[..end]).is_err(), "generation cut at {end}");
    }
    let (_, bytes) = region(2, 5, 3);
    for end in 0..bytes.len() {
        assert!(Region::parse(&bytes[..end]).is_err(), "region cut at {end}");
    }
}

#[test]
fn extra_bytes_are_refused() {
    let (_, mut bytes) = generation(1, 70, 5);
    bytes.push(0);
    assert!(matches!(Generation::parse(&bytes), Err(GenerationError::Length { .. })));
    let (_, mut bytes) = region(2, 5, 3);
    bytes.push(0);
    assert!(matches!(Region::parse(&bytes), Err(RegionError::Length { .. })));
}

#[test]
fn every_flipped_byte_is_survived() {
    let (_, bytes) = generation(3, 70, 4);
    let (_, coded) = region(4, 4, 3);
    let mut out = vec![0.0; 70];
    for at in 0..bytes.len() {
        for flip in [0x01, 0x80, 0xff] {
            let mut bytes = bytes.clone();
            bytes[at] ^= flip;
            let Ok(parsed) = Generation::parse(&bytes) else { continue };
            let mut basis = Basis::new();
            basis.append(&parsed).unwrap();
            basis.reconstruct(&[0.5; 4], 0..70, 4, &mut out).unwrap();
        }
    }
    for at in 0..coded.len() {
        for flip in [0x01, 0x80, 0xff] {
            let mut coded = coded.clone();
            coded[at] ^= flip;
            let Ok(parsed) = Region::parse(&coded) else { continue };
            let mut out = vec![0.0; parsed.columns()];
            (0..parsed.states()).for_each(|state| parsed.state(state, &mut out));
        }
    }
}

#[test]
fn malformed_headers_are_named() {
    let (_, bytes) = generation(5, 70, 4);
    let with = |at: usize, value: u8| {
        let mut bytes = bytes.clone();
        bytes[at] = value;
        Generation::parse(&bytes).map(|_| ()).unwrap_err()
    };
    assert!(matches!(with(0, b'X'), GenerationError::Magic(_)));
    assert_eq!(with(4, 9), GenerationError::Version(9));
    assert!(matches!(with(7, 0xff), GenerationError::Shape { .. }));
    assert!(matches!(with(11, 0xff), GenerationError::Shape { .. }));
    assert!(matches!(with(15, 0xbf), GenerationError::Step(_)));
    assert!(matches!(with(19, 0xff), GenerationError::Maximum { column: 0, .. }));
    assert!(matches!(with(16 + 16, 12), GenerationError::Width { column: 0, bits: 12 }));
    assert_eq!(Region::parse(&[2, 0, 1, 0, 1, 0, 0, 0]).unwrap_err(), RegionError::Version(2));
    let states = Region::parse(&[1, 0, 1, 0, 33, 0, 0, 0]).unwrap_err();
    assert_eq!(states, RegionError::Shape { states: 33, columns: 1 });
}

#[test]
fn what_is_not_finite_is_refused() {
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let column = kim2013::quantise_column(&[0.0, value], STEP_M, &mut [0; 2]);
        assert!(matches!(column, Err(QuantiseError::NotFinite { index: 1, .. })));
        let row = kim2013::quantise_coefficients(&[0.0, value], &mut [0; 2]);
        assert!(matches!(row, Err(QuantiseError::NotFinite { index: 1, .. })));
        assert!(matches!(
            kim2013::encode_generation(1, STEP_M, &[value], &[0], &mut Vec::new()),
            Err(GenerationError::Maximum { column: 0, .. })
        ));
    }
    let beyond = kim2013::quantise_coefficients(&[1.001], &mut [0; 1]);
    assert!(matches!(beyond, Err(QuantiseError::OutOfRange { index: 0, .. })));
    let beyond = kim2013::quantise_column(&[9.9], STEP_M, &mut [0; 1]);
    assert!(matches!(beyond, Err(QuantiseError::OutOfRange { index: 0, .. })));
}

#[test]
fn a_generation_that_does_not_fit_is_refused() {
    let mut basis = Basis::new();
    basis.append(&Generation::parse(&generation(1, 70, 4).1).unwrap()).unwrap();
    let other = generation(1, 71, 4).1;
    let refused = basis.append(&Generation::parse(&other).unwrap());
    assert_eq!(refused, Err(AppendError::Rows { expected: 70, actual: 71 }));
    let many = generation(1, 70, COLUMNS_MAX - 3).1;
    let refused = basis.append(&Generation::parse(&many).unwrap());
    assert_eq!(refused, Err(AppendError::Columns(COLUMNS_MAX + 1)));
    assert_eq!(basis.columns(), 4);
}

#[test]
fn a_caller_that_asks_for_too_much_is_told() {
    let mut basis = Basis::new();
    basis.append(&Generation::parse(&generation(1, 70, 4).1).unwrap()).unwrap();
    let mut out = vec![0.0; 70];
    let rows = basis.reconstruct(&[0.0; 4], 0..71, 4, &mut out);
    assert!(matches!(rows, Err(ReconstructError::Rows { .. })));
    let columns = basis.reconstruct(&[0.0; 5], 0..70, 5, &mut out);
    assert!(matches!(columns, Err(ReconstructError::Columns { .. })));
    let given = basis.reconstruct(&[0.0; 3], 0..70, 4, &mut out);
    assert!(matches!(given, Err(ReconstructError::Columns { .. })));
    let short = basis.reconstruct(&[0.0; 4], 0..70, 4, &mut out[1..]);
    assert!(matches!(short, Err(ReconstructError::Output { .. })));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn decoding_comes_within_the_stated_step(
        seed in any::<u64>(), vertices in 1usize..90, first in 1usize..9, second in 1usize..9,
    ) {
        let rows = 3 * vertices;
        let columns = first + second;
        let (mut exact, bytes) = generation(seed, rows, first);
        let mut basis = Basis::new();
        basis.append(&Generation::parse(&bytes).unwrap()).unwrap();
        let (appended, bytes) = generation(seed ^ 77, rows, second);
        basis.append(&Generation::parse(&bytes).unwrap()).unwrap();
        exact.extend(appended);
        let (coefficients, bytes) = region(seed, columns, 1);
        let mut decoded = vec![0.0; columns];
        Region::parse(&bytes).unwrap().state(0, &mut decoded);
        let mut out = vec![0.0; rows];
        basis.reconstruct(&decoded, 0..rows, columns, &mut out).unwrap();
        for (row, out) in out.iter().enumerate() {
            let sum: f32 = (0..columns).map(|c| coefficients[c] * exact[c * rows + row]).sum();
            let bound = columns as f32 * (0.5 * STEP_M + 0.9 / kim2013::FULL_SCALE);
            prop_assert!((sum - out).abs() <= bound, "row {}: {} for {}", row, out, sum);
        }
    }

    #[test]
    fn parts_and_batches_equal_the_whole(
        seed in any::<u64>(), rows in 1usize..300, cut in 0usize..300, columns in 1usize..9,
    ) {
        let mut basis = Basis::new();
        basis.append(&Generation::parse(&generation(seed, rows, 5).1).unwrap()).unwrap();
        basis.append(&Generation::parse(&generation(seed ^ 5, rows, 4).1).unwrap()).unwrap();
        let (coefficients, _) = region(seed, 9, 2);
        let mut whole = vec![0.0; 2 * rows];
        let (one, two) = whole.split_at_mut(rows);
        basis.reconstruct(&coefficients[..9], 0..rows, columns, one).unwrap();
        basis.reconstruct(&coefficients[9..], 0..rows, columns, two).unwrap();
        let cut = cut % (rows + 1);
        let mut part = vec![0.0; rows - cut];
        basis.reconstruct(&coefficients[..9], cut..rows, columns, &mut part).unwrap();
        prop_assert_eq!(&part[..], &whole[cut..rows]);
        let mut batch = vec![0.0; 2 * rows];
        basis.reconstruct_batch(&coefficients, 9, 0..rows, columns, &mut batch).unwrap();
        prop_assert_eq!(&batch, &whole);
        let mut zeroed = coefficients[..9].to_vec();
        zeroed[columns..].fill(0.0);
        basis.reconstruct(&zeroed, 0..rows, 9, &mut part[..0]).unwrap_err();
        let mut prefix = vec![0.0; rows];
        basis.reconstruct(&zeroed, 0..rows, 9, &mut prefix).unwrap();
        prop_assert_eq!(&prefix[..], &whole[..rows]);
    }

    #[test]
    fn garbage_is_survived(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
        let _ = Generation::parse(&bytes);
        let _ = Region::parse(&bytes);
    }
}

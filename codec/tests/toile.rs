//! The `toile` bitstream: golden bytes, faults, and what decoding promises.

use codec::toile::{
    self, Column, Fix, Generation, GenerationParts, Model, PARENTS, RegionParts, TIERS, Tree,
    encode_generation, encode_region, parse_generation, parse_region,
};
use proptest::prelude::*;
use rand_core::Rng;
use rand_pcg::Pcg64Mcg;

fn noise(seed: u64, count: usize) -> Vec<f32> {
    let mut rng = Pcg64Mcg::new(u128::from(seed) | 1);
    (0..count).map(|_| (rng.next_u32() >> 8) as f32 / (1 << 23) as f32 - 1.0).collect()
}

fn column(maximum_m: f32, multiple: u8) -> Column {
    let size = Column::size_code(f64::from(maximum_m) * 0.05);
    let sizes = [Column::size_code(f64::from(maximum_m) * 0.3), size, size];
    let after_two = [Column::factor(1.6), Column::factor(-0.7)];
    Column { maximum_m, multiple, sizes, after_one: Column::factor(0.9), after_two }
}

fn columns(count: usize) -> Vec<Column> {
    (0..count).map(|c| column(3.0 / (1.0 + c as f32), 1 + (c % 3) as u8)).collect()
}

/// A tree with parents all over the place.
fn tree(vertices: usize) -> Tree {
    let order: Vec<u32> = (0..vertices as u32).rev().collect();
    let parent = |place: usize, k: usize| (place * (k + 3) / 7) as u32 % place.max(1) as u32;
    let parents = (0..vertices).map(|p| [0, 1, 2, 3].map(|k| parent(p, k))).collect();
    assert_eq!(PARENTS, 4);
    Tree::new(order, parents).unwrap()
}

fn generation_bytes(seed: u64, vertices: usize, count: usize, with_tree: bool) -> Vec<u8> {
    let (columns, tree) = (columns(count), tree(vertices));
    let values_m: Vec<f32> = noise(seed, 3 * vertices * count).iter().map(|x| 0.05 * x).collect();
    let parts = GenerationParts {
        step_m: 2e-4,
        columns: &columns,
        values_m: &values_m,
        step: 40,
        states: 77,
        rms_m: 0.003,
        tree: &tree,
        with_tree,
    };
    let mut bytes = Vec::new();
    encode_generation(&parts, &mut bytes).unwrap();
    let generation = parse_generation(&bytes, Some(&tree)).unwrap();
    for (c, (column, values)) in columns.iter().zip(values_m.chunks(3 * vertices)).enumerate() {
        let rounding_m = 0.5001 * f32::from(column.multiple) * 2e-4;
        let entries = &generation.entries()[c * 3 * vertices..];
        for (value, entry) in values.iter().zip(entries) {
            assert!((value - f32::from(*entry) * 2e-4).abs() <= rounding_m, "column {c}");
        }
    }
    bytes
}

fn model(vertices: usize, count: usize) -> Model {
    let mut model = Model::new(vertices);
    assert!(model.append(&columns(count)));
    model
}

fn fixes() -> Vec<Fix> {
    let fix = |state, vertex, steps| Fix { state, vertex, steps };
    vec![fix(0, 3, [1, 0, -2]), fix(0, 9, [0, 0, 1]), fix(2, 0, [-400, 1, 70_000])]
}

fn region_bytes(model: &Model, seed: u64, states: usize, fixes: &[Fix]) -> (Vec<i32>, Vec<u8>) {
    let columns = model.columns().len();
    let scale = |(i, x): (usize, f32)| (x * 2000.0 / (1 + i % columns) as f32).round() as i32;
    let mut coefficients: Vec<i32> =
        noise(seed, columns * states).into_iter().enumerate().map(scale).collect();
    coefficients.iter_mut().skip(columns / 2).step_by(columns).for_each(|q| *q = 0);
    let parts = RegionParts {
        columns,
        step: 40,
        coefficients: &coefficients,
        fix_step: 30,
        fixes,
        tier_errors_m: [0.04, 0.03, 0.02, 0.01],
        leading_error_m: 0.035,
    };
    let mut bytes = Vec::new();
    encode_region(model, &parts, &mut bytes).unwrap();
    (coefficients, bytes)
}

#[test]
fn generation_bytes_are_golden() {
    let tree = Tree::sequence(2);
    let parts = GenerationParts {
        step_m: 0.5,
        columns: &[column(1.0, 1)],
        values_m: &[1.0, -2.0, 0.5, 1.0, -2.5, 0.0],
        step: 9,
        states: 5,
        rms_m: 0.25,
        tree: &tree,
        with_tree: true,
    };
    let mut bytes = Vec::new();
    encode_generation(&parts, &mut bytes).unwrap();
    let parsed = parse_generation(&bytes, None).unwrap();
    assert_eq!(parsed.entries(), [2, -4, 1, 2, -5, 0]);
    assert_eq!((parsed.states(), parsed.step(), parsed.tree()), (5, 9, Some(&tree)));
    assert_eq!(hex(&bytes), GOLDEN_GENERATION);
}

#[test]
fn region_bytes_are_golden() {
    let model = model(10, 2);
    let parts = RegionParts {
        columns: 2,
        step: 40,
        coefficients: &[100, -3, 90, 0, 70, 5],
        fix_step: 30,
        fixes: &fixes(),
        tier_errors_m: [0.001; TIERS.len()],
        leading_error_m: 0.002,
    };
    let mut bytes = Vec::new();
    encode_region(&model, &parts, &mut bytes).unwrap();
    let parsed = parse_region(&bytes, &model).unwrap();
    let full = |q: f64, maximum: f64| {
        (q * f64::from(toile::step_m(40)) * 32_767.0 / maximum).round() as i16
    };
    let expected = [100.0, -3.0, 90.0, 0.0, 70.0, 5.0].map(|q| q);
    for (i, (q, c)) in expected.iter().zip(parsed.coefficients()).enumerate() {
        assert_eq!(*c, full(*q, if i % 2 == 0 { 3.0 } else { 1.5 }), "coefficient {i}");
    }
    assert_eq!(parsed.fixes(), fixes());
    let leading_m = parsed.leading_error_m().unwrap();
    assert!((0.002..0.0022).contains(&leading_m), "{leading_m}");
    assert_eq!(hex(&bytes), GOLDEN_REGION);
    // Regions of version 1 stay readable for ever.
    let old: Vec<u8> = (0..GOLDEN_REGION_1.len() / 2)
        .map(|at| u8::from_str_radix(&GOLDEN_REGION_1[2 * at..2 * at + 2], 16).unwrap())
        .collect();
    let old = parse_region(&old, &model).unwrap();
    assert_eq!((old.coefficients(), old.fixes()), (parsed.coefficients(), parsed.fixes()));
    assert_eq!((old.tier_errors_m(), old.leading_error_m()), (parsed.tier_errors_m(), None));
}

const GOLDEN_GENERATION: &str = "5474426701000100060000000000003f0109000006000000050000000000803e\
    0000803f01493e3e660e9a19cdf47ffffb3ca70b";
const GOLDEN_REGION_1: &str =
    "0100020003281e010900090009000900150022852512b939a33eb9810ab46e754a69bb4e9a1d58";
const GOLDEN_REGION: &str =
    "0200020003281e0109000900090009001100150022852512b939a33eb9810ab46e754a69bb4e9a1d58";

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

#[test]
fn every_truncation_is_refused() {
    let bytes = generation_bytes(1, 40, 3, true);
    for end in 0..bytes.len() {
        assert!(parse_generation(&bytes[..end], None).is_err(), "generation cut at {end}");
    }
    let model = model(10, 6);
    let (_, bytes) = region_bytes(&model, 2, 3, &fixes());
    for end in 0..bytes.len() {
        assert!(parse_region(&bytes[..end], &model).is_err(), "region cut at {end}");
    }
}

#[test]
fn every_flipped_byte_is_survived() {
    let model = model(10, 6);
    let (_, bytes) = region_bytes(&model, 2, 3, &fixes());
    let generation = generation_bytes(1, 40, 3, true);
    let mut positions = [0.0; 30];
    for flip in [1u8, 0x80, 0xff] {
        for at in 0..bytes.len() {
            let mut broken = bytes.clone();
            broken[at] ^= flip;
            if let Ok(region) = parse_region(&broken, &model) {
                assert_eq!(region.coefficients().len(), region.states() * region.columns());
                (0..region.states()).for_each(|state| region.fix(state, &mut positions));
            }
        }
        for at in 0..generation.len() {
            let mut broken = generation.clone();
            broken[at] ^= flip;
            if let Ok(read) = parse_generation(&broken, None) {
                assert_eq!(read.entries().len(), read.rows() * read.columns().len());
                read.to_resident();
            }
        }
    }
}

#[test]
fn an_appended_generation_needs_the_first_ones_order() {
    let bytes = generation_bytes(5, 12, 2, false);
    let refused = |tree: Option<&Tree>| parse_generation(&bytes, tree).unwrap_err().to_string();
    assert!(refused(None).contains("order of the first"));
    assert!(refused(Some(&Tree::sequence(11))).contains("11 vertices"));
}

#[test]
fn who_knows_the_leading_columns_reads_these() {
    let whole = model(10, 6);
    let (_, bytes) = region_bytes(&whole, 2, 5, &fixes());
    let all = parse_region(&bytes, &whole).unwrap();
    let part = parse_region(&bytes, &model(10, 4)).unwrap();
    assert!(all.is_whole() && !part.is_whole());
    assert_eq!((part.columns(), part.fixes().len()), (4, 0));
    for (part, all) in part.coefficients().chunks(4).zip(all.coefficients().chunks(6)) {
        assert_eq!(part, &all[..4]);
    }
}

#[test]
fn what_does_not_fit_is_refused() {
    let model = model(10, 2);
    let parts = RegionParts {
        columns: 2,
        step: 40,
        coefficients: &[1, 2],
        fix_step: 30,
        fixes: &[],
        tier_errors_m: [0.0; TIERS.len()],
        leading_error_m: 9.0,
    };
    let refused = |parts: RegionParts<'_>| encode_region(&model, &parts, &mut Vec::new()).is_err();
    assert!(!refused(parts));
    assert!(refused(RegionParts { columns: 3, coefficients: &[1, 2, 3], ..parts }));
    assert!(refused(RegionParts { coefficients: &[1, 2, 3], ..parts }));
    assert!(refused(RegionParts { coefficients: &[i32::MIN, 2], ..parts }));
    let fix = Fix { state: 0, vertex: 10, steps: [0; 3] };
    assert!(refused(RegionParts { fixes: &[fix], ..parts }));
    let fix = Fix { state: 0, vertex: 9, steps: [0; 3] };
    assert!(refused(RegionParts { fixes: &[fix, fix], ..parts }));
    assert!(Tree::new(vec![0, 0], vec![[0; 4]; 2]).is_err());
    assert!(Tree::new(vec![0, 1], vec![[0; 4], [1, 0, 0, 0]]).is_err());
}

proptest! {
    #[test]
    fn coefficients_come_back(seed in any::<u64>(), states in 1usize..=32, count in 1usize..9) {
        let model = model(10, count);
        let (coefficients, bytes) = region_bytes(&model, seed, states, &[]);
        let region = parse_region(&bytes, &model).unwrap();
        prop_assert_eq!((region.states(), region.columns()), (states, count));
        for (at, (q, c)) in coefficients.iter().zip(region.coefficients()).enumerate() {
            let maximum_m = f64::from(model.columns()[at % count].maximum_m);
            let full = f64::from(*q) * f64::from(toile::step_m(40)) * 32_767.0 / maximum_m;
            prop_assert!((full.clamp(-32_767.0, 32_767.0) - f64::from(*c)).abs() <= 0.51);
        }
    }

    #[test]
    fn any_bytes_are_survived(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
        let model = model(10, 3);
        let _ = parse_region(&bytes, &model);
        let mut header = b"TtBg\x01\x00\x02\x00\x1e\x00\x00\x00".to_vec();
        header.extend_from_slice(&bytes);
        let _: Result<Generation, _> = parse_generation(&header, Some(&tree(10)));
    }
}

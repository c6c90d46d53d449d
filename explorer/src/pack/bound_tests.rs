//! Profile `toile` keeps to its bound, whatever the states.

use proptest::prelude::*;

use super::bench::{Bench, BenchError, Measured, Source};
use super::design::Bound;

fn clock() -> f64 {
    0.0
}

/// Encodes states of `vertices` in regions of 20 and checks both bounds on what is decoded.
fn kept(states: Vec<f32>, vertices: usize, bound: Bound) -> Measured {
    let source = Source::from_memory(states, vertices, 20);
    let bench = Bench::new(&source, &clock, &|_| {}).unwrap();
    let measured = bench.toile("toile", bound).unwrap();
    if let Some(max_m) = bound.max_m {
        assert!(measured.max_m <= f64::from(max_m), "{bound:?}: {measured:?}");
    }
    if let Some(rms_m) = bound.rms_m {
        assert!(measured.rms_m <= f64::from(rms_m), "{bound:?}: {measured:?}");
    }
    measured
}

fn bounds() -> [Bound; 4] {
    let bound = |max_m, rms_m| Bound { max_m, rms_m };
    [
        bound(Some(0.01), None),
        bound(None, Some(0.002)),
        bound(Some(0.004), Some(0.001)),
        bound(Some(0.0005), Some(0.0001)),
    ]
}

fn wave(vertices: usize, states: usize) -> Vec<f32> {
    let row = |t: usize, row: usize| {
        let (t, x) = (t as f32 * 0.2, row as f32 / (3 * vertices) as f32);
        let bend = |k: f32| (k * t + k).sin() * (7.0 * k * x).sin() * 0.2 / (k * k);
        (5.0 * x).cos() + bend(1.0) + bend(2.0) + bend(3.0) + bend(4.0)
    };
    (0..states).flat_map(|t| (0..3 * vertices).map(move |r| row(t, r))).collect()
}

#[test]
fn smooth_states_are_kept_and_cheap() {
    for bound in bounds() {
        let measured = kept(wave(60, 200), 60, bound);
        assert!(measured.bytes_per_frame < 200.0, "{measured:?}");
    }
}

#[test]
fn a_single_spiking_vertex_is_kept() {
    let (vertices, states) = (50, 120);
    let mut spiking = wave(vertices, states);
    for t in 0..states {
        // A new vertex every time, so that no column can hold it.
        spiking[3 * (t * vertices + (t * 7) % vertices) + t % 3] += 0.7;
    }
    bounds().into_iter().for_each(|bound| {
        kept(spiking.clone(), vertices, bound);
    });
}

#[test]
fn still_states_one_state_and_one_vertex_are_kept() {
    for bound in bounds() {
        kept(wave(30, 1).repeat(50), 30, bound);
        kept(wave(30, 1), 30, bound);
        kept(wave(1, 90), 1, bound);
        kept(wave(1, 1), 1, bound);
    }
}

#[test]
fn what_is_not_finite_or_no_bound_is_refused() {
    let mut states = wave(10, 30);
    let source = Source::from_memory(states.clone(), 10, 20);
    let bench = Bench::new(&source, &clock, &|_| {}).unwrap();
    let refused = bench.toile("x", Bound { max_m: Some(0.0), rms_m: None });
    assert!(refused.unwrap_err().to_string().contains("0.01 mm"));
    states[77] = f32::NAN;
    let source = Source::from_memory(states, 10, 20);
    let Err(BenchError::Encode(error)) = Bench::new(&source, &clock, &|_| {}) else {
        panic!("not a number, and taken");
    };
    assert!(error.to_string().contains("state 2"), "{error}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]
    #[test]
    fn random_states_are_kept(
        states in proptest::collection::vec(-1.5f32..1.5, 60 * 12..60 * 13),
        bound in 0usize..4,
    ) {
        let whole = states.len() / 36 * 36;
        kept(states[..whole].to_vec(), 12, bounds()[bound]);
    }
}

use codec::kim2013::Region;

use super::columns;
use super::encode::{EncodeError, EncodeSettings, Encoder};

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
        (0..10).try_for_each(|r| show(&region(20 * r, 0.0)))
    };
    let settings = EncodeSettings::for_rank(rank);
    let made = columns::first_generations(ROWS, 200, &settings, &mut visit).unwrap();
    let mut encoder = Encoder::new(&settings);
    made.iter().for_each(|bytes| encoder.append(bytes).unwrap());
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
    let mut visit = |show: &mut dyn FnMut(&[f32]) -> Result<(), EncodeError>| show(&rest);
    let settings = EncodeSettings::for_rank(20);
    let made = columns::appended_generation(ROWS, 8, &settings, None, &mut visit);
    let bytes = made.unwrap().unwrap();
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

#[test]
fn any_number_of_workers_encode_equal_bytes() {
    use super::design::Bound;
    for settings in [
        EncodeSettings::for_rank(6),
        EncodeSettings::for_bound(Bound { max_m: Some(0.001), rms_m: None }),
    ] {
        let mut visit = |show: &mut dyn FnMut(&[f32]) -> Result<(), EncodeError>| {
            (0..10).try_for_each(|r| show(&region(20 * r, 0.0)))
        };
        let made = columns::first_generations(ROWS, 200, &settings, &mut visit).unwrap();
        let mut encoder = Encoder::new(&settings);
        made.iter().for_each(|bytes| encoder.append(bytes).unwrap());
        let encode = |encoder: &Encoder, from: usize| encoder.region(&region(from, 0.05)).unwrap();
        let alone: Vec<_> = (0..12).map(|from| encode(&encoder, 15 * from)).collect();
        std::thread::scope(|scope| {
            let workers: Vec<_> = (0..4)
                .map(|worker| {
                    let encoder = encoder.clone();
                    scope.spawn(move || {
                        let own = (worker..12).step_by(4);
                        own.map(|from| (from, encode(&encoder, 15 * from))).collect::<Vec<_>>()
                    })
                })
                .collect();
            for worker in workers {
                for (from, region) in worker.join().unwrap() {
                    assert_eq!(region, alone[from], "region {from}");
                }
            }
        });
    }
}

//! Prints what packing costs on made-up states: `cargo run --release -p explorer --example
//! pack_time [VERTICES STATES RANK]`.

use std::time::Instant;

use explorer::pack::basis::StreamingSvd;
use explorer::pack::encode::{self, Encoder};
use rand_core::Rng;
use rand_pcg::Pcg64Mcg;

/// Combinations of 400 shapes of falling size that swing at their own rates.
fn made_up(rows: usize, states: usize) -> Vec<Vec<f32>> {
    const SHAPES: usize = 400;
    let mut rng = Pcg64Mcg::new(1);
    let mut unit = move || (rng.next_u32() >> 8) as f32 / (1 << 23) as f32 - 1.0;
    let shapes: Vec<f32> = (0..SHAPES * rows).map(|_| unit()).collect();
    let rates: Vec<f32> = (0..SHAPES).map(|_| unit()).collect();
    let state = |t: usize| {
        let mut state = vec![0.0; rows];
        for (k, shape) in shapes.chunks(rows).enumerate() {
            let size = 0.5 / (1.0 + k as f32).powf(1.5) * (rates[k] * t as f32 * 0.3).cos();
            state.iter_mut().zip(shape).for_each(|(out, x)| *out += size * x);
        }
        state
    };
    (0..states).map(state).collect()
}

fn main() {
    let arguments: Vec<usize> = std::env::args().skip(1).filter_map(|a| a.parse().ok()).collect();
    let [vertices, states, rank] = *arguments else {
        return measure(5_000, 700, 200);
    };
    measure(vertices, states, rank);
}

fn measure(vertices: usize, states: usize, rank: usize) {
    let rows = 3 * vertices;
    let all = made_up(rows, states);
    let start = Instant::now();
    let mut svd = StreamingSvd::new(rows, rank);
    all.iter().for_each(|state| svd.push(state).expect("finite states"));
    let columns = svd.finish().expect("finite states").columns.ncols();
    let svd_s = start.elapsed().as_secs_f64();

    let start = Instant::now();
    let mut visit = |show: &mut dyn FnMut(&[f32]) -> Result<(), encode::EncodeError>| {
        all.iter().try_for_each(|state| show(state))
    };
    let bytes = encode::generation(rows, rank, 1.5, &mut visit).expect("finite").expect("extent");
    let generation_s = start.elapsed().as_secs_f64();

    let start = Instant::now();
    let mut encoder = Encoder::new();
    encoder.append(&bytes).expect("just made");
    let regions = all.chunks(20).map(|states| encoder.region(&states.concat()).expect("a region"));
    let worst_m = regions.map(|region| region.max_error_m).fold(0.0, f32::max);
    println!(
        "{vertices} vertices, {states} states: {columns} columns in {svd_s:.2} s; generation of \
         {} columns, {} bytes in {generation_s:.2} s; regions {:.2} ms a state, worst {:.2} mm",
        encoder.basis().columns(),
        bytes.len(),
        start.elapsed().as_secs_f64() / states as f64 * 1e3,
        worst_m * 1e3,
    );
}

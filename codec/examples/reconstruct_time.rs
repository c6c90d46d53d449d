//! Prints the time of one reconstruction: `cargo run --release -p codec --example
//! reconstruct_time [ROWS COLUMNS CHARACTERS]`. A third of the columns is 16 bits wide.

use std::time::Instant;

use codec::kim2013::{self, Generation};
use codec::{Basis, kernel};

fn main() {
    let arguments: Vec<usize> = std::env::args().skip(1).filter_map(|a| a.parse().ok()).collect();
    let [rows, columns, characters] = *arguments else {
        return measure(15_000, 200, 1);
    };
    measure(rows, columns, characters);
}

fn measure(rows: usize, columns: usize, characters: usize) {
    let wide = |c: usize| if c.is_multiple_of(3) { 3000 } else { 100 };
    let entry = |i: usize| ((i * 7919) % 199) as i16 * wide(i / rows) / 199;
    let entries: Vec<i16> = (0..rows * columns).map(entry).collect();
    let mut bytes = Vec::new();
    let maxima = vec![1.0; columns];
    kim2013::encode_generation(rows as u32, kim2013::STEP_M, &maxima, &entries, &mut bytes)
        .expect("a shape within the limits");
    let mut basis = Basis::new();
    basis.append(&Generation::parse(&bytes).expect("just encoded")).expect("first generation");
    let coefficients = vec![0.25; columns * characters];
    let mut out = vec![0.0; rows * characters];
    let mut times_us: Vec<f64> = (0..400)
        .map(|_| {
            let start = Instant::now();
            basis
                .reconstruct_batch(&coefficients, columns, 0..rows, columns, &mut out)
                .expect("matching shapes");
            start.elapsed().as_secs_f64() * 1e6
        })
        .collect();
    times_us.sort_by(f64::total_cmp);
    println!(
        "{:?}: {rows} rows x {columns} columns x {characters} characters, {} bytes: p50 {:.0} us, \
         p99 {:.0} us",
        kernel::Set::detect(),
        basis.resident_bytes(),
        times_us[200],
        times_us[396],
    );
}

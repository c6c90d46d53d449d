//! Prints what the skirt's operator of Kavan et al. 2011 takes, 7,016 x 196, in 16 bits and in 8, and
//! in 8 bits with 24 coarse points a row: called back to back, and with 256 MiB of other memory read
//! before each call. Beside it, what reading as many bytes takes at the speed at which that memory
//! was read: `cargo run --release -p codec --example operator_time`.

use std::hint::black_box;
use std::time::Instant;

use codec::kernel::operator::{Operator, OperatorError};
use codec::kernel::read::{Reader, memory, read};

/// Coarse points.
const COARSE: usize = 196;

fn main() -> Result<(), OperatorError> {
    let fine = std::env::args().nth(1).and_then(|n| n.parse().ok()).unwrap_or(7_016);
    let step = |i: usize, most: i16| ((i * 7_919) % (2 * most as usize + 1)) as i16 - most;
    let near = |i: usize| {
        let (row, column) = (i / COARSE, i % COARSE);
        (column + COARSE - row * COARSE / fine).is_multiple_of(8)
    };
    let count = fine * COARSE;
    let forms: [(&str, Vec<i16>); 3] = [
        ("16 bits", (0..count).map(|i| step(i, 300)).collect()),
        ("8 bits", (0..count).map(|i| step(i, 127)).collect()),
        ("8 bits, sparse", (0..count).map(|i| if near(i) { step(i, 127) } else { 0 }).collect()),
    ];
    let points: Vec<f32> = (0..3 * COARSE).map(|i| (i as f32 * 0.37).sin()).collect();
    let mut out = vec![0.0; 3 * fine];
    let other = memory(256);
    for (name, steps) in forms {
        let operator = Operator::from_steps(COARSE, &steps, vec![1e-4; fine], vec![1.0; fine])?;
        let bytes = operator.resident_bytes();
        let mut time = |cold: bool, calls: usize| -> Result<Vec<f64>, OperatorError> {
            let mut times_us = Vec::new();
            for _ in 0..calls {
                if cold {
                    black_box(read(Reader::FourAhead, &other));
                }
                let start = Instant::now();
                operator.apply(&points, &mut out)?;
                times_us.push(start.elapsed().as_secs_f64() * 1e6);
            }
            times_us.sort_by(f64::total_cmp);
            Ok(times_us)
        };
        for _ in 0..3 {
            let (hot, cold) = (time(false, 2_000)?, time(true, 60)?);
            let start = Instant::now();
            black_box(read(Reader::FourAhead, &other));
            let bytes_us = 256.0 * 1_048_576.0 / (start.elapsed().as_secs_f64() * 1e6);
            println!(
                "{name}, {:.2} MB: hot p10 {:.0}, p50 {:.0} us; cold p10 {:.0}, p50 {:.0} us; at the \
                 {:.1} GB/s of other memory {:.0} us",
                bytes as f64 * 1e-6,
                hot[200],
                hot[1_000],
                cold[6],
                cold[30],
                bytes_us * 1e-3,
                bytes as f64 / bytes_us
            );
        }
    }
    Ok(())
}

//! Prints what the skirt's operator of Kavan et al. 2011 takes, 7,016 x 196, called back to back and
//! with 256 MiB of other memory read before each call: `cargo run --release -p codec --example
//! operator_time`.

use std::hint::black_box;
use std::time::Instant;

use codec::kernel::operator::{Operator, OperatorError};
use codec::kernel::read::{Reader, memory, read};

fn main() -> Result<(), OperatorError> {
    let fine = std::env::args().nth(1).and_then(|n| n.parse().ok()).unwrap_or(7_016);
    let coarse = 196;
    let weight = |i: usize| ((i * 7_919) % 2_003) as f32 / 2_003.0 / coarse as f32;
    let weights: Vec<f32> = (0..fine * coarse).map(weight).collect();
    let operator = Operator::quantised(fine, coarse, &weights)?;
    let points: Vec<f32> = (0..3 * coarse).map(|i| (i as f32 * 0.37).sin()).collect();
    let mut out = vec![0.0; 3 * fine];
    let other = memory(256);
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
        let gb_s = 256.0 * 1.048_576e-3 / start.elapsed().as_secs_f64();
        println!(
            "hot p10 {:.0}, p50 {:.0} us; cold p10 {:.0}, p50 {:.0} us; other memory {gb_s:.1} GB/s",
            hot[200], hot[1_000], cold[6], cold[30]
        );
    }
    Ok(())
}

//! Solves the Laplacian operator's aggregate system (Kavan et al. 2011, section 3.2) on a scene and
//! prints processor time and error as they come down, beside those of the equivalent fast form:
//! `cargo run --release -p explorer --example aggregate_laplacian -- curtain [SECONDS] [WORK FOLDER]`.
//! It stops at that much processor time (default 600 s), or where the error is within 1 % of the exact one.

use std::path::PathBuf;

use explorer::cpu::CpuClock;
use explorer::upsample::cache::Cache;
use explorer::upsample::data::narrow;
use explorer::upsample::learn::{HARMONICS, Lesson, Tests};
use faer::Mat;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut words = std::env::args().skip(1);
    let scene = words.next().unwrap_or_else(|| "curtain".into());
    let limit_s: f64 = words.next().map_or(Ok(600.0), |word| word.parse())?;
    let work = PathBuf::from(words.next().unwrap_or_else(|| "work/upsample".into()));
    let lesson = Lesson::new(
        &scene,
        usize::MAX,
        HARMONICS,
        Tests::Harmonic,
        &Cache::new(&work),
        &mut |_, _, _| (),
    )?;
    let errors = |operator: &Mat<f32>| -> Vec<f64> {
        let rms = |frames: &explorer::upsample::data::Frames| {
            let off = operator * narrow(frames.coarse.as_ref()) - &frames.fine;
            let count = (off.nrows() * frames.count()) as f64;
            1e3 * (f64::from(off.squared_norm_l2()) / count).sqrt()
        };
        lesson.frames.iter().map(rms).collect()
    };
    let training = lesson.fitted()?;
    let alpha = lesson.table(lesson.training())?.laplacian(&lesson.harmonics);
    let clock = CpuClock::start();
    let exact = training.laplacian(&lesson.laplacian(), alpha)?;
    let wanted = errors(&exact);
    println!("alpha {alpha:.3e}; fast form: {:.1} s, RMS {wanted:.3?} mm", clock.elapsed_s());
    let clock = CpuClock::start();
    let mut judged_s = 0.0;
    training.aggregate(&lesson.laplacian(), alpha, &mut |solve, operator| {
        let judging = CpuClock::start();
        let found = errors(operator);
        let spent = clock.elapsed_s() - judged_s - judging.elapsed_s();
        println!(
            "{} unknowns, {} entries: {} iterations, {spent:.1} s, residual {:.1e}, RMS {found:.3?} mm",
            solve.unknowns, solve.entries, solve.iterations, solve.residual
        );
        judged_s += judging.elapsed_s();
        let close = found.iter().zip(&wanted).all(|(a, b)| (a / b - 1.0).abs() < 0.01);
        !close && spent < limit_s
    });
    Ok(())
}

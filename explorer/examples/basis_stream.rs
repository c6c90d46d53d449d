//! Streams made-up states of the size of Kim et al. 2013 (88,962 numbers, 99,352 states: 35.4 GB)
//! through the basis builder, and says what it took. Nothing of that size is stored.
//!
//!     cargo run --release -p explorer --example basis_stream -- --minutes 10
//!
//! States are sums of 300 shapes of falling size with weights of their own, so the best residual of
//! any rank is known exactly. When the time is over, the rest is extrapolated: the cost of a block
//! of states does not depend on how many came before.

use std::error::Error;
use std::time::Instant;

use explorer::cpu::process_cpu_s;
use explorer::pack::basis::{Columns, StreamingSvd};
use faer::{Mat, Side};
use rand_core::Rng;
use rand_pcg::Pcg64Mcg;

const SHAPES: usize = 300;
const BLOCK: usize = 128;

struct Given {
    rows: usize,
    states: usize,
    rank: usize,
    minutes: f64,
}

struct Maker {
    rng: Pcg64Mcg,
    shapes: Mat<f32>,
    /// Products of weights, summed over all states so far.
    weights: Mat<f64>,
    spent_s: f64,
}

impl Maker {
    fn new(rows: usize) -> Self {
        let mut rng = Pcg64Mcg::new(99_352);
        let shapes = Mat::from_fn(rows, SHAPES, |_, _| unit(&mut rng));
        Self { rng, shapes, weights: Mat::zeros(SHAPES, SHAPES), spent_s: 0.0 }
    }

    fn block(&mut self, states: usize) -> Mat<f32> {
        let start = cpu_s();
        let size = |shape: usize| (1.0 + shape as f32).powf(-1.2);
        let rng = &mut self.rng;
        let weights = Mat::from_fn(SHAPES, states, |shape, _| size(shape) * unit(rng));
        let made = &self.shapes * &weights;
        let weights = Mat::from_fn(SHAPES, states, |r, c| f64::from(weights[(r, c)]));
        self.weights += &weights * weights.transpose();
        self.spent_s += cpu_s() - start;
        made
    }

    /// Residual of these columns over the best residual of their rank.
    fn ratio(&self, found: &Columns) -> Result<f64, Box<dyn Error>> {
        let shapes =
            Mat::from_fn(self.shapes.nrows(), SHAPES, |r, c| f64::from(self.shapes[(r, c)]));
        let gram = shapes.transpose() * &shapes;
        let lower = gram.llt(Side::Lower).map_err(|_| "shapes depend on one another")?;
        let lower = lower.L().to_owned();
        let turned = lower.transpose() * &self.weights * &lower;
        let squares = turned.self_adjoint_eigenvalues(Side::Lower).map_err(|_| "no convergence")?;
        let rank = found.columns.ncols();
        let best: f64 = squares[..SHAPES - rank].iter().sum();
        let all: f64 = squares.iter().sum();
        let seen = found.columns.transpose() * &shapes;
        let caught = &seen * &self.weights * seen.transpose();
        let caught: f64 = (0..rank).map(|i| caught[(i, i)]).sum();
        Ok(((all - caught) / best).sqrt())
    }
}

fn unit(rng: &mut Pcg64Mcg) -> f32 {
    (rng.next_u32() >> 8) as f32 / (1 << 23) as f32 - 1.0
}

fn cpu_s() -> f64 {
    process_cpu_s().unwrap_or_default()
}

/// The most memory that this process ever held (bytes), where the system tells it.
fn peak_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|line| line.starts_with("VmHWM:"));
    let kib = line.and_then(|line| line.split_whitespace().nth(1)?.parse::<u64>().ok());
    1024 * kib.unwrap_or_default()
}

fn given() -> Result<Given, Box<dyn Error>> {
    let mut given = Given { rows: 88_962, states: 99_352, rank: 200, minutes: 10.0 };
    let mut args = std::env::args().skip(1);
    while let Some(name) = args.next() {
        let value = args.next().ok_or_else(|| format!("{name} needs a value"))?;
        match name.as_str() {
            "--rows" => given.rows = value.parse()?,
            "--states" => given.states = value.parse()?,
            "--rank" => given.rank = value.parse()?,
            "--minutes" => given.minutes = value.parse()?,
            _ => return Err(format!("{name}: --rows, --states, --rank or --minutes").into()),
        }
    }
    if given.rank == 0 || given.rank >= SHAPES || given.rows < SHAPES || given.states < given.rank {
        return Err(
            format!("rank below {SHAPES}, rows from {SHAPES} on, states from the rank on").into()
        );
    }
    Ok(given)
}

/// Pushes states until there are so many or the time is over; returns how many.
fn push(
    svd: &mut StreamingSvd,
    maker: &mut Maker,
    states: usize,
    going_on: impl Fn() -> bool,
) -> Result<usize, Box<dyn Error>> {
    let mut done = 0;
    while done < states && going_on() {
        let block = maker.block(BLOCK.min(states - done));
        for state in 0..block.ncols() {
            svd.push(block.col_as_slice(state))?;
        }
        done += block.ncols();
        if done.is_multiple_of(8 * BLOCK) {
            eprintln!("{done} of {states} states, {:.0} s of processor time", cpu_s());
        }
    }
    Ok(done)
}

fn main() -> Result<(), Box<dyn Error>> {
    let Given { rows, states, rank, minutes } = given()?;
    let mut maker = Maker::new(rows);
    let begun = Instant::now();
    let mut svd = StreamingSvd::new(rows, rank);
    let before_s = cpu_s();
    let in_time = || begun.elapsed().as_secs_f64() < 60.0 * minutes;
    let done = push(&mut svd, &mut maker, states, in_time)?;
    let stream_s = cpu_s() - before_s - maker.spent_s;
    let start_s = cpu_s();
    let columns = svd.finish()?;
    let finish_s = cpu_s() - start_s;
    let ratio = maker.ratio(&columns)?;
    let more = done.div_ceil(100);
    let (start_s, making_s) = (cpu_s(), maker.spent_s);
    let mut svd = StreamingSvd::resume(columns, rank);
    push(&mut svd, &mut maker, more, || true)?;
    let columns = svd.finish()?;
    let append_s = cpu_s() - start_s - (maker.spent_s - making_s);
    let whole_s = stream_s + finish_s;
    let of_paper_s = finish_s + stream_s * 99_352.0 / done as f64;
    println!("{done} of {states} states of {rows} numbers, rank {rank}");
    println!(
        "{:.2} GB streamed, {:.2} GB of memory at most",
        4e-9 * (rows * done) as f64,
        1e-9 * peak_bytes() as f64
    );
    println!(
        "{whole_s:.1} s of processor time for the basis, {:.1} s for making states",
        maker.spent_s
    );
    println!(
        "residual over the best of its rank {ratio:.4}, {:.4} with 1 % more states",
        maker.ratio(&columns)?
    );
    println!(
        "appending {more} states: {append_s:.1} s, {:.2} % of the whole",
        100.0 * append_s / whole_s
    );
    println!("extrapolated to 99,352 states: {of_paper_s:.0} s");
    Ok(())
}

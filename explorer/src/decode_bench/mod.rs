//! Times the client's kernels on made-up data of the papers' dimensions, beside what the machine's
//! memory gives, a library and a plain loop in the same run.
//!
//! Kim et al. 2013: 29,654 vertices, rank 200, 70 columns of 16 bits and 130 of 8. Kavan et al. 2011:
//! the skirt's operator, 7,016 x 196. *Hot*: called back to back. *Cold*: other memory is read
//! between two calls. All times are medians, of the thread's processor time where the system tells
//! it: on an idle machine the same as the clock's, and on a busy one without the neighbours' turns.

mod baseline;

use std::hint::black_box;

use codec::Basis;
use codec::kernel::normals::{Faces, NormalsError};
use codec::kernel::operator::Operator;
use codec::kernel::read::{Reader, memory, read};
use codec::kernel::{Column, Entries, Set};
use codec::upsample::{UpsampleError, Weights};
use codec::{AppendError, ReconstructError};
use rand_core::Rng;
use rand_pcg::Pcg64Mcg;

/// Vertices of the robe of Kim et al. 2013.
pub const VERTICES: usize = 29_654;
/// Columns of 16 and of 8 bits.
pub const COLUMNS: [usize; 2] = [70, 130];
/// Fine and coarse points of the skirt of Kavan et al. 2011.
pub const OPERATOR: [usize; 2] = [7_016, 196];
/// Smallest memory that is read for a bandwidth, or between cold frames (MiB).
pub const OTHER_MB_MIN: usize = 256;

/// What was measured. Times in microseconds, medians.
#[derive(Debug, Clone, serde::Serialize)]
pub struct DecodeReport {
    /// Instruction set that the kernels ran on.
    pub instructions: String,
    /// Other memory read between cold calls (MiB).
    pub other_mb: usize,
    /// Best reader over that memory (GB/s).
    pub read_gb_s: f64,
    /// Best reader over as much as a mixed frame reads, back to back (GB/s).
    pub read_hot_gb_s: f64,
    /// One frame, 70 columns of 16 bits and 130 of 8, back to back.
    pub mixed_hot_us: f64,
    /// The same, cold.
    pub mixed_cold_us: f64,
    /// One frame, all columns of 8 bits, back to back.
    pub i8_hot_us: f64,
    /// The same, cold.
    pub i8_cold_us: f64,
    /// Four characters on the 8-bit basis, all together, back to back.
    pub i8_batch4_us: f64,
    /// The same, cold.
    pub i8_batch4_cold_us: f64,
    /// Sixteen, all together.
    pub i8_batch16_us: f64,
    /// Four characters on the mixed basis.
    pub mixed_batch4_us: f64,
    /// Normals of all vertices.
    pub normals_us: f64,
    /// Bytes read and written for a mixed frame.
    pub mixed_bytes: usize,
    /// Bytes of a mixed frame over its cold time, as a fraction of `read_gb_s`.
    pub fraction_of_read_bandwidth_cold: f64,
    /// The same for the 8-bit frame.
    pub i8_fraction_of_read_bandwidth_cold: f64,
    /// Bytes of a mixed frame over its hot time, as a fraction of `read_hot_gb_s`.
    pub fraction_of_read_bandwidth_hot: f64,
    /// faer's matrix times vector in f32, the better of both layouts, back to back.
    pub faer_us: f64,
    /// A plain f32 loop, column after column, back to back.
    pub plain_us: f64,
    /// The skirt's operator with 8-bit weights, back to back.
    pub operator_hot_us: f64,
    /// The same, cold.
    pub operator_cold_us: f64,
    /// With f32 weights, back to back.
    pub operator_f32_hot_us: f64,
    /// The same, cold.
    pub operator_f32_cold_us: f64,
    /// Largest distance of the 8-bit operator's points from f64, a waving sheet of 2 m (mm).
    pub operator_error_mm: f64,
}

/// Why nothing was measured.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DecodeBenchError {
    /// Too little memory to be out of cache.
    #[error("{0} MiB between cold frames is too little: at least {OTHER_MB_MIN}")]
    OtherMemory(usize),
    /// The made-up basis was refused.
    #[error(transparent)]
    Append(#[from] AppendError),
    /// The made-up state was refused.
    #[error(transparent)]
    Reconstruct(#[from] ReconstructError),
    /// The made-up operator was refused.
    #[error(transparent)]
    Operator(#[from] UpsampleError),
    /// The made-up mesh was refused.
    #[error(transparent)]
    Normals(#[from] NormalsError),
}

/// Measures on one thread; takes about a minute and, beside `other_mb`, 250 MB.
///
/// # Errors
/// `other_mb` below [`OTHER_MB_MIN`].
pub fn run(other_mb: usize) -> Result<DecodeReport, DecodeBenchError> {
    if other_mb < OTHER_MB_MIN {
        return Err(DecodeBenchError::OtherMemory(other_mb));
    }
    let other = memory(other_mb);
    let read_gb_s = bandwidth(&other, 5);
    let rows = 3 * VERTICES;
    let columns = COLUMNS[0] + COLUMNS[1];
    let coefficients = noise(1, 16 * columns);
    let mut out = vec![0.0; 16 * rows];
    let mut frame = |basis: &Basis, characters: usize, other: &[u64]| {
        let (c, o) = (&coefficients[..characters * columns], &mut out[..characters * rows]);
        time(other, || basis.reconstruct_batch(c, columns, 0..rows, columns, o))
    };
    let mixed = made_up_basis(COLUMNS)?;
    let mixed_hot_us = frame(&mixed, 1, &[])?;
    let mixed_cold_us = frame(&mixed, 1, &other)?;
    let mixed_batch4_us = frame(&mixed, 4, &[])?;
    let mixed_bytes = mixed.resident_bytes() + 4 * rows;
    let read_hot_gb_s = bandwidth(&other[..mixed_bytes / 8], 40);
    drop(mixed);
    let narrow = made_up_basis([0, columns])?;
    let i8_hot_us = frame(&narrow, 1, &[])?;
    let i8_cold_us = frame(&narrow, 1, &other)?;
    let i8_batch4_us = frame(&narrow, 4, &[])?;
    let i8_batch4_cold_us = frame(&narrow, 4, &other)?;
    let i8_batch16_us = frame(&narrow, 16, &[])?;
    let i8_bytes = narrow.resident_bytes() + 4 * rows;
    drop(narrow);
    let gb_s = |bytes: usize, us: f64| bytes as f64 / us / 1000.0;
    let operators = operators(&other)?;
    Ok(DecodeReport {
        instructions: format!("{:?}", Set::detect()),
        other_mb,
        read_gb_s,
        read_hot_gb_s,
        mixed_hot_us,
        mixed_cold_us,
        i8_hot_us,
        i8_cold_us,
        i8_batch4_us,
        i8_batch4_cold_us,
        i8_batch16_us,
        mixed_batch4_us,
        normals_us: normals()?,
        mixed_bytes,
        fraction_of_read_bandwidth_cold: gb_s(mixed_bytes, mixed_cold_us) / read_gb_s,
        i8_fraction_of_read_bandwidth_cold: gb_s(i8_bytes, i8_cold_us) / read_gb_s,
        fraction_of_read_bandwidth_hot: gb_s(mixed_bytes, mixed_hot_us) / read_hot_gb_s,
        faer_us: baseline::faer(rows, columns),
        plain_us: baseline::plain(rows, columns),
        operator_hot_us: operators.us[0],
        operator_cold_us: operators.us[1],
        operator_f32_hot_us: operators.us[2],
        operator_f32_cold_us: operators.us[3],
        operator_error_mm: operators.error_mm,
    })
}

/// Best of all readers, each the best of so many walks (GB/s).
fn bandwidth(words: &[u64], walks: usize) -> f64 {
    let walk = |reader| {
        let start = now_us();
        black_box(read(reader, black_box(words)));
        size_of_val(words) as f64 / (now_us() - start) / 1000.0
    };
    let each = Reader::ALL.iter().flat_map(|reader| (0..walks).map(|_| walk(*reader)));
    each.fold(0.0, f64::max)
}

/// Processor time of this thread (us).
#[cfg(target_os = "linux")]
fn now_us() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    time.tv_sec as f64 * 1e6 + time.tv_nsec as f64 / 1e3
}

/// Time (us).
#[cfg(not(target_os = "linux"))]
fn now_us() -> f64 {
    static START: std::sync::OnceLock<std::time::Instant> = std::sync::OnceLock::new();
    START.get_or_init(std::time::Instant::now).elapsed().as_secs_f64() * 1e6
}

/// Median time of a call (us), with `other` read before each.
pub(crate) fn time<E>(other: &[u64], mut call: impl FnMut() -> Result<(), E>) -> Result<f64, E> {
    let repeats = if other.is_empty() { 201 } else { 41 };
    let mut times = Vec::with_capacity(repeats);
    for _ in 0..repeats {
        if !other.is_empty() {
            black_box(read(Reader::Four, black_box(other)));
        }
        let start = now_us();
        call()?;
        times.push(now_us() - start);
    }
    times.sort_by(f64::total_cmp);
    Ok(times[repeats / 2])
}

/// Numbers in -1..1.
fn noise(seed: u64, count: usize) -> Vec<f32> {
    let mut rng = Pcg64Mcg::new(u128::from(seed) | 1);
    (0..count).map(|_| (rng.next_u32() >> 8) as f32 / (1 << 23) as f32 - 1.0).collect()
}

/// A mean and so many columns of 16 and of 8 bits in steps of 300 micrometres: wide ones reach a
/// metre.
fn made_up_basis([wide, narrow]: [usize; 2]) -> Result<Basis, AppendError> {
    let rows = 3 * VERTICES;
    let mut rng = Pcg64Mcg::new(7);
    let mut entry = |most: i32| (rng.next_u32() as i32 % (most + 1)) as i16;
    let wide: Vec<Vec<i16>> = (0..wide).map(|_| (0..rows).map(|_| entry(3300)).collect()).collect();
    let narrow: Vec<Vec<u8>> =
        (0..narrow).map(|_| (0..rows).map(|_| entry(127) as u8).collect()).collect();
    let column = |entries| Column { entries, scale_m: 3e-4, limit: 1.0 };
    let columns: Vec<Column<'_>> = wide
        .iter()
        .map(|e| column(Entries::Wide(e)))
        .chain(narrow.iter().map(|e| column(Entries::Narrow(e))))
        .collect();
    let mut basis = Basis::with_mean(&noise(3, rows));
    basis.append_columns(rows, &columns, std::iter::empty())?;
    Ok(basis)
}

/// A sheet of as many vertices, 172 wide.
fn normals() -> Result<f64, NormalsError> {
    const WIDTH: usize = 172;
    let quad = |i: usize| {
        let [a, b, c, d] = [i, i + 1, i + WIDTH, i + WIDTH + 1].map(|v| v as u32);
        [[a, c, b], [b, c, d]]
    };
    let inside = |i: &usize| i % WIDTH + 1 < WIDTH && i + WIDTH + 1 < VERTICES;
    let triangles = (0..VERTICES).filter(inside).flat_map(quad).collect();
    let faces = Faces::new(VERTICES, triangles)?;
    let (positions, mut out) = (noise(9, 3 * VERTICES), vec![0.0; 3 * VERTICES]);
    time(&[], || faces.normals(&positions, &mut out))
}

struct Operators {
    /// 8 bits hot and cold, f32 hot and cold.
    us: [f64; 4],
    error_mm: f64,
}

/// Waves of the sheet that the operator is tried on, and frames along which it is rounded.
const WAVES: usize = 12;
const FRAMES: u64 = 60;

/// Coarse points of one frame: a square sheet of 2 m that waves.
fn waving(frame: u64, coarse: usize) -> Vec<f32> {
    let side = (coarse as f32).sqrt().ceil();
    let amounts = noise(100 + frame, 3 * WAVES);
    let point = |i: usize| {
        let (u, v) = (i as f32 % side / side, (i as f32 / side).floor() / side);
        let mut p = [2.0 * u - 1.0, 2.0 * v - 1.0, 0.0];
        for (wave, amounts) in amounts.chunks(3).enumerate() {
            let (a, b) = (1.0 + (wave % 4) as f32, (wave / 4) as f32);
            let height = 0.1 * (2.0 * a * u + b).sin() * (1.5 * b * v + a).cos();
            p.iter_mut().zip(amounts).for_each(|(p, amount)| *p += height * amount);
        }
        p
    };
    (0..coarse).flat_map(point).collect()
}

/// Sum of products of the points of `FRAMES` frames, from their middles.
fn products(coarse: usize) -> Vec<f64> {
    let mut sums = vec![0.0; coarse * coarse];
    for frame in 1..=FRAMES {
        let points = waving(frame, coarse);
        for axis in 0..3 {
            let line: Vec<f64> = points.iter().skip(axis).step_by(3).map(|x| (*x).into()).collect();
            let mean = line.iter().sum::<f64>() / coarse as f64;
            for (row, a) in sums.chunks_mut(coarse).zip(&line) {
                row.iter_mut().zip(&line).for_each(|(s, b)| *s += (a - mean) * (b - mean));
            }
        }
    }
    sums
}

/// Weights that fall with the distance to random places, rows that sum to 1, some below 0; rounded as
/// a client holds them, along sixty frames of a waving sheet, and applied to another frame of it.
fn operators(other: &[u64]) -> Result<Operators, UpsampleError> {
    let [fine, coarse] = OPERATOR;
    let mut weights = noise(11, fine * coarse);
    for row in weights.chunks_mut(coarse) {
        row.iter_mut().for_each(|w| *w = 0.3 * w.powi(5));
        let more = (1.0 - row.iter().sum::<f32>()) / coarse as f32;
        row.iter_mut().for_each(|w| *w += more);
    }
    let points = waving(0, coarse);
    let mut out = vec![0.0; 3 * fine];
    let rounded = Weights::round_along(coarse, &weights, 8, &products(coarse))?;
    let ones = vec![1.0; fine];
    let whole = Operator::from_steps(coarse, &rounded.steps, rounded.units, ones)?;
    let float = Operator::float(fine, coarse, &weights)?;
    let mut us = [0.0; 4];
    for (us, (operator, other)) in
        us.iter_mut().zip([(&whole, &[][..]), (&whole, other), (&float, &[][..]), (&float, other)])
    {
        *us = time(other, || operator.apply(&points, &mut out).map_err(UpsampleError::from))?;
    }
    whole.apply(&points, &mut out).map_err(UpsampleError::from)?;
    let mut error_m = 0.0f64;
    for (row, found) in weights.chunks(coarse).zip(out.chunks(3)) {
        let error = |axis: usize| {
            let term = |(w, p): (&f32, &[f32])| f64::from(*w) * f64::from(p[axis]);
            row.iter().zip(points.chunks(3)).map(term).sum::<f64>() - f64::from(found[axis])
        };
        error_m = error_m.max((0..3).map(|a| error(a).powi(2)).sum::<f64>().sqrt());
    }
    Ok(Operators { us, error_mm: 1000.0 * error_m })
}

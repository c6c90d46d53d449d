//! The SIMD room: products of the block matrix, and bodies compiled for several instruction sets.
//!
//! Everything here has a scalar twin with the same order of operations. Products and sums are
//! rounded one by one (no fused multiply-add), so every instruction set gives the same bits.
#![allow(unsafe_code)] // calls of functions compiled for a detected instruction set; their loads

use glam::{Mat3A, Vec3A};

use super::matrix::{Matrix, Pattern};

/// Something to be done whose body is compiled for the best instruction set of this CPU.
/// Implementations mark `run` and all that it calls `#[inline(always)]`.
pub(crate) trait Task {
    /// What comes out.
    type Output;
    /// Does it.
    fn run(self) -> Self::Output;
}

/// An instruction set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Set {
    /// Whatever the target has for sure.
    Baseline,
    /// AVX2.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// AVX-512 F, VL, DQ and BW, and AVX2.
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl Set {
    /// The best one of this CPU.
    pub(crate) fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            let avx512 = is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512vl")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512bw");
            if is_x86_feature_detected!("avx2") {
                return if avx512 { Self::Avx512 } else { Self::Avx2 };
            }
        }
        Self::Baseline
    }
}

/// Runs `task` as compiled for the best instruction set.
pub(crate) fn run<T: Task>(task: T) -> T::Output {
    match Set::detect() {
        Set::Baseline => task.run(),
        // SAFETY: `detect` has just found the set; the body is safe code.
        #[cfg(target_arch = "x86_64")]
        Set::Avx2 => unsafe { run_avx2(task) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Set::Avx512 => unsafe { run_avx512(task) },
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn run_avx2<T: Task>(task: T) -> T::Output {
    task.run()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,avx512f,avx512vl,avx512dq,avx512bw")]
fn run_avx512<T: Task>(task: T) -> T::Output {
    task.run()
}

/// `out = A x`; returns `x . out`.
///
/// # Panics
/// The lengths must be those of the pattern.
pub(crate) fn multiply(
    set: Set,
    matrix: &Matrix,
    pattern: &Pattern,
    x: &[Vec3A],
    out: &mut [Vec3A],
) -> f32 {
    let count = pattern.near.count();
    assert!(x.len() == count && out.len() == count && matrix.diagonal.len() == count);
    assert!(pattern.far.count() == count);
    assert_eq!(matrix.near.len(), pattern.near_upper.whole.len());
    assert_eq!(matrix.far.len(), pattern.far_upper.whole.len());
    out.fill(Vec3A::ZERO);
    match set {
        // SAFETY: the set was detected. Columns are below `count` and slots below the lengths just
        // compared, as `Rows` is made.
        #[cfg(target_arch = "x86_64")]
        Set::Avx512 => unsafe { multiply_avx512(matrix, pattern, x, out) },
        // SAFETY: the set was detected; the body is safe code.
        #[cfg(target_arch = "x86_64")]
        Set::Avx2 => unsafe { run_avx2(Product { matrix, pattern, x, out }) },
        Set::Baseline => Product { matrix, pattern, x, out }.run(),
    }
}

/// The scalar twin.
struct Product<'a> {
    matrix: &'a Matrix,
    pattern: &'a Pattern,
    x: &'a [Vec3A],
    out: &'a mut [Vec3A],
}

impl Task for Product<'_> {
    type Output = f32;

    #[inline(always)]
    fn run(self) -> f32 {
        let Self { matrix, pattern, x, out } = self;
        let (near, far) = (&pattern.near_upper.rows, &pattern.far_upper.rows);
        let mut dot = Vec3A::ZERO;
        for row in 0..x.len() {
            let own = x[row];
            let d = &matrix.diagonal[row];
            let mut sums = [d.x_axis * own.x, d.y_axis * own.y, d.z_axis * own.z];
            for slot in near.row(row) {
                let column = near.columns[slot] as usize;
                let b = &matrix.near[slot];
                let v = x[column];
                sums[0] += Vec3A::new(b[0], b[1], b[2]) * v.x;
                sums[1] += Vec3A::new(b[3], b[4], b[5]) * v.y;
                sums[2] += Vec3A::new(b[6], b[7], b[8]) * v.z;
                let first = Vec3A::new(b[0], b[3], b[6]) * own.x;
                let second = Vec3A::new(b[1], b[4], b[7]) * own.y;
                let third = Vec3A::new(b[2], b[5], b[8]) * own.z;
                out[column] += (first + second) + third;
            }
            let mut apart = Vec3A::ZERO;
            for slot in far.row(row) {
                let (column, scalar) = (far.columns[slot] as usize, matrix.far[slot]);
                apart += x[column] * scalar;
                out[column] += own * scalar;
            }
            out[row] += (sums[0] + sums[1]) + (sums[2] + apart);
            dot += own * out[row];
        }
        dot.element_sum()
    }
}

const _: () = assert!(size_of::<Mat3A>() == 48 && size_of::<Vec3A>() == 16);

/// One block a register: its columns in lanes 0..4, 4..8 and 8..12 for its row, its rows in the
/// same lanes for its column. Fourth lanes never meet the others.
///
/// # Safety
/// As in [`multiply`]: lengths equal, columns and slots in range.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,avx512f,avx512vl,avx512dq,avx512bw")]
unsafe fn multiply_avx512(
    matrix: &Matrix,
    pattern: &Pattern,
    x: &[Vec3A],
    out: &mut [Vec3A],
) -> f32 {
    use std::arch::x86_64::*;
    const BLOCK: __mmask16 = 0x01ff;
    const DIAGONAL: __mmask16 = 0x0fff;
    let columns = _mm512_setr_epi32(0, 1, 2, 15, 3, 4, 5, 15, 6, 7, 8, 15, 15, 15, 15, 15);
    let rows = _mm512_setr_epi32(0, 3, 6, 15, 1, 4, 7, 15, 2, 5, 8, 15, 15, 15, 15, 15);
    let spread = _mm512_setr_epi32(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3);
    let (near, far) = (&pattern.near_upper.rows, &pattern.far_upper.rows);
    let from: *const f32 = x.as_ptr().cast();
    let to: *mut f32 = out.as_mut_ptr().cast();
    let blocks: *const f32 = matrix.near.as_ptr().cast();
    let diagonal: *const f32 = matrix.diagonal.as_ptr().cast();
    let mut dot = _mm_setzero_ps();
    for row in 0..x.len() {
        // SAFETY: 9 or 12 of the 16 lanes are read from a block, 4 from a vector of 4; rows, slots
        // and columns are in range, as the caller promises.
        unsafe {
            let spread_of = |column: usize| {
                let v = _mm512_broadcast_f32x4(_mm_load_ps(from.add(4 * column)));
                _mm512_permutevar_ps(v, spread)
            };
            let own = spread_of(row);
            let block = _mm512_maskz_loadu_ps(DIAGONAL, diagonal.add(12 * row));
            let mut sums = _mm512_mul_ps(block, own);
            for slot in near.row(row) {
                let column = *near.columns.get_unchecked(slot) as usize;
                let block = _mm512_maskz_loadu_ps(BLOCK, blocks.add(9 * slot));
                let straight = _mm512_permutexvar_ps(columns, block);
                sums = _mm512_add_ps(sums, _mm512_mul_ps(straight, spread_of(column)));
                let turned = _mm512_mul_ps(_mm512_permutexvar_ps(rows, block), own);
                let at = to.add(4 * column);
                _mm_store_ps(at, _mm_add_ps(_mm_load_ps(at), quarters(turned, None)));
            }
            let alone = _mm_load_ps(from.add(4 * row));
            let mut apart = _mm_setzero_ps();
            for slot in far.row(row) {
                let column = *far.columns.get_unchecked(slot) as usize;
                let scalar = _mm_set1_ps(*matrix.far.get_unchecked(slot));
                let v = _mm_load_ps(from.add(4 * column));
                apart = _mm_add_ps(apart, _mm_mul_ps(v, scalar));
                let at = to.add(4 * column);
                _mm_store_ps(at, _mm_add_ps(_mm_load_ps(at), _mm_mul_ps(alone, scalar)));
            }
            let at = to.add(4 * row);
            let sum = _mm_add_ps(_mm_load_ps(at), quarters(sums, Some(apart)));
            _mm_store_ps(at, sum);
            dot = _mm_add_ps(dot, _mm_mul_ps(alone, sum));
        }
    }
    Vec3A::from(dot).element_sum()
}

/// `(first + second) + third`, or `(first + second) + (third + more)`, of the quarters.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,avx512f,avx512vl,avx512dq,avx512bw")]
fn quarters(
    v: std::arch::x86_64::__m512,
    more: Option<std::arch::x86_64::__m128>,
) -> std::arch::x86_64::__m128 {
    use std::arch::x86_64::*;
    let first = _mm512_castps512_ps128(v);
    let second = _mm512_extractf32x4_ps::<1>(v);
    let third = _mm512_extractf32x4_ps::<2>(v);
    let third = more.map_or(third, |more| _mm_add_ps(third, more));
    _mm_add_ps(_mm_add_ps(first, second), third)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Mesh, Vec3};

    #[test]
    fn every_instruction_set_gives_the_same_bits() {
        let n = 12u32;
        let rest = (0..n * n).map(|v| Vec3::new((v % n) as f32, 0.1, (v / n) as f32)).collect();
        let cell = |v: u32| [[v, v + n, v + 1], [v + 1, v + n, v + n + 1]];
        let cells = (0..n * (n - 1)).filter(|v| v % n != n - 1);
        let mesh = Mesh::new(rest, cells.flat_map(cell).collect()).unwrap();
        let pattern = Pattern::new(&mesh);
        let noise = |i: usize| ((i * 7919) % 1009) as f32 / 509.0 - 1.0;
        let vector = |i: usize| Vec3A::new(noise(i), noise(i + 1), noise(i + 2));
        let block = |i: usize| Mat3A::from_cols(vector(i), vector(2 * i), vector(3 * i));
        let count = mesh.vertex_count();
        let mut matrix = Matrix::default();
        matrix.size(&pattern);
        for (i, d) in matrix.diagonal.iter_mut().enumerate() {
            let m = block(i);
            *d = m + m.transpose();
        }
        for (i, b) in matrix.near.iter_mut().enumerate() {
            *b = block(i + 17).to_cols_array();
        }
        for (i, f) in matrix.far.iter_mut().enumerate() {
            *f = noise(i + 5);
        }
        let x: Vec<Vec3A> = (0..count).map(|i| vector(5 * i)).collect();
        let with = |set| {
            let mut out = vec![Vec3A::ZERO; count];
            let dot = multiply(set, &matrix, &pattern, &x, &mut out);
            (dot.to_bits(), out.iter().map(|v| v.to_array().map(f32::to_bits)).collect::<Vec<_>>())
        };
        let wanted = with(Set::Baseline);
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx2") {
                assert!(with(Set::Avx2) == wanted);
            }
            if Set::detect() == Set::Avx512 {
                assert!(with(Set::Avx512) == wanted);
            }
        }
        assert!(with(Set::detect()) == wanted);
    }
}

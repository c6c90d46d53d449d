//! The SIMD room: products of the block matrix, and bodies compiled for several instruction sets.
//!
//! Every body is safe code that is compiled once for each set, so all do the same operations in the
//! same order. Products and sums are
//! rounded one by one (no fused multiply-add), so every instruction set gives the same bits.
#![allow(unsafe_code)] // calls of functions compiled for a detected instruction set

use glam::{Vec3A, Vec4};

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
    run_with(Set::detect(), task)
}

fn run_with<T: Task>(set: Set, task: T) -> T::Output {
    match set {
        Set::Baseline => task.run(),
        // SAFETY: sets come from `detect`; the body is safe code.
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

/// Numbers after the last block, so that its last column can be read as four.
pub(crate) const PADDING: usize = 3;

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
    assert_eq!(matrix.near.len(), 9 * pattern.near.columns.len() + PADDING);
    assert_eq!(matrix.far.len(), pattern.far.columns.len());
    run_with(set, Product { matrix, pattern, x, out })
}

/// A row's blocks are read in order, each as three vectors of which the fourth lane is the next
/// number; fourth lanes never meet the others.
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
        let (near, far) = (&pattern.near, &pattern.far);
        let mut dot = Vec3A::ZERO;
        for (row, out) in out.iter_mut().enumerate() {
            let own = x[row];
            let d = &matrix.diagonal[row];
            let mut sums = [d.x_axis * own.x, d.y_axis * own.y, d.z_axis * own.z];
            let slots = near.row(row);
            let blocks = matrix.near[9 * slots.start..9 * slots.end + PADDING].windows(12);
            for (column, b) in near.columns[slots].iter().zip(blocks.step_by(9)) {
                let v = x[*column as usize];
                sums[0] += four(&b[0..4]) * v.x;
                sums[1] += four(&b[3..7]) * v.y;
                sums[2] += four(&b[6..10]) * v.z;
            }
            let mut apart = Vec3A::ZERO;
            let slots = far.row(row);
            for (column, scalar) in far.columns[slots.clone()].iter().zip(&matrix.far[slots]) {
                apart += x[*column as usize] * *scalar;
            }
            *out = (sums[0] + sums[1]) + (sums[2] + apart);
            dot += own * *out;
        }
        dot.element_sum()
    }
}

/// The first three of four numbers.
#[inline(always)]
fn four(numbers: &[f32]) -> Vec3A {
    Vec3A::from_vec4(Vec4::from_slice(numbers))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Mesh, Vec3};
    use glam::Mat3A;

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
        for (i, b) in matrix.upper.iter_mut().enumerate() {
            *b = block(i + 17).to_cols_array();
        }
        matrix.mirror(&pattern);
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

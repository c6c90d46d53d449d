//! The SIMD room: products of the block matrix, and bodies compiled for several instruction sets.
//!
//! Every body but one is safe code that is compiled once for each set; the product of the matrix has
//! a twin by hand. All do the same operations in the same order. Products and sums are
//! rounded one by one (no fused multiply-add), so every instruction set gives the same bits.
#![allow(unsafe_code)] // functions for a detected instruction set

use glam::{Vec3A, Vec4};

use super::matrix::{Matrix, Pattern};
use crate::tree::Leaf;
use crate::wide::{self, Boxes, Lanes, Movers};

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

/// Numbers after the last block, so that it can be read as sixteen.
pub(crate) const PADDING: usize = 7;

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
    let product = Product { matrix, pattern, x, out };
    match set {
        // SAFETY: sets come from `detect`; lengths are those of the pattern.
        #[cfg(target_arch = "x86_64")]
        Set::Avx512 => unsafe { product_avx512(product) },
        set => run_with(set, product),
    }
}

/// [`Leaf::meets`].
pub(crate) fn meets(set: Set, a: &Leaf, b: &Leaf, reach: f32) -> u32 {
    match set {
        // SAFETY: sets come from `detect`.
        #[cfg(target_arch = "x86_64")]
        Set::Avx512 => unsafe { meets_avx512(a, b, reach) },
        _ => a.meets(b, reach),
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,avx512f,avx512vl,avx512dq,avx512bw")]
fn meets_avx512(a: &Leaf, b: &Leaf, reach: f32) -> u32 {
    use std::arch::x86_64::*;
    let four_times = _mm512_setr_epi32(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3);
    let load = |leaf: &Leaf, k: usize| {
        let [x, y, z, w] = leaf.0[k];
        _mm_setr_ps(x, y, z, w)
    };
    let of_a = |k| _mm512_permutexvar_ps(four_times, _mm512_castps128_ps512(load(a, k)));
    let of_b = |k| _mm512_broadcast_f32x4(load(b, k));
    let (zero, reach) = (_mm512_setzero_ps(), _mm512_set1_ps(reach));
    let mut apart = 0;
    for k in 0..3 {
        let down = _mm512_min_ps(_mm512_sub_ps(of_a(6 + k), of_b(9 + k)), zero);
        let up = _mm512_max_ps(_mm512_sub_ps(of_a(9 + k), of_b(6 + k)), zero);
        let low = _mm512_add_ps(of_a(k), _mm512_sub_ps(down, reach));
        let high = _mm512_add_ps(of_a(3 + k), _mm512_add_ps(up, reach));
        apart |= _mm512_cmp_ps_mask::<_CMP_GT_OQ>(low, of_b(3 + k));
        apart |= _mm512_cmp_ps_mask::<_CMP_LT_OQ>(high, of_b(k));
    }
    u32::from(!apart)
}

/// [`wide::box_distances2`], compiled by itself: within a larger body compilers tear its lanes
/// apart.
#[inline(always)]
pub(crate) fn box_distances2(set: Set, boxes: &Boxes, point: Vec3A) -> Lanes {
    match set {
        Set::Baseline => wide::box_distances2(boxes, point),
        // SAFETY: sets come from `detect`; the body is safe code.
        #[cfg(target_arch = "x86_64")]
        _ => unsafe { box_distances2_avx2(boxes, point) },
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
#[inline(never)]
fn box_distances2_avx2(boxes: &Boxes, point: Vec3A) -> Lanes {
    wide::box_distances2(boxes, point)
}

/// [`Movers::may_meet`], compiled by itself, too.
#[inline(always)]
pub(crate) fn may_meet(set: Set, movers: &Movers, edges: bool, reach: f32) -> u32 {
    match set {
        Set::Baseline => movers.may_meet(edges, reach),
        // SAFETY: sets come from `detect`; the body is safe code.
        #[cfg(target_arch = "x86_64")]
        _ if edges => unsafe { edges_may_meet_avx2(movers, reach) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        _ => unsafe { faces_may_meet_avx2(movers, reach) },
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
#[inline(never)]
fn edges_may_meet_avx2(movers: &Movers, reach: f32) -> u32 {
    movers.may_meet(true, reach)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
#[inline(never)]
fn faces_may_meet_avx2(movers: &Movers, reach: f32) -> u32 {
    movers.may_meet(false, reach)
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

/// [`Product::run`] with a block in one register: columns in three quarters, each with an x of its
/// own; so all is multiplied and added in the same order.
///
/// # Safety
/// The CPU has these sets; `x`, `out` and the matrix have the pattern's lengths.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,avx512f,avx512vl,avx512dq,avx512bw")]
unsafe fn product_avx512(product: Product<'_>) -> f32 {
    use std::arch::x86_64::*;
    let Product { matrix, pattern, x, out } = product;
    let (near, far) = (&pattern.near, &pattern.far);
    let columns = _mm512_setr_epi32(0, 1, 2, 3, 3, 4, 5, 6, 6, 7, 8, 9, 9, 9, 9, 9);
    let each = _mm512_setr_epi32(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3);
    let at = x.as_ptr().cast::<f32>();
    // SAFETY: a Vec3A is four numbers, aligned; `column` is less than the pattern's count.
    let load = |column: u32| unsafe { _mm_load_ps(at.add(4 * column as usize)) };
    let spread = |v: __m128| _mm512_permutevar_ps(_mm512_broadcast_f32x4(v), each);
    let mut dot = _mm_setzero_ps();
    for (row, out) in out.iter_mut().enumerate() {
        let own = load(row as u32);
        let diagonal = (&raw const matrix.diagonal[row]).cast::<f32>();
        // SAFETY: a Mat3A is three times four numbers.
        let diagonal = unsafe { _mm512_maskz_loadu_ps(0x0fff, diagonal) };
        let mut sums = _mm512_mul_ps(diagonal, spread(own));
        let slots = near.row(row);
        let mut block = matrix.near[9 * slots.start..].as_ptr();
        for column in &near.columns[slots] {
            // SAFETY: after the last block there are PADDING numbers more.
            let numbers = unsafe { _mm512_loadu_ps(block) };
            let numbers = _mm512_permutexvar_ps(columns, numbers);
            sums = _mm512_add_ps(sums, _mm512_mul_ps(numbers, spread(load(*column))));
            // SAFETY: the next block, or the padding.
            block = unsafe { block.add(9) };
        }
        let mut apart = _mm_setzero_ps();
        let slots = far.row(row);
        for (column, scalar) in far.columns[slots.clone()].iter().zip(&matrix.far[slots]) {
            apart = _mm_add_ps(apart, _mm_mul_ps(load(*column), _mm_set1_ps(*scalar)));
        }
        let first = _mm512_castps512_ps128(sums);
        let first = _mm_add_ps(first, _mm512_extractf32x4_ps::<1>(sums));
        let rest = _mm_add_ps(_mm512_extractf32x4_ps::<2>(sums), apart);
        let sum = _mm_add_ps(first, rest);
        *out = Vec3A::from(sum);
        dot = _mm_add_ps(dot, _mm_mul_ps(own, sum));
    }
    Vec3A::from(dot).element_sum()
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

    #[test]
    fn leaves_meet_alike_with_every_instruction_set() {
        let mut chance = crate::lab::shapes::Chance::new(3);
        let mut met = 0;
        for _ in 0..2000 {
            let mut leaf = || {
                let mut leaf = Leaf::default();
                for k in 0..3 {
                    for lane in 0..4 {
                        let low = 1.5 * chance.signed();
                        leaf.0[k][lane] = low;
                        leaf.0[3 + k][lane] = low + chance.signed().abs();
                        let way = chance.signed();
                        leaf.0[6 + k][lane] = way;
                        leaf.0[9 + k][lane] = way + chance.signed().abs();
                    }
                }
                leaf
            };
            let (a, b) = (leaf(), leaf());
            let wanted = a.meets(&b, 0.1);
            assert_eq!(meets(Set::detect(), &a, &b, 0.1), wanted);
            met += wanted.count_ones();
        }
        assert!((2000..30000).contains(&met), "{met} of 32000");
    }
}

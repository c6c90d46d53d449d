//! The pair loops in AVX-512 VNNI and AVX2.
#![allow(unsafe_code)] // vector loads and stores through pointers

use std::arch::x86_64::*;

use super::pairs::{Chunk, Pair, Sums};

/// Bytes ahead of the entry in use that are asked for: hardware prefetchers stop at each 4 KiB, and
/// 2 KiB measured best of 1, 2, 4 and 8 out of cache (`toile codec decode-bench`).
const AHEAD: usize = 2048;

/// Asks for one cache line of each small page of `list`, so that the addresses of all are looked up side
/// by side instead of one after the other when they are come to.
pub(super) fn ask_for_pages<T>(list: &[T]) {
    let at = list.as_ptr().cast::<i8>();
    for page in (0..size_of_val(list)).step_by(4096) {
        // SAFETY: a prefetch may name any address, and every x86-64 has it.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(at.wrapping_add(page)) };
    }
}

/// `acc[k][quarter] += ` 16 rows of a pair.
macro_rules! avx512 {
    ($name:ident, $step:ident, $entry:ty, |$at:ident| $load:expr) => {
        #[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
        #[inline]
        fn $step<const K: usize>(
            chunk: &Chunk<$entry>,
            coefficients: &[i32; K],
            sums: &mut [[__m512i; 4]; K],
        ) {
            let mut entries = [_mm512_setzero_si512(); 4];
            for (quarter, entries) in entries.iter_mut().enumerate() {
                let $at = chunk.0[32 * quarter..].as_ptr();
                // SAFETY: a chunk holds 4 quarters of 32 entries; a prefetch may name any address.
                unsafe {
                    *entries = $load;
                    let ahead = $at.cast::<i8>().wrapping_add(AHEAD);
                    if quarter % (2 / size_of::<$entry>()) == 0 {
                        _mm_prefetch::<_MM_HINT_T0>(ahead);
                    }
                }
            }
            for (sums, coefficients) in sums.iter_mut().zip(coefficients) {
                let both = _mm512_set1_epi32(*coefficients);
                for (sum, entries) in sums.iter_mut().zip(entries) {
                    *sum = _mm512_dpwssd_epi32(*sum, entries, both);
                }
            }
        }

        #[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
        pub(super) fn $name<const K: usize>(
            chunks: &[Chunk<$entry>],
            pairs: &[Pair<K>],
            factors: &[f32; K],
            sums: &mut [Sums; K],
        ) {
            let mut exact = [[_mm512_setzero_si512(); 4]; K];
            if K == 1 {
                // Twice the sums, or each addition would wait for the one before.
                let mut more = exact;
                let (twos, last) = pairs.as_chunks::<2>();
                for [a, b] in twos {
                    $step(&chunks[a.at as usize], &a.coefficients, &mut exact);
                    $step(&chunks[b.at as usize], &b.coefficients, &mut more);
                }
                for a in last {
                    $step(&chunks[a.at as usize], &a.coefficients, &mut exact);
                }
                for (sum, more) in exact[0].iter_mut().zip(more[0]) {
                    *sum = _mm512_add_epi32(*sum, more);
                }
            } else {
                for a in pairs {
                    $step(&chunks[a.at as usize], &a.coefficients, &mut exact);
                }
            }
            for ((exact, factor), sums) in exact.iter().zip(factors).zip(sums) {
                let factor = _mm512_set1_ps(*factor);
                for (exact, at) in exact.iter().zip(sums.0.chunks_exact_mut(16)) {
                    let more = _mm512_mul_ps(_mm512_cvtepi32_ps(*exact), factor);
                    // SAFETY: `at` is 16 numbers.
                    unsafe {
                        let sum = _mm512_add_ps(_mm512_loadu_ps(at.as_ptr()), more);
                        _mm512_storeu_ps(at.as_mut_ptr(), sum);
                    }
                }
            }
        }
    };
}

avx512!(avx512_wide, avx512_wide_step, i16, |at| _mm512_loadu_si512(at.cast()));
avx512!(avx512_narrow, avx512_narrow_step, i8, |at| {
    _mm512_cvtepi8_epi16(_mm256_loadu_si256(at.cast()))
});

/// The same in AVX2, which has 16 registers: one character at a time, a quarter of the rows for
/// four.
macro_rules! avx2 {
    ($name:ident, $tile:ident, $entry:ty, |$at:ident| $load:expr) => {
        /// Rows from `8 * first`, 8 times `TILE` of them.
        #[target_feature(enable = "avx2")]
        #[inline]
        fn $tile<const K: usize, const TILE: usize>(
            first: usize,
            chunks: &[Chunk<$entry>],
            pairs: &[Pair<K>],
            factors: &[f32; K],
            sums: &mut [Sums; K],
        ) {
            let mut exact = [[_mm256_setzero_si256(); TILE]; K];
            for pair in pairs {
                let chunk = &chunks[pair.at as usize];
                let mut entries = [_mm256_setzero_si256(); TILE];
                for (i, entries) in entries.iter_mut().enumerate() {
                    let $at = chunk.0[16 * (first + i)..][..16].as_ptr();
                    // SAFETY: 16 entries from there on.
                    unsafe { *entries = $load };
                }
                for (exact, coefficients) in exact.iter_mut().zip(&pair.coefficients) {
                    let both = _mm256_set1_epi32(*coefficients);
                    for (sum, entries) in exact.iter_mut().zip(entries) {
                        *sum = _mm256_add_epi32(*sum, _mm256_madd_epi16(entries, both));
                    }
                }
            }
            for ((exact, factor), sums) in exact.iter().zip(factors).zip(sums) {
                let factor = _mm256_set1_ps(*factor);
                for (exact, at) in exact.iter().zip(sums.0[8 * first..].chunks_exact_mut(8)) {
                    let more = _mm256_mul_ps(_mm256_cvtepi32_ps(*exact), factor);
                    // SAFETY: `at` is 8 numbers.
                    unsafe {
                        let sum = _mm256_add_ps(_mm256_loadu_ps(at.as_ptr()), more);
                        _mm256_storeu_ps(at.as_mut_ptr(), sum);
                    }
                }
            }
        }

        #[target_feature(enable = "avx2")]
        pub(super) fn $name<const K: usize>(
            chunks: &[Chunk<$entry>],
            pairs: &[Pair<K>],
            factors: &[f32; K],
            sums: &mut [Sums; K],
        ) {
            if K == 1 {
                return $tile::<K, 8>(0, chunks, pairs, factors, sums);
            }
            for first in [0, 2, 4, 6] {
                $tile::<K, 2>(first, chunks, pairs, factors, sums);
            }
        }
    };
}

avx2!(avx2_wide, avx2_wide_tile, i16, |at| _mm256_loadu_si256(at.cast()));
avx2!(avx2_narrow, avx2_narrow_tile, i8, |at| _mm256_cvtepi8_epi16(_mm_loadu_si128(at.cast())));

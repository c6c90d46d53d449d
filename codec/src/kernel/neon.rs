//! The pair loops in NEON.
#![allow(unsafe_code)] // vector loads and stores through pointers

use std::arch::aarch64::*;

use super::pairs::{Chunk, Pair, Sums};

/// Rows in tiles of 32 for one character and of 8 for four, so that sums stay in registers.
macro_rules! neon {
    ($name:ident, $tile:ident, $entry:ty, |$at:ident| $load:expr) => {
        /// Rows from `8 * first`, 8 times `TILE` of them.
        #[target_feature(enable = "neon")]
        #[inline]
        fn $tile<const K: usize, const TILE: usize>(
            first: usize,
            chunks: &[Chunk<$entry>],
            pairs: &[Pair<K>],
            factors: &[f32; K],
            sums: &mut [Sums; K],
        ) {
            let mut exact = [[[vdupq_n_s32(0); 2]; TILE]; K];
            for pair in pairs {
                let chunk = &chunks[pair.at as usize];
                for i in 0..TILE {
                    let $at = chunk.0[16 * (first + i)..][..16].as_ptr();
                    // SAFETY: 16 entries from there on: 8 of each column.
                    let int16x8x2_t(a, b) = unsafe { $load };
                    for (exact, coefficients) in exact.iter_mut().zip(&pair.coefficients) {
                        let both = vreinterpret_s16_s32(vdup_n_s32(*coefficients));
                        let [low, high] = &mut exact[i];
                        *low = vmlal_lane_s16::<0>(*low, vget_low_s16(a), both);
                        *low = vmlal_lane_s16::<1>(*low, vget_low_s16(b), both);
                        *high = vmlal_high_lane_s16::<0>(*high, a, both);
                        *high = vmlal_high_lane_s16::<1>(*high, b, both);
                    }
                }
            }
            for ((exact, factor), sums) in exact.iter().zip(factors).zip(sums) {
                let parts = exact.as_flattened();
                for (exact, at) in parts.iter().zip(sums.0[8 * first..].chunks_exact_mut(4)) {
                    let more = vmulq_n_f32(vcvtq_f32_s32(*exact), *factor);
                    // SAFETY: `at` is 4 numbers.
                    unsafe {
                        let sum = vaddq_f32(vld1q_f32(at.as_ptr()), more);
                        vst1q_f32(at.as_mut_ptr(), sum);
                    }
                }
            }
        }

        #[target_feature(enable = "neon")]
        pub(super) fn $name<const K: usize>(
            chunks: &[Chunk<$entry>],
            pairs: &[Pair<K>],
            factors: &[f32; K],
            sums: &mut [Sums; K],
        ) {
            if K == 1 {
                for first in [0, 4] {
                    $tile::<K, 4>(first, chunks, pairs, factors, sums);
                }
                return;
            }
            for first in 0..8 {
                $tile::<K, 1>(first, chunks, pairs, factors, sums);
            }
        }
    };
}

neon!(neon_wide, neon_wide_tile, i16, |at| vld2q_s16(at));
neon!(neon_narrow, neon_narrow_tile, i8, |at| {
    let int8x8x2_t(a, b) = vld2_s8(at);
    int16x8x2_t(vmovl_s8(a), vmovl_s8(b))
});

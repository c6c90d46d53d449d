//! The innermost loop: pairs of columns times pairs of coefficients, for up to `K` characters.

use super::{PANEL_ROWS, Set};

/// A pair of columns in one panel: row by row the entry of the first and of the second.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
pub(crate) struct Chunk<T>(pub(crate) [T; 2 * PANEL_ROWS]);

/// Which chunk of a panel, and the two coefficients of each character: the first column's in the
/// low 16 bits, the second's in the high ones.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pair<const K: usize> {
    pub(crate) at: u32,
    pub(crate) coefficients: [i32; K],
}

impl<const K: usize> Pair<K> {
    pub(crate) const ZERO: Self = Self { at: 0, coefficients: [0; K] };
}

/// Sums (m) of one panel.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
pub(crate) struct Sums(pub(crate) [f32; PANEL_ROWS]);

/// Both coefficients in one word.
pub(crate) fn packed(first: i16, second: i16) -> i32 {
    (i32::from(second) << 16) | i32::from(first as u16)
}

/// Entries of one width: what the kernels are compiled for.
pub(crate) trait Entry: Copy + Default + Into<i32> {
    /// `sums[k] += factors[k] * (the exact sum over pairs of entries x coefficients)`.
    ///
    /// # Panics
    /// Every `at` must be below `chunks.len()`.
    fn add<const K: usize>(
        set: Set,
        chunks: &[Chunk<Self>],
        pairs: &[Pair<K>],
        factors: &[f32; K],
        sums: &mut [Sums; K],
    );
}

macro_rules! entry {
    ($entry:ty, $avx512:ident, $avx2:ident, $neon:ident) => {
        #[allow(unsafe_code)] // calls of functions compiled for a detected instruction set
        impl Entry for $entry {
            fn add<const K: usize>(
                set: Set,
                chunks: &[Chunk<Self>],
                pairs: &[Pair<K>],
                factors: &[f32; K],
                sums: &mut [Sums; K],
            ) {
                match set {
                    // SAFETY: `Set::checked` gave these sets because this CPU has them.
                    #[cfg(target_arch = "x86_64")]
                    Set::Avx512Vnni => unsafe { super::x86::$avx512(chunks, pairs, factors, sums) },
                    // SAFETY: as above.
                    #[cfg(target_arch = "x86_64")]
                    Set::Avx2 => unsafe { super::x86::$avx2(chunks, pairs, factors, sums) },
                    // SAFETY: as above.
                    #[cfg(target_arch = "aarch64")]
                    Set::Neon => unsafe { super::neon::$neon(chunks, pairs, factors, sums) },
                    _ => scalar(chunks, pairs, factors, sums),
                }
            }
        }
    };
}

entry!(i8, avx512_narrow, avx2_narrow, neon_narrow);
entry!(i16, avx512_wide, avx2_wide, neon_wide);

/// The twin that says what all others compute.
fn scalar<T: Entry, const K: usize>(
    chunks: &[Chunk<T>],
    pairs: &[Pair<K>],
    factors: &[f32; K],
    sums: &mut [Sums; K],
) {
    for ((k, sums), factor) in sums.iter_mut().enumerate().zip(factors) {
        let mut exact = [0i32; PANEL_ROWS];
        for pair in pairs {
            let packed = pair.coefficients[k];
            let (first, second) = (i32::from(packed as i16), packed >> 16);
            let (rows, _) = chunks[pair.at as usize].0.as_chunks::<2>();
            for (sum, [a, b]) in exact.iter_mut().zip(rows) {
                let (a, b): (i32, i32) = ((*a).into(), (*b).into());
                *sum += a * first + b * second;
            }
        }
        for (sum, exact) in sums.0.iter_mut().zip(exact) {
            *sum += exact as f32 * factor;
        }
    }
}

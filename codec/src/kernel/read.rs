//! How fast memory can be read at all: what a decoder that is bound by memory is compared with.

use super::Set;
use super::memory::with_huge_pages;

/// Ways to read memory; which is fastest depends on the machine and on what its neighbours do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reader {
    /// One stream from end to end.
    Plain,
    /// One stream, asking 4 KiB ahead.
    Ahead,
    /// One stream, asking 1 KiB ahead.
    Near,
    /// Four streams at once.
    Four,
    /// Four streams at once, asking 4 KiB ahead in each.
    FourAhead,
    /// Sixteen streams at once.
    Sixteen,
}

impl Reader {
    /// All of them.
    pub const ALL: [Self; 6] =
        [Self::Plain, Self::Ahead, Self::Near, Self::Four, Self::FourAhead, Self::Sixteen];
}

/// So many MiB to read, on huge pages where the system gives them, as a basis is.
pub fn memory(mib: usize) -> Vec<u64> {
    let count = mib << 17;
    let mut words = with_huge_pages(count);
    words.extend(0..count as u64);
    words
}

/// Adds up all `words` (wrapping) with the best vectors of this CPU; reads each exactly once.
#[allow(unsafe_code)] // calls of functions compiled for a detected instruction set
pub fn read(reader: Reader, words: &[u64]) -> u64 {
    match Set::detect() {
        // SAFETY: this CPU has the set; the body is safe code but for a prefetch.
        #[cfg(target_arch = "x86_64")]
        Set::Avx512Vnni => unsafe { read_avx512(reader, words) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Set::Avx2 => unsafe { read_avx2(reader, words) },
        _ => any(reader, words),
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
fn read_avx512(reader: Reader, words: &[u64]) -> u64 {
    any(reader, words)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn read_avx2(reader: Reader, words: &[u64]) -> u64 {
    any(reader, words)
}

#[inline(always)]
fn any(reader: Reader, words: &[u64]) -> u64 {
    match reader {
        Reader::Plain => streams::<1, 0>(words),
        Reader::Ahead => streams::<1, 4096>(words),
        Reader::Near => streams::<1, 1024>(words),
        Reader::Four => streams::<4, 0>(words),
        Reader::FourAhead => streams::<4, 4096>(words),
        Reader::Sixteen => streams::<16, 0>(words),
    }
}

/// Words taken from each stream in turn: four cache lines.
const STRIDE: usize = 32;

#[inline(always)]
fn streams<const N: usize, const AHEAD: usize>(words: &[u64]) -> u64 {
    let blocks = words.len() / (N * STRIDE);
    let (even, rest) = words.split_at(blocks * N * STRIDE);
    let mut sums = [0u64; STRIDE];
    let parts: [&[u64]; N] =
        std::array::from_fn(|n| &even[n * blocks * STRIDE..][..blocks * STRIDE]);
    for block in 0..blocks {
        for part in parts {
            let from = &part[block * STRIDE..][..STRIDE];
            if AHEAD > 0 {
                ask_ahead::<AHEAD>(from);
            }
            for (sum, word) in sums.iter_mut().zip(from) {
                *sum = sum.wrapping_add(*word);
            }
        }
    }
    sums.iter().chain(rest).fold(0, |sum, word| sum.wrapping_add(*word))
}

#[inline(always)]
#[allow(unsafe_code)] // prefetch
fn ask_ahead<const AHEAD: usize>(from: &[u64]) {
    #[cfg(target_arch = "x86_64")]
    for line in 0..STRIDE / 8 {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let ahead = from.as_ptr().wrapping_add(8 * line + AHEAD / 8).cast();
        // SAFETY: a prefetch may name any address.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(ahead) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = from;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_reader_reads_every_word_once() {
        for count in [0, 1, 511, 512, 5000] {
            let words: Vec<u64> = (0..count).map(|i| i * i + 1).collect();
            let expected: u64 = words.iter().sum();
            for reader in Reader::ALL {
                assert_eq!(read(reader, &words), expected, "{reader:?} {count}");
            }
        }
    }
}

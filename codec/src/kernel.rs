//! The SIMD room: `sums += entries x coefficients` over one panel.
//!
//! One scalar body is compiled for several instruction sets and chosen at run time. Products and
//! sums are rounded one by one (no fused multiply-add), so every set gives the same bits.
#![allow(unsafe_code)] // calls of functions compiled for a detected instruction set

/// Rows of a panel: 256 bytes of sums, which stay in registers from AVX2 on.
pub const PANEL_ROWS: usize = 64;

/// An instruction set that the kernel is compiled for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Set {
    /// Whatever the target has for sure.
    Baseline,
    /// AVX2.
    Avx2,
    /// AVX-512 F, BW, VL and DQ.
    Avx512,
}

impl Set {
    /// The best one that this CPU has.
    pub fn detect() -> Self {
        Self::available().last().copied().unwrap_or(Self::Baseline)
    }

    /// All that this CPU has, slowest first.
    pub fn available() -> &'static [Self] {
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx2") {
                let avx512 = is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512bw")
                    && is_x86_feature_detected!("avx512dq")
                    && is_x86_feature_detected!("avx512vl");
                return if avx512 {
                    &[Self::Baseline, Self::Avx2, Self::Avx512]
                } else {
                    &[Self::Baseline, Self::Avx2]
                };
            }
        }
        &[Self::Baseline]
    }
}

/// Adds 8-bit columns: for each `(number, entries)` of `columns`,
/// `sums += entries * (coefficients[number] * step_m)`.
///
/// * `columns`: numbers, and `PANEL_ROWS` entries for each, column after column.
///
/// # Panics
/// Every number must be below `coefficients.len()`.
pub fn add_narrow(
    columns: (&[u16], &[i8]),
    coefficients: &[f32],
    step_m: f32,
    sums: &mut [f32; PANEL_ROWS],
) {
    add_with(Set::detect(), columns, coefficients, step_m, sums);
}

/// As [`add_narrow`], for 16-bit columns.
///
/// # Panics
/// Every number must be below `coefficients.len()`.
pub fn add_wide(
    columns: (&[u16], &[i16]),
    coefficients: &[f32],
    step_m: f32,
    sums: &mut [f32; PANEL_ROWS],
) {
    add_with(Set::detect(), columns, coefficients, step_m, sums);
}

/// The same with a given instruction set; falls back to the baseline where the CPU lacks it.
///
/// # Panics
/// Every number must be below `coefficients.len()`.
pub fn add_with<T: Copy + Into<f32>>(
    set: Set,
    columns: (&[u16], &[T]),
    coefficients: &[f32],
    step_m: f32,
    sums: &mut [f32; PANEL_ROWS],
) {
    #[cfg(target_arch = "x86_64")]
    if set != Set::Baseline && Set::available().contains(&set) {
        // SAFETY: the set was just found among those that this CPU has, which is all that these
        // functions ask for; their bodies are safe code.
        return unsafe {
            match set {
                Set::Avx512 => add_avx512(columns, coefficients, step_m, sums),
                _ => add_avx2(columns, coefficients, step_m, sums),
            }
        };
    }
    let _ = set;
    add(columns, coefficients, step_m, sums);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn add_avx2<T: Copy + Into<f32>>(
    columns: (&[u16], &[T]),
    coefficients: &[f32],
    step_m: f32,
    sums: &mut [f32; PANEL_ROWS],
) {
    add(columns, coefficients, step_m, sums);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
fn add_avx512<T: Copy + Into<f32>>(
    columns: (&[u16], &[T]),
    coefficients: &[f32],
    step_m: f32,
    sums: &mut [f32; PANEL_ROWS],
) {
    add(columns, coefficients, step_m, sums);
}

#[inline(always)]
fn add<T: Copy + Into<f32>>(
    (numbers, entries): (&[u16], &[T]),
    coefficients: &[f32],
    step_m: f32,
    sums: &mut [f32; PANEL_ROWS],
) {
    let (columns, _) = entries.as_chunks::<PANEL_ROWS>();
    let mut local = *sums;
    for (number, column) in numbers.iter().zip(columns) {
        let weight = coefficients[usize::from(*number)] * step_m;
        for (sum, entry) in local.iter_mut().zip(column) {
            let entry: f32 = (*entry).into();
            *sum += entry * weight;
        }
    }
    *sums = local;
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn every_instruction_set_gives_the_same_bits(
            entries in proptest::collection::vec(any::<i16>(), 0..40 * PANEL_ROWS),
            coefficients in proptest::collection::vec(-1.0f32..=1.0, 40),
        ) {
            let columns = entries.len() / PANEL_ROWS;
            let numbers: Vec<u16> = (0..columns as u16).rev().collect();
            let entries = &entries[..columns * PANEL_ROWS];
            let narrow: Vec<i8> = entries.iter().map(|e| *e as i8).collect();
            let mut expected = [0.5; PANEL_ROWS];
            add_with(Set::Baseline, (&numbers, entries), &coefficients, 3e-4, &mut expected);
            add_with(Set::Baseline, (&numbers, &narrow[..]), &coefficients, 3e-4, &mut expected);
            for set in Set::available() {
                let mut sums = [0.5; PANEL_ROWS];
                add_with(*set, (&numbers, entries), &coefficients, 3e-4, &mut sums);
                add_with(*set, (&numbers, &narrow[..]), &coefficients, 3e-4, &mut sums);
                prop_assert_eq!(sums.map(f32::to_bits), expected.map(f32::to_bits), "{:?}", set);
            }
        }
    }
}

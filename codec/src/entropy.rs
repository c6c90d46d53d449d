//! Integers to bytes and back: a binary range coder with adaptive probabilities, and signed
//! integers of a known scale over it.
//!
//! The coder is the carry-propagating range coder of Martin 1979 in its binary form. Integers are
//! taken to be Laplace-distributed around zero: whoever writes and whoever reads names the mean
//! size to expect, in quarter octaves, and the probabilities begin at those of that distribution
//! and follow what is met. Integer arithmetic alone decides, so bytes are equal on every machine.

const TOP: u32 = 1 << 24;
const PROBABILITY_BITS: u32 = 15;
const ONE: u16 = 1 << PROBABILITY_BITS;
/// No probability comes nearer to 0 or 1 than this.
const MARGIN: u16 = 48;
/// Scales that are told apart: quarter octaves from 2^-5 on.
pub const SCALES: usize = 96;
/// The scale of integers whose mean size is 1.
pub const SCALE_ONE: usize = 20;
/// Steps in unary before the rest is written out.
const UNARY_MAX: u32 = 20;
/// Bits of the longest rest.
const REST_BITS_MAX: u32 = 31;
/// 2^(1/4), 2^(1/2), 2^(3/4), after 1.
const QUARTER_OCTAVES: [f64; 4] =
    [1.0, 1.189_207_115_002_721, std::f64::consts::SQRT_2, 1.681_792_830_507_429];

/// Writes bits.
#[derive(Debug)]
pub struct Writer {
    low: u64,
    range: u32,
    cache: Option<u8>,
    pending: usize,
    out: Vec<u8>,
}

/// Reads what a [`Writer`] wrote. Past the end it reads zeros: whoever needs to know the length
/// keeps it elsewhere.
#[derive(Debug)]
pub struct Reader<'a> {
    bytes: &'a [u8],
    range: u32,
    code: u32,
}

impl Default for Writer {
    fn default() -> Self {
        Self { low: 0, range: u32::MAX, cache: None, pending: 0, out: Vec::new() }
    }
}

impl Writer {
    /// Nothing written yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// One bit at a probability that follows it.
    pub fn bit(&mut self, bit: bool, of: &mut Bit) {
        let bound = (self.range >> PROBABILITY_BITS) * u32::from(of.zero);
        if bit {
            self.low += u64::from(bound);
            self.range -= bound;
        } else {
            self.range = bound;
        }
        of.meet(bit);
        self.normalise();
    }

    /// `count` bits as they are, the highest first; at most 31.
    pub fn raw(&mut self, value: u32, count: u32) {
        for at in (0..count).rev() {
            self.range >>= 1;
            if (value >> at) & 1 == 1 {
                self.low += u64::from(self.range);
            }
            self.normalise();
        }
    }

    /// Bytes so far, about.
    pub fn len(&self) -> usize {
        self.out.len() + self.pending + 1
    }

    /// Whether nothing was written out yet.
    pub fn is_empty(&self) -> bool {
        self.out.is_empty()
    }

    /// The bytes; zeros at their end are left out.
    pub fn finish(mut self) -> Vec<u8> {
        // Of all numbers in the last interval, the one with most zeros at its end.
        let last = self.low + u64::from(self.range) - 1;
        for zeros in (0..32).rev() {
            let rounded = last >> zeros << zeros;
            if rounded >= self.low {
                self.low = rounded;
                break;
            }
        }
        (0..5).for_each(|_| self.shift());
        while self.out.last() == Some(&0) {
            self.out.pop();
        }
        self.out
    }

    fn normalise(&mut self) {
        while self.range < TOP {
            self.range <<= 8;
            self.shift();
        }
    }

    fn shift(&mut self) {
        if self.low < 0xff00_0000 || self.low > u64::from(u32::MAX) {
            let carry = (self.low >> 32) as u8;
            if let Some(cache) = self.cache {
                self.out.push(cache.wrapping_add(carry));
            }
            let filler = 0xff_u8.wrapping_add(carry);
            self.out.extend(std::iter::repeat_n(filler, self.pending));
            self.pending = 0;
            self.cache = Some((self.low >> 24) as u8);
        } else {
            self.pending += 1;
        }
        self.low = (self.low & 0x00ff_ffff) << 8;
    }
}

impl<'a> Reader<'a> {
    /// Reads from the beginning of `bytes`.
    pub fn new(bytes: &'a [u8]) -> Self {
        let mut reader = Self { bytes, range: u32::MAX, code: 0 };
        (0..4).for_each(|_| reader.shift());
        reader
    }

    /// The next bit.
    pub fn bit(&mut self, of: &mut Bit) -> bool {
        let bound = (self.range >> PROBABILITY_BITS) * u32::from(of.zero);
        let bit = self.code >= bound;
        if bit {
            self.code -= bound;
            self.range -= bound;
        } else {
            self.range = bound;
        }
        of.meet(bit);
        while self.range < TOP {
            self.range <<= 8;
            self.shift();
        }
        bit
    }

    /// The next `count` raw bits; at most 31.
    pub fn raw(&mut self, count: u32) -> u32 {
        let mut value = 0;
        for _ in 0..count {
            self.range >>= 1;
            let bit = self.code >= self.range;
            if bit {
                self.code -= self.range;
            }
            value = value << 1 | u32::from(bit);
            while self.range < TOP {
                self.range <<= 8;
                self.shift();
            }
        }
        value
    }

    fn shift(&mut self) {
        let next = self.bytes.split_off_first().copied().unwrap_or(0);
        self.code = self.code << 8 | u32::from(next);
    }
}

/// The probability of one kind of bit.
#[derive(Debug, Clone, Copy)]
pub struct Bit {
    zero: u16,
    met: u8,
}

impl Bit {
    /// Zero with this probability (0..=1), to begin with.
    pub fn new(zero: f64) -> Self {
        let zero = (zero * f64::from(ONE)) as u16;
        Self { zero: zero.clamp(MARGIN, ONE - MARGIN), met: 0 }
    }

    fn meet(&mut self, bit: bool) {
        let rate = match self.met {
            0..32 => 5,
            32..96 => 6,
            _ => 7,
        };
        self.met = self.met.saturating_add(1);
        if bit {
            self.zero -= self.zero >> rate;
        } else {
            self.zero += (ONE - self.zero) >> rate;
        }
        self.zero = self.zero.clamp(MARGIN, ONE - MARGIN);
    }
}

/// Signed integers, told apart by the mean size that is expected.
#[derive(Debug, Clone)]
pub struct Integers {
    scales: Vec<Scale>,
}

#[derive(Debug, Clone, Copy)]
struct Scale {
    /// Bits of each integer that are as likely 0 as 1.
    low_bits: u32,
    zero: Bit,
    one: Bit,
    more: Bit,
}

impl Default for Integers {
    fn default() -> Self {
        Self { scales: (0..SCALES).map(Scale::new).collect() }
    }
}

impl Scale {
    fn new(scale: usize) -> Self {
        let mean = size_of_scale(scale);
        let mut low_bits = 0;
        while mean >= 8.0 * f64::from(1u32 << low_bits) {
            low_bits += 1;
        }
        let group = f64::from(1u32 << low_bits);
        let more = exp_minus(group / mean);
        let zero = 1.0 - exp_minus((group - 0.5) / mean);
        Self {
            low_bits,
            zero: Bit::new(zero),
            one: Bit::new(1.0 - more),
            more: Bit::new(1.0 - more),
        }
    }
}

impl Integers {
    /// Probabilities at their beginning.
    pub fn new() -> Self {
        Self::default()
    }

    /// Writes a number where one of this scale (below [`SCALES`]) is expected.
    pub fn write(&mut self, writer: &mut Writer, scale: usize, value: i32) {
        let model = &mut self.scales[scale.min(SCALES - 1)];
        let size = value.unsigned_abs();
        let high = size >> model.low_bits;
        let mut met = 0;
        while met < high && met < UNARY_MAX {
            writer.bit(true, model.step(met));
            met += 1;
        }
        if met < UNARY_MAX {
            writer.bit(false, model.step(met));
        } else {
            let rest = high - UNARY_MAX + 1;
            let bits = 31 - rest.leading_zeros();
            (0..bits).for_each(|_| writer.raw(1, 1));
            if bits < REST_BITS_MAX {
                writer.raw(0, 1);
            }
            writer.raw(rest & !(1 << bits), bits);
        }
        writer.raw(size & ((1 << model.low_bits) - 1), model.low_bits);
        if size > 0 {
            writer.raw(u32::from(value < 0), 1);
        }
    }

    /// Reads a number where one of this scale (below [`SCALES`]) is expected. Bytes that no writer
    /// made give some number.
    pub fn read(&mut self, reader: &mut Reader<'_>, scale: usize) -> i32 {
        let model = &mut self.scales[scale.min(SCALES - 1)];
        let mut high = 0;
        while high < UNARY_MAX && reader.bit(model.step(high)) {
            high += 1;
        }
        let mut high = u64::from(high);
        if high == u64::from(UNARY_MAX) {
            let mut bits = 0;
            while bits < REST_BITS_MAX && reader.raw(1) == 1 {
                bits += 1;
            }
            high += (1u64 << bits) - 1 + u64::from(reader.raw(bits));
        }
        let size = high << model.low_bits | u64::from(reader.raw(model.low_bits));
        let size = i32::try_from(size).unwrap_or(i32::MAX);
        if size > 0 && reader.raw(1) == 1 { -size } else { size }
    }
}

impl Scale {
    fn step(&mut self, met: u32) -> &mut Bit {
        match met {
            0 => &mut self.zero,
            1 => &mut self.one,
            _ => &mut self.more,
        }
    }
}

/// The scale at which numbers have the mean size `mean_256ths / 256`.
pub fn scale_of(mean_256ths: u32) -> usize {
    let quarters = quarter_octaves(mean_256ths.max(1));
    (quarters + SCALE_ONE).saturating_sub(32).min(SCALES - 1)
}

/// Mean size at a scale, in 256ths.
pub fn size_256ths(scale: usize) -> u32 {
    (256.0 * size_of_scale(scale.min(SCALES - 1))) as u32
}

/// `4 * log2(x)`, rounded down; `x` is at least 1.
pub fn quarter_octaves(x: u32) -> usize {
    let octave = 31 - x.leading_zeros();
    // The number as 1.xxx in 2^16ths, compared with the quarter octaves.
    let mantissa = (u64::from(x) << 16) >> octave;
    let quarter = [77_936, 92_682, 110_218].iter().filter(|q| mantissa >= **q).count();
    4 * octave as usize + quarter
}

/// `2^(quarters / 4)`; the same on every machine.
pub fn from_quarter_octaves(quarters: i32) -> f64 {
    let octaves = quarters.div_euclid(4).clamp(-1000, 1000);
    let power = f64::from_bits(((1023 + octaves) as u64) << 52);
    QUARTER_OCTAVES[quarters.rem_euclid(4) as usize] * power
}

fn size_of_scale(scale: usize) -> f64 {
    from_quarter_octaves(scale as i32 - SCALE_ONE as i32)
}

/// `exp(-x)` by a short series and ten squarings: basic operations alone, equal on every machine.
fn exp_minus(x: f64) -> f64 {
    let y = (x / 1024.0).min(0.1);
    let mut power = 1.0 - y * (1.0 - y / 2.0 * (1.0 - y / 3.0 * (1.0 - y / 4.0)));
    (0..10).for_each(|_| power *= power);
    power
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn integers_come_back(
            values in proptest::collection::vec((any::<i32>(), 0usize..SCALES, 0u32..32), 0..300),
        ) {
            let shifted = |(v, _, s): &(i32, usize, u32)| (v >> s).max(-i32::MAX);
            let (mut writer, mut model) = (Writer::new(), Integers::new());
            values.iter().for_each(|v| model.write(&mut writer, v.1, shifted(v)));
            let bytes = writer.finish();
            let (mut reader, mut model) = (Reader::new(&bytes), Integers::new());
            for value in &values {
                prop_assert_eq!(model.read(&mut reader, value.1), shifted(value));
            }
        }

        #[test]
        fn any_bytes_are_read(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            let (mut reader, mut model) = (Reader::new(&bytes), Integers::new());
            (0..500).for_each(|i| { model.read(&mut reader, i % SCALES); });
        }
    }

    #[test]
    fn a_known_scale_costs_what_its_entropy_says() {
        // A geometric sequence of sizes by inversion, mean about 2, both signs.
        let mut state = 1u64;
        let mut unit = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695);
            ((state >> 33) as f64 + 0.5) / f64::from(1u32 << 31)
        };
        let values: Vec<i32> = (0..20_000)
            .map(|_| {
                let size = (-2.0 * unit().ln()).round() as i32;
                if unit() < 0.5 { -size } else { size }
            })
            .collect();
        let mut counts = std::collections::BTreeMap::new();
        values.iter().for_each(|v| *counts.entry(*v).or_insert(0.0) += 1.0);
        let all = values.len() as f64;
        let entropy: f64 = counts.values().map(|c: &f64| -c * (c / all).log2()).sum();
        let (mut writer, mut model) = (Writer::new(), Integers::new());
        values.iter().for_each(|v| model.write(&mut writer, scale_of(512), *v));
        let bits = 8.0 * writer.finish().len() as f64;
        assert!(bits < 1.01 * entropy, "{bits} bits for an entropy of {entropy}");
    }

    #[test]
    fn scales_are_quarter_octaves() {
        assert_eq!((scale_of(256), scale_of(512), scale_of(1)), (20, 24, 0));
        assert_eq!((size_256ths(20), size_256ths(16)), (256, 128));
        assert_eq!(quarter_octaves(u32::MAX), 127);
        assert!((from_quarter_octaves(-3) - 0.594_603_557_5).abs() < 1e-9);
        for x in [0.01, 0.5, 3.0, 20.0] {
            assert!((exp_minus(x) - (-x).exp()).abs() < 1e-9);
        }
    }
}

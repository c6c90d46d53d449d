//! What was shown, in figures: counts, and percentiles in fixed memory.

/// What a character showed since it entered.
#[derive(Debug, Clone, Default)]
pub struct PlayStats {
    /// Frames played: all calls of `step`.
    pub frames: u64,
    /// Of these, exact.
    pub exact: u64,
    /// Of these, substituted.
    pub substituted: u64,
    /// Of these, missed.
    pub missed: u64,
    /// Calls whose pose was no successor of the one before.
    pub jumps: u64,
    /// Version switches that this character lived through.
    pub switches: u64,
    /// Of the substituted frames, those outside the graph.
    pub outside: u64,
    /// How often it left the graph.
    pub left: u64,
    /// How often it came back.
    pub entered: u64,
    /// Shown error per frame that was not missed, in metres: what is left of the errors of merges and
    /// switches under the blend, and the error of a substitute.
    pub shown_error_m: Histogram,
}

impl PlayStats {
    /// Adds another character's figures.
    pub fn merge(&mut self, other: &Self) {
        self.frames += other.frames;
        self.exact += other.exact;
        self.substituted += other.substituted;
        self.missed += other.missed;
        self.jumps += other.jumps;
        self.switches += other.switches;
        self.outside += other.outside;
        self.left += other.left;
        self.entered += other.entered;
        self.shown_error_m.merge(&other.shown_error_m);
    }
}

/// Bins per factor of two: a percentile is at most 1/16 of itself too high.
const BINS_PER_OCTAVE: usize = 16;
/// The smallest value told from zero is `2^LOWEST_EXPONENT`.
const LOWEST_EXPONENT: i32 = -24;
/// Octaves from there on; larger values count as the largest.
const OCTAVES: usize = 56;

/// A histogram with logarithmic bins over about 6e-8 to 4e9, good for metres and microseconds.
///
/// Percentiles are given by the upper end of their bin, but never above the largest value seen.
#[derive(Debug, Clone)]
pub struct Histogram {
    zeros: u64,
    bins: Vec<u64>,
    count: u64,
    sum: f64,
    max: f64,
}

impl Default for Histogram {
    fn default() -> Self {
        Self { zeros: 0, bins: vec![0; OCTAVES * BINS_PER_OCTAVE], count: 0, sum: 0.0, max: 0.0 }
    }
}

impl Histogram {
    /// Counts a value; what is below the smallest bin, negative or NaN counts as zero.
    pub fn record(&mut self, value: f64) {
        self.count += 1;
        match bin_of(value) {
            None => self.zeros += 1,
            Some(bin) => {
                self.bins[bin] += 1;
                self.sum += value;
                self.max = self.max.max(value);
            }
        }
    }

    /// How many values were counted.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// The largest value; 0 when there was none.
    pub fn max(&self) -> f64 {
        self.max
    }

    /// The mean; 0 when there was none.
    pub fn mean(&self) -> f64 {
        if self.count == 0 { 0.0 } else { self.sum / self.count as f64 }
    }

    /// The value that `share` (0..=1) of all values do not exceed; 0 when there was none.
    pub fn percentile(&self, share: f64) -> f64 {
        let rank = (share.clamp(0.0, 1.0) * self.count as f64).ceil() as u64;
        let mut seen = self.zeros;
        if rank <= seen {
            return 0.0;
        }
        for (bin, count) in self.bins.iter().enumerate() {
            seen += count;
            if rank <= seen {
                return upper_end(bin).min(self.max);
            }
        }
        self.max
    }

    /// Adds what another one counted.
    pub fn merge(&mut self, other: &Self) {
        self.zeros += other.zeros;
        self.count += other.count;
        self.sum += other.sum;
        self.max = self.max.max(other.max);
        for (mine, theirs) in self.bins.iter_mut().zip(&other.bins) {
            *mine += theirs;
        }
    }
}

fn bin_of(value: f64) -> Option<usize> {
    let octave = value.log2() - f64::from(LOWEST_EXPONENT);
    if octave.is_nan() || octave < 0.0 {
        return None;
    }
    let bin = (octave * BINS_PER_OCTAVE as f64) as usize;
    Some(bin.min(OCTAVES * BINS_PER_OCTAVE - 1))
}

fn upper_end(bin: usize) -> f64 {
    let octave = (bin + 1) as f64 / BINS_PER_OCTAVE as f64;
    (octave + f64::from(LOWEST_EXPONENT)).exp2()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_of_a_ramp() {
        let mut histogram = Histogram::default();
        for value in 1..=1000 {
            histogram.record(f64::from(value));
        }
        for (share, exact) in [(0.5, 500.0), (0.9, 900.0), (0.99, 990.0)] {
            let found = histogram.percentile(share);
            assert!((exact..=exact * 1.07).contains(&found), "{share}: {found}");
        }
        assert!((histogram.percentile(1.0) - 1000.0).abs() < 1e-9);
        assert!((histogram.mean() - 500.5).abs() < 1e-9);
    }

    #[test]
    fn zeros_and_nonsense_count_as_zero() {
        let mut histogram = Histogram::default();
        for value in [0.0, -1.0, f64::NAN, 1e-12] {
            histogram.record(value);
        }
        assert_eq!(histogram.percentile(0.99), 0.0);
        histogram.record(1e300);
        assert!(histogram.percentile(1.0) >= 1e300 || histogram.percentile(1.0).is_finite());
        assert_eq!(histogram.count(), 5);
    }

    #[test]
    fn merged_halves_equal_the_whole() {
        let (mut whole, mut left, mut right) =
            (Histogram::default(), Histogram::default(), Histogram::default());
        for value in 0..100 {
            whole.record(f64::from(value) * 0.001);
            let half = if value % 3 == 0 { &mut left } else { &mut right };
            half.record(f64::from(value) * 0.001);
        }
        left.merge(&right);
        assert_eq!(left.percentile(0.99), whole.percentile(0.99));
        assert_eq!(left.count(), whole.count());
    }
}

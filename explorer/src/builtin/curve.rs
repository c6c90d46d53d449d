//! Curves through keys that never overshoot: where two keys agree, the curve rests.

/// A monotone cubic through `(at, value)` keys (Fritsch and Carlson 1980, with harmonic slopes).
/// Flat at both ends, constant beyond them. Keys are in ascending order.
pub(super) struct Curve<'a> {
    keys: &'a [(f32, f32)],
}

impl<'a> Curve<'a> {
    pub fn new(keys: &'a [(f32, f32)]) -> Self {
        debug_assert!(keys.windows(2).all(|k| k[0].0 < k[1].0), "keys out of order: {keys:?}");
        Self { keys }
    }

    /// Value at `x`.
    pub fn at(&self, x: f32) -> f32 {
        let next = self.keys.partition_point(|key| key.0 <= x);
        let (Some(left), Some(right)) = (next.checked_sub(1), self.keys.get(next)) else {
            let end = if next == 0 { self.keys.first() } else { self.keys.last() };
            return end.map_or(0.0, |key| key.1);
        };
        let width = right.0 - self.keys[left].0;
        let t = (x - self.keys[left].0) / width;
        let (a, b) = (self.keys[left].1, right.1);
        let (slope_a, slope_b) = (self.slope(left) * width, self.slope(next) * width);
        let (t2, t3) = (t * t, t * t * t);
        a * (2.0 * t3 - 3.0 * t2 + 1.0)
            + b * (3.0 * t2 - 2.0 * t3)
            + slope_a * (t3 - 2.0 * t2 + t)
            + slope_b * (t3 - t2)
    }

    fn slope(&self, key: usize) -> f32 {
        if key == 0 || key + 1 >= self.keys.len() {
            return 0.0;
        }
        let rise = |k: usize| {
            (self.keys[k + 1].1 - self.keys[k].1) / (self.keys[k + 1].0 - self.keys[k].0)
        };
        let (before, after) = (rise(key - 1), rise(key));
        if before * after <= 0.0 { 0.0 } else { 2.0 * before * after / (before + after) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_meets_its_keys_and_stays_between_them() {
        let keys = [(0.0, 0.0), (4.0, 1.0), (5.0, 3.0), (9.0, 3.0), (12.0, -1.0)];
        let curve = Curve::new(&keys);
        for (x, value) in keys {
            assert!((curve.at(x) - value).abs() < 1e-6);
        }
        for pair in keys.windows(2) {
            for i in 0..=20 {
                let y = curve.at(pair[0].0 + (pair[1].0 - pair[0].0) * i as f32 / 20.0);
                let (low, high) = (pair[0].1.min(pair[1].1), pair[0].1.max(pair[1].1));
                assert!((low - 1e-5..=high + 1e-5).contains(&y));
            }
        }
        assert!((curve.at(7.3) - 3.0).abs() < 1e-6, "rests between equal keys");
        assert!((curve.at(99.0) + 1.0).abs() < 1e-6);
    }
}

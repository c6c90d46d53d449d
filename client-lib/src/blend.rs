//! The blend after a merge: offsets on coefficients that decay over ten frames.
//!
//! Source: Kim et al. 2013, section 3 (linear blend over ten frames); here in the causal half
//! alone, because what the player does next is not known. Overlapping offsets add.

/// Frames until an offset is gone.
pub const BLEND_FRAMES: usize = 10;

/// Offsets under way, by age. A sum per age is enough, since all decay alike.
#[derive(Debug, Clone)]
pub struct Blend {
    columns: usize,
    /// `BLEND_FRAMES` rows of `columns`; row `(newest + age) % BLEND_FRAMES` is `age` frames old.
    rows: Vec<f32>,
    errors_m: [f32; BLEND_FRAMES],
    active: [bool; BLEND_FRAMES],
    newest: usize,
}

impl Blend {
    /// Nothing under way.
    pub fn new(columns: usize) -> Self {
        Self {
            columns,
            rows: vec![0.0; BLEND_FRAMES * columns],
            errors_m: [0.0; BLEND_FRAMES],
            active: [false; BLEND_FRAMES],
            newest: 0,
        }
    }

    /// Makes room for appended columns, which are zero in all offsets so far.
    pub fn grow(&mut self, columns: usize) {
        if columns <= self.columns {
            return;
        }
        let mut rows = vec![0.0; BLEND_FRAMES * columns];
        for (new, old) in rows.chunks_exact_mut(columns).zip(self.rows.chunks(self.columns.max(1)))
        {
            new[..self.columns].copy_from_slice(old);
        }
        self.rows = rows;
        self.columns = columns;
    }

    /// Ages all offsets by a frame; the oldest is gone.
    pub fn advance(&mut self) {
        self.newest = (self.newest + BLEND_FRAMES - 1) % BLEND_FRAMES;
        self.active[self.newest] = false;
        self.errors_m[self.newest] = 0.0;
    }

    /// Adds the offset `from - to`, which has its full weight in this frame.
    pub fn add(&mut self, from: &[f32], to: &[f32]) {
        let row = &mut self.rows[self.newest * self.columns..][..self.columns];
        if !std::mem::replace(&mut self.active[self.newest], true) {
            row.fill(0.0);
        }
        for ((sum, from), to) in row.iter_mut().zip(from).zip(to) {
            *sum += from - to;
        }
    }

    /// Counts an error, in metres that begins in this frame and decays as its offset does.
    pub fn add_error(&mut self, error_m: f32) {
        self.errors_m[self.newest] += error_m;
    }

    /// Forgets all offsets.
    pub fn clear(&mut self) {
        self.active = [false; BLEND_FRAMES];
        self.errors_m = [0.0; BLEND_FRAMES];
    }

    /// Adds what is left of all offsets to `out`.
    pub fn apply(&self, out: &mut [f32]) {
        for age in 0..BLEND_FRAMES {
            let slot = (self.newest + age) % BLEND_FRAMES;
            if self.active[slot] {
                let row = &self.rows[slot * self.columns..][..self.columns];
                for (out, offset) in out.iter_mut().zip(row) {
                    *out += weight(age) * offset;
                }
            }
        }
    }

    /// What is left of the errors that the offsets hide, in metres.
    pub fn error_m(&self) -> f32 {
        let slot = |age| (self.newest + age) % BLEND_FRAMES;
        (0..BLEND_FRAMES).map(|age| weight(age) * self.errors_m[slot(age)]).sum()
    }
}

/// Of an offset's ten frames: 1, 0.9, ..., 0.1.
fn weight(age: usize) -> f32 {
    (BLEND_FRAMES - age) as f32 / BLEND_FRAMES as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_fall_by_a_tenth_and_overlapping_offsets_add() {
        let mut blend = Blend::new(2);
        blend.add(&[15.0, 0.0], &[5.0, 20.0]);
        blend.add_error(0.01);
        for frame in 0..14u8 {
            if frame == 3 {
                blend.add(&[0.0, 0.0], &[-100.0, 0.0]);
            }
            let tenths = |since: u8| f32::from(10u8.saturating_sub(frame - since)) / 10.0;
            let second = if frame >= 3 { tenths(3) * 100.0 } else { 0.0 };
            let mut out = [1.0, 1.0];
            blend.apply(&mut out);
            assert!((out[0] - (1.0 + 10.0 * tenths(0) + second)).abs() < 1e-4, "{frame}: {out:?}");
            assert!((out[1] - (1.0 - 20.0 * tenths(0))).abs() < 1e-4, "{frame}: {out:?}");
            assert!((blend.error_m() - 0.01 * tenths(0)).abs() < 1e-7);
            blend.advance();
        }
    }

    #[test]
    fn two_offsets_of_one_frame_add_and_new_columns_keep_them() {
        let mut blend = Blend::new(1);
        for from in [1.0, 2.0] {
            blend.add(&[from], &[0.0]);
            blend.add_error(0.5);
        }
        blend.grow(3);
        let mut out = [0.0; 3];
        blend.apply(&mut out);
        assert_eq!(out, [3.0, 0.0, 0.0]);
        assert!((blend.error_m() - 1.0).abs() < 1e-6);
        blend.clear();
        blend.apply(&mut out);
        assert_eq!(out, [3.0, 0.0, 0.0]);
    }
}

//! The blend after a merge: offsets on coefficients that decay over ten frames.
//!
//! Source: Kim et al. 2013, section 3 (linear blend over ten frames); here in the causal half
//! alone, because what the player does next is not known. Overlapping offsets add.

/// Frames until an offset is gone.
pub const BLEND_FRAMES: usize = 10;

/// How an offset disappears.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum BlendMode {
    /// At once: the jump is seen as it is.
    Off,
    /// By a tenth a frame: the causal half of the paper's blend (Kim et al. 2013, section 3).
    #[default]
    Linear,
    /// By a quintic that takes up the offset's velocity where it is known, and ends without a jump
    /// in velocity or acceleration (inertialisation, as in Bollo, GDC 2018).
    Smooth,
}

impl BlendMode {
    /// What an offset's velocity (a frame) adds `age` frames after it began.
    fn of_velocity(self, age: usize) -> f32 {
        let t = age as f32 / BLEND_FRAMES as f32;
        match self {
            Self::Off | Self::Linear => 0.0,
            // 0 at both ends, 1 in its first derivative at the beginning alone.
            Self::Smooth => BLEND_FRAMES as f32 * t * (1.0 + t * t * (t * (8.0 - 3.0 * t) - 6.0)),
        }
    }

    /// What is left of an offset `age` frames after it began; 1 at first, except where it is off.
    fn weight(self, age: usize) -> f32 {
        let t = age as f32 / BLEND_FRAMES as f32;
        match self {
            Self::Off => 0.0,
            Self::Linear => (BLEND_FRAMES - age) as f32 / BLEND_FRAMES as f32,
            Self::Smooth => 1.0 - t * t * t * (10.0 + t * (6.0 * t - 15.0)),
        }
    }
}

/// Offsets under way, by age. A sum per age is enough, since all decay alike.
#[derive(Debug, Clone)]
pub struct Blend {
    columns: usize,
    /// `BLEND_FRAMES` rows of `columns`; row `(newest + age) % BLEND_FRAMES` is `age` frames old.
    rows: Vec<f32>,
    /// By how much each offset was growing when it began, a frame; only where `moving` says so.
    velocities: Vec<f32>,
    moving: [bool; BLEND_FRAMES],
    errors_m: [f32; BLEND_FRAMES],
    active: [bool; BLEND_FRAMES],
    newest: usize,
    mode: BlendMode,
}

impl Blend {
    /// Nothing under way.
    pub fn new(columns: usize) -> Self {
        Self {
            columns,
            rows: vec![0.0; BLEND_FRAMES * columns],
            velocities: vec![0.0; BLEND_FRAMES * columns],
            moving: [false; BLEND_FRAMES],
            errors_m: [0.0; BLEND_FRAMES],
            active: [false; BLEND_FRAMES],
            newest: 0,
            mode: BlendMode::default(),
        }
    }

    /// Chooses how offsets disappear, those under way included.
    pub fn set_mode(&mut self, mode: BlendMode) {
        self.mode = mode;
    }

    /// Whether a velocity makes a difference.
    pub fn takes_velocity(&self) -> bool {
        self.mode == BlendMode::Smooth
    }

    /// Makes room for appended columns, which are zero in all offsets so far.
    pub fn grow(&mut self, columns: usize) {
        if columns <= self.columns {
            return;
        }
        for rows in [&mut self.rows, &mut self.velocities] {
            let mut wider = vec![0.0; BLEND_FRAMES * columns];
            let each = wider.chunks_exact_mut(columns).zip(rows.chunks(self.columns.max(1)));
            each.for_each(|(new, old)| new[..self.columns].copy_from_slice(old));
            *rows = wider;
        }
        self.columns = columns;
    }

    /// Ages all offsets by a frame; the oldest is gone.
    pub fn advance(&mut self) {
        self.newest = (self.newest + BLEND_FRAMES - 1) % BLEND_FRAMES;
        self.active[self.newest] = false;
        self.moving[self.newest] = false;
        self.errors_m[self.newest] = 0.0;
    }

    /// Adds to the velocity of this frame's offset: by how much it grew since the frame before, by
    /// column. After [`Blend::add`].
    pub fn add_velocity(&mut self, velocity: impl Iterator<Item = f32>) {
        let row = &mut self.velocities[self.newest * self.columns..][..self.columns];
        if !std::mem::replace(&mut self.moving[self.newest], true) {
            row.fill(0.0);
        }
        row.iter_mut().zip(velocity).for_each(|(sum, v)| *sum += v);
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
        self.moving = [false; BLEND_FRAMES];
        self.errors_m = [0.0; BLEND_FRAMES];
    }

    /// Adds what is left of all offsets to `out`.
    pub fn apply(&self, out: &mut [f32]) {
        for age in 0..BLEND_FRAMES {
            let slot = (self.newest + age) % BLEND_FRAMES;
            for (there, rows, weight) in [
                (self.active[slot], &self.rows, self.mode.weight(age)),
                (self.moving[slot], &self.velocities, self.mode.of_velocity(age)),
            ] {
                if there && weight != 0.0 {
                    let row = &rows[slot * self.columns..][..self.columns];
                    out.iter_mut().zip(row).for_each(|(out, x)| *out += weight * x);
                }
            }
        }
    }

    /// What is left of the errors that the offsets hide, in metres.
    pub fn error_m(&self) -> f32 {
        let slot = |age| (self.newest + age) % BLEND_FRAMES;
        (0..BLEND_FRAMES).map(|age| self.mode.weight(age) * self.errors_m[slot(age)]).sum()
    }
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
    fn an_offset_can_go_at_once_or_smoothly() {
        let left = |mode, frames| {
            let mut blend = Blend::new(1);
            blend.set_mode(mode);
            blend.add(&[1.0], &[0.0]);
            (0..frames).for_each(|_| blend.advance());
            let mut out = [0.0];
            blend.apply(&mut out);
            out[0]
        };
        assert_eq!(left(BlendMode::Off, 0), 0.0);
        assert_eq!((left(BlendMode::Smooth, 0), left(BlendMode::Smooth, 10)), (1.0, 0.0));
        assert!((left(BlendMode::Smooth, 5) - 0.5).abs() < 1e-6, "even about the middle");
        assert!(left(BlendMode::Smooth, 1) > 0.99, "no jump in velocity");
    }

    #[test]
    fn a_velocity_is_taken_up_and_gone_at_the_end() {
        let after = |frames| {
            let mut blend = Blend::new(1);
            blend.set_mode(BlendMode::Smooth);
            blend.add(&[1.0], &[0.0]);
            blend.add_velocity([0.03].into_iter());
            (0..frames).for_each(|_| blend.advance());
            let mut out = [0.0];
            blend.apply(&mut out);
            out[0]
        };
        assert_eq!((after(0), after(10)), (1.0, 0.0));
        // Within a frame the quintic has begun to bend.
        assert!((after(1) - 1.0 - 0.03).abs() < 0.012, "{}", after(1));
        assert!(after(9) < 0.02, "{}", after(9));
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

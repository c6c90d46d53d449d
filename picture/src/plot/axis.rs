//! Where values stand, and which of them are named.

/// One named value.
pub(super) struct Tick {
    /// In plot units.
    pub(super) place: f32,
    pub(super) label: String,
}

/// A range of values on a range of plot units.
pub(super) struct Axis {
    low: f64,
    high: f64,
    from: f32,
    to: f32,
    log: bool,
    pub(super) ticks: Vec<Tick>,
}

impl Axis {
    /// Evenly spaced; the ends are rounded outwards to ticks. Reaches to zero when zero is near.
    pub(super) fn linear(ends: [f64; 2], from: f32, to: f32) -> Self {
        let [mut low, mut high] = sorted(ends, [0.0, 1.0]);
        if low > 0.0 && low < 0.4 * high {
            low = 0.0;
        }
        if high - low <= 1e-12 * high.abs().max(low.abs()) {
            let room = 0.5 * high.abs().max(1e-9);
            (low, high) = (low - room, high + room);
        }
        let wanted = f64::from((to - from).abs() / 40.0).clamp(2.0, 8.0);
        let step = nice((high - low) / wanted);
        (low, high) = ((low / step + 1e-9).floor() * step, (high / step - 1e-9).ceil() * step);
        let mut axis = Self { low, high, from, to, log: false, ticks: Vec::new() };
        let count = ((high - low) / step).round() as u32;
        let unit = unit(low.abs().max(high.abs()));
        for k in 0..=count.min(64) {
            let value = low + f64::from(k) * step;
            axis.tick(value, fixed(value, step, unit));
        }
        axis
    }

    /// Spaced by logarithm; ticks at 1, or at 1, 2 and 5, of each decade. `ends` above zero.
    pub(super) fn logarithmic(ends: [f64; 2], from: f32, to: f32) -> Self {
        let [low, high] = sorted(ends, [0.1, 10.0]).map(|value| value.max(1e-300));
        let steps: &[f64] = if high / low < 200.0 { &[1.0, 2.0, 5.0] } else { &[1.0] };
        let decades = low.log10().floor() as i32 - 1..=high.log10().ceil() as i32 + 1;
        let all: Vec<f64> = decades
            .flat_map(|decade| steps.iter().map(move |step| step * 10_f64.powi(decade)))
            .collect();
        let below = |value: &&f64| **value <= low * 1.000_001;
        let above = |value: &&f64| **value >= high * 0.999_999;
        let low = all.iter().rev().find(below).copied().unwrap_or(low);
        let mut high = all.iter().find(above).copied().unwrap_or(high);
        if high <= low {
            high = all.iter().find(|value| **value > low).copied().unwrap_or(10.0 * low);
        }
        let mut axis = Self { low, high, from, to, log: true, ticks: Vec::new() };
        let within: Vec<f64> =
            all.into_iter().filter(|value| (low..=high).contains(value)).collect();
        let room = ((to - from).abs() / 18.0).max(2.0) as usize;
        for value in within.iter().step_by(within.len().div_ceil(room).max(1)) {
            axis.tick(*value, scientific(*value));
        }
        axis
    }

    /// Where a value stands, in plot units.
    pub(super) fn place(&self, value: f64) -> f32 {
        let share = match self.log {
            true => (value / self.low).ln() / (self.high / self.low).ln(),
            false => (value - self.low) / (self.high - self.low),
        };
        self.from + share as f32 * (self.to - self.from)
    }

    fn tick(&mut self, value: f64, label: String) {
        self.ticks.push(Tick { place: self.place(value), label });
    }
}

/// The ends, or `otherwise` when nothing was to be shown.
fn sorted(ends: [f64; 2], otherwise: [f64; 2]) -> [f64; 2] {
    if ends[0] <= ends[1] { ends } else { otherwise }
}

/// The smallest of 1, 2, 5 times a power of ten that is no less than `step`.
fn nice(step: f64) -> f64 {
    let decade = 10_f64.powf(step.log10().floor());
    let factor = [1.0, 2.0, 5.0].into_iter().find(|factor| factor * decade >= step * 0.999_999);
    factor.unwrap_or(10.0) * decade
}

/// Thousands and millions are named by a letter.
fn unit(largest: f64) -> (f64, &'static str) {
    match largest {
        large if large >= 2e6 => (1e6, "M"),
        large if large >= 1e4 => (1e3, "k"),
        _ => (1.0, ""),
    }
}

fn fixed(value: f64, step: f64, (size, letter): (f64, &str)) -> String {
    let decimals = (-(step / size).log10() - 1e-9).ceil().clamp(0.0, 9.0) as usize;
    if value.abs() < 1e-9 * step {
        return "0".to_owned();
    }
    format!("{:.decimals$}{letter}", value / size)
}

fn scientific(value: f64) -> String {
    let (size, letter) = unit(value);
    if (1e-3..1e9).contains(&value) {
        let decimals = (-(value / size).log10() - 1e-9).ceil().clamp(0.0, 9.0) as usize;
        return format!("{:.decimals$}{letter}", value / size);
    }
    format!("{value:.0e}")
}

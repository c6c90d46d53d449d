//! The way back to the graph: once no force acts, coarse cloth is drawn towards a state, gently at
//! first. Cloth that hangs by itself seldom comes near one of a few states a pose; drawn so, what
//! the coarse simulation does differently from the graph cannot keep it away.

use cloth::{Rigid, Vec3};

use super::probe::Probes;

/// How fast it is drawn (1/s) at first and at most, and how much faster after a second.
const RATES: [f32; 2] = [2.0, 24.0];
const FASTER: f32 = 16.0;
/// Largest share of the way that a step goes, so that it cannot swing beyond.
const SHARE_MAX: f32 = 0.4;
/// What has not let it come near by then (s) is a limb on its wrong side: from then on it passes
/// through the body, as the state that it is drawn to lies well.
const LATE_S: f32 = 0.8;
/// Strongest pull (m/s^2): what an arm does to a sleeve.
const PULL_MAX: f32 = 200.0;

/// What cloth is drawn to during a frame; its memory is kept.
#[derive(Debug, Default)]
pub(crate) struct Draw {
    on: bool,
    /// For how long it has been drawn (s).
    seconds: f32,
    /// Where the coarse points of the state are in the world (m) when the frame begins and ends.
    from: Vec<Vec3>,
    to: Vec<Vec3>,
    coarse_m: Vec<f32>,
}

impl Draw {
    /// Not any more, or not yet.
    pub(crate) fn stop(&mut self) {
        (self.on, self.seconds) = (false, 0.0);
    }

    /// Whether cloth is drawn during this frame.
    pub(crate) fn is_on(&self) -> bool {
        self.on
    }

    /// Whether the body is no hindrance any more.
    pub(crate) fn passes_body(&self) -> bool {
        self.on && self.seconds > LATE_S
    }

    /// Draws towards the state with these coefficients. `follows`: the state drawn to
    /// in the last frame leads to it without a merge; otherwise it is as if it had been carried by the
    /// hips on their `way` through the frame.
    pub(crate) fn towards(
        &mut self,
        probes: &Probes,
        coefficients: &[f32],
        [before, after]: [&Rigid; 2],
        follows: bool,
    ) {
        probes.coarse_m(coefficients, &mut self.coarse_m);
        self.on = true;
        std::mem::swap(&mut self.from, &mut self.to);
        let (points, _) = self.coarse_m.as_chunks::<3>();
        self.to.clear();
        self.to.extend(points.iter().map(|p| after.point(Vec3::from_array(*p))));
        if !follows || self.from.len() != self.to.len() {
            self.from.clear();
            self.from.extend(points.iter().map(|p| before.point(Vec3::from_array(*p))));
        }
    }

    /// A step of the frame is over.
    pub(crate) fn pass(&mut self, seconds: f32) {
        self.seconds += seconds;
    }

    /// Adds the pull (m/s^2) on each point at the beginning of a step, a share `part` into the frame:
    /// a critically damped spring.
    pub(crate) fn add(
        &self,
        (positions, velocities): (&[Vec3], &[Vec3]),
        part: f32,
        (frame_s, step_s): (f32, f32),
        pulls: &mut [Vec3],
    ) {
        let rate = (RATES[0] + FASTER * self.seconds).min(RATES[1]).min(SHARE_MAX / step_s);
        let ways = self.from.iter().zip(&self.to);
        let points = positions.iter().zip(velocities).zip(ways);
        for (pull, ((x, v), (from, to))) in pulls.iter_mut().zip(points) {
            let (off, led) = (from.lerp(*to, part) - *x, (*to - *from) / frame_s);
            *pull += (off * rate * rate + (led - *v) * 2.0 * rate).clamp_length_max(PULL_MAX);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_comes_to_what_it_is_drawn_to_and_does_not_swing_beyond() {
        for step_s in [1.0 / 60.0, 1.0 / 30.0, 1.0 / 240.0] {
            let target = vec![Vec3::X];
            let mut draw = Draw { on: true, from: target.clone(), to: target, ..Draw::default() };
            let (mut x, mut v, mut fastest) = (Vec3::ZERO, Vec3::ZERO, 0.0f32);
            let mut seconds = 0.0;
            while seconds < 3.0 {
                let mut pull = [Vec3::ZERO];
                draw.add((&[x], &[v]), 0.5, (step_s, step_s), &mut pull);
                v += pull[0] * step_s;
                x += v * step_s;
                draw.pass(step_s);
                (seconds, fastest) = (seconds + step_s, fastest.max(v.length()));
                assert!(x.x < 1.02 && x.y.abs() < 1e-6, "{x}");
            }
            assert!((x - Vec3::X).length() < 1e-3, "{x} with steps of {step_s} s");
            assert!((0.5..4.0).contains(&fastest), "{fastest} m/s");
        }
    }
}

//! Exits at even intervals: how a motion graph answers soon without becoming larger than it must.
//!
//! Every transition is ten poses to simulate, so what counts is where the few exits lie. Between two clips
//! they are chosen by dynamic programming over the frames of the clip that is left: no longer than a gap
//! apart, as few and as well-fitting as that allows.

use super::transition::Transition;

/// Distance (m) at which a fit costs as much as an exit more.
const FIT_M: f32 = 0.15;
/// Cost of every frame by which two exits lie further apart than the gap: more than that of an exit.
const LATE: f32 = 4.0;

/// Frames of one clip at which another can be entered, each with the best place to go on, in order.
#[derive(Debug, Clone, PartialEq)]
pub struct Way {
    /// In order of `from_frame`; frames at which nothing fits are left out.
    pub fits: Vec<Transition>,
    /// First frame that may be left.
    pub first: usize,
    /// Frames of the clip.
    pub frames: usize,
}

impl Way {
    /// Exits that lie at most `gap` frames apart wherever something fits.
    pub fn exits(&self, gap: usize) -> Vec<Transition> {
        let late = |from: usize, to: usize| (to - from).saturating_sub(gap) as f32 * LATE;
        // Cheapest way to have an exit here, and the exit before it.
        let mut costs: Vec<(f32, Option<usize>)> = Vec::with_capacity(self.fits.len());
        for fit in &self.fits {
            let fitness = 1.0 + (fit.distance_m / FIT_M).powi(2);
            let begin = (late(self.first.min(fit.from_frame), fit.from_frame), None);
            let follow = |(index, (cost, _)): (usize, &(f32, Option<usize>))| {
                let gap = late(self.fits[index].from_frame, fit.from_frame);
                (cost + gap, Some(index))
            };
            let before = costs.iter().enumerate().map(follow).chain([begin]);
            let (cost, before) = before.min_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or(begin);
            costs.push((cost + fitness, before));
        }
        let ends = costs.iter().zip(&self.fits).enumerate();
        let ends = ends.map(|(i, ((cost, _), fit))| (cost + late(fit.from_frame, self.frames), i));
        let mut at = ends.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, index)| index);
        let mut exits = Vec::new();
        while let Some(index) = at {
            exits.push(self.fits[index]);
            at = costs[index].1;
        }
        exits.reverse();
        exits
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn way(distances: &[f32]) -> Way {
        let fit = |(from_frame, distance_m): (usize, &f32)| Transition {
            from_clip: 0,
            from_frame,
            to_clip: 1,
            to_frame: 0,
            distance_m: *distance_m,
        };
        let fits = distances.iter().enumerate().filter(|(_, d)| d.is_finite()).map(fit).collect();
        Way { fits, first: 0, frames: distances.len() }
    }

    fn frames(exits: &[Transition]) -> Vec<usize> {
        exits.iter().map(|t| t.from_frame).collect()
    }

    /// The cost of a choice of exits, straight from its definition.
    fn cost(way: &Way, chosen: &[Transition], gap: usize) -> f32 {
        let mut last = way.first;
        let mut cost = 0.0;
        for t in chosen {
            cost += 1.0 + (t.distance_m / FIT_M).powi(2);
            cost += (t.from_frame - last).saturating_sub(gap) as f32 * LATE;
            last = t.from_frame;
        }
        cost + (way.frames - last).saturating_sub(gap) as f32 * LATE
    }

    #[test]
    fn where_all_fits_are_equal_exits_are_as_few_as_the_gap_allows() {
        let way = way(&[0.1; 50]);
        let exits = frames(&way.exits(10));
        assert_eq!(exits.len(), 4, "{exits:?}");
        assert!(exits.windows(2).all(|two| two[1] - two[0] <= 10), "{exits:?}");
    }

    #[test]
    fn no_choice_is_cheaper() {
        let mut distances =
            [12, 30, 9, 25, 31, 5, 28, 19, 33, 8, 27, 14, 22, 40].map(|d: u8| f32::from(d) * 0.01);
        distances[6] = f32::INFINITY;
        let way = way(&distances);
        for gap in [1, 2, 3, 5, 9] {
            let best = (1u32..1 << way.fits.len())
                .map(|bits| {
                    let all = way.fits.iter().enumerate();
                    let chosen = all.filter(|(i, _)| bits >> i & 1 == 1).map(|(_, t)| *t);
                    cost(&way, &chosen.collect::<Vec<_>>(), gap)
                })
                .fold(f32::INFINITY, f32::min);
            let found = cost(&way, &way.exits(gap), gap);
            assert!((found - best).abs() < 1e-4, "{gap}: {found} {best}");
        }
    }

    #[test]
    fn nothing_that_fits_is_no_exit() {
        assert!(way(&[f32::INFINITY; 5]).exits(3).is_empty());
    }
}

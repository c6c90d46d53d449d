//! How far an expansion goes: until its own dead ends would no longer be chosen.
//!
//! Greedy follows every trajectory to full depth, as the paper does (Kim et al. 2013, section 3.2). The other
//! policies give every expansion an aim: once a known state is so near that merging there ranks at a part of
//! what the merge that is undone ranked at, the trajectory ends. Nothing is lost by ending early: the dead end is
//! queued, and gone on with from there once it ranks highest itself. So it is best to end soon: at a mere part
//! less than what is undone. What is won are the frames that would have
//! been simulated while something worse waited, and those along ways that nobody takes.
//!
//! Aims are made when a round opens, from the records alone, and do not change while it lasts.

use std::collections::BTreeMap;

use protocol::{EdgeId, PoseId, StateId};

use super::graph::{Graph, Kind};
use super::policy::{Growth, WalkModel};

/// A trajectory ends where merging ranks at this part of what is undone.
pub const REACH: f32 = 0.85;
/// How far learnt growth may move the end of a trajectory: by this factor and its inverse.
const GROWTH_SWING: f64 = 1.5;

/// Where the expansions of a round end; empty: at the scene's tolerance and depth alone.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Aims {
    /// Error of the merge that is undone (m), by start, and whether ways are weighed by who takes them.
    starts: BTreeMap<StateId, (f32, bool)>,
    /// The share of players that takes an edge, given its pose; empty where that does not count.
    shares: Vec<f32>,
    /// By pose: the factor by which a merge there is expected to grow; empty where that does not count.
    growth: Vec<f32>,
}

impl Aims {
    /// Of these dead ends. `worst`: the one that is chosen whoever passes it.
    pub fn new(graph: &Graph, chosen: &[StateId], worst: Option<StateId>) -> Self {
        let aim = |state: &StateId| match graph.state(*state).kind {
            Kind::DeadEnd { error_m, .. } => Some((*state, (error_m, worst != Some(*state)))),
            _ => None,
        };
        Self { starts: chosen.iter().filter_map(aim).collect(), ..Self::default() }
    }

    /// Weighs what lies along an edge by the players that take it.
    pub fn weighed_by(mut self, graph: &Graph, model: &WalkModel) -> Self {
        let edges = graph.primary().edges().len() as u32;
        self.shares = (0..edges).map(|edge| model.probability(EdgeId(edge)) as f32).collect();
        self
    }

    /// Weighs a merge by what it is expected to grow into.
    pub fn grown_by(mut self, graph: &Graph, growth: &Growth) -> Self {
        let factor = |pose: &crate::primary::PrimaryPose| growth.factor((pose.clip, pose.frame));
        self.growth = graph.primary().poses().iter().map(|pose| factor(pose) as f32).collect();
        self
    }

    /// What the weight of a state becomes along an edge, in the expansion of `start`.
    pub fn along(&self, start: StateId, weight: f32, edge: EdgeId) -> f32 {
        match (self.starts.get(&start), self.shares.get(edge.index())) {
            (Some((_, true)), Some(share)) => weight * share,
            _ => weight,
        }
    }

    /// How near a known state must be for a trajectory to end at it (m), penalties included.
    ///
    /// * `at`: poses of the expansion's start and of the state that might end.
    pub fn enough_m(&self, start: StateId, at: (PoseId, PoseId), weight: f32) -> f32 {
        let Some(&(error_m, _)) = self.starts.get(&start) else { return 0.0 };
        let growth = |pose: PoseId| self.growth.get(pose.index()).map_or(1.0, |g| f64::from(*g));
        let swing = (growth(at.0) / growth(at.1)).clamp(1.0 / GROWTH_SWING, GROWTH_SWING);
        // Never worse than what is undone.
        (REACH * swing as f32 / weight.max(1e-6)).min(1.0) * error_m
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::grow::graph::tests::initial;
    use crate::grow::toy;

    #[test]
    fn a_trajectory_ends_by_what_is_undone_who_goes_there_and_what_it_grows_into() {
        let graph = initial(toy::figure_4());
        let primary = Arc::clone(graph.primary());
        // c9 has 0.9 m, c5 0.5 m; from p1 a player goes on to p2 or p5.
        let (worst, other) = (StateId(9), StateId(5));
        let at = (PoseId(0), PoseId(1));
        let none = Aims::default();
        assert_eq!(
            none.enough_m(other, at, 1.0).to_bits(),
            0,
            "greedy goes to the scene's tolerance"
        );
        let plain = Aims::new(&graph, &[worst, other], Some(worst));
        assert!((plain.enough_m(worst, at, 1.0) - 0.9 * REACH).abs() < 1e-6);
        assert!((plain.enough_m(other, at, 1.0) - 0.5 * REACH).abs() < 1e-6);
        let model = WalkModel::uniform(&primary);
        let walked = plain.clone().weighed_by(&graph, &model);
        let fork = primary.out_edges(PoseId(1)).next().unwrap();
        assert!((walked.along(other, 1.0, fork) - 0.5).abs() < 1e-6);
        assert!((walked.along(worst, 1.0, fork) - 1.0).abs() < 1e-6, "whoever passes the worst");
        assert!((walked.enough_m(other, at, 0.9) - 0.5 * REACH / 0.9).abs() < 1e-6);
        assert!((walked.enough_m(other, at, 0.1) - 0.5).abs() < 1e-6, "never worse than before");
        let mut growth = Growth::default();
        for _ in 0..300 {
            growth.learn((0, 1), 0.01, 0.012);
        }
        let grown = plain.grown_by(&graph, &growth);
        let less = grown.enough_m(other, (PoseId(0), PoseId(1)), 1.0);
        assert!((less - 0.5 * REACH).abs() < 0.02, "both lie in one part of the clip: {less}");
    }
}

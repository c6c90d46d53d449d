//! Which dead ends are simulated next: one interface, three policies.
//!
//! `greedy` takes the largest merge error, as the paper does (Kim et al. 2013, section 3.2).
//! `visited` takes the largest error times the probability that a player passes the merge.
//! `predictive` takes the largest error that a merge is expected to grow into, learnt from the
//! merges undone so far. All add the penalty for crossing classes to the error. Under `visited` and
//! `predictive` the first job of every round still goes to the globally worst merge, so that
//! nothing starves; and expansions go only as far as they pay (see [`super::aim`]).
//!
//! A choice is a function of the records alone; what players walked enters as a record.

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use protocol::{EdgeId, PoseId, StateId};
use serde::{Deserialize, Serialize};

use super::aim::Aims;
use super::graph::Graph;
use super::record::SteerRecord;
use super::visits::Walk;
pub use super::visits::{visits, visits_at};
use crate::primary::PrimaryGraph;

/// What older counts are worth when a new batch of telemetry comes: half after seven batches.
const COUNTS_KEPT: f64 = 0.9;
/// A batch weighs at most as many traversals: eleven players for ten seconds. What is above
/// counts in proportion.
const BATCH_TRAVERSALS_MAX: f64 = 3300.0;
/// Every edge is taken to have been walked so often before anybody walked: a share of the players
/// does what nobody did yet.
const PRIOR_TRAVERSALS: f64 = 0.5;
/// No merge counts for less than this share of the mean merge's visits.
const VISITS_FLOOR: f64 = 0.01;
/// Share of the states that may be new before visits are computed afresh.
const VISITS_STALE: f64 = 0.02;
/// Frames of a clip that share what is learnt about growth.
const GROWTH_FRAMES: u32 = 8;
/// Observations that the mean of the clip (and of all clips) counts for.
const GROWTH_PRIOR: f64 = 4.0;
/// Largest factor, or its inverse, that one observation counts for.
const GROWTH_MAX: f64 = 8.0;

/// How dead ends are ranked; see the module.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Policy {
    /// The largest merge error first.
    #[default]
    Greedy,
    /// Error times the probability that a player passes.
    Visited,
    /// The error that is expected to be seen.
    Predictive,
}

impl Policy {
    /// As on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Greedy => "greedy",
            Self::Visited => "visited",
            Self::Predictive => "predictive",
        }
    }
}

impl fmt::Display for Policy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Policy {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        [Self::Greedy, Self::Visited, Self::Predictive]
            .into_iter()
            .find(|policy| policy.name() == text)
            .ok_or_else(|| format!("{text:?} is no policy; give greedy, visited or predictive"))
    }
}

/// Where players go: the probability of each edge, given its pose.
#[derive(Debug, Clone, PartialEq)]
pub struct WalkModel {
    primary: Arc<PrimaryGraph>,
    counts: Vec<f64>,
}

impl WalkModel {
    /// Everybody takes every way out of a pose equally often.
    pub fn uniform(primary: &Arc<PrimaryGraph>) -> Self {
        Self { primary: Arc::clone(primary), counts: vec![0.0; primary.edges().len()] }
    }

    /// Adds a batch of counts; older ones fade. An edge counts at most twice what led to its pose,
    /// since nobody can leave more often than arrive: counts that no walk could make are void.
    pub fn add(&mut self, batch: &[(EdgeId, u64)]) {
        let known = |(edge, _): &&(EdgeId, u64)| edge.index() < self.counts.len();
        let mut arrived = vec![0.0; self.primary.poses().len()];
        for (edge, count) in batch.iter().filter(known) {
            arrived[self.primary.edge(*edge).to.index()] += *count as f64;
        }
        let possible = |(edge, count): &(EdgeId, u64)| {
            let most = 2.0 * arrived[self.primary.edge(*edge).from.index()] + 2.0;
            (*edge, (*count as f64).min(most))
        };
        let batch: Vec<(EdgeId, f64)> = batch.iter().filter(known).map(possible).collect();
        let total: f64 = batch.iter().map(|(_, count)| count).sum();
        let scale = (BATCH_TRAVERSALS_MAX / total.max(1.0)).min(1.0);
        self.counts.iter_mut().for_each(|count| *count *= COUNTS_KEPT);
        for (edge, count) in batch {
            self.counts[edge.index()] += scale * count;
        }
    }

    /// The probability that whoever is at the edge's pose takes it.
    pub fn probability(&self, edge: EdgeId) -> f64 {
        let pose = self.primary.edge(edge).from;
        let weight = |edge: EdgeId| self.counts[edge.index()] + PRIOR_TRAVERSALS;
        weight(edge) / self.primary.out_edges(pose).map(weight).sum::<f64>()
    }

    /// How often a player is at each pose in the long run; sums to 1.
    pub fn poses(&self) -> Vec<f64> {
        let edges = (0u32..).zip(self.primary.edges());
        let links = edges.map(|(id, edge)| (edge.from.0, edge.to.0, self.probability(EdgeId(id))));
        let count = self.primary.poses().len();
        let walk = Walk::new(count, links.collect());
        let mut share = vec![1.0 / count as f64; count];
        walk.settle(&mut share, &mut |share| {
            let sum: f64 = share.iter().sum();
            share.iter_mut().for_each(|s| *s /= sum);
        });
        share
    }
}

/// How much merge errors grow, learnt from merges that were undone.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Growth {
    all: Mean,
    clips: BTreeMap<u16, Mean>,
    places: BTreeMap<(u16, u32), Mean>,
}

#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Mean {
    count: f64,
    sum: f64,
}

impl Mean {
    /// Drawn towards a prior while there is little to go by.
    fn towards(self, prior: f64) -> f64 {
        (self.sum + GROWTH_PRIOR * prior) / (self.count + GROWTH_PRIOR)
    }
}

impl Growth {
    /// An undone merge: its error (m), and the largest distance in the frames behind it between
    /// what was simulated and what had been played instead (m).
    pub fn learn(&mut self, (clip, frame): (u16, u32), error_m: f32, future_m: f32) {
        if error_m <= 0.0 {
            return;
        }
        let factor = f64::from(future_m / error_m).clamp(1.0 / GROWTH_MAX, GROWTH_MAX);
        let place = (clip, frame / GROWTH_FRAMES);
        let means = [
            &mut self.all,
            self.clips.entry(clip).or_default(),
            self.places.entry(place).or_default(),
        ];
        for mean in means {
            mean.count += 1.0;
            mean.sum += factor.ln();
        }
    }

    /// The factor by which an error is expected to grow there.
    pub fn factor(&self, (clip, frame): (u16, u32)) -> f64 {
        let mean = |mean: Option<&Mean>| mean.copied().unwrap_or_default();
        let clips = mean(self.clips.get(&clip)).towards(self.all.towards(0.0));
        mean(self.places.get(&(clip, frame / GROWTH_FRAMES))).towards(clips).exp()
    }
}

/// What steers an exploration, as a function of its records.
#[derive(Debug, Clone, PartialEq)]
pub struct Steering {
    policy: Policy,
    /// Only dead ends in these clips are simulated, if any are named.
    clips: Vec<u16>,
    model: WalkModel,
    telemetry: u64,
    growth: Growth,
    visits: Vec<f64>,
    stale: bool,
}

impl Steering {
    /// Greedy, with players who take every way equally often.
    pub fn new(primary: &Arc<PrimaryGraph>) -> Self {
        Self {
            policy: Policy::default(),
            clips: Vec::new(),
            model: WalkModel::uniform(primary),
            telemetry: 0,
            growth: Growth::default(),
            visits: Vec::new(),
            stale: true,
        }
    }

    /// The policy.
    pub fn policy(&self) -> Policy {
        self.policy
    }

    /// Clips to which the exploration is restricted; none: all.
    pub fn clips(&self) -> &[u16] {
        &self.clips
    }

    /// Where players go.
    pub fn model(&self) -> &WalkModel {
        &self.model
    }

    /// Number of the last batch of telemetry that was taken in; 0 for none.
    pub fn telemetry(&self) -> u64 {
        self.telemetry
    }

    /// What was learnt about the growth of errors.
    pub fn growth(&self) -> &Growth {
        &self.growth
    }

    /// Takes a record in.
    pub fn steer(&mut self, record: &SteerRecord) {
        self.policy = record.policy;
        self.clips.clone_from(&record.clips);
        self.telemetry = record.telemetry;
        if !record.counts.is_empty() {
            self.model.add(&record.counts);
            self.stale = true;
        }
    }

    /// A merge was undone; see [`Growth::learn`].
    pub fn learn(&mut self, graph: &Graph, pose: PoseId, error_m: f32, future_m: f32) {
        let pose = graph.primary().pose(pose);
        self.growth.learn((pose.clip, pose.frame), error_m, future_m);
    }

    /// The dead ends to be simulated next, at most `count`, among those that `free` allows.
    pub fn choose(
        &mut self,
        graph: &Graph,
        count: usize,
        free: &dyn Fn(StateId) -> bool,
    ) -> Vec<StateId> {
        if self.policy == Policy::Visited {
            self.look(graph);
        }
        self.rank(graph, count, free)
    }

    /// As [`Self::choose`], by visits as they were computed last.
    pub fn rank(
        &self,
        graph: &Graph,
        count: usize,
        free: &dyn Fn(StateId) -> bool,
    ) -> Vec<StateId> {
        let primary = Arc::clone(graph.primary());
        let inside = |state: &StateId| {
            let clip = primary.pose(graph.state(*state).pose).clip;
            (self.clips.is_empty() || self.clips.contains(&clip)) && free(*state)
        };
        let open = graph.queue().iter().map(|(state, _)| state).filter(inside);
        let open: Vec<(StateId, f64)> =
            open.map(|state| (state, f64::from(graph.cost_m(state)))).collect();
        let open: Vec<_> = open.into_iter().filter(|(_, cost_m)| *cost_m > 0.0).collect();
        if self.policy == Policy::Greedy {
            return best(open, count);
        }
        let mut chosen = best(open.clone(), 1);
        let ranked: Vec<_> = match self.policy {
            Policy::Visited => self.by_visits(graph, &open),
            _ => {
                let place = |state: StateId| {
                    let pose = primary.pose(graph.state(state).pose);
                    (pose.clip, pose.frame)
                };
                let expected = |(state, cost_m): &(StateId, f64)| {
                    (*state, cost_m * self.growth.factor(place(*state)).max(1.0))
                };
                open.iter().map(expected).collect()
            }
        };
        let others = ranked.into_iter().filter(|(state, _)| !chosen.contains(state)).collect();
        let others = best(others, count.saturating_sub(chosen.len()));
        chosen.extend(others);
        chosen
    }

    /// How far the expansions of these dead ends go, the first of them being the worst of all.
    pub fn aims(&self, graph: &Graph, chosen: &[StateId]) -> Aims {
        let aims = || Aims::new(graph, chosen, chosen.first().copied());
        match self.policy {
            Policy::Greedy => Aims::default(),
            Policy::Visited => aims().weighed_by(graph, &self.model),
            Policy::Predictive => aims().grown_by(graph, &self.growth),
        }
    }

    fn by_visits(&self, graph: &Graph, open: &[(StateId, f64)]) -> Vec<(StateId, f64)> {
        let visits: Vec<f64> =
            open.iter().map(|(state, _)| self.visits_of(graph, *state)).collect();
        let mean = visits.iter().sum::<f64>() / visits.len().max(1) as f64;
        let weigh = |(&(state, cost_m), visits): (&(StateId, f64), &f64)| {
            (state, cost_m * visits.max(VISITS_FLOOR * mean))
        };
        open.iter().zip(&visits).map(weigh).collect()
    }

    /// Computes visits afresh where the graph or the model has moved on.
    fn look(&mut self, graph: &Graph) {
        let states = graph.next_id().0 as usize;
        let fresh = self.visits.len() as f64 > (1.0 - VISITS_STALE) * states as f64;
        if self.stale || !fresh {
            self.visits = visits(graph, &self.model, &self.visits);
            self.stale = false;
        }
    }

    /// How often a player passes a dead end, by the last look; what is newer is counted from its
    /// nearest ancestor that is not.
    fn visits_of(&self, graph: &Graph, state: StateId) -> f64 {
        let mut factor = 1.0;
        let mut at = state;
        while at.index() >= self.visits.len() {
            let Some((parent, edge)) = graph.state(at).parent else { return 0.0 };
            factor *= self.model.probability(edge);
            at = parent;
        }
        factor * self.visits[at.index()]
    }
}

/// The first `count` by value, largest first; of equals the lowest ids.
fn best(mut all: Vec<(StateId, f64)>, count: usize) -> Vec<StateId> {
    all.sort_unstable_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    all.into_iter().take(count).map(|(state, _)| state).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grow::graph::tests::initial;
    use crate::grow::toy;

    fn edge(primary: &PrimaryGraph, from: u32, to: u32) -> EdgeId {
        let leads = |edge: &EdgeId| primary.edge(*edge).to == PoseId(to);
        primary.out_edges(PoseId(from)).find(leads).unwrap()
    }

    #[test]
    fn the_long_run_of_a_ring_with_a_branch_is_known() {
        // From p1 half go on to p2 (4 frames round), half by p5, p6, p7 (7 frames round).
        let primary = Arc::new(toy::figure_4());
        let model = WalkModel::uniform(&primary);
        let poses = model.poses();
        let round = 0.5 * 5.0 + 0.5 * 8.0;
        for (pose, expected) in [(0, 1.0), (1, 1.0), (2, 1.0), (5, 0.5), (7, 0.5)] {
            assert!((poses[pose] - expected / round).abs() < 1e-8, "{pose}: {}", poses[pose]);
        }
        let graph = initial(toy::figure_4());
        let visits = visits(&graph, &model, &[]);
        let interior: f64 = (0..10).filter(|s| ![5, 9].contains(s)).map(|s| visits[s]).sum();
        assert!((interior - 1.0).abs() < 1e-8);
        assert!((visits[9] - 0.5 / round).abs() < 1e-8, "half of the rounds pass c9");
        assert!((visits[5] - 1.0 / round).abs() < 1e-8, "every round passes c5");
    }

    #[test]
    fn players_move_the_choice_and_the_worst_is_never_forgotten() {
        let graph = initial(toy::figure_4());
        let primary = Arc::clone(graph.primary());
        let steer = |policy, counts: Vec<(EdgeId, u64)>| {
            let record = SteerRecord { policy, clips: Vec::new(), telemetry: 1, counts };
            let mut steering = Steering::new(&primary);
            steering.steer(&record);
            steering
        };
        let chosen = |mut steering: Steering, count| steering.choose(&graph, count, &|_| true);
        // c9 has 0.9 m, c5 0.5 m.
        assert_eq!(chosen(steer(Policy::Greedy, vec![]), 9), [StateId(9), StateId(5)]);
        assert_eq!(chosen(steer(Policy::Visited, vec![]), 1), [StateId(9)], "the worst is first");
        let only = |state: u64| move |other: StateId| other != StateId(state);
        let round = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 0)];
        let walked = round.map(|(a, b)| (edge(&primary, a, b), 400)).to_vec();
        let mut steering = steer(Policy::Visited, walked);
        steering.look(&graph);
        let all = [(StateId(5), 0.5), (StateId(9), 0.9)];
        let ranked = best(steering.by_visits(&graph, &all), 2);
        assert_eq!(ranked, [StateId(5), StateId(9)], "nobody goes by p5 any more");
        assert_eq!(steering.choose(&graph, 2, &only(9)), [StateId(5)]);
        let mut restricted = steer(Policy::Greedy, vec![]);
        restricted.clips = vec![7];
        assert!(restricted.choose(&graph, 2, &|_| true).is_empty());
    }

    #[test]
    fn counts_that_no_walk_could_make_change_nearly_nothing() {
        let primary = Arc::new(toy::knot());
        let mut honest = WalkModel::uniform(&primary);
        let round: Vec<(EdgeId, u64)> =
            [(0, 1), (1, 2), (2, 0)].map(|(a, b)| (edge(&primary, a, b), 300)).into();
        let mut cheated = honest.clone();
        honest.add(&round);
        let absurd = edge(&primary, 4, 5);
        let batch = [&round[..], &[(absurd, u64::MAX), (EdgeId(9_999), 7)]].concat();
        cheated.add(&batch);
        for (a, b) in honest.poses().into_iter().zip(cheated.poses()) {
            assert!((a - b).abs() < 0.01, "{a} became {b}");
        }
    }

    #[test]
    fn growth_is_learnt_where_it_was_seen() {
        let mut growth = Growth::default();
        assert!((growth.factor((3, 40)) - 1.0).abs() < 1e-12);
        for _ in 0..200 {
            growth.learn((3, 41), 0.01, 0.04);
            growth.learn((4, 0), 0.02, 0.01);
            growth.learn((4, 0), 0.0, 1.0);
        }
        assert!((growth.factor((3, 40)) - 4.0).abs() < 0.1);
        assert!((growth.factor((4, 7)) - 0.5).abs() < 0.02);
        let unseen = growth.factor((9, 0));
        assert!(unseen > 1.0 && unseen < 2.0, "{unseen}: between the two");
    }
}

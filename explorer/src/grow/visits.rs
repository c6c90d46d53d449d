//! How often players pass every state in the long run: the stationary distribution of the walk that
//! takes every edge with its probability, through merges.

use protocol::{PoseId, StateId};

use super::graph::Graph;
use super::policy::WalkModel;
use super::view::KindAt;

/// Shares that together move by less than this in a sweep have settled.
const SETTLED: f64 = 1e-9;
/// Most sweeps: a graph that needs more is left where it stands.
const SWEEPS_MAX: usize = 2000;
/// Part of the way that a sweep goes. Less than all of it, since a sweep may have a period, as a ring has.
const DAMPING: f64 = 0.9;
/// Smaller shares count as none; what nobody comes to fades, and must not become subnormal on its way.
const NEVER: f64 = 1e-30;

/// Places with links between them, each taken with a probability.
#[derive(Debug)]
pub(super) struct Walk {
    /// By place: where its part of `links` begins; one more, for the end of the last.
    first: Vec<u32>,
    /// Source and probability of links, by target.
    links: Vec<(u32, f64)>,
}

impl Walk {
    /// Of links by source, target and probability; those out of a place sum to 1.
    pub fn new(count: usize, links: Vec<(u32, u32, f64)>) -> Self {
        let mut first = vec![0u32; count + 1];
        links.iter().for_each(|(_, to, _)| first[*to as usize + 1] += 1);
        for place in 0..count {
            first[place + 1] += first[place];
        }
        let mut next = first.clone();
        let mut by_target = vec![(0, 0.0); links.len()];
        for (from, to, probability) in links {
            let place = &mut next[to as usize];
            by_target[*place as usize] = (from, probability);
            *place += 1;
        }
        Self { first, links: by_target }
    }

    /// Moves shares until nothing changes any more; `scale` is called before every sweep and at the end.
    /// Says how many sweeps it took.
    ///
    /// Gauss-Seidel: a place is given what comes to it by the shares of this sweep already. Places that follow on
    /// each other have rising numbers, so a sweep carries shares along a whole trajectory.
    pub fn settle(&self, share: &mut [f64], scale: &mut dyn FnMut(&mut [f64])) -> usize {
        scale(share);
        let mut before = share.to_vec();
        for sweep in 1..=SWEEPS_MAX {
            for place in 0..share.len() {
                let links = self.first[place] as usize..self.first[place + 1] as usize;
                let coming = self.links[links].iter().map(|(from, p)| share[*from as usize] * p);
                share[place] = coming.sum();
            }
            for (share, before) in share.iter_mut().zip(&before) {
                let damped = before + DAMPING * (*share - before);
                *share = if damped < NEVER { 0.0 } else { damped };
            }
            scale(share);
            let moved: f64 = share.iter().zip(&before).map(|(a, b)| (a - b).abs()).sum();
            if moved < SETTLED {
                return sweep;
            }
            before.copy_from_slice(share);
        }
        SWEEPS_MAX
    }
}

/// How often players pass every state of the newest graph, dead ends included; all interior states
/// together: 1. `before`: what this gave when there were fewer states, or nothing.
pub fn visits(graph: &Graph, model: &WalkModel, before: &[f64]) -> Vec<f64> {
    visits_at(graph, graph.commit(), model, before)
}

/// As [`visits`], in the graph as it was after a commit since the initial pass.
pub fn visits_at(graph: &Graph, commit: u64, model: &WalkModel, before: &[f64]) -> Vec<f64> {
    // What follows on a pose does not depend on the cloth: poses have the same shares whatever the states.
    let poses = model.poses();
    let states = graph.moments()[commit as usize].states;
    let of_pose = (0..poses.len() as u32).map(|pose| graph.interior_at(PoseId(pose), commit));
    let interior: Vec<&[StateId]> = of_pose.collect();
    let mut share = vec![0.0; states as usize];
    for interior in &interior {
        for state in *interior {
            // What is new since the last look gets its share within a sweep or two.
            let warm = match before {
                [] => 1.0 / interior.len() as f64,
                before => before.get(state.index()).copied().unwrap_or(0.0),
            };
            share[state.index()] = warm + 1e-12;
        }
    }
    let (links, dead_ends) = links(graph, (commit, states), model);
    Walk::new(share.len(), links).settle(&mut share, &mut |share| {
        for (interior, wanted) in interior.iter().zip(&poses) {
            let sum: f64 = interior.iter().map(|state| share[state.index()]).sum();
            let factor = if sum > 0.0 { wanted / sum } else { 0.0 };
            interior.iter().for_each(|state| share[state.index()] *= factor);
        }
    });
    for (dead_end, from, probability) in dead_ends {
        share[dead_end.index()] = share[from.index()] * probability;
    }
    share
}

/// Links between interior states, and dead ends with what leads to them.
type Links = (Vec<(u32, u32, f64)>, Vec<(StateId, StateId, f64)>);

fn links(graph: &Graph, (commit, states): (u64, u64), model: &WalkModel) -> Links {
    let (mut links, mut dead_ends) = (Vec::new(), Vec::new());
    for id in (0..states).map(StateId) {
        let KindAt::Interior(next) = graph.kind_at(id, commit) else { continue };
        for (edge, child) in graph.primary().out_edges(graph.state(id).pose).zip(next.iter()) {
            let probability = model.probability(edge);
            let to = match graph.kind_at(child, commit) {
                KindAt::DeadEnd(target, _) => {
                    dead_ends.push((child, id, probability));
                    target
                }
                _ => child,
            };
            links.push((id.0 as u32, to.0 as u32, probability));
        }
    }
    (links, dead_ends)
}

//! What will be needed soon: the primary graph is followed ahead of each cursor, the likeliest
//! ways first.
//!
//! A pure function of cursors, version and what is resident: equal inputs, equal wants.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap, HashSet};

use protocol::manifest::ChunkRef;
use protocol::{ChunkHash, EdgeId, StateId};

use crate::cache::Resident;
use crate::version::{Version, decoded_bytes};

/// How far to look ahead.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Horizon {
    /// Frames ahead of each cursor. Default 75: two and a half seconds at 30 fps cover a slow
    /// connection's round trips many times over.
    pub frames: u32,
    /// States followed per cursor: bounds the work. Default 2,000, well under a millisecond.
    pub states_max: usize,
    /// Ways less likely than this are not followed. Default 1/500.
    pub probability_min: f32,
}

impl Default for Horizon {
    fn default() -> Self {
        Self { frames: 75, states_max: 2_000, probability_min: 0.002 }
    }
}

/// How likely each edge is, relative to the others out of the same pose.
#[derive(Debug, Clone, Default)]
pub struct EdgeWeights(Vec<u32>);

impl EdgeWeights {
    /// Counts walked edges.
    pub fn add(&mut self, edge: EdgeId, count: u32) {
        if self.0.len() <= edge.index() {
            self.0.resize(edge.index() + 1, 0);
        }
        self.0[edge.index()] = self.0[edge.index()].saturating_add(count);
    }

    /// One more than was counted, so that no edge is ruled out; uniform without counts.
    fn weight(&self, edge: EdgeId) -> f32 {
        self.0.get(edge.index()).map_or(1.0, |count| 1.0 + *count as f32)
    }
}

/// A chunk that lies ahead of a cursor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ahead {
    /// The chunk.
    pub chunk: ChunkRef,
    /// About what it takes in memory once it is decoded, in bytes.
    pub decoded_bytes: usize,
    /// The soonest that a cursor can be there, in frames; 0 where one already stands.
    pub frames: u32,
    /// How likely one comes there on that way.
    pub probability: f32,
    /// Whether all its states that lie ahead are resident.
    pub resident: bool,
}

/// What to do about the chunks ahead.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Plan {
    /// To be fetched, the most pressing first.
    pub fetch: Vec<Ahead>,
    /// Not to be evicted: what is ahead and here, and what will be.
    pub keep: BTreeSet<ChunkHash>,
}

/// The most pressing chunks that fit into `budget_bytes` together once they are decoded: the rest would
/// only push each other out.
pub fn plan(ahead: &[Ahead], budget_bytes: usize) -> Plan {
    let mut plan = Plan::default();
    let mut planned_bytes = 0;
    for chunk in ahead {
        planned_bytes += chunk.decoded_bytes;
        if planned_bytes > budget_bytes && !plan.keep.is_empty() {
            break;
        }
        plan.keep.insert(chunk.chunk.hash);
        if !chunk.resident {
            plan.fetch.push(*chunk);
        }
    }
    plan
}

/// A state ahead of a cursor. Ordered by probability, then nearness, then id.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Place {
    /// Bits of a positive `f32`, which are in the order of the numbers.
    probability: u32,
    frames: Reverse<u32>,
    state: Reverse<StateId>,
}

/// The streamed chunks that lie ahead, the most pressing first; those of the initial graph only
/// where they are not resident.
pub fn ahead(
    version: &Version,
    resident: &Resident,
    cursors: &[StateId],
    weights: &EdgeWeights,
    horizon: &Horizon,
) -> Vec<Ahead> {
    let mut found = BTreeMap::new();
    for cursor in cursors {
        let search = Search { version, resident, weights, horizon, found: &mut found };
        search.run(*cursor);
    }
    let mut all: Vec<Ahead> = found.into_values().collect();
    // An unlikely way may wait for as many frames longer as it is less likely.
    let pressing = |a: &Ahead| (a.frames as f32 + 1.0) / a.probability;
    all.sort_by(|a, b| pressing(a).total_cmp(&pressing(b)).then(a.chunk.hash.cmp(&b.chunk.hash)));
    all
}

struct Search<'a> {
    version: &'a Version,
    resident: &'a Resident,
    weights: &'a EdgeWeights,
    horizon: &'a Horizon,
    found: &'a mut BTreeMap<ChunkHash, Ahead>,
}

impl Search<'_> {
    fn run(mut self, cursor: StateId) {
        let Some(start) = self.version.links().resume(cursor) else { return };
        let mut open = BinaryHeap::new();
        let mut seen = HashSet::new();
        open.push(Place { probability: 1f32.to_bits(), frames: Reverse(0), state: Reverse(start) });
        while let Some(Place { probability, frames, state }) = open.pop() {
            let (probability, frames, state) = (f32::from_bits(probability), frames.0, state.0);
            if !seen.insert(state) {
                continue;
            }
            if seen.len() > self.horizon.states_max {
                break;
            }
            self.find(state, frames, probability);
            if frames < self.horizon.frames {
                self.look_on(&mut open, state, frames + 1, probability);
            }
        }
    }

    /// Opens the successors of a state.
    fn look_on(
        &mut self,
        open: &mut BinaryHeap<Place>,
        state: StateId,
        frames: u32,
        probability: f32,
    ) {
        let (scene, links) = (self.version.scene(), self.version.links());
        let Some(pose) = links.pose(state) else { return };
        let sum: f32 = scene.out_edges(pose).map(|edge| self.weights.weight(edge)).sum();
        for (slot, edge) in scene.out_edges(pose).enumerate() {
            let probability = probability * self.weights.weight(edge) / sum;
            let Some(follow) = links.follow(state, slot) else { continue };
            if probability < self.horizon.probability_min {
                continue;
            }
            if let Some((dead_end, _)) = follow.via {
                self.find(dead_end, frames, probability);
            }
            open.push(Place {
                probability: probability.to_bits(),
                frames: Reverse(frames),
                state: Reverse(follow.state),
            });
        }
    }

    fn find(&mut self, state: StateId, frames: u32, probability: f32) {
        let Some(region) = self.version.region_chunk(state) else { return };
        let resident = self.resident.has(state);
        if resident && region.initial {
            return;
        }
        let (chunk, decoded_bytes) = (region.chunk, decoded_bytes(self.version.listing(), region));
        let found = Ahead { chunk, decoded_bytes, frames, probability, resident };
        let known = self.found.entry(chunk.hash).or_insert(found);
        known.frames = known.frames.min(frames);
        known.probability = known.probability.max(probability);
        known.resident &= resident;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tiny;

    #[test]
    fn the_chunk_ahead_is_found_at_its_distance_and_the_initial_graph_needs_none() {
        let version = tiny::version(2, tiny::grown_links());
        let view = tiny::view(&version, &[0]);
        let ask = |cursor: u64, weights: &EdgeWeights| {
            ahead(&version, &view.resident, &[StateId(cursor)], weights, &Horizon::default())
        };
        // From 0: edge 1 to state 1, then to 3 (resident), then to 4 or 5 in the second chunk.
        let found = ask(0, &EdgeWeights::default());
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].chunk.hash, tiny::region_chunk(1));
        assert_eq!((found[0].frames, found[0].resident), (3, false));
        assert!((found[0].probability - 0.25).abs() < 1e-6, "{found:?}");
        assert_eq!(ask(3, &EdgeWeights::default())[0].frames, 1);
        // Players who always take edge 1 make it likelier.
        let mut weights = EdgeWeights::default();
        weights.add(EdgeId(1), 8);
        assert!((ask(0, &weights)[0].probability - 0.9 * 0.9).abs() < 1e-6);
        let all = tiny::view(&version, &[0, 1]);
        let found = ahead(&version, &all.resident, &[StateId(0)], &weights, &Horizon::default());
        assert!(found.len() == 1 && found[0].resident);
    }

    #[test]
    fn equal_inputs_give_equal_answers() {
        let version = tiny::version(2, tiny::grown_links());
        let view = tiny::view(&version, &[]);
        let cursors = [StateId(5), StateId(0), StateId(1_000_000)];
        let ask = || {
            let weights = EdgeWeights::default();
            ahead(&version, &view.resident, &cursors, &weights, &Horizon::default())
        };
        let first = ask();
        assert_eq!(first.len(), 2, "a cursor that does not exist is ignored");
        assert!((0..10).all(|_| ask() == first));
        assert_eq!(first[0].frames, 0, "where a cursor stands comes first");
    }

    #[test]
    fn a_plan_takes_what_fits_and_never_nothing() {
        let chunk = |id: u8, resident| {
            // What travels is a tenth of what is held.
            let chunk = ChunkRef { hash: ChunkHash([id; 32]), bytes: 10 };
            Ahead { chunk, decoded_bytes: 100, frames: 0, probability: 1.0, resident }
        };
        let all = [chunk(1, true), chunk(2, false), chunk(3, false)];
        let plan_250 = plan(&all, 250);
        assert_eq!(plan_250.fetch, [chunk(2, false)]);
        assert_eq!(plan_250.keep.len(), 2);
        assert_eq!(plan(&all[1..], 10).fetch, [chunk(2, false)]);
    }
}

//! Which chunks a garment wants now.

use std::collections::{BTreeMap, BTreeSet};

use protocol::ChunkHash;
use protocol::manifest::ChunkRef;

use super::{GarmentLoader, Need};
use crate::prefetch;
use crate::version::decoded_bytes;

/// Of the cache's budget, the share that is planned for; the rest is for what decoding adds.
const PLANNED_SHARE: f32 = 0.8;
/// What lies at most this many frames ahead is urgent.
const URGENT_FRAMES: u32 = 30;

impl GarmentLoader {
    /// Looks ahead of the cursors, and adds every chunk that is lacking to `wants`.
    pub fn plan(&mut self, wants: &mut BTreeMap<ChunkHash, (ChunkRef, Need)>) {
        let budget_bytes = self.planned_bytes_max();
        self.look_ahead(budget_bytes);
        let mut add = |chunk: ChunkRef, need: Need| {
            if !self.is_refused(&chunk.hash) {
                let want = wants.entry(chunk.hash).or_insert((chunk, need));
                want.1 = want.1.min(need);
            }
        };
        if let Some((_, next)) = &self.next {
            let cache = self.next_cache.as_ref().unwrap_or(&self.cache);
            // First cloth needs the leading columns alone: the others come after them.
            let first = self.current.is_none();
            let later = next.generations.iter().skip(1);
            let later: BTreeSet<ChunkHash> =
                later.filter(|_| first).map(|generation| generation.chunk.hash).collect();
            self.parts.lacking(next, |chunk| {
                let is_later = later.contains(&chunk.hash);
                add(chunk, if is_later { Need::Urgent } else { Need::Version });
            });
            let initial = next.regions.iter().filter(|region| region.initial);
            let here = |chunk| cache.contains(chunk) || self.parts.regions.contains_key(chunk);
            let lacking = initial.filter(|region| !here(&region.chunk.hash));
            lacking.for_each(|region| add(region.chunk, Need::Version));
        }
        let Some(version) = &self.current else { return };
        for chunk in &self.plan.fetch {
            let soon = if chunk.frames <= URGENT_FRAMES { Need::Urgent } else { Need::Soon };
            add(chunk.chunk, soon);
        }
        if let Some(upsampler) = self.lacking_upsampler() {
            add(upsampler, Need::Soon);
        }
        // Whatever fits without pushing anything out.
        let mut filled = self.cache.resident_bytes() - self.cache.initial_bytes();
        filled += self.plan.fetch.iter().map(|ahead| ahead.decoded_bytes).sum::<usize>();
        for region in &version.listing().regions {
            let hash = &region.chunk.hash;
            if !self.cache.contains(hash) && !self.plan.keep.contains(hash) {
                filled += decoded_bytes(version.listing(), region);
                if filled > budget_bytes {
                    break;
                }
                add(region.chunk, Need::Idle);
            }
        }
    }

    /// Whether everything is here that the last plan found ahead of the cursors.
    pub fn is_ahead(&self) -> bool {
        self.plan.fetch.iter().all(|ahead| self.is_refused(&ahead.chunk.hash))
    }

    /// Makes the plan anew.
    fn look_ahead(&mut self, budget_bytes: usize) {
        let (Some(version), Some(view)) = (&self.current, self.stage.view()) else { return };
        let cursors = self.stage.cursors();
        let ahead =
            prefetch::ahead(version, &view.resident, &cursors, &self.weights, &self.horizon);
        let plan = prefetch::plan(&ahead, budget_bytes);
        // What did not fit beside what was kept may fit beside something else.
        if plan.keep != self.plan.keep {
            self.unfit.clear();
        }
        self.plan = plan;
    }

    /// Expected bytes that may be planned for: where chunks have turned out larger than expected, the
    /// next ones will.
    fn planned_bytes_max(&self) -> usize {
        let [taken, expected] = self.decoded.map(|bytes| bytes as f32);
        let growth = if expected > 0.0 { (taken / expected).max(1.0) } else { 1.0 };
        (self.budget_bytes as f32 * PLANNED_SHARE / growth) as usize
    }

    fn is_refused(&self, chunk: &ChunkHash) -> bool {
        [&self.refused, &self.missing, &self.unfit].iter().any(|refused| refused.contains(chunk))
    }
}

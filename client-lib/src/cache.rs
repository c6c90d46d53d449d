//! Decoded regions in memory, within a budget.
//!
//! The driver owns the [`Cache`]; the frame loop reads immutable [`Resident`] snapshots of it, so
//! that neither waits for the other. What is evicted stays valid in snapshots that still hold it.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use codec::VertexFix;
use codec::toile::TIERS;
use protocol::{ChunkHash, StateId};

/// Coefficients of consecutive states, as decoded: 16 bits each, in steps of full scale.
#[derive(Debug)]
pub struct Region {
    first_state: StateId,
    state_count: usize,
    columns: usize,
    coefficients: Vec<i16>,
    /// Vertices that are moved after reconstruction, by state.
    fixes: Vec<VertexFix>,
    /// Columns that carry most here, the first of them first: as many as the largest tier.
    by_energy: Vec<u16>,
    /// Largest vertex error (m) of each of [`TIERS`], where the publisher states it.
    tier_errors_m: Option<[f32; TIERS.len()]>,
    /// Largest vertex error (m), where only the leading columns are known so far.
    leading_error_m: Option<f32>,
    chunk_use: Arc<AtomicU64>,
}

/// What a shorter list of columns shows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TierColumns<'a> {
    /// The columns that carry most in the state's region, the first of them first; empty where
    /// all of them are asked for or nothing is known.
    pub columns: &'a [u16],
    /// Largest vertex error (m) of the region with these, as the publisher measured it.
    pub error_m: f32,
}

impl Region {
    /// Takes `state_count` rows of `columns` coefficients each.
    ///
    /// # Panics
    /// If there is no column, or no whole number of rows.
    pub fn new(first_state: StateId, columns: usize, coefficients: Vec<i16>) -> Self {
        assert!(columns > 0 && coefficients.len().is_multiple_of(columns), "whole rows");
        let state_count = coefficients.len() / columns;
        Self {
            first_state,
            state_count,
            columns,
            coefficients,
            fixes: Vec::new(),
            by_energy: Vec::new(),
            tier_errors_m: None,
            leading_error_m: None,
            chunk_use: Arc::default(),
        }
    }

    /// With the columns that carry most, and the error (m) of each of [`TIERS`].
    pub fn with_tiers(mut self, by_energy: &[u16], errors_m: Option<[f32; TIERS.len()]>) -> Self {
        let kept = by_energy.len().min(TIERS[TIERS.len() - 1]);
        self.by_energy = by_energy[..kept].to_vec();
        self.tier_errors_m = errors_m;
        self
    }

    /// With the error (m) of the leading columns, which are all that is known so far.
    pub fn of_leading_columns(self, error_m: f32) -> Self {
        Self { leading_error_m: Some(error_m), ..self }
    }

    /// With vertices that are moved after reconstruction, sorted by state.
    pub fn with_fixes(self, fixes: Vec<VertexFix>) -> Self {
        Self { fixes, ..self }
    }

    /// Its first state.
    pub fn first_state(&self) -> StateId {
        self.first_state
    }

    /// How many states follow each other here.
    pub fn state_count(&self) -> usize {
        self.state_count
    }

    /// Memory held, in bytes.
    pub fn bytes(&self) -> usize {
        let fixes = size_of::<VertexFix>() * self.fixes.capacity();
        let numbers = self.coefficients.capacity() + self.by_energy.capacity();
        size_of::<Self>() + 2 * numbers + fixes
    }

    /// About what `states` take once they are decoded over `columns`, in bytes, fixes apart.
    pub fn bytes_expected(states: usize, columns: usize) -> usize {
        // Regions hold 16 to 32 states.
        let regions = states.div_ceil(16);
        2 * states * columns
            + regions * (size_of::<Self>() + 2 * TIERS[TIERS.len() - 1].min(columns))
    }

    /// Whether a state lies here.
    fn contains(&self, state: StateId) -> bool {
        state >= self.first_state && state.0 - self.first_state.0 < self.state_count as u64
    }

    /// Writes the coefficients of the `index`-th state into the head of `out`, zeros after them.
    /// Columns that `out` has no room for are left out.
    fn expand(&self, index: usize, out: &mut [f32]) {
        let row = &self.coefficients[index * self.columns..][..self.columns];
        let kept = self.columns.min(out.len());
        let (head, tail) = out.split_at_mut(kept);
        for (out, c) in head.iter_mut().zip(row) {
            *out = f32::from(*c) * (1.0 / codec::kim2013::FULL_SCALE);
        }
        tail.fill(0.0);
    }
}

/// A snapshot of what is decoded: immutable, cheap to share.
#[derive(Debug, Default)]
pub struct Resident {
    /// By first state; where two begin at the same state, the longer one.
    regions: Vec<Arc<Region>>,
    clock: Arc<AtomicU64>,
}

impl Resident {
    /// Whether a state's coefficients are here.
    pub fn has(&self, state: StateId) -> bool {
        self.find(state).is_some()
    }

    /// Writes a state's coefficients [fractions of full scale] into `out` and notes that they were
    /// used; `false`, and `out` untouched, where they are not here.
    pub fn read(&self, state: StateId, out: &mut [f32]) -> bool {
        let Some(region) = self.find(state) else { return false };
        region.chunk_use.store(self.clock.fetch_add(1, Ordering::Relaxed) + 1, Ordering::Relaxed);
        region.expand((state.0 - region.first_state.0) as usize, out);
        true
    }

    /// Appends the vertices of a state that are moved after reconstruction, and by how much (m).
    pub fn fixes(&self, state: StateId, out: &mut Vec<(u32, [f32; 3])>) {
        let Some(region) = self.find(state) else { return };
        let index = (state.0 - region.first_state.0) as usize;
        let first = region.fixes.partition_point(|fix| usize::from(fix.state) < index);
        let own = region.fixes[first..].iter().take_while(|fix| usize::from(fix.state) == index);
        out.extend(own.map(|fix| (fix.vertex, fix.offset_m)));
    }

    /// Which columns a tier of so many decodes for a state, and their error; `None` where the state
    /// is not here or its publisher states no tiers.
    pub fn tier(&self, state: StateId, columns: usize) -> Option<TierColumns<'_>> {
        let region = self.find(state)?;
        let errors_m = region.tier_errors_m?;
        let Some(tier) = TIERS.iter().position(|tier| *tier >= columns) else {
            return Some(TierColumns { columns: &[], error_m: 0.0 });
        };
        let kept = region.by_energy.len().min(TIERS[tier]);
        Some(TierColumns { columns: &region.by_energy[..kept], error_m: errors_m[tier] })
    }

    /// The shortest tier of a state whose stated error is at most `error_m`; empty columns where all are needed
    /// or nothing is stated.
    pub fn tier_within(&self, state: StateId, error_m: f32) -> TierColumns<'_> {
        let all = TierColumns { columns: &[], error_m: 0.0 };
        let tiers = TIERS.iter().filter_map(|columns| self.tier(state, *columns));
        tiers.into_iter().find(|tier| tier.error_m <= error_m).unwrap_or(all)
    }

    /// Largest vertex error (m) of a state of which only the leading columns are known so far.
    pub fn leading_error_m(&self, state: StateId) -> Option<f32> {
        self.find(state)?.leading_error_m
    }

    fn find(&self, state: StateId) -> Option<&Region> {
        let after = self.regions.partition_point(|r| r.first_state <= state);
        // A tail that was extended by a later version may lie under its longer successor.
        let near = self.regions[..after].iter().rev().take(2);
        near.map(Arc::as_ref).find(|region| region.contains(state))
    }
}

/// A chunk of regions in the cache.
#[derive(Debug)]
struct Held {
    regions: Vec<Arc<Region>>,
    bytes: usize,
    initial: bool,
    last_use: Arc<AtomicU64>,
}

/// Decoded chunks of one garment, by name. Evicts the chunk that was used longest ago; never one
/// of the initial graph, never one that is pinned.
#[derive(Debug)]
pub struct Cache {
    budget_bytes: usize,
    held: BTreeMap<ChunkHash, Held>,
    initial_bytes: usize,
    streamed_bytes: usize,
    clock: Arc<AtomicU64>,
}

impl Cache {
    /// An empty cache. `budget_bytes` bounds what is streamed; the initial graph, which always
    /// stays, is counted apart (see [`Cache::initial_bytes`]).
    pub fn new(budget_bytes: usize) -> Self {
        Self {
            budget_bytes,
            held: BTreeMap::new(),
            initial_bytes: 0,
            streamed_bytes: 0,
            clock: Arc::default(),
        }
    }

    /// Whether a chunk is here.
    pub fn contains(&self, chunk: &ChunkHash) -> bool {
        self.held.contains_key(chunk)
    }

    /// Takes a decoded chunk in, and evicts others until the budget holds. `pinned` are the
    /// chunks in which cursors stand.
    ///
    /// Returns `false`, and keeps nothing, where the chunk does not fit beside what is pinned.
    pub fn insert(
        &mut self,
        chunk: ChunkHash,
        regions: Vec<Region>,
        initial: bool,
        pinned: &BTreeSet<ChunkHash>,
    ) -> bool {
        if self.contains(&chunk) {
            return true;
        }
        let bytes = regions.iter().map(Region::bytes).sum();
        if !initial && !self.make_room(bytes, pinned) {
            return false;
        }
        let now = self.clock.fetch_add(1, Ordering::Relaxed) + 1;
        let last_use = Arc::new(AtomicU64::new(now));
        let share = |mut region: Region| {
            region.chunk_use = Arc::clone(&last_use);
            Arc::new(region)
        };
        let regions = regions.into_iter().map(share).collect();
        self.held.insert(chunk, Held { regions, bytes, initial, last_use: Arc::clone(&last_use) });
        if initial {
            self.initial_bytes += bytes;
        } else {
            self.streamed_bytes += bytes;
        }
        true
    }

    /// Forgets everything: the coefficients of another basis mean nothing here.
    pub fn clear(&mut self) {
        self.held.clear();
        self.initial_bytes = 0;
        self.streamed_bytes = 0;
    }

    /// Forgets chunks of the initial graph that `keep` does not name: their version is gone.
    pub fn retain_initial(&mut self, keep: &BTreeSet<ChunkHash>) {
        let gone = |hash: &ChunkHash, held: &Held| held.initial && !keep.contains(hash);
        let stale: Vec<ChunkHash> =
            self.held.iter().filter(|(hash, held)| gone(hash, held)).map(|(h, _)| *h).collect();
        for hash in stale {
            self.remove(&hash);
        }
    }

    /// Bytes of decoded regions, the initial graph included.
    pub fn resident_bytes(&self) -> usize {
        self.initial_bytes + self.streamed_bytes
    }

    /// Bytes that streamed regions may take.
    pub fn budget_bytes(&self) -> usize {
        self.budget_bytes
    }

    /// Bytes of the initial graph's regions.
    pub fn initial_bytes(&self) -> usize {
        self.initial_bytes
    }

    /// A snapshot for the frame loop. Cost: linear in the number of regions.
    pub fn snapshot(&self) -> Resident {
        let mut regions: Vec<Arc<Region>> =
            self.held.values().flat_map(|held| held.regions.iter().cloned()).collect();
        regions.sort_by_key(|r| (r.first_state, std::cmp::Reverse(r.state_count)));
        regions.dedup_by_key(|r| r.first_state);
        Resident { regions, clock: Arc::clone(&self.clock) }
    }

    fn make_room(&mut self, bytes: usize, pinned: &BTreeSet<ChunkHash>) -> bool {
        let free = |(hash, held): &(&ChunkHash, &Held)| !held.initial && !pinned.contains(hash);
        while self.streamed_bytes + bytes > self.budget_bytes {
            let oldest = self
                .held
                .iter()
                .filter(free)
                .min_by_key(|(_, held)| held.last_use.load(Ordering::Relaxed))
                .map(|(hash, _)| *hash);
            let Some(oldest) = oldest else { return false };
            self.remove(&oldest);
        }
        true
    }

    fn remove(&mut self, chunk: &ChunkHash) {
        let Some(held) = self.held.remove(chunk) else { return };
        if held.initial {
            self.initial_bytes -= held.bytes;
        } else {
            self.streamed_bytes -= held.bytes;
        }
    }
}

#[cfg(test)]
mod tests {
    use rand_core::{Rng, SeedableRng};
    use rand_pcg::Pcg64;

    use super::*;

    fn hash(of: u64) -> ChunkHash {
        ChunkHash::of(&of.to_le_bytes())
    }

    fn region(first: u64, value: i16) -> Region {
        Region::new(StateId(first), 10, vec![value; 40])
    }

    fn fits(count: usize) -> usize {
        count * region(0, 1000).bytes()
    }

    #[test]
    fn a_state_is_read_with_zeros_for_columns_it_does_not_know() {
        let region = Region::new(StateId(7), 2, vec![32_767, 0, -32_767, 0]);
        let mut out = [9.0; 4];
        region.expand(1, &mut out);
        assert_eq!(out, [-1.0, 0.0, 0.0, 0.0]);
        region.expand(0, &mut out[..1]);
        assert_eq!(out[0], 1.0);
    }

    #[test]
    fn a_tier_is_the_next_one_that_has_enough_columns() {
        let mut cache = Cache::new(1 << 20);
        let by_energy: Vec<u16> = (0..60).rev().collect();
        let tiers = region(0, 1).with_tiers(&by_energy, Some([0.04, 0.03, 0.0, 0.0]));
        cache.insert(hash(0), vec![tiers], true, &BTreeSet::new());
        let resident = cache.snapshot();
        let tier = |columns| resident.tier(StateId(1), columns).unwrap();
        assert_eq!((tier(10).columns, tier(10).error_m), (&by_energy[..16], 0.04));
        assert_eq!((tier(17).columns, tier(17).error_m), (&by_energy[..32], 0.03));
        assert_eq!(tier(64).columns.len(), 60);
        assert_eq!((tier(129).columns.len(), tier(129).error_m), (0, 0.0));
        assert_eq!(resident.tier(StateId(9), 16), None);
        let within = |error_m| resident.tier_within(StateId(1), error_m).columns.len();
        assert_eq!([0.04, 0.039, 0.03, 0.01].map(within), [16, 32, 32, 60]);
    }

    #[test]
    fn the_budget_holds_whatever_comes() {
        let mut cache = Cache::new(fits(5) + 3);
        let mut random = Pcg64::seed_from_u64(2);
        let none = BTreeSet::new();
        for _ in 0..500 {
            let first = u64::from(random.next_u32() % 40) * 4;
            cache.insert(hash(first), vec![region(first, 1000)], false, &none);
            assert!(cache.resident_bytes() <= fits(5) + 3);
            assert!(cache.snapshot().has(StateId(first)));
        }
        assert_eq!(cache.held.len(), 5, "and is used");
    }

    #[test]
    fn what_is_pinned_initial_or_just_used_stays() {
        let mut cache = Cache::new(fits(2));
        let none = BTreeSet::new();
        cache.insert(hash(0), vec![region(0, 1000)], true, &none);
        cache.insert(hash(4), vec![region(4, 1000)], false, &none);
        cache.insert(hash(8), vec![region(8, 1000)], false, &none);
        let mut out = [0.0; 10];
        assert!(cache.snapshot().read(StateId(4), &mut out));
        cache.insert(hash(12), vec![region(12, 1000)], false, &none);
        assert!(!cache.contains(&hash(8)), "8 was used longest ago");
        let pinned = BTreeSet::from([hash(4), hash(12)]);
        assert!(!cache.insert(hash(16), vec![region(16, 1000)], false, &pinned));
        assert!(cache.contains(&hash(0)) && cache.contains(&hash(4)));
        assert_eq!(cache.initial_bytes(), fits(1));
    }

    #[test]
    fn an_extended_tail_replaces_the_short_one() {
        let mut cache = Cache::new(fits(9));
        let none = BTreeSet::new();
        cache.insert(hash(1), vec![Region::new(StateId(8), 2, vec![5; 4])], false, &none);
        cache.insert(hash(2), vec![Region::new(StateId(8), 2, vec![5; 8])], false, &none);
        let resident = cache.snapshot();
        assert!(resident.has(StateId(9)) && resident.has(StateId(11)));
        assert!(!resident.has(StateId(12)) && !resident.has(StateId(7)));
        assert!(!resident.read(StateId(12), &mut [0.0; 2]));
    }
}

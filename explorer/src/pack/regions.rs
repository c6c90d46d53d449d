//! From runs of states to region chunks.

use protocol::manifest::RegionChunkRef;
use protocol::region::{RegionChunk, RegionEntry};
use protocol::{GenerationId, StateId, limits};

use super::columns;
use super::encode::{Coding, EncodeError, EncodeSettings, EncodedRegion, Encoder};
use super::store::NewChunks;
use crate::view::{GraphView, Run};

/// Runs longer than a region are cut evenly, so that no piece is shorter than half of one.
const REGION_STATES: u32 = limits::REGION_STATES_MAX as u32;
/// A chunk is closed once it holds this many bytes: the initial graph comes in a few chunks, and
/// one fetch stays short.
const CHUNK_BYTES: usize = 256 << 10;

// Neither leaf knows the other; here their limits meet.
const _: () = assert!(codec::REGION_STATES_MAX == limits::REGION_STATES_MAX);
const _: () = assert!(codec::COLUMNS_MAX == limits::COLUMNS_MAX);
const _: () = assert!(codec::ROWS_MAX == 3 * limits::VERTICES_MAX);

/// One region to be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Cut {
    pub(super) first: StateId,
    pub(super) count: u32,
    pub(super) job: u64,
    pub(super) initial: bool,
}

/// Runs that cannot be what a graph holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RunsError {
    /// A run does not begin where the one before ended.
    #[error("run {run} begins at state {found}, not {expected}")]
    Gap {
        /// Index of the run.
        run: usize,
        /// Where it begins.
        found: StateId,
        /// Where it should begin.
        expected: StateId,
    },
    /// The runs end before or after the links.
    #[error("the runs cover {runs} states, the links {links}")]
    Count {
        /// States in runs.
        runs: u64,
        /// Entries in the links.
        links: u64,
    },
    /// What is published ends within a run, or past the last: another graph was published.
    #[error(
        "the store covers {covered} states, but no run of this graph ends there: it holds another \
         graph; publish to an empty store"
    )]
    OtherGraph {
        /// States that the head covers.
        covered: u64,
    },
}

/// Checks that runs cover `states` states once and in order, and cuts those past `covered` into
/// regions of 16-32 states; a run shorter than 16 stays whole.
pub(super) fn cut(runs: &[Run], covered: u64, states: u64) -> Result<Vec<Cut>, RunsError> {
    let mut cuts = Vec::new();
    let mut end = 0;
    let mut met = covered == 0;
    for (index, run) in runs.iter().enumerate() {
        if run.first.0 != end {
            let expected = StateId(end);
            return Err(RunsError::Gap { run: index, found: run.first, expected });
        }
        end += u64::from(run.count);
        met |= end == covered;
        if end <= covered {
            continue;
        }
        let pieces = run.count.div_ceil(REGION_STATES);
        for piece in 0..pieces {
            let from = run.count * piece / pieces;
            let to = run.count * (piece + 1) / pieces;
            let first = StateId(run.first.0 + u64::from(from));
            cuts.push(Cut { first, count: to - from, job: run.job, initial: run.initial });
        }
    }
    if end != states {
        return Err(RunsError::Count { runs: end, links: states });
    }
    if met { Ok(cuts) } else { Err(RunsError::OtherGraph { covered }) }
}

/// The newly encoded part of a version.
pub(super) struct NewRegions {
    /// The encoder, with the new generations if some were opened.
    pub(super) encoder: Encoder,
    /// Bytes and columns of each generation that was opened.
    pub(super) generations: Vec<(Vec<u8>, u16)>,
    /// One per cut, with its generation.
    pub(super) regions: Vec<(GenerationId, EncodedRegion)>,
}

impl NewRegions {
    pub(super) fn max_error_m(&self) -> f32 {
        self.regions.iter().map(|(_, region)| region.max_error_m).fold(0.0, f32::max)
    }

    pub(super) fn square_sum_m2(&self) -> f64 {
        self.regions.iter().map(|(_, region)| region.square_sum_m2).sum()
    }
}

/// What regions are encoded with.
pub(super) struct Encoding<'a> {
    pub(super) view: &'a dyn GraphView,
    pub(super) settings: &'a EncodeSettings,
    /// Generations published so far; 0 where the basis is to be made.
    pub(super) generations: usize,
    /// A region of profile `kim2013` falls outside from this error on (m); infinite for the first
    /// version.
    pub(super) outside_m: f32,
}

/// A basis from more states than this is made from every second, third, ... of their regions: what
/// they leave out is much like what they hold, and every state is certified anyway.
const BASIS_STATES_MAX: u64 = 8192;
/// States outside of the basis before a generation is opened for them, in profile `toile`: fewer
/// are not worth its bytes.
const OUTSIDE_STATES_MIN: u32 = 64;

impl Encoding<'_> {
    /// Encodes the cuts. The first version, and a new base, freezes its basis over them; later ones
    /// open a generation for those that fall outside, as long as there is room.
    pub(super) fn encode(&self, known: &Encoder, cuts: &[Cut]) -> Result<NewRegions, EncodeError> {
        let (encoder, generations) = (known.clone(), Vec::new());
        let mut new = NewRegions { encoder, generations, regions: Vec::new() };
        let mut positions = Vec::new();
        if self.generations == 0 && !cuts.is_empty() {
            let states: u64 = cuts.iter().map(|cut| u64::from(cut.count)).sum();
            let every = states.div_ceil(BASIS_STATES_MAX) as usize;
            let mut visit = |show: &mut dyn FnMut(&[f32]) -> Result<(), EncodeError>| {
                cuts.iter().step_by(every).try_for_each(|cut| {
                    self.read(cut, &mut positions)?;
                    show(&positions)
                })
            };
            let settings = self.settings;
            for bytes in columns::first_generations(self.rows(), states, settings, &mut visit)? {
                new.open(bytes)?;
            }
        }
        let generation = (self.generations + new.generations.len()).max(1) - 1;
        let mut outside = Vec::new();
        for (index, cut) in cuts.iter().enumerate() {
            self.read(cut, &mut positions)?;
            let region = new.encoder.region(&positions)?;
            if self.is_outside(&new.encoder, cut, &region) {
                outside.push(index);
            }
            new.regions.push((GenerationId(generation as u16), region));
        }
        if self.generations > 0 && !outside.is_empty() {
            self.extend(&mut new, cuts, &outside)?;
        }
        Ok(new)
    }

    fn is_outside(&self, encoder: &Encoder, cut: &Cut, region: &EncodedRegion) -> bool {
        match &encoder.coding {
            Coding::Kim2013 => region.overflowed || region.max_error_m > self.outside_m,
            Coding::Toile(bounded) => {
                let vertices = f64::from(cut.count) * self.view.vertex_count() as f64;
                let rms_m = (region.square_sum_m2 / vertices).sqrt();
                rms_m > f64::from(self.settings.error_factor * bounded.made.1)
            }
        }
    }

    /// Opens a generation from what the columns so far leave of the regions that fall outside, and
    /// encodes these again.
    fn extend(
        &self,
        new: &mut NewRegions,
        cuts: &[Cut],
        outside: &[usize],
    ) -> Result<(), EncodeError> {
        let room = self.settings.columns_max.saturating_sub(new.encoder.basis().columns());
        let columns_max = room.min(self.settings.generation_columns_max);
        let states: u32 = outside.iter().map(|i| cuts[*i].count).sum();
        let bounded = match &new.encoder.coding {
            Coding::Kim2013 => None,
            Coding::Toile(_) if states < OUTSIDE_STATES_MIN => return Ok(()),
            Coding::Toile(bounded) => Some(bounded.clone()),
        };
        if columns_max == 0 || self.generations >= limits::GENERATIONS_MAX {
            return Ok(());
        }
        let before = new.encoder.clone();
        let (mut positions, mut decoded) = (Vec::new(), Vec::new());
        let mut visit = |show: &mut dyn FnMut(&[f32]) -> Result<(), EncodeError>| {
            outside.iter().try_for_each(|index| {
                self.read(&cuts[*index], &mut positions)?;
                before.decode_columns(&new.regions[*index].1.bytes, &mut decoded);
                positions.iter_mut().zip(&decoded).for_each(|(p, d)| *p -= d);
                show(&positions)
            })
        };
        let known = bounded.as_ref().and_then(|bounded| {
            let tree = bounded.tree.as_deref()?;
            Some((tree, bounded.step, f64::from(bounded.made.1)))
        });
        let (rows, settings) = (self.rows(), self.settings);
        let made = columns::appended_generation(rows, columns_max, settings, known, &mut visit)?;
        let Some(bytes) = made else { return Ok(()) };
        new.open(bytes)?;
        for index in outside {
            self.read(&cuts[*index], &mut positions)?;
            let region = new.encoder.region(&positions)?;
            new.regions[*index] = (GenerationId(self.generations as u16), region);
        }
        Ok(())
    }

    fn rows(&self) -> usize {
        3 * self.view.vertex_count()
    }

    /// Positions of a cut's states, one after the other; `out` is resized.
    fn read(&self, cut: &Cut, out: &mut Vec<f32>) -> Result<(), EncodeError> {
        let rows = self.rows();
        out.resize(rows * cut.count as usize, 0.0);
        for (state, out) in (cut.first.0..).zip(out.chunks_exact_mut(rows)) {
            self.view.positions(StateId(state), out)?;
        }
        Ok(())
    }
}

impl NewRegions {
    fn open(&mut self, bytes: Vec<u8>) -> Result<(), EncodeError> {
        let columns = self.encoder.basis().columns();
        self.encoder.append(&bytes)?;
        let appended = self.encoder.basis().columns() - columns;
        self.generations.push((bytes, appended as u16));
        Ok(())
    }
}

/// Bundles regions into chunks: those of the initial graph together, those of one job together.
pub(super) fn bundle(
    cuts: &[Cut],
    regions: Vec<(GenerationId, EncodedRegion)>,
    chunks: &mut NewChunks,
) -> Vec<RegionChunkRef> {
    let mut bundled = Vec::new();
    let mut open: Vec<RegionEntry> = Vec::new();
    let mut bytes = 0;
    for (index, (cut, (generation, region))) in cuts.iter().zip(regions).enumerate() {
        bytes += region.bytes.len();
        open.push(RegionEntry {
            first_state: cut.first,
            state_count: cut.count as u16,
            generation,
            max_error_m: region.max_error_m,
            bytes: region.bytes,
        });
        let goes_on = cuts.get(index + 1).is_some_and(|next| {
            next.initial == cut.initial && (cut.initial || next.job == cut.job)
        });
        if goes_on && bytes < CHUNK_BYTES {
            continue;
        }
        let regions = std::mem::take(&mut open);
        bytes = 0;
        bundled.push(RegionChunkRef {
            first_state: regions[0].first_state,
            state_count: regions.iter().map(|r| u32::from(r.state_count)).sum(),
            initial: cut.initial,
            chunk: chunks.add(RegionChunk { regions }.encode()),
        });
    }
    bundled
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(first: u64, count: u32) -> Run {
        Run { first: StateId(first), count, job: 0, initial: false }
    }

    fn counts(run_length: u32) -> Vec<u32> {
        let cuts = cut(&[run(0, run_length)], 0, u64::from(run_length)).unwrap();
        cuts.iter().map(|cut| cut.count).collect()
    }

    #[test]
    fn runs_are_cut_evenly() {
        assert_eq!(counts(1), [1]);
        assert_eq!(counts(15), [15]);
        assert_eq!(counts(32), [32]);
        assert_eq!(counts(33), [16, 17]);
        assert_eq!(counts(40), [20, 20]);
        assert_eq!(counts(70), [23, 23, 24]);
        for length in 16..500 {
            let counts = counts(length);
            assert!(counts.iter().all(|c| (16..=32).contains(c)), "{length}: {counts:?}");
            assert_eq!(counts.iter().sum::<u32>(), length);
        }
    }

    #[test]
    fn what_is_covered_is_left_alone() {
        let runs = [run(0, 20), run(20, 5), run(25, 7)];
        let cuts = cut(&runs, 25, 32).unwrap();
        assert_eq!((cuts.len(), cuts[0].first, cuts[0].count), (1, StateId(25), 7));
        assert_eq!(cut(&runs, 32, 32).unwrap(), []);
        let other = Err(RunsError::OtherGraph { covered: 21 });
        assert_eq!(cut(&runs, 21, 32), other);
        assert_eq!(cut(&runs, 40, 32), Err(RunsError::OtherGraph { covered: 40 }));
    }

    #[test]
    fn runs_with_gaps_are_refused() {
        let gap = cut(&[run(0, 20), run(21, 5)], 0, 26);
        assert!(matches!(gap, Err(RunsError::Gap { run: 1, .. })));
        let count = cut(&[run(0, 20)], 0, 26);
        assert_eq!(count, Err(RunsError::Count { runs: 20, links: 26 }));
    }
}

//! A growing graph: what appended generations cost beside a basis made at once, and a re-base.

use protocol::StateId;
use protocol::links::LinkEntry;
use protocol::manifest::VersionStats;

use super::super::encode::{EncodeError, EncodeSettings, Encoder};
use super::super::publish::pays_to_rebase;
use super::super::regions::{Cut, Encoding, NewRegions};
use super::{BenchError, Bound, Source};
use crate::view::{GraphView, Run};

/// One version of a growing graph.
#[derive(Debug, Clone, PartialEq)]
pub struct Batch {
    /// States so far.
    pub states: u64,
    /// Columns of all generations so far.
    pub columns: usize,
    /// Bytes of generations that this version brings.
    pub generation_bytes: u64,
    /// Bytes of regions that it brings.
    pub region_bytes: u64,
    /// Root mean square vertex error of its own states (m).
    pub rms_m: f64,
    /// Largest vertex error of its own states (m).
    pub max_m: f64,
    /// Whether the rule asks for a new basis after it.
    pub rebase_pays: bool,
}

/// A new basis for everything.
#[derive(Debug, Clone, PartialEq)]
pub struct Rebase {
    /// Columns before.
    pub columns_before: usize,
    /// Columns after: those of a basis made at once.
    pub columns: usize,
    /// Bytes that a client holds or has fetched before it, basis and regions.
    pub bytes_before: u64,
    /// Bytes that a client fetches for it, basis and regions.
    pub bytes: u64,
    /// Of these, the basis.
    pub basis_bytes: u64,
    /// Processor time (s).
    pub time_s: f64,
    /// Root mean square vertex error before and after (m).
    pub rms_m: [f64; 2],
    /// Largest vertex error before and after (m).
    pub max_m: [f64; 2],
}

/// What growing cost.
#[derive(Debug, Clone, PartialEq)]
pub struct Growth {
    /// The first version, and those that were appended.
    pub versions: Vec<Batch>,
    /// The re-base after the last.
    pub rebase: Rebase,
}

struct View<'a>(&'a Source);

impl GraphView for View<'_> {
    fn vertex_count(&self) -> usize {
        self.0.vertices()
    }

    fn runs(&self) -> &[Run] {
        &[]
    }

    fn positions(&self, state: StateId, out: &mut [f32]) -> std::io::Result<()> {
        self.0.read_state(state, out)
    }

    fn links(&self) -> Vec<LinkEntry> {
        Vec::new()
    }

    fn stats(&self) -> VersionStats {
        VersionStats::default()
    }
}

impl Growth {
    /// Encodes the first half of the states, in the order in which they were made, then the rest in
    /// `batches` versions as a publisher does, and at last everything anew on one basis.
    ///
    /// # Errors
    /// The bound is none, or the states cannot be encoded.
    pub fn measure(
        source: &Source,
        bound: Bound,
        batches: usize,
        clock: &dyn Fn() -> f64,
        say: &dyn Fn(&str),
    ) -> Result<Self, BenchError> {
        if !bound.is_valid() {
            return Err(EncodeError::Bound(bound).into());
        }
        let mut cuts: Vec<Cut> = (0..source.regions())
            .map(|region| source.region(region))
            .map(|(first, count)| Cut { first, count: count as u32, job: 0, initial: false })
            .collect();
        cuts.sort_by_key(|cut| cut.first);
        let settings = EncodeSettings::for_bound(bound);
        let mut encoder = Encoder::new(&settings);
        let mut versions: Vec<Batch> = Vec::new();
        let (mut sums, mut bytes, mut generations, mut from) = ([0.0; 2], 0, 0, 0);
        for batch in 0..=batches {
            let to = cuts.len() * (batches + batch) / (2 * batches);
            let new = &cuts[from..to];
            from = to;
            if new.is_empty() {
                continue;
            }
            say(&format!("version {batch} of {batches}: {} regions", new.len()));
            let encoding = Encoding {
                view: &View(source),
                settings: &settings,
                generations,
                outside_m: f32::INFINITY,
            };
            let made = encoding.encode(&encoder, new)?;
            generations += made.generations.len();
            encoder = made.encoder.clone();
            let own = states(new);
            let all = own + versions.last().map_or(0, |last| last.states);
            let version = Batch::of(&made, own, all, source.vertices());
            sums = [sums[0] + made.square_sum_m2(), f64::max(sums[1], version.max_m)];
            let rms_m = (sums[0] / (all * source.vertices() as u64) as f64).sqrt();
            bytes += version.generation_bytes + version.region_bytes;
            let rebase_pays = pays_to_rebase(&encoder, generations, all, rms_m as f32);
            versions.push(Batch { rebase_pays, ..version });
        }
        let all = states(&cuts);
        let before_rms_m = (sums[0] / (all * source.vertices() as u64) as f64).sqrt();
        say("a new basis for everything");
        let start = clock();
        let view = &View(source);
        let anew = Encoding { view, settings: &settings, generations: 0, outside_m: f32::INFINITY };
        let made = anew.encode(&Encoder::new(&settings), &cuts)?;
        let time_s = clock() - start;
        let after = Batch::of(&made, all, all, source.vertices());
        let rebase = Rebase {
            columns_before: encoder.basis().columns(),
            columns: after.columns,
            bytes_before: bytes,
            bytes: after.generation_bytes + after.region_bytes,
            basis_bytes: after.generation_bytes,
            time_s,
            rms_m: [before_rms_m, after.rms_m],
            max_m: [sums[1], after.max_m],
        };
        Ok(Self { versions, rebase })
    }
}

impl Batch {
    fn of(made: &NewRegions, own: u64, states: u64, vertices: usize) -> Self {
        let regions = made.regions.iter().map(|(_, region)| region.bytes.len() as u64);
        Self {
            states,
            columns: made.encoder.basis().columns(),
            generation_bytes: made.generations.iter().map(|(bytes, _)| bytes.len() as u64).sum(),
            region_bytes: regions.sum(),
            rms_m: (made.square_sum_m2() / (own * vertices as u64) as f64).sqrt(),
            max_m: f64::from(made.max_error_m()),
            rebase_pays: false,
        }
    }
}

fn states(cuts: &[Cut]) -> u64 {
    cuts.iter().map(|cut| u64::from(cut.count)).sum()
}

//! Codecs side by side on the states of an explored store.

use std::path::Path;

use object_store::ObjectStore;
use protocol::StateId;
use protocol::region::RegionChunk;

use super::columns::{Analysis, ToileColumns, toile_generations};
use super::design::{Bound, Design, Spectrum};
use super::encode::{EncodeError, EncodeSettings, Encoder};
use super::store;
use crate::grow::states::StateFile;

/// Regions of exact states, read one at a time.
pub struct Source {
    states: Exact,
    regions: Vec<(StateId, usize)>,
    vertices: usize,
}

enum Exact {
    File(StateFile),
    Memory(Vec<f32>),
}

/// Why a store cannot be measured.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BenchError {
    /// The store.
    #[error(transparent)]
    Store(#[from] store::StoreError),
    /// A region chunk.
    #[error("a region chunk: {0}")]
    Chunk(#[from] protocol::DecodeError),
    /// Encoding.
    #[error("encoding: {0}")]
    Encode(#[from] EncodeError),
    /// The exact states.
    #[error("{}: {source}; give the work folder of this store with --work", .path.display())]
    States {
        /// The state file.
        path: std::path::PathBuf,
        /// What is wrong.
        source: std::io::Error,
    },
    /// Nothing to measure.
    #[error("the store holds no {0}")]
    Nothing(&'static str),
}

impl Source {
    /// The newest version of a store's first garment: which states its regions hold. Their exact
    /// positions come from the work folder. At most `states` of them, whole regions spread evenly.
    ///
    /// # Errors
    /// The store or the work folder cannot be read.
    pub async fn open(
        from: &dyn ObjectStore,
        work: &Path,
        states: Option<usize>,
    ) -> Result<Self, BenchError> {
        let number = store::head_number(from).await?.ok_or(BenchError::Nothing("version"))?;
        let publisher = store::publisher(from).await?.ok_or(BenchError::Nothing("publisher"))?;
        let head = store::version(from, number, &publisher).await?.manifest;
        let garment = head.garments.first().ok_or(BenchError::Nothing("garment"))?;
        let path = work.join("states");
        let failed = |source| BenchError::States { path: path.clone(), source };
        let file = StateFile::view(&path).map_err(failed)?;
        let vertices = file.vertex_count();
        let mut regions = Vec::new();
        for listed in &garment.regions {
            let bytes = store::chunk(from, &listed.chunk).await?;
            let chunk = RegionChunk::decode(&bytes)?;
            regions
                .extend(chunk.regions.iter().map(|r| (r.first_state, usize::from(r.state_count))));
        }
        let all: usize = regions.iter().map(|(_, count)| count).sum();
        let every = states.map_or(1, |states| all.div_ceil(states.max(1)));
        let regions: Vec<_> = regions.into_iter().step_by(every).collect();
        if regions.is_empty() {
            return Err(BenchError::Nothing("region"));
        }
        Ok(Self { states: Exact::File(file), regions, vertices })
    }

    /// States in memory, `3 * vertices` numbers each (m), in regions of `count`.
    pub fn from_memory(states: Vec<f32>, vertices: usize, count: usize) -> Self {
        let all = states.len() / (3 * vertices);
        let region = |first: usize| (StateId(first as u64), count.min(all - first));
        let regions = (0..all).step_by(count).map(region).collect();
        Self { states: Exact::Memory(states), regions, vertices }
    }

    /// Vertices of a state.
    pub fn vertices(&self) -> usize {
        self.vertices
    }

    /// Number of regions.
    pub fn regions(&self) -> usize {
        self.regions.len()
    }

    /// Number of states.
    pub fn states(&self) -> usize {
        self.regions.iter().map(|(_, count)| count).sum()
    }

    /// Positions (m) of a region's states, one after the other; `out` is resized.
    ///
    /// # Errors
    /// The state file cannot be read.
    pub fn read(&self, region: usize, out: &mut Vec<f32>) -> std::io::Result<()> {
        let (first, count) = self.regions[region];
        let rows = 3 * self.vertices;
        out.resize(rows * count, 0.0);
        match &self.states {
            Exact::Memory(states) => {
                let from = first.0 as usize * rows;
                let to = from + out.len();
                out.copy_from_slice(&states[from..to]);
            }
            Exact::File(file) => {
                for (state, out) in (first.0..).zip(out.chunks_exact_mut(rows)) {
                    let state = file.read(StateId(state))?;
                    for (vertex, out) in out.chunks_exact_mut(3).enumerate() {
                        out.copy_from_slice(&state.position(vertex).to_array());
                    }
                }
            }
        }
        Ok(())
    }
}

/// What a codec did.
#[derive(Debug, Clone, PartialEq)]
pub struct Measured {
    /// Which codec.
    pub name: String,
    /// Columns.
    pub rank: usize,
    /// Encoded coefficients and fixes, over all states.
    pub bytes_per_frame: f64,
    /// Encoded columns.
    pub basis_bytes: u64,
    /// Columns as a client holds them in memory.
    pub resident_bytes: u64,
    /// Everything.
    pub total_bytes: u64,
    /// Largest vertex error (m).
    pub max_m: f64,
    /// 99.9th percentile of vertex errors (m), to 3 %.
    pub p999_m: f64,
    /// Root mean square vertex error (m).
    pub rms_m: f64,
    /// Time to encode a state, its check included (s).
    pub encode_s: f64,
    /// Time to decode a state (s).
    pub decode_s: f64,
    /// Vertices with a fix of their own, over all states and vertices.
    pub fixed_share: f64,
}

/// Vertex errors, in bins of 3 %.
#[derive(Debug, Clone)]
pub struct Errors {
    bins: Vec<u64>,
    max: f64,
    square: f64,
    count: u64,
}

impl Default for Errors {
    fn default() -> Self {
        Self { bins: vec![0; 1024], max: 0.0, square: 0.0, count: 0 }
    }
}

impl Errors {
    /// Compares positions (m), three numbers a vertex.
    pub fn compare(&mut self, exact: &[f32], decoded: &[f32]) {
        for (exact, decoded) in exact.chunks_exact(3).zip(decoded.chunks_exact(3)) {
            let square: f64 =
                (0..3).map(|i| (f64::from(exact[i]) - f64::from(decoded[i])).powi(2)).sum();
            self.square += square;
            self.count += 1;
            let distance = square.sqrt();
            self.max = self.max.max(distance);
            // Bin 0 ends at a nanometre.
            let bin = ((distance / 1e-9).max(1.0).ln() / 1.03f64.ln()) as usize;
            self.bins[bin.min(1023)] += 1;
        }
    }

    /// Largest (m).
    pub fn max_m(&self) -> f64 {
        self.max
    }

    /// Root mean square (m).
    pub fn rms_m(&self) -> f64 {
        (self.square / self.count.max(1) as f64).sqrt()
    }

    /// The error that this share of all vertices does not exceed (m), to 3 %.
    pub fn quantile_m(&self, share: f64) -> f64 {
        let wanted = (share * self.count as f64).ceil() as u64;
        let mut met = 0;
        let reached = |count: &u64| {
            met += count;
            met >= wanted
        };
        let bin = self.bins.iter().position(reached).unwrap_or(1023);
        (1e-9 * 1.03f64.powi(bin as i32 + 1)).min(self.max)
    }
}

/// Codecs over one analysis of the states.
pub struct Bench<'a> {
    source: &'a Source,
    analysis: Analysis,
    spectrum: Spectrum,
    /// Seconds, from any moment on.
    clock: &'a dyn Fn() -> f64,
}

/// Most columns that are looked at.
const RANK_MAX: usize = 480;
/// States that the columns are made from, at most.
const BASIS_STATES_MAX: usize = 8192;
/// Regions on which a design is tried before all are encoded: every so many.
const TRIAL: usize = 16;

impl<'a> Bench<'a> {
    /// Analyses the states: one singular value decomposition serves all codecs.
    ///
    /// # Errors
    /// The states cannot be read or span nothing.
    pub fn new(source: &'a Source, clock: &'a dyn Fn() -> f64) -> Result<Self, BenchError> {
        super::basis::stay_on_this_thread();
        let every = source.states().div_ceil(BASIS_STATES_MAX);
        let mut block = Vec::new();
        let mut visit = |show: &mut dyn FnMut(&[f32]) -> Result<(), EncodeError>| {
            (0..source.regions()).step_by(every).try_for_each(|region| {
                source.read(region, &mut block)?;
                show(&block)
            })
        };
        let analysis = Analysis::new(3 * source.vertices(), RANK_MAX, &mut visit)?;
        let tree = analysis.tree();
        let spectrum = analysis.spectrum(&tree, source.states() as u64);
        Ok(Self { source, analysis, spectrum, clock })
    }

    /// `kim2013` in the paper's batch form: maxima without headroom.
    ///
    /// # Errors
    /// The states cannot be encoded.
    pub fn kim2013(&self, rank: usize) -> Result<Measured, BenchError> {
        let generation = self.analysis.kim2013(rank, 1.0)?;
        let generations: Vec<Vec<u8>> = generation.into_iter().collect();
        let encoder = encoder(&EncodeSettings::for_rank(rank), &generations)?;
        let mut measured = self.measure(&encoder, 1)?.0;
        measured.name = format!("kim2013-r{rank}");
        measured.basis_bytes = bytes(&generations);
        Ok(self.total(measured))
    }

    /// `toile` within a bound.
    ///
    /// # Errors
    /// The bound is none, or the states cannot be encoded.
    pub fn toile(&self, name: &str, bound: Bound) -> Result<Measured, BenchError> {
        if !bound.is_valid() {
            return Err(EncodeError::Bound(bound).into());
        }
        let asked_m = bound.rms_m.map(f64::from);
        let mut rms_m = bound.design_rms_m();
        // A design is a forecast; a sample corrects it, and the whole has the last word.
        for _ in 0..6 {
            let (encoder, _) = self.encoder(&self.spectrum.design(rms_m), bound.max_m, rms_m)?;
            let found_m = self.measure(&encoder, TRIAL.min(self.source.regions()))?.0.rms_m;
            match asked_m {
                Some(asked_m) if found_m > 0.997 * asked_m => rms_m *= 0.99 * asked_m / found_m,
                Some(asked_m) if found_m < 0.98 * asked_m && found_m > 0.0 => {
                    rms_m *= 0.99 * asked_m / found_m;
                }
                _ => break,
            }
        }
        let mut max_m = bound.max_m;
        let mut last_m = 0.0;
        for _ in 0..12 {
            let design = self.spectrum.design(rms_m);
            let (encoder, generations) = self.encoder(&design, max_m, rms_m)?;
            let (mut measured, errors) = self.measure(&encoder, 1)?;
            let Some(asked_m) = asked_m.filter(|asked_m| measured.rms_m > *asked_m) else {
                measured.name = name.into();
                measured.basis_bytes = bytes(&generations);
                return Ok(self.total(measured));
            };
            last_m = measured.rms_m;
            rms_m *= 0.99 * asked_m / last_m;
            if design == self.spectrum.design(rms_m) || design.rank >= self.spectrum.power_m2.len()
            {
                // No more columns: fixes alone bring it down.
                let tight_m = max_m.map_or(errors.max_m(), f64::from) * (asked_m / last_m).min(0.7);
                max_m = Some(tight_m.max(asked_m) as f32);
            }
        }
        Err(EncodeError::Unreached { reached_m: last_m, asked_m: asked_m.unwrap_or(0.0) }.into())
    }

    /// `toile` of about so many bytes in all, without fixes.
    ///
    /// # Errors
    /// The states cannot be encoded.
    pub fn toile_of_bytes(&self, name: &str, total: u64) -> Result<Measured, BenchError> {
        let mut aim = total as f64;
        let mut best = None;
        for _ in 0..4 {
            let design = self.spectrum.design_of_bytes(aim);
            let (encoder, generations) = self.encoder(&design, None, design.rms_m)?;
            let mut measured = self.measure(&encoder, TRIAL.min(self.source.regions()))?.0;
            measured.basis_bytes = bytes(&generations);
            let found = self.total(measured).total_bytes as f64;
            best = Some((encoder, generations));
            if (0.97..=1.0).contains(&(found / total as f64)) {
                break;
            }
            aim *= 0.99 * total as f64 / found;
        }
        let (encoder, generations) = best.expect("four designs were tried");
        let mut measured = self.measure(&encoder, 1)?.0;
        (measured.name, measured.basis_bytes) = (name.into(), bytes(&generations));
        Ok(self.total(measured))
    }

    /// What a client shows that has the leading generation of a bound's basis alone.
    ///
    /// # Errors
    /// The bound is none, or the states cannot be encoded.
    pub fn leading(&self, name: &str, bound: Bound) -> Result<Measured, BenchError> {
        let rms_m = bound.design_rms_m();
        let (_, generations) = self.encoder(&self.spectrum.design(rms_m), None, rms_m)?;
        let settings = EncodeSettings::for_bound(Bound::default());
        let encoder = encoder(&settings, &generations[..1])?;
        let mut measured = self.measure(&encoder, TRIAL.min(self.source.regions()))?.0;
        (measured.name, measured.basis_bytes) = (name.into(), bytes(&generations[..1]));
        Ok(self.total(measured))
    }

    fn encoder(
        &self,
        design: &Design,
        max_m: Option<f32>,
        rms_m: f64,
    ) -> Result<(Encoder, Vec<Vec<u8>>), BenchError> {
        let tree = self.analysis.tree();
        let states = self.source.states() as u64;
        let how =
            ToileColumns { tree: &tree, with_tree: true, headroom: 1.1, from: 0, rms_m, states };
        let generations = toile_generations(&self.analysis, design, how)?;
        let bound = Bound { max_m, rms_m: None };
        Ok((encoder(&EncodeSettings::for_bound(bound), &generations)?, generations))
    }

    /// Encodes every `every`-th region, decodes it as a client does, and compares.
    fn measure(&self, encoder: &Encoder, every: usize) -> Result<(Measured, Errors), BenchError> {
        let (mut exact, mut decoded) = (Vec::new(), Vec::new());
        let mut errors = Errors::default();
        let (mut bytes, mut states, mut fixes) = (0, 0, 0);
        let (mut encode_s, mut decode_s) = (0.0, 0.0);
        for region in (0..self.source.regions()).step_by(every) {
            self.source.read(region, &mut exact).map_err(EncodeError::Read)?;
            let start = (self.clock)();
            let encoded = encoder.region(&exact)?;
            let coded = (self.clock)();
            encoder.decode(&encoded.bytes, &mut decoded);
            encode_s += coded - start;
            decode_s += (self.clock)() - coded;
            errors.compare(&exact, &decoded);
            bytes += encoded.bytes.len();
            fixes += encoded.fixes;
            states += exact.len() / (3 * self.source.vertices());
        }
        let per_state = |sum: f64| sum / states as f64;
        let measured = Measured {
            name: String::new(),
            rank: encoder.basis().columns(),
            bytes_per_frame: per_state(bytes as f64),
            basis_bytes: 0,
            resident_bytes: encoder.basis().resident_bytes() as u64,
            total_bytes: 0,
            max_m: errors.max_m(),
            p999_m: errors.quantile_m(0.999),
            rms_m: errors.rms_m(),
            encode_s: per_state(encode_s),
            decode_s: per_state(decode_s),
            fixed_share: per_state(fixes as f64) / self.source.vertices() as f64,
        };
        Ok((measured, errors))
    }

    fn total(&self, measured: Measured) -> Measured {
        let regions = measured.bytes_per_frame * self.source.states() as f64;
        Measured { total_bytes: measured.basis_bytes + regions.round() as u64, ..measured }
    }
}

fn encoder(settings: &EncodeSettings, generations: &[Vec<u8>]) -> Result<Encoder, EncodeError> {
    let mut encoder = Encoder::new(settings);
    generations.iter().try_for_each(|bytes| encoder.append(bytes))?;
    Ok(encoder)
}

fn bytes(generations: &[Vec<u8>]) -> u64 {
    generations.iter().map(|bytes| bytes.len() as u64).sum()
}

//! Codecs side by side on the states of an explored store.
//!
//! Map: `source` exact states; `errors` what is told of vertex errors; `world` the character under
//! them: plain skinning, skinned space; `contact` how deep cloth is in the body, and what hides it;
//! `growth` generations appended to a growing graph.

use codec::kernel::Select;
use codec::toile::{self, TIERS};

use super::columns::{Analysis, ToileColumns, toile_generations};
use super::design::{Bound, Design, Spectrum};
use super::encode::{EncodeError, EncodeSettings, Encoder};
use super::store;

mod contact;
mod errors;
mod growth;
mod source;
mod world;

pub use contact::{Cleaned, Cleanup, Inside, Skin};
pub use errors::Errors;
pub use growth::{Batch, Growth, Rebase};
pub use source::Source;
pub use world::SpaceError;

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

impl Measured {
    /// Errors alone.
    fn new(name: &str, errors: &Errors) -> Self {
        Self {
            name: name.into(),
            rank: 0,
            bytes_per_frame: 0.0,
            basis_bytes: 0,
            resident_bytes: 0,
            total_bytes: 0,
            max_m: errors.max_m(),
            p999_m: errors.quantile_m(0.999),
            rms_m: errors.rms_m(),
            encode_s: 0.0,
            decode_s: 0.0,
            fixed_share: 0.0,
        }
    }

    fn timed(self, encode_s: f64, decode_s: f64, resident_bytes: u64) -> Self {
        Self { encode_s, decode_s, resident_bytes, ..self }
    }
}

/// Rounded coefficients.
#[derive(Debug, Clone, PartialEq)]
pub struct Steps {
    /// Coefficients of a state.
    pub columns: usize,
    /// States of each region.
    pub regions: Vec<usize>,
    /// State after state, in steps of one size.
    pub steps: Vec<i32>,
    /// What our own coder makes of them, headers of regions included.
    pub bytes: u64,
}

/// Codecs over one analysis of the states.
pub struct Bench<'a> {
    source: &'a Source,
    analysis: Analysis,
    spectrum: Spectrum,
    /// Seconds, from any moment on.
    clock: &'a dyn Fn() -> f64,
    say: &'a dyn Fn(&str),
}

/// Most columns that are looked at: of a garment of 3,000 vertices they are 76 MB while measured.
pub const RANK_MAX: usize = 1024;
/// States that the columns are made from, at most.
const BASIS_STATES_MAX: usize = 32_768;
/// Regions on which a design is tried before all are encoded: every so many.
const TRIAL: usize = 16;
/// Regions whose decoding is timed: every so many.
const TIMED: usize = 4;

impl<'a> Bench<'a> {
    /// Analyses the states: one singular value decomposition serves all codecs. `clock` gives
    /// seconds; `say` is told what is being done, often.
    ///
    /// # Errors
    /// The states cannot be read or span nothing.
    pub fn new(
        source: &'a Source,
        clock: &'a dyn Fn() -> f64,
        say: &'a dyn Fn(&str),
    ) -> Result<Self, BenchError> {
        Self::with_rank(source, RANK_MAX, clock, say)
    }

    /// As [`Bench::new`], looking at no more than `rank` columns.
    ///
    /// # Errors
    /// The states cannot be read or span nothing.
    pub fn with_rank(
        source: &'a Source,
        rank: usize,
        clock: &'a dyn Fn() -> f64,
        say: &'a dyn Fn(&str),
    ) -> Result<Self, BenchError> {
        super::basis::stay_on_this_thread();
        let every = source.states().div_ceil(BASIS_STATES_MAX);
        let mut block = Vec::new();
        let mut pass = 0;
        let mut visit = |show: &mut dyn FnMut(&[f32]) -> Result<(), EncodeError>| {
            pass += 1;
            (0..source.regions()).step_by(every).try_for_each(|region| {
                say(&format!("columns: pass {pass}, region {region} of {}", source.regions()));
                source.read(region, &mut block)?;
                show(&block)
            })
        };
        let analysis = Analysis::wide(3 * source.vertices(), rank, &mut visit)?;
        let tree = analysis.tree();
        let spectrum = analysis.spectrum(&tree, source.states() as u64);
        Ok(Self { source, analysis, spectrum, clock, say })
    }

    /// `kim2013` in the paper's batch form: maxima without headroom.
    ///
    /// # Errors
    /// The states cannot be encoded.
    pub fn kim2013(&self, rank: usize) -> Result<Measured, BenchError> {
        let generation = self.analysis.kim2013(rank, 1.0)?;
        let generations: Vec<Vec<u8>> = generation.into_iter().collect();
        let encoder = encoder(&EncodeSettings::for_rank(rank), &generations)?;
        let measured = self.measure(&format!("kim2013-r{rank}"), &encoder, 1)?.0;
        Ok(self.total(measured, &generations))
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
            let found_m = self.measure(name, &encoder, TRIAL.min(self.source.regions()))?.0.rms_m;
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
            let (measured, errors) = self.measure(name, &encoder, 1)?;
            let Some(asked_m) = asked_m.filter(|asked_m| measured.rms_m > *asked_m) else {
                return Ok(self.total(measured, &generations));
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

    /// `toile` of about so many bytes in all, and no vertex further off than `max_m` (m).
    ///
    /// # Errors
    /// The states cannot be encoded.
    pub fn toile_of_bytes(
        &self,
        name: &str,
        total: u64,
        max_m: Option<f32>,
    ) -> Result<Measured, BenchError> {
        let mut aim = total as f64;
        let mut best = None;
        for _ in 0..6 {
            let design = self.spectrum.design_of_bytes(aim);
            let (encoder, generations) = self.encoder(&design, max_m, design.rms_m)?;
            let measured = self.measure(name, &encoder, TRIAL.min(self.source.regions()))?.0;
            let found = self.total(measured, &generations).total_bytes as f64;
            best = Some((encoder, generations));
            let share = found / total as f64;
            let widest = design.rank >= self.spectrum.power_m2.len();
            if (0.97..=1.0).contains(&share) || widest && share < 1.0 && aim > total as f64 {
                break;
            }
            aim *= 0.99 / share;
        }
        let (encoder, generations) = best.expect("a design was tried");
        let measured = self.measure(name, &encoder, 1)?.0;
        Ok(self.total(measured, &generations))
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
        let measured = self.measure(name, &encoder, TRIAL.min(self.source.regions()))?.0;
        Ok(self.total(measured, &generations[..1]))
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

    /// What the columns that carry most in each region show, without fixes: a row for each of
    /// [`TIERS`], of every fourth region.
    ///
    /// # Errors
    /// The bound is none, or the states cannot be encoded.
    pub fn tiers(&self, name: &str, bound: Bound) -> Result<Vec<Measured>, BenchError> {
        let rms_m = bound.design_rms_m();
        let (encoder, generations) =
            self.encoder(&self.spectrum.design(rms_m), bound.max_m, rms_m)?;
        let basis = encoder.basis();
        let (mut exact, mut shown) = (Vec::new(), vec![0.0; basis.rows()]);
        let mut errors = TIERS.map(|_| Errors::default());
        let mut decode_s = TIERS.map(|_| 0.0);
        let (mut bytes, mut states, mut encode_s) = (0usize, 0usize, 0.0);
        for region in (0..self.source.regions()).step_by(4) {
            self.progress(name, region);
            self.source.read(region, &mut exact).map_err(EncodeError::Read)?;
            let start = (self.clock)();
            let encoded = encoder.region(&exact)?;
            encode_s += (self.clock)() - start;
            let (coefficients, by_energy) = encoder.coefficients(&encoded.bytes);
            for ((tier, errors), spent_s) in TIERS.iter().zip(&mut errors).zip(&mut decode_s) {
                let mut active = by_energy[..by_energy.len().min(*tier)].to_vec();
                active.sort_unstable();
                let start = (self.clock)();
                let each = coefficients.chunks_exact(basis.columns());
                for (state, exact) in each.zip(exact.chunks_exact(basis.rows())) {
                    let fits = basis.reconstruct(
                        state,
                        0..basis.rows(),
                        Select::Only(&active),
                        &mut shown,
                    );
                    fits.map_err(|_| BenchError::Nothing("column of a tier"))?;
                    errors.compare(exact, &shown);
                }
                *spent_s += (self.clock)() - start;
            }
            bytes += encoded.bytes.len();
            states += exact.len() / basis.rows();
        }
        let per_state = |sum: f64| sum / states as f64;
        let resident = basis.resident_bytes() as u64;
        let row = |((tier, errors), spent_s): ((&usize, &Errors), &f64)| {
            let name = format!("{name}-tier{tier}");
            let row = Measured::new(&name, errors);
            let row = row.timed(per_state(encode_s), per_state(*spent_s), resident);
            let (rank, bytes_per_frame) = (*tier, per_state(bytes as f64));
            self.total(Measured { rank, bytes_per_frame, ..row }, &generations)
        };
        Ok(TIERS.iter().zip(&errors).zip(&decode_s).map(row).collect())
    }

    /// The rounded coefficients of a bound's design, for other coders to try themselves on.
    ///
    /// # Errors
    /// The bound is none, or the states cannot be encoded.
    pub fn steps(&self, bound: Bound) -> Result<Steps, BenchError> {
        let rms_m = bound.design_rms_m();
        let design = self.spectrum.design(rms_m);
        let (encoder, _) = self.encoder(&design, None, rms_m)?;
        let (columns, maxima) = (encoder.basis().columns(), encoder.basis().maxima());
        let mut out = Steps { columns, regions: Vec::new(), steps: Vec::new(), bytes: 0 };
        let mut exact = Vec::new();
        for region in 0..self.source.regions() {
            self.progress("steps", region);
            self.source.read(region, &mut exact).map_err(EncodeError::Read)?;
            let encoded = encoder.region(&exact)?;
            let full = encoder.coefficients(&encoded.bytes).0;
            let step_m = toile::step_m(design.step);
            let of_full = |(at, c): (usize, &f32)| (c * maxima[at % columns] / step_m).round();
            out.steps.extend(full.iter().enumerate().map(|c| of_full(c) as i32));
            out.regions.push(self.source.region(region).1);
            out.bytes += encoded.bytes.len() as u64;
        }
        Ok(out)
    }

    /// Encodes every `every`-th region, decodes it as a client does, and compares.
    fn measure(
        &self,
        name: &str,
        encoder: &Encoder,
        every: usize,
    ) -> Result<(Measured, Errors), BenchError> {
        let (mut exact, mut decoded) = (Vec::new(), Vec::new());
        let mut errors = Errors::default();
        let (mut bytes, mut states, mut fixes) = (0, 0, 0);
        let (mut encode_s, mut decode_s, mut timed) = (0.0, 0.0, 0);
        let (rows, columns) = (encoder.basis().rows(), encoder.basis().columns());
        for (turn, region) in (0..self.source.regions()).step_by(every).enumerate() {
            self.progress(name, region);
            self.source.read(region, &mut exact).map_err(EncodeError::Read)?;
            let start = (self.clock)();
            let encoded = encoder.region(&exact)?;
            encode_s += (self.clock)() - start;
            encoder.decode(&encoded.bytes, &mut decoded);
            errors.compare(&exact, &decoded);
            let here = exact.len() / rows;
            if turn.is_multiple_of(TIMED) {
                // A client reads a region once, and reconstructs one state a frame.
                let start = (self.clock)();
                let (coefficients, _) = encoder.coefficients(&encoded.bytes);
                let read = (self.clock)();
                let shown = &mut decoded[..rows];
                let first = &coefficients[..columns];
                let fits = encoder.basis().reconstruct(first, 0..rows, columns, shown);
                fits.map_err(|_| BenchError::Nothing("state of this basis"))?;
                decode_s += (read - start) / here as f64 + (self.clock)() - read;
                timed += 1;
            }
            bytes += encoded.bytes.len();
            fixes += encoded.fixes;
            states += here;
        }
        let per_state = |sum: f64| sum / states as f64;
        let resident = encoder.basis().resident_bytes() as u64;
        let row = Measured::new(name, &errors);
        let row = row.timed(per_state(encode_s), decode_s / f64::from(timed.max(1)), resident);
        let measured = Measured {
            rank: columns,
            bytes_per_frame: per_state(bytes as f64),
            fixed_share: per_state(fixes as f64) / self.source.vertices() as f64,
            ..row
        };
        Ok((measured, errors))
    }

    fn progress(&self, name: &str, region: usize) {
        (self.say)(&format!("{name}: region {region} of {}", self.source.regions()));
    }

    fn total(&self, measured: Measured, generations: &[Vec<u8>]) -> Measured {
        let regions = measured.bytes_per_frame * self.source.states() as f64;
        let basis_bytes = bytes(generations);
        let total_bytes = basis_bytes + regions.round() as u64;
        Measured { basis_bytes, total_bytes, ..measured }
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

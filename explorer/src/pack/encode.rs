//! Encoding, whatever the profile: fitting states to columns, and how far off they are.
//!
//! Every region is decoded again as a client decodes it, and every vertex of every state compared.

use std::sync::Arc;

use codec::kernel::Select;
use codec::kim2013::{self, FULL_SCALE};
use codec::toile::{self, Model, Tree};
use codec::{AppendError, Basis};
use faer::linalg::solvers::{Llt, Solve};
use faer::{Mat, Side};

use super::basis::{BasisError, stay_on_this_thread};
use super::design::Bound;
use super::{bounded, fixed_bits};

/// How coefficients become bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Profile {
    /// 16 bits a coefficient, as in Kim et al. 2013, section 4.
    Kim2013,
    /// Bounded, predicted and entropy-coded.
    #[default]
    Toile,
}

impl Profile {
    /// The profile of a name in a manifest.
    pub fn named(name: &str) -> Option<Self> {
        [Self::Kim2013, Self::Toile].into_iter().find(|profile| profile.name() == name)
    }

    /// Its name in a manifest.
    pub fn name(self) -> &'static str {
        match self {
            Self::Kim2013 => kim2013::PROFILE,
            Self::Toile => toile::PROFILE,
        }
    }
}

/// Policy of the encoder.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EncodeSettings {
    /// How coefficients become bytes.
    pub profile: Profile,
    /// What profile `toile` keeps to.
    pub bound: Bound,
    /// States that a basis is made for, at least: profile `toile` weighs the bytes of its basis
    /// against those of so many states.
    pub states_expected: u64,
    /// Columns of the basis of a first version, at most.
    pub rank_max: usize,
    /// Columns that one later generation appends, at most: 32 of 8 bits cost a client about half
    /// a megabyte per 5,000 vertices.
    pub generation_columns_max: usize,
    /// Columns of all generations, at most. Twice the first rank keeps decoding within twice its
    /// cost; what comes later is encoded as well as these columns can, its error stated.
    pub columns_max: usize,
    /// Full scale of a coefficient over the largest one seen when its column was made.
    pub headroom: f32,
    /// A region is said to fall outside once its error is this many times that of the first
    /// version (`kim2013`: its largest; `toile`: its root mean square).
    pub error_factor: f32,
    /// ... and, for `kim2013`, above this (m): below, no one sees it, and the first version may be
    /// tiny.
    pub error_floor_m: f32,
}

impl EncodeSettings {
    /// The defaults of profile `kim2013` for a basis of `rank_max` columns.
    pub fn for_rank(rank_max: usize) -> Self {
        Self {
            profile: Profile::Kim2013,
            bound: Bound::default(),
            states_expected: 0,
            rank_max,
            generation_columns_max: 32,
            columns_max: (2 * rank_max).min(codec::COLUMNS_MAX),
            headroom: 1.5,
            error_factor: 1.5,
            error_floor_m: 0.002,
        }
    }

    /// The defaults of profile `toile` for a bound.
    pub fn for_bound(bound: Bound) -> Self {
        Self {
            profile: Profile::Toile,
            bound,
            states_expected: 20_000,
            columns_max: 512,
            ..Self::for_rank(400)
        }
    }
}

/// Why states could not be encoded.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// No basis.
    #[error("basis: {0}")]
    Basis(#[from] BasisError),
    /// A column that does not fit its bits.
    #[error("column {column}: {source}")]
    Column {
        /// Which one.
        column: usize,
        /// Why.
        source: kim2013::QuantiseError,
    },
    /// Columns that do not make a generation.
    #[error(transparent)]
    Generation(#[from] kim2013::GenerationError),
    /// Columns that do not make a generation of profile `toile`.
    #[error(transparent)]
    ToileGeneration(#[from] toile::GenerationError),
    /// Coefficients or fixes that do not make a region of profile `toile`.
    #[error(transparent)]
    ToileRegion(#[from] toile::RegionError),
    /// A generation that does not extend the basis.
    #[error(transparent)]
    Append(#[from] AppendError),
    /// Columns of a generation that depend on one another.
    #[error("generation {0} has columns that depend on one another")]
    Dependent(usize),
    /// States without extent: every vertex is at the hips.
    #[error("the states span nothing that a step of 300 micrometres can hold")]
    Nothing,
    /// A bound that cannot be kept.
    #[error("a bound of {0:?} cannot be kept: give lengths of 0.01 mm and more")]
    Bound(Bound),
    /// A root mean square that fixes did not reach.
    #[error("the states were brought to {reached_m} m in the root mean square, not to {asked_m} m")]
    Unreached {
        /// Reached (m).
        reached_m: f64,
        /// Asked for (m).
        asked_m: f64,
    },
    /// Not whole states of the basis' rows, none, or more than a region holds.
    #[error(
        "{numbers} numbers do not make 1 to {} states of {rows} rows",
        codec::REGION_STATES_MAX
    )]
    States {
        /// Numbers given.
        numbers: usize,
        /// Rows of the basis.
        rows: usize,
    },
    /// The states could not be read.
    #[error("reading states: {0}")]
    Read(#[from] std::io::Error),
}

/// A region in bytes, and how far off it is.
#[derive(Debug, Clone, PartialEq)]
pub struct EncodedRegion {
    /// A region of the encoder's profile.
    pub bytes: Vec<u8>,
    /// Largest vertex error of its states, decoded as a client decodes them (m); rounded up.
    pub max_error_m: f32,
    /// Sum of squared vertex errors over all its states and vertices (m^2).
    pub square_sum_m2: f64,
    /// A coefficient was beyond its column's headroom and was held there.
    pub overflowed: bool,
    /// Vertices with a fix of their own, over all its states.
    pub fixes: usize,
}

/// Columns of all generations, as the encoder needs them. Made from encoded generations only, so
/// that a publisher that was resumed encodes as one that never stopped. Clones share them.
#[derive(Clone)]
pub struct Encoder {
    pub(super) basis: Basis,
    layers: Vec<Arc<Layer>>,
    pub(super) coding: Coding,
}

/// What a profile keeps beside the columns.
#[derive(Clone)]
pub(super) enum Coding {
    Kim2013,
    Toile(Box<Bounded>),
}

/// What profile `toile` keeps beside the columns.
#[derive(Clone)]
pub(super) struct Bounded {
    pub(super) model: Model,
    pub(super) tree: Option<Arc<Tree>>,
    /// Code of the step of coefficients, from the newest generation.
    pub(super) step: u8,
    /// States that the first generation was made from, and its root mean square error (m).
    pub(super) made: (u32, f32),
    /// How many generations are of that moment.
    pub(super) first_generations: usize,
    pub(super) generations: usize,
    /// Columns of the first generation.
    pub(super) leading: usize,
    pub(super) max_m: Option<f32>,
}

/// One generation: `C' -> metres`, and the factor of its normal equations.
struct Layer {
    columns: Mat<f32>,
    normal: Llt<f64>,
}

/// Shows regions of states to a visitor, in order: state after state. Called several times.
pub type Visit<'a> =
    dyn FnMut(&mut dyn FnMut(&[f32]) -> Result<(), EncodeError>) -> Result<(), EncodeError> + 'a;

impl Encoder {
    /// Without columns.
    pub fn new(settings: &EncodeSettings) -> Self {
        stay_on_this_thread();
        let coding = match settings.profile {
            Profile::Kim2013 => Coding::Kim2013,
            Profile::Toile => Coding::Toile(Box::new(Bounded {
                model: Model::default(),
                tree: None,
                step: 0,
                made: (0, 0.0),
                first_generations: 0,
                generations: 0,
                leading: 0,
                max_m: settings.bound.max_m,
            })),
        };
        Self { basis: Basis::new(), layers: Vec::new(), coding }
    }

    /// The basis as a client has it.
    pub fn basis(&self) -> &Basis {
        &self.basis
    }

    /// Appends an encoded generation.
    ///
    /// # Errors
    /// Bytes that are no generation, or one that does not extend this basis.
    pub fn append(&mut self, generation: &[u8]) -> Result<(), EncodeError> {
        let resident = match &mut self.coding {
            Coding::Kim2013 => None,
            Coding::Toile(bounded) => Some(bounded.append(generation)?),
        };
        let generation = kim2013::Generation::parse(resident.as_deref().unwrap_or(generation))?;
        self.basis.append(&generation)?;
        let layer = Layer::new(&generation).ok_or(EncodeError::Dependent(self.layers.len()))?;
        self.layers.push(Arc::new(layer));
        Ok(())
    }

    /// Encodes 1 to 32 states: least squares against the decoded columns of each generation in
    /// turn, each taking what the ones before left.
    ///
    /// * `positions`: state after state, the basis' rows each (m).
    ///
    /// # Errors
    /// Numbers that are not such states, or not finite.
    pub fn region(&self, positions: &[f32]) -> Result<EncodedRegion, EncodeError> {
        let rows = self.basis.rows();
        let numbers = positions.len();
        let states = numbers.checked_div(rows).unwrap_or(0);
        let fits = (1..=codec::REGION_STATES_MAX).contains(&states) && states * rows == numbers;
        if !fits {
            return Err(EncodeError::States { numbers, rows });
        }
        if let Some(at) = positions.iter().position(|x| !x.is_finite()) {
            return Err(BasisError::NotFinite { state: at / rows, row: at % rows }.into());
        }
        match &self.coding {
            Coding::Kim2013 => Ok(fixed_bits::region(self, positions)),
            Coding::Toile(bounded) => bounded::region(self, bounded, positions),
        }
    }

    /// Positions (m) of all states of a region that this encoder made, as a client decodes them;
    /// `out` is resized.
    ///
    /// # Panics
    /// Bytes that this encoder did not make.
    pub fn decode(&self, region: &[u8], out: &mut Vec<f32>) {
        match &self.coding {
            Coding::Kim2013 => fixed_bits::decode(self, region, out),
            Coding::Toile(bounded) => bounded::decode(self, bounded, region, out),
        }
    }

    /// As [`Encoder::decode`], without the vertices' own fixes: what more columns could better.
    ///
    /// # Panics
    /// Bytes that this encoder did not make.
    pub(super) fn decode_columns(&self, region: &[u8], out: &mut Vec<f32>) {
        match &self.coding {
            Coding::Kim2013 => fixed_bits::decode(self, region, out),
            Coding::Toile(bounded) => {
                bounded::decode_columns(self, bounded, region, out);
            }
        }
    }

    /// A region's coefficients in fractions of full scale, state after state, as many as the basis
    /// has columns; and its columns that are not zero, those that carry most first.
    pub(super) fn coefficients(&self, region: &[u8]) -> (Vec<f32>, Vec<u16>) {
        let columns = self.basis.columns();
        match &self.coding {
            Coding::Kim2013 => {
                let region = kim2013::Region::parse(region).expect("a region of this encoder");
                let full = region.coefficients().map(|c| f32::from(c) * (1.0 / FULL_SCALE));
                (full.collect(), (0..columns as u16).collect())
            }
            Coding::Toile(bounded) => {
                let region = toile::parse_region(region, &bounded.model);
                let region = region.expect("a region of this encoder");
                let full = region.coefficients().iter().map(|c| f32::from(*c) / FULL_SCALE);
                (full.collect(), region.by_energy().to_vec())
            }
        }
    }

    /// Positions (m) from coefficients in 16-bit steps of full scale, state after state, with these
    /// columns; `out` is resized.
    pub(super) fn reconstruct(&self, coefficients: &[i16], select: Select<'_>, out: &mut Vec<f32>) {
        let (rows, columns) = (self.basis.rows(), self.basis.columns());
        out.resize(coefficients.len() / columns * rows, 0.0);
        let scaled: Vec<f32> =
            coefficients.iter().map(|c| f32::from(*c) * (1.0 / FULL_SCALE)).collect();
        // All states in one pass over the columns: each comes out as it does alone.
        let whole = self.basis.reconstruct_batch(&scaled, columns, 0..rows, select, out);
        whole.expect("lengths are those of the basis");
    }

    /// Fits states to the columns. `round` gets column, state and the coefficient in fractions of
    /// full scale (held within -1..=1), and returns it as the client will have it; says whether
    /// one had to be held.
    pub(super) fn fit(
        &self,
        positions: &[f32],
        mut round: impl FnMut(usize, usize, f64) -> f64,
    ) -> bool {
        let rows = self.basis.rows();
        let states = positions.len() / rows;
        let mut rest = Mat::from_fn(rows, states, |row, s| positions[s * rows + row]);
        let mut overflowed = false;
        let mut first = 0;
        for (index, layer) in self.layers.iter().enumerate() {
            // Products in f32: what they round away is micrometres, where a step is millimetres.
            let products = layer.columns.transpose() * &rest;
            let mut coefficients =
                Mat::from_fn(products.nrows(), states, |c, s| f64::from(products[(c, s)]));
            layer.normal.solve_in_place(coefficients.as_mut());
            for state in 0..states {
                let column = coefficients.col_as_slice_mut(state);
                for (c, value) in column.iter_mut().enumerate() {
                    let held = value.clamp(-1.0, 1.0);
                    overflowed |= held.to_bits() != value.to_bits();
                    *value = round(first + c, state, held);
                }
            }
            if index + 1 < self.layers.len() {
                let rounded =
                    Mat::from_fn(products.nrows(), states, |c, s| coefficients[(c, s)] as f32);
                rest -= &layer.columns * &rounded;
            }
            first += layer.columns.ncols();
        }
        overflowed
    }
}

impl Layer {
    /// `None` where the columns depend on one another.
    fn new(generation: &kim2013::Generation<'_>) -> Option<Self> {
        let mut exact = Mat::zeros(generation.rows(), generation.columns());
        let step = f64::from(generation.step_m());
        for (c, (width, bytes)) in generation.entries().enumerate() {
            let entry = |b: &[u8]| match width {
                kim2013::Width::Bits8 => i16::from(b[0] as i8),
                kim2013::Width::Bits16 => i16::from_le_bytes([b[0], b[1]]),
            };
            let out = exact.col_as_slice_mut(c).iter_mut();
            out.zip(bytes.chunks_exact(width.bytes()))
                .for_each(|(out, b)| *out = step * f64::from(entry(b)));
        }
        let mut gram = exact.transpose() * &exact;
        for c in 0..gram.ncols() {
            // Quantised columns may all but depend on one another, or be nothing at all.
            let square = gram[(c, c)];
            gram[(c, c)] = if square > 0.0 { square * (1.0 + 1e-9) } else { 1.0 };
        }
        let normal = gram.llt(Side::Lower).ok()?;
        let columns = Mat::from_fn(exact.nrows(), exact.ncols(), |r, c| exact[(r, c)] as f32);
        Some(Self { columns, normal })
    }
}

/// Largest vertex error (m, rounded up) and the sum of their squares (m^2).
pub(super) fn errors(exact: &[f32], decoded: &[f32]) -> (f32, f64) {
    let (mut max, mut sum) = (0.0f64, 0.0);
    for (exact, decoded) in exact.chunks_exact(3).zip(decoded.chunks_exact(3)) {
        let square: f64 =
            (0..3).map(|i| (f64::from(exact[i]) - f64::from(decoded[i])).powi(2)).sum();
        sum += square;
        max = max.max(square);
    }
    (round_up(max.sqrt()), sum)
}

/// The smallest f32 that is not below `x`.
pub(super) fn round_up(x: f64) -> f32 {
    let nearest = x as f32;
    if f64::from(nearest) < x { nearest.next_up() } else { nearest }
}

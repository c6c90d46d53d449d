//! Generations and regions of any profile, to one resident form.

use std::sync::Arc;

use crate::kim2013;
use crate::toile::{self, Model, Tree};
use crate::{AppendError, Basis};

/// Decodes what one garment is made of: generations first, in order, then regions. A clone shares
/// the columns.
#[derive(Debug, Clone)]
pub struct Decoder {
    basis: Basis,
    toile: Option<ToileDecoder>,
}

/// What profile `toile` keeps beside the columns.
#[derive(Debug, Clone, Default)]
struct ToileDecoder {
    model: Model,
    tree: Option<Arc<Tree>>,
}

/// A region, decoded.
#[derive(Debug, Clone, PartialEq)]
pub struct DecodedRegion {
    /// How many states.
    pub states: usize,
    /// Columns of all generations up to the region's, as far as they are known.
    pub columns: usize,
    /// Whether all of its columns are known; else the leading ones are here.
    pub is_whole: bool,
    /// State after state: fractions of full scale in steps of 1/32,767.
    pub coefficients: Vec<i16>,
    /// Vertices that are moved after reconstruction, by state, then vertex.
    pub fixes: Vec<VertexFix>,
    /// Columns that are not zero here, those that carry most first; empty in profile `kim2013`.
    pub by_energy: Vec<u16>,
    /// Largest vertex error (m) with the first [`toile::TIERS`] of `by_energy` alone, where the
    /// region states it.
    pub tier_errors_m: Option<[f32; toile::TIERS.len()]>,
    /// Largest vertex error (m) with the first generation's columns alone, where the region states
    /// it.
    pub leading_error_m: Option<f32>,
}

/// A vertex of a state that is moved after reconstruction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VertexFix {
    /// Place in the region.
    pub state: u16,
    /// Which vertex.
    pub vertex: u32,
    /// By how much (m).
    pub offset_m: [f32; 3],
}

/// Why a generation or a region could not be decoded.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum DecoderError {
    /// A generation of profile `kim2013`.
    #[error(transparent)]
    Generation(#[from] kim2013::GenerationError),
    /// A generation of profile `toile`.
    #[error(transparent)]
    ToileGeneration(#[from] toile::GenerationError),
    /// A generation that does not extend the ones before.
    #[error(transparent)]
    Append(#[from] AppendError),
    /// A region of profile `kim2013`.
    #[error(transparent)]
    Region(#[from] kim2013::RegionError),
    /// A region of profile `toile`.
    #[error(transparent)]
    ToileRegion(#[from] toile::RegionError),
}

impl Decoder {
    /// Names of the profiles that can be decoded.
    pub const PROFILES: [&str; 2] = [kim2013::PROFILE, toile::PROFILE];

    /// For a profile of this name; `None` for one that this build does not know.
    pub fn new(profile: &str) -> Option<Self> {
        let toile = match profile {
            kim2013::PROFILE => None,
            toile::PROFILE => Some(ToileDecoder::default()),
            _ => return None,
        };
        Some(Self { basis: Basis::new(), toile })
    }

    /// The columns so far.
    pub fn basis(&self) -> &Basis {
        &self.basis
    }

    /// Appends a generation.
    ///
    /// # Errors
    /// Bytes that are no generation, or one that does not extend the ones before.
    pub fn append(&mut self, generation: &[u8]) -> Result<(), DecoderError> {
        let Some(toile) = &mut self.toile else {
            return Ok(self.basis.append(&kim2013::Generation::parse(generation)?)?);
        };
        let generation = toile::parse_generation(generation, toile.tree.as_deref())?;
        let resident = generation.to_resident();
        self.basis.append(&kim2013::Generation::parse(&resident)?)?;
        if toile.tree.is_none() {
            toile.model = Model::new(generation.rows() / 3);
            toile.tree = generation.tree().cloned().map(Arc::new);
        }
        toile.model.append(generation.columns());
        Ok(())
    }

    /// Decodes a region. Where its newest generations are not here yet, the leading columns alone.
    ///
    /// # Errors
    /// Bytes that are no region.
    pub fn region(&self, bytes: &[u8]) -> Result<DecodedRegion, DecoderError> {
        let Some(toile) = &self.toile else {
            let region = kim2013::Region::parse(bytes)?;
            let is_whole = region.columns() <= self.basis.columns();
            return Ok(DecodedRegion {
                states: region.states(),
                columns: region.columns(),
                is_whole,
                coefficients: region.coefficients().collect(),
                fixes: Vec::new(),
                by_energy: Vec::new(),
                tier_errors_m: None,
                leading_error_m: None,
            });
        };
        let region = toile::parse_region(bytes, &toile.model)?;
        let step_m = region.fix_step_m();
        let fix = |fix: &toile::Fix| VertexFix {
            state: fix.state,
            vertex: fix.vertex,
            offset_m: fix.steps.map(|steps| steps as f32 * step_m),
        };
        Ok(DecodedRegion {
            states: region.states(),
            columns: region.columns(),
            is_whole: region.is_whole(),
            fixes: region.fixes().iter().map(fix).collect(),
            by_energy: region.by_energy().to_vec(),
            tier_errors_m: Some(region.tier_errors_m()),
            leading_error_m: region.leading_error_m(),
            coefficients: region.into_coefficients(),
        })
    }
}

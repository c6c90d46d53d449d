//! The container of encoded regions: a chunk bundles regions that are likely to be needed
//! together. The encoded coefficients themselves are opaque here (see `codec`).

use serde::{Deserialize, Serialize};

use crate::ids::{GenerationId, StateId};
use crate::limits;
use crate::wire::{DecodeError, Format, at_most, ensure};

const REGIONS: Format = Format {
    what: "region chunk",
    magic: *b"TRGN",
    version: 1,
    bytes_max: limits::CHUNK_BYTES_MAX,
};

/// One region: consecutive states of one trajectory, which decode on their own.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RegionEntry {
    /// Its first state; the others follow by id.
    pub first_state: StateId,
    /// How many states, at most `REGION_STATES_MAX`.
    pub state_count: u16,
    /// The newest basis generation its coefficients refer to.
    pub generation: GenerationId,
    /// True maximum vertex error of its states after decoding (m).
    pub max_error_m: f32,
    /// Encoded bytes, in the garment's codec.
    #[serde(with = "crate::wire::bytes")]
    pub bytes: Vec<u8>,
}

/// A chunk of regions, in order of `first_state`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RegionChunk {
    /// The regions.
    pub regions: Vec<RegionEntry>,
}

impl RegionChunk {
    /// Bytes to store.
    ///
    /// # Panics
    /// If [`RegionChunk::check`] fails.
    pub fn encode(&self) -> Vec<u8> {
        self.check().expect("a region chunk is checked before it is written");
        REGIONS.encode(self)
    }

    /// Reads and checks.
    ///
    /// # Errors
    /// Damaged bytes, or regions that break a rule of [`RegionChunk::check`].
    pub fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
        let chunk: Self = REGIONS.decode(bytes)?;
        chunk.check()?;
        Ok(chunk)
    }

    /// Regions of 1 to `REGION_STATES_MAX` states, sorted and apart, errors finite.
    ///
    /// # Errors
    /// The first rule that is broken, with its place.
    pub fn check(&self) -> Result<(), DecodeError> {
        self.check_regions().map_err(|why| REGIONS.invalid(why))
    }

    fn check_regions(&self) -> Result<(), String> {
        ensure(!self.regions.is_empty(), || "no region".into())?;
        let mut free_from = 0;
        for (index, region) in self.regions.iter().enumerate() {
            let count = usize::from(region.state_count);
            at_most("states in a region", count, limits::REGION_STATES_MAX)?;
            ensure(count > 0, || format!("region {index} has no state"))?;
            let first = region.first_state.0;
            ensure(first < limits::STATES_MAX, || format!("region {index}: state {first}"))?;
            ensure(first >= free_from, || {
                format!("region {index} begins at state {first}, before {free_from}, out of order")
            })?;
            free_from = first + u64::from(region.state_count);
            ensure(region.max_error_m.is_finite() && region.max_error_m >= 0.0, || {
                format!("region {index} claims an error of {} m", region.max_error_m)
            })?;
        }
        Ok(())
    }
}

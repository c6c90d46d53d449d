//! The container of encoded regions: a chunk bundles regions that are likely to be needed
//! together. The encoded coefficients themselves are opaque here (see `codec`).

use serde::{Deserialize, Serialize};

use crate::ids::{GenerationId, StateId};

/// One region: consecutive states of one trajectory, which decode on their own.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RegionEntry {
    /// Its first state; the others follow by id.
    pub first_state: StateId,
    /// How many states, at most `REGION_STATES_MAX`.
    pub state_count: u16,
    /// The newest basis generation its coefficients refer to.
    pub generation: GenerationId,
    /// True maximum vertex error of its states after decoding [m].
    pub max_error_m: f32,
    /// Encoded bytes, in the garment's codec.
    pub bytes: Vec<u8>,
}

/// A chunk of regions, in order of `first_state`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RegionChunk {
    /// The regions.
    pub regions: Vec<RegionEntry>,
}

//! Merges that a person pointed at, as servers leave them in the store for the explorer: an audit
//! trail beside the telemetry, outside every version.

use serde::{Deserialize, Serialize};

use crate::ids::{GarmentId, StateId, VersionNumber};
use crate::limits;
use crate::wire::{DecodeError, Format, ensure};

const TAG: Format = Format { what: "tag", magic: *b"TTAG", version: 1, bytes_max: 64 };

/// The explorer is asked to simulate at this dead end next. No clock and no name in it: when it was
/// written is the store's to tell.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Tag {
    /// The garment.
    pub garment: GarmentId,
    /// The dead end.
    pub state: StateId,
    /// The newest version of the server that took it.
    pub version: VersionNumber,
}

impl Tag {
    /// Bytes to store at `store::tag_path(number)`.
    ///
    /// # Panics
    /// If [`Tag::check`] fails.
    pub fn encode(&self) -> Vec<u8> {
        self.check().expect("a tag is checked before it is written");
        TAG.encode(self)
    }

    /// Reads and checks.
    ///
    /// # Errors
    /// Damaged bytes, or a state out of range.
    pub fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
        let tag: Self = TAG.decode(bytes)?;
        tag.check()?;
        Ok(tag)
    }

    /// The state is in range.
    ///
    /// # Errors
    /// It is not.
    pub fn check(&self) -> Result<(), DecodeError> {
        let fits = self.state.0 < limits::STATES_MAX;
        ensure(fits, || format!("state {} is out of range", self.state))
            .map_err(|why| TAG.invalid(why))
    }
}

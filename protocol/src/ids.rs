//! Names of things. Ids are given in order of creation and never reused.

use serde::{Deserialize, Serialize};

macro_rules! id {
    ($(#[$doc:meta])* $name:ident($inner:ty)) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        pub struct $name(pub $inner);

        impl $name {
            /// As an index into a table.
            pub fn index(self) -> usize {
                self.0 as usize
            }
        }

        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                self.0.fmt(f)
            }
        }
    };
}

id!(
    /// A garment of the world (character + garment + motion graph).
    GarmentId(u32)
);
id!(
    /// A cloth state of one garment, dead ends included; in order of creation.
    StateId(u64)
);
id!(
    /// A pose: a node of the primary graph.
    PoseId(u32)
);
id!(
    /// An edge of the primary graph. Edges are sorted by source pose, so the out-edges of a pose
    /// are consecutive.
    EdgeId(u32)
);
id!(
    /// A basis generation; generation 0 is frozen at the first version.
    GenerationId(u16)
);
id!(
    /// Number of a version; the first published is 1.
    VersionNumber(u64)
);

/// BLAKE3 hash of a chunk's bytes: its name everywhere.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct ChunkHash(pub [u8; 32]);

impl ChunkHash {
    /// The name of these bytes.
    pub fn of(bytes: &[u8]) -> Self {
        Self(*blake3::hash(bytes).as_bytes())
    }

    /// 64 lower-case hexadecimal digits, or `None`.
    pub fn from_hex(text: &str) -> Option<Self> {
        blake3::Hash::from_hex(text).ok().map(|hash| Self(*hash.as_bytes()))
    }
}

impl std::fmt::Display for ChunkHash {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        blake3::Hash::from(self.0).to_hex().fmt(f)
    }
}

impl std::fmt::Debug for ChunkHash {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:.8}", blake3::Hash::from(self.0).to_hex())
    }
}

//! A version: a numbered, signed, immutable listing.

use serde::{Deserialize, Serialize};

use crate::ids::{ChunkHash, GarmentId, StateId, VersionNumber};

/// A chunk by name and size.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct ChunkRef {
    /// Its name.
    pub hash: ChunkHash,
    /// Its size in bytes.
    pub bytes: u32,
}

/// Everything that makes one version of the world. No clock in it (design decision 7).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Counts up by one.
    pub number: VersionNumber,
    /// BLAKE3 of the previous manifest's unsigned bytes.
    pub previous: Option<ChunkHash>,
    /// The garments of the world, by id.
    pub garments: Vec<GarmentVersion>,
}

/// One garment in a version.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GarmentVersion {
    /// Its id.
    pub id: GarmentId,
    /// Its name, unique in the world.
    pub name: String,
    /// Name of the codec profile, e.g. `kim2013`.
    pub codec: String,
    /// A `SceneChunk`.
    pub scene: ChunkRef,
    /// A `GarmentChunk`.
    pub mesh: ChunkRef,
    /// Basis generations, oldest first; a generation only appends columns.
    pub generations: Vec<GenerationRef>,
    /// Region chunks, by first state.
    pub regions: Vec<RegionChunkRef>,
    /// Link pages, in order.
    pub links: Vec<ChunkRef>,
    /// What is known of this version.
    pub stats: VersionStats,
}

/// A basis generation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GenerationRef {
    /// Encoded columns.
    pub chunk: ChunkRef,
    /// How many columns it appends.
    pub columns: u16,
}

/// A chunk of regions and the states that it covers.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RegionChunkRef {
    /// A `RegionChunk`.
    pub chunk: ChunkRef,
    /// Its first state.
    pub first_state: StateId,
    /// It covers this many consecutive ids.
    pub state_count: u32,
    /// Part of the initial graph, which clients keep resident.
    pub initial: bool,
}

/// Figures of a version, as measured by its publisher.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct VersionStats {
    /// Poses of the primary graph.
    pub poses: u32,
    /// Edges of the primary graph.
    pub edges: u32,
    /// States, dead ends included, retired ones not.
    pub states: u64,
    /// Trajectories.
    pub trajectories: u64,
    /// Dead ends, each merged into an interior state.
    pub merges: u64,
    /// Frames simulated so far, drape apart.
    pub simulated_frames: u64,
    /// Largest merge error of this version [m].
    pub worst_error_m: f32,
    /// Mean merge error of this version [m].
    pub mean_error_m: f32,
    /// Largest vertex error of any encoded state of this version [m].
    pub codec_max_error_m: f32,
    /// Root mean square vertex error of the encoded states [m].
    pub codec_rms_error_m: f32,
    /// Raw f32 positions of all its states, in bytes.
    pub raw_bytes: u64,
}

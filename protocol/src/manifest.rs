//! A version: a numbered, signed, immutable listing.

use serde::{Deserialize, Serialize};

use crate::ids::{ChunkHash, GarmentId, StateId, VersionNumber};
use crate::limits;
use crate::sign::{PublisherKey, SIGNATURE_BYTES, Signature, SigningKey};
use crate::wire::{DecodeError, Format, at_most, check_name, ensure};

const MANIFEST: Format = Format {
    what: "manifest",
    magic: *b"TMAN",
    version: 1,
    bytes_max: limits::MANIFEST_BYTES_MAX - SIGNATURE_BYTES,
};

/// Version 2 is version 1 and the list of upsamplers after it. A manifest without any is written as
/// version 1, so that equal content has one form.
const WITH_UPSAMPLERS: Format = Format { version: 2, ..MANIFEST };

/// What follows a manifest of version 2: garments that have an upsampler, by id.
pub(crate) type Upsamplers = Vec<(GarmentId, ChunkRef)>;

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

/// A manifest as it is stored and sent: its unsigned bytes, then the 64 bytes of the signature.
#[derive(Debug, Clone, PartialEq)]
pub struct SignedManifest {
    /// What was signed.
    pub manifest: Manifest,
    /// By whom, see [`SignedManifest::verify`].
    pub signature: Signature,
}

/// Why a manifest was refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ManifestError {
    /// Damaged, or it says something impossible.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// Not from the publisher that is expected.
    #[error("version {number} is not signed by publisher {publisher}; it may be forged")]
    NotSigned {
        /// Its number.
        number: VersionNumber,
        /// Who should have signed it.
        publisher: PublisherKey,
    },
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
    /// A learned upsampler (`codec::upsample`), with which clients leave the graph. It stands apart in
    /// the bytes, see `docs/formats.md`.
    #[serde(skip)]
    pub upsampler: Option<ChunkRef>,
}

/// A basis generation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct GenerationRef {
    /// Encoded columns.
    pub chunk: ChunkRef,
    /// How many columns it appends.
    pub columns: u16,
}

/// A chunk of regions and the states that it covers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
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
    /// Largest merge error of this version (m).
    pub worst_error_m: f32,
    /// Mean merge error of this version (m).
    pub mean_error_m: f32,
    /// Largest vertex error of any encoded state of this version (m).
    pub codec_max_error_m: f32,
    /// Root mean square vertex error of the encoded states (m).
    pub codec_rms_error_m: f32,
    /// Raw f32 positions of all its states, in bytes.
    pub raw_bytes: u64,
}

impl Manifest {
    /// The bytes that are hashed and signed.
    ///
    /// # Panics
    /// If [`Manifest::check`] fails.
    pub fn encode(&self) -> Vec<u8> {
        self.check().expect("a manifest is checked before it is written");
        let upsamplers = self.upsamplers();
        if upsamplers.is_empty() {
            return MANIFEST.encode(self);
        }
        WITH_UPSAMPLERS.encode(&(self, upsamplers))
    }

    /// Reads unsigned bytes and checks them.
    ///
    /// # Errors
    /// Damaged bytes, or a manifest that breaks a rule of [`Manifest::check`].
    pub fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
        let manifest = if Format::is_after(bytes, MANIFEST.version) {
            let (mut manifest, upsamplers): (Self, Upsamplers) = WITH_UPSAMPLERS.decode(bytes)?;
            manifest.set_upsamplers(&upsamplers).map_err(|why| MANIFEST.invalid(why))?;
            manifest
        } else {
            MANIFEST.decode(bytes)?
        };
        manifest.check()?;
        Ok(manifest)
    }

    /// Garments that have an upsampler, by id.
    pub(crate) fn upsamplers(&self) -> Upsamplers {
        let of = |garment: &GarmentVersion| Some((garment.id, garment.upsampler?));
        self.garments.iter().filter_map(of).collect()
    }

    /// Gives garments their upsamplers; refuses a list that no manifest would be written with.
    pub(crate) fn set_upsamplers(&mut self, list: &[(GarmentId, ChunkRef)]) -> Result<(), String> {
        ensure(!list.is_empty(), || "an empty list of upsamplers".into())?;
        ensure(list.is_sorted_by(|a, b| a.0 < b.0), || "upsamplers are out of order".into())?;
        for (id, chunk) in list {
            let garment = self.garments.iter_mut().find(|garment| garment.id == *id);
            let garment = garment.ok_or_else(|| format!("an upsampler of no garment, {id}"))?;
            garment.upsampler = Some(*chunk);
        }
        Ok(())
    }

    /// BLAKE3 of the unsigned bytes: what `previous` and differences name.
    pub fn hash(&self) -> ChunkHash {
        ChunkHash::of(&self.encode())
    }

    /// Signs it.
    pub fn sign(self, key: &SigningKey) -> SignedManifest {
        let signature = key.sign(&self.encode());
        SignedManifest { manifest: self, signature }
    }

    /// The garment of this name.
    pub fn garment(&self, name: &str) -> Option<&GarmentVersion> {
        self.garments.iter().find(|garment| garment.name == name)
    }

    /// Numbered from 1; garments sorted by id, names unique; every list within its limit; region
    /// chunks sorted and apart; figures finite.
    ///
    /// # Errors
    /// The first rule that is broken, with its place.
    pub fn check(&self) -> Result<(), DecodeError> {
        self.check_garments().map_err(|why| MANIFEST.invalid(why))
    }

    fn check_garments(&self) -> Result<(), String> {
        ensure(self.number.0 > 0, || "version 0; the first is 1".into())?;
        at_most("garments", self.garments.len(), limits::GARMENTS_MAX)?;
        let entries = self.garments.iter().map(|g| g.links.len() + g.regions.len());
        at_most("region chunks and link pages", entries.sum(), limits::MANIFEST_ENTRIES_MAX)?;
        let mut names = std::collections::BTreeSet::new();
        let mut id_before = None;
        for garment in &self.garments {
            ensure(id_before < Some(garment.id), || "garments are not sorted by id".into())?;
            id_before = Some(garment.id);
            check_name("a garment", &garment.name)?;
            ensure(names.insert(&garment.name), || format!("two garments {:?}", garment.name))?;
            garment.check().map_err(|why| format!("garment {:?}: {why}", garment.name))?;
        }
        Ok(())
    }
}

impl SignedManifest {
    /// Bytes to store: at `store::version_path(number)`.
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = self.manifest.encode();
        bytes.extend_from_slice(&self.signature.0);
        bytes
    }

    /// Reads and checks all but who signed it.
    ///
    /// # Errors
    /// Damaged bytes, or a manifest that breaks a rule of [`Manifest::check`].
    pub fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
        let malformed = DecodeError::Malformed { what: MANIFEST.what, bytes: bytes.len() };
        let (unsigned, signature) = bytes.split_last_chunk().ok_or(malformed)?;
        Ok(Self { manifest: Manifest::decode(unsigned)?, signature: Signature(*signature) })
    }

    /// Checks who signed it.
    ///
    /// # Errors
    /// Someone else did, or nobody.
    pub fn verify(&self, publisher: &PublisherKey) -> Result<(), ManifestError> {
        if publisher.has_signed(&self.manifest.encode(), &self.signature) {
            return Ok(());
        }
        let number = self.manifest.number;
        Err(ManifestError::NotSigned { number, publisher: *publisher })
    }

    /// Reads, checks and verifies.
    ///
    /// # Errors
    /// Damaged, impossible, or not signed by `publisher`.
    pub fn open(bytes: &[u8], publisher: &PublisherKey) -> Result<Self, ManifestError> {
        let signed = Self::decode(bytes)?;
        signed.verify(publisher)?;
        Ok(signed)
    }
}

impl GarmentVersion {
    /// Every chunk it lists, without order or duplicates removed.
    pub fn chunks(&self) -> impl Iterator<Item = ChunkRef> + '_ {
        [self.scene, self.mesh]
            .into_iter()
            .chain(self.generations.iter().map(|generation| generation.chunk))
            .chain(self.links.iter().copied())
            .chain(self.regions.iter().map(|region| region.chunk))
            .chain(self.upsampler)
    }

    fn check(&self) -> Result<(), String> {
        check_name("its codec", &self.codec)?;
        at_most("generations", self.generations.len(), limits::GENERATIONS_MAX)?;
        let columns = self.generations.iter().map(|generation| usize::from(generation.columns));
        at_most("columns", columns.sum(), limits::COLUMNS_MAX)?;
        let mut free_from = 0;
        for (index, region) in self.regions.iter().enumerate() {
            let first = region.first_state.0;
            ensure(first >= free_from && first < limits::STATES_MAX, || {
                format!("region chunk {index} begins at state {first}, out of order or range")
            })?;
            ensure(region.state_count > 0, || format!("region chunk {index} covers no state"))?;
            free_from = first + u64::from(region.state_count);
        }
        for chunk in self.chunks() {
            at_most("bytes in a chunk", chunk.bytes as usize, limits::CHUNK_BYTES_MAX)?;
        }
        self.stats.check()
    }
}

impl VersionStats {
    fn check(&self) -> Result<(), String> {
        let figures =
            [self.worst_error_m, self.mean_error_m, self.codec_max_error_m, self.codec_rms_error_m];
        ensure(figures.iter().all(|m| m.is_finite() && *m >= 0.0), || {
            format!("errors of {figures:?} m are no errors")
        })
    }
}

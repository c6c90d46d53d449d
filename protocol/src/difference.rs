//! What changed from one manifest to another: a new version costs only that.

use std::collections::HashMap;
use std::hash::Hash;

use serde::{Deserialize, Serialize};

use crate::ids::{ChunkHash, GarmentId, VersionNumber};
use crate::limits;
use crate::manifest::{
    ChunkRef, GarmentVersion, GenerationRef, Manifest, ManifestError, RegionChunkRef,
    SignedManifest, Upsamplers, VersionStats,
};
use crate::sign::{PublisherKey, Signature};
use crate::wire::{DecodeError, Format};

const DIFFERENCE: Format = Format {
    what: "manifest difference",
    magic: *b"TDIF",
    version: 1,
    bytes_max: limits::MANIFEST_BYTES_MAX,
};

/// Version 2 is version 1 and the upsamplers of the manifest it leads to, as in a manifest.
const WITH_UPSAMPLERS: Format = Format { version: 2, ..DIFFERENCE };

/// Turns a manifest that the receiver holds into a newer (or any other) one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ManifestDifference {
    /// Number of the manifest it starts from.
    pub base: VersionNumber,
    /// BLAKE3 of that manifest's unsigned bytes.
    pub base_hash: ChunkHash,
    /// Number of the manifest it leads to.
    pub number: VersionNumber,
    previous: Option<ChunkHash>,
    garments: Vec<GarmentDifference>,
    signature: Signature,
    /// All of the manifest it leads to; it stands apart in the bytes.
    #[serde(skip)]
    upsamplers: Upsamplers,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
enum GarmentDifference {
    /// As in the base.
    Same(GarmentId),
    /// Changed or new (then every list is).
    Changed(Box<Changed>),
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Changed {
    id: GarmentId,
    name: String,
    codec: String,
    scene: ChunkRef,
    mesh: ChunkRef,
    generations: Vec<Piece<GenerationRef>>,
    regions: Vec<Piece<RegionChunkRef>>,
    links: Vec<Piece<ChunkRef>>,
    stats: VersionStats,
}

/// A stretch of a list.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
enum Piece<T> {
    /// Entries of the base's list.
    Kept { first: u32, count: u32 },
    /// New entries.
    New(Vec<T>),
}

/// Why a difference could not be applied.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ApplyError {
    /// It starts from another manifest.
    #[error("the difference starts from version {expected}, not from this version {found}")]
    OtherBase {
        /// What it starts from.
        expected: VersionNumber,
        /// What it was applied to.
        found: VersionNumber,
    },
    /// It names garments or entries that the base does not have.
    #[error("the difference to version {0} does not fit its base")]
    DoesNotFit(VersionNumber),
    /// The result is no valid manifest, or not the one that was signed.
    #[error(transparent)]
    Manifest(#[from] ManifestError),
}

impl ManifestDifference {
    /// What leads from `from` to `to`; carries the signature of `to`.
    ///
    /// Cost: linear in both lists.
    pub fn compute(from: &Manifest, to: &SignedManifest) -> Self {
        let changed = |garment: &GarmentVersion| {
            let base = from.garments.iter().find(|base| base.id == garment.id);
            match base {
                Some(base) if base == garment => GarmentDifference::Same(garment.id),
                _ => GarmentDifference::Changed(Box::new(Changed::compute(base, garment))),
            }
        };
        Self {
            base: from.number,
            base_hash: from.hash(),
            number: to.manifest.number,
            previous: to.manifest.previous,
            garments: to.manifest.garments.iter().map(changed).collect(),
            signature: to.signature,
            upsamplers: to.manifest.upsamplers(),
        }
    }

    /// The manifest it leads to, whole, checked, and verified as signed by `publisher`.
    ///
    /// # Errors
    /// Another base, entries that the base does not have, or a result that was not signed.
    pub fn apply(
        &self,
        base: &Manifest,
        publisher: &PublisherKey,
    ) -> Result<SignedManifest, ApplyError> {
        if base.number != self.base || base.hash() != self.base_hash {
            return Err(ApplyError::OtherBase { expected: self.base, found: base.number });
        }
        let misfit = ApplyError::DoesNotFit(self.number);
        let mut room = limits::MANIFEST_ENTRIES_MAX;
        let garments = self.garments.iter().map(|difference| match difference {
            GarmentDifference::Same(id) => {
                let same = base.garments.iter().find(|g| g.id == *id)?;
                room = room.checked_sub(same.links.len() + same.regions.len())?;
                Some(same.clone())
            }
            GarmentDifference::Changed(changed) => {
                changed.apply(base.garments.iter().find(|g| g.id == changed.id), &mut room)
            }
        });
        let garments: Vec<GarmentVersion> = garments.collect::<Option<_>>().ok_or(misfit)?;
        let mut manifest = Manifest { number: self.number, previous: self.previous, garments };
        manifest.garments.iter_mut().for_each(|garment| garment.upsampler = None);
        if !self.upsamplers.is_empty() {
            let misfit = |_| ApplyError::DoesNotFit(self.number);
            manifest.set_upsamplers(&self.upsamplers).map_err(misfit)?;
        }
        manifest.check().map_err(ManifestError::from)?;
        let signed = SignedManifest { manifest, signature: self.signature };
        signed.verify(publisher)?;
        Ok(signed)
    }

    /// Bytes to send.
    pub fn encode(&self) -> Vec<u8> {
        if self.upsamplers.is_empty() {
            return DIFFERENCE.encode(self);
        }
        WITH_UPSAMPLERS.encode(&(self, &self.upsamplers))
    }

    /// Reads; what it means is checked by [`ManifestDifference::apply`].
    ///
    /// # Errors
    /// Damaged bytes.
    pub fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
        let difference = if Format::is_after(bytes, DIFFERENCE.version) {
            let (plain, upsamplers): (Self, Upsamplers) = WITH_UPSAMPLERS.decode(bytes)?;
            let small =
                |(_, chunk): &(_, ChunkRef)| chunk.bytes as usize <= limits::CHUNK_BYTES_MAX;
            let fits = (1..=limits::GARMENTS_MAX).contains(&upsamplers.len());
            if !fits || !upsamplers.iter().all(small) {
                let why = format!("{} upsamplers, or one too large", upsamplers.len());
                return Err(DIFFERENCE.invalid(why));
            }
            Self { upsamplers, ..plain }
        } else {
            DIFFERENCE.decode(bytes)?
        };
        if difference.garments.len() > limits::GARMENTS_MAX {
            let why = format!("{} garments are too many", difference.garments.len());
            return Err(DIFFERENCE.invalid(why));
        }
        Ok(difference)
    }
}

impl Changed {
    fn compute(base: Option<&GarmentVersion>, to: &GarmentVersion) -> Self {
        Self {
            id: to.id,
            name: to.name.clone(),
            codec: to.codec.clone(),
            scene: to.scene,
            mesh: to.mesh,
            generations: pieces(base.map_or(&[], |b| &b.generations), &to.generations),
            regions: pieces(base.map_or(&[], |b| &b.regions), &to.regions),
            links: pieces(base.map_or(&[], |b| &b.links), &to.links),
            stats: to.stats,
        }
    }

    fn apply(&self, base: Option<&GarmentVersion>, room: &mut usize) -> Option<GarmentVersion> {
        let mut generations_room = limits::GENERATIONS_MAX;
        let generations = base.map_or(&[][..], |b| &b.generations);
        Some(GarmentVersion {
            id: self.id,
            name: self.name.clone(),
            codec: self.codec.clone(),
            scene: self.scene,
            mesh: self.mesh,
            generations: join(generations, &self.generations, &mut generations_room)?,
            regions: join(base.map_or(&[], |b| &b.regions), &self.regions, room)?,
            links: join(base.map_or(&[], |b| &b.links), &self.links, room)?,
            stats: self.stats,
            upsampler: None,
        })
    }
}

/// `to` as stretches of `base` and new entries.
fn pieces<T: Copy + Eq + Hash>(base: &[T], to: &[T]) -> Vec<Piece<T>> {
    // Looked up only, never iterated: the result does not depend on the map's order.
    let mut place = HashMap::with_capacity(base.len());
    for (index, entry) in base.iter().enumerate() {
        place.entry(*entry).or_insert(index as u32);
    }
    let mut pieces = Vec::new();
    for entry in to {
        let next_kept = match pieces.last() {
            Some(Piece::Kept { first, count }) => Some(first + count),
            _ => None,
        };
        let runs_on = next_kept.is_some_and(|next| base.get(next as usize) == Some(entry));
        match (pieces.last_mut(), place.get(entry)) {
            (Some(Piece::Kept { count, .. }), _) if runs_on => *count += 1,
            (_, Some(&first)) => pieces.push(Piece::Kept { first, count: 1 }),
            (Some(Piece::New(new)), None) => new.push(*entry),
            (_, None) => pieces.push(Piece::New(vec![*entry])),
        }
    }
    pieces
}

/// The list again; `None` where a piece does not fit, or there is no `room` for its entries.
fn join<T: Copy>(base: &[T], pieces: &[Piece<T>], room: &mut usize) -> Option<Vec<T>> {
    let mut list = Vec::new();
    for piece in pieces {
        let entries = match piece {
            Piece::New(entries) => &entries[..],
            Piece::Kept { first, count } => {
                let end = first.checked_add(*count)?;
                base.get(*first as usize..end as usize)?
            }
        };
        *room = room.checked_sub(entries.len())?;
        list.extend_from_slice(entries);
    }
    Some(list)
}

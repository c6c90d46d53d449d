//! The upsampler of a version: fetched once the version can be shown, for a version is played
//! without it as well.

use std::sync::Arc;

use protocol::ChunkHash;
use protocol::manifest::ChunkRef;

use super::GarmentLoader;
use crate::free::Upsampled;
use crate::free::probe::Probes;
use crate::version::Version;

/// What was read, and what was made of it.
#[derive(Debug, Default)]
pub(super) struct Upsamplers {
    /// Bytes that were not put on a character yet.
    bytes: Option<(ChunkHash, Vec<u8>)>,
    upsampled: Option<(Key, Arc<Upsampled>)>,
    /// On which basis: its oldest generation, and how many there are.
    probes: Option<(Key, (ChunkHash, usize), Arc<Probes>)>,
}

/// Chunks of the upsampler, the mesh and the scene.
type Key = [ChunkHash; 3];

impl GarmentLoader {
    /// The current version's upsampler, where it is still to be fetched.
    pub(super) fn lacking_upsampler(&self) -> Option<ChunkRef> {
        let version = self.current.as_ref()?;
        let chunk = version.listing().upsampler?;
        let key = key(version)?;
        let made = self.upsamplers.upsampled.as_ref().is_some_and(|(of, _)| *of == key);
        let here = self.upsamplers.bytes.as_ref().is_some_and(|(of, _)| *of == chunk.hash);
        (!made && !here).then_some(chunk)
    }

    /// Keeps the bytes of the current version's upsampler, or of the next one's.
    pub(super) fn read_upsampler(&mut self, chunk: ChunkHash, bytes: &[u8]) {
        let current = self.current.as_ref().and_then(|version| version.listing().upsampler);
        let next = self.next.as_ref().and_then(|(_, next)| next.upsampler);
        if [current, next].into_iter().flatten().any(|listed| listed.hash == chunk) {
            self.upsamplers.bytes = Some((chunk, bytes.to_vec()));
            self.changed = true;
        }
    }

    /// The current version's upsampler on its character, and its probes on the basis; none where it has
    /// none, or it is not here yet, or does not fit (then it is not asked for again).
    pub(super) fn upsampled(&mut self) -> Option<(Arc<Upsampled>, Arc<Probes>)> {
        let version = Arc::clone(self.current.as_ref()?);
        let key = key(&version)?;
        let held = &mut self.upsamplers;
        if held.upsampled.as_ref().is_none_or(|(of, _)| *of != key) {
            let (_, bytes) = held.bytes.take_if(|(of, _)| *of == key[0])?;
            match Upsampled::new(&bytes, version.mesh(), version.scene()) {
                Ok(made) => held.upsampled = Some((key, Arc::new(made))),
                Err(error) => {
                    tracing::warn!(%error, chunk = %key[0], "played without an upsampler");
                    self.refused.insert(key[0]);
                    return None;
                }
            }
        }
        let (_, upsampled) = held.upsampled.as_ref()?;
        let basis = (version.lineage()?, version.listing().generations.len());
        if held.probes.as_ref().is_none_or(|(of, on, _)| *of != key || *on != basis) {
            let probes = Probes::new(upsampled, version.basis());
            held.probes = Some((key, basis, Arc::new(probes)));
        }
        let (_, _, probes) = held.probes.as_ref()?;
        Some((Arc::clone(upsampled), Arc::clone(probes)))
    }

    /// Memory of what is held (bytes).
    pub(super) fn upsampler_bytes(&self) -> usize {
        let made = self.upsamplers.upsampled.as_ref().map_or(0, |(_, u)| u.resident_bytes());
        made + self.upsamplers.bytes.as_ref().map_or(0, |(_, bytes)| bytes.len())
    }
}

fn key(version: &Version) -> Option<Key> {
    let listing = version.listing();
    Some([listing.upsampler?.hash, listing.mesh.hash, listing.scene.hash])
}

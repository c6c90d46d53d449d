//! Versions as they go over the line, each made once for all players who need it.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use crate::difference::ManifestDifference;
use crate::frame::frame;
use crate::ids::ChunkHash;
use crate::limits;
use crate::manifest::SignedManifest;
use crate::message::ServerMessage;
use crate::sign::Signature;

/// Messages that are held: players who come back after a restart start from a few versions.
const MESSAGES_MAX: usize = 16;
/// Bytes of all of them; one that is longer is held alone.
const BYTES_MAX: usize = 2 * limits::MANIFEST_BYTES_MAX;
/// Hashes that are held.
const HASHES_MAX: usize = 16;

/// Manifests and differences in frames, shared by the sessions of a server: whoever asks first makes
/// one, the others get the same bytes.
#[derive(Debug, Default)]
pub struct Deliveries(Mutex<Held>);

#[derive(Debug, Default)]
struct Held {
    messages: VecDeque<(Way, Arc<[u8]>)>,
    hashes: VecDeque<(Signature, ChunkHash)>,
}

/// From a version, or from nothing, to a version. A signature names what was signed.
type Way = (Option<Signature>, Signature);

impl Deliveries {
    /// A whole manifest.
    pub(super) fn full(&self, head: &SignedManifest) -> Arc<[u8]> {
        self.message((None, head.signature), || ServerMessage::ManifestFull(head.encode()))
    }

    /// What leads from `base` to `head`.
    pub(super) fn difference(&self, base: &SignedManifest, head: &SignedManifest) -> Arc<[u8]> {
        self.message((Some(base.signature), head.signature), || {
            let difference = ManifestDifference::compute(&base.manifest, head);
            ServerMessage::ManifestDifference(difference.encode())
        })
    }

    /// [`Manifest::hash`](crate::Manifest::hash).
    pub(super) fn hash(&self, signed: &SignedManifest) -> ChunkHash {
        let mut held = self.lock();
        if let Some((_, hash)) = held.hashes.iter().find(|(of, _)| *of == signed.signature) {
            return *hash;
        }
        let hash = signed.manifest.hash();
        held.hashes.push_back((signed.signature, hash));
        if held.hashes.len() > HASHES_MAX {
            held.hashes.pop_front();
        }
        hash
    }

    fn message(&self, way: Way, make: impl FnOnce() -> ServerMessage) -> Arc<[u8]> {
        // Held while the message is made: all players want it at once, and one is enough.
        let mut held = self.lock();
        if let Some((_, bytes)) = held.messages.iter().find(|(of, _)| *of == way) {
            return Arc::clone(bytes);
        }
        let bytes: Arc<[u8]> = frame(&make().encode()).into();
        held.messages.push_back((way, Arc::clone(&bytes)));
        let total = |messages: &VecDeque<(Way, Arc<[u8]>)>| -> usize {
            messages.iter().map(|(_, bytes)| bytes.len()).sum()
        };
        while held.messages.len() > 1
            && (held.messages.len() > MESSAGES_MAX || total(&held.messages) > BYTES_MAX)
        {
            held.messages.pop_front();
        }
        bytes
    }

    /// A panic elsewhere leaves whole entries behind.
    fn lock(&self) -> std::sync::MutexGuard<'_, Held> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

//! Reading and writing versions and chunks in an object store.

use std::collections::BTreeMap;
use std::path::Path as FilePath;
use std::sync::Arc;

use bytes::Bytes;
use futures::TryStreamExt;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt, PutMode, PutOptions};
use protocol::manifest::{ChunkRef, ManifestError};
use protocol::{
    ChunkHash, DecodeError, PublisherKey, SignedManifest, VersionNumber, limits, store,
};

/// Why something could not be read from or written to a store.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StoreError {
    /// The store itself failed: no such folder, no permission, disk full, network.
    #[error("store: {what}: {source}")]
    Io {
        /// What was tried.
        what: String,
        /// Why it failed.
        source: object_store::Error,
    },
    /// A chunk that a version lists is not there.
    #[error("chunk {0} is missing from the store")]
    MissingChunk(ChunkHash),
    /// A chunk's bytes are not those that its name promises.
    #[error("chunk {hash} is corrupted: {bytes} bytes, hash {found}; {expected} bytes expected")]
    CorruptChunk {
        /// Its name.
        hash: ChunkHash,
        /// Its true hash.
        found: ChunkHash,
        /// Its size.
        bytes: u64,
        /// The size that the version states.
        expected: u32,
    },
    /// No such version.
    #[error("the store has no version {0}")]
    NoVersion(VersionNumber),
    /// No version at all.
    #[error("the store has no version yet; `toile explore` or `toile up` publishes one")]
    Empty,
    /// A manifest that cannot be read or is not the publisher's.
    #[error("version {number}: {source}{}", remedy(*.number, .source))]
    Manifest {
        /// Its number.
        number: VersionNumber,
        /// Why.
        source: ManifestError,
    },
    /// A manifest under another number than its own.
    #[error("version {number} holds the manifest of version {found}")]
    Misplaced {
        /// Where it was found.
        number: VersionNumber,
        /// What it says.
        found: VersionNumber,
    },
    /// More bytes than anything stored may have.
    #[error("{path} has {bytes} bytes; at most {max} are allowed")]
    TooLong {
        /// The object.
        path: String,
        /// Its size.
        bytes: u64,
        /// The limit.
        max: usize,
    },
    /// The publisher's key in the store is not one.
    #[error("{} in the store is not 64 hexadecimal digits", store::PUBLISHER)]
    BadPublisher,
}

/// What to do about a damaged manifest. One of another format is not damaged.
fn remedy(number: VersionNumber, source: &ManifestError) -> String {
    if matches!(source, ManifestError::Decode(DecodeError::UnknownVersion { .. })) {
        return String::new();
    }
    let path = store::version_path(number);
    format!("; restore {path} from a copy, or remove it: exploring publishes it again")
}

/// A folder as a store, made if it does not exist; whatever is put there is on disk when the put
/// returns.
///
/// # Errors
/// The folder cannot be made or entered.
pub fn local_store(folder: &FilePath) -> Result<Arc<dyn ObjectStore>, StoreError> {
    let what = || format!("folder {}", folder.display());
    std::fs::create_dir_all(folder).map_err(|source| StoreError::Io {
        what: what(),
        source: object_store::Error::Generic { store: "folder", source: source.into() },
    })?;
    let local = LocalFileSystem::new_with_prefix(folder)
        .map_err(|source| StoreError::Io { what: what(), source })?;
    Ok(Arc::new(local.with_fsync(true)))
}

/// Removes what a killed writer left in a local store: half-written files (`NAME#1`), which readers
/// never see. Only for the one process that publishes there, before it does. Returns how many.
///
/// # Errors
/// A folder that cannot be read, or a file that cannot be removed.
pub fn collect_leftovers(folder: &FilePath) -> std::io::Result<usize> {
    let mut removed = 0;
    let mut folders = vec![(folder.to_path_buf(), 0)];
    while let Some((folder, depth)) = folders.pop() {
        for entry in std::fs::read_dir(&folder)? {
            let entry = entry?;
            if entry.file_type()?.is_dir() {
                // A store is two levels deep: chunks, and a folder per first byte.
                if depth < 2 {
                    folders.push((entry.path(), depth + 1));
                }
            } else if is_leftover(&entry.file_name().to_string_lossy()) {
                std::fs::remove_file(entry.path())?;
                removed += 1;
            }
        }
    }
    Ok(removed)
}

fn is_leftover(name: &str) -> bool {
    let digits = name.rsplit_once('#').map_or("", |(_, digits)| digits);
    !digits.is_empty() && digits.bytes().all(|b| b.is_ascii_digit())
}

/// Number of the newest version, if any.
///
/// # Errors
/// The store cannot be listed.
pub async fn head_number(from: &dyn ObjectStore) -> Result<Option<VersionNumber>, StoreError> {
    let folder = Path::from(store::VERSIONS);
    let mut listed = from.list(Some(&folder));
    let mut newest = None;
    let failed = |source| StoreError::Io { what: "listing versions".into(), source };
    while let Some(meta) = listed.try_next().await.map_err(failed)? {
        newest = newest.max(store::version_of_path(meta.location.as_ref()));
    }
    Ok(newest)
}

/// A version's manifest, verified.
///
/// # Errors
/// It is missing, damaged, or not signed by `publisher`.
pub async fn version(
    from: &dyn ObjectStore,
    number: VersionNumber,
    publisher: &PublisherKey,
) -> Result<SignedManifest, StoreError> {
    let path = store::version_path(number);
    let bytes = read(from, &path).await?.ok_or(StoreError::NoVersion(number))?;
    let signed = SignedManifest::open(&bytes, publisher)
        .map_err(|source| StoreError::Manifest { number, source })?;
    let found = signed.manifest.number;
    if found == number { Ok(signed) } else { Err(StoreError::Misplaced { number, found }) }
}

/// The publisher's key as the store states it, if it does.
///
/// # Errors
/// The store fails, or holds something that is no key.
pub async fn publisher(from: &dyn ObjectStore) -> Result<Option<PublisherKey>, StoreError> {
    let Some(bytes) = read(from, store::PUBLISHER).await? else { return Ok(None) };
    let text = std::str::from_utf8(&bytes).map_err(|_| StoreError::BadPublisher)?;
    PublisherKey::from_hex(text).map(Some).ok_or(StoreError::BadPublisher)
}

/// A chunk, checked against its name and size.
///
/// # Errors
/// It is missing or corrupted.
pub async fn chunk(from: &dyn ObjectStore, chunk: &ChunkRef) -> Result<Bytes, StoreError> {
    let path = store::chunk_path(&chunk.hash);
    let bytes = read(from, &path).await?.ok_or(StoreError::MissingChunk(chunk.hash))?;
    let found = ChunkHash::of(&bytes);
    if found == chunk.hash && bytes.len() == chunk.bytes as usize {
        return Ok(bytes);
    }
    let (hash, size, expected) = (chunk.hash, bytes.len() as u64, chunk.bytes);
    Err(StoreError::CorruptChunk { hash, found, bytes: size, expected })
}

/// Creates an object, whole or not at all; `false` if it exists already.
///
/// # Errors
/// The store refuses: the message names the object and the reason (a full disk, say).
pub async fn create(
    at: &dyn ObjectStore,
    path: &str,
    bytes: impl Into<Bytes>,
) -> Result<bool, StoreError> {
    let options = PutOptions::from(PutMode::Create);
    match at.put_opts(&Path::from(path), bytes.into().into(), options).await {
        Ok(_) => Ok(true),
        Err(object_store::Error::AlreadyExists { .. }) => Ok(false),
        Err(source) => Err(StoreError::Io { what: format!("writing {path}"), source }),
    }
}

/// New chunks by name, each once.
#[derive(Debug, Default)]
pub(super) struct NewChunks {
    pub(super) chunks: BTreeMap<ChunkHash, Bytes>,
}

impl NewChunks {
    pub(super) fn add(&mut self, bytes: Vec<u8>) -> ChunkRef {
        let chunk = ChunkRef { hash: ChunkHash::of(&bytes), bytes: bytes.len() as u32 };
        self.chunks.insert(chunk.hash, bytes.into());
        chunk
    }

    pub(super) fn bytes(&self) -> u64 {
        self.chunks.values().map(|bytes| bytes.len() as u64).sum()
    }
}

async fn read(from: &dyn ObjectStore, path: &str) -> Result<Option<Bytes>, StoreError> {
    let failed = |source| StoreError::Io { what: format!("reading {path}"), source };
    match from.get(&Path::from(path)).await {
        Ok(found) if found.meta.size > limits::CHUNK_BYTES_MAX as u64 => {
            let (path, max) = (path.into(), limits::CHUNK_BYTES_MAX);
            Err(StoreError::TooLong { path, bytes: found.meta.size, max })
        }
        Ok(found) => found.bytes().await.map(Some).map_err(failed),
        Err(object_store::Error::NotFound { .. }) => Ok(None),
        Err(source) => Err(failed(source)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_damaged_manifest_may_be_removed_and_one_of_another_format_may_not() {
        let said = |source: DecodeError| {
            let source = ManifestError::Decode(source);
            StoreError::Manifest { number: VersionNumber(7), source }.to_string()
        };
        let damaged = said(DecodeError::Malformed { what: "manifest", bytes: 3 });
        assert!(damaged.contains("remove it") && damaged.contains("00007"), "{damaged}");
        let of = |found| said(DecodeError::UnknownVersion { what: "manifest", found, known: 2 });
        assert!(of(3).ends_with("only 2 is known; update this program"), "{}", of(3));
        assert!(of(1).contains("version 1") && of(1).contains("older program"), "{}", of(1));
        assert!(!of(3).contains("remove") && !of(1).contains("remove"));
    }
}

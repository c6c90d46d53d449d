//! Reading the store: head, manifests, chunks. Nothing is served that is not what its name says.

use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use bytes::Bytes;
use futures::TryStreamExt;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt, PutMode, PutOptions};
use protocol::manifest::ManifestError;
use tokio::sync::OnceCell;

use protocol::{ChunkHash, PublisherKey, SignedManifest, VersionNumber, limits, store};

use crate::shared::listed;

/// Why something was not read from the store.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReadError {
    /// It is not there.
    #[error("{0} is not in the store")]
    Missing(String),
    /// A chunk's bytes are not those that its name promises. It is not served; publish it again.
    #[error("{path} is corrupted: its bytes have the hash {found}; restore it from a copy")]
    Corrupted {
        /// The object.
        path: String,
        /// Hash of its bytes.
        found: ChunkHash,
    },
    /// A manifest that is damaged, misplaced or not the publisher's.
    #[error("version {number} is not served: {why}")]
    BadManifest {
        /// Its number.
        number: VersionNumber,
        /// What is wrong with it.
        why: String,
    },
    /// The publisher's key in the store is not one.
    #[error("{} is not 64 hexadecimal digits", store::PUBLISHER)]
    BadPublisher,
    /// More bytes than anything stored may have.
    #[error("{path} has {bytes} bytes; at most {} are allowed", limits::CHUNK_BYTES_MAX)]
    TooLong {
        /// The object.
        path: String,
        /// Its size.
        bytes: u64,
    },
    /// The store itself failed.
    #[error("the store failed at {path}: {source}")]
    Store {
        /// The object.
        path: String,
        /// Why.
        source: object_store::Error,
    },
}

/// A store with a bounded cache of chunks.
#[derive(Debug)]
pub(crate) struct Source {
    store: Arc<dyn ObjectStore>,
    cache: Mutex<Cache>,
    reads: Reads,
    /// Versions read lately: many players come back with the same one.
    versions: Mutex<VecDeque<Known>>,
    telemetry: Numbers,
    tags: Numbers,
}

/// Versions that are kept after they were read.
const VERSIONS_KEPT: usize = 4;
/// How often a number that another server took first is tried again.
const TRIES: u32 = 16;

/// A version and what it lists.
#[derive(Debug)]
struct Known {
    signed: Arc<SignedManifest>,
    listed: HashSet<ChunkHash>,
}

/// A folder of numbered objects that are only ever added.
#[derive(Debug)]
struct Numbers {
    folder: &'static str,
    path: fn(u64) -> String,
    number: fn(&str) -> Option<u64>,
    /// The newest one known; `None` before the folder was listed.
    newest: tokio::sync::Mutex<Option<u64>>,
}

impl Numbers {
    fn new(folder: &'static str, path: fn(u64) -> String, number: fn(&str) -> Option<u64>) -> Self {
        Self { folder, path, number, newest: tokio::sync::Mutex::default() }
    }
}

impl Source {
    pub fn new(store: Arc<dyn ObjectStore>, cache_bytes_max: usize) -> Self {
        Self {
            store,
            cache: Mutex::new(Cache::new(cache_bytes_max)),
            reads: Reads::default(),
            versions: Mutex::default(),
            telemetry: Numbers::new(
                store::TELEMETRY,
                store::telemetry_path,
                store::telemetry_of_path,
            ),
            tags: Numbers::new(store::TAGS, store::tag_path, store::tag_of_path),
        }
    }

    /// All versions above `after`, newest first, by listing.
    pub async fn versions(
        &self,
        after: Option<VersionNumber>,
    ) -> Result<Vec<VersionNumber>, ReadError> {
        let paths = self.paths(store::VERSIONS, after.map(store::version_path)).await?;
        let numbers = paths.iter().filter_map(|path| store::version_of_path(path));
        let mut numbers: Vec<_> = numbers.filter(|number| Some(*number) > after).collect();
        numbers.sort_unstable();
        numbers.reverse();
        Ok(numbers)
    }

    /// Creates a tag under the next free number and says which; `None` where others took all that
    /// were tried.
    pub async fn add_tag(&self, bytes: &[u8]) -> Result<Option<u64>, ReadError> {
        self.add(&self.tags, bytes, &AtomicU64::new(0)).await
    }

    /// Creates a batch of telemetry, as [`Source::add_tag`]. Where this fails or is dropped, `tried` is
    /// the number under which the store may have it all the same, or 0.
    pub async fn add_telemetry(
        &self,
        bytes: &[u8],
        tried: &AtomicU64,
    ) -> Result<Option<u64>, ReadError> {
        self.add(&self.telemetry, bytes, tried).await
    }

    /// Puts a batch under the number where the store may have it already; says whether it is there.
    pub async fn settle_telemetry(&self, number: u64, bytes: &[u8]) -> Result<bool, ReadError> {
        let path = store::telemetry_path(number);
        if self.create(path.clone(), bytes.to_vec()).await? {
            return Ok(true);
        }
        Ok(self.read(&path).await?.is_some_and(|found| found[..] == *bytes))
    }

    /// Lists the folder once, then only what was added by others since: a world runs for years.
    async fn add(
        &self,
        numbers: &Numbers,
        bytes: &[u8],
        tried: &AtomicU64,
    ) -> Result<Option<u64>, ReadError> {
        let mut newest = numbers.newest.lock().await;
        for _ in 0..TRIES {
            let after = match *newest {
                None => self.newest_after(numbers, 0).await?,
                Some(known) => known,
            };
            let next = after + 1;
            // Not known unless all goes well: a number must neither be left out nor taken twice.
            *newest = None;
            tried.store(next, Ordering::Relaxed);
            if self.create((numbers.path)(next), bytes.to_vec()).await? {
                *newest = Some(next);
                return Ok(Some(next));
            }
            // Another server of this store was faster.
            tried.store(0, Ordering::Relaxed);
            *newest = Some(self.newest_after(numbers, next).await?);
        }
        Ok(None)
    }

    /// The newest number in a folder, at least `known`; what lies before that is not listed.
    async fn newest_after(&self, numbers: &Numbers, known: u64) -> Result<u64, ReadError> {
        let after = (known > 0).then(|| (numbers.path)(known));
        let paths = self.paths(numbers.folder, after).await?;
        let newest = paths.iter().filter_map(|path| (numbers.number)(path)).max();
        Ok(newest.unwrap_or(0).max(known))
    }

    async fn create(&self, path: String, bytes: Vec<u8>) -> Result<bool, ReadError> {
        let options = PutOptions::from(PutMode::Create);
        match self.store.put_opts(&Path::from(&*path), bytes.into(), options).await {
            Ok(_) => Ok(true),
            Err(object_store::Error::AlreadyExists { .. }) => Ok(false),
            Err(source) => Err(ReadError::Store { path, source }),
        }
    }

    /// The publisher's key, once there is one.
    pub async fn publisher(&self) -> Result<Option<PublisherKey>, ReadError> {
        let Some(bytes) = self.read(store::PUBLISHER).await? else { return Ok(None) };
        let text = std::str::from_utf8(&bytes).map_err(|_| ReadError::BadPublisher)?;
        PublisherKey::from_hex(text).map(Some).ok_or(ReadError::BadPublisher)
    }

    /// A version, verified; `None` where there is none.
    pub async fn version(
        &self,
        number: VersionNumber,
        publisher: &PublisherKey,
    ) -> Result<Option<Arc<SignedManifest>>, ReadError> {
        if let Some(known) = self.known(number) {
            return Ok(Some(known));
        }
        let Some(bytes) = self.read(&store::version_path(number)).await? else { return Ok(None) };
        let bad = |error: ManifestError| ReadError::BadManifest { number, why: error.to_string() };
        let signed = SignedManifest::open(&bytes, publisher).map_err(bad)?;
        let found = signed.manifest.number;
        if found != number {
            let why = format!("it holds the manifest of version {found}");
            return Err(ReadError::BadManifest { number, why });
        }
        let signed = Arc::new(signed);
        let known = Known { signed: signed.clone(), listed: listed(&signed) };
        let mut versions = self.lock_versions();
        versions.retain(|known| known.signed.manifest.number != number);
        versions.push_back(known);
        if versions.len() > VERSIONS_KEPT {
            versions.pop_front();
        }
        Ok(Some(signed))
    }

    fn known(&self, number: VersionNumber) -> Option<Arc<SignedManifest>> {
        let mut versions = self.lock_versions();
        let at = versions.iter().position(|known| known.signed.manifest.number == number)?;
        let known = versions.remove(at)?;
        let signed = known.signed.clone();
        versions.push_back(known);
        Some(signed)
    }

    /// Whether a version that was read lately lists a chunk.
    pub fn lists(&self, hash: &ChunkHash) -> bool {
        self.lock_versions().iter().any(|known| known.listed.contains(hash))
    }

    /// A chunk, where it is in memory.
    pub fn cached(&self, hash: &ChunkHash) -> Option<Bytes> {
        self.lock().get(hash)
    }

    /// A chunk, verified against its name. Whoever asks while it is being read waits for that
    /// read: a new version is wanted by every player at once.
    pub async fn chunk(&self, hash: &ChunkHash) -> Result<Bytes, ReadError> {
        self.reads.share(*hash, || self.read_chunk(hash)).await
    }

    async fn read_chunk(&self, hash: &ChunkHash) -> Result<Bytes, ReadError> {
        if let Some(bytes) = self.lock().get(hash) {
            return Ok(bytes);
        }
        let path = store::chunk_path(hash);
        let bytes = self.read(&path).await?.ok_or_else(|| ReadError::Missing(path.clone()))?;
        let found = ChunkHash::of(&bytes);
        if found != *hash {
            return Err(ReadError::Corrupted { path, found });
        }
        self.lock().put(*hash, bytes.clone());
        Ok(bytes)
    }

    /// Paths in a folder after `after`; the store may ignore `after`.
    async fn paths(&self, folder: &str, after: Option<String>) -> Result<Vec<String>, ReadError> {
        let prefix = Path::from(folder);
        let listed = match after {
            Some(after) => self.store.list_with_offset(Some(&prefix), &Path::from(after)),
            None => self.store.list(Some(&prefix)),
        };
        let paths = listed.map_ok(|meta| meta.location.to_string()).try_collect();
        paths.await.map_err(|source| ReadError::Store { path: folder.into(), source })
    }

    async fn read(&self, path: &str) -> Result<Option<Bytes>, ReadError> {
        let failed = |source| ReadError::Store { path: path.into(), source };
        match self.store.get(&Path::from(path)).await {
            Ok(found) if found.meta.size > limits::CHUNK_BYTES_MAX as u64 => {
                Err(ReadError::TooLong { path: path.into(), bytes: found.meta.size })
            }
            Ok(found) => found.bytes().await.map(Some).map_err(failed),
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(source) => Err(failed(source)),
        }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Cache> {
        self.cache.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn lock_versions(&self) -> std::sync::MutexGuard<'_, VecDeque<Known>> {
        self.versions.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

type Cell = Arc<OnceCell<Bytes>>;

/// Chunks that are being read, each once for all who wait for it.
#[derive(Debug, Default)]
struct Reads(Mutex<HashMap<ChunkHash, Cell>>);

impl Reads {
    /// Reads, or waits for the read under way. Where that one fails or is dropped, the next of
    /// those who wait reads.
    async fn share<F>(&self, hash: ChunkHash, read: impl FnOnce() -> F) -> Result<Bytes, ReadError>
    where
        F: Future<Output = Result<Bytes, ReadError>>,
    {
        let cell = self.lock().entry(hash).or_default().clone();
        let waiting = Waiting { reads: self, hash, cell };
        waiting.cell.get_or_try_init(read).await.cloned()
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, HashMap<ChunkHash, Cell>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Somebody who waits for a chunk; the last one forgets it.
struct Waiting<'a> {
    reads: &'a Reads,
    hash: ChunkHash,
    cell: Cell,
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        let mut reads = self.reads.lock();
        // Cells are cloned under the lock alone: two owners are the map and this one.
        if Arc::strong_count(&self.cell) == 2 {
            reads.remove(&self.hash);
        }
    }
}

/// The chunks used last, up to a number of bytes.
#[derive(Debug)]
struct Cache {
    chunks: HashMap<ChunkHash, (Bytes, u64)>,
    /// By time of last use.
    used: BTreeMap<u64, ChunkHash>,
    uses: u64,
    bytes: usize,
    bytes_max: usize,
}

impl Cache {
    fn new(bytes_max: usize) -> Self {
        Self { chunks: HashMap::new(), used: BTreeMap::new(), uses: 0, bytes: 0, bytes_max }
    }

    fn get(&mut self, hash: &ChunkHash) -> Option<Bytes> {
        let (bytes, used) = self.chunks.get_mut(hash)?;
        self.used.remove(used);
        self.uses += 1;
        *used = self.uses;
        self.used.insert(self.uses, *hash);
        Some(bytes.clone())
    }

    fn put(&mut self, hash: ChunkHash, bytes: Bytes) {
        if bytes.len() > self.bytes_max || self.chunks.contains_key(&hash) {
            return;
        }
        self.bytes += bytes.len();
        self.uses += 1;
        self.used.insert(self.uses, hash);
        self.chunks.insert(hash, (bytes, self.uses));
        while self.bytes > self.bytes_max {
            let (_, oldest) = self.used.pop_first().expect("what has bytes was used");
            let (bytes, _) = self.chunks.remove(&oldest).expect("what was used is here");
            self.bytes -= bytes.len();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU32, Ordering};

    use futures::FutureExt;

    use super::*;

    #[tokio::test]
    async fn a_chunk_wanted_by_many_is_read_once_and_again_after_a_failure() {
        let (reads, count) = (Reads::default(), AtomicU32::new(0));
        let hash = ChunkHash::of(b"chunk");
        let read = || async {
            let before = count.fetch_add(1, Ordering::Relaxed);
            tokio::task::yield_now().await;
            match before {
                0 => Err(ReadError::Missing("at first".into())),
                _ => Ok(Bytes::from_static(b"chunk")),
            }
        };
        let all = (0..100).map(|_| reads.share(hash, read));
        let found = futures::future::join_all(all).await;
        assert_eq!(found.iter().filter(|found| found.is_err()).count(), 1);
        assert_eq!(count.load(Ordering::Relaxed), 2);
        let dropped = reads.share(hash, std::future::pending).now_or_never();
        assert!(dropped.is_none());
        assert!(reads.lock().is_empty());
    }

    #[test]
    fn the_cache_keeps_what_was_used_last() {
        let chunk = |byte: u8| (ChunkHash::of(&[byte]), Bytes::from(vec![byte; 10]));
        let mut cache = Cache::new(30);
        for byte in 0..3 {
            let (hash, bytes) = chunk(byte);
            cache.put(hash, bytes);
        }
        assert!(cache.get(&chunk(0).0).is_some());
        let (hash, bytes) = chunk(3);
        cache.put(hash, bytes);
        let kept: Vec<_> = (0..4).map(|byte| cache.get(&chunk(byte).0).is_some()).collect();
        assert_eq!(kept, [true, false, true, true]);
        assert_eq!(cache.bytes, 30);
        cache.put(ChunkHash::of(b"large"), Bytes::from(vec![0; 31]));
        assert_eq!((cache.bytes, cache.chunks.len(), cache.used.len()), (30, 3, 3));
    }
}

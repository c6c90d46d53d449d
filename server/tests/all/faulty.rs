//! A store that can be made to fail, hang or take its time, before a good one.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicUsize, Ordering};
use std::time::Duration;

use futures::stream::BoxStream;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{
    CopyOptions, Error, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta,
    ObjectStore, PutMultipartOptions, PutOptions, PutPayload, PutResult, Result,
};

#[derive(Debug)]
pub struct Faulty {
    inner: LocalFileSystem,
    /// Reads of this path fail so many times more.
    failing: Mutex<(String, u32)>,
    /// Everything fails.
    pub is_down: AtomicBool,
    /// So many more writes never end.
    pub hanging_puts: AtomicU32,
    /// So many more writes are done, and the answer is lost.
    pub unanswered_puts: AtomicU32,
    /// Each read takes so long (ms).
    pub delay_ms: AtomicU32,
    gets: AtomicUsize,
    gets_max: AtomicUsize,
    /// Folders that were listed from their beginning.
    listed: Mutex<Vec<String>>,
}

impl Faulty {
    pub fn new(inner: LocalFileSystem) -> Self {
        Self {
            inner,
            failing: Mutex::default(),
            is_down: AtomicBool::new(false),
            hanging_puts: AtomicU32::new(0),
            unanswered_puts: AtomicU32::new(0),
            delay_ms: AtomicU32::new(0),
            gets: AtomicUsize::new(0),
            gets_max: AtomicUsize::new(0),
            listed: Mutex::default(),
        }
    }

    /// The next `times` reads of a path fail.
    pub fn fail(&self, path: &str, times: u32) {
        *self.failing.lock().unwrap() = (path.into(), times);
    }

    /// How many reads of [`Faulty::fail`] are left.
    pub fn failures_left(&self) -> u32 {
        self.failing.lock().unwrap().1
    }

    /// The largest number of reads at the same time.
    pub fn gets_max(&self) -> usize {
        self.gets_max.load(Ordering::Relaxed)
    }

    /// How often a folder was listed from its beginning.
    pub fn listings(&self, folder: &str) -> usize {
        self.listed.lock().unwrap().iter().filter(|listed| *listed == folder).count()
    }

    fn check(&self, path: &Path) -> Result<()> {
        let mut failing = self.failing.lock().unwrap();
        let is_named = failing.1 > 0 && failing.0 == path.as_ref();
        if is_named {
            failing.1 -= 1;
        }
        if is_named || self.is_down.load(Ordering::Relaxed) {
            return Err(Error::Generic { store: "faulty", source: "out of order".into() });
        }
        Ok(())
    }
}

impl std::fmt::Display for Faulty {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "a faulty store")
    }
}

#[async_trait::async_trait]
impl ObjectStore for Faulty {
    async fn put_opts(
        &self,
        location: &Path,
        payload: PutPayload,
        opts: PutOptions,
    ) -> Result<PutResult> {
        let taken = |left: u32| left.checked_sub(1);
        let order = Ordering::Relaxed;
        if self.hanging_puts.fetch_update(order, order, taken).is_ok() {
            return std::future::pending().await;
        }
        self.check(location)?;
        let done = self.inner.put_opts(location, payload, opts).await;
        if self.unanswered_puts.fetch_update(order, order, taken).is_ok() {
            return Err(Error::Generic { store: "faulty", source: "the line was cut".into() });
        }
        done
    }

    async fn put_multipart_opts(
        &self,
        location: &Path,
        opts: PutMultipartOptions,
    ) -> Result<Box<dyn MultipartUpload>> {
        self.inner.put_multipart_opts(location, opts).await
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
        let gets = self.gets.fetch_add(1, Ordering::Relaxed) + 1;
        if location.as_ref().starts_with("chunks/") {
            self.gets_max.fetch_max(gets, Ordering::Relaxed);
        }
        tokio::time::sleep(Duration::from_millis(self.delay_ms.load(Ordering::Relaxed).into()))
            .await;
        self.gets.fetch_sub(1, Ordering::Relaxed);
        self.check(location)?;
        self.inner.get_opts(location, options).await
    }

    fn delete_stream(
        &self,
        locations: BoxStream<'static, Result<Path>>,
    ) -> BoxStream<'static, Result<Path>> {
        self.inner.delete_stream(locations)
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        self.listed.lock().unwrap().push(prefix.map(Path::to_string).unwrap_or_default());
        self.inner.list(prefix)
    }

    fn list_with_offset(
        &self,
        prefix: Option<&Path>,
        offset: &Path,
    ) -> BoxStream<'static, Result<ObjectMeta>> {
        self.inner.list_with_offset(prefix, offset)
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.inner.list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.inner.copy_opts(from, to, options).await
    }
}

//! A full disk.

use futures::StreamExt;
use object_store::ObjectStore;
use object_store::memory::InMemory;
use object_store::path::Path;

/// A store that refuses writes after a number of them.
#[derive(Debug)]
pub struct Full {
    pub inner: InMemory,
    pub left: std::sync::atomic::AtomicU64,
}

impl std::fmt::Display for Full {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("a full disk")
    }
}

type Stored<'a, T> = futures::future::BoxFuture<'a, object_store::Result<T>>;
type Listed<'a, T> = futures::stream::BoxStream<'a, object_store::Result<T>>;

impl ObjectStore for Full {
    fn put_opts<'a, 'b, 'c>(
        &'a self,
        location: &'b Path,
        payload: object_store::PutPayload,
        options: object_store::PutOptions,
    ) -> Stored<'c, object_store::PutResult>
    where
        'a: 'c,
        'b: 'c,
    {
        use std::sync::atomic::Ordering::SeqCst;
        let spent = self.left.fetch_update(SeqCst, SeqCst, |left| left.checked_sub(1));
        if spent.is_err() {
            let source = std::io::Error::from(std::io::ErrorKind::StorageFull);
            let source = std::io::Error::other(format!("No space left on device ({source})"));
            let error = object_store::Error::Generic { store: "full", source: source.into() };
            return Box::pin(std::future::ready(Err(error)));
        }
        self.inner.put_opts(location, payload, options)
    }

    fn put_multipart_opts<'a, 'b, 'c>(
        &'a self,
        location: &'b Path,
        options: object_store::PutMultipartOptions,
    ) -> Stored<'c, Box<dyn object_store::MultipartUpload>>
    where
        'a: 'c,
        'b: 'c,
    {
        self.inner.put_multipart_opts(location, options)
    }

    fn get_opts<'a, 'b, 'c>(
        &'a self,
        location: &'b Path,
        options: object_store::GetOptions,
    ) -> Stored<'c, object_store::GetResult>
    where
        'a: 'c,
        'b: 'c,
    {
        self.inner.get_opts(location, options)
    }

    fn delete_stream(&self, locations: Listed<'static, Path>) -> Listed<'static, Path> {
        self.inner.delete_stream(locations)
    }

    fn list(&self, prefix: Option<&Path>) -> Listed<'static, object_store::ObjectMeta> {
        self.inner.list(prefix).boxed()
    }

    fn list_with_delimiter<'a, 'b, 'c>(
        &'a self,
        prefix: Option<&'b Path>,
    ) -> Stored<'c, object_store::ListResult>
    where
        'a: 'c,
        'b: 'c,
    {
        self.inner.list_with_delimiter(prefix)
    }

    fn copy_opts<'a, 'b, 'd, 'c>(
        &'a self,
        from: &'b Path,
        to: &'d Path,
        options: object_store::CopyOptions,
    ) -> Stored<'c, ()>
    where
        'a: 'c,
        'b: 'c,
        'd: 'c,
    {
        self.inner.copy_opts(from, to, options)
    }
}

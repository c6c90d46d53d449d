//! A store from what a user writes: a folder, `file://` or `s3://`.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail, ensure};
use object_store::ObjectStore;
use object_store::local::LocalFileSystem;
use url::Url;

const SUPPORTED: &str = "a store is a folder (./store), file:///folder, or \
    s3://bucket/prefix?endpoint=https://host:port&region=name";

/// A store that is ready to use.
#[derive(Clone, Debug)]
pub struct Opened {
    /// What is read and written.
    pub store: Arc<dyn ObjectStore>,
    /// The folder itself, absolute, when the store is one on this machine.
    pub folder: Option<PathBuf>,
}

/// Opens a store that is expected to be there.
///
/// `text` is a folder, a `file://` URL, or `s3://bucket/prefix` with `endpoint` (for servers other
/// than Amazon's) and `region` as parameters. S3 takes its credentials, and all else, from the
/// environment (`AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`, `AWS_REGION`, ...). No network is
/// touched yet: whether a bucket exists shows at its first use.
///
/// # Errors
/// The text is no store, or the folder does not exist.
pub fn open_store(text: &str) -> Result<Opened> {
    match place(text)? {
        Place::Folder(folder) => {
            ensure_no_file(&folder)?;
            ensure!(
                folder.is_dir(),
                "there is no store in {}: no such folder (`toile explore` makes one)",
                folder.display()
            );
            open_folder(&folder)
        }
        Place::Bucket(url) => open_bucket(&url),
    }
}

/// Opens a store as [`open_store`] does; a folder is made first where there is none.
///
/// # Errors
/// The text is no store, or the folder cannot be made.
pub fn create_store(text: &str) -> Result<Opened> {
    match place(text)? {
        Place::Folder(folder) => {
            ensure_no_file(&folder)?;
            std::fs::create_dir_all(&folder)
                .with_context(|| format!("the folder {} cannot be made", folder.display()))?;
            open_folder(&folder)
        }
        Place::Bucket(url) => open_bucket(&url),
    }
}

enum Place {
    Folder(PathBuf),
    Bucket(Url),
}

fn place(text: &str) -> Result<Place> {
    ensure!(!text.trim().is_empty(), "no store was named; {SUPPORTED}");
    // Anything without a scheme is a folder, so that `C:\store` is one, too.
    if !text.contains("://") {
        return Ok(Place::Folder(PathBuf::from(text)));
    }
    let url = Url::parse(text).with_context(|| format!("{text} is no URL; {SUPPORTED}"))?;
    match url.scheme() {
        "file" => match url.to_file_path() {
            Ok(folder) => Ok(Place::Folder(folder)),
            Err(()) => bail!("{text} names another machine; write file:///folder, three slashes"),
        },
        "s3" => Ok(Place::Bucket(url)),
        other => bail!("stores of kind {other}:// are not supported; {SUPPORTED}"),
    }
}

fn ensure_no_file(folder: &Path) -> Result<()> {
    ensure!(!folder.is_file(), "{} is a file; {SUPPORTED}", folder.display());
    Ok(())
}

fn open_folder(folder: &Path) -> Result<Opened> {
    let context = || format!("the folder {} cannot be opened", folder.display());
    let folder = std::fs::canonicalize(folder).with_context(context)?;
    // A put is on disk before it returns: a version must never name what a power cut may take.
    let local = LocalFileSystem::new_with_prefix(&folder).with_context(context)?;
    let local = local.with_fsync(true).with_automatic_cleanup(true);
    Ok(Opened { store: Arc::new(local), folder: Some(folder) })
}

#[cfg(not(feature = "s3"))]
fn open_bucket(url: &Url) -> Result<Opened> {
    bail!("{url}: this program was built without S3; build it with `--features s3`")
}

#[cfg(feature = "s3")]
fn open_bucket(url: &Url) -> Result<Opened> {
    use object_store::aws::AmazonS3Builder;
    use object_store::prefix::PrefixStore;

    ensure!(
        url.username().is_empty() && url.password().is_none(),
        "credentials do not belong in a URL, where logs and shells keep them; set \
         AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
    );
    let bucket = url.host_str().filter(|host| !host.is_empty());
    let bucket = bucket.with_context(|| format!("{url} names no bucket; {SUPPORTED}"))?;
    ensure!(url.port().is_none(), "{url}: a port belongs to ?endpoint=https://host:port");
    let mut builder = AmazonS3Builder::from_env().with_bucket_name(bucket);
    for (key, value) in url.query_pairs() {
        builder = match key.as_ref() {
            "endpoint" => {
                let endpoint = Url::parse(&value)
                    .ok()
                    .filter(|at| matches!(at.scheme(), "http" | "https") && at.has_host())
                    .with_context(|| format!("endpoint {value} must be http(s)://host:port"))?;
                // Who writes http:// means it; without an endpoint it is always TLS.
                let plain = endpoint.scheme() == "http";
                builder.with_endpoint(value.trim_end_matches('/')).with_allow_http(plain)
            }
            "region" => builder.with_region(value),
            other => bail!("{url}: unknown parameter {other}; {SUPPORTED}"),
        };
    }
    // The HTTP client asks for the process's provider when it is built. An error means that one is
    // installed already, and the only one linked is ring.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let store = builder.build().with_context(|| format!("{url} cannot be opened"))?;
    let prefix = object_store::path::Path::from_url_path(url.path())
        .with_context(|| format!("{url}: the prefix is no valid path"))?;
    let store: Arc<dyn ObjectStore> = match prefix.as_ref().is_empty() {
        true => Arc::new(store),
        false => Arc::new(PrefixStore::new(store, prefix)),
    };
    Ok(Opened { store, folder: None })
}

#[cfg(test)]
mod tests {
    use futures::TryStreamExt;
    use object_store::path::Path as Key;
    use object_store::{Error, ObjectStoreExt, PutMode, PutPayload};

    use super::*;

    /// What publishing needs of any store: creating only what is not there, reading, listing.
    async fn exercise(store: &dyn ObjectStore, name: &str) {
        let key = Key::from(format!("versions/{name}"));
        let _ = store.delete(&key).await;
        let put = |text: &'static str| {
            store.put_opts(&key, PutPayload::from_static(text.as_bytes()), PutMode::Create.into())
        };
        put("first").await.expect("nothing was there");
        let again = put("second").await.expect_err("it was there already");
        assert!(matches!(again, Error::AlreadyExists { .. }), "{again}");
        let bytes = store.get(&key).await.unwrap().bytes().await.unwrap();
        assert_eq!(&bytes[..], b"first");
        let listed: Vec<_> = store.list(Some(&Key::from("versions"))).try_collect().await.unwrap();
        assert!(listed.iter().any(|meta| meta.location == key && meta.size == 5), "{listed:?}");
        store.delete(&key).await.unwrap();
        let gone = store.get(&key).await.expect_err("it was deleted");
        assert!(matches!(gone, Error::NotFound { .. }), "{gone}");
    }

    fn refusal(text: &str) -> String {
        format!("{:#}", create_store(text).map(|_| ()).expect_err(text))
    }

    #[tokio::test]
    async fn a_folder_is_made_and_used() {
        let temporary = tempfile::tempdir().unwrap();
        let folder = temporary.path().join("a b/store");
        let text = folder.to_str().unwrap();
        let missing = format!("{:#}", open_store(text).unwrap_err());
        assert!(missing.contains("no such folder") && !folder.exists(), "{missing}");
        let opened = create_store(text).unwrap();
        assert_eq!(opened.folder.as_deref(), Some(&*folder.canonicalize().unwrap()));
        exercise(&*opened.store, "1").await;
        let url = Url::from_directory_path(&folder).unwrap();
        let again = open_store(url.as_str()).unwrap();
        assert_eq!(again.folder, opened.folder);
        exercise(&*again.store, "2").await;
    }

    #[test]
    fn what_is_no_store_is_refused_with_what_would_be() {
        for text in ["", "  ", "http://host/store", "gs://bucket", "S4://x", "://", "s3 ://b"] {
            assert!(refusal(text).contains("s3://bucket/prefix"), "{text}: {}", refusal(text));
        }
        #[cfg(unix)]
        assert!(refusal("file://host/folder").contains("another machine"));
        let file = tempfile::NamedTempFile::new().unwrap();
        assert!(refusal(file.path().to_str().unwrap()).contains("is a file"));
        assert!(open_store(file.path().to_str().unwrap()).is_err());
    }

    #[cfg(not(feature = "s3"))]
    #[test]
    fn without_s3_a_bucket_is_refused() {
        assert!(refusal("s3://bucket/prefix").contains("--features s3"));
    }

    #[cfg(feature = "s3")]
    #[test]
    fn bad_buckets_are_refused() {
        assert!(refusal("s3:///prefix").contains("names no bucket"));
        assert!(refusal("s3://key:secret@bucket").contains("AWS_ACCESS_KEY_ID"));
        assert!(!refusal("s3://key:secret@bucket").contains("secret@"));
        assert!(refusal("s3://bucket:9000/x").contains("port"));
        assert!(refusal("s3://bucket?endpont=http://a").contains("endpont"));
        assert!(refusal("s3://bucket?endpoint=host:9000").contains("http(s)"));
        let opened = open_store("s3://bucket/a/b?endpoint=http://127.0.0.1:9&region=eu-1").unwrap();
        assert!(opened.folder.is_none());
        let shown = opened.store.to_string();
        assert!(shown.contains("a/b"), "{shown}");
    }

    /// Against a server: `TOILE_S3=s3://bucket/prefix?endpoint=http://127.0.0.1:5000`, with
    /// credentials in the environment.
    #[cfg(feature = "s3")]
    #[tokio::test]
    async fn a_bucket_is_used() {
        let Ok(text) = std::env::var("TOILE_S3") else {
            println!("skipped: TOILE_S3 names no bucket");
            return;
        };
        exercise(&*open_store(&text).unwrap().store, "1").await;
    }
}

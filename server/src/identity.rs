//! The server's certificate: made on first start, kept, and pinned by clients.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer};
use rustls::sign::CertifiedKey;
use sha2::{Digest, Sha256};

/// Why there is no certificate.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum IdentityError {
    /// The folder cannot be read or written.
    #[error("certificate: cannot {what} {}: {source}", path.display())]
    Io {
        /// What was tried.
        what: &'static str,
        /// The file.
        path: PathBuf,
        /// Why it failed.
        source: std::io::Error,
    },
    /// No certificate could be made.
    #[error("certificate: {0}")]
    Make(#[from] rcgen::Error),
    /// A file is not what it was.
    #[error(
        "certificate: {} is damaged ({why}); restore it from a copy, or remove {} and {} for a new \
         certificate, whose fingerprint players must then pin",
        path.display(), CERTIFICATE, KEY
    )]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        why: String,
    },
    /// Of the certificate and its key, one is there.
    #[error(
        "certificate: {} is there, but {} is not; restore it from a copy, or remove the other one for a \
         new certificate, whose fingerprint players must then pin",
        found.display(), missing.display()
    )]
    Half {
        /// The one that is there.
        found: PathBuf,
        /// The one that is not.
        missing: PathBuf,
    },
}

const CERTIFICATE: &str = "server.cert";
const KEY: &str = "server.key";

/// A certificate with its key.
#[derive(Debug)]
pub(crate) struct Identity {
    pub certified: Arc<CertifiedKey>,
    certificate: CertificateDer<'static>,
}

impl Identity {
    /// Reads it from `folder`, or makes one and keeps it there. Servers that start there at the
    /// same moment all get the same one.
    pub fn load_or_make(folder: &Path) -> Result<Self, IdentityError> {
        match Self::load(folder) {
            Ok(Some(kept)) => return Ok(kept),
            // Another server may be making the other half.
            Ok(None) | Err(IdentityError::Half { .. }) => {}
            Err(error) => return Err(error),
        }
        std::fs::create_dir_all(folder).map_err(failed("make", folder))?;
        let lock_path = folder.join("server.lock");
        let lock = std::fs::File::create(&lock_path).map_err(failed("make", &lock_path))?;
        lock.lock().map_err(failed("lock", &lock_path))?;
        Self::finish(folder)?;
        // Another server may have made it while this one waited.
        match Self::load(folder)? {
            Some(kept) => Ok(kept),
            None => Self::make(folder),
        }
    }

    fn load(folder: &Path) -> Result<Option<Self>, IdentityError> {
        let (certificate, key) = paths(folder);
        match (read(&certificate)?, read(&key)?) {
            (None, None) => Ok(None),
            (Some(_), None) => Err(IdentityError::Half { found: certificate, missing: key }),
            (None, Some(_)) => Err(IdentityError::Half { found: key, missing: certificate }),
            (Some(found), Some(found_key)) => Self::new(folder, found, found_key).map(Some),
        }
    }

    fn make(folder: &Path) -> Result<Self, IdentityError> {
        let (certificate_path, key_path) = paths(folder);
        let made = rcgen::generate_simple_self_signed(["toile".to_string()])?;
        let (certificate, key) = (made.cert.der().to_vec(), made.signing_key.serialize_der());
        // Both are written before either is there, so that `finish` can go on from anywhere.
        write_secret(&certificate_path, &certificate)?;
        write_secret(&key_path, &key)?;
        rename(&key_path)?;
        rename(&certificate_path)?;
        Self::new(folder, certificate, key)
    }

    /// Takes the last step of [`Identity::make`] for a server that was killed right before it.
    fn finish(folder: &Path) -> Result<(), IdentityError> {
        let (certificate, key) = paths(folder);
        let is_left = key.exists() && !certificate.exists() && unfinished(&certificate).exists();
        if is_left { rename(&certificate) } else { Ok(()) }
    }

    /// SHA-256 of the certificate, in hexadecimal: what clients pin.
    pub fn fingerprint(&self) -> String {
        Sha256::digest(&self.certificate).iter().map(|byte| format!("{byte:02x}")).collect()
    }

    fn new(folder: &Path, certificate: Vec<u8>, key: Vec<u8>) -> Result<Self, IdentityError> {
        let (certificate_path, key_path) = paths(folder);
        let damaged = |path, why: String| IdentityError::Damaged { path, why };
        let provider = rustls::crypto::ring::default_provider();
        let key = PrivateKeyDer::Pkcs8(PrivatePkcs8KeyDer::from(key));
        let key = provider.key_provider.load_private_key(key);
        let key = key.map_err(|error| damaged(key_path, error.to_string()))?;
        let certificate = CertificateDer::from(certificate);
        let certified = CertifiedKey::new(vec![certificate.clone()], key);
        certified.keys_match().map_err(|error| damaged(certificate_path, error.to_string()))?;
        Ok(Self { certified: Arc::new(certified), certificate })
    }
}

/// Of the certificate and its key.
fn paths(folder: &Path) -> (PathBuf, PathBuf) {
    (folder.join(CERTIFICATE), folder.join(KEY))
}

fn read(path: &Path) -> Result<Option<Vec<u8>>, IdentityError> {
    match std::fs::read(path) {
        Ok(bytes) => Ok(Some(bytes)),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(failed("read", path)(error)),
    }
}

/// Under which name a file is written before it is renamed.
fn unfinished(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_os_string();
    name.push(".new");
    name.into()
}

fn rename(path: &Path) -> Result<(), IdentityError> {
    std::fs::rename(unfinished(path), path).map_err(failed("write", path))
}

/// Readable by its owner alone.
fn write_secret(path: &Path, bytes: &[u8]) -> Result<(), IdentityError> {
    let unfinished = unfinished(path);
    let mut options = std::fs::OpenOptions::new();
    options.write(true).create(true).truncate(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    let mut file = options.open(&unfinished).map_err(failed("write", &unfinished))?;
    file.write_all(bytes).and_then(|()| file.sync_all()).map_err(failed("write", &unfinished))
}

fn failed(what: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> IdentityError {
    let path = path.to_path_buf();
    move |source| IdentityError::Io { what, path, source }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn servers_that_start_at_once_share_one_certificate() {
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().join("identity");
        let start = std::sync::Barrier::new(8);
        let fingerprints: Vec<String> = std::thread::scope(|scope| {
            let one = || {
                start.wait();
                Identity::load_or_make(&place).unwrap().fingerprint()
            };
            let threads: Vec<_> = (0..8).map(|_| scope.spawn(one)).collect();
            threads.into_iter().map(|t| t.join().unwrap()).collect()
        });
        assert!(fingerprints.iter().all(|f| *f == fingerprints[0]), "{fingerprints:?}");
    }

    #[test]
    fn a_damaged_or_lost_half_is_named_and_never_made_anew() {
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path();
        let made = Identity::load_or_make(place).unwrap().fingerprint();
        let (certificate, key) = paths(place);
        for (file, other) in [(&certificate, &key), (&key, &certificate)] {
            let good = std::fs::read(file).unwrap();
            for bad in [&good[..good.len() / 2], b"", b"not a certificate"] {
                std::fs::write(file, bad).unwrap();
                let error = Identity::load_or_make(place).unwrap_err().to_string();
                let named = error.contains(&file.display().to_string());
                assert!(named && error.contains("damaged"), "{error}");
            }
            std::fs::remove_file(file).unwrap();
            let error = Identity::load_or_make(place).unwrap_err();
            let half = matches!(&error, IdentityError::Half { found, missing }
                if found == other && missing == file);
            assert!(half && error.to_string().contains("restore"), "{error}");
            assert!(!file.exists());
            std::fs::write(file, good).unwrap();
            // Killed between the two last steps of making it.
            std::fs::rename(&certificate, unfinished(&certificate)).unwrap();
            assert_eq!(Identity::load_or_make(place).unwrap().fingerprint(), made);
        }
        // A certificate of another key.
        let elsewhere = tempfile::tempdir().unwrap();
        Identity::load_or_make(elsewhere.path()).unwrap();
        std::fs::copy(paths(elsewhere.path()).0, &certificate).unwrap();
        let error = Identity::load_or_make(place).unwrap_err().to_string();
        assert!(error.contains("server.cert is damaged"), "{error}");
    }
}

//! The server's certificate: made on first start, kept, and pinned by clients.

use std::io::Write;
use std::path::{Path, PathBuf};

use rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer};
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
}

/// A certificate with its key.
#[derive(Debug)]
pub(crate) struct Identity {
    pub certificate: CertificateDer<'static>,
    pub key: PrivateKeyDer<'static>,
}

impl Identity {
    /// Reads it from `folder`, or makes one and keeps it there. Servers that start there at the
    /// same moment all get the same one.
    pub fn load_or_make(folder: &Path) -> Result<Self, IdentityError> {
        if let Some(kept) = Self::load(folder)? {
            return Ok(kept);
        }
        std::fs::create_dir_all(folder).map_err(failed("make", folder))?;
        let lock_path = folder.join("server.lock");
        let lock = std::fs::File::create(&lock_path).map_err(failed("make", &lock_path))?;
        lock.lock().map_err(failed("lock", &lock_path))?;
        // Another server may have made it while this one waited.
        match Self::load(folder)? {
            Some(kept) => Ok(kept),
            None => Self::make(folder),
        }
    }

    fn load(folder: &Path) -> Result<Option<Self>, IdentityError> {
        let (certificate, key) = paths(folder);
        let both = read(&certificate)?.zip(read(&key)?);
        Ok(both.map(|(certificate, key)| Self::new(certificate, key)))
    }

    /// The key first: where there is a certificate, there is its key.
    fn make(folder: &Path) -> Result<Self, IdentityError> {
        let (certificate_path, key_path) = paths(folder);
        let made = rcgen::generate_simple_self_signed(["toile".to_string()])?;
        let (certificate, key) = (made.cert.der().to_vec(), made.signing_key.serialize_der());
        write_secret(&key_path, &key)?;
        write_secret(&certificate_path, &certificate)?;
        Ok(Self::new(certificate, key))
    }

    /// SHA-256 of the certificate, in hexadecimal: what clients pin.
    pub fn fingerprint(&self) -> String {
        Sha256::digest(&self.certificate).iter().map(|byte| format!("{byte:02x}")).collect()
    }

    fn new(certificate: Vec<u8>, key: Vec<u8>) -> Self {
        let key = PrivateKeyDer::Pkcs8(PrivatePkcs8KeyDer::from(key));
        Self { certificate: certificate.into(), key }
    }
}

/// Of the certificate and its key.
fn paths(folder: &Path) -> (PathBuf, PathBuf) {
    (folder.join("server.cert"), folder.join("server.key"))
}

fn read(path: &Path) -> Result<Option<Vec<u8>>, IdentityError> {
    match std::fs::read(path) {
        Ok(bytes) => Ok(Some(bytes)),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(failed("read", path)(error)),
    }
}

/// Whole or not at all, and readable by its owner alone.
fn write_secret(path: &Path, bytes: &[u8]) -> Result<(), IdentityError> {
    let unfinished = path.with_extension("new");
    let mut options = std::fs::OpenOptions::new();
    options.write(true).create(true).truncate(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    let mut file = options.open(&unfinished).map_err(failed("write", &unfinished))?;
    file.write_all(bytes)
        .and_then(|()| file.sync_all())
        .and_then(|()| std::fs::rename(&unfinished, path))
        .map_err(failed("write", path))
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
}

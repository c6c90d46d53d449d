//! The publisher's signing key: 32 secret bytes in a file of its owner's.

use std::fs;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use protocol::SigningKey;

/// Why there is no key.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum KeyError {
    /// The file cannot be read or made.
    #[error("signing key {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The file holds something else.
    #[error("signing key {path}: {bytes} bytes, but a key has 32; is this another file?")]
    Length {
        /// The file.
        path: PathBuf,
        /// Its length.
        bytes: usize,
    },
}

/// Loads the key, or makes it once from the operating system's randomness (mode 0600).
///
/// # Errors
/// A file that cannot be read or made, or is no key.
pub fn load_or_make_key(path: &Path) -> Result<SigningKey, KeyError> {
    let failed = |source| KeyError::Io { path: path.into(), source };
    match load(path) {
        Err(KeyError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => {}
        loaded => return loaded,
    }
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder).map_err(failed)?;
    }
    // Written aside and linked into place: whoever comes second finds the whole key of the first.
    let mut aside = path.as_os_str().to_owned();
    aside.push(format!(".{}", std::process::id()));
    let aside = PathBuf::from(aside);
    let made = make(&aside).and_then(|()| match fs::hard_link(&aside, path) {
        Err(e) if e.kind() != io::ErrorKind::AlreadyExists => Err(e),
        _ => Ok(()),
    });
    let removed = fs::remove_file(&aside);
    made.and(removed).map_err(failed)?;
    load(path)
}

fn load(path: &Path) -> Result<SigningKey, KeyError> {
    let failed = |source| KeyError::Io { path: path.into(), source };
    let mut bytes = Vec::new();
    fs::File::open(path).map_err(failed)?.take(33).read_to_end(&mut bytes).map_err(failed)?;
    let seed: [u8; 32] = bytes
        .as_slice()
        .try_into()
        .map_err(|_| KeyError::Length { path: path.into(), bytes: bytes.len() })?;
    Ok(SigningKey::from_seed(&seed))
}

fn make(path: &Path) -> io::Result<()> {
    let mut seed = [0; 32];
    fs::File::open("/dev/urandom")?.read_exact(&mut seed)?;
    let mut options = fs::OpenOptions::new();
    options.write(true).create(true).truncate(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    let mut file = options.open(path)?;
    file.write_all(&seed)?;
    file.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_is_made_once() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("work/key");
        let made = load_or_make_key(&path).unwrap();
        let loaded = load_or_make_key(&path).unwrap();
        assert_eq!(made.public(), loaded.public());
        let other = load_or_make_key(&folder.path().join("other")).unwrap();
        assert_ne!(made.public(), other.public());
        assert_eq!(fs::read_dir(folder.path().join("work")).unwrap().count(), 1);
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            let mode = fs::metadata(&path).unwrap().permissions().mode();
            assert_eq!(mode & 0o777, 0o600);
        }
    }

    #[test]
    fn another_file_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("key");
        fs::write(&path, [7; 31]).unwrap();
        assert!(matches!(load_or_make_key(&path), Err(KeyError::Length { bytes: 31, .. })));
        fs::write(&path, [7; 100]).unwrap();
        assert!(matches!(load_or_make_key(&path), Err(KeyError::Length { .. })));
    }
}

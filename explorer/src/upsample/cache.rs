//! Files in the work folder that are named by what they were made from, and checked when read.

use std::io::Write;
use std::path::{Path, PathBuf};

/// Changes whenever the same inputs would give other results.
const RULES: u32 = 2;
/// Longest file that is read (bytes).
const BYTES_MAX: u64 = 4 << 30;

/// A folder of results; without a folder nothing is kept.
#[derive(Debug, Clone, Default)]
pub struct Cache {
    folder: Option<PathBuf>,
}

/// What a result was made from, hashed.
#[derive(Debug, Clone)]
pub struct Key(blake3::Hasher);

impl Key {
    /// Of a kind of result.
    pub fn new(kind: &str) -> Self {
        let mut hasher = blake3::Hasher::new();
        hasher.update(&RULES.to_le_bytes());
        hasher.update(&(kind.len() as u64).to_le_bytes());
        hasher.update(kind.as_bytes());
        Self(hasher)
    }

    /// The same with one more input.
    pub fn with(mut self, numbers: &[f32]) -> Self {
        self.0.update(&(numbers.len() as u64).to_le_bytes());
        numbers.iter().for_each(|n| {
            self.0.update(&n.to_bits().to_le_bytes());
        });
        self
    }

    /// The same with one more input.
    pub fn with_words(mut self, words: &[u32]) -> Self {
        self.0.update(&(words.len() as u64).to_le_bytes());
        words.iter().for_each(|n| {
            self.0.update(&n.to_le_bytes());
        });
        self
    }

    fn name(&self) -> String {
        self.0.finalize().to_hex()[..32].to_string()
    }
}

impl Cache {
    /// Results in `folder`, which is made when the first one is kept.
    pub fn new(folder: &Path) -> Self {
        Self { folder: Some(folder.to_owned()) }
    }

    /// Where the result of `key` is.
    fn path(&self, key: &Key) -> Option<PathBuf> {
        self.folder.as_ref().map(|folder| folder.join(format!("{}.f32", key.name())))
    }

    /// The numbers kept under `key`; `None` where there are none, or where the file is damaged.
    pub fn load(&self, key: &Key) -> Option<Vec<f32>> {
        let path = self.path(key)?;
        if std::fs::metadata(&path).ok()?.len() > BYTES_MAX {
            return None;
        }
        let bytes = std::fs::read(&path).ok()?;
        let (sum, numbers) = bytes.split_at_checked(32)?;
        if blake3::hash(numbers).as_bytes() != sum || numbers.len() % 4 != 0 {
            tracing::warn!("{} is damaged and is made again", path.display());
            return None;
        }
        let (numbers, _) = numbers.as_chunks::<4>();
        Some(numbers.iter().map(|b| f32::from_le_bytes(*b)).collect())
    }

    /// Keeps `numbers` under `key`: whole or not at all.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn keep(&self, key: &Key, numbers: &[f32]) -> std::io::Result<()> {
        let (Some(path), Some(folder)) = (self.path(key), &self.folder) else { return Ok(()) };
        std::fs::create_dir_all(folder)?;
        let bytes: Vec<u8> = numbers.iter().flat_map(|n| n.to_le_bytes()).collect();
        let part = path.with_extension(format!("part{}", std::process::id()));
        let mut file = std::fs::File::create(&part)?;
        file.write_all(blake3::hash(&bytes).as_bytes())?;
        file.write_all(&bytes)?;
        file.sync_all()?;
        std::fs::rename(&part, &path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_kept_is_found_under_its_inputs_only_and_damage_is_seen() {
        let folder = tempfile::tempdir().unwrap();
        let cache = Cache::new(folder.path());
        let key = Key::new("test").with(&[1.0, 2.0]).with_words(&[3]);
        assert_eq!(cache.load(&key), None);
        cache.keep(&key, &[0.5, f32::MAX]).unwrap();
        assert_eq!(cache.load(&key), Some(vec![0.5, f32::MAX]));
        assert_eq!(cache.load(&Key::new("test").with(&[1.0]).with(&[2.0]).with_words(&[3])), None);
        let path = cache.path(&key).unwrap();
        let mut bytes = std::fs::read(&path).unwrap();
        bytes[35] ^= 1;
        std::fs::write(&path, bytes).unwrap();
        assert_eq!(cache.load(&key), None);
        assert_eq!(Cache::default().load(&key), None);
    }
}

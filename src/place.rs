//! Where things lie beside a store.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use explorer::pack::Bound;

use crate::store::Opened;

/// The folder beside a local store with this ending; a remote store has none.
fn beside(store: &Opened, ending: &str) -> Option<PathBuf> {
    let root = store.folder.as_ref()?;
    let mut name = root.file_name()?.to_os_string();
    name.push(ending);
    Some(root.with_file_name(name))
}

/// The explorer's work folder: as asked, or `STORE.work`.
pub fn work(store: &Opened, asked: Option<PathBuf>) -> Result<PathBuf> {
    asked
        .or_else(|| beside(store, ".work"))
        .context("a remote store needs --work DIR: working data is never published")
}

/// Where the server keeps its certificate: as asked, or `STORE.server`.
pub fn identity(store: &Opened, asked: Option<PathBuf>) -> Result<PathBuf> {
    asked
        .or_else(|| beside(store, ".server"))
        .context("a remote store needs --identity DIR for the server's certificate")
}

/// Refuses a file that could not be written, before the work for it is done. Leaves nothing there.
pub fn ensure_writable(file: &Path) -> Result<()> {
    let folder = file.parent().filter(|f| !f.as_os_str().is_empty()).unwrap_or(Path::new("."));
    ensure!(folder.is_dir(), "{}: there is no folder {}", file.display(), folder.display());
    ensure!(!file.is_dir(), "{} is a folder; name a file", file.display());
    let is_new = !file.exists();
    std::fs::File::options()
        .append(true)
        .create(true)
        .open(file)
        .with_context(|| format!("{} cannot be written", file.display()))?;
    if is_new {
        std::fs::remove_file(file).with_context(|| format!("removing {}", file.display()))?;
    }
    Ok(())
}

/// A bound on every vertex, from millimetres.
pub fn bound(mm: f32) -> Result<Bound> {
    let bound = Bound { max_m: Some(mm / 1000.0), rms_m: None };
    ensure!(bound.is_valid(), "--bound-mm {mm}: millimetres, at least 0.01");
    Ok(bound)
}

/// As many threads as asked, at least one; by default one per core.
pub fn workers(asked: Option<usize>) -> Result<usize> {
    match asked {
        Some(0) => anyhow::bail!("--workers 0: at least one is needed"),
        Some(n) if n > 1024 => anyhow::bail!("--workers {n}: at most 1024"),
        Some(n) => Ok(n),
        None => Ok(std::thread::available_parallelism().map_or(1, usize::from)),
    }
}

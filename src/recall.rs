//! What a work folder was made from, so that a store is enough to name it later.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, ensure};
use explorer::explore::OLDER;
use explorer::grow::archive::{Archive, ArchiveError};
use explorer::scene::Scene;
use serde::{Deserialize, Serialize};

use crate::store::Opened;
use crate::{args, place, scene};

const FILE: &str = "scene.json";

/// The scene as it was named.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Named {
    /// A built-in scene or a file, absolute.
    pub scene: String,
    /// `--vertices`.
    pub vertices: Option<usize>,
}

impl Named {
    /// As given on the command line.
    pub fn new(scene: &str, vertices: Option<usize>) -> Self {
        let file = Path::new(scene).is_file().then(|| std::fs::canonicalize(scene).ok()).flatten();
        let scene = file.map_or(scene.to_owned(), |file| file.display().to_string());
        Self { scene, vertices }
    }

    /// Leaves it in a work folder.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub fn leave(&self, work: &Path) -> Result<()> {
        let file = work.join(FILE);
        let text = serde_json::to_string(self)?;
        if std::fs::read_to_string(&file).is_ok_and(|there| there == text) {
            return Ok(());
        }
        std::fs::write(&file, text).with_context(|| format!("writing {}", file.display()))
    }
}

/// An explored store's working data.
pub struct Explored {
    /// The scene.
    pub scene: Scene,
    /// The work folder.
    pub work: PathBuf,
    /// What it holds.
    pub archive: Archive,
}

/// Reads the work folder of a store.
///
/// # Errors
/// There is none, or it is of another scene than the one named.
pub fn recall(opened: &Opened, a: &args::Explored) -> Result<Explored> {
    let work = place::work(opened, a.work.clone())?;
    ensure!(
        work.join("journal").is_file(),
        "nothing was explored in {}: certificates, plots and comparisons need the exact states of \
         the explorer; name its work folder with --work, or explore first",
        work.display()
    );
    let left = || {
        let text = std::fs::read_to_string(work.join(FILE)).ok()?;
        serde_json::from_str::<Named>(&text).ok()
    };
    let named = match &a.scene {
        Some(scene) => Named::new(scene, left().and_then(|named| named.vertices)),
        None => left().with_context(|| {
            format!("{} does not say which scene it is of; give --scene", work.display())
        })?,
    };
    let scene = scene::load_with(&named.scene, named.vertices)?;
    let archive = Archive::open(&work, &scene).map_err(|error| match error {
        ArchiveError::Records { .. } => anyhow!("{error}{OLDER}"),
        ArchiveError::Journal { .. } | ArchiveError::States { .. } => {
            anyhow!("{error}; restore a copy of the work folder, or name another (--work)")
        }
        other => other.into(),
    })?;
    Ok(Explored { scene, work, archive })
}

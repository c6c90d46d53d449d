//! A work folder read only: what was explored, for certificates, comparisons and plots. It may be
//! read while an explorer is at work in it.

use std::path::{Path, PathBuf};

use protocol::StateId;

use super::class::Classifier;
use super::graph::Graph;
use super::journal::{Journal, JournalError};
use super::ledger::{Ledger, LedgerError, Phase};
use super::metric::Metric;
use super::record::{Header, Record};
use super::states::StateFile;
use super::view::View;
use super::work::header_digest;
use crate::grid::GridState;
use crate::scene::Scene;

/// Why a work folder cannot be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ArchiveError {
    /// The journal.
    #[error("{}: {source}", .path.display())]
    Journal {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: JournalError,
    },
    /// Its records contradict each other.
    #[error("{}: {source}", .path.display())]
    Records {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: LedgerError,
    },
    /// The states.
    #[error("{}: {source}", .path.display())]
    States {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: std::io::Error,
    },
    /// Made for another scene.
    #[error("{}: made for other inputs: {differences}; name its scene", .path.display())]
    Mismatch {
        /// The file.
        path: PathBuf,
        /// Each input that differs.
        differences: String,
    },
    /// The initial pass is not over: there is no whole graph yet.
    #[error("{}: the initial pass is not over; explore further first", .0.display())]
    NoGraph(PathBuf),
}

/// What a work folder holds.
#[derive(Debug)]
pub struct Archive {
    ledger: Ledger,
    states: StateFile,
    metric: Metric,
    classifier: Classifier,
}

impl Archive {
    /// Reads the folder of a scene.
    ///
    /// # Errors
    /// It is missing, of another scene, damaged, or without a whole graph.
    pub fn open(folder: &Path, scene: &Scene) -> Result<Self, ArchiveError> {
        let path = folder.join("journal");
        let mut ledger = Ledger::new(scene);
        let mut header = None;
        let each = |record: Record| match (record, &header) {
            (Record::Header(then), None) => {
                header = Some(then);
                Ok(())
            }
            (_, None) => Err(Refused::Ledger(LedgerError::OutOfTurn("no header"))),
            (record, Some(_)) => ledger.apply(&record).map_err(Refused::Ledger),
        };
        let read = Journal::read(&path, each);
        let at = || path.clone();
        let header = header.ok_or(JournalError::Foreign);
        if let Ok(then) = &header
            && let Some(differences) = then.differences(&Header::new(scene, then.paper()))
        {
            return Err(ArchiveError::Mismatch { path: at(), differences });
        }
        match read {
            Err(Refused::Journal(source)) => {
                return Err(ArchiveError::Journal { path: at(), source });
            }
            Err(Refused::Ledger(source)) => {
                return Err(ArchiveError::Records { path: at(), source });
            }
            Ok(()) => {}
        }
        let header = header.map_err(|source| ArchiveError::Journal { path: at(), source })?;
        if ledger.phase() != Phase::Expansion {
            return Err(ArchiveError::NoGraph(folder.to_owned()));
        }
        let path = folder.join("states");
        let count = ledger.graph().next_id().0;
        let digest = header_digest(&header);
        let states = StateFile::open_to_read(&path, header.vertex_count, &digest, count)
            .map_err(|source| ArchiveError::States { path, source })?;
        let (metric, classifier) = (Metric::of_scene(scene), Classifier::new(scene));
        Ok(Self { ledger, states, metric, classifier })
    }

    /// Graph and bookkeeping.
    pub fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    /// The secondary graph.
    pub fn graph(&self) -> &Graph {
        self.ledger.graph()
    }

    /// How far states are apart.
    pub fn metric(&self) -> &Metric {
        &self.metric
    }

    /// Tells a state's class.
    pub fn classifier(&self) -> &Classifier {
        &self.classifier
    }

    /// The graph at a commit since the end of the initial pass.
    pub fn view(&self, commit: u64) -> View<'_> {
        View::new(self.graph(), &self.states, commit)
    }

    /// The commit that the newest version shows; the newest where none was published.
    pub fn shown(&self) -> u64 {
        self.ledger.published().map_or(self.graph().commit(), |version| version.shown)
    }

    /// An exact state.
    ///
    /// # Errors
    /// It cannot be read.
    pub fn state(&self, state: StateId) -> std::io::Result<GridState> {
        self.states.read(state)
    }
}

enum Refused {
    Journal(JournalError),
    Ledger(LedgerError),
}

impl From<JournalError> for Refused {
    fn from(error: JournalError) -> Self {
        Self::Journal(error)
    }
}

//! The work folder: journal, states, and what keeps them together.
//!
//! Order of writes: states, then the journal's record, each waited for until it is on the disk;
//! only then is the outcome part of the graph. So a kill at any instant loses the jobs in flight
//! and nothing else. One process at a time: the folder is locked.

use std::fs::{File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use protocol::StateId;

use super::class::{self, Class, Classifier};
use super::files;
use super::graph::{Graph, Kind};
use super::job::{Local, LocalFrame, Outcome, Rules};
use super::journal::{Journal, JournalError, TAIL_BYTES};
use super::ledger::{Job, Ledger, LedgerError};
use super::record::{
    DrapeRecord, FailedRecord, FrameRecord, Header, JobRecord, MergeRecord, PublishRecord, Record,
    SteerRecord, TagRecord,
};
use super::similar::{Found, Similar};
use super::states::StateFile;
use super::view::View;
use crate::grid::GridState;
use crate::scene::Scene;
use crate::simulator::Frame;

/// How long to wait for a folder that is in use.
const LOCK_PATIENCE: Duration = Duration::from_millis(300);

/// Frames behind a merge in which its true error is looked for.
const FUTURE_FRAMES: usize = 10;

/// Why a work folder cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WorkError {
    /// A file could not be read or written, e.g. because the disk is full.
    #[error(
        "{}: {source}; what was reported as done is safe: mend this and run again",
        .path.display()
    )]
    Io {
        /// Which file.
        path: PathBuf,
        /// What happened.
        source: io::Error,
    },
    /// Another explorer has it open.
    #[error(
        "{}: another explorer is at work in this folder; stop it or take another one",
        .0.display()
    )]
    Locked(PathBuf),
    /// The journal was made for something else.
    #[error(
        "{}: made for other inputs: {differences}; take these back or another work folder",
        .path.display()
    )]
    Mismatch {
        /// The journal.
        path: PathBuf,
        /// Each input that differs, with both values.
        differences: String,
    },
    /// The journal cannot be understood.
    #[error("{}: {source}", .path.display())]
    Journal {
        /// The journal.
        path: PathBuf,
        /// What is wrong.
        source: JournalError,
    },
    /// States without the journal that tells what they are.
    #[error(
        "{}: there are states here, and no journal; put the journal back, or take another work folder",
        .0.display()
    )]
    NoJournal(PathBuf),
    /// The journal's records contradict each other.
    #[error("{}: {source}; restore a copy or take another work folder", .path.display())]
    Records {
        /// The journal.
        path: PathBuf,
        /// What is wrong.
        source: LedgerError,
    },
}

/// An open work folder.
#[derive(Debug)]
pub struct Work {
    folder: PathBuf,
    ledger: Ledger,
    journal: Journal,
    states: Arc<StateFile>,
    similar: Arc<Similar>,
    classifier: Arc<Classifier>,
    rules: Rules,
    simulate_cpu: File,
    simulate_cpu_s: f64,
    /// The journal is compacted when its tail is longer.
    tail_bytes: u64,
    _lock: File,
}

impl Work {
    /// Opens the folder of a scene, or makes it; replays the journal.
    ///
    /// # Errors
    /// It is in use, was made for other inputs, was damaged, or cannot be read or written.
    pub fn open(folder: &Path, scene: &Scene, paper: bool) -> Result<Self, WorkError> {
        Self::open_with(folder, scene, paper, TAIL_BYTES)
    }

    /// As [`Work::open`]; the journal is compacted whenever its tail has more than so many bytes.
    ///
    /// # Errors
    /// As for [`Work::open`].
    pub fn open_with(
        folder: &Path,
        scene: &Scene,
        paper: bool,
        tail_bytes: u64,
    ) -> Result<Self, WorkError> {
        std::fs::create_dir_all(folder).map_err(at(folder))?;
        let lock = lock(&folder.join("lock"))?;
        let header = Header::new(scene, paper);
        let digest = header_digest(&header);
        let states_path = folder.join("states");
        let journal_path = folder.join("journal");
        let mut ledger = Ledger::new(scene);
        let exists = journal_path.try_exists().map_err(at(&journal_path))?;
        let (journal, states) = if exists {
            let journal = replay(&journal_path, &header, &mut ledger)?;
            let draped = ledger.phase() != super::ledger::Phase::Drape;
            let count = if draped { ledger.graph().next_id().0 } else { 0 };
            let states = StateFile::open(&states_path, header.vertex_count, &digest, count);
            (journal, states.map_err(at(&states_path))?)
        } else if StateFile::holds_states(&states_path).map_err(at(&states_path))? {
            return Err(WorkError::NoJournal(folder.to_owned()));
        } else {
            let states = StateFile::create(&states_path, header.vertex_count, &digest);
            let states = states.map_err(at(&states_path))?;
            let journal = Journal::create(&journal_path, &Record::Header(header));
            (journal.map_err(at(&journal_path))?, states)
        };
        let mut similar = Similar::new(scene);
        let classes = match ledger.phase() {
            super::ledger::Phase::Drape => Vec::new(),
            _ => ledger.graph().states().map(|state| state.class).collect(),
        };
        let path = folder.join("landmarks");
        similar.open(&path, &digest, &states, classes).map_err(at(&path))?;
        let cpu_path = folder.join("simulate_cpu_s");
        let (simulate_cpu, simulate_cpu_s) = open_cpu(&cpu_path).map_err(at(&cpu_path))?;
        let e = &scene.exploration;
        let rules =
            Rules { tolerance_m: e.tolerance_m, depth_frames: e.depth_frames.max(1), paper };
        let states = Arc::new(states);
        let folder = folder.to_owned();
        let mut work = Self {
            folder,
            ledger,
            journal,
            states,
            similar: Arc::new(similar),
            classifier: Arc::new(Classifier::new(scene)),
            rules,
            simulate_cpu,
            simulate_cpu_s,
            tail_bytes,
            _lock: lock,
        };
        work.compact()?;
        Ok(work)
    }

    /// Graph and bookkeeping.
    pub fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    /// The secondary graph.
    pub fn graph(&self) -> &Graph {
        self.ledger.graph()
    }

    /// The states.
    pub fn states(&self) -> &Arc<StateFile> {
        &self.states
    }

    /// Finds similar states.
    pub fn similar(&self) -> &Arc<Similar> {
        &self.similar
    }

    /// Tells a state's class.
    pub fn classifier(&self) -> &Arc<Classifier> {
        &self.classifier
    }

    /// How jobs are judged.
    pub fn rules(&self) -> &Rules {
        &self.rules
    }

    /// The journal.
    pub fn journal(&self) -> &Journal {
        &self.journal
    }

    /// CPU seconds spent in jobs, over all runs; a killed run's last seconds may be missing.
    pub fn simulate_cpu_s(&self) -> f64 {
        self.simulate_cpu_s
    }

    /// Bytes of a state in this folder, its part of the journal included, about.
    pub fn state_bytes(&self) -> u64 {
        self.states.state_bytes() + 12 * super::similar::LANDMARKS as u64 + 24
    }

    /// The graph at a commit, ready to be published.
    pub fn view(&self, commit: u64) -> View<'_> {
        View::new(self.graph(), &self.states, commit)
    }

    /// Chooses the next round; false where there is nothing to do.
    pub fn open_round(&mut self) -> bool {
        self.ledger.open_round()
    }

    /// Gives dead ends whose job was given up another chance, and chooses the next round; false where
    /// there is none.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub fn reconsider(&mut self) -> Result<bool, WorkError> {
        if self.ledger.set_aside().is_empty() {
            return Ok(false);
        }
        self.record(&Record::Reconsidered)?;
        Ok(self.open_round())
    }

    /// Records the drape.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub fn drape(&mut self, frame: &Frame) -> Result<(), WorkError> {
        let pose = self.graph().state(StateId(0)).pose;
        let class = self.classifier.class(pose, &frame.state) | class::flag(&frame.quality);
        self.write_states(StateId(0), std::slice::from_ref(&frame.state), &[class])?;
        self.record(&Record::Drape(DrapeRecord { quality: frame.quality, class }))
    }

    /// From the next round on, jobs are chosen by this.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub fn steer(&mut self, steer: SteerRecord) -> Result<(), WorkError> {
        self.record(&Record::Steer(steer))
    }

    /// Dead ends that people pointed at: the next round is theirs.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub fn tag(&mut self, tagged: TagRecord) -> Result<(), WorkError> {
        self.record(&Record::Tagged(tagged))
    }

    /// The same while a round is open: it waits until theirs is done.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub fn interrupt(&mut self, tagged: TagRecord) -> Result<(), WorkError> {
        self.record(&Record::Interrupted(tagged))
    }

    /// Commits the outcome of the round's next job.
    ///
    /// # Errors
    /// The folder cannot be read or written.
    pub fn commit(&mut self, outcome: &Outcome) -> Result<(), WorkError> {
        let read = at(&self.folder.join("states"));
        let classes: Vec<Class> = outcome.frames.iter().map(|frame| frame.class).collect();
        self.write_states(self.graph().next_id(), &outcome.states, &classes)?;
        let record = self.job_record(outcome).map_err(read)?;
        self.record(&Record::Job(record))
    }

    /// Gives the round's next job up.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub fn fail(&mut self) -> Result<(), WorkError> {
        let (round, index, start) = self.turn();
        self.record(&Record::Failed(FailedRecord { round, index, start }))
    }

    /// Merges the dead ends of the initial pass, each into the most similar (here: the only)
    /// interior state of its pose; from here on the graph is total.
    ///
    /// # Errors
    /// The folder cannot be read or written.
    pub fn merge_initial(&mut self) -> Result<(), WorkError> {
        let path = self.folder.join("states");
        let mut merges = Vec::new();
        for &state in self.graph().open() {
            let candidates = self.graph().interior(self.graph().state(state).pose);
            let frame = self.states.read(state).map_err(at(&path))?;
            let frame = (&frame, self.graph().state(state).class);
            let near = self.similar.nearest(&self.states, frame, candidates, f32::INFINITY);
            let near = near.map_err(at(&path))?;
            let Found { target, error_m, .. } =
                near.expect("the initial pass left every pose a state");
            merges.push(MergeRecord { state, target, error_m });
        }
        self.record(&Record::Initialised(merges))
    }

    /// Records that a version is in the store.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub fn published(&mut self, version: PublishRecord) -> Result<(), WorkError> {
        self.record(&Record::Published(version))
    }

    /// Adds to the CPU seconds. They are no part of the journal, which is equal for equal inputs.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub fn add_cpu_s(&mut self, seconds: f64) -> Result<(), WorkError> {
        self.simulate_cpu_s += seconds;
        let bytes = self.simulate_cpu_s.to_le_bytes();
        files::write_at(&self.simulate_cpu, &bytes, 0)
            .map_err(at(&self.folder.join("simulate_cpu_s")))
    }

    /// Round, place and start of the job whose turn it is.
    fn turn(&self) -> (u64, u32, StateId) {
        let round = self.ledger.round();
        let start = match round.jobs[round.done] {
            Job::Expand(state) => state,
            Job::Initial(job) => {
                let pose = self.ledger.plan().jobs()[job].start;
                self.ledger.placed(pose).expect("a job is chosen once its start is known")
            }
        };
        (round.number, round.done as u32, start)
    }

    /// Gives ids to a job's states, and looks for nearer targets than its snapshot had.
    fn job_record(&self, outcome: &Outcome) -> io::Result<JobRecord> {
        let (round, index, start) = self.turn();
        let first = self.graph().next_id().0;
        let id = |local: Local| match local {
            Local::Known(state) => state,
            Local::New(place) => StateId(first + u64::from(place)),
        };
        let frame = |f: &LocalFrame| FrameRecord {
            parent: id(f.parent),
            edge: f.edge,
            class: f.class,
            merge: f.merge.map(|found| (id(found.target), found.error_m)),
        };
        let frames = outcome.frames.iter().map(frame).collect();
        let quality = outcome.quality;
        let remerges = Vec::new();
        let expands = self.graph().initialised().is_some();
        let future_m = if expands { self.future_m(outcome, start)? } else { None };
        let mut record = JobRecord { round, index, start, frames, remerges, quality, future_m };
        if expands && !self.rules.paper {
            self.look_at_this_round(outcome, &mut record)?;
            record.remerges = self.nearer_targets(outcome, &record, first)?;
        }
        Ok(record)
    }

    /// The largest distance (m), along the job's first chain, between what it simulated and what
    /// was played there while its start was merged.
    fn future_m(&self, outcome: &Outcome, start: StateId) -> io::Result<Option<f32>> {
        let Kind::DeadEnd { target: mut played, .. } = self.graph().state(start).kind else {
            return Ok(None);
        };
        let (mut parent, mut worst_m) = (Local::Known(start), None);
        let frames = outcome.frames.iter().zip(&outcome.states).take(FUTURE_FRAMES);
        for (place, (frame, state)) in (0..).zip(frames) {
            let Some(next) = self.graph().follow(played, frame.edge) else { break };
            if frame.parent != parent {
                break;
            }
            let apart_m = self.similar.metric().distance(state, &self.states.read(next)?);
            worst_m = Some(apart_m.max(worst_m.unwrap_or(0.0)));
            (played, parent) = (next, Local::New(place));
        }
        Ok(worst_m)
    }

    /// Moves the job's dead ends to nearer states that earlier jobs of its round committed.
    fn look_at_this_round(&self, outcome: &Outcome, record: &mut JobRecord) -> io::Result<()> {
        let graph = self.graph();
        let snapshot = self.ledger.round().snapshot;
        let frames = record.frames.iter_mut().zip(&outcome.frames).zip(&outcome.states);
        for ((frame, local), state) in frames {
            let Some(Found { cost_m, .. }) = local.merge else { continue };
            let interior = graph.interior(graph.primary().edge(frame.edge).to);
            let since = |id: &StateId| graph.state(*id).interior_since;
            // In order of becoming interior: those after the snapshot come last.
            let new = interior.partition_point(|id| since(id).is_some_and(|s| s <= snapshot));
            let state = (state, frame.class);
            let near = self.similar.nearest(&self.states, state, &interior[new..], cost_m)?;
            if let Some(found) = near.filter(|found| found.cost_m < cost_m) {
                frame.merge = Some((found.target, found.error_m));
            }
        }
        Ok(())
    }

    /// Older dead ends for which one of the job's interior states is nearer than their target.
    fn nearer_targets(
        &self,
        outcome: &Outcome,
        record: &JobRecord,
        first: u64,
    ) -> io::Result<Vec<MergeRecord>> {
        let graph = self.graph();
        let start = self.states.read(record.start)?;
        let from = graph.state(record.start);
        let mut interior = vec![((from.pose, from.class), record.start, &start)];
        for ((frame, state), id) in record.frames.iter().zip(&outcome.states).zip(first..) {
            if frame.merge.is_none() {
                let pose = graph.primary().edge(frame.edge).to;
                interior.push(((pose, frame.class), StateId(id), state));
            }
        }
        interior.sort_by_key(|((pose, _), id, _)| (*pose, *id));
        let mut remerges = Vec::new();
        for group in interior.chunk_by(|a, b| a.0.0 == b.0.0) {
            for &dead_end in graph.dead_ends(group[0].0.0) {
                if dead_end != record.start {
                    remerges.extend(self.nearer_target(dead_end, group)?);
                }
            }
        }
        remerges.sort_by_key(|merge| merge.state);
        Ok(remerges)
    }

    fn nearer_target(
        &self,
        dead_end: StateId,
        candidates: &[((protocol::PoseId, Class), StateId, &GridState)],
    ) -> io::Result<Option<MergeRecord>> {
        let (mut cost_m, mut best) = (self.graph().cost_m(dead_end), None);
        let similar = &self.similar;
        let mut near = false;
        for (_, target, _) in candidates {
            near = near || similar.least_cost(&self.states, dead_end, *target)? < cost_m;
        }
        if !near {
            return Ok(best);
        }
        let frame = self.states.read(dead_end)?;
        let class = self.graph().state(dead_end).class;
        for &((_, other), target, state) in candidates {
            let penalty_m = similar.penalties().of(class, other);
            let near = similar.judge((&frame, state), penalty_m, cost_m);
            if let Some((error_m, nearer_m)) = near.filter(|(_, nearer_m)| *nearer_m < cost_m) {
                cost_m = nearer_m;
                best = Some(MergeRecord { state: dead_end, target, error_m });
            }
        }
        Ok(best)
    }

    fn write_states(
        &self,
        first: StateId,
        states: &[GridState],
        classes: &[Class],
    ) -> Result<(), WorkError> {
        self.states.write(first, states).map_err(at(&self.folder.join("states")))?;
        let landmarks = at(&self.folder.join("landmarks"));
        self.similar.add(first, states, classes).map_err(landmarks)
    }

    fn record(&mut self, record: &Record) -> Result<(), WorkError> {
        self.journal.append(record).map_err(at(self.journal.path()))?;
        let path = self.journal.path().to_owned();
        self.ledger.apply(record).map_err(|source| WorkError::Records { path, source })?;
        self.compact()
    }

    /// Compacts the journal where its tail is long: at places that the records give, so that a run that was
    /// killed leaves the same journal.
    fn compact(&mut self) -> Result<(), WorkError> {
        if self.journal.tail_bytes() <= self.tail_bytes {
            return Ok(());
        }
        let states = self.graph().next_id().0;
        self.journal.compact(states).map_err(at(self.journal.path()))
    }
}

fn replay(path: &Path, header: &Header, ledger: &mut Ledger) -> Result<Journal, WorkError> {
    enum Refused {
        Journal(JournalError),
        Ledger(LedgerError),
        Differs(String),
    }
    impl From<JournalError> for Refused {
        fn from(error: JournalError) -> Self {
            Self::Journal(error)
        }
    }
    let mut first = true;
    let each = |record: Record| match record {
        Record::Header(then) if std::mem::take(&mut first) => {
            then.differences(header).map_or(Ok(()), |text| Err(Refused::Differs(text)))
        }
        _ if first => Err(Refused::Ledger(LedgerError::OutOfTurn("no header"))),
        record => ledger.apply(&record).map_err(Refused::Ledger),
    };
    let path = path.to_owned();
    match Journal::open(&path, each) {
        Ok((journal, torn)) => {
            if torn > 0 {
                tracing::warn!(bytes = torn, "cut the torn last record off the journal");
            }
            Ok(journal)
        }
        Err(Refused::Journal(JournalError::Io(source))) => Err(WorkError::Io { path, source }),
        Err(Refused::Journal(source)) => Err(WorkError::Journal { path, source }),
        Err(Refused::Ledger(source)) => Err(WorkError::Records { path, source }),
        Err(Refused::Differs(differences)) => Err(WorkError::Mismatch { path, differences }),
    }
}

fn at(path: &Path) -> impl Fn(io::Error) -> WorkError + use<> {
    let path = path.to_owned();
    move |source| WorkError::Io { path: path.clone(), source }
}

fn lock(path: &Path) -> Result<File, WorkError> {
    let options = File::options().write(true).create(true).truncate(false).open(path);
    let file = options.map_err(at(path))?;
    for last in [false, true] {
        match file.try_lock() {
            Ok(()) => break,
            Err(TryLockError::WouldBlock) if last => {
                return Err(WorkError::Locked(path.to_owned()));
            }
            // Whoever was killed just now, or is being started by another thread of its process,
            // may hold it for an instant more.
            Err(TryLockError::WouldBlock) => std::thread::sleep(LOCK_PATIENCE),
            Err(TryLockError::Error(source)) => return Err(at(path)(source)),
        }
    }
    Ok(file)
}

fn open_cpu(path: &Path) -> io::Result<(File, f64)> {
    let options = File::options().read(true).write(true).create(true).truncate(false).open(path);
    let file = options?;
    let mut bytes = [0; 8];
    // Missing or torn: only a figure is lost.
    let seconds = files::read_at(&file, &mut bytes, 0).map_or(0.0, |()| f64::from_le_bytes(bytes));
    Ok((file, if seconds.is_finite() { seconds.max(0.0) } else { 0.0 }))
}

pub(super) fn header_digest(header: &Header) -> [u8; 32] {
    let mut hasher = blake3::Hasher::new();
    hasher.update(&header.format.to_le_bytes());
    for (name, value) in &header.inputs {
        hasher.update(name.as_bytes()).update(b"=").update(value.as_bytes()).update(b"\n");
    }
    *hasher.finalize().as_bytes()
}

//! The handle that a game keeps: connect, ask how it goes, make characters, close.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use protocol::message::TagOutcome;
use protocol::{GarmentId, PublisherKey, StateId, VersionNumber};
use tokio::sync::Notify;

use crate::character::Character;
use crate::driver::{self, Fingerprint};
use crate::loader::{FirstCloth, Memory};
use crate::prefetch::Horizon;
use crate::scene::Scene;
use crate::shared::Stage;
use crate::version::Version;

/// Bytes of streamed regions that a garment's cache holds by default: at about 300 bytes a state
/// some 14,000 states, and with an initial graph of a few thousand well under 8 MB in all.
pub const CACHE_BYTES_DEFAULT: usize = 4 << 20;

/// How to reach a server, and what for.
#[derive(Debug, Clone)]
pub struct ClientConfig {
    /// `host:port` of the server's QUIC socket.
    pub address: String,
    /// SHA-256 of the server's certificate in hexadecimal (colons are allowed). Without it the
    /// first certificate that the server shows is trusted, and from then on no other: enough on
    /// a machine of one's own, not elsewhere.
    pub fingerprint: Option<String>,
    /// Lets the client in, where the server asks for a token.
    pub token: Option<String>,
    /// The only publisher whose versions are played. Without it the first that the server names.
    pub publisher: Option<PublisherKey>,
    /// Garments to play, by name; none: all.
    pub garments: Vec<String>,
    /// Streamed regions that the cache of each garment may hold, in bytes, the initial graph
    /// apart. Default [`CACHE_BYTES_DEFAULT`].
    pub cache_bytes: usize,
    /// How far to look ahead of each character.
    pub horizon: Horizon,
    /// Spreads the reconnections of many clients; any number that differs between them.
    pub jitter_seed: u64,
    /// The only version to play, for looking at what was; `None`: always the newest.
    pub version: Option<VersionNumber>,
}

impl ClientConfig {
    /// The defaults for a server at `host:port`.
    pub fn new(address: impl Into<String>) -> Self {
        Self {
            address: address.into(),
            fingerprint: None,
            token: None,
            publisher: None,
            garments: Vec::new(),
            cache_bytes: CACHE_BYTES_DEFAULT,
            horizon: Horizon::default(),
            jitter_seed: 0,
            version: None,
        }
    }
}

/// Why the client cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ClientError {
    /// The fingerprint cannot be read.
    #[error(
        "\"{0}\" is no fingerprint: it takes the 64 hexadecimal digits that the server prints \
         when it starts"
    )]
    BadFingerprint(String),
    /// The background thread could not be started.
    #[error("the network thread could not be started: {0}")]
    NoThread(String),
    /// Something that trying again does not mend.
    #[error("{0}")]
    Refused(String),
    /// Nothing to play within the time given.
    #[error("no version to play after {waited:?}; {detail}")]
    NotReady {
        /// How long was waited.
        waited: Duration,
        /// What is known about why.
        detail: String,
    },
    /// A garment that is not there.
    #[error("no garment \"{garment}\" to play; there are: {known}")]
    NoGarment {
        /// The one asked for.
        garment: String,
        /// Those that are ready.
        known: String,
    },
}

/// How it goes.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Status {
    /// Whether the line is up and the server has let us in.
    pub connected: bool,
    /// The newest version that all its garments play.
    pub version: Option<VersionNumber>,
    /// What the first cloth was shown with, where that was before the basis was whole.
    pub first_cloth: Option<FirstCloth>,
    /// Versions taken up so far.
    pub versions_applied: u64,
    /// Whose versions are played.
    pub publisher: Option<PublisherKey>,
    /// UDP payload received so far.
    pub bytes_received: u64,
    /// Memory of all garments together.
    pub memory: Memory,
    /// Chunks that are being fetched.
    pub wanted: usize,
    /// The last failure, if it has not been mended since.
    pub error: Option<String>,
    /// Whether the client has given up.
    pub is_final: bool,
}

impl Status {
    /// Memory held for playing, the basis, links and scene apart.
    pub fn resident_bytes(&self) -> usize {
        self.memory.regions
    }
}

/// What the handle and its thread share.
#[derive(Debug, Default)]
pub(crate) struct Shared {
    state: Mutex<State>,
    changed: Condvar,
    /// Wakes the driver.
    pub wake: Notify,
    pub quit: AtomicBool,
    /// Counts requests for a plan, and up to which of them everything is here.
    pub asked: AtomicU64,
}

#[derive(Debug, Default)]
struct State {
    status: Status,
    stages: BTreeMap<String, Arc<Stage>>,
    answered: u64,
    /// Tags to be set, and answers to those that were.
    tags: Vec<(GarmentId, StateId)>,
    tagged: Vec<(GarmentId, StateId, TagOutcome)>,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Changes the status and wakes whoever waits for it.
    pub fn update(&self, change: impl FnOnce(&mut Status)) {
        change(&mut self.lock().status);
        self.changed.notify_all();
    }

    /// A garment that can be played from now on.
    pub fn add_stage(&self, garment: &str, stage: &Arc<Stage>) {
        self.lock().stages.insert(garment.to_owned(), Arc::clone(stage));
        self.changed.notify_all();
    }

    /// Everything that request `asked` needed is here.
    pub fn answer(&self, asked: u64) {
        let mut state = self.lock();
        if state.answered < asked {
            state.answered = asked;
            self.changed.notify_all();
        }
    }

    /// Tags that were asked for since the last look.
    pub fn take_tags(&self) -> Vec<(GarmentId, StateId)> {
        std::mem::take(&mut self.lock().tags)
    }

    /// What became of a tag.
    pub fn answer_tag(&self, garment: GarmentId, state: StateId, outcome: TagOutcome) {
        self.lock().tagged.push((garment, state, outcome));
        self.changed.notify_all();
    }

    /// Waits until `done` gives something, or the time is over.
    fn wait<T>(&self, timeout: Duration, done: impl Fn(&State) -> Option<T>) -> Option<T> {
        // Longer than clocks go: for ever.
        let end = Instant::now().checked_add(timeout);
        let mut state = self.lock();
        loop {
            if let Some(found) = done(&state) {
                return Some(found);
            }
            let Some(end) = end else {
                state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
                continue;
            };
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return None;
            }
            state =
                self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

/// A connection to a server, with its thread. The thread ends when this is closed or dropped.
#[derive(Debug)]
pub struct Client {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

impl Client {
    /// Starts connecting, and goes on by itself: it reconnects, streams and takes up versions.
    ///
    /// # Errors
    /// A fingerprint that cannot be read, or a system out of threads. Failures of the network
    /// are told by [`Client::status`] and [`Client::wait_ready`].
    pub fn connect(config: ClientConfig) -> Result<Self, ClientError> {
        let fingerprint = match &config.fingerprint {
            None => None,
            Some(text) => Some(
                Fingerprint::parse(text)
                    .ok_or_else(|| ClientError::BadFingerprint(text.clone()))?,
            ),
        };
        let shared = Arc::new(Shared::default());
        let for_thread = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name("toile-client".to_owned())
            .spawn(move || driver::run(config, fingerprint, &for_thread))
            .map_err(|e| ClientError::NoThread(e.to_string()))?;
        Ok(Self { shared, thread: Some(thread) })
    }

    /// Waits until there is a version to play, with its initial graph resident.
    ///
    /// # Errors
    /// The server refuses us, or the time is over; the message says what is known.
    pub fn wait_ready(&self, timeout: Duration) -> Result<(), ClientError> {
        let outcome = self.shared.wait(timeout, |state| {
            if state.status.version.is_some() {
                return Some(Ok(()));
            }
            let status = &state.status;
            let refused = || status.error.clone().unwrap_or_else(|| "closed".to_owned());
            status.is_final.then(|| Err(ClientError::Refused(refused())))
        });
        outcome.unwrap_or_else(|| {
            let status = self.status();
            let detail = match status.error {
                Some(error) => error,
                None if status.connected => format!(
                    "the server has let us in, but has published no version that is complete \
                     ({} chunks are awaited)",
                    status.wanted
                ),
                None => "the server has not answered".to_owned(),
            };
            Err(ClientError::NotReady { waited: timeout, detail })
        })
    }

    /// Waits until there is cloth to show, if only with the leading columns of the basis, or the
    /// time is over; says which. Steps are counted as substituted until the basis is whole.
    pub fn wait_first_cloth(&self, timeout: Duration) -> bool {
        let done = |state: &State| (!state.stages.is_empty()).then_some(());
        self.shared.wait(timeout, done).is_some()
    }

    /// Waits until what can be needed within the horizon ahead of all characters is resident, or
    /// the time is over; says which. For tools that play faster than real time: an engine has no
    /// use for it.
    pub fn wait_ahead(&self, timeout: Duration) -> bool {
        let asked = self.shared.asked.fetch_add(1, Ordering::SeqCst) + 1;
        self.shared.wake.notify_one();
        let done = |state: &State| {
            let gone = state.status.is_final;
            (gone || state.answered >= asked).then_some(!gone)
        };
        self.shared.wait(timeout, done).unwrap_or(false)
    }

    /// Waits until a version of at least this number is being offered to all characters.
    pub fn wait_version(&self, number: VersionNumber, timeout: Duration) -> bool {
        let done = |state: &State| (state.status.version >= Some(number)).then_some(());
        self.shared.wait(timeout, done).is_some()
    }

    /// Asks that the explorer simulate at a dead end next, and waits for the server's answer; `None`
    /// where none came in time. Takes a token with that right. For tools, not for a frame loop.
    pub fn wait_tagged(
        &self,
        garment: GarmentId,
        state: StateId,
        timeout: Duration,
    ) -> Option<TagOutcome> {
        let is_it =
            move |tag: &&(GarmentId, StateId, TagOutcome)| (tag.0, tag.1) == (garment, state);
        {
            let mut shared = self.shared.lock();
            shared.tagged.retain(|tag| !is_it(&tag));
            shared.tags.push((garment, state));
        }
        self.shared.wake.notify_one();
        self.shared.wait(timeout, |state| state.tagged.iter().find(is_it).map(|tag| tag.2))
    }

    /// How it goes.
    pub fn status(&self) -> Status {
        self.shared.lock().status.clone()
    }

    /// Names of the garments that can be played, sorted.
    pub fn garments(&self) -> Vec<String> {
        self.shared.lock().stages.keys().cloned().collect()
    }

    /// A character in a garment; `None`: the first by name.
    ///
    /// # Errors
    /// The garment is not there, or not ready.
    pub fn character(&self, garment: Option<&str>) -> Result<Character, ClientError> {
        let stage = self.stage(garment)?;
        Character::enter(&stage).ok_or_else(|| self.no_garment(garment))
    }

    /// The version of a garment that is offered to characters now.
    ///
    /// # Errors
    /// The garment is not there, or not ready.
    pub fn version(&self, garment: Option<&str>) -> Result<Arc<Version>, ClientError> {
        let view = self.stage(garment)?.view().ok_or_else(|| self.no_garment(garment))?;
        Ok(Arc::clone(&view.version))
    }

    /// The character and its primary graph.
    ///
    /// # Errors
    /// The garment is not there, or not ready.
    pub fn scene(&self, garment: Option<&str>) -> Result<Arc<Scene>, ClientError> {
        Ok(Arc::clone(self.version(garment)?.scene()))
    }

    /// Says goodbye to the server and waits for the thread to end, at most about a second.
    /// Characters can be played on with what they have.
    pub fn close(mut self) {
        self.end();
    }

    fn stage(&self, garment: Option<&str>) -> Result<Arc<Stage>, ClientError> {
        let state = self.shared.lock();
        let stage = match garment {
            Some(garment) => state.stages.get(garment),
            None => state.stages.values().next(),
        };
        let stage = stage.cloned();
        drop(state);
        stage.ok_or_else(|| self.no_garment(garment))
    }

    fn no_garment(&self, garment: Option<&str>) -> ClientError {
        let known = self.garments();
        let known = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
        ClientError::NoGarment { garment: garment.unwrap_or("(any)").to_owned(), known }
    }

    fn end(&mut self) {
        self.shared.quit.store(true, Ordering::SeqCst);
        self.shared.wake.notify_one();
        if let Some(thread) = self.thread.take() {
            // The thread catches its own failures; a panic in it has been printed.
            let _ = thread.join();
        }
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        self.end();
    }
}

//! One player's connection: drives the session machine of `protocol` over quinn.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use bytes::Bytes;
use protocol::frame::chunk_head;
use protocol::message::{CloseCode, Priority, TagOutcome, Telemetry};
use protocol::session::{Server as Machine, ServerConfig, ServerEvent};
use protocol::{ChunkHash, GarmentId, SignedManifest, StateId, VersionNumber, limits};
use quinn::{Connection, RecvStream, SendStream, VarInt};
use tokio::sync::oneshot;
use tokio::task::JoinSet;

use crate::shared::{Head, Shared, lock};
use crate::store::ReadError;
use crate::tags;

/// Chunks sent at the same time to one player; what is urgent gets a few more places.
const SENDS_MAX: usize = 16;
const URGENT_SENDS_MAX: usize = 24;
/// Bytes read from the control stream at once.
const READ_BYTES: usize = 16 << 10;
/// How long the last words may take.
const LAST_WORDS: Duration = Duration::from_millis(500);
/// A store that fails is asked again after these pauses. If it fails altogether, the session then ends,
/// and the client comes back.
const STORE_PAUSES: [Duration; 4] = [
    Duration::from_millis(100),
    Duration::from_millis(200),
    Duration::from_millis(400),
    Duration::from_millis(800),
];

/// Serves one player until either side ends it.
pub(crate) async fn serve(shared: Arc<Shared>, connection: Connection) {
    let limit = Duration::from_micros(limits::HANDSHAKE_US_MAX);
    let Ok(streams) = tokio::time::timeout(limit, connection.accept_bi()).await else {
        shared.metrics.broken_sessions.inc();
        if let Some(more) = shared.logs.sessions.may_write() {
            tracing::warn!(from = %connection.remote_address(), more, "no control stream in time");
        }
        let code = CloseCode::HandshakeTimeout.number();
        return connection.close(VarInt::from_u32(code), b"no control stream in time");
    };
    // The connection was lost before it said anything: nothing to tell.
    let Ok((control, messages)) = streams else { return };
    // Control overtakes every chunk.
    let _ = control.set_priority(i32::MAX);
    let (token, tag_token) = (shared.token.clone(), shared.tag_token.clone());
    let machine = Machine::new(ServerConfig { token, tag_token }, shared.now());
    let machine = machine.sharing(shared.deliveries.clone());
    let session = Session {
        shared,
        connection,
        machine,
        player: None,
        unsent: Arc::default(),
        sent: 0,
        waiting: BTreeSet::new(),
        sending: HashMap::new(),
        tasks: JoinSet::new(),
        serial: 0,
        closed: None,
    };
    session.run(control, messages).await;
}

struct Session {
    shared: Arc<Shared>,
    connection: Connection,
    machine: Machine,
    /// Once let in.
    player: Option<Player>,
    /// For the control stream, which has taken this much of it.
    unsent: Arc<[u8]>,
    sent: usize,
    /// Chunks asked for, not yet being sent.
    waiting: BTreeSet<(Priority, u64, ChunkHash)>,
    sending: HashMap<ChunkHash, Sending>,
    tasks: JoinSet<Done>,
    serial: u64,
    closed: Option<(CloseCode, String)>,
}

struct Sending {
    serial: u64,
    /// Dropped to stop it.
    _cancel: oneshot::Sender<()>,
}

enum Done {
    Base(Option<Arc<SignedManifest>>),
    Pinned(VersionNumber, Option<Arc<SignedManifest>>),
    Tagged(GarmentId, StateId, TagOutcome),
    Chunk { hash: ChunkHash, serial: u64, sent: Sent },
}

/// What became of a chunk.
enum Sent {
    /// It is on its way whole, or the connection or the wish for it is gone.
    Whole,
    /// There is no such chunk, or only one that cannot be read.
    Missing,
    /// The store fails, again and again.
    Failed,
}

impl Session {
    async fn run(mut self, mut control: SendStream, mut messages: RecvStream) {
        let mut head = self.shared.head.subscribe();
        let mut stop = self.shared.stop.subscribe();
        loop {
            self.act();
            if self.closed.is_some() {
                break;
            }
            let timeout = self
                .machine
                .poll_timeout()
                .map(|time| Duration::from_micros(time.0.saturating_sub(self.shared.now().0)));
            tokio::select! {
                read = messages.read_chunk(READ_BYTES, true) => match read {
                    Ok(Some(chunk)) => {
                        self.machine.handle_control(self.shared.now(), &chunk.bytes);
                    }
                    Ok(None) => self.machine.close(CloseCode::Done, "the control stream ended"),
                    Err(_) => return,
                },
                written = control.write(&self.unsent[self.sent..]), if !self.is_written() => {
                    let Ok(count) = written else { return };
                    self.sent += count;
                    self.shared.metrics.bytes_sent.inc_by(count as u64);
                }
                Some(done) = self.tasks.join_next(), if !self.tasks.is_empty() => {
                    // A task that panicked has said so; its chunk is not answered.
                    if let Ok(done) = done {
                        self.finish(done);
                    }
                }
                Ok(()) = head.changed() => {
                    let head = head.borrow_and_update().clone();
                    self.hand_head(&head);
                }
                _ = stop.wait_for(|stop| *stop) => {
                    self.machine.close(CloseCode::ShuttingDown, "the server is going down");
                }
                () = tokio::time::sleep(timeout.unwrap_or_default()), if timeout.is_some() => {
                    self.machine.handle_timeout(self.shared.now());
                }
            }
        }
        self.say_last_words(&mut control).await;
    }

    /// Does what the machine says until it has nothing more to say.
    fn act(&mut self) {
        while let Some(event) = self.machine.poll_event() {
            self.handle(event);
        }
        self.start_sends();
        if self.is_written()
            && let Some(bytes) = self.machine.poll_transmit()
        {
            (self.unsent, self.sent) = (bytes, 0);
        }
    }

    /// Whether the control stream has taken all there was.
    fn is_written(&self) -> bool {
        self.sent == self.unsent.len()
    }

    fn handle(&mut self, event: ServerEvent) {
        match event {
            ServerEvent::Open { .. } => self.let_in(),
            ServerEvent::Base(number) => self.find_base(number),
            ServerEvent::Pin(number) => self.find_pinned(number),
            ServerEvent::Tag { garment, state } => {
                let shared = self.shared.clone();
                self.tasks.spawn(async move {
                    let outcome = tags::keep(&shared, garment, state).await;
                    Done::Tagged(garment, state, outcome)
                });
            }
            ServerEvent::Send { hash, priority } => {
                self.waiting.retain(|(_, _, waiting)| *waiting != hash);
                if !self.sending.contains_key(&hash) {
                    self.serial += 1;
                    self.waiting.insert((priority, self.serial, hash));
                }
            }
            ServerEvent::Cancel { hash } => {
                self.waiting.retain(|(_, _, waiting)| *waiting != hash);
                self.sending.remove(&hash);
            }
            ServerEvent::Applied(version) => {
                if let Some(player) = &self.player {
                    lock(&self.shared.players).insert(player.number, Some(version));
                }
            }
            ServerEvent::Telemetry { telemetry, dropped } => self.count(&telemetry, dropped),
            ServerEvent::Outside { steps } => {
                self.shared.metrics.outside.inc_by(steps.into());
            }
            ServerEvent::Closed { code, message } => self.closed = Some((code, message)),
        }
    }

    fn let_in(&mut self) {
        match Player::enter(&self.shared) {
            Some(player) => {
                self.player = Some(player);
                let head = self.shared.head.borrow().clone();
                self.hand_head(&head);
            }
            None => {
                self.shared.metrics.refused_connections.inc();
                self.machine.close(CloseCode::Full, "the server is full");
            }
        }
    }

    fn hand_head(&mut self, head: &Head) {
        if let Some(publisher) = head.publisher {
            self.machine.handle_publisher(publisher);
        }
        if let Some(signed) = &head.signed {
            self.machine.handle_head(signed);
        }
    }

    fn find_base(&mut self, number: VersionNumber) {
        let head = self.shared.head.borrow().clone();
        let is_head = |signed: &Arc<SignedManifest>| signed.manifest.number == number;
        if let Some(signed) = head.signed.filter(is_head) {
            return self.machine.handle_base(Some(signed));
        }
        let Some(publisher) = head.publisher else { return self.machine.handle_base(None) };
        let shared = self.shared.clone();
        self.tasks.spawn(async move {
            // Whatever is wrong with an old version, the whole head will do.
            Done::Base(shared.source.version(number, &publisher).await.ok().flatten())
        });
    }

    fn find_pinned(&mut self, number: VersionNumber) {
        let Some(publisher) = self.shared.head.borrow().publisher else {
            return self.machine.handle_pinned(number, None);
        };
        let shared = self.shared.clone();
        self.tasks.spawn(async move {
            let found = shared.source.version(number, &publisher).await;
            Done::Pinned(number, found.ok().flatten())
        });
    }

    fn start_sends(&mut self) {
        while let Some(&(priority, serial, hash)) = self.waiting.first() {
            let is_urgent = priority <= Priority::Urgent;
            let places = if is_urgent { URGENT_SENDS_MAX } else { SENDS_MAX };
            if self.sending.len() >= places {
                return;
            }
            self.waiting.pop_first();
            let (cancel, cancelled) = oneshot::channel();
            self.sending.insert(hash, Sending { serial, _cancel: cancel });
            let (shared, connection) = (self.shared.clone(), self.connection.clone());
            self.tasks.spawn(async move {
                // Whatever it waits for: a place that is given up must hold nothing.
                let sent = tokio::select! {
                    sent = send(&shared, &connection, &hash, priority) => sent,
                    _ = cancelled => Sent::Whole,
                };
                Done::Chunk { hash, serial, sent }
            });
        }
    }

    fn finish(&mut self, done: Done) {
        match done {
            Done::Base(manifest) => self.machine.handle_base(manifest),
            Done::Pinned(number, manifest) => self.machine.handle_pinned(number, manifest),
            Done::Tagged(garment, state, outcome) => {
                self.machine.handle_tagged(garment, state, outcome);
            }
            Done::Chunk { hash, serial, sent } => {
                // A cancelled chunk may be on its way a second time already.
                if self.sending.get(&hash).is_some_and(|sending| sending.serial == serial) {
                    self.sending.remove(&hash);
                    match sent {
                        Sent::Whole => self.machine.handle_sent(&hash),
                        Sent::Missing => self.machine.handle_missing(&hash),
                        Sent::Failed => {
                            self.machine.close(CloseCode::Internal, "the store cannot be read");
                        }
                    }
                }
            }
        }
    }

    fn count(&self, telemetry: &Telemetry, dropped: u64) {
        let Some(player) = self.player.as_ref().map(|player| player.number) else { return };
        let edge_count = self.shared.edge_count(telemetry.garment);
        let (counted, stray) = lock(&self.shared.counts).add(player, telemetry, edge_count);
        let metrics = &self.shared.metrics;
        metrics.traversals.inc_by(counted);
        metrics.traversals_dropped.inc_by(dropped + stray);
        metrics.exact.inc_by(telemetry.exact.into());
        metrics.substituted.inc_by(telemetry.substituted.into());
        metrics.missed.inc_by(telemetry.missed.into());
        metrics.jumps.inc_by(telemetry.jumps.into());
    }

    /// Lets the client read why, then closes.
    async fn say_last_words(mut self, control: &mut SendStream) {
        let (code, message) = self.closed.take().expect("the machine has closed");
        let from = self.connection.remote_address();
        let logs = &self.shared.logs.sessions;
        match code {
            CloseCode::Done | CloseCode::ShuttingDown => tracing::debug!(%from, "{message}"),
            CloseCode::TokenRefused => {
                self.shared.metrics.refused_tokens.inc();
                if let Some(more) = logs.may_write() {
                    tracing::warn!(%from, more, "refused: {message}");
                }
            }
            CloseCode::Full => {
                if let Some(more) = logs.may_write() {
                    tracing::warn!(%from, more, "refused: {message}");
                }
            }
            // Our own fault: it was counted and said where the store failed.
            CloseCode::Internal => tracing::debug!(%from, "session ended: {message}"),
            _ => {
                self.shared.metrics.broken_sessions.inc();
                if let Some(more) = logs.may_write() {
                    tracing::warn!(%from, ?code, more, "session ended: {message}");
                }
            }
        }
        let last_words = async {
            control.write_all(&self.unsent[self.sent..]).await?;
            while let Some(bytes) = self.machine.poll_transmit() {
                control.write_all(&bytes).await?;
            }
            // Fails only if it is finished already.
            let _ = control.finish();
            let _ = control.stopped().await;
            Ok::<(), quinn::WriteError>(())
        };
        // The close itself carries the same words, should these not arrive.
        let _ = tokio::time::timeout(LAST_WORDS, last_words).await;
        self.connection.close(VarInt::from_u32(code.number()), message.as_bytes());
    }
}

/// Sends a chunk on a stream of its own. Dropped on the way, it resets the stream.
async fn send(
    shared: &Shared,
    connection: &Connection,
    hash: &ChunkHash,
    priority: Priority,
) -> Sent {
    let bytes = match read(shared, hash).await {
        Ok(bytes) => bytes,
        // This chunk alone cannot be read, or none can.
        Err(ReadError::Store { .. }) if lock(&shared.failing).is_some() => return Sent::Failed,
        Err(_) => return Sent::Missing,
    };
    let Ok(stream) = connection.open_uni().await else { return Sent::Whole };
    let mut stream = ChunkStream { stream, is_whole: false };
    let _ = stream.stream.set_priority(-(priority as i32));
    let head = chunk_head(hash, bytes.len() as u32);
    let payload = head.len() + bytes.len();
    let written = async {
        stream.stream.write_all(&head).await?;
        stream.stream.write_chunk(bytes).await
    };
    // Where it fails, the connection or the stream is gone.
    if written.await.is_ok() {
        stream.is_whole = true;
        let _ = stream.stream.finish();
        shared.metrics.chunks_sent.inc();
        shared.metrics.bytes_sent.inc_by(payload as u64);
    }
    Sent::Whole
}

/// Reads a chunk; has patience with a store that fails.
async fn read(shared: &Shared, hash: &ChunkHash) -> Result<Bytes, ReadError> {
    let mut pauses = STORE_PAUSES.into_iter();
    loop {
        let read = shared.chunk(hash).await;
        if let Err(error) = &read {
            count_failure(shared, error);
        }
        let pause = match &read {
            Err(ReadError::Store { .. }) => pauses.next(),
            _ => None,
        };
        let Some(pause) = pause else { return read };
        tokio::time::sleep(pause).await;
    }
}

/// A stream that was not written to its end is reset: dropping it would end it as if it were whole.
struct ChunkStream {
    stream: SendStream,
    is_whole: bool,
}

impl Drop for ChunkStream {
    fn drop(&mut self) {
        if !self.is_whole {
            let _ = self.stream.reset(VarInt::from_u32(CloseCode::Done.number()));
        }
    }
}

/// Counts and logs why a chunk was not served.
pub(crate) fn count_failure(shared: &Shared, error: &ReadError) {
    let counter = match error {
        ReadError::Missing(_) => {
            shared.metrics.chunks_missing.inc();
            // Anybody may ask for any hash.
            return tracing::debug!(%error, "chunk not served");
        }
        ReadError::Corrupted { .. } => &shared.metrics.chunks_corrupted,
        _ => &shared.metrics.store_failures,
    };
    counter.inc();
    if let Some(more) = shared.logs.chunks.may_write() {
        tracing::warn!(%error, more, "chunk not served");
    }
}

/// A place among the players, left when dropped.
struct Player {
    shared: Arc<Shared>,
    number: u64,
}

impl Player {
    fn enter(shared: &Arc<Shared>) -> Option<Self> {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let mut players = lock(&shared.players);
        if players.len() >= shared.players_max {
            return None;
        }
        players.insert(number, None);
        shared.metrics.players.set(players.len() as i64);
        Some(Self { shared: shared.clone(), number })
    }
}

impl Drop for Player {
    fn drop(&mut self) {
        let mut players = lock(&self.shared.players);
        players.remove(&self.number);
        self.shared.metrics.players.set(players.len() as i64);
    }
}

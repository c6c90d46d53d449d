//! The client's side.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use super::error::SessionError;
use super::wants::{Change, Wants};
use super::{Allowance, Time};
use crate::difference::ManifestDifference;
use crate::frame::{CHUNK_HEAD_BYTES, FrameDecoder, frame, parse_chunk_head};
use crate::ids::{ChunkHash, GarmentId, StateId, VersionNumber};
use crate::limits;
use crate::manifest::{ChunkRef, SignedManifest};
use crate::message::{
    ClientMessage, CloseCode, Have, Hello, PROTOCOL, Priority, ServerMessage, TagOutcome, Telemetry,
};
use crate::sign::PublisherKey;

/// How a client introduces itself.
#[derive(Debug, Clone, Default)]
pub struct ClientConfig {
    /// Shown to the server.
    pub token: Option<String>,
    /// Garments that it plays, by name; none: all.
    pub garments: Vec<String>,
    /// The only publisher whose manifests are accepted. `None` trusts the first that the server
    /// names, and from then on no other.
    pub publisher: Option<PublisherKey>,
    /// Spreads the reconnections of many clients; any number that differs between them.
    pub jitter_seed: u64,
    /// The only version that is wanted; `None`: always the newest.
    pub pin: Option<VersionNumber>,
}

/// What the driver has to do, or hand to the player.
#[derive(Debug, Clone, PartialEq)]
pub enum ClientEvent {
    /// Dial the server now: answer by [`Client::handle_connected`] or
    /// [`Client::handle_disconnected`]. Any earlier connection must be gone.
    Connect,
    /// The server has let us in.
    Welcome,
    /// A new version: verified, newer than the one before.
    Version(Arc<SignedManifest>),
    /// A chunk that was wanted; its bytes are what its hash says.
    Chunk {
        /// Its name.
        hash: ChunkHash,
        /// Its bytes.
        bytes: Vec<u8>,
    },
    /// The server does not have this chunk. It is no longer wanted.
    Missing {
        /// Its name.
        hash: ChunkHash,
    },
    /// What became of a tag.
    Tagged {
        /// The garment.
        garment: GarmentId,
        /// The dead end.
        state: StateId,
        /// The server's answer.
        outcome: TagOutcome,
    },
    /// Close the connection (with this code) if it is still there. Unless the reason
    /// [is final](SessionError::is_final), a `Connect` follows after a while, and everything that
    /// is still wanted is asked for again.
    Disconnect {
        /// Why.
        reason: SessionError,
    },
}

/// The client's side of the conversation. Lives across reconnections: it remembers the manifest
/// and everything that is wanted.
///
/// See the [module](super) for how to drive it.
#[derive(Debug)]
pub struct Client {
    config: ClientConfig,
    link: Link,
    /// Connections in a row that did not last.
    failures: u32,
    opened: Option<Time>,
    random: u64,
    publisher: Option<PublisherKey>,
    manifest: Option<Arc<SignedManifest>>,
    /// The last difference did not fit: ask for the whole manifest.
    whole: bool,
    applied: Option<VersionNumber>,
    frames: FrameDecoder,
    wants: Wants,
    /// Chunk streams that have begun.
    incoming: BTreeMap<u64, Incoming>,
    outbox: VecDeque<ClientMessage>,
    pace: Allowance,
    events: VecDeque<ClientEvent>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Link {
    Waiting { until: Time },
    Connecting,
    Hello { deadline: Time },
    Answer { deadline: Time },
    Open,
    Closed,
}

#[derive(Debug, Default)]
struct Incoming {
    /// Head, then the chunk.
    bytes: Vec<u8>,
    /// What it brings, once its head is here and as long as somebody waits for it.
    hash: Option<ChunkHash>,
    /// Nobody waits for it any more.
    discard: bool,
}

impl Incoming {
    fn discarded() -> Self {
        Self { discard: true, ..Self::default() }
    }
}

impl Client {
    /// Asks to be connected as soon as [`Client::handle_timeout`] is called.
    pub fn new(config: ClientConfig) -> Self {
        Self {
            publisher: config.publisher,
            random: config.jitter_seed,
            config,
            link: Link::Waiting { until: Time(0) },
            failures: 0,
            opened: None,
            manifest: None,
            whole: false,
            applied: None,
            frames: FrameDecoder::new(ServerMessage::BYTES_MAX),
            wants: Wants::default(),
            incoming: BTreeMap::new(),
            outbox: VecDeque::new(),
            pace: client_pace(),
            events: VecDeque::new(),
        }
    }

    /// The connection stands and the control stream is open.
    pub fn handle_connected(&mut self, now: Time) {
        if self.link == Link::Connecting {
            self.frames = FrameDecoder::new(ServerMessage::BYTES_MAX);
            self.link = Link::Hello { deadline: now.after_us(limits::HANDSHAKE_US_MAX) };
        }
    }

    /// The connection could not be made, or was lost.
    ///
    /// `close`: error code and text of the server's close, where there was one.
    pub fn handle_disconnected(&mut self, now: Time, close: Option<(u64, &str)>, why: &str) {
        if matches!(self.link, Link::Waiting { .. } | Link::Closed) {
            return;
        }
        let code = close.and_then(|(code, _)| CloseCode::from_number(code));
        let reason = match (code, close) {
            (Some(code), Some((_, text))) => {
                SessionError::Closed { code, message: text.to_string() }
            }
            _ => SessionError::Lost(why.to_string()),
        };
        self.disconnect(now, reason);
    }

    /// Bytes from the control stream.
    pub fn handle_control(&mut self, now: Time, bytes: &[u8]) {
        if !self.is_talking() {
            return;
        }
        self.frames.push(bytes);
        while self.is_talking() {
            let result = match self.frames.poll() {
                Ok(None) => return,
                Ok(Some(message)) => self.handle_message(now, &message),
                Err(error) => Err(error.into()),
            };
            if let Err(reason) = result {
                self.disconnect(now, reason);
            }
        }
    }

    /// Bytes from one of the server's unidirectional streams.
    ///
    /// * `stream`: its number, in the order in which the server opened the connection's streams. Of two
    ///   that bring the same chunk, the later one counts: the other was cancelled.
    /// * `end`: no more bytes will follow.
    pub fn handle_chunk(&mut self, now: Time, stream: u64, bytes: &[u8], end: bool) {
        if !self.is_talking() {
            return;
        }
        if let Err(reason) = self.receive(stream, bytes, end) {
            self.disconnect(now, reason);
        }
    }

    /// The server has cut this stream; its chunk is asked for again if it is still wanted.
    pub fn handle_chunk_reset(&mut self, stream: u64) {
        let hash = self.incoming.remove(&stream).and_then(|incoming| incoming.hash);
        hash.iter().for_each(|hash| self.wants.ask_again(hash));
    }

    /// Time has passed.
    pub fn handle_timeout(&mut self, now: Time) {
        match self.link {
            Link::Waiting { until } if now >= until => {
                self.link = Link::Connecting;
                self.events.push_back(ClientEvent::Connect);
            }
            Link::Hello { deadline } | Link::Answer { deadline } if now >= deadline => {
                self.disconnect(now, SessionError::HandshakeTimeout);
            }
            _ => {}
        }
    }

    /// Asks for a chunk, or changes the priority of one that is wanted already. It is remembered
    /// across reconnections until it arrives, is [missing](ClientEvent::Missing) or cancelled.
    ///
    /// Says `false` when `WANTS_MAX` chunks are wanted already.
    #[must_use]
    pub fn want(&mut self, chunk: ChunkRef, priority: Priority) -> bool {
        match self.wants.want(chunk, priority) {
            Change::Full => return false,
            Change::Queued => {}
            Change::AskAgain => {
                self.say(ClientMessage::Fetch { hash: chunk.hash, priority });
            }
        }
        true
    }

    /// No longer wanted.
    pub fn cancel(&mut self, hash: ChunkHash) {
        if self.wants.forget(&hash) {
            self.say(ClientMessage::Cancel { hash });
        }
    }

    /// This version is being played now.
    pub fn applied(&mut self, version: VersionNumber) {
        self.applied = Some(version);
        if self.link == Link::Open {
            self.say(ClientMessage::Applied { version });
        }
    }

    /// Reports what was seen. Long reports are split; while the line is down up to `OUTBOX_MAX`
    /// reports are kept, then new ones are dropped.
    pub fn report(&mut self, mut telemetry: Telemetry) {
        while telemetry.edges.len() > limits::TELEMETRY_EDGES_MAX {
            let at = telemetry.edges.len() - limits::TELEMETRY_EDGES_MAX;
            let edges = telemetry.edges.split_off(at);
            let part =
                Telemetry { edges, exact: 0, substituted: 0, missed: 0, jumps: 0, ..telemetry };
            self.say(ClientMessage::Telemetry(part));
        }
        self.say(ClientMessage::Telemetry(telemetry));
    }

    /// Reports steps outside the graph, where there were any.
    pub fn report_outside(&mut self, garment: GarmentId, version: VersionNumber, steps: u32) {
        if steps > 0 {
            self.say(ClientMessage::Outside { garment, version, steps });
        }
    }

    /// Asks that the explorer simulate at this dead end next; answered by [`ClientEvent::Tagged`]. Says
    /// `false`, and nothing else, while the line is down.
    pub fn tag(&mut self, garment: GarmentId, state: StateId) -> bool {
        let open = self.link == Link::Open;
        if open {
            self.say(ClientMessage::Tag { garment, state });
        }
        open
    }

    /// Says bye after what is queued; ends in a final `Disconnect`.
    pub fn close(&mut self) {
        if self.link == Link::Open {
            self.outbox.push_back(ClientMessage::Bye);
        } else if self.link != Link::Closed {
            self.link = Link::Closed;
            self.events.push_back(ClientEvent::Disconnect { reason: SessionError::Done });
        }
    }

    /// Bytes for the control stream.
    pub fn poll_transmit(&mut self, now: Time) -> Option<Vec<u8>> {
        if let Link::Hello { deadline } = self.link {
            self.link = Link::Answer { deadline };
            return Some(frame(&self.hello().encode()));
        }
        let idle = self.outbox.is_empty() && !self.wants.is_ready();
        if self.link != Link::Open || idle || self.pace.take(now, 1) == 0 {
            return None;
        }
        let message = self.outbox.pop_front().or_else(|| {
            let (hash, priority) = self.wants.ask()?;
            Some(ClientMessage::Fetch { hash, priority })
        })?;
        if message == ClientMessage::Bye {
            self.disconnect(now, SessionError::Done);
        }
        Some(frame(&message.encode()))
    }

    /// What to do next.
    pub fn poll_event(&mut self) -> Option<ClientEvent> {
        self.events.pop_front()
    }

    /// When to call [`Client::handle_timeout`] (and then poll) at the latest.
    pub fn poll_timeout(&self) -> Option<Time> {
        match self.link {
            Link::Waiting { until } => Some(until),
            Link::Hello { deadline } | Link::Answer { deadline } => Some(deadline),
            Link::Open if !self.outbox.is_empty() || self.wants.is_ready() => {
                Some(self.pace.ready_at())
            }
            Link::Open | Link::Connecting | Link::Closed => None,
        }
    }

    /// The newest version received.
    pub fn manifest(&self) -> Option<&Arc<SignedManifest>> {
        self.manifest.as_ref()
    }

    /// The pinned publisher, or the one that the server has named.
    pub fn publisher(&self) -> Option<PublisherKey> {
        self.publisher
    }

    /// Chunks wanted and not yet here.
    pub fn wanted(&self) -> usize {
        self.wants.len()
    }

    /// Whether the server has let us in and the line is up.
    pub fn is_open(&self) -> bool {
        self.link == Link::Open
    }

    fn is_talking(&self) -> bool {
        matches!(self.link, Link::Hello { .. } | Link::Answer { .. } | Link::Open)
    }

    fn hello(&self) -> ClientMessage {
        let have = self
            .manifest
            .as_ref()
            .filter(|_| !self.whole && self.config.pin.is_none())
            .map(|held| Have { version: held.manifest.number, hash: held.manifest.hash() });
        ClientMessage::Hello(Hello {
            protocol: PROTOCOL,
            token: self.config.token.clone(),
            garments: self.config.garments.clone(),
            have,
        })
    }

    /// Queues a message; drops it when the queue is full, which only reports can bring about.
    fn say(&mut self, message: ClientMessage) {
        let keeps = is_report(&message) || self.link == Link::Open;
        if keeps && self.outbox.len() < limits::OUTBOX_MAX {
            self.outbox.push_back(message);
        }
    }

    fn handle_message(&mut self, now: Time, bytes: &[u8]) -> Result<(), SessionError> {
        let message = ServerMessage::decode(bytes)?;
        let is_greeting =
            matches!(message, ServerMessage::Welcome { .. } | ServerMessage::Close { .. });
        if self.link != Link::Open && !is_greeting {
            return Err(SessionError::OutOfPlace("something before welcome"));
        }
        match message {
            ServerMessage::Welcome { .. } if self.link == Link::Open => {
                Err(SessionError::OutOfPlace("a second welcome"))
            }
            ServerMessage::Welcome { protocol, .. } if protocol != PROTOCOL => {
                Err(SessionError::OtherProtocol { found: protocol })
            }
            ServerMessage::Welcome { publisher, .. } => {
                publisher.map_or(Ok(()), |publisher| self.meet(publisher))?;
                self.link = Link::Open;
                self.opened = Some(now);
                self.events.push_back(ClientEvent::Welcome);
                if let Some(version) = self.config.pin {
                    self.say(ClientMessage::Pin { version });
                }
                if let Some(version) = self.applied {
                    self.say(ClientMessage::Applied { version });
                }
                Ok(())
            }
            ServerMessage::Publisher { publisher } => self.meet(publisher),
            ServerMessage::ManifestFull(bytes) => {
                let publisher = self.known_publisher()?;
                self.accept(SignedManifest::open(&bytes, &publisher)?)
            }
            // The head, said before the server had read our wish.
            ServerMessage::ManifestDifference(_) if self.config.pin.is_some() => Ok(()),
            ServerMessage::ManifestDifference(bytes) => {
                let publisher = self.known_publisher()?;
                let base = self.manifest.as_ref().filter(|_| !self.whole);
                let base = base.ok_or(SessionError::OutOfPlace("a difference to nothing"))?;
                // Whatever is wrong with it, the same one must not come again.
                self.whole = true;
                let difference = ManifestDifference::decode(&bytes)?;
                let applied = difference.apply(&base.manifest, &publisher)?;
                self.whole = false;
                self.accept(applied)
            }
            ServerMessage::Missing { hash } => {
                if self.wants.forget(&hash) {
                    self.events.push_back(ClientEvent::Missing { hash });
                }
                Ok(())
            }
            ServerMessage::Close { code, message } => Err(SessionError::Closed { code, message }),
            ServerMessage::Tagged { garment, state, outcome } => {
                self.events.push_back(ClientEvent::Tagged { garment, state, outcome });
                Ok(())
            }
        }
    }

    fn meet(&mut self, found: PublisherKey) -> Result<(), SessionError> {
        match self.publisher {
            Some(expected) if expected != found => {
                Err(SessionError::WrongPublisher { expected, found })
            }
            _ => {
                self.publisher = Some(found);
                Ok(())
            }
        }
    }

    fn known_publisher(&self) -> Result<PublisherKey, SessionError> {
        self.publisher.ok_or(SessionError::OutOfPlace("a manifest before its publisher"))
    }

    fn accept(&mut self, signed: SignedManifest) -> Result<(), SessionError> {
        let offered = signed.manifest.number;
        if self.config.pin.is_some_and(|pin| pin != offered || self.manifest.is_some()) {
            return Ok(());
        }
        if let Some(held) = &self.manifest {
            if self.whole && **held == signed {
                self.whole = false;
                return Ok(());
            }
            let held = held.manifest.number;
            if offered <= held {
                return Err(SessionError::WentBack { held, offered });
            }
        }
        self.whole = false;
        let signed = Arc::new(signed);
        self.manifest = Some(signed.clone());
        self.events.push_back(ClientEvent::Version(signed));
        Ok(())
    }

    fn receive(&mut self, stream: u64, bytes: &[u8], end: bool) -> Result<(), SessionError> {
        let known = self.incoming.remove(&stream);
        if known.is_none() && self.incoming.len() >= limits::FETCHES_MAX {
            return Err(SessionError::OutOfPlace("more chunk streams than fetches"));
        }
        let mut incoming = known.unwrap_or_default();
        if !incoming.discard {
            self.collect(stream, &mut incoming, bytes)?;
        }
        if end {
            return self.finish(incoming);
        }
        self.incoming.insert(stream, incoming);
        Ok(())
    }

    /// Adds to a chunk. A stream that nobody asked for is refused as soon as its head is there.
    fn collect(
        &mut self,
        stream: u64,
        incoming: &mut Incoming,
        bytes: &[u8],
    ) -> Result<(), SessionError> {
        let head_lacks = CHUNK_HEAD_BYTES.saturating_sub(incoming.bytes.len());
        let (head, body) = bytes.split_at(head_lacks.min(bytes.len()));
        incoming.bytes.extend_from_slice(head);
        let Some(head) = incoming.bytes.first_chunk::<CHUNK_HEAD_BYTES>() else { return Ok(()) };
        let (hash, length) = parse_chunk_head(head);
        let damaged = |why| Err(SessionError::DamagedChunk { hash, why });
        let Some(expected) = self.wants.asked_bytes_of(&hash) else {
            *incoming = Incoming::discarded();
            return Ok(());
        };
        if expected != length {
            return damaged("its length is not the manifest's");
        }
        if incoming.hash.replace(hash).is_none() {
            // One stream alone collects a chunk, or a server could fill our memory with one hash.
            match self.incoming.iter_mut().find(|(_, other)| other.hash == Some(hash)) {
                Some((later, _)) if *later > stream => {
                    *incoming = Incoming::discarded();
                    return Ok(());
                }
                Some((_, earlier)) => *earlier = Incoming::discarded(),
                None => {}
            }
        }
        incoming.bytes.extend_from_slice(body);
        if incoming.bytes.len() > CHUNK_HEAD_BYTES + expected as usize {
            return damaged("it goes on after its end");
        }
        Ok(())
    }

    fn finish(&mut self, mut incoming: Incoming) -> Result<(), SessionError> {
        if incoming.discard {
            return Ok(());
        }
        let head = incoming.bytes.first_chunk::<CHUNK_HEAD_BYTES>();
        let head = head.ok_or(SessionError::OutOfPlace("a chunk stream without a head"))?;
        let (hash, length) = parse_chunk_head(head);
        let bytes = incoming.bytes.split_off(CHUNK_HEAD_BYTES);
        if bytes.len() != length as usize {
            return Err(SessionError::DamagedChunk { hash, why: "it ends early" });
        }
        if ChunkHash::of(&bytes) != hash {
            return Err(SessionError::DamagedChunk { hash, why: "its bytes have another hash" });
        }
        if self.wants.forget(&hash) {
            self.events.push_back(ClientEvent::Chunk { hash, bytes });
        }
        Ok(())
    }

    fn disconnect(&mut self, now: Time, reason: SessionError) {
        self.incoming.clear();
        self.wants.ask_all_again();
        self.outbox.retain(is_report);
        self.pace = client_pace();
        let lasted_us = self.opened.take().map_or(0, |opened| now.0.saturating_sub(opened.0));
        if lasted_us >= limits::RECONNECT_US_MAX {
            self.failures = 0;
        }
        self.link = if reason.is_final() {
            Link::Closed
        } else {
            Link::Waiting { until: now.after_us(self.delay_us()) }
        };
        self.events.push_back(ClientEvent::Disconnect { reason });
    }

    /// Doubles with every failure, up to a cap; half of it is chance, so that the clients of a
    /// server that went down do not come back all at once.
    fn delay_us(&mut self) -> u64 {
        let doubled = limits::RECONNECT_US_MIN << self.failures.min(16);
        self.failures += 1;
        let delay_us = doubled.min(limits::RECONNECT_US_MAX);
        // SplitMix64 (Steele, Lea and Flood 2014).
        self.random = self.random.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut bits = self.random;
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        delay_us / 2 + (bits ^ (bits >> 31)) % (delay_us / 2 + 1)
    }
}

/// Half of what the server allows; starting small, for the server's clock may lag behind.
fn client_pace() -> Allowance {
    let per_second = limits::MESSAGES_PER_SECOND_MAX / 2;
    Allowance::new(per_second, per_second / 2)
}

/// Whether a message outlives the line.
fn is_report(message: &ClientMessage) -> bool {
    matches!(message, ClientMessage::Telemetry(_) | ClientMessage::Outside { .. })
}

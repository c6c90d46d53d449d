//! The server's side: one machine per connection.

use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;

use super::{Allowance, Deliveries, Time};
use crate::frame::{FrameDecoder, frame};
use crate::ids::{ChunkHash, GarmentId, StateId, VersionNumber};
use crate::limits;
use crate::manifest::SignedManifest;
use crate::message::{
    ClientMessage, CloseCode, Have, Hello, PROTOCOL, Priority, ServerMessage, TagOutcome, Telemetry,
};
use crate::sign::PublisherKey;

/// Whom a server lets in.
#[derive(Debug, Clone, Default)]
pub struct ServerConfig {
    /// Every client must show this token; `None`: all are let in.
    pub token: Option<String>,
    /// Clients that show this token instead may set tags; `None`: nobody may.
    pub tag_token: Option<String>,
}

/// What the driver has to do.
#[derive(Debug, Clone, PartialEq)]
pub enum ServerEvent {
    /// The client is in. Answer by [`Server::handle_publisher`] and [`Server::handle_head`] as far
    /// as they are known, and again whenever there is a new head.
    Open {
        /// Garments that it plays, by name; none: all.
        garments: Vec<String>,
    },
    /// Look up the manifest that the client holds: answer by [`Server::handle_base`].
    Base(VersionNumber),
    /// Send this chunk on a stream of its own: [`chunk_head`](crate::frame::chunk_head), then its
    /// bytes; answer by [`Server::handle_sent`] or [`Server::handle_missing`]. A second `Send` of
    /// the same chunk before that answer changes its priority.
    Send {
        /// The chunk.
        hash: ChunkHash,
        /// Most urgent first.
        priority: Priority,
    },
    /// Do not send it, or reset its stream. No answer; the chunk may be asked for again.
    Cancel {
        /// The chunk.
        hash: ChunkHash,
    },
    /// The client plays this version now.
    Applied(VersionNumber),
    /// What the client saw, with its weight capped.
    Telemetry {
        /// The report; it holds no more traversals, and no more outcomes, than one client may add.
        telemetry: Telemetry,
        /// Traversals above the cap, dropped.
        dropped: u64,
    },
    /// Of the substituted steps reported, those outside the graph.
    Outside {
        /// How many.
        steps: u32,
    },
    /// The client wants this version and no other: answer by [`Server::handle_pinned`].
    Pin(VersionNumber),
    /// Keep a tag, of a client that may set it: answer by [`Server::handle_tagged`].
    Tag {
        /// The garment.
        garment: GarmentId,
        /// The dead end.
        state: StateId,
    },
    /// The conversation is over: write what `poll_transmit` still gives, then close the connection
    /// with this code and text.
    Closed {
        /// Why.
        code: CloseCode,
        /// The same for people.
        message: String,
    },
}

/// The server's side of the conversation with one client.
///
/// See the [module](super) for how to drive it.
#[derive(Debug)]
pub struct Server {
    config: ServerConfig,
    link: Link,
    frames: FrameDecoder,
    publisher: Option<PublisherKey>,
    head: Option<Arc<SignedManifest>>,
    /// What the client said it holds.
    have: Option<Have>,
    base: Base,
    fetches: BTreeSet<ChunkHash>,
    messages: Allowance,
    traversals: Allowance,
    /// Outcomes of steps, jumps among them.
    steps: Allowance,
    /// Substituted steps of the last report of which nobody has said that they were outside.
    substituted: u32,
    may_tag: bool,
    tags: Allowance,
    /// No other version than this is sent.
    pinned: Option<VersionNumber>,
    /// The host looks for it.
    looking_up: Option<VersionNumber>,
    pins: Allowance,
    deliveries: Arc<Deliveries>,
    outbox: VecDeque<ServerMessage>,
    events: VecDeque<ServerEvent>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Link {
    Hello { deadline: Time },
    Open,
    Closed,
}

/// What a difference to the client can start from.
#[derive(Debug)]
enum Base {
    /// Nothing: the client gets a whole manifest.
    Nothing,
    /// The host looks for it.
    Asked,
    /// The client holds this one.
    Held(Arc<SignedManifest>),
}

impl Server {
    /// A client has connected and opened its control stream.
    pub fn new(config: ServerConfig, now: Time) -> Self {
        let messages = limits::MESSAGES_PER_SECOND_MAX;
        let traversals = limits::TRAVERSALS_PER_SECOND_MAX;
        Self {
            config,
            link: Link::Hello { deadline: now.after_us(limits::HANDSHAKE_US_MAX) },
            frames: FrameDecoder::new(limits::MESSAGE_BYTES_MAX),
            publisher: None,
            head: None,
            have: None,
            base: Base::Nothing,
            fetches: BTreeSet::new(),
            messages: Allowance::new(messages, messages),
            traversals: Allowance::new(traversals, limits::TRAVERSALS_BURST_MAX),
            steps: Allowance::new(traversals, limits::TRAVERSALS_BURST_MAX),
            substituted: 0,
            may_tag: false,
            tags: Allowance::new(limits::TAGS_PER_SECOND_MAX, limits::TAGS_BURST_MAX),
            pinned: None,
            looking_up: None,
            pins: Allowance::new(limits::PINS_PER_SECOND_MAX, limits::PINS_BURST_MAX),
            deliveries: Arc::default(),
            outbox: VecDeque::new(),
            events: VecDeque::new(),
        }
    }

    /// Shares what is made for one player with the sessions of all others.
    pub fn sharing(self, deliveries: Arc<Deliveries>) -> Self {
        Self { deliveries, ..self }
    }

    /// Bytes from the control stream.
    pub fn handle_control(&mut self, now: Time, bytes: &[u8]) {
        if self.link == Link::Closed {
            return;
        }
        self.frames.push(bytes);
        while self.link != Link::Closed {
            let message = match self.frames.poll() {
                Ok(None) => return,
                Ok(Some(message)) => message,
                Err(error) => return self.close(CloseCode::TooLong, &error.to_string()),
            };
            if self.messages.take(now, 1) == 0 {
                let max = limits::MESSAGES_PER_SECOND_MAX;
                let why = format!("more than {max} messages a second");
                return self.close(CloseCode::TooManyMessages, &why);
            }
            match ClientMessage::decode(&message) {
                Ok(message) => self.handle_message(now, message),
                Err(error) => self.close(CloseCode::Malformed, &error.to_string()),
            }
        }
    }

    /// Whose manifests are served.
    pub fn handle_publisher(&mut self, publisher: PublisherKey) {
        if self.publisher.is_none() {
            self.publisher = Some(publisher);
            if self.link == Link::Open {
                self.outbox.push_back(ServerMessage::Publisher { publisher });
            }
        }
    }

    /// The head of the store; an older one than before is ignored.
    pub fn handle_head(&mut self, head: &Arc<SignedManifest>) {
        let held = self.head.as_ref().map(|held| held.manifest.number);
        if self.pinned.is_none() && held < Some(head.manifest.number) {
            self.head = Some(head.clone());
        }
    }

    /// The manifest that [`ServerEvent::Base`] asked for; `None` where the store has none.
    pub fn handle_base(&mut self, manifest: Option<Arc<SignedManifest>>) {
        if !matches!(self.base, Base::Asked) {
            return;
        }
        let have_hash = self.have.map(|have| have.hash);
        let held = manifest.filter(|held| Some(self.deliveries.hash(held)) == have_hash);
        self.base = held.map_or(Base::Nothing, Base::Held);
    }

    /// The version that [`ServerEvent::Pin`] asked for; `None` where the store has none, which ends the
    /// conversation.
    pub fn handle_pinned(&mut self, number: VersionNumber, manifest: Option<Arc<SignedManifest>>) {
        if self.looking_up != Some(number) {
            return;
        }
        self.looking_up = None;
        if self.pinned != Some(number) {
            return self.look_up_pinned();
        }
        match manifest {
            Some(manifest) => self.head = Some(manifest),
            None => self.close(CloseCode::Done, &format!("there is no version {number}")),
        }
    }

    /// What became of a tag.
    pub fn handle_tagged(&mut self, garment: GarmentId, state: StateId, outcome: TagOutcome) {
        if self.link == Link::Open {
            self.outbox.push_back(ServerMessage::Tagged { garment, state, outcome });
        }
    }

    /// A chunk was sent whole.
    pub fn handle_sent(&mut self, hash: &ChunkHash) {
        self.fetches.remove(hash);
    }

    /// The store does not have this chunk, or only a damaged copy.
    pub fn handle_missing(&mut self, hash: &ChunkHash) {
        if self.fetches.remove(hash) && self.link == Link::Open {
            self.outbox.push_back(ServerMessage::Missing { hash: *hash });
        }
    }

    /// Time has passed.
    pub fn handle_timeout(&mut self, now: Time) {
        if let Link::Hello { deadline } = self.link
            && now >= deadline
        {
            self.close(CloseCode::HandshakeTimeout, "no hello in time");
        }
    }

    /// Ends the conversation.
    pub fn close(&mut self, code: CloseCode, message: &str) {
        if self.link == Link::Closed {
            return;
        }
        self.link = Link::Closed;
        let end = (0..=message.len().min(limits::REASON_BYTES_MAX))
            .rfind(|end| message.is_char_boundary(*end))
            .unwrap_or(0);
        let message = message[..end].to_string();
        self.outbox.clear();
        self.outbox.push_back(ServerMessage::Close { code, message: message.clone() });
        self.events.push_back(ServerEvent::Closed { code, message });
    }

    /// Bytes for the control stream. A new head waits here until the stream has taken the one
    /// before, so that a slow client skips versions rather than queueing them.
    pub fn poll_transmit(&mut self) -> Option<Arc<[u8]>> {
        match self.outbox.pop_front() {
            Some(message) => Some(frame(&message.encode()).into()),
            None => self.next_version(),
        }
    }

    /// What to do next.
    pub fn poll_event(&mut self) -> Option<ServerEvent> {
        self.events.pop_front()
    }

    /// When to call [`Server::handle_timeout`] at the latest.
    pub fn poll_timeout(&self) -> Option<Time> {
        match self.link {
            Link::Hello { deadline } => Some(deadline),
            Link::Open | Link::Closed => None,
        }
    }

    /// Whether the client was let in and has not left.
    pub fn is_open(&self) -> bool {
        self.link == Link::Open
    }

    fn handle_message(&mut self, now: Time, message: ClientMessage) {
        match (message, self.link) {
            (ClientMessage::Hello(hello), Link::Hello { .. }) => self.greet(hello),
            (ClientMessage::Hello(_), _) => self.close(CloseCode::Malformed, "a second hello"),
            (_, Link::Hello { .. }) => {
                self.close(CloseCode::Malformed, "the first message must be hello");
            }
            (ClientMessage::Fetch { hash, priority }, _) => {
                self.fetches.insert(hash);
                // Answers that the client does not read count too.
                if self.fetches.len() + self.outbox.len() > limits::FETCHES_MAX {
                    let why = format!("more than {} fetches under way", limits::FETCHES_MAX);
                    return self.close(CloseCode::TooManyFetches, &why);
                }
                self.events.push_back(ServerEvent::Send { hash, priority });
            }
            (ClientMessage::Cancel { hash }, _) => {
                if self.fetches.remove(&hash) {
                    self.events.push_back(ServerEvent::Cancel { hash });
                }
            }
            (ClientMessage::Applied { version }, _) => {
                self.events.push_back(ServerEvent::Applied(version));
            }
            (ClientMessage::Telemetry(telemetry), _) => self.weigh(now, telemetry),
            (ClientMessage::Bye, _) => self.close(CloseCode::Done, "bye"),
            (ClientMessage::Pin { version }, _) => self.pin(now, version),
            (ClientMessage::Tag { garment, state }, _) => self.tag(now, garment, state),
            (ClientMessage::Outside { steps, .. }, _) => {
                let steps = steps.min(self.substituted);
                self.substituted -= steps;
                self.events.push_back(ServerEvent::Outside { steps });
            }
        }
    }

    fn greet(&mut self, hello: Hello) {
        if hello.protocol != PROTOCOL {
            let why = format!("this server speaks protocol {PROTOCOL}, not {}", hello.protocol);
            return self.close(CloseCode::OtherProtocol, &why);
        }
        self.may_tag = is_shown(self.config.tag_token.as_deref(), hello.token.as_deref());
        if !self.may_tag && !self.lets_in(hello.token.as_deref()) {
            return self.close(CloseCode::TokenRefused, "this server asks for another token");
        }
        self.link = Link::Open;
        self.have = hello.have;
        if let Some(have) = hello.have {
            self.base = Base::Asked;
            self.events.push_back(ServerEvent::Base(have.version));
        }
        let publisher = self.publisher;
        self.outbox.push_back(ServerMessage::Welcome { protocol: PROTOCOL, publisher });
        self.events.push_back(ServerEvent::Open { garments: hello.garments });
    }

    fn lets_in(&self, token: Option<&str>) -> bool {
        self.config.token.is_none() || is_shown(self.config.token.as_deref(), token)
    }

    fn pin(&mut self, now: Time, version: VersionNumber) {
        if self.pins.take(now, 1) == 0 {
            let max = limits::PINS_PER_SECOND_MAX;
            let why = format!("more than {max} pins a second");
            return self.close(CloseCode::TooManyMessages, &why);
        }
        if self.pinned != Some(version) {
            self.pinned = Some(version);
            self.head = None;
            self.have = None;
            self.base = Base::Nothing;
            self.look_up_pinned();
        }
    }

    /// One look at a time: of what is asked for meanwhile, the newest is looked up after it.
    fn look_up_pinned(&mut self) {
        if let (None, Some(version)) = (self.looking_up, self.pinned) {
            self.looking_up = Some(version);
            self.events.push_back(ServerEvent::Pin(version));
        }
    }

    fn tag(&mut self, now: Time, garment: GarmentId, state: StateId) {
        if !self.may_tag {
            self.handle_tagged(garment, state, TagOutcome::NotAllowed);
        } else if self.tags.take(now, 1) == 0 {
            self.handle_tagged(garment, state, TagOutcome::TooMany);
        } else {
            self.events.push_back(ServerEvent::Tag { garment, state });
        }
        // Answers that the client does not read.
        if self.fetches.len() + self.outbox.len() > limits::FETCHES_MAX {
            self.close(CloseCode::TooManyMessages, "answers to tags are not read");
        }
    }

    /// Caps what one client adds to the counts.
    fn weigh(&mut self, now: Time, mut telemetry: Telemetry) {
        let mut dropped = 0;
        for (_, count) in &mut telemetry.edges {
            let kept = self.traversals.take(now, *count);
            dropped += u64::from(*count - kept);
            *count = kept;
        }
        telemetry.edges.retain(|(_, count)| *count > 0);
        let Telemetry { exact, substituted, missed, jumps, .. } = &mut telemetry;
        let outcomes = [exact, substituted, missed, jumps];
        let told = outcomes.iter().map(|count| u64::from(**count)).sum::<u64>();
        let kept = self.steps.take(now, u32::try_from(told).unwrap_or(u32::MAX));
        for count in outcomes {
            // All alike, so that their shares stay as told. At most the count itself.
            *count = (u64::from(*count) * u64::from(kept) / told.max(1)) as u32;
        }
        self.substituted = telemetry.substituted;
        self.events.push_back(ServerEvent::Telemetry { telemetry, dropped });
    }

    /// The head, if the client should have it: as a difference where that can be, else whole.
    fn next_version(&mut self) -> Option<Arc<[u8]>> {
        if self.link != Link::Open || self.publisher.is_none() {
            return None;
        }
        let head = self.head.as_ref()?;
        let number = head.manifest.number;
        let bytes = match &self.base {
            Base::Asked => return None,
            Base::Held(held) if held.manifest.number >= number => return None,
            Base::Held(held) => self.deliveries.difference(held, head),
            // A client may hold a version that this server's store does not show yet.
            Base::Nothing if self.have.is_some_and(|have| have.version >= number) => return None,
            Base::Nothing => self.deliveries.full(head),
        };
        self.base = Base::Held(head.clone());
        Some(bytes)
    }
}

/// Whether a token is the expected one; not, where none is expected.
fn is_shown(expected: Option<&str>, token: Option<&str>) -> bool {
    // Hashes compare in constant time, so that a token cannot be guessed byte by byte.
    let hash = |text: &str| blake3::hash(text.as_bytes());
    token.zip(expected).is_some_and(|(token, expected)| hash(token) == hash(expected))
}

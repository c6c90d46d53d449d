//! What is said on the control stream. See `docs/protocol.md` for the conversation.

use serde::{Deserialize, Serialize};

use crate::ids::{ChunkHash, EdgeId, GarmentId, StateId, VersionNumber};
use crate::limits;
use crate::sign::PublisherKey;
use crate::wire::{DecodeError, at_most, ensure, parse};

/// Version of the conversation, said in hello and welcome.
pub const PROTOCOL: u16 = 1;
/// Name of the protocol in the TLS handshake.
pub const ALPN: &[u8] = b"toile/1";

/// How soon a chunk is needed; the first is served first.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, Default,
)]
pub enum Priority {
    /// Nothing can be shown without it: scene, mesh, basis, links, the initial graph.
    Scene,
    /// The next steps need it.
    Urgent,
    /// Likely needed within seconds.
    Soon,
    /// While the line is idle.
    #[default]
    Background,
}

/// The manifest that a client holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Have {
    /// Its number.
    pub version: VersionNumber,
    /// BLAKE3 of its unsigned bytes.
    pub hash: ChunkHash,
}

/// The first message of a client.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Hello {
    /// [`PROTOCOL`].
    pub protocol: u16,
    /// Lets it in, where the server asks for one.
    pub token: Option<String>,
    /// Garments that it plays, by name; none: all. Manifests are whole either way, for they are
    /// signed as one.
    pub garments: Vec<String>,
    /// What it holds from before; the server then sends the difference only.
    pub have: Option<Have>,
}

/// What a client saw since its last report. Counts only: no time, no order, no identity.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Telemetry {
    /// The garment.
    pub garment: GarmentId,
    /// The version that was played.
    pub version: VersionNumber,
    /// How often each primary edge was walked.
    pub edges: Vec<(EdgeId, u32)>,
    /// Steps that showed what the links name.
    pub exact: u32,
    /// Steps that showed another state of the same pose.
    pub substituted: u32,
    /// Steps without any state.
    pub missed: u32,
    /// Steps to a pose that is no successor.
    pub jumps: u32,
}

/// From client to server.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum ClientMessage {
    /// Opens the conversation.
    Hello(Hello),
    /// Asks for a chunk, or changes the priority of one asked for.
    Fetch {
        /// The chunk.
        hash: ChunkHash,
        /// How soon.
        priority: Priority,
    },
    /// No longer needed.
    Cancel {
        /// The chunk.
        hash: ChunkHash,
    },
    /// This version is being played now.
    Applied {
        /// Its number.
        version: VersionNumber,
    },
    /// What was seen.
    Telemetry(Telemetry),
    /// Ends the conversation.
    Bye,
    /// From now on this version only, whatever the head is: for looking at what was.
    Pin {
        /// Its number.
        version: VersionNumber,
    },
    /// The explorer should simulate at this dead end next. Takes a token with that right.
    Tag {
        /// The garment.
        garment: GarmentId,
        /// The dead end.
        state: StateId,
    },
    /// Of the substituted steps reported, those outside the graph. Said only where there are any, so
    /// that a server without upsamplers never meets it.
    Outside {
        /// The garment.
        garment: GarmentId,
        /// The version that was played.
        version: VersionNumber,
        /// Steps since the last report.
        steps: u32,
    },
}

/// What became of a tag.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum TagOutcome {
    /// It is in the store, under this number.
    Kept {
        /// See [`store::tag_path`](crate::store::tag_path).
        number: u64,
    },
    /// The client's token does not allow it.
    NotAllowed,
    /// The head has no such garment or state.
    Unknown,
    /// More tags than one client may set.
    TooMany,
    /// The store could not be written; try again.
    Failed,
}

/// From server to client.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum ServerMessage {
    /// Answers hello.
    Welcome {
        /// [`PROTOCOL`].
        protocol: u16,
        /// Whose manifests will follow; `None` while nothing was ever published.
        publisher: Option<PublisherKey>,
    },
    /// Sent once, before the first manifest, where welcome could not yet name the publisher.
    Publisher {
        /// Whose manifests will follow.
        publisher: PublisherKey,
    },
    /// A new head: a whole [`SignedManifest`](crate::SignedManifest), encoded.
    ManifestFull(#[serde(with = "crate::wire::bytes")] Vec<u8>),
    /// A new head: an encoded [`ManifestDifference`](crate::ManifestDifference) to the one before.
    ManifestDifference(#[serde(with = "crate::wire::bytes")] Vec<u8>),
    /// The store does not have this chunk, or only a damaged copy.
    Missing {
        /// The chunk asked for.
        hash: ChunkHash,
    },
    /// Ends the conversation.
    Close {
        /// Why.
        code: CloseCode,
        /// The same for people.
        message: String,
    },
    /// Answers a tag.
    Tagged {
        /// The garment.
        garment: GarmentId,
        /// The dead end.
        state: StateId,
        /// What became of it.
        outcome: TagOutcome,
    },
}

/// Why a conversation ended; also the error code of the QUIC connection's close.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum CloseCode {
    /// The client said bye.
    Done,
    /// The server is going down; come back later.
    ShuttingDown,
    /// No token, or a wrong one.
    TokenRefused,
    /// The other side speaks another version of the protocol.
    OtherProtocol,
    /// A message that cannot be read, or is out of place.
    Malformed,
    /// A message over the limit.
    TooLong,
    /// More messages per second than allowed.
    TooManyMessages,
    /// More fetches under way than allowed.
    TooManyFetches,
    /// No hello in time.
    HandshakeTimeout,
    /// The server is full; come back later.
    Full,
    /// The server's own fault, such as an unreachable store.
    Internal,
}

impl CloseCode {
    /// All, by number.
    pub const ALL: [Self; 11] = [
        Self::Done,
        Self::ShuttingDown,
        Self::TokenRefused,
        Self::OtherProtocol,
        Self::Malformed,
        Self::TooLong,
        Self::TooManyMessages,
        Self::TooManyFetches,
        Self::HandshakeTimeout,
        Self::Full,
        Self::Internal,
    ];

    /// As the error code of a QUIC close.
    pub fn number(self) -> u32 {
        self as u32
    }

    /// The inverse of [`CloseCode::number`].
    pub fn from_number(number: u64) -> Option<Self> {
        Self::ALL.get(usize::try_from(number).ok()?).copied()
    }
}

impl ClientMessage {
    /// Bytes of one frame.
    pub fn encode(&self) -> Vec<u8> {
        postcard::to_stdvec(self).expect("writing to memory does not fail")
    }

    /// Reads and checks one frame.
    ///
    /// # Errors
    /// Damaged bytes, or a list or text over its limit.
    pub fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
        const WHAT: &str = "client's message";
        let message: Self = parse(WHAT, bytes)?;
        message.check().map_err(|why| DecodeError::Invalid { what: WHAT, why })?;
        Ok(message)
    }

    fn check(&self) -> Result<(), String> {
        match self {
            Self::Hello(hello) => {
                let token_bytes = hello.token.as_ref().map_or(0, String::len);
                at_most("bytes of token", token_bytes, limits::TOKEN_BYTES_MAX)?;
                at_most("garments", hello.garments.len(), limits::GARMENTS_MAX)?;
                let longest = hello.garments.iter().map(String::len).max().unwrap_or(0);
                at_most("bytes of a name", longest, limits::NAME_BYTES_MAX)
            }
            Self::Telemetry(telemetry) => {
                at_most("edges", telemetry.edges.len(), limits::TELEMETRY_EDGES_MAX)?;
                let stray = telemetry.edges.iter().find(|e| e.0.index() >= limits::EDGES_MAX);
                ensure(stray.is_none(), || format!("edge {stray:?} is out of range"))
            }
            Self::Tag { state, .. } => {
                ensure(state.0 < limits::STATES_MAX, || format!("state {state} is out of range"))
            }
            Self::Fetch { .. }
            | Self::Cancel { .. }
            | Self::Applied { .. }
            | Self::Bye
            | Self::Pin { .. }
            | Self::Outside { .. } => Ok(()),
        }
    }
}

impl ServerMessage {
    /// Largest frame of a server: a manifest and its place in the message.
    pub const BYTES_MAX: usize = limits::MANIFEST_BYTES_MAX + 16;

    /// Bytes of one frame.
    pub fn encode(&self) -> Vec<u8> {
        postcard::to_stdvec(self).expect("writing to memory does not fail")
    }

    /// Reads and checks one frame.
    ///
    /// # Errors
    /// Damaged bytes, or a text over its limit.
    pub fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
        const WHAT: &str = "server's message";
        let message: Self = parse(WHAT, bytes)?;
        if let Self::Close { message, .. } = &message {
            at_most("bytes of reason", message.len(), limits::REASON_BYTES_MAX)
                .map_err(|why| DecodeError::Invalid { what: WHAT, why })?;
        }
        Ok(message)
    }
}

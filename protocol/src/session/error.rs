//! Why a client's connection ended.

use crate::difference::ApplyError;
use crate::frame::FrameTooLong;
use crate::ids::{ChunkHash, VersionNumber};
use crate::manifest::ManifestError;
use crate::message::{CloseCode, PROTOCOL};
use crate::sign::PublisherKey;
use crate::wire::DecodeError;

/// Why a connection ended.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SessionError {
    /// We said bye.
    #[error("the client has ended the session")]
    Done,
    /// The connection could not be made, or was lost.
    #[error("no connection to the server: {0}")]
    Lost(String),
    /// The server ended it.
    #[error("the server has ended the session ({code:?}): {message}")]
    Closed {
        /// Why.
        code: CloseCode,
        /// The same for people.
        message: String,
    },
    /// No welcome in time.
    #[error("the server did not answer hello in time")]
    HandshakeTimeout,
    /// The server speaks another protocol.
    #[error("the server speaks protocol {found}, this client {PROTOCOL}; update the older one")]
    OtherProtocol {
        /// Its version.
        found: u16,
    },
    /// Another publisher than the pinned one.
    #[error("the server's publisher is {found}, but {expected} is pinned; is it the right server?")]
    WrongPublisher {
        /// The pinned one.
        expected: PublisherKey,
        /// The one it names.
        found: PublisherKey,
    },
    /// A message that cannot be read.
    #[error("a message that cannot be read: {0}")]
    Malformed(#[from] DecodeError),
    /// A message over the limit.
    #[error(transparent)]
    TooLong(#[from] FrameTooLong),
    /// A message that is out of place.
    #[error("the server's message is out of place: {0}")]
    OutOfPlace(&'static str),
    /// A manifest that is damaged or was not signed by the publisher.
    #[error(transparent)]
    Manifest(#[from] ManifestError),
    /// A difference that does not lead to what was signed; the whole manifest is asked for next.
    #[error(transparent)]
    Difference(#[from] ApplyError),
    /// A manifest that is not newer than ours.
    #[error("the server offers version {offered}, but version {held} is already held")]
    WentBack {
        /// The one we hold.
        held: VersionNumber,
        /// The one offered.
        offered: VersionNumber,
    },
    /// A chunk whose bytes are not what was asked for.
    #[error("chunk {hash} arrived damaged: {why}")]
    DamagedChunk {
        /// Its name.
        hash: ChunkHash,
        /// What is wrong with it.
        why: &'static str,
    },
}

impl SessionError {
    /// Whether trying again is of no use.
    pub fn is_final(&self) -> bool {
        match self {
            Self::Done
            | Self::OtherProtocol { .. }
            | Self::WrongPublisher { .. }
            | Self::Manifest(_)
            | Self::WentBack { .. } => true,
            Self::Closed { code, .. } => {
                matches!(code, CloseCode::TokenRefused | CloseCode::OtherProtocol)
            }
            _ => false,
        }
    }

    /// The code to close the connection with.
    pub fn close_code(&self) -> CloseCode {
        match self {
            Self::OtherProtocol { .. } => CloseCode::OtherProtocol,
            Self::HandshakeTimeout => CloseCode::HandshakeTimeout,
            Self::TooLong(_) => CloseCode::TooLong,
            Self::Done | Self::Lost(_) | Self::WrongPublisher { .. } | Self::Closed { .. } => {
                CloseCode::Done
            }
            _ => CloseCode::Malformed,
        }
    }
}

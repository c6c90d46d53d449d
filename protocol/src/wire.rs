//! The envelope of everything stored: four bytes of magic, a version (u16, little-endian), then
//! postcard. Bytes from outside are checked here before and after parsing.

use serde::{Deserialize, Serialize};

/// Bytes before the postcard part.
pub(crate) const HEADER_BYTES: usize = 6;

/// Why bytes were refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DecodeError {
    /// More bytes than the limit of this type.
    #[error("{what}: {bytes} bytes, but at most {max} are allowed")]
    TooLong {
        /// The type.
        what: &'static str,
        /// What was offered.
        bytes: usize,
        /// The limit.
        max: usize,
    },
    /// Another kind of file.
    #[error("not a {what}: it begins with {found:02x?}; is this chunk of another kind?")]
    NotThis {
        /// The type expected.
        what: &'static str,
        /// Its first bytes, at most four.
        found: Vec<u8>,
    },
    /// Written by another version of the format.
    #[error(
        "{what}: format version {found}, but only {known} is known; {} program", which(*.found, *.known)
    )]
    UnknownVersion {
        /// The type.
        what: &'static str,
        /// Version found.
        found: u16,
        /// Version known.
        known: u16,
    },
    /// The bytes end early or do not parse.
    #[error("{what}: damaged or cut short ({bytes} bytes)")]
    Malformed {
        /// The type.
        what: &'static str,
        /// Length of the input.
        bytes: usize,
    },
    /// Bytes after the end.
    #[error("{what}: {bytes} bytes too many after its end")]
    Trailing {
        /// The type.
        what: &'static str,
        /// How many.
        bytes: usize,
    },
    /// It parses, but says something impossible.
    #[error("{what}: {why}")]
    Invalid {
        /// The type.
        what: &'static str,
        /// What is wrong, and where.
        why: String,
    },
}

/// What to do about a format version.
fn which(found: u16, known: u16) -> &'static str {
    if found > known { "update this" } else { "make it anew: it is of an older" }
}

/// A type's envelope.
pub(crate) struct Format {
    /// For error messages.
    pub what: &'static str,
    /// First four bytes.
    pub magic: [u8; 4],
    /// Version written and read.
    pub version: u16,
    /// Largest input, in bytes.
    pub bytes_max: usize,
}

impl Format {
    pub(crate) fn encode<T: Serialize>(&self, value: &T) -> Vec<u8> {
        self.to_bytes(value).expect("what is written keeps to its limit")
    }

    /// As [`Format::encode`]; refuses what is too long.
    pub(crate) fn to_bytes<T: Serialize>(&self, value: &T) -> Result<Vec<u8>, DecodeError> {
        let mut head = Vec::with_capacity(256);
        head.extend_from_slice(&self.magic);
        head.extend_from_slice(&self.version.to_le_bytes());
        let bytes = postcard::to_extend(value, head).expect("writing to memory does not fail");
        if bytes.len() > self.bytes_max {
            let (what, max) = (self.what, self.bytes_max);
            return Err(DecodeError::TooLong { what, bytes: bytes.len(), max });
        }
        Ok(bytes)
    }

    /// The value, still to be checked for meaning.
    ///
    /// Memory taken is bounded by the input: serde reserves at most a mebibyte ahead of what it
    /// has read, and every element takes at least a byte of input.
    pub(crate) fn decode<'a, T: Deserialize<'a>>(&self, bytes: &'a [u8]) -> Result<T, DecodeError> {
        let what = self.what;
        if bytes.len() > self.bytes_max {
            return Err(DecodeError::TooLong { what, bytes: bytes.len(), max: self.bytes_max });
        }
        if bytes.len() < HEADER_BYTES || bytes[..4] != self.magic {
            let found = bytes[..bytes.len().min(4)].to_vec();
            return Err(DecodeError::NotThis { what, found });
        }
        let version = u16::from_le_bytes([bytes[4], bytes[5]]);
        if version != self.version {
            let known = self.version;
            return Err(DecodeError::UnknownVersion { what, found: version, known });
        }
        parse(what, &bytes[HEADER_BYTES..])
    }

    /// Whether bytes state a version above `version`; [`Format::decode`] checks which.
    pub(crate) fn is_after(bytes: &[u8], version: u16) -> bool {
        bytes.get(4..6).is_some_and(|v| u16::from_le_bytes([v[0], v[1]]) > version)
    }

    pub(crate) fn invalid(&self, why: String) -> DecodeError {
        DecodeError::Invalid { what: self.what, why }
    }
}

/// Postcard and nothing after it.
pub(crate) fn parse<'a, T: Deserialize<'a>>(
    what: &'static str,
    bytes: &'a [u8],
) -> Result<T, DecodeError> {
    let (value, rest) = postcard::take_from_bytes(bytes)
        .map_err(|_| DecodeError::Malformed { what, bytes: bytes.len() })?;
    if !rest.is_empty() {
        return Err(DecodeError::Trailing { what, bytes: rest.len() });
    }
    Ok(value)
}

/// `Err(why)` unless `condition`; keeps semantic checks readable.
pub(crate) fn ensure(condition: bool, why: impl FnOnce() -> String) -> Result<(), String> {
    if condition { Ok(()) } else { Err(why()) }
}

/// A count within its limit.
pub(crate) fn at_most(what: &str, count: usize, max: usize) -> Result<(), String> {
    ensure(count <= max, || format!("{count} {what}, but at most {max} are allowed"))
}

/// A name: not empty, not too long.
pub(crate) fn check_name(what: &str, name: &str) -> Result<(), String> {
    let max = crate::limits::NAME_BYTES_MAX;
    ensure(!name.is_empty() && name.len() <= max, || {
        format!("{what} has a name of {} bytes; between 1 and {max} are allowed", name.len())
    })
}

/// No NaN, no infinity.
pub(crate) fn check_finite(what: &str, index: usize, numbers: &[f32]) -> Result<(), String> {
    ensure(numbers.iter().all(|x| x.is_finite()), || {
        format!("{what} {index} has a number that is not finite: {numbers:?}")
    })
}

/// `Vec<u8>` in one copy; on the wire the same as serde's default.
pub(crate) mod bytes {
    use serde::de::Visitor;
    use serde::{Deserializer, Serializer};

    pub(crate) fn serialize<S: Serializer>(bytes: &[u8], serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_bytes(bytes)
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<u8>, D::Error> {
        struct Copy;
        impl Visitor<'_> for Copy {
            type Value = Vec<u8>;
            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("bytes")
            }
            fn visit_bytes<E>(self, bytes: &[u8]) -> Result<Vec<u8>, E> {
                Ok(bytes.to_vec())
            }
        }
        from.deserialize_bytes(Copy)
    }
}

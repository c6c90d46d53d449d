//! How bytes on streams are cut: messages on the control stream, and the head of a chunk stream.
//!
//! A message is its length (u32, little-endian) and that many bytes. A chunk stream is the chunk's
//! hash (32 bytes), its length (u32, little-endian) and its bytes; then the stream ends.

use crate::ids::ChunkHash;

/// Bytes before a message.
pub const MESSAGE_HEAD_BYTES: usize = 4;
/// Bytes before a chunk on its stream.
pub const CHUNK_HEAD_BYTES: usize = 36;

/// A message that is longer than the receiver allows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a message of {bytes} bytes, but at most {max} are allowed")]
pub struct FrameTooLong {
    /// Its length.
    pub bytes: usize,
    /// The limit.
    pub max: usize,
}

/// A message with its length in front.
pub fn frame(message: &[u8]) -> Vec<u8> {
    let length = u32::try_from(message.len()).expect("messages are far below 4 GiB");
    [&length.to_le_bytes()[..], message].concat()
}

/// The first bytes of a chunk stream.
pub fn chunk_head(hash: &ChunkHash, bytes: u32) -> [u8; CHUNK_HEAD_BYTES] {
    let mut head = [0; CHUNK_HEAD_BYTES];
    head[..32].copy_from_slice(&hash.0);
    head[32..].copy_from_slice(&bytes.to_le_bytes());
    head
}

/// The inverse of [`chunk_head`].
pub fn parse_chunk_head(head: &[u8; CHUNK_HEAD_BYTES]) -> (ChunkHash, u32) {
    let (hash, length) = head.split_first_chunk::<32>().expect("36 bytes");
    (ChunkHash(*hash), u32::from_le_bytes([length[0], length[1], length[2], length[3]]))
}

/// Puts messages together from bytes that arrive in any pieces.
#[derive(Debug)]
pub struct FrameDecoder {
    buffer: Vec<u8>,
    taken: usize,
    bytes_max: usize,
}

impl FrameDecoder {
    /// Accepts messages of at most `bytes_max` bytes.
    pub fn new(bytes_max: usize) -> Self {
        Self { buffer: Vec::new(), taken: 0, bytes_max }
    }

    /// Adds bytes as they came. Memory is bounded if [`FrameDecoder::poll`] is called until `None`
    /// after each.
    pub fn push(&mut self, bytes: &[u8]) {
        self.buffer.drain(..self.taken);
        self.taken = 0;
        self.buffer.extend_from_slice(bytes);
    }

    /// The next whole message.
    ///
    /// # Errors
    /// The next message is too long; said as soon as its length is known.
    pub fn poll(&mut self) -> Result<Option<Vec<u8>>, FrameTooLong> {
        let waiting = &self.buffer[self.taken..];
        let Some((head, rest)) = waiting.split_first_chunk::<MESSAGE_HEAD_BYTES>() else {
            return Ok(None);
        };
        let bytes = u32::from_le_bytes(*head) as usize;
        if bytes > self.bytes_max {
            return Err(FrameTooLong { bytes, max: self.bytes_max });
        }
        let Some(message) = rest.get(..bytes) else { return Ok(None) };
        let message = message.to_vec();
        self.taken += MESSAGE_HEAD_BYTES + bytes;
        Ok(Some(message))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_survive_any_cut() {
        let stream: Vec<u8> = [&b"one"[..], b"", b"three"].iter().flat_map(|m| frame(m)).collect();
        for step in 1..stream.len() {
            let mut decoder = FrameDecoder::new(5);
            let mut messages = Vec::new();
            for piece in stream.chunks(step) {
                decoder.push(piece);
                while let Some(message) = decoder.poll().unwrap() {
                    messages.push(message);
                }
            }
            assert_eq!(messages, [&b"one"[..], b"", b"three"], "cut every {step}");
        }
    }

    #[test]
    fn a_long_message_is_refused_by_its_length_alone() {
        let mut decoder = FrameDecoder::new(5);
        decoder.push(&[6, 0, 0]);
        assert_eq!(decoder.poll(), Ok(None));
        decoder.push(&[0]);
        assert_eq!(decoder.poll(), Err(FrameTooLong { bytes: 6, max: 5 }));
    }

    #[test]
    fn a_chunk_head_reads_back() {
        let hash = ChunkHash::of(b"x");
        assert_eq!(parse_chunk_head(&chunk_head(&hash, 77)), (hash, 77));
    }
}

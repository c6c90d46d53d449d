//! Who published it: ed25519 keys and signatures, in our own plain types.

use ed25519_dalek::Signer;
use serde::{Deserialize, Serialize};

/// Bytes of a signature.
pub const SIGNATURE_BYTES: usize = 64;

/// A publisher's public key.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct PublisherKey(pub [u8; 32]);

impl PublisherKey {
    /// 64 hexadecimal digits (white space around them is ignored), or `None`.
    pub fn from_hex(text: &str) -> Option<Self> {
        crate::ids::ChunkHash::from_hex(text.trim()).map(|bytes| Self(bytes.0))
    }

    /// Whether this key's owner signed exactly these bytes.
    pub fn has_signed(&self, bytes: &[u8], signature: &Signature) -> bool {
        let Ok(key) = ed25519_dalek::VerifyingKey::from_bytes(&self.0) else { return false };
        key.verify_strict(bytes, &ed25519_dalek::Signature::from_bytes(&signature.0)).is_ok()
    }
}

impl std::fmt::Display for PublisherKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        crate::ids::ChunkHash(self.0).fmt(f)
    }
}

impl std::fmt::Debug for PublisherKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        std::fmt::Display::fmt(self, f)
    }
}

/// An ed25519 signature.
#[derive(Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "[[u8; 32]; 2]", into = "[[u8; 32]; 2]")]
pub struct Signature(pub [u8; SIGNATURE_BYTES]);

impl From<[[u8; 32]; 2]> for Signature {
    fn from([a, b]: [[u8; 32]; 2]) -> Self {
        let mut bytes = [0; SIGNATURE_BYTES];
        bytes[..32].copy_from_slice(&a);
        bytes[32..].copy_from_slice(&b);
        Self(bytes)
    }
}

impl From<Signature> for [[u8; 32]; 2] {
    fn from(signature: Signature) -> Self {
        let mut halves = [[0; 32]; 2];
        halves[0].copy_from_slice(&signature.0[..32]);
        halves[1].copy_from_slice(&signature.0[32..]);
        halves
    }
}

impl std::fmt::Debug for Signature {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Signature({:02x}{:02x}..)", self.0[0], self.0[1])
    }
}

/// A publisher's secret key. Whoever makes one brings 32 random bytes; nothing here is random.
#[derive(Clone)]
pub struct SigningKey(ed25519_dalek::SigningKey);

impl SigningKey {
    /// From 32 secret random bytes.
    pub fn from_seed(seed: &[u8; 32]) -> Self {
        Self(ed25519_dalek::SigningKey::from_bytes(seed))
    }

    /// The secret bytes, to be kept.
    pub fn seed(&self) -> [u8; 32] {
        self.0.to_bytes()
    }

    /// The public half.
    pub fn public(&self) -> PublisherKey {
        PublisherKey(self.0.verifying_key().to_bytes())
    }

    /// Signs; the same bytes always give the same signature.
    pub fn sign(&self, bytes: &[u8]) -> Signature {
        Signature(self.0.sign(bytes).to_bytes())
    }
}

impl std::fmt::Debug for SigningKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "SigningKey(of {})", self.public())
    }
}

//! Where things lie in an object store. Paths are relative to the store's root, `/`-separated.

use crate::ids::{ChunkHash, VersionNumber};

/// Folder of chunks.
pub const CHUNKS: &str = "chunks";
/// Folder of manifests.
pub const VERSIONS: &str = "versions";
/// The publisher's public key: 64 hexadecimal digits and a newline.
pub const PUBLISHER: &str = "publisher.pub";
/// Folder of telemetry batches.
pub const TELEMETRY: &str = "telemetry";
/// Folder of tags.
pub const TAGS: &str = "tags";

/// `chunks/ab/abcdef...`: the first byte spreads the load over folders.
pub fn chunk_path(hash: &ChunkHash) -> String {
    let hex = hash.to_string();
    format!("{CHUNKS}/{}/{hex}", &hex[..2])
}

/// `versions/00000000000000000001`: names sort like numbers.
pub fn version_path(number: VersionNumber) -> String {
    format!("{VERSIONS}/{:020}", number.0)
}

/// `telemetry/00000000000000000001`: a [`TelemetryBatch`](crate::telemetry::TelemetryBatch).
pub fn telemetry_path(number: u64) -> String {
    format!("{TELEMETRY}/{number:020}")
}

/// `tags/00000000000000000001`: a [`Tag`](crate::tag::Tag). Numbers begin at 1 and leave none out, so
/// that a reader who knows how far it has read needs no listing.
pub fn tag_path(number: u64) -> String {
    format!("{TAGS}/{number:020}")
}

/// The number in a tag's path, or `None` for another file.
pub fn tag_of_path(path: &str) -> Option<u64> {
    numbered(path, TAGS)
}

/// The number in a telemetry batch's path, or `None` for another file.
pub fn telemetry_of_path(path: &str) -> Option<u64> {
    numbered(path, TELEMETRY)
}

/// The number in a manifest's path, or `None` for another file.
pub fn version_of_path(path: &str) -> Option<VersionNumber> {
    numbered(path, VERSIONS).map(VersionNumber)
}

fn numbered(path: &str, folder: &str) -> Option<u64> {
    let name = path.strip_prefix(folder)?.strip_prefix('/')?;
    let all_digits = name.len() == 20 && name.bytes().all(|b| b.is_ascii_digit());
    all_digits.then(|| name.parse().ok())?
}

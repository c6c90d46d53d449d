//! What travels and what is stored: ids, hashes, manifest, links, messages, limits, and the
//! client's and the server's session as state machines.
//!
//! Bytes in, values out: no I/O, no async, no threads, no clock. Time is an argument.
//!
//! Non-goals: what a region's coefficients mean (that is `codec`), how cloth moves (`cloth`).
//!
//! Map: [`ids`]; [`limits`]; [`scene`] the scene and garment chunks; [`region`] the container of
//! encoded regions; [`links`] which state follows which, [`table`] all of it, proved total;
//! [`manifest`] a version, [`difference`] what changed since another, [`sign`] who published it;
//! [`telemetry`] what players walked; [`store`] where things lie in an object store; [`message`]
//! what is said on a connection and [`frame`] how it is cut; [`session`] the two sides of the
//! conversation.
//!
//! ```
//! use protocol::{ChunkHash, scene::GarmentChunk};
//!
//! let garment = GarmentChunk { name: "robe".into(), vertex_count: 3, triangles: vec![[0, 1, 2]] };
//! let bytes = garment.encode();
//! let name = ChunkHash::of(&bytes);
//! assert_eq!(protocol::store::chunk_path(&name).len(), "chunks/ab/".len() + 64);
//! assert_eq!(GarmentChunk::decode(&bytes).unwrap(), garment);
//! assert!(GarmentChunk::decode(&bytes[1..]).is_err());
//! ```

pub mod difference;
pub mod frame;
pub mod ids;
pub mod limits;
pub mod links;
pub mod manifest;
pub mod message;
pub mod region;
pub mod scene;
pub mod session;
pub mod sign;
pub mod store;
pub mod table;
pub mod tag;
pub mod telemetry;
mod wire;

pub use difference::ManifestDifference;
pub use ids::{ChunkHash, EdgeId, GarmentId, GenerationId, PoseId, StateId, VersionNumber};
pub use manifest::{Manifest, SignedManifest};
pub use sign::{PublisherKey, Signature, SigningKey};
pub use table::{LinkTable, NotTotal};
pub use wire::DecodeError;

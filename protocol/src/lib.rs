//! What travels and what is stored: ids, hashes, manifest, links, messages, limits, and the
//! client's and the server's session as state machines.
//!
//! Bytes in, values out: no I/O, no async, no threads, no clock. Time is an argument.
//!
//! Non-goals: what a region's coefficients mean (that is `codec`), how cloth moves (`cloth`).
//!
//! Map: [`ids`]; [`limits`]; [`scene`] the scene and garment chunks; [`region`] the container of
//! encoded regions; [`links`] which state follows which; [`manifest`] a version; [`store`] where
//! things lie in an object store.

pub mod ids;
pub mod limits;
pub mod links;
pub mod manifest;
pub mod region;
pub mod scene;
pub mod store;

pub use ids::{ChunkHash, EdgeId, GarmentId, GenerationId, PoseId, StateId, VersionNumber};

//! Turns states into a basis, regions and versions in an object store.
//!
//! Map: [`basis`] streaming SVD; [`design`] from a bound to rank and steps; [`encode`] regions and
//! their true error; [`publish`] versions;
//! [`upsampler`] what cloth leaves the graph with; [`mod@inspect`] what a store holds; [`scene_chunk`] a scene as clients get it; [`store`] reading
//! and writing; [`key`] who signs.
//!
//! Absent on purpose: who is connected, and any clock: equal views and equal history make equal
//! chunks and manifests.

pub mod basis;
pub mod bench;
mod bounded;
mod columns;
pub mod design;
pub mod encode;
mod fixed_bits;
pub mod inspect;
pub mod key;
mod order;
pub mod publish;
mod regions;
pub mod scene_chunk;
mod statistics;
pub mod store;
pub mod upsampler;
mod wide;

pub use design::Bound;
pub use encode::{EncodeSettings, Profile};
pub use inspect::{GarmentInspection, InspectError, Inspection, inspect};
pub use key::{KeyError, load_or_make_key};
pub use publish::{Prepared, PublishError, Published, Publisher};
pub use regions::RunsError;
pub use store::{StoreError, collect_leftovers, local_store, publisher};

#[cfg(test)]
mod bound_tests;
#[cfg(test)]
mod encode_tests;

//! Turns states into a basis, regions and versions in an object store.
//!
//! Map: [`basis`] streaming SVD; [`encode`] regions and their true error; [`publish`] versions;
//! [`mod@inspect`] what a store holds; [`scene_chunk`] a scene as clients get it; [`store`] reading
//! and writing; [`key`] who signs.
//!
//! Absent on purpose: who is connected, and any clock: equal views and equal history make equal
//! chunks and manifests.

pub mod basis;
pub mod encode;
pub mod inspect;
pub mod key;
pub mod publish;
mod regions;
pub mod scene_chunk;
pub mod store;

pub use encode::EncodeSettings;
pub use inspect::{GarmentInspection, InspectError, Inspection, inspect};
pub use key::{KeyError, load_or_make_key};
pub use publish::{Prepared, PublishError, Published, Publisher};
pub use regions::RunsError;
pub use store::{StoreError, collect_leftovers, local_store, publisher};

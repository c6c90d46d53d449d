//! Turns states into a basis, regions and versions in an object store.
//!
//! Map: [`basis`] streaming SVD; [`encode`] regions and their true error.

pub mod basis;
pub mod encode;

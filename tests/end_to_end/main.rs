//! The whole of Toile through its command line: real scene, real store, real QUIC.
//!
//! One store of the built-in robe is explored once and shared by the tests that only read.

mod determinism;
mod faults;
mod first_cloth;
mod line;
mod run;
mod view;

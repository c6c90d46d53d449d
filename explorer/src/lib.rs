//! Grows the secondary motion graph of a garment and publishes it.
//!
//! Wings: [`import`] reads scenes, characters, motion graphs and garments; [`builtin`] makes the
//! built-in scene; [`grow`] explores (graph, metric, queue, jobs, journal); [`pack`] builds the
//! basis, encodes and publishes; [`explore`] ties them together; [`simulate`] walks without
//! a graph; [`tailor`] makes garments for any body.
//!
//! Non-goals: who is connected (they meet in the store), what a region's bytes mean (`codec`).

pub mod builtin;
pub mod certificate;
pub mod cloth_simulator;
pub mod compare;
pub mod cpu;
pub mod decode_bench;
pub mod disk;
pub mod explore;
pub mod faults;
pub mod figures;
pub mod grid;
pub mod grow;
pub mod import;
pub mod pack;
pub mod pipe;
pub mod primary;
pub mod scene;
pub mod simulate;
pub mod simulator;
pub mod tags;
pub mod tailor;
pub mod telemetry;
pub mod upsample;
pub mod view;
pub mod watchdog;

/// The garment of a store that holds one: ids are given from 0 on and never taken back.
pub const FIRST_GARMENT: protocol::GarmentId = protocol::GarmentId(0);

/// The simulation kernel: its test bench and its fabrics are for the command line too.
pub use cloth;

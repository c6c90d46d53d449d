//! The cloth simulation kernel: mesh, material, body, contact, solver, measures.
//!
//! Goals: one `step` from a [`State`] to the next over a moving skinned body; nothing hidden
//! between steps (positions and velocities are the whole state); bit-equal results for equal
//! inputs; no allocation per step after warm-up.
//!
//! Non-goals: files, threads, clocks, garments of a particular scene, graphs of states.
//!
//! Units: metres, kilograms, seconds, radians; y up; right-handed. All arithmetic is f32 unless a
//! function says otherwise.
//!
//! Map: [`rigid`] rigid transforms; [`body`] skeleton, poses, skinning; [`mesh`] garment
//! topology; [`material`] physical constants; [`model`] what does not change during a run;
//! [`solver`] the step; [`surface`], [`bvh`], [`triangle`] closest points of a moving surface;
//! [`measure`] strain, penetration, clearance; [`fabrics`] measured fabrics by name; [`lab`] the test
//! bench.

pub mod body;
pub mod bvh;
pub mod coarse;
pub mod crossings;
pub mod fabrics;
pub mod lab;
pub mod material;
pub mod measure;
pub mod mesh;
pub mod model;
pub mod rigid;
mod segment;
pub mod solver;
pub mod surface;
mod tree;
pub mod triangle;
mod wide;

pub use body::{Body, Pose, Skeleton};
pub use crossings::{Crossing, Crossings, crossings};
pub use glam::{Quat, Vec3};
pub use material::{Material, MembraneStiffness};
pub use mesh::{Mesh, MeshError};
pub use model::{Environment, Model, ModelError, State};
pub use rigid::Rigid;
pub use solver::{Span, Workspace, step};
pub use surface::Surface;

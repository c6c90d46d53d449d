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
//! [`solver`] the step; [`measure`] strain, penetration, clearance.

pub mod body;
pub mod rigid;

pub use body::{Body, Pose, Skeleton};
pub use glam::{Quat, Vec3};
pub use rigid::Rigid;

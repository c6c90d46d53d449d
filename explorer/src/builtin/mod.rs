//! The built-in scene `robe`: our own character, its clips and a hooded robe, all made by code.
//!
//! Nothing is read from outside and nothing is random: every call makes the same scene, bit for
//! bit on one machine.
//!
//! Map: `skeleton` joints; `figure` poses by inverse kinematics; `gait`, `curve`, `clips` motion;
//! `graph`, `clearance` the primary graph; `field`, `surface`, `remesh` meshes from distance fields;
//! `character` the body; `garment` the robe.

mod character;
mod clearance;
mod clips;
mod curve;
pub(crate) mod field;
mod figure;
mod gait;
pub(crate) mod garment;
mod graph;
pub(crate) mod remesh;
mod skeleton;
pub(crate) mod surface;
#[cfg(test)]
mod tests;

use std::sync::Arc;

use protocol::PoseId;

use crate::primary::PrimaryError;
use crate::scene::{ExplorationSettings, MetricSettings, Scene};

/// Why the built-in scene could not be made: our own mistake, never the caller's.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum BuiltinError {
    /// Body or robe came out with an edge that more than two triangles share.
    #[error("the built-in {mesh} is not a manifold at edge {edge:?}; please report it")]
    NotManifold {
        /// `body` or `robe`.
        mesh: &'static str,
        /// Its two vertices.
        edge: [u32; 2],
    },
    /// Body or robe came out with another number of openings than it has by design.
    #[error("the built-in {mesh} has {found} openings instead of {wanted}; please report it")]
    Openings {
        /// `body` or `robe`.
        mesh: &'static str,
        /// How many closed boundary curves were found.
        found: usize,
        /// How many there shall be.
        wanted: usize,
    },
    /// A number of vertices for which no robe can be made.
    #[error("a robe of {asked} vertices cannot be made; ask for {least} to {most}")]
    Vertices {
        /// As asked for.
        asked: usize,
        /// The fewest.
        least: usize,
        /// The most.
        most: usize,
    },
    /// Clips and transitions do not form a primary graph.
    #[error("the built-in motion graph does not hold together: {0}; please report it")]
    Primary(#[from] PrimaryError),
}

/// The built-in scene: a character of 1.7 m that walks, runs, turns, jumps, kicks and spins in a
/// hooded robe of about 3,100 vertices, or of exactly `vertices`.
///
/// Meshes are in the rest pose (m), y up, facing +z. The garment starts from the first frame of
/// the walk. Cost: under a second.
///
/// # Errors
/// A number of vertices for which no robe can be made; else only if a change to this module broke
/// it.
pub fn robe(vertices: Option<usize>) -> Result<Scene, BuiltinError> {
    let body = character::body()?;
    let garment = garment::robe(&body, vertices)?;
    let cycles = clips::clips(&body.skeleton);
    let primary = graph::primary_graph(&body.skeleton, &cycles)?;
    Ok(Scene {
        name: "robe".into(),
        body: Arc::new(body),
        primary: Arc::new(primary),
        start: PoseId(0),
        garment,
        exploration: ExplorationSettings {
            tolerance_m: 0.015,
            // Short rounds: on two cores a version every few seconds, so that there is
            // something to watch.
            depth_frames: 20,
            round_jobs: 4,
            publish_every_frames: 60,
            drape_frames: 20,
            ..ExplorationSettings::default()
        },
        metric: MetricSettings::default(),
        simulator: None,
    })
}

/// Refuses a mesh that is no manifold with the given number of openings.
fn check(mesh: &surface::Mesh, name: &'static str, wanted: usize) -> Result<(), BuiltinError> {
    let openings = mesh.boundary_loops();
    let found = openings.map_err(|edge| BuiltinError::NotManifold { mesh: name, edge })?;
    if found != wanted {
        return Err(BuiltinError::Openings { mesh: name, found, wanted });
    }
    Ok(())
}

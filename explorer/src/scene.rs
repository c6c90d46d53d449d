//! A scene as the explorer works on it: read by [`crate::import`] or made by [`crate::builtin`].

use std::sync::Arc;

use cloth::{Body, Vec3};

use crate::primary::PrimaryGraph;
use protocol::PoseId;

/// A character, its primary graph, and a garment.
#[derive(Debug, Clone)]
pub struct Scene {
    /// Name of the scene.
    pub name: String,
    /// The character.
    pub body: Arc<Body>,
    /// Its motion.
    pub primary: Arc<PrimaryGraph>,
    /// Where exploration starts (the garment is draped there) and players enter.
    pub start: PoseId,
    /// The garment.
    pub garment: Garment,
    /// How states are compared and how far exploration goes.
    pub exploration: ExplorationSettings,
}

/// A garment in the rest pose of the character it was made for.
#[derive(Debug, Clone, PartialEq)]
pub struct Garment {
    /// Unique in the world.
    pub name: String,
    /// Vertices in the body's rest pose (m), refined to the scene's edge length.
    pub positions: Vec<Vec3>,
    /// Counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Vertices that are held to the body where they lie in the rest pose; sorted.
    pub attached: Vec<u32>,
    /// The cloth.
    pub fabric: Fabric,
}

/// Physical constants of the cloth, as a scene file gives them.
pub use cloth::Material as Fabric;

/// How states are compared, and how far the graph is grown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExplorationSettings {
    /// Seconds by which velocities are scaled in the metric (Kim et al. 2013, section 5.1).
    pub velocity_time_s: f32,
    /// A trajectory stops once it is this near to a known state (m).
    pub tolerance_m: f32,
    /// Longest expansion from a dead end (frames).
    pub depth_frames: u32,
    /// Jobs of a round, chosen from one snapshot.
    pub round_jobs: u32,
    /// A version is published each time this many frames have been simulated.
    pub publish_every_frames: u64,
    /// Frames from the rest pose to the start pose, then the same number to settle.
    pub drape_frames: u32,
    /// Largest rank of the basis frozen at the first version.
    pub rank_max: u16,
    /// Ground plane at y = 0.
    pub ground: bool,
}

impl Default for ExplorationSettings {
    fn default() -> Self {
        Self {
            velocity_time_s: 1.0 / 30.0,
            tolerance_m: 0.010,
            depth_frames: 30,
            round_jobs: 8,
            publish_every_frames: 500,
            drape_frames: 45,
            rank_max: 200,
            ground: true,
        }
    }
}

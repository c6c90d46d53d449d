//! A scene as the explorer works on it: read by [`crate::import`] or made by [`crate::builtin`].

use std::sync::Arc;

use cloth::{Body, Vec3};

use crate::pipe::Foreign;
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
    /// How far exploration goes.
    pub exploration: ExplorationSettings,
    /// How states are compared, beyond [`ExplorationSettings::velocity_time_s`].
    pub metric: MetricSettings,
    /// The program that simulates; `None`: our own kernel.
    pub simulator: Option<Foreign>,
}

/// How vertices' distances become one distance.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Norm {
    /// The largest, as in the paper (Kim et al. 2013, section 5.1).
    #[default]
    Largest,
    /// The root mean square.
    Rms,
}

/// What a garment adds to the metric (Kim et al. 2013, section 3.3).
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MetricSettings {
    /// How vertices' distances become one.
    pub norm: Norm,
    /// Weight of each vertex, at least 0; empty where all are 1.
    pub weights: Vec<f32>,
    /// Classes of states; at most [`CLASS_RULES_MAX`].
    pub classes: Vec<ClassRule>,
}

/// Most rules of a scene: a state's class has one bit of each, and one for the watchdog's flag.
pub const CLASS_RULES_MAX: usize = 7;

/// Divides states into two values by where a region of the garment lies relative to a joint.
#[derive(Debug, Clone, PartialEq)]
pub struct ClassRule {
    /// What is classified, e.g. `hood`.
    pub name: String,
    /// The value below the threshold and the value above it, e.g. `down`, `up`.
    pub values: [String; 2],
    /// The joint.
    pub joint: u16,
    /// Vertices whose mean place counts; not empty.
    pub vertices: Vec<u32>,
    /// Unit vector in the axes of the rest pose, carried along by the joint.
    pub axis: Vec3,
    /// How far the mean place lies from the joint along the axis where the value changes (m).
    pub threshold_m: f32,
    /// A merge from the first value into the second is implausible (places in `values`).
    pub implausible: [u8; 2],
    /// What such a merge costs in the queue on top of its error (m).
    pub penalty_m: f32,
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
    /// Layer of each vertex, the innermost 0; empty where there is one layer.
    pub layers: Vec<u8>,
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
    /// Whether the cloth keeps off itself.
    pub self_contact: bool,
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
            self_contact: true,
        }
    }
}

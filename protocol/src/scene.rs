//! What a client needs to walk: skeleton, poses, edges with their alignments, colliders, and
//! optionally the body; and the garment's mesh. Both are chunks, named by hash.

use serde::{Deserialize, Serialize};

use crate::ids::PoseId;

/// A character with its primary graph.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SceneChunk {
    /// Frames per second of the graph.
    pub fps: f32,
    /// Joints; parents come first, joint 0 is the hips.
    pub joints: Vec<Joint>,
    /// Clip names; `Pose::clip` indexes this.
    pub clips: Vec<String>,
    /// Nodes of the primary graph; `PoseId` indexes this.
    pub poses: Vec<Pose>,
    /// Edges, sorted by `from`, then by `to`; `EdgeId` indexes this.
    pub edges: Vec<Edge>,
    /// Capsules that stand for the body where the mesh is too much.
    pub colliders: Vec<Capsule>,
    /// The skinned body, where the publisher gives it away.
    pub body: Option<BodyMesh>,
}

/// A joint of the skeleton.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Joint {
    /// Name as in the character's file.
    pub name: String,
    /// Parent; `None` for joint 0 only.
    pub parent: Option<u16>,
    /// Translation in the parent's frame [m].
    pub offset: [f32; 3],
    /// World position in the bind pose [m].
    pub rest_translation: [f32; 3],
    /// World rotation in the bind pose: x, y, z, w.
    pub rest_rotation: [f32; 4],
}

/// A node of the primary graph.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// The clip it belongs to; for a pose of a transition, the clip that it leads to.
    pub clip: u16,
    /// Frame in that clip.
    pub frame: u32,
    /// Whether this pose belongs to a transition (made, not recorded).
    pub transition: bool,
    /// World position of the hips in the clip's frame [m].
    pub root: [f32; 3],
    /// Rotation per joint in its parent's frame: x, y, z, w, each times 32,767, rounded.
    pub rotations: Vec<[i16; 4]>,
}

/// One pose may follow another. The target's clip is placed by turning it about +y by `yaw` and
/// then shifting it horizontally, so that any walk is continuous in the world.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Edge {
    /// Source.
    pub from: PoseId,
    /// Target.
    pub to: PoseId,
    /// Radians about +y.
    pub yaw: f32,
    /// Metres along x and z.
    pub shift: [f32; 2],
}

/// A capsule that rides on a joint, in the joint's frame [m].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Capsule {
    /// Joint it rides on.
    pub joint: u16,
    /// One end of its axis.
    pub a: [f32; 3],
    /// The other end.
    pub b: [f32; 3],
    /// Radius.
    pub radius: f32,
}

/// The skinned body in the bind pose.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BodyMesh {
    /// Vertices [m].
    pub positions: Vec<[f32; 3]>,
    /// Counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Up to four joints per vertex.
    pub joints: Vec<[u16; 4]>,
    /// Their weights.
    pub weights: Vec<[f32; 4]>,
}

/// The garment's mesh: what the renderer needs beside positions.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GarmentChunk {
    /// Name in the scene.
    pub name: String,
    /// Vertices; a state has three rows per vertex in the basis: x0, y0, z0, x1, ...
    pub vertex_count: u32,
    /// Counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

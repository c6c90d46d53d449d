//! What a client needs to walk: skeleton, poses, edges with their alignments, colliders, and
//! optionally the body; and the garment's mesh. Both are chunks, named by hash.

use serde::{Deserialize, Serialize};

use crate::ids::PoseId;
use crate::limits;
use crate::wire::{DecodeError, Format, at_most, check_finite, check_name, ensure};

const SCENE: Format =
    Format { what: "scene chunk", magic: *b"TSCN", version: 1, bytes_max: limits::CHUNK_BYTES_MAX };

const GARMENT: Format = Format {
    what: "garment chunk",
    magic: *b"TGRM",
    version: 1,
    bytes_max: limits::CHUNK_BYTES_MAX,
};

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
    /// Translation in the parent's frame (m).
    pub offset: [f32; 3],
    /// World position in the bind pose (m).
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
    /// World position of the hips in the clip's frame (m).
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

/// A capsule that rides on a joint, in the joint's frame (m).
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
    /// Vertices (m).
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

impl SceneChunk {
    /// Bytes to store, checked.
    ///
    /// # Errors
    /// It breaks a rule of [`SceneChunk::check`], or is longer than a chunk may be.
    pub fn to_bytes(&self) -> Result<Vec<u8>, DecodeError> {
        self.check()?;
        SCENE.to_bytes(self)
    }

    /// As [`SceneChunk::to_bytes`], for what is known to be good.
    ///
    /// # Panics
    /// Where that refuses.
    pub fn encode(&self) -> Vec<u8> {
        self.to_bytes().expect("a scene chunk is checked before it is written")
    }

    /// Reads and checks.
    ///
    /// # Errors
    /// Damaged bytes, or a scene that breaks a rule of [`SceneChunk::check`].
    pub fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
        let scene: Self = SCENE.decode(bytes)?;
        scene.check()?;
        Ok(scene)
    }

    /// Indices in range, parents before children, numbers finite, quaternions of unit length
    /// (within 1 %), edges sorted, an out-edge for every pose.
    ///
    /// # Errors
    /// The first rule that is broken, with its place.
    pub fn check(&self) -> Result<(), DecodeError> {
        self.check_skeleton()
            .and_then(|()| self.check_poses())
            .and_then(|()| self.check_edges())
            .and_then(|()| self.check_shapes())
            .map_err(|why| SCENE.invalid(why))
    }

    fn check_skeleton(&self) -> Result<(), String> {
        ensure(self.fps.is_finite() && self.fps > 0.0, || {
            format!("{} frames per second", self.fps)
        })?;
        at_most("joints", self.joints.len(), limits::JOINTS_MAX)?;
        ensure(!self.joints.is_empty(), || "no joint".into())?;
        for (index, joint) in self.joints.iter().enumerate() {
            check_name(&format!("joint {index}"), &joint.name)?;
            let parent_fits = match joint.parent {
                None => index == 0,
                Some(parent) => usize::from(parent) < index,
            };
            ensure(parent_fits, || {
                format!("joint {index} has parent {:?}; parents come first", joint.parent)
            })?;
            check_finite("joint", index, &joint.offset)?;
            check_finite("joint", index, &joint.rest_translation)?;
            check_finite("joint", index, &joint.rest_rotation)?;
            let square: f32 = joint.rest_rotation.iter().map(|x| x * x).sum();
            check_unit("rest rotation of joint", index, f64::from(square).sqrt())?;
        }
        Ok(())
    }

    fn check_poses(&self) -> Result<(), String> {
        at_most("clips", self.clips.len(), usize::from(u16::MAX))?;
        for (index, clip) in self.clips.iter().enumerate() {
            check_name(&format!("clip {index}"), clip)?;
        }
        at_most("poses", self.poses.len(), limits::POSES_MAX)?;
        ensure(!self.poses.is_empty(), || "no pose".into())?;
        for (index, pose) in self.poses.iter().enumerate() {
            ensure(usize::from(pose.clip) < self.clips.len(), || {
                format!("pose {index} is of clip {} of {}", pose.clip, self.clips.len())
            })?;
            check_finite("pose", index, &pose.root)?;
            ensure(pose.rotations.len() == self.joints.len(), || {
                let (rotations, joints) = (pose.rotations.len(), self.joints.len());
                format!("pose {index} has {rotations} rotations for {joints} joints")
            })?;
            for q in &pose.rotations {
                let square: f64 = q.iter().map(|&x| f64::from(x).powi(2)).sum();
                check_unit("a rotation of pose", index, square.sqrt() / f64::from(i16::MAX))?;
            }
        }
        Ok(())
    }

    fn check_edges(&self) -> Result<(), String> {
        at_most("edges", self.edges.len(), limits::EDGES_MAX)?;
        let mut pose_reached = 0;
        for (index, edge) in self.edges.iter().enumerate() {
            let poses = self.poses.len();
            ensure(edge.from.index() < poses && edge.to.index() < poses, || {
                format!("edge {index} leads from pose {} to {} of {poses}", edge.from, edge.to)
            })?;
            check_finite("edge", index, &[edge.yaw, edge.shift[0], edge.shift[1]])?;
            let before = index.checked_sub(1).map(|i| (self.edges[i].from, self.edges[i].to));
            ensure(before <= Some((edge.from, edge.to)), || {
                format!("edge {index} is out of order; edges are sorted by from, then by to")
            })?;
            ensure(edge.from.index() <= pose_reached, || no_way_out(pose_reached))?;
            pose_reached = edge.from.index() + 1;
        }
        ensure(pose_reached == self.poses.len(), || no_way_out(pose_reached))
    }

    fn check_shapes(&self) -> Result<(), String> {
        at_most("colliders", self.colliders.len(), limits::COLLIDERS_MAX)?;
        for (index, capsule) in self.colliders.iter().enumerate() {
            ensure(usize::from(capsule.joint) < self.joints.len(), || {
                format!("collider {index} rides on joint {}", capsule.joint)
            })?;
            check_finite("collider", index, &capsule.a)?;
            check_finite("collider", index, &capsule.b)?;
            check_finite("collider", index, &[capsule.radius])?;
            ensure(capsule.radius >= 0.0, || format!("collider {index} has a negative radius"))?;
        }
        self.body.as_ref().map_or(Ok(()), |body| body.check(self.joints.len()))
    }
}

fn no_way_out(pose: usize) -> String {
    format!("pose {pose} has no out-edge; playing would end there")
}

fn check_unit(what: &str, index: usize, length: f64) -> Result<(), String> {
    ensure((length - 1.0).abs() < 0.01, || format!("{what} {index} has length {length}, not 1"))
}

fn check_triangles(triangles: &[[u32; 3]], vertex_count: usize) -> Result<(), String> {
    at_most("vertices", vertex_count, limits::VERTICES_MAX)?;
    at_most("triangles", triangles.len(), limits::TRIANGLES_MAX)?;
    for (index, [a, b, c]) in triangles.iter().enumerate() {
        ensure([a, b, c].iter().all(|v| (**v as usize) < vertex_count), || {
            format!("triangle {index} names vertices {a}, {b}, {c} of {vertex_count}")
        })?;
        ensure(a != b && b != c && c != a, || format!("triangle {index} names a vertex twice"))?;
    }
    Ok(())
}

impl BodyMesh {
    fn check(&self, joint_count: usize) -> Result<(), String> {
        let vertices = self.positions.len();
        check_triangles(&self.triangles, vertices)?;
        ensure(self.joints.len() == vertices && self.weights.len() == vertices, || {
            let (joints, weights) = (self.joints.len(), self.weights.len());
            format!("body: {vertices} vertices, {joints} joint rows, {weights} weight rows")
        })?;
        for index in 0..vertices {
            check_finite("body vertex", index, &self.positions[index])?;
            check_finite("body vertex", index, &self.weights[index])?;
            let joints = &self.joints[index];
            ensure(joints.iter().all(|j| usize::from(*j) < joint_count), || {
                format!("body vertex {index} hangs on joints {joints:?} of {joint_count}")
            })?;
        }
        Ok(())
    }
}

impl GarmentChunk {
    /// Bytes to store, checked.
    ///
    /// # Errors
    /// It breaks a rule of [`GarmentChunk::check`], or is longer than a chunk may be.
    pub fn to_bytes(&self) -> Result<Vec<u8>, DecodeError> {
        self.check()?;
        GARMENT.to_bytes(self)
    }

    /// As [`GarmentChunk::to_bytes`], for what is known to be good.
    ///
    /// # Panics
    /// Where that refuses.
    pub fn encode(&self) -> Vec<u8> {
        self.to_bytes().expect("a garment chunk is checked before it is written")
    }

    /// Reads and checks.
    ///
    /// # Errors
    /// Damaged bytes, or a mesh that breaks a rule of [`GarmentChunk::check`].
    pub fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
        let garment: Self = GARMENT.decode(bytes)?;
        garment.check()?;
        Ok(garment)
    }

    /// A name, at least one vertex, triangles of three different vertices in range.
    ///
    /// # Errors
    /// The first rule that is broken, with its place.
    pub fn check(&self) -> Result<(), DecodeError> {
        check_name("the garment", &self.name)
            .and_then(|()| ensure(self.vertex_count > 0, || "no vertex".into()))
            .and_then(|()| check_triangles(&self.triangles, self.vertex_count as usize))
            .map_err(|why| GARMENT.invalid(why))
    }
}

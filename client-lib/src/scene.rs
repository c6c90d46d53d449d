//! A character as the client walks it: the checked form of a `SceneChunk`.

use cloth::{Body, Pose, Quat, Rigid, Skeleton, Vec3};
use protocol::scene::{BodyMesh, Capsule, Edge, SceneChunk};
use protocol::{DecodeError, EdgeId, PoseId};

/// The primary graph with its character, checked once, so that walking it needs no checks.
#[derive(Debug, Clone)]
pub struct Scene {
    fps: f32,
    clips: Vec<String>,
    skeleton: Skeleton,
    body: Option<Body>,
    colliders: Vec<Capsule>,
    poses: Vec<ScenePose>,
    edges: Vec<Edge>,
    first_edge: Vec<u32>,
    bytes: usize,
}

/// A node of the primary graph.
#[derive(Debug, Clone)]
struct ScenePose {
    clip: u16,
    frame: u32,
    transition: bool,
    root: Vec3,
    rotations: Vec<[i16; 4]>,
}

impl Scene {
    /// Checks a chunk and prepares it for walking.
    ///
    /// # Errors
    /// The first rule of [`SceneChunk::check`] that is broken.
    pub fn new(chunk: SceneChunk) -> Result<Self, DecodeError> {
        chunk.check()?;
        let bytes = resident_bytes(&chunk);
        let skeleton = skeleton(&chunk);
        let first_edge = (0..=chunk.poses.len())
            .map(|pose| chunk.edges.partition_point(|e| e.from.index() < pose) as u32)
            .collect();
        let poses = chunk.poses.into_iter().map(|pose| ScenePose {
            clip: pose.clip,
            frame: pose.frame,
            transition: pose.transition,
            root: Vec3::from_array(pose.root),
            rotations: pose.rotations,
        });
        Ok(Self {
            fps: chunk.fps,
            clips: chunk.clips,
            body: chunk.body.map(|mesh| body(mesh, &skeleton)),
            skeleton,
            colliders: chunk.colliders,
            poses: poses.collect(),
            edges: chunk.edges,
            first_edge,
            bytes,
        })
    }

    /// Frames per second of the graph: how often `step` is called.
    pub fn fps(&self) -> f32 {
        self.fps
    }

    /// Clip names.
    pub fn clips(&self) -> &[String] {
        &self.clips
    }

    /// Index of a clip by name.
    pub fn clip(&self, name: &str) -> Option<u16> {
        self.clips.iter().position(|clip| clip == name).map(|clip| clip as u16)
    }

    /// Number of poses.
    pub fn pose_count(&self) -> usize {
        self.poses.len()
    }

    /// Whether a pose is of this scene: one of another version may not be. Below, those that are not are
    /// the caller's mistake, for these are called many times a frame.
    pub fn has(&self, pose: PoseId) -> bool {
        pose.index() < self.poses.len()
    }

    /// All edges, by id; sorted by source, then target.
    pub fn edges(&self) -> &[Edge] {
        &self.edges
    }

    /// The clip of a pose; for a pose of a transition, the clip that it leads to.
    ///
    /// # Panics
    /// If the pose is not of this scene.
    pub fn clip_of(&self, pose: PoseId) -> u16 {
        self.poses[pose.index()].clip
    }

    /// The frame of a pose in its clip.
    ///
    /// # Panics
    /// If the pose is not of this scene.
    pub fn frame_of(&self, pose: PoseId) -> u32 {
        self.poses[pose.index()].frame
    }

    /// Whether the pose was made for a transition.
    ///
    /// # Panics
    /// If the pose is not of this scene.
    pub fn is_transition(&self, pose: PoseId) -> bool {
        self.poses[pose.index()].transition
    }

    /// Out-edges of a pose: consecutive ids, never empty.
    ///
    /// # Panics
    /// If the pose is not of this scene.
    pub fn out_edges(&self, pose: PoseId) -> impl DoubleEndedIterator<Item = EdgeId> + use<> {
        (self.first_edge[pose.index()]..self.first_edge[pose.index() + 1]).map(EdgeId)
    }

    /// How many edges leave a pose.
    ///
    /// # Panics
    /// If the pose is not of this scene.
    pub fn out_degree(&self, pose: PoseId) -> usize {
        (self.first_edge[pose.index() + 1] - self.first_edge[pose.index()]) as usize
    }

    /// The edge from one pose to another, or `None` where `to` is no successor.
    pub fn edge_between(&self, from: PoseId, to: PoseId) -> Option<EdgeId> {
        let out_edges = self.has(from).then(|| self.out_edges(from));
        out_edges?.find(|edge| self.edges[edge.index()].to == to)
    }

    /// Position of an edge among the out-edges of its source: the index into a link entry.
    ///
    /// # Panics
    /// If the edge is not of this scene.
    pub fn slot(&self, edge: EdgeId) -> usize {
        (edge.0 - self.first_edge[self.edges[edge.index()].from.index()]) as usize
    }

    /// Moves the target's clip into the world of the source's clip.
    ///
    /// # Panics
    /// If the edge is not of this scene.
    pub fn alignment(&self, edge: EdgeId) -> Rigid {
        let Edge { yaw, shift, .. } = self.edges[edge.index()];
        Rigid::from_yaw(yaw, Vec3::new(shift[0], 0.0, shift[1]))
    }

    /// The hips in the world of the pose's clip: the state frame.
    ///
    /// # Panics
    /// If the pose is not of this scene.
    pub fn hips(&self, pose: PoseId) -> Rigid {
        let pose = &self.poses[pose.index()];
        Rigid { rotation: rotation(pose.rotations[0]), translation: pose.root }
    }

    /// A pose in the world of its clip, for skinning.
    ///
    /// # Panics
    /// If the pose is not of this scene.
    pub fn pose(&self, pose: PoseId) -> Pose {
        let pose = &self.poses[pose.index()];
        Pose { root: pose.root, rotations: pose.rotations.iter().map(|q| rotation(*q)).collect() }
    }

    /// As [`Scene::pose`], into a pose that keeps its memory.
    ///
    /// # Panics
    /// If the pose is not of this scene.
    pub fn pose_into(&self, pose: PoseId, out: &mut Pose) {
        let pose = &self.poses[pose.index()];
        out.root = pose.root;
        out.rotations.clear();
        out.rotations.extend(pose.rotations.iter().map(|q| rotation(*q)));
    }

    /// The character's joints.
    pub fn skeleton(&self) -> &Skeleton {
        &self.skeleton
    }

    /// The skinned body, where the publisher gives it away.
    pub fn body(&self) -> Option<&Body> {
        self.body.as_ref()
    }

    /// Capsules that stand for the body.
    pub fn colliders(&self) -> &[Capsule] {
        &self.colliders
    }

    /// Memory held, in bytes.
    pub fn resident_bytes(&self) -> usize {
        self.bytes
    }
}

/// Unit quaternion of a stored rotation (x, y, z, w, each times 32,767).
fn rotation(q: [i16; 4]) -> Quat {
    Quat::from_array(q.map(|x| f32::from(x) / 32_767.0)).normalize()
}

fn skeleton(chunk: &SceneChunk) -> Skeleton {
    let joints = &chunk.joints;
    Skeleton {
        names: joints.iter().map(|j| j.name.clone()).collect(),
        parents: joints.iter().map(|j| j.parent).collect(),
        offsets: joints.iter().map(|j| Vec3::from_array(j.offset)).collect(),
        rest: joints
            .iter()
            .map(|j| Rigid {
                rotation: Quat::from_array(j.rest_rotation).normalize(),
                translation: Vec3::from_array(j.rest_translation),
            })
            .collect(),
    }
}

fn body(mesh: BodyMesh, skeleton: &Skeleton) -> Body {
    Body {
        skeleton: skeleton.clone(),
        rest_positions: mesh.positions.iter().map(|p| Vec3::from_array(*p)).collect(),
        triangles: mesh.triangles,
        joints: mesh.joints,
        weights: mesh.weights,
    }
}

/// About what the checked scene takes in memory.
fn resident_bytes(chunk: &SceneChunk) -> usize {
    let per_pose = size_of::<ScenePose>() + chunk.joints.len() * size_of::<[i16; 4]>() + 4;
    let body = chunk.body.as_ref().map_or(0, |b| b.positions.len() * 36 + b.triangles.len() * 12);
    chunk.poses.len() * per_pose + chunk.edges.len() * size_of::<Edge>() + body
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tiny;

    #[test]
    fn a_good_scene_is_read() {
        let scene = Scene::new(tiny::scene_chunk()).unwrap();
        assert_eq!(scene.pose_count(), 2);
        assert_eq!(scene.out_degree(PoseId(0)), 2);
        let edge = scene.edge_between(PoseId(1), PoseId(0)).unwrap();
        assert_eq!((edge, scene.slot(edge)), (EdgeId(2), 0));
        assert_eq!(scene.edge_between(PoseId(1), PoseId(1)), None);
        assert!(scene.has(PoseId(1)) && !scene.has(PoseId(2)));
        assert_eq!(scene.edge_between(PoseId(2), PoseId(1)), None);
        let mut steer = crate::Steer::new(&std::sync::Arc::new(scene));
        assert_eq!((steer.next(PoseId(2), 0), steer.frames_to(PoseId(2), 0)), (None, None));
    }

    #[test]
    fn a_broken_scene_is_refused() {
        let mut chunk = tiny::scene_chunk();
        chunk.edges.truncate(2);
        assert!(Scene::new(chunk).unwrap_err().to_string().contains("out-edge"));
    }
}

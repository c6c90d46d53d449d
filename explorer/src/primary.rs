//! The primary graph: one node per pose, edges where one pose may follow another.

use cloth::{Pose, Rigid, Vec3};
use protocol::{EdgeId, PoseId};

/// A node of the primary graph.
#[derive(Debug, Clone, PartialEq)]
pub struct PrimaryPose {
    /// Index into `PrimaryGraph::clips`; for a pose of a transition, the clip that it leads to.
    pub clip: u16,
    /// Frame in that clip (for a pose of a transition: the frame that it stands for).
    pub frame: u32,
    /// Whether the pose was made for a transition.
    pub transition: bool,
    /// The pose in the world of its clip.
    pub pose: Pose,
}

/// An edge: `to` may follow `from`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PrimaryEdge {
    /// Source.
    pub from: PoseId,
    /// Target.
    pub to: PoseId,
    /// Turn of the target's clip about +y (rad), before the shift.
    pub yaw: f32,
    /// Horizontal shift of the target's clip: x and z (m).
    pub shift: [f32; 2],
}

impl PrimaryEdge {
    /// Moves the target's clip into the world of the source's clip.
    pub fn alignment(&self) -> Rigid {
        Rigid::from_yaw(self.yaw, Vec3::new(self.shift[0], 0.0, self.shift[1]))
    }
}

/// Why a primary graph was refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PrimaryError {
    /// An edge names a pose that does not exist.
    #[error("edge {edge} names pose {pose}, but there are {poses} poses")]
    UnknownPose {
        /// Position of the edge in the list.
        edge: usize,
        /// The pose it names.
        pose: u32,
        /// How many there are.
        poses: usize,
    },
    /// A pose without an out-edge: playing would end there.
    #[error("pose {0} has no out-edge")]
    NoWayOut(PoseId),
}

/// Poses and edges; every pose has at least one out-edge. Edges are sorted by source, then target.
#[derive(Debug, Clone, PartialEq)]
pub struct PrimaryGraph {
    fps: f32,
    clips: Vec<String>,
    poses: Vec<PrimaryPose>,
    edges: Vec<PrimaryEdge>,
    first_edge: Vec<u32>,
}

impl PrimaryGraph {
    /// Sorts and checks.
    ///
    /// # Errors
    /// An edge to nowhere, or a pose without an out-edge.
    pub fn new(
        fps: f32,
        clips: Vec<String>,
        poses: Vec<PrimaryPose>,
        mut edges: Vec<PrimaryEdge>,
    ) -> Result<Self, PrimaryError> {
        for (edge, e) in edges.iter().enumerate() {
            if let Some(pose) = [e.from, e.to].into_iter().find(|p| p.index() >= poses.len()) {
                return Err(PrimaryError::UnknownPose { edge, pose: pose.0, poses: poses.len() });
            }
        }
        edges.sort_by_key(|e| (e.from, e.to));
        let mut first_edge = vec![0u32; poses.len() + 1];
        for e in &edges {
            first_edge[e.from.index() + 1] += 1;
        }
        for pose in 0..poses.len() {
            if first_edge[pose + 1] == 0 {
                return Err(PrimaryError::NoWayOut(PoseId(pose as u32)));
            }
            first_edge[pose + 1] += first_edge[pose];
        }
        Ok(Self { fps, clips, poses, edges, first_edge })
    }

    /// Frames per second.
    pub fn fps(&self) -> f32 {
        self.fps
    }

    /// Clip names.
    pub fn clips(&self) -> &[String] {
        &self.clips
    }

    /// All poses, by id.
    pub fn poses(&self) -> &[PrimaryPose] {
        &self.poses
    }

    /// All edges, by id.
    pub fn edges(&self) -> &[PrimaryEdge] {
        &self.edges
    }

    /// A pose by id.
    pub fn pose(&self, pose: PoseId) -> &PrimaryPose {
        &self.poses[pose.index()]
    }

    /// An edge by id.
    pub fn edge(&self, edge: EdgeId) -> &PrimaryEdge {
        &self.edges[edge.index()]
    }

    /// Ids of the out-edges of a pose, consecutive and never empty.
    pub fn out_edges(&self, pose: PoseId) -> impl DoubleEndedIterator<Item = EdgeId> + use<> {
        (self.first_edge[pose.index()]..self.first_edge[pose.index() + 1]).map(EdgeId)
    }

    /// Number of out-edges of a pose.
    pub fn out_degree(&self, pose: PoseId) -> usize {
        (self.first_edge[pose.index() + 1] - self.first_edge[pose.index()]) as usize
    }
}

//! The initial pass, planned before anything is simulated.
//!
//! Breadth-first search from the start pose over every primary edge once (Kim et al. 2013,
//! section 3.2): an edge that reaches a pose first is a tree edge, and the state simulated along
//! it stays interior; along any other edge the state is a dead end. So each pose has exactly one
//! interior state, and the tree does not depend on the simulation. It is cut into chains, which
//! are the initial jobs.

use std::collections::VecDeque;

use protocol::{EdgeId, PoseId};

use crate::primary::PrimaryGraph;

/// Longest chain of one job: one region's worth, so that workers share the pass evenly and a kill
/// costs little.
pub const CHAIN_FRAMES: usize = protocol::limits::REGION_STATES_MAX;

/// One initial job: edges in the order in which they are simulated.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InitialJob {
    /// The pose whose interior state it starts from.
    pub start: PoseId,
    /// First a chain of edges, each from the pose that the one before reached; then single edges
    /// from poses of the chain to poses that are known already.
    pub edges: Vec<EdgeId>,
    /// Frames on the longest way from its start to a leaf of the tree: what is urgent.
    pub height: u32,
}

/// All jobs of the initial pass.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Plan {
    jobs: Vec<InitialJob>,
    tree: Vec<bool>,
}

impl Plan {
    /// Plans the initial pass. Edges of poses that cannot be reached from `start` are left out.
    pub fn new(primary: &PrimaryGraph, start: PoseId) -> Self {
        let (order, tree) = breadth_first(primary, start);
        let heavy = heaviest_edges(primary, &order, &tree);
        let mut jobs = Vec::new();
        let mut heads = VecDeque::from([(start, None)]);
        while let Some((pose, first)) = heads.pop_front() {
            jobs.push(chain(primary, (&tree, &heavy), (pose, first), &mut heads));
        }
        Self { jobs, tree }
    }

    /// The jobs; a job's start is reached by an earlier one.
    pub fn jobs(&self) -> &[InitialJob] {
        &self.jobs
    }

    /// Whether the state simulated along `edge` stays interior.
    pub fn is_tree(&self, edge: EdgeId) -> bool {
        self.tree[edge.index()]
    }

    /// Frames of the whole pass: one per edge.
    pub fn frames(&self) -> u64 {
        self.jobs.iter().map(|job| job.edges.len() as u64).sum()
    }
}

/// The heaviest tree edge out of each pose, and the height of each pose above the leaves.
struct Heavy {
    edge: Vec<Option<EdgeId>>,
    height: Vec<u32>,
}

/// Poses in order of discovery, and which edges discovered one.
fn breadth_first(primary: &PrimaryGraph, start: PoseId) -> (Vec<PoseId>, Vec<bool>) {
    let mut tree = vec![false; primary.edges().len()];
    let mut seen = vec![false; primary.poses().len()];
    let mut order = vec![start];
    seen[start.index()] = true;
    let mut next = 0;
    while next < order.len() {
        for edge in primary.out_edges(order[next]) {
            let to = primary.edge(edge).to;
            if !seen[to.index()] {
                seen[to.index()] = true;
                tree[edge.index()] = true;
                order.push(to);
            }
        }
        next += 1;
    }
    (order, tree)
}

fn heaviest_edges(primary: &PrimaryGraph, order: &[PoseId], tree: &[bool]) -> Heavy {
    let poses = primary.poses().len();
    let mut heavy = Heavy { edge: vec![None; poses], height: vec![1; poses] };
    for &pose in order.iter().rev() {
        for edge in primary.out_edges(pose).filter(|edge| tree[edge.index()]) {
            let height = heavy.height[primary.edge(edge).to.index()] + 1;
            if heavy.edge[pose.index()].is_none() || height > heavy.height[pose.index()] {
                heavy.edge[pose.index()] = Some(edge);
                heavy.height[pose.index()] = height;
            }
        }
    }
    heavy
}

/// Cuts the chain that begins at `head` (through a given light edge, or through the heaviest edge
/// of its pose) and queues the chains that branch off it.
fn chain(
    primary: &PrimaryGraph,
    (tree, heavy): (&[bool], &Heavy),
    (start, first): (PoseId, Option<EdgeId>),
    heads: &mut VecDeque<(PoseId, Option<EdgeId>)>,
) -> InitialJob {
    let mut edges = Vec::new();
    let mut passed = Vec::new();
    let mut next = first;
    if first.is_none() {
        passed.push(start);
        next = heavy.edge[start.index()];
    }
    while let Some(edge) = next {
        edges.push(edge);
        let pose = primary.edge(edge).to;
        next = heavy.edge[pose.index()];
        if next.is_some() && edges.len() >= CHAIN_FRAMES {
            heads.push_back((pose, None));
            break;
        }
        passed.push(pose);
    }
    // At a leaf of the tree a known pose follows: its dead end ends the same trajectory.
    if next.is_none() {
        let leaf = passed.pop().expect("a leaf was passed");
        edges.extend(primary.out_edges(leaf));
    }
    for &pose in &passed {
        for edge in primary.out_edges(pose) {
            if !tree[edge.index()] {
                edges.push(edge);
            } else if heavy.edge[pose.index()] != Some(edge) {
                heads.push_back((pose, Some(edge)));
            }
        }
    }
    let height = match first {
        Some(edge) => heavy.height[primary.edge(edge).to.index()] + 1,
        None => heavy.height[start.index()],
    };
    InitialJob { start, edges, height }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grow::toy;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn every_edge_once_and_every_start_reached_before(graph in toy::any_primary(24)) {
            let plan = Plan::new(&graph, PoseId(0));
            let mut simulated = vec![0; graph.edges().len()];
            let mut reached = vec![false; graph.poses().len()];
            reached[0] = true;
            for job in plan.jobs() {
                prop_assert!(reached[job.start.index()]);
                for &edge in &job.edges {
                    simulated[edge.index()] += 1;
                    prop_assert!(reached[graph.edge(edge).from.index()]);
                    if plan.is_tree(edge) {
                        let to = graph.edge(edge).to.index();
                        prop_assert!(!reached[to]);
                        reached[to] = true;
                    }
                }
            }
            prop_assert!(simulated.iter().all(|&times| times == 1));
            prop_assert!(reached.iter().all(|&r| r));
            prop_assert_eq!(plan.frames(), graph.edges().len() as u64);
        }
    }

    #[test]
    fn a_long_clip_is_cut_into_jobs() {
        let poses = 150;
        let ring: Vec<(u32, u32)> = (0..poses).map(|p| (p, (p + 1) % poses)).collect();
        let plan = Plan::new(&toy::primary(poses, &ring), PoseId(0));
        let lengths: Vec<usize> = plan.jobs().iter().map(|job| job.edges.len()).collect();
        assert_eq!(lengths, [32, 32, 32, 32, 22]);
        assert_eq!(plan.jobs()[1].start, PoseId(32));
        assert_eq!(plan.jobs()[0].height, 150);
    }

    #[test]
    fn a_single_pose_that_follows_itself_is_one_dead_end() {
        let plan = Plan::new(&toy::primary(1, &[(0, 0)]), PoseId(0));
        assert_eq!(plan.jobs().len(), 1);
        assert_eq!(plan.jobs()[0].edges, [EdgeId(0)]);
        assert!(!plan.is_tree(EdgeId(0)));
    }
}

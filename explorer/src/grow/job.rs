//! What a worker does: simulate from one state, decide which new states are dead ends, and find
//! the most similar interior state for each.
//!
//! Every decision depends on the job's start and on the snapshot of its round alone.

use std::collections::VecDeque;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use protocol::{EdgeId, PoseId, StateId};

use super::ahead::Use;
use super::aim::Aims;
use super::class::{self, Class, Classifier};
use super::plan::{InitialJob, Plan};
use super::similar::{Found, Similar};
use super::states::StateFile;
use crate::grid::GridState;
use crate::primary::PrimaryGraph;
use crate::simulator::{FrameQuality, SimulateError, Simulator};

/// Most states of one job. Only a dense primary graph gets there: beyond it the tree stops.
pub const JOB_STATES_MAX: usize = 512;
/// Most states of a job that somebody waits for: two seconds of cloth.
pub const TAGGED_STATES_MAX: usize = 64;

/// What jobs are judged by.
#[derive(Debug, Clone, Copy)]
pub struct Rules {
    /// A trajectory stops this near to a known state (m).
    pub tolerance_m: f32,
    /// Longest way from the start (frames).
    pub depth_frames: u32,
    /// As in the paper: neither early stop nor re-merging.
    pub paper: bool,
}

/// What all jobs of a round share.
#[derive(Debug, Clone, Copy)]
pub struct Context<'a> {
    /// The primary graph.
    pub primary: &'a PrimaryGraph,
    /// The plan of the initial pass.
    pub plan: &'a Plan,
    /// All states so far.
    pub states: &'a StateFile,
    /// Finds similar states.
    pub similar: &'a Similar,
    /// Tells a state's class.
    pub classifier: &'a Classifier,
    /// Interior states of the snapshot by pose.
    pub known: &'a [Arc<Vec<StateId>>],
    /// How to judge.
    pub rules: &'a Rules,
    /// How far expansions go.
    pub aims: &'a Aims,
    /// Most states of a job.
    pub states_max: usize,
    /// Set when jobs are to be dropped.
    pub abandon: &'a AtomicBool,
    /// Frames that were simulated before their turn.
    pub ahead: Use<'a>,
}

/// A state that has an id, or one of the job's own by its place in [`Outcome::frames`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Local {
    /// Has an id.
    Known(StateId),
    /// Of this job.
    New(u32),
}

/// A simulated frame of a job.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LocalFrame {
    /// What it was simulated from.
    pub parent: Local,
    /// Along which edge.
    pub edge: EdgeId,
    /// Class of the state at its end.
    pub class: Class,
    /// For a dead end of an expansion: the most similar interior state.
    pub merge: Option<Found<Local>>,
}

/// What a job found, chain by chain.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Outcome {
    /// Its frames; a parent comes before its children.
    pub frames: Vec<LocalFrame>,
    /// The states at their ends.
    pub states: Vec<GridState>,
    /// Their measures, added up.
    pub quality: FrameQuality,
}

/// Why a job has no outcome.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum JobError {
    /// A frame could not be simulated.
    #[error("edge {edge}, {depth} frames from its start: {source}")]
    Simulate {
        /// The edge.
        edge: EdgeId,
        /// How far the job had come (frames).
        depth: u32,
        /// What the simulator said.
        source: SimulateError,
    },
    /// Nothing can be simulated, this frame or another.
    #[error("{0}; nor can frames be simulated that were before")]
    OutOfOrder(SimulateError),
    /// A state could not be read.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// It was asked to stop.
    #[error("dropped")]
    Abandoned,
}

/// Runs a job of the initial pass from the state of its start pose.
///
/// # Errors
/// A frame could not be simulated, a state not read, or the job was dropped.
pub fn initial(
    context: &Context<'_>,
    simulator: &mut dyn Simulator,
    job: &InitialJob,
    start: StateId,
) -> Result<Outcome, JobError> {
    let from = context.states.read(start)?;
    let mut outcome = Outcome::default();
    let mut places: Vec<(PoseId, u32)> = Vec::new();
    for &edge in &job.edges {
        let source = context.primary.edge(edge).from;
        let place = places.iter().find(|(pose, _)| *pose == source).map(|(_, place)| *place);
        let (parent, state) = match place {
            Some(place) => (Local::New(place), &outcome.states[place as usize]),
            None => (Local::Known(start), &from),
        };
        let depth = outcome.states.len() as u32;
        let place = (edge, depth);
        let (state, class) = simulate(context, simulator, state, place, &mut outcome.quality)?;
        if context.plan.is_tree(edge) {
            places.push((context.primary.edge(edge).to, depth));
        }
        outcome.frames.push(LocalFrame { parent, edge, class, merge: None });
        outcome.states.push(state);
    }
    Ok(outcome)
}

/// Undoes the merge of a dead end: simulates on from it along every out-edge, breadth first, until
/// near a known state or at full depth, then merges the new dead ends.
///
/// It may be left between two frames and gone on with later, by any worker: what comes of it is the same.
pub struct Expansion {
    tree: Tree,
    queue: VecDeque<usize>,
    /// The node being expanded, and which of its out-edges comes next.
    at: Option<(usize, usize)>,
}

impl Expansion {
    /// Of the dead end `start`.
    ///
    /// # Errors
    /// Its state could not be read.
    pub fn new(context: &Context<'_>, start: StateId, pose: PoseId) -> io::Result<Self> {
        let root = Node {
            parent: None,
            edge: EdgeId(0),
            pose,
            depth: 0,
            weight: 1.0,
            class: context.similar.class(start),
            state: context.states.read(start)?,
            interior: true,
        };
        let tree = Tree { start, nodes: vec![root], quality: FrameQuality::default() };
        Ok(Self { tree, queue: VecDeque::from([0]), at: None })
    }

    /// Goes on to its end, once.
    ///
    /// # Errors
    /// A frame could not be simulated, a state not read; or [`JobError::Abandoned`]: it stands where it
    /// was left, and may be run again.
    pub fn run(
        &mut self,
        context: &Context<'_>,
        simulator: &mut dyn Simulator,
    ) -> Result<Outcome, JobError> {
        let Self { tree, queue, at } = self;
        while let Some((parent, first)) = at.or_else(|| queue.pop_front().map(|node| (node, 0))) {
            let pose = tree.nodes[parent].pose;
            // Whatever is queued is interior and must be expanded, so room is kept for it.
            for (place, edge) in context.primary.out_edges(pose).enumerate().skip(first) {
                *at = Some((parent, place));
                let child = tree.step(context, simulator, (parent, edge))?;
                let waiting: usize = queue.iter().map(|&n| tree.degree(context, n)).sum();
                let rest = context.primary.out_degree(pose);
                let room = tree.nodes.len() + waiting + rest + tree.degree(context, child);
                let node = &tree.nodes[child];
                let deep = node.depth >= context.rules.depth_frames || room > context.states_max;
                if !deep && !tree.is_near_known(context, child)? {
                    tree.nodes[child].interior = true;
                    queue.push_back(child);
                }
            }
            *at = None;
        }
        tree.outcome(context)
    }
}

/// A state of an expansion; node 0 is the start.
struct Node {
    parent: Option<usize>,
    edge: EdgeId,
    pose: PoseId,
    depth: u32,
    /// Of a merge here, against one of the start (see [`Aims`]).
    weight: f32,
    class: Class,
    state: GridState,
    interior: bool,
}

struct Tree {
    start: StateId,
    nodes: Vec<Node>,
    quality: FrameQuality,
}

impl Tree {
    fn degree(&self, context: &Context<'_>, node: usize) -> usize {
        context.primary.out_degree(self.nodes[node].pose)
    }

    fn step(
        &mut self,
        context: &Context<'_>,
        simulator: &mut dyn Simulator,
        (parent, edge): (usize, EdgeId),
    ) -> Result<usize, JobError> {
        let from = &self.nodes[parent];
        let depth = from.depth + 1;
        let place = (edge, depth);
        let (state, class) = simulate(context, simulator, &from.state, place, &mut self.quality)?;
        let pose = context.primary.edge(edge).to;
        let weight = context.aims.along(self.start, from.weight, edge);
        let parent = Some(parent);
        self.nodes.push(Node { parent, edge, pose, depth, weight, class, state, interior: false });
        Ok(self.nodes.len() - 1)
    }

    /// Whether a node may stop early: a known interior state, or one of its own tree, is near.
    fn is_near_known(&self, context: &Context<'_>, node: usize) -> io::Result<bool> {
        if context.rules.paper {
            return Ok(false);
        }
        let Node { pose, weight, .. } = self.nodes[node];
        let enough_m = context.aims.enough_m(self.start, (self.nodes[0].pose, pose), weight);
        let bound_m = enough_m.max(context.rules.tolerance_m);
        Ok(self.most_similar(context, node, bound_m)?.is_some())
    }

    /// The paper's FindMostSimilar, among the snapshot and this tree.
    fn most_similar(
        &self,
        context: &Context<'_>,
        node: usize,
        bound_m: f32,
    ) -> io::Result<Option<Found<Target>>> {
        let Node { pose, class, state, .. } = &self.nodes[node];
        let similar = context.similar;
        let known = &context.known[pose.index()];
        let known = similar.nearest(context.states, (state, *class), known, bound_m)?;
        let mut best = known.map(|found| found.of(Target::Known(found.target)));
        for (own, other) in self.nodes.iter().enumerate() {
            if !other.interior || other.pose != *pose || own == node {
                continue;
            }
            let bound_m = best.map_or(bound_m, |found| found.cost_m);
            let penalty_m = similar.penalties().of(*class, other.class);
            let Some((error_m, cost_m)) = similar.judge((state, &other.state), penalty_m, bound_m)
            else {
                continue;
            };
            if best.is_none_or(|found| cost_m < found.cost_m) {
                best = Some(Found { target: Target::Node(own), error_m, cost_m });
            }
        }
        Ok(best)
    }

    /// Nodes in the order in which they get ids: chain by chain, the longest way first.
    fn chains(&self) -> Vec<usize> {
        let mut height = vec![0; self.nodes.len()];
        let mut heavy: Vec<Option<usize>> = vec![None; self.nodes.len()];
        for node in (1..self.nodes.len()).rev() {
            let parent = self.nodes[node].parent.expect("only the start has no parent");
            // From the back: of equal heights the first child is the last to get here.
            if height[node] + 1 >= height[parent] {
                height[parent] = height[node] + 1;
                heavy[parent] = Some(node);
            }
        }
        let mut order = Vec::with_capacity(self.nodes.len() - 1);
        for node in 1..self.nodes.len() {
            let parent = self.nodes[node].parent.expect("only the start has no parent");
            if parent != 0 && heavy[parent] == Some(node) {
                continue;
            }
            let mut next = Some(node);
            while let Some(node) = next {
                order.push(node);
                next = heavy[node];
            }
        }
        order
    }

    /// Its states move out of it.
    fn outcome(&mut self, context: &Context<'_>) -> Result<Outcome, JobError> {
        let order = self.chains();
        let mut place = vec![Local::Known(self.start); self.nodes.len()];
        for (index, &node) in order.iter().enumerate() {
            place[node] = Local::New(index as u32);
        }
        let mut outcome = Outcome { quality: self.quality, ..Outcome::default() };
        for &node in &order {
            let merge = if self.nodes[node].interior {
                None
            } else {
                let found = self
                    .most_similar(context, node, f32::INFINITY)?
                    .expect("every pose has an interior state since the initial pass");
                Some(found.of(match found.target {
                    Target::Known(id) => Local::Known(id),
                    Target::Node(own) => place[own],
                }))
            };
            let Node { parent, edge, class, .. } = self.nodes[node];
            let parent = place[parent.expect("only the start has no parent")];
            outcome.frames.push(LocalFrame { parent, edge, class, merge });
        }
        for &node in &order {
            let empty = GridState { positions: Vec::new(), velocities: Vec::new() };
            outcome.states.push(std::mem::replace(&mut self.nodes[node].state, empty));
        }
        Ok(outcome)
    }
}

#[derive(Clone, Copy)]
enum Target {
    Known(StateId),
    Node(usize),
}

/// The next state and its class.
fn simulate(
    context: &Context<'_>,
    simulator: &mut dyn Simulator,
    state: &GridState,
    (edge, depth): (EdgeId, u32),
    quality: &mut FrameQuality,
) -> Result<(GridState, Class), JobError> {
    if context.abandon.load(Ordering::Relaxed) {
        return Err(JobError::Abandoned);
    }
    let failed = |source| JobError::Simulate { edge, depth, source };
    let count = context.states.vertex_count();
    let frame = context.ahead.frame((state, edge), || {
        let frame = simulator.step(state, edge).map_err(failed)?;
        if frame.state.vertex_count() != count || frame.state.velocities.len() != count {
            let text = format!("{} vertices returned", frame.state.vertex_count());
            return Err(failed(SimulateError(text)));
        }
        Ok(frame)
    })?;
    quality.add(&frame.quality);
    let class = context.classifier.class(context.primary.edge(edge).to, &frame.state);
    Ok((frame.state, class | class::flag(&frame.quality)))
}

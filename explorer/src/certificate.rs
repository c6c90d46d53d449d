//! The certificate of a version: every merge with its error, and the proof that it is true.
//!
//! A merge says: playing goes on at `target`, `error_mm` away from what was simulated. Replaying it
//! simulates the dead end's trajectory once more, from the exact state where its job began, and
//! measures the distance again: the same number, because a job's outcome depends on its inputs
//! alone and every state is exact.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use protocol::{EdgeId, StateId};
use serde::Serialize;

use crate::grow::archive::Archive;
use crate::grow::class;
use crate::grow::graph::Graph;
use crate::grow::policy::visits_at;
use crate::grow::view::{KindAt, View};
use crate::scene::Scene;
use crate::simulator::{SimulateError, Simulator, SimulatorFactory};

/// Clips of a walk that are named, the last ones.
const WALK_CLIPS: usize = 6;

/// A merge.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Merge {
    /// The dead end.
    pub state: u64,
    /// Its pose.
    pub pose: u32,
    /// The clip of the pose; of a transition, the clip that it leads to.
    pub clip: String,
    /// Frame of the clip.
    pub frame: u32,
    /// Whether the pose was made for a transition.
    pub transition: bool,
    /// The primary edge that leads into it.
    pub edge: u32,
    /// The interior state where playing goes on.
    pub target: u64,
    /// The metric's distance between the two (mm), free of penalties.
    pub error_mm: f64,
    /// Class of the dead end; empty without rules.
    pub class: String,
    /// Class of the target.
    pub target_class: String,
    /// What the queue adds for crossing classes (mm).
    pub penalty_mm: f64,
    /// Whether the target's frame came out of bounds: such a merge is undone before any other.
    pub into_flagged: bool,
    /// Share of a player's frames that end in this merge.
    pub visits: f64,
    /// Traversals of its edge that players reported.
    pub walked: u64,
}

/// Two classes, and what leads from one to the other.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Bifurcation {
    /// From this class ...
    pub from: String,
    /// ... to this one.
    pub to: String,
    /// States of `from`.
    pub from_states: u64,
    /// States of `to`.
    pub to_states: u64,
    /// Simulated frames that lead across: what the cloth truly does.
    pub crossings: u64,
    /// Different sequences of clips that end in such a frame, each once: the last clips of it.
    pub walks: Vec<Vec<String>>,
    /// Dead ends whose merge leads across: what playing makes up.
    pub merges: Vec<u64>,
    /// Whether these merges are implausible by the scene's rules.
    pub implausible: bool,
}

/// See the module.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Certificate {
    /// The garment.
    pub garment: String,
    /// States of the graph that is certified.
    pub states: u64,
    /// Largest merge error (mm).
    pub worst_error_mm: f64,
    /// Bifurcations between classes of states.
    pub bifurcations: Vec<Bifurcation>,
    /// Every merge, the largest error first.
    pub merges: Vec<Merge>,
}

/// The certificate of the graph at a commit. `walked`: traversals by edge that players reported.
pub fn certify(
    archive: &Archive,
    scene: &Scene,
    commit: u64,
    walked: &BTreeMap<EdgeId, u64>,
) -> Certificate {
    let view = archive.view(commit);
    let graph = archive.graph();
    let visits = visits_at(graph, commit, archive.ledger().steering().model(), &[]);
    let penalties = class::Penalties::new(&scene.metric.classes);
    let mut merges = Vec::new();
    for id in (0..view.state_count()).map(StateId) {
        let KindAt::DeadEnd(target, error_m) = view.kind(id) else { continue };
        let state = graph.state(id);
        let pose = graph.primary().pose(state.pose);
        let edge = state.parent.expect("a dead end was simulated from somewhere").1;
        let named = |id: StateId| class::name(&scene.metric.classes, graph.state(id).class);
        let led_into = graph.state(target).class;
        let penalty_m = penalties.of(state.class, led_into & !class::FLAGGED);
        merges.push(Merge {
            state: id.0,
            pose: state.pose.0,
            clip: graph.primary().clips()[usize::from(pose.clip)].clone(),
            frame: pose.frame,
            transition: pose.transition,
            edge: edge.0,
            target: target.0,
            error_mm: 1e3 * f64::from(error_m),
            class: named(id),
            target_class: named(target),
            penalty_mm: 1e3 * f64::from(penalty_m),
            into_flagged: led_into & class::FLAGGED != 0,
            visits: visits[id.index()],
            walked: walked.get(&edge).copied().unwrap_or(0),
        });
    }
    merges.sort_by(|a, b| b.error_mm.total_cmp(&a.error_mm).then(a.state.cmp(&b.state)));
    Certificate {
        garment: scene.garment.name.clone(),
        states: view.state_count(),
        worst_error_mm: merges.first().map_or(0.0, |merge| merge.error_mm),
        bifurcations: bifurcations(&view, scene),
        merges,
    }
}

/// Pairs of classes between which a simulated frame or a merge leads.
pub fn bifurcations(view: &View<'_>, scene: &Scene) -> Vec<Bifurcation> {
    let graph = view.graph();
    let class_of = |state: StateId| graph.state(state).class & !class::FLAGGED;
    let mut counts: BTreeMap<class::Class, u64> = BTreeMap::new();
    let mut crossings: BTreeMap<(class::Class, class::Class), Vec<StateId>> = BTreeMap::new();
    let mut merges: BTreeMap<(class::Class, class::Class), Vec<u64>> = BTreeMap::new();
    for id in (0..view.state_count()).map(StateId) {
        let here = class_of(id);
        *counts.entry(here).or_default() += 1;
        if let Some((parent, _)) = graph.state(id).parent
            && class_of(parent) != here
        {
            crossings.entry((class_of(parent), here)).or_default().push(id);
        }
        if let KindAt::DeadEnd(target, _) = view.kind(id)
            && class_of(target) != here
        {
            merges.entry((here, class_of(target))).or_default().push(id.0);
        }
    }
    let pairs: BTreeSet<_> = crossings.keys().chain(merges.keys()).copied().collect();
    let rules = &scene.metric.classes;
    let penalties = class::Penalties::new(rules);
    let made = |(from, to)| {
        let crossed = crossings.get(&(from, to)).map_or(&[][..], Vec::as_slice);
        let walks: BTreeSet<Vec<String>> =
            crossed.iter().map(|state| walk_to(graph, *state)).collect();
        Bifurcation {
            from: class::name(rules, from),
            to: class::name(rules, to),
            from_states: counts.get(&from).copied().unwrap_or(0),
            to_states: counts.get(&to).copied().unwrap_or(0),
            crossings: crossed.len() as u64,
            walks: walks.into_iter().collect(),
            merges: merges.get(&(from, to)).cloned().unwrap_or_default(),
            implausible: penalties.of(from, to) > 0.0,
        }
    };
    pairs.into_iter().map(made).collect()
}

/// The last clips of the simulated walk from the drape to a state.
fn walk_to(graph: &Graph, state: StateId) -> Vec<String> {
    let mut clips: Vec<String> = Vec::new();
    let mut at = Some(state);
    while let Some(state) = at {
        let pose = graph.primary().pose(graph.state(state).pose);
        let clip = &graph.primary().clips()[usize::from(pose.clip)];
        if clips.last() != Some(clip) {
            if clips.len() == WALK_CLIPS {
                break;
            }
            clips.push(clip.clone());
        }
        at = graph.state(state).parent.map(|(parent, _)| parent);
    }
    clips.reverse();
    clips
}

/// What replaying gave.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Replay {
    /// Merges replayed.
    pub replayed: u64,
    /// Frames simulated for it.
    pub frames: u64,
    /// Largest difference between an error on record and the one measured again (mm).
    pub largest_difference_mm: f64,
    /// States on the way that did not come out bit for bit as they were.
    pub states_differing: u64,
}

impl Replay {
    /// Whether all came out as it is on record.
    pub fn is_exact(&self) -> bool {
        self.largest_difference_mm <= 0.0 && self.states_differing == 0
    }
}

/// Why a merge cannot be replayed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReplayError {
    /// A state cannot be read.
    #[error("reading state {0}: {1}")]
    Read(StateId, std::io::Error),
    /// A frame could not be simulated.
    #[error("simulating state {0} again: {1}")]
    Simulate(StateId, SimulateError),
}

/// Replays `count` merges spread evenly over the certificate (all, if there are fewer), the worst
/// among them, on `workers` threads.
///
/// # Errors
/// A state cannot be read, or a frame not be simulated.
pub fn replay(
    archive: &Archive,
    certificate: &Certificate,
    (simulators, workers): (&dyn SimulatorFactory, usize),
    count: usize,
    each: &(dyn Fn(usize) + Sync),
) -> Result<Replay, ReplayError> {
    let merges = &certificate.merges;
    let count = count.min(merges.len());
    let chosen: Vec<&Merge> = (0..count).map(|i| &merges[i * merges.len() / count]).collect();
    let (next, done) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let total = Mutex::new(Ok(Replay::default()));
    let work = || {
        let mut simulator = simulators.simulator();
        while let Some(merge) = chosen.get(next.fetch_add(1, Ordering::Relaxed)) {
            let found = replay_one(archive, simulator.as_mut(), merge);
            let mut total = total.lock().expect("no worker panics holding it");
            match (&mut *total, found) {
                (Ok(total), Ok(found)) => total.add(&found),
                (Ok(_), Err(error)) => *total = Err(error),
                (Err(_), _) => return,
            }
            each(done.fetch_add(1, Ordering::Relaxed) + 1);
        }
    };
    std::thread::scope(|scope| {
        (0..workers.clamp(1, count.max(1))).for_each(|_| drop(scope.spawn(work)));
    });
    total.into_inner().expect("no worker panics holding it")
}

impl Replay {
    fn add(&mut self, other: &Self) {
        self.replayed += other.replayed;
        self.frames += other.frames;
        self.largest_difference_mm = self.largest_difference_mm.max(other.largest_difference_mm);
        self.states_differing += other.states_differing;
    }
}

fn replay_one(
    archive: &Archive,
    simulator: &mut dyn Simulator,
    merge: &Merge,
) -> Result<Replay, ReplayError> {
    let graph = archive.graph();
    let dead_end = StateId(merge.state);
    let read = |id| archive.state(id).map_err(|e| ReplayError::Read(id, e));
    // Back to the state where its job began: the first on the way that an earlier job made.
    let job = graph.commit_of(dead_end);
    let (mut way, mut start) = (Vec::new(), dead_end);
    while graph.commit_of(start) == job
        && let Some((parent, edge)) = graph.state(start).parent
    {
        way.push((edge, start));
        start = parent;
    }
    let mut found = Replay { replayed: 1, ..Replay::default() };
    let mut state = read(start)?;
    for &(edge, id) in way.iter().rev() {
        let frame =
            simulator.step(&state, edge).map_err(|error| ReplayError::Simulate(id, error))?;
        state = frame.state;
        found.frames += 1;
        found.states_differing += u64::from(state != read(id)?);
    }
    let again_m = archive.metric().distance(&state, &read(StateId(merge.target))?);
    found.largest_difference_mm = (1e3 * f64::from(again_m) - merge.error_mm).abs();
    Ok(found)
}

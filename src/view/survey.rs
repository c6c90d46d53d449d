//! What a version's merges are: a table of the worst, and the way that leads through one.

use std::collections::BTreeMap;
use std::sync::Arc;

use client_lib::{Character, Scene};
use client_lib::{Entry, PoseId, StateId};
use serde::Serialize;

/// Merges listed.
const WORST: usize = 40;
/// Frames of a loop before the merge and after it.
const BEFORE: usize = 20;
const AFTER: usize = 25;

/// A merge as the page lists it.
#[derive(Debug, Clone, Serialize)]
pub struct Merge {
    /// The dead end.
    pub dead_end: u64,
    /// Where playing goes on.
    pub target: u64,
    /// Metres times a thousand.
    pub mm: f32,
    /// The clip, by name.
    pub clip: String,
    /// The frame in it.
    pub frame: u32,
}

/// A walk around a merge.
#[derive(Debug, Clone)]
pub struct Loop {
    /// The dead end, or what was one.
    pub dead_end: StateId,
    /// Where it begins.
    pub start: StateId,
    /// The poses after that one.
    pub poses: Vec<PoseId>,
    /// Index into `poses` at which the merge lies.
    pub at: usize,
}

/// One version, looked through once.
#[derive(Debug)]
pub struct Survey {
    version: Arc<client_lib::version::Version>,
    /// The state from which each was simulated; only where it is linked.
    parents: BTreeMap<u64, u64>,
    worst: Vec<Merge>,
    merges: usize,
}

impl Survey {
    /// Looks through a character's version. Cost: linear in its states.
    pub fn new(character: &Character) -> Self {
        let version = Arc::clone(character.version());
        let (links, scene) = (version.links(), version.scene());
        let mut parents = BTreeMap::new();
        let mut dead_ends = Vec::new();
        for id in 0..links.state_count() as u64 {
            match links.entry(StateId(id)) {
                Some(Entry::Interior(next)) => {
                    parents.extend(next.iter().map(|child| (child.0, id)));
                }
                Some(Entry::DeadEnd { error_m, .. }) => dead_ends.push((error_m, id)),
                _ => {}
            }
        }
        let merges = dead_ends.len();
        dead_ends.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        // One of which nobody knows where it comes from is not walked through.
        dead_ends.retain(|(_, id)| parents.contains_key(id));
        dead_ends.truncate(WORST);
        let listed = dead_ends.iter().filter_map(|(_, id)| merge(&version, StateId(*id)));
        let worst = listed.collect();
        debug_assert!(scene.pose_count() > 0, "a scene has poses");
        Self { version, parents, worst, merges }
    }

    /// Whether it speaks of the version that this character plays.
    pub fn is_of(&self, character: &Character) -> bool {
        Arc::ptr_eq(&self.version, character.version())
    }

    /// The worst merges, worst first.
    pub fn worst(&self) -> &[Merge] {
        &self.worst
    }

    /// How many merges there are.
    pub fn merges(&self) -> usize {
        self.merges
    }

    /// The walk around a merge, or around a state that was a dead end once; `None` where nobody
    /// knows where it comes from.
    pub fn around(&self, dead_end: StateId) -> Option<Loop> {
        let links = self.version.links();
        let scene = self.version.scene();
        let mut states = vec![dead_end.0];
        while states.len() <= BEFORE
            && let Some(parent) = self.parents.get(states.last()?)
        {
            states.push(*parent);
        }
        if states.len() < 2 {
            return None;
        }
        let start = StateId(*states.last()?);
        let mut poses = Vec::new();
        for state in states.iter().rev().skip(1) {
            poses.push(links.pose(StateId(*state))?);
        }
        let at = poses.len() - 1;
        while poses.len() <= at + AFTER {
            poses.push(straight_on(scene, *poses.last()?)?);
        }
        Some(Loop { dead_end, start, poses, at })
    }

    /// What is known of a merge now; `None` where it is none.
    pub fn merge(&self, dead_end: StateId) -> Option<Merge> {
        merge(&self.version, dead_end)
    }

    /// The worst merge (mm) that a walk around passes at its middle or after it.
    pub fn worst_on(&self, around: &Loop) -> f32 {
        let (links, scene) = (self.version.links(), self.version.scene());
        let Some(mut state) = links.resume(around.start) else { return 0.0 };
        let Some(mut pose) = links.pose(state) else { return 0.0 };
        let mut worst_m = 0.0f32;
        for (index, next) in around.poses.iter().enumerate() {
            let Some(edge) = scene.edge_between(pose, *next) else { break };
            let Some(follow) = links.follow(state, scene.slot(edge)) else { break };
            if let Some((_, error_m)) = follow.via.filter(|_| index >= around.at) {
                worst_m = worst_m.max(error_m);
            }
            (state, pose) = (follow.state, *next);
        }
        worst_m * 1000.0
    }
}

fn merge(version: &client_lib::version::Version, dead_end: StateId) -> Option<Merge> {
    let (links, scene) = (version.links(), version.scene());
    let Entry::DeadEnd { target, error_m } = links.entry(dead_end)? else { return None };
    let pose = links.pose(dead_end)?;
    Some(Merge {
        dead_end: dead_end.0,
        target: target.0,
        mm: error_m * 1000.0,
        clip: clip_name(scene, pose),
        frame: scene.frame_of(pose),
    })
}

/// A clip's name; where the pose leads there, with an arrow.
pub fn clip_name(scene: &Scene, pose: PoseId) -> String {
    let name = &scene.clips()[usize::from(scene.clip_of(pose))];
    let arrow = if scene.is_transition(pose) { "> " } else { "" };
    format!("{arrow}{name}")
}

/// The next pose of the same clip, or else the first that follows.
fn straight_on(scene: &Scene, pose: PoseId) -> Option<PoseId> {
    let same = |to: &PoseId| scene.clip_of(*to) == scene.clip_of(pose);
    let nexts = || scene.out_edges(pose).map(|edge| scene.edges()[edge.index()].to);
    nexts().find(same).or_else(|| nexts().next())
}

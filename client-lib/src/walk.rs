//! Who decides the next pose in tests and tools: walks over the primary graph.
//!
//! `random:SEED` takes every out-edge with equal probability; `clip:A,B,...` goes to each clip by
//! the shortest way, plays it, and begins again; `edges:FILE` replays a list.

use std::collections::VecDeque;
use std::sync::Arc;

use protocol::PoseId;
use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::scene::Scene;

/// A walk as the user asks for it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum WalkSpec {
    /// Uniform over out-edges, from a seed.
    Random(u64),
    /// Through these clips, in turn, for ever.
    Clips(Vec<String>),
    /// Lines of a file: edges (`edge 17` or `17`) or poses (`pose 17`).
    Edges {
        /// Where the text came from, for messages.
        source: String,
        /// The text.
        text: String,
    },
}

/// Why a walk cannot be walked.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum WalkError {
    /// Not one of the three kinds.
    #[error("\"{0}\" is no walk; write random:SEED, clip:NAME,NAME,... or edges:FILE")]
    Unknown(String),
    /// A seed that is no number.
    #[error("\"{0}\" is no seed; write random: and a whole number, such as random:7")]
    Seed(String),
    /// The file of edges could not be read.
    #[error("the edges of \"{path}\" could not be read: {why}")]
    File {
        /// The file.
        path: String,
        /// The system's reason.
        why: String,
    },
    /// A clip that the scene does not have.
    #[error("the scene has no clip \"{name}\"; it has {known}")]
    NoClip {
        /// The name asked for.
        name: String,
        /// The names there are.
        known: String,
    },
    /// A clip that no walk reaches.
    #[error("no way leads from pose {from} to clip \"{name}\"")]
    Unreachable {
        /// The pose where the way ended.
        from: PoseId,
        /// The clip.
        name: String,
    },
    /// A line that names nothing.
    #[error("{source_name}, line {line}: {why}")]
    Line {
        /// The file.
        source_name: String,
        /// Counted from 1.
        line: usize,
        /// What is wrong, and what to do.
        why: String,
    },
    /// A list without a single step.
    #[error("{0} has no line that names an edge or a pose")]
    Empty(String),
}

impl WalkSpec {
    /// Reads what stands on a command line; `edges:` reads its file.
    ///
    /// # Errors
    /// Another kind, a seed that is no number, a file that cannot be read.
    pub fn parse(text: &str) -> Result<Self, WalkError> {
        match text.split_once(':') {
            Some(("random", seed)) => {
                seed.parse().map(Self::Random).map_err(|_| WalkError::Seed(seed.into()))
            }
            Some(("clip", names)) if !names.is_empty() => {
                Ok(Self::Clips(names.split(',').map(|name| name.trim().to_owned()).collect()))
            }
            Some(("edges", path)) => std::fs::read_to_string(path)
                .map(|text| Self::Edges { source: path.into(), text })
                .map_err(|e| WalkError::File { path: path.into(), why: e.to_string() }),
            _ => Err(WalkError::Unknown(text.into())),
        }
    }
}

/// An endless sequence of next poses; a list of edges or poses ends.
#[derive(Debug, Clone)]
pub struct Walk {
    scene: Arc<Scene>,
    pose: PoseId,
    kind: Kind,
}

#[derive(Debug, Clone)]
enum Kind {
    Random(Box<Pcg64Mcg>),
    Clips { clips: Vec<u16>, turn: usize, ahead: VecDeque<PoseId> },
    List(VecDeque<PoseId>),
}

impl Walk {
    /// A walk from `start`; over at once where the scene has no such pose.
    ///
    /// # Errors
    /// Clips that do not exist or cannot be reached; lines that name nothing.
    pub fn new(spec: &WalkSpec, scene: &Arc<Scene>, start: PoseId) -> Result<Self, WalkError> {
        let kind = match spec {
            WalkSpec::Random(seed) => Kind::Random(Box::new(Pcg64Mcg::seed_from_u64(*seed))),
            WalkSpec::Clips(names) => {
                let clips = names.iter().map(|name| clip_of(scene, name));
                let clips: Vec<u16> = clips.collect::<Result<_, _>>()?;
                check_reachable(scene, start, &clips)?;
                Kind::Clips { clips, turn: 0, ahead: VecDeque::new() }
            }
            WalkSpec::Edges { source, text } => Kind::List(listed(scene, start, source, text)?),
        };
        Ok(Self { scene: Arc::clone(scene), pose: start, kind })
    }
}

impl Iterator for Walk {
    type Item = PoseId;

    fn next(&mut self) -> Option<PoseId> {
        let scene = &self.scene;
        if !scene.has(self.pose) {
            return None;
        }
        let next = match &mut self.kind {
            Kind::Random(random) => {
                let degree = scene.out_degree(self.pose) as u64;
                // The high half of a product: uniform to within 2^-32 of the degree.
                let choice = (u64::from(random.next_u32()) * degree) >> 32;
                let edge = scene.out_edges(self.pose).nth(choice as usize)?;
                scene.edges()[edge.index()].to
            }
            Kind::Clips { clips, turn, ahead } => {
                if ahead.is_empty() {
                    let clip = clips[*turn % clips.len()];
                    *turn += 1;
                    ahead.extend(way_through(scene, self.pose, clip)?);
                }
                ahead.pop_front()?
            }
            Kind::List(list) => list.pop_front()?,
        };
        self.pose = next;
        Some(next)
    }
}

fn clip_of(scene: &Scene, name: &str) -> Result<u16, WalkError> {
    scene
        .clip(name)
        .ok_or_else(|| WalkError::NoClip { name: name.to_owned(), known: scene.clips().join(", ") })
}

/// Walks the round of clips once (twice, as the second round begins elsewhere), to find out now
/// what would else be found out in mid-walk.
fn check_reachable(scene: &Scene, start: PoseId, clips: &[u16]) -> Result<(), WalkError> {
    let mut from = start;
    for clip in clips.iter().chain(clips) {
        let way = way_through(scene, from, *clip).ok_or_else(|| WalkError::Unreachable {
            from,
            name: scene.clips()[usize::from(*clip)].clone(),
        })?;
        from = way.last().copied().unwrap_or(from);
    }
    Ok(())
}

/// To the earliest recorded pose of a clip by the shortest way, then on through the clip until it
/// has no next frame. Never empty.
///
/// "Earliest": a pose of the clip from which at least half of the clip's longest run can still
/// be played, so that entering at the very last frame does not count.
fn way_through(scene: &Scene, from: PoseId, clip: u16) -> Option<Vec<PoseId>> {
    let run_left = runs_left(scene, clip);
    let longest = run_left.iter().copied().max().unwrap_or(0);
    let is_entry = |pose: PoseId| {
        scene.clip_of(pose) == clip
            && !scene.is_transition(pose)
            && 2 * run_left[pose.index()] >= longest
    };
    let mut way = shortest_way(scene, from, is_entry)?;
    let mut pose = *way.last()?;
    while let Some(next) = next_in_clip(scene, pose) {
        way.push(next);
        pose = next;
    }
    Some(way)
}

/// The next frame of the same clip, where an edge leads there.
fn next_in_clip(scene: &Scene, pose: PoseId) -> Option<PoseId> {
    let follows = |to: &PoseId| {
        scene.clip_of(*to) == scene.clip_of(pose)
            && !scene.is_transition(*to)
            && scene.frame_of(*to) == scene.frame_of(pose) + 1
    };
    scene.out_edges(pose).map(|edge| scene.edges()[edge.index()].to).find(follows)
}

/// Per pose: how many frames of `clip` can be played on from there.
fn runs_left(scene: &Scene, clip: u16) -> Vec<u32> {
    let mut left = vec![0; scene.pose_count()];
    let mut poses: Vec<PoseId> = (0..scene.pose_count() as u32)
        .map(PoseId)
        .filter(|pose| scene.clip_of(*pose) == clip && !scene.is_transition(*pose))
        .collect();
    poses.sort_by_key(|pose| std::cmp::Reverse(scene.frame_of(*pose)));
    for pose in poses {
        left[pose.index()] = next_in_clip(scene, pose).map_or(1, |next| left[next.index()] + 1);
    }
    left
}

/// Breadth-first, at least one step; the poses after `from`, the goal last.
fn shortest_way(
    scene: &Scene,
    from: PoseId,
    is_goal: impl Fn(PoseId) -> bool,
) -> Option<Vec<PoseId>> {
    if !scene.has(from) {
        return None;
    }
    let mut came_from: Vec<Option<PoseId>> = vec![None; scene.pose_count()];
    let mut open = VecDeque::from([from]);
    while let Some(pose) = open.pop_front() {
        for edge in scene.out_edges(pose) {
            let to = scene.edges()[edge.index()].to;
            if came_from[to.index()].is_some() {
                continue;
            }
            came_from[to.index()] = Some(pose);
            if is_goal(to) {
                return Some(trace_back(&came_from, from, to));
            }
            open.push_back(to);
        }
    }
    None
}

fn trace_back(came_from: &[Option<PoseId>], from: PoseId, goal: PoseId) -> Vec<PoseId> {
    let mut way = vec![goal];
    let mut pose = goal;
    while let Some(before) = came_from[pose.index()] {
        if before == from || way.len() > came_from.len() {
            break;
        }
        way.push(before);
        pose = before;
    }
    way.reverse();
    way
}

/// Poses of a list: each line `17` or `edge 17` (an edge that leaves the pose before), or
/// `pose 17`; empty lines and `#` comments are passed over.
fn listed(
    scene: &Scene,
    start: PoseId,
    source: &str,
    text: &str,
) -> Result<VecDeque<PoseId>, WalkError> {
    let mut poses = VecDeque::new();
    let mut before = start;
    for (index, line) in text.lines().enumerate() {
        let content = line.split('#').next().unwrap_or_default().trim();
        if content.is_empty() {
            continue;
        }
        let pose = named(scene, before, content).map_err(|why| WalkError::Line {
            source_name: source.to_owned(),
            line: index + 1,
            why,
        })?;
        poses.push_back(pose);
        before = pose;
    }
    if poses.is_empty() { Err(WalkError::Empty(source.to_owned())) } else { Ok(poses) }
}

/// The pose that a line leads to.
fn named(scene: &Scene, before: PoseId, content: &str) -> Result<PoseId, String> {
    let (kind, number) = content.rsplit_once(char::is_whitespace).unwrap_or(("edge", content));
    let number: usize = number
        .parse()
        .map_err(|_| format!("\"{content}\" is no id; write \"edge 17\", \"17\" or \"pose 17\""))?;
    match kind.trim() {
        "edge" => {
            let edge = scene.edges().get(number).ok_or_else(|| {
                format!("edge {number} does not exist; there are {}", scene.edges().len())
            })?;
            if edge.from != before {
                let from = edge.from;
                return Err(format!("edge {number} leaves pose {from}, but we are at {before}"));
            }
            Ok(edge.to)
        }
        // No need to be a successor: that is how jumps are tried out.
        "pose" if number < scene.pose_count() => Ok(PoseId(number as u32)),
        "pose" => Err(format!("pose {number} does not exist; there are {}", scene.pose_count())),
        other => Err(format!("\"{other}\" is neither edge nor pose")),
    }
}

#[cfg(test)]
mod tests;

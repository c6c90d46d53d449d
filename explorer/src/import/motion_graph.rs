//! Motion graphs: which clip may follow which, and the primary graph made from that.
//!
//! The file format is JSON: `fps`, `clips` (name and frames) and `transitions` (`from_clip`,
//! `from_frame`, `to_clip`, `to_frame`, `distance_m`): after `from_frame` of `from_clip` the next
//! frame shown is `to_frame` of `to_clip`.

use std::collections::BTreeSet;

use cloth::Skeleton;
use protocol::PoseId;
use protocol::limits::{EDGES_MAX, POSES_MAX};
use serde::{Deserialize, Serialize};

use super::character::Clip;
use super::components::Digraph;
use super::transition::{self, TRANSITION_FRAMES_MIN, Transition};
use crate::primary::{PrimaryEdge, PrimaryError, PrimaryGraph, PrimaryPose};

/// A motion graph as it is written.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GraphFile {
    /// Frames per second that the frame numbers are counted in.
    pub fps: f32,
    /// How distances were measured, in words.
    #[serde(default)]
    pub metric: String,
    /// All clips.
    pub clips: Vec<FileClip>,
    /// All transitions.
    pub transitions: Vec<FileTransition>,
    /// Figures of the graph when it was made; not trusted, not needed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub largest_scc: Option<serde_json::Value>,
}

/// A clip by name, with its length as a check.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FileClip {
    /// As the animation or the BVH file is called.
    pub name: String,
    /// Frames at the file's rate.
    pub frames: usize,
}

/// A transition by clip names.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FileTransition {
    /// The clip that is left.
    pub from_clip: String,
    /// Its last frame shown.
    pub from_frame: usize,
    /// The clip that is entered.
    pub to_clip: String,
    /// Its first frame shown.
    pub to_frame: usize,
    /// How well they fit (m).
    #[serde(default)]
    pub distance_m: f32,
}

/// Why a motion graph was refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum MotionGraphError {
    /// The JSON.
    #[error("not a motion graph: {0}; write it with `toile scene graph`")]
    Json(String),
    /// Another rate than the scene's.
    #[error("its frames are at {file} fps, the scene's at {scene}; set the scene's fps to {file}")]
    Rate {
        /// Of the motion graph.
        file: f32,
        /// Of the scene.
        scene: f32,
    },
    /// A clip that the character does not have, or with another length.
    #[error("clip {clip:?}: {problem}")]
    Clip {
        /// Its name.
        clip: String,
        /// What is wrong and what to do.
        problem: String,
    },
    /// A transition.
    #[error("transition {index} ({from} -> {to}): {problem}")]
    Transition {
        /// Its position in the list, from 0.
        index: usize,
        /// Clip and frame.
        from: String,
        /// Clip and frame.
        to: String,
        /// What is wrong and what to do.
        problem: String,
    },
    /// Nothing can be played for ever.
    #[error(
        "the motion graph has no cycle, so every walk ends; add transitions that lead back to \
         earlier frames (toile scene graph finds some)"
    )]
    NoCycle,
    /// Over a limit of `protocol::limits`.
    #[error("{count} {what}, at most {max} are allowed; leave out clips")]
    TooMany {
        /// Of what.
        what: &'static str,
        /// How many.
        count: usize,
        /// The limit.
        max: usize,
    },
    /// The primary graph itself.
    #[error(transparent)]
    Primary(#[from] PrimaryError),
}

impl GraphFile {
    /// Reads the JSON.
    ///
    /// # Errors
    /// No such JSON.
    pub fn parse(text: &str) -> Result<Self, MotionGraphError> {
        serde_json::from_str(text).map_err(|e| MotionGraphError::Json(e.to_string()))
    }

    /// The JSON, one transition a line.
    pub fn to_json(&self) -> String {
        let clips = self.clips.iter().map(json).collect::<Vec<_>>().join(",\n  ");
        let transitions = self.transitions.iter().map(json).collect::<Vec<_>>().join(",\n  ");
        format!(
            "{{\n \"fps\": {},\n \"metric\": {},\n \"clips\": [\n  {clips}\n ],\n \
             \"transitions\": [\n  {transitions}\n ]\n}}\n",
            self.fps,
            json(&self.metric),
        )
    }

    /// Transitions by clip index, checked against the clips.
    ///
    /// # Errors
    /// Another rate, an unknown clip, another length, a frame outside its clip, a transition given
    /// twice or one that arrives with too few frames left.
    pub fn resolve(&self, clips: &[Clip], fps: f32) -> Result<Vec<Transition>, MotionGraphError> {
        if (self.fps - fps).abs() > 1e-3 {
            return Err(MotionGraphError::Rate { file: self.fps, scene: fps });
        }
        let clip_error =
            |clip: &str, problem: String| MotionGraphError::Clip { clip: clip.to_owned(), problem };
        for file in &self.clips {
            let clip = clips.iter().find(|c| c.name == file.name);
            let clip = clip.ok_or_else(|| {
                let problem = "the character has no clip of this name; add it or take it out";
                clip_error(&file.name, problem.to_owned())
            })?;
            if clip.poses.len() != file.frames {
                let (ours, theirs) = (clip.poses.len(), file.frames);
                let problem = format!("has {ours} frames, the motion graph says {theirs}");
                return Err(clip_error(&file.name, problem));
            }
        }
        let index_of = |name: &str| {
            clips.iter().position(|c| c.name == name).ok_or_else(|| {
                let problem = "a transition names it, but there is no such clip";
                clip_error(name, problem.to_owned())
            })
        };
        let mut transitions = Vec::with_capacity(self.transitions.len());
        for file in &self.transitions {
            transitions.push(Transition {
                from_clip: index_of(&file.from_clip)?,
                from_frame: file.from_frame,
                to_clip: index_of(&file.to_clip)?,
                to_frame: file.to_frame,
                distance_m: file.distance_m,
            });
        }
        check(clips, &transitions)?;
        Ok(transitions)
    }
}

/// Refuses transitions that lie outside their clips, are given twice or arrive too late.
///
/// # Errors
/// The first such transition.
pub fn check(clips: &[Clip], transitions: &[Transition]) -> Result<(), MotionGraphError> {
    let mut seen = BTreeSet::new();
    for (index, t) in transitions.iter().enumerate() {
        let place = |clip: usize, frame: usize| {
            let name = clips.get(clip).map_or("?", |c| c.name.as_str());
            format!("{name} {frame}")
        };
        let error = |problem: String| MotionGraphError::Transition {
            index,
            from: place(t.from_clip, t.from_frame),
            to: place(t.to_clip, t.to_frame),
            problem,
        };
        let frames = |clip: usize| clips.get(clip).map_or(0, |c| c.poses.len());
        if t.from_frame >= frames(t.from_clip) || t.to_frame >= frames(t.to_clip) {
            return Err(error("the frame lies outside its clip; mend the numbers".to_owned()));
        }
        if !seen.insert((t.from_clip, t.from_frame, t.to_clip, t.to_frame)) {
            return Err(error("is given twice; take one out".to_owned()));
        }
        let left = transition::run_length(frames(t.to_clip), t.to_frame);
        if left < TRANSITION_FRAMES_MIN {
            return Err(error(format!(
                "arrives with {left} frames left, at least {TRANSITION_FRAMES_MIN} are needed \
                 to blend; arrive earlier"
            )));
        }
    }
    Ok(())
}

/// What became of the clips and transitions.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct GraphReport {
    /// Frames of all clips.
    pub clip_frames: usize,
    /// Of these, kept.
    pub clip_frames_kept: usize,
    /// Transitions given.
    pub transitions: usize,
    /// Of these, kept.
    pub transitions_kept: usize,
    /// Poses before anything was dropped (those of transitions included).
    pub poses_before: usize,
    /// Frames that fell outside the largest strongly connected component.
    pub outside: Vec<FrameRange>,
}

/// Frames of one clip.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct FrameRange {
    /// Name of the clip.
    pub clip: String,
    /// First frame.
    pub first: usize,
    /// Last frame.
    pub last: usize,
}

/// Which nodes there are and which edges: clip frames one after another, then the transitions'
/// poses one after another.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Topology {
    /// First node of each clip.
    pub clip_first: Vec<u32>,
    /// First node of each transition.
    pub run_first: Vec<u32>,
    /// Number of poses of each transition.
    pub run_length: Vec<u32>,
    /// All nodes.
    pub nodes: usize,
    /// All edges.
    pub edges: Vec<(u32, u32)>,
}

impl Topology {
    /// Of clips with these frame counts; `blended` gives each transition poses of its own,
    /// otherwise it is one edge (a cut), as the data that transitions are chosen from is counted.
    pub fn new(frames: &[usize], transitions: &[Transition], blended: bool) -> Self {
        let mut nodes = 0u32;
        let mut edges = Vec::new();
        let mut clip_first = Vec::new();
        for count in frames {
            clip_first.push(nodes);
            edges.extend((1..*count as u32).map(|f| (nodes + f - 1, nodes + f)));
            nodes += *count as u32;
        }
        let (mut run_first, mut run_length) = (Vec::new(), Vec::new());
        for t in transitions {
            let from = clip_first[t.from_clip] + t.from_frame as u32;
            let to = clip_first[t.to_clip] + t.to_frame as u32;
            let length = transition::run_length(frames[t.to_clip], t.to_frame) as u32;
            let length = if blended { length } else { 0 };
            run_first.push(nodes);
            run_length.push(length);
            let mut last = from;
            for node in nodes..nodes + length {
                edges.push((last, node));
                last = node;
            }
            edges.push((last, to + length));
            nodes += length;
        }
        Self { clip_first, run_first, run_length, nodes: nodes as usize, edges }
    }

    /// As a graph.
    pub fn digraph(&self) -> Digraph {
        Digraph::new(self.nodes, &self.edges)
    }
}

/// Builds the primary graph: one node per pose, transitions as runs of poses of their own, only
/// the largest strongly connected component kept.
///
/// Alignments: the edge into a transition's first pose carries the turn and shift that minimise
/// the distance by which transitions are found; all other edges stay in one clip's world.
///
/// # Errors
/// A transition that cannot be, a graph without a cycle, over a limit.
pub fn build(
    skeleton: &Skeleton,
    clips: &[Clip],
    fps: f32,
    transitions: &[Transition],
) -> Result<(PrimaryGraph, GraphReport), MotionGraphError> {
    check(clips, transitions)?;
    let frames: Vec<usize> = clips.iter().map(|c| c.poses.len()).collect();
    let clip_frames: usize = frames.iter().sum();
    let most = clip_frames + transitions.len() * transition::TRANSITION_FRAMES;
    too_many("clips", clips.len(), usize::from(u16::MAX))?;
    too_many("poses", most, POSES_MAX)?;
    too_many("edges", most + transitions.len(), EDGES_MAX)?;
    let topology = Topology::new(&frames, transitions, true);
    let kept = topology.digraph().largest_cycle_component();
    if kept.is_empty() {
        return Err(MotionGraphError::NoCycle);
    }
    let mut id_of = vec![None; topology.nodes];
    for (id, node) in kept.iter().enumerate() {
        id_of[*node as usize] = Some(PoseId(id as u32));
    }
    let (poses, alignments) = all_poses(skeleton, clips, transitions);
    let edge = |(from, to): &(u32, u32)| {
        let (yaw, shift) = alignments[*to as usize];
        let (from, to) = (id_of[*from as usize]?, id_of[*to as usize]?);
        Some((from, to, yaw, shift))
    };
    // Only a run's first pose has an alignment, and only one edge leads there.
    let edges = topology.edges.iter().filter_map(edge);
    let edges = edges.map(|(from, to, yaw, shift)| PrimaryEdge { from, to, yaw, shift });
    let edges: Vec<_> = edges.collect();
    let report = report(clips, transitions, &topology, &id_of);
    let mut poses = poses;
    let mut node = 0;
    poses.retain(|_| {
        node += 1;
        id_of[node - 1].is_some()
    });
    let names = clips.iter().map(|c| c.name.clone()).collect();
    Ok((PrimaryGraph::new(fps, names, poses, edges)?, report))
}

type Alignment = (f32, [f32; 2]);

/// Poses in the order of [`Topology`], and the alignment of the edges into each.
fn all_poses(
    skeleton: &Skeleton,
    clips: &[Clip],
    transitions: &[Transition],
) -> (Vec<PrimaryPose>, Vec<Alignment>) {
    let mut poses = Vec::new();
    let mut alignments = Vec::new();
    for (clip, all) in clips.iter().enumerate() {
        for (frame, pose) in all.poses.iter().enumerate() {
            poses.push(PrimaryPose {
                clip: clip as u16,
                frame: frame as u32,
                transition: false,
                pose: pose.clone(),
            });
            alignments.push((0.0, [0.0; 2]));
        }
    }
    let tracks = transition::tracks(skeleton, clips);
    for t in transitions {
        let run = transition::run(clips, &tracks, t);
        for (k, pose) in run.poses.into_iter().enumerate() {
            poses.push(PrimaryPose {
                clip: t.to_clip as u16,
                frame: (t.to_frame + k) as u32,
                transition: true,
                pose,
            });
            let first = (run.fit.yaw, run.fit.shift);
            alignments.push(if k == 0 { first } else { (0.0, [0.0; 2]) });
        }
    }
    (poses, alignments)
}

fn report(
    clips: &[Clip],
    transitions: &[Transition],
    topology: &Topology,
    id_of: &[Option<PoseId>],
) -> GraphReport {
    let mut outside: Vec<FrameRange> = Vec::new();
    let mut clip_frames_kept = 0;
    for (clip, first) in clips.iter().zip(&topology.clip_first) {
        for frame in 0..clip.poses.len() {
            if id_of[*first as usize + frame].is_some() {
                clip_frames_kept += 1;
                continue;
            }
            match outside.last_mut() {
                Some(range) if range.clip == clip.name && range.last + 1 == frame => {
                    range.last = frame;
                }
                _ => {
                    outside.push(FrameRange { clip: clip.name.clone(), first: frame, last: frame })
                }
            }
        }
    }
    let kept = topology.run_first.iter().filter(|first| id_of[**first as usize].is_some());
    GraphReport {
        clip_frames: clips.iter().map(|c| c.poses.len()).sum(),
        clip_frames_kept,
        transitions: transitions.len(),
        transitions_kept: kept.count(),
        poses_before: topology.nodes,
        outside,
    }
}

/// These plain types always have a JSON form.
fn json<T: Serialize>(value: &T) -> String {
    serde_json::to_string(value).unwrap_or_default()
}

fn too_many(what: &'static str, count: usize, max: usize) -> Result<(), MotionGraphError> {
    if count > max { Err(MotionGraphError::TooMany { what, count, max }) } else { Ok(()) }
}

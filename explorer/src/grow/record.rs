//! What is journalled. A file's types: appended to, never changed in place.

use protocol::{EdgeId, StateId, VersionNumber};
use serde::{Deserialize, Serialize};

use super::class::Class;
use super::policy::Policy;
use crate::scene::{Norm, Scene};
use crate::simulator::FrameQuality;

/// Version of the journal's records and of the state file.
pub const FORMAT_VERSION: u32 = 2;

/// One record of the journal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Record {
    /// The first record: what the folder was made for.
    Header(Header),
    /// State 0 was draped on the start pose.
    Drape(DrapeRecord),
    /// A job's outcome.
    Job(JobRecord),
    /// A job was given up; its dead end stays merged.
    Failed(FailedRecord),
    /// The initial pass ended with these merges of all its dead ends.
    Initialised(Vec<MergeRecord>),
    /// A version is in the store. Not written if the process is killed just after publishing: then
    /// the version is published again, which makes no other of it.
    Published(PublishRecord),
    /// From the next round on, jobs are chosen by this.
    Steer(SteerRecord),
    /// People pointed at these dead ends: they come before all others, a round of their own.
    Tagged(TagRecord),
    /// The same while a round was under way: what is left of it waits until theirs is done.
    Interrupted(TagRecord),
    /// Many of the others, packed (see [`super::journal`]); only the journal sees this one.
    Compacted(Vec<u8>),
    /// Nothing else was left: dead ends whose job was given up may be chosen again.
    Reconsidered,
}

/// Tags that were read.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TagRecord {
    /// The newest tag that was read.
    pub newest: u64,
    /// What was tagged, in order.
    pub states: Vec<StateId>,
}

/// The drape.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DrapeRecord {
    /// Measures of its last frame.
    pub quality: FrameQuality,
    /// Class of state 0.
    pub class: Class,
}

/// What jobs are chosen by; see [`super::policy`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SteerRecord {
    /// The policy.
    pub policy: Policy,
    /// Only dead ends in these clips are simulated, if any are named.
    pub clips: Vec<u16>,
    /// The newest batch of telemetry that was taken in; 0 for none.
    pub telemetry: u64,
    /// Traversals counted since the record before, by edge.
    pub counts: Vec<(EdgeId, u64)>,
}

/// Everything that decides what a folder's graph becomes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Header {
    /// [`FORMAT_VERSION`].
    pub format: u32,
    /// Vertices of a state.
    pub vertex_count: u32,
    /// Inputs by name: a setting's value, or a digest of what is too long to print.
    pub inputs: Vec<(String, String)>,
}

/// A job's outcome. Ids are given in the order of `frames`, from the graph's next id on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct JobRecord {
    /// Its round, counted from 0.
    pub round: u64,
    /// Its place in the round.
    pub index: u32,
    /// The state it started from.
    pub start: StateId,
    /// What it simulated.
    pub frames: Vec<FrameRecord>,
    /// Older dead ends that moved to a nearer state of this job.
    pub remerges: Vec<MergeRecord>,
    /// Measures of its frames.
    pub quality: FrameQuality,
    /// Of an expansion: the largest distance (m), over the first frames, between what was
    /// simulated and what had been played instead.
    pub future_m: Option<f32>,
}

/// A simulated frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FrameRecord {
    /// The state it was simulated from.
    pub parent: StateId,
    /// Along which edge.
    pub edge: EdgeId,
    /// Class of the state at its end.
    pub class: Class,
    /// For a dead end: where it was merged and at which distance (m).
    pub merge: Option<(StateId, f32)>,
}

/// A merge.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MergeRecord {
    /// The dead end.
    pub state: StateId,
    /// The interior state it was merged into.
    pub target: StateId,
    /// The metric's distance between the two (m).
    pub error_m: f32,
}

/// A job that was given up.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FailedRecord {
    /// Its round, counted from 0.
    pub round: u64,
    /// Its place in the round.
    pub index: u32,
    /// The dead end it started from.
    pub start: StateId,
}

/// A version.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct PublishRecord {
    /// Its number.
    pub number: VersionNumber,
    /// The newest commit when it was published.
    pub commit: u64,
    /// The commit that it shows: the same, or that of the best prefix.
    pub shown: u64,
}

impl Header {
    /// The header of a scene's work folder.
    pub fn new(scene: &Scene, paper: bool) -> Self {
        let e = &scene.exploration;
        let text = |name: &str, value: String| (name.to_owned(), value);
        let inputs = vec![
            text("scene", scene.name.clone()),
            text("character", digest(&character(scene))),
            text("motion graph", digest(&motion(scene))),
            text("garment", digest(&garment(scene))),
            text("start pose", scene.start.to_string()),
            text("velocity_time_s", e.velocity_time_s.to_string()),
            text("tolerance_m", e.tolerance_m.to_string()),
            text("depth_frames", e.depth_frames.to_string()),
            text("round_jobs", e.round_jobs.to_string()),
            text("publish_every_frames", e.publish_every_frames.to_string()),
            text("drape_frames", e.drape_frames.to_string()),
            text("rank_max", e.rank_max.to_string()),
            text("ground", e.ground.to_string()),
            text("self_contact", e.self_contact.to_string()),
            text("metric", metric(scene)),
            text("classes", digest(&classes(scene))),
            text("simulator", simulator(scene)),
            text("--paper", paper.to_string()),
        ];
        let vertex_count = scene.garment.positions.len() as u32;
        Self { format: FORMAT_VERSION, vertex_count, inputs }
    }

    /// Whether `--paper` was given.
    pub fn paper(&self) -> bool {
        self.inputs.iter().any(|(name, value)| name == "--paper" && value == "true")
    }

    /// Names the inputs that differ, with both values; `None` where there is none.
    pub fn differences(&self, now: &Self) -> Option<String> {
        let mut lines = Vec::new();
        let mut compare = |name: &str, then: &str, now: &str| {
            if then != now {
                lines.push(format!("{name} was {then} and is {now}"));
            }
        };
        compare("the format", &self.format.to_string(), &now.format.to_string());
        compare("the vertex count", &self.vertex_count.to_string(), &now.vertex_count.to_string());
        for (name, value) in &now.inputs {
            let then = self.inputs.iter().find(|(n, _)| n == name).map_or("absent", |(_, v)| v);
            compare(name, then, value);
        }
        (!lines.is_empty()).then(|| lines.join("; "))
    }
}

/// The first 16 digits of a BLAKE3 hash over all bits of an input.
fn digest(hasher: &Hasher) -> String {
    hasher.0.finalize().to_hex()[..16].to_owned()
}

/// Numbers in, little-endian, with the length of every list before it.
struct Hasher(blake3::Hasher);

impl Hasher {
    fn new() -> Self {
        Self(blake3::Hasher::new())
    }

    fn floats(mut self, values: impl IntoIterator<Item = f32>) -> Self {
        let mut count = 0u64;
        for value in values {
            self.0.update(&value.to_bits().to_le_bytes());
            count += 1;
        }
        self.0.update(&count.to_le_bytes());
        self
    }

    fn integers(mut self, values: impl IntoIterator<Item = u64>) -> Self {
        let mut count = 0u64;
        for value in values {
            self.0.update(&value.to_le_bytes());
            count += 1;
        }
        self.0.update(&count.to_le_bytes());
        self
    }
}

fn character(scene: &Scene) -> Hasher {
    let body = &scene.body;
    let skeleton = &body.skeleton;
    let rest = |r: &cloth::Rigid| [r.rotation.to_array().to_vec(), r.translation.to_array().into()];
    Hasher::new()
        .integers(skeleton.parents.iter().map(|p| p.map_or(u64::MAX, u64::from)))
        .floats(skeleton.offsets.iter().flat_map(|v| v.to_array()))
        .floats(skeleton.rest.iter().flat_map(rest).flatten())
        .floats(body.rest_positions.iter().flat_map(|v| v.to_array()))
        .integers(body.triangles.iter().flatten().map(|i| u64::from(*i)))
        .integers(body.joints.iter().flatten().map(|i| u64::from(*i)))
        .floats(body.weights.iter().flatten().copied())
}

fn motion(scene: &Scene) -> Hasher {
    let primary = &scene.primary;
    let poses = primary.poses();
    let rotations = poses.iter().flat_map(|p| &p.pose.rotations).flat_map(|q| q.to_array());
    Hasher::new()
        .floats([primary.fps()])
        .floats(poses.iter().flat_map(|p| p.pose.root.to_array()))
        .floats(rotations)
        .integers(primary.edges().iter().flat_map(|e| [u64::from(e.from.0), u64::from(e.to.0)]))
        .floats(primary.edges().iter().flat_map(|e| [e.yaw, e.shift[0], e.shift[1]]))
}

fn garment(scene: &Scene) -> Hasher {
    let garment = &scene.garment;
    let f = &garment.fabric;
    Hasher::new()
        .integers(garment.name.bytes().map(u64::from))
        .floats(garment.positions.iter().flat_map(|v| v.to_array()))
        .integers(garment.triangles.iter().flatten().map(|i| u64::from(*i)))
        .integers(garment.layers.iter().map(|layer| u64::from(*layer)))
        .integers(garment.attached.iter().map(|i| u64::from(*i)))
        .floats(
            [f.density, f.stretch, f.shear, f.bend, f.friction, f.drag, f.damping_s, f.offset]
                .into_iter()
                .chain(f.weft),
        )
}

/// The program's command, or `toile`.
fn simulator(scene: &Scene) -> String {
    scene.simulator.as_ref().map_or("toile".into(), |foreign| foreign.command.join(" "))
}

/// The norm, and a digest of the weights where there are any.
fn metric(scene: &Scene) -> String {
    let norm = match scene.metric.norm {
        Norm::Largest => "largest",
        Norm::Rms => "rms",
    };
    match &scene.metric.weights[..] {
        [] => norm.into(),
        weights => format!("{norm} {}", digest(&Hasher::new().floats(weights.iter().copied()))),
    }
}

fn classes(scene: &Scene) -> Hasher {
    scene.metric.classes.iter().fold(Hasher::new(), |hasher, rule| {
        hasher
            .integers([u64::from(rule.joint), u64::from(rule.implausible[0])])
            .integers([u64::from(rule.implausible[1])])
            .integers(rule.vertices.iter().map(|v| u64::from(*v)))
            .floats(rule.axis.to_array())
            .floats([rule.threshold_m, rule.penalty_m])
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grow::toy;

    #[test]
    fn what_differs_is_named_with_both_values() {
        let scene = toy::scene(toy::knot(), toy::settings());
        let header = Header::new(&scene, false);
        assert_eq!(header.differences(&Header::new(&scene, false)), None);
        let mut other = scene.clone();
        other.exploration.tolerance_m = 0.5;
        other.garment.fabric.bend *= 2.0;
        let text = header.differences(&Header::new(&other, true)).unwrap();
        assert!(text.contains("tolerance_m was 0.004 and is 0.5"), "{text}");
        assert!(text.contains("garment was"), "{text}");
        assert!(text.contains("--paper was false and is true"), "{text}");
        assert!(!text.contains("motion graph"), "{text}");
        let mut moved = scene;
        moved.primary = std::sync::Arc::new(toy::figure_4());
        let text = header.differences(&Header::new(&moved, false)).unwrap();
        assert!(text.starts_with("motion graph was"), "{text}");
    }
}

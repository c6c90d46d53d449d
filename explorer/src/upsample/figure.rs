//! The real character as coarse cloth sees it: capsules on bones (Kavan et al. 2011, section 6).

use std::path::PathBuf;
use std::sync::Arc;

use cloth::coarse::Capsule;
use cloth::{Body, Pose, Rigid, Vec3};

use super::scene::smooth;
use crate::import::character::{Character, CharacterError, Clip, read_character};
use crate::import::data_dir;
use crate::import::transition::{self, Transition};

/// Poses a second of the clips.
const RATE: f32 = 30.0;
/// Bones with a capsule from the first joint to the second, as thick as the first one's skin.
const LIMBS: [[&str; 2]; 12] = [
    ["LeftUpLeg", "LeftLeg"],
    ["RightUpLeg", "RightLeg"],
    ["LeftLeg", "LeftFoot"],
    ["RightLeg", "RightFoot"],
    ["Neck", "Head"],
    ["LeftShoulder", "LeftArm"],
    ["RightShoulder", "RightArm"],
    ["LeftArm", "LeftForeArm"],
    ["RightArm", "RightForeArm"],
    ["LeftForeArm", "LeftHand"],
    ["RightForeArm", "RightHand"],
    ["Head", "Head"],
];
/// Joints whose skin is wider than deep: a capsule from side to side.
const TRUNK: [&str; 4] = ["Hips", "LowerBack", "Spine", "Spine1"];
/// Radii are such that this share of the skin around a bone is inside.
const SHARE: f32 = 0.7;
/// How far the waistband keeps off the body (m).
const WAIST_M: f32 = 0.025;

/// A character with its capsules.
#[derive(Debug, Clone)]
pub struct Figure {
    body: Body,
    clips: Vec<Clip>,
    capsules: Vec<Part>,
    /// Middle of the waist in the rest pose (m).
    pub waist: Vec3,
    /// Base of the neck in the rest pose (m).
    pub neck: Vec3,
    half: [f32; 2],
}

/// A capsule: joints that carry its ends, where these are in the rest pose, and the radius (m).
#[derive(Debug, Clone, Copy)]
struct Part {
    joints: [usize; 2],
    ends: [Vec3; 2],
    radius: f32,
}

/// What a character does: clips one after the other.
#[derive(Debug, Clone)]
pub struct Passage {
    /// Pose after pose.
    pub poses: Arc<[Pose]>,
    /// Joint that carries the pins.
    pub carrier: &'static str,
    /// Joints whose capsules the cloth does not meet, as games do it: an arm that gets between
    /// the points of a skirt would carry it along.
    pub ignored: &'static [&'static str],
}

/// Why the character could not be had.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FigureError {
    /// No data folder.
    #[error("this scene needs the real character: set TOILE_DATA to the folder of character.glb")]
    NoData,
    /// The file cannot be read.
    #[error("{path}: {source}; TOILE_DATA names the folder of character.glb")]
    File {
        /// Which.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// It was refused.
    #[error(transparent)]
    Character(#[from] CharacterError),
    /// A joint or clip that the scenes need is not there.
    #[error("the character has no joint or clip {0}")]
    Missing(&'static str),
}

impl Figure {
    /// Reads `character.glb` from the data folder ([`data_dir`]).
    ///
    /// # Errors
    /// No folder, no file, another character than the scenes were made for.
    pub fn load() -> Result<Self, FigureError> {
        let path = data_dir().ok_or(FigureError::NoData)?.join("character.glb");
        let bytes = std::fs::read(&path).map_err(|source| FigureError::File { path, source })?;
        Self::new(read_character(&bytes, None, RATE)?)
    }

    /// Fits capsules to a character.
    ///
    /// # Errors
    /// A joint that is not there.
    pub fn new(character: Character) -> Result<Self, FigureError> {
        let Character { body, clips } = character;
        let joint = |name| body.skeleton.joint(name).ok_or(FigureError::Missing(name));
        let mut capsules = Vec::new();
        for [from, to] in LIMBS {
            capsules.push(limb(&body, [joint(from)?, joint(to)?]));
        }
        for name in TRUNK {
            capsules.push(trunk(&body, joint(name)?));
        }
        let neck = body.skeleton.rest[joint("Neck")?].translation + Vec3::new(0.0, 0.03, 0.0);
        let around =
            body.rest_positions.iter().filter(|p| (p.y - 0.95).abs() < 0.02 && p.x.abs() < 0.25);
        let (mut low, mut high) = (Vec3::splat(f32::INFINITY), Vec3::splat(f32::NEG_INFINITY));
        around.for_each(|p| (low, high) = (low.min(*p), high.max(*p)));
        let waist = 0.5 * (low + high);
        let half = [0.5 * (high.x - low.x) + WAIST_M, 0.5 * (high.z - low.z) + WAIST_M];
        Ok(Self { body, clips, capsules, waist, neck, half })
    }

    /// Clips one after the other, in one world: each begins where the one before ends, and what
    /// separates them decays over ten frames, as in a motion graph.
    ///
    /// # Errors
    /// A clip that is not there.
    pub fn poses(&self, clips: &[&'static str]) -> Result<Arc<[Pose]>, FigureError> {
        let clip = |name: &&'static str| {
            let found = self.clips.iter().find(|c| c.name == *name);
            found.cloned().ok_or(FigureError::Missing(name))
        };
        let clips = clips.iter().map(clip).collect::<Result<Vec<Clip>, FigureError>>()?;
        let tracks = transition::tracks(&self.body.skeleton, &clips);
        let mut poses = clips.first().map(|c| c.poses.clone()).unwrap_or_default();
        let mut into = Rigid::IDENTITY;
        for to_clip in 1..clips.len() {
            let from_clip = to_clip - 1;
            let from_frame = clips[from_clip].poses.len() - 1;
            let cut = Transition { from_clip, from_frame, to_clip, to_frame: 0, distance_m: 0.0 };
            let run = transition::run(&clips, &tracks, &cut);
            into = into.after(&run.fit.alignment());
            let rest = &clips[to_clip].poses[run.joins..];
            poses.extend(run.poses.iter().chain(rest).map(|pose| pose.moved(&into)));
        }
        Ok(poses.into())
    }

    /// Half axes of the waistband: to the side and to the front (m).
    pub fn waist_axes(&self) -> [f32; 2] {
        self.half
    }

    /// The skinned body (m) and its triangles.
    pub fn skin(&self, passage: &Passage, t: f32, lead: f32) -> (Vec<Vec3>, Vec<[u32; 3]>) {
        let mut out = Vec::new();
        self.body.skin(&self.pose(passage, t, lead), &mut Vec::new(), &mut out);
        (out, self.body.triangles.clone())
    }

    /// What carries the pins, and the capsules, `t` after the passage's begin (s). Before it, the
    /// body goes from its rest pose to the first pose in two thirds of `lead` (s).
    pub fn at(&self, passage: &Passage, t: f32, lead: f32) -> (Rigid, Vec<Capsule>) {
        let mut world = Vec::new();
        self.body.skeleton.world(&self.pose(passage, t, lead), &mut world);
        let rest = &self.body.skeleton.rest;
        let carry = |joint: usize, p: Vec3| world[joint].point(rest[joint].inverse().point(p));
        let capsule = |part: &Part| Capsule {
            ends: [0, 1].map(|end| carry(part.joints[end], part.ends[end])),
            radius: part.radius,
        };
        let joint = self.body.skeleton.joint(passage.carrier).unwrap_or(0);
        let carrier = world[joint].after(&rest[joint].inverse());
        let ignored = |part: &&Part| {
            let name = &self.body.skeleton.names[part.joints[0]];
            !passage.ignored.contains(&name.as_str())
        };
        (carrier, self.capsules.iter().filter(ignored).map(capsule).collect())
    }

    fn pose(&self, passage: &Passage, t: f32, lead: f32) -> Pose {
        let Some(first) = passage.poses.first() else { return self.body.skeleton.rest_pose() };
        if t < 0.0 {
            let rest = self.body.skeleton.rest_pose();
            return rest.interpolate(first, smooth((t + lead) / (0.67 * lead)));
        }
        let last = passage.poses.len() - 1;
        let frame = t * RATE;
        let before = (frame as usize).min(last);
        let (from, to) = (&passage.poses[before], &passage.poses[(before + 1).min(last)]);
        from.interpolate(to, (frame - before as f32).clamp(0.0, 1.0))
    }
}

/// Vertices in the rest pose (m) that a joint moves more than any other does.
fn skin_of(body: &Body, joint: usize) -> Vec<Vec3> {
    let all = body.rest_positions.iter().zip(&body.joints).zip(&body.weights);
    let main =
        |weights: &[f32; 4]| (0..4).fold(0, |m, k| if weights[k] > weights[m] { k } else { m });
    let own = all.filter(|((_, joints), weights)| usize::from(joints[main(weights)]) == joint);
    own.map(|((p, _), _)| *p).collect()
}

/// What a share of the numbers is below.
fn quantile(mut numbers: Vec<f32>, share: f32) -> Option<f32> {
    numbers.sort_by(f32::total_cmp);
    let at = ((numbers.len() as f32 * share) as usize).min(numbers.len().saturating_sub(1));
    numbers.get(at).copied()
}

/// A capsule along a bone, as thick as its skin is far from its axis.
fn limb(body: &Body, joints: [usize; 2]) -> Part {
    let ends = joints.map(|joint| body.skeleton.rest[joint].translation);
    let way = ends[1] - ends[0];
    let far = |p: &Vec3| {
        let t = (*p - ends[0]).dot(way) / way.length_squared().max(1e-9);
        p.distance(ends[0] + way * t.clamp(0.0, 1.0))
    };
    let far: Vec<f32> = skin_of(body, joints[0]).iter().map(far).collect();
    Part { joints, ends, radius: quantile(far, SHARE).unwrap_or(0.05) }
}

/// A capsule from side to side, as deep and as wide as a joint's skin.
fn trunk(body: &Body, joint: usize) -> Part {
    let skin = skin_of(body, joint);
    let range = |axis: usize| {
        let along = |share| quantile(skin.iter().map(|p| p[axis]).collect(), share).unwrap_or(0.0);
        [along(0.5 - 0.46), along(0.5), along(0.5 + 0.46)]
    };
    let [left, _, right] = range(0);
    let [back, _, front] = range(2);
    let radius = 0.5 * (front - back);
    let half = (0.5 * (right - left) - radius).max(0.0);
    let middle = Vec3::new(0.5 * (left + right), range(1)[1], 0.5 * (back + front));
    Part { joints: [joint; 2], ends: [middle - Vec3::X * half, middle + Vec3::X * half], radius }
}

//! Reads BVH files: a skeleton by offsets, and its motion by channels.

use cloth::{Quat, Vec3};
use protocol::limits::{JOINTS_MAX, NAME_BYTES_MAX, POSES_MAX};
/// Rotations of all joints in all frames: 512 MB.
const ROTATIONS_MAX: usize = 1 << 25;

/// A skeleton with its motion, in the file's own unit.
#[derive(Debug, Clone, PartialEq)]
pub struct Bvh {
    /// Joints, parents first; end sites are left out.
    pub joints: Vec<BvhJoint>,
    /// Seconds from one frame to the next.
    pub frame_time_s: f32,
    /// Frames.
    pub frames: Vec<BvhFrame>,
}

/// A joint of the hierarchy.
#[derive(Debug, Clone, PartialEq)]
pub struct BvhJoint {
    /// Its name.
    pub name: String,
    /// Its parent; `None` for the root only.
    pub parent: Option<usize>,
    /// From the parent, in the parent's frame [file units].
    pub offset: Vec3,
    channels: Vec<Channel>,
}

/// One sampled instant.
#[derive(Debug, Clone, PartialEq)]
pub struct BvhFrame {
    /// Where the root is [file units].
    pub root: Vec3,
    /// Rotation of each joint in its parent's frame.
    pub rotations: Vec<Quat>,
}

/// What is wrong with a BVH file.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum BvhError {
    /// Not as the format says.
    #[error("line {line}: {problem}; export the clip again as BVH")]
    Line {
        /// Counted from 1.
        line: usize,
        /// What is wrong.
        problem: String,
    },
    /// A number that is not finite.
    #[error("frame {frame}, joint {joint:?}: {value} is not a finite number; repair the clip")]
    NotFinite {
        /// Counted from 0.
        frame: usize,
        /// Name of the joint.
        joint: String,
        /// As written.
        value: String,
    },
    /// The joints are not those of the character.
    #[error("{0}")]
    Skeleton(String),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Channel {
    Position(usize),
    Rotation(usize),
}

impl Bvh {
    /// Reads the text of a file.
    ///
    /// # Errors
    /// Line and problem of what is not BVH, or a number that is not finite.
    pub fn parse(text: &str) -> Result<Self, BvhError> {
        let mut tokens = Tokens::new(text);
        tokens.expect("HIERARCHY")?;
        let joints = parse_joints(&mut tokens)?;
        tokens.expect("MOTION")?;
        tokens.expect("Frames:")?;
        let count = tokens.number("a number of frames")? as usize;
        tokens.expect("Frame")?;
        tokens.expect("Time:")?;
        let frame_time_s = tokens.number("a frame time")?;
        let most = POSES_MAX.min(ROTATIONS_MAX / joints.len());
        if count == 0 || count > most {
            return Err(tokens.error(format!("{count} frames; 1 to {most} are allowed")));
        }
        if !(frame_time_s > 1e-4 && frame_time_s < 10.0) {
            return Err(tokens.error(format!("a frame time of {frame_time_s} s")));
        }
        let mut frames = Vec::new();
        for frame in 0..count {
            frames.push(parse_frame(&mut tokens, &joints, frame)?);
        }
        Ok(Self { joints, frame_time_s, frames })
    }

    /// The motion at a time (s) from the first frame on, held after the last.
    pub fn sample(&self, time_s: f32) -> BvhFrame {
        let at = (time_s / self.frame_time_s).clamp(0.0, (self.frames.len() - 1) as f32);
        // Frames that are meant to be hit are hit, whatever the frame time was rounded to.
        let at = if (at - at.round()).abs() < 1e-2 { at.round() } else { at };
        let (first, t) = (at as usize, at.fract());
        let a = &self.frames[first];
        let b = &self.frames[(first + 1).min(self.frames.len() - 1)];
        let rotations = a.rotations.iter().zip(&b.rotations).map(|(a, b)| a.slerp(*b, t));
        BvhFrame { root: a.root.lerp(b.root, t), rotations: rotations.collect() }
    }

    /// Length of the motion (s).
    pub fn duration_s(&self) -> f32 {
        (self.frames.len() - 1) as f32 * self.frame_time_s
    }
}

fn parse_joints(tokens: &mut Tokens<'_>) -> Result<Vec<BvhJoint>, BvhError> {
    let mut joints: Vec<BvhJoint> = Vec::new();
    // Open braces: a joint, or an end site.
    let mut open: Vec<Option<usize>> = Vec::new();
    loop {
        match tokens.next("a joint")? {
            word @ ("ROOT" | "JOINT") => {
                if (word == "ROOT") != joints.is_empty() {
                    return Err(tokens.error("one ROOT, then JOINTs are expected".to_owned()));
                }
                let parent = open.last().copied().flatten();
                if joints.len() >= JOINTS_MAX || (parent.is_none() && !joints.is_empty()) {
                    return Err(tokens.error(format!("a joint too many (of {JOINTS_MAX})")));
                }
                let name: String =
                    tokens.next("a name")?.chars().take(NAME_BYTES_MAX / 4).collect();
                if joints.iter().any(|j| j.name == name) {
                    return Err(tokens.error(format!("a second joint {name:?}")));
                }
                tokens.expect("{")?;
                open.push(Some(joints.len()));
                joints.push(BvhJoint { name, parent, offset: Vec3::ZERO, channels: Vec::new() });
            }
            "End" => {
                tokens.expect("Site")?;
                tokens.expect("{")?;
                open.push(None);
            }
            "OFFSET" => {
                let mut offset = Vec3::ZERO;
                for axis in 0..3 {
                    offset[axis] = tokens.number("an offset")?;
                }
                if let Some(Some(joint)) = open.last() {
                    joints[*joint].offset = offset;
                }
            }
            "CHANNELS" => {
                let Some(Some(joint)) = open.last().copied() else {
                    return Err(tokens.error("CHANNELS outside a joint".to_owned()));
                };
                let count = tokens.number("a number of channels")? as usize;
                for _ in 0..count.min(6) {
                    let channel = parse_channel(tokens)?;
                    joints[joint].channels.push(channel);
                }
            }
            "}" => {
                if open.pop().is_none() {
                    return Err(tokens.error("a closing brace too many".to_owned()));
                }
                if open.is_empty() {
                    return Ok(joints);
                }
            }
            word => {
                let word: String = word.chars().take(40).collect();
                return Err(tokens.error(format!("{word:?} where a joint is described")));
            }
        }
    }
}

fn parse_channel(tokens: &mut Tokens<'_>) -> Result<Channel, BvhError> {
    Ok(match tokens.next("a channel")? {
        "Xposition" => Channel::Position(0),
        "Yposition" => Channel::Position(1),
        "Zposition" => Channel::Position(2),
        "Xrotation" => Channel::Rotation(0),
        "Yrotation" => Channel::Rotation(1),
        "Zrotation" => Channel::Rotation(2),
        _ => return Err(tokens.error("an unknown channel".to_owned())),
    })
}

fn parse_frame(
    tokens: &mut Tokens<'_>,
    joints: &[BvhJoint],
    frame: usize,
) -> Result<BvhFrame, BvhError> {
    const AXES: [Vec3; 3] = [Vec3::X, Vec3::Y, Vec3::Z];
    let mut root = joints[0].offset;
    let mut rotations = Vec::with_capacity(joints.len());
    for (index, joint) in joints.iter().enumerate() {
        let mut rotation = Quat::IDENTITY;
        for channel in &joint.channels {
            let word = tokens.next("a value of the motion")?;
            let value: f32 = word.parse().map_err(|_| {
                tokens.error(format!("{:?} is no number", word.get(..20).unwrap_or(word)))
            })?;
            if !value.is_finite() {
                let (joint, value) = (joint.name.clone(), word.to_owned());
                return Err(BvhError::NotFinite { frame, joint, value });
            }
            match channel {
                Channel::Position(axis) if index == 0 => root[*axis] = value,
                // Bones keep their lengths.
                Channel::Position(_) => {}
                Channel::Rotation(axis) => {
                    rotation *= Quat::from_axis_angle(AXES[*axis], value.to_radians());
                }
            }
        }
        rotations.push(rotation.normalize());
    }
    Ok(BvhFrame { root, rotations })
}

/// Words with their lines.
struct Tokens<'a> {
    lines: std::iter::Enumerate<std::str::Lines<'a>>,
    words: std::str::SplitWhitespace<'a>,
    line: usize,
}

impl<'a> Tokens<'a> {
    fn new(text: &'a str) -> Self {
        Self { lines: text.lines().enumerate(), words: "".split_whitespace(), line: 0 }
    }

    fn next(&mut self, what: &str) -> Result<&'a str, BvhError> {
        loop {
            if let Some(word) = self.words.next() {
                return Ok(word);
            }
            let Some((index, text)) = self.lines.next() else {
                return Err(self.error(format!("the file ends where {what} is expected")));
            };
            self.line = index + 1;
            self.words = text.split_whitespace();
        }
    }

    fn expect(&mut self, word: &str) -> Result<(), BvhError> {
        let found = self.next(word)?;
        if found == word {
            return Ok(());
        }
        let found: String = found.chars().take(40).collect();
        Err(self.error(format!("{found:?} where {word:?} is expected")))
    }

    fn number(&mut self, what: &str) -> Result<f32, BvhError> {
        let word = self.next(what)?;
        let number = word.parse().ok().filter(|n: &f32| n.is_finite());
        number.ok_or_else(|| self.error(format!("no number where {what} is expected")))
    }

    fn error(&self, problem: String) -> BvhError {
        BvhError::Line { line: self.line, problem }
    }
}

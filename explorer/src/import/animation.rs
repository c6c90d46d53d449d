//! Samples glTF animations into clips of poses.

use cloth::{Pose, Quat, Rigid, Skeleton, Vec3};
use gltf::json;
use gltf::json::animation::{Interpolation, Property};
use gltf::json::validation::Checked;
use protocol::limits::{NAME_BYTES_MAX, POSES_MAX};

use super::character::{CharacterError, Clip, Rig};
use super::gltf_file::Document;

/// A joint other than the root may move in its parent by this much (m) before it is refused.
const SLIDE_M: f32 = 1e-3;
/// Rotations of all joints in all frames of all clips: 512 MB.
const ROTATIONS_MAX: usize = 1 << 25;

/// All animations that move a joint of the rig, sampled at `fps` from their first key on.
pub(super) fn read_clips(
    document: &Document,
    rig: &Rig,
    skeleton: &Skeleton,
    fps: f32,
) -> Result<Vec<Clip>, CharacterError> {
    let mut clips: Vec<Clip> = Vec::new();
    for (index, animation) in document.root.animations.iter().enumerate() {
        let name = animation.name.clone().unwrap_or_else(|| format!("animation {index}"));
        let name: String = name.chars().take(NAME_BYTES_MAX / 4).collect();
        let problem = |problem: String| CharacterError::Clip { clip: name.clone(), problem };
        let channels = read_channels(document, rig, animation, &name)?;
        if channels.is_empty() {
            continue;
        }
        if clips.iter().any(|c| c.name == name) {
            return Err(problem("two animations have this name; rename one".to_owned()));
        }
        let start = channels.iter().map(|c| c.curve.times[0]).fold(f32::INFINITY, f32::min);
        let last = |c: &Channel| c.curve.times[c.curve.times.len() - 1];
        let end = channels.iter().map(last).fold(f32::NEG_INFINITY, f32::max);
        let frames = (((end - start) * fps).round() as usize).saturating_add(1);
        let before: usize = clips.iter().map(|c| c.poses.len()).sum();
        let most = POSES_MAX.min(ROTATIONS_MAX / rig.nodes.len()).saturating_sub(before);
        if frames > most {
            return Err(problem(format!("{frames} frames, at most {most} are left for it")));
        }
        let poses = (0..frames)
            .map(|frame| sample(&channels, rig, start + frame as f32 / fps))
            .collect::<Result<Vec<_>, String>>()
            .map_err(problem)?;
        debug_assert!(poses.iter().all(|p| p.rotations.len() == skeleton.joint_count()));
        clips.push(Clip { name, poses });
    }
    Ok(clips)
}

struct Channel {
    joint: usize,
    property: Property,
    curve: Curve,
}

/// Keys of one property; `width` is 3 or 4, three times as many values where the curve is cubic.
struct Curve {
    times: Vec<f32>,
    values: Vec<f32>,
    width: usize,
    interpolation: Interpolation,
}

fn read_channels(
    document: &Document,
    rig: &Rig,
    animation: &json::Animation,
    name: &str,
) -> Result<Vec<Channel>, CharacterError> {
    let problem = |problem: String| CharacterError::Clip { clip: name.to_owned(), problem };
    let mut channels = Vec::new();
    for channel in &animation.channels {
        let node = channel.target.node.value();
        let joint = rig.nodes.iter().position(|n| *n == node);
        let who = super::character::node_name(&document.root, node);
        let Some(joint) = joint else {
            if rig.ancestors.contains(&node) {
                return Err(problem(format!(
                    "moves node {who:?} above the root joint; bake that motion into the root joint"
                )));
            }
            continue;
        };
        let Checked::Valid(property) = channel.target.path else { continue };
        let width = match property {
            Property::Translation | Property::Scale => 3,
            Property::Rotation => 4,
            Property::MorphTargetWeights => continue,
        };
        let sampler = animation.samplers.get(channel.sampler.value());
        let sampler = sampler.ok_or_else(|| problem(format!("{who:?} has no sampler")))?;
        let curve = read_curve(document, sampler, width, name)
            .map_err(|e| problem(format!("joint {who:?}: {e}")))?;
        channels.push(Channel { joint, property, curve });
    }
    Ok(channels)
}

fn read_curve(
    document: &Document,
    sampler: &json::animation::Sampler,
    width: usize,
    name: &str,
) -> Result<Curve, String> {
    let Checked::Valid(interpolation) = sampler.interpolation else {
        return Err("unknown interpolation".to_owned());
    };
    let times = document.numbers(sampler.input, 1, name).map_err(|e| e.to_string())?;
    let values = document.numbers(sampler.output, width, name).map_err(|e| e.to_string())?;
    let per_key = if interpolation == Interpolation::CubicSpline { 3 * width } else { width };
    if times.is_empty() || values.len() != times.len() * per_key {
        return Err(format!("{} keys but {} values", times.len(), values.len() / width));
    }
    if let Some(key) = values.iter().position(|v| !v.is_finite()) {
        let frame = key / per_key;
        return Err(format!("key {frame} is not a finite number (NaN); repair the clip"));
    }
    let rising = times.windows(2).all(|t| t[0] < t[1]);
    if !(rising && times.iter().all(|t| t.is_finite())) {
        return Err("times of its keys do not rise; export the clip again".to_owned());
    }
    Ok(Curve { times, values, width, interpolation })
}

fn sample(channels: &[Channel], rig: &Rig, time: f32) -> Result<Pose, String> {
    let mut local = rig.local.clone();
    for channel in channels {
        let value = channel.curve.at(time);
        match channel.property {
            Property::Rotation => {
                let rotation = Quat::from_slice(&value);
                if rotation.length_squared() < 1e-6 {
                    return Err(format!("joint {} has a rotation of length 0", channel.joint));
                }
                local[channel.joint].rotation = rotation.normalize();
            }
            Property::Translation => {
                let at = Vec3::from_slice(&value);
                if channel.joint > 0 && (at - local[channel.joint].translation).length() > SLIDE_M {
                    return Err(format!(
                        "joint {} moves in its parent by over {} mm; only the root joint may be \
                         translated, bones keep their lengths",
                        channel.joint,
                        SLIDE_M * 1e3
                    ));
                }
                local[channel.joint].translation = at;
            }
            _ if Vec3::from_slice(&value).abs_diff_eq(Vec3::ONE, 1e-3) => {}
            _ => return Err(format!("joint {} is scaled; remove the scale", channel.joint)),
        }
    }
    let hips: Rigid = rig.above.after(&local[0]);
    let mut rotations: Vec<Quat> = local.iter().map(|l| l.rotation).collect();
    rotations[0] = hips.rotation;
    Ok(Pose { root: hips.translation, rotations })
}

impl Curve {
    fn key(&self, key: usize, part: usize) -> &[f32] {
        let parts = if self.interpolation == Interpolation::CubicSpline { 3 } else { 1 };
        let at = (key * parts + part) * self.width;
        &self.values[at..at + self.width]
    }

    /// The value at a time, held before the first key and after the last.
    fn at(&self, time: f32) -> Vec<f32> {
        let middle = usize::from(self.interpolation == Interpolation::CubicSpline);
        let after = self.times.partition_point(|t| *t <= time);
        if after == 0 || after == self.times.len() {
            return self.key(after.saturating_sub(1), middle).to_vec();
        }
        let (a, b) = (after - 1, after);
        let span = self.times[b] - self.times[a];
        let t = (time - self.times[a]) / span;
        let (from, to) = (self.key(a, middle), self.key(b, middle));
        match self.interpolation {
            Interpolation::Step => from.to_vec(),
            Interpolation::Linear if self.width == 4 => {
                let (from, to) = (Quat::from_slice(from), Quat::from_slice(to));
                from.slerp(to, t).to_array().to_vec()
            }
            Interpolation::Linear => from.iter().zip(to).map(|(a, b)| a + (b - a) * t).collect(),
            Interpolation::CubicSpline => {
                let (out, into) = (self.key(a, 2), self.key(b, 0));
                (0..self.width)
                    .map(|i| hermite([from[i], out[i] * span, to[i], into[i] * span], t))
                    .collect()
            }
        }
    }
}

/// glTF 2.0, appendix C.5: value and tangent at 0, value and tangent at 1.
fn hermite([p0, m0, p1, m1]: [f32; 4], t: f32) -> f32 {
    let (t2, t3) = (t * t, t * t * t);
    (2.0 * t3 - 3.0 * t2 + 1.0) * p0
        + (t3 - 2.0 * t2 + t) * m0
        + (3.0 * t2 - 2.0 * t3) * p1
        + (t3 - t2) * m1
}

//! The character under the states: the garment carried by its skin, and the error of spaces.

use cloth::{Body, Pose, Rigid, Skeleton, Surface, Vec3};
use glam::{Mat3, Quat};
use protocol::scene::{BodyMesh, SceneChunk};
use protocol::{PoseId, StateId};

use super::super::encode::EncodeError;
use super::super::wide::wide_columns;
use super::{Bench, BenchError, Errors, Measured};

/// How far a garment's vertex looks for the skin that carries it (m).
const REACH_M: f32 = 1.0;
/// States of each half on which spaces are compared, at most.
const HALF_STATES_MAX: usize = 2048;
/// Ranks at which they are compared.
const RANKS: [usize; 3] = [50, 100, 200];

/// A garment bound to the body as a game would bind it: each vertex moves with the nearest skin.
pub struct Skinner<'a> {
    scene: &'a SceneChunk,
    skeleton: Skeleton,
    /// By vertex: joints and their share.
    weights: Vec<Vec<(u16, f32)>>,
    /// By joint: from the reference pose's state frame into the joint.
    into_joint: Vec<Rigid>,
}

/// An affine map of one vertex.
#[derive(Debug, Clone, Copy)]
struct Carried {
    turn: Mat3,
    shift: Vec3,
}

impl<'a> Skinner<'a> {
    /// Binds positions (m) in the state frame of `pose`; `None` where the scene gives no body away.
    pub fn new(scene: &'a SceneChunk, pose: PoseId, positions: &[f32]) -> Option<Self> {
        let body = body(scene, scene.body.as_ref()?);
        let reference = pose_of(scene, pose);
        let (mut joints, mut skin) = (Vec::new(), Vec::new());
        body.skin(&reference, &mut joints, &mut skin);
        body.skeleton.world(&reference, &mut joints);
        let from_hips = reference.hips();
        let surface = Surface::new(&skin, &body.triangles);
        let posed = surface.posed(&skin);
        let bind = |p: &[f32]| {
            let point = from_hips.point(Vec3::new(p[0], p[1], p[2]));
            let mut shares: Vec<(u16, f32)> = Vec::new();
            let Some(contact) = surface.closest(&posed, point, REACH_M) else {
                return vec![(0, 1.0)];
            };
            let corners = body.triangles[contact.triangle as usize];
            for (corner, weight) in corners.into_iter().zip(contact.weights.to_array()) {
                let corner = corner as usize;
                for (joint, share) in body.joints[corner].iter().zip(body.weights[corner]) {
                    match shares.iter_mut().find(|(known, _)| known == joint) {
                        Some((_, sum)) => *sum += weight * share,
                        None => shares.push((*joint, weight * share)),
                    }
                }
            }
            shares.retain(|(_, share)| *share > 1e-4);
            shares
        };
        let weights = positions.chunks_exact(3).map(bind).collect();
        let into_joint = joints.iter().map(|joint| joint.inverse().after(&from_hips)).collect();
        Some(Self { scene, skeleton: body.skeleton, weights, into_joint })
    }

    /// How each vertex is carried from the reference pose to another, both in their state frames.
    fn carried(&self, pose: PoseId) -> Vec<Carried> {
        let pose = pose_of(self.scene, pose);
        let mut joints = Vec::new();
        self.skeleton.world(&pose, &mut joints);
        let to_hips = pose.hips().inverse();
        let moves: Vec<(Mat3, Vec3)> = joints
            .iter()
            .zip(&self.into_joint)
            .map(|(joint, into)| to_hips.after(joint).after(into))
            .map(|rigid| (Mat3::from_quat(rigid.rotation), rigid.translation))
            .collect();
        let carry = |shares: &Vec<(u16, f32)>| {
            let all: f32 = shares.iter().map(|(_, share)| share).sum();
            let mut sum = Carried { turn: Mat3::ZERO, shift: Vec3::ZERO };
            for (joint, share) in shares {
                let (turn, shift) = moves[usize::from(*joint)];
                sum.turn += turn * (share / all);
                sum.shift += shift * (share / all);
            }
            sum
        };
        self.weights.iter().map(carry).collect()
    }

    /// Carries positions (m) of the reference pose to another pose, in place.
    pub fn pose(&self, pose: PoseId, positions: &mut [f32]) {
        for (p, carried) in positions.chunks_exact_mut(3).zip(self.carried(pose)) {
            let moved = carried.turn * Vec3::new(p[0], p[1], p[2]) + carried.shift;
            p.copy_from_slice(&moved.to_array());
        }
    }

    /// The way back: positions (m) of a pose to where the reference pose would have them.
    pub fn unpose(&self, pose: PoseId, positions: &mut [f32]) {
        for (p, carried) in positions.chunks_exact_mut(3).zip(self.carried(pose)) {
            // Turns that cancel each other out leave nothing to invert.
            let turn = if carried.turn.determinant().abs() > 0.05 {
                carried.turn.inverse()
            } else {
                Mat3::IDENTITY
            };
            let moved = turn * (Vec3::new(p[0], p[1], p[2]) - carried.shift);
            p.copy_from_slice(&moved.to_array());
        }
    }
}

/// How well columns made from one half of the states hold the other half.
#[derive(Debug, Clone, PartialEq)]
pub struct SpaceError {
    /// `state frame` or `skinned`.
    pub space: &'static str,
    /// Columns.
    pub rank: usize,
    /// Root mean square vertex error of held-out states, in the state frame (m).
    pub rms_m: f64,
    /// Largest vertex error of held-out states, in the state frame (m).
    pub max_m: f64,
}

impl Bench<'_> {
    /// The garment bound to the body at its first state, and its mean shape there: the best that a
    /// mesh carried by the skin alone can show.
    fn skinner(&self) -> Result<Option<(Skinner<'_>, Vec<f32>)>, BenchError> {
        let source = self.source;
        let mut first = vec![0.0; 3 * source.vertices()];
        let state = source.region(0).0;
        source.read_state(state, &mut first).map_err(EncodeError::Read)?;
        let (Some(scene), Some(pose)) = (source.scene(), source.pose(state)) else {
            return Ok(None);
        };
        let Some(skinner) = Skinner::new(scene, pose, &first) else { return Ok(None) };
        let mut sum = vec![0.0f64; first.len()];
        let every = (source.regions() / 256).max(1);
        let mut states = 0.0;
        self.each(every, &mut |state, positions| {
            let Some(pose) = source.pose(state) else { return };
            skinner.unpose(pose, positions);
            sum.iter_mut().zip(&*positions).for_each(|(sum, x)| *sum += f64::from(*x));
            states += 1.0;
        })?;
        let mean = sum.iter().map(|x| (x / states) as f32).collect();
        Ok(Some((skinner, mean)))
    }

    /// The cheap end of the chart: no cloth at all, a mesh that its skin carries. `None` where the
    /// store gives no body away.
    ///
    /// # Errors
    /// The states cannot be read.
    pub fn plain_skinning(&self) -> Result<Option<Measured>, BenchError> {
        let Some((skinner, mean)) = self.skinner()? else { return Ok(None) };
        let mut errors = Errors::default();
        let (mut states, mut decode_s) = (0usize, 0.0);
        let mut shown = mean.clone();
        self.each((self.source.regions() / 512).max(1), &mut |state, positions| {
            let Some(pose) = self.source.pose(state) else { return };
            let start = (self.clock)();
            shown.copy_from_slice(&mean);
            skinner.pose(pose, &mut shown);
            decode_s += (self.clock)() - start;
            errors.compare(positions, &shown);
            states += 1;
        })?;
        let resident_bytes = (16 * self.source.vertices()) as u64;
        let decode_s = decode_s / states.max(1) as f64;
        Ok(Some(Measured::new("plain-skinning", &errors).timed(0.0, decode_s, resident_bytes)))
    }

    /// The dear end: simulating each state, at the processor time that exploring took. `None`
    /// where that was not recorded.
    pub fn full_simulation(&self) -> Option<Measured> {
        let simulate_s = self.source.simulate_s()?;
        Some(Measured::new("full-simulation", &Errors::default()).timed(0.0, simulate_s, 0))
    }

    /// Columns made from every second region, in the state frame and in skinned space, and what
    /// they leave of the regions between them. Empty where the store gives no body away.
    ///
    /// # Errors
    /// The states cannot be read, or span nothing.
    pub fn spaces(&self) -> Result<Vec<SpaceError>, BenchError> {
        let Some((skinner, _)) = self.skinner()? else { return Ok(Vec::new()) };
        let mut found = Vec::new();
        for (space, skinned) in [("state frame", None), ("skinned", Some(&skinner))] {
            found.extend(self.space(space, skinned)?);
        }
        Ok(found)
    }

    fn space(
        &self,
        space: &'static str,
        skinned: Option<&Skinner<'_>>,
    ) -> Result<Vec<SpaceError>, BenchError> {
        let source = self.source;
        let rows = 3 * source.vertices();
        let every = 2 * source.states().div_ceil(2 * HALF_STATES_MAX);
        let region = |from: usize, out: &mut Vec<f32>| -> Result<(), EncodeError> {
            source.read(from, out)?;
            for (state, out) in (source.region(from).0.0..).zip(out.chunks_exact_mut(rows)) {
                if let (Some(skinner), Some(pose)) = (skinned, source.pose(StateId(state))) {
                    skinner.unpose(pose, out);
                }
            }
            Ok(())
        };
        let mut block = Vec::new();
        let mut visit = |show: &mut dyn FnMut(&[f32]) -> Result<(), EncodeError>| {
            (0..source.regions()).step_by(every).try_for_each(|at| {
                region(at, &mut block)?;
                show(&block)
            })
        };
        let columns = wide_columns(rows, RANKS[2], &mut visit)?.columns;
        let mut errors = RANKS.map(|_| Errors::default());
        let (mut exact, mut block) = (Vec::new(), Vec::new());
        for at in (every / 2..source.regions()).step_by(every) {
            source.read(at, &mut exact).map_err(EncodeError::Read)?;
            region(at, &mut block)?;
            let states = block.len() / rows;
            let held = faer::Mat::from_fn(rows, states, |r, s| f64::from(block[s * rows + r]));
            for (rank, errors) in RANKS.into_iter().zip(&mut errors) {
                let columns = columns.subcols(0, rank.min(columns.ncols()));
                let shown = columns * (columns.transpose() * &held);
                for (s, exact) in exact.chunks_exact(rows).enumerate() {
                    let mut state: Vec<f32> = (0..rows).map(|r| shown[(r, s)] as f32).collect();
                    let id = StateId(source.region(at).0.0 + s as u64);
                    if let (Some(skinner), Some(pose)) = (skinned, source.pose(id)) {
                        skinner.pose(pose, &mut state);
                    }
                    errors.compare(exact, &state);
                }
            }
        }
        let of = |(rank, errors): (usize, &Errors)| {
            let (rms_m, max_m) = (errors.rms_m(), errors.max_m());
            SpaceError { space, rank, rms_m, max_m }
        };
        Ok(RANKS.into_iter().zip(&errors).map(of).collect())
    }

    /// Shows every state of every `every`-th region.
    fn each(
        &self,
        every: usize,
        show: &mut dyn FnMut(StateId, &mut [f32]),
    ) -> Result<(), BenchError> {
        let mut block = Vec::new();
        for region in (0..self.source.regions()).step_by(every) {
            self.source.read(region, &mut block).map_err(EncodeError::Read)?;
            let first = self.source.region(region).0.0;
            let states = block.chunks_exact_mut(3 * self.source.vertices());
            states.zip(first..).for_each(|(state, id)| show(StateId(id), state));
        }
        Ok(())
    }
}

pub(super) fn body(scene: &SceneChunk, mesh: &BodyMesh) -> Body {
    let joints = || scene.joints.iter();
    let rest = |joint: &protocol::scene::Joint| Rigid {
        rotation: Quat::from_array(joint.rest_rotation).normalize(),
        translation: Vec3::from(joint.rest_translation),
    };
    Body {
        skeleton: Skeleton {
            names: joints().map(|joint| joint.name.clone()).collect(),
            parents: joints().map(|joint| joint.parent).collect(),
            offsets: joints().map(|joint| Vec3::from(joint.offset)).collect(),
            rest: joints().map(rest).collect(),
        },
        rest_positions: mesh.positions.iter().map(|p| Vec3::from(*p)).collect(),
        triangles: mesh.triangles.clone(),
        joints: mesh.joints.clone(),
        weights: mesh.weights.clone(),
    }
}

pub(super) fn pose_of(scene: &SceneChunk, pose: PoseId) -> Pose {
    let pose = &scene.poses[pose.index()];
    let rotation = |q: &[i16; 4]| Quat::from_array(q.map(f32::from)).normalize();
    Pose { root: Vec3::from(pose.root), rotations: pose.rotations.iter().map(rotation).collect() }
}

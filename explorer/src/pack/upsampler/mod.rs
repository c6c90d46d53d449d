//! An upsampler for a garment of a graph: what clients leave the graph with.
//!
//! The coarse mesh is the garment's own, decimated (`coarsen`), so a coarse point is a vertex and
//! any state of the graph is a pair of coarse and fine positions: the graph's initial states are the
//! training data, as exact as any tracked simulation. U is fitted under the partition of unity and
//! drawn to the barycentric lift (`fit`); what follows the body closely, as the states tell, is left
//! to skinning (`bind`; Kavan et al. 2011, section 6).

mod bind;
mod capsules;
mod coarsen;
mod fit;

use cloth::{Mesh, MeshError, Vec3};
use codec::kernel::operator::OperatorError;
use codec::upsample::{
    Class, Fabric, Parts, Pin, Place, Skin, Stepping, Tether, UpsampleError, Upsampler, WHOLE,
    Weights,
};
use protocol::links::LinkEntry;
use protocol::{PoseId, StateId};

use crate::scene::Scene;
use crate::view::GraphView;

/// States that are learned from, at most; evenly over the initial graph.
const STATES_MAX: usize = 600;
/// Fewer tell nothing.
const STATES_MIN: usize = 20;
/// Bits of a weight in store.
const BITS: u8 = 8;
/// A coarse point that follows the skin by more than this is led by it.
const PINNED_SHARE: f32 = 0.5;

/// A fine vertex that strays further from where the skin leads it is not kept off the body (m): coarse
/// points are, and a plane further away would lift it off the states as well.
const GUARDED_M: f32 = 0.1;

/// How an upsampler is made.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UpsamplerSettings {
    /// Coarse points, about: as few as can be had without breaking the mesh, but no fewer.
    pub points: usize,
}

impl Default for UpsamplerSettings {
    /// As many as Kavan et al. 2011 have for a skirt.
    fn default() -> Self {
        Self { points: 196 }
    }
}

/// Why a garment has no upsampler.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LearnError {
    /// The garment is too small, or the graph is.
    #[error("{vertices} vertices and {states} states are too few to learn an upsampler from")]
    Small {
        /// Vertices of the garment.
        vertices: usize,
        /// States of the initial graph.
        states: usize,
    },
    /// The whole garment follows the body.
    #[error("the garment follows the body closely everywhere; nothing of it can leave the graph")]
    Skin,
    /// The coarse mesh.
    #[error("the coarse mesh: {0}")]
    Mesh(#[from] MeshError),
    /// States could not be read.
    #[error("reading states: {0}")]
    States(#[from] std::io::Error),
    /// The result breaks a rule.
    #[error(transparent)]
    Upsampler(#[from] UpsampleError),
    /// U cannot be applied.
    #[error(transparent)]
    Operator(#[from] OperatorError),
}

/// What was learned, in figures.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Learned {
    /// Coarse points.
    pub points: usize,
    /// Of these, led by the skin.
    pub pins: usize,
    /// Fine vertices that follow the skin alone.
    pub skinned: usize,
    /// States learned from.
    pub states: usize,
    /// Strength of the pull to the lift that did best on states left out, relative to the data's.
    pub strength: f32,
    /// Root mean square distance of a vertex on states left out (m), before rounding.
    pub held_out_m: f32,
    /// The same for the barycentric lift.
    pub lift_m: f32,
    /// Root mean square and largest distance of a vertex over all states, as stored (m).
    pub stored_m: [f32; 2],
}

/// States as learned from: positions in their state frames, three numbers a vertex (m).
struct Data {
    states: Vec<(PoseId, Vec<f32>)>,
}

/// Learns an upsampler for a scene's garment from the initial graph of `view`. A function of these
/// alone: a later view of the same graph gives the same bytes.
///
/// # Errors
/// The garment or the graph is too small, or follows the body everywhere; states cannot be read.
pub fn learn(
    scene: &Scene,
    view: &dyn GraphView,
    settings: &UpsamplerSettings,
) -> Result<(Vec<u8>, Learned), LearnError> {
    let garment = &scene.garment;
    let vertices = garment.positions.len();
    let data = Data::read(view)?;
    if vertices < 4 * settings.points.max(12) || data.states.len() < STATES_MIN {
        return Err(LearnError::Small { vertices, states: data.states.len() });
    }
    let coarse = coarsen::coarsen(&garment.positions, &garment.triangles, settings.points);
    let points: Vec<Vec3> =
        coarse.vertices.iter().map(|v| garment.positions[*v as usize]).collect();
    let mesh = Mesh::new(points.clone(), coarse.triangles.clone())?;
    let bound = bind::bind(scene, &data.states);
    let shares = &bound.shares;
    let pinned = |v: u32| shares[v as usize] > PINNED_SHARE;
    let free = coarse.vertices.iter().filter(|v| !pinned(**v)).count();
    if free < 8 {
        return Err(LearnError::Skin);
    }
    let lift = fit::lift(&garment.positions, &mesh);
    let samples = fit::Samples::new(&coarse.vertices, data.states.iter().map(|(_, x)| &x[..]));
    let fitted = fit::fit(&samples, &lift, shares);
    let pins = coarse.vertices.iter().enumerate().filter(|(_, v)| pinned(**v));
    let pins =
        pins.map(|(point, v)| Pin { point: point as u16, binding: bound.bindings[*v as usize] });
    let mut parts = Parts {
        points: points.iter().map(Vec3::to_array).collect(),
        triangles: coarse.triangles.iter().map(|t| t.map(|v| v as u16)).collect(),
        places: coarse.vertices.iter().map(|v| place(*v)).collect(),
        pins: pins.collect(),
        tethers: tethers(&coarse.vertices, &bound),
        capsules: capsules::capsules(&scene.body),
        fabric: fabric(scene, &mesh),
        stepping: stepping(scene),
        skins: skins(scene, &bound),
        modes: Vec::new(),
        classes: classes(scene),
        rms_m: 0.0,
        max_m: 0.0,
        weights: Weights::round_along(points.len(), &fitted.weights, BITS, &samples.products())?,
    };
    let stored_m = measure(scene, &data, &parts)?;
    [parts.rms_m, parts.max_m] = stored_m;
    let learned = Learned {
        points: points.len(),
        pins: parts.pins.len(),
        skinned: parts.skins.iter().filter(|skin| skin.share == WHOLE).count(),
        states: data.states.len(),
        strength: fitted.strength,
        held_out_m: fitted.held_out_m,
        lift_m: fitted.lift_m,
        stored_m,
    };
    Ok((parts.encode()?, learned))
}

impl Data {
    fn read(view: &dyn GraphView) -> Result<Self, LearnError> {
        let links = view.links();
        let initial = view.runs().iter().filter(|run| run.initial);
        let ids: Vec<u64> =
            initial.flat_map(|run| run.first.0..run.first.0 + u64::from(run.count)).collect();
        let every = ids.len().div_ceil(STATES_MAX).max(1);
        let mut states = Vec::new();
        for id in ids.into_iter().step_by(every) {
            let mut positions = vec![0.0; 3 * view.vertex_count()];
            view.positions(StateId(id), &mut positions)?;
            let pose = match &links[id as usize] {
                LinkEntry::Interior { pose, .. }
                | LinkEntry::DeadEnd { pose, .. }
                | LinkEntry::Retired { pose, .. } => *pose,
            };
            states.push((pose, positions));
        }
        Ok(Self { states })
    }
}

/// Largest and root mean square distance of what is stored from the states it was learned from (m).
fn measure(scene: &Scene, data: &Data, parts: &Parts) -> Result<[f32; 2], LearnError> {
    let upsampler = Upsampler::new(parts.clone())?;
    let (fine, coarse) = (upsampler.fine(), upsampler.coarse());
    let faces = codec::kernel::normals::Faces::new(fine, scene.garment.triangles.clone());
    let faces = faces.map_err(|_| LearnError::Small { vertices: fine, states: 0 })?;
    let mut workspace = codec::upsample::Workspace::default();
    let (mut made, mut coarse_m) = (vec![0.0; 3 * fine], vec![0.0; 3 * coarse]);
    let (mut largest, mut sum) = (0.0f32, 0.0f64);
    for (pose, positions) in &data.states {
        let joints = bind::transforms(&scene.body, &scene.primary.poses()[pose.index()].pose);
        upsampler.restrict(positions, &mut coarse_m)?;
        let drive = codec::upsample::Drive { coarse_m: &coarse_m, joints: &joints };
        upsampler.apply(&drive, &faces, &mut workspace, &mut made, &mut [])?;
        for (a, b) in made.chunks_exact(3).zip(positions.chunks_exact(3)) {
            let square: f32 = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum();
            largest = largest.max(square);
            sum += f64::from(square);
        }
    }
    let count = (data.states.len() * fine).max(1) as f64;
    Ok([(sum / count).sqrt() as f32, largest.sqrt()])
}

/// A coarse point is a vertex.
fn place(vertex: u32) -> Place {
    Place { vertices: [vertex; 3], weights: [1.0, 0.0] }
}

fn skins(scene: &Scene, bound: &bind::Bound) -> Vec<Skin> {
    let skin = |v: usize| Skin {
        vertex: v as u32,
        share: (bound.shares[v] * f32::from(WHOLE)).round() as u16,
        binding: bound.bindings[v],
        rest: scene.garment.positions[v].to_array(),
        normal: guard(&bound.rooms[v]).map_or([0.0; 3], |room| room.normal.to_array()),
        floor_m: guard(&bound.rooms[v]).map_or(0.0, |room| room.floor_m),
    };
    let touches = |skin: &Skin| skin.share > 0 || skin.is_guarded();
    (0..bound.shares.len()).map(skin).filter(touches).collect()
}

/// What keeps a fine vertex off the body, where it is near enough for a plane to tell.
fn guard(room: &bind::Room) -> Option<&bind::Room> {
    (room.reach_m <= GUARDED_M && room.normal != Vec3::ZERO).then_some(room)
}

/// Free coarse points that the skin leaves some room only.
fn tethers(vertices: &[u32], bound: &bind::Bound) -> Vec<Tether> {
    let tether = |(point, v): (usize, &u32)| {
        let (v, room) = (*v as usize, &bound.rooms[*v as usize]);
        let held = bound.shares[v] <= PINNED_SHARE && room.reach_m.is_finite();
        held.then(|| Tether {
            point: point as u16,
            binding: bound.bindings[v],
            reach_m: room.reach_m,
            normal: room.normal.to_array(),
            floor_m: room.floor_m,
        })
    };
    vertices.iter().enumerate().filter_map(tether).collect()
}

/// The garment's own, but for bending: a fold that the coarse mesh cannot resolve must not form, so that
/// cloth of its edges' length stands against its own weight (bending length = edge).
fn fabric(scene: &Scene, mesh: &Mesh) -> Fabric {
    let f = &scene.garment.fabric;
    let edges = mesh.rest_lengths();
    let edge_m = edges.iter().sum::<f32>() / edges.len().max(1) as f32;
    let resolved = f.density * 9.81 * edge_m.powi(3);
    Fabric {
        density: f.density,
        stretch: f.stretch,
        weft: f.weft,
        shear: f.shear,
        bend: f.bend.max(resolved.min(1.0)),
        friction: f.friction,
        drag: f.drag,
        damping_s: f.damping_s,
        offset: f.offset,
    }
}

/// Two steps a frame; coarse triangles may shrink where the fine cloth folds. Capsules are wider by what
/// triangles between points cut off (Kavan et al. 2011, section 7).
fn stepping(scene: &Scene) -> Stepping {
    Stepping {
        steps: 2,
        passes: 10,
        sweeps: 4,
        ground: scene.exploration.ground,
        compression: 0.6,
        damping_per_s: 1.0,
        expansion_m: 0.015,
        spacing_m: 0.08,
        apart_m: 0.04,
    }
}

fn classes(scene: &Scene) -> Vec<Class> {
    let class = |rule: &crate::scene::ClassRule| Class {
        joint: rule.joint,
        axis: rule.axis.to_array(),
        threshold_m: rule.threshold_m,
        vertices: rule.vertices.clone(),
    };
    scene.metric.classes.iter().map(class).collect()
}

#[cfg(test)]
mod tests;

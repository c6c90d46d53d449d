//! Cloth outside the graph: coarse simulation and a learned upsampler, where a host applies a force
//! that no graph has seen (Kavan et al. 2011; their run time).
//!
//! [`Upsampled`] is made once of a version's chunk, off the frame loop; `run` steps it once a frame;
//! [`probe`] finds the state of the graph to which it comes back, `draw` leads it there. Nothing
//! here waits, reads or
//! writes, and a warm frame allocates nothing.

pub(crate) mod draw;
pub mod probe;
pub(crate) mod run;

use cloth::coarse::{Coarse, CoarseError, Settings};
use cloth::{Environment, Material, Mesh, MeshError, Rigid, Vec3};
use codec::kernel::normals::{Faces, NormalsError};
use codec::upsample::{Transform, UpsampleError, Upsampler};
use protocol::scene::GarmentChunk;

use crate::scene::Scene;

/// Pushes that act at the same time.
pub const PUSHES_MAX: usize = 8;
/// Fastest wind (m/s) and largest acceleration of a push (m/s^2); what is above counts as this.
pub const FORCE_MAX: f32 = 200.0;

/// A push: for some frames, cloth near a point is accelerated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Push {
    /// Where, in the world (m).
    pub at: Vec3,
    /// How far it reaches, fading out (m).
    pub radius_m: f32,
    /// Acceleration at that point (m/s^2).
    pub acceleration: Vec3,
    /// For how many frames.
    pub frames: u32,
}

/// Where a character stands while it is outside the graph.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outside {
    /// Frames since it left.
    pub frames: u32,
    /// Distance (m) of the nearest state found so far of this pose: the largest of any probed vertex.
    /// `None` while a force acts, or where no state of the pose and the class is resident: nothing
    /// is close, and it stays outside.
    pub nearest_m: Option<f32>,
}

/// Why a chunk is no upsampler for this garment on this character.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum UpsampledError {
    /// The bytes.
    #[error(transparent)]
    Bytes(#[from] UpsampleError),
    /// Of another mesh.
    #[error("the upsampler makes {fine} vertices, the garment has {vertices}")]
    Vertices {
        /// What it makes.
        fine: usize,
        /// What there are.
        vertices: u32,
    },
    /// Of another character.
    #[error("the upsampler names {named} joints, the character has {joints}")]
    Joints {
        /// Named.
        named: usize,
        /// Existing.
        joints: usize,
    },
    /// The coarse mesh.
    #[error("the upsampler's coarse mesh: {0}")]
    Mesh(#[from] MeshError),
    /// The coarse cloth.
    #[error("the upsampler's coarse cloth: {0}")]
    Coarse(#[from] CoarseError),
    /// The garment's triangles.
    #[error("the garment's triangles: {0}")]
    Faces(#[from] NormalsError),
}

/// A garment's upsampler with everything to run it, immutable.
#[derive(Debug)]
pub struct Upsampled {
    upsampler: Upsampler,
    coarse: Coarse,
    faces: Faces,
    /// By joint: from the rest pose into the joint's frame.
    to_joint: Vec<Rigid>,
}

impl Upsampled {
    /// Puts a stored upsampler on a garment and a character. Never done on the frame loop.
    ///
    /// # Errors
    /// It does not fit, or cannot be simulated.
    pub fn new(bytes: &[u8], mesh: &GarmentChunk, scene: &Scene) -> Result<Self, UpsampledError> {
        let upsampler = Upsampler::decode(bytes)?;
        let (fine, vertices) = (upsampler.fine(), mesh.vertex_count);
        if fine != vertices as usize {
            return Err(UpsampledError::Vertices { fine, vertices });
        }
        let (named, joints) = (upsampler.joints(), scene.skeleton().joint_count());
        if named > joints {
            return Err(UpsampledError::Joints { named, joints });
        }
        Ok(Self {
            coarse: coarse(&upsampler)?,
            faces: Faces::new(fine, mesh.triangles.clone())?,
            to_joint: scene.skeleton().rest.iter().map(Rigid::inverse).collect(),
            upsampler,
        })
    }

    /// What it was made from.
    pub fn upsampler(&self) -> &Upsampler {
        &self.upsampler
    }

    /// Memory held (bytes), about.
    pub fn resident_bytes(&self) -> usize {
        let (fine, coarse) = (self.upsampler.fine(), self.upsampler.coarse());
        // Triangles; per coarse point the mesh, its stencils and its row of the solve.
        self.upsampler.resident_bytes() + 24 * fine + 1024 * coarse
    }
}

fn coarse(upsampler: &Upsampler) -> Result<Coarse, UpsampledError> {
    let parts = upsampler.parts();
    let points = parts.points.iter().map(|p| Vec3::from_array(*p)).collect();
    let triangles = parts.triangles.iter().map(|t| t.map(u32::from)).collect();
    let (f, s) = (&parts.fabric, &parts.stepping);
    let material = Material {
        density: f.density,
        stretch: f.stretch,
        weft: f.weft,
        shear: f.shear,
        bend: f.bend,
        friction: f.friction,
        drag: f.drag,
        damping_s: f.damping_s,
        offset: f.offset,
    };
    let environment = Environment { ground: s.ground, ..Environment::default() };
    let pinned: Vec<u32> = parts.pins.iter().map(|pin| pin.point.into()).collect();
    let settings = Settings {
        passes: s.passes.into(),
        sweeps: s.sweeps.into(),
        compression: s.compression,
        damping_per_s: s.damping_per_s,
        expansion_m: s.expansion_m,
        spacing_m: s.spacing_m,
        apart_m: s.apart_m,
    };
    let mesh = Mesh::new(points, triangles)?;
    Ok(Coarse::new(mesh, material, environment, &pinned, settings)?)
}

/// A rigid transform as the codec takes it.
fn transform(rigid: &Rigid) -> Transform {
    let [x, y, z] = [Vec3::X, Vec3::Y, Vec3::Z].map(|axis| rigid.vector(axis));
    let t = rigid.translation;
    [[x.x, y.x, z.x, t.x], [x.y, y.y, z.y, t.y], [x.z, y.z, z.z, t.z]]
}

/// What a host does to a character's cloth.
#[derive(Debug, Clone)]
pub(crate) struct Forces {
    /// Velocity of the air in the world (m/s).
    pub(crate) wind: Vec3,
    /// The host wants it outside whatever acts.
    pub(crate) stay: bool,
    pub(crate) pushes: Vec<Push>,
}

impl Default for Forces {
    fn default() -> Self {
        Self { wind: Vec3::ZERO, stay: false, pushes: Vec::with_capacity(PUSHES_MAX) }
    }
}

impl Forces {
    pub(crate) fn act(&self) -> bool {
        self.stay || self.wind != Vec3::ZERO || !self.pushes.is_empty()
    }

    /// A frame has passed.
    fn pass(&mut self) {
        self.pushes.retain_mut(|push| {
            push.frames -= 1;
            push.frames > 0
        });
    }

    /// Acceleration of a point (m/s^2): each push fades to nothing at its radius.
    fn acceleration(&self, at: Vec3) -> Vec3 {
        let one = |push: &Push| {
            let square = at.distance_squared(push.at) / (push.radius_m * push.radius_m);
            let left = (1.0 - square).max(0.0);
            push.acceleration * (left * left)
        };
        self.pushes.iter().map(one).sum()
    }
}

impl Push {
    /// As it is applied; `None` where it does nothing or is no push.
    pub(crate) fn sound(self) -> Option<Self> {
        let finite = self.at.is_finite() && self.acceleration.is_finite();
        let reaches = self.radius_m.is_finite() && self.radius_m > 0.0 && self.frames > 0;
        let acceleration = self.acceleration.clamp_length_max(FORCE_MAX);
        (finite && reaches).then_some(Self { acceleration, ..self })
    }
}

#[cfg(test)]
mod sheet;
#[cfg(test)]
mod tests;

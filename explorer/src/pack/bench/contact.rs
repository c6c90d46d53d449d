//! How deep cloth is in the body, and what a renderer does about it: a body that is a little
//! thinner under the garment, and a depth offset of the garment's vertices (Kim et al. 2013,
//! section 5, name both for what blending and compression push through the skin).

use cloth::surface::Posed;
use cloth::{Body, Surface, Vec3};
use protocol::scene::SceneChunk;
use protocol::{PoseId, StateId};

use super::world::{body, pose_of};
use super::{Bench, BenchError, Bound, EncodeError};

/// How far skin is looked for (m): what is deeper is counted as this deep.
const REACH_M: f32 = 0.05;
/// Shallower than this is on the skin (m).
const TOUCH_M: f32 = 1e-4;
/// A vertex is held between two body parts if this far out of one it is in another (m).
const PINCH_M: f32 = 0.004;
/// The body is made thinner by this much at most (m): more would be seen at its seams.
const SHRINK_MAX_M: f32 = 0.008;
/// The garment is drawn nearer by this much at most (m).
const OFFSET_MAX_M: f32 = 0.02;
/// Corners of a triangle that carry less of a contact than this are left alone.
const SHARE_MIN: f32 = 0.2;

/// The body, to be asked how deep cloth is in it.
pub struct Skin<'a> {
    scene: &'a SceneChunk,
    body: Body,
    surface: Surface,
}

/// Vertices in the body, those held between two of its parts apart.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Inside {
    /// Vertices looked at.
    pub vertices: u64,
    /// Of these, deeper than 0.1 mm.
    pub inside: u64,
    /// Of these, deeper than 2 mm.
    pub deep: u64,
    /// The deepest (m), at most 50 mm.
    pub max_m: f32,
}

impl Inside {
    /// Counts one vertex at this depth (m).
    pub fn add(&mut self, depth_m: f32) {
        self.vertices += 1;
        self.inside += u64::from(depth_m > TOUCH_M);
        self.deep += u64::from(depth_m > 0.002);
        self.max_m = self.max_m.max(depth_m);
    }
}

/// Data for a renderer.
#[derive(Debug, Clone, PartialEq)]
pub struct Cleanup {
    /// By body vertex: how far it is drawn inwards along its normal in the bind pose (m).
    pub shrink_m: Vec<f32>,
    /// By garment vertex: how much nearer to the eye its depth is taken (m).
    pub depth_offset_m: Vec<f32>,
}

/// What it does, on states that it was not made from.
#[derive(Debug, Clone, PartialEq)]
pub struct Cleaned {
    /// The data.
    pub cleanup: Cleanup,
    /// States looked at.
    pub states: usize,
    /// States as they were simulated, and the body.
    pub exact: Inside,
    /// As a client decodes them.
    pub decoded: Inside,
    /// Decoded, and the thinner body.
    pub shrunk: Inside,
    /// Decoded, the thinner body, and what the depth offset hides taken out.
    pub offset: Inside,
}

impl<'a> Skin<'a> {
    /// `None` where the scene gives no body away.
    pub fn new(scene: &'a SceneChunk) -> Option<Self> {
        let body = body(scene, scene.body.as_ref()?);
        let surface = Surface::new(&body.rest_positions, &body.triangles);
        Some(Self { scene, body, surface })
    }

    /// The body of this much less at each vertex (m).
    fn shrunk(&self, by_m: &[f32]) -> Self {
        let mut normals = vec![Vec3::ZERO; self.body.rest_positions.len()];
        for corners in &self.body.triangles {
            let [a, b, c] = corners.map(|v| self.body.rest_positions[v as usize]);
            let normal = (b - a).cross(c - a);
            corners.iter().for_each(|v| normals[*v as usize] += normal);
        }
        let mut body = self.body.clone();
        for ((p, normal), by_m) in body.rest_positions.iter_mut().zip(&normals).zip(by_m) {
            *p -= normal.normalize_or_zero() * *by_m;
        }
        let surface = Surface::new(&body.rest_positions, &body.triangles);
        Self { scene: self.scene, body, surface }
    }

    /// The skin in the state frame of a pose.
    pub fn posed(&self, pose: PoseId) -> Posed {
        let pose = pose_of(self.scene, pose);
        let (mut joints, mut skin) = (Vec::new(), Vec::new());
        self.body.skin(&pose, &mut joints, &mut skin);
        let to_hips = pose.hips().inverse();
        let skin: Vec<Vec3> = skin.iter().map(|p| to_hips.point(*p)).collect();
        self.surface.posed(&skin)
    }

    /// Tells `found` of each vertex (three numbers of `positions` each, m) how deep it is (m), 0
    /// outside, and which corners of the body carry the skin above it, by their share.
    fn each(
        &self,
        posed: &Posed,
        positions: &[f32],
        found: &mut dyn FnMut(usize, f32, [(u32, f32); 3]),
    ) {
        for (vertex, p) in positions.chunks_exact(3).enumerate() {
            let point = Vec3::new(p[0], p[1], p[2]);
            let near = self.surface.closest(posed, point, REACH_M);
            let near = near.filter(|contact| contact.distance < 0.0);
            let free = near.filter(|contact| !self.surface.is_pinched(posed, contact, PINCH_M));
            match free {
                None => found(vertex, 0.0, [(0, 0.0); 3]),
                Some(contact) => {
                    let corners = self.surface.triangles()[contact.triangle as usize];
                    let shares = contact.weights.to_array();
                    let carried = [0, 1, 2].map(|i| (corners[i], shares[i]));
                    found(vertex, -contact.distance, carried);
                }
            }
        }
    }

    /// Counts the vertices of positions (m) in the state frame that are in the body.
    pub fn inside(&self, posed: &Posed, positions: &[f32], sum: &mut Inside) {
        self.each(posed, positions, &mut |_, depth_m, _| sum.add(depth_m));
    }
}

impl Bench<'_> {
    /// Makes the data from every second region, as decoded within a bound, and measures it on the
    /// regions between them. `None` where the store gives no body away.
    ///
    /// # Errors
    /// The bound is none, or the states cannot be encoded.
    pub fn cleanup(&self, bound: Bound) -> Result<Option<Cleaned>, BenchError> {
        let Some(skin) = self.source.scene().and_then(Skin::new) else { return Ok(None) };
        let vertices = self.source.vertices();
        let body_vertices = skin.body.rest_positions.len();
        let mut shrink_m = vec![0.0f32; body_vertices];
        self.decoded(bound, 0, |pose, _, decoded| {
            skin.each(&skin.posed(pose), decoded, &mut |_, depth_m, corners| {
                for (corner, share) in corners {
                    if share > SHARE_MIN {
                        let most = &mut shrink_m[corner as usize];
                        *most = most.max(depth_m.min(SHRINK_MAX_M));
                    }
                }
            });
        })?;
        let thin = skin.shrunk(&shrink_m);
        let mut depth_offset_m = vec![0.0f32; vertices];
        self.decoded(bound, 0, |pose, _, decoded| {
            thin.each(&thin.posed(pose), decoded, &mut |vertex, depth_m, _| {
                let most = &mut depth_offset_m[vertex];
                *most = most.max(depth_m.min(OFFSET_MAX_M));
            });
        })?;
        let (mut states, mut sums) = (0, [Inside::default(); 4]);
        self.decoded(bound, 1, |pose, exact, decoded| {
            let [of_exact, of_decoded, of_thin, hidden] = &mut sums;
            let posed = skin.posed(pose);
            skin.inside(&posed, exact, of_exact);
            skin.inside(&posed, decoded, of_decoded);
            thin.each(&thin.posed(pose), decoded, &mut |vertex, depth_m, _| {
                of_thin.add(depth_m);
                hidden.add((depth_m - depth_offset_m[vertex]).max(0.0));
            });
            states += 1;
        })?;
        let [exact, decoded, shrunk, offset] = sums;
        let cleanup = Cleanup { shrink_m, depth_offset_m };
        Ok(Some(Cleaned { cleanup, states, exact, decoded, shrunk, offset }))
    }

    /// Shows the states of every second region, from `from` on: pose, exact, decoded.
    fn decoded(
        &self,
        bound: Bound,
        from: usize,
        mut show: impl FnMut(PoseId, &[f32], &[f32]),
    ) -> Result<(), BenchError> {
        if !bound.is_valid() {
            return Err(EncodeError::Bound(bound).into());
        }
        let rms_m = bound.design_rms_m();
        let (encoder, _) = self.encoder(&self.spectrum.design(rms_m), bound.max_m, rms_m)?;
        let rows = encoder.basis().rows();
        let (mut exact, mut decoded) = (Vec::new(), Vec::new());
        for region in (from..self.source.regions()).step_by(2) {
            self.progress("contact", region);
            self.source.read(region, &mut exact).map_err(EncodeError::Read)?;
            encoder.decode(&encoder.region(&exact)?.bytes, &mut decoded);
            let states = exact.chunks_exact(rows).zip(decoded.chunks_exact(rows));
            for (id, (exact, decoded)) in (self.source.region(region).0.0..).zip(states) {
                if let Some(pose) = self.source.pose(StateId(id)) {
                    show(pose, exact, decoded);
                }
            }
        }
        Ok(())
    }
}

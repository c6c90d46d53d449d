//! What does not change during a run, what does, and what a step needs besides.

use std::sync::Arc;

use glam::Vec3;

use crate::body::Body;
use crate::material::{Material, MaterialError};
use crate::mesh::Mesh;
use crate::solver::aggregate::Shares;
use crate::solver::bending;
use crate::solver::matrix::Pattern;
use crate::surface::{Posed, Surface};
use crate::tree::Tree;

/// Gravity, air and ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Environment {
    /// Acceleration (m/s^2).
    pub gravity: Vec3,
    /// Density of the air (kg/m^3).
    pub air_density: f32,
    /// Velocity of the air (m/s).
    pub wind: Vec3,
    /// Whether there is a ground plane at y = 0.
    pub ground: bool,
    /// Coulomb friction against the ground.
    pub ground_friction: f32,
    /// Whether the cloth keeps off itself.
    pub self_contact: bool,
}

impl Default for Environment {
    /// The earth at sea level, in a calm, without a ground.
    fn default() -> Self {
        Self {
            gravity: Vec3::new(0.0, -9.81, 0.0),
            air_density: 1.225,
            wind: Vec3::ZERO,
            ground: false,
            ground_friction: 0.4,
            self_contact: true,
        }
    }
}

/// A cloth vertex that is held to the body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Attachment {
    /// Vertex of the garment.
    pub vertex: u32,
    /// Triangle of the body; unused where there is no body.
    pub triangle: u32,
    /// Barycentric coordinates of the closest point in the rest pose.
    pub weights: Vec3,
    /// From there to the vertex, in the triangle's frame (m).
    pub offset: Vec3,
}

/// A garment on a body: everything that stays the same from frame to frame.
#[derive(Debug, Clone)]
pub struct Model {
    pub(crate) mesh: Mesh,
    pub(crate) material: Material,
    pub(crate) environment: Environment,
    pub(crate) body: Option<Character>,
    pub(crate) attachments: Vec<Attachment>,
    /// Triangle of the body nearest to each vertex in the rest pose; empty without a body.
    pub(crate) nearest: Vec<u32>,
    /// Edges between held vertices, with their rest lengths (m).
    pub(crate) held_edges: Vec<([u32; 2], f32)>,
    /// Vertex masses (kg).
    pub(crate) masses: Vec<f32>,
    pub(crate) pattern: Pattern,
    /// Coarse nodes of the preconditioner.
    pub(crate) shares: Shares,
    /// Over the garment's triangles.
    pub(crate) tree: Tree,
    /// Layer of each vertex, counted outwards; empty where all are one.
    pub(crate) layers: Vec<u8>,
    /// Bending energy's Hessian, in the pattern's layout (N/m).
    pub(crate) bending: bending::Stiffness,
}

/// A body and its surface's topology.
#[derive(Debug, Clone)]
pub(crate) struct Character {
    pub(crate) body: Arc<Body>,
    pub(crate) surface: Surface,
}

/// The whole state of a garment: nothing else is carried from frame to frame.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct State {
    /// World positions (m).
    pub positions: Vec<Vec3>,
    /// World velocities (m/s).
    pub velocities: Vec<Vec3>,
}

/// Why a model could not be made.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ModelError {
    /// A physical constant is outside its range.
    #[error(transparent)]
    Material(#[from] MaterialError),
    /// An attached vertex does not exist or is listed twice.
    #[error("attached vertex {vertex} must be under {count} and listed once, in ascending order")]
    Attached {
        /// The vertex.
        vertex: u32,
        /// Number of vertices.
        count: usize,
    },
    /// Layers were not given for every vertex.
    #[error("{given} layers are given for {count} vertices; give each vertex one")]
    Layers {
        /// How many were given.
        given: usize,
        /// Number of vertices.
        count: usize,
    },
}

impl Model {
    /// A garment in the rest pose of `body`.
    ///
    /// * `attached`: vertices held to the body where they lie in the rest pose (without a body:
    ///   held in place), ascending.
    ///
    /// # Errors
    /// A constant outside its range, or an attached vertex that does not exist.
    pub fn new(
        mesh: Mesh,
        material: Material,
        environment: Environment,
        body: Option<Arc<Body>>,
        attached: &[u32],
    ) -> Result<Self, ModelError> {
        material.check()?;
        let count = mesh.vertex_count();
        let ascending = |i: usize| i == 0 || attached[i - 1] < attached[i];
        for (i, vertex) in attached.iter().copied().enumerate() {
            if vertex as usize >= count || !ascending(i) {
                return Err(ModelError::Attached { vertex, count });
            }
        }
        let body = body.map(|body| Character {
            surface: Surface::new(&body.rest_positions, &body.triangles),
            body,
        });
        let all: Vec<u32> = (0..count as u32).collect();
        let homes = if body.is_some() { attach(&mesh, body.as_ref(), &all) } else { Vec::new() };
        let nearest = homes.iter().map(|home| home.triangle).collect();
        let pattern = Pattern::new(&mesh);
        let held = |v: u32| attached.binary_search(&v).is_ok();
        let edges = mesh.edges().iter().copied().zip(mesh.rest_lengths().iter().copied());
        let held_edges = edges.filter(|(e, _)| held(e[0]) && held(e[1])).collect();
        Ok(Self {
            attachments: attach(&mesh, body.as_ref(), attached),
            masses: mesh.vertex_areas().iter().map(|a| a * material.density).collect(),
            bending: bending::Stiffness::new(&mesh, &pattern, material.bend),
            held_edges,
            nearest,
            shares: Shares::new(&mesh, &pattern, held),
            tree: Tree::new(&mesh),
            layers: Vec::new(),
            pattern,
            mesh,
            material,
            environment,
            body,
        })
    }

    /// The same garment worn in layers: `layers` says for each vertex to which it belongs, counted
    /// outwards. Where two layers meet, the outer one is led to the side to which the inner one's
    /// triangles are turned, also if it starts on the other.
    ///
    /// # Errors
    /// Not one layer per vertex.
    pub fn with_layers(mut self, layers: Vec<u8>) -> Result<Self, ModelError> {
        let (given, count) = (layers.len(), self.mesh.vertex_count());
        if given != count {
            return Err(ModelError::Layers { given, count });
        }
        self.layers = layers;
        Ok(self)
    }

    /// The garment's mesh.
    pub fn mesh(&self) -> &Mesh {
        &self.mesh
    }

    /// The garment's cloth.
    pub fn material(&self) -> &Material {
        &self.material
    }

    /// The vertices that are held.
    pub fn attachments(&self) -> &[Attachment] {
        &self.attachments
    }

    /// The body's surface, for measures.
    pub fn surface(&self) -> Option<&Surface> {
        self.body.as_ref().map(|c| &c.surface)
    }

    /// The garment in the rest pose, at rest.
    pub fn rest_state(&self) -> State {
        let positions = self.mesh.rest_positions().to_vec();
        State { velocities: vec![Vec3::ZERO; positions.len()], positions }
    }
}

impl Attachment {
    /// Where the vertex is held when the body's vertices are at `body` (m).
    pub(crate) fn place(&self, surface: &Surface, posed: &Posed) -> Vec3 {
        let [a, b, c] = surface.triangle_frame(posed, self.triangle);
        let o = self.offset;
        surface.point(posed, self.triangle, self.weights) + a * o.x + b * o.y + c * o.z
    }
}

fn attach(mesh: &Mesh, body: Option<&Character>, attached: &[u32]) -> Vec<Attachment> {
    let free = |vertex| Attachment { vertex, triangle: 0, weights: Vec3::X, offset: Vec3::ZERO };
    let Some(character) = body else { return attached.iter().map(|v| free(*v)).collect() };
    let surface = &character.surface;
    let posed = surface.posed(&character.body.rest_positions);
    let one = |vertex: &u32| {
        let at = mesh.rest_positions()[*vertex as usize];
        let Some(contact) = surface.closest(&posed, at, f32::INFINITY) else {
            return free(*vertex);
        };
        let [a, b, c] = surface.triangle_frame(&posed, contact.triangle);
        let d = at - contact.point;
        let offset = Vec3::new(d.dot(a), d.dot(b), d.dot(c));
        let (triangle, weights) = (contact.triangle, contact.weights);
        Attachment { vertex: *vertex, triangle, weights, offset }
    };
    attached.iter().map(one).collect()
}

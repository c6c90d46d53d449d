//! Reads a character: a skinned body and its clips, from glTF 2.0.

use std::path::Path;

use cloth::{Body, Pose, Quat, Rigid, Skeleton, Vec3};
use glam::Mat4;
use gltf::json;
use gltf::json::mesh::{Mode, Semantic};
use gltf::json::validation::Checked;
use protocol::limits::{JOINTS_MAX, NAME_BYTES_MAX, TRIANGLES_MAX, VERTICES_MAX};

use super::animation;
use super::gltf_file::{Document, GltfError};

/// Smallest and largest height of a character (m); outside, the unit is taken to be wrong.
pub const HEIGHT_M: [f32; 2] = [0.3, 3.0];

/// A run of poses at a fixed rate.
#[derive(Debug, Clone, PartialEq)]
pub struct Clip {
    /// Its name, unique in a scene.
    pub name: String,
    /// Poses, one per frame.
    pub poses: Vec<Pose>,
}

/// A skinned body and what it can do.
#[derive(Debug, Clone, PartialEq)]
pub struct Character {
    /// The body, bound to its skeleton.
    pub body: Body,
    /// Its clips in the order of the file.
    pub clips: Vec<Clip>,
}

/// Why a character was refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CharacterError {
    /// The glTF document itself.
    #[error(transparent)]
    Gltf(#[from] GltfError),
    /// No mesh bound to a skin.
    #[error("no mesh is bound to a skin; export the body with its armature and vertex weights")]
    NoSkin,
    /// Meshes bound to several skins.
    #[error("meshes are bound to skins {0} and {1}; keep one character in the file")]
    SeveralSkins(usize, usize),
    /// A limit of `protocol::limits`.
    #[error("{what}: {count}, at most {max} are allowed; simplify the character")]
    TooMany {
        /// Of what.
        what: &'static str,
        /// How many.
        count: usize,
        /// The limit.
        max: usize,
    },
    /// The skin's joints do not form one tree.
    #[error("joint {joint:?}: {problem}")]
    Skeleton {
        /// Name of the joint.
        joint: String,
        /// What is wrong and what to do.
        problem: String,
    },
    /// The body mesh.
    #[error("body mesh {mesh:?}: {problem}")]
    Mesh {
        /// Name of the mesh.
        mesh: String,
        /// What is wrong and what to do.
        problem: String,
    },
    /// Weights name a joint that the skin does not have.
    #[error(
        "body mesh {mesh:?}: vertex {vertex} is bound to joint {joint}, but the skin has {joints} \
         joints; export the character again with all its joints"
    )]
    MissingJoint {
        /// Name of the mesh.
        mesh: String,
        /// The vertex.
        vertex: usize,
        /// The joint it names.
        joint: u32,
        /// How many the skin has.
        joints: usize,
    },
    /// A character of the wrong size.
    #[error(
        "the character is {height_m:.3} m high in its rest pose; between {} and {} m are \
         expected: set the unit to metres when exporting",
        HEIGHT_M[0],
        HEIGHT_M[1]
    )]
    Units {
        /// Measured along y.
        height_m: f32,
    },
    /// A clip.
    #[error("clip {clip:?}: {problem}")]
    Clip {
        /// Name of the clip.
        clip: String,
        /// What is wrong and what to do.
        problem: String,
    },
}

/// Reads a character from a `.glb` (or a `.gltf` whose buffers lie in `folder`), its animations
/// sampled at `fps`.
///
/// The skin's root joint becomes joint 0 (the hips); rigid transforms of nodes above it are
/// applied. The four largest weights of each vertex are kept and normalised.
///
/// # Errors
/// Anything that is missing, out of bounds, of the wrong size or not finite.
pub fn read_character(
    bytes: &[u8],
    folder: Option<&Path>,
    fps: f32,
) -> Result<Character, CharacterError> {
    let document = Document::read(bytes, folder)?;
    let meshes = skinned_nodes(&document.root)?;
    let rig = Rig::read(&document, meshes.skin)?;
    let body = read_body(&document, &meshes.nodes, &rig)?;
    check_height(&body.rest_positions)?;
    let clips = animation::read_clips(&document, &rig, &body.skeleton, fps)?;
    Ok(Character { body, clips })
}

fn check_height(positions: &[Vec3]) -> Result<(), CharacterError> {
    let low = positions.iter().map(|p| p.y).fold(f32::INFINITY, f32::min);
    let high = positions.iter().map(|p| p.y).fold(f32::NEG_INFINITY, f32::max);
    let height_m = high - low;
    if (HEIGHT_M[0]..=HEIGHT_M[1]).contains(&height_m) {
        Ok(())
    } else {
        Err(CharacterError::Units { height_m })
    }
}

struct SkinnedNodes {
    skin: usize,
    nodes: Vec<usize>,
}

fn skinned_nodes(root: &json::Root) -> Result<SkinnedNodes, CharacterError> {
    let mut found: Option<SkinnedNodes> = None;
    for (index, node) in root.nodes.iter().enumerate() {
        let (Some(_), Some(skin)) = (node.mesh, node.skin) else { continue };
        match &mut found {
            None => found = Some(SkinnedNodes { skin: skin.value(), nodes: vec![index] }),
            Some(all) if all.skin == skin.value() => all.nodes.push(index),
            Some(all) => return Err(CharacterError::SeveralSkins(all.skin, skin.value())),
        }
    }
    found.ok_or(CharacterError::NoSkin)
}

/// A skin's joints, parents first, and how they relate to the file's nodes.
pub(super) struct Rig {
    /// Node of each joint.
    pub(super) nodes: Vec<usize>,
    /// Our joint of each joint of the skin.
    joint_of_slot: Vec<u16>,
    names: Vec<String>,
    parents: Vec<Option<u16>>,
    /// Place of each joint in its parent's frame as the file's nodes say.
    pub(super) local: Vec<Rigid>,
    /// What stands above the root joint.
    pub(super) above: Rigid,
    /// Nodes above the root joint; they must not move.
    pub(super) ancestors: Vec<usize>,
    rest: Vec<Rigid>,
}

impl Rig {
    fn read(document: &Document, skin: usize) -> Result<Self, CharacterError> {
        let root = &document.root;
        let skin = root.skins.get(skin).ok_or(CharacterError::NoSkin)?;
        let slots: Vec<usize> = skin.joints.iter().map(|j| j.value()).collect();
        if slots.is_empty() || slots.len() > JOINTS_MAX {
            let count = slots.len();
            return Err(CharacterError::TooMany { what: "joints", count, max: JOINTS_MAX });
        }
        let parents = node_parents(root);
        let order = parents_first(root, &slots, &parents)?;
        let slot_of = |node: usize| slots.iter().position(|s| *s == node);
        let nodes: Vec<usize> = order.iter().map(|slot| slots[*slot]).collect();
        let mut joint_of_slot = vec![0u16; slots.len()];
        for (joint, slot) in order.iter().enumerate() {
            joint_of_slot[*slot] = joint as u16;
        }
        let (above, ancestors) = above(root, nodes[0], &parents)?;
        let parent =
            |node: &usize| parents[*node].and_then(slot_of).map(|slot| joint_of_slot[slot]);
        let local: Result<Vec<_>, _> = nodes.iter().map(|n| local_transform(root, *n)).collect();
        Ok(Self {
            names: nodes.iter().map(|n| node_name(root, *n)).collect(),
            parents: nodes.iter().map(parent).collect(),
            local: local?,
            above,
            ancestors,
            rest: rest_transforms(document, skin, &order, &nodes)?,
            nodes,
            joint_of_slot,
        })
    }

    fn skeleton(&self) -> Skeleton {
        let mut offsets: Vec<Vec3> = self.local.iter().map(|l| l.translation).collect();
        offsets[0] = self.rest[0].translation;
        Skeleton {
            names: self.names.clone(),
            parents: self.parents.clone(),
            offsets,
            rest: self.rest.clone(),
        }
    }
}

pub(super) fn node_name(root: &json::Root, node: usize) -> String {
    let name = root.nodes.get(node).and_then(|n| n.name.clone());
    let name = name.unwrap_or_else(|| format!("node {node}"));
    name.chars().take(NAME_BYTES_MAX / 4).collect()
}

fn node_parents(root: &json::Root) -> Vec<Option<usize>> {
    let mut parents = vec![None; root.nodes.len()];
    for (index, node) in root.nodes.iter().enumerate() {
        for child in node.children.iter().flatten() {
            if let Some(parent) = parents.get_mut(child.value()) {
                *parent = Some(index);
            }
        }
    }
    parents
}

/// Slots of the skin, each after its parent, otherwise in the order of the skin.
fn parents_first(
    root: &json::Root,
    slots: &[usize],
    parents: &[Option<usize>],
) -> Result<Vec<usize>, CharacterError> {
    let problem = |node: usize, problem: &str| CharacterError::Skeleton {
        joint: node_name(root, node),
        problem: problem.to_owned(),
    };
    let slot_of = |node: usize| slots.iter().position(|s| *s == node);
    let mut order = Vec::new();
    for (slot, node) in slots.iter().enumerate() {
        if *node >= root.nodes.len() {
            return Err(problem(*node, "the skin names a node that does not exist"));
        }
        if parents[*node].and_then(slot_of).is_none() {
            order.push(slot);
        }
    }
    match order.as_slice() {
        [_] => {}
        [] => return Err(problem(slots[0], "the joints form a ring; export the file again")),
        [_, second, ..] => {
            let text = "has no parent in the skin, nor has another joint; a skin needs one root \
                        joint (the hips) and no nodes between its joints";
            return Err(problem(slots[*second], text));
        }
    }
    let mut next = 0;
    while next < order.len() {
        let parent = slots[order[next]];
        let children = (0..slots.len()).filter(|s| parents[slots[*s]] == Some(parent));
        order.extend(children);
        if order.len() > slots.len() {
            return Err(problem(parent, "the joints form a ring; export the file again"));
        }
        next += 1;
    }
    if order.len() < slots.len() {
        return Err(problem(slots[0], "not every joint is below it; export the file again"));
    }
    Ok(order)
}

fn above(
    root: &json::Root,
    hips: usize,
    parents: &[Option<usize>],
) -> Result<(Rigid, Vec<usize>), CharacterError> {
    let mut above = Rigid::IDENTITY;
    let mut ancestors = Vec::new();
    let mut node = parents[hips];
    while let Some(at) = node {
        if ancestors.len() > parents.len() {
            return Err(CharacterError::Skeleton {
                joint: node_name(root, hips),
                problem: "the nodes above it form a ring; export the file again".to_owned(),
            });
        }
        above = local_transform(root, at)?.after(&above);
        ancestors.push(at);
        node = parents[at];
    }
    Ok((above, ancestors))
}

fn local_transform(root: &json::Root, node: usize) -> Result<Rigid, CharacterError> {
    let file = &root.nodes[node];
    let matrix = match file.matrix {
        Some(matrix) => Mat4::from_cols_array(&matrix),
        None => Mat4::from_scale_rotation_translation(
            file.scale.map_or(Vec3::ONE, Vec3::from_array),
            file.rotation.map_or(Quat::IDENTITY, |r| Quat::from_array(r.0)),
            file.translation.map_or(Vec3::ZERO, Vec3::from_array),
        ),
    };
    rigid(matrix).ok_or_else(|| CharacterError::Skeleton {
        joint: node_name(root, node),
        problem: "its transform scales, mirrors or is not finite; apply scale to the armature \
                  and export again"
            .to_owned(),
    })
}

/// A matrix as a rigid transform; `None` where it scales or shears by more than one in a thousand.
fn rigid(matrix: Mat4) -> Option<Rigid> {
    let (scale, rotation, translation) = matrix.to_scale_rotation_translation();
    let finite = rotation.is_finite() && translation.is_finite();
    let unit = (scale - Vec3::ONE).abs().max_element() < 1e-3;
    let again = Mat4::from_scale_rotation_translation(scale, rotation, translation);
    (finite && unit && again.abs_diff_eq(matrix, 1e-3))
        .then(|| Rigid { rotation: rotation.normalize(), translation })
}

/// World transforms of the joints when the body was bound: inverses of the inverse binds.
fn rest_transforms(
    document: &Document,
    skin: &json::Skin,
    order: &[usize],
    nodes: &[usize],
) -> Result<Vec<Rigid>, CharacterError> {
    let Some(accessor) = skin.inverse_bind_matrices else {
        return Ok(vec![Rigid::IDENTITY; order.len()]);
    };
    let numbers = document.numbers(accessor, 16, "inverse bind matrices")?;
    let one = |(slot, node): (&usize, &usize)| {
        let problem = |problem: &str| CharacterError::Skeleton {
            joint: node_name(&document.root, *node),
            problem: problem.to_owned(),
        };
        let matrix = numbers.get(slot * 16..slot * 16 + 16);
        let matrix = matrix.ok_or_else(|| problem("has no inverse bind matrix"))?;
        let bind = rigid(Mat4::from_cols_slice(matrix));
        let text = "its inverse bind matrix scales, shears or is not finite; apply scale to the \
                    armature and the mesh and export again";
        Ok(bind.ok_or_else(|| problem(text))?.inverse())
    };
    order.iter().zip(nodes).map(one).collect()
}

fn read_body(document: &Document, nodes: &[usize], rig: &Rig) -> Result<Body, CharacterError> {
    let mut body = Body {
        skeleton: rig.skeleton(),
        rest_positions: Vec::new(),
        triangles: Vec::new(),
        joints: Vec::new(),
        weights: Vec::new(),
    };
    for node in nodes {
        let mesh = document.root.nodes[*node].mesh;
        let Some(mesh) = mesh.and_then(|m| document.root.meshes.get(m.value())) else { continue };
        let name = mesh.name.clone().unwrap_or_else(|| node_name(&document.root, *node));
        for primitive in &mesh.primitives {
            add_primitive(document, primitive, &name, rig, &mut body)?;
        }
    }
    Ok(body)
}

fn add_primitive(
    document: &Document,
    primitive: &json::mesh::Primitive,
    mesh: &str,
    rig: &Rig,
    body: &mut Body,
) -> Result<(), CharacterError> {
    let problem = |problem: String| CharacterError::Mesh { mesh: mesh.to_owned(), problem };
    let first = body.rest_positions.len();
    let (positions, triangles) = read_triangles(document, primitive, mesh)?;
    let count = first + positions.len();
    if count > VERTICES_MAX {
        return Err(CharacterError::TooMany { what: "body vertices", count, max: VERTICES_MAX });
    }
    let count = body.triangles.len() + triangles.len();
    if count > TRIANGLES_MAX {
        return Err(CharacterError::TooMany { what: "body triangles", count, max: TRIANGLES_MAX });
    }
    let mut bonds: Vec<Vec<(u16, f32)>> = vec![Vec::new(); positions.len()];
    for set in 0.. {
        let joints = primitive.attributes.get(&Checked::Valid(Semantic::Joints(set)));
        let weights = primitive.attributes.get(&Checked::Valid(Semantic::Weights(set)));
        let (Some(joints), Some(weights)) = (joints, weights) else { break };
        let joints = document.integers(*joints, 4, mesh)?;
        let weights = document.numbers(*weights, 4, mesh)?;
        if joints.len() != 4 * positions.len() || weights.len() != joints.len() {
            return Err(problem("joints or weights of some vertices are missing".to_owned()));
        }
        for (i, (slot, weight)) in joints.iter().zip(&weights).enumerate() {
            if *weight > 0.0 {
                let joint = rig.joint_of_slot.get(*slot as usize);
                let joint = joint.ok_or_else(|| CharacterError::MissingJoint {
                    mesh: mesh.to_owned(),
                    vertex: first + i / 4,
                    joint: *slot,
                    joints: rig.joint_of_slot.len(),
                })?;
                bonds[i / 4].push((*joint, *weight));
            }
        }
    }
    for (vertex, bonds) in bonds.iter_mut().enumerate() {
        let (joints, weights) = largest_four(bonds).ok_or_else(|| {
            problem(format!("vertex {} has no weight; bind it to a joint", first + vertex))
        })?;
        body.joints.push(joints);
        body.weights.push(weights);
    }
    let offset = first as u32;
    body.rest_positions.extend(positions);
    body.triangles.extend(triangles.iter().map(|t| t.map(|v| v + offset)));
    Ok(())
}

/// The four largest bonds, normalised; `None` where they add up to nothing.
fn largest_four(bonds: &mut [(u16, f32)]) -> Option<([u16; 4], [f32; 4])> {
    bonds.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    let sum: f32 = bonds.iter().take(4).map(|b| b.1).sum();
    if !(sum.is_finite() && sum > 1e-6) {
        return None;
    }
    let (mut joints, mut weights) = ([0; 4], [0.0; 4]);
    for (i, (joint, weight)) in bonds.iter().take(4).enumerate() {
        joints[i] = *joint;
        weights[i] = weight / sum;
    }
    Some((joints, weights))
}

/// Positions and triangles of a primitive, indices checked.
pub(super) fn read_triangles(
    document: &Document,
    primitive: &json::mesh::Primitive,
    mesh: &str,
) -> Result<(Vec<Vec3>, Vec<[u32; 3]>), CharacterError> {
    let problem = |problem: String| CharacterError::Mesh { mesh: mesh.to_owned(), problem };
    if primitive.mode != Checked::Valid(Mode::Triangles) {
        return Err(problem("is not made of triangles; triangulate it and export again".into()));
    }
    let accessor = primitive.attributes.get(&Checked::Valid(Semantic::Positions));
    let accessor = accessor.ok_or_else(|| problem("has no positions".to_owned()))?;
    let numbers = document.numbers(*accessor, 3, mesh)?;
    let positions: Vec<Vec3> = numbers.chunks_exact(3).map(Vec3::from_slice).collect();
    if let Some(vertex) = positions.iter().position(|p| !p.is_finite()) {
        return Err(problem(format!("vertex {vertex} is not finite; export the file again")));
    }
    let indices = match primitive.indices {
        Some(accessor) => document.integers(accessor, 1, mesh)?,
        None => (0..positions.len() as u32).collect(),
    };
    if indices.len() % 3 != 0 {
        return Err(problem(format!("{} indices are no whole triangles", indices.len())));
    }
    if let Some(index) = indices.iter().find(|i| **i as usize >= positions.len()) {
        let count = positions.len();
        return Err(problem(format!("names vertex {index}, but there are {count}")));
    }
    Ok((positions, indices.chunks_exact(3).map(|t| [t[0], t[1], t[2]]).collect()))
}

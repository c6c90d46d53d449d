//! Reads a garment: a surface in the rest pose of its character, refined and attached.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use cloth::{Skeleton, Vec3};
use protocol::limits::{TRIANGLES_MAX, VERTICES_MAX};

use super::character::{self, CharacterError};
use super::gltf_file::Document;
use super::obj;
use super::refine::{TooFine, refine, refine_to};

/// A triangle mesh as read.
#[derive(Debug, Clone, PartialEq)]
pub struct Surface {
    /// Vertices (m).
    pub positions: Vec<Vec3>,
    /// Counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

/// Which vertices are held to the body where they lie in the rest pose.
#[derive(Debug, Clone, PartialEq)]
pub enum Attachment {
    /// All that are nearer to a place than so many metres.
    Near {
        /// Name of a joint,
        joint: String,
        /// and how far from it the place lies in the rest pose (m).
        offset: Vec3,
        /// Metres.
        within_m: f32,
    },
    /// The boundary loop whose vertices are nearest to a joint on average.
    Loop {
        /// Name of the joint.
        joint: String,
    },
    /// Vertices of the file by index, from 0.
    Vertices(Vec<u32>),
}

/// Why a garment was refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum GarmentError {
    /// The OBJ file.
    #[error("line {line}: {problem}; export the mesh again as OBJ")]
    Obj {
        /// Counted from 1.
        line: usize,
        /// What is wrong.
        problem: String,
    },
    /// The glTF file.
    #[error(transparent)]
    Gltf(#[from] CharacterError),
    /// Neither `.obj` nor `.glb` nor `.gltf`.
    #[error("a garment is an .obj, .glb or .gltf file")]
    Kind,
    /// No triangles, or over a limit of `protocol::limits`.
    #[error("{vertices} vertices and {triangles} triangles; 1 to {TRIANGLES_MAX} are allowed")]
    Size {
        /// Vertices.
        vertices: usize,
        /// Triangles.
        triangles: usize,
    },
    /// The surface itself.
    #[error("{0}")]
    Surface(String),
    /// Refinement.
    #[error("edge_length_m = {edge_length_m}: {problem}")]
    Refine {
        /// As asked for (m).
        edge_length_m: f32,
        /// What is wrong.
        problem: String,
    },
    /// A number of vertices.
    #[error("{vertices} vertices: {problem}")]
    Vertices {
        /// As asked for.
        vertices: usize,
        /// What is wrong.
        problem: String,
    },
    /// A piece that could not be made.
    #[error(transparent)]
    Tailor(#[from] crate::tailor::TailorError),
    /// An attachment.
    #[error("attach[{index}]: {problem}")]
    Attach {
        /// Position in the list.
        index: usize,
        /// What is wrong and what to do.
        problem: String,
    },
}

impl Surface {
    /// Reads an OBJ, or the one unskinned or skinned mesh of a glTF file, by the file's ending.
    ///
    /// # Errors
    /// A file that cannot be read, of another kind, or empty.
    pub fn read(path: &Path, bytes: &[u8]) -> Result<Self, GarmentError> {
        let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        let surface = match ending.as_deref() {
            Some("obj") => obj::parse(bytes)?,
            Some("glb" | "gltf") => Self::parse_gltf(bytes, path.parent())?,
            _ => return Err(GarmentError::Kind),
        };
        let (vertices, triangles) = (surface.positions.len(), surface.triangles.len());
        if triangles == 0 || triangles > TRIANGLES_MAX || vertices > VERTICES_MAX {
            return Err(GarmentError::Size { vertices, triangles });
        }
        Ok(surface)
    }

    fn parse_gltf(bytes: &[u8], folder: Option<&Path>) -> Result<Self, GarmentError> {
        let document = Document::read(bytes, folder).map_err(CharacterError::from)?;
        let mut surface = Self { positions: Vec::new(), triangles: Vec::new() };
        for mesh in &document.root.meshes {
            let name = mesh.name.as_deref().unwrap_or("garment");
            for primitive in &mesh.primitives {
                let (positions, triangles) = character::read_triangles(&document, primitive, name)?;
                surface.append(positions, triangles.as_flattened())?;
            }
        }
        surface.weld();
        Ok(surface)
    }

    fn append(&mut self, positions: Vec<Vec3>, indices: &[u32]) -> Result<(), GarmentError> {
        let first = self.positions.len() as u32;
        if let Some(index) = indices.iter().find(|i| **i as usize >= positions.len()) {
            let text = format!("a face names vertex {index}, but there are {}", positions.len());
            return Err(GarmentError::Surface(text));
        }
        self.positions.extend(positions);
        self.triangles
            .extend(indices.chunks_exact(3).map(|t| [t[0], t[1], t[2]].map(|v| v + first)));
        Ok(())
    }

    /// Vertices at exactly one place become one: glTF splits them where normals differ.
    fn weld(&mut self) {
        let mut kept: BTreeMap<[u32; 3], u32> = BTreeMap::new();
        let mut positions = Vec::new();
        let mut new_index = Vec::with_capacity(self.positions.len());
        for p in &self.positions {
            let place = (*p + Vec3::ZERO).to_array().map(f32::to_bits);
            new_index.push(*kept.entry(place).or_insert_with(|| {
                positions.push(*p);
                positions.len() as u32 - 1
            }));
        }
        self.positions = positions;
        for corner in self.triangles.iter_mut().flatten() {
            *corner = new_index[*corner as usize];
        }
    }

    /// Cuts edges until none is longer than `edge_length_m`.
    ///
    /// # Errors
    /// A length that is not positive, or so short that a limit would be passed.
    pub fn refine(&mut self, edge_length_m: f32) -> Result<(), GarmentError> {
        let error = |problem: String| GarmentError::Refine { edge_length_m, problem };
        if !(edge_length_m.is_finite() && edge_length_m > 0.0) {
            return Err(error("must be a positive number of metres".to_owned()));
        }
        refine(&mut self.positions, &mut self.triangles, edge_length_m, VERTICES_MAX)
            .map_err(|e: TooFine| error(e.to_string()))
    }

    /// Cuts edges, the longest first, until there are exactly so many vertices.
    ///
    /// # Errors
    /// The surface has more vertices already, or the number is over a limit.
    pub fn refine_to(&mut self, vertices: usize) -> Result<(), GarmentError> {
        let error = |problem: String| GarmentError::Vertices { vertices, problem };
        if vertices > VERTICES_MAX {
            return Err(error(format!("at most {VERTICES_MAX} are allowed")));
        }
        refine_to(&mut self.positions, &mut self.triangles, vertices)
            .map_err(|e| error(e.to_string()))
    }

    /// Boundary loops as vertex lists, in order of their smallest vertex.
    pub fn boundary_loops(&self) -> Vec<Vec<u32>> {
        let mut directed = BTreeSet::new();
        for t in &self.triangles {
            directed.extend([(t[0], t[1]), (t[1], t[2]), (t[2], t[0])]);
        }
        let border = directed.iter().filter(|(a, b)| !directed.contains(&(*b, *a)));
        let mut next: BTreeMap<u32, u32> = border.copied().collect();
        let mut loops = Vec::new();
        while let Some((start, mut at)) = next.pop_first() {
            let mut vertices = vec![start];
            while at != start {
                vertices.push(at);
                let Some(to) = next.remove(&at) else { break };
                at = to;
            }
            loops.push(vertices);
        }
        loops
    }

    /// Attached vertices, sorted, each once. Vertices of the file keep their index when the
    /// surface is refined.
    ///
    /// # Errors
    /// A joint that is not there, or an attachment that holds nothing.
    pub fn attach(
        &self,
        attachments: &[Attachment],
        skeleton: &Skeleton,
        file_vertices: usize,
    ) -> Result<Vec<u32>, GarmentError> {
        let mut all = BTreeSet::new();
        for (index, attachment) in attachments.iter().enumerate() {
            let held = self
                .held(attachment, skeleton, file_vertices)
                .map_err(|problem| GarmentError::Attach { index, problem })?;
            all.extend(held);
        }
        Ok(all.into_iter().collect())
    }

    fn held(
        &self,
        attachment: &Attachment,
        skeleton: &Skeleton,
        file_vertices: usize,
    ) -> Result<Vec<u32>, String> {
        let place = |joint: &String| match skeleton.joint(joint) {
            Some(index) => Ok(skeleton.rest[index].translation),
            None => Err(format!(
                "the character has no joint {joint:?}; it has {}",
                skeleton.names.join(", ")
            )),
        };
        match attachment {
            Attachment::Near { joint, offset, within_m } => {
                let at = place(joint)? + *offset;
                let near = |v: &u32| self.positions[*v as usize].distance(at) <= *within_m;
                let held: Vec<u32> = (0..self.positions.len() as u32).filter(near).collect();
                if held.is_empty() {
                    return Err(format!("no vertex is within {within_m} m of {joint:?}; raise it"));
                }
                Ok(held)
            }
            Attachment::Loop { joint } => {
                let at = place(joint)?;
                let mean = |vertices: &Vec<u32>| {
                    let sum: f32 =
                        vertices.iter().map(|v| self.positions[*v as usize].distance(at)).sum();
                    sum / vertices.len() as f32
                };
                let loops = self.boundary_loops();
                let nearest = loops.into_iter().min_by(|a, b| mean(a).total_cmp(&mean(b)));
                nearest.ok_or_else(|| "the garment has no boundary loop".to_owned())
            }
            Attachment::Vertices(vertices) => {
                match vertices.iter().find(|v| **v as usize >= file_vertices) {
                    Some(v) => Err(format!("vertex {v} of {file_vertices} does not exist")),
                    None => Ok(vertices.clone()),
                }
            }
        }
    }
}

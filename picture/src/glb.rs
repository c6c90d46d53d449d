//! Moving meshes as binary glTF 2.0.
//!
//! The first frame is the mesh; every later frame is a morph target, and the animation turns one
//! target on at a time, blending linearly between frames. So programs that know nothing of cloth
//! (Blender, web viewers) play a clip without loss.

mod buffer;

use glam::Vec3;
use serde_json::{Value, json};

use crate::image::Rgb;
use buffer::Buffer;

/// Most frames of a clip: the weights alone are frames squared.
pub const FRAMES_MAX: usize = 2048;
/// Most bytes of a clip.
pub const BYTES_MAX: usize = 1 << 30;

/// Meshes that move together.
#[derive(Clone, Copy, Debug)]
pub struct Clip<'a> {
    /// Frames per second.
    pub rate: f32,
    /// Whether normals are written too. It doubles the size; without them most viewers show facets.
    pub normals: bool,
    /// At least one; all with the same number of frames.
    pub meshes: &'a [ClipMesh<'a>],
}

/// A mesh of a clip: a body, a garment.
#[derive(Clone, Copy, Debug)]
pub struct ClipMesh<'a> {
    /// Name of its node, mesh and material.
    pub name: &'a str,
    /// Vertex numbers, counter-clockwise when seen from the front.
    pub triangles: &'a [[u32; 3]],
    /// Vertex positions in the world of every frame, in metres, y up.
    pub frames: &'a [Vec<Vec3>],
    /// Its colour.
    pub colour: Rgb,
    /// Whether backs are drawn: yes for cloth.
    pub two_sided: bool,
}

/// Why a clip could not be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum GlbError {
    /// The rate is zero, negative or not a number.
    #[error("a clip of {0} frames per second cannot be played; the rate must be above zero")]
    Rate(f32),
    /// No mesh at all.
    #[error("a clip needs at least one mesh")]
    Empty,
    /// A mesh has no triangles or no frames, or too many frames.
    #[error(
        "mesh {mesh}: {triangles} triangles in {frames} frames; at least one of each is needed, \
         and at most {FRAMES_MAX} frames"
    )]
    Extent {
        /// Name of the mesh.
        mesh: String,
        /// Triangles given.
        triangles: usize,
        /// Frames given.
        frames: usize,
    },
    /// Meshes or frames differ in length.
    #[error("mesh {mesh}, frame {frame}: {found} {what}, where the first has {expected}")]
    Uneven {
        /// Name of the mesh.
        mesh: String,
        /// Number of the frame.
        frame: usize,
        /// What was counted.
        what: &'static str,
        /// Count found.
        found: usize,
        /// Count expected.
        expected: usize,
    },
    /// A triangle names a vertex that does not exist.
    #[error("mesh {mesh}: triangle {triangle} names a vertex that is not there; check the mesh")]
    Vertex {
        /// Name of the mesh.
        mesh: String,
        /// Number of the triangle.
        triangle: usize,
    },
    /// A position is not finite.
    #[error("mesh {mesh}, frame {frame}: vertex {vertex} is not finite; leave this frame out")]
    NotFinite {
        /// Name of the mesh.
        mesh: String,
        /// Number of the frame.
        frame: usize,
        /// Number of the vertex.
        vertex: usize,
    },
    /// The clip would be larger than [`BYTES_MAX`].
    #[error("the clip would take {bytes} bytes, of at most {BYTES_MAX}; write fewer frames")]
    Size {
        /// Bytes needed.
        bytes: usize,
    },
}

/// The clip as a `.glb` file.
///
/// Cost: 12 bytes per vertex and frame (24 with normals), plus 4 per frame squared.
///
/// # Errors
/// [`GlbError`] when the clip is empty, uneven, not finite or too large.
pub fn glb(clip: &Clip<'_>) -> Result<Vec<u8>, GlbError> {
    check(clip)?;
    let frames = clip.meshes[0].frames.len();
    let mut buffer = Buffer::default();
    let mut meshes = Vec::new();
    for mesh in clip.meshes {
        meshes.push(write_mesh(mesh, clip.normals, &mut buffer));
    }
    let numbers = 0..clip.meshes.len();
    let node = |index: usize| json!({ "name": clip.meshes[index].name, "mesh": index });
    let mut root = json!({
        "asset": { "version": "2.0", "generator": "toile" },
        "scene": 0,
        "scenes": [{ "nodes": numbers.clone().collect::<Vec<_>>() }],
        "nodes": numbers.map(node).collect::<Vec<_>>(),
        "meshes": meshes,
        "materials": clip.meshes.iter().map(material).collect::<Vec<_>>(),
    });
    // One frame is a still: it has no targets to animate.
    if frames > 1 {
        root["animations"] = json!([animation(clip, frames, &mut buffer)]);
    }
    Ok(buffer.into_glb(root))
}

fn check(clip: &Clip<'_>) -> Result<(), GlbError> {
    if !(clip.rate.is_finite() && clip.rate > 0.0) {
        return Err(GlbError::Rate(clip.rate));
    }
    let first = clip.meshes.first().ok_or(GlbError::Empty)?;
    let mut bytes = 4 * first.frames.len() * first.frames.len().min(FRAMES_MAX);
    for mesh in clip.meshes {
        check_mesh(mesh, first.frames.len())?;
        let vectors = mesh.frames.len() * mesh.frames[0].len() * if clip.normals { 2 } else { 1 };
        bytes += 12 * (vectors + mesh.triangles.len());
    }
    if bytes > BYTES_MAX {
        return Err(GlbError::Size { bytes });
    }
    Ok(())
}

fn check_mesh(mesh: &ClipMesh<'_>, frame_count: usize) -> Result<(), GlbError> {
    let name = || mesh.name.to_owned();
    let (triangles, frames) = (mesh.triangles.len(), mesh.frames.len());
    if triangles == 0 || frames == 0 || frames > FRAMES_MAX {
        return Err(GlbError::Extent { mesh: name(), triangles, frames });
    }
    let uneven = |frame: usize, what: &'static str, found: usize, expected: usize| {
        if found == expected {
            return Ok(());
        }
        Err(GlbError::Uneven { mesh: name(), frame, what, found, expected })
    };
    uneven(frames - 1, "frames", frames, frame_count)?;
    let count = mesh.frames[0].len();
    for (frame, positions) in mesh.frames.iter().enumerate() {
        uneven(frame, "vertices", positions.len(), count)?;
        if let Some(vertex) = positions.iter().position(|position| !position.is_finite()) {
            return Err(GlbError::NotFinite { mesh: name(), frame, vertex });
        }
    }
    let outside = |corners: &[u32; 3]| corners.iter().any(|&corner| corner as usize >= count);
    match mesh.triangles.iter().position(outside) {
        Some(triangle) => Err(GlbError::Vertex { mesh: name(), triangle }),
        None => Ok(()),
    }
}

/// A mesh with its targets; its material has the same number.
fn write_mesh(mesh: &ClipMesh<'_>, with_normals: bool, buffer: &mut Buffer) -> Value {
    let material = buffer.mesh_count;
    buffer.mesh_count += 1;
    let indices = buffer.indices(mesh.triangles);
    let normals_of = |positions: &[Vec3]| unit_normals(positions, mesh.triangles);
    let first = &mesh.frames[0];
    let first_normals = if with_normals { normals_of(first) } else { Vec::new() };

    let mut attributes = json!({ "POSITION": buffer.vectors(first) });
    if with_normals {
        attributes["NORMAL"] = buffer.vectors(&first_normals).into();
    }
    let mut targets = Vec::new();
    for positions in &mesh.frames[1..] {
        let mut target = json!({ "POSITION": buffer.vectors(&minus(positions, first)) });
        if with_normals {
            let change = minus(&normals_of(positions), &first_normals);
            target["NORMAL"] = buffer.vectors(&change).into();
        }
        targets.push(target);
    }
    let mut primitive = json!({
        "attributes": attributes, "indices": indices, "material": material, "mode": 4
    });
    let mut value = json!({ "name": mesh.name });
    if !targets.is_empty() {
        value["weights"] = vec![0.0_f32; targets.len()].into();
        primitive["targets"] = targets.into();
    }
    value["primitives"] = json!([primitive]);
    value
}

/// One key a frame, at which that frame's target alone is on; all meshes share it.
fn animation(clip: &Clip<'_>, frames: usize, buffer: &mut Buffer) -> Value {
    // In f64, so that a late key is not off by a sum of roundings.
    let time = |frame: usize| (frame as f64 / f64::from(clip.rate)) as f32;
    let times: Vec<f32> = (0..frames).map(time).collect();
    let mut weights = vec![0.0_f32; frames * (frames - 1)];
    for frame in 1..frames {
        weights[frame * (frames - 1) + frame - 1] = 1.0;
    }
    let (input, output) = (buffer.scalars(&times), buffer.scalars(&weights));
    let channel =
        |node: usize| json!({ "sampler": 0, "target": { "node": node, "path": "weights" } });
    json!({
        "name": "clip",
        "samplers": [{ "input": input, "output": output, "interpolation": "LINEAR" }],
        "channels": (0..clip.meshes.len()).map(channel).collect::<Vec<_>>(),
    })
}

fn material(mesh: &ClipMesh<'_>) -> Value {
    let linear = mesh.colour.map(|value| match f32::from(value) / 255.0 {
        dark @ 0.0..=0.04045 => dark / 12.92,
        light => ((light + 0.055) / 1.055).powf(2.4),
    });
    json!({
        "name": mesh.name,
        "doubleSided": mesh.two_sided,
        "pbrMetallicRoughness": {
            "baseColorFactor": [linear[0], linear[1], linear[2], 1.0],
            "metallicFactor": 0.0,
            "roughnessFactor": 0.8,
        },
    })
}

/// Normals as glTF wants them: always of unit length.
fn unit_normals(positions: &[Vec3], triangles: &[[u32; 3]]) -> Vec<Vec3> {
    let normals = crate::raster::normals(positions, triangles);
    normals.into_iter().map(|normal| normal.try_normalize().unwrap_or(Vec3::Y)).collect()
}

fn minus(left: &[Vec3], right: &[Vec3]) -> Vec<Vec3> {
    left.iter().zip(right).map(|(left, right)| *left - *right).collect()
}

#[cfg(test)]
mod tests;

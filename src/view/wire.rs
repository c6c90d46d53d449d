//! Bytes for the page: meshes once, then a frame per request. Little-endian, every part a multiple of
//! four bytes long, so that the page reads them in place.

use client_lib::{Rigid, Scene};
use glam::Vec3;

/// First number of a message: meshes,
const MESHES: u32 = 1;
/// or a frame.
const FRAME: u32 = 2;
/// Of a character: the body's joints follow,
const HAS_BODY: u32 = 1;
/// a distance per vertex follows.
const HAS_DISTANCES: u32 = 2;

/// The garment's and the body's topology, and the body's binding.
pub fn meshes(scene: &Scene, cloth_vertices: u32, cloth: &[[u32; 3]]) -> Vec<u8> {
    let body = scene.body();
    let count = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
    let joints = count(scene.skeleton().joint_count());
    let (vertices, triangles) =
        body.map_or((0, 0), |b| (count(b.rest_positions.len()), count(b.triangles.len())));
    let mut out = Vec::new();
    for word in [MESHES, cloth_vertices, count(cloth.len()), vertices, triangles, joints] {
        out.extend(word.to_le_bytes());
    }
    out.extend(cloth.as_flattened().iter().flat_map(|i| i.to_le_bytes()));
    if let Some(body) = body {
        let positions = body.rest_positions.iter().flat_map(|p| p.to_array());
        out.extend(positions.flat_map(f32::to_le_bytes));
        out.extend(body.weights.as_flattened().iter().flat_map(|w| w.to_le_bytes()));
        out.extend(body.joints.as_flattened().iter().flat_map(|j| j.to_le_bytes()));
        out.extend(body.triangles.as_flattened().iter().flat_map(|i| i.to_le_bytes()));
    }
    out
}

/// One character of a frame.
#[derive(Debug)]
pub struct Figure<'a> {
    /// The pane it is drawn in, from 0.
    pub pane: u32,
    /// Moves the cloth from the state frame into the world.
    pub placement: Rigid,
    /// The cloth in the state frame (m): x, y, z per vertex.
    pub positions: &'a [f32],
    /// Triangles of the cloth, for its normals.
    pub triangles: &'a [[u32; 3]],
    /// World transforms of the body's joints, each after the inverse of its rest transform.
    pub joints: &'a [Rigid],
    /// Share of the colour scale per vertex, 0..=1; empty: cloth has its own colour.
    pub distances: &'a [f32],
}

/// Writes frames; keeps its memory.
#[derive(Debug, Default)]
pub struct FrameWriter {
    out: Vec<u8>,
    figures: u32,
    normals: Vec<Vec3>,
}

impl FrameWriter {
    /// Begins a frame.
    pub fn begin(&mut self) {
        self.out.clear();
        self.figures = 0;
        self.words(&[FRAME, 0]);
    }

    /// Adds a character.
    pub fn add(&mut self, figure: &Figure<'_>) {
        self.figures += 1;
        let vertices = figure.positions.len() / 3;
        let mut flags = 0;
        flags |= if figure.joints.is_empty() { 0 } else { HAS_BODY };
        flags |= if figure.distances.len() == vertices { HAS_DISTANCES } else { 0 };
        self.words(&[figure.pane, u32::try_from(vertices).unwrap_or(0), flags]);
        let furthest = figure.positions.iter().fold(1e-6f32, |most, x| most.max(x.abs()));
        self.numbers(&[furthest]);
        self.numbers(&figure.placement.rotation.to_array());
        self.numbers(&figure.placement.translation.to_array());
        for joint in figure.joints {
            let turn = glam::Mat3::from_quat(joint.rotation);
            for row in 0..3 {
                let [x, y, z] = turn.row(row).to_array();
                self.numbers(&[x, y, z, joint.translation[row]]);
            }
        }
        self.cloth(figure, f32::from(i16::MAX) / furthest);
        if flags & HAS_DISTANCES != 0 {
            let shares = figure.distances.iter().map(|d| (d.clamp(0.0, 1.0) * 255.0) as u8);
            self.out.extend(shares);
            self.out.resize(self.out.len().next_multiple_of(4), 0);
        }
    }

    /// The bytes of the frame.
    pub fn end(&mut self) -> Vec<u8> {
        self.out[4..8].copy_from_slice(&self.figures.to_le_bytes());
        self.out.clone()
    }

    /// Eight bytes a vertex: x, y, z as shares of the furthest coordinate, and the normal.
    fn cloth(&mut self, figure: &Figure<'_>, per_metre: f32) {
        let mut normals = std::mem::take(&mut self.normals);
        smooth_normals(figure.positions, figure.triangles, &mut normals);
        let (vertices, _) = figure.positions.as_chunks::<3>();
        self.out.reserve(8 * vertices.len());
        for (p, n) in vertices.iter().zip(&normals) {
            let mut vertex = [0u8; 8];
            for (bytes, x) in vertex.chunks_exact_mut(2).zip(p) {
                // A cast saturates, and takes what is no number to 0.
                bytes.copy_from_slice(&((x * per_metre).round() as i16).to_le_bytes());
            }
            let [u, v] = octahedral(*n);
            vertex[6] = u as u8;
            vertex[7] = v as u8;
            self.out.extend(vertex);
        }
        self.normals = normals;
    }

    fn words(&mut self, words: &[u32]) {
        self.out.extend(words.iter().flat_map(|w| w.to_le_bytes()));
    }

    fn numbers(&mut self, numbers: &[f32]) {
        self.out.extend(numbers.iter().flat_map(|x| x.to_le_bytes()));
    }
}

/// Normals of unit length (zero where there is no triangle), weighted by the area around.
fn smooth_normals(positions: &[f32], triangles: &[[u32; 3]], normals: &mut Vec<Vec3>) {
    let (vertices, _) = positions.as_chunks::<3>();
    normals.clear();
    normals.resize(vertices.len(), Vec3::ZERO);
    for triangle in triangles {
        let [a, b, c] = triangle.map(|v| Vec3::from_array(vertices[v as usize]));
        let normal = (b - a).cross(c - a);
        for v in triangle {
            normals[*v as usize] += normal;
        }
    }
    for normal in normals {
        *normal = normal.normalize_or_zero();
    }
}

/// A direction on the octahedron, unfolded into a square of -127..=127.
fn octahedral(n: Vec3) -> [i8; 2] {
    let n = n / (n.x.abs() + n.y.abs() + n.z.abs()).max(1e-9);
    let sign = |x: f32| if x < 0.0 { -1.0 } else { 1.0 };
    let [u, v] = if n.z >= 0.0 {
        [n.x, n.y]
    } else {
        [(1.0 - n.y.abs()) * sign(n.x), (1.0 - n.x.abs()) * sign(n.y)]
    };
    [u, v].map(|x| (x * 127.0).round() as i8)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn unfolded([u, v]: [i8; 2]) -> Vec3 {
        let (x, y) = (f32::from(u) / 127.0, f32::from(v) / 127.0);
        let z = 1.0 - x.abs() - y.abs();
        let t = (-z).max(0.0);
        Vec3::new(x - t * x.signum(), y - t * y.signum(), z).normalize()
    }

    #[test]
    fn directions_survive_their_two_bytes() {
        for i in 0..2000u16 {
            let angle = f32::from(i) * 0.731;
            let z = f32::from(i) / 1000.0 - 1.0;
            let n = Vec3::new(angle.cos(), angle.sin(), 0.0) * (1.0 - z * z).max(0.0).sqrt();
            let n = Vec3::new(n.x, n.y, z).normalize();
            assert!(unfolded(octahedral(n)).angle_between(n) < 0.02, "{n}");
        }
        assert_eq!(octahedral(Vec3::ZERO), [0, 0]);
    }

    #[test]
    fn a_frame_holds_what_was_put_in() {
        let positions = [0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, -1.0, 0.25];
        let placement = Rigid::from_yaw(0.0, Vec3::new(7.0, 8.0, 9.0));
        let mut writer = FrameWriter::default();
        for round in 0..2 {
            writer.begin();
            writer.add(&Figure {
                pane: 3,
                placement,
                positions: &positions,
                triangles: &[[0, 1, 2]],
                joints: &[Rigid::IDENTITY; 2],
                distances: &[0.0, 1.0, 7.0],
            });
            let bytes = writer.end();
            let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
            assert_eq!([0, 4, 8, 12, 16].map(word), [FRAME, 1, 3, 3, 3], "round {round}");
            let expected = [1.0f32, 7.0, 8.0, 9.0].map(f32::to_bits);
            assert_eq!([20, 40, 44, 48].map(word), expected);
            let cloth = 52 + 2 * 48;
            let short = |at: usize| i16::from_le_bytes([bytes[at], bytes[at + 1]]);
            assert_eq!([short(cloth + 8), short(cloth + 18)], [16384, -32767]);
            assert_eq!(bytes[cloth + 24..], [0, 255, 255, 0]);
        }
    }

    #[test]
    fn what_is_no_number_does_no_harm() {
        let mut writer = FrameWriter::default();
        writer.begin();
        let figure = Figure {
            pane: 0,
            placement: Rigid::IDENTITY,
            positions: &[f32::NAN, f32::INFINITY, 1.0],
            triangles: &[],
            joints: &[],
            distances: &[],
        };
        writer.add(&figure);
        assert_eq!(writer.end().len(), 8 + 12 + 4 + 28 + 8);
    }
}

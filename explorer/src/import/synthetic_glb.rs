//! A tiny glTF file made by hand, for tests: a box of a body on three joints, with one clip.

use serde_json::{Value, json};

/// What the file shall be like; tests change one thing at a time.
pub(super) struct Glb {
    /// Height of the box (m).
    pub(super) height_m: f32,
    /// Joint that every vertex is bound to (a place in the skin's list).
    pub(super) bound_to: u8,
    /// Where the root goes, one per frame.
    pub(super) path: Vec<[f32; 3]>,
    /// `LINEAR`, `STEP` or `CUBICSPLINE` (tangents zero).
    pub(super) interpolation: &'static str,
    /// Seconds between keys.
    pub(super) key_s: f32,
    /// Translation of the node above the root joint.
    pub(super) above: [f32; 3],
    /// Its scale.
    pub(super) above_scale: f32,
    /// Node that the animation moves: 1 is the root joint, 0 stands above it.
    pub(super) animated: usize,
}

impl Default for Glb {
    fn default() -> Self {
        Self {
            height_m: 1.7,
            bound_to: 1,
            path: (0..60).map(|f| [0.0, 1.0, f as f32 * 0.03]).collect(),
            interpolation: "LINEAR",
            key_s: 1.0 / 30.0,
            above: [0.0; 3],
            above_scale: 1.0,
            animated: 1,
        }
    }
}

/// The buffer and the JSON that describes it, growing together.
#[derive(Default)]
struct Parts {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Parts {
    fn add(&mut self, bytes: &[u8], count: usize, component: u32, shape: &str) -> usize {
        let offset = self.bytes.len();
        self.bytes.extend_from_slice(bytes);
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        self.views.push(json!({"buffer": 0, "byteOffset": offset, "byteLength": bytes.len()}));
        self.accessors.push(json!({
            "bufferView": self.views.len() - 1, "componentType": component, "count": count,
            "type": shape, "min": [0, 0, 0], "max": [1, 1, 1],
        }));
        self.accessors.len() - 1
    }

    fn add_floats(&mut self, values: &[f32], width: usize, shape: &str) -> usize {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.add(&bytes, values.len() / width, 5126, shape)
    }
}

/// Corners of a box around the y axis, from the ground up.
pub(super) fn box_corners(half_m: f32, low_m: f32, high_m: f32) -> Vec<[f32; 3]> {
    let around = [[-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [1.0, -1.0]];
    let ring = |y: f32| around.map(|[x, z]| [x * half_m, y, z * half_m]);
    [ring(low_m), ring(high_m)].concat()
}

/// The four walls of [`box_corners`], seen from outside.
pub(super) const WALLS: [[u8; 3]; 8] =
    [[0, 1, 5], [0, 5, 4], [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]];
const FLOOR_AND_LID: [[u8; 3]; 4] = [[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7]];

impl Glb {
    /// The bytes of the file.
    pub(super) fn bytes(&self) -> Vec<u8> {
        let mut parts = Parts::default();
        let corners = box_corners(0.15 * self.height_m, 0.0, self.height_m);
        let positions = parts.add_floats(corners.as_flattened(), 3, "VEC3");
        let joints = [self.bound_to, 0, 0, 0].repeat(8);
        let joints = parts.add(&joints, 8, 5121, "VEC4");
        let weights = parts.add_floats(&[0.5, 0.0, 0.0, 0.0].repeat(8), 4, "VEC4");
        let triangles = [&WALLS[..], &FLOOR_AND_LID[..]].concat();
        let indices = parts.add(triangles.as_flattened(), 36, 5121, "SCALAR");
        // The skin names the head first, so that joints must be sorted; binds are translations.
        let bind = |y: f32| {
            let mut m = [0.0f32; 16];
            for i in [0, 5, 10, 15] {
                m[i] = 1.0;
            }
            m[13] = -y;
            m
        };
        let binds = [bind(1.5), bind(1.0), bind(1.2)].concat();
        let binds = parts.add_floats(&binds, 16, "MAT4");
        let times: Vec<f32> = (0..self.path.len()).map(|k| k as f32 * self.key_s).collect();
        let times = parts.add_floats(&times, 1, "SCALAR");
        let keys: Vec<[f32; 3]> = match self.interpolation {
            "CUBICSPLINE" => self.path.iter().flat_map(|p| [[0.0; 3], *p, [0.0; 3]]).collect(),
            _ => self.path.clone(),
        };
        let keys = parts.add_floats(keys.as_flattened(), 3, "VEC3");
        let scale = [self.above_scale; 3];
        let json = json!({
            "asset": {"version": "2.0"},
            "buffers": [{"byteLength": parts.bytes.len()}],
            "bufferViews": parts.views,
            "accessors": parts.accessors,
            "nodes": [
                {"name": "Armature", "children": [1], "translation": self.above, "scale": scale},
                {"name": "Hips", "children": [2], "translation": [0, 1, 0]},
                {"name": "Spine", "children": [3], "translation": [0, 0.2, 0]},
                {"name": "Head", "translation": [0, 0.3, 0]},
                {"name": "Body", "mesh": 0, "skin": 0},
            ],
            "skins": [{"joints": [3, 1, 2], "inverseBindMatrices": binds}],
            "meshes": [{"name": "Box", "primitives": [{
                "attributes": {"POSITION": positions, "JOINTS_0": joints, "WEIGHTS_0": weights},
                "indices": indices,
            }]}],
            "animations": [{
                "name": "go",
                "samplers": [{"input": times, "output": keys, "interpolation": self.interpolation}],
                "channels": [
                    {"sampler": 0, "target": {"node": self.animated, "path": "translation"}},
                ],
            }],
        });
        container(json.to_string().into_bytes(), parts.bytes)
    }
}

fn container(mut json: Vec<u8>, mut binary: Vec<u8>) -> Vec<u8> {
    json.resize(json.len().next_multiple_of(4), b' ');
    binary.resize(binary.len().next_multiple_of(4), 0);
    let length = 12 + 8 + json.len() + 8 + binary.len();
    let mut out = b"glTF".to_vec();
    out.extend(2u32.to_le_bytes());
    out.extend((length as u32).to_le_bytes());
    for (kind, chunk) in [(b"JSON", json), (b"BIN\0", binary)] {
        out.extend((chunk.len() as u32).to_le_bytes());
        out.extend(kind);
        out.extend(chunk);
    }
    out
}

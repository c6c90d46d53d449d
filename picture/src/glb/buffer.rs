//! The binary half of a `.glb`, and the accessors that describe it.

use glam::Vec3;
use serde_json::{Value, json};

const FLOAT: u32 = 5126;
const UNSIGNED_INT: u32 = 5125;
const VERTICES: u32 = 34962;
const INDICES: u32 = 34963;
/// "glTF", "JSON" and "BIN\0", little-endian.
const MAGIC: u32 = 0x4654_6c67;
const JSON: u32 = 0x4e4f_534a;
const BINARY: u32 = 0x004e_4942;

/// Everything written is four-byte numbers, so that every view is aligned.
#[derive(Default)]
pub(super) struct Buffer {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
    pub(super) mesh_count: usize,
}

impl Buffer {
    /// Adds vectors; returns the number of their accessor.
    pub(super) fn vectors(&mut self, vectors: &[Vec3]) -> usize {
        let low = vectors.iter().fold(Vec3::INFINITY, |low, &vector| low.min(vector));
        let high = vectors.iter().fold(Vec3::NEG_INFINITY, |high, &vector| high.max(vector));
        let numbers = vectors.iter().flat_map(|vector| vector.to_array());
        let view = self.view(numbers.map(f32::to_le_bytes), Some(VERTICES));
        self.accessor(json!({
            "bufferView": view, "componentType": FLOAT, "count": vectors.len(), "type": "VEC3",
            "min": low.to_array(), "max": high.to_array(),
        }))
    }

    /// Adds numbers; returns the number of their accessor.
    pub(super) fn scalars(&mut self, numbers: &[f32]) -> usize {
        let low = numbers.iter().copied().fold(f32::INFINITY, f32::min);
        let high = numbers.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let view = self.view(numbers.iter().map(|number| number.to_le_bytes()), None);
        self.accessor(json!({
            "bufferView": view, "componentType": FLOAT, "count": numbers.len(), "type": "SCALAR",
            "min": [low], "max": [high],
        }))
    }

    /// Adds triangles; returns the number of their accessor.
    pub(super) fn indices(&mut self, triangles: &[[u32; 3]]) -> usize {
        let numbers = triangles.iter().flatten().map(|number| number.to_le_bytes());
        let view = self.view(numbers, Some(INDICES));
        self.accessor(json!({
            "bufferView": view, "componentType": UNSIGNED_INT, "count": 3 * triangles.len(),
            "type": "SCALAR",
        }))
    }

    /// The file: header, JSON, binary.
    pub(super) fn into_glb(self, mut root: Value) -> Vec<u8> {
        root["accessors"] = self.accessors.into();
        root["bufferViews"] = self.views.into();
        root["buffers"] = json!([{ "byteLength": self.bytes.len() }]);
        let mut text = root.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let length = 12 + 8 + text.len() + 8 + self.bytes.len();
        let mut file = Vec::with_capacity(length);
        let word = |value: usize| u32::try_from(value).expect("checked against BYTES_MAX");
        for value in [MAGIC, 2, word(length), word(text.len()), JSON] {
            file.extend(value.to_le_bytes());
        }
        file.extend(text);
        for value in [word(self.bytes.len()), BINARY] {
            file.extend(value.to_le_bytes());
        }
        file.extend(self.bytes);
        file
    }

    fn view(&mut self, words: impl Iterator<Item = [u8; 4]>, target: Option<u32>) -> usize {
        let start = self.bytes.len();
        self.bytes.extend(words.flatten());
        let length = self.bytes.len() - start;
        let mut view = json!({ "buffer": 0, "byteOffset": start, "byteLength": length });
        if let Some(target) = target {
            view["target"] = target.into();
        }
        self.views.push(view);
        self.views.len() - 1
    }

    fn accessor(&mut self, accessor: Value) -> usize {
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }
}

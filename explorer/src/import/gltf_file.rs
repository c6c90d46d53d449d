//! A glTF 2.0 document with its buffers, read with every index and length checked.
//!
//! Only what a character or a garment needs; images are never opened. Garbage and truncated
//! files give an error, never a panic.

use std::path::Path;

use gltf::json;
use gltf::json::accessor::{ComponentType, Type};
use gltf::json::validation::Checked;
use protocol::limits::TRIANGLES_MAX;

/// Largest glTF file or buffer, in bytes.
pub const FILE_BYTES_MAX: usize = 1 << 30;
/// Most elements of one accessor (indices are the longest).
const ELEMENTS_MAX: usize = 3 * TRIANGLES_MAX;

/// What is wrong with a glTF document.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum GltfError {
    /// The container or its JSON.
    #[error("not a readable glTF 2.0 file ({0}); export it again, best as one .glb file")]
    Unreadable(String),
    /// A buffer cannot be had.
    #[error("buffer {buffer}: {problem}; export as one .glb file")]
    Buffer {
        /// Index of the buffer.
        buffer: usize,
        /// What is wrong.
        problem: String,
    },
    /// An accessor's layout or range.
    #[error("{what}: accessor {accessor} {problem}; export the file again")]
    Accessor {
        /// What was being read.
        what: String,
        /// Index of the accessor.
        accessor: usize,
        /// What is wrong.
        problem: String,
    },
}

/// The JSON and the bytes that it speaks of.
#[derive(Debug)]
pub(super) struct Document {
    pub(super) root: json::Root,
    buffers: Vec<Vec<u8>>,
}

impl Document {
    /// Reads a `.glb`, or a `.gltf` whose buffers are files in `folder`.
    pub(super) fn read(bytes: &[u8], folder: Option<&Path>) -> Result<Self, GltfError> {
        if bytes.len() > FILE_BYTES_MAX {
            return Err(GltfError::Unreadable(format!("over {FILE_BYTES_MAX} bytes")));
        }
        check_container(bytes)?;
        // Its validation panics on primitives that name no accessor; everything that is read here
        // is checked where it is read.
        let file = gltf::Gltf::from_slice_without_validation(bytes)
            .map_err(|e| GltfError::Unreadable(e.to_string().replace('\n', " ")))?;
        let root = file.document.into_json();
        check_version(&root)?;
        let mut blob = file.blob;
        let mut buffers = Vec::new();
        for (index, buffer) in root.buffers.iter().enumerate() {
            let problem = |problem: String| GltfError::Buffer { buffer: index, problem };
            let data = match &buffer.uri {
                None if index == 0 => blob.take().ok_or("has no bytes in this file".to_owned()),
                None => Err("names no file".to_owned()),
                Some(uri) => read_uri(uri, folder),
            }
            .map_err(problem)?;
            if (data.len() as u64) < buffer.byte_length.0 {
                let text = format!("{} bytes of {} are there", data.len(), buffer.byte_length.0);
                return Err(problem(text));
            }
            buffers.push(data);
        }
        Ok(Self { root, buffers })
    }

    /// An accessor's numbers as f32, `components` per element; normalised integers are mapped to
    /// -1..1 or 0..1, others are taken as they are.
    pub(super) fn numbers(
        &self,
        accessor: json::Index<json::Accessor>,
        components: usize,
        what: &str,
    ) -> Result<Vec<f32>, GltfError> {
        let layout = self.layout(accessor.value(), components, what)?;
        let mut out = Vec::with_capacity(layout.count * components);
        for element in 0..layout.count {
            for component in 0..components {
                out.push(layout.number(element, component));
            }
        }
        Ok(out)
    }

    /// An accessor's unsigned integers, `components` per element.
    pub(super) fn integers(
        &self,
        accessor: json::Index<json::Accessor>,
        components: usize,
        what: &str,
    ) -> Result<Vec<u32>, GltfError> {
        let layout = self.layout(accessor.value(), components, what)?;
        if !matches!(layout.kind, ComponentType::U8 | ComponentType::U16 | ComponentType::U32) {
            return Err(bad(what, accessor.value(), "does not hold unsigned integers"));
        }
        let mut out = Vec::with_capacity(layout.count * components);
        for element in 0..layout.count {
            for component in 0..components {
                out.push(layout.integer(element, component));
            }
        }
        Ok(out)
    }

    fn layout(&self, index: usize, components: usize, what: &str) -> Result<Layout<'_>, GltfError> {
        let bad = |problem: &str| bad(what, index, problem);
        let accessor = self.root.accessors.get(index).ok_or_else(|| bad("does not exist"))?;
        let Checked::Valid(kind) = accessor.component_type else {
            return Err(bad("has an unknown component type"));
        };
        let Checked::Valid(shape) = accessor.type_ else {
            return Err(bad("has an unknown type"));
        };
        if multiplicity(shape) != components {
            return Err(bad(&format!("is {shape:?}, expected {components} numbers an element")));
        }
        if accessor.sparse.is_some() {
            return Err(bad("is sparse, which is not supported"));
        }
        let count = accessor.count.0 as usize;
        if count > ELEMENTS_MAX {
            return Err(bad(&format!("has {count} elements, at most {ELEMENTS_MAX} are allowed")));
        }
        let view = accessor.buffer_view.ok_or_else(|| bad("has no buffer view"))?;
        let view = self.root.buffer_views.get(view.value());
        let view = view.ok_or_else(|| bad("names a buffer view that does not exist"))?;
        let bytes = self.buffers.get(view.buffer.value());
        let bytes = bytes.ok_or_else(|| bad("names a buffer that does not exist"))?;
        let start = view.byte_offset.map_or(0, |o| o.0) as usize;
        let end = start.checked_add(view.byte_length.0 as usize);
        let bytes = end.and_then(|end| bytes.get(start..end));
        let bytes = bytes.ok_or_else(|| bad("lies outside its buffer"))?;
        let element = components * kind.0.size();
        let stride = view.byte_stride.map_or(element, |s| s.0);
        let offset = accessor.byte_offset.map_or(0, |o| o.0) as usize;
        if stride < element || stride > 252.max(element) {
            return Err(bad("has a byte stride out of range"));
        }
        let needed = if count == 0 { 0 } else { (count - 1) * stride + element };
        let bytes = bytes.get(offset..).filter(|b| b.len() >= needed);
        let bytes = bytes.ok_or_else(|| bad("reaches beyond its buffer view"))?;
        let normalized = accessor.normalized;
        Ok(Layout { bytes, kind: kind.0, count, stride, normalized })
    }
}

/// Where an accessor's elements lie; every element is inside `bytes`.
struct Layout<'a> {
    bytes: &'a [u8],
    kind: ComponentType,
    count: usize,
    stride: usize,
    normalized: bool,
}

impl Layout<'_> {
    fn raw(&self, element: usize, component: usize) -> [u8; 4] {
        let size = self.kind.size();
        let at = element * self.stride + component * size;
        let mut raw = [0; 4];
        raw[..size].copy_from_slice(&self.bytes[at..at + size]);
        raw
    }

    fn integer(&self, element: usize, component: usize) -> u32 {
        u32::from_le_bytes(self.raw(element, component))
    }

    fn number(&self, element: usize, component: usize) -> f32 {
        let raw = self.raw(element, component);
        let (value, scale) = match self.kind {
            ComponentType::F32 => return f32::from_le_bytes(raw),
            ComponentType::U32 => return u32::from_le_bytes(raw) as f32,
            ComponentType::U8 => (f32::from(raw[0]), 255.0),
            ComponentType::I8 => (f32::from(raw[0] as i8), 127.0),
            ComponentType::U16 => (f32::from(u16::from_le_bytes([raw[0], raw[1]])), 65_535.0),
            ComponentType::I16 => (f32::from(i16::from_le_bytes([raw[0], raw[1]])), 32_767.0),
        };
        if self.normalized { (value / scale).max(-1.0) } else { value }
    }
}

fn multiplicity(shape: Type) -> usize {
    match shape {
        Type::Scalar => 1,
        Type::Vec2 => 2,
        Type::Vec3 => 3,
        Type::Vec4 | Type::Mat2 => 4,
        Type::Mat3 => 9,
        Type::Mat4 => 16,
    }
}

fn bad(what: &str, accessor: usize, problem: &str) -> GltfError {
    GltfError::Accessor { what: what.to_owned(), accessor, problem: problem.to_owned() }
}

/// The length in the header must not be shorter than the header itself.
fn check_container(bytes: &[u8]) -> Result<(), GltfError> {
    if !bytes.starts_with(b"glTF") {
        return Ok(());
    }
    let length = bytes.get(8..12).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize);
    match length {
        Some(length) if length >= 12 && length <= bytes.len() => Ok(()),
        Some(length) => Err(GltfError::Unreadable(format!(
            "its header says {length} bytes, the file has {}",
            bytes.len()
        ))),
        None => Err(GltfError::Unreadable("it ends within its header".to_owned())),
    }
}

/// Extensions that a file may require: they do not change where anything is.
const HARMLESS: [&str; 4] =
    ["KHR_materials_", "KHR_texture_", "KHR_lights_", "KHR_mesh_quantization"];

fn check_version(root: &json::Root) -> Result<(), GltfError> {
    if !root.asset.version.starts_with("2.") {
        let text = format!("its version is {:?}", root.asset.version);
        return Err(GltfError::Unreadable(text));
    }
    let harmless = |name: &String| HARMLESS.iter().any(|known| name.starts_with(known));
    match root.extensions_required.iter().find(|name| !harmless(name)) {
        None => Ok(()),
        Some(name) => Err(GltfError::Unreadable(format!(
            "it requires the extension {name}, which is not supported; export without compression"
        ))),
    }
}

fn read_uri(uri: &str, folder: Option<&Path>) -> Result<Vec<u8>, String> {
    if uri.starts_with("data:") {
        return Err("is embedded as a data URI, which is not supported".to_owned());
    }
    let inside = |c| matches!(c, std::path::Component::Normal(_) | std::path::Component::CurDir);
    if !Path::new(uri).components().all(inside) {
        return Err(format!("names {uri:?}, which is not beside the glTF file"));
    }
    let folder = folder.ok_or_else(|| format!("is the file {uri:?}, and no folder is known"))?;
    let path = folder.join(uri);
    let length = std::fs::metadata(&path).map_err(|e| format!("{}: {e}", path.display()))?.len();
    if length > FILE_BYTES_MAX as u64 {
        return Err(format!("{} is over {FILE_BYTES_MAX} bytes", path.display()));
    }
    std::fs::read(&path).map_err(|e| format!("{}: {e}", path.display()))
}

//! Every limit on what comes from outside, in one place.

/// Largest chunk, in bytes.
pub const CHUNK_BYTES_MAX: usize = 64 << 20;
/// Largest manifest, in bytes.
pub const MANIFEST_BYTES_MAX: usize = 32 << 20;
/// Largest control message, in bytes, manifests apart.
pub const MESSAGE_BYTES_MAX: usize = 64 << 10;
/// Garments in a world.
pub const GARMENTS_MAX: usize = 1024;
/// Poses of a primary graph.
pub const POSES_MAX: usize = 1 << 20;
/// Edges of a primary graph.
pub const EDGES_MAX: usize = 1 << 21;
/// Joints of a skeleton.
pub const JOINTS_MAX: usize = 1024;
/// Capsules that stand for a body.
pub const COLLIDERS_MAX: usize = 4096;
/// Vertices of a garment or a body.
pub const VERTICES_MAX: usize = 1 << 20;
/// Triangles of a garment or a body.
pub const TRIANGLES_MAX: usize = 1 << 21;
/// States of a garment.
pub const STATES_MAX: u64 = 1 << 32;
/// States in one region.
pub const REGION_STATES_MAX: usize = 32;
/// Columns of a basis, all generations together.
pub const COLUMNS_MAX: usize = 2048;
/// Bytes of any name (clip, joint, garment).
pub const NAME_BYTES_MAX: usize = 256;
/// States in one link page.
pub const LINK_PAGE_STATES: usize = 256;
/// Region chunks and link pages of a manifest, all garments together: at up to 48 bytes each they
/// fit into `MANIFEST_BYTES_MAX`, with `GARMENTS_MAX` garments of `GENERATIONS_MAX` generations.
pub const MANIFEST_ENTRIES_MAX: usize = 1 << 19;
/// Basis generations of a garment.
pub const GENERATIONS_MAX: usize = 64;

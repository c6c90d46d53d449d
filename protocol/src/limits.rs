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
/// Points of an upsampler's coarse cloth; fine vertices are a garment's (`VERTICES_MAX`).
pub const COARSE_POINTS_MAX: usize = 1024;
/// Weights of an upsampler, all rows together.
pub const UPSAMPLER_WEIGHTS_MAX: usize = 1 << 24;
/// Capsules, oscillatory modes and class rules of an upsampler.
pub const UPSAMPLER_PARTS_MAX: [usize; 3] = [64, 16, 7];
/// Bytes of a token.
pub const TOKEN_BYTES_MAX: usize = 1024;
/// Bytes of the sentence in a close message.
pub const REASON_BYTES_MAX: usize = 1024;
/// Edges in one telemetry message; a client splits what is longer.
pub const TELEMETRY_EDGES_MAX: usize = 4096;
/// Traversals per second that one client adds to the counts, and outcomes of steps; what is above is
/// dropped, so that nobody steers the exploration alone. Eight characters at 30 frames per second.
pub const TRAVERSALS_PER_SECOND_MAX: u32 = 240;
/// Traversals that a client may save up while it is silent.
pub const TRAVERSALS_BURST_MAX: u32 = 60 * TRAVERSALS_PER_SECOND_MAX;
/// Versions per second that one client may pin, and how many it may save up: each is read from the
/// store, and sent whole.
pub const PINS_PER_SECOND_MAX: u32 = 2;
/// See [`PINS_PER_SECOND_MAX`].
pub const PINS_BURST_MAX: u32 = 16;
/// Tags per second that a server takes from one client, and how many it may save up.
pub const TAGS_PER_SECOND_MAX: u32 = 2;
/// See [`TAGS_PER_SECOND_MAX`].
pub const TAGS_BURST_MAX: u32 = 60;
/// Messages per second that a server accepts from one client; a client keeps to half of it.
pub const MESSAGES_PER_SECOND_MAX: u32 = 4000;
/// Fetches under way that a server accepts from one client.
pub const FETCHES_MAX: usize = 256;
/// Fetches under way that a client asks for: it leaves room for re-requests that cross answers.
pub const CLIENT_FETCHES_MAX: usize = 64;
/// Bytes under way at which a client asks for no more.
pub const CLIENT_FETCH_BYTES_MAX: u64 = 16 << 20;
/// Chunks that a client may want at once.
pub const WANTS_MAX: usize = 1 << 17;
/// Messages that wait for the link on either side.
pub const OUTBOX_MAX: usize = 4096;
/// Time from connecting to hello and from hello to welcome, in microseconds.
pub const HANDSHAKE_US_MAX: u64 = 10_000_000;
/// First delay before reconnecting, in microseconds; it doubles with every failure.
pub const RECONNECT_US_MIN: u64 = 100_000;
/// Longest delay before reconnecting, in microseconds.
pub const RECONNECT_US_MAX: u64 = 5_000_000;

//! A hand-made world for tests: two poses, three edges, a basis of two columns over one vertex.
//!
//! Edges: 0 -> 0 (edge 0), 0 -> 1 (edge 1), 1 -> 0 (edge 2).

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use codec::{Basis, VertexFix, kim2013};
use protocol::links::{LinkEntry, LinkPage};
use protocol::manifest::{ChunkRef, GarmentVersion, GenerationRef, RegionChunkRef, VersionStats};
use protocol::region::{RegionChunk, RegionEntry};
use protocol::scene::{Edge, GarmentChunk, Joint, Pose, SceneChunk};
use protocol::{ChunkHash, GarmentId, GenerationId, PoseId, StateId, VersionNumber};

use crate::cache::{Cache, Region};
use crate::scene::Scene;
use crate::version::{Parts, Version, View};

/// Metres from pose to pose.
pub const STRIDE_M: f32 = 0.1;
/// Metres of full scale of each column: the first along x, the second along y.
pub const SCALE_M: f32 = 3.0;

/// What the first column alone is said to cost in [`published_in_parts`] (m).
pub const LEADING_ERROR_M: f32 = 0.05;

/// Two poses of one joint, a stride along z apart; 1 -> 0 goes on straight after a turn.
pub fn scene_chunk() -> SceneChunk {
    let pose = |frame: u32| Pose {
        clip: 0,
        frame,
        transition: false,
        root: [0.0, 1.0, STRIDE_M * frame as f32],
        rotations: vec![[0, 0, 0, 32_767]],
    };
    let edge = |from, to, yaw, shift| Edge { from: PoseId(from), to: PoseId(to), yaw, shift };
    SceneChunk {
        fps: 30.0,
        joints: vec![Joint {
            name: "hips".into(),
            parent: None,
            offset: [0.0; 3],
            rest_translation: [0.0, 1.0, 0.0],
            rest_rotation: [0.0, 0.0, 0.0, 1.0],
        }],
        clips: vec!["walk".into()],
        poses: vec![pose(0), pose(1)],
        edges: vec![
            edge(0, 0, 0.0, [0.0, STRIDE_M]),
            edge(0, 1, 0.0, [0.0, 0.0]),
            edge(1, 0, 0.02, [0.0, 2.0 * STRIDE_M]),
        ],
        colliders: Vec::new(),
        body: None,
    }
}

/// One vertex; x is column 0, y is column 1.
pub fn basis() -> Basis {
    let mut basis = Basis::new();
    basis.append(&kim2013::Generation::parse(&generation()).unwrap()).unwrap();
    basis
}

/// The basis in bytes.
fn generation() -> Vec<u8> {
    let mut entries = [0i16; 6];
    let (x, y) = entries.split_at_mut(3);
    kim2013::quantise_column(&[SCALE_M, 0.0, 0.0], kim2013::STEP_M, x).unwrap();
    kim2013::quantise_column(&[0.0, SCALE_M, 0.0], kim2013::STEP_M, y).unwrap();
    let mut bytes = Vec::new();
    let maxima = [SCALE_M, SCALE_M];
    kim2013::encode_generation(3, kim2013::STEP_M, &maxima, &entries, &mut bytes).unwrap();
    bytes
}

/// An interior state.
pub fn interior(pose: u32, next: &[u64]) -> LinkEntry {
    LinkEntry::Interior { pose: PoseId(pose), next: next.iter().map(|s| StateId(*s)).collect() }
}

/// A dead end merged with an error of 10 mm.
pub fn dead_end(pose: u32, target: u64) -> LinkEntry {
    LinkEntry::DeadEnd { pose: PoseId(pose), target: StateId(target), error_m: 0.01 }
}

/// A state of another version.
pub fn retired(pose: u32, successor: u64) -> LinkEntry {
    LinkEntry::Retired { pose: PoseId(pose), successor: StateId(successor) }
}

/// The initial graph: states 0 (pose 0), 1 (pose 1); dead ends 2 (pose 0, the loop 0 -> 0) and
/// 3 (pose 0, after 1), both merged into 0.
pub fn initial_links() -> Vec<LinkEntry> {
    vec![interior(0, &[2, 1]), interior(1, &[3]), dead_end(0, 0), dead_end(0, 0)]
}

/// The same after dead end 3 was expanded: it leads to 4 (dead end of pose 0) and 5 (interior,
/// pose 1, which leads to dead end 6).
pub fn grown_links() -> Vec<LinkEntry> {
    let mut links = initial_links();
    links[3] = interior(0, &[4, 5]);
    links.extend([dead_end(0, 0), interior(1, &[6]), dead_end(0, 0)]);
    links
}

/// Name of the chunk of states 0..4 (`part` 0) or 4.. (`part` 1).
pub fn region_chunk(part: u64) -> ChunkHash {
    ChunkHash::of(&part.to_le_bytes())
}

/// Two region chunks: states 0..4, the initial graph, and the rest.
pub fn version(number: u64, links: Vec<LinkEntry>) -> Arc<Version> {
    let chunk = |hash| ChunkRef { hash, bytes: 100 };
    let state_count = links.len() as u32;
    let mut regions = vec![RegionChunkRef {
        chunk: chunk(region_chunk(0)),
        first_state: StateId(0),
        state_count: state_count.min(4),
        initial: true,
    }];
    if state_count > 4 {
        regions.push(RegionChunkRef {
            chunk: chunk(region_chunk(1)),
            first_state: StateId(4),
            state_count: state_count - 4,
            initial: false,
        });
    }
    let garment = GarmentVersion {
        id: GarmentId(0),
        name: "speck".into(),
        codec: kim2013::PROFILE.into(),
        scene: chunk(ChunkHash::of(b"scene")),
        mesh: chunk(ChunkHash::of(b"mesh")),
        generations: vec![GenerationRef { chunk: chunk(ChunkHash::of(b"basis")), columns: 2 }],
        regions,
        links: vec![chunk(ChunkHash::of(b"links"))],
        stats: VersionStats::default(),
        upsampler: None,
    };
    let parts = Parts {
        number: VersionNumber(number),
        garment,
        scene: Arc::new(Scene::new(scene_chunk()).unwrap()),
        mesh: Arc::new(GarmentChunk { name: "speck".into(), vertex_count: 1, triangles: vec![] }),
        basis: Arc::new(basis()),
        pages: vec![LinkPage { first_state: StateId(0), entries: links }],
    };
    Arc::new(Version::assemble(parts).unwrap())
}

/// Coefficients of a state, by a rule that makes every state another place.
pub fn coefficients(state: u64) -> [i16; 2] {
    [1000 * state as i16, 500 - 100 * state as i16]
}

/// The same as fractions of full scale.
pub fn fractions(state: u64) -> [f32; 2] {
    coefficients(state).map(|c| f32::from(c) / kim2013::FULL_SCALE)
}

/// A view in which the chunks named are resident.
pub fn view(version: &Arc<Version>, parts: &[u64]) -> Arc<View> {
    view_with(version, parts, &[])
}

/// The same; states of the first chunk have fixes.
pub fn view_with(version: &Arc<Version>, parts: &[u64], fixes: &[VertexFix]) -> Arc<View> {
    let mut cache = Cache::new(1 << 20);
    for part in parts {
        let (first, count) = if *part == 0 { (0, 4) } else { (4, 8) };
        let rows = (first..first + count).flat_map(coefficients).collect();
        let own = if first == 0 { fixes.to_vec() } else { Vec::new() };
        let region = Region::new(StateId(first), 2, rows).with_fixes(own);
        cache.insert(region_chunk(*part), vec![region], *part == 0, &BTreeSet::new());
    }
    let resident = Arc::new(cache.snapshot());
    Arc::new(View { version: Arc::clone(version), resident, upsampled: None, probes: None })
}

/// A version as a publisher lays it down: its garment, and its chunks by name.
pub fn published(links: Vec<LinkEntry>) -> (GarmentVersion, BTreeMap<ChunkHash, Vec<u8>>) {
    let mut chunks = BTreeMap::new();
    let mut put = |bytes: Vec<u8>| {
        let chunk = ChunkRef { hash: ChunkHash::of(&bytes), bytes: bytes.len() as u32 };
        chunks.insert(chunk.hash, bytes);
        chunk
    };
    let mut regions = Vec::new();
    for (first, end) in [(0, 4), (4, links.len() as u64)] {
        if first < end {
            let rows: Vec<i16> = (first..end).flat_map(coefficients).collect();
            let mut bytes = Vec::new();
            kim2013::encode_region(2, &rows, &mut bytes).unwrap();
            let entry = RegionEntry {
                first_state: StateId(first),
                state_count: (end - first) as u16,
                generation: GenerationId(0),
                max_error_m: 0.0,
                bytes,
            };
            regions.push(RegionChunkRef {
                chunk: put(RegionChunk { regions: vec![entry] }.encode()),
                first_state: StateId(first),
                state_count: (end - first) as u32,
                initial: first == 0,
            });
        }
    }
    let mesh = GarmentChunk { name: "speck".into(), vertex_count: 1, triangles: vec![] };
    let garment = GarmentVersion {
        id: GarmentId(0),
        name: "speck".into(),
        codec: kim2013::PROFILE.into(),
        scene: put(scene_chunk().encode()),
        mesh: put(mesh.encode()),
        generations: vec![GenerationRef { chunk: put(generation()), columns: 2 }],
        regions,
        links: vec![put(LinkPage { first_state: StateId(0), entries: links }.encode())],
        stats: VersionStats::default(),
        upsampler: None,
    };
    (garment, chunks)
}

/// As [`published`] in profile `toile`, with a generation for each of the two columns.
pub fn published_in_parts(links: Vec<LinkEntry>) -> (GarmentVersion, BTreeMap<ChunkHash, Vec<u8>>) {
    use codec::toile::{self, Column, GenerationParts, Model, RegionParts, Tree};
    let (mut garment, mut chunks) = published(links);
    let mut put = |bytes: Vec<u8>| {
        let chunk = ChunkRef { hash: ChunkHash::of(&bytes), bytes: bytes.len() as u32 };
        chunks.insert(chunk.hash, bytes);
        chunk
    };
    let column =
        Column { maximum_m: SCALE_M, multiple: 1, sizes: [60; 3], after_one: 0, after_two: [0; 2] };
    let (tree, mut model) = (Tree::sequence(1), Model::new(1));
    garment.codec = toile::PROFILE.into();
    garment.generations.clear();
    for values_m in [[SCALE_M, 0.0, 0.0], [0.0, SCALE_M, 0.0]] {
        let with_tree = garment.generations.is_empty();
        let parts = GenerationParts {
            step_m: 3e-4,
            columns: &[column],
            values_m: &values_m,
            step: 20,
            states: 4,
            rms_m: 0.001,
            tree: &tree,
            with_tree,
        };
        let mut bytes = Vec::new();
        toile::encode_generation(&parts, &mut bytes).unwrap();
        garment.generations.push(GenerationRef { chunk: put(bytes), columns: 1 });
        model.append(&[column]);
    }
    for region in &mut garment.regions {
        let states = region.first_state.0..region.first_state.0 + u64::from(region.state_count);
        let step_m = toile::step_m(20);
        let steps: Vec<i32> = states
            .flat_map(fractions)
            .map(|fraction| (fraction * SCALE_M / step_m).round() as i32)
            .collect();
        let parts = RegionParts {
            columns: 2,
            step: 20,
            coefficients: &steps,
            fix_step: 0,
            fixes: &[],
            tier_errors_m: [0.0; 4],
            leading_error_m: LEADING_ERROR_M,
        };
        let mut bytes = Vec::new();
        toile::encode_region(&model, &parts, &mut bytes).unwrap();
        let entry = RegionEntry {
            first_state: region.first_state,
            state_count: region.state_count as u16,
            generation: GenerationId(1),
            max_error_m: 0.0,
            bytes,
        };
        region.chunk = put(RegionChunk { regions: vec![entry] }.encode());
    }
    (garment, chunks)
}

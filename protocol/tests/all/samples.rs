//! One small sample of everything that is stored.

use protocol::links::{LinkEntry, LinkPage};
use protocol::manifest::{ChunkRef, GarmentVersion, GenerationRef, RegionChunkRef, VersionStats};
use protocol::region::{RegionChunk, RegionEntry};
use protocol::scene::{BodyMesh, Capsule, Edge, GarmentChunk, Joint, Pose, SceneChunk};
use protocol::tag::Tag;
use protocol::telemetry::{GarmentCounts, TelemetryBatch};
use protocol::{
    ChunkHash, EdgeId, GarmentId, GenerationId, Manifest, PoseId, SigningKey, StateId,
    VersionNumber,
};

pub fn scene() -> SceneChunk {
    let joint = |name: &str, parent| Joint {
        name: name.into(),
        parent,
        offset: [0.0, 0.5, 0.0],
        rest_translation: [0.0, 1.0, 0.0],
        rest_rotation: [0.0, 0.0, 0.0, 1.0],
    };
    let pose = |frame| Pose {
        clip: 0,
        frame,
        transition: frame == 2,
        root: [0.25, 1.0, -0.5],
        rotations: vec![[0, 0, 0, 32767], [0, 23170, 0, 23170]],
    };
    let edge = |from, to| Edge { from: PoseId(from), to: PoseId(to), yaw: 0.5, shift: [1.0, 2.0] };
    SceneChunk {
        fps: 30.0,
        joints: vec![joint("hips", None), joint("chest", Some(0))],
        clips: vec!["walk".into()],
        poses: vec![pose(0), pose(1), pose(2)],
        edges: vec![edge(0, 1), edge(0, 2), edge(1, 0), edge(2, 0)],
        colliders: vec![Capsule { joint: 1, a: [0.0; 3], b: [0.0, 0.5, 0.0], radius: 0.125 }],
        body: Some(BodyMesh {
            positions: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
            triangles: vec![[0, 1, 2]],
            joints: vec![[0, 1, 0, 0]; 3],
            weights: vec![[0.5, 0.5, 0.0, 0.0]; 3],
        }),
    }
}

pub fn garment() -> GarmentChunk {
    GarmentChunk { name: "robe".into(), vertex_count: 4, triangles: vec![[0, 1, 2], [0, 2, 3]] }
}

pub fn regions() -> RegionChunk {
    let region = |first, state_count| RegionEntry {
        first_state: StateId(first),
        state_count,
        generation: GenerationId(0),
        max_error_m: 0.0003,
        bytes: vec![1, 2, 3],
    };
    RegionChunk { regions: vec![region(0, 16), region(16, 2)] }
}

/// Total over the scene's graph: 0 -> 1 -> 0 and 0 -> 2 -> 0, one merge back at each end.
pub fn entries() -> Vec<LinkEntry> {
    let interior = |pose, next: &[u64]| LinkEntry::Interior {
        pose: PoseId(pose),
        next: next.iter().map(|id| StateId(*id)).collect(),
    };
    vec![
        interior(0, &[1, 3]),
        interior(1, &[2]),
        LinkEntry::DeadEnd { pose: PoseId(0), target: StateId(0), error_m: 0.005 },
        interior(2, &[4]),
        LinkEntry::DeadEnd { pose: PoseId(0), target: StateId(0), error_m: 0.0 },
        LinkEntry::Retired { pose: PoseId(1), successor: StateId(1) },
    ]
}

pub fn page() -> LinkPage {
    LinkPage { first_state: StateId(0), entries: entries() }
}

pub fn telemetry() -> TelemetryBatch {
    let edges = vec![(EdgeId(0), 300), (EdgeId(3), 1)];
    TelemetryBatch { garments: vec![GarmentCounts { garment: GarmentId(0), edges }] }
}

pub fn tag() -> Tag {
    Tag { garment: GarmentId(0), state: StateId(300), version: VersionNumber(7) }
}

pub fn chunk(name: u64) -> ChunkRef {
    ChunkRef { hash: ChunkHash::of(&name.to_le_bytes()), bytes: 1000 + name as u32 }
}

/// `regions` region chunks and `pages` link pages; `salt` makes the last pages differ.
pub fn manifest(number: u64, regions: u64, pages: u64, salt: u64) -> Manifest {
    let region = |index| RegionChunkRef {
        chunk: chunk(100 + index),
        first_state: StateId(index * 64),
        state_count: 64,
        initial: index == 0,
    };
    Manifest {
        number: VersionNumber(number),
        previous: (number > 1).then(|| ChunkHash::of(b"previous")),
        garments: vec![GarmentVersion {
            id: GarmentId(0),
            name: "robe".into(),
            codec: "kim2013".into(),
            scene: chunk(0),
            mesh: chunk(1),
            generations: vec![GenerationRef { chunk: chunk(2), columns: 200 }],
            regions: (0..regions).map(region).collect(),
            links: (0..pages)
                .map(|p| chunk(100_000 + p + if p + 2 >= pages { salt } else { 0 }))
                .collect(),
            stats: VersionStats {
                poses: 3,
                edges: 4,
                states: 6,
                worst_error_m: 0.005,
                ..VersionStats::default()
            },
            upsampler: None,
        }],
    }
}

/// The same with an upsampler.
pub fn upsampled(number: u64, name: u64) -> Manifest {
    let mut manifest = manifest(number, 2, 3, 0);
    manifest.garments[0].upsampler = Some(chunk(name));
    manifest
}

pub fn key() -> SigningKey {
    SigningKey::from_seed(&[7; 32])
}

//! A hand-made world for tests: a sheet of 7 x 7 vertices that hangs from the hips of the tiny
//! character, with a basis of three columns and an upsampler of 4 x 4 points.

use std::collections::BTreeSet;
use std::sync::Arc;

use codec::upsample::{
    Binding, Class, Fabric, Parts as Stored, Pin, Place, Skin, Stepping, WHOLE, Weights,
};
use codec::{Basis, kim2013};
use protocol::links::{LinkEntry, LinkPage};
use protocol::manifest::{ChunkRef, GarmentVersion, GenerationRef, RegionChunkRef, VersionStats};
use protocol::scene::GarmentChunk;
use protocol::{ChunkHash, GarmentId, StateId, VersionNumber};

use super::Upsampled;
use super::probe::Probes;
use crate::cache::{Cache, Region};
use crate::scene::Scene;
use crate::tiny;
use crate::version::{Parts, Version, View};

/// Vertices along a side, and coarse points.
pub const FINE: usize = 7;
pub const COARSE: usize = 4;
/// Side of the sheet (m).
const SIDE_M: f32 = 0.6;

/// Of the rest pose, whose hips are 1 m above the origin.
fn grid(n: usize) -> Vec<[f32; 3]> {
    let at = |i: usize| SIDE_M * i as f32 / (n - 1) as f32;
    (0..n * n).map(|i| [at(i % n) - 0.5 * SIDE_M, 1.0 - at(i / n), 0.0]).collect()
}

fn triangles(n: u32) -> Vec<[u32; 3]> {
    let cells = (0..n * (n - 1)).filter(|i| i % n + 1 < n);
    cells.flat_map(|i| [[i, i + n, i + 1], [i + 1, i + n, i + n + 1]]).collect()
}

/// Bilinear: every second fine vertex is a coarse point.
fn weights() -> Vec<f32> {
    let hat = |fine: usize, coarse: usize| (1.0 - 0.5 * fine.abs_diff(2 * coarse) as f32).max(0.0);
    let row = |f: usize| {
        let (x, y) = (f % FINE, f / FINE);
        (0..COARSE * COARSE).map(move |c| hat(x, c % COARSE) * hat(y, c / COARSE))
    };
    (0..FINE * FINE).flat_map(row).collect()
}

/// An upsampler; cloth is drawn to rest within a second.
pub fn stored() -> Stored {
    let place = |c: usize| {
        let vertex = (2 * (c % COARSE) + 2 * FINE * (c / COARSE)) as u32;
        Place { vertices: [vertex; 3], weights: [1.0, 0.0] }
    };
    let skin = |vertex: usize| Skin {
        vertex: vertex as u32,
        share: WHOLE,
        binding: Binding::of(0),
        rest: grid(FINE)[vertex],
        normal: [0.0; 3],
        floor_m: 0.0,
    };
    Stored {
        points: grid(COARSE),
        triangles: triangles(COARSE as u32).iter().map(|t| t.map(|v| v as u16)).collect(),
        places: (0..COARSE * COARSE).map(place).collect(),
        pins: (0..COARSE as u16).map(|point| Pin { point, binding: Binding::of(0) }).collect(),
        tethers: vec![],
        capsules: vec![],
        fabric: Fabric {
            density: 0.2,
            stretch: 1000.0,
            weft: None,
            shear: 400.0,
            bend: 5e-5,
            friction: 0.3,
            drag: 0.0,
            damping_s: 0.0,
            offset: 0.0,
        },
        stepping: Stepping {
            steps: 2,
            passes: 60,
            sweeps: 4,
            ground: false,
            compression: 1.0,
            damping_per_s: 4.0,
            expansion_m: 0.0,
            spacing_m: 0.0,
            apart_m: 0.0,
        },
        skins: (0..FINE).map(skin).collect(),
        modes: vec![],
        classes: vec![],
        rms_m: 0.001,
        max_m: 0.003,
        weights: Weights::round(COARSE * COARSE, &weights(), 16).unwrap(),
    }
}

/// A rule: how far in front of the hips (+z) does the sheet's lower edge lie?
pub fn class() -> Class {
    let vertices = (FINE as u32 * (FINE as u32 - 1)..(FINE * FINE) as u32).collect();
    Class { joint: 0, axis: [0.0, 0.0, 1.0], threshold_m: 0.0, vertices }
}

/// Hanging; swung forward by 0.3 m at the lower edge; the same sideways. Full scale.
fn basis() -> Basis {
    let points = grid(FINE);
    let depth = |p: &[f32; 3]| (1.0 - p[1]) / SIDE_M;
    let columns: [Vec<f32>; 3] = [
        points.iter().flat_map(|p| [p[0], p[1] - 1.0, p[2]]).collect(),
        points.iter().flat_map(|p| [0.0, 0.0, 0.3 * depth(p)]).collect(),
        points.iter().flat_map(|p| [0.3 * depth(p), 0.0, 0.0]).collect(),
    ];
    let rows = 3 * points.len();
    let mut entries = vec![0i16; 3 * rows];
    for (column, entries) in columns.iter().zip(entries.chunks_mut(rows)) {
        kim2013::quantise_column(column, kim2013::STEP_M, entries).unwrap();
    }
    let mut bytes = Vec::new();
    kim2013::encode_generation(rows as u32, kim2013::STEP_M, &[1.0; 3], &entries, &mut bytes)
        .unwrap();
    let mut basis = Basis::new();
    basis.append(&kim2013::Generation::parse(&bytes).unwrap()).unwrap();
    basis
}

/// Coefficients of a state: hanging, 10 to 14 mm behind.
fn coefficients(state: u64) -> [i16; 3] {
    [i16::MAX, 300 * (state as i16 % 4) - 1500, 200 * (state as i16 % 3)]
}

/// A view of the tiny graph with these links; `resident` says whether its states are here.
pub fn view(links: Vec<LinkEntry>, stored: Option<&Stored>, resident: bool) -> Arc<View> {
    let chunk = |name: &str| ChunkRef { hash: ChunkHash::of(name.as_bytes()), bytes: 100 };
    let count = links.len() as u64;
    let region = RegionChunkRef {
        chunk: chunk("region"),
        first_state: StateId(0),
        state_count: count as u32,
        initial: true,
    };
    let garment = GarmentVersion {
        id: GarmentId(0),
        name: "sheet".into(),
        codec: kim2013::PROFILE.into(),
        scene: chunk("scene"),
        mesh: chunk("mesh"),
        generations: vec![GenerationRef { chunk: chunk("basis"), columns: 3 }],
        regions: vec![region],
        links: vec![chunk("links")],
        stats: VersionStats { mean_error_m: 0.02, ..VersionStats::default() },
        upsampler: stored.map(|_| chunk("upsampler")),
    };
    let triangles = triangles(FINE as u32);
    let vertex_count = (FINE * FINE) as u32;
    let mesh = GarmentChunk { name: "sheet".into(), vertex_count, triangles };
    // Straight on: in a bend the sheet would lean over, where no state is.
    let mut chunks = tiny::scene_chunk();
    chunks.edges[2].yaw = 0.0;
    let scene = Arc::new(Scene::new(chunks).unwrap());
    let parts = Parts {
        number: VersionNumber(1),
        garment,
        scene,
        mesh: Arc::new(mesh),
        basis: Arc::new(basis()),
        pages: vec![LinkPage { first_state: StateId(0), entries: links }],
    };
    let version = Arc::new(Version::assemble(parts).unwrap());
    let mut cache = Cache::new(1 << 20);
    if resident {
        let rows = (0..count).flat_map(coefficients).collect();
        let region = Region::new(StateId(0), 3, rows);
        cache.insert(chunk("region").hash, vec![region], true, &BTreeSet::new());
    }
    let upsampled = stored.map(|stored| {
        let bytes = stored.encode().unwrap();
        Arc::new(Upsampled::new(&bytes, version.mesh(), version.scene()).unwrap())
    });
    let probes = upsampled.as_ref().map(|u| Arc::new(Probes::new(u, version.basis())));
    Arc::new(View { version, resident: Arc::new(cache.snapshot()), upsampled, probes })
}

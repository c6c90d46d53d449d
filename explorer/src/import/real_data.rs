//! Tests on the real character; skipped, with a line that says so, where the data is not there.

use std::path::{Path, PathBuf};

use super::motion_graph::Topology;
use super::*;

/// The data folder, or `None` (skip). `TOILE_REQUIRE_DATA` makes its absence a failure.
fn data() -> Option<PathBuf> {
    let named = std::env::var_os("TOILE_DATA").map(PathBuf::from);
    let found = named.or_else(|| {
        let here = Path::new(env!("CARGO_MANIFEST_DIR"));
        here.ancestors().map(|a| a.join("shared/data")).find(|d| d.is_dir())
    });
    if found.is_none() {
        assert!(std::env::var_os("TOILE_REQUIRE_DATA").is_none(), "the data folder is missing");
        eprintln!("skipped: no data folder (set TOILE_DATA)");
    }
    found
}

fn character(data: &Path) -> Character {
    let bytes = std::fs::read(data.join("character.glb")).unwrap();
    character::read_character(&bytes, None, 30.0).unwrap()
}

fn graph_file(data: &Path) -> GraphFile {
    GraphFile::parse(&std::fs::read_to_string(data.join("motion-graph.json")).unwrap()).unwrap()
}

#[test]
fn the_character_is_as_its_readme_says() {
    let Some(data) = data() else { return };
    let Character { body, clips } = character(&data);
    assert_eq!((body.rest_positions.len(), body.triangles.len()), (6702, 13_400));
    assert_eq!(body.skeleton.joint_count(), 31);
    assert_eq!(body.skeleton.names[0], "Hips");
    assert_eq!(clips.len(), 12);
    assert_eq!(clips.iter().map(|c| c.poses.len()).sum::<usize>(), 3108);
    let mut skinned = Vec::new();
    body.skin(&body.skeleton.rest_pose(), &mut Vec::new(), &mut skinned);
    let moved = skinned.iter().zip(&body.rest_positions).map(|(a, b)| a.distance(*b));
    assert!(moved.fold(0.0, f32::max) < 1e-5, "the rest pose leaves the body where it was bound");
}

#[test]
fn the_raw_graph_keeps_as_many_frames_as_the_data_says() {
    let Some(data) = data() else { return };
    let clips = character(&data).clips;
    let transitions = graph_file(&data).resolve(&clips, 30.0).unwrap();
    let frames: Vec<usize> = clips.iter().map(|c| c.poses.len()).collect();
    let raw = Topology::new(&frames, &transitions, false);
    assert_eq!(raw.digraph().largest_cycle_component().len(), 3092);
}

#[test]
fn distances_are_those_of_the_file() {
    let Some(data) = data() else { return };
    let Character { body, clips } = character(&data);
    let transitions = graph_file(&data).resolve(&clips, 30.0).unwrap();
    let tracks = transition::tracks(&body.skeleton, &clips);
    for t in &transitions {
        let source = tracks[t.from_clip].window(t.from_frame + 1);
        let fit = align::fit(source, tracks[t.to_clip].window(t.to_frame));
        assert!((fit.distance_m - t.distance_m).abs() < 2e-4, "{t:?}: {}", fit.distance_m);
    }
}

#[test]
fn the_dress_loads_and_every_edge_is_continuous_in_the_world() {
    let Some(data) = data() else { return };
    let loaded = load("dress", Some(&data)).unwrap();
    let Scene { body, primary, garment, .. } = loaded.scene;
    assert!((5000..=5600).contains(&garment.positions.len()));
    // Speeds of all joints over each edge, in the world of its source.
    let mut worst = [0.0f32; 2];
    let (mut a, mut b) = (Vec::new(), Vec::new());
    for edge in primary.edges() {
        let (from, to) = (primary.pose(edge.from), primary.pose(edge.to));
        body.skeleton.world(&from.pose, &mut a);
        body.skeleton.world(&to.pose.moved(&edge.alignment()), &mut b);
        let step = a
            .iter()
            .zip(&b)
            .map(|(a, b)| a.translation.distance(b.translation))
            .fold(0.0, f32::max);
        let kind = usize::from(from.transition || to.transition);
        worst[kind] = worst[kind].max(step);
    }
    assert!(worst[1] <= worst[0], "transitions move no faster than the clips");
}

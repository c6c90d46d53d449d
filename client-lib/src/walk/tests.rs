use super::*;
use crate::tiny;

/// Clips `a` (poses 0..4) and `b` (4..9); 3 -> 0, 3 -> 9 -> 5 (9 a transition to b), 8 -> 0.
fn two_clips() -> Arc<Scene> {
    let mut chunk = tiny::scene_chunk();
    let pose = chunk.poses[0].clone();
    let edge = chunk.edges[0];
    chunk.clips = vec!["a".into(), "b".into(), "c".into()];
    chunk.poses = (0..10u32)
        .map(|id| {
            let (clip, frame) = if id < 4 { (0, id) } else { (1, id - 4) };
            protocol::scene::Pose { clip, frame, transition: id == 9, ..pose.clone() }
        })
        .collect();
    let pairs =
        [(0, 1), (1, 2), (2, 3), (3, 0), (3, 9), (4, 5), (5, 6), (6, 7), (7, 8), (8, 0), (9, 5)];
    chunk.edges = pairs
        .map(|(from, to)| protocol::scene::Edge { from: PoseId(from), to: PoseId(to), ..edge })
        .to_vec();
    Arc::new(Scene::new(chunk).unwrap())
}

fn first(spec: &str, count: usize) -> Vec<u32> {
    let walk = Walk::new(&WalkSpec::parse(spec).unwrap(), &two_clips(), PoseId(0)).unwrap();
    walk.take(count).map(|pose| pose.0).collect()
}

fn error(spec: &WalkSpec) -> String {
    Walk::new(spec, &two_clips(), PoseId(0)).unwrap_err().to_string()
}

#[test]
fn a_random_walk_follows_edges_and_its_seed() {
    let scene = two_clips();
    let poses = first("random:7", 2_000);
    let mut before = PoseId(0);
    for pose in poses.iter().copied().map(PoseId) {
        assert!(scene.edge_between(before, pose).is_some(), "{before} -> {pose}");
        before = pose;
    }
    assert_eq!(poses, first("random:7", 2_000));
    assert_ne!(poses, first("random:8", 2_000));
    let (to_0, to_9) = poses
        .windows(2)
        .filter(|w| w[0] == 3)
        .fold((0, 0), |(a, b), w| if w[1] == 0 { (a + 1, b) } else { (a, b + 1) });
    assert!((to_0 as f32 / (to_0 + to_9) as f32 - 0.5).abs() < 0.1, "{to_0} against {to_9}");
}

#[test]
fn clips_are_reached_by_the_shortest_way_and_played_in_turn() {
    assert_eq!(first("clip:b", 16), [1, 2, 3, 9, 5, 6, 7, 8, 0, 1, 2, 3, 9, 5, 6, 7]);
    assert_eq!(first("clip:a,b", 12), [1, 2, 3, 9, 5, 6, 7, 8, 0, 1, 2, 3]);
}

#[test]
fn lists_of_edges_and_poses_end() {
    let text = "# to the other clip\n0\nedge 1\n\npose 8 # a jump\nedge 9\n".to_owned();
    let spec = WalkSpec::Edges { source: "list".into(), text };
    let walk = Walk::new(&spec, &two_clips(), PoseId(0)).unwrap();
    assert_eq!(walk.map(|pose| pose.0).collect::<Vec<_>>(), [1, 2, 8, 0]);
}

#[test]
fn mistakes_are_named() {
    let spec_error = |text| WalkSpec::parse(text).unwrap_err().to_string();
    assert!(spec_error("sideways").contains("clip:NAME"));
    assert!(spec_error("random:abc").contains("\"abc\""));
    assert!(spec_error("edges:/no/such/file").contains("/no/such/file"));
    assert!(error(&WalkSpec::Clips(vec!["z".into()])).contains("a, b, c"));
    let list = |text: &str| error(&WalkSpec::Edges { source: "list".into(), text: text.into() });
    assert!(list("0\n5").contains("list, line 2: edge 5 leaves pose 4, but we are at 1"));
    assert!(list("99").contains("there are 11"));
    assert!(list("pose 10").contains("there are 10"));
    assert!(list("x").contains("no id"));
    assert!(list("# nothing").contains("no line"));
    // Clip c exists in name only.
    assert!(error(&WalkSpec::Clips(vec!["c".into()])).contains("no way"));
}

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
    // The neckline is held, all around the neck.
    let neck = body.skeleton.rest[body.skeleton.joint("Neck").unwrap()].translation;
    let held: Vec<_> = garment.attached.iter().map(|v| garment.positions[*v as usize]).collect();
    assert!((20..40).contains(&held.len()));
    assert!(held.iter().all(|p| p.distance(neck) < 0.2), "{neck} {held:?}");
    let middle = held.iter().sum::<cloth::Vec3>() / held.len() as f32;
    assert!(middle.x.abs() < 0.01, "{middle}");
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

#[test]
fn retargeted_clips_come_close_to_the_animations() {
    let Some(data) = data() else { return };
    let Character { body, clips } = character(&data);
    let skeleton = &body.skeleton;
    for clip in &clips {
        let text = std::fs::read_to_string(data.join(format!("clips/{}.bvh", clip.name))).unwrap();
        let bvh = bvh::Bvh::parse(&text).unwrap();
        let ours = retarget::retarget(&clip.name, &bvh, skeleton, 30.0).unwrap();
        assert_eq!(ours.poses.len(), clip.poses.len());
        // The animation is the same motion, shifted by a constant and lifted off the floor.
        let (mut a, mut b) = (Vec::new(), Vec::new());
        let shift = (clip.poses[0].root - ours.poses[0].root).with_y(0.0);
        for (ours, theirs) in ours.poses.iter().zip(&clip.poses) {
            skeleton.world(ours, &mut a);
            skeleton.world(theirs, &mut b);
            for (joint, (a, b)) in a.iter().zip(&b).enumerate() {
                let name = &skeleton.names[joint];
                let ends = ["Foot", "Toe", "Hand", "Thumb", "Finger", "Neck", "Head"];
                let offset = a.translation + shift - b.translation;
                let is_end = ends.iter().any(|end| name.contains(end));
                let (near_m, angle) = if is_end { (0.12, 0.7) } else { (2e-3, 5e-3) };
                assert!(offset.with_y(0.0).length() < near_m, "{} {name} {offset}", clip.name);
                assert!(offset.y.abs() < 0.08 + near_m, "{} {name} {offset}", clip.name);
                // The animation spreads what lies between chest and head over two neck joints
                // and limits the toes.
                let turned = a.rotation.angle_between(b.rotation);
                assert!(
                    turned < angle || name.contains("Neck") || name.contains("Toe"),
                    "{} {name} {turned}",
                    clip.name
                );
            }
        }
    }
}

#[test]
fn the_dress_is_reported() {
    let Some(data) = data() else { return };
    let report = check::check_scene("dress", Some(&data)).unwrap();
    assert_eq!(report.largest_component, report.poses);
    assert_eq!(report.transitions, 72);
    assert!(report.cloth.clearance_min_mm > 1.0);
    assert!(report.reach.median_s < report.reach.p90_s && report.reach.p90_s < 60.0);
}

#[test]
fn a_graph_computed_from_the_clips_keeps_nearly_all_of_them() {
    let Some(data) = data() else { return };
    for density in [Density::Threshold(0.1), Density::Reach(6.0)] {
        let file = scene_graph("dress", Some(&data), Some(density), &[]).unwrap();
        let Character { body, clips } = character(&data);
        let transitions = file.resolve(&clips, 30.0).unwrap();
        let frames: Vec<usize> = clips.iter().map(|c| c.poses.len()).collect();
        let raw = Topology::new(&frames, &transitions, false);
        let kept = raw.digraph().largest_cycle_component().len();
        let reach = reach::Reach::of_clips(&frames, &transitions, 30.0);
        let (primary, report) =
            motion_graph::build(&body.skeleton, &clips, 30.0, &transitions).unwrap();
        assert!(primary.poses().len() > 3500 && report.clip_frames_kept > 2900);
        if let Density::Reach(asked_s) = density {
            assert!(reach.median_s <= asked_s && transitions.len() < 200);
        }
        assert!(kept > 3000);
    }
}

#[test]
fn gaits_are_answered_in_half_a_second_by_few_transitions_that_fit() {
    let Some(data) = data() else { return };
    let file = scene_graph("dress-agile", Some(&data), None, &[]).unwrap();
    let Character { clips, .. } = character(&data);
    let frames: Vec<usize> = clips.iter().map(|c| c.poses.len()).collect();
    let transitions = file.resolve(&clips, 30.0).unwrap();
    let gaits = ["walk_figure8", "run_figure8", "walk_backward", "sidestep", "turn_left"];
    let gaits = gaits.map(|name| clips.iter().position(|c| c.name == name).unwrap());
    let reach = reach::Reach::to_clips(&frames, &transitions, 30.0, &gaits);
    assert!(reach.median_s <= 0.5 && reach.p90_s < 0.7, "{reach:?}");
    assert!(transitions.len() < 700, "{}", transitions.len());
    let mut distances: Vec<f32> = transitions.iter().map(|t| t.distance_m).collect();
    distances.sort_by(f32::total_cmp);
    assert!(distances[distances.len() / 2] < 0.15, "median {}", distances[distances.len() / 2]);
}

#[test]
fn transitions_move_no_faster_than_the_clips_around_them() {
    let Some(data) = data() else { return };
    let Character { body, clips } = character(&data);
    let transitions = graph_file(&data).resolve(&clips, 30.0).unwrap();
    let tracks = transition::tracks(&body.skeleton, &clips);
    let places = |poses: &[cloth::Pose]| -> Vec<Vec<cloth::Vec3>> {
        let mut world = Vec::new();
        let mut all = Vec::new();
        for pose in poses {
            body.skeleton.world(pose, &mut world);
            all.push(world.iter().map(|w| w.translation).collect());
        }
        all
    };
    let step = |a: &[cloth::Vec3], b: &[cloth::Vec3]| {
        a.iter().zip(b).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max)
    };
    let mut ratios = Vec::new();
    for t in &transitions {
        let run = transition::run(&clips, &tracks, t);
        let source = &clips[t.from_clip].poses;
        let target = &clips[t.to_clip].poses;
        let back = run.fit.alignment().inverse();
        let mut path = vec![source[t.from_frame].moved(&back)];
        path.extend(run.poses.iter().cloned());
        path.push(target[run.joins].clone());
        let path = places(&path);
        let steps: Vec<f32> = path.windows(2).map(|p| step(&p[0], &p[1])).collect();
        let most = steps.iter().copied().fold(0.0, f32::max);
        let before = places(&source[t.from_frame - 2..=(t.from_frame + 1).min(source.len() - 1)]);
        let after = places(&target[t.to_frame.saturating_sub(1)..=run.joins]);
        let of_clips = before.windows(2).chain(after.windows(2)).map(|p| step(&p[0], &p[1]));
        let of_clips = of_clips.fold(0.0, f32::max);
        // The offset itself must be travelled: at most 1.9 tenths of it in a frame, and the
        // worst transitions of this graph are 0.6 m apart at the hands.
        assert!(most < of_clips + 0.12, "{t:?}: {most} m in a frame, {of_clips} m in the clips");
        ratios.push(most / of_clips);
    }
    ratios.sort_by(f32::total_cmp);
    assert!(ratios[ratios.len() / 2] < 1.05, "median {}", ratios[ratios.len() / 2]);
    assert!(ratios[ratios.len() * 9 / 10] < 1.6, "{ratios:?}");
}

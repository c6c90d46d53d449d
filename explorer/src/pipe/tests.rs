//! The Python example, and what becomes of a run when it misbehaves.

use std::path::Path;

use super::*;
use crate::explore::{End, ExploreOptions, Place, Progress, Summary, explore};
use crate::grow::toy;

/// Whether Python is there; its absence is a failure where `TOILE_REQUIRE_PYTHON` is set.
fn python() -> bool {
    let found = std::process::Command::new("python3").arg("--version").output().is_ok();
    assert!(found || std::env::var_os("TOILE_REQUIRE_PYTHON").is_none(), "python3 is required");
    if !found {
        println!("skipped: there is no python3");
    }
    found
}

fn scene(arguments: &[&str], timeout_s: f32) -> Scene {
    let mut scene = toy::scene(toy::knot(), toy::settings());
    scene.exploration.drape_frames = 2;
    let command = ["python3"].iter().chain(arguments).map(|a| (*a).to_owned()).collect();
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/pipe");
    scene.simulator = Some(Foreign { command, folder, timeout_s });
    // Poses that differ, so that the cloth moves.
    let mut poses = scene.primary.poses().to_vec();
    for (i, pose) in poses.iter_mut().enumerate() {
        pose.pose.rotations[0] = cloth::Quat::from_rotation_y(0.4 * i as f32);
        pose.pose.root.x = 0.02 * i as f32;
    }
    let edges = scene.primary.edges().to_vec();
    let clips = scene.primary.clips().to_vec();
    let primary = crate::primary::PrimaryGraph::new(30.0, clips, poses, edges).unwrap();
    scene.primary = Arc::new(primary);
    scene.exploration.tolerance_m = 0.0005;
    scene
}

fn run(scene: &Scene, folder: &Path, frames: u64) -> (Summary, Vec<String>) {
    let root = folder.join("store");
    let place = Place {
        store: crate::pack::local_store(&root).unwrap(),
        folder: Some(root),
        key: protocol::SigningKey::from_seed(&[5; 32]),
        work: folder.join("work"),
    };
    let options = ExploreOptions { frames: Some(frames), ..ExploreOptions::default() };
    let mut failures = Vec::new();
    let mut note = |p: &Progress| failures.extend(p.failure.clone());
    let simulators = simulators(scene).unwrap();
    let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
    let summary = explore(scene, &*simulators, &place, &options, &mut note);
    (runtime.block_on(summary).unwrap(), failures)
}

fn states(folder: &Path) -> Vec<u8> {
    // Behind the header, which names the program.
    std::fs::read(folder.join("work/states")).unwrap().split_off(64)
}

#[test]
fn a_python_program_simulates_and_a_fault_that_passes_changes_nothing() {
    if !python() {
        return;
    }
    let sound = tempfile::tempdir().unwrap();
    let (summary, failures) = run(&scene(&["springs.py"], 30.0), sound.path(), 60);
    assert_eq!((summary.end, failures.len()), (End::Frames, 0));
    assert!(summary.worst_error_mm > 0.0);
    for fault in ["hang", "die", "nan", "size"] {
        let folder = tempfile::tempdir().unwrap();
        let marker = folder.path().join("fault");
        std::fs::write(&marker, b"").unwrap();
        let arguments = ["faulty.py", fault, "once", marker.to_str().unwrap()];
        // A hang costs its time limit.
        let limit_s = if fault == "hang" { 3.0 } else { 30.0 };
        let (summary, failures) = run(&scene(&arguments, limit_s), folder.path(), 60);
        assert!(!marker.exists(), "{fault}: it went wrong once");
        assert_eq!((summary.failed_jobs, failures.len()), (0, 0), "{fault}: {failures:?}");
        assert!(states(folder.path()) == states(sound.path()), "{fault}");
    }
}

#[test]
fn a_fault_that_stays_costs_its_jobs_and_says_why() {
    if !python() {
        return;
    }
    for (fault, words) in
        [("die", "ended without an answer"), ("nan", "vertex 0"), ("size", "bytes, 72 were")]
    {
        let folder = tempfile::tempdir().unwrap();
        let marker = folder.path().join("fault");
        let arguments = ["faulty.py", fault, "always", marker.to_str().unwrap()];
        let scene = scene(&arguments, 30.0);
        // The initial pass needs every edge, so it fails only afterwards.
        run(&scene, folder.path(), 1);
        std::fs::write(&marker, b"").unwrap();
        let (summary, failures) = run(&scene, folder.path(), 60);
        assert!(summary.failed_jobs > 0, "{fault}");
        assert_eq!(summary.failed_jobs, failures.len() as u64);
        assert!(failures.iter().all(|text| text.contains(words)), "{fault}: {failures:?}");
    }
}

#[test]
fn a_program_that_is_not_there_is_named() {
    let mut scene = scene(&[], 5.0);
    scene.simulator.as_mut().unwrap().command = vec!["no-such-program-anywhere".into()];
    let error = simulators(&scene).unwrap().simulator().drape().unwrap_err().to_string();
    assert!(error.contains("no-such-program-anywhere") && error.contains("started"), "{error}");
}

//! The Python example, and what becomes of a run when it misbehaves.

use std::path::Path;

use super::*;
use crate::explore::{End, ExploreError, ExploreOptions, Place, Progress, Summary, explore};
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
    try_run(scene, folder, frames).unwrap()
}

fn try_run(
    scene: &Scene,
    folder: &Path,
    frames: u64,
) -> Result<(Summary, Vec<String>), ExploreError> {
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
    Ok((runtime.block_on(summary)?, failures))
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
    assert!(summary.quality.speed_max_m_s > 0.1, "frames of a program are measured too");
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

/// Writes a program that takes 4 ms of CPU time a step and then answers as the example does.
fn write_slow(program: &Path) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/pipe");
    let text = format!(
        "import sys, time\nsys.path.insert(0, {folder:?})\nimport springs\n\ndef answer(simulator, payload):\n    \
         end = time.process_time() + 0.004\n    while time.process_time() < end:\n        pass\n    \
         return springs.answer(simulator, payload)\n\nsprings.main(answer)\n"
    );
    std::fs::write(program, text).unwrap();
}

/// A program that cannot run for a while is waited for; one that stays broken ends the run, and nothing is set
/// aside for it.
#[test]
fn a_broken_program_costs_no_job() {
    if !python() {
        return;
    }
    let [sound, folder] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let program = folder.path().join("program.py");
    write_slow(&program);
    let scene = scene(&[program.to_str().unwrap()], 30.0);
    let (summary, _) = run(&scene, sound.path(), 60);
    let cpu_s = summary.simulate_cpu_s;
    assert!(cpu_s > 0.2, "{cpu_s} s of {} frames", summary.simulated_frames);
    run(&scene, folder.path(), 1);
    // It starts, and ends at its first step; another cannot even be started.
    for broken in ["import springs\n", "import sys\nsys.exit(3)\n"] {
        let before = std::fs::read(folder.path().join("work/journal")).unwrap();
        let broken = broken.replace("import springs", &dying());
        std::fs::write(&program, broken).unwrap();
        let error = try_run(&scene, folder.path(), 60).unwrap_err().to_string();
        assert!(error.contains("out of order") && error.contains("mend it"), "{error}");
        assert!(std::fs::read(folder.path().join("work/journal")).unwrap() == before);
    }
    // Mended while it is waited for.
    let mended = std::thread::spawn(move || {
        std::thread::sleep(Duration::from_millis(900));
        write_slow(&program);
    });
    let (summary, failures) = run(&scene, folder.path(), 60);
    mended.join().unwrap();
    assert_eq!((summary.failed_jobs, summary.set_aside, failures.len()), (0, 0, 0));
    assert!(states(folder.path()) == states(sound.path()));
}

/// A program that is ready, and ends at its first step.
fn dying() -> String {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/pipe");
    format!(
        "import os, sys\nsys.path.insert(0, {folder:?})\nimport springs\n\
         springs.main(lambda simulator, payload: os._exit(3))"
    )
}

#[test]
fn a_program_that_is_not_there_is_named() {
    let mut scene = scene(&[], 5.0);
    scene.simulator.as_mut().unwrap().command = vec!["no-such-program-anywhere".into()];
    let error = simulators(&scene).unwrap().simulator().drape(&|| false).unwrap_err().to_string();
    assert!(error.contains("no-such-program-anywhere") && error.contains("started"), "{error}");
}

//! Same inputs, same bytes: for any number of workers, and after kill -9.

use std::time::Duration;

use crate::run::{SHARED_FRAMES, command, contents, explore, path, shared_store, wait_for};

#[test]
fn one_worker_killed_three_times_writes_the_store_that_two_workers_wrote() {
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("robe");
    let frames = SHARED_FRAMES.to_string();
    let arguments = [
        "explore",
        "--scene",
        "robe",
        "--store",
        path(&store),
        "--frames",
        &frames,
        "--workers",
        "1",
    ];
    for seconds in [3, 6, 6] {
        let mut child = command(&arguments).spawn().unwrap();
        std::thread::sleep(Duration::from_secs(seconds));
        child.kill().unwrap();
        child.wait().unwrap();
    }
    let resumed = explore(&store, SHARED_FRAMES, 1);
    assert!(resumed["simulated_frames"].as_u64().unwrap() >= SHARED_FRAMES);
    let (ours, theirs) = (contents(&store), contents(shared_store()));
    let names =
        |c: &std::collections::BTreeMap<String, Vec<u8>>| c.keys().cloned().collect::<Vec<_>>();
    assert_eq!(names(&ours), names(&theirs));
    assert!(ours == theirs, "same names, other bytes");
}

#[test]
fn two_explorers_on_one_work_folder_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("robe");
    let arguments = ["explore", "--scene", "robe", "--store", path(&store)];
    let mut first = command(&arguments).spawn().unwrap();
    let work = folder.path().join("robe.work");
    wait_for(Duration::from_secs(60), || work.join("journal").exists().then_some(()));
    let second = crate::run::toile_error(&arguments);
    first.kill().unwrap();
    first.wait().unwrap();
    assert!(second.contains("robe.work"), "says which folder: {second}");
}

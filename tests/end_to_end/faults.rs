//! What goes wrong outside gets a clear error each; the server stays up, the store stays valid.

use std::path::Path;
use std::process::Command;

use crate::run::{Serving, contents, path, shared_store, toile, toile_error, toile_json};

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy(&entry.path(), &target);
        } else {
            std::fs::copy(entry.path(), target).unwrap();
        }
    }
}

#[test]
fn a_wrong_fingerprint_is_named_and_nothing_is_played() {
    let mut serving = Serving::start(shared_store(), &[]);
    let wrong = "00".repeat(32);
    let said = toile_error(&[
        "play",
        "--connect",
        &serving.address,
        "--fingerprint",
        &wrong,
        "--frames",
        "5",
    ]);
    assert!(said.contains("fingerprint"), "{said}");
    assert!(said.contains(&serving.fingerprint), "names the one it met: {said}");
    assert!(serving.is_up());
}

#[test]
fn a_wrong_token_is_refused_and_the_right_one_is_not() {
    let mut serving = Serving::start(shared_store(), &["--token", "open sesame"]);
    let said = toile_error(&serving.play_arguments(&["--token", "open barley", "--frames", "5"]));
    assert!(said.contains("token"), "{said}");
    let said = toile_error(&serving.play_arguments(&["--frames", "5"]));
    assert!(said.contains("token"), "{said}");
    assert_eq!(serving.play(&["--token", "open sesame", "--frames", "5"])["frames"], 5);
    assert!(serving.is_up());
}

#[test]
fn garbage_truncated_and_oversized_bytes_leave_the_server_up() {
    let mut serving = Serving::start(shared_store(), &[]);
    let address = serving.address.parse().unwrap();
    let answers = loadtest::faults::throw_garbage(address, 11).unwrap();
    assert!(answers.iter().all(|(_, answer)| answer.code.is_some()), "{answers:?}");
    assert!(serving.is_up());
    assert_eq!(serving.play(&["--frames", "30"])["missed"], 0);
}

#[test]
fn a_corrupted_chunk_is_named_by_inspect_and_never_served() {
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("robe");
    copy(shared_store(), &store);
    let scene_chunk = largest_chunk(&store);
    let mut bytes = std::fs::read(&scene_chunk).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&scene_chunk, bytes).unwrap();
    let name = scene_chunk.file_name().unwrap().to_str().unwrap();
    let said = toile_error(&["inspect", "--store", path(&store)]);
    assert!(said.contains(name), "names the chunk: {said}");
    let mut serving = Serving::start(&store, &[]);
    assert!(serving.get(&format!("/chunks/{name}")).unwrap().0 >= 500);
    assert!(serving.is_up());
}

fn largest_chunk(store: &Path) -> std::path::PathBuf {
    let files = contents(store);
    let chunks = files.iter().filter(|(name, _)| name.starts_with("chunks/"));
    let (name, _) = chunks.max_by_key(|(_, bytes)| bytes.len()).unwrap();
    store.join(name)
}

#[test]
fn a_full_disk_is_reported_and_the_store_stays_valid() {
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("robe");
    copy(shared_store(), &store);
    let work = shared_store().with_file_name("robe.work");
    copy(&work, &folder.path().join("robe.work"));
    let before = toile_json(&["inspect", "--store", path(&store), "--json"]);
    // No file may grow: what a full disk does to a file that is being written.
    let blocks = largest_file_blocks(&folder.path().join("robe.work"));
    let script = format!(
        "trap '' XFSZ; ulimit -f {blocks}; exec '{}' explore --scene robe --store '{}' --frames 100000",
        env!("CARGO_BIN_EXE_toile"),
        path(&store),
    );
    let output = Command::new("bash").args(["-c", &script]).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success(), "a disk that is full is an error: {said}");
    assert!(!said.contains("panicked"), "{said}");
    assert!(said.contains("error:"), "{said}");
    let after = toile_json(&["inspect", "--store", path(&store), "--json"]);
    assert_eq!(after["total"], true);
    assert!(after["version"].as_u64().unwrap() >= before["version"].as_u64().unwrap());
}

/// The size of the largest file, in the blocks of 1,024 bytes that `ulimit -f` of bash counts.
fn largest_file_blocks(folder: &Path) -> u64 {
    let sizes = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().metadata().unwrap().len());
    sizes.max().unwrap() / 1024 + 8
}

#[test]
fn missing_and_foreign_inputs_are_refused_in_words() {
    let folder = tempfile::tempdir().unwrap();
    let nowhere = folder.path().join("nowhere");
    let said = toile_error(&["inspect", "--store", path(&nowhere)]);
    assert!(said.contains("nowhere"), "{said}");
    let scene = folder.path().join("scene.toml");
    for bytes in [&b""[..], b"name = ", b"\xff\xfe\x00garbage", b"name = \"x\"\nunknown = 1\n"] {
        std::fs::write(&scene, bytes).unwrap();
        let said = toile_error(&["scene", "check", path(&scene)]);
        assert!(said.contains("scene.toml"), "{said}");
    }
    let said = toile_error(&["up", "--scene", "no-such-scene", "--for", "1s"]);
    assert!(said.contains("no-such-scene"), "{said}");
    assert!(!toile(&["explore", "--scene", "robe"]).status.success());
}

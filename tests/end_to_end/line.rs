//! The whole line: explore, publish, serve, play, inspect; and `up`, which does it all.

use std::time::Duration;

use crate::run::{Serving, command, path, shared_store, toile_error, toile_json};

#[test]
fn an_explored_store_is_total_and_its_figures_add_up() {
    let store = shared_store();
    let inspected = toile_json(&["inspect", "--store", path(store), "--json"]);
    assert_eq!(inspected["total"], true);
    for key in ["version", "poses", "states", "regions", "merges", "rank", "basis_bytes"] {
        assert!(inspected[key].as_u64().unwrap() > 0, "{key}");
    }
    assert!(inspected["worst_error_mm"].as_f64().unwrap() > 0.0);
    assert!(inspected["codec_max_error_mm"].as_f64().unwrap() > 0.0);
    let raw = inspected["raw_bytes"].as_u64().unwrap();
    assert!(raw > 5 * inspected["region_bytes"].as_u64().unwrap());
}

#[test]
fn a_player_streams_and_plays_what_was_published() {
    let serving = Serving::start(shared_store(), &[]);
    let folder = tempfile::tempdir().unwrap();
    let (glb, png) = (folder.path().join("walk.glb"), folder.path().join("sheet.png"));
    let played = serving.play(&["--walk", "random:7", "--frames", "300"]);
    assert_eq!(played["frames"], 300);
    assert_eq!(played["missed"], 0);
    assert!(played["exact"].as_u64().unwrap() + played["substituted"].as_u64().unwrap() == 300);
    assert!(played["resident_bytes"].as_u64().unwrap() < 8 << 20);
    assert!(played["max_vertex_speed_m_s"].as_f64().unwrap() < 60.0);
    let walk = ["--walk", "clip:kick,walk", "--frames", "60", "--export", path(&glb)];
    serving.play(&[&walk[..], &["--picture", path(&png)]].concat());
    assert_eq!(&std::fs::read(&glb).unwrap()[..4], b"glTF");
    assert_eq!(&std::fs::read(&png).unwrap()[1..4], b"PNG");
}

#[test]
fn a_player_in_real_time_misses_nothing_and_plays_nearly_all_exactly() {
    let serving = Serving::start(shared_store(), &[]);
    let played = serving.play(&["--walk", "random:3", "--frames", "150", "--realtime"]);
    assert_eq!(played["missed"], 0);
    assert!(played["exact"].as_u64().unwrap() >= 142, "95 %: {played}");
}

#[test]
fn walks_that_make_no_sense_are_refused_in_words() {
    let serving = Serving::start(shared_store(), &[]);
    for (walk, word) in [
        ("clip:cartwheel-on-ice", "cartwheel-on-ice"),
        ("sideways", "sideways"),
        ("edges:/nowhere/edges.txt", "/nowhere/edges.txt"),
        ("random:x", "random"),
    ] {
        let said = toile_error(&serving.play_arguments(&["--walk", walk, "--frames", "5"]));
        assert!(said.contains(word), "{walk}: {said}");
    }
}

#[test]
fn http_answers_health_metrics_status_chunks_and_a_page() {
    let serving = Serving::start(shared_store(), &[]);
    serving.play(&["--frames", "30"]);
    assert_eq!(serving.get("/healthz").unwrap().0, 200);
    let metrics = String::from_utf8(serving.get("/metrics").unwrap().1).unwrap();
    assert!(metrics.contains("# TYPE toile_"), "{metrics}");
    let status: serde_json::Value =
        serde_json::from_slice(&serving.get("/status").unwrap().1).unwrap();
    assert!(status["version"].as_u64().unwrap() > 0);
    assert!(String::from_utf8(serving.get("/").unwrap().1).unwrap().contains("<html"));
    let chunks = shared_store().join("chunks");
    let folder = std::fs::read_dir(&chunks).unwrap().next().unwrap().unwrap().path();
    let chunk = std::fs::read_dir(&folder).unwrap().next().unwrap().unwrap().path();
    let name = chunk.file_name().unwrap().to_str().unwrap();
    let (status, bytes) = serving.get(&format!("/chunks/{name}")).unwrap();
    assert_eq!((status, bytes), (200, std::fs::read(&chunk).unwrap()));
    assert_eq!(serving.get(&format!("/chunks/{}", "0".repeat(64))).unwrap().0, 404);
    assert!(serving.get("/chunks/../versions").unwrap().0 >= 400);
}

#[test]
fn up_explores_serves_and_plays_and_goes_on_where_it_stopped() {
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("robe");
    let up = |time: &str| {
        toile_json(&["up", "--store", path(&store), "--for", time, "--players", "2", "--json"])
    };
    // On a busy machine the first version takes longer; a later start goes on where one ended.
    let mut first = up("60s");
    for _ in 0..3 {
        if first["versions"].as_u64().unwrap() == 0 {
            first = up("60s");
        }
    }
    assert!(first["versions"].as_u64().unwrap() >= 1, "{first}");
    assert_eq!(first["players"], 2);
    assert_eq!(first["frames_missed"], 0);
    let outcomes = ["frames_exact", "frames_substituted", "frames_missed"];
    let sum: u64 = outcomes.iter().map(|key| first[*key].as_u64().unwrap()).sum();
    assert_eq!(first["frames_played"].as_u64().unwrap(), sum);
    let second = up("10s");
    assert!(second["states"].as_u64().unwrap() >= first["states"].as_u64().unwrap());
    assert!(second["frames_played"].as_u64().unwrap() > 0, "plays at once: {second}");
    std::thread::sleep(Duration::from_millis(10));
}

#[test]
fn merges_are_certified_replayed_drawn_and_compared() {
    let store = path(shared_store());
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("merges.json");
    let certificate = ["--certificate", path(&file), "--replay", "3", "--json"];
    let found = toile_json(&[&["inspect", "--store", store][..], &certificate].concat());
    assert_eq!(found["replayed"], 3, "{found}");
    assert_eq!(found["largest_difference_mm"], 0.0, "{found}");
    let page: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(&file).unwrap()).unwrap();
    let merges = page["merges"].as_array().unwrap();
    assert_eq!(merges.len() as u64, found["merges"].as_u64().unwrap());
    for key in ["pose", "clip", "error_mm", "class", "visits", "walked", "target"] {
        assert!(merges[0].get(key).is_some(), "{key}");
    }
    let plots = folder.path().join("plots");
    assert!(crate::run::toile(&["plot", store, "--out", path(&plots)]).status.success());
    assert_eq!(std::fs::read_dir(&plots).unwrap().count(), 10);
    let compared = toile_json(&["compare", store, "--walks", "1", "--frames", "15", "--json"]);
    let rows = compared["rows"].as_array().unwrap();
    assert!(rows.iter().any(|row| row["what"] == "floor" && row["horizon_s"] == 0.5));
    assert_eq!(rows[0]["what"], "graph");
}

#[test]
fn another_scene_named_by_mistake_changes_nothing() {
    let store = shared_store();
    let left = || std::fs::read_to_string(format!("{}.work/scene.json", path(store))).unwrap();
    let before = left();
    let other = ["--scene", "robe", "--vertices", "1600", "--frames", "1"];
    let said = toile_error(&[&["explore", "--store", path(store)], &other[..]].concat());
    assert!(said.contains("made for other inputs"), "{said}");
    assert_eq!(left(), before);
    let said = toile_error(&["scene", "check", "rope"]);
    assert!(said.contains("\"rope\"") && said.contains("robe, dress"), "{said}");
}

#[test]
fn a_reader_that_goes_away_is_no_panic() {
    let mut child = command(&["scene", "check", "robe"])
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let mut said = String::new();
    let mut stderr = child.stderr.take().unwrap();
    std::io::Read::read_to_string(&mut stderr, &mut said).unwrap();
    assert!(!child.wait().unwrap().success());
    assert_eq!(said, "");
}

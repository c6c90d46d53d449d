//! Every refusal on a small scene made by hand: what is wrong, where, and what to do.

use std::fs;
use std::path::Path;

use cloth::Vec3;
use proptest::prelude::*;

use super::character::read_character;
use super::synthetic_glb::{Glb, WALLS, box_corners};
use super::*;

const SCENE: &str = r#"
name = "box"
[character]
file = "body.glb"
[motion_graph]
file = "graph.json"
[garment]
file = "tube.obj"
"#;

const GRAPH: &str = r#"{"fps": 30, "clips": [{"name": "go", "frames": 60}], "transitions": [
  {"from_clip": "go", "from_frame": 58, "to_clip": "go", "to_frame": 5}]}"#;

/// Files of a scene in a folder of its own.
struct Files {
    folder: tempfile::TempDir,
}

impl Files {
    /// A scene that loads: a tube 2 cm around the box of a body.
    fn new() -> Self {
        let files = Self { folder: tempfile::tempdir().unwrap() };
        files.write("scene.toml", SCENE);
        files.write("graph.json", GRAPH);
        files.write("body.glb", Glb::default().bytes());
        files.write("tube.obj", tube(0.275));
        files
    }

    fn write(&self, name: &str, bytes: impl AsRef<[u8]>) {
        fs::write(self.folder.path().join(name), bytes).unwrap();
    }

    fn load(&self) -> Result<Loaded, SceneError> {
        load(&self.folder.path().join("scene.toml").display().to_string(), None)
    }

    /// The refusal, which must name this file and these words.
    #[track_caller]
    fn refused(&self, file: &str, words: &[&str]) {
        let text = self.load().expect_err("a refusal").to_string();
        for word in [file].iter().chain(words) {
            assert!(text.contains(word), "{word:?} is missing in: {text}");
        }
    }
}

/// Walls of a box around the body as an OBJ file.
fn tube(half_m: f32) -> String {
    let mut obj: String =
        box_corners(half_m, 0.6, 1.2).iter().map(|[x, y, z]| format!("v {x} {y} {z}\n")).collect();
    for [a, b, c] in WALLS.map(|t| t.map(|v| v + 1)) {
        obj += &format!("f {a} {b} {c}\n");
    }
    obj
}

#[test]
fn a_bare_file_name_lies_in_the_current_folder() {
    let place = super::Place { scene: std::path::Path::new("s.toml"), data: None };
    assert_eq!(place.folder(), std::env::current_dir().unwrap());
}

#[test]
fn the_small_scene_loads_and_is_measured() {
    let files = Files::new();
    files.write(
        "scene.toml",
        format!("{SCENE}edge_length_m = 0.1\nattach = [{{loop_near = \"Head\"}}]"),
    );
    let loaded = files.load().unwrap();
    let report = check::report(&loaded).unwrap();
    // Frames 15 to 59 and a transition of ten poses; frames after 58 lead nowhere.
    assert_eq!((report.poses, report.edges, report.transitions), (54, 54, 1));
    assert_eq!(report.initial_dead_ends, 1);
    assert_eq!(report.outside.len(), 2);
    assert!((report.cloth.area_m2 - 4.0 * 0.55 * 0.6).abs() < 1e-4);
    assert!((report.cloth.clearance_min_mm - 20.0).abs() < 0.1, "{report}");
    assert!(report.cloth.edge_length_max_mm <= 100.0);
    let held = &loaded.scene.garment.attached;
    assert!(held.len() > 16);
    assert!(held.iter().all(|v| loaded.scene.garment.positions[*v as usize].y > 1.19));
}

#[test]
fn joints_are_sorted_and_what_stands_above_the_root_is_applied() {
    let glb = Glb { above: [0.5, 0.0, 0.0], ..Default::default() };
    let character = read_character(&glb.bytes(), None, 30.0).unwrap();
    let skeleton = &character.body.skeleton;
    assert_eq!(skeleton.names, ["Hips", "Spine", "Head"]);
    assert_eq!(skeleton.parents, [None, Some(0), Some(1)]);
    // Slot 1 of the skin is the root joint; weights are normalised.
    assert_eq!(character.body.joints[0][0], 0);
    assert!((character.body.weights[0][0] - 1.0).abs() < 1e-6);
    assert!(skeleton.rest[2].translation.distance(Vec3::new(0.0, 1.5, 0.0)) < 1e-6);
    let pose = &character.clips[0].poses[10];
    assert!(pose.root.distance(Vec3::new(0.5, 1.0, 0.3)) < 1e-5);
}

#[test]
fn keys_are_sampled_as_their_interpolation_says() {
    for (interpolation, quarter, half) in
        [("LINEAR", 0.25, 0.5), ("STEP", 0.0, 0.0), ("CUBICSPLINE", 0.156_25, 0.5)]
    {
        let path = vec![[0.0, 1.0, 0.0], [0.0, 1.0, 1.0]];
        let glb = Glb { path, interpolation, key_s: 1.0, ..Default::default() };
        let clips = read_character(&glb.bytes(), None, 20.0).unwrap().clips;
        assert_eq!(clips[0].poses.len(), 21);
        assert!((clips[0].poses[5].root.z - quarter).abs() < 1e-5, "{interpolation}");
        assert!((clips[0].poses[10].root.z - half).abs() < 1e-5, "{interpolation}");
        assert!((clips[0].poses[20].root.z - 1.0).abs() < 1e-5, "{interpolation}");
    }
}

#[test]
fn wrong_units_are_refused() {
    for height_m in [160.0, 0.016] {
        let files = Files::new();
        files.write("body.glb", Glb { height_m, ..Default::default() }.bytes());
        files.refused("body.glb", &[&format!("{height_m:.3} m high"), "unit to metres"]);
    }
    let files = Files::new();
    files.write("body.glb", Glb { above_scale: 0.01, ..Default::default() }.bytes());
    files.refused("body.glb", &["Armature", "scale"]);
}

#[test]
fn missing_joints_are_refused() {
    let files = Files::new();
    files.write("body.glb", Glb { bound_to: 3, ..Default::default() }.bytes());
    files.refused("body.glb", &["vertex 0 is bound to joint 3", "the skin has 3"]);

    let files = Files::new();
    for attach in ["{loop_near = \"Tail\"}", "{near = \"Tail\", within_m = 0.1}"] {
        files.write("scene.toml", format!("{SCENE}attach = [{attach}]"));
        files.refused(
            "scene.toml",
            &["garment.attach[0]", "no joint \"Tail\"", "Hips, Spine, Head"],
        );
    }

    let scene = SCENE.replace("body.glb\"", "body.glb\"\nclips = [\"run.bvh\"]");
    files.write("scene.toml", scene);
    let hierarchy = "HIERARCHY\nROOT Hips\n{\nOFFSET 0 0 0\nCHANNELS 3 Xposition Yposition \
                     Zposition\nJOINT Tail\n{\nOFFSET 0 1 0\nCHANNELS 1 Xrotation\nEnd Site\n{\n\
                     OFFSET 0 1 0\n}\n}\n}\nMOTION\nFrames: 1\nFrame Time: 0.0333\n";
    files.write("run.bvh", format!("{hierarchy}0 0 0 0\n"));
    files.refused("run.bvh", &["joint \"Spine\" is missing"]);
    files.write("run.bvh", format!("{hierarchy}0 0 0 nan\n"));
    files.refused("run.bvh", &["frame 0, joint \"Tail\"", "nan"]);
    files.write("run.bvh", format!("{hierarchy}0 0 0\n"));
    files.refused("run.bvh", &["line 19", "the file ends"]);
}

#[test]
fn clips_with_nan_are_refused() {
    let mut glb = Glb::default();
    glb.path[7][1] = f32::NAN;
    let files = Files::new();
    files.write("body.glb", glb.bytes());
    files.refused("body.glb", &["clip \"go\"", "joint \"Hips\"", "key 7", "NaN"]);
}

#[test]
fn endless_clips_are_refused() {
    let files = Files::new();
    files.write("body.glb", Glb { key_s: 1e30, ..Default::default() }.bytes());
    files.refused("body.glb", &["clip \"go\"", "frames"]);
}

#[test]
fn motion_that_poses_cannot_hold_is_refused() {
    let files = Files::new();
    files.write("body.glb", Glb { animated: 0, ..Default::default() }.bytes());
    files.refused("body.glb", &["\"Armature\" above the root joint", "bake"]);
    files.write("body.glb", Glb { animated: 2, ..Default::default() }.bytes());
    files.refused("body.glb", &["clip \"go\"", "joint 1 moves in its parent"]);
}

#[test]
fn motion_graphs_that_cannot_be_played_are_refused() {
    let files = Files::new();
    let with = |transitions: &str| {
        let head = r#"{"fps": 30, "clips": [{"name": "go", "frames": 60}], "transitions": ["#;
        format!("{head}{transitions}]}}")
    };
    let way = |from: usize, clip: &str, to: usize| {
        format!(
            r#"{{"from_clip": "go", "from_frame": {from}, "to_clip": "{clip}", "to_frame": {to}}}"#
        )
    };
    let refused = |transitions: &str, words: &[&str]| {
        files.write("graph.json", with(transitions));
        files.refused("graph.json", words);
    };
    refused("", &["no cycle", "add transitions"]);
    refused(&way(20, "go", 40), &["no cycle"]);
    refused(&way(60, "go", 0), &["transition 0 (go 60 -> go 0)", "outside"]);
    refused(&way(50, "jog", 0), &["\"jog\"", "no such clip"]);
    refused(&way(50, "go", 57), &["2 frames left"]);
    refused(&[way(50, "go", 0), way(50, "go", 0)].join(","), &["transition 1", "twice"]);
    files.write("graph.json", GRAPH.replace("\"frames\": 60", "\"frames\": 61"));
    files.refused("graph.json", &["\"go\"", "60 frames", "61"]);
    files.write("graph.json", GRAPH.replace("\"fps\": 30", "\"fps\": 25"));
    files.refused("graph.json", &["25 fps", "30"]);
    files.write("graph.json", "{");
    files.refused("graph.json", &["not a motion graph", "line 1"]);
}

#[test]
fn unfit_garments_are_refused() {
    let files = Files::new();
    let refused = |obj: String, words: &[&str]| {
        files.write("tube.obj", obj);
        files.refused("tube.obj", words);
    };
    let good = tube(0.275);
    let flap = "v 0.5 0.9 0.0\n";
    refused(format!("{good}{flap}f 6 1 9\n"), &["edge 0-5 is not manifold", "(near ["]);
    refused(format!("{good}{flap}f 1 2 9\n"), &["edge 0-1", "inconsistently", "normals"]);
    refused(format!("{good}v 1 1 1\nv 1 2 1\nv 1 3 1\nf 9 10 11\n"), &["degenerate", "triangle 8"]);
    refused(tube(0.275).replace("f ", "# "), &["0 triangles"]);
    refused(tube(0.2), &["8 vertices are inside the body", "vertex 0", "55.0 mm"]);
    let flipped: String = good
        .lines()
        .map(|line| match line.strip_prefix("f ") {
            Some(face) => {
                let corners: Vec<&str> = face.split(' ').rev().collect();
                format!("f {}\n", corners.join(" "))
            }
            None => format!("{line}\n"),
        })
        .collect();
    refused(flipped, &["inverted", "100 %", "flip the normals"]);
    refused("f 1 2 3\n".to_owned(), &["line 1", "vertex 1", "OBJ"]);
    refused(good.replace("f 1", "f 99"), &["line 9", "vertex 99"]);
    files.write("scene.toml", format!("{SCENE}edge_length_m = 0.00001"));
    files.write("tube.obj", good);
    files.refused("tube.obj", &["edge_length_m", "vertices"]);
}

#[test]
fn scene_files_say_key_and_remedy() {
    let files = Files::new();
    let refused = |text: String, words: &[&str]| {
        files.write("scene.toml", text);
        files.refused("scene.toml", words);
    };
    refused(format!("{SCENE}[garment]\nfile = \"b.obj\""), &["given 2 times", "exactly one"]);
    let two = SCENE.replace("[garment]", "[[garment]]");
    refused(format!("{two}[[garment]]\nfile = \"b.obj\""), &["given 2 times"]);
    refused(format!("{SCENE}colour = 3"), &["colour"]);
    refused(format!("speed = 3\n{SCENE}"), &["line 1", "speed"]);
    refused(SCENE.replace("\"box\"", "7"), &["line 2", "string"]);
    refused(SCENE.replace("box", ""), &["name", "1 to 256"]);
    refused(SCENE.replace("[character]", "fps = 1\n[character]"), &["fps", "5 to 240"]);
    let computed = SCENE.replace("file = \"graph.json\"", "");
    refused(computed.clone(), &["motion_graph", "exactly one of file, threshold_m, reach_s"]);
    refused(
        format!("{SCENE}[garment.material]\ndensity = -1"),
        &["garment.material.density", "-1"],
    );
    refused(format!("{SCENE}[exploration]\nround_jobs = 0"), &["exploration.round_jobs"]);
    refused(format!("{SCENE}attach = [{{near = \"Head\"}}]"), &["garment.attach[0]", "within_m"]);
    let start = SCENE.replace("[character]", "start = {clip = \"go\", frame = 2}\n[character]");
    refused(start, &["start", "frame 2", "largest component"]);
    refused(SCENE.replace("body.glb", "$TOILE_DATA/body.glb"), &["TOILE_DATA"]);
    files.write("scene.toml", SCENE.replace("body.glb", "nobody.glb"));
    files.refused("nobody.glb", &["character.file"]);
    files.write("scene.toml", computed.replace("[garment]", "threshold_m = 0.2\n[garment]"));
    let loaded = files.load().unwrap();
    assert!(loaded.graph.unwrap().transitions > 0 && loaded.asked.is_none());
    // What was asked for and what the whole scene then has, worst of each clip included.
    let reach = "reach_s = 9.0\nreach_clips = [\"go\"]\n[garment]";
    files.write("scene.toml", computed.replace("[garment]", reach));
    let report = check::report(&files.load().unwrap()).unwrap();
    let asked = report.reach_asked.as_ref().unwrap();
    assert_eq!((asked.asked_s, &asked.clips[..]), (9.0, &["go".to_owned()][..]));
    assert!(asked.met && asked.reach.median_s <= 9.0, "{report}");
    assert_eq!(report.reach_by_clip.len(), report.clips.len());
    let worst = report.reach_by_clip.iter().map(|clip| clip.reach.worst_s);
    assert!(worst.fold(0.0, f32::max).total_cmp(&report.reach.worst_s).is_eq(), "{report}");
    assert!(report.to_string().contains("asked for among go: "), "{report}");
}

#[test]
fn a_garment_may_be_a_gltf_mesh() {
    let surface = garment::Surface::read(Path::new("body.glb"), &Glb::default().bytes()).unwrap();
    assert_eq!((surface.positions.len(), surface.triangles.len()), (8, 12));
    assert!(surface.boundary_loops().is_empty());
}

#[test]
fn every_truncation_of_a_character_is_an_error() {
    let bytes = Glb::default().bytes();
    for length in 0..bytes.len() {
        assert!(read_character(&bytes[..length], None, 30.0).is_err());
    }
}

proptest! {
    #[test]
    fn damaged_characters_never_panic(
        damage in proptest::collection::vec((0usize..6000, any::<u8>()), 1..6),
    ) {
        let mut bytes = Glb::default().bytes();
        for (at, value) in damage {
            let at = at % bytes.len();
            bytes[at] = value;
        }
        let _ = read_character(&bytes, None, 30.0);
    }

    #[test]
    fn changed_numbers_in_the_json_never_panic(digit in 0usize..400, new in 0u8..10) {
        let mut bytes = Glb::default().bytes();
        let json_end = bytes.windows(4).position(|w| w == b"BIN\0").unwrap();
        let digits: Vec<usize> =
            (20..json_end).filter(|at| bytes[*at].is_ascii_digit()).collect();
        bytes[digits[digit % digits.len()]] = b'0' + new;
        let _ = read_character(&bytes, None, 30.0);
    }

    #[test]
    fn garbage_motion_and_garments_never_panic(text in "[ -~\n]{0,200}") {
        let _ = Bvh::parse(&text);
        let _ = Bvh::parse(&format!("HIERARCHY\nROOT a\n{{\nOFFSET 0 0 0\n{text}"));
        let _ = garment::Surface::read(Path::new("a.obj"), text.as_bytes());
        let _ = garment::Surface::read(Path::new("a.obj"), format!("v 1 2 3\nf {text}").as_bytes());
        let _ = GraphFile::parse(&text);
        let _ = SceneFile::parse(&text);
    }
}

#[test]
fn regions_metric_and_classes_are_resolved_or_refused_by_name() {
    let class = "[[exploration.class]]\nname = \"collar\"\nregion = \"top\"\njoint = \"Head\"\n\
        axis = [0.0, 2.0, 0.0]\nthreshold_m = 0.1\nvalues = [\"down\", \"up\"]\n\
        implausible = [\"down\", \"up\"]\npenalty_mm = 500.0\n";
    let metric = "[exploration.metric]\nnorm = \"rms\"\n\
        weights = [{ region = \"top\", weight = 2.0 }]\n";
    let whole = format!(
        "{SCENE}edge_length_m = 0.1\n[garment.regions]\ntop = [{{ loop_near = \"Head\" }}]\n\
         {metric}{class}"
    );
    let files = Files::new();
    files.write("scene.toml", &whole);
    let scene = files.load().unwrap().scene;
    let rule = &scene.metric.classes[0];
    assert_eq!(scene.metric.norm, crate::scene::Norm::Rms);
    assert_eq!(scene.metric.weights.len(), scene.garment.positions.len());
    assert!(
        rule.vertices.len() > 16
            && rule.vertices.iter().all(|v| {
                scene.garment.positions[*v as usize].y > 1.19
                    && (scene.metric.weights[*v as usize] - 2.0).abs() < 1e-6
            })
    );
    assert_eq!((rule.joint, rule.implausible, rule.axis), (2, [0, 1], Vec3::Y));
    assert!((rule.penalty_m - 0.5).abs() < 1e-6);
    for (from, to, words) in [
        ("region = \"top\"\njoint", "region = \"hem\"\njoint", ["class[0].region", "\"hem\""]),
        ("joint = \"Head\"", "joint = \"Tail\"", ["class[0].joint", "Tail"]),
        ("[\"down\", \"up\"]\npenalty", "[\"down\", \"off\"]\npenalty", ["implausible", "off"]),
        ("[0.0, 2.0, 0.0]", "[0.0, 0.0, 0.0]", ["class[0].axis", "range"]),
        ("weight = 2.0", "weight = -1.0", ["weights[0].weight", "range"]),
        ("norm = \"rms\"", "norm = \"mean\"", ["norm", "mean"]),
        ("{ loop_near = \"Head\" }", "{ near = \"Head\" }", ["garment.regions.top[0]", "within_m"]),
        ("{ loop_near", "{ offset_m = [0.0, 1.0, 0.0], loop_near", ["regions.top[0]", "offset_m"]),
    ] {
        assert!(whole.contains(from), "{from}");
        files.write("scene.toml", whole.replacen(from, to, 1));
        files.refused("scene.toml", &words);
    }
    for frames in ["0", "10001", "2147483648"] {
        files.write("scene.toml", format!("{SCENE}[exploration]\ndrape_frames = {frames}\n"));
        files.refused("scene.toml", &["exploration.drape_frames", "1 to 10000"]);
    }
    files.write("scene.toml", format!("{SCENE}[simulator]\ncommand = []\n"));
    files.refused("scene.toml", &["simulator.command", "program"]);
}

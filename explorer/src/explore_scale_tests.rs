//! Explorations under stress: killed a hundred times, on a full disk, steered, certified, large.

use std::io::BufRead;
use std::process::{Command, Stdio};

use cloth::Vec3;
use rand_core::{Rng, SeedableRng};

use super::*;
use crate::certificate::{certify, replay};
use crate::grid::GridState;
use crate::grow::archive::Archive;
use crate::grow::policy::{WalkModel, visits};
use crate::scene::ClassRule;
use crate::simulator::{Frame, FrameQuality, SimulateError, Simulator};

const FRAMES: u64 = 1500;

/// What a child of this test binary explores, when it is asked to.
fn child_place(folder: &Path) -> Place {
    let root = folder.join("store");
    Place {
        store: crate::pack::local_store(&root).unwrap(),
        folder: Some(root),
        key: SigningKey::from_seed(&[3; 32]),
        work: folder.join("work"),
    }
}

fn slow_scene() -> Scene {
    let mut scene = toy_scene();
    scene.exploration.publish_every_frames = 150;
    scene
}

/// A disk that may be filled, and a journal that is compacted many times over.
fn scarce() -> ExploreOptions {
    ExploreOptions { keep_free_bytes: 0, journal_tail_bytes: 1500, ..options(FRAMES) }
}

/// Not a test of its own: the process that the tests below start, kill and starve.
#[test]
fn child() {
    let Some(folder) = std::env::var_os("TOILE_TEST_CHILD") else { return };
    let options = ExploreOptions { workers: 2, ..scarce() };
    let mut said = |progress: &Progress| println!("reported {}", progress.states);
    let place = child_place(Path::new(&folder));
    let (scene, toy) = (slow_scene(), Toy::new(150));
    match block_on(super::super::explore(&scene, &toy, &place, &options, &mut said)) {
        Ok(summary) => println!("ended {:?} at {}", summary.end, summary.simulated_frames),
        Err(error) => println!("failed: {error}"),
    }
}

fn start_child(folder: &Path, before: &str) -> std::process::Child {
    let test = std::env::current_exe().unwrap();
    let line = format!(
        "{before} exec '{}' --exact explore::tests::scale::child --nocapture --test-threads=1",
        test.display()
    );
    Command::new("sh")
        .args(["-c", &line])
        .env("TOILE_TEST_CHILD", folder)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

/// The largest number of states reported as done, and the last line.
fn read_reports(child: &mut std::process::Child) -> (u64, String) {
    let lines = std::io::BufReader::new(child.stdout.take().unwrap()).lines();
    let (mut reported, mut last) = (0, String::new());
    for line in lines.map_while(Result::ok) {
        if let Some(states) = line.trim().strip_prefix("reported ") {
            // The last line of a killed child may be cut.
            reported = reported.max(states.parse().unwrap_or(0));
        }
        if line.starts_with("ended") || line.starts_with("failed") {
            last = line;
        }
    }
    (reported, last)
}

fn whole_run(folder: &Path) -> std::collections::BTreeMap<PathBuf, Vec<u8>> {
    let options = scarce();
    let place = child_place(folder);
    let (scene, toy, mut quiet) = (slow_scene(), Toy::new(150), |_: &Progress| {});
    block_on(super::super::explore(&scene, &toy, &place, &options, &mut quiet)).unwrap();
    durable(folder)
}

/// Everything but the count of CPU seconds.
fn durable(folder: &Path) -> std::collections::BTreeMap<PathBuf, Vec<u8>> {
    let mut files = tree(folder);
    files.retain(|name, _| !name.ends_with("simulate_cpu_s"));
    files
}

#[cfg(unix)]
#[test]
fn killed_a_hundred_times_it_loses_nothing_that_it_reported() {
    let whole = tempfile::tempdir().unwrap();
    let expected = whole_run(whole.path());
    let folder = tempfile::tempdir().unwrap();
    let mut random = rand_pcg::Pcg64Mcg::seed_from_u64(11);
    let (mut kills, mut ends) = (0, 0);
    while kills < 100 {
        let mut child = start_child(folder.path(), "");
        let patience = std::time::Duration::from_micros(4_000 + random.next_u64() % 60_000);
        std::thread::sleep(patience);
        let _ = child.kill();
        let (reported, last) = read_reports(&mut child);
        let _ = child.wait();
        kills += 1;
        if folder.path().join("work/journal").exists() {
            let scene = slow_scene();
            let work = Work::open(&folder.path().join("work"), &scene, false).unwrap();
            assert!(work.graph().next_id().0 >= reported, "kill {kills}: {reported} reported");
        }
        if last.starts_with("ended Frames") {
            // It got there before its kill: the rest of the kills hit another folder.
            ends += 1;
            assert!(durable(folder.path()) == expected);
            std::fs::remove_dir_all(folder.path().join("work")).unwrap();
            std::fs::remove_dir_all(folder.path().join("store")).unwrap();
        }
    }
    let mut child = start_child(folder.path(), "");
    let (_, last) = read_reports(&mut child);
    child.wait().unwrap();
    assert!(last.starts_with("ended Frames"), "{last} after {ends} ends");
    assert!(durable(folder.path()) == expected);
}

#[cfg(unix)]
#[test]
fn a_disk_that_fills_up_ends_the_run_in_words_and_loses_nothing() {
    let whole = tempfile::tempdir().unwrap();
    let expected = whole_run(whole.path());
    let folder = tempfile::tempdir().unwrap();
    let mut failures = 0;
    // No file may grow beyond so many blocks: writes fail as on a full disk.
    for blocks in [8, 16, 32, 48, 64, 80] {
        let limit = format!("trap '' XFSZ; ulimit -f {blocks};");
        let mut child = start_child(folder.path(), &limit);
        let (reported, last) = read_reports(&mut child);
        child.wait().unwrap();
        assert!(!last.is_empty(), "it ended in words at {blocks} blocks");
        failures += u32::from(last.starts_with("failed"));
        assert!(!last.contains("panicked"), "{last}");
        if folder.path().join("work/journal").exists() {
            let work = Work::open(&folder.path().join("work"), &slow_scene(), false).unwrap();
            assert!(work.graph().next_id().0 >= reported);
        }
    }
    assert!(failures >= 2, "{failures}");
    let mut child = start_child(folder.path(), "");
    let (_, last) = read_reports(&mut child);
    child.wait().unwrap();
    assert!(last.starts_with("ended Frames"), "{last}");
    assert!(durable(folder.path()) == expected);
}

#[test]
fn it_stops_short_of_a_full_disk_and_goes_on_when_there_is_room() {
    let (scene, toy) = (toy_scene(), Toy::new(150));
    let folder = tempfile::tempdir().unwrap();
    let mut store = Memory::default();
    let short = ExploreOptions { keep_free_bytes: u64::MAX / 2, ..options(100) };
    let summary = explore(&scene, &toy, (folder.path(), &mut store), &short).unwrap();
    if cfg!(unix) {
        assert_eq!((summary.end, summary.simulated_frames), (End::Disk, 0));
    }
    let summary = explore(&scene, &toy, (folder.path(), &mut store), &options(100)).unwrap();
    assert_eq!(summary.end, End::Frames);
}

#[test]
fn every_merge_is_certified_and_replays_to_the_same_number() {
    let (scene, toy) = (toy_scene(), Toy::new(150));
    let folder = tempfile::tempdir().unwrap();
    explore(&scene, &toy, (folder.path(), &mut Memory::default()), &options(400)).unwrap();
    let archive = Archive::open(folder.path(), &scene).unwrap();
    let walked = [(EdgeId(2), 77)].into_iter().collect();
    let certificate = certify(&archive, &scene, archive.shown(), &walked);
    let stats = archive.view(archive.shown()).stats();
    assert_eq!(certificate.merges.len() as u64, stats.merges);
    assert_eq!(certificate.worst_error_mm, 1e3 * f64::from(stats.worst_error_m));
    let passed: f64 = certificate.merges.iter().map(|merge| merge.visits).sum();
    assert!(passed > 0.0 && passed <= 1.0 + 1e-9, "{passed}");
    assert!(certificate.merges.iter().all(|m| m.walked == if m.edge == 2 { 77 } else { 0 }));
    let all = replay(&archive, &certificate, (&toy, 2), usize::MAX, &|_| {}).unwrap();
    assert_eq!(all.replayed as usize, certificate.merges.len());
    assert_eq!((all.largest_difference_mm, all.states_differing), (0.0, 0));
    let some = replay(&archive, &certificate, (&toy, 1), 5, &|_| {}).unwrap();
    assert_eq!(some.replayed, 5);
    // Another simulator than the one on record is found out.
    let other = replay(&archive, &certificate, (&Toy::new(149), 1), 20, &|_| {}).unwrap();
    assert!(other.states_differing > 0 && other.largest_difference_mm > 0.0);
}

fn classes(scene: &mut Scene, penalty_m: f32) {
    scene.metric.classes = vec![ClassRule {
        name: "first".into(),
        values: ["left".into(), "right".into()],
        joint: 0,
        vertices: vec![0],
        axis: Vec3::X,
        threshold_m: 0.0,
        implausible: [0, 1],
        penalty_m,
    }];
}

#[test]
fn implausible_merges_are_undone_first_and_errors_stay_free_of_the_penalty() {
    let mut found = Vec::new();
    for penalty_m in [0.0, 5.0] {
        let mut scene = toy_scene();
        classes(&mut scene, penalty_m);
        let folder = tempfile::tempdir().unwrap();
        let place = (folder.path(), &mut Memory::default());
        let summary = explore(&scene, &Toy::new(200), place, &options(600)).unwrap();
        assert_eq!(summary.classes.len(), 2, "{:?}", summary.classes);
        assert!(summary.classes.iter().map(|c| c.states).sum::<u64>() == summary.states);
        assert!(summary.worst_error_mm < 2000.0, "{}", summary.worst_error_mm);
        let archive = Archive::open(folder.path(), &scene).unwrap();
        let certificate = certify(&archive, &scene, archive.graph().commit(), &[].into());
        let crossing = |m: &&crate::certificate::Merge| {
            m.class == "first left" && m.target_class == "first right"
        };
        let merges: Vec<_> = certificate.merges.iter().filter(crossing).collect();
        assert!(merges.iter().all(|m| m.penalty_mm == f64::from(penalty_m) * 1e3));
        assert!(summary.best_worst_cost_mm >= summary.best_worst_error_mm);
        assert!(certificate.bifurcations.iter().all(|b| b.from != b.to));
        assert!(certificate.bifurcations.iter().any(|b| b.crossings > 0 && !b.walks.is_empty()));
        if penalty_m > 0.0 {
            assert_eq!(summary.implausible_merges, merges.len() as u64);
        }
        found.push(merges.len());
    }
    assert!(found[1] <= found[0], "{found:?}");
}

/// A merge into a flagged state says so, and its penalty is that of its classes alone.
#[test]
fn the_flag_is_no_penalty_of_a_class() {
    let (scene, mut found) = (toy_scene(), 0);
    for edge in 0..scene.primary.edges().len() as u32 {
        // By this much the first frame of all comes out on an odd place, which is pose 1's only state.
        let toy = Toy { doubtful: Some(EdgeId(edge)), ..Toy::new(150) };
        let folder = tempfile::tempdir().unwrap();
        let place = (folder.path(), &mut Memory::default());
        let summary = explore(&scene, &toy, place, &options(1)).unwrap();
        let archive = Archive::open(folder.path(), &scene).unwrap();
        let certificate = certify(&archive, &scene, archive.graph().commit(), &[].into());
        assert!(certificate.merges.iter().all(|m| m.penalty_mm == 0.0));
        let into_flagged = certificate.merges.iter().filter(|m| m.into_flagged).count() as u64;
        assert_eq!(into_flagged, summary.merges_into_flagged);
        assert!(into_flagged == 0 || summary.best_worst_cost_mm > 1e5);
        found += into_flagged;
    }
    assert!(found > 0, "the toy must flag a pose's only state");
}

/// Two long ways that part and meet: what the computed visits say is what a long walk meets.
#[test]
fn visits_are_what_a_long_random_walk_meets() {
    let (short, long) = (40, 53);
    let mut edges: Vec<(u32, u32)> = (0..short + long).map(|p| (p, p + 1)).collect();
    edges.extend([(short, 0), (0, short + 1), (short + long, 0)]);
    edges.retain(|way| *way != (short, short + 1));
    edges.sort_unstable();
    let mut scene = toy_scene();
    scene.primary = std::sync::Arc::new(toy::primary(short + long + 1, &edges));
    scene.exploration.depth_frames = 30;
    let folder = tempfile::tempdir().unwrap();
    let place = (folder.path(), &mut Memory::default());
    explore(&scene, &Toy::new(252), place, &options(3000)).unwrap();
    let archive = Archive::open(folder.path(), &scene).unwrap();
    let graph = archive.graph();
    let visits = visits(graph, &WalkModel::uniform(&scene.primary), &[]);
    let mut random = rand_pcg::Pcg64Mcg::seed_from_u64(5);
    let (mut met, mut at, steps) = (vec![0u32; visits.len()], StateId(0), 6_000_000);
    for _ in 0..steps {
        let ways: Vec<EdgeId> = scene.primary.out_edges(graph.state(at).pose).collect();
        let slot = (random.next_u64() % ways.len() as u64) as usize;
        let (edge, next) = (ways[slot], graph.next(at).get(slot).unwrap());
        if matches!(graph.state(next).kind, Kind::DeadEnd { .. }) {
            met[next.index()] += 1;
        }
        at = graph.follow(at, edge).unwrap();
    }
    let (mut sum, mut sum_met) = (0.0, 0.0);
    for (state, _) in graph.queue().iter() {
        let (expected, met) = (visits[state.index()], f64::from(met[state.index()]) / 6e6);
        let worst = 0.05 * expected + 3e-5;
        assert!((expected - met).abs() < worst, "{state}: {expected} computed, {met} met");
        (sum, sum_met) = (sum + expected, sum_met + met);
    }
    println!("{} states: {sum} merges a frame computed, {sum_met} met", graph.states().len());
    assert!((sum / sum_met - 1.0).abs() < 0.01, "{sum} computed, {sum_met} met");
}

/// The error that players of this model see on average (m).
fn seen(folder: &Path, scene: &Scene, model: &WalkModel) -> f64 {
    let archive = Archive::open(folder, scene).unwrap();
    let visits = visits(archive.graph(), model, &[]);
    let errors = archive.graph().queue().iter();
    errors.map(|(state, error_m)| f64::from(error_m) * visits[state.index()]).sum()
}

#[test]
fn what_players_walk_is_explored_first_and_one_cheat_changes_little() {
    let scene = toy_scene();
    let walk = |ways: &[(u32, u32)], count: u64| {
        let edge = |(from, to): &(u32, u32)| {
            let leads = |e: &EdgeId| scene.primary.edge(*e).to.0 == *to;
            let edge = scene.primary.out_edges(protocol::PoseId(*from)).find(leads).unwrap();
            (edge, count)
        };
        ways.iter().map(edge).collect::<Vec<_>>()
    };
    let honest = walk(&[(0, 1), (1, 2), (2, 0)], 900);
    let absurd = [honest.clone(), walk(&[(4, 5), (3, 0)], u64::MAX / 4)].concat();
    let run = |policy, batch: &[(EdgeId, u64)]| {
        let folder = tempfile::tempdir().unwrap();
        let counts = batch.iter().copied().collect();
        let mut store = Memory { walked: vec![Walked { newest: 1, counts }], ..Memory::default() };
        let options = ExploreOptions { policy, ..options(260) };
        let place = (folder.path(), &mut store);
        explore(&scene, &Toy::new(200), place, &options).unwrap();
        folder
    };
    let mut model = WalkModel::uniform(&scene.primary);
    model.add(&honest);
    let seen = |folder: &tempfile::TempDir| seen(folder.path(), &scene, &model);
    let greedy = seen(&run(Policy::Greedy, &honest));
    let visited = run(Policy::Visited, &honest);
    let cheated = run(Policy::Visited, &absurd);
    let (steered, misled) = (seen(&visited), seen(&cheated));
    println!("seen by players: greedy {greedy}, visited {steered}, with a cheat {misled}");
    assert!(steered < greedy, "{steered} against {greedy}");
    assert!(misled < 1.25 * steered + 1e-4, "{misled} against {steered}");
    // The record holds what steered, so that a resumed run chooses the same.
    let archive = Archive::open(visited.path(), &scene).unwrap();
    assert_eq!(archive.ledger().steering().telemetry(), 1);
    assert_eq!(archive.ledger().steering().policy(), Policy::Visited);
    let summary = explore(
        &scene,
        &Toy::new(200),
        (visited.path(), &mut Memory::default()),
        &ExploreOptions { policy: Policy::Predictive, ..options(2000) },
    )
    .unwrap();
    assert_eq!((summary.policy, summary.end), (Policy::Predictive, End::Frames));
}

#[test]
fn a_clip_that_is_not_there_is_named_with_those_that_are() {
    let folder = tempfile::tempdir().unwrap();
    let options = ExploreOptions { clips: vec!["tango".into()], ..options(10) };
    let place = (folder.path(), &mut Memory::default());
    let error = explore(&toy_scene(), &Toy::new(9), place, &options).unwrap_err().to_string();
    assert!(error.contains("\"tango\"") && error.contains("toy"), "{error}");
}

#[test]
fn it_stops_by_itself_at_the_error_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    let options = ExploreOptions { error_m: Some(0.05), ..ExploreOptions::default() };
    let place = (folder.path(), &mut Memory::default());
    let summary = explore(&toy_scene(), &Toy::new(60), place, &options).unwrap();
    assert_eq!(summary.end, End::Error);
    assert!(summary.best_worst_error_mm <= 50.0, "{}", summary.best_worst_error_mm);
}

/// `cargo test --release -p explorer --lib -- --ignored --nocapture very_large`; `TOILE_STATES` states
/// (100,000 unless given) of a simulator that costs nothing, with as many landmarks as a garment has.
#[test]
#[ignore = "takes minutes; prints times"]
fn very_large_folders_are_resumed_quickly() {
    let wanted = std::env::var("TOILE_STATES").map_or(100_000, |n| n.parse().unwrap());
    let mut scene = toy_scene();
    scene.exploration.depth_frames = 100;
    scene.exploration.round_jobs = 8;
    scene.exploration.publish_every_frames = u64::MAX;
    scene.garment.positions = (0..24).map(|v| Vec3::new(v as f32, 0.0, 0.0)).collect();
    // As many poses as a dozen clips have, and twelve ways between clips.
    let (clips, length) = (12, 250);
    let ring = (0..clips * length).map(|p| (p, (p + 1) % (clips * length)));
    let ways = (0..clips).map(|c| (c * length + 200, (c * 7 + 5) % clips * length + 10));
    let mut edges: Vec<(u32, u32)> = ring.chain(ways).collect();
    edges.sort_unstable();
    scene.primary = std::sync::Arc::new(toy::primary(clips * length, &edges));
    let folder = tempfile::tempdir().unwrap();
    let long = ExploreOptions { paper: true, best_prefix_at_end: false, ..options(wanted) };
    let mut done = 0;
    // Twice as long each time: what grows is seen.
    for frames in [wanted / 8, wanted / 4, wanted / 2, wanted] {
        let options = ExploreOptions { frames: Some(frames), ..long.clone() };
        let clock = Instant::now();
        let work = Work::open(folder.path(), &scene, true).unwrap();
        let resumed_s = clock.elapsed().as_secs_f64();
        let rounds = work.ledger().round().number;
        let before = (work.journal().bytes(), work.journal().tail_bytes());
        let setup = Setup {
            scene: &scene,
            simulators: &Wide(24),
            work: folder.path(),
            folder: None,
            options: &options,
        };
        let mut store = Unread::default();
        let clock = Instant::now();
        let explored = block_on(run(setup, work, &mut store, &mut |_| {})).unwrap();
        let wall_s = clock.elapsed().as_secs_f64();
        let work = Work::open(folder.path(), &scene, true).unwrap();
        let made = work.ledger().round().number - rounds;
        println!(
            "from {done} states, resumed in {resumed_s:.2} s (journal {} bytes, {} of them not packed), \
             to {}: {:.1} ms a round, {:.3} ms a frame",
            before.0,
            before.1,
            explored.states,
            1e3 * wall_s / made.max(1) as f64,
            1e3 * wall_s / (explored.states - done) as f64,
        );
        done = explored.states;
        measure_search(&work, done);
    }
}

fn measure_search(work: &Work, states: u64) {
    let (clock, searches) = (Instant::now(), 200);
    let mut among = 0;
    for id in (0..searches).map(|at| StateId(at * states / searches)) {
        let state = work.states().read(id).unwrap();
        let known = work.graph().interior(work.graph().state(id).pose);
        let found = work.similar().nearest(work.states(), (&state, 0), known, f32::INFINITY);
        assert!(found.unwrap().is_some());
        among += known.len() as u64;
    }
    let search_ms = clock.elapsed().as_secs_f64() * 1e3 / searches as f64;
    let (look, model) = (Instant::now(), WalkModel::uniform(work.graph().primary()));
    let cold = visits(work.graph(), &model, &[]);
    let cold_s = look.elapsed().as_secs_f64();
    let again = visits(work.graph(), &model, &cold[..cold.len() * 49 / 50]);
    let apart: f64 = cold.iter().zip(&again).map(|(a, b)| (a - b).abs()).sum();
    println!(
        "  visits in {cold_s:.3} s, in {:.3} s from those of 98 % of the states, {apart:.1e} apart",
        look.elapsed().as_secs_f64() - cold_s
    );
    let [now, peak] = ["VmRSS:", "VmHWM:"].map(memory_mb);
    println!(
        "  {} bytes of journal; a search at a place taken at random, among {}: {:.2} ms; memory {now:.0} MB \
         (peak {peak:.0}), {:.1} of it landmarks",
        work.journal().bytes(),
        among / searches,
        search_ms,
        work.similar().landmark_bytes() as f64 / 1e6,
    );
}

/// A store that takes everything and keeps nothing.
#[derive(Default)]
struct Unread(u64);

impl Publish for Unread {
    fn head(&self) -> (Option<VersionNumber>, u64) {
        ((self.0 > 0).then_some(VersionNumber(self.0)), 0)
    }

    async fn publish(&mut self, _: &dyn GraphView, _: bool) -> Result<VersionNumber, PublishError> {
        self.0 += 1;
        Ok(VersionNumber(self.0))
    }

    async fn walked(&self, after: u64) -> Result<Walked, object_store::Error> {
        Ok(Walked { newest: after, ..Walked::default() })
    }

    async fn tagged(&self, after: u64) -> Result<Tagged, object_store::Error> {
        Ok(Tagged { newest: after, ..Tagged::default() })
    }
}

/// So many vertices that never settle: no two trajectories come together.
struct Wide(usize);

impl Simulator for Wide {
    fn step(&mut self, state: &GridState, edge: EdgeId) -> Result<Frame, SimulateError> {
        let mut next = state.clone();
        let rows = next.positions.iter_mut().chain(&mut next.velocities);
        for (place, value) in (0u32..).zip(rows.flatten()) {
            let mixed =
                (*value as u32 ^ edge.0 << 16).wrapping_add(place).wrapping_mul(0x9e37_79b9);
            *value = ((mixed ^ mixed >> 15).wrapping_mul(0x85eb_ca6b) >> 19) as i16 - 4096;
        }
        let quality = FrameQuality { frames: 1, ..FrameQuality::default() };
        Ok(Frame { state: next, quality })
    }

    fn drape(&mut self, _should_stop: &dyn Fn() -> bool) -> Result<Frame, SimulateError> {
        let state = GridState { positions: vec![[0; 3]; self.0], velocities: vec![[0; 3]; self.0] };
        Ok(Frame { state, quality: FrameQuality::default() })
    }
}

impl SimulatorFactory for Wide {
    fn simulator(&self) -> Box<dyn Simulator> {
        Box::new(Wide(self.0))
    }
}

/// Memory of this process by a line of its status (MB), where the system tells it.
fn memory_mb(line: &str) -> f64 {
    let text = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let found = text.lines().find_map(|l| l.strip_prefix(line));
    let kilobytes = found.and_then(|rest| rest.split_whitespace().next()?.parse::<f64>().ok());
    kilobytes.unwrap_or(0.0) / 1e3
}

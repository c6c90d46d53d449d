//! Whole explorations with toy simulators and a store in memory: any number of workers, killed
//! anywhere, with and without `--paper`.

// Figures are compared with where they come from: equal means equal.
#![allow(clippy::float_cmp)]

use std::sync::atomic::{AtomicU64, Ordering};

use protocol::links::LinkEntry;
use protocol::manifest::VersionStats;
use protocol::{EdgeId, StateId};

use super::*;
use crate::grow::graph::Kind;
use crate::grow::toy::{self, Toy};

/// A version as the store in memory keeps it.
#[derive(Debug, Clone, PartialEq)]
struct Version {
    links: Vec<LinkEntry>,
    stats: VersionStats,
    first_coordinates: Vec<f32>,
}

#[derive(Debug, Default, Clone, PartialEq)]
struct Memory {
    versions: Vec<Version>,
    /// What players walked, as batches.
    walked: Vec<Walked>,
    /// What people pointed at, in order.
    tags: Vec<StateId>,
}

impl Publish for Memory {
    fn head(&self) -> (Option<VersionNumber>, u64) {
        let number = self.versions.len() as u64;
        let states = self.versions.iter().map(|v| v.links.len()).max().unwrap_or(0);
        ((number > 0).then_some(VersionNumber(number)), states as u64)
    }

    async fn publish(
        &mut self,
        view: &dyn GraphView,
        _soon: bool,
    ) -> Result<VersionNumber, PublishError> {
        let links = view.links();
        let mut positions = vec![0.0; 3 * view.vertex_count()];
        let mut first_coordinates = Vec::new();
        for id in 0..links.len() as u64 {
            view.positions(StateId(id), &mut positions).unwrap();
            first_coordinates.push(positions[0]);
        }
        check_total(view, &links);
        let version = Version { links, stats: view.stats(), first_coordinates };
        if self.versions.last() != Some(&version) {
            self.versions.push(version);
        }
        Ok(VersionNumber(self.versions.len() as u64))
    }

    async fn tagged(&self, after: u64) -> Result<Tagged, object_store::Error> {
        let states = self.tags.iter().skip(after as usize).copied().collect();
        Ok(Tagged { newest: after.max(self.tags.len() as u64), states })
    }

    async fn walked(&self, after: u64) -> Result<Walked, object_store::Error> {
        let new = self.walked.iter().filter(|walked| walked.newest > after);
        let mut all = Walked { newest: after, ..Walked::default() };
        for walked in new {
            all.newest = walked.newest;
            all.counts.extend(&walked.counts);
        }
        Ok(all)
    }
}

/// Every link of a version leads to a playable state of the right pose; retired ones go on.
fn check_total(view: &dyn GraphView, links: &[LinkEntry]) {
    let playable = |state: StateId| match &links[state.index()] {
        LinkEntry::Interior { pose, .. } => *pose,
        other => panic!("{state} is not playable: {other:?}"),
    };
    let mut merges = 0;
    for entry in links {
        match entry {
            LinkEntry::Interior { next, .. } => {
                for next in next {
                    match &links[next.index()] {
                        LinkEntry::Interior { .. } => {}
                        LinkEntry::DeadEnd { target, .. } => _ = playable(*target),
                        LinkEntry::Retired { .. } => panic!("{next} is linked, but retired"),
                    }
                }
            }
            LinkEntry::DeadEnd { pose, target, .. } => {
                merges += 1;
                assert_eq!(playable(*target), *pose);
            }
            LinkEntry::Retired { pose, successor } => assert_eq!(playable(*successor), *pose),
        }
    }
    assert_eq!(view.stats().merges, merges);
    let covered: u64 = view.runs().iter().map(|run| u64::from(run.count)).sum();
    assert_eq!(covered, links.len() as u64);
}

fn options(frames: u64) -> ExploreOptions {
    ExploreOptions { frames: Some(frames), ..ExploreOptions::default() }
}

fn explore(
    scene: &Scene,
    toy: &Toy,
    (folder, store): (&Path, &mut Memory),
    options: &ExploreOptions,
) -> Result<Summary, ExploreError> {
    let setup = Setup { scene, simulators: toy, work: folder, folder: None, options };
    let work = Work::open(folder, scene, options.paper)?;
    block_on(run(setup, work, store, &mut |_| {}))
}

fn block_on<T>(future: impl Future<Output = T>) -> T {
    tokio::runtime::Builder::new_current_thread().build().unwrap().block_on(future)
}

fn toy_scene() -> Scene {
    toy::scene(toy::knot(), toy::settings())
}

fn files(folder: &Path) -> [Vec<u8>; 2] {
    ["journal", "states"].map(|name| std::fs::read(folder.join(name)).unwrap())
}

#[test]
fn one_two_and_four_workers_write_the_same_bytes() {
    let mut first = None;
    for workers in [1, 2, 4] {
        let folder = tempfile::tempdir().unwrap();
        let mut store = Memory::default();
        let options = ExploreOptions { workers, ..options(400) };
        let place = (folder.path(), &mut store);
        let summary = explore(&toy_scene(), &Toy::new(150), place, &options).unwrap();
        assert_eq!(summary.end, End::Frames);
        assert!(summary.simulated_frames >= 400);
        assert!(summary.best_worst_error_mm <= summary.worst_error_mm);
        let found = (files(folder.path()), store);
        assert!(found.1.versions.len() >= 4, "{}", found.1.versions.len());
        assert!(*first.get_or_insert_with(|| found.clone()) == found, "{workers} workers");
    }
}

/// Cuts the journal all along its length, with and without the version after in the store.
#[test]
fn killed_anywhere_it_goes_on_to_the_same_files_and_versions() {
    let (scene, toy, options) = (toy_scene(), Toy::new(150), options(160));
    let whole = tempfile::tempdir().unwrap();
    let mut store = Memory::default();
    explore(&scene, &toy, (whole.path(), &mut store), &options).unwrap();
    let [journal, states] = files(whole.path());
    let folder = tempfile::tempdir().unwrap();
    let path = |name| folder.path().join(name);
    let header_end = 12 + u32::from_le_bytes(journal[8..12].try_into().unwrap()) as usize + 8;
    for cut in (header_end..journal.len()).step_by(61) {
        std::fs::write(path("journal"), &journal[..cut]).unwrap();
        std::fs::write(path("states"), &states).unwrap();
        // What the store held then: every version on record, and perhaps the one after.
        let recorded = published_by(folder.path(), &scene);
        let ahead = [recorded, (recorded + 1).min(store.versions.len())];
        for held in ahead {
            std::fs::write(path("journal"), &journal[..cut]).unwrap();
            std::fs::write(path("states"), &states).unwrap();
            let mut versions = store.versions[..held].to_vec();
            let known = Work::open(folder.path(), &scene, false).unwrap().graph().next_id().0;
            if versions.last().is_some_and(|v| v.links.len() as u64 > known) {
                // That version could not have been published yet.
                versions.pop();
            }
            // States behind the journal's may be missing, torn or stale.
            let mut torn = states.clone();
            if cut % 2 == 0 {
                torn.truncate(64 + 36 * known as usize);
                torn.extend_from_slice(b"torn");
            }
            std::fs::write(path("states"), torn).unwrap();
            let mut resumed = Memory { versions, ..Memory::default() };
            explore(&scene, &toy, (folder.path(), &mut resumed), &options).unwrap();
            assert!(files(folder.path()) == [journal.clone(), states.clone()], "cut at {cut}");
            assert!(resumed == store, "cut at {cut}, {held} versions");
        }
    }
}

fn published_by(folder: &Path, scene: &Scene) -> usize {
    let work = Work::open(folder, scene, false).unwrap();
    work.ledger().published().map_or(0, |last| last.number.0 as usize)
}

#[test]
fn stopped_again_and_again_it_ends_as_if_it_had_not_been() {
    let (scene, toy) = (toy_scene(), Toy::new(150));
    let whole = tempfile::tempdir().unwrap();
    let mut store = Memory::default();
    explore(&scene, &toy, (whole.path(), &mut store), &options(200)).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let mut resumed = Memory::default();
    for attempt in 1.. {
        assert!(attempt < 500, "no progress");
        let asked = Arc::new(AtomicU64::new(0));
        let should_stop = Arc::new(move || asked.fetch_add(1, Ordering::Relaxed) >= 3);
        let options = ExploreOptions { workers: 2, should_stop, ..options(200) };
        let summary = explore(&scene, &toy, (folder.path(), &mut resumed), &options).unwrap();
        if summary.end == End::Frames {
            break;
        }
        assert_eq!(summary.end, End::Stopped);
    }
    assert!(files(folder.path()) == files(whole.path()));
    assert_eq!(resumed, store);
}

#[test]
fn an_end_that_is_reached_already_publishes_nothing_more() {
    let (scene, toy) = (toy_scene(), Toy::new(150));
    let folder = tempfile::tempdir().unwrap();
    let mut store = Memory::default();
    explore(&scene, &toy, (folder.path(), &mut store), &options(200)).unwrap();
    let before = (files(folder.path()), store.clone());
    explore(&scene, &toy, (folder.path(), &mut store), &options(200)).unwrap();
    assert!((files(folder.path()), store.clone()) == before);
    let head = store.versions.last().unwrap();
    let work = Work::open(folder.path(), &scene, false).unwrap();
    assert_eq!(Some(head.stats.worst_error_m), work.graph().best_worst_error_m());
    // And a longer exploration grows the same graph.
    let longer = tempfile::tempdir().unwrap();
    drop(work);
    explore(&scene, &toy, (folder.path(), &mut store), &options(400)).unwrap();
    explore(&scene, &toy, (longer.path(), &mut Memory::default()), &options(400)).unwrap();
    assert!(files(folder.path())[1] == files(longer.path())[1]);
}

#[test]
fn the_head_is_the_longest_of_the_best_prefixes_and_later_states_are_retired() {
    let (scene, toy) = (toy_scene(), Toy::new(200));
    let folder = tempfile::tempdir().unwrap();
    let mut store = Memory::default();
    explore(&scene, &toy, (folder.path(), &mut store), &options(300)).unwrap();
    let work = Work::open(folder.path(), &scene, false).unwrap();
    let graph = work.graph();
    let best = graph.best_commit().unwrap();
    let since = graph.initialised().unwrap();
    for commit in since..=graph.commit() {
        let view = work.view(commit);
        let links = view.links();
        check_total(&view, &links);
        let moment = graph.moments()[commit as usize];
        assert_eq!(view.stats().worst_error_m, moment.worst_error_m);
        let retired = links.iter().filter(|e| matches!(e, LinkEntry::Retired { .. })).count();
        assert_eq!(retired as u64, graph.next_id().0 - moment.states);
        let best_m = graph.moments()[best as usize].worst_error_m;
        assert!(moment.worst_error_m >= best_m);
        assert!(commit <= best || moment.worst_error_m > best_m);
    }
    assert_eq!(store.versions.last().unwrap().links, work.view(best).links());
}

/// Tolerance: a state that is near a known one is expanded only from a queue, never in a tree.
#[test]
fn tolerance_and_depth_are_respected() {
    for paper in [false, true] {
        let (scene, toy) = (toy_scene(), Toy::new(60));
        let folder = tempfile::tempdir().unwrap();
        let mut store = Memory::default();
        let options = ExploreOptions { paper, ..options(500) };
        explore(&scene, &toy, (folder.path(), &mut store), &options).unwrap();
        let work = Work::open(folder.path(), &scene, paper).unwrap();
        let graph = work.graph();
        let first = graph.moments()[graph.initialised().unwrap() as usize].states;
        let (mut early, mut deepest) = (0, 0);
        let mut depths = vec![0; graph.states().len()];
        for (id, state) in (0..).zip(graph.states()).skip(first as usize) {
            let (parent, _) = state.parent.unwrap();
            let run = |s: u64| graph.moments().partition_point(|m| m.states <= s);
            let same_job = parent.0 >= first && run(parent.0) == run(id as u64);
            depths[id] = if same_job { depths[parent.index()] + 1 } else { 1 };
            deepest = deepest.max(depths[id]);
            // What it was when its job was committed.
            let merges = graph.merges(StateId(id as u64));
            if let Some(merge) = merges.first() {
                early += u32::from(depths[id] < 6);
                assert!(depths[id] == 6 || merge.error_m <= 0.004, "{id}: {merge:?}");
            }
            assert!(merges.windows(2).all(|m| m[1].error_m < m[0].error_m));
            assert!(!paper || merges.len() <= 1, "no re-merging with --paper");
        }
        assert_eq!(deepest, 6);
        assert_eq!(early == 0, paper, "early stops only without --paper: {early}");
    }
}

#[test]
fn without_paper_dead_ends_move_to_nearer_states() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, toy) = (toy_scene(), Toy::new(200));
    explore(&scene, &toy, (folder.path(), &mut Memory::default()), &options(500)).unwrap();
    let work = Work::open(folder.path(), &scene, false).unwrap();
    let ids = || (0..work.graph().next_id().0).map(StateId);
    assert!(ids().any(|state| work.graph().merges(state).len() > 1));
    // Each dead end is merged into the nearest interior state of its pose, whatever its age.
    let metric = work.similar().metric();
    for (id, state) in (0..).zip(work.graph().states()) {
        if let Kind::DeadEnd { error_m, .. } = state.kind {
            let frame = work.states().read(StateId(id)).unwrap();
            for other in work.graph().interior(state.pose).iter() {
                let other = work.states().read(*other).unwrap();
                assert!(metric.distance(&frame, &other) >= error_m);
            }
        }
    }
    crate::grow::graph::tests::check(work.graph()).unwrap();
    crate::grow::graph::tests::check_table(work.graph());
}

#[test]
fn cloth_that_forgets_at_once_is_exhausted_with_no_error() {
    let folder = tempfile::tempdir().unwrap();
    let mut store = Memory::default();
    // One in-edge a pose but for p2: its two dead ends differ, everything else repeats.
    let scene = toy::scene(toy::figure_4(), toy::settings());
    let options = ExploreOptions::default();
    let place = (folder.path(), &mut store);
    let summary = explore(&scene, &Toy::new(0), place, &options).unwrap();
    assert_eq!((summary.end, summary.worst_error_mm), (End::Exhausted, 0.0));
    assert_eq!(summary.best_worst_error_mm, 0.0);
}

#[test]
fn an_edge_that_fails_costs_its_jobs_only() {
    let (scene, sound) = (toy_scene(), Toy::new(150));
    let folder = tempfile::tempdir().unwrap();
    let mut store = Memory::default();
    explore(&scene, &sound, (folder.path(), &mut store), &options(10)).unwrap();
    let broken = Toy { broken: Some(EdgeId(3)), ..sound };
    let mut failures = 0;
    let options = ExploreOptions { workers: 2, ..options(150) };
    let setup = Setup {
        scene: &scene,
        simulators: &broken,
        work: folder.path(),
        folder: None,
        options: &options,
    };
    let work = Work::open(folder.path(), &scene, false).unwrap();
    let mut count = |progress: &Progress| failures += u64::from(progress.failure.is_some());
    let summary = block_on(run(setup, work, &mut store, &mut count)).unwrap();
    assert!(failures > 0);
    // Every way leads over that edge: each of them got its second chance.
    assert_eq!((summary.failed_jobs, 2 * summary.set_aside), (failures, failures));
    let work = Work::open(folder.path(), &scene, false).unwrap();
    assert_eq!(work.ledger().set_aside().len() as u64, summary.set_aside);
    work.graph().check_total().unwrap();
    // In the initial pass it is an error that names the edge.
    let folder = tempfile::tempdir().unwrap();
    let place = (folder.path(), &mut Memory::default());
    let error = explore(&scene, &broken, place, &options).unwrap_err();
    assert!(error.to_string().contains("edge 3"), "{error}");
}

#[test]
fn other_inputs_other_stores_and_second_explorers_are_refused() {
    let (scene, toy) = (toy_scene(), Toy::new(150));
    let folder = tempfile::tempdir().unwrap();
    let mut store = Memory::default();
    explore(&scene, &toy, (folder.path(), &mut store), &options(50)).unwrap();
    let mut other = scene.clone();
    other.exploration.tolerance_m = 0.001;
    let error = explore(&other, &toy, (folder.path(), &mut store), &options(60)).unwrap_err();
    assert!(error.to_string().contains("tolerance_m was 0.004 and is 0.001"), "{error}");
    let paper = ExploreOptions { paper: true, ..options(60) };
    let error = explore(&scene, &toy, (folder.path(), &mut store), &paper).unwrap_err();
    assert!(error.to_string().contains("--paper was false"), "{error}");
    let empty = tempfile::tempdir().unwrap();
    let error = explore(&scene, &toy, (empty.path(), &mut store), &options(60)).unwrap_err();
    assert!(matches!(error, ExploreError::StoreAhead { .. }), "{error}");
    let held = Work::open(folder.path(), &scene, false).unwrap();
    let error = explore(&scene, &toy, (folder.path(), &mut store), &options(60)).unwrap_err();
    assert!(matches!(error, ExploreError::Work(WorkError::Locked(_))), "{error}");
    drop(held);
    // A new, empty store is brought up to date at once.
    let mut fresh = Memory::default();
    explore(&scene, &toy, (folder.path(), &mut fresh), &options(50)).unwrap();
    assert!(!fresh.versions.is_empty());
    std::fs::write(folder.path().join("journal"), b"a diary").unwrap();
    let error = explore(&scene, &toy, (folder.path(), &mut store), &options(60)).unwrap_err();
    assert!(error.to_string().contains("not a journal"), "{error}");
}

/// Every file below a folder, by path, but the work folder's.
#[test]
fn states_without_their_journal_are_refused_and_kept() {
    let (folder, mut store) = (tempfile::tempdir().unwrap(), Memory::default());
    let (scene, toy) = (toy_scene(), Toy::new(150));
    explore(&scene, &toy, (folder.path(), &mut store), &options(60)).unwrap();
    let [journal, states] = files(folder.path());
    std::fs::remove_file(folder.path().join("journal")).unwrap();
    let error = explore(&scene, &toy, (folder.path(), &mut store), &options(60)).unwrap_err();
    assert!(error.to_string().contains("no journal"), "{error}");
    std::fs::write(folder.path().join("journal"), &journal).unwrap();
    assert_eq!(files(folder.path()), [journal, states]);
    explore(&scene, &toy, (folder.path(), &mut store), &options(80)).unwrap();
}

fn tree(root: &Path) -> std::collections::BTreeMap<PathBuf, Vec<u8>> {
    let mut found = std::collections::BTreeMap::new();
    let mut folders = vec![root.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(root).unwrap().to_owned();
                found.insert(name, std::fs::read(path).unwrap());
            }
        }
    }
    found
}

#[test]
fn the_published_store_is_equal_for_any_workers_and_after_any_stop() {
    for policy in [Policy::Greedy, Policy::Visited, Policy::Predictive] {
        let mut first = None;
        for (workers, patience) in [(1, u64::MAX), (2, u64::MAX), (2, 4)] {
            let found = published(policy, workers, patience);
            let expected = first.get_or_insert_with(|| found.clone());
            assert!(expected.keys().eq(found.keys()), "{policy}, {workers} workers, {patience}");
            assert!(*expected == found, "{policy}, {workers} workers, {patience}");
        }
    }
}

/// What an exploration that is stopped again and again leaves in its store.
fn published(
    policy: Policy,
    workers: usize,
    patience: u64,
) -> std::collections::BTreeMap<PathBuf, Vec<u8>> {
    let (scene, toy) = (toy_scene(), Toy::new(150));
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("store");
    std::fs::create_dir(&root).unwrap();
    let summary = (0..500).find_map(|_| {
        let place = Place {
            store: crate::pack::local_store(&root).unwrap(),
            folder: Some(root.clone()),
            key: SigningKey::from_seed(&[7; 32]),
            work: folder.path().join("work"),
        };
        let asked = AtomicU64::new(0);
        let should_stop = Arc::new(move || asked.fetch_add(1, Ordering::Relaxed) >= patience);
        let options = ExploreOptions { workers, policy, should_stop, ..options(200) };
        let mut quiet = |_: &Progress| {};
        let future = super::explore(&scene, &toy, &place, &options, &mut quiet);
        let summary = block_on(future).unwrap();
        (summary.end == End::Frames).then_some(summary)
    });
    let versions = summary.expect("it gets there").version;
    assert!(versions >= 3, "{versions}");
    let found = tree(&root);
    assert!(found.len() > versions as usize);
    found
}

/// The dead end with the smallest error is tagged: it is simulated next, alone, and shown at once; a
/// run that was killed after it goes on to the same bytes.
#[test]
fn what_people_point_at_is_simulated_next_and_shown_at_once() {
    let (scene, toy) = (toy_scene(), Toy::new(150));
    let folder = tempfile::tempdir().unwrap();
    let mut store = Memory::default();
    let place = (folder.path(), &mut store);
    explore(&scene, &toy, place, &options(60)).unwrap();
    let work = Work::open(folder.path(), &scene, false).unwrap();
    let (least, _) = work.graph().queue().iter().last().unwrap();
    let frames = work.graph().simulated_frames();
    drop(work);
    let before = store.versions.len();
    // One that was never a dead end, and one that is none of this graph, cost nothing.
    store.tags = vec![StateId(0), least, StateId(1 << 40), least];
    let mut versions = Vec::new();
    let options = ExploreOptions {
        best_prefix_at_end: false,
        tags_every: Duration::ZERO,
        ..options(frames + 1)
    };
    explore(&scene, &toy, (folder.path(), &mut store), &options).unwrap();
    versions.extend_from_slice(&store.versions[before..]);
    let is_simulated =
        |version: &Version| matches!(version.links[least.index()], LinkEntry::Interior { .. });
    assert!(is_simulated(&versions[0]), "the first version after the tag shows it");
    let [journal, states] = files(folder.path());
    let again = tempfile::tempdir().unwrap();
    for (name, bytes) in [("journal", &journal), ("states", &states)] {
        std::fs::write(again.path().join(name), bytes).unwrap();
    }
    let reopened = Work::open(again.path(), &scene, false).unwrap();
    assert_eq!(reopened.ledger().newest_tag(), 4);
    assert!(reopened.graph().queue().iter().all(|(state, _)| state != least));
}

#[path = "explore_resume_tests.rs"]
mod resume;
#[path = "explore_scale_tests.rs"]
mod scale;
#[path = "explore_tags_tests.rs"]
mod tags;

#[test]
fn nothing_merges_into_a_flagged_state_where_its_pose_has_another() {
    let scene = toy_scene();
    let mut found = 0;
    for edge in 0..scene.primary.edges().len() as u32 {
        let toy = Toy { doubtful: Some(EdgeId(edge)), ..Toy::new(200) };
        let folder = tempfile::tempdir().unwrap();
        let place = (folder.path(), &mut Memory::default());
        let summary = explore(&scene, &toy, place, &options(400)).unwrap();
        let work = Work::open(folder.path(), &scene, false).unwrap();
        let graph = work.graph();
        let flagged = |state: StateId| graph.state(state).class & crate::grow::class::FLAGGED != 0;
        let all = (0..graph.next_id().0).map(StateId);
        let count = all.clone().filter(|state| flagged(*state)).count() as u64;
        assert_eq!(count, summary.frames_flagged, "each flagged frame is a flagged state");
        let mut into_flagged = 0;
        for state in all {
            let Kind::DeadEnd { target, error_m } = graph.state(state).kind else { continue };
            assert!(error_m < 100.0, "errors stay free of the penalty");
            let others = graph.interior(graph.state(state).pose);
            let better = others.iter().any(|other| !flagged(*other));
            assert!(!flagged(target) || !better, "{state} merged into {target}");
            into_flagged += u64::from(flagged(target));
        }
        assert_eq!(into_flagged, summary.merges_into_flagged);
        assert_eq!(into_flagged, 0, "such poses are simulated first, so that none is left");
        found += count;
    }
    assert!(found > 20, "{found}: the toy must flag something");
}

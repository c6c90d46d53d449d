//! Runs that go on after something went wrong: set aside, under another simulator, stopped in the drape.

use super::*;

/// What a simulator could not do is asked for again once nothing else is left, once in a run: one that was
/// mended does it.
#[test]
fn dead_ends_set_aside_get_a_second_chance() {
    // Two ways meet in p2: without a past the cloth is the same there after a frame.
    let (scene, sound) = (toy::scene(toy::figure_4(), toy::settings()), Toy::new(20));
    let whole = tempfile::tempdir().unwrap();
    let endless = ExploreOptions::default();
    let all = explore(&scene, &sound, (whole.path(), &mut Memory::default()), &endless).unwrap();
    assert_eq!((all.end, all.failed_jobs), (End::Exhausted, 0));
    let folder = tempfile::tempdir().unwrap();
    let mut store = Memory::default();
    explore(&scene, &sound, (folder.path(), &mut store), &options(1)).unwrap();
    let last = EdgeId(scene.primary.edges().len() as u32 - 1);
    let broken = Toy { broken: Some(last), ..sound };
    let mut before = 0;
    for run in 1..=2 {
        let end = explore(&scene, &broken, (folder.path(), &mut store), &endless).unwrap();
        assert_eq!(end.end, End::Exhausted);
        assert!(end.set_aside > 0 && end.failed_jobs >= before + end.set_aside, "run {run}");
        before = end.failed_jobs;
    }
    let end = explore(&scene, &sound, (folder.path(), &mut store), &endless).unwrap();
    assert_eq!((end.end, end.set_aside, end.failed_jobs), (End::Exhausted, 0, before));
    assert!(end.worst_error_mm <= all.worst_error_mm, "{} mm", end.worst_error_mm);
    // The journal says so, for whoever replays it.
    let work = Work::open(folder.path(), &scene, false).unwrap();
    assert_eq!((work.ledger().set_aside().len(), work.ledger().failed_jobs()), (0, before));
}

#[test]
fn a_folder_goes_on_under_its_own_physics_only() {
    let (scene, toy) = (toy_scene(), Toy::new(150));
    let folder = tempfile::tempdir().unwrap();
    let mut store = Memory::default();
    explore(&scene, &toy, (folder.path(), &mut store), &options(60)).unwrap();
    let before = files(folder.path());
    let place = (folder.path(), &mut store);
    let error = explore(&scene, &Toy::new(149), place, &options(90)).unwrap_err();
    assert!(matches!(&error, ExploreError::OtherPhysics { apart_mm, .. } if *apart_mm > 0.0));
    assert!(error.to_string().contains("another work folder"), "{error}");
    assert!(files(folder.path()) == before, "nothing was added");
    explore(&scene, &toy, (folder.path(), &mut store), &options(90)).unwrap();
}

#[test]
fn a_drape_can_be_stopped_and_made_later() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, toy, mut store) = (toy_scene(), Toy::new(150), Memory::default());
    let stopped = ExploreOptions { should_stop: Arc::new(|| true), ..options(60) };
    let summary = explore(&scene, &toy, (folder.path(), &mut store), &stopped).unwrap();
    assert_eq!((summary.end, summary.simulated_frames), (End::Stopped, 0));
    let summary = explore(&scene, &toy, (folder.path(), &mut store), &options(60)).unwrap();
    assert_eq!(summary.end, End::Frames);
}

/// Records that contradict each other need not be damaged: policies have chosen otherwise before.
#[test]
fn a_folder_of_an_older_toile_is_refused_with_what_to_do() {
    let source = crate::grow::ledger::LedgerError::OutOfTurn("a job");
    let error = crate::grow::work::WorkError::Records { path: "w/journal".into(), source };
    let said = ExploreError::from(error).to_string();
    let words =
        ["w/journal", "a job is out of turn", "restore a copy", "older toile", "begin anew"];
    assert!(words.iter().all(|word| said.contains(word)), "{said}");
}

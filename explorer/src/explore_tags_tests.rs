//! Tags that come while a round is under way.

use std::cell::Cell;
use std::collections::BTreeSet;

use super::*;
use crate::grow::journal::{Journal, JournalError};
use crate::grow::record::Record;

/// A store in which a tag appears once it was looked for so many times.
struct Late {
    memory: Memory,
    looks: Cell<u32>,
    after: u32,
}

impl Publish for Late {
    fn head(&self) -> (Option<VersionNumber>, u64) {
        self.memory.head()
    }

    async fn publish(
        &mut self,
        view: &dyn GraphView,
        soon: bool,
    ) -> Result<VersionNumber, PublishError> {
        self.memory.publish(view, soon).await
    }

    async fn walked(&self, after: u64) -> Result<Walked, object_store::Error> {
        self.memory.walked(after).await
    }

    async fn tagged(&self, after: u64) -> Result<Tagged, object_store::Error> {
        self.looks.set(self.looks.get() + 1);
        if self.looks.get() > self.after {
            return self.memory.tagged(after).await;
        }
        Ok(Tagged { newest: after, states: Vec::new() })
    }
}

fn options(frames: u64, workers: usize) -> ExploreOptions {
    ExploreOptions {
        workers,
        tags_every: Duration::ZERO,
        best_prefix_at_end: false,
        ..super::options(frames)
    }
}

fn go_on(folder: &Path, store: &mut Late, options: &ExploreOptions) -> Summary {
    let (scene, toy) = (toy_scene(), Toy::new(150));
    let setup = Setup { scene: &scene, simulators: &toy, work: folder, folder: None, options };
    let work = Work::open(folder, &scene, options.paper).unwrap();
    block_on(run(setup, work, store, &mut |_| {})).unwrap()
}

/// The records of a journal, and where each ends (bytes).
fn records(folder: &Path) -> Vec<(Record, usize)> {
    let mut records = Vec::new();
    let mut end = 8;
    let path = folder.join("journal");
    let bytes = std::fs::read(&path).unwrap();
    Journal::read(&path, |record| {
        end += 12 + u32::from_le_bytes(bytes[end..end + 4].try_into().unwrap()) as usize;
        records.push((record, end));
        Ok::<_, JournalError>(())
    })
    .unwrap();
    records
}

fn copy(files: &[Vec<u8>; 2], cut: usize) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("journal"), &files[0][..cut]).unwrap();
    std::fs::write(folder.path().join("states"), &files[1]).unwrap();
    folder
}

/// The tagged dead end's record comes next, a version right behind it; then the round that was interrupted
/// ends, job by job. Killed anywhere on the way, when all that waited in memory is lost, any number of
/// workers write the same bytes.
#[test]
fn a_tag_interrupts_the_round_and_the_round_goes_on() {
    let begun = tempfile::tempdir().unwrap();
    let mut store = Memory::default();
    let place = (begun.path(), &mut store);
    explore(&toy_scene(), &Toy::new(150), place, &options(60, 1)).unwrap();
    let work = Work::open(begun.path(), &toy_scene(), false).unwrap();
    let (least, _) = work.graph().queue().iter().last().unwrap();
    let frames = work.graph().simulated_frames() + 300;
    drop(work);
    let begun = files(begun.path());
    let (mut places, mut went_on) = (BTreeSet::new(), 0);
    for after in 1..14 {
        let folder = copy(&begun, begun[0].len());
        let memory = Memory { tags: vec![least], ..store.clone() };
        let mut late = Late { memory, looks: Cell::new(0), after };
        go_on(folder.path(), &mut late, &options(frames, 1));
        let whole = files(folder.path());
        let found = records(folder.path());
        let Some(at) = found.iter().position(|(r, _)| matches!(r, Record::Interrupted(_))) else {
            continue;
        };
        places.insert(job_before(&found, at));
        went_on += u32::from(follows(&found, at, least));
        for (_, cut) in &found[at..(at + 6).min(found.len())] {
            let again = copy(&whole, *cut);
            let published = published_by(again.path(), &toy_scene());
            let versions = late.memory.versions[..published].to_vec();
            let memory = Memory { versions, tags: vec![least], ..Memory::default() };
            let mut resumed = Late { memory, looks: Cell::new(0), after: 0 };
            go_on(again.path(), &mut resumed, &options(frames, 3));
            assert!(files(again.path()) == whole, "after look {after}, cut at {cut}");
            assert!(resumed.memory.versions == late.memory.versions, "cut at {cut}");
        }
    }
    assert!(places.contains(&None) && places.len() > 1, "in all places of a round: {places:?}");
    assert!(went_on > 2, "{went_on} rounds went on");
}

/// The place in its round of the job that was committed last before a record; `None` where the round had
/// none yet.
fn job_before(records: &[(Record, usize)], at: usize) -> Option<u32> {
    match &records[at - 1].0 {
        Record::Job(job) if job.index < 2 => Some(job.index),
        _ => None,
    }
}

/// What comes of a tag; whether the round that it interrupted goes on.
fn follows(records: &[(Record, usize)], at: usize, tagged: StateId) -> bool {
    let Record::Job(job) = &records[at + 1].0 else { panic!("{:?}", records[at + 1].0) };
    assert_eq!((job.start, job.index), (tagged, 0));
    assert!(matches!(records[at + 2].0, Record::Published(_)), "{:?}", records[at + 2].0);
    let interrupted = job_before(records, at);
    let parked = job.round - 1;
    let later: Vec<u32> = records[at + 3..]
        .iter()
        .filter_map(|(record, _)| match record {
            Record::Job(job) if job.round == parked => Some(job.index),
            _ => None,
        })
        .collect();
    let first = interrupted.map_or(0, |index| index + 1);
    assert_eq!(later, (first..first + later.len() as u32).collect::<Vec<_>>());
    // It may end before by the number of frames.
    !later.is_empty()
}

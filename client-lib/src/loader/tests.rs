use protocol::{PoseId, StateId};

use super::*;
use crate::character::{Character, StepOutcome};
use crate::tiny;

type Chunks = BTreeMap<ChunkHash, Vec<u8>>;

fn loader() -> GarmentLoader {
    GarmentLoader::new(Arc::new(Stage::default()), 1 << 20, Horizon::default())
}

fn wants(loader: &mut GarmentLoader) -> BTreeMap<ChunkHash, (ChunkRef, Need)> {
    let mut wants = BTreeMap::new();
    loader.plan(&mut wants);
    wants
}

/// Gives what is wanted with at least this need, until nothing is.
fn feed(loader: &mut GarmentLoader, chunks: &Chunks, least: Need) -> Result<usize, LoadError> {
    let mut versions = 0;
    loop {
        let wanted = wants(loader);
        let wanted: Vec<_> = wanted.iter().filter(|(_, (_, need))| *need <= least).collect();
        if wanted.is_empty() {
            return Ok(versions);
        }
        for (hash, (chunk, _)) in wanted {
            assert_eq!(chunks[hash].len(), chunk.bytes as usize);
            loader.handle_chunk(*hash, &chunks[hash])?;
        }
        versions += usize::from(loader.show()?);
    }
}

#[test]
fn a_version_is_shown_when_its_initial_graph_is_here_and_the_rest_comes_after() {
    let (garment, chunks) = tiny::published(tiny::grown_links());
    let mut loader = loader();
    loader.handle_version(VersionNumber(3), &garment).unwrap();
    assert_eq!(wants(&mut loader).len(), 5, "scene, mesh, basis, links and one region");
    assert_eq!(loader.pending(), Some(VersionNumber(3)));
    assert_eq!(feed(&mut loader, &chunks, Need::Version), Ok(1));
    assert_eq!(loader.pending(), None);
    let mut character = Character::enter(loader.stage()).unwrap();
    assert_eq!(character.version().number(), VersionNumber(3));
    // A character two frames away makes the second region urgent.
    let region = garment.regions[1].chunk.hash;
    assert_eq!(wants(&mut loader)[&region].1, Need::Urgent);
    assert!(!loader.is_ahead());
    assert_eq!(feed(&mut loader, &chunks, Need::Idle), Ok(0));
    assert!(loader.is_ahead());
    for pose in [1, 0, 1, 0, 0] {
        assert_eq!(character.step(PoseId(pose)), StepOutcome::Exact);
    }
    let memory = loader.memory();
    assert!(memory.initial > 0 && memory.initial < memory.regions);
    assert!(memory.links > 0 && memory.scene > 0 && memory.basis > 0);
}

#[test]
fn first_cloth_comes_with_the_leading_columns_its_error_stated() {
    let (garment, chunks) = tiny::published_in_parts(tiny::initial_links());
    let mut loader = loader();
    loader.handle_version(VersionNumber(1), &garment).unwrap();
    let rest = garment.generations[1].chunk;
    assert_eq!(wants(&mut loader)[&rest.hash].1, Need::Urgent, "after the leading columns");
    assert_eq!(feed(&mut loader, &chunks, Need::Version), Ok(0), "no whole version yet");
    let (name, first) = loader.take_first_cloth().unwrap();
    assert_eq!((name.as_str(), first.columns, first.all_columns), ("speck", 1, 2));
    assert_eq!(first.basis_bytes, u64::from(garment.generations[0].chunk.bytes));
    assert!((first.error_m - tiny::LEADING_ERROR_M).abs() < 2e-4, "{first:?}");
    assert_eq!(loader.take_first_cloth(), None);
    let mut character = Character::enter(loader.stage()).unwrap();
    let StepOutcome::Substituted { error_m } = character.step(PoseId(1)) else {
        panic!("leading columns are no exact cloth");
    };
    assert_eq!(error_m.to_bits(), first.error_m.to_bits());
    assert!(character.shown_error_m() >= error_m);
    let near = |a: f32, b: f32| (a - b).abs() < 1e-4;
    assert!(near(character.sample(1.0)[0], tiny::fractions(1)[0]));
    // The rest comes: what it adds fades in, and the step is exact.
    assert_eq!(feed(&mut loader, &chunks, Need::Idle), Ok(1));
    assert_eq!(character.step(PoseId(0)), StepOutcome::Exact);
    assert_eq!(character.version().columns_to_come(), 0);
    let (shown, whole, missing) =
        (character.sample(1.0)[1], tiny::fractions(3)[1], tiny::fractions(1)[1]);
    assert!(near(shown, whole - 0.9 * missing), "{shown}");
    assert_eq!((character.stats().switches, character.stats().missed), (0, 0));
}

#[test]
fn a_new_version_fetches_only_what_changed() {
    let (old, mut chunks) = tiny::published(tiny::initial_links());
    let (new, more) = tiny::published(tiny::grown_links());
    chunks.extend(more);
    let mut loader = loader();
    loader.handle_version(VersionNumber(1), &old).unwrap();
    assert_eq!(feed(&mut loader, &chunks, Need::Idle), Ok(1));
    let mut character = Character::enter(loader.stage()).unwrap();
    character.step(PoseId(1));
    loader.handle_version(VersionNumber(2), &new).unwrap();
    let wanted = wants(&mut loader);
    assert_eq!(wanted.keys().collect::<Vec<_>>(), [&new.links[0].hash]);
    assert_eq!(feed(&mut loader, &chunks, Need::Idle), Ok(1));
    assert_eq!(character.step(PoseId(0)), StepOutcome::Exact);
    assert_eq!(character.state(), StateId(3), "the state survived and goes on in the new graph");
}

#[test]
fn what_is_broken_or_missing_is_named_and_not_asked_for_again() {
    let (garment, chunks) = tiny::published(tiny::grown_links());
    let mut loader = loader();
    loader.handle_version(VersionNumber(1), &garment).unwrap();
    let region = garment.regions[0].chunk.hash;
    let error = loader.handle_chunk(region, &chunks[&region][..9]).unwrap_err();
    assert!(error.to_string().contains(&region.to_string()), "{error}");
    loader.handle_missing(garment.scene.hash);
    let wanted = wants(&mut loader);
    assert!(!wanted.contains_key(&region) && !wanted.contains_key(&garment.scene.hash));
    assert!(loader.is_stuck(), "a broken part does not mend itself");
    // What the server did not have it may have a while later.
    loader.retry_missing(garment.scene.hash);
    assert!(wants(&mut loader).contains_key(&garment.scene.hash));
    // The next version asks again.
    loader.handle_version(VersionNumber(2), &garment).unwrap();
    assert!(wants(&mut loader).contains_key(&region));
    assert_eq!(feed(&mut loader, &chunks, Need::Idle), Ok(1));
    let mut other = garment.clone();
    other.codec = "h.266".into();
    let error = loader.handle_version(VersionNumber(3), &other).unwrap_err();
    assert!(error.to_string().contains("h.266"), "{error}");
    assert!(!loader.is_stuck(), "the version before is played on");
    let mut unreadable = self::loader();
    assert!(unreadable.handle_version(VersionNumber(3), &other).is_err() && unreadable.is_stuck());
}

/// How often chunks were fetched until nothing more was wanted, and how often the same.
fn fetches(budget_bytes: usize, links: Vec<protocol::links::LinkEntry>) -> (usize, usize, usize) {
    let (garment, chunks) = tiny::published_in_parts(links);
    let mut loader = GarmentLoader::new(Arc::default(), budget_bytes, Horizon::default());
    loader.handle_version(VersionNumber(1), &garment).unwrap();
    feed(&mut loader, &chunks, Need::Version).unwrap();
    let mut characters: Vec<_> =
        (0..3).map(|_| Character::enter(loader.stage()).unwrap()).collect();
    let mut counts: BTreeMap<ChunkHash, usize> = BTreeMap::new();
    for round in 0..50 {
        let wanted = wants(&mut loader);
        for hash in wanted.keys() {
            *counts.entry(*hash).or_default() += 1;
            loader.handle_chunk(*hash, &chunks[hash]).unwrap();
        }
        loader.show().unwrap();
        if round == 10 {
            // Characters, which have nothing to do with it, play.
            for character in &mut characters {
                character.step(PoseId(1));
            }
        }
    }
    let memory = loader.memory();
    let most = counts.values().copied().max().unwrap_or(0);
    (counts.len(), most, memory.regions - memory.initial)
}

#[test]
fn what_does_not_fit_decoded_is_not_fetched_again_and_again() {
    // Encoded, the streamed chunk would fit into this many bytes.
    let (garment, _) = tiny::published_in_parts(tiny::grown_links());
    let region = &garment.regions[1];
    let expected = decoded_bytes(&garment, region);
    let small = 2 * region.chunk.bytes as usize;
    assert!(small < expected, "{small} bytes, {expected} decoded");
    let (_, most, held) = fetches(small, tiny::grown_links());
    assert!(most <= 2, "fetched {most} times");
    assert!(held <= small);
    let (_, most, held) = fetches(2 * expected, tiny::grown_links());
    assert_eq!((most, held > 0), (1, true));
}

#[test]
fn a_version_that_is_not_total_is_refused_and_the_old_one_played_on() {
    let (old, mut chunks) = tiny::published(tiny::initial_links());
    let mut links = tiny::initial_links();
    links[1] = tiny::interior(1, &[1]);
    let (broken, more) = tiny::published(links);
    chunks.extend(more);
    let mut loader = loader();
    loader.handle_version(VersionNumber(1), &old).unwrap();
    assert_eq!(feed(&mut loader, &chunks, Need::Idle), Ok(1));
    loader.handle_version(VersionNumber(2), &broken).unwrap();
    let error = feed(&mut loader, &chunks, Need::Idle).unwrap_err();
    assert!(error.to_string().contains("version 2"), "{error}");
    assert_eq!(loader.current().unwrap().number(), VersionNumber(1));
    assert_eq!(wants(&mut loader).len(), 0, "and it is not tried for ever");
}

#[test]
fn another_basis_starts_over_with_a_cache_of_its_own() {
    let (old, mut chunks) = tiny::published(tiny::grown_links());
    let mut loader = loader();
    loader.handle_version(VersionNumber(1), &old).unwrap();
    feed(&mut loader, &chunks, Need::Idle).unwrap();
    let mut character = Character::enter(loader.stage()).unwrap();
    character.step(PoseId(1));
    // The same columns under another name: as far as the client knows, another basis.
    let mut new = old;
    let mut bytes = Vec::new();
    let (mut x, mut y) = ([0i16; 3], [0i16; 3]);
    codec::kim2013::quantise_column(&[1.0, 0.0, 0.0], codec::kim2013::STEP_M, &mut x).unwrap();
    codec::kim2013::quantise_column(&[0.0, 1.0, 0.0], codec::kim2013::STEP_M, &mut y).unwrap();
    let entries = [x, y].concat();
    codec::kim2013::encode_generation(3, codec::kim2013::STEP_M, &[1.0, 1.0], &entries, &mut bytes)
        .unwrap();
    let chunk = ChunkRef { hash: ChunkHash::of(&bytes), bytes: bytes.len() as u32 };
    new.generations[0].chunk = chunk;
    chunks.insert(chunk.hash, bytes);
    loader.handle_version(VersionNumber(2), &new).unwrap();
    let wanted = wants(&mut loader);
    assert!(wanted.contains_key(&new.regions[0].chunk.hash), "read again into a cache of its own");
    assert_eq!(character.step(PoseId(0)), StepOutcome::Exact, "meanwhile the old one is played");
    assert_eq!(feed(&mut loader, &chunks, Need::Idle), Ok(1));
    character.step(PoseId(1));
    assert_eq!(character.version().number(), VersionNumber(2));
    assert_eq!(character.stats().missed, 0);
}

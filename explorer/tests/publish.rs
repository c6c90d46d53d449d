//! Publishing into in-memory and on-disk stores, with states that nobody simulated.

mod ring;

use std::collections::BTreeMap;
use std::sync::Arc;

use codec::Basis;
use codec::kim2013::{Generation, Region};
use explorer::pack::{
    Bound, EncodeSettings, InspectError, PublishError, Publisher, RunsError, StoreError,
    collect_leftovers, inspect, local_store,
};
use explorer::view::{GraphView, Run};
use futures::TryStreamExt;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};
use protocol::links::LinkEntry;
use protocol::manifest::VersionStats;
use protocol::region::RegionChunk;
use protocol::{Manifest, PoseId, SigningKey, StateId};

use ring::full::Full;
use ring::{POSES, ROWS, Ring, VERTICES, key, scene};

fn settings() -> EncodeSettings {
    EncodeSettings::for_rank(12)
}

fn memory() -> Arc<dyn ObjectStore> {
    Arc::new(InMemory::new())
}

async fn open(store: &Arc<dyn ObjectStore>) -> Publisher {
    Publisher::open(store.clone(), &scene(), key(), settings()).await.unwrap()
}

/// Everything in a store, by path.
async fn contents(store: &dyn ObjectStore) -> BTreeMap<String, Vec<u8>> {
    let listed: Vec<_> = store.list(None).try_collect().await.unwrap();
    let mut all = BTreeMap::new();
    for meta in listed {
        let bytes = store.get(&meta.location).await.unwrap().bytes().await.unwrap();
        all.insert(meta.location.to_string(), bytes.to_vec());
    }
    all
}

async fn chunk(store: &dyn ObjectStore, hash: &protocol::ChunkHash) -> Vec<u8> {
    let path = Path::from(protocol::store::chunk_path(hash));
    store.get(&path).await.unwrap().bytes().await.unwrap().to_vec()
}

/// Decodes every state as a client does; `(true maximum, stated maximum, states)` over all.
async fn compare(store: &dyn ObjectStore, manifest: &Manifest, view: &Ring) -> (f64, f32, u64) {
    let garment = manifest.garment("sheet").unwrap();
    let mut basis = Basis::new();
    for generation in &garment.generations {
        let bytes = chunk(store, &generation.chunk.hash).await;
        basis.append(&Generation::parse(&bytes).unwrap()).unwrap();
    }
    let (mut worst, mut stated, mut states) = (0.0f64, 0.0f32, 0);
    for listed in &garment.regions {
        let bytes = chunk(store, &listed.chunk.hash).await;
        for entry in RegionChunk::decode(&bytes).unwrap().regions {
            let region = Region::parse(&entry.bytes).unwrap();
            let mut coefficients = vec![0.0; region.columns()];
            let mut out = vec![0.0; ROWS];
            let mut of_region = 0.0f64;
            for state in 0..region.states() {
                region.state(state, &mut coefficients);
                basis.reconstruct(&coefficients, 0..ROWS, coefficients.len(), &mut out).unwrap();
                let exact = view.state(StateId(entry.first_state.0 + state as u64));
                for (a, b) in exact.chunks(3).zip(out.chunks(3)) {
                    let d = (0..3).map(|i| (f64::from(a[i]) - f64::from(b[i])).powi(2));
                    of_region = of_region.max(d.sum::<f64>().sqrt());
                }
                states += 1;
            }
            assert!(of_region <= f64::from(entry.max_error_m), "the bound must hold");
            assert!(of_region > 0.999 * f64::from(entry.max_error_m), "and be the true maximum");
            worst = worst.max(of_region);
            stated = stated.max(entry.max_error_m);
        }
    }
    (worst, stated, states)
}

#[tokio::test]
async fn the_stated_error_is_the_true_one() {
    let store = memory();
    let mut publisher = open(&store).await;
    for jobs in [1, 4, 6] {
        let view = Ring::new(jobs);
        let published = publisher.publish(&view).await.unwrap();
        let (worst, stated, states) = compare(&*store, &published.manifest, &view).await;
        let stats = published.manifest.garments[0].stats;
        assert_eq!(states, view.states());
        assert_eq!(stats.codec_max_error_m.to_bits(), stated.to_bits());
        assert!(worst > 0.0 && f64::from(stats.codec_rms_error_m) < worst);
        assert_eq!(stats.raw_bytes, states * 12 * VERTICES as u64);
    }
    let seen = inspect(&*store, None).await.unwrap();
    let sheet = &seen.garments[0];
    assert!(sheet.total && sheet.not_total.is_none());
    assert_eq!((seen.version.0, sheet.poses, sheet.merges), (3, 40, 6));
    assert_eq!(sheet.states, Ring::new(6).states());
    assert!(inspect(&*store, Some(protocol::VersionNumber(1))).await.unwrap().version.0 == 1);
}

#[tokio::test]
async fn publishing_the_same_again_makes_nothing() {
    let store = memory();
    let mut publisher = open(&store).await;
    assert!(publisher.publish(&Ring::new(3)).await.unwrap().created);
    let before = contents(&*store).await;
    let again = publisher.publish(&Ring::new(3)).await.unwrap();
    assert_eq!((again.created, again.number.0, again.new_bytes), (false, 1, 0));
    let reopened = open(&store).await.publish(&Ring::new(3)).await.unwrap();
    assert_eq!((reopened.created, reopened.number.0), (false, 1));
    assert_eq!(contents(&*store).await, before);
}

#[tokio::test]
async fn a_version_costs_what_changed() {
    let store = memory();
    let mut publisher = open(&store).await;
    let one = publisher.publish(&Ring::new(3)).await.unwrap().manifest;
    let published = publisher.publish(&Ring::new(4)).await.unwrap();
    let (one, two) = (&one.garments[0], &published.manifest.garments[0]);
    assert_eq!(published.encoded_states, 31);
    assert_eq!(two.regions[..one.regions.len()], one.regions[..]);
    assert_eq!(two.regions.len(), one.regions.len() + 1);
    assert_eq!(two.generations, one.generations);
    assert_eq!(published.new_chunks, 2, "one of regions, one of links");
    assert!(one.regions[0].initial && !two.regions.last().unwrap().initial);
}

/// Undoing a merge is links alone.
struct Remerged(Ring);

impl GraphView for Remerged {
    fn vertex_count(&self) -> usize {
        self.0.vertex_count()
    }
    fn runs(&self) -> &[Run] {
        self.0.runs()
    }
    fn positions(&self, state: StateId, out: &mut [f32]) -> std::io::Result<()> {
        self.0.positions(state, out)
    }
    fn links(&self) -> Vec<LinkEntry> {
        let mut links = self.0.links();
        let pose = PoseId(0);
        links[POSES as usize] =
            LinkEntry::DeadEnd { pose, target: StateId(u64::from(POSES) + 1), error_m: 0.001 };
        links
    }
    fn stats(&self) -> VersionStats {
        self.0.stats()
    }
}

#[tokio::test]
async fn a_changed_merge_changes_links_alone() {
    let store = memory();
    let mut publisher = open(&store).await;
    let one = publisher.publish(&Ring::new(3)).await.unwrap().manifest;
    let published = publisher.publish(&Remerged(Ring::new(3))).await.unwrap();
    assert_eq!((published.new_chunks, published.encoded_states), (1, 0));
    let (one, two) = (&one.garments[0], &published.manifest.garments[0]);
    assert_eq!((&one.regions, &one.generations), (&two.regions, &two.generations));
    assert_eq!(one.stats.codec_rms_error_m.to_bits(), two.stats.codec_rms_error_m.to_bits());
    assert_eq!(published.manifest.previous, Some(publisher_previous(&store).await));
}

async fn publisher_previous(store: &Arc<dyn ObjectStore>) -> protocol::ChunkHash {
    let path = Path::from(protocol::store::version_path(protocol::VersionNumber(1)));
    let bytes = store.get(&path).await.unwrap().bytes().await.unwrap();
    protocol::ChunkHash::of(&bytes[..bytes.len() - 64])
}

#[tokio::test]
async fn killed_and_resumed_equals_uninterrupted() {
    let (store, killed) = (memory(), memory());
    let mut odd = Ring::new(7);
    odd.odd_from = 5;
    let views = [Ring::new(2), Ring::new(4), odd];
    let mut publisher = open(&store).await;
    for view in &views {
        publisher.publish(view).await.unwrap();
    }
    for view in &views {
        // Killed while preparing; then between the last chunk and the manifest; then after it.
        drop(open(&killed).await.prepare(view).unwrap());
        let mut resumed = open(&killed).await;
        let before = contents(&*killed).await;
        let published = resumed.publish(view).await.unwrap();
        let manifest = protocol::store::version_path(published.number);
        killed.delete(&Path::from(manifest)).await.unwrap();
        assert!(contents(&*killed).await.len() > before.len(), "chunks without a manifest");
        let again = open(&killed).await.publish(view).await.unwrap();
        assert_eq!((again.created, &again.manifest), (true, &published.manifest));
        assert!(!open(&killed).await.publish(view).await.unwrap().created);
    }
    assert_eq!(contents(&*killed).await, contents(&*store).await);
}

#[tokio::test]
async fn a_manifest_that_was_created_just_before_the_crash_is_adopted() {
    let store = memory();
    let mut publisher = open(&store).await;
    let mut twin = open(&store).await;
    let one = publisher.publish(&Ring::new(2)).await.unwrap();
    let adopted = twin.publish(&Ring::new(2)).await.unwrap();
    assert_eq!(one.manifest, adopted.manifest);
    publisher.publish(&Ring::new(3)).await.unwrap();
    let before = contents(&*store).await;
    let refused = twin.publish(&Ring::new(5)).await.unwrap_err();
    assert!(matches!(refused, PublishError::Conflict(number) if number.0 == 2), "{refused}");
    let versions = |all: &BTreeMap<String, Vec<u8>>| {
        all.iter().filter(|(k, _)| k.starts_with("versions")).count()
    };
    assert_eq!(versions(&contents(&*store).await), versions(&before));
}

#[tokio::test]
async fn a_new_shape_opens_a_generation_and_old_bytes_stay() {
    let store = memory();
    let mut publisher = open(&store).await;
    let one = publisher.publish(&Ring::new(5)).await.unwrap().manifest;
    let before = contents(&*store).await;
    let mut view = Ring::new(7);
    view.odd_from = 6;
    let two = publisher.publish(&view).await.unwrap().manifest;
    let (old, new) = (&one.garments[0], &two.garments[0]);
    assert_eq!((old.generations.len(), new.generations.len()), (1, 2));
    assert_eq!(new.regions[..old.regions.len()], old.regions[..]);
    let (worst, ..) = compare(&*store, &two, &view).await;
    assert!(worst < 0.01, "the new shape is encoded too: {worst}");
    let after = contents(&*store).await;
    assert!(before.iter().all(|(path, bytes)| after.get(path) == Some(bytes)));
    assert_eq!(inspect(&*store, None).await.unwrap().garments[0].generations, 2);
}

#[tokio::test]
async fn without_room_for_columns_the_error_grows_but_is_stated() {
    let store = memory();
    let tight = EncodeSettings { rank_max: 6, columns_max: 6, ..settings() };
    let mut publisher = Publisher::open(store.clone(), &scene(), key(), tight).await.unwrap();
    publisher.publish(&Ring::new(5)).await.unwrap();
    let mut view = Ring::new(7);
    view.odd_from = 6;
    let two = publisher.publish(&view).await.unwrap().manifest;
    assert_eq!(two.garments[0].generations.len(), 1);
    let (worst, stated, _) = compare(&*store, &two, &view).await;
    assert!(worst > 0.05 && f64::from(stated) >= worst);
    assert_eq!(two.garments[0].stats.codec_max_error_m.to_bits(), stated.to_bits());
}

#[tokio::test]
async fn a_corrupted_chunk_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let store = local_store(folder.path()).unwrap();
    let manifest = open(&store).await.publish(&Ring::new(3)).await.unwrap().manifest;
    let listed: Vec<_> = manifest.garments[0].chunks().collect();
    for chunk in listed {
        let path = folder.path().join(protocol::store::chunk_path(&chunk.hash));
        let good = std::fs::read(&path).unwrap();
        let mut bad = good.clone();
        bad[good.len() / 2] ^= 1;
        std::fs::write(&path, &bad).unwrap();
        let error = inspect(&*store, None).await.unwrap_err();
        assert!(error.to_string().contains(&chunk.hash.to_string()), "{error}");
        std::fs::remove_file(&path).unwrap();
        let error = inspect(&*store, None).await.unwrap_err();
        let missing = matches!(&error, InspectError::Store(StoreError::MissingChunk(h))
            if *h == chunk.hash);
        assert!(missing, "{error}");
        std::fs::write(&path, &good).unwrap();
    }
    inspect(&*store, None).await.unwrap();
}

#[tokio::test]
async fn half_written_files_are_ignored_and_collected() {
    let folder = tempfile::tempdir().unwrap();
    let store = local_store(folder.path()).unwrap();
    open(&store).await.publish(&Ring::new(2)).await.unwrap();
    let before = contents(&*store).await;
    for left in ["versions/00000000000000000002#1", "chunks/ab/abcd#12", "publisher.pub#1"] {
        let path = folder.path().join(left);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, [1, 2, 3]).unwrap();
    }
    assert_eq!(inspect(&*store, None).await.unwrap().version.0, 1);
    assert_eq!(collect_leftovers(folder.path()).unwrap(), 3);
    assert_eq!(collect_leftovers(folder.path()).unwrap(), 0);
    assert_eq!(contents(&*store).await, before);
}

#[tokio::test]
async fn a_left_over_chunk_that_is_corrupted_is_not_published() {
    let (store, other) = (memory(), memory());
    let manifest = open(&other).await.publish(&Ring::new(2)).await.unwrap().manifest;
    let hash = manifest.garments[0].regions[0].chunk.hash;
    let path = Path::from(protocol::store::chunk_path(&hash));
    store.put(&path, vec![1, 2, 3].into()).await.unwrap();
    let refused = open(&store).await.publish(&Ring::new(2)).await.unwrap_err();
    assert!(refused.to_string().contains(&hash.to_string()), "{refused}");
    assert!(matches!(inspect(&*store, None).await, Err(InspectError::Store(StoreError::Empty))));
}

#[tokio::test]
async fn what_is_not_a_valid_store_is_told_apart() {
    let empty = inspect(&*memory(), None).await.unwrap_err();
    assert!(empty.to_string().contains("no version yet"), "{empty}");
    let store = memory();
    open(&store).await.publish(&Ring::new(2)).await.unwrap();
    let missing = inspect(&*store, Some(protocol::VersionNumber(9))).await.unwrap_err();
    assert!(missing.to_string().contains("no version 9"), "{missing}");
    let other = SigningKey::from_seed(&[8; 32]);
    let refused = Publisher::open(store.clone(), &scene(), other, settings()).await;
    assert!(matches!(refused.err(), Some(PublishError::OtherPublisher { .. })));
    let mut changed = scene();
    changed.garment.triangles.pop();
    let refused = Publisher::open(store.clone(), &changed, key(), settings()).await;
    assert!(matches!(refused.err(), Some(PublishError::OtherScene { what: "mesh", .. })));
    let path = Path::from(protocol::store::version_path(protocol::VersionNumber(1)));
    let mut bytes = store.get(&path).await.unwrap().bytes().await.unwrap().to_vec();
    let end = bytes.len() - 1;
    bytes[end] ^= 1;
    store.put(&path, bytes.into()).await.unwrap();
    let forged = inspect(&*store, None).await.unwrap_err();
    assert!(forged.to_string().contains("not signed"), "{forged}");
}

#[tokio::test]
async fn a_graph_that_is_not_total_or_not_this_store_s_is_refused() {
    struct Broken(Ring);
    impl GraphView for Broken {
        fn vertex_count(&self) -> usize {
            self.0.vertex_count()
        }
        fn runs(&self) -> &[Run] {
            self.0.runs()
        }
        fn positions(&self, state: StateId, out: &mut [f32]) -> std::io::Result<()> {
            self.0.positions(state, out)
        }
        fn links(&self) -> Vec<LinkEntry> {
            let mut links = self.0.links();
            links[5] = LinkEntry::Interior { pose: PoseId(5), next: vec![] };
            links
        }
        fn stats(&self) -> VersionStats {
            self.0.stats()
        }
    }
    let store = memory();
    let mut publisher = open(&store).await;
    let refused = publisher.publish(&Broken(Ring::new(2))).await.unwrap_err();
    assert!(matches!(refused, PublishError::NotTotal(_)), "{refused}");
    assert_eq!(contents(&*store).await.len(), 1, "the key alone");
    publisher.publish(&Ring::new(4)).await.unwrap();
    let shorter = publisher.publish(&Ring::new(3)).await.unwrap_err();
    assert!(matches!(shorter, PublishError::Runs(RunsError::OtherGraph { .. })), "{shorter}");
}

#[tokio::test]
async fn a_full_disk_leaves_the_head_as_it_was() {
    let full = Arc::new(Full { inner: InMemory::new(), left: 0.into() });
    let store: Arc<dyn ObjectStore> = full.clone();
    full.left.store(u64::MAX, std::sync::atomic::Ordering::SeqCst);
    let mut publisher = open(&store).await;
    let one = publisher.publish(&Ring::new(2)).await.unwrap();
    for writes in 0..3 {
        full.left.store(writes, std::sync::atomic::Ordering::SeqCst);
        let refused = publisher.publish(&Ring::new(4)).await.unwrap_err();
        assert!(refused.to_string().contains("No space left"), "{refused}");
        assert_eq!(publisher.head(), Some(&one.manifest));
        assert_eq!(inspect(&*store, None).await.unwrap().version, one.number);
    }
    full.left.store(u64::MAX, std::sync::atomic::Ordering::SeqCst);
    let two = publisher.publish(&Ring::new(4)).await.unwrap();
    assert_eq!((two.number.0, two.created), (2, true));
    inspect(&*store, None).await.unwrap();
}

#[tokio::test]
async fn a_bounded_store_is_rebased_once_outgrown_keeps_its_bound_and_resumes() {
    let bound = Bound { max_m: Some(0.004), rms_m: None };
    let bounded = EncodeSettings::for_bound(bound);
    let (mut stores, scene) = (Vec::new(), scene());
    for interrupted in [false, true] {
        let store = memory();
        let open = || Publisher::open(store.clone(), &scene, key(), bounded);
        let mut publisher = open().await.unwrap();
        let mut rebased = Vec::new();
        for jobs in [3, 6, 9, 12, 15] {
            if interrupted {
                publisher = open().await.unwrap();
            }
            let mut ring = Ring::new(jobs);
            ring.odd_from = 4;
            let published = publisher.publish(&ring).await.unwrap();
            rebased.push(published.rebased);
            let found = inspect(&*store, None).await.unwrap();
            assert!(found.garments[0].codec_max_error_mm <= 4.0, "{jobs} jobs: {found:?}");
        }
        assert!(!rebased[0] && rebased.iter().any(|r| *r), "{rebased:?}");
        let garment = publisher.head().unwrap().garment("sheet").unwrap();
        assert_eq!((garment.codec.as_str(), garment.id.0), ("toile", 0));
        stores.push(contents(&*store).await);
    }
    assert!(stores[0] == stores[1], "a resumed publisher writes what an uninterrupted one writes");
}

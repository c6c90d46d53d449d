//! Publishing: a version appears atomically or not at all.
//!
//! Order of writes: chunks under their hashes first, which nobody sees; then the manifest under
//! the next number, only if that number is free. A crash before the manifest leaves chunks that
//! the next attempt finds; a crash after it leaves a version that the next attempt adopts.

use std::collections::BTreeSet;
use std::sync::Arc;

use bytes::Bytes;
use futures::TryStreamExt;
use object_store::ObjectStore;
use protocol::links::{LinkEntry, LinkPage};
use protocol::manifest::{ChunkRef, GarmentVersion, GenerationRef, VersionStats};
use protocol::scene::Edge;
use protocol::{
    ChunkHash, DecodeError, GarmentId, LinkTable, Manifest, NotTotal, PublisherKey, SigningKey,
    VersionNumber,
};

use super::encode::{Coding, EncodeError, EncodeSettings, Encoder, Profile};
use super::regions::{self, Cut, Encoding, NewRegions, RunsError};
use super::scene_chunk::{garment_chunk, scene_chunk};
use super::store::{self, NewChunks, StoreError};
use crate::scene::Scene;
use crate::view::GraphView;

/// Chunks written at the same time: a put waits for the disk or the network, not for the CPU.
/// Their order is of no effect, since nobody looks for them before the manifest is there.
const PUTS_MAX: usize = 8;

/// Why nothing was published; the head is as it was.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PublishError {
    /// The store failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The scene breaks a limit, or a figure is impossible.
    #[error("cannot be published: {0}")]
    Invalid(#[from] DecodeError),
    /// From some state, some edge leads nowhere.
    #[error("the graph is not total: {0}")]
    NotTotal(#[from] NotTotal),
    /// The graph's runs are not those of the store.
    #[error(transparent)]
    Runs(#[from] RunsError),
    /// States cannot be encoded.
    #[error("encoding: {0}")]
    Encode(#[from] EncodeError),
    /// No upsampler.
    #[error(transparent)]
    Upsampler(#[from] codec::upsample::UpsampleError),
    /// The store belongs to another key.
    #[error(
        "the store belongs to publisher {found}, but this key is {ours}; give the work folder \
         that the store was published from, or take another store"
    )]
    OtherPublisher {
        /// Whose it is.
        found: PublisherKey,
        /// Ours.
        ours: PublisherKey,
    },
    /// The store holds a garment of this name in another scene, mesh or codec.
    #[error(
        "the store holds another {what} for garment {garment:?}; publish to an empty store, or \
         name the garment differently"
    )]
    OtherScene {
        /// Name of the garment.
        garment: String,
        /// What differs.
        what: &'static str,
    },
    /// States of another mesh.
    #[error("states of {view} vertices, but the garment has {garment}")]
    Vertices {
        /// Vertices of the view's states.
        view: usize,
        /// Vertices of the scene's garment.
        garment: usize,
    },
    /// Someone else published at the same time.
    #[error("version {0} was created by another publisher of this store; open the store again")]
    Conflict(VersionNumber),
}

/// Publishes the versions of one garment.
pub struct Publisher {
    store: Arc<dyn ObjectStore>,
    key: SigningKey,
    settings: EncodeSettings,
    scene: Fixed,
    head: Option<Manifest>,
    encoder: Encoder,
    /// Largest error of the garment's first version (m).
    first_error_m: Option<f32>,
    /// An upsampler to publish with the next version.
    upsampler: Option<Vec<u8>>,
}

/// What never changes.
struct Fixed {
    name: String,
    vertex_count: usize,
    pose_count: usize,
    edges: Vec<Edge>,
    scene: Vec<u8>,
    mesh: Vec<u8>,
}

/// A version that is ready, but not yet visible.
pub struct Prepared {
    manifest: Manifest,
    /// `None` when the head says the same already.
    new: Option<New>,
}

struct New {
    chunks: NewChunks,
    encoder: Encoder,
    encoded_states: u64,
    rebased: bool,
}

/// What publishing did.
#[derive(Debug, Clone, PartialEq)]
pub struct Published {
    /// The head now.
    pub number: VersionNumber,
    /// Its manifest.
    pub manifest: Manifest,
    /// Whether a version was made; `false` when the head said the same already.
    pub created: bool,
    /// Chunks that no earlier version lists.
    pub new_chunks: usize,
    /// Their bytes.
    pub new_bytes: u64,
    /// States encoded.
    pub encoded_states: u64,
    /// Whether this version stands on a new basis: every state was encoded again.
    pub rebased: bool,
}

impl Publisher {
    /// Opens a store for publishing this scene's garment, and recovers everything from its head:
    /// which states are covered, the basis, the codec's figures.
    ///
    /// # Errors
    /// The store fails, belongs to another key, or holds another scene under the garment's name.
    pub async fn open(
        store: Arc<dyn ObjectStore>,
        scene: &Scene,
        key: SigningKey,
        settings: EncodeSettings,
    ) -> Result<Self, PublishError> {
        let scene = Fixed::new(scene)?;
        claim(&*store, &key).await?;
        let encoder = Encoder::new(&settings);
        let mut publisher = Self {
            store,
            key,
            settings,
            scene,
            head: None,
            encoder,
            first_error_m: None,
            upsampler: None,
        };
        if let Some(number) = store::head_number(&*publisher.store).await? {
            publisher.recover(number).await?;
        }
        Ok(publisher)
    }

    /// The newest version, if there is one.
    pub fn head(&self) -> Option<&Manifest> {
        self.head.as_ref()
    }

    /// From the next version on the garment has this upsampler (the bytes of
    /// `codec::upsample::Parts::encode`); later versions keep it.
    ///
    /// # Errors
    /// Bytes that are none, or one of another garment.
    pub fn set_upsampler(&mut self, bytes: Vec<u8>) -> Result<(), PublishError> {
        let upsampler = codec::upsample::Upsampler::decode(&bytes)?;
        let (found, expected) = (upsampler.fine(), self.scene.vertex_count);
        if found != expected {
            return Err(PublishError::Vertices { view: found, garment: expected });
        }
        self.upsampler = Some(bytes);
        Ok(())
    }

    /// Prepares and commits. The future is not `Send` where the view is not `Sync`; then call
    /// [`Publisher::prepare`] and [`Publisher::commit`].
    ///
    /// # Errors
    /// Nothing was published; the head is as it was.
    pub async fn publish(&mut self, view: &dyn GraphView) -> Result<Published, PublishError> {
        let prepared = self.prepare(view)?;
        self.commit(prepared).await
    }

    /// The same on the basis that the head has, also where a new one would pay: somebody waits.
    ///
    /// # Errors
    /// Nothing was published; the head is as it was.
    pub async fn publish_soon(&mut self, view: &dyn GraphView) -> Result<Published, PublishError> {
        let prepared = self.prepare_on(view, false)?;
        self.commit(prepared).await
    }

    /// Checks totality and encodes what is new. Touches no store and changes nothing; takes CPU
    /// time (of the order of a millisecond a new state, more for the first version).
    ///
    /// # Errors
    /// The view is not total, not of this scene, or cannot be encoded.
    pub fn prepare(&self, view: &dyn GraphView) -> Result<Prepared, PublishError> {
        self.prepare_on(view, true)
    }

    fn prepare_on(&self, view: &dyn GraphView, may_rebase: bool) -> Result<Prepared, PublishError> {
        let (found, expected) = (view.vertex_count(), self.scene.vertex_count);
        if found != expected {
            return Err(PublishError::Vertices { view: found, garment: expected });
        }
        let links = view.links();
        let pages = self.total(&links)?;
        let before = self.garment();
        let states = links.len() as u64;
        let rebased = may_rebase && self.pays_to_rebase(states);
        let kept = before.filter(|_| !rebased);
        let cuts = regions::cut(view.runs(), kept.map_or(0, covered), states)?;
        let encoding = Encoding {
            view,
            settings: &self.settings,
            generations: kept.map_or(0, |garment| garment.generations.len()),
            outside_m: self.outside_m(),
        };
        let fresh = rebased.then(|| Encoder::new(&self.settings));
        let new = encoding.encode(fresh.as_ref().unwrap_or(&self.encoder), &cuts)?;
        let mut chunks = NewChunks::default();
        let encoder = new.encoder.clone();
        let garment = self.version(kept, (view.stats(), &cuts, new), &pages, &mut chunks);
        if let Some(head) = self.head.as_ref().filter(|_| before == Some(&garment)) {
            return Ok(Prepared { manifest: head.clone(), new: None });
        }
        let manifest = self.next(garment);
        manifest.check()?;
        let listed = self.head.iter().flat_map(|head| &head.garments);
        let listed: BTreeSet<ChunkHash> =
            listed.flat_map(|garment| garment.chunks()).map(|chunk| chunk.hash).collect();
        chunks.chunks.retain(|hash, _| !listed.contains(hash));
        let encoded_states = cuts.iter().map(|cut| u64::from(cut.count)).sum();
        Ok(Prepared { manifest, new: Some(New { chunks, encoder, encoded_states, rebased }) })
    }

    /// Makes a prepared version visible: chunks first, then its manifest in one atomic step.
    ///
    /// # Errors
    /// The store refused a write, or another publisher was faster. The head is as it was.
    pub async fn commit(&mut self, prepared: Prepared) -> Result<Published, PublishError> {
        let Prepared { manifest, new } = prepared;
        let number = manifest.number;
        let Some(New { chunks, encoder, encoded_states, rebased }) = new else {
            return Ok(Published {
                number,
                manifest,
                created: false,
                new_chunks: 0,
                new_bytes: 0,
                encoded_states: 0,
                rebased: false,
            });
        };
        if self.next_number() != number {
            return Err(PublishError::Conflict(number));
        }
        let store = &*self.store;
        let puts = futures::stream::iter(chunks.chunks.iter().map(Ok));
        puts.try_for_each_concurrent(PUTS_MAX, |(hash, bytes)| put_chunk(store, hash, bytes))
            .await?;
        let signed = manifest.clone().sign(&self.key).encode();
        let path = protocol::store::version_path(number);
        if !store::create(&*self.store, &path, signed).await? {
            let there = store::version(&*self.store, number, &self.key.public()).await?;
            if there.manifest.encode() != manifest.encode() {
                return Err(PublishError::Conflict(number));
            }
        }
        let (new_chunks, new_bytes) = (chunks.chunks.len(), chunks.bytes());
        self.encoder = encoder;
        let first = manifest.garment(&self.scene.name).map(|g| g.stats.codec_max_error_m);
        self.first_error_m = self.first_error_m.or(first);
        self.head = Some(manifest.clone());
        Ok(Published {
            number,
            manifest,
            created: true,
            new_chunks,
            new_bytes,
            encoded_states,
            rebased,
        })
    }

    fn garment(&self) -> Option<&GarmentVersion> {
        self.head.as_ref()?.garment(&self.scene.name)
    }

    fn next_number(&self) -> VersionNumber {
        VersionNumber(self.head.as_ref().map_or(1, |head| head.number.0 + 1))
    }

    /// From which error on a region falls outside the basis (m).
    fn outside_m(&self) -> f32 {
        let settings = &self.settings;
        self.first_error_m.map_or(f32::INFINITY, |first| {
            (settings.error_factor * first).max(settings.error_floor_m)
        })
    }

    /// Whether a new basis pays for the head's garment.
    fn pays_to_rebase(&self, states: u64) -> bool {
        let Some(garment) = self.garment() else { return false };
        let rms_m = garment.stats.codec_rms_error_m;
        pays_to_rebase(&self.encoder, garment.generations.len(), states, rms_m)
    }

    /// The link pages, proved total.
    fn total(&self, links: &[LinkEntry]) -> Result<Vec<LinkPage>, PublishError> {
        let pages = LinkPage::split(links);
        pages.iter().try_for_each(LinkPage::check)?;
        LinkTable::new(&pages, self.scene.pose_count, &self.scene.edges)?;
        Ok(pages)
    }

    /// The garment's part of the next manifest; its chunks go to `chunks`.
    fn version(
        &self,
        before: Option<&GarmentVersion>,
        (stats, cuts, new): (VersionStats, &[Cut], NewRegions),
        pages: &[LinkPage],
        chunks: &mut NewChunks,
    ) -> GarmentVersion {
        let stats = self.with_codec_figures(before, stats, cuts, &new);
        let mut generations = before.map_or(Vec::new(), |garment| garment.generations.clone());
        for (bytes, columns) in new.generations {
            generations.push(GenerationRef { chunk: chunks.add(bytes), columns });
        }
        let mut covered = before.map_or(Vec::new(), |garment| garment.regions.clone());
        covered.extend(regions::bundle(cuts, new.regions, chunks));
        GarmentVersion {
            id: self.garment().map_or_else(|| self.free_id(), |garment| garment.id),
            name: self.scene.name.clone(),
            codec: self.settings.profile.name().into(),
            scene: chunks.add(self.scene.scene.clone()),
            mesh: chunks.add(self.scene.mesh.clone()),
            generations,
            regions: covered,
            links: pages.iter().map(|page| chunks.add(page.encode())).collect(),
            stats,
            upsampler: self.upsampler(chunks),
        }
    }

    /// The upsampler given to this publisher, else the one that the store has.
    fn upsampler(&self, chunks: &mut NewChunks) -> Option<ChunkRef> {
        match &self.upsampler {
            Some(bytes) => Some(chunks.add(bytes.clone())),
            None => self.garment().and_then(|garment| garment.upsampler),
        }
    }

    /// Maximum and RMS go on from the figures of the head as they stand there, so that a resumed
    /// publisher writes what an uninterrupted one writes.
    fn with_codec_figures(
        &self,
        before: Option<&GarmentVersion>,
        stats: VersionStats,
        cuts: &[Cut],
        new: &NewRegions,
    ) -> VersionStats {
        let old_states = before.map_or(0, covered);
        let before = before.map_or_else(VersionStats::default, |garment| garment.stats);
        let vertices = self.scene.vertex_count as f64;
        let new_states: u64 = cuts.iter().map(|cut| u64::from(cut.count)).sum();
        let old_squares =
            f64::from(before.codec_rms_error_m).powi(2) * old_states as f64 * vertices;
        let all = (old_states + new_states).max(1) as f64 * vertices;
        let rms = ((old_squares + new.square_sum_m2()) / all).sqrt() as f32;
        VersionStats {
            codec_max_error_m: before.codec_max_error_m.max(new.max_error_m()),
            codec_rms_error_m: if new_states == 0 { before.codec_rms_error_m } else { rms },
            raw_bytes: stats.states * 12 * self.scene.vertex_count as u64,
            ..stats
        }
    }

    fn free_id(&self) -> GarmentId {
        let last = self.head.as_ref().and_then(|head| head.garments.last());
        GarmentId(last.map_or(0, |garment| garment.id.0 + 1))
    }

    /// The head with this garment in it and the next number on it.
    fn next(&self, garment: GarmentVersion) -> Manifest {
        let mut garments = self.head.as_ref().map_or(Vec::new(), |head| head.garments.clone());
        match garments.iter_mut().find(|known| known.id == garment.id) {
            Some(known) => *known = garment,
            None => garments.push(garment),
        }
        let previous = self.head.as_ref().map(Manifest::hash);
        Manifest { number: self.next_number(), previous, garments }
    }

    async fn recover(&mut self, number: VersionNumber) -> Result<(), PublishError> {
        let publisher = self.key.public();
        let head = store::version(&*self.store, number, &publisher).await?.manifest;
        if let Some(garment) = head.garment(&self.scene.name) {
            self.scene.check_same(garment, self.settings.profile)?;
            for generation in &garment.generations {
                let bytes = store::chunk(&*self.store, &generation.chunk).await?;
                self.encoder.append(&bytes)?;
            }
            self.first_error_m = Some(self.first_error(number).await?);
        }
        self.head = Some(head);
        Ok(())
    }

    /// Largest error of the first version that has the garment.
    async fn first_error(&self, head: VersionNumber) -> Result<f32, PublishError> {
        for number in (1..=head.0).map(VersionNumber) {
            match store::version(&*self.store, number, &self.key.public()).await {
                Ok(version) => {
                    if let Some(garment) = version.manifest.garment(&self.scene.name) {
                        return Ok(garment.stats.codec_max_error_m);
                    }
                }
                Err(StoreError::NoVersion(_)) => {} // old versions may be thinned out
                Err(error) => return Err(error.into()),
            }
        }
        Err(StoreError::NoVersion(head).into())
    }
}

impl Fixed {
    fn new(scene: &Scene) -> Result<Self, PublishError> {
        let chunk = scene_chunk(scene);
        let mesh = garment_chunk(scene);
        Ok(Self {
            name: scene.garment.name.clone(),
            vertex_count: scene.garment.positions.len(),
            pose_count: chunk.poses.len(),
            scene: chunk.to_bytes()?,
            mesh: mesh.to_bytes()?,
            edges: chunk.edges,
        })
    }

    fn check_same(&self, garment: &GarmentVersion, profile: Profile) -> Result<(), PublishError> {
        let same = |chunk: &ChunkRef, bytes: &[u8]| chunk.hash == ChunkHash::of(bytes);
        let what = if !same(&garment.scene, &self.scene) {
            "scene"
        } else if !same(&garment.mesh, &self.mesh) {
            "mesh"
        } else if garment.codec != profile.name() {
            "codec"
        } else {
            return Ok(());
        };
        Err(PublishError::OtherScene { garment: self.name.clone(), what })
    }
}

/// Whether a new basis pays, though every state is sent again on it: the states have doubled
/// since the basis was made, and they have outgrown it. Doubling bounds the price: all bases
/// together cost no more than twice the last one.
pub(super) fn pays_to_rebase(
    encoder: &Encoder,
    generations: usize,
    states: u64,
    codec_rms_m: f32,
) -> bool {
    let Coding::Toile(bounded) = &encoder.coding else { return false };
    let (made_states, rms_m) = bounded.made;
    let outgrown = generations > bounded.first_generations || codec_rms_m > 1.1 * rms_m;
    states >= 2 * u64::from(made_states).max(1) && outgrown
}

/// The profile in which a store holds a garment, if it does.
///
/// # Errors
/// The store fails.
pub async fn codec_of(from: &dyn ObjectStore, name: &str) -> Result<Option<Profile>, StoreError> {
    let (number, publisher) = (store::head_number(from).await?, store::publisher(from).await?);
    let (Some(number), Some(publisher)) = (number, publisher) else { return Ok(None) };
    let head = store::version(from, number, &publisher).await?;
    let garment = head.manifest.garment(name);
    Ok(garment.and_then(|garment| Profile::named(&garment.codec)))
}

/// States covered by the region chunks: a prefix, since ids are given in order of creation.
fn covered(garment: &GarmentVersion) -> u64 {
    garment.regions.last().map_or(0, |last| last.first_state.0 + u64::from(last.state_count))
}

/// Puts the public key into an empty store; refuses one that belongs to another key.
async fn claim(store: &dyn ObjectStore, key: &SigningKey) -> Result<(), PublishError> {
    let ours = key.public();
    let text = format!("{ours}\n");
    if store::create(store, protocol::store::PUBLISHER, text).await? {
        return Ok(());
    }
    match store::publisher(store).await? {
        Some(found) if found != ours => Err(PublishError::OtherPublisher { found, ours }),
        _ => Ok(()),
    }
}

/// A chunk that is there already (from an attempt that crashed) is checked.
async fn put_chunk(
    store: &dyn ObjectStore,
    hash: &ChunkHash,
    bytes: &Bytes,
) -> Result<(), StoreError> {
    let path = protocol::store::chunk_path(hash);
    if store::create(store, &path, bytes.clone()).await? {
        return Ok(());
    }
    let chunk = ChunkRef { hash: *hash, bytes: bytes.len() as u32 };
    store::chunk(store, &chunk).await.map(|_| ())
}

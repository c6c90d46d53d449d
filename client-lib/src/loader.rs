//! From manifests and chunks to views: what is still lacking, what was read, what can be played.
//!
//! One [`GarmentLoader`] per garment, fed by the driver off the frame loop. No I/O: chunks in,
//! wants and views out.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use codec::{Basis, Decoder};
use protocol::links::LinkPage;
use protocol::manifest::{ChunkRef, GarmentVersion};
use protocol::region::{RegionChunk, RegionEntry};
use protocol::scene::{GarmentChunk, SceneChunk};
use protocol::{ChunkHash, DecodeError, GarmentId, VersionNumber};

use crate::cache::{Cache, Region};
use crate::prefetch::{EdgeWeights, Horizon, Plan};
use crate::scene::Scene;
use crate::shared::Stage;
use crate::telemetry::Batch;
use crate::version::{Parts, Version, VersionError, View, decoded_bytes};
use upsampled::Upsamplers;

mod ahead;
mod first_cloth;
mod upsampled;

pub use first_cloth::FirstCloth;

/// Why a garment's chunk or version was refused. The version before is played on.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum LoadError {
    /// The bytes do not parse.
    #[error("garment {garment}: chunk {chunk}: {source}")]
    Chunk {
        /// The garment.
        garment: GarmentId,
        /// The chunk.
        chunk: ChunkHash,
        /// What is wrong.
        source: DecodeError,
    },
    /// The encoded numbers do not parse.
    #[error("garment {garment}: chunk {chunk}: {why}")]
    Codec {
        /// The garment.
        garment: GarmentId,
        /// The chunk.
        chunk: ChunkHash,
        /// What is wrong.
        why: String,
    },
    /// Encoded in a way that this client cannot read.
    #[error(
        "garment \"{garment}\" is encoded as \"{found}\"; this client reads {}: update it",
        Decoder::PROFILES.join(", ")
    )]
    Profile {
        /// The garment's name.
        garment: String,
        /// Its codec.
        found: String,
    },
    /// The parts do not fit together.
    #[error(transparent)]
    Version(#[from] VersionError),
}

/// How soon a chunk is needed, the most urgent first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Need {
    /// A version cannot be shown without it.
    Version,
    /// A cursor is there within a second.
    Urgent,
    /// Within the horizon.
    Soon,
    /// Nothing else to do.
    Idle,
}

/// Memory of one garment, in bytes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Memory {
    /// Decoded regions, the initial graph included; no basis.
    pub regions: usize,
    /// Of these, the initial graph.
    pub initial: usize,
    /// Transition table and the pages it was made from.
    pub links: usize,
    /// Poses, edges, body.
    pub scene: usize,
    /// Basis columns.
    pub basis: usize,
    /// The upsampler.
    pub upsampler: usize,
}

impl Memory {
    /// Both together.
    pub fn plus(self, other: Self) -> Self {
        Self {
            regions: self.regions + other.regions,
            initial: self.initial + other.initial,
            links: self.links + other.links,
            scene: self.scene + other.scene,
            basis: self.basis + other.basis,
            upsampler: self.upsampler + other.upsampler,
        }
    }
}

/// One garment's way from chunks to views.
#[derive(Debug)]
pub struct GarmentLoader {
    stage: Arc<Stage>,
    budget_bytes: usize,
    horizon: Horizon,
    weights: EdgeWeights,
    current: Option<Arc<Version>>,
    /// The newest version announced, while it is not complete.
    next: Option<(VersionNumber, GarmentVersion)>,
    cache: Cache,
    /// Where the next version's coefficients go if they are of another basis.
    next_cache: Option<Cache>,
    plan: Plan,
    parts: PartsSoFar,
    upsamplers: Upsamplers,
    /// Chunks that are broken; tried again with the next version.
    refused: BTreeSet<ChunkHash>,
    /// Chunks that the server does not have; tried again when the driver says so.
    missing: BTreeSet<ChunkHash>,
    /// Chunks for which there was no room beside what is planned; tried again with another plan.
    unfit: BTreeSet<ChunkHash>,
    /// What was decoded of streamed chunks: bytes taken, bytes expected.
    decoded: [usize; 2],
    changed: bool,
    first_shown: bool,
    first_cloth: Option<FirstCloth>,
}

/// What was read of the next version and kept of the current one.
#[derive(Debug, Default)]
struct PartsSoFar {
    scene: Option<(ChunkHash, Arc<Scene>)>,
    mesh: Option<(ChunkHash, Arc<GarmentChunk>)>,
    basis: Option<(Vec<ChunkHash>, Decoder, Arc<Basis>)>,
    /// Encoded generations that are not yet in `basis`.
    generations: BTreeMap<ChunkHash, Vec<u8>>,
    /// Encoded link pages, each read once on arrival.
    pages: BTreeMap<ChunkHash, Vec<u8>>,
    /// Region chunks of the next version that need generations that are not yet in `basis`.
    regions: BTreeMap<ChunkHash, (RegionChunk, bool)>,
}

impl GarmentLoader {
    /// A loader that shows its views on `stage`.
    ///
    /// `budget_bytes` bounds streamed regions, the initial graph apart.
    pub fn new(stage: Arc<Stage>, budget_bytes: usize, horizon: Horizon) -> Self {
        Self {
            stage,
            budget_bytes,
            horizon,
            weights: EdgeWeights::default(),
            current: None,
            next: None,
            cache: Cache::new(budget_bytes),
            next_cache: None,
            plan: Plan::default(),
            parts: PartsSoFar::default(),
            upsamplers: Upsamplers::default(),
            refused: BTreeSet::new(),
            missing: BTreeSet::new(),
            unfit: BTreeSet::new(),
            decoded: [0; 2],
            changed: false,
            first_shown: false,
            first_cloth: None,
        }
    }

    /// Where its views are shown.
    pub fn stage(&self) -> &Arc<Stage> {
        &self.stage
    }

    /// The version that is shown.
    pub fn current(&self) -> Option<&Arc<Version>> {
        self.current.as_ref()
    }

    /// The newest version announced, while it is not complete.
    pub fn pending(&self) -> Option<VersionNumber> {
        self.next.as_ref().map(|(number, _)| *number)
    }

    /// A version was announced: from now on its chunks are wanted. One that was still being
    /// loaded is passed over.
    ///
    /// # Errors
    /// A codec that this client cannot read.
    pub fn handle_version(
        &mut self,
        number: VersionNumber,
        garment: &GarmentVersion,
    ) -> Result<(), LoadError> {
        if Decoder::new(&garment.codec).is_none() {
            let (garment, found) = (garment.name.clone(), garment.codec.clone());
            return Err(LoadError::Profile { garment, found });
        }
        self.refused.clear();
        self.missing.clear();
        self.unfit.clear();
        let oldest = |listing: &GarmentVersion| listing.generations.first().map(|g| g.chunk.hash);
        let held = self.current.as_ref().map(|version| version.lineage());
        let other_basis = held.is_some_and(|lineage| lineage != oldest(garment));
        self.next_cache = other_basis.then(|| Cache::new(self.budget_bytes));
        self.next = Some((number, garment.clone()));
        self.changed = true;
        Ok(())
    }

    /// A chunk arrived, its hash verified. Chunks of other garments are passed over.
    ///
    /// # Errors
    /// It is broken; it is not wanted again before the next version.
    pub fn handle_chunk(&mut self, chunk: ChunkHash, bytes: &[u8]) -> Result<(), LoadError> {
        self.missing.remove(&chunk);
        let read = self.read(chunk, bytes);
        if read.is_err() {
            self.refused.insert(chunk);
        }
        read
    }

    /// The server does not have this chunk: it is not wanted until [`GarmentLoader::retry_missing`].
    pub fn handle_missing(&mut self, chunk: ChunkHash) {
        self.missing.insert(chunk);
    }

    /// The server may have a chunk by now that it did not have.
    pub fn retry_missing(&mut self, chunk: ChunkHash) {
        self.missing.remove(&chunk);
    }

    /// Whether nothing can be played before the next version is announced.
    pub fn is_stuck(&self) -> bool {
        if self.current.is_some() {
            return false;
        }
        let Some((_, next)) = &self.next else { return true };
        let mut stuck = false;
        self.parts.lacking(next, |chunk| stuck |= self.refused.contains(&chunk.hash));
        let initial = next.regions.iter().filter(|region| region.initial);
        stuck || initial.into_iter().any(|region| self.refused.contains(&region.chunk.hash))
    }

    /// Counts what was walked, for prefetching.
    pub fn handle_walked(&mut self, batch: &Batch) {
        for (edge, count) in &batch.edges {
            self.weights.add(*edge, *count);
        }
    }

    /// Shows what has become playable; says whether a new version is among it. Before the first
    /// version is whole, its leading columns are shown.
    ///
    /// # Errors
    /// The next version's parts do not fit together; the current one is played on.
    pub fn show(&mut self) -> Result<bool, LoadError> {
        if !std::mem::take(&mut self.changed) {
            return Ok(false);
        }
        let completed = self.complete_next();
        // What it took in is shown right now.
        self.changed = false;
        if let Some(version) = &self.current {
            let resident = Arc::new(self.cache.snapshot());
            let version = Arc::clone(version);
            let (upsampled, probes) = self.upsampled().unzip();
            self.stage.show(Arc::new(View { version, resident, upsampled, probes }));
        } else {
            self.show_first_cloth();
        }
        completed
    }

    /// What it holds in memory.
    pub fn memory(&self) -> Memory {
        let version = self.current.as_ref();
        let pages: usize = self.parts.pages.values().map(Vec::len).sum();
        Memory {
            regions: self.cache.resident_bytes(),
            initial: self.cache.initial_bytes(),
            links: pages + version.map_or(0, |version| version.link_bytes()),
            scene: version.map_or(0, |version| version.scene().resident_bytes()),
            basis: version.map_or(0, |version| version.basis().resident_bytes()),
            upsampler: self.upsampler_bytes(),
        }
    }

    fn read(&mut self, chunk: ChunkHash, bytes: &[u8]) -> Result<(), LoadError> {
        let garment = self.id();
        if let Some((_, next)) = &self.next {
            let broken = |source| LoadError::Chunk { garment, chunk, source };
            if next.scene.hash == chunk {
                let scene = SceneChunk::decode(bytes).and_then(Scene::new).map_err(broken)?;
                self.parts.scene = Some((chunk, Arc::new(scene)));
                self.changed = true;
            }
            if next.mesh.hash == chunk {
                let mesh = GarmentChunk::decode(bytes).map_err(broken)?;
                self.parts.mesh = Some((chunk, Arc::new(mesh)));
                self.changed = true;
            }
            if next.generations.iter().any(|generation| generation.chunk.hash == chunk) {
                self.parts.generations.insert(chunk, bytes.to_vec());
                self.changed = true;
            }
            if next.links.iter().any(|page| page.hash == chunk) {
                LinkPage::decode(bytes).map_err(broken)?;
                self.parts.pages.insert(chunk, bytes.to_vec());
                self.changed = true;
            }
        }
        self.read_upsampler(chunk, bytes);
        self.read_regions(chunk, bytes)
    }

    fn read_regions(&mut self, chunk: ChunkHash, bytes: &[u8]) -> Result<(), LoadError> {
        let garment = self.id();
        let listed = |listing: &GarmentVersion| {
            let region = listing.regions.iter().find(|r| r.chunk.hash == chunk);
            region.map(|region| (region.initial, decoded_bytes(listing, region)))
        };
        let next = self.next.as_ref().and_then(|(_, next)| listed(next));
        let current = self.current.as_ref().and_then(|version| listed(version.listing()));
        let Some((initial, expected_bytes)) = next.or(current) else { return Ok(()) };
        let regions = RegionChunk::decode(bytes).map_err(|source| LoadError::Chunk {
            garment,
            chunk,
            source,
        })?;
        let of_other_basis = next.is_some() && self.next_cache.is_some();
        let decoded = match &self.parts.basis {
            Some((_, decoder, _)) if !of_other_basis => decode_all(decoder, &regions),
            _ => Ok(None),
        };
        let decoded = decoded.map_err(|why| LoadError::Codec { garment, chunk, why })?;
        let Some(decoded) = decoded else {
            if next.is_some() {
                self.parts.regions.insert(chunk, (regions, initial));
                self.changed = true;
            }
            return Ok(());
        };
        if !initial {
            self.decoded[0] += decoded.iter().map(Region::bytes).sum::<usize>();
            self.decoded[1] += expected_bytes;
        }
        self.take_in(chunk, decoded, initial);
        Ok(())
    }

    /// Makes the next version the current one if nothing of it is lacking.
    fn complete_next(&mut self) -> Result<bool, LoadError> {
        let Some((number, next)) = &self.next else { return Ok(false) };
        let cache = self.next_cache.as_ref().unwrap_or(&self.cache);
        let mut lacking = 0;
        self.parts.lacking(next, |_| lacking += 1);
        let initial = || next.regions.iter().filter(|region| region.initial);
        let here = |chunk| cache.contains(chunk) || self.parts.regions.contains_key(chunk);
        lacking += initial().filter(|region| !here(&region.chunk.hash)).count();
        if lacking > 0 {
            return Ok(false);
        }
        let (number, next) = (*number, next.clone());
        let keep: BTreeSet<ChunkHash> = initial().map(|region| region.chunk.hash).collect();
        // Whatever comes of it, it is not tried again.
        self.next = None;
        let parts = self.parts.parts(number, next)?;
        self.current = Some(Arc::new(Version::assemble(parts)?));
        if let Some(cache) = self.next_cache.take() {
            self.cache = cache;
        }
        self.take_in_regions()?;
        self.cache.retain_initial(&keep);
        Ok(true)
    }

    /// Decodes the regions that waited for the basis.
    fn take_in_regions(&mut self) -> Result<(), LoadError> {
        let garment = self.id();
        for (chunk, (regions, initial)) in std::mem::take(&mut self.parts.regions) {
            let Some((_, decoder, _)) = &self.parts.basis else { return Ok(()) };
            let codec = |why| LoadError::Codec { garment, chunk, why };
            let lacking = || codec("it refers to a basis generation that is not listed".into());
            let decoded = decode_all(decoder, &regions).map_err(codec);
            match decoded.and_then(|decoded| decoded.ok_or_else(lacking)) {
                Ok(decoded) => self.take_in(chunk, decoded, initial),
                Err(error) => {
                    self.refused.insert(chunk);
                    return Err(error);
                }
            }
        }
        Ok(())
    }

    fn take_in(&mut self, chunk: ChunkHash, decoded: Vec<Region>, initial: bool) {
        if self.cache.insert(chunk, decoded, initial, &self.plan.keep) {
            self.changed = true;
        } else {
            self.unfit.insert(chunk);
        }
    }

    fn id(&self) -> GarmentId {
        let next = self.next.as_ref().map(|(_, next)| next.id);
        next.or(self.current.as_ref().map(|v| v.garment())).unwrap_or(GarmentId(0))
    }
}

impl PartsSoFar {
    /// Calls `lacks` for every chunk that is not here, regions apart.
    fn lacking(&self, next: &GarmentVersion, mut lacks: impl FnMut(ChunkRef)) {
        let scene = self.scene.as_ref().map(|(hash, _)| *hash);
        let mesh = self.mesh.as_ref().map(|(hash, _)| *hash);
        if scene != Some(next.scene.hash) {
            lacks(next.scene);
        }
        if mesh != Some(next.mesh.hash) {
            lacks(next.mesh);
        }
        let known = self.known_generations(next);
        let unread = next.generations[known..].iter().map(|generation| generation.chunk);
        unread.filter(|g| !self.generations.contains_key(&g.hash)).for_each(&mut lacks);
        next.links.iter().filter(|p| !self.pages.contains_key(&p.hash)).copied().for_each(lacks);
    }

    /// How many of the listed generations the basis at hand has; 0 if it has others.
    fn known_generations(&self, next: &GarmentVersion) -> usize {
        let Some((hashes, ..)) = &self.basis else { return 0 };
        let listed = next.generations.iter().map(|generation| generation.chunk.hash);
        let same = listed.zip(hashes).filter(|(a, b)| a == *b).count();
        if same == hashes.len() { same } else { 0 }
    }

    /// All parts of a version of which nothing is lacking; forgets what it does not need.
    fn parts(&mut self, number: VersionNumber, next: GarmentVersion) -> Result<Parts, LoadError> {
        let basis = self.basis(&next)?;
        let parts = self.with_basis(number, next, basis)?;
        let listed: BTreeSet<ChunkHash> = parts.garment.links.iter().map(|p| p.hash).collect();
        self.pages.retain(|hash, _| listed.contains(hash));
        Ok(parts)
    }

    /// All parts of a version, on this basis.
    fn with_basis(
        &self,
        number: VersionNumber,
        next: GarmentVersion,
        basis: Arc<Basis>,
    ) -> Result<Parts, LoadError> {
        let garment = next.id;
        let mut pages = Vec::with_capacity(next.links.len());
        for page in &next.links {
            let chunk = page.hash;
            let bytes = self.pages.get(&chunk).map_or(&[][..], Vec::as_slice);
            let page = LinkPage::decode(bytes);
            pages.push(page.map_err(|source| LoadError::Chunk { garment, chunk, source })?);
        }
        let lost = |chunk, what: &str| LoadError::Codec { garment, chunk, why: what.to_owned() };
        let scene = self.scene.as_ref().ok_or_else(|| lost(next.scene.hash, "no scene"))?;
        let mesh = self.mesh.as_ref().ok_or_else(|| lost(next.mesh.hash, "no mesh"))?;
        let (scene, mesh) = (Arc::clone(&scene.1), Arc::clone(&mesh.1));
        Ok(Parts { number, garment: next, scene, mesh, basis, pages })
    }

    /// The basis with all listed generations; appends those that it lacks.
    fn basis(&mut self, next: &GarmentVersion) -> Result<Arc<Basis>, LoadError> {
        let known = self.known_generations(next);
        let mut decoder = match &self.basis {
            Some((hashes, _, basis))
                if known == next.generations.len() && known == hashes.len() =>
            {
                return Ok(Arc::clone(basis));
            }
            Some((_, decoder, _)) if known > 0 => Decoder::clone(decoder),
            _ => Decoder::new(&next.codec).ok_or_else(|| LoadError::Profile {
                garment: next.name.clone(),
                found: next.codec.clone(),
            })?,
        };
        for generation in &next.generations[known..] {
            let chunk = generation.chunk.hash;
            let codec = |why| LoadError::Codec { garment: next.id, chunk, why };
            let bytes = self.generations.get(&chunk).map_or(&[][..], Vec::as_slice);
            decoder.append(bytes).map_err(|e| codec(e.to_string()))?;
        }
        let hashes = next.generations.iter().map(|generation| generation.chunk.hash).collect();
        let basis = Arc::new(decoder.basis().clone());
        self.basis = Some((hashes, decoder, Arc::clone(&basis)));
        self.generations.clear();
        Ok(basis)
    }
}

/// All regions of a chunk as the publisher rounded them; `None` where one needs a generation that
/// is not here yet.
fn decode_all(decoder: &Decoder, chunk: &RegionChunk) -> Result<Option<Vec<Region>>, String> {
    let decoded: Result<Vec<Option<Region>>, String> =
        chunk.regions.iter().map(|entry| decode(decoder, entry)).collect();
    Ok(decoded?.into_iter().collect())
}

fn decode(decoder: &Decoder, entry: &RegionEntry) -> Result<Option<Region>, String> {
    let region = decoder.region(&entry.bytes).map_err(|e| e.to_string())?;
    if region.states != usize::from(entry.state_count) {
        let (found, listed) = (region.states, entry.state_count);
        return Err(format!("a region of {found} states where {listed} are listed"));
    }
    if !region.is_whole {
        return Ok(None);
    }
    let decoded = Region::new(entry.first_state, region.columns, region.coefficients);
    let decoded = decoded.with_tiers(&region.by_energy, region.tier_errors_m);
    Ok(Some(decoded.with_fixes(region.fixes)))
}

#[cfg(test)]
mod tests;

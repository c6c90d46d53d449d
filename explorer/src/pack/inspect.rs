//! What a store holds: every promise of a version checked, and its figures.

use object_store::ObjectStore;
use protocol::links::{LinkEntry, LinkPage};
use protocol::manifest::{GarmentVersion, VersionStats};
use protocol::region::{RegionChunk, RegionEntry};
use protocol::scene::{GarmentChunk, SceneChunk};
use protocol::{ChunkHash, DecodeError, LinkTable, NotTotal, PublisherKey, StateId, VersionNumber};

use codec::upsample::{UpsampleError, Upsampler};
use codec::{Decoder, DecoderError};

use super::store::{self, StoreError};

/// A version that holds what it promises.
#[derive(Debug, Clone, PartialEq)]
pub struct Inspection {
    /// Its number.
    pub version: VersionNumber,
    /// Who signed it.
    pub publisher: PublisherKey,
    /// Its garments, by id.
    pub garments: Vec<GarmentInspection>,
}

/// One garment of it.
#[derive(Debug, Clone, PartialEq)]
pub struct GarmentInspection {
    /// Its name.
    pub name: String,
    /// Poses of the primary graph.
    pub poses: usize,
    /// States of the version, dead ends included, retired ones not.
    pub states: u64,
    /// Regions.
    pub regions: usize,
    /// Dead ends, each merged into an interior state.
    pub merges: u64,
    /// Largest merge error (mm).
    pub worst_error_mm: f32,
    /// Whether every edge of every state leads to a state, as checked just now.
    pub total: bool,
    /// Why not, if not.
    pub not_total: Option<NotTotal>,
    /// Columns of all generations.
    pub rank: usize,
    /// Basis generations.
    pub generations: usize,
    /// Largest vertex error of any region (mm).
    pub codec_max_error_mm: f32,
    /// Root mean square vertex error (mm), as the publisher measured it.
    pub codec_rms_error_mm: f32,
    /// Bytes of all generations.
    pub basis_bytes: u64,
    /// Bytes of all region chunks.
    pub region_bytes: u64,
    /// Bytes of all link pages.
    pub link_bytes: u64,
    /// Raw f32 positions of all its states, in bytes.
    pub raw_bytes: u64,
    /// Everything else that the publisher stated.
    pub stats: VersionStats,
}

/// Which promise is broken.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum InspectError {
    /// The store fails, or a chunk is missing or corrupted.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The store does not say whose it is.
    #[error("the store has no {}; is this a store?", protocol::store::PUBLISHER)]
    NoPublisher,
    /// A chunk whose bytes are as promised, but make no sense.
    #[error("chunk {hash}: {source}")]
    Chunk {
        /// Its name.
        hash: ChunkHash,
        /// What is wrong.
        source: ChunkError,
    },
    /// A codec that this build does not have.
    #[error("garment {garment:?} is in codec {codec:?}; this build reads {:?}", Decoder::PROFILES)]
    Codec {
        /// Name of the garment.
        garment: String,
        /// Name of the codec.
        codec: String,
    },
    /// A state that no region covers.
    #[error("garment {garment:?}: no region covers state {state}")]
    Uncovered {
        /// Name of the garment.
        garment: String,
        /// The first such state.
        state: StateId,
    },
    /// The manifest states a smaller error than a region of it.
    #[error("garment {garment:?}: the manifest states {stated_m} m, a region {found_m} m")]
    ErrorStated {
        /// Name of the garment.
        garment: String,
        /// In the manifest (m).
        stated_m: f32,
        /// In a region (m).
        found_m: f32,
    },
    /// The manifest states another figure than its link pages.
    #[error("garment {garment:?}: the manifest states {stated} {what}, its links hold {found}")]
    Figure {
        /// Name of the garment.
        garment: String,
        /// Which figure.
        what: &'static str,
        /// In the manifest.
        stated: f64,
        /// In the link pages.
        found: f64,
    },
}

/// What is wrong inside a chunk.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ChunkError {
    /// The container.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// A basis generation.
    #[error(transparent)]
    Generation(#[from] DecoderError),
    /// A region's bytes.
    #[error("region of state {state}: {source}")]
    Region {
        /// Its first state.
        state: StateId,
        /// What is wrong.
        source: DecoderError,
    },
    /// An upsampler.
    #[error(transparent)]
    Upsampler(#[from] UpsampleError),
    /// Something that does not match what lists it.
    #[error("{what} is {found}, but {expected} is promised")]
    Mismatch {
        /// Which figure.
        what: &'static str,
        /// What the chunk holds.
        found: u64,
        /// What was promised.
        expected: u64,
    },
}

/// Reads a version (the head where `number` is `None`) and checks its signature, every chunk's
/// hash, that every region decodes with the basis, that an upsampler can be read, that every state is covered, that the stated figures of
/// states and merges are those of the links, and totality.
///
/// # Errors
/// The first broken promise, by name. A table that is not total is no error: see
/// [`GarmentInspection::total`].
pub async fn inspect(
    from: &dyn ObjectStore,
    number: Option<VersionNumber>,
) -> Result<Inspection, InspectError> {
    let head = store::head_number(from).await?.ok_or(StoreError::Empty)?;
    let publisher = store::publisher(from).await?.ok_or(InspectError::NoPublisher)?;
    let version = number.unwrap_or(head);
    let signed = store::version(from, version, &publisher).await?;
    let mut garments = Vec::new();
    for garment in &signed.manifest.garments {
        garments.push(inspect_garment(from, garment).await?);
    }
    Ok(Inspection { version, publisher, garments })
}

async fn inspect_garment(
    from: &dyn ObjectStore,
    garment: &GarmentVersion,
) -> Result<GarmentInspection, InspectError> {
    let Some(decoder) = Decoder::new(&garment.codec) else {
        let (garment, codec) = (garment.name.clone(), garment.codec.clone());
        return Err(InspectError::Codec { garment, codec });
    };
    let bytes = store::chunk(from, &garment.scene).await?;
    let scene = SceneChunk::decode(&bytes).map_err(|e| wrong(garment.scene.hash, e))?;
    let bytes = store::chunk(from, &garment.mesh).await?;
    let mesh = GarmentChunk::decode(&bytes).map_err(|e| wrong(garment.mesh.hash, e))?;
    let rows = 3 * mesh.vertex_count as usize;
    let (decoder, ends) = read_basis(from, garment, decoder, rows).await?;
    let regions = read_regions(from, garment, &decoder, &ends).await?;
    let found_m = regions.iter().map(|region| region.max_error_m).fold(0.0, f32::max);
    let stated_m = garment.stats.codec_max_error_m;
    if found_m > stated_m {
        let garment = garment.name.clone();
        return Err(InspectError::ErrorStated { garment, stated_m, found_m });
    }
    let mut pages = Vec::new();
    for page in &garment.links {
        let bytes = store::chunk(from, page).await?;
        pages.push(LinkPage::decode(&bytes).map_err(|e| wrong(page.hash, e))?);
    }
    let states = pages.iter().map(|page| page.entries.len() as u64).sum();
    check_coverage(garment, &regions, states)?;
    check_figures(garment, &pages)?;
    if let Some(upsampler) = &garment.upsampler {
        let bytes = store::chunk(from, upsampler).await?;
        let read = Upsampler::decode(&bytes).map_err(|e| wrong(upsampler.hash, e))?;
        same(upsampler.hash, "fine vertices", read.fine() as u64, u64::from(mesh.vertex_count))?;
    }
    let table = LinkTable::new(&pages, scene.poses.len(), &scene.edges);
    Ok(GarmentInspection {
        name: garment.name.clone(),
        poses: scene.poses.len(),
        states: garment.stats.states,
        regions: regions.len(),
        merges: garment.stats.merges,
        worst_error_mm: 1e3 * garment.stats.worst_error_m,
        total: table.is_ok(),
        not_total: table.err(),
        rank: decoder.basis().columns(),
        generations: ends.len(),
        codec_max_error_mm: 1e3 * found_m,
        codec_rms_error_mm: 1e3 * garment.stats.codec_rms_error_m,
        basis_bytes: sum(garment.generations.iter().map(|generation| generation.chunk.bytes)),
        region_bytes: sum(garment.regions.iter().map(|region| region.chunk.bytes)),
        link_bytes: sum(garment.links.iter().map(|page| page.bytes)),
        raw_bytes: garment.stats.raw_bytes,
        stats: garment.stats,
    })
}

/// The basis, and how many columns there are up to and with each generation.
async fn read_basis(
    from: &dyn ObjectStore,
    garment: &GarmentVersion,
    mut decoder: Decoder,
    rows: usize,
) -> Result<(Decoder, Vec<usize>), InspectError> {
    let mut ends = Vec::new();
    for listed in &garment.generations {
        let hash = listed.chunk.hash;
        let bytes = store::chunk(from, &listed.chunk).await?;
        let before = decoder.basis().columns();
        decoder.append(&bytes).map_err(|e| wrong(hash, e))?;
        let columns = decoder.basis().columns();
        same(hash, "rows", decoder.basis().rows() as u64, rows as u64)?;
        same(hash, "columns", (columns - before) as u64, u64::from(listed.columns))?;
        ends.push(columns);
    }
    Ok((decoder, ends))
}

async fn read_regions(
    from: &dyn ObjectStore,
    garment: &GarmentVersion,
    decoder: &Decoder,
    ends: &[usize],
) -> Result<Vec<RegionEntry>, InspectError> {
    let mut regions = Vec::new();
    for listed in &garment.regions {
        let hash = listed.chunk.hash;
        let bytes = store::chunk(from, &listed.chunk).await?;
        let chunk = RegionChunk::decode(&bytes).map_err(|e| wrong(hash, e))?;
        let first = chunk.regions.first().map_or(0, |region| region.first_state.0);
        same(hash, "first state", first, listed.first_state.0)?;
        let states = chunk.regions.iter().map(|region| u64::from(region.state_count)).sum();
        same(hash, "state count", states, u64::from(listed.state_count))?;
        for entry in &chunk.regions {
            let state = entry.first_state;
            let region = decoder
                .region(&entry.bytes)
                .map_err(|source| wrong(hash, ChunkError::Region { state, source }))?;
            let states = region.states as u64;
            same(hash, "states of a region", states, u64::from(entry.state_count))?;
            let columns = ends.get(entry.generation.index()).copied().unwrap_or(0);
            same(hash, "columns of a region", region.columns as u64, columns as u64)?;
        }
        regions.extend(chunk.regions);
    }
    Ok(regions)
}

fn check_coverage(
    garment: &GarmentVersion,
    regions: &[RegionEntry],
    states: u64,
) -> Result<(), InspectError> {
    let mut end = 0;
    for region in regions {
        if region.first_state.0 > end {
            break;
        }
        end = end.max(region.first_state.0 + u64::from(region.state_count));
    }
    if end >= states {
        return Ok(());
    }
    Err(InspectError::Uncovered { garment: garment.name.clone(), state: StateId(end) })
}

/// States, merges and their errors, as the links have them.
fn check_figures(garment: &GarmentVersion, pages: &[LinkPage]) -> Result<(), InspectError> {
    let (mut states, mut merges, mut sum_m, mut worst_m) = (0u64, 0u64, 0f64, 0f32);
    for entry in pages.iter().flat_map(|page| &page.entries) {
        states += u64::from(!matches!(entry, LinkEntry::Retired { .. }));
        if let LinkEntry::DeadEnd { error_m, .. } = entry {
            merges += 1;
            sum_m += f64::from(*error_m);
            worst_m = worst_m.max(*error_m);
        }
    }
    let stats = &garment.stats;
    let mean_m = sum_m / merges.max(1) as f64;
    let worst = (f64::from(stats.worst_error_m), f64::from(worst_m));
    let figures = [
        ("states", stats.states as f64, states as f64, 0.0),
        ("merges", stats.merges as f64, merges as f64, 0.0),
        ("m of worst merge error", worst.0, worst.1, 0.0),
        // A mean is summed in whatever order, and rounded.
        ("m of mean merge error", f64::from(stats.mean_error_m), mean_m, 1e-6 * mean_m.max(1e-3)),
    ];
    for (what, stated, found, slack) in figures {
        if (stated - found).abs() > slack {
            let garment = garment.name.clone();
            return Err(InspectError::Figure { garment, what, stated, found });
        }
    }
    Ok(())
}

fn wrong(hash: ChunkHash, source: impl Into<ChunkError>) -> InspectError {
    InspectError::Chunk { hash, source: source.into() }
}

fn same(
    hash: ChunkHash,
    what: &'static str,
    found: u64,
    expected: u64,
) -> Result<(), InspectError> {
    let mismatch = ChunkError::Mismatch { what, found, expected };
    if found == expected { Ok(()) } else { Err(wrong(hash, mismatch)) }
}

fn sum(bytes: impl Iterator<Item = u32>) -> u64 {
    bytes.map(u64::from).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::manifest::ChunkRef;
    use protocol::{GarmentId, PoseId};

    #[test]
    fn figures_that_are_not_those_of_the_links_are_refused() {
        let dead = |error_m| LinkEntry::DeadEnd { pose: PoseId(0), target: StateId(0), error_m };
        let entries = vec![
            LinkEntry::Interior { pose: PoseId(0), next: vec![StateId(1)] },
            dead(0.25),
            dead(0.5),
            LinkEntry::Retired { pose: PoseId(0), successor: StateId(0) },
        ];
        let pages = [LinkPage { first_state: StateId(0), entries }];
        let stats = VersionStats {
            states: 3,
            merges: 2,
            worst_error_m: 0.5,
            mean_error_m: 0.375,
            ..VersionStats::default()
        };
        let chunk = ChunkRef { hash: ChunkHash::of(b""), bytes: 0 };
        let garment = |stats| GarmentVersion {
            id: GarmentId(0),
            name: "flag".into(),
            codec: "toile".into(),
            scene: chunk,
            mesh: chunk,
            generations: Vec::new(),
            regions: Vec::new(),
            links: Vec::new(),
            stats,
            upsampler: None,
        };
        check_figures(&garment(stats), &pages).unwrap();
        let forged = [
            ("states", VersionStats { states: 4, ..stats }),
            ("merges", VersionStats { merges: 1, ..stats }),
            ("worst", VersionStats { worst_error_m: 0.25, ..stats }),
            ("mean", VersionStats { mean_error_m: 0.3, ..stats }),
        ];
        for (what, stats) in forged {
            let error = check_figures(&garment(stats), &pages).unwrap_err().to_string();
            assert!(error.contains(what), "{error}");
        }
    }
}

//! A version as the client plays it: immutable, assembled off the frame loop, swapped in between
//! two frames.

use std::sync::Arc;

use codec::Basis;
use protocol::links::LinkPage;
use protocol::manifest::{GarmentVersion, RegionChunkRef};
use protocol::scene::GarmentChunk;
use protocol::table::Entry;
use protocol::{ChunkHash, GarmentId, LinkTable, NotTotal, PoseId, StateId, VersionNumber};

use crate::cache::{Region, Resident};
use crate::free::Upsampled;
use crate::free::probe::Probes;
use crate::scene::Scene;

/// One garment of one version: everything but the coefficients.
#[derive(Debug)]
pub struct Version {
    number: VersionNumber,
    garment: GarmentVersion,
    scene: Arc<Scene>,
    mesh: Arc<GarmentChunk>,
    basis: Arc<Basis>,
    links: LinkTable,
    columns_to_come: usize,
}

/// The parts of a version, each read and checked on its own; shared with the version before
/// where they did not change.
#[derive(Debug)]
pub struct Parts {
    /// The version's number.
    pub number: VersionNumber,
    /// Its listing, out of a manifest whose signature was checked.
    pub garment: GarmentVersion,
    /// From the chunk `garment.scene`.
    pub scene: Arc<Scene>,
    /// From the chunk `garment.mesh`.
    pub mesh: Arc<GarmentChunk>,
    /// From all chunks of `garment.generations`, or from the leading ones.
    pub basis: Arc<Basis>,
    /// From all chunks of `garment.links`, in order.
    pub pages: Vec<LinkPage>,
}

/// Why parts do not make a version.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum VersionError {
    /// The transition table leads nowhere somewhere.
    #[error("version {number} of garment {garment} cannot be played: {source}")]
    NotTotal {
        /// The version.
        number: VersionNumber,
        /// The garment.
        garment: GarmentId,
        /// What is wrong.
        source: NotTotal,
    },
    /// Mesh and basis are not of one garment.
    #[error(
        "version {number}: the basis has {rows} rows, but the mesh has {vertices} vertices \
         (three rows each)"
    )]
    MeshMismatch {
        /// The version.
        number: VersionNumber,
        /// Rows of the basis.
        rows: usize,
        /// Vertices of the mesh.
        vertices: u32,
    },
}

impl Version {
    /// Puts a version together and proves its transition table total.
    ///
    /// Cost: linear in states and links; never done on the frame loop.
    ///
    /// # Errors
    /// Parts that do not fit each other.
    pub fn assemble(parts: Parts) -> Result<Self, VersionError> {
        let Parts { number, garment, scene, mesh, basis, pages } = parts;
        let rows = basis.rows();
        if rows != 3 * mesh.vertex_count as usize {
            let vertices = mesh.vertex_count;
            return Err(VersionError::MeshMismatch { number, rows, vertices });
        }
        let links = LinkTable::new(&pages, scene.pose_count(), scene.edges())
            .map_err(|source| VersionError::NotTotal { number, garment: garment.id, source })?;
        let listed = garment.generations.iter().map(|g| usize::from(g.columns)).sum::<usize>();
        let columns_to_come = listed.saturating_sub(basis.columns());
        Ok(Self { number, garment, scene, mesh, basis, links, columns_to_come })
    }

    /// Its number.
    pub fn number(&self) -> VersionNumber {
        self.number
    }

    /// The garment's id.
    pub fn garment(&self) -> GarmentId {
        self.garment.id
    }

    /// The listing it was made from.
    pub fn listing(&self) -> &GarmentVersion {
        &self.garment
    }

    /// The character and its primary graph.
    pub fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    /// The garment's mesh.
    pub fn mesh(&self) -> &Arc<GarmentChunk> {
        &self.mesh
    }

    /// The basis: all generations, or the leading ones where [`Version::columns_to_come`] says so.
    pub fn basis(&self) -> &Arc<Basis> {
        &self.basis
    }

    /// Columns that are still on their way: first cloth is shown with the leading ones.
    pub fn columns_to_come(&self) -> usize {
        self.columns_to_come
    }

    /// Which state follows which.
    pub fn links(&self) -> &LinkTable {
        &self.links
    }

    /// Coefficients of one version can be mixed with those of another where this is equal: the
    /// oldest generation, to which the others only append.
    pub fn lineage(&self) -> Option<ChunkHash> {
        self.garment.generations.first().map(|generation| generation.chunk.hash)
    }

    /// The chunk in which a state's region lies.
    pub fn region_chunk(&self, state: StateId) -> Option<&RegionChunkRef> {
        let regions = &self.garment.regions;
        let after = regions.partition_point(|r| r.first_state <= state);
        let region = &regions[after.checked_sub(1)?];
        let covered = state.0 - region.first_state.0 < u64::from(region.state_count);
        covered.then_some(region)
    }

    /// Where a character enters a pose that it cannot walk to: the pose of the first state.
    pub fn start(&self) -> PoseId {
        self.links.pose(StateId(0)).unwrap_or(PoseId(0))
    }

    /// Whether a state can be played here.
    pub fn is_interior(&self, state: StateId) -> bool {
        matches!(self.links.entry(state), Some(Entry::Interior(_)))
    }

    /// Memory of the transition table, about, in bytes.
    pub fn link_bytes(&self) -> usize {
        let states = self.links.state_count();
        let mut links = 0;
        for pose in 0..self.scene.pose_count() as u32 {
            let interior = self.links.interior(PoseId(pose)).len();
            links += interior * (self.scene.out_degree(PoseId(pose)) + 1);
        }
        states * 32 + links * size_of::<StateId>()
    }
}

/// About what a region chunk takes in memory once it is decoded, in bytes.
pub fn decoded_bytes(garment: &GarmentVersion, region: &RegionChunkRef) -> usize {
    let columns =
        garment.generations.iter().map(|generation| usize::from(generation.columns)).sum();
    Region::bytes_expected(region.state_count as usize, columns)
}

/// What a character plays from: a version and the coefficients that are resident.
#[derive(Debug, Clone)]
pub struct View {
    /// The version.
    pub version: Arc<Version>,
    /// The coefficients.
    pub resident: Arc<Resident>,
    /// What cloth leaves the graph with, once it is here.
    pub upsampled: Option<Arc<Upsampled>>,
    /// How it finds back.
    pub probes: Option<Arc<Probes>>,
}

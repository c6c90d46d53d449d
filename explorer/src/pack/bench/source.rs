//! Exact states of an explored store, region by region.

use std::path::Path;

use object_store::ObjectStore;
use protocol::links::{LinkEntry, LinkPage};
use protocol::region::RegionChunk;
use protocol::scene::SceneChunk;
use protocol::{PoseId, StateId};

use super::super::store;
use super::BenchError;
use crate::grow::states::StateFile;

/// Regions of exact states, read one at a time.
pub struct Source {
    states: Exact,
    regions: Vec<(StateId, usize)>,
    vertices: usize,
    scene: Option<SceneChunk>,
    /// By state id.
    links: Vec<LinkEntry>,
    /// Processor time of simulating a state (s), where it was recorded.
    simulate_s: Option<f64>,
}

enum Exact {
    File(StateFile),
    Memory(Vec<f32>),
}

impl Source {
    /// The newest version of a store's first garment: which states its regions hold. Their exact
    /// positions come from the work folder. At most `states` of them, whole regions spread evenly.
    ///
    /// # Errors
    /// The store or the work folder cannot be read.
    pub async fn open(
        from: &dyn ObjectStore,
        work: &Path,
        states: Option<usize>,
    ) -> Result<Self, BenchError> {
        let number = store::head_number(from).await?.ok_or(BenchError::Nothing("version"))?;
        let publisher = store::publisher(from).await?.ok_or(BenchError::Nothing("publisher"))?;
        let head = store::version(from, number, &publisher).await?.manifest;
        let garment = head.garments.first().ok_or(BenchError::Nothing("garment"))?;
        let path = work.join("states");
        let failed = |source| BenchError::States { path: path.clone(), source };
        let file = StateFile::view(&path).map_err(failed)?;
        let vertices = file.vertex_count();
        let mut regions = Vec::new();
        for listed in &garment.regions {
            let bytes = store::chunk(from, &listed.chunk).await?;
            let chunk = RegionChunk::decode(&bytes)?;
            regions
                .extend(chunk.regions.iter().map(|r| (r.first_state, usize::from(r.state_count))));
        }
        let all: usize = regions.iter().map(|(_, count)| count).sum();
        let every = states.map_or(1, |states| all.div_ceil(states.max(1)));
        let regions: Vec<_> = regions.into_iter().step_by(every).collect();
        if regions.is_empty() {
            return Err(BenchError::Nothing("region"));
        }
        let scene = SceneChunk::decode(&store::chunk(from, &garment.scene).await?)?;
        let mut links = Vec::with_capacity(all);
        for page in &garment.links {
            links.extend(LinkPage::decode(&store::chunk(from, page).await?)?.entries);
        }
        let cpu = std::fs::read(work.join("simulate_cpu_s")).ok();
        let cpu = cpu.and_then(|bytes| Some(f64::from_le_bytes(bytes.try_into().ok()?)));
        let simulate_s = cpu.filter(|s| s.is_finite() && *s > 0.0).map(|s| s / all as f64);
        let (states, scene) = (Exact::File(file), Some(scene));
        Ok(Self { states, regions, vertices, scene, links, simulate_s })
    }

    /// States in memory, `3 * vertices` numbers each (m), in regions of `count`.
    pub fn from_memory(states: Vec<f32>, vertices: usize, count: usize) -> Self {
        let all = states.len() / (3 * vertices);
        let region = |first: usize| (StateId(first as u64), count.min(all - first));
        let regions = (0..all).step_by(count).map(region).collect();
        let (states, links) = (Exact::Memory(states), Vec::new());
        Self { states, regions, vertices, scene: None, links, simulate_s: None }
    }

    /// Vertices of a state.
    pub fn vertices(&self) -> usize {
        self.vertices
    }

    /// Number of regions.
    pub fn regions(&self) -> usize {
        self.regions.len()
    }

    /// Number of states.
    pub fn states(&self) -> usize {
        self.regions.iter().map(|(_, count)| count).sum()
    }

    /// First state of a region, and how many follow each other.
    pub fn region(&self, region: usize) -> (StateId, usize) {
        self.regions[region]
    }

    /// The character, where a store was opened.
    pub fn scene(&self) -> Option<&SceneChunk> {
        self.scene.as_ref()
    }

    /// The pose of a state, where a store was opened.
    pub fn pose(&self, state: StateId) -> Option<PoseId> {
        self.link(state).map(LinkEntry::pose)
    }

    fn link(&self, state: StateId) -> Option<&LinkEntry> {
        self.links.get(state.0 as usize)
    }

    /// Whether a state is playable and one of its edges leads to another.
    pub fn leads(&self, from: StateId, to: StateId) -> bool {
        matches!(self.link(from), Some(LinkEntry::Interior { next, .. }) if next.contains(&to))
    }

    /// What a dead end is merged into; `None` for any other state.
    pub fn merged_into(&self, dead_end: StateId) -> Option<StateId> {
        match self.link(dead_end)? {
            LinkEntry::DeadEnd { target, .. } => Some(*target),
            _ => None,
        }
    }

    /// The first playable state that a playable state leads to without a merge.
    pub fn next_playable(&self, state: StateId) -> Option<StateId> {
        let Some(LinkEntry::Interior { next, .. }) = self.link(state) else { return None };
        let playable = |s: &&StateId| matches!(self.link(**s), Some(LinkEntry::Interior { .. }));
        next.iter().find(playable).copied()
    }

    /// How many states have links.
    pub fn linked_states(&self) -> u64 {
        self.links.len() as u64
    }

    /// Processor time of simulating one state (s), as the work folder recorded it.
    pub fn simulate_s(&self) -> Option<f64> {
        self.simulate_s
    }

    /// Positions (m) of a region's states, one after the other; `out` is resized.
    ///
    /// # Errors
    /// The state file cannot be read.
    pub fn read(&self, region: usize, out: &mut Vec<f32>) -> std::io::Result<()> {
        let (first, count) = self.regions[region];
        let rows = 3 * self.vertices;
        out.resize(rows * count, 0.0);
        for (state, out) in (first.0..).zip(out.chunks_exact_mut(rows)) {
            self.read_state(StateId(state), out)?;
        }
        Ok(())
    }

    /// Positions (m) of one state, `3 * vertices` numbers.
    ///
    /// # Errors
    /// The state file cannot be read.
    pub fn read_state(&self, state: StateId, out: &mut [f32]) -> std::io::Result<()> {
        match &self.states {
            Exact::Memory(states) => {
                let from = state.0 as usize * out.len();
                out.copy_from_slice(&states[from..from + out.len()]);
            }
            Exact::File(file) => {
                let state = file.read(state)?;
                for (vertex, out) in out.chunks_exact_mut(3).enumerate() {
                    out.copy_from_slice(&state.position(vertex).to_array());
                }
            }
        }
        Ok(())
    }
}

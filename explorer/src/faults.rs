//! Why frames were flagged: found again from the states alone, so that any work folder can be asked.

use std::collections::BTreeMap;

use protocol::StateId;
use serde::Serialize;

use crate::cloth_simulator::ClothSimulator;
use crate::grow::archive::Archive;
use crate::grow::class;
use crate::scene::Scene;
use crate::simulator::SimulateError;
use crate::watchdog::Fault;

/// Flagged frames by cause, the first that applies, and by clip.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Flagged {
    /// All of them.
    pub frames: u64,
    /// An edge is longer than cloth can be.
    pub strain: u64,
    /// A vertex is faster than the body could make it.
    pub speed: u64,
    /// Too large a part of the cloth is deep in the body.
    pub deep: u64,
    /// The cloth cuts itself in more places than in the frame before.
    pub crossings: u64,
    /// Within bounds as it is kept: the fault was in rounding.
    pub none: u64,
    /// By the clip of their pose, the most first.
    pub clips: Vec<ClipFlagged>,
}

/// A clip's share of the flagged frames.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ClipFlagged {
    /// Its name.
    pub clip: String,
    /// How many.
    pub frames: u64,
}

/// Why flagged frames cannot be looked at.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FaultsError {
    /// The garment cannot be set up.
    #[error(transparent)]
    Simulator(#[from] SimulateError),
    /// A state cannot be read.
    #[error("state {0} cannot be read: {1}")]
    Read(StateId, std::io::Error),
}

/// Looks at every flagged state of a work folder that our own simulator made.
///
/// # Errors
/// The garment cannot be set up or a state not be read.
pub fn flagged(archive: &Archive, scene: &Scene) -> Result<Flagged, FaultsError> {
    let mut simulator = ClothSimulator::new(scene)?;
    let mut found = Flagged::default();
    let mut clips = BTreeMap::<u16, u64>::new();
    let read = |id: StateId| archive.state(id).map_err(|e| FaultsError::Read(id, e));
    for (id, state) in (0..).map(StateId).zip(archive.graph().states()) {
        let Some((parent, edge)) = state.parent.filter(|_| state.class & class::FLAGGED != 0)
        else {
            continue;
        };
        found.frames += 1;
        *clips.entry(scene.primary.pose(state.pose).clip).or_default() += 1;
        *match simulator.fault((&read(parent)?, &read(id)?), edge) {
            Some(Fault::Strain(_)) => &mut found.strain,
            Some(Fault::Speed(_)) => &mut found.speed,
            Some(Fault::Deep(_)) => &mut found.deep,
            Some(Fault::Crossings(_)) => &mut found.crossings,
            None => &mut found.none,
        } += 1;
    }
    let name = |(clip, frames): (u16, u64)| ClipFlagged {
        clip: scene.primary.clips()[usize::from(clip)].clone(),
        frames,
    };
    found.clips = clips.into_iter().map(name).collect();
    found.clips.sort_by_key(|clip| std::cmp::Reverse(clip.frames));
    Ok(found)
}

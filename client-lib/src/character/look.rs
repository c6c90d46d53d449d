//! For tools that look: placing a character at a state, reading states, what was just passed.

use codec::ReconstructError;
use protocol::StateId;

use super::{Character, Shown};
use crate::blend::BlendMode;
use crate::placement::Placement;

/// A merge that a step went through.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Passed {
    /// The state that was simulated next.
    pub dead_end: StateId,
    /// The state that is played instead.
    pub target: StateId,
    /// Distance of the two (m), by the garment's metric.
    pub error_m: f32,
}

impl Character {
    /// The merge that the last step went through, if it did.
    pub fn passed(&self) -> Option<Passed> {
        self.passed
    }

    /// Chooses how the offset of a merge disappears.
    pub fn set_blend(&mut self, mode: BlendMode) {
        self.blend.set_mode(mode);
    }

    /// Whether what this character walks is reported to the server; `true` at first. A tool that walks
    /// where no player does would pull the exploration after it.
    pub fn set_counted(&mut self, counted: bool) {
        self.counted = counted;
    }

    /// Coefficients of a state (fractions of full scale) into `out`, where they are resident.
    pub fn read(&self, state: StateId, out: &mut [f32]) -> bool {
        self.view.resident.read(state, out)
    }

    /// Positions of a state (m, 3 a vertex, in the state frame) with every column and the state's own
    /// fixes, into `out`; `false` where it is not resident.
    ///
    /// # Errors
    /// A basis that cannot be applied; no version that was taken up has one.
    pub fn cloth_of(&self, state: StateId, out: &mut Vec<f32>) -> Result<bool, ReconstructError> {
        let basis = self.view.version.basis();
        let mut coefficients = vec![0.0; basis.columns()];
        if !self.view.resident.read(state, &mut coefficients) {
            return Ok(false);
        }
        out.resize(basis.rows(), 0.0);
        basis.reconstruct(&coefficients, 0..basis.rows(), basis.columns(), out)?;
        let mut fixes = Vec::new();
        self.view.resident.fixes(state, &mut fixes);
        for (vertex, offset) in fixes {
            let at = 3 * vertex as usize;
            let rows = out.get_mut(at..at + 3).into_iter().flatten();
            rows.zip(offset).for_each(|(row, part)| *row += part);
        }
        Ok(true)
    }

    /// Takes up a newer version without a step, so that [`Character::version`] is what the next
    /// step will play from.
    pub fn refresh(&mut self) {
        self.take_newer_view();
    }

    /// Goes to a state, or to where one goes on that plays it, at the origin of its clip, without a
    /// blend. The step counts as none. `false`, and nothing happens, where the version does not have
    /// the state; where it is not resident yet, the last cloth is shown until it is.
    pub fn place(&mut self, state: StateId) -> bool {
        self.take_newer_view();
        let view = std::sync::Arc::clone(&self.view);
        let Some(state) = view.version.links().resume(state) else { return false };
        let Some(pose) = view.version.links().pose(state) else { return false };
        self.stop_outside();
        self.blend.clear();
        self.passed = None;
        self.state = state;
        self.cursor.set(state);
        self.placement = Placement::at(pose);
        self.placement_before = self.placement;
        let resident = view.resident.read(state, &mut self.base);
        self.shown_by = if resident { Shown::Named } else { Shown::Last };
        self.compose();
        self.before.copy_from_slice(&self.now);
        true
    }

    /// Goes to where another character stands, in the world too: the same state where this version
    /// has it, else any of its pose. For the same walk through several versions, side by side.
    pub fn join(&mut self, other: &Self) {
        self.take_newer_view();
        let view = std::sync::Arc::clone(&self.view);
        let pose = other.placement.pose();
        if pose.index() >= view.version.scene().pose_count() {
            return;
        }
        let links = view.version.links();
        let same = links.resume(other.state).filter(|state| links.pose(*state) == Some(pose));
        let Some(state) = same.or_else(|| links.interior(pose).first().copied()) else { return };
        if self.place(state) {
            self.placement = other.placement;
            self.placement_before = other.placement;
        }
    }
}

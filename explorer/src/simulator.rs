//! The simulator as the explorer sees it: a black box (Kim et al. 2013, section 3.2).

use protocol::EdgeId;

use crate::grid::GridState;

/// Given a state and an edge out of its pose, the next state. A job's outcome depends on its
/// inputs alone, bit for bit.
pub trait Simulator: Send {
    /// Simulates one frame along `edge`; `state` is in the state frame of the edge's source, the
    /// result in that of its target.
    ///
    /// # Errors
    /// Whatever went wrong, in words; the job is given up, the run goes on.
    fn step(&mut self, state: &GridState, edge: EdgeId) -> Result<GridState, SimulateError>;

    /// The garment draped on the start pose: checked against the body in the rest pose, brought
    /// to the start pose over some frames, settled.
    ///
    /// # Errors
    /// As for `step`.
    fn drape(&mut self) -> Result<GridState, SimulateError>;
}

/// A frame that could not be simulated.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{0}")]
pub struct SimulateError(pub String);

/// Makes one simulator per worker.
pub trait SimulatorFactory: Sync {
    /// A new simulator of the same scene.
    fn simulator(&self) -> Box<dyn Simulator>;
}

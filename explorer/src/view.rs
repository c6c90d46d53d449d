//! What publishing needs to know of a graph: the seam between [`crate::grow`] and
//! [`crate::pack`].

use protocol::StateId;
use protocol::links::LinkEntry;
use protocol::manifest::VersionStats;

/// A run of consecutive states of one trajectory, each simulated from the one before; the last
/// may be a dead end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Run {
    /// First state.
    pub first: StateId,
    /// How many.
    pub count: u32,
    /// The job that made it; runs of one job are consecutive.
    pub job: u64,
    /// Made while the graph was initialised.
    pub initial: bool,
}

/// A graph at one moment, ready to be published.
pub trait GraphView {
    /// Vertices of a state.
    fn vertex_count(&self) -> usize;

    /// Runs in order of creation; together they cover every state ever created, once.
    fn runs(&self) -> &[Run];

    /// Positions of a state in its state frame (m), `3 * vertex_count` numbers: x0, y0, z0, ...
    ///
    /// # Errors
    /// Working data could not be read.
    fn positions(&self, state: StateId, out: &mut [f32]) -> std::io::Result<()>;

    /// One entry per state ever created, by id.
    fn links(&self) -> Vec<LinkEntry>;

    /// Figures of this moment; the codec's are filled in by the publisher.
    fn stats(&self) -> VersionStats;
}

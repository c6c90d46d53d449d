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
    fn step(&mut self, state: &GridState, edge: EdgeId) -> Result<Frame, SimulateError>;

    /// Whether a step that failed may succeed when it is asked for again, as with a program that
    /// died and is started anew.
    fn may_recover(&self) -> bool {
        false
    }

    /// Whether the last step failed whatever it was: a program that cannot be started, or that
    /// ended before it answered anything.
    fn is_out_of_order(&self) -> bool {
        false
    }

    /// CPU time so far outside of the threads that asked (s): of a program, as far as the system
    /// tells; where it does not, the time that was waited for it.
    fn program_cpu_s(&self) -> f64 {
        0.0
    }

    /// The garment draped on the start pose: checked against the body in the rest pose, brought
    /// to the start pose over some frames, settled. `should_stop` is asked before every frame.
    ///
    /// # Errors
    /// As for `step`; also where it was to stop.
    fn drape(&mut self, should_stop: &dyn Fn() -> bool) -> Result<Frame, SimulateError>;
}

/// A simulated frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// The state at its end.
    pub state: GridState,
    /// What was measured on it.
    pub quality: FrameQuality,
}

/// Measures of one frame's end, or, added up, of many frames.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct FrameQuality {
    /// Frames measured.
    pub frames: u64,
    /// Vertices times frames measured.
    pub vertex_frames: u64,
    /// Of these, deeper than 1 mm in the body and not held between two body parts.
    pub inside_vertex_frames: u64,
    /// Of these, deeper than 5 mm in the body and not held between two body parts.
    pub deep_vertex_frames: u64,
    /// Of these, deeper than 1 mm and held between two body parts.
    pub pinched_vertex_frames: u64,
    /// Deepest vertex that is not held between two body parts (m).
    pub depth_max_m: f32,
    /// Pairs of an edge and a triangle of the cloth that cut each other.
    pub crossings: u64,
    /// Frames in which there is such a pair.
    pub crossed_frames: u64,
    /// Largest strain of an edge (0.1: 10 % longer than at rest), less what rounding to the grid may have
    /// added.
    pub stretch_max: f32,
    /// Fastest vertex (m/s).
    pub speed_max_m_s: f32,
    /// Substeps that were simulated, those of attempts that were given up included.
    pub substeps: u64,
    /// Iterations of conjugate gradients in them.
    pub iterations: u64,
    /// Frames that were simulated again at a finer step.
    pub frames_retried: u64,
    /// Frames that came out of bounds all the same: their states are flagged.
    pub frames_flagged: u64,
}

impl FrameQuality {
    /// Adds the measures of other frames.
    pub fn add(&mut self, other: &Self) {
        self.frames += other.frames;
        self.vertex_frames += other.vertex_frames;
        self.inside_vertex_frames += other.inside_vertex_frames;
        self.deep_vertex_frames += other.deep_vertex_frames;
        self.pinched_vertex_frames += other.pinched_vertex_frames;
        self.depth_max_m = self.depth_max_m.max(other.depth_max_m);
        self.crossings += other.crossings;
        self.crossed_frames += other.crossed_frames;
        self.stretch_max = self.stretch_max.max(other.stretch_max);
        self.speed_max_m_s = self.speed_max_m_s.max(other.speed_max_m_s);
        self.substeps += other.substeps;
        self.iterations += other.iterations;
        self.frames_retried += other.frames_retried;
        self.frames_flagged += other.frames_flagged;
    }
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

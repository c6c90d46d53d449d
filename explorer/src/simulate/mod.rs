//! Straight simulation: a garment along a walk, frame after frame, without a graph.
//!
//! [`Straight`] walks, [`Tally`] adds up what was measured, [`converge`] compares finer steps and
//! meshes.

pub mod converge;
mod tally;

use cloth::{Mesh, Pose, Rigid, Vec3};
use protocol::{EdgeId, PoseId};

use crate::cloth_simulator::ClothSimulator;
use crate::cpu::CpuClock;
use crate::grid::GridState;
use crate::grow::class::{self, Classifier};
use crate::scene::Scene;
use crate::simulator::{Frame, FrameQuality, SimulateError, Simulator};

pub use tally::{Sum, Tally};

/// How a walk is simulated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// Steps are divided by this more than usual.
    pub refine: u32,
    /// The drape is shifted by this before the first frame (m).
    pub nudge_m: f32,
}

impl Default for Options {
    /// As an exploration simulates.
    fn default() -> Self {
        Self { refine: 1, nudge_m: 0.0 }
    }
}

/// A simulated frame of a walk.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step {
    /// What was measured at its end.
    pub quality: FrameQuality,
    /// CPU time of its simulation, measures and retries included (s).
    pub cpu_s: f64,
}

/// A garment on its way.
#[derive(Debug)]
pub struct Straight<'a> {
    scene: &'a Scene,
    simulator: ClothSimulator,
    pose: PoseId,
    /// From the world of the pose's clip into that of the walk.
    place: Rigid,
    state: GridState,
    drape: FrameQuality,
    classifier: Classifier,
}

impl<'a> Straight<'a> {
    /// Drapes the scene's garment on its start pose.
    ///
    /// # Errors
    /// A garment that the kernel refuses or that cannot be draped, or a scene with a program of
    /// its own: a walk's steps, nudges and measures are the kernel's.
    pub fn new(scene: &'a Scene, options: Options) -> Result<Self, SimulateError> {
        if let Some(foreign) = &scene.simulator {
            return Err(SimulateError(format!(
                "scene {}: its [simulator] is the program {:?}, and a walk is simulated by our own \
                 kernel alone; take [simulator] out, or explore the scene with its program",
                scene.name,
                foreign.command.join(" ")
            )));
        }
        let mut simulator = ClothSimulator::new(scene)?;
        // Draped alike whatever the options, so that walks start alike.
        let Frame { state, quality } = simulator.drape(&|| false)?;
        Ok(Self::from_drape(scene, simulator, (state, quality), options))
    }

    /// Another walk from the same start.
    ///
    /// # Errors
    /// A garment that the kernel refuses.
    pub fn again(&self, options: Options) -> Result<Self, SimulateError> {
        let simulator = ClothSimulator::new(self.scene)?;
        let start = (self.state.clone(), self.drape);
        let mut again = Self::from_drape(self.scene, simulator, start, options);
        (again.pose, again.place) = (self.pose, self.place);
        Ok(again)
    }

    fn from_drape(
        scene: &'a Scene,
        mut simulator: ClothSimulator,
        (state, drape): (GridState, FrameQuality),
        options: Options,
    ) -> Self {
        simulator.set_refine(options.refine);
        simulator.nudge_next(Vec3::X * options.nudge_m);
        let classifier = Classifier::new(scene);
        let (pose, place) = (scene.start, Rigid::IDENTITY);
        Self { scene, simulator, pose, place, state, drape, classifier }
    }

    /// Simulates the frame to a pose that may follow the one where the walk stands.
    ///
    /// # Errors
    /// No edge leads there, or the frame cannot be simulated; the walk stays where it was.
    pub fn step(&mut self, to: PoseId) -> Result<Step, SimulateError> {
        let edge = self.edge_to(to)?;
        let clock = CpuClock::start();
        let frame = self.simulator.step(&self.state, edge)?;
        let cpu_s = clock.elapsed_s();
        self.place = self.place.after(&self.scene.primary.edge(edge).alignment());
        (self.pose, self.state) = (to, frame.state);
        Ok(Step { quality: frame.quality, cpu_s })
    }

    fn edge_to(&self, to: PoseId) -> Result<EdgeId, SimulateError> {
        let primary = &self.scene.primary;
        let mut edges = primary.out_edges(self.pose);
        let text =
            || format!("no edge leads from pose {} to pose {to}; a walk has none", self.pose);
        edges.find(|e| primary.edge(*e).to == to).ok_or_else(|| SimulateError(text()))
    }

    /// Measures of the drape's last frame.
    pub fn drape(&self) -> &FrameQuality {
        &self.drape
    }

    /// The pose where the walk stands.
    pub fn pose(&self) -> PoseId {
        self.pose
    }

    /// That pose in the walk's world: continuous from frame to frame.
    pub fn world_pose(&self) -> Pose {
        self.scene.primary.pose(self.pose).pose.moved(&self.place)
    }

    /// The cloth in the walk's world (m).
    pub fn world(&self) -> Vec<Vec3> {
        let hips = self.world_pose().hips();
        (0..self.state.vertex_count()).map(|v| hips.point(self.state.position(v))).collect()
    }

    /// The state, in the state frame.
    pub fn state(&self) -> &GridState {
        &self.state
    }

    /// The state's class in words, e.g. `hood down`; empty where the scene has no rules.
    pub fn class(&self) -> String {
        class::name(&self.scene.metric.classes, self.classifier.class(self.pose, &self.state))
    }

    /// How far each rule's region lies above its threshold (m), in the scene's order.
    pub fn class_heights(&self) -> impl Iterator<Item = f32> {
        self.classifier.heights(self.pose, &self.state)
    }

    /// The garment's mesh.
    pub fn mesh(&self) -> &Mesh {
        self.simulator.model().mesh()
    }

    /// Strain of every edge: 0.1 means 10 % longer than at rest.
    pub fn strains(&self) -> impl Iterator<Item = f32> + '_ {
        let mesh = self.mesh();
        let at = |v: u32| self.state.position(v as usize);
        let edges = mesh.edges().iter().zip(mesh.rest_lengths());
        edges.map(move |(e, rest)| at(e[0]).distance(at(e[1])) / rest - 1.0)
    }
}

#[cfg(test)]
mod tests;

//! Our own simulator: the kernel of crate `cloth`, one frame along a primary edge at a time.
//!
//! The kernel runs in the world of the edge's source clip, shifted so that the source's hips stand
//! over the origin; states enter and leave in the hips' frames and on the grid, so that nothing
//! but a grid state passes from frame to frame.

use std::sync::Arc;

use cloth::{
    Crossings, Environment, Mesh, Model, Pose, Rigid, Span, State, Vec3, Workspace, measure,
};
use protocol::EdgeId;

use crate::grid::{GridState, POSITION_STEP_M};
use crate::scene::Scene;
use crate::simulator::{Frame, FrameQuality, SimulateError, Simulator, SimulatorFactory};
use crate::watchdog::{self, Fault};

/// A vertex of the garment in the rest pose may be this deep in the body (m): it is led out.
const REST_DEPTH_M: f32 = 0.001;

/// Simulates a scene's garment. Not shared between threads; see [`ClothSimulatorFactory`].
#[derive(Debug, Clone)]
pub struct ClothSimulator {
    scene: Arc<Scene>,
    model: Arc<Model>,
    workspace: Workspace,
    crossings: Crossings,
    refine: u32,
    nudge: Vec3,
}

/// Makes simulators that share one model.
#[derive(Debug, Clone)]
pub struct ClothSimulatorFactory {
    scene: Arc<Scene>,
    model: Arc<Model>,
}

impl ClothSimulatorFactory {
    /// Checks the scene's garment and prepares its model.
    ///
    /// # Errors
    /// A garment or material that the kernel refuses; the message names element and reason.
    pub fn new(scene: &Scene) -> Result<Self, SimulateError> {
        let garment = &scene.garment;
        let refused = |what: String| SimulateError(format!("garment {}: {what}", garment.name));
        let mesh = Mesh::new(garment.positions.clone(), garment.triangles.clone())
            .map_err(|e| refused(e.to_string()))?;
        let environment = Environment {
            ground: scene.exploration.ground,
            self_contact: scene.exploration.self_contact,
            ..Environment::default()
        };
        let body = Some(scene.body.clone());
        let mut model = Model::new(mesh, garment.fabric, environment, body, &garment.attached)
            .map_err(|e| refused(e.to_string()))?;
        if !garment.layers.is_empty() {
            let layers = garment.layers.clone();
            model = model.with_layers(layers).map_err(|e| refused(e.to_string()))?;
        }
        Ok(Self { scene: Arc::new(scene.clone()), model: Arc::new(model) })
    }

    /// A simulator of its own.
    pub fn make(&self) -> ClothSimulator {
        ClothSimulator {
            scene: self.scene.clone(),
            model: self.model.clone(),
            workspace: Workspace::default(),
            crossings: Crossings::new(self.model.mesh()),
            refine: 1,
            nudge: Vec3::ZERO,
        }
    }
}

impl SimulatorFactory for ClothSimulatorFactory {
    fn simulator(&self) -> Box<dyn Simulator> {
        Box::new(self.make())
    }
}

impl ClothSimulator {
    /// A simulator of the scene's garment.
    ///
    /// # Errors
    /// As for [`ClothSimulatorFactory::new`].
    pub fn new(scene: &Scene) -> Result<Self, SimulateError> {
        Ok(ClothSimulatorFactory::new(scene)?.make())
    }

    /// The kernel's model.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// Divides every step by `refine` (at least 1) more than usual.
    pub fn set_refine(&mut self, refine: u32) {
        self.refine = refine.max(1);
    }

    /// Shifts all vertices by so much in the world (m) before the next frame is simulated, to find
    /// out how far chaos carries that. May be less than a step of the grid.
    pub fn nudge_next(&mut self, by: Vec3) {
        self.nudge = by;
    }

    /// Moves the body from one pose to another in `seconds`; states are in the poses' hips
    /// frames. What comes out of bounds is tried again at half the step, and at a quarter; what is
    /// still out of bounds then is flagged, or an error where it cannot even be kept.
    fn advance(
        &mut self,
        state: &GridState,
        from: &Pose,
        to: &Pose,
        (seconds, sort_layers): (f32, bool),
    ) -> Result<Frame, SimulateError> {
        // Near the origin f32 is finest.
        let home =
            Rigid { translation: Vec3::new(-from.root.x, 0.0, -from.root.z), ..Rigid::IDENTITY };
        let (from, to) = (from.moved(&home), to.moved(&home));
        let nudge = std::mem::take(&mut self.nudge);
        let body_speed_m_s = self.body_speed(&from, &to, seconds);
        let (mut failed, mut attempts) = (String::new(), Attempts::default());
        let (mut substeps, mut iterations) = (0, 0);
        for finer in watchdog::REFINE {
            let mut world = to_world(state, &from.hips());
            world.positions.iter_mut().for_each(|p| *p += nudge);
            let refine = self.refine * finer;
            let span = Span { motion: Some((&from, &to)), seconds, refine, sort_layers };
            let moved = match cloth::step(&self.model, &span, &mut world, &mut self.workspace) {
                Ok(effort) => {
                    substeps += u64::from(effort.substeps);
                    iterations += u64::from(effort.iterations);
                    to_grid(&world, &to.hips()).map_err(|e| e.to_string())
                }
                Err(e) => Err(e.to_string()),
            };
            let frame = match moved {
                Ok(state) => self.measured(state, &to),
                Err(why) => {
                    failed = why;
                    attempts.fail();
                    continue;
                }
            };
            let crossings = frame.quality.crossings;
            // Where cloth may pass through itself by the scene's wish, that is no fault.
            let is_new = self.scene.exploration.self_contact
                && crossings > 0
                && crossings > self.crossings_of(state);
            let fault = Fault::of(&frame.quality, body_speed_m_s)
                .or(is_new.then_some(Fault::Crossings(crossings)));
            if attempts.is_enough(frame, fault) {
                break;
            }
        }
        let text = || format!("the cloth left its bounds, also at a quarter step: {failed}");
        let mut frame = attempts.best().ok_or_else(|| SimulateError(text()))?;
        (frame.quality.substeps, frame.quality.iterations) = (substeps, iterations);
        Ok(frame)
    }

    fn crossings_of(&mut self, state: &GridState) -> u64 {
        let positions: Vec<Vec3> = (0..state.vertex_count()).map(|v| state.position(v)).collect();
        self.crossings.find(&positions).len() as u64
    }

    /// Why a frame that was simulated along an edge is out of bounds, from the states at its ends alone.
    pub fn fault(
        &mut self,
        (before, after): (&GridState, &GridState),
        edge: EdgeId,
    ) -> Option<Fault> {
        let scene = self.scene.clone();
        let edge = scene.primary.edge(edge);
        let from = &scene.primary.pose(edge.from).pose;
        let to = scene.primary.pose(edge.to).pose.moved(&edge.alignment());
        let home =
            Rigid { translation: Vec3::new(-from.root.x, 0.0, -from.root.z), ..Rigid::IDENTITY };
        let (from, to) = (from.moved(&home), to.moved(&home));
        let body_speed_m_s = self.body_speed(&from, &to, 1.0 / scene.primary.fps());
        let mut quality = self.measured_cloth(&to_world(after, &to.hips()));
        if let Some(surface) = self.model.surface() {
            let (mut joints, mut body) = (Vec::new(), Vec::new());
            scene.body.skin(&to, &mut joints, &mut body);
            let offset = self.model.material().offset;
            let positions = to_world(after, &to.hips()).positions;
            let posed = surface.posed(&body);
            watchdog::measure_depth(surface, &posed, &positions, offset, &mut quality);
        }
        let crossings = quality.crossings;
        let is_new = scene.exploration.self_contact
            && crossings > 0
            && crossings > self.crossings_of(before);
        Fault::of(&quality, body_speed_m_s).or(is_new.then_some(Fault::Crossings(crossings)))
    }

    /// Speed of the fastest vertex of the body between two poses (m/s), measured on the straight
    /// way from one to the other.
    fn body_speed(&self, from: &Pose, to: &Pose, seconds: f32) -> f32 {
        let (mut joints, mut a, mut b) = (Vec::new(), Vec::new(), Vec::new());
        self.scene.body.skin(from, &mut joints, &mut a);
        self.scene.body.skin(to, &mut joints, &mut b);
        let ways = a.iter().zip(&b).map(|(a, b)| a.distance_squared(*b));
        ways.fold(0.0, f32::max).sqrt() / seconds
    }

    /// Measures a state as it will be kept: rounded.
    fn measured(&mut self, state: GridState, pose: &Pose) -> Frame {
        let world = to_world(&state, &pose.hips());
        let mut quality = self.measured_cloth(&world);
        if let Some(surface) = self.model.surface() {
            let offset = self.model.material().offset;
            let body = self.workspace.body();
            watchdog::measure_depth(surface, body, &world.positions, offset, &mut quality);
        }
        Frame { state, quality }
    }

    /// What is measured on a frame's end without the body.
    fn measured_cloth(&mut self, world: &State) -> FrameQuality {
        let crossings = self.crossings.find(&world.positions).len() as u64;
        FrameQuality {
            frames: 1,
            crossings,
            crossed_frames: u64::from(crossings > 0),
            vertex_frames: world.positions.len() as u64,
            stretch_max: measure::stretch_max_rounded(
                self.model.mesh(),
                &world.positions,
                POSITION_STEP_M,
            ),
            speed_max_m_s: world.velocities.iter().map(|v| v.length()).fold(0.0, f32::max),
            ..FrameQuality::default()
        }
    }

    fn check_rest(&self) -> Result<(), SimulateError> {
        let (body, garment) = (&self.scene.body, &self.scene.garment);
        let at = measure::clearance(&body.rest_positions, &body.triangles, &garment.positions);
        let worst = at.iter().enumerate().min_by(|a, b| a.1.total_cmp(b.1));
        match worst {
            Some((vertex, depth)) if *depth < -REST_DEPTH_M => {
                let inside = at.iter().filter(|d| **d < 0.0).count();
                Err(SimulateError(format!(
                    "garment {}: {inside} vertices are inside the body in its rest pose, vertex \
                     {vertex} by {:.1} mm; move them outside",
                    garment.name,
                    -depth * 1e3
                )))
            }
            _ => Ok(()),
        }
    }
}

/// Attempts at a frame, and the best of them.
#[derive(Default)]
struct Attempts {
    count: u32,
    /// Fault of the last attempt that came to an end.
    last: Option<Fault>,
    best: Option<(Frame, Option<Fault>)>,
}

impl Attempts {
    /// One that could not be kept.
    fn fail(&mut self) {
        self.count += 1;
    }

    /// One that came to an end; says whether no other is worth its cost.
    fn is_enough(&mut self, frame: Frame, fault: Option<Fault>) -> bool {
        self.count += 1;
        let is_better = match (&self.best, fault) {
            (None, _) | (_, None) => true,
            (Some((_, best)), Some(now)) => best.is_some_and(|best| now.is_less_than(&best)),
        };
        if is_better {
            self.best = Some((frame, fault));
        }
        let last = std::mem::replace(&mut self.last, fault);
        fault.zip(last).map_or(fault.is_none(), |(now, last)| now.resists(&last))
    }

    /// The best, which says what became of all.
    fn best(self) -> Option<Frame> {
        let (mut frame, fault) = self.best?;
        frame.quality.frames_retried = u64::from(self.count > 1);
        frame.quality.frames_flagged = u64::from(fault.is_some());
        Some(frame)
    }
}

impl Simulator for ClothSimulator {
    fn step(&mut self, state: &GridState, edge: EdgeId) -> Result<Frame, SimulateError> {
        let scene = self.scene.clone();
        let edge = scene.primary.edge(edge);
        let from = &scene.primary.pose(edge.from).pose;
        let to = scene.primary.pose(edge.to).pose.moved(&edge.alignment());
        self.advance(state, from, &to, (1.0 / scene.primary.fps(), false))
            .map_err(|e| SimulateError(format!("pose {} to pose {}: {e}", edge.from, edge.to)))
    }

    fn drape(&mut self, should_stop: &dyn Fn() -> bool) -> Result<Frame, SimulateError> {
        self.check_rest()?;
        let scene = self.scene.clone();
        let rest = scene.body.skeleton.rest_pose();
        let start = &scene.primary.pose(scene.start).pose;
        let seconds = 1.0 / scene.primary.fps();
        let frames = scene.exploration.drape_frames.max(1);
        let state = State {
            positions: scene.garment.positions.clone(),
            velocities: vec![Vec3::ZERO; scene.garment.positions.len()],
        };
        let mut state = to_grid(&state, &rest.hips()).map_err(|e| SimulateError(e.to_string()))?;
        let mut from = rest.clone();
        let mut quality = FrameQuality::default();
        for frame in 1..=2 * u64::from(frames) {
            if should_stop() {
                return Err(SimulateError("the drape was stopped".to_owned()));
            }
            let t = (frame as f32 / frames as f32).min(1.0);
            let to = rest.interpolate(start, t * t * (3.0 - 2.0 * t));
            // The layers' order is the scene's; once it is there, nothing passes.
            let moved = self
                .advance(&state, &from, &to, (seconds, frame <= u64::from(frames)))
                .map_err(|e| SimulateError(format!("drape, frame {frame}: {e}")))?;
            (state, quality, from) = (moved.state, moved.quality, to);
        }
        Ok(Frame { state, quality })
    }
}

/// A grid state in the world, given its frame's place there.
pub(crate) fn to_world(state: &GridState, hips: &Rigid) -> State {
    let vertices = 0..state.vertex_count();
    State {
        positions: vertices.clone().map(|v| hips.point(state.position(v))).collect(),
        velocities: vertices.map(|v| hips.vector(state.velocity(v))).collect(),
    }
}

pub(crate) fn to_grid(world: &State, hips: &Rigid) -> Result<GridState, crate::grid::OffGrid> {
    let inverse = hips.inverse();
    let positions: Vec<Vec3> = world.positions.iter().map(|p| inverse.point(*p)).collect();
    let velocities: Vec<Vec3> = world.velocities.iter().map(|v| inverse.vector(*v)).collect();
    GridState::round(&positions, &velocities)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(mark: i16) -> Frame {
        let state = GridState { positions: vec![[mark; 3]], velocities: vec![[0; 3]] };
        Frame { state, quality: FrameQuality { frames: 1, ..FrameQuality::default() } }
    }

    /// What is kept: its mark, whether it counts as retried, whether as flagged.
    fn kept(attempts: Attempts) -> Option<(i16, u64, u64)> {
        let Frame { state, quality } = attempts.best()?;
        Some((state.positions[0][0], quality.frames_retried, quality.frames_flagged))
    }

    #[test]
    fn the_best_attempt_is_kept_and_every_retry_counts() {
        let mut sound = Attempts::default();
        assert!(sound.is_enough(frame(1), None));
        assert_eq!(kept(sound), Some((1, 0, 0)));
        let mut healed = Attempts::default();
        assert!(!healed.is_enough(frame(1), Some(Fault::Strain(0.2))));
        assert!(healed.is_enough(frame(2), None));
        assert_eq!(kept(healed), Some((2, 1, 0)));
        let mut alone = Attempts::default();
        assert!(!alone.is_enough(frame(1), Some(Fault::Strain(0.2))));
        alone.fail();
        alone.fail();
        assert_eq!(kept(alone), Some((1, 1, 1)), "finer steps failed, and were tried");
        let mut worse = Attempts::default();
        assert!(!worse.is_enough(frame(1), Some(Fault::Deep(0.010))));
        assert!(worse.is_enough(frame(2), Some(Fault::Deep(0.020))), "it resists");
        assert_eq!(kept(worse), Some((1, 1, 1)), "the better of two that are at fault");
        let mut less = Attempts::default();
        assert!(!less.is_enough(frame(1), Some(Fault::Speed(30.0))));
        assert!(!less.is_enough(frame(2), Some(Fault::Crossings(4))));
        assert!(less.is_enough(frame(3), Some(Fault::Crossings(3))));
        assert_eq!(kept(less), Some((3, 1, 1)));
        let mut none = Attempts::default();
        none.fail();
        assert_eq!(kept(none), None);
    }

    #[test]
    fn a_drape_ends_where_it_is_to_stop() {
        let scene = crate::builtin::robe(Some(1500)).unwrap();
        let asked = std::cell::Cell::new(0);
        let should_stop = || asked.replace(asked.get() + 1) == 1;
        let error = ClothSimulator::new(&scene).unwrap().drape(&should_stop).unwrap_err();
        assert_eq!((error.to_string().as_str(), asked.get()), ("the drape was stopped", 2));
    }
}

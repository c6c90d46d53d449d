//! A foreign program as the simulator, over its standard input and output: `docs/pipe.md`.
//!
//! Whatever the program does, the run goes on: one that hangs is ended, one that died is started
//! anew, an answer that is not finite or of the wrong size is refused. Each costs one job, which is
//! run once more and then set aside. Only where nothing can be simulated at all, since the program
//! cannot be started or ends at every frame, the run ends.

mod process;

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use cloth::{Crossings, Mesh, Pose, Rigid, Skeleton, State, Surface, Vec3, measure};
use protocol::EdgeId;

use self::process::{Answer, Process};
use crate::cloth_simulator::{ClothSimulatorFactory, to_grid, to_world};
use crate::grid::{GridState, POSITION_STEP_M};
use crate::scene::Scene;
use crate::simulator::{Frame, FrameQuality, SimulateError, Simulator, SimulatorFactory};
use crate::watchdog;

/// Version of the protocol.
pub const PIPE_PROTOCOL: u32 = 1;

/// A program that simulates, as the scene file names it.
#[derive(Debug, Clone, PartialEq)]
pub struct Foreign {
    /// The program and its arguments.
    pub command: Vec<String>,
    /// Where it runs: the scene file's folder.
    pub folder: PathBuf,
    /// Longest time for one answer (s).
    pub timeout_s: f32,
}

/// The simulators of a scene: the program that it names, or our own.
///
/// # Errors
/// A garment that the simulator refuses.
pub fn simulators(scene: &Scene) -> Result<Box<dyn SimulatorFactory>, SimulateError> {
    match &scene.simulator {
        Some(foreign) => Ok(Box::new(PipeFactory::new(scene, foreign.clone())?)),
        None => Ok(Box::new(ClothSimulatorFactory::new(scene)?)),
    }
}

/// Makes simulators, each with a process of its own.
#[derive(Debug, Clone)]
pub struct PipeFactory {
    scene: Arc<Scene>,
    mesh: Arc<Mesh>,
    surface: Arc<Surface>,
    foreign: Foreign,
    hello: Arc<Vec<u8>>,
}

impl PipeFactory {
    /// Of a scene and a program, which is started at the first step.
    ///
    /// # Errors
    /// A garment that is no mesh.
    pub fn new(scene: &Scene, foreign: Foreign) -> Result<Self, SimulateError> {
        let garment = &scene.garment;
        let mesh = Mesh::new(garment.positions.clone(), garment.triangles.clone())
            .map_err(|e| SimulateError(format!("garment {}: {e}", garment.name)))?;
        let hello = Arc::new(hello(scene));
        let surface = Arc::new(Surface::new(&scene.body.rest_positions, &scene.body.triangles));
        let (scene, mesh) = (Arc::new(scene.clone()), Arc::new(mesh));
        Ok(Self { scene, mesh, surface, foreign, hello })
    }
}

impl SimulatorFactory for PipeFactory {
    fn simulator(&self) -> Box<dyn Simulator> {
        Box::new(PipeSimulator {
            factory: self.clone(),
            process: None,
            crossings: Crossings::new(&self.mesh),
            is_out_of_order: false,
            ended_cpu_s: 0.0,
        })
    }
}

struct PipeSimulator {
    factory: PipeFactory,
    process: Option<Process>,
    crossings: Crossings,
    is_out_of_order: bool,
    /// CPU time of processes that ended (s).
    ended_cpu_s: f64,
}

impl PipeSimulator {
    /// Moves the body from one pose to another; states are in the poses' hips frames.
    fn advance(
        &mut self,
        state: &GridState,
        (from, to): (&Pose, &Pose),
    ) -> Result<Frame, SimulateError> {
        // As for our own simulator: near the origin f32 is finest.
        let home =
            Rigid { translation: Vec3::new(-from.root.x, 0.0, -from.root.z), ..Rigid::IDENTITY };
        let (from, to) = (from.moved(&home), to.moved(&home));
        let scene = Arc::clone(&self.factory.scene);
        let request = request(&scene.body.skeleton, (&from, &to), &to_world(state, &from.hips()));
        let vertices = state.vertex_count();
        let world = self.ask(&request, vertices)?;
        let state = to_grid(&world, &to.hips())
            .map_err(|e| SimulateError(format!("the program's answer: {e}")))?;
        let quality = self.measured(&to_world(&state, &to.hips()), &to);
        Ok(Frame { state, quality })
    }

    /// What our own simulator's frames are measured by; nothing of it is held against the program.
    fn measured(&mut self, world: &State, pose: &Pose) -> FrameQuality {
        let PipeFactory { scene, mesh, surface, .. } = &self.factory;
        let crossings = self.crossings.find(&world.positions).len() as u64;
        let mut quality = FrameQuality {
            frames: 1,
            vertex_frames: world.positions.len() as u64,
            crossings,
            crossed_frames: u64::from(crossings > 0),
            stretch_max: measure::stretch_max_rounded(mesh, &world.positions, POSITION_STEP_M),
            speed_max_m_s: world.velocities.iter().map(|v| v.length()).fold(0.0, f32::max),
            ..FrameQuality::default()
        };
        let (mut joints, mut body) = (Vec::new(), Vec::new());
        scene.body.skin(pose, &mut joints, &mut body);
        let (posed, offset) = (surface.posed(&body), scene.garment.fabric.offset);
        watchdog::measure_depth(surface, &posed, &world.positions, offset, &mut quality);
        quality
    }

    fn ask(&mut self, request: &[u8], vertices: usize) -> Result<State, SimulateError> {
        let foreign = &self.factory.foreign;
        let timeout = Duration::from_secs_f32(foreign.timeout_s);
        let answer_bytes = 24 * vertices;
        self.is_out_of_order = true;
        let mut process = match self.process.take() {
            Some(process) => process,
            None => Process::start(foreign, &self.factory.hello, answer_bytes, timeout)
                .map_err(|e| named(foreign, &e))?,
        };
        let answer = process.ask(request, timeout);
        let late = answer.as_ref().is_err_and(|none| none.late);
        self.is_out_of_order = !late && !process.has_answered();
        let text = match answer {
            Ok(Answer::State(bytes)) if bytes.len() == answer_bytes => {
                self.process = Some(process);
                return Ok(read_state(&bytes, vertices));
            }
            Ok(Answer::Failed(text)) => {
                self.process = Some(process);
                return Err(named(foreign, &text));
            }
            Ok(Answer::State(bytes)) => {
                format!("answered {} bytes, {answer_bytes} were expected", bytes.len())
            }
            Err(none) => none.text,
        };
        // Dropped here: it is ended, and started anew.
        self.ended_cpu_s += process.cpu_s();
        Err(named(foreign, &text))
    }
}

impl Simulator for PipeSimulator {
    fn step(&mut self, state: &GridState, edge: EdgeId) -> Result<Frame, SimulateError> {
        let scene = Arc::clone(&self.factory.scene);
        let edge = scene.primary.edge(edge);
        let from = &scene.primary.pose(edge.from).pose;
        let to = scene.primary.pose(edge.to).pose.moved(&edge.alignment());
        self.advance(state, (from, &to))
            .map_err(|e| SimulateError(format!("pose {} to pose {}: {e}", edge.from, edge.to)))
    }

    fn may_recover(&self) -> bool {
        true
    }

    fn is_out_of_order(&self) -> bool {
        self.is_out_of_order
    }

    fn program_cpu_s(&self) -> f64 {
        self.ended_cpu_s + self.process.as_ref().map_or(0.0, Process::cpu_s)
    }

    fn drape(&mut self, should_stop: &dyn Fn() -> bool) -> Result<Frame, SimulateError> {
        let scene = Arc::clone(&self.factory.scene);
        let rest = scene.body.skeleton.rest_pose();
        let start = &scene.primary.pose(scene.start).pose;
        let frames = scene.exploration.drape_frames.max(1);
        let positions = scene.garment.positions.clone();
        let velocities = vec![Vec3::ZERO; positions.len()];
        let state = to_grid(&State { positions, velocities }, &rest.hips());
        let mut state = state.map_err(|e| SimulateError(e.to_string()))?;
        let (mut from, mut quality) = (rest.clone(), FrameQuality::default());
        for frame in 1..=2 * u64::from(frames) {
            if should_stop() {
                return Err(SimulateError("the drape was stopped".to_owned()));
            }
            let t = (frame as f32 / frames as f32).min(1.0);
            let to = rest.interpolate(start, t * t * (3.0 - 2.0 * t));
            let moved = self
                .advance(&state, (&from, &to))
                .map_err(|e| SimulateError(format!("drape, frame {frame}: {e}")))?;
            (state, quality, from) = (moved.state, moved.quality, to);
        }
        Ok(Frame { state, quality })
    }
}

fn named(foreign: &Foreign, text: &str) -> SimulateError {
    SimulateError(format!("simulator {:?}: {text}", foreign.command.join(" ")))
}

/// The first message: everything that stays the same.
fn hello(scene: &Scene) -> Vec<u8> {
    let (body, garment) = (&scene.body, &scene.garment);
    let points = |all: &[Vec3]| all.iter().map(Vec3::to_array).collect::<Vec<_>>();
    let rigid = |r: &Rigid| {
        let ([x, y, z], [a, b, c, d]) = (r.translation.to_array(), r.rotation.to_array());
        [x, y, z, a, b, c, d]
    };
    let f = &garment.fabric;
    let hello = serde_json::json!({
        "protocol": PIPE_PROTOCOL,
        "scene": scene.name,
        "frame_s": 1.0 / scene.primary.fps(),
        "ground": scene.exploration.ground,
        "garment": {
            "name": garment.name,
            "positions": points(&garment.positions),
            "triangles": garment.triangles,
            "attached": garment.attached,
            "material": {
                "density": f.density, "bend": f.bend, "friction": f.friction, "drag": f.drag,
                "damping_s": f.damping_s, "offset": f.offset,
            },
        },
        "body": {
            "joints": body.skeleton.names,
            "parents": body.skeleton.parents,
            "rest": body.skeleton.rest.iter().map(rigid).collect::<Vec<_>>(),
            "positions": points(&body.rest_positions),
            "triangles": body.triangles,
            "vertex_joints": body.joints,
            "vertex_weights": body.weights,
        },
    });
    hello.to_string().into_bytes()
}

/// A step: the joints at its beginning and at its end, then the cloth.
fn request(skeleton: &Skeleton, (from, to): (&Pose, &Pose), state: &State) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut put = |values: &[f32]| {
        values.iter().for_each(|value| bytes.extend_from_slice(&value.to_le_bytes()));
    };
    let mut joints = Vec::new();
    for pose in [from, to] {
        skeleton.world(pose, &mut joints);
        for joint in &joints {
            put(&joint.translation.to_array());
            put(&joint.rotation.to_array());
        }
    }
    state.positions.iter().chain(&state.velocities).for_each(|v| put(&v.to_array()));
    bytes
}

/// `bytes` has 24 for each vertex.
fn read_state(bytes: &[u8], vertices: usize) -> State {
    let value = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
    let row = |b: &[u8]| Vec3::new(value(b), value(&b[4..]), value(&b[8..]));
    let mut positions: Vec<Vec3> = bytes.chunks_exact(12).map(row).collect();
    let velocities = positions.split_off(vertices);
    State { positions, velocities }
}

#[cfg(test)]
mod tests;

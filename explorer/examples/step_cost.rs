//! Cost and effort of the kernel's step on a scene's clips, or on the pinned sheet S1:
//!
//! ```text
//! cargo run --release -p explorer --example step_cost -- dress (frames) [clip ...]
//! cargo run --release -p explorer --example step_cost -- S1 (vertices a side)
//! ```
//!
//! Each clip is played from the drape at the scene's start, over the shortest way there in the
//! primary graph, which is not counted. Times are CPU seconds of the thread, where the system tells.

use std::collections::VecDeque;

use cloth::{Environment, Material, Mesh, Model, Span, State, Vec3, Workspace, measure};
use explorer::cloth_simulator::ClothSimulator;
use explorer::grid::GridState;
use explorer::import;
use explorer::scene::Scene;
use explorer::simulator::Simulator;
use protocol::{EdgeId, PoseId};

fn main() -> Result<(), String> {
    let mut arguments = std::env::args().skip(1);
    let name = arguments.next().unwrap_or_else(|| "dress".into());
    let number = arguments.next().and_then(|n| n.parse().ok());
    if name == "S1" {
        pinned_sheet(number.unwrap_or(100));
        return Ok(());
    }
    let clips: Vec<String> = arguments.collect();
    let scene = import::load_scene(&name, import::data_dir().as_deref());
    let scene = scene.map_err(|e| e.to_string())?;
    let mut simulator = ClothSimulator::new(&scene).map_err(|e| e.0)?;
    let begun = cpu_s();
    let draped = simulator.drape(&|| false).map_err(|e| e.0)?;
    println!("drape {:.2} s", cpu_s() - begun);
    let clips = if clips.is_empty() { scene.primary.clips().to_vec() } else { clips };
    for clip in &clips {
        let run = Run { scene: &scene, simulator: &simulator, limit: number.unwrap_or(usize::MAX) };
        run.clip(clip, &draped.state)?;
    }
    Ok(())
}

/// CPU time of this thread (s); of the wall clock where the system does not tell.
fn cpu_s() -> f64 {
    let told = std::fs::read_to_string("/proc/thread-self/schedstat").ok();
    let nanos = told.and_then(|t| t.split(' ').next()?.parse::<u64>().ok());
    static BEGUN: std::sync::OnceLock<std::time::Instant> = std::sync::OnceLock::new();
    let wall = BEGUN.get_or_init(std::time::Instant::now).elapsed().as_secs_f64();
    nanos.map_or(wall, |n| n as f64 * 1e-9)
}

struct Run<'a> {
    scene: &'a Scene,
    simulator: &'a ClothSimulator,
    limit: usize,
}

#[derive(Default)]
struct Sum {
    seconds: Vec<f64>,
    substeps: u32,
    iterations: u32,
    sweeps: u32,
    stretch: f32,
    p99: f32,
    deep: [u64; 2],
    failed: u32,
}

impl Run<'_> {
    fn clip(&self, clip: &str, draped: &GridState) -> Result<(), String> {
        let primary = &self.scene.primary;
        let index = primary.clips().iter().position(|c| c == clip);
        let index = index.ok_or_else(|| format!("no clip {clip}: {:?}", primary.clips()))?;
        let inside = |p: PoseId| primary.pose(p).clip as usize == index;
        let way = self.way(&|p| inside(p) && !primary.pose(p).transition);
        let (mut state, mut ws) = (draped.clone(), Workspace::default());
        let mut at = self.scene.start;
        for edge in way {
            (state, _) = self.frame(&state, edge, &mut ws)?;
            at = primary.edge(edge).to;
        }
        let mut sum = Sum::default();
        while sum.seconds.len() < self.limit {
            let next = primary.out_edges(at).find(|e| inside(primary.edge(*e).to));
            let Some(edge) = next else { break };
            let begun = cpu_s();
            let (moved, effort) = self.frame(&state, edge, &mut ws)?;
            sum.seconds.push(cpu_s() - begun);
            self.measure(&moved, edge, &ws, &mut sum);
            sum.substeps += effort.substeps;
            sum.iterations += effort.iterations;
            sum.sweeps += effort.sweeps;
            (state, at) = (moved, primary.edge(edge).to);
            let frame = primary.pose(at).frame;
            if frame + 1 >= self.frames(index) || sum.seconds.len() > 2000 {
                break;
            }
        }
        sum.print(clip, state.vertex_count());
        Ok(())
    }

    fn frames(&self, clip: usize) -> u32 {
        let poses = self.scene.primary.poses().iter();
        poses
            .filter(|p| p.clip as usize == clip && !p.transition)
            .map(|p| p.frame + 1)
            .max()
            .unwrap_or(0)
    }

    /// The shortest way from the start to a pose.
    fn way(&self, arrived: &dyn Fn(PoseId) -> bool) -> Vec<EdgeId> {
        let primary = &self.scene.primary;
        let mut by: Vec<Option<EdgeId>> = vec![None; primary.poses().len()];
        let mut queue = VecDeque::from([self.scene.start]);
        while let Some(pose) = queue.pop_front() {
            if arrived(pose) {
                let (mut way, mut at) = (Vec::new(), pose);
                while at != self.scene.start {
                    let Some(edge) = by[at.index()] else { break };
                    way.push(edge);
                    at = primary.edge(edge).from;
                }
                way.reverse();
                return way;
            }
            for edge in primary.out_edges(pose) {
                let to = primary.edge(edge).to;
                if by[to.index()].is_none() && to != self.scene.start {
                    by[to.index()] = Some(edge);
                    queue.push_back(to);
                }
            }
        }
        Vec::new()
    }

    fn frame(
        &self,
        state: &GridState,
        edge: EdgeId,
        ws: &mut Workspace,
    ) -> Result<(GridState, cloth::solver::Effort), String> {
        let primary = &self.scene.primary;
        let edge = primary.edge(edge);
        let from = &primary.pose(edge.from).pose;
        let to = primary.pose(edge.to).pose.moved(&edge.alignment());
        let hips = from.hips();
        let vertices = 0..state.vertex_count();
        let mut world = State {
            positions: vertices.clone().map(|v| hips.point(state.position(v))).collect(),
            velocities: vertices.map(|v| hips.vector(state.velocity(v))).collect(),
        };
        let seconds = 1.0 / primary.fps();
        let span = Span { motion: Some((from, &to)), seconds, refine: 1, sort_layers: false };
        let effort = cloth::step(self.simulator.model(), &span, &mut world, ws)
            .map_err(|e| e.to_string())?;
        let inverse = to.hips().inverse();
        let positions: Vec<Vec3> = world.positions.iter().map(|p| inverse.point(*p)).collect();
        let velocities: Vec<Vec3> = world.velocities.iter().map(|v| inverse.vector(*v)).collect();
        let state = GridState::round(&positions, &velocities).map_err(|e| e.to_string())?;
        Ok((state, effort))
    }

    fn measure(&self, state: &GridState, edge: EdgeId, ws: &Workspace, sum: &mut Sum) {
        let primary = &self.scene.primary;
        let edge = primary.edge(edge);
        let hips = primary.pose(edge.to).pose.moved(&edge.alignment()).hips();
        let vertices = 0..state.vertex_count();
        let at: Vec<Vec3> = vertices.map(|v| hips.point(state.position(v))).collect();
        let model = self.simulator.model();
        sum.stretch = sum.stretch.max(measure::stretch_max(model.mesh(), &at));
        sum.p99 = sum.p99.max(measure::stretch_quantile(model.mesh(), &at, 0.99));
        let Some(surface) = model.surface() else { return };
        for (deep, limit) in sum.deep.iter_mut().zip([0.001, 0.005]) {
            let offset = model.material().offset;
            *deep += measure::penetration(surface, ws.body(), &at, limit, offset).deep;
        }
    }
}

impl Sum {
    fn print(&mut self, name: &str, vertices: usize) {
        let n = self.seconds.len().max(1);
        let mean = self.seconds.iter().sum::<f64>() / n as f64;
        self.seconds.sort_unstable_by(f64::total_cmp);
        let at = |q: f64| self.seconds.get((n as f64 * q) as usize).copied().unwrap_or(0.0);
        let per = |count: u32| f64::from(count) / n as f64;
        let share = |deep: u64| 100.0 * deep as f64 / (n * vertices) as f64;
        println!(
            "{name:14} {n:4} frames x {vertices}: ms mean {:.1} p50 {:.1} p90 {:.1} p99 {:.1} max \
             {:.1}; a frame {:.1} substeps {:.0} iterations {:.1} sweeps; stretch p99 {:.1} % max \
             {:.1} %; deeper than 1 mm {:.4} %, 5 mm {:.4} %; failed {}",
            1e3 * mean,
            1e3 * at(0.5),
            1e3 * at(0.9),
            1e3 * at(0.99),
            1e3 * at(0.9999),
            per(self.substeps),
            per(self.iterations),
            per(self.sweeps),
            1e2 * self.p99,
            1e2 * self.stretch,
            share(self.deep[0]),
            share(self.deep[1]),
            self.failed,
        );
    }
}

/// S1: 1 m x 1 m, two adjacent corners pinned, released horizontal, 2 s of 1/60 s.
fn pinned_sheet(n: usize) {
    let at = |k: usize| k as f32 / (n - 1) as f32;
    let positions = (0..n * n).map(|v| Vec3::new(at(v / n), 0.0, at(v % n))).collect();
    let mut triangles = Vec::new();
    for i in 0..n - 1 {
        for j in 0..n - 1 {
            let a = (i * n + j) as u32;
            let [b, c] = [a + n as u32, a + 1];
            let d = b + 1;
            let odd = (i + j) % 2 == 1;
            triangles.extend(if odd { [[a, c, b], [b, c, d]] } else { [[a, d, b], [a, c, d]] });
        }
    }
    let mesh = Mesh::new(positions, triangles).expect("a sheet");
    let material = Material { shear: 1000.0 / 2.6, drag: 0.0, ..Material::default() };
    let held = [0, ((n - 1) * n) as u32];
    let model = Model::new(mesh, material, Environment::default(), None, &held).expect("a model");
    let (mut state, mut ws) = (model.rest_state(), Workspace::default());
    let mut sum = Sum::default();
    let (mut low, mut low_p99, mut fastest) = (0.0f32, 0.0, 0.0f32);
    for _ in 0..120 {
        let span = Span { motion: None, seconds: 1.0 / 60.0, refine: 1, sort_layers: false };
        let begun = cpu_s();
        let effort = cloth::step(&model, &span, &mut state, &mut ws).expect("a finite sheet");
        sum.seconds.push(cpu_s() - begun);
        sum.substeps += effort.substeps;
        sum.iterations += effort.iterations;
        sum.sweeps += effort.sweeps;
        let lowest = state.positions.iter().map(|p| p.y).fold(0.0, f32::min);
        fastest = state.velocities.iter().map(|v| v.length()).fold(fastest, f32::max);
        if lowest < low {
            low = lowest;
            low_p99 = measure::stretch_quantile(model.mesh(), &state.positions, 0.99);
            sum.stretch = measure::stretch_max(model.mesh(), &state.positions);
        }
    }
    sum.p99 = low_p99;
    sum.print("S1, 1/60 s", n * n);
    println!("lowest {low:.4} m, fastest {fastest:.2} m/s");
}

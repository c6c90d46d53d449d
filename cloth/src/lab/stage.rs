//! Where benches run: steps that are timed, shown and measured.

use std::cell::Cell;
use std::ops::RangeInclusive;

use glam::Vec3;

use super::{Bench, LabError, Limit, Row};
use crate::body::Pose;
use crate::crossings::Crossings;
use crate::fabrics::Fabric;
use crate::material::Material;
use crate::measure;
use crate::model::{Model, State};
use crate::solver::{Effort, SUBSTEP_S_MAX, Span, Workspace, step};

/// What a bench can be asked for, beside fewer cases.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Setting {
    /// [`Settings::n`].
    N,
    /// [`Settings::vertices`].
    Vertices,
    /// [`Settings::fabric`].
    Fabric,
    /// [`Settings::dt_s`].
    Dt,
}

impl Setting {
    /// All there are.
    pub const ALL: &'static [Setting] =
        &[Setting::N, Setting::Vertices, Setting::Fabric, Setting::Dt];

    /// Its name as an option.
    pub fn name(self) -> &'static str {
        match self {
            Setting::N => "n",
            Setting::Vertices => "vertices",
            Setting::Fabric => "fabric",
            Setting::Dt => "dt",
        }
    }

    /// Nothing but this one of what is asked for.
    #[cfg(test)]
    pub(super) fn only(self, by_n: &Settings, by_count: &Settings) -> Settings {
        let none = Settings::default();
        match self {
            Setting::N => Settings { n: by_n.n, ..none },
            Setting::Vertices => Settings { vertices: by_count.vertices, ..none },
            Setting::Fabric => Settings { fabric: by_n.fabric, ..none },
            Setting::Dt => Settings { dt_s: by_n.dt_s, ..none },
        }
    }

    fn is_in(self, settings: &Settings) -> bool {
        match self {
            Setting::N => settings.n.is_some(),
            Setting::Vertices => settings.vertices.is_some(),
            Setting::Fabric => settings.fabric.is_some(),
            Setting::Dt => settings.dt_s.is_some(),
        }
    }
}

/// What a caller may set.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Settings {
    /// Size of the mesh, as the bench understands it: vertices a side, edges a length.
    pub n: Option<u32>,
    /// Number of vertices, about, in place of `n`; of the coarsest mesh where a bench compares some.
    pub vertices: Option<u32>,
    /// Fabric instead of the bench's own material.
    pub fabric: Option<&'static Fabric>,
    /// Longest substep (s); the solver's own is the longest possible.
    pub dt_s: Option<f32>,
    /// Fewer cases, for tests that run every time.
    pub quick: bool,
}

impl Settings {
    /// Checks the ranges, and that the bench reads all of it.
    ///
    /// # Errors
    /// Names the first parameter that is out of range or not read.
    pub fn check(&self, bench: &Bench) -> Result<(), LabError> {
        let unread = |s: &&Setting| s.is_in(self) && !bench.reads.contains(s);
        if let Some(setting) = Setting::ALL.iter().find(unread) {
            let (name, reads) = (setting.name(), bench.options());
            return Err(LabError::Unread { bench: bench.name, name, reads });
        }
        if self.n.is_some() && self.vertices.is_some() {
            return Err(LabError::Both);
        }
        let given = [
            ("n", self.n.map(f64::from), 2.0, 400.0),
            ("vertices", self.vertices.map(f64::from), 4.0, 160_000.0),
            ("dt", self.dt_s.map(f64::from), 1e-5, 1.0 / 30.0),
        ];
        for (name, value, least, most) in given {
            if let Some(value) = value
                && !(value >= least && value <= most + 1e-9)
            {
                return Err(LabError::Parameter { name, value, least, most });
            }
        }
        Ok(())
    }
}

/// A frame, as the caller may draw it.
#[derive(Debug, Clone, Copy)]
pub struct Shot<'a> {
    /// Which run of the bench: a bench that compares makes several.
    pub run: u32,
    /// Time since the run's beginning (s).
    pub time_s: f32,
    /// The cloth (m).
    pub positions: &'a [Vec3],
    /// Its triangles.
    pub triangles: &'a [[u32; 3]],
    /// What it lies on, if anything: vertices (m) and triangles.
    pub body: Option<(&'a [Vec3], &'a [[u32; 3]])>,
}

/// What the stage measures in every bench.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tally {
    /// Vertices of the largest run.
    pub vertices: usize,
    /// Frames of all runs.
    pub frames: u64,
    /// Simulated time (s).
    pub simulated_s: f64,
    /// Processor time spent in steps (s), without the first frame of each run.
    pub cpu_s: f64,
    /// Simulated time to which that belongs (s).
    pub timed_s: f64,
    /// Substeps.
    pub substeps: u64,
    /// Iterations of the linear solver.
    pub iterations: u64,
    /// Edge strain below which 99 % lie; largest of all frames unless the bench says otherwise.
    pub stretch_p99: f32,
    /// Largest edge strain.
    pub stretch_max: f32,
    /// Deepest vertex in the body in any frame (m); `None` without a body.
    pub penetration_m: Option<f32>,
    /// Edges that cut a triangle: most in any frame looked at; `None` where none was.
    pub self_hits: Option<u64>,
    /// Lowest vertex of all frames (m).
    pub lowest_m: f32,
    /// Fastest vertex (m/s).
    pub speed_max_m_s: f32,
}

impl Default for Tally {
    fn default() -> Self {
        Self {
            vertices: 0,
            frames: 0,
            simulated_s: 0.0,
            cpu_s: 0.0,
            timed_s: 0.0,
            substeps: 0,
            iterations: 0,
            stretch_p99: 0.0,
            stretch_max: 0.0,
            penetration_m: None,
            self_hits: None,
            lowest_m: f32::INFINITY,
            speed_max_m_s: 0.0,
        }
    }
}

impl Tally {
    /// Processor time (ms) per 1/60 s of simulated time.
    pub fn cpu_ms_per_frame(&self) -> f64 {
        if self.timed_s > 0.0 { 1e3 * self.cpu_s / (60.0 * self.timed_s) } else { 0.0 }
    }
}

/// What counts as inside the body: a tenth of the distance that cloth keeps (m).
const INSIDE_M: f32 = 4e-4;

/// A cloth on the stage.
pub struct Sim {
    /// What does not change.
    pub model: Model,
    /// What does.
    pub state: State,
    /// Length of a frame (s).
    pub frame_s: f32,
    /// Longest substep asked for (s).
    pub dt_s: f32,
    /// What the last frame took.
    pub effort: Effort,
    /// Time since the beginning (s).
    pub time_s: f32,
    /// See [`crate::Span::sort_layers`].
    pub sort_layers: bool,
    /// Crossings are counted in every frame whose number is a multiple; 0: never.
    pub hits_every: u64,
    /// Deepest vertex in the body after the last frame, those pinched between two parts apart (m).
    pub depth_m: f32,
    frames: u64,
    run: u32,
    crossings: Crossings,
    workspace: Workspace,
}

impl Sim {
    /// Frames so far.
    pub fn frames(&self) -> u64 {
        self.frames
    }

    /// Length of the last substep (s).
    pub fn substep_s(&self) -> f32 {
        self.frame_s / self.effort.substeps.max(1) as f32
    }

    /// Vertices of the body where the last step left it (m).
    pub fn body(&self) -> &[Vec3] {
        &self.workspace.body().positions
    }
}

/// Where a bench runs.
pub struct Stage<'a> {
    settings: Settings,
    read: Cell<[bool; 4]>,
    /// What was measured so far; a bench may correct it.
    pub tally: Tally,
    /// Most crossings in any frame looked at since the bench last took this.
    pub hits: u64,
    clock: &'a mut dyn FnMut() -> f64,
    watch: &'a mut dyn FnMut(&Shot<'_>) -> bool,
    rows: Vec<Row>,
    runs: u32,
}

impl<'a> Stage<'a> {
    /// An empty stage.
    pub fn new(
        settings: Settings,
        clock: &'a mut dyn FnMut() -> f64,
        watch: &'a mut dyn FnMut(&Shot<'_>) -> bool,
    ) -> Self {
        let tally = Tally::default();
        let (rows, read) = (Vec::new(), Cell::default());
        Self { settings, read, tally, hits: 0, clock, watch, rows, runs: 0 }
    }

    /// The figures and measures.
    pub fn finish(self) -> (Vec<Row>, Tally) {
        (self.rows, self.tally)
    }

    /// Vertices a side of a square sheet, as asked or `default`.
    pub fn side(&self, default: u32) -> u32 {
        self.mark(Setting::N);
        self.mark(Setting::Vertices);
        let of_count = |v: u32| (f64::from(v).sqrt().round() as u32).clamp(2, 400);
        self.settings.vertices.map(of_count).or(self.settings.n).unwrap_or(default)
    }

    /// Edges a length (or rings) of a mesh, as asked or `default`. `count` says how many vertices
    /// belong to them, and grows.
    ///
    /// # Errors
    /// A size outside `range`, or of a mesh outside it.
    pub fn edges(
        &self,
        default: u32,
        range: RangeInclusive<u32>,
        count: impl Fn(u32) -> u32,
    ) -> Result<u32, LabError> {
        self.mark(Setting::N);
        self.mark(Setting::Vertices);
        let (least, most) = (*range.start(), *range.end());
        let within = |name, value: u32, least: u32, most: u32| {
            let [value, least, most] = [value, least, most].map(f64::from);
            let error = LabError::Parameter { name, value, least, most };
            if value >= least && value <= most { Ok(()) } else { Err(error) }
        };
        if let Some(vertices) = self.settings.vertices {
            within("vertices", vertices, count(least), count(most))?;
            let off = |n: &u32| count(*n).abs_diff(vertices);
            return Ok(range.min_by_key(off).unwrap_or(default));
        }
        let n = self.settings.n.unwrap_or(default);
        within("n", n, least, most)?;
        Ok(n)
    }

    /// Whether fewer cases do.
    pub fn quick(&self) -> bool {
        self.settings.quick
    }

    /// The fabric that was asked for.
    pub fn fabric(&self) -> Option<&'static Fabric> {
        self.mark(Setting::Fabric);
        self.settings.fabric
    }

    fn mark(&self, setting: Setting) {
        let mut read = self.read.get();
        read[setting as usize] = true;
        self.read.set(read);
    }

    /// What was read so far.
    #[cfg(test)]
    pub(super) fn read(&self) -> Vec<Setting> {
        Setting::ALL.iter().copied().filter(|s| self.read.get()[*s as usize]).collect()
    }

    /// The bench's material, or the fabric that was asked for, without air.
    pub fn material(&self, default: Material) -> Material {
        let Some(fabric) = self.fabric() else { return default };
        let keep = Material { ..default };
        Material {
            friction: keep.friction,
            drag: keep.drag,
            damping_s: keep.damping_s,
            offset: keep.offset,
            ..fabric.material()
        }
    }

    /// Puts a model at rest on the stage.
    pub fn sim(&mut self, model: Model, frame_s: f32) -> Sim {
        self.runs += 1;
        let state = model.rest_state();
        self.tally.vertices = self.tally.vertices.max(state.positions.len());
        Sim {
            crossings: Crossings::new(model.mesh()),
            state,
            model,
            frame_s,
            dt_s: self.settings.dt_s.unwrap_or(SUBSTEP_S_MAX),
            effort: Effort::default(),
            time_s: 0.0,
            hits_every: 0,
            sort_layers: false,
            depth_m: 0.0,
            frames: 0,
            run: self.runs - 1,
            workspace: Workspace::default(),
        }
    }

    /// A frame, with the body moving from the first pose to the second.
    ///
    /// # Errors
    /// A state that is not finite, or the caller's wish to stop.
    pub fn step(&mut self, sim: &mut Sim, motion: Option<(&Pose, &Pose)>) -> Result<(), LabError> {
        if Some(sim.dt_s) == self.settings.dt_s {
            self.mark(Setting::Dt);
        }
        let refine = (SUBSTEP_S_MAX / sim.dt_s - 1e-3).ceil().max(1.0) as u32;
        let (seconds, sort_layers) = (sim.frame_s, sim.sort_layers);
        let span = Span { motion, seconds, refine, sort_layers };
        let start = (self.clock)();
        sim.effort = step(&sim.model, &span, &mut sim.state, &mut sim.workspace)?;
        let took = (self.clock)() - start;
        // The first frame of a run also fills memory.
        if sim.frames > 0 {
            self.tally.cpu_s += took;
            self.tally.timed_s += f64::from(sim.frame_s);
        }
        sim.frames += 1;
        sim.time_s += sim.frame_s;
        self.measure(sim);
        let body = sim.model.surface().map(|s| (sim.body(), s.triangles()));
        let shot = Shot {
            run: sim.run,
            time_s: sim.time_s,
            positions: &sim.state.positions,
            triangles: sim.model.mesh().triangles(),
            body,
        };
        if (self.watch)(&shot) { Ok(()) } else { Err(LabError::Stopped) }
    }

    fn measure(&mut self, sim: &mut Sim) {
        let (mesh, at) = (sim.model.mesh(), &sim.state.positions);
        let t = &mut self.tally;
        t.frames += 1;
        t.simulated_s += f64::from(sim.frame_s);
        t.substeps += u64::from(sim.effort.substeps);
        t.iterations += u64::from(sim.effort.iterations);
        t.stretch_p99 = t.stretch_p99.max(measure::stretch_quantile(mesh, at, 0.99));
        t.stretch_max = t.stretch_max.max(measure::stretch_max(mesh, at));
        t.lowest_m = at.iter().map(|p| p.y).fold(t.lowest_m, f32::min);
        let fastest = sim.state.velocities.iter().map(|v| v.length_squared()).fold(0.0, f32::max);
        t.speed_max_m_s = t.speed_max_m_s.max(fastest.sqrt());
        if sim.hits_every > 0 && sim.frames.is_multiple_of(sim.hits_every) {
            let hits = sim.crossings.find(at).len() as u64;
            self.hits = self.hits.max(hits);
            t.self_hits = t.self_hits.max(Some(hits));
        }
        if let Some(surface) = sim.model.surface() {
            let posed = surface.posed(sim.body());
            let offset = sim.model.material().offset;
            sim.depth_m = measure::penetration(surface, &posed, at, INSIDE_M, offset).depth_max_m;
            t.penetration_m = Some(t.penetration_m.map_or(sim.depth_m, |m| m.max(sim.depth_m)));
        }
    }

    /// Lets the cloth come to rest: whenever its motion slows down, it is stopped (kinetic
    /// damping), until the fastest vertex stays below `speed` (m/s) or `frames` are over.
    ///
    /// # Errors
    /// As [`Stage::step`].
    pub fn settle(
        &mut self,
        sim: &mut Sim,
        motion: Option<(&Pose, &Pose)>,
        speed: f32,
        frames: u32,
    ) -> Result<(), LabError> {
        let (mut before, mut calm) = (0.0, 0);
        for _ in 0..frames {
            self.step(sim, motion)?;
            let v = &sim.state.velocities;
            let fastest = v.iter().map(|v| v.length_squared()).fold(0.0, f32::max).sqrt();
            let energy: f64 = v.iter().map(|v| f64::from(v.length_squared())).sum();
            if energy < before {
                sim.state.velocities.fill(Vec3::ZERO);
                before = 0.0;
                calm = if fastest < speed { calm + 1 } else { 0 };
                if calm >= 3 {
                    break;
                }
            } else {
                before = energy;
            }
        }
        Ok(())
    }

    /// Puts a figure on record.
    pub fn row(
        &mut self,
        what: impl Into<String>,
        figure: f64,
        unit: &'static str,
        reference: impl Into<String>,
        limit: Limit,
    ) {
        let (what, reference) = (what.into(), reference.into());
        self.rows.push(Row { what, figure, unit, reference, limit });
    }
}

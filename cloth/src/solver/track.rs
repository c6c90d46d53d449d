//! Tracked steps: the fine cloth moves as physics wants, but for a few smooth averages that it
//! shares with a guide (Bergou et al. 2007; Kavan et al. 2011, section 4).
//!
//! Rows of the constraint are mass-weighted test functions, orthonormal in the metric of the
//! masses; so the projector onto motions that no row sees is a product with one thin dense
//! matrix and its transpose. Conjugate gradients search in that space alone, and the guess they
//! start from meets the constraint: nothing is pulled by springs. The position part, with the strain
//! limit in turn, has the last word in f64.
//!
//! What the cloth meets are sphere-swept colliders, the same that the coarse cloth met; it does not
//! meet itself.

use glam::{Mat3A, Vec3, Vec3A};

use super::contact::{Friction, Kind, Row};
use super::matrix::{Scratch, Stop};
use super::simd::{self, Task};
use super::{FIRST, SPEED_MAX_M_S, Workspace, limit};
use crate::coarse::Moving;
use crate::model::{Model, State};

/// Rows of a panel of the test functions.
const LANES: usize = 64;
/// The last solve of a substep.
const SECOND: Stop = Stop { tolerance: 3e-3, iterations: 60 };
/// Strain limit and constraint in turn, so many times.
const TURNS: u32 = 3;
/// Test functions, at most.
pub const TESTS_MAX: usize = 512;

/// The constraint of one cloth.
#[derive(Debug, Clone)]
pub struct Tracker {
    tests: usize,
    /// Vertex after vertex its values of all test functions, orthonormal over all vertices.
    functions: Vec<f64>,
    /// Masses, as shares of the whole.
    shares: Vec<f64>,
    shares32: Vec<f32>,
    /// The same space over the vertices that are not held, orthonormal there.
    free: Vec<f64>,
    /// The same once more, rounded, and panel after panel of [`LANES`] vertices function after
    /// function: each way of adding up runs along memory.
    rows: Vec<f32>,
    panels: Vec<f32>,
    /// Lower triangle that turns sums over `functions` into those over `free`.
    lower: Vec<f64>,
}

/// What leads a step.
#[derive(Debug, Clone, Copy)]
pub struct Guide<'a> {
    /// What [`Tracker::measure`] must find at the step's end (m).
    pub goal: &'a [[f64; 3]],
    /// Where the held vertices are at the step's end (m), in the order of the model's.
    pub held: &'a [Vec3],
    /// What the cloth must not enter.
    pub colliders: &'a [Moving],
    /// Velocity of the air (m/s).
    pub wind: Vec3,
    /// Length (s).
    pub seconds: f32,
}

/// What a tracked step took.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Tracked {
    /// Iterations of conjugate gradients.
    pub iterations: u32,
    /// Sweeps of the strain limit.
    pub sweeps: u32,
    /// Largest difference between a test function's sum and its goal, at the end (m).
    pub residual_m: f64,
}

/// Why a cloth cannot be tracked, or a step failed.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TrackError {
    /// Lists of other lengths.
    #[error("{actual} {what} where {expected} are needed")]
    Length {
        /// Which list.
        what: &'static str,
        /// Its length.
        actual: usize,
        /// What it must be (or at most may be).
        expected: usize,
    },
    /// A test function that is a sum of those before it, perhaps but for held vertices.
    #[error("test function {0} is a combination of those before it on the vertices that are free")]
    Dependent(usize),
    /// A position that is not finite.
    #[error("vertex {vertex} is at {position} after a tracked step; give it shorter steps")]
    NotFinite {
        /// The first such vertex.
        vertex: usize,
        /// Where it is.
        position: Vec3,
    },
}

impl Tracker {
    /// For the cloth of `model`; `functions` holds vertex after vertex `tests` values. Any
    /// independent functions will do: they are made orthonormal in the masses' metric.
    ///
    /// # Errors
    /// A wrong length, or functions that depend on each other.
    pub fn new(model: &Model, functions: &[f32], tests: usize) -> Result<Self, TrackError> {
        let count = model.masses.len();
        length("test functions", tests, tests.clamp(1, TESTS_MAX))?;
        length("values of test functions", functions.len(), count * tests)?;
        let whole: f64 = model.masses.iter().map(|m| f64::from(*m)).sum();
        let shares: Vec<f64> = model.masses.iter().map(|m| f64::from(*m) / whole).collect();
        let mut functions: Vec<f64> = functions.iter().map(|v| f64::from(*v)).collect();
        // Twice: the first time leaves what rounding makes of nearly dependent functions.
        for _ in 0..2 {
            let lower = cholesky(gram(&functions, &shares, tests), tests)?;
            orthonormalise(&mut functions, &lower, tests);
        }
        let mut free = functions.clone();
        for a in &model.attachments {
            free[a.vertex as usize * tests..][..tests].fill(0.0);
        }
        let lower = cholesky(gram(&free, &shares, tests), tests)?;
        orthonormalise(&mut free, &lower, tests);
        let mut panels = vec![0.0; count.div_ceil(LANES) * tests * LANES];
        for (i, row) in free.chunks(tests).enumerate() {
            for (j, value) in row.iter().enumerate() {
                panels[(i / LANES * tests + j) * LANES + i % LANES] = *value as f32;
            }
        }
        let shares32 = shares.iter().map(|s| *s as f32).collect();
        let rows = free.iter().map(|v| *v as f32).collect();
        Ok(Self { tests, functions, shares, shares32, free, rows, panels, lower })
    }

    /// Number of test functions.
    pub fn tests(&self) -> usize {
        self.tests
    }

    /// The rows of the constraint, applied: mass-weighted sums of positions (m), one per test
    /// function.
    ///
    /// # Panics
    /// As many positions are needed as the cloth has vertices.
    pub fn measure(&self, positions: &[Vec3]) -> Vec<[f64; 3]> {
        assert_eq!(positions.len(), self.shares.len(), "a position for each vertex");
        self.sums(positions.iter().map(|p| p.to_array().map(f64::from)))
    }

    fn sums(&self, positions: impl Iterator<Item = [f64; 3]>) -> Vec<[f64; 3]> {
        let mut sums = vec![[0.0; 3]; self.tests];
        let rows = self.functions.chunks(self.tests).zip(&self.shares);
        for ((row, share), p) in rows.zip(positions) {
            let p = p.map(|p| p * share);
            for (sum, value) in sums.iter_mut().zip(row) {
                (0..3).for_each(|k| sum[k] += value * p[k]);
            }
        }
        sums
    }

    /// How far sums are from `goal` (m).
    fn offsets(&self, goal: &[[f64; 3]], x: &[Vec3A]) -> Vec<[f64; 3]> {
        let sums = self.sums(x.iter().map(|x| x.to_array().map(f64::from)));
        let offset = |(g, s): (&[f64; 3], &[f64; 3])| std::array::from_fn(|k| g[k] - s[k]);
        goal.iter().zip(&sums).map(offset).collect()
    }

    /// Moves free vertices so that their sums meet `goal`; returns how far they were off (m).
    fn correct(&self, goal: &[[f64; 3]], x: &mut [Vec3A]) -> f64 {
        let t = self.tests;
        let mut c = self.offsets(goal, x);
        let off = largest(&c);
        for j in 0..t {
            let (known, rest) = c.split_at_mut(j);
            let row = &self.lower[j * t..];
            for (axis, c) in rest[0].iter_mut().enumerate() {
                let sum: f64 = known.iter().zip(row).map(|(k, value)| k[axis] * value).sum();
                *c = (*c - sum) / row[j];
            }
        }
        for (x, row) in x.iter_mut().zip(self.free.chunks(t)) {
            let mut way = [0.0; 3];
            for (value, c) in row.iter().zip(&c) {
                (0..3).for_each(|k| way[k] += c[k] * value);
            }
            *x += Vec3A::from_array(way.map(|w| w as f32));
        }
        off
    }

    /// Takes out of `z` what the rows see of it; `transposed`: out of forces instead of ways.
    fn project(&self, z: &mut [Vec3A], transposed: bool) {
        simd::run(Projection { tracker: self, z, transposed });
    }
}

/// `z -= F F' M z` or, transposed, `z -= M F F' z`, with the functions F over free vertices.
struct Projection<'a> {
    tracker: &'a Tracker,
    z: &'a mut [Vec3A],
    transposed: bool,
}

impl Task for Projection<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { tracker: t, z, transposed } = self;
        let (mut sums, mut ways) = ([[0.0f32; TESTS_MAX]; 3], [[0.0f32; LANES]; 3]);
        for ((z, share), row) in z.iter().zip(&t.shares32).zip(t.rows.chunks(t.tests)) {
            let z = if transposed { *z } else { *z * *share };
            for (sums, z) in sums.iter_mut().zip(z.to_array()) {
                add(&mut sums[..t.tests], row, z);
            }
        }
        let panels = t.panels.chunks(t.tests * LANES);
        for ((z, shares), panel) in z.chunks_mut(LANES).zip(t.shares32.chunks(LANES)).zip(panels) {
            for (way, sums) in ways.iter_mut().zip(&sums) {
                way.fill(0.0);
                for (values, sum) in panel.chunks(LANES).zip(&sums[..t.tests]) {
                    add(&mut way[..values.len()], values, *sum);
                }
            }
            for (i, (z, share)) in z.iter_mut().zip(shares).enumerate() {
                let way = Vec3A::new(ways[0][i], ways[1][i], ways[2][i]);
                *z -= if transposed { way * *share } else { way };
            }
        }
    }
}

/// `sums += values * factor`.
#[inline(always)]
fn add(sums: &mut [f32], values: &[f32], factor: f32) {
    for (sum, value) in sums.iter_mut().zip(values) {
        *sum += value * factor;
    }
}

/// Moves `state` on by one substep that meets the guide. Equal inputs give equal bits.
///
/// # Errors
/// Lists of wrong lengths, or a cloth that came apart; `state` is then of no use.
pub fn step_tracked(
    model: &Model,
    tracker: &Tracker,
    guide: &Guide<'_>,
    state: &mut State,
    workspace: &mut Workspace,
) -> Result<Tracked, TrackError> {
    let ws = workspace;
    length("goals", guide.goal.len(), tracker.tests)?;
    length("held positions", guide.held.len(), model.attachments.len())?;
    length("vertices", state.positions.len(), tracker.shares.len())?;
    let dt = guide.seconds;
    ws.begin(model, state);
    for (at, (x, v)) in ws.ends.iter_mut().zip(ws.x.iter().zip(&ws.v)) {
        *at = *x + *v * dt;
    }
    for (a, held) in model.attachments.iter().zip(guide.held) {
        ws.ends[a.vertex as usize] = (*held).into();
    }
    tracker.correct(guide.goal, &mut ws.ends);
    for ((dx, x), at) in ws.dx.iter_mut().zip(&ws.x).zip(&ws.ends) {
        *dx = *at - *x;
    }
    ws.assemble(model, guide.wind, dt, true);
    let mut iterations = 0;
    if ws.meet(model, guide, true) {
        iterations += ws.tracked_pass(model, tracker, dt, true);
        ws.meet(model, guide, false);
    }
    iterations += ws.tracked_pass(model, tracker, dt, false);
    let sweeps = ws.finish_tracked(model, tracker, guide);
    let residual_m = largest(&tracker.offsets(guide.goal, &ws.ends));
    for (i, (x, v)) in ws.x.iter().zip(&ws.v).enumerate() {
        state.positions[i] = (*x).into();
        state.velocities[i] = (*v).into();
    }
    match state.positions.iter().position(|p| !p.is_finite()) {
        Some(vertex) => Err(TrackError::NotFinite { vertex, position: state.positions[vertex] }),
        None => Ok(Tracked { iterations, sweeps, residual_m }),
    }
}

impl Workspace {
    /// Looks for the collider that each vertex is deepest in, or nearest to, where its way leads.
    /// Returns whether any vertex meets one.
    fn meet(&mut self, model: &Model, guide: &Guide<'_>, first: bool) -> bool {
        let fall = Vec3A::from(model.environment.gravity) * (guide.seconds * guide.seconds);
        let mut any = false;
        for i in 0..self.x.len() {
            let at = self.x[i] + self.dx[i];
            let load = self.rows[i].load(at);
            self.loads[i] = [if first { 0.0 } else { load }, 0.0];
            let ahead = if first { at + fall } else { at };
            let mut row = Row::default();
            let mut least = if first { 0.0 } else { model.material.offset };
            for collider in guide.colliders.iter().filter(|_| !self.held[i]) {
                let found = plane(collider, self.x[i], ahead, model.material.offset);
                let gap = found.gap(ahead);
                if gap < least {
                    (row, least) = (found, gap);
                }
            }
            any |= row.kind == Kind::Plane;
            self.rows[i] = row;
        }
        any
    }

    fn tracked_pass(&mut self, model: &Model, tracker: &Tracker, dt: f32, first: bool) -> u32 {
        self.matrix.diagonal.copy_from_slice(&self.bare);
        self.scratch.residual.copy_from_slice(&self.forces);
        let fall = Vec3A::from(model.environment.gravity) * (dt * dt);
        for i in 0..self.x.len() {
            let row = &self.rows[i];
            let at = self.x[i] + self.dx[i];
            if row.kind == Kind::Plane && (first || row.gap(at) < 0.0) {
                let (way, mass) = (self.v[i] * dt + fall, model.masses[i]);
                let (coefficient, load) = (model.material.friction, self.loads[i][0]);
                let friction = Friction { coefficient, load, way, mass, dt };
                let force = &mut self.scratch.residual[i];
                row.add(self.x[i], Vec3A::ZERO, friction, &mut self.matrix.diagonal[i], force);
            }
        }
        self.solve_tracked(model, tracker, if first { FIRST } else { SECOND })
    }

    /// Conjugate gradients in the space of the ways that the constraint leaves free; the
    /// preconditioner is the inverted diagonal between two projections.
    fn solve_tracked(&mut self, model: &Model, tracker: &Tracker, stop: Stop) -> u32 {
        let count = self.x.len();
        let diagonal = self.matrix.diagonal.iter().zip(&self.held);
        let Scratch { residual: r, inverse, z, p, q, .. } = &mut self.scratch;
        inverse.clear();
        inverse.extend(diagonal.map(|(d, held)| if *held { Mat3A::ZERO } else { d.inverse() }));
        for list in [&mut *z, &mut *p, &mut *q] {
            list.clear();
            list.resize(count, Vec3A::ZERO);
        }
        let free = |held: &[bool], list: &mut [Vec3A]| {
            list.iter_mut()
                .zip(held)
                .filter(|(_, held)| **held)
                .for_each(|(v, _)| *v = Vec3A::ZERO);
        };
        let precondition = |r: &[Vec3A], z: &mut [Vec3A]| {
            z.iter_mut().zip(r).zip(&*inverse).for_each(|((z, r), inverse)| *z = *inverse * *r);
            tracker.project(z, false);
            z.iter().zip(r).map(|(z, r)| *z * *r).sum::<Vec3A>().element_sum()
        };
        self.matrix.multiply(&model.pattern, &self.dx, q);
        r.iter_mut().zip(&*q).for_each(|(r, q)| *r -= *q);
        free(&self.held, r);
        tracker.project(r, true);
        let floor: f32 =
            self.reference.iter().zip(&*inverse).map(|(f, inverse)| f.dot(*inverse * *f)).sum();
        let mut rz = precondition(r, z);
        let enough = stop.tolerance * stop.tolerance * rz.max(floor);
        p.copy_from_slice(z);
        let mut iterations = 0;
        while rz > enough && iterations < stop.iterations {
            let curvature = self.matrix.multiply(&model.pattern, p, q);
            if !curvature.is_normal() || curvature < 0.0 {
                break;
            }
            let alpha = rz / curvature;
            free(&self.held, q);
            for i in 0..count {
                self.dx[i] += p[i] * alpha;
                r[i] -= q[i] * alpha;
            }
            tracker.project(r, true);
            let next = precondition(r, z);
            let beta = next / rz;
            rz = next;
            p.iter_mut().zip(&*z).for_each(|(p, z)| *p = *z + *p * beta);
            iterations += 1;
        }
        iterations
    }

    /// Strain limit and constraint in turn; new velocities and positions.
    fn finish_tracked(&mut self, model: &Model, tracker: &Tracker, guide: &Guide<'_>) -> u32 {
        let dt = guide.seconds;
        let mut all = 0;
        let ends = &mut self.ends;
        for ((end, x), dx) in ends.iter_mut().zip(&self.x).zip(&self.dx) {
            *end = *x + *dx;
        }
        for (load, (row, end)) in self.loads.iter_mut().zip(self.rows.iter().zip(ends.iter())) {
            load[0] = row.load(*end);
        }
        for (weight, held) in self.inverse_masses.iter_mut().zip(&self.held) {
            if *held {
                // Held vertices are where they are led, whatever the strain.
                *weight = 0.0;
            }
        }
        for _ in 0..TURNS {
            let (mesh, weights, rows) = (&model.mesh, &self.inverse_masses, &self.rows);
            let sweeps = limit::project(mesh, weights, weights, rows, ends, &mut self.busy);
            let off = tracker.correct(guide.goal, ends);
            all += sweeps;
            if sweeps == 0 && off < 1e-7 {
                break;
            }
        }
        for (i, end) in ends.iter().copied().enumerate() {
            let mut way = end - self.x[i];
            if self.loads[i][0] > 0.0 && !self.held[i] {
                way = self.rows[i].without_bounce(way);
            }
            self.v[i] = (way / dt).clamp_length_max(SPEED_MAX_M_S);
            self.x[i] = end;
        }
        all
    }
}

/// The plane that keeps a vertex out of a collider: through the surface's point that is nearest to
/// where it is heading, or on the side from which it came if it would pass through.
fn plane(collider: &Moving, start: Vec3A, at: Vec3A, offset: f32) -> Row {
    let (on, t) = collider.to.closest(at);
    let from = Vec3A::from(collider.from.ends[0].lerp(collider.from.ends[1], t));
    let (before, after) = (start - from, at - on);
    let side = if before.dot(after) > 0.0 { after } else { before };
    let normal = side.try_normalize().unwrap_or(Vec3A::Y);
    Row::plane(normal, on + normal * collider.to.radius, on - from, offset)
}

fn largest(offsets: &[[f64; 3]]) -> f64 {
    offsets.iter().flatten().fold(0.0, |most, o| most.max(o.abs()))
}

/// `F' M F`, row by row.
fn gram(functions: &[f64], shares: &[f64], tests: usize) -> Vec<f64> {
    let mut sums = vec![0.0; tests * tests];
    for (row, share) in functions.chunks(tests).zip(shares) {
        for (j, value) in row.iter().enumerate() {
            let value = value * share;
            sums[j * tests..][..=j].iter_mut().zip(row).for_each(|(s, other)| *s += value * other);
        }
    }
    sums
}

/// The lower triangle L of `L L' = matrix`, of which the lower half is read.
fn cholesky(mut matrix: Vec<f64>, n: usize) -> Result<Vec<f64>, TrackError> {
    for j in 0..n {
        let whole = matrix[j * n + j];
        for k in 0..=j {
            let known: f64 = (0..k).map(|m| matrix[j * n + m] * matrix[k * n + m]).sum();
            let rest = matrix[j * n + k] - known;
            if k < j {
                matrix[j * n + k] = rest / matrix[k * n + k];
            } else if rest > 1e-10 * whole.max(f64::MIN_POSITIVE) {
                matrix[j * n + j] = rest.sqrt();
            } else {
                return Err(TrackError::Dependent(j));
            }
        }
        matrix[j * n + j + 1..(j + 1) * n].fill(0.0);
    }
    Ok(matrix)
}

/// Functions whose Gram matrix is L L' become orthonormal: each row is multiplied by L'^-1.
fn orthonormalise(functions: &mut [f64], lower: &[f64], n: usize) {
    for row in functions.chunks_mut(n) {
        for j in 0..n {
            let known: f64 = (0..j).map(|k| row[k] * lower[j * n + k]).sum();
            row[j] = (row[j] - known) / lower[j * n + j];
        }
    }
}

fn length(what: &'static str, actual: usize, expected: usize) -> Result<(), TrackError> {
    if actual == expected { Ok(()) } else { Err(TrackError::Length { what, actual, expected }) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::coarse::Capsule;
    use crate::lab::shapes::{Cut, sheet};
    use crate::material::Material;
    use crate::model::Environment;

    const SIDE: u32 = 24;

    fn cloth() -> Model {
        let mesh = sheet(SIDE, SIDE, Cut::Alternating, |u, v| Vec3::new(u, -v, 0.0)).unwrap();
        let held: Vec<u32> = (0..=SIDE).collect();
        let environment = Environment { self_contact: false, ..Environment::default() };
        Model::new(mesh, Material::default(), environment, None, &held).unwrap()
    }

    /// Products of cosines: harmonics of the square.
    fn waves(model: &Model, side: usize) -> Vec<f32> {
        let wave = |p: &Vec3| {
            let cos = |k: usize, x: f32| (k as f32 * std::f32::consts::PI * x).cos();
            (0..side * side).map(move |j| cos(j % side, p.x) * cos(j / side, -p.y)).collect()
        };
        model.mesh().rest_positions().iter().flat_map(|p| -> Vec<f32> { wave(p) }).collect()
    }

    #[test]
    fn the_projector_takes_out_what_the_rows_see_and_nothing_else() {
        let model = cloth();
        let tracker = Tracker::new(&model, &waves(&model, 4), 16).unwrap();
        let mut chance = crate::lab::shapes::Chance::new(7);
        let mut by_chance = || Vec3A::from_array(std::array::from_fn(|_| chance.signed()));
        let mut z: Vec<Vec3A> = tracker.shares.iter().map(|_| by_chance()).collect();
        (0..=SIDE as usize).for_each(|i| z[i] = Vec3A::ZERO);
        let before = tracker.sums(z.iter().map(|z| z.to_array().map(f64::from)));
        assert!(largest(&before) > 1e-2);
        tracker.project(&mut z, false);
        let after = tracker.sums(z.iter().map(|z| z.to_array().map(f64::from)));
        assert!(largest(&after) < 1e-6, "{after:?}");
        let once = z.clone();
        tracker.project(&mut z, false);
        assert!(z.iter().zip(&once).all(|(a, b)| (*a - *b).length() < 1e-5));
    }

    #[test]
    fn a_tracked_cloth_follows_its_guide_and_is_physical_besides() {
        let model = cloth();
        let tracker = Tracker::new(&model, &waves(&model, 4), 16).unwrap();
        let mut state = model.rest_state();
        let mut ws = Workspace::default();
        let held: Vec<Vec3> = model.mesh().rest_positions()[..=SIDE as usize].to_vec();
        let ball = Moving::resting(Capsule::sphere(Vec3::new(0.5, -0.6, 0.15), 0.1));
        for step in 0..60 {
            // Swings out and in, and is compressed by a tenth: something must buckle.
            let swing = 0.3 * (step as f32 / 20.0).sin();
            let shrink = 1.0 - 0.1 * (step as f32 / 60.0);
            let lifted = model.mesh().rest_positions().iter().map(|p| {
                let at = *p * Vec3::new(1.0, shrink, 1.0);
                at + Vec3::Z * swing * p.y * p.y
            });
            let goal = tracker.measure(&lifted.collect::<Vec<_>>());
            let (goal, held, colliders) = (&goal[..], &held[..], &[ball][..]);
            let guide = Guide { goal, held, colliders, wind: Vec3::ZERO, seconds: 1.0 / 120.0 };
            let done = step_tracked(&model, &tracker, &guide, &mut state, &mut ws).unwrap();
            assert!(done.residual_m < 1e-6, "step {step}: off by {} m", done.residual_m);
        }
        let stretch =
            |e: &[u32; 2]| state.positions[e[0] as usize].distance(state.positions[e[1] as usize]);
        let edges = model.mesh().edges().iter().zip(model.mesh().rest_lengths());
        let mean: f32 =
            edges.clone().map(|(e, rest)| stretch(e) / rest).sum::<f32>() / edges.len() as f32;
        assert!(
            (0.97..1.06).contains(&mean),
            "the fine cloth buckles, it is not compressed: {mean}"
        );
    }

    #[test]
    fn functions_that_depend_on_each_other_are_refused() {
        let model = cloth();
        let twice: Vec<f32> = vec![1.0; 2 * model.mesh().vertex_count()];
        let error = Tracker::new(&model, &twice, 2).unwrap_err();
        assert!(matches!(error, TrackError::Dependent(1)), "{error}");
        assert!(matches!(Tracker::new(&model, &twice, 3), Err(TrackError::Length { .. })));
    }
}

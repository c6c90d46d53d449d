//! The run-time face: a mesh of one or two hundred points that a game steps once a frame.
//!
//! The kernel's own energies (membrane and bending, `solver`) in implicit Euler, but with work that
//! is known beforehand: a fixed number of passes, each of which takes the true forces and solves with
//! one constant matrix that no state's Hessian exceeds. It is factored once for a length of step
//! (Liu et al. 2013 show why such passes descend; for the part without Poisson's effect they are
//! projective dynamics, Bouaziz et al. 2014). Strain limit and colliders have the last word, also a
//! fixed number of times (Kavan et al. 2011, section 6, for the sphere-swept colliders; section 7 for
//! their expansion).
//!
//! Whatever happens to it, a state stays finite and bounded: speeds are limited, pins that jump take
//! the cloth along, a pass cannot overshoot, and no point gets further from its pin than cloth reaches.

mod apart;
mod between;
mod collide;
mod contact;
mod elastic;
mod envelope;
mod tether;

use glam::{Vec3, Vec3A};

use crate::material::{Material, MaterialError};
use crate::mesh::Mesh;
use crate::model::{Environment, State};
use crate::solver::SPEED_MAX_M_S;
use crate::solver::bending::Stiffness;
use crate::solver::matrix::Pattern;
use crate::solver::simd;
use between::Sample;
use collide::Swept;
pub use collide::{Capsule, Moving};
use elastic::{Constants, Group};
use envelope::Envelope;
pub use tether::Tether;

/// Points of a coarse mesh, at most.
pub const POINTS_MAX: usize = 1024;
/// Colliders of a step, at most.
pub const COLLIDERS_MAX: usize = 64;
/// Shortest and longest step (s).
pub const STEP_S: [f32; 2] = [1e-4, 0.1];
/// Colliders that one point minds in a step: those nearest to it.
const NEAREST: usize = 2;
/// Edges are shortened to this much above their rest length.
const STRAIN_MAX: f32 = 0.10;
/// Coordinates and accelerations are at most this large (m, m/s^2).
const FAR: f32 = 1e6;
/// Pins that jump further than the fastest point may go take the cloth along.
const JUMP_M_S: f32 = SPEED_MAX_M_S;

/// How much work and which liberties.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Passes of a step.
    pub passes: u32,
    /// Sweeps of the strain limit after them.
    pub sweeps: u32,
    /// How much of its resistance the membrane has against being compressed (0..=1). Less than 1 lets
    /// a coarse mesh shrink where a fine one would fold (Kavan et al. 2011, section 6).
    pub compression: f32,
    /// Share of a point's speed against the pins' that is lost per second (1/s): what air and seams
    /// take from slow swinging, which drag leaves alone.
    pub damping_per_s: f32,
    /// Added to every collider's radius (m), so that the fine points stay out as well.
    pub expansion_m: f32,
    /// Besides the points, places along the edges keep off colliders, no further apart than this (m):
    /// a thin limb does not slip between points. 0: the points alone.
    pub spacing_m: f32,
    /// Points that are no neighbours keep this far apart (m), so that layers do not pass through each
    /// other; 0: they do not mind each other.
    pub apart_m: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            passes: 6,
            sweeps: 4,
            compression: 1.0,
            damping_per_s: 0.5,
            expansion_m: 0.0,
            spacing_m: 0.0,
            apart_m: 0.0,
        }
    }
}

/// What does not change from step to step.
#[derive(Debug, Clone)]
pub struct Coarse {
    mesh: Mesh,
    material: Material,
    environment: Environment,
    settings: Settings,
    pinned: Vec<u32>,
    /// Place in the solve's order, `usize::MAX` for pinned points.
    places: Vec<usize>,
    /// Free points in the solve's order.
    order: Vec<u32>,
    /// For each free point the nearest pinned one along the cloth, and how far from it a point can
    /// be at the strain limit (m).
    leashes: Vec<(u32, u32, f32)>,
    masses: Vec<f32>,
    pattern: Pattern,
    bending: Stiffness,
    constants: Constants,
    groups: Vec<Group>,
    /// Places along edges that keep off colliders as well.
    samples: Vec<Sample>,
    shape: Envelope,
}

/// What happens during a step.
#[derive(Debug, Clone, Copy)]
pub struct Input<'a> {
    /// Where the pinned points are at the step's end (m), in the order of [`Coarse::pinned`].
    pub pins: &'a [Vec3],
    /// The colliders.
    pub colliders: &'a [Moving],
    /// Velocity of the air (m/s).
    pub wind: Vec3,
    /// Acceleration of each point on top of gravity (m/s^2): a push. Empty for none.
    pub push: &'a [Vec3],
    /// Points that something leaves some room only, such as the skin beneath them.
    pub tethers: &'a [Tether],
    /// Length of the step (s), within [`STEP_S`].
    pub seconds: f32,
}

/// Scratch; what it keeps depends on the model and the length of step alone.
#[derive(Debug, Clone, Default)]
pub struct Workspace {
    /// Length of step that the factor is for, and the factor.
    seconds: f32,
    factor: Envelope,
    swept: Vec<Swept>,
    near: Vec<[u16; NEAREST]>,
    /// How far each point may go from its start without meeting them (m).
    clear: Vec<[f32; NEAREST]>,
    /// The same for places along edges.
    near_between: Vec<[u16; NEAREST]>,
    /// Points that may come too near each other.
    apart: apart::Pairs,
    start: Vec<Vec3A>,
    aim: Vec<Vec3A>,
    x: Vec<Vec3A>,
    forces: Vec<Vec3A>,
    rhs: Vec<Vec3A>,
    normals: Vec<Vec3A>,
    /// Normal and collider's way of the contact that each point ended on.
    contacts: Vec<Option<(Vec3A, Vec3A)>>,
}

/// Why a coarse cloth could not be made or stepped.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CoarseError {
    /// A constant out of range.
    #[error(transparent)]
    Material(#[from] MaterialError),
    /// Too many points.
    #[error("{0} points; a coarse mesh has at most {POINTS_MAX}")]
    Points(usize),
    /// Pinned points that do not exist or are not ascending.
    #[error("pinned point {0} must exist and be listed once, in ascending order")]
    Pinned(u32),
    /// Settings that make no sense.
    #[error(
        "settings {0:?}: 1..=64 passes, up to 64 sweeps, compression 0..=1, damping 0..=100 a \
             second, expansion 0..=1 m, spacing 0 or 0.01..=1 m, apart 0..=1 m"
    )]
    Settings(Settings),
    /// A list of another length.
    #[error("{actual} {what} where {expected} are needed")]
    Length {
        /// Which list.
        what: &'static str,
        /// Its length.
        actual: usize,
        /// What it must be (or at most may be).
        expected: usize,
    },
    /// NaN, infinite or out of range.
    #[error("{what} {index} is not finite, or out of its range")]
    Unsound {
        /// Of which list.
        what: &'static str,
        /// Place in it.
        index: usize,
    },
}

impl Coarse {
    /// A cloth whose points `pinned` (ascending) are led.
    ///
    /// # Errors
    /// Constants or settings out of range, too many points, pins that do not exist.
    pub fn new(
        mesh: Mesh,
        material: Material,
        environment: Environment,
        pinned: &[u32],
        settings: Settings,
    ) -> Result<Self, CoarseError> {
        material.check()?;
        let count = mesh.vertex_count();
        if count > POINTS_MAX {
            return Err(CoarseError::Points(count));
        }
        for (i, pin) in pinned.iter().enumerate() {
            if *pin as usize >= count || (i > 0 && pinned[i - 1] >= *pin) {
                return Err(CoarseError::Pinned(*pin));
            }
        }
        let Settings { passes, sweeps, compression, damping_per_s, .. } = settings;
        let Settings { expansion_m, spacing_m, apart_m, .. } = settings;
        let fine =
            (1..=64).contains(&passes) && sweeps <= 64 && (0.0..=100.0).contains(&damping_per_s);
        let spaced = spacing_m.to_bits() == 0 || (0.01..=1.0).contains(&spacing_m);
        let unit = |x: f32| (0.0..=1.0).contains(&x);
        let shares = unit(compression) && unit(expansion_m) && unit(apart_m);
        if !fine || !shares || !spaced {
            return Err(CoarseError::Settings(settings));
        }
        let pattern = Pattern::new(&mesh);
        let (places, order) = arrange(&mesh, &pattern, pinned);
        let shape = Envelope::new(order.len(), below(&pattern, &places));
        let leashes = leashes(&mesh, pinned);
        Ok(Self {
            masses: mesh.vertex_areas().iter().map(|a| a * material.density).collect(),
            bending: Stiffness::new(&mesh, &pattern, material.bend),
            constants: Constants::new(&material, compression),
            groups: Group::all(&mesh),
            samples: between::samples(&mesh, spacing_m),
            pinned: pinned.to_vec(),
            mesh,
            material,
            environment,
            settings,
            places,
            order,
            leashes,
            pattern,
            shape,
        })
    }

    /// The mesh.
    pub fn mesh(&self) -> &Mesh {
        &self.mesh
    }

    /// Points that are led, ascending.
    pub fn pinned(&self) -> &[u32] {
        &self.pinned
    }

    /// The rest shape, at rest.
    pub fn rest_state(&self) -> State {
        let positions = self.mesh.rest_positions().to_vec();
        State { velocities: vec![Vec3::ZERO; positions.len()], positions }
    }

    /// Energy of motion and of height (J): what a watchdog looks at.
    pub fn energy(&self, state: &State) -> f32 {
        let gravity = self.environment.gravity;
        let one =
            |((x, v), m): ((&Vec3, &Vec3), &f32)| m * (0.5 * v.length_squared() - gravity.dot(*x));
        state.positions.iter().zip(&state.velocities).zip(&self.masses).map(one).sum()
    }

    /// Moves `state` on by `input.seconds`. The work depends on nothing but the number of points and
    /// colliders; a step of another length than the one before factors the matrix again. Equal inputs
    /// give equal bits. Allocates nothing after the first step.
    ///
    /// # Errors
    /// Lists of wrong lengths, or numbers that are not finite; `state` is then as it was.
    pub fn step(
        &self,
        input: &Input<'_>,
        state: &mut State,
        workspace: &mut Workspace,
    ) -> Result<(), CoarseError> {
        self.check(input, state)?;
        let ws = workspace;
        let dt = input.seconds;
        self.prepare(dt, ws);
        let shift = self.begin(input, state, ws);
        self.aim(input, state, ws);
        self.find_near(input, shift, ws);
        self.find_pairs(ws);
        for _ in 0..self.settings.passes {
            self.pass(dt, ws);
            self.push_out(ws);
            self.hold_tethers(input.tethers, ws);
        }
        self.hold_leashes(ws);
        for _ in 0..self.settings.sweeps {
            self.shorten(ws);
            self.keep_apart(ws);
            self.push_out(ws);
            self.push_out_between(ws);
            self.hold_tethers(input.tethers, ws);
        }
        self.hold_leashes(ws);
        self.end(dt, state, ws);
        Ok(())
    }

    fn check(&self, input: &Input<'_>, state: &State) -> Result<(), CoarseError> {
        let count = self.masses.len();
        for (what, actual, expected) in [
            ("pins", input.pins.len(), self.pinned.len()),
            ("positions", state.positions.len(), count),
            ("velocities", state.velocities.len(), count),
            ("pushes", input.push.len(), if input.push.is_empty() { 0 } else { count }),
            ("colliders", input.colliders.len(), input.colliders.len().min(COLLIDERS_MAX)),
        ] {
            if actual != expected {
                return Err(CoarseError::Length { what, actual, expected });
            }
        }
        let bad = |what, list: &[Vec3]| {
            let index = list.iter().position(|p| p.is_nan() || p.abs().max_element() > FAR);
            index.map_or(Ok(()), |index| Err(CoarseError::Unsound { what, index }))
        };
        bad("pin", input.pins)?;
        bad("push", input.push)?;
        bad("position", &state.positions)?;
        bad("velocity", &state.velocities)?;
        bad("wind", &[input.wind])?;
        if let Some(index) = input.tethers.iter().position(|t| !t.is_sound(count, FAR)) {
            return Err(CoarseError::Unsound { what: "tether", index });
        }
        let sound = |m: &Moving| m.from.is_sound(FAR) && m.to.is_sound(FAR);
        if let Some(index) = input.colliders.iter().position(|m| !sound(m)) {
            return Err(CoarseError::Unsound { what: "collider", index });
        }
        if !(STEP_S[0]..=STEP_S[1]).contains(&input.seconds) {
            return Err(CoarseError::Unsound { what: "length of step", index: 0 });
        }
        Ok(())
    }

    /// Factors the matrix for steps of `dt` (s): inertia, bending, and the membrane at its stiffest.
    fn prepare(&self, dt: f32, ws: &mut Workspace) {
        if ws.seconds.to_bits() == dt.to_bits() && ws.rhs.len() == self.order.len() {
            return;
        }
        ws.seconds = dt;
        ws.rhs.resize(self.order.len(), Vec3A::ZERO);
        ws.factor.clone_from(&self.shape);
        ws.factor.clear();
        let mut add = |a: usize, b: usize, value: f32| {
            let (p, q) = (self.places[a], self.places[b]);
            if p != usize::MAX && q != usize::MAX && p >= q {
                ws.factor.add(p, q, value);
            }
        };
        for (i, mass) in self.masses.iter().enumerate() {
            add(i, i, mass / (dt * dt) + self.bending.diagonal[i]);
            for slot in self.pattern.near.row(i) {
                add(i, self.pattern.near.columns[slot] as usize, self.bending.near[slot]);
            }
            for slot in self.pattern.far.row(i) {
                add(i, self.pattern.far.columns[slot] as usize, self.bending.far[slot]);
            }
        }
        let shapes = self.mesh.shape_gradients().iter().zip(self.mesh.rest_areas());
        for (t, (gradients, area)) in self.mesh.triangles().iter().zip(shapes) {
            for (a, ga) in t.iter().zip(gradients) {
                for (b, gb) in t.iter().zip(gradients) {
                    let value = area * self.constants.stiffness() * ga.dot(*gb);
                    add(*a as usize, *b as usize, value);
                }
            }
        }
        ws.factor.factor();
    }

    /// Takes the state over; returns by how much everything was moved because the pins jumped (m).
    fn begin(&self, input: &Input<'_>, state: &State, ws: &mut Workspace) -> Vec3A {
        let pins = self.pinned.iter().zip(input.pins);
        let ways = pins.map(|(v, pin)| *pin - state.positions[*v as usize]);
        let way = ways.sum::<Vec3>() / self.pinned.len().max(1) as f32;
        let jumped = way.length() > JUMP_M_S * input.seconds;
        let shift = Vec3A::from(if jumped { way } else { Vec3::ZERO });
        ws.start.clear();
        ws.start.extend(state.positions.iter().map(|p| Vec3A::from(*p) + shift));
        shift
    }

    /// Where each point goes by inertia, gravity, push and air; pinned points go where they are led.
    fn aim(&self, input: &Input<'_>, state: &State, ws: &mut Workspace) {
        let dt = input.seconds;
        let count = self.masses.len();
        ws.normals.clear();
        ws.normals.resize(count, Vec3A::ZERO);
        for t in self.mesh.triangles() {
            let [i, j, k] = t.map(|v| v as usize);
            let n = (ws.start[j] - ws.start[i]).cross(ws.start[k] - ws.start[i]);
            for v in [i, j, k] {
                ws.normals[v] += n;
            }
        }
        let drag = 0.5 * self.environment.air_density * self.material.drag;
        let gravity = Vec3A::from(self.environment.gravity);
        let wind = Vec3A::from(input.wind).clamp_length_max(4.0 * SPEED_MAX_M_S);
        let ways = self.pinned.iter().zip(input.pins);
        let ways = ways.map(|(v, pin)| Vec3A::from(*pin) - ws.start[*v as usize]);
        let led = ways.sum::<Vec3A>() / (dt * self.pinned.len().max(1) as f32);
        let damping = dt * self.settings.damping_per_s;
        ws.aim.clear();
        for i in 0..count {
            let push = input.push.get(i).map_or(Vec3A::ZERO, |a| Vec3A::from(*a));
            let mut v = Vec3A::from(state.velocities[i]).clamp_length_max(SPEED_MAX_M_S);
            v += (gravity + push) * dt;
            v -= (v - led) * (damping / (1.0 + damping));
            // Implicit in the velocity along the normal: air can stop a point, not throw it back.
            let n = ws.normals[i].normalize_or_zero();
            let against = n.dot(v - wind);
            let share = dt * drag * self.mesh.vertex_areas()[i] * against.abs() / self.masses[i];
            v -= n * (against * share / (1.0 + share));
            ws.aim.push(ws.start[i] + v.clamp_length_max(SPEED_MAX_M_S) * dt);
        }
        for (pin, at) in self.pinned.iter().zip(input.pins) {
            ws.aim[*pin as usize] = (*at).into();
        }
        ws.x.clone_from(&ws.aim);
    }

    /// One pass: true forces, constant matrix.
    fn pass(&self, dt: f32, ws: &mut Workspace) {
        ws.forces.clear();
        ws.forces.resize(self.masses.len(), Vec3A::ZERO);
        self.bending.add_forces(&self.pattern, &ws.x, &mut ws.forces);
        simd::run(elastic::Forces {
            groups: &self.groups,
            constants: &self.constants,
            x: &ws.x,
            forces: &mut ws.forces,
        });
        let inertia = 1.0 / (dt * dt);
        for (rhs, i) in ws.rhs.iter_mut().zip(&self.order) {
            let i = *i as usize;
            *rhs = ws.forces[i] + (ws.aim[i] - ws.x[i]) * (self.masses[i] * inertia);
        }
        ws.factor.solve(&mut ws.rhs);
        for (dx, i) in ws.rhs.iter().zip(&self.order) {
            ws.x[*i as usize] += *dx;
        }
    }

    /// One sweep over the edges, shortened where too long (Provot 1995, with masses).
    fn shorten(&self, ws: &mut Workspace) {
        let edges = self.mesh.edges().iter().zip(self.mesh.rest_lengths());
        for (e, rest) in edges {
            let [a, b] = e.map(|v| v as usize);
            let d = ws.x[b] - ws.x[a];
            let most = rest * (1.0 + STRAIN_MAX);
            let length2 = d.length_squared();
            if length2 <= most * most {
                continue;
            }
            let weight =
                |i: usize| if self.places[i] == usize::MAX { 0.0 } else { 1.0 / self.masses[i] };
            let (wa, wb) = (weight(a), weight(b));
            // Between two pins nothing gives, however far apart they are led.
            if wa + wb <= 0.0 {
                continue;
            }
            let length = length2.sqrt();
            let correction = d * ((length - most) / (length * (wa + wb)));
            ws.x[a] += correction * wa;
            ws.x[b] -= correction * wb;
        }
    }

    /// Leads back what is further from its pin than cloth reaches (Kim et al. 2012, "Long range
    /// attachments"): what no sweep over edges can undo in a step, such as a ball that tears along.
    fn hold_leashes(&self, ws: &mut Workspace) {
        for (point, pin, most) in &self.leashes {
            let pin = ws.x[*pin as usize];
            let x = &mut ws.x[*point as usize];
            *x = pin + (*x - pin).clamp_length_max(*most);
        }
    }

    fn end(&self, dt: f32, state: &mut State, ws: &mut Workspace) {
        for (i, x) in ws.x.iter().enumerate() {
            let mut way = *x - ws.start[i];
            if let Some((normal, travel)) = ws.contacts[i] {
                // Contact is inelastic: nothing leaves faster than the collider itself moves.
                way -= normal * normal.dot(way - travel).max(0.0);
            }
            state.positions[i] = (*x).into();
            state.velocities[i] = (way / dt).clamp_length_max(SPEED_MAX_M_S).into();
        }
    }
}

/// Places of free points in the solve's order, and the order itself.
fn arrange(mesh: &Mesh, pattern: &Pattern, pinned: &[u32]) -> (Vec<usize>, Vec<u32>) {
    let count = mesh.vertex_count();
    let free: Vec<u32> = (0..count as u32).filter(|v| pinned.binary_search(v).is_err()).collect();
    let mut number = vec![u32::MAX; count];
    free.iter().enumerate().for_each(|(n, v)| number[*v as usize] = n as u32);
    let neighbours = |v: &u32| {
        let row = *v as usize;
        let near = pattern.near.row(row).map(|s| pattern.near.columns[s]);
        let far = pattern.far.row(row).map(|s| pattern.far.columns[s]);
        near.chain(far).map(|v| number[v as usize]).filter(|n| *n != u32::MAX).collect()
    };
    let neighbours: Vec<Vec<u32>> = free.iter().map(neighbours).collect();
    let order: Vec<u32> =
        envelope::order(&neighbours).into_iter().map(|n| free[n as usize]).collect();
    let mut places = vec![usize::MAX; count];
    order.iter().enumerate().for_each(|(place, v)| places[*v as usize] = place);
    (places, order)
}

/// For each point that hangs on a pinned one: the nearest along the edges, and the way to it at the
/// strain limit (m).
fn leashes(mesh: &Mesh, pinned: &[u32]) -> Vec<(u32, u32, f32)> {
    let mut nearest: Vec<(f32, u32)> = vec![(f32::INFINITY, 0); mesh.vertex_count()];
    pinned.iter().for_each(|pin| nearest[*pin as usize] = (0.0, *pin));
    let edges = || mesh.edges().iter().zip(mesh.rest_lengths());
    let mut changed = true;
    while changed {
        changed = false;
        for (e, length) in edges() {
            for [from, to] in [[e[0], e[1]], [e[1], e[0]]] {
                let (way, pin) = nearest[from as usize];
                if way + length < nearest[to as usize].0 {
                    nearest[to as usize] = (way + length, pin);
                    changed = true;
                }
            }
        }
    }
    let leash = |(point, (way, pin)): (usize, &(f32, u32))| {
        let free = *way > 0.0 && way.is_finite();
        free.then_some((point as u32, *pin, way * (1.0 + STRAIN_MAX)))
    };
    nearest.iter().enumerate().filter_map(leash).collect()
}

/// Entries below the diagonal, in the solve's order.
fn below(pattern: &Pattern, places: &[usize]) -> impl Iterator<Item = (usize, usize)> {
    (0..places.len()).flat_map(move |v| {
        let near = pattern.near.row(v).map(|s| pattern.near.columns[s]);
        let far = pattern.far.row(v).map(|s| pattern.far.columns[s]);
        near.chain(far).filter_map(move |w| {
            let (p, q) = (places[v], places[w as usize]);
            (p != usize::MAX && q != usize::MAX && p > q).then_some((p, q))
        })
    })
}

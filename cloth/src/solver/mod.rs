//! The step: implicit Euler, two projected Newton linearisations and contact passes a substep.
//!
//! The first pass keeps the cloth off the contact planes found at the substep's beginning, the
//! second, linearised where the first ended, off those found at its end. Baraff & Witkin 1998 for
//! the implicit system, Kim & Eberle 2022 for projection; contact and limits as their modules say.

pub(crate) mod aggregate;
pub(crate) mod bending;
pub(crate) mod coarse_level;
pub(crate) mod contact;
pub(crate) mod limit;
pub(crate) mod matrix;
pub(crate) mod membrane;
pub(crate) mod self_contact;
pub(crate) mod simd;
pub mod track;

use glam::{Mat3A, Vec3, Vec3A};

use crate::body::Pose;
use crate::model::{Model, State};
use crate::rigid::Rigid;
use crate::surface::Posed;
use contact::{Friction, Kind, Near, Row};
use matrix::{Given, Matrix, Scratch, Stop};
use self_contact::SelfContact;

/// Longest substep (s).
pub const SUBSTEP_S_MAX: f32 = 1.0 / 120.0;
/// The body moves at most this far in a substep where that takes no more than 8 times as many (m).
const BODY_WAY_M: f32 = 0.03;
/// Vertices deeper inside than this at a frame's beginning are given up to the cloth around (m).
const DEPTH_FOUND_M: f32 = 0.12;
/// How readily a held vertex gives way to the strain limit, against a free one.
const HELD_SHARE: f32 = 0.02;
/// The ground is looked for this far further down than a vertex moves (m).
const NEAR_M: f32 = 0.005;
/// Deeper than this a vertex is put back on its contact plane after the solve (m).
const SLACK_M: f32 = 1e-5;
/// No vertex moves faster (m/s).
pub const SPEED_MAX_M_S: f32 = 40.0;

/// The first pass only has to find where the second is to be linearised. From 3e-2 on limp, heavy
/// cloth gains energy (bench B3); at 2e-2 a sheet at rest hops a little faster than its test allows;
/// at 1e-2 a tumbling one loses more momentum (bench A12). What scatters there is resting contact,
/// not this number.
const FIRST: Stop = Stop { tolerance: 1.8e-2, iterations: 40 };
const SECOND: Stop = Stop { tolerance: 2e-3, iterations: 80 };

/// What happens during a step.
#[derive(Debug, Clone, Copy)]
pub struct Span<'a> {
    /// The body's pose at the beginning and at the end; without a body nothing.
    pub motion: Option<(&'a Pose, &'a Pose)>,
    /// How long it takes (s).
    pub seconds: f32,
    /// 1, or by how much finer than usual to divide it.
    pub refine: u32,
    /// Whether an outer layer that lies inside an inner one is led through it, as a garment that is
    /// draped for the first time may need. Otherwise nothing passes, whatever the order.
    pub sort_layers: bool,
}

/// What a step took.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Effort {
    /// Substeps.
    pub substeps: u32,
    /// Iterations of conjugate gradients.
    pub iterations: u32,
    /// Sweeps of the strain limit.
    pub sweeps: u32,
    /// Pairs of the cloth with itself that were listed.
    pub pairs: u32,
    /// Vertices that were moved on in one piece, so that their cloth should not cross itself.
    pub pieces: u32,
    /// Substeps in which all of the cloth was moved on as one piece, for nothing else kept it whole.
    pub wholes: u32,
}

/// A step that came out of bounds.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("vertex {vertex} is at {position} in substep {substep} of {substeps}")]
pub struct StepError {
    /// The first vertex that is not finite.
    pub vertex: usize,
    /// Where it is.
    pub position: Vec3,
    /// Substep in which it happened.
    pub substep: u32,
    /// Of how many.
    pub substeps: u32,
}

/// Scratch of the step; holds nothing that a later step depends on.
#[derive(Debug, Clone, Default)]
pub struct Workspace {
    pose: Option<Pose>,
    joints: Vec<Rigid>,
    from: Posed,
    to: Posed,
    x: Vec<Vec3A>,
    v: Vec<Vec3A>,
    dx: Vec<Vec3A>,
    /// The matrix's diagonal without contacts.
    bare: Vec<Mat3A>,
    ends: Vec<Vec3A>,
    forces: Vec<Vec3A>,
    normals: Vec<Vec3A>,
    reference: Vec<Vec3A>,
    near: Vec<Near>,
    rows: Vec<Row>,
    ground: Vec<Row>,
    loads: Vec<[f32; 2]>,
    held: Vec<bool>,
    inverse_masses: Vec<f32>,
    free: Vec<f32>,
    self_contact: SelfContact,
    /// What holds the cloth as a whole: inertia, air and, in a pass, bodies (kg/s^2).
    hold: Mat3A,
    busy: Vec<limit::Edge>,
    matrix: Matrix,
    scratch: Scratch,
}

/// Moves `state` on by `span.seconds`; equal inputs give equal bits, whatever `workspace` served
/// for before.
///
/// # Errors
/// A position or velocity that is not finite; `state` is then of no use.
pub fn step(
    model: &Model,
    span: &Span<'_>,
    state: &mut State,
    workspace: &mut Workspace,
) -> Result<Effort, StepError> {
    let ws = workspace;
    ws.begin(model, state);
    ws.self_contact.sort_layers = span.sort_layers;
    let way = ws.body_way(model, span);
    let base = ((span.seconds / SUBSTEP_S_MAX) - 1e-3).ceil().max(1.0) as u32;
    let asked = (way / BODY_WAY_M).ceil() as u32;
    let substeps = asked.clamp(base, 8 * base) * span.refine.max(1);
    let dt = span.seconds / substeps as f32;
    let body_way = way / substeps as f32;
    ws.find_all(model, dt, body_way);
    if model.environment.self_contact {
        ws.self_contact.find_tangles(model, &ws.x);
    }
    let mut effort = Effort { substeps, ..Effort::default() };
    for substep in 0..substeps {
        if let Some((from, to)) = span.motion {
            ws.pose_body(model, from, to, (substep + 1) as f32 / substeps as f32);
        }
        ws.substep(model, dt, body_way, substep == 0, &mut effort);
        let finite = |(x, v): (&Vec3A, &Vec3A)| x.is_finite() && v.is_finite();
        if let Some(vertex) = ws.x.iter().zip(&ws.v).position(|p| !finite(p)) {
            let position = ws.x[vertex].into();
            return Err(StepError { vertex, position, substep, substeps });
        }
        std::mem::swap(&mut ws.from, &mut ws.to);
    }
    for (i, (x, v)) in ws.x.iter().zip(&ws.v).enumerate() {
        state.positions[i] = (*x).into();
        state.velocities[i] = (*v).into();
    }
    Ok(effort)
}

impl Workspace {
    /// The body's surface where the last step left it.
    pub fn body(&self) -> &Posed {
        &self.from
    }

    fn begin(&mut self, model: &Model, state: &State) {
        let count = model.mesh.vertex_count();
        assert_eq!(state.positions.len(), count, "a state has as many vertices as its model");
        assert_eq!(state.velocities.len(), count, "a state has as many vertices as its model");
        self.x.clear();
        self.x.extend(state.positions.iter().map(|p| Vec3A::from(*p)));
        self.v.clear();
        self.v.extend(state.velocities.iter().map(|v| Vec3A::from(*v)));
        for list in [&mut self.dx, &mut self.ends, &mut self.forces] {
            list.clear();
            list.resize(count, Vec3A::ZERO);
        }
        self.normals.resize(count, Vec3A::ZERO);
        self.scratch.residual.resize(count, Vec3A::ZERO);
        self.rows.resize(count, Row::default());
        self.ground.resize(count, Row::default());
        self.loads.clear();
        self.loads.resize(count, [0.0; 2]);
        self.bare.resize(count, Mat3A::ZERO);
        self.matrix.size(&model.pattern);
        self.held.clear();
        self.held.resize(count, false);
        self.inverse_masses.clear();
        self.inverse_masses.extend(model.masses.iter().map(|m| 1.0 / m));
        self.free.clone_from(&self.inverse_masses);
        self.reference.clear();
        self.reference.extend(model.masses.iter().map(|m| Vec3A::Y * (9.81 * m)));
        for a in &model.attachments {
            self.held[a.vertex as usize] = true;
            self.inverse_masses[a.vertex as usize] *= HELD_SHARE;
        }
    }

    /// Poses the body at the beginning; returns the longest way of a point of its surface, less
    /// the way on which the cloth is as a whole (m): what a character carries along costs nothing, and what runs
    /// into cloth that hangs still is met in time.
    fn body_way(&mut self, model: &Model, span: &Span<'_>) -> f32 {
        let (Some(character), Some((from, to))) = (&model.body, span.motion) else { return 0.0 };
        character.body.skin(from, &mut self.joints, &mut self.from.positions);
        character.body.skin(to, &mut self.joints, &mut self.to.positions);
        character.surface.refit(&mut self.from);
        let mean = self.v.iter().sum::<Vec3A>() / self.v.len().max(1) as f32;
        let shift = Vec3::from(mean * span.seconds);
        let ends = self.from.positions.iter().zip(&self.to.positions);
        ends.map(|(a, b)| (*b - *a - shift).length_squared()).fold(0.0, f32::max).sqrt()
    }

    fn pose_body(&mut self, model: &Model, from: &Pose, to: &Pose, t: f32) {
        let Some(character) = &model.body else { return };
        let pose = self.pose.get_or_insert_with(|| from.clone());
        pose.interpolate_into(from, to, t);
        character.body.skin(pose, &mut self.joints, &mut self.to.positions);
        character.surface.refit(&mut self.to);
    }

    fn find_all(&mut self, model: &Model, dt: f32, body_way: f32) {
        self.near.clear();
        for (i, (x, v)) in self.x.iter().zip(&self.v).enumerate() {
            let reach = contact::reach(model.material.offset, v.length() * dt, body_way);
            let reach = reach.max(DEPTH_FOUND_M);
            self.near.push(Near::find(
                model,
                &self.from,
                (*x).into(),
                reach,
                model.nearest.get(i).copied(),
            ));
        }
    }

    fn substep(&mut self, model: &Model, dt: f32, body_way: f32, first: bool, effort: &mut Effort) {
        effort.substeps = effort.substeps.max(1);
        self.set_guess(model, dt);
        self.carry_rows(model, dt);
        let wind = model.environment.wind;
        self.assemble(model, wind, dt, true);
        if first {
            self.scratch.coarse.gather(&model.shares, &model.pattern, &self.matrix);
        }
        effort.iterations += self.pass(model, dt, true);
        self.find_rows(model, dt, body_way);
        self.find_pairs(model);
        self.assemble(model, wind, dt, false);
        effort.iterations += self.pass(model, dt, false);
        self.finish(model, dt, effort);
    }

    /// First guess of the way of each vertex: on by its velocity; held vertices go where they
    /// are led.
    fn set_guess(&mut self, model: &Model, dt: f32) {
        for (guess, v) in self.dx.iter_mut().zip(&self.v) {
            *guess = *v * dt;
        }
        let Some(c) = &model.body else {
            model.attachments.iter().for_each(|a| self.dx[a.vertex as usize] = Vec3A::ZERO);
            return;
        };
        for a in &model.attachments {
            self.ends[a.vertex as usize] = a.place(&c.surface, &self.to).into();
        }
        limit::tighten(&model.held_edges, &self.inverse_masses, &mut self.ends);
        for a in &model.attachments {
            let i = a.vertex as usize;
            self.dx[i] = self.ends[i] - self.x[i];
        }
    }

    fn carry_rows(&mut self, model: &Model, dt: f32) {
        let offset = model.material.offset;
        let fall = Vec3A::from(model.environment.gravity) * (dt * dt);
        for i in 0..self.x.len() {
            let ahead = self.x[i] + self.dx[i] + fall;
            let mut row = Row::default();
            if let Some(c) = &model.body {
                let near = &self.near[i];
                row = near.carried(&c.surface, &self.from, &self.to);
                row = row.keep(offset, near.distance, dt);
            }
            self.rows[i] = if meets(&row, ahead) { row } else { Row::default() };
            self.ground[i] = ground_row(model, ahead, 0.0);
        }
    }

    /// Looks for the body where the first pass has led each vertex.
    fn find_rows(&mut self, model: &Model, dt: f32, body_way: f32) {
        let offset = model.material.offset;
        for i in 0..self.x.len() {
            let at = self.x[i] + self.dx[i];
            self.loads[i] = [self.rows[i].load(at), self.ground[i].load(at)];
            self.ground[i] = ground_row(model, at, self.dx[i].length() + NEAR_M);
            let Some(c) = &model.body else { continue };
            let reach = contact::reach(offset, self.dx[i].length(), body_way);
            let start = if self.near[i].found { self.near[i].distance } else { offset };
            let inside = (-start).max(0.0);
            let first = self.near[i].triangle();
            let near = Near::find(model, &self.to, at.into(), reach + inside, first);
            self.near[i] = near;
            self.rows[i] = near.ended(&c.surface, &self.from, &self.to).keep(offset, start, dt);
        }
    }

    /// Lists the pairs of the cloth itself that may meet on the way of the first pass.
    fn find_pairs(&mut self, model: &Model) {
        if model.environment.self_contact {
            if self.self_contact.is_tangled() {
                self.self_contact.find_tangles(model, &self.x);
            }
            self.self_contact.mark_tangles(model);
            self.self_contact.find(model, &self.x, &self.dx);
        }
    }

    /// Solves for the way `dx`, from the guess that stands there, with the contacts of this pass.
    fn pass(&mut self, model: &Model, dt: f32, first: bool) -> u32 {
        let stop = if first { FIRST } else { SECOND };
        self.matrix.diagonal.copy_from_slice(&self.bare);
        self.scratch.residual.copy_from_slice(&self.forces);
        self.add_contacts(model, dt, first);
        let added = self.matrix.diagonal.iter().zip(&self.bare).map(|(now, bare)| *now - *bare);
        let hold = added.fold(self.hold, |sum, block| sum + block);
        if !first && model.environment.self_contact {
            let pass = self_contact::Pass {
                x: &self.x,
                v: &self.v,
                way: &self.dx,
                inverse_masses: &self.inverse_masses,
                dt,
            };
            let force = &mut self.scratch.residual;
            self.self_contact.add_rows(model, pass, &mut self.matrix, force);
        }
        let (held, reference) = (&self.held[..], &self.reference[..]);
        self.scratch.coarse.factorise(&model.shares, &self.bare, &self.matrix.diagonal);
        let shares = &model.shares;
        let given = Given { pattern: &model.pattern, held, reference, shares, stop };
        let iterations = self.matrix.solve(given, &mut self.dx, &mut self.scratch);
        if !first && model.attachments.is_empty() {
            // Forces within the cloth add up to nothing, but what is left of them when iterations end
            // does not: cloth that flies freely would be slowed or hastened.
            let left = self.scratch.residual.iter().sum::<Vec3A>();
            let shift = hold.inverse() * left;
            self.dx.iter_mut().for_each(|dx| *dx += shift);
        }
        iterations
    }

    /// Matrix and right-hand side (in `forces`) of inertia, gravity, air, bending, membrane and
    /// damping, linearised where the substep begins, or then where the first pass has led.
    fn assemble(&mut self, model: &Model, wind: Vec3, dt: f32, first: bool) {
        let scale = 1.0 + model.material.damping_s / dt;
        let (matrix, bending) = (&mut self.matrix, &model.bending);
        matrix.pairs.0.clear();
        for (block, slot) in matrix.upper.iter_mut().zip(&model.pattern.near_upper.whole) {
            let w = bending.near[*slot as usize] * scale;
            *block = [w, 0.0, 0.0, 0.0, w, 0.0, 0.0, 0.0, w];
        }
        for (far, exact) in matrix.far.iter_mut().zip(&bending.far) {
            *far = exact * scale;
        }
        for (d, w) in matrix.diagonal.iter_mut().zip(&bending.diagonal) {
            *d = Mat3A::from_diagonal(Vec3::splat(w * scale));
        }
        let (mesh, pattern, x) = (&model.mesh, &model.pattern, &mut self.ends);
        x.copy_from_slice(&self.x);
        if !first {
            x.iter_mut().zip(&self.dx).for_each(|(x, dx)| *x += *dx);
        }
        self.forces.fill(Vec3A::ZERO);
        bending.add_forces(pattern, x, &mut self.forces);
        let constants = membrane::Constants::new(&model.material);
        let sums = membrane::Sums { forces: &mut self.forces, matrix: &mut *matrix };
        membrane::assemble(mesh, pattern, constants, scale, x, sums);
        matrix.mirror(pattern);
        if !first {
            // The unknowns are whole ways, of which the forces are told some way on.
            matrix.multiply(pattern, &self.dx, &mut self.normals);
            for (force, slope) in self.forces.iter_mut().zip(&self.normals) {
                *force += *slope * (1.0 / scale);
            }
        }
        let gravity = Vec3A::from(model.environment.gravity);
        let mass: f32 = model.masses.iter().sum();
        self.hold = Mat3A::from_diagonal(Vec3::splat(mass / (dt * dt)));
        for (i, d) in matrix.diagonal.iter_mut().enumerate() {
            let inertia = model.masses[i] / (dt * dt);
            *d += Mat3A::from_diagonal(Vec3::splat(inertia));
            self.forces[i] += gravity * model.masses[i] + self.v[i] * (dt * inertia);
        }
        self.add_air(model, wind, dt);
        self.bare.copy_from_slice(&self.matrix.diagonal);
    }

    /// Drag on each vertex's share of the sheet, along the sheet's normal.
    fn add_air(&mut self, model: &Model, wind: Vec3, dt: f32) {
        let factor = 0.5 * model.environment.air_density * model.material.drag;
        if factor <= 0.0 {
            return;
        }
        self.normals.fill(Vec3A::ZERO);
        for t in model.mesh.triangles() {
            let [i, j, k] = t.map(|v| v as usize);
            let n = (self.x[j] - self.x[i]).cross(self.x[k] - self.x[i]);
            for v in [i, j, k] {
                self.normals[v] += n;
            }
        }
        let wind = Vec3A::from(wind);
        for (i, area) in model.mesh.vertex_areas().iter().enumerate() {
            let n = self.normals[i].normalize_or_zero();
            let speed = n.dot(self.v[i] - wind);
            let c = factor * area * speed.abs() / dt;
            let drag = Mat3A::from_cols(n * n.x, n * n.y, n * n.z) * c;
            self.matrix.diagonal[i] += drag;
            self.hold += drag;
            self.forces[i] += n * (n.dot(wind * dt) * c);
        }
    }

    /// Rows and friction. Those of the first pass have been chosen by where vertices head; those
    /// of the second act where the first pass has led a vertex too near.
    fn add_contacts(&mut self, model: &Model, dt: f32, first: bool) {
        let fall = Vec3A::from(model.environment.gravity) * (dt * dt);
        for i in 0..self.x.len() {
            if self.held[i] {
                continue;
            }
            let (x, at, way) = (self.x[i], self.x[i] + self.dx[i], self.v[i] * dt + fall);
            let mass = model.masses[i];
            let diagonal = &mut self.matrix.diagonal[i];
            let force = &mut self.scratch.residual[i];
            let mut add = |row: &Row, coefficient, load| {
                let acts = row.kind == Kind::Plane && (first || row.gap(at) < 0.0);
                if acts || row.kind == Kind::Held {
                    let friction = Friction { coefficient, load, way, mass, dt };
                    row.add(x, Vec3A::ZERO, friction, diagonal, force);
                }
            };
            add(&self.rows[i], model.material.friction, self.loads[i][0]);
            add(&self.ground[i], model.environment.ground_friction, self.loads[i][1]);
        }
    }

    /// Strain limit, new velocities and positions.
    fn finish(&mut self, model: &Model, dt: f32, effort: &mut Effort) {
        let ends = &mut self.ends;
        for (i, end) in ends.iter_mut().enumerate() {
            *end = self.x[i] + self.dx[i];
            self.loads[i] = [self.rows[i].load(*end), self.ground[i].load(*end)];
            for row in [&self.rows[i], &self.ground[i]] {
                // What the second pass led in where the first had not.
                if row.kind == Kind::Plane && !self.held[i] && row.gap(*end) < -SLACK_M {
                    let out = row.push_out(*end);
                    self.dx[i] += out - *end;
                    *end = out;
                }
            }
        }
        let own = model.environment.self_contact;
        if own {
            self.self_contact.untangle(model, &self.inverse_masses, ends);
        }
        let sweeps = limit::project(
            &model.mesh,
            &self.inverse_masses,
            &self.free,
            &self.rows,
            ends,
            &mut self.busy,
        );
        effort.sweeps += sweeps;
        let mut moved = sweeps > 0;
        if own {
            moved |= self.self_contact.is_tangled();
            let bounded = self.self_contact.bound(model, &self.x, &self.inverse_masses, ends);
            moved |= bounded.moved;
            effort.pairs += self.self_contact.pairs.len() as u32;
            effort.pieces += bounded.pieces;
            effort.wholes += u32::from(bounded.whole);
        }
        for (i, end) in ends.iter().copied().enumerate() {
            let mut way = if moved { end - self.x[i] } else { self.dx[i] };
            if !self.held[i] {
                for (row, load) in [&self.rows[i], &self.ground[i]].into_iter().zip(self.loads[i]) {
                    if load > 0.0 {
                        way = row.without_bounce(way);
                    }
                }
            }
            self.v[i] = (way / dt).clamp_length_max(SPEED_MAX_M_S);
            self.x[i] = end;
            if let Some(c) = &model.body {
                self.near[i].moved(&c.surface, &self.to, end.into());
            }
        }
    }
}

fn meets(row: &Row, at: Vec3A) -> bool {
    row.kind == Kind::Held || row.kind == Kind::Plane && row.gap(at) < 0.0
}

/// The ground, where it is less than `reach` (m) further down than it must stay.
fn ground_row(model: &Model, at: Vec3A, reach: f32) -> Row {
    let offset = model.material.offset;
    if model.environment.ground && at.y < offset + reach {
        Row::ground(at, offset)
    } else {
        Row::default()
    }
}

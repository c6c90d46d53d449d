//! Contact with the body and the ground as stiff one-sided rows of the implicit system.
//!
//! A vertex keeps off the plane through the closest point of the body. The plane found at a
//! substep's beginning is carried with its triangle to the substep's end, so that a fast limb
//! pushes the cloth before it instead of passing through; then planes are looked for again.

use glam::{Mat3, Mat3A, Vec3, Vec3A};

use crate::model::Model;
use crate::surface::{Posed, Surface};

/// Stiffness of a row (N/m): a hanging garment's weight sinks in by micrometres.
const STIFFNESS: f32 = 1e4;
/// A vertex inside is led out no faster than this (m/s).
const CORRECTION_M_S: f32 = 2.0;
/// A vertex deeper than this is examined for being held between two body parts (m).
const PINCH_DEPTH_M: f32 = 0.002;
/// Stiffness with which a vertex held between two body parts follows them (N/m).
const HELD_STIFFNESS: f32 = 300.0;
/// Slip at which Coulomb's force is reached (m/s).
const STICK_M_S: f32 = 1e-3;
/// Planes are looked for this much further than the motion of a substep demands (m).
const MARGIN_M: f32 = 0.015;

/// Where a vertex was found near the body.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Near {
    /// Whether anything is near.
    pub(crate) found: bool,
    /// Held between two body parts.
    pub(crate) pinched: bool,
    triangle: u32,
    weights: Vec3,
    normal: Vec3,
    /// Signed distance (m).
    pub(crate) distance: f32,
}

/// What a vertex must keep during one substep.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Row {
    pub(crate) kind: Kind,
    normal: Vec3A,
    /// Point of the plane at the substep's end (m).
    point: Vec3A,
    /// Way of that point of the body during the substep (m).
    travel: Vec3A,
    /// Distance to keep (m).
    offset: f32,
}

/// Kinds of rows.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) enum Kind {
    #[default]
    None,
    /// Stay in front of the plane.
    Plane,
    /// Follow the body.
    Held,
}

/// What friction needs besides a row.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Friction {
    pub(crate) coefficient: f32,
    /// Normal force (N).
    pub(crate) load: f32,
    /// Way that the vertex would go by its velocity and gravity (m).
    pub(crate) way: Vec3A,
    /// Of the vertex (kg).
    pub(crate) mass: f32,
    /// Substep (s).
    pub(crate) dt: f32,
}

impl Near {
    /// Looks at `point` within `reach` (m), first at the triangle `first`.
    pub(crate) fn find(
        model: &Model,
        posed: &Posed,
        point: Vec3,
        reach: f32,
        first: Option<u32>,
    ) -> Self {
        let Some(character) = &model.body else { return Self::default() };
        let surface = &character.surface;
        let Some(c) = surface.closest_from(posed, point, reach, first) else {
            return Self::default();
        };
        let deep = c.distance < -PINCH_DEPTH_M;
        Self {
            found: true,
            pinched: deep && surface.is_pinched(posed, &c, model.material.offset),
            triangle: c.triangle,
            weights: c.weights,
            normal: c.normal,
            distance: c.distance,
        }
    }

    /// Where to look first the next time.
    pub(crate) fn triangle(&self) -> Option<u32> {
        self.found.then_some(self.triangle)
    }

    /// Measures the distance to the plane again after the vertex moved to `point`.
    pub(crate) fn moved(&mut self, surface: &Surface, posed: &Posed, point: Vec3) {
        if self.found {
            let plane = surface.point(posed, self.triangle, self.weights);
            self.distance = self.normal.dot(point - plane);
        }
    }

    /// The row of a plane found at the substep's beginning, carried to its end.
    pub(crate) fn carried(&self, surface: &Surface, from: &Posed, to: &Posed) -> Row {
        if !self.found {
            return Row::default();
        }
        let frame = |posed| {
            Mat3::from_cols_array_2d(
                &surface.triangle_frame(posed, self.triangle).map(|v| v.to_array()),
            )
        };
        let local = frame(from).transpose() * self.normal;
        let normal = (frame(to) * local).normalize_or_zero();
        self.row(surface, from, to, normal)
    }

    /// The row of a plane found at the substep's end.
    pub(crate) fn ended(&self, surface: &Surface, from: &Posed, to: &Posed) -> Row {
        if self.found { self.row(surface, from, to, self.normal) } else { Row::default() }
    }

    fn row(&self, surface: &Surface, from: &Posed, to: &Posed, normal: Vec3) -> Row {
        let point = surface.point(to, self.triangle, self.weights);
        let travel = point - surface.point(from, self.triangle, self.weights);
        Row {
            kind: if self.pinched { Kind::Held } else { Kind::Plane },
            normal: normal.into(),
            point: point.into(),
            travel: travel.into(),
            offset: 0.0,
        }
    }
}

impl Row {
    /// In front of the plane through `point`, which moves by `travel` during the substep.
    pub(crate) fn plane(normal: Vec3A, point: Vec3A, travel: Vec3A, offset: f32) -> Self {
        Self { kind: Kind::Plane, normal, point, travel, offset }
    }

    /// The ground below `x`.
    pub(crate) fn ground(x: Vec3A, offset: f32) -> Self {
        let point = Vec3A::new(x.x, 0.0, x.z);
        Self { kind: Kind::Plane, normal: Vec3A::Y, point, travel: Vec3A::ZERO, offset }
    }

    /// Asks for `offset`, or for less if the vertex began the substep at the signed distance
    /// `start` inside and would have to be led out too fast.
    pub(crate) fn keep(mut self, offset: f32, start: f32, dt: f32) -> Self {
        self.offset = offset.min(start + CORRECTION_M_S * dt);
        self
    }

    /// How far in front of its plane's offset a vertex would be at `x` (m).
    pub(crate) fn gap(&self, x: Vec3A) -> f32 {
        self.normal.dot(x - self.point) - self.offset
    }

    /// Normal force at `x` (N).
    pub(crate) fn load(&self, x: Vec3A) -> f32 {
        if self.kind == Kind::Plane { STIFFNESS * (-self.gap(x)).max(0.0) } else { 0.0 }
    }

    /// Adds the row's Hessian and its force at `x + dx` for a vertex that began at `x`.
    pub(crate) fn add(
        &self,
        x: Vec3A,
        dx: Vec3A,
        friction: Friction,
        diagonal: &mut Mat3A,
        force: &mut Vec3A,
    ) {
        if self.kind == Kind::Held {
            *diagonal += Mat3A::from_diagonal(Vec3::splat(HELD_STIFFNESS));
            *force += (self.travel - dx) * HELD_STIFFNESS;
            return;
        }
        let n = self.normal;
        let normal = Mat3A::from_cols(n * n.x, n * n.y, n * n.z);
        *diagonal += normal * STIFFNESS;
        *force -= n * (STIFFNESS * self.gap(x + dx));
        let slip = |way: Vec3A| way - self.travel - n * n.dot(way - self.travel);
        let most = friction.coefficient * friction.load;
        // Coulomb's force, linear in the slip that it leaves of a free one: taken against the old slip
        // it would hold back whatever starts to slide.
        let left = slip(friction.way).length() - most * friction.dt * friction.dt / friction.mass;
        let drag = (most / left.max(STICK_M_S * friction.dt)).min(STIFFNESS);
        *diagonal += (Mat3A::IDENTITY - normal) * drag;
        *force -= slip(dx) * drag;
    }

    /// The same way without leaving the body faster than it moves itself: contact is inelastic.
    pub(crate) fn without_bounce(&self, dx: Vec3A) -> Vec3A {
        dx - self.normal * self.normal.dot(dx - self.travel).max(0.0)
    }

    /// Moves `x` in front of the plane.
    pub(crate) fn push_out(&self, x: Vec3A) -> Vec3A {
        x - self.normal * self.gap(x).min(0.0)
    }
}

/// How far from a vertex planes must be looked for (m), when it and the body move so far.
pub(crate) fn reach(offset: f32, vertex_way: f32, body_way: f32) -> f32 {
    offset + MARGIN_M + vertex_way + body_way
}

//! Sphere-swept colliders that move during a step.

use glam::{Vec3, Vec3A};

/// A capsule: all points within `radius` of a segment; a sphere where both ends are equal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Capsule {
    /// Both ends of the segment (m).
    pub ends: [Vec3; 2],
    /// Radius (m).
    pub radius: f32,
}

/// A capsule at the beginning and at the end of a step; in between it moves evenly.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moving {
    /// At the beginning.
    pub from: Capsule,
    /// At the end.
    pub to: Capsule,
}

impl Capsule {
    /// A sphere.
    pub fn sphere(center: Vec3, radius: f32) -> Self {
        Self { ends: [center, center], radius }
    }

    /// The point of its axis that is nearest to `x`, and how far along it lies (0 to 1).
    pub(crate) fn closest(&self, x: Vec3A) -> (Vec3A, f32) {
        closest(&self.ends.map(Vec3A::from), x)
    }

    /// Whether no number is NaN or above `far` and the radius is not below 0.
    pub(super) fn is_sound(&self, far: f32) -> bool {
        let near = |e: &Vec3| !e.is_nan() && e.abs().max_element() <= far;
        self.ends.iter().all(near) && (0.0..=far).contains(&self.radius)
    }
}

impl Moving {
    /// One that stands still.
    pub fn resting(capsule: Capsule) -> Self {
        Self { from: capsule, to: capsule }
    }
}

/// A collider prepared for one step.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Swept {
    from: [Vec3A; 2],
    to: [Vec3A; 2],
    /// With the cloth's offset and the expansion (m).
    radius: f32,
    /// Sphere around the whole way.
    center: Vec3A,
    reach: f32,
}

/// Where a vertex ended up against a collider.
#[derive(Debug, Clone, Copy)]
pub(super) struct Hit {
    pub(super) normal: Vec3A,
    /// How far the vertex has to go along the normal (m).
    pub(super) depth: f32,
    /// Way of the collider where it was hit (m).
    pub(super) travel: Vec3A,
}

impl Swept {
    pub(super) fn new(moving: &Moving, offset: f32, shift: Vec3A) -> Self {
        let points = |c: &Capsule| c.ends.map(Vec3A::from);
        let (from, to) = (points(&moving.from).map(|p| p + shift), points(&moving.to));
        let center = (from[0] + from[1] + to[0] + to[1]) * 0.25;
        let radius = moving.from.radius.max(moving.to.radius) + offset;
        let far = |p: &Vec3A| (*p - center).length();
        let reach = from.iter().chain(&to).map(far).fold(0.0, f32::max) + radius;
        Self { from, to, radius, center, reach }
    }

    /// By how much a vertex that stays within `way` of `x` misses the collider's whole way, at
    /// least (m); negative where it may meet it.
    pub(super) fn misses(&self, x: Vec3A, way: f32) -> f32 {
        (x - self.center).length() - self.reach - way
    }

    /// Distance from the surface at the beginning (m).
    pub(super) fn distance(&self, x: Vec3A) -> f32 {
        (x - closest(&self.from, x).0).length() - self.radius
    }

    /// How far a vertex may go from `x` (m) and still not be met, at least: 0 or less where it may be at
    /// once. On its way a collider stays within half its travel of the segment between both ends'
    /// middles, and a segment from `x` comes no nearer to that than it is long.
    pub(super) fn clear(&self, x: Vec3A) -> f32 {
        let middle = [0, 1].map(|k| (self.from[k] + self.to[k]) * 0.5);
        let travel = [0, 1].map(|k| (self.to[k] - self.from[k]).length());
        let far = (x - closest(&middle, x).0).length();
        // What rounding may take from either.
        far * (1.0 - 1e-5) - 0.5 * travel[0].max(travel[1]) - self.radius - 1e-5
    }

    /// Whether a vertex that moved from `x0` to `x` was met on its way, seen from the collider: so
    /// nothing is passed through, however fast. It is led out on the side from which it came.
    pub(super) fn hit(&self, x0: Vec3A, x: Vec3A) -> Option<Hit> {
        let (on_end, t) = closest(&self.to, x);
        let end = x - on_end;
        let travel = on_end - (self.from[0] + (self.from[1] - self.from[0]) * t);
        let start = x0 - closest(&self.from, x0).0;
        let way = end - start;
        let length2 = way.length_squared();
        let nearest = if length2 > 0.0 { (-start.dot(way) / length2).clamp(0.0, 1.0) } else { 0.0 };
        let radius2 = self.radius * self.radius;
        let passed = start + way * nearest;
        if passed.length_squared() >= radius2 {
            return None;
        }
        let inside_at_end = end.length_squared() < radius2 && end.dot(start) > 0.0;
        let side = if inside_at_end || length2 < 1e-12 { end } else { self.entry(start, way) };
        let normal = side.try_normalize().or_else(|| start.try_normalize()).unwrap_or(Vec3A::Y);
        let depth = self.radius - normal.dot(end);
        (depth > 0.0).then_some(Hit { normal, depth, travel })
    }

    /// Where the way enters the radius; its start if that is inside.
    fn entry(&self, start: Vec3A, way: Vec3A) -> Vec3A {
        let outside = start.length_squared() - self.radius * self.radius;
        if outside <= 0.0 {
            return start;
        }
        let (a, b) = (way.length_squared(), start.dot(way));
        let root = (b * b - a * outside).max(0.0).sqrt();
        start + way * ((-b - root) / a).clamp(0.0, 1.0)
    }
}

/// The closest point of a segment, and how far along it lies (0 to 1).
fn closest([a, b]: &[Vec3A; 2], x: Vec3A) -> (Vec3A, f32) {
    let way = *b - *a;
    let length2 = way.length_squared();
    let t = if length2 > 0.0 { ((x - *a).dot(way) / length2).clamp(0.0, 1.0) } else { 0.0 };
    (*a + way * t, t)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hit(from: Vec3, to: Vec3, x0: Vec3A, x: Vec3A) -> Option<Hit> {
        let moving = Moving { from: Capsule::sphere(from, 0.1), to: Capsule::sphere(to, 0.1) };
        Swept::new(&moving, 0.0, Vec3A::ZERO).hit(x0, x)
    }

    #[test]
    fn a_fast_sphere_takes_along_what_was_in_its_way_and_nothing_else() {
        let (from, to) = (Vec3::new(-1.0, 0.0, 0.0), Vec3::new(1.0, 0.0, 0.0));
        let there = Vec3A::new(0.0, 0.05, 0.0);
        let found = hit(from, to, there, there).expect("the sphere went through the vertex");
        assert!(found.normal.x > 0.8, "led out ahead of the sphere: {found:?}");
        let out = there + found.normal * found.depth;
        assert!((out - Vec3A::from(to)).length() >= 0.1 - 1e-5);
        let beside = Vec3A::new(0.0, 0.2, 0.0);
        assert!(hit(from, to, beside, beside).is_none());
    }

    #[test]
    fn what_stays_clear_is_never_met() {
        let mut state = 7u32;
        let mut chance = move || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 23) as f32 - 1.0
        };
        let mut point = |size: f32| Vec3::new(size * chance(), size * chance(), size * chance());
        let mut clear = 0;
        for _ in 0..20_000 {
            let ends = [point(0.5), point(0.5)];
            let moved = [ends[0] + point(0.2), ends[1] + point(0.2)];
            let capsule = |ends| Capsule { ends, radius: 0.1 };
            let swept =
                Swept::new(&Moving { from: capsule(ends), to: capsule(moved) }, 0.0, Vec3A::ZERO);
            let x0 = Vec3A::from(point(0.6));
            let room = swept.clear(x0);
            if room > 0.0 {
                let way = Vec3A::from(point(1.0)).normalize_or_zero();
                assert!(swept.hit(x0, x0 + way * (room * 0.999)).is_none());
                clear += 1;
            }
        }
        assert!(clear > 5_000, "{clear}");
    }

    #[test]
    fn a_vertex_that_falls_through_a_resting_sphere_is_put_back_on_its_side() {
        let (above, below) = (Vec3A::new(0.02, 0.3, 0.0), Vec3A::new(0.02, -0.3, 0.0));
        let found = hit(Vec3::ZERO, Vec3::ZERO, above, below).unwrap();
        let out = below + found.normal * found.depth;
        assert!(out.y > 0.05 && out.length() >= 0.1 - 1e-5, "{found:?}");
        assert!(hit(Vec3::ZERO, Vec3::ZERO, above, above).is_none());
    }
}

//! A vertex and a face, or two edges: how near they are, and whether they meet on their way.

use glam::Vec3A;

use crate::segment;
use crate::triangle;

/// Rounds of conservative advancement after which a pair counts as meeting.
const ADVANCES: u32 = 48;

/// A vertex and a face (vertex first), or two edges; they share no vertex.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pair {
    pub(crate) vertices: [u32; 4],
    pub(crate) edges: bool,
    /// Unit vector from the second part to the first where they are closest at the beginning.
    pub(crate) normal: Vec3A,
    /// Distance at the beginning (m).
    pub(crate) distance: f32,
    /// Distance at which they begin to repel each other (m).
    pub(crate) keep: f32,
    /// Whether an outer layer lies inside an inner one here: the pair may pass, and is led to.
    pub(crate) wrong: bool,
    /// The pair is clear while its vertices' ends were moved by no more than this together (m).
    pub(crate) clear_until: f32,
}

/// The closest points of a pair.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Closest {
    /// Shares of the four vertices; those of the second part are negative. They sum to 0.
    pub(crate) shares: [f32; 4],
    /// From the second part's point to the first's (m).
    pub(crate) across: Vec3A,
}

impl Closest {
    pub(crate) fn of(edges: bool, x: &[Vec3A; 4]) -> Self {
        let shares = if edges {
            let (s, t) = segment::closest([x[0], x[1]], [x[2], x[3]]);
            [1.0 - s, s, t - 1.0, -t]
        } else {
            let w = triangle::closest(&[x[1], x[2], x[3]], x[0]).weights;
            [1.0, -w.x, -w.y, -w.z]
        };
        Self { shares, across: mix(&shares, x) }
    }
}

/// `sum c_i x_i`.
pub(crate) fn mix(shares: &[f32; 4], x: &[Vec3A; 4]) -> Vec3A {
    x[0] * shares[0] + x[1] * shares[1] + x[2] * shares[2] + x[3] * shares[3]
}

/// How far the first part is in front of the second along `n` (m); negative if they overlap.
pub(crate) fn slab(edges: bool, n: Vec3A, x: &[Vec3A; 4]) -> f32 {
    let [a, b, c, d] = x.map(|p| n.dot(p));
    if edges { a.min(b) - c.max(d) } else { a - b.max(c).max(d) }
}

impl Pair {
    /// The four vertices of a pair, relative to the first one's beginning (m): so f32 is finest.
    pub(crate) fn gather(&self, from: Vec3A, x: &[Vec3A]) -> [Vec3A; 4] {
        self.vertices.map(|v| x[v as usize] - from)
    }

    /// Whether the parts stay further apart than `floor` (m) while every vertex moves straight
    /// from `a` to `b`: there is a plane direction in which they do at both ends, hence always,
    /// or small steps along the way show it. If so, by how much their ends may be moved, together,
    /// before it may be otherwise (m).
    pub(crate) fn slack(&self, a: &[Vec3A; 4], b: &[Vec3A; 4], floor: f32) -> Option<f32> {
        let along = slab(self.edges, self.normal, b);
        if along > floor {
            return Some(along - floor);
        }
        let end = Closest::of(self.edges, b);
        let distance = end.across.length();
        if distance <= floor {
            return None;
        }
        let n = end.across / distance;
        if slab(self.edges, n, a) > floor {
            return Some(distance - floor);
        }
        let middle = (n + self.normal).normalize_or_zero();
        let there = slab(self.edges, middle, b);
        if slab(self.edges, middle, a).min(there) > floor {
            return Some(there - floor);
        }
        self.meeting(a, b, 0.5 * floor).is_none().then_some(0.0)
    }

    /// The first time (0..=1) at which the parts come nearer than `floor` (m), but for an error on
    /// the safe side; `None` if they never do. Additive conservative advancement (Li et al. 2021,
    /// "Codimensional Incremental Potential Contact", section 4.2).
    pub(crate) fn meeting(&self, a: &[Vec3A; 4], b: &[Vec3A; 4], floor: f32) -> Option<f32> {
        let mut way: [Vec3A; 4] = std::array::from_fn(|k| b[k] - a[k]);
        let mean = (way[0] + way[1] + way[2] + way[3]) * 0.25;
        way = way.map(|w| w - mean);
        let far = way.map(|w| w.length_squared());
        let speed = if self.edges {
            far[0].max(far[1]).sqrt() + far[2].max(far[3]).sqrt()
        } else {
            far[0].sqrt() + far[1].max(far[2]).max(far[3]).sqrt()
        };
        if speed <= 0.0 {
            return None;
        }
        let mut t = 0.0f32;
        for advance in 0..ADVANCES {
            let x: [Vec3A; 4] = std::array::from_fn(|k| a[k] + way[k] * t);
            let free = Closest::of(self.edges, &x).across.length() - floor;
            if free <= 0.1 * floor && advance > 0 || free <= 0.0 {
                return Some(t);
            }
            t += 0.9 * free / speed;
            if t >= 1.0 {
                return None;
            }
        }
        Some(t)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pair(edges: bool, x: &[Vec3A; 4]) -> Pair {
        let c = Closest::of(edges, x);
        let distance = c.across.length();
        Pair {
            vertices: [0, 1, 2, 3],
            edges,
            normal: c.across / distance,
            distance,
            keep: 4e-3,
            wrong: false,
            clear_until: f32::NEG_INFINITY,
        }
    }

    #[test]
    fn a_vertex_that_goes_through_a_face_is_caught_and_one_beside_it_is_not() {
        let face = [Vec3A::ZERO, Vec3A::X * 0.1, Vec3A::Z * 0.1];
        for (x, hits) in [(0.02, true), (0.09, false)] {
            let start = [Vec3A::new(x, 0.01, 0.02), face[0], face[1], face[2]];
            let end = [Vec3A::new(x, -0.01, 0.02), face[0], face[1], face[2]];
            let p = pair(false, &start);
            assert_eq!(p.slack(&start, &end, 2e-4).is_some(), !hits);
            let t = p.meeting(&start, &end, 1e-4);
            assert_eq!(t.is_some(), hits);
            assert!(t.is_none_or(|t| t > 0.45 && t < 0.5), "{t:?}");
        }
    }

    #[test]
    fn ends_moved_by_less_than_the_slack_leave_a_pair_clear() {
        let mut chance = crate::lab::shapes::Chance::new(3);
        let mut clear = [0; 2];
        for round in 0..4000 {
            let mut by_chance =
                |most: f32| Vec3A::from_array(std::array::from_fn(|_| most * chance.signed()));
            let start: [Vec3A; 4] = std::array::from_fn(|_| by_chance(0.1));
            let end = start.map(|x| x + by_chance(0.05));
            let (edges, floor) = (round % 2 == 0, 1e-3);
            let p = pair(edges, &start);
            let Some(slack) = p.slack(&start, &end, floor).filter(|_| p.distance > floor) else {
                continue;
            };
            clear[usize::from(edges)] += 1;
            // All of it to one vertex, or a part to each.
            let share =
                |k: usize| if round % 3 == 0 { (k == round % 4) as u8 as f32 } else { 0.25 };
            let moved: [Vec3A; 4] = std::array::from_fn(|k| {
                let towards = by_chance(1.0).normalize_or(Vec3A::X);
                end[k] + towards * (0.99 * slack * share(k))
            });
            assert!(p.slack(&start, &moved, floor).is_some(), "{round}: {slack}");
        }
        assert!(clear.iter().all(|count| *count > 1000), "{clear:?}");
    }

    #[test]
    fn what_moves_together_is_clear_however_far_it_goes() {
        let start =
            [Vec3A::ZERO, Vec3A::X, Vec3A::new(0.5, 1e-3, -0.5), Vec3A::new(0.5, 1e-3, 0.5)];
        let p = pair(true, &start);
        let end = start.map(|x| x + Vec3A::new(3.0, -20.0, 5.0));
        assert!(p.slack(&start, &end, 2e-4).is_some());
        let mut through = end;
        through[0].y += 3e-3;
        through[1].y += 3e-3;
        assert!(p.slack(&start, &through, 2e-4).is_none());
    }
}

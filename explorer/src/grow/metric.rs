//! How far two cloth states are from each other.

use crate::grid::{GridState, POSITION_STEP_M, VELOCITY_STEP_M_S};
use crate::scene::{Norm, Scene};

/// Vertices compared between two looks at the bound: long enough to vectorise, short enough that
/// most candidates are given up after one block.
const BLOCK: usize = 64;

/// How far two states of one mesh are apart, in metres.
///
/// A vertex contributes its weight times `max(|dp|, velocity_time_s * |dv|)` to
/// [`Norm::Largest`], and times `sqrt(|dp|^2 + (velocity_time_s * |dv|)^2)` to [`Norm::Rms`];
/// `|.|` is Euclidean. Without weights the grid makes maxima and sums exact integers. Whatever the
/// settings, the distance is symmetric, zero for equal states and never NaN. Source: Kim et al.
/// 2013, sections 3.2, 3.3 and 5.1.
#[derive(Debug, Clone, PartialEq)]
pub struct Metric {
    norm: Norm,
    velocity_time_s: f64,
    /// Squares of the vertices' weights; empty where all are 1.
    weights: Vec<f64>,
}

/// What was summed over some vertices, in squared steps.
#[derive(Debug, Clone, Copy, Default)]
struct Total {
    position: u64,
    velocity: u64,
    /// With weights: the largest or the sum, in squared metres.
    weighted_m2: f64,
}

impl Metric {
    /// The plain metric of the paper.
    ///
    /// * `velocity_time_s`: how far ahead a difference of velocity counts (s), finite and >= 0.
    pub fn new(velocity_time_s: f32) -> Self {
        assert!(velocity_time_s.is_finite() && velocity_time_s >= 0.0);
        let velocity_time_s = f64::from(velocity_time_s);
        Self { norm: Norm::Largest, velocity_time_s, weights: Vec::new() }
    }

    /// A scene's metric.
    pub fn of_scene(scene: &Scene) -> Self {
        let settings = &scene.metric;
        let weights = settings.weights.iter().map(|w| f64::from(*w).powi(2)).collect();
        Self { norm: settings.norm, weights, ..Self::new(scene.exploration.velocity_time_s) }
    }

    /// The metric between the same states cut down to these vertices, for
    /// [`Metric::least_distance`].
    pub fn of_vertices(&self, vertices: &[u32]) -> Self {
        let weight = |v: &u32| self.weights[*v as usize];
        let weights = match self.weights.is_empty() {
            true => Vec::new(),
            false => vertices.iter().map(weight).collect(),
        };
        Self { weights, ..self.clone() }
    }

    /// The distance of two states of the same mesh (m).
    pub fn distance(&self, a: &GridState, b: &GridState) -> f32 {
        self.distance_within(a, b, f32::INFINITY).expect("no distance is above infinity")
    }

    /// The distance (m) where it is at most `bound_m`, else `None`, as a rule long before all
    /// vertices were looked at.
    pub fn distance_within(&self, a: &GridState, b: &GridState, bound_m: f32) -> Option<f32> {
        assert_eq!(a.vertex_count(), b.vertex_count(), "states of different meshes");
        let (count, mut total) = (a.vertex_count(), Total::default());
        let positions = a.positions.chunks(BLOCK).zip(b.positions.chunks(BLOCK));
        let velocities = a.velocities.chunks(BLOCK).zip(b.velocities.chunks(BLOCK));
        for (block, (p, v)) in positions.zip(velocities).enumerate() {
            self.add(&mut total, block * BLOCK, p, v);
            if self.metres(&total, count) > bound_m {
                return None;
            }
        }
        let distance_m = self.metres(&total, count);
        (distance_m <= bound_m).then_some(distance_m)
    }

    /// What two rows of some of the mesh's vertices say about the distance of the whole states: it
    /// is at least this (m). `count`: vertices of the whole.
    ///
    /// * `a`, `b`: per vertex its position's and its velocity's three components (steps).
    pub fn least_distance(&self, a: &[[i16; 6]], b: &[[i16; 6]], count: usize) -> f32 {
        let mut total = Total::default();
        if self.weights.is_empty() {
            for (a, b) in a.iter().zip(b) {
                let (p, v) = (squared(&a[..3], &b[..3]), squared(&a[3..], &b[3..]));
                self.join(&mut total, p, v);
            }
            return self.metres(&total, count);
        }
        for ((a, b), weight) in a.iter().zip(b).zip(&self.weights) {
            let (p, v) = (squared(&a[..3], &b[..3]), squared(&a[3..], &b[3..]));
            self.join_weighted(&mut total, (p, v), *weight);
        }
        // Another order of summation than in the whole: a bound must not be above.
        self.metres(&total, count) * (1.0 - 1e-6)
    }

    fn add(
        &self,
        total: &mut Total,
        first: usize,
        (pa, pb): (&[[i16; 3]], &[[i16; 3]]),
        (va, vb): (&[[i16; 3]], &[[i16; 3]]),
    ) {
        if !self.weights.is_empty() {
            let pairs = pa.iter().zip(pb).zip(va.iter().zip(vb));
            for (((pa, pb), (va, vb)), weight) in pairs.zip(&self.weights[first..]) {
                self.join_weighted(total, (squared(pa, pb), squared(va, vb)), *weight);
            }
            return;
        }
        match self.norm {
            Norm::Largest => {
                total.position = total.position.max(squared_max(pa, pb));
                total.velocity = total.velocity.max(squared_max(va, vb));
            }
            Norm::Rms => {
                total.position += pa.iter().zip(pb).map(|(a, b)| squared(a, b)).sum::<u64>();
                total.velocity += va.iter().zip(vb).map(|(a, b)| squared(a, b)).sum::<u64>();
            }
        }
    }

    fn join(&self, total: &mut Total, position: u64, velocity: u64) {
        match self.norm {
            Norm::Largest => {
                total.position = total.position.max(position);
                total.velocity = total.velocity.max(velocity);
            }
            Norm::Rms => {
                total.position += position;
                total.velocity += velocity;
            }
        }
    }

    fn join_weighted(&self, total: &mut Total, (position, velocity): (u64, u64), weight: f64) {
        let [position, velocity] = self.squared_metres(position, velocity);
        match self.norm {
            Norm::Largest => {
                let here = weight * position.max(velocity);
                total.weighted_m2 = total.weighted_m2.max(here);
            }
            Norm::Rms => total.weighted_m2 += weight * (position + velocity),
        }
    }

    /// Squared steps as squared metres.
    fn squared_metres(&self, position: u64, velocity: u64) -> [f64; 2] {
        let position_step = f64::from(POSITION_STEP_M);
        let velocity_step = f64::from(VELOCITY_STEP_M_S) * self.velocity_time_s;
        [
            position as f64 * (position_step * position_step),
            velocity as f64 * (velocity_step * velocity_step),
        ]
    }

    /// `count`: vertices of the whole state.
    fn metres(&self, total: &Total, count: usize) -> f32 {
        let [position, velocity] = self.squared_metres(total.position, total.velocity);
        let squared = match self.norm {
            Norm::Largest => position.max(velocity).max(total.weighted_m2),
            Norm::Rms => (position + velocity + total.weighted_m2) / count.max(1) as f64,
        };
        squared.sqrt() as f32
    }
}

fn squared(a: &[i16], b: &[i16]) -> u64 {
    let axis = |axis: usize| {
        let d = i64::from(a[axis]) - i64::from(b[axis]);
        (d * d) as u64
    };
    axis(0) + axis(1) + axis(2)
}

/// Largest squared length of the differences, in squared steps.
fn squared_max(a: &[[i16; 3]], b: &[[i16; 3]]) -> u64 {
    let mut max = 0;
    for (a, b) in a.iter().zip(b) {
        let squared = |axis: usize| {
            let d = i64::from(a[axis]) - i64::from(b[axis]);
            (d * d) as u64
        };
        max = max.max(squared(0) + squared(1) + squared(2));
    }
    max
}

#[cfg(test)]
// The grid is exact: equal means equal.
#[allow(clippy::float_cmp)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn plain(a: &GridState, b: &GridState, metric: &Metric) -> f64 {
        let length = |d: cloth::Vec3| {
            let [x, y, z] = d.to_array().map(f64::from);
            (x * x + y * y + z * z).sqrt()
        };
        let (mut worst, mut sum) = (0.0f64, 0.0);
        for v in 0..a.vertex_count() {
            let dp = length(a.position(v) - b.position(v));
            let dv = metric.velocity_time_s * length(a.velocity(v) - b.velocity(v));
            let weight = metric.weights.get(v).map_or(1.0, |square| square.sqrt());
            worst = worst.max(weight * dp.max(dv));
            sum += weight * weight * (dp * dp + dv * dv);
        }
        match metric.norm {
            Norm::Largest => worst,
            Norm::Rms => (sum / a.vertex_count() as f64).sqrt(),
        }
    }

    fn rows(state: &GridState, vertices: &[u32]) -> Vec<[i16; 6]> {
        let row = |v: &u32| {
            let ([a, b, c], [d, e, f]) =
                (state.positions[*v as usize], state.velocities[*v as usize]);
            [a, b, c, d, e, f]
        };
        vertices.iter().map(row).collect()
    }

    fn state(vertices: usize) -> impl Strategy<Value = GridState> {
        let component = prop_oneof![any::<i16>(), -20i16..20];
        let rows = proptest::collection::vec(proptest::array::uniform3(component), 2 * vertices);
        rows.prop_map(move |rows| GridState {
            positions: rows[..vertices].to_vec(),
            velocities: rows[vertices..].to_vec(),
        })
    }

    proptest! {
        #[test]
        fn agrees_with_a_plain_loop_and_with_its_bounds(
            a in state(70), b in state(70), time in 0.0f32..0.2, share in 0.0f32..2.0,
            rms in any::<bool>(), weighted in any::<bool>(),
        ) {
            let weights = (0..70).map(|v| f64::from(v % 5) * 0.25).collect();
            let metric = Metric {
                norm: if rms { Norm::Rms } else { Norm::Largest },
                weights: if weighted { weights } else { Vec::new() },
                ..Metric::new(time)
            };
            let distance = metric.distance(&a, &b);
            let reference = plain(&a, &b, &metric);
            prop_assert!((f64::from(distance) - reference).abs() <= 1e-6 * reference.max(1e-3));
            prop_assert_eq!(distance.to_bits(), metric.distance(&b, &a).to_bits());
            prop_assert_eq!(metric.distance(&a, &a), 0.0);
            let bound = distance * share;
            let within = (distance <= bound).then_some(distance);
            prop_assert_eq!(metric.distance_within(&a, &b, bound), within);
            prop_assert_eq!(metric.distance_within(&a, &b, distance), Some(distance));
            for vertices in [&[3u32, 69, 7][..], &(0..70).collect::<Vec<_>>()] {
                let few = metric.of_vertices(vertices);
                let least = few.least_distance(&rows(&a, vertices), &rows(&b, vertices), 70);
                prop_assert!(least <= distance, "{least} > {distance}");
                prop_assert!(vertices.len() < 70 || least >= distance * (1.0 - 1e-5));
            }
        }
    }

    #[test]
    fn one_step_of_one_vertex_counts() {
        let a = GridState { positions: vec![[0; 3]; 200], velocities: vec![[0; 3]; 200] };
        let mut b = a.clone();
        b.positions[199] = [0, 2, 0];
        let metric = Metric::new(1.0 / 32.0);
        assert_eq!(metric.distance(&a, &b), 2.0 * POSITION_STEP_M);
        b.velocities[0] = [0, 0, -32];
        assert_eq!(metric.distance(&a, &b), VELOCITY_STEP_M_S);
        let far = GridState { positions: vec![[i16::MAX; 3]; 1], velocities: vec![[0; 3]; 1] };
        let near = GridState { positions: vec![[i16::MIN; 3]; 1], velocities: vec![[0; 3]; 1] };
        let diagonal = 65_535.0 * 3f32.sqrt() * POSITION_STEP_M;
        assert!((metric.distance(&far, &near) - diagonal).abs() < 1e-5);
    }
}

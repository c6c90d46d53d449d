//! How far two cloth states are from each other.

use crate::grid::{GridState, POSITION_STEP_M, VELOCITY_STEP_M_S};

/// Vertices compared between two looks at the bound: long enough to vectorise, short enough that
/// most candidates are given up after one block.
const BLOCK: usize = 64;

/// L-infinity over vertices of `max(|dp|, velocity_time_s * |dv|)`, in metres.
///
/// `|.|` is the Euclidean length of a vertex's displacement. The grid makes both maxima exact
/// integers, so that the distance is symmetric, zero only for equal states, never NaN, and does
/// not depend on the order of vertices. Source: Kim et al. 2013, sections 3.2 and 5.1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Metric {
    velocity_time_s: f64,
}

impl Metric {
    /// `velocity_time_s`: how far ahead a difference of velocity counts (s), finite and >= 0.
    pub fn new(velocity_time_s: f32) -> Self {
        assert!(velocity_time_s.is_finite() && velocity_time_s >= 0.0);
        Self { velocity_time_s: f64::from(velocity_time_s) }
    }

    /// The distance of two states of the same mesh (m).
    pub fn distance(&self, a: &GridState, b: &GridState) -> f32 {
        self.distance_within(a, b, f32::INFINITY).expect("no distance is above infinity")
    }

    /// The distance (m) where it is at most `bound_m`, else `None`, as a rule long before all
    /// vertices were looked at.
    pub fn distance_within(&self, a: &GridState, b: &GridState, bound_m: f32) -> Option<f32> {
        assert_eq!(a.vertex_count(), b.vertex_count(), "states of different meshes");
        let (position_limit, velocity_limit) = self.limits(bound_m);
        let (mut position, mut velocity) = (0u64, 0u64);
        let positions = a.positions.chunks(BLOCK).zip(b.positions.chunks(BLOCK));
        let velocities = a.velocities.chunks(BLOCK).zip(b.velocities.chunks(BLOCK));
        for ((pa, pb), (va, vb)) in positions.zip(velocities) {
            position = position.max(squared_max(pa, pb));
            velocity = velocity.max(squared_max(va, vb));
            if position > position_limit || velocity > velocity_limit {
                return None;
            }
        }
        let distance_m = self.metres(position, velocity);
        (distance_m <= bound_m).then_some(distance_m)
    }

    fn metres(&self, position_squared: u64, velocity_squared: u64) -> f32 {
        let position_m = (position_squared as f64).sqrt() * f64::from(POSITION_STEP_M);
        let velocity_m = (velocity_squared as f64).sqrt()
            * (f64::from(VELOCITY_STEP_M_S) * self.velocity_time_s);
        position_m.max(velocity_m) as f32
    }

    /// Squared steps above which the distance is certainly above the bound. Generous by a few
    /// parts in a million, so that rounding decides nothing here.
    fn limits(&self, bound_m: f32) -> (u64, u64) {
        let limit = |step: f64| {
            let steps = f64::from(bound_m) / step * (1.0 + 1e-6) + 1.0;
            // A cast saturates: infinity, also from a step of zero, means no limit.
            (steps * steps) as u64
        };
        let velocity_step = f64::from(VELOCITY_STEP_M_S) * self.velocity_time_s;
        let velocity = if velocity_step > 0.0 { limit(velocity_step) } else { u64::MAX };
        (limit(f64::from(POSITION_STEP_M)), velocity)
    }
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

    fn plain(a: &GridState, b: &GridState, velocity_time_s: f64) -> f64 {
        let length = |d: cloth::Vec3| {
            let [x, y, z] = d.to_array().map(f64::from);
            (x * x + y * y + z * z).sqrt()
        };
        let mut worst = 0.0f64;
        for v in 0..a.vertex_count() {
            let dp = length(a.position(v) - b.position(v));
            let dv = length(a.velocity(v) - b.velocity(v));
            worst = worst.max(dp).max(velocity_time_s * dv);
        }
        worst
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
        fn agrees_with_a_plain_loop_and_with_its_bound(
            a in state(70), b in state(70), time in 0.0f32..0.2, share in 0.0f32..2.0,
        ) {
            let metric = Metric::new(time);
            let distance = metric.distance(&a, &b);
            let reference = plain(&a, &b, f64::from(time));
            prop_assert!((f64::from(distance) - reference).abs() <= 1e-6 * reference.max(1e-3));
            prop_assert_eq!(distance.to_bits(), metric.distance(&b, &a).to_bits());
            prop_assert_eq!(metric.distance(&a, &a), 0.0);
            let bound = distance * share;
            let within = (distance <= bound).then_some(distance);
            prop_assert_eq!(metric.distance_within(&a, &b, bound), within);
            prop_assert_eq!(metric.distance_within(&a, &b, distance), Some(distance));
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

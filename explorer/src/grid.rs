//! Cloth states as they are kept: on a grid, so that 12 bytes a vertex are exact.
//!
//! Whatever a simulator returns is rounded to this grid at the end of every frame, also in an
//! uninterrupted run. So every state, not only a dead end, restarts a simulation bit for bit, and
//! a merge error is computed from exact states. The rounding is at most 0.031 mm and 1 mm/s per
//! component, a tenth of the tightest tolerance in use. (Kim et al. 2013 keep raw f32 frames.)

use cloth::Vec3;

/// Position step: 2^-14 m = 0.061 mm; range +-2 m around the hips.
pub const POSITION_STEP_M: f32 = 1.0 / 16_384.0;
/// Velocity step: 2^-9 m/s = 1.95 mm/s; range +-64 m/s.
pub const VELOCITY_STEP_M_S: f32 = 1.0 / 512.0;

/// A cloth configuration in the state frame (the hips' rigid transform), on the grid.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GridState {
    /// Position of each vertex in steps.
    pub positions: Vec<[i16; 3]>,
    /// World velocity of each vertex, turned into the state frame, in steps.
    pub velocities: Vec<[i16; 3]>,
}

/// A component does not fit the grid.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("vertex {vertex} is not on the grid: {what} is {value}")]
pub struct OffGrid {
    /// Which vertex.
    pub vertex: usize,
    /// `position (m)` or `velocity (m/s)`.
    pub what: &'static str,
    /// The component's value.
    pub value: f32,
}

impl GridState {
    /// Rounds a state in the state frame to the grid.
    ///
    /// # Errors
    /// A component that is not finite or out of range.
    pub fn round(positions: &[Vec3], velocities: &[Vec3]) -> Result<Self, OffGrid> {
        Ok(Self {
            positions: round(positions, POSITION_STEP_M, "position [m]")?,
            velocities: round(velocities, VELOCITY_STEP_M_S, "velocity [m/s]")?,
        })
    }

    /// Number of vertices.
    pub fn vertex_count(&self) -> usize {
        self.positions.len()
    }

    /// Position of a vertex (m).
    pub fn position(&self, vertex: usize) -> Vec3 {
        unround(self.positions[vertex], POSITION_STEP_M)
    }

    /// Velocity of a vertex (m/s).
    pub fn velocity(&self, vertex: usize) -> Vec3 {
        unround(self.velocities[vertex], VELOCITY_STEP_M_S)
    }
}

fn round(values: &[Vec3], step: f32, what: &'static str) -> Result<Vec<[i16; 3]>, OffGrid> {
    let component = |vertex: usize, value: f32| {
        let steps = (value / step).round();
        if steps.abs() <= f32::from(i16::MAX) {
            Ok(steps as i16)
        } else {
            Err(OffGrid { vertex, what, value })
        }
    };
    let one = |(vertex, v): (usize, &Vec3)| {
        Ok([component(vertex, v.x)?, component(vertex, v.y)?, component(vertex, v.z)?])
    };
    values.iter().enumerate().map(one).collect()
}

fn unround(steps: [i16; 3], step: f32) -> Vec3 {
    Vec3::new(f32::from(steps[0]), f32::from(steps[1]), f32::from(steps[2])) * step
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rounded_state_rounds_to_itself() {
        let positions = [Vec3::new(0.1, -1.999, 0.000_03), Vec3::ZERO];
        let velocities = [Vec3::new(-63.9, 0.001, 5.0), Vec3::ONE];
        let state = GridState::round(&positions, &velocities).unwrap();
        let p: Vec<_> = (0..2).map(|v| state.position(v)).collect();
        let v: Vec<_> = (0..2).map(|i| state.velocity(i)).collect();
        assert_eq!(GridState::round(&p, &v).unwrap(), state);
        assert!((p[0] - positions[0]).abs().max_element() <= POSITION_STEP_M / 2.0);
    }

    #[test]
    fn what_does_not_fit_is_named() {
        let far = GridState::round(&[Vec3::ZERO, Vec3::new(0.0, 2.1, 0.0)], &[]);
        assert_eq!(far.unwrap_err().vertex, 1);
        assert!(GridState::round(&[Vec3::splat(f32::NAN)], &[]).is_err());
    }
}

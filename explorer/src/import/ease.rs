//! Room to move in: a garment that lies on the skin in the rest pose is let out before it is sewn.
//!
//! A tailor leaves ease around the body, and a hem as wide as the stride. A garment modelled on the
//! skin has neither: it is stretched to its limit in every pose but the one it was modelled in, and
//! where legs are further apart than its hem is wide, strain limit and contact contradict each other.

use cloth::Vec3;
use serde::Deserialize;

use super::garment::Surface;

/// Around what is held to the body the ease comes over this distance (m).
const TAPER_M: f32 = 0.08;
/// Most ease (mm).
const EASE_MM_MAX: f32 = 50.0;
/// Most by which a hem is widened.
const TIMES_MAX: f32 = 4.0;

/// How much wider a garment gets towards its lower end.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlareTable {
    /// Height in the rest pose at which the widening begins (m).
    pub below_m: f32,
    /// How many times as wide the lowest point is.
    pub times: f32,
}

/// How a garment is let out.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Ease {
    /// Way outwards of all that is not held (mm).
    pub ease_mm: Option<f32>,
    /// Widening of the lower part.
    pub flare: Option<FlareTable>,
}

impl Ease {
    /// Checks the ranges; names the key that is out of range.
    ///
    /// # Errors
    /// Key and what it may be.
    pub fn check(&self) -> Result<(), (&'static str, String)> {
        if self.ease_mm.is_some_and(|mm| !(0.0..=EASE_MM_MAX).contains(&mm)) {
            return Err(("garment.ease_mm", format!("must lie in 0..={EASE_MM_MAX}")));
        }
        let Some(flare) = self.flare else { return Ok(()) };
        if !(1.0..=TIMES_MAX).contains(&flare.times) {
            return Err(("garment.flare.times", format!("must lie in 1..={TIMES_MAX}")));
        }
        if !flare.below_m.is_finite() {
            return Err(("garment.flare.below_m", "must be a height in metres".to_owned()));
        }
        Ok(())
    }

    /// Lets `surface` out; `held` stays where it is but for the flare.
    pub(super) fn apply(&self, surface: &mut Surface, held: &[u32]) {
        if let Some(ease_mm) = self.ease_mm {
            ease(surface, held, ease_mm * 1e-3);
        }
        if let Some(flare) = self.flare {
            widen(&mut surface.positions, flare);
        }
    }
}

/// Moves vertices along their normals by `most` (m), smoothly less towards what is held.
fn ease(surface: &mut Surface, held: &[u32], most: f32) {
    let at = |v: u32| surface.positions[v as usize];
    let mut normals = vec![Vec3::ZERO; surface.positions.len()];
    for t in &surface.triangles {
        let [a, b, c] = t.map(at);
        let normal = (b - a).cross(c - a);
        t.iter().for_each(|v| normals[*v as usize] += normal);
    }
    let fixed: Vec<Vec3> = held.iter().map(|v| at(*v)).collect();
    for (position, normal) in surface.positions.iter_mut().zip(&normals) {
        let far = fixed.iter().map(|p| p.distance(*position)).fold(f32::INFINITY, f32::min);
        let t = (far / TAPER_M).min(1.0);
        *position += normal.normalize_or_zero() * (most * t * t * (3.0 - 2.0 * t));
    }
}

/// Widens around the upright line through the middle of what lies below, in proportion to depth.
fn widen(positions: &mut [Vec3], flare: FlareTable) {
    let lowest = positions.iter().map(|p| p.y).fold(f32::INFINITY, f32::min);
    let depth = flare.below_m - lowest;
    if depth <= 0.0 {
        return;
    }
    let below = || positions.iter().filter(|p| p.y < flare.below_m);
    let low = below().copied().reduce(Vec3::min).unwrap_or_default();
    let high = below().copied().reduce(Vec3::max).unwrap_or_default();
    let middle = 0.5 * (low + high);
    for p in positions.iter_mut() {
        let grown = (flare.times - 1.0) * ((flare.below_m - p.y) / depth).clamp(0.0, 1.0);
        *p += (*p - middle) * Vec3::new(grown, 0.0, grown);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An upright tube of radius 0.2 m from 0 to 1 m, counter-clockwise seen from outside.
    fn tube() -> Surface {
        let (around, rows) = (24u32, 11u32);
        let place = |v: u32| {
            let angle = std::f32::consts::TAU * (v % around) as f32 / around as f32;
            Vec3::new(0.2 * angle.sin(), (v / around) as f32 * 0.1, 0.2 * angle.cos())
        };
        let cell = |v: u32| {
            let next = v / around * around + (v + 1) % around;
            [[v, next, v + around], [next, next + around, v + around]]
        };
        Surface {
            positions: (0..around * rows).map(place).collect(),
            triangles: (0..around * (rows - 1)).flat_map(cell).collect(),
        }
    }

    fn radius(p: &Vec3) -> f32 {
        p.x.hypot(p.z)
    }

    #[test]
    fn what_is_held_stays_and_the_rest_gets_room() {
        let mut surface = tube();
        let before = surface.positions.clone();
        let top: Vec<u32> = (240..264).collect();
        Ease { ease_mm: Some(10.0), flare: None }.apply(&mut surface, &top);
        for (v, (p, old)) in surface.positions.iter().zip(&before).enumerate() {
            let wanted = if v >= 240 { 0.2 } else { 0.21 };
            assert!((radius(p) - wanted).abs() < 2e-4, "{v}: {p} from {old}");
        }
    }

    #[test]
    fn a_flare_widens_in_proportion_to_depth_and_keeps_heights() {
        let mut surface = tube();
        let before = surface.positions.clone();
        let flare = FlareTable { below_m: 0.5, times: 1.8 };
        Ease { ease_mm: None, flare: Some(flare) }.apply(&mut surface, &[]);
        for (p, old) in surface.positions.iter().zip(&before) {
            let wanted = 0.2 * (1.0 + 0.8 * ((0.5 - old.y) / 0.5).max(0.0));
            let off = (radius(p) - wanted).abs().max((p.y - old.y).abs());
            assert!(off < 1e-5, "{p} from {old}");
        }
    }

    #[test]
    fn ranges_are_checked() {
        let flare = |times| Some(FlareTable { below_m: 0.5, times });
        assert!(Ease { ease_mm: Some(10.0), flare: flare(1.5) }.check().is_ok());
        let keys = [
            Ease { ease_mm: Some(-1.0), flare: None },
            Ease { ease_mm: Some(f32::NAN), flare: None },
            Ease { ease_mm: None, flare: flare(0.5) },
            Ease { ease_mm: None, flare: Some(FlareTable { below_m: f32::NAN, times: 2.0 }) },
        ]
        .map(|ease| ease.check().unwrap_err().0);
        assert_eq!(keys[0], keys[1]);
        assert_eq!(keys[2..], ["garment.flare.times", "garment.flare.below_m"]);
    }
}

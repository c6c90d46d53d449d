//! Measures of a result: strain, penetration, clearance.

use glam::Vec3;

use crate::mesh::Mesh;
use crate::surface::{Posed, Surface};

/// How far into a body its surface is looked for (m): beyond any limb's half thickness.
pub const DEPTH_REACH_M: f32 = 0.25;

/// Largest strain of an edge: 0.1 means 10 % longer than at rest; negative if all are shorter.
pub fn stretch_max(mesh: &Mesh, positions: &[Vec3]) -> f32 {
    strains(mesh, positions).fold(f32::NEG_INFINITY, f32::max)
}

/// The same of positions that were rounded to a grid of `step_m`: each edge counts as shorter by as much
/// as that can have drawn it out, a diagonal of a cell. On a fine mesh that is a few per cent of it.
pub fn stretch_max_rounded(mesh: &Mesh, positions: &[Vec3], step_m: f32) -> f32 {
    let drawn_out = 3.0f32.sqrt() * step_m;
    let rests = mesh.rest_lengths().iter();
    strains(mesh, positions)
        .zip(rests)
        .map(|(strain, rest)| strain - drawn_out / rest)
        .fold(f32::NEG_INFINITY, f32::max)
}

/// The edge strain under which a share `quantile` (0..=1) of all edges lies.
pub fn stretch_quantile(mesh: &Mesh, positions: &[Vec3], quantile: f32) -> f32 {
    let mut all: Vec<f32> = strains(mesh, positions).collect();
    all.sort_unstable_by(f32::total_cmp);
    let last = all.len() - 1;
    all[((last as f32 * quantile.clamp(0.0, 1.0)).round() as usize).min(last)]
}

fn strains<'a>(mesh: &'a Mesh, positions: &'a [Vec3]) -> impl Iterator<Item = f32> + 'a {
    mesh.edges()
        .iter()
        .zip(mesh.rest_lengths())
        .map(|(e, rest)| positions[e[0] as usize].distance(positions[e[1] as usize]) / rest - 1.0)
}

/// Vertices of a garment inside a body.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Penetration {
    /// Vertices deeper than the limit and not held between two body parts.
    pub deep: u64,
    /// Vertices deeper than the limit and held between two body parts.
    pub pinched: u64,
    /// Deepest vertex that is not held between two body parts (m).
    pub depth_max_m: f32,
}

/// Counts vertices deeper than `limit_m` in the body. A vertex is *pinched* when the shortest way
/// out of one body part, and `offset_m` on, leads into another.
pub fn penetration(
    surface: &Surface,
    posed: &Posed,
    positions: &[Vec3],
    limit_m: f32,
    offset_m: f32,
) -> Penetration {
    let mut sum = Penetration::default();
    for p in positions {
        // Points outside need only be found to be near nothing deep.
        let Some(contact) = surface.closest(posed, *p, DEPTH_REACH_M) else { continue };
        let depth = -contact.distance;
        if depth <= 0.0 {
            continue;
        }
        if depth > limit_m && surface.is_pinched(posed, &contact, offset_m) {
            sum.pinched += 1;
            continue;
        }
        sum.deep += u64::from(depth > limit_m);
        if depth > sum.depth_max_m && !surface.is_pinched(posed, &contact, offset_m) {
            sum.depth_max_m = depth;
        }
    }
    sum
}

/// Signed distance (m) of each point to a closed body, positive outside.
///
/// * `positions`, `triangles`: the body's mesh in one pose.
///
/// Cost: one tree over the body, then one closest-point search per point.
pub fn clearance(positions: &[Vec3], triangles: &[[u32; 3]], points: &[Vec3]) -> Vec<f32> {
    let surface = Surface::new(positions, triangles);
    let posed = surface.posed(positions);
    points.iter().map(|p| surface.signed_distance(&posed, *p, f32::INFINITY)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::tests::sphere;

    #[test]
    fn strain_is_relative_lengthening() {
        let rest = vec![Vec3::ZERO, Vec3::X, Vec3::Y];
        let mesh = Mesh::new(rest.clone(), vec![[0, 1, 2]]).unwrap();
        let mut p = rest;
        assert!(stretch_max(&mesh, &p).abs() < 1e-6);
        p[1].x = 1.1;
        assert!((stretch_max(&mesh, &p) - 0.1).abs() < 1e-6);
        let step = 1.0 / 16_384.0;
        let rounded: Vec<Vec3> = p.iter().map(|p| (*p / step).round() * step).collect();
        assert!(stretch_max_rounded(&mesh, &rounded, step) < 0.1);
        assert!(stretch_max_rounded(&mesh, &rounded, step) > 0.1 - 4.0 * step);
        assert!(stretch_quantile(&mesh, &p, 0.0).abs() < 1e-6);
    }

    #[test]
    fn clearance_is_positive_outside() {
        let (p, t) = sphere(Vec3::ZERO, 1.0, 32);
        let at = clearance(&p, &t, &[Vec3::ZERO, Vec3::X * 0.9, Vec3::Y * 1.5]);
        assert!((at[0] + 1.0).abs() < 0.01);
        assert!((at[1] + 0.1).abs() < 0.01);
        assert!((at[2] - 0.5).abs() < 0.01);
    }

    #[test]
    fn depth_is_counted_over_the_limit() {
        let (p, t) = sphere(Vec3::ZERO, 1.0, 32);
        let surface = Surface::new(&p, &t);
        let points = [Vec3::X * 0.9, Vec3::X * 0.999, Vec3::X * 1.1];
        let found = penetration(&surface, &surface.posed(&p), &points, 0.005, 0.004);
        assert_eq!((found.deep, found.pinched), (1, 0));
        assert!((found.depth_max_m - 0.1).abs() < 0.01);
    }
}

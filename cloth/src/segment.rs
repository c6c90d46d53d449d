//! Two segments.

use glam::Vec3A;

/// Where on each of two segments (0..=1) they are closest to each other (Ericson 2005, section
/// 5.1.9). Of parallel ones some closest pair of points.
pub(crate) fn closest([p, q]: [Vec3A; 2], [r, s]: [Vec3A; 2]) -> (f32, f32) {
    let (d1, d2, to) = (q - p, s - r, p - r);
    let (a, e, f) = (d1.length_squared(), d2.length_squared(), d2.dot(to));
    if a <= f32::MIN_POSITIVE {
        return (0.0, if e > f32::MIN_POSITIVE { (f / e).clamp(0.0, 1.0) } else { 0.0 });
    }
    let c = d1.dot(to);
    if e <= f32::MIN_POSITIVE {
        return ((-c / a).clamp(0.0, 1.0), 0.0);
    }
    let b = d1.dot(d2);
    let determinant = a * e - b * b;
    // Nearly parallel: any point serves, the middle is the steadiest.
    let start = if determinant > 1e-6 * a * e {
        ((b * f - c * e) / determinant).clamp(0.0, 1.0)
    } else {
        0.5
    };
    let t = (b * start + f) / e;
    let t = t.clamp(0.0, 1.0);
    let s = ((b * t - c) / a).clamp(0.0, 1.0);
    // Once more from the other side, so that a clamped end and a parallel pair come out right.
    let t = ((b * s + f) / e).clamp(0.0, 1.0);
    (s, t)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_sampled_pair_of_points_is_nearer() {
        let hash = |k: u32| ((k + 1).wrapping_mul(2_654_435_761) >> 8) as f32 / 16_777_216.0 - 0.5;
        for i in 0..300 {
            let at =
                |k: u32| Vec3A::new(hash(i * 12 + k), hash(i * 97 + k + 50), hash(i * 31 + k + 9));
            let (mut one, other) = ([at(0), at(3)], [at(6), at(9)]);
            if i % 5 == 0 {
                one[1] = one[0] + (other[1] - other[0]) * hash(i); // parallel
            }
            let (s, t) = closest(one, other);
            let gap = |s: f32, t: f32| one[0].lerp(one[1], s).distance(other[0].lerp(other[1], t));
            for j in 0..=20 {
                for k in 0..=20 {
                    assert!(gap(s, t) <= gap(j as f32 / 20.0, k as f32 / 20.0) + 1e-4, "{i}");
                }
            }
        }
    }
}

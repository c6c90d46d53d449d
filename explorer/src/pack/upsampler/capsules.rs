//! Capsules in the body's stead, as many as it takes to fill it: one for each joint that moves enough of
//! the skin, and more where one does not fit.

use cloth::{Body, Vec3};
use codec::upsample::Capsule;

use crate::pack::scene_chunk::main_axis;

/// A capsule stands for this many vertices at least.
const VERTICES_MIN: usize = 12;
/// Capsules of a body.
const COUNT: usize = 32;
/// Of its vertices, this share lies inside.
const INSIDE: f32 = 0.6;
/// Thinner ones hold nothing (m).
const THINNEST_M: f32 = 0.01;

/// The skin around a part of a bone, in the joint's frame.
struct Part {
    joint: u16,
    points: Vec<Vec3>,
    fit: Fit,
}

/// What dividing a part gains (m), which one, and its halves.
type Division = (f32, usize, [Part; 2]);

#[derive(Debug, Clone, Copy)]
struct Fit {
    ends: [Vec3; 2],
    radius: f32,
    /// Sum of the vertices' distances from its surface (m).
    off_m: f32,
}

/// Capsules fitted to the body.
pub(super) fn capsules(body: &Body) -> Vec<Capsule> {
    let capsule = |part: &Part| Capsule {
        joint: part.joint,
        ends: part.fit.ends.map(|end| end.to_array()),
        radius: part.fit.radius,
    };
    let thick = |part: &&Part| part.fit.radius > THINNEST_M;
    parts(body, COUNT).iter().filter(thick).map(capsule).collect()
}

/// The body in parts, at most `count`: the one that its capsule fits worst is divided next, where that
/// helps most.
fn parts(body: &Body, count: usize) -> Vec<Part> {
    let mut moved = vec![Vec::new(); body.skeleton.joint_count()];
    for ((p, joints), weights) in body.rest_positions.iter().zip(&body.joints).zip(&body.weights) {
        let heaviest = (0..4).fold(0, |best, i| if weights[i] > weights[best] { i } else { best });
        let joint = usize::from(joints[heaviest]);
        moved[joint].push(body.skeleton.rest[joint].inverse().point(*p));
    }
    let enough = moved.into_iter().enumerate().filter(|(_, p)| p.len() >= VERTICES_MIN);
    let mut parts: Vec<Part> = enough
        .map(|(joint, points)| Part { joint: joint as u16, fit: fit(&points), points })
        .collect();
    while parts.len() < count {
        let divisions = parts.iter().enumerate().filter_map(|(at, part)| {
            let halves = divide(part)?;
            let gain = part.fit.off_m - halves[0].fit.off_m - halves[1].fit.off_m;
            Some((gain, at, halves))
        });
        let more = |best: Option<Division>, next: Division| match best {
            Some(best) if best.0 >= next.0 => Some(best),
            _ => Some(next),
        };
        let Some((gain, at, [one, other])) = divisions.fold(None, more) else { break };
        if gain <= 0.0 {
            break;
        }
        parts[at] = one;
        parts.insert(at + 1, other);
    }
    parts
}

/// Two halves along whichever axis of the joint leaves least.
fn divide(part: &Part) -> Option<[Part; 2]> {
    let centre = part.points.iter().sum::<Vec3>() / part.points.len() as f32;
    let halves = |axis: usize| {
        let (low, high): (Vec<Vec3>, Vec<Vec3>) =
            part.points.iter().partition(|p| p[axis] < centre[axis]);
        let enough = low.len() >= VERTICES_MIN && high.len() >= VERTICES_MIN;
        let one = |points: Vec<Vec3>| Part { joint: part.joint, fit: fit(&points), points };
        enough.then(|| [one(low), one(high)])
    };
    let left = |halves: &[Part; 2]| halves[0].fit.off_m + halves[1].fit.off_m;
    (0..3).filter_map(halves).min_by(|a, b| left(a).total_cmp(&left(b)))
}

/// Along the main axis or either axis across, whichever fits best.
fn fit(points: &[Vec3]) -> Fit {
    let centre = points.iter().sum::<Vec3>() / points.len().max(1) as f32;
    let main = main_axis(points, centre);
    let across = main.any_orthonormal_vector();
    let axes = [main, across, main.cross(across)];
    let fits = axes.map(|axis| along(points, centre, axis));
    fits.into_iter().fold(fits[0], |best, fit| if fit.off_m < best.off_m { fit } else { best })
}

fn along(points: &[Vec3], centre: Vec3, axis: Vec3) -> Fit {
    let along = |p: &Vec3| (*p - centre).dot(axis);
    let quantile = |mut list: Vec<f32>, share: f32| {
        list.sort_by(f32::total_cmp);
        list.get((list.len() as f32 * share) as usize).copied().unwrap_or(0.0)
    };
    let lengths: Vec<f32> = points.iter().map(along).collect();
    let distances: Vec<f32> =
        points.iter().map(|p| (*p - centre - axis * along(p)).length()).collect();
    let radius = quantile(distances, INSIDE);
    let (low, high) = (quantile(lengths.clone(), 0.02), quantile(lengths, 0.98));
    // A stout part is a ball; the ends of a part that goes on in another are round as well.
    let (low, high) = (low + 0.5 * radius, high - 0.5 * radius);
    let (low, high) =
        if low < high { (low, high) } else { (0.5 * (low + high), 0.5 * (low + high)) };
    let ends = [low, high].map(|t| centre + axis * t);
    let off_m = points.iter().map(|p| (to_segment(*p, ends) - radius).abs()).sum();
    Fit { ends, radius, off_m }
}

fn to_segment(p: Vec3, [a, b]: [Vec3; 2]) -> f32 {
    let way = b - a;
    let length2 = way.length_squared();
    let t = if length2 > 0.0 { ((p - a).dot(way) / length2).clamp(0.0, 1.0) } else { 0.0 };
    p.distance(a + way * t)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cloth::{Quat, Rigid, Skeleton};

    /// One joint at its origin.
    fn body(points: Vec<Vec3>) -> Body {
        let skeleton = Skeleton {
            names: vec!["one".into()],
            parents: vec![None],
            offsets: vec![Vec3::ZERO],
            rest: vec![Rigid { rotation: Quat::IDENTITY, translation: Vec3::ZERO }],
        };
        let count = points.len();
        Body {
            skeleton,
            rest_positions: points,
            triangles: Vec::new(),
            joints: vec![[0; 4]; count],
            weights: vec![[1.0, 0.0, 0.0, 0.0]; count],
        }
    }

    fn ring(i: usize, around: usize) -> (f32, f32) {
        let (sin, cos) = ((i % around) as f32 / around as f32 * std::f32::consts::TAU).sin_cos();
        (cos, sin)
    }

    #[test]
    fn a_leg_that_tapers_gets_capsules_that_taper() {
        let at = |i: usize| {
            let ((cos, sin), t) = (ring(i, 12), (i / 12) as f32 / 29.0);
            let radius = 0.09 - 0.05 * t;
            Vec3::new(radius * cos, -0.8 * t, radius * sin)
        };
        let points: Vec<Vec3> = (0..360).map(at).collect();
        let fitted = parts(&body(points.clone()), 6);
        assert_eq!(fitted.len(), 6);
        let top = fitted.iter().max_by(|a, b| a.fit.ends[0].y.total_cmp(&b.fit.ends[0].y)).unwrap();
        let low = fitted.iter().min_by(|a, b| a.fit.ends[0].y.total_cmp(&b.fit.ends[0].y)).unwrap();
        assert!(top.fit.radius > low.fit.radius + 0.02, "{:?} {:?}", top.fit, low.fit);
        let off: f32 = fitted.iter().map(|part| part.fit.off_m).sum();
        let one = parts(&body(points), 1)[0].fit.off_m;
        assert!(off < 0.5 * one, "{off} m for {one}");
    }

    #[test]
    fn a_trunk_that_is_wider_than_deep_has_no_gap_in_its_skin() {
        let at = |i: usize| {
            let ((cos, sin), t) = (ring(i, 24), (i / 24) as f32 / 15.0);
            Vec3::new(0.2 * cos, 0.4 * t, 0.1 * sin)
        };
        let points: Vec<Vec3> = (0..384).map(at).collect();
        let worst = |count: usize| {
            let fitted = parts(&body(points.clone()), count);
            assert_eq!(fitted.len(), count);
            let off = |p: &Vec3| {
                let one = |part: &Part| to_segment(*p, part.fit.ends) - part.fit.radius;
                fitted.iter().map(one).fold(f32::INFINITY, f32::min)
            };
            points.iter().map(|p| off(p).abs()).fold(0.0, f32::max)
        };
        // One capsule is too thin at the sides or too thick in front.
        let (one, four) = (worst(1), worst(4));
        assert!(one > 0.035 && four < 0.8 * one, "{one} m, {four} m");
        assert!(capsules(&body(points.clone())).len() <= COUNT);
    }

    #[test]
    fn few_vertices_or_vertices_in_one_place_make_no_capsule() {
        assert!(capsules(&body(vec![Vec3::ONE; 5])).is_empty());
        assert!(capsules(&body(vec![Vec3::ONE; 50])).is_empty());
    }
}

//! Vertices from coarse to fine: farthest points of the mean shape, each predicted from the
//! nearest ones before it.

use codec::toile::{PARENTS, Tree};

/// Above, the order given is kept: the cost is quadratic (a second at 30,000).
const VERTICES_MAX: usize = 60_000;

/// The order of a shape of `3 * vertices` numbers (m).
pub(super) fn tree(shape: &[f64]) -> Tree {
    let points: Vec<[f32; 3]> =
        shape.chunks_exact(3).map(|p| [p[0] as f32, p[1] as f32, p[2] as f32]).collect();
    if points.len() > VERTICES_MAX {
        return Tree::sequence(points.len());
    }
    let order = farthest_first(&points);
    let placed: Vec<[f32; 3]> = order.iter().map(|v| points[*v as usize]).collect();
    let parents = (0..placed.len()).map(|place| nearest(&placed[..place], placed[place])).collect();
    Tree::new(order, parents).expect("every vertex once, parents before children")
}

fn farthest_first(points: &[[f32; 3]]) -> Vec<u32> {
    let mut distance = vec![f32::INFINITY; points.len()];
    let mut order = Vec::with_capacity(points.len());
    let mut next = 0;
    while order.len() < points.len() {
        order.push(next as u32);
        let from = points[next];
        distance[next] = -1.0;
        let mut farthest = (-1.0, 0);
        for (vertex, (distance, point)) in distance.iter_mut().zip(points).enumerate() {
            *distance = distance.min(square(from, *point));
            if *distance > farthest.0 {
                farthest = (*distance, vertex);
            }
        }
        if farthest.0 < 0.0 {
            break;
        }
        next = farthest.1;
    }
    order
}

/// Places of the nearest points before one, the nearest first.
fn nearest(before: &[[f32; 3]], point: [f32; 3]) -> [u32; PARENTS] {
    let mut best = [(f32::INFINITY, 0u32); PARENTS];
    for (place, other) in before.iter().enumerate() {
        let distance = square(*other, point);
        if distance < best[PARENTS - 1].0 {
            let at = best.iter().position(|b| distance < b.0).unwrap_or(PARENTS - 1);
            best[at..].rotate_right(1);
            best[at] = (distance, place as u32);
        }
    }
    best.map(|(_, place)| place)
}

fn square(a: [f32; 3], b: [f32; 3]) -> f32 {
    (0..3).map(|i| (a[i] - b[i]) * (a[i] - b[i])).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_prefix_covers_the_shape_and_parents_are_near() {
        let shape: Vec<f64> = (0..400)
            .flat_map(|i| [f64::from(i % 20) * 0.05, f64::from(i / 20) * 0.05, 0.0])
            .collect();
        let tree = tree(&shape);
        let point = |v: u32| [shape[3 * v as usize], shape[3 * v as usize + 1]];
        let apart = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
        let coarse: Vec<[f64; 2]> = tree.order()[..50].iter().map(|v| point(*v)).collect();
        for vertex in 0..400 {
            let near = coarse.iter().map(|c| apart(*c, point(vertex))).fold(9.0, f64::min);
            assert!(near < 0.16, "vertex {vertex} is {near} m from the coarse level");
        }
    }

    #[test]
    fn equal_points_are_ordered_too() {
        let tree = tree(&[0.5; 30]);
        let mut order = tree.order().to_vec();
        order.sort_unstable();
        assert_eq!(order, (0..10).collect::<Vec<u32>>());
    }
}

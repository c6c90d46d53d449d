use super::*;
use crate::crossings::find;
use crate::lab::shapes::{Cut, sheet};

/// 30 triangles in a ring of so many radians; the ends lie crosswise.
fn ring(angle: f32) -> Mesh {
    let place = |u: f32, v: f32| {
        let (turn, out) = (angle * u, 0.1 + 0.02 * v);
        Vec3::new(out * turn.cos(), out * turn.sin(), 0.01 * (u - 0.5) * (v - 0.5))
    };
    sheet(15, 1, Cut::Alternating, place).unwrap()
}

#[test]
fn cloth_that_is_pressed_together_and_cuts_itself_is_not_smooth() {
    let mut chance = crate::lab::shapes::Chance::new(23);
    let rest = sheet(4, 4, Cut::Uniform, |u, v| Vec3::new(u, 0.0, v)).unwrap();
    let (tree, mut fit) = (Tree::new(&rest), Fit::default());
    let (mut smooth, mut all) = (Vec::new(), Vec::new());
    let (mut cut, mut missed) = (0, 0);
    for _ in 0..100_000 {
        let mut by_chance =
            |most: f32| Vec3::from_array(std::array::from_fn(|_| most * chance.signed()));
        let (pressed, wild) = (0.2 + 0.8 * by_chance(1.0).x.abs(), by_chance(0.14).x.abs());
        let mut x: Vec<Vec3> = rest.rest_positions().iter().map(|p| *p * pressed).collect();
        x.iter_mut().for_each(|x| *x += by_chance(wild));
        // Cloth may be pressed together, not drawn out.
        if crate::measure::stretch_max(&rest, &x) > 0.15 {
            continue;
        }
        find(&tree, &mut fit, &x, true, &mut smooth);
        find(&tree, &mut fit, &x, false, &mut all);
        cut += usize::from(!all.is_empty());
        missed += usize::from(smooth != all);
    }
    // What is left are stars around one vertex that lie on themselves.
    assert!(cut > 1000 && 1500 * missed <= cut, "{missed} of {cut}");
}

#[test]
fn a_flat_patch_whose_ends_meet_is_no_smooth_patch() {
    let rest = ring(5.5);
    let closed = ring(6.6);
    let (tree, mut fit) = (Tree::new(&rest), Fit::default());
    let (mut smooth, mut all) = (Vec::new(), Vec::new());
    find(&tree, &mut fit, closed.rest_positions(), true, &mut smooth);
    find(&tree, &mut fit, closed.rest_positions(), false, &mut all);
    assert!(!all.is_empty());
    assert_eq!(smooth, all);
    let strip = sheet(4, 4, Cut::Alternating, |u, v| Vec3::new(u, v, 0.0)).unwrap();
    assert!(Tree::new(&strip).whole[0], "a square has no notch");
}

#[test]
fn what_turns_over_is_compared_with_what_it_hangs_on() {
    let p = [Vec3::ZERO, Vec3::Y, Vec3::new(1.0, 0.5, 0.0), Vec3::new(-1.0, 0.5, 0.0)];
    let mesh = Mesh::new(p.to_vec(), vec![[0, 2, 1], [0, 1, 3]]).unwrap();
    let tree = Tree::new(&mesh);
    // The wings stay flat, lean, or change sides through each other: flat before and after.
    for (shift, is_compared) in [(0.0, false), (0.5, false), (2.0, true)] {
        let way = [Vec3A::ZERO, Vec3A::ZERO, Vec3A::X * -shift, Vec3A::X * shift];
        let mut fit = Fit::default();
        tree.fit(at(&p), |v| way[v as usize], &mut fit);
        let mut met = 0;
        tree.pairs(&mut fit, 0.01, true, |_, _, _| met += 1);
        assert_eq!(met > 0, is_compared, "{shift}");
        // Foreseen to stay, they end there.
        tree.fit(at(&p), |_| Vec3A::ZERO, &mut fit);
        let ends: Vec<Vec3A> = p.iter().zip(way).map(|(p, way)| Vec3A::from(*p) + way).collect();
        let mut turned = 0;
        tree.turned(&fit, &ends, |_| turned += 1);
        assert_eq!(turned, if is_compared { 2 } else { 0 });
    }
}

use std::f32::consts::PI;

use super::*;

/// A sphere of `rings` x `2 rings` patches, its front outside.
fn sphere(centre: Vec3, radius: f32, rings: u32) -> (Vec<Vec3>, Vec<[u32; 3]>) {
    let sectors = 2 * rings;
    let mut positions = Vec::new();
    let mut triangles = Vec::new();
    for ring in 0..=rings {
        for sector in 0..sectors {
            let (polar, turn) =
                (PI * ring as f32 / rings as f32, 2.0 * PI * sector as f32 / sectors as f32);
            let level = Vec3::new(turn.sin(), 0.0, turn.cos());
            positions.push(centre + radius * (polar.sin() * level + polar.cos() * Vec3::Y));
            if ring < rings {
                let at = |r: u32, s: u32| r * sectors + s % sectors;
                let (a, b) = (at(ring, sector), at(ring + 1, sector));
                let (c, d) = (at(ring + 1, sector + 1), at(ring, sector + 1));
                triangles.extend([[a, b, c], [a, c, d]]);
            }
        }
    }
    (positions, triangles)
}

fn bare(camera: Camera, side: u32) -> View {
    View { ground: None, background: [0; 3], ..View::new(camera, side, side) }
}

fn quad(z: f32, half: f32) -> [Vec3; 4] {
    [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]
        .map(|[x, y]: [f32; 2]| Vec3::new(half * x, half * y, z))
}

const QUAD: [[u32; 3]; 2] = [[0, 1, 2], [0, 2, 3]];
const RED: Paint<'_> = Paint::Plain([220, 30, 30]);
const GREEN: Paint<'_> = Paint::Plain([30, 220, 30]);

#[test]
fn a_triangle_covers_its_area() {
    let camera = Camera::orbit(Vec3::ZERO, 2.0, 0.0, 0.0);
    let positions = [Vec3::new(-0.3, -0.2, 0.0), Vec3::new(0.35, -0.25, 0.0), Vec3::Y * 0.3];
    let layer = Layer { positions: &positions, triangles: &[[0, 1, 2]], paint: RED };
    let image = render(&bare(camera, 200), &[layer]).unwrap();
    let scale = 100.0 / (0.5 * camera.angle).tan() / 2.0;
    let area = 0.5 * (positions[1] - positions[0]).cross(positions[2] - positions[0]).length();
    let expected = area * scale * scale;
    let covered = image.pixels().iter().filter(|pixel| pixel[0] > 90).count() as f32;
    assert!((covered - expected).abs() < 0.02 * expected, "{covered} of {expected} pixels");
}

#[test]
fn the_nearer_surface_hides_the_farther_in_any_order() {
    let camera = Camera::orbit(Vec3::ZERO, 3.0, 0.0, 0.0);
    let (near, far) = (quad(0.2, 0.2), quad(-0.2, 0.5));
    let near = Layer { positions: &near, triangles: &QUAD, paint: RED };
    let far = Layer { positions: &far, triangles: &QUAD, paint: GREEN };
    let view = bare(camera, 100);
    let image = render(&view, &[near, far]).unwrap();
    assert_eq!(image, render(&view, &[far, near]).unwrap());
    let (middle, side) = (image.at(50, 50), image.at(25, 50));
    assert!(middle[0] > 2 * middle[1], "{middle:?}");
    assert!(side[1] > 2 * side[0], "{side:?}");
}

#[test]
fn a_sphere_is_shaded_evenly_to_both_sides() {
    let (positions, triangles) = sphere(Vec3::ZERO, 0.5, 24);
    let camera = Camera::orbit(Vec3::ZERO, 3.0, 0.0, 0.0);
    let view = View { key: Some(Vec3::new(0.0, 1.0, 0.6)), ..bare(camera, 120) };
    let layer = Layer { positions: &positions, triangles: &triangles, paint: GREEN };
    let image = render(&view, &[layer]).unwrap();
    for y in 20..100 {
        for x in 0..60 {
            let (left, right) = (image.at(x, y)[1], image.at(119 - x, y)[1]);
            assert!(left.abs_diff(right) < 12, "{left} and {right} at {x}, {y}");
        }
    }
    assert!(image.at(60, 40)[1] > image.at(60, 80)[1] + 30, "light comes from above");
}

#[test]
fn the_back_has_another_hue() {
    let positions = quad(0.0, 0.5);
    let layer = Layer { positions: &positions, triangles: &QUAD, paint: Paint::CLOTH };
    let seen = |yaw: f32| {
        let view = bare(Camera::orbit(Vec3::ZERO, 3.0, yaw, 0.0), 40);
        render(&view, &[layer]).unwrap().at(20, 20).map(f32::from)
    };
    let (front, back) = (seen(0.0), seen(PI));
    assert!(front[2] > 1.2 * front[1] && back[1] < back[2].max(back[0]), "{front:?} {back:?}");
    assert!(back.iter().sum::<f32>() < 0.9 * front.iter().sum::<f32>());
}

#[test]
fn colours_by_vertex_blend() {
    let positions = quad(0.0, 0.5);
    let colours = [[255, 0, 0], [0, 0, 255], [0, 0, 255], [255, 0, 0]];
    let paint = Paint::Vertices(&colours);
    let layer = Layer { positions: &positions, triangles: &QUAD, paint };
    let view = bare(Camera::orbit(Vec3::ZERO, 3.0, 0.0, 0.0), 100);
    let image = render(&view, &[layer]).unwrap();
    let (left, right) = (image.at(20, 50), image.at(80, 50));
    assert!(left[0] > left[2] && right[2] > right[0], "{left:?} {right:?}");
}

#[test]
fn what_crosses_the_eye_is_clipped() {
    let positions = [Vec3::new(-1.0, -0.2, -5.0), Vec3::new(1.0, -0.2, -5.0), Vec3::Z * 5.0];
    let layer = Layer { positions: &positions, triangles: &[[0, 1, 2]], paint: GREEN };
    let camera = Camera { eye: Vec3::Y * 0.1, target: Vec3::new(0.0, 0.1, -1.0), angle: 1.0 };
    let image = render(&bare(camera, 64), &[layer]).unwrap();
    assert!(image.at(32, 60)[1] > 50, "the part before the eye is drawn");
    assert_eq!(image.at(32, 4), [0; 3], "nothing from behind the eye is drawn");
}

#[test]
fn a_shadow_lies_on_the_ground() {
    let (positions, triangles) = sphere(Vec3::Y * 0.5, 0.3, 12);
    let camera = Camera::orbit(Vec3::Y * 0.3, 4.0, 0.0, 0.6);
    let view = View { key: Some(Vec3::Y), ..View::new(camera, 120, 120) };
    let layer = Layer { positions: &positions, triangles: &triangles, paint: RED };
    let (with, without) = (render(&view, &[layer]).unwrap(), render(&view, &[]).unwrap());
    let pairs = with.pixels().iter().zip(without.pixels());
    let darker = pairs.filter(|(a, b)| a[0] == a[1].min(a[0]) && a[2] + 20 < b[2] && a[1] > 90);
    let darker = darker.count();
    assert!((100..2500).contains(&darker), "{darker} pixels of ground are in shadow");
}

#[test]
fn broken_meshes_are_refused_or_left_out() {
    let camera = Camera::around(Vec3::ZERO, 2.0);
    let view = View::new(camera, 32, 32);
    let positions = [Vec3::NAN, Vec3::X, Vec3::Y * f32::INFINITY, Vec3::splat(1e30), Vec3::ZERO];
    let wild = [[0, 1, 2], [1, 2, 3], [1, 3, 4], [4, 4, 4], [1, 1, 4]];
    let layer = Layer { positions: &positions, triangles: &wild, paint: RED };
    assert!(render(&view, &[layer]).is_ok());
    let outside = Layer { triangles: &[[0, 1, 9]], ..layer };
    let error = render(&view, &[layer, outside]).unwrap_err();
    assert!(matches!(error, RasterError::Vertex { layer: 1, triangle: 0, vertex: 9, count: 5 }));
    let few = Layer { paint: Paint::Vertices(&[[0; 3]]), ..layer };
    assert!(matches!(render(&view, &[few]), Err(RasterError::Colours { layer: 0, .. })));
    assert!(matches!(render(&View::new(camera, 0, 9), &[]), Err(RasterError::Image(_))));
}

#[test]
fn framing_holds_every_point() {
    let (positions, triangles) = sphere(Vec3::new(3.0, 1.0, -2.0), 0.8, 12);
    for yaw in [0.0, 0.7, 2.5] {
        let camera = Camera::framing(&positions, 1.0, yaw, 0.3);
        let layer = Layer { positions: &positions, triangles: &triangles, paint: RED };
        let image = render(&bare(camera, 80), &[layer]).unwrap();
        let edge = (0..80).flat_map(|k| [(k, 0), (k, 79), (0, k), (79, k)]);
        assert!(edge.into_iter().all(|(x, y)| image.at(x, y) == [0; 3]));
        let filled = image.pixels().iter().filter(|pixel| pixel[0] > 40).count();
        assert!(filled > 80 * 80 / 2, "only {filled} pixels are filled");
    }
}

#[test]
fn normals_of_a_sphere_point_outwards() {
    let (positions, triangles) = sphere(Vec3::ZERO, 2.0, 16);
    for (normal, position) in normals(&positions, &triangles).iter().zip(&positions) {
        // The poles' copies of one point have one triangle each; their normals lean a little.
        assert!(normal.dot(position.normalize()) > 0.97, "{normal} at {position}");
    }
}

//! From the world to the sample grid: transform, clip at the near plane, set up.

use std::ops::Range;

use glam::{Vec2, Vec3};

use super::light;
use super::{Layer, Paint};
use crate::camera::Camera;

/// Nearest distance that is drawn, in metres.
const NEAR: f32 = 0.01;

/// Perspective onto a grid of samples.
pub(super) struct Projection {
    pub(super) eye: Vec3,
    /// Right, up, back.
    pub(super) axes: [Vec3; 3],
    /// Middle of the grid, in samples.
    pub(super) middle: Vec2,
    /// Samples per unit of tangent.
    pub(super) focal: f32,
}

impl Projection {
    pub(super) fn new(camera: &Camera, width: u32, height: u32) -> Self {
        let middle = 0.5 * Vec2::new(width as f32, height as f32);
        let tangent = (0.5 * camera.angle.clamp(0.01, 3.0)).tan();
        Self { eye: camera.eye, axes: camera.axes(), middle, focal: middle.y / tangent }
    }

    /// Right, up and depth (towards what is looked at), in metres from the eye.
    fn view(&self, point: Vec3) -> Vec3 {
        let [right, up, back] = self.axes;
        let from_eye = point - self.eye;
        Vec3::new(from_eye.dot(right), from_eye.dot(up), -from_eye.dot(back))
    }

    fn screen(&self, view: Vec3) -> Vec2 {
        self.middle + self.focal / view.z * Vec2::new(view.x, -view.y)
    }
}

/// A triangle on the sample grid, with all that shading needs.
pub(super) struct Triangle {
    corners: [Vec2; 3],
    /// Gradients of the first two barycentric coordinates.
    gradients: [Vec2; 2],
    /// 1/w at the corners, in 1/metres.
    pub(super) nearness: [f32; 3],
    normals: [Vec3; 3],
    /// Linear light.
    colours: [Vec3; 3],
    /// Whether its back is seen.
    pub(super) back: bool,
}

impl Triangle {
    fn new(projection: &Projection, corners: [Corner; 3]) -> Option<Self> {
        let [a, b, c] = corners.map(|corner| projection.screen(corner.view));
        // Rows run downwards, so a front, counter-clockwise in the world, has a negative area here.
        let area = (b - a).perp_dot(c - a);
        if !area.is_finite() || area.abs() < 1e-9 {
            return None;
        }
        let gradient = |from: Vec2, to: Vec2| (to - from).perp() / area;
        Some(Self {
            corners: [a, b, c],
            gradients: [gradient(b, c), gradient(c, a)],
            nearness: corners.map(|corner| corner.view.z.recip()),
            normals: corners.map(|corner| corner.normal),
            colours: corners.map(|corner| corner.colour),
            back: area > 0.0,
        })
    }

    /// Columns and rows whose samples may be covered.
    pub(super) fn extent(&self, width: u32, height: u32) -> [Range<u32>; 2] {
        let [a, b, c] = self.corners;
        let (low, high) = (a.min(b).min(c), a.max(b).max(c));
        // `as` saturates: what lies left of or above the grid becomes 0.
        let range = |low: f32, high: f32, size: u32| {
            (low - 0.5).ceil() as u32..((high - 0.5).floor() + 1.0).max(0.0).min(size as f32) as u32
        };
        [range(low.x, high.x, width), range(low.y, high.y, height)]
    }

    /// Barycentric coordinates on the screen of a point of the grid.
    pub(super) fn barycentric(&self, x: f32, y: f32) -> [f32; 3] {
        let offset = Vec2::new(x, y) - self.corners[2];
        let a = self.gradients[0].dot(offset);
        let b = self.gradients[1].dot(offset);
        [a, b, 1.0 - a - b]
    }

    /// Normal (not of unit length) and colour at a point of the grid, true to perspective.
    pub(super) fn surface(&self, x: f32, y: f32) -> (Vec3, Vec3) {
        let barycentric = self.barycentric(x, y);
        // The mean of several samples may lie a little outside.
        let weights = [0, 1, 2].map(|k| barycentric[k].max(0.0) * self.nearness[k]);
        let scale = (weights[0] + weights[1] + weights[2]).recip();
        let blend = |values: &[Vec3; 3]| {
            scale * (weights[0] * values[0] + weights[1] * values[1] + weights[2] * values[2])
        };
        (blend(&self.normals), blend(&self.colours))
    }
}

/// A corner before projection: position from the eye, normal, colour.
#[derive(Clone, Copy)]
struct Corner {
    view: Vec3,
    normal: Vec3,
    colour: Vec3,
}

impl Corner {
    /// The point between two corners that lies on the near plane.
    fn at_near(self, other: Self) -> Self {
        let t = (NEAR - self.view.z) / (other.view.z - self.view.z);
        Self {
            view: self.view.lerp(other.view, t).with_z(NEAR),
            normal: self.normal.lerp(other.normal, t),
            colour: self.colour.lerp(other.colour, t),
        }
    }
}

/// All triangles of all layers that lie before the eye.
pub(super) fn triangles(projection: &Projection, layers: &[Layer<'_>]) -> Vec<Triangle> {
    let mut triangles = Vec::with_capacity(layers.iter().map(|mesh| mesh.triangles.len()).sum());
    for mesh in layers {
        let normals = super::normals(mesh.positions, mesh.triangles);
        let corners: Vec<Corner> = (0..mesh.positions.len())
            .map(|vertex| Corner {
                view: projection.view(mesh.positions[vertex]),
                normal: normals[vertex],
                colour: light::decode(match mesh.paint {
                    Paint::Plain(colour) => colour,
                    Paint::Vertices(colours) => colours[vertex],
                }),
            })
            .collect();
        for numbers in mesh.triangles {
            let three = numbers.map(|number| corners[number as usize]);
            if three.iter().all(|corner| corner.view.is_finite()) {
                clip(projection, three, &mut triangles);
            }
        }
    }
    triangles
}

/// Adds what lies beyond the near plane: nothing, one triangle or two.
fn clip(projection: &Projection, corners: [Corner; 3], out: &mut Vec<Triangle>) {
    if corners.iter().all(|corner| corner.view.z >= NEAR) {
        out.extend(Triangle::new(projection, corners));
        return;
    }
    let mut kept = Vec::with_capacity(4);
    for (k, &corner) in corners.iter().enumerate() {
        let next = corners[(k + 1) % 3];
        if corner.view.z >= NEAR {
            kept.push(corner);
        }
        if (corner.view.z >= NEAR) != (next.view.z >= NEAR) {
            kept.push(corner.at_near(next));
        }
    }
    for k in 2..kept.len() {
        out.extend(Triangle::new(projection, [kept[0], kept[k - 1], kept[k]]));
    }
}

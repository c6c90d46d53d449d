//! Lights, the ground and the shadow upon it.

use glam::{Vec2, Vec3};

use super::project::Projection;
use super::{Layer, View};
use crate::image::Rgb;

/// Side of the shadow's grid, in cells.
const SHADOW_CELLS: usize = 192;
/// Farthest that a shadow may reach from its middle, in metres: a stray vertex must not spread the
/// grid until nothing is left of the shadow.
const SHADOW_REACH: f32 = 4.0;
/// Side of a square of the ground, in metres.
const TILE: f32 = 0.5;

/// sRGB to linear light (as a square, close enough for a picture and cheap).
pub(super) fn decode(colour: Rgb) -> Vec3 {
    let v = Vec3::from_array(colour.map(f32::from)) / 255.0;
    v * v
}

/// Linear light to sRGB, the inverse of [`decode`].
pub(super) fn encode(light: Vec3) -> Rgb {
    light.to_array().map(|v| (255.0 * v.clamp(0.0, 1.0).sqrt()).round() as u8)
}

/// A key light, a weaker one from the other side, and the sky.
pub(super) struct Lights {
    key: Vec3,
    fill: Vec3,
    /// Half way between the key light and the eye: where a surface gleams.
    gleam: Vec3,
}

impl Lights {
    pub(super) fn new(view: &View) -> Self {
        let [right, _, back] = view.camera.axes();
        let level = Vec3::new(back.x, 0.0, back.z).normalize_or_zero();
        let usual = 0.7 * level - 0.75 * right + 1.15 * Vec3::Y;
        let key = view.key.and_then(Vec3::try_normalize).unwrap_or(usual.normalize());
        // The fill comes from where the viewer is, moved to the side that the key leaves dark.
        let fill = (back - 0.6 * key.dot(right) * right).normalize_or_zero();
        Self { key, fill, gleam: (key + back).normalize_or_zero() }
    }

    /// Light from a surface; `normal` points out of its front.
    pub(super) fn shade(&self, normal: Vec3, colour: Vec3, seen_from_back: bool) -> Vec3 {
        let normal = normal.normalize_or_zero();
        let (normal, colour) = match seen_from_back {
            true => (-normal, back_of(colour)),
            false => (normal, colour),
        };
        let sky = 0.5 + 0.5 * normal.y;
        let ambient = 0.20 + 0.16 * sky;
        let key = 0.78 * normal.dot(self.key).max(0.0);
        let fill = 0.22 * normal.dot(self.fill).max(0.0);
        let gleam = normal.dot(self.gleam).max(0.0).powi(24);
        colour * (ambient + key + fill) + Vec3::splat(0.05 * gleam)
    }
}

/// The colour of a back: darker, and its hue turned.
fn back_of(colour: Vec3) -> Vec3 {
    let turned = Vec3::new(colour.z, colour.x, colour.y);
    0.62 * colour.lerp(turned, 0.55)
}

/// A level plane of pale squares that fades with distance.
pub(super) struct Ground {
    height: f32,
    eye: Vec3,
    axes: [Vec3; 3],
    middle: Vec2,
    focal: f32,
    target: Vec2,
    fade: f32,
    background: Vec3,
    key: Vec3,
    shadow: Shadow,
}

impl Ground {
    /// `None` when the eye is not above the ground.
    pub(super) fn new(
        view: &View,
        projection: &Projection,
        lights: &Lights,
        height: f32,
    ) -> Option<Self> {
        let above = projection.eye.y - height;
        if !(above > 0.0 && projection.eye.is_finite()) {
            return None;
        }
        let target = view.camera.target;
        Some(Self {
            height,
            eye: projection.eye,
            axes: projection.axes,
            middle: projection.middle,
            focal: projection.focal,
            target: Vec2::new(target.x, target.z),
            fade: 1.3 * projection.eye.distance(target).max(1.0),
            background: decode(view.background),
            key: lights.key,
            shadow: Shadow::default(),
        })
    }

    /// The ray through a point of the grid; one metre deep.
    fn ray(&self, x: f32, y: f32) -> Vec3 {
        let [right, up, back] = self.axes;
        (x - self.middle.x) / self.focal * right - (y - self.middle.y) / self.focal * up - back
    }

    /// 1/w of the ground in a row of the grid, in 1/metres; 0 or less above the horizon. It is the
    /// same along a row, for the camera never tilts to a side.
    pub(super) fn nearness(&self, y: f32) -> f32 {
        self.ray(self.middle.x, y).y / (self.height - self.eye.y)
    }

    /// Linear light at a point of the grid.
    pub(super) fn shade(&self, x: f32, y: f32) -> Vec3 {
        let nearness = self.nearness(y);
        if nearness <= 0.0 {
            return self.background;
        }
        let hit = self.eye + self.ray(x, y) / nearness;
        let place = Vec2::new(hit.x, hit.z);
        let distance = place.distance(self.target) / self.fade;
        let shown = (-distance * distance).exp();
        // How much ground a pixel covers, so that far squares blur instead of flickering.
        let depth = nearness.recip();
        let slant = (self.eye.y - self.height) / self.eye.distance(hit);
        let width = (2.0 * depth / self.focal / slant.max(0.02) / TILE).clamp(1e-4, 1.0);
        let tile =
            decode([214, 217, 221]).lerp(decode([198, 202, 207]), checker(place / TILE, width));
        let lit = tile * (1.0 - 0.6 * self.shadow.at(place));
        self.background.lerp(lit, shown)
    }

    /// The same ground with the shadow of these meshes.
    pub(super) fn with_shadow(mut self, layers: &[Layer<'_>]) -> Self {
        // A light from the side or from below casts no shadow that is worth drawing.
        if self.key.y < 0.2 {
            return self;
        }
        let slope = Vec2::new(self.key.x, self.key.z) / self.key.y;
        let fall = |point: Vec3| {
            let above = point.y - self.height;
            (above >= 0.0).then(|| Vec2::new(point.x, point.z) - above * slope)
        };
        let mut fallen = Vec::new();
        for mesh in layers {
            let places: Vec<_> = mesh.positions.iter().map(|&point| fall(point)).collect();
            for corners in mesh.triangles {
                if let [Some(a), Some(b), Some(c)] = corners.map(|corner| places[corner as usize]) {
                    fallen.push([a, b, c]);
                }
            }
        }
        self.shadow = Shadow::new(&fallen);
        self
    }
}

/// A checkerboard of unit squares, averaged over a box of this width: 0 to 1.
fn checker(place: Vec2, width: f32) -> f32 {
    let wave = |v: f32| {
        let triangle = |v: f32| ((0.5 * v).rem_euclid(1.0) - 0.5).abs();
        2.0 * (triangle(v - 0.5 * width) - triangle(v + 0.5 * width)) / width
    };
    0.5 - 0.5 * wave(place.x) * wave(place.y)
}

/// How much of the key light is taken from each place of the ground.
#[derive(Default)]
struct Shadow {
    low: Vec2,
    /// Side of a cell, in metres.
    cell: f32,
    /// 0 (lit) to 1, `SHADOW_CELLS` squared; empty when nothing casts a shadow.
    cells: Vec<f32>,
}

impl Shadow {
    fn new(triangles: &[[Vec2; 3]]) -> Self {
        let finite = || triangles.iter().flatten().filter(|place| place.is_finite());
        let count = finite().count();
        if count == 0 {
            return Self::default();
        }
        let middle = finite().fold(Vec2::ZERO, |sum, &place| sum + place / count as f32);
        let spread = |place: &Vec2| (*place - middle).abs().max_element();
        let reach = finite().map(spread).fold(0.0, f32::max).min(SHADOW_REACH) + 0.1;
        let cell = 2.0 * reach / SHADOW_CELLS as f32;
        let mut shadow = Self {
            low: middle - Vec2::splat(reach),
            cell,
            cells: vec![0.0; SHADOW_CELLS * SHADOW_CELLS],
        };
        for triangle in triangles {
            shadow.cast(triangle);
        }
        // Two box filters, of about three centimetres to either side, make a soft edge.
        let radius = ((0.03 / cell) as usize).clamp(1, 8);
        for _ in 0..2 {
            shadow.blur(radius);
        }
        shadow
    }

    fn cast(&mut self, triangle: &[Vec2; 3]) {
        let [a, b, c] = triangle.map(|place| (place - self.low) / self.cell);
        let area = (b - a).perp_dot(c - a);
        if !area.is_finite() || area.abs() < 1e-12 {
            return;
        }
        let (low, high) = (a.min(b).min(c).floor(), a.max(b).max(c).ceil());
        let range = |low: f32, high: f32| low as usize..(high as usize).min(SHADOW_CELLS);
        for y in range(low.y, high.y) {
            for x in range(low.x, high.x) {
                let place = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
                let side = |from: Vec2, to: Vec2| (to - from).perp_dot(place - from) * area;
                if side(a, b) >= 0.0 && side(b, c) >= 0.0 && side(c, a) >= 0.0 {
                    self.cells[y * SHADOW_CELLS + x] = 1.0;
                }
            }
        }
    }

    /// One box filter along rows and one along columns.
    fn blur(&mut self, radius: usize) {
        let share = 1.0 / (2 * radius + 1) as f32;
        for (step, start) in [(1, SHADOW_CELLS), (SHADOW_CELLS, 1)] {
            for line in 0..SHADOW_CELLS {
                let at = |k: usize| line * start + k * step;
                let old: Vec<f32> = (0..SHADOW_CELLS).map(|k| self.cells[at(k)]).collect();
                let mut sum: f32 = old[..radius].iter().sum();
                for k in 0..SHADOW_CELLS {
                    sum += old.get(k + radius).copied().unwrap_or(0.0);
                    self.cells[at(k)] = (share * sum).clamp(0.0, 1.0);
                    sum -= k.checked_sub(radius).map_or(0.0, |k| old[k]);
                }
            }
        }
    }

    fn at(&self, place: Vec2) -> f32 {
        if self.cells.is_empty() {
            return 0.0;
        }
        let grid = (place - self.low) / self.cell - Vec2::splat(0.5);
        let limit = (SHADOW_CELLS - 1) as f32;
        if !(grid.min_element() >= 0.0 && grid.max_element() < limit) {
            return 0.0;
        }
        let (column, row) = (grid.x as usize, grid.y as usize);
        let (u, v) = (grid.x.fract(), grid.y.fract());
        let corner = |x: usize, y: usize| self.cells[(row + y) * SHADOW_CELLS + column + x];
        let upper = corner(0, 0) * (1.0 - u) + corner(1, 0) * u;
        let lower = corner(0, 1) * (1.0 - u) + corner(1, 1) * u;
        upper * (1.0 - v) + lower * v
    }
}

//! Meshes to a picture.
//!
//! Each sample of a 2 x 2 grid per pixel remembers the nearest triangle (depth is 1/w, which is
//! linear on the screen); shading happens once per triangle and pixel afterwards, so that hidden
//! surfaces cost no shading.

mod light;
mod project;

use glam::Vec3;

use crate::camera::Camera;
use crate::image::{Image, ImageError, Rgb};
use light::{Ground, Lights};
use project::{Projection, Triangle};

/// Samples per pixel along one axis.
const SAMPLES: u32 = 2;
const NOTHING: u32 = u32::MAX;
const GROUND: u32 = u32::MAX - 1;

/// A mesh in a picture.
#[derive(Clone, Copy, Debug)]
pub struct Layer<'a> {
    /// Vertex positions in the world, in metres. A triangle with a vertex that is not finite is
    /// left out, so that what is left of a failed simulation can be seen.
    pub positions: &'a [Vec3],
    /// Vertex numbers, counter-clockwise when seen from the front.
    pub triangles: &'a [[u32; 3]],
    /// Its colour.
    pub paint: Paint<'a>,
}

/// The colour of a mesh.
#[derive(Clone, Copy, Debug)]
pub enum Paint<'a> {
    /// One colour for all.
    Plain(Rgb),
    /// One colour a vertex, blended between them: strain, error, distance.
    Vertices(&'a [Rgb]),
}

impl Paint<'_> {
    /// A warm grey, for bodies.
    pub const BODY: Self = Self::Plain([196, 176, 160]);
    /// A clear blue, for cloth.
    pub const CLOTH: Self = Self::Plain([72, 118, 196]);
}

/// How meshes are looked at.
#[derive(Clone, Copy, Debug)]
pub struct View {
    /// Where from.
    pub camera: Camera,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Colour behind everything.
    pub background: Rgb,
    /// Height of the ground, in metres; without it, nothing is drawn below or cast on it.
    pub ground: Option<f32>,
    /// Direction towards the key light; without it, it comes over the viewer's left shoulder.
    pub key: Option<Vec3>,
}

impl View {
    /// A view with ground at height 0 and the key light over the viewer's left shoulder.
    pub fn new(camera: Camera, width: u32, height: u32) -> Self {
        let background = [226, 230, 235];
        Self { camera, width, height, background, ground: Some(0.0), key: None }
    }

    /// The same view with the camera carried along, so that it looks at `target`.
    pub fn following(&self, target: Vec3) -> Self {
        Self { camera: self.camera.following(target), ..*self }
    }
}

/// Why meshes could not be drawn.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RasterError {
    /// The picture's size is out of range (each sample counts, four to a pixel).
    #[error(transparent)]
    Image(#[from] ImageError),
    /// A triangle names a vertex that does not exist.
    #[error("layer {layer}: triangle {triangle} names vertex {vertex}, of {count}; check the mesh")]
    Vertex {
        /// Number of the layer.
        layer: usize,
        /// Number of the triangle.
        triangle: usize,
        /// The vertex it names.
        vertex: u32,
        /// Vertices there are.
        count: usize,
    },
    /// Another number of colours than of vertices.
    #[error("layer {layer}: {colours} colours for {count} vertices; there must be one for each")]
    Colours {
        /// Number of the layer.
        layer: usize,
        /// Colours given.
        colours: usize,
        /// Vertices there are.
        count: usize,
    },
}

/// Draws meshes with smooth normals, two-sided shading and a shadow on the ground.
///
/// Backs of triangles are darker and of another hue than their fronts, so that cloth turned inside
/// out is seen at once.
///
/// Cost: some ten milliseconds for 25,000 triangles at 400 x 400 pixels on one core.
///
/// # Errors
/// [`RasterError`] when the picture is too large or a mesh contradicts itself.
pub fn render(view: &View, layers: &[Layer<'_>]) -> Result<Image, RasterError> {
    check(layers)?;
    let mut image = Image::new(view.width, view.height, view.background)?;
    // The samples are a picture themselves, within the same limits.
    let [wide, high] = [view.width, view.height].map(|side| side.saturating_mul(SAMPLES));
    let mut samples = Samples::new(&Image::new(wide, high, [0; 3])?);
    let projection = Projection::new(&view.camera, wide, high);
    let triangles = project::triangles(&projection, layers);
    for (index, triangle) in (0..GROUND).zip(&triangles) {
        samples.cover(index, triangle);
    }
    let lights = Lights::new(view);
    let ground = view.ground.and_then(|height| Ground::new(view, &projection, &lights, height));
    let ground = ground.map(|ground| ground.with_shadow(layers));
    if let Some(ground) = &ground {
        samples.cover_ground(ground);
    }
    let shader = Shader { triangles: &triangles, lights, ground, background: view.background };
    shader.resolve(&samples, &mut image);
    Ok(image)
}

/// Smooth unit normals: each triangle counts by its angle at the vertex. Zero where no triangle
/// with an area meets.
///
/// * `positions` in metres; `triangles` counter-clockwise, every number below `positions.len()`.
///
/// Source: Thürmer and Wüthrich 1998, "Computing vertex normals from polygonal facets".
///
/// # Panics
/// When a triangle names a vertex that does not exist.
pub fn normals(positions: &[Vec3], triangles: &[[u32; 3]]) -> Vec<Vec3> {
    let mut sums = vec![Vec3::ZERO; positions.len()];
    for corners in triangles {
        let [a, b, c] = corners.map(|corner| positions[corner as usize]);
        let cross = (b - a).cross(c - a);
        let reach = (b - a).length_squared().max((c - a).length_squared());
        // A sliver's normal is rounding noise.
        if cross.length() <= 1e-5 * reach {
            continue;
        }
        let Some(face) = cross.try_normalize() else { continue };
        let angle = |at: Vec3, left: Vec3, right: Vec3| {
            let (left, right) = ((left - at).normalize_or_zero(), (right - at).normalize_or_zero());
            left.cross(right).length().atan2(left.dot(right))
        };
        sums[corners[0] as usize] += angle(a, b, c) * face;
        sums[corners[1] as usize] += angle(b, c, a) * face;
        sums[corners[2] as usize] += angle(c, a, b) * face;
    }
    sums.into_iter().map(Vec3::normalize_or_zero).collect()
}

fn check(layers: &[Layer<'_>]) -> Result<(), RasterError> {
    for (layer, mesh) in layers.iter().enumerate() {
        let count = mesh.positions.len();
        for (triangle, corners) in mesh.triangles.iter().enumerate() {
            if let Some(&vertex) = corners.iter().find(|&&corner| corner as usize >= count) {
                return Err(RasterError::Vertex { layer, triangle, vertex, count });
            }
        }
        if let Paint::Vertices(colours) = mesh.paint
            && colours.len() != count
        {
            return Err(RasterError::Colours { layer, colours: colours.len(), count });
        }
    }
    Ok(())
}

/// The nearest surface at every sample.
struct Samples {
    width: u32,
    height: u32,
    /// 1/w of the nearest surface; 0 is infinitely far.
    nearness: Vec<f32>,
    surface: Vec<u32>,
}

impl Samples {
    fn new(size: &Image) -> Self {
        let (width, height) = (size.width(), size.height());
        let count = size.pixels().len();
        Self { width, height, nearness: vec![0.0; count], surface: vec![NOTHING; count] }
    }

    fn cover(&mut self, index: u32, triangle: &Triangle) {
        let [columns, rows] = triangle.extent(self.width, self.height);
        if columns.is_empty() {
            return;
        }
        let [na, nb, nc] = triangle.nearness;
        for y in rows {
            let row = (y * self.width) as usize;
            let span = row + columns.start as usize..row + columns.end as usize;
            let depths = self.nearness[span.clone()].iter_mut().zip(&mut self.surface[span]);
            for (x, (depth, surface)) in columns.clone().zip(depths) {
                let [a, b, c] = triangle.barycentric(x as f32 + 0.5, y as f32 + 0.5);
                let nearness = a * na + b * nb + c * nc;
                if a.min(b).min(c) >= 0.0 && nearness > *depth {
                    *depth = nearness;
                    *surface = index;
                }
            }
        }
    }

    fn cover_ground(&mut self, ground: &Ground) {
        let wide = self.width as usize;
        let rows = self.nearness.chunks_mut(wide).zip(self.surface.chunks_mut(wide));
        for (y, (depths, surfaces)) in rows.enumerate() {
            let nearness = ground.nearness(y as f32 + 0.5);
            for (depth, surface) in depths.iter_mut().zip(surfaces) {
                if nearness > *depth {
                    *depth = nearness;
                    *surface = GROUND;
                }
            }
        }
    }
}

struct Shader<'a> {
    triangles: &'a [Triangle],
    lights: Lights,
    ground: Option<Ground>,
    background: Rgb,
}

impl Shader<'_> {
    /// Mixes the samples of each pixel; a surface is shaded once a pixel, amid its samples.
    fn resolve(&self, samples: &Samples, image: &mut Image) {
        let width = image.width() as usize;
        let wide = samples.width as usize;
        for (index, pixel) in image.pixels_mut().iter_mut().enumerate() {
            let (x, y) = (index % width * 2, index / width * 2);
            let at = |k: usize| samples.surface[(y + k / 2) * wide + x + k % 2];
            let surfaces = [at(0), at(1), at(2), at(3)];
            if surfaces == [NOTHING; 4] {
                continue;
            }
            // Most pixels lie within one surface.
            if surfaces == [surfaces[0]; 4] {
                let light = self.shade(surfaces[0], x as f32 + 1.0, y as f32 + 1.0);
                *pixel = light::encode(light);
                continue;
            }
            let mut sum = Vec3::ZERO;
            for k in 0..4 {
                if surfaces[..k].contains(&surfaces[k]) {
                    continue;
                }
                let (mut count, mut middle) = (0.0, [0.0; 2]);
                for other in (k..4).filter(|&other| surfaces[other] == surfaces[k]) {
                    count += 1.0;
                    middle[0] += (x + other % 2) as f32 + 0.5;
                    middle[1] += (y + other / 2) as f32 + 0.5;
                }
                sum += count * self.shade(surfaces[k], middle[0] / count, middle[1] / count);
            }
            *pixel = light::encode(0.25 * sum);
        }
    }

    /// Linear light of a surface at a point of the sample grid.
    fn shade(&self, surface: u32, x: f32, y: f32) -> Vec3 {
        match (surface, &self.ground) {
            (GROUND, Some(ground)) => ground.shade(x, y),
            (NOTHING | GROUND, _) => light::decode(self.background),
            _ => {
                let triangle = &self.triangles[surface as usize];
                let (normal, colour) = triangle.surface(x, y);
                self.lights.shade(normal, colour, triangle.back)
            }
        }
    }
}

#[cfg(test)]
mod tests;

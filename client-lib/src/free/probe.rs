//! The way back: how far a state of the graph is from the cloth outside, by a few vertices.
//!
//! Positions are linear in coefficients, and so are coarse points, to which cloth is drawn.
//! So a few rows of the basis, laid out once, give a state's
//! probed vertices without reconstructing it. Classes (hood up, hood down) are told in the same
//! way, from the mean rows of their regions.

use cloth::{Rigid, Vec3};
use codec::Basis;
use codec::upsample::{Class, Upsampler};

use super::Upsampled;
use crate::scene::Scene;

/// Vertices that are compared.
const PROBES: usize = 24;
/// States that are compared in a frame, at most.
pub(crate) const CANDIDATES: usize = 64;

/// Rows of a basis for the probed vertices and the classes' means.
#[derive(Debug)]
pub struct Probes {
    vertices: Vec<u32>,
    columns: usize,
    /// Three rows for each probed vertex, then for each class; `columns` numbers each (m at full
    /// scale).
    rows: Vec<f32>,
    /// Three rows for each coarse point, likewise.
    coarse: Vec<f32>,
}

/// Scratch of a search: probed places (m) of the cloth and of a candidate, and the cloth's classes.
#[derive(Debug, Default)]
pub(crate) struct Found {
    cloth: Vec<Vec3>,
    classes: Vec<bool>,
}

impl Probes {
    /// Of a garment's upsampler on a basis. Cost: one reconstruction a column; never on the frame
    /// loop.
    pub fn new(upsampled: &Upsampled, basis: &Basis) -> Self {
        let upsampler = &upsampled.upsampler;
        let vertices = probed(upsampler);
        let columns = basis.columns();
        let classes = &upsampler.parts().classes;
        let count = 3 * (vertices.len() + classes.len());
        let mut rows = vec![0.0; count * columns];
        let points = 3 * upsampler.coarse();
        let (mut coarse, mut restricted) = (vec![0.0; points * columns], vec![0.0; points]);
        let (mut unit, mut all) = (vec![0.0; columns], vec![0.0; basis.rows()]);
        let means: Vec<&[u32]> = classes.iter().map(|class| &class.vertices[..]).collect();
        for column in 0..columns {
            unit[column] = 1.0;
            let fits = basis.reconstruct(&unit, 0..basis.rows(), columns, &mut all);
            debug_assert!(fits.is_ok(), "made to measure");
            let fits = upsampler.restrict(&all, &mut restricted);
            debug_assert!(fits.is_ok(), "made to measure");
            for (row, x) in restricted.iter().enumerate() {
                coarse[row * columns + column] = *x;
            }
            unit[column] = 0.0;
            let single = vertices.iter().map(std::slice::from_ref);
            for (index, of) in single.chain(means.iter().copied()).enumerate() {
                let mean = mean(&all, of).to_array();
                for (axis, x) in mean.into_iter().enumerate() {
                    rows[(3 * index + axis) * columns + column] = x;
                }
            }
        }
        Self { vertices, columns, rows, coarse }
    }

    /// Coarse points (m, in the state frame) of the state with these coefficients.
    pub(crate) fn coarse_m(&self, coefficients: &[f32], out: &mut Vec<f32>) {
        let known = self.columns.min(coefficients.len());
        let of = |row: &[f32]| dot(&row[..known], &coefficients[..known]);
        out.clear();
        out.extend(self.coarse.chunks_exact(self.columns.max(1)).map(of));
    }

    /// Prepares the comparison with cloth whose rows (m) are given, in the state frame at `hips`.
    pub(crate) fn look(&self, rows: &[f32], planes: &Planes, found: &mut Found) {
        found.cloth.clear();
        found.cloth.extend(self.vertices.iter().map(|v| mean(rows, &[*v])));
        found.classes.clear();
        let sides = planes.0.iter().map(|(vertices, plane)| plane.above(mean(rows, vertices)));
        found.classes.extend(sides);
    }

    /// Largest distance (m) of a probed vertex of the state with these coefficients; `None` where it is
    /// at least `most`, or of another class.
    pub(crate) fn distance_m(
        &self,
        coefficients: &[f32],
        planes: &Planes,
        found: &Found,
        most: f32,
    ) -> Option<f32> {
        let place = |index: usize| {
            let row = |axis| {
                let row = &self.rows[(3 * index + axis) * self.columns..][..self.columns];
                dot(row, coefficients.get(..self.columns).unwrap_or_default())
            };
            Vec3::new(row(0), row(1), row(2))
        };
        let mut largest = 0.0f32;
        for (index, cloth) in found.cloth.iter().enumerate() {
            largest = largest.max(place(index).distance(*cloth));
            if largest >= most {
                return None;
            }
        }
        let first = found.cloth.len();
        let mut classes = planes.0.iter().zip(&found.classes).enumerate();
        let same = classes.all(|(i, ((_, plane), above))| plane.above(place(first + i)) == *above);
        same.then_some(largest)
    }
}

/// The classes' planes in a pose's state frame, with their vertices.
#[derive(Debug, Default)]
pub(crate) struct Planes(Vec<(Vec<u32>, Plane)>);

#[derive(Debug, Clone, Copy)]
struct Plane {
    direction: Vec3,
    offset_m: f32,
}

impl Plane {
    fn above(&self, at: Vec3) -> bool {
        self.direction.dot(at) + self.offset_m > 0.0
    }
}

impl Planes {
    /// Moves the planes to where the joints are (in the world), seen from the state frame at `hips`.
    pub(crate) fn place(
        &mut self,
        upsampled: &Upsampled,
        scene: &Scene,
        joints: &[Rigid],
        hips: &Rigid,
    ) {
        let classes = &upsampled.upsampler.parts().classes;
        if self.0.len() != classes.len() {
            let plane = Plane { direction: Vec3::Y, offset_m: 0.0 };
            self.0 = classes.iter().map(|class| (class.vertices.clone(), plane)).collect();
        }
        for (class, (_, plane)) in classes.iter().zip(&mut self.0) {
            *plane = placed(class, scene, joints, hips);
        }
    }
}

fn placed(class: &Class, scene: &Scene, joints: &[Rigid], hips: &Rigid) -> Plane {
    let joint = usize::from(class.joint);
    let (at, rest) = (&joints[joint], &scene.skeleton().rest[joint]);
    let carried = at.vector(rest.rotation.conjugate() * Vec3::from_array(class.axis));
    let direction = hips.inverse().vector(carried);
    let offset_m = carried.dot(hips.translation - at.translation) - class.threshold_m;
    Plane { direction, offset_m }
}

/// Vertices spread over the garment: where the coarse points lie, evenly among those that are free.
fn probed(upsampler: &Upsampler) -> Vec<u32> {
    let parts = upsampler.parts();
    let pinned = |point: usize| parts.pins.iter().any(|pin| usize::from(pin.point) == point);
    let free: Vec<u32> = (0..parts.places.len())
        .filter(|point| !pinned(*point))
        .map(|point| parts.places[point].vertices[0])
        .collect();
    let count = PROBES.min(free.len());
    (0..count).map(|i| free[i * free.len() / count]).collect()
}

fn mean(rows: &[f32], vertices: &[u32]) -> Vec3 {
    let at = |v: &u32| Vec3::from_slice(&rows[3 * *v as usize..][..3]);
    vertices.iter().map(at).sum::<Vec3>() / vertices.len().max(1) as f32
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    const LANES: usize = 16;
    let (a, a_last) = a.as_chunks::<LANES>();
    let (b, b_last) = b.as_chunks::<LANES>();
    let mut sums = [0.0f32; LANES];
    for (a, b) in a.iter().zip(b) {
        for lane in 0..LANES {
            sums[lane] += a[lane] * b[lane];
        }
    }
    let last: f32 = a_last.iter().zip(b_last).map(|(a, b)| a * b).sum();
    sums.iter().sum::<f32>() + last
}

//! The tailor's dummy: a body's distances and measures in its rest pose.

use std::sync::Arc;

use cloth::surface::{Posed, Surface};
use cloth::{Body, Vec3};

use super::{Piece, TailorError};

/// Cells of the sampled field (m).
const CELL_M: f32 = 0.015;
/// Distances are sampled up to this (m).
const REACH_M: f32 = 0.12;

/// A body to fit garments to.
#[derive(Debug)]
pub struct Form {
    body: Arc<Body>,
    surface: Surface,
    posed: Posed,
    field: Sampled,
}

impl Form {
    /// Of a body in its rest pose. Samples its distances: about a second.
    pub fn new(body: &Arc<Body>) -> Self {
        let surface = Surface::new(&body.rest_positions, &body.triangles);
        let posed = surface.posed(&body.rest_positions);
        let field =
            Sampled::new(&body.rest_positions, &|p| surface.signed_distance(&posed, p, REACH_M));
        Self { body: Arc::clone(body), surface, posed, field }
    }

    /// Distance to the body (m), negative inside; sampled, and bounded far away.
    pub fn distance(&self, p: Vec3) -> f32 {
        self.field.at(p)
    }

    /// Distance to the body (m), negative inside, and the direction out of it; exact.
    pub fn exact(&self, p: Vec3) -> (f32, Vec3) {
        let contact = self.surface.closest(&self.posed, p, f32::INFINITY);
        contact.map_or((REACH_M, Vec3::Y), |c| (c.distance, c.normal))
    }

    /// Where a joint lies (m).
    ///
    /// # Errors
    /// The skeleton has no such joint.
    pub fn joint(&self, name: &'static str) -> Result<Vec3, TailorError> {
        let skeleton = &self.body.skeleton;
        let joint = skeleton.joint(name).ok_or(TailorError::Joint(name))?;
        Ok(skeleton.rest[joint].translation)
    }

    /// Lowest and highest corner of the skin that these joints move most (m).
    ///
    /// # Errors
    /// The skeleton has no such joint.
    pub fn skin_of(&self, names: &[&'static str]) -> Result<[Vec3; 2], TailorError> {
        let skeleton = &self.body.skeleton;
        let mut joints = Vec::new();
        for name in names {
            joints.push(skeleton.joint(name).ok_or(TailorError::Joint(name))?);
        }
        let skin = self.body.rest_positions.iter().zip(&self.body.joints).zip(&self.body.weights);
        let mut bounds = [Vec3::splat(f32::MAX), Vec3::splat(f32::MIN)];
        for ((p, of), weights) in skin {
            let heaviest =
                (0..4).fold(0, |best, i| if weights[i] > weights[best] { i } else { best });
            if joints.contains(&usize::from(of[heaviest])) {
                bounds = [bounds[0].min(*p), bounds[1].max(*p)];
            }
        }
        Ok(bounds)
    }

    /// Lowest and highest corner of the body (m).
    pub fn bounds(&self) -> [Vec3; 2] {
        bounds(&self.body.rest_positions)
    }
}

/// Distance to the nearer side of an open surface.
#[derive(Debug)]
pub(super) struct Worn {
    field: Sampled,
    surface: Surface,
    posed: Posed,
}

impl Worn {
    pub fn new(piece: &Piece) -> Self {
        let surface = Surface::new(&piece.positions, &piece.triangles);
        let posed = surface.posed(&piece.positions);
        let field =
            Sampled::new(&piece.positions, &|p| surface.signed_distance(&posed, p, REACH_M).abs());
        Self { field, surface, posed }
    }

    /// Distance to the surface (m), sampled.
    pub fn distance(&self, p: Vec3) -> f32 {
        self.field.at(p)
    }

    /// The nearest point of the surface within `reach` (m).
    pub fn nearest(&self, p: Vec3, reach: f32) -> Option<Vec3> {
        self.surface.closest(&self.posed, p, reach).map(|c| c.point)
    }
}

fn bounds(points: &[Vec3]) -> [Vec3; 2] {
    points
        .iter()
        .fold([Vec3::splat(f32::MAX), Vec3::splat(f32::MIN)], |[a, b], p| [a.min(*p), b.max(*p)])
}

/// A function sampled on a grid around some points, trilinear between.
#[derive(Debug)]
struct Sampled {
    low: Vec3,
    n: [usize; 3],
    values: Vec<f32>,
}

impl Sampled {
    fn new(around: &[Vec3], function: &dyn Fn(Vec3) -> f32) -> Self {
        let [low, high] = bounds(around);
        let low = low - Vec3::splat(REACH_M);
        let size = (high + Vec3::splat(REACH_M) - low) / CELL_M;
        let n = size.to_array().map(|s| s.ceil().max(1.0) as usize + 1);
        let mut values = Vec::with_capacity(n[0] * n[1] * n[2]);
        for z in 0..n[2] {
            for y in 0..n[1] {
                for x in 0..n[0] {
                    let p = low + Vec3::new(x as f32, y as f32, z as f32) * CELL_M;
                    values.push(function(p));
                }
            }
        }
        Self { low, n, values }
    }

    fn at(&self, p: Vec3) -> f32 {
        let place = ((p - self.low) / CELL_M).to_array();
        let (mut cell, mut t) = ([0; 3], [0.0; 3]);
        for axis in 0..3 {
            let last = self.n[axis] - 2;
            cell[axis] = (place[axis].max(0.0) as usize).min(last);
            t[axis] = (place[axis] - cell[axis] as f32).clamp(0.0, 1.0);
        }
        let value = |x: usize, y: usize, z: usize| {
            self.values[((cell[2] + z) * self.n[1] + cell[1] + y) * self.n[0] + cell[0] + x]
        };
        let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
        let along_x = |y, z| mix(value(0, y, z), value(1, y, z), t[0]);
        let along_y = |z| mix(along_x(0, z), along_x(1, z), t[1]);
        mix(along_y(0), along_y(1), t[2])
    }
}

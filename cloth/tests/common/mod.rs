//! Meshes and bodies for the tests: the benches' own.
#![allow(dead_code, unused_imports, missing_docs)] // each test file uses its own part

use cloth::lab::shapes::{self, Cut};
pub use cloth::lab::shapes::{ellipsoids, pose_at};
use cloth::{Environment, Material, Mesh, Model, Vec3};

/// A sheet of `nx` x `ny` cells with alternating diagonals; `at` places (0..=1, 0..=1).
pub fn sheet(nx: u32, ny: u32, at: impl Fn(f32, f32) -> Vec3) -> Mesh {
    shapes::sheet(nx, ny, Cut::Alternating, at).unwrap()
}

pub fn free(mesh: Mesh, material: Material, environment: Environment, held: &[u32]) -> Model {
    Model::new(mesh, material, environment, None, held).unwrap()
}

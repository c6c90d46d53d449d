//! Learned upsampling, off line (Kavan et al. 2011): from a coarse and a tracked fine simulation
//! to the linear operator that lifts one to the other.
//!
//! Map: [`aggregate`] the paper's slow baseline whole; [`scene`] the paper's four scenes;
//! [`figure`] the character with its capsules; [`patch`]
//! coarse and fine meshes of one surface, barycentric lift and Loop subdivision; [`mod@harmonics`] the
//! smoothest functions of a mesh; [`run`] tracked simulation; [`cache`] results in the work
//! folder; [`data`] frames as matrices; [`fit`] the paper's operators; [`tune`] their parameters;
//! [`modes`] oscillatory modes; [`beyond`] what the paper leaves open; [`mirror`] frames
//! seen in a mirror; [`judge`] errors; [`fair`] learning again, judged on frames that were not
//! learnt from; [`mod@learn`] a
//! scene from its name to an operator; [`stored`] U as a client holds it; [`report`] all methods side by side.

pub mod aggregate;
pub mod beyond;
pub mod cache;
pub mod data;
pub mod fair;
pub mod figure;
pub mod fit;
pub mod harmonics;
pub mod judge;
pub mod learn;
pub mod mirror;
pub mod modes;
pub mod patch;
pub mod report;
pub mod run;
pub mod scene;
pub mod stored;
pub mod tune;

pub use learn::{Learned, learn};

use cache::{Cache, Key};
use cloth::Mesh;
use harmonics::{Harmonics, HarmonicsError, harmonics};

/// The lowest `k` harmonics of a mesh, taken from `cache` or kept there.
///
/// # Errors
/// As [`harmonics()`]; a work folder that cannot be written only costs time next time.
pub fn cached_harmonics(mesh: &Mesh, k: usize, cache: &Cache) -> Result<Harmonics, HarmonicsError> {
    let points: Vec<f32> = mesh.rest_positions().iter().flat_map(|p| p.to_array()).collect();
    let key = Key::new("harmonics").with(&points);
    let key = key.with_words(mesh.triangles().as_flattened()).with_words(&[k as u32]);
    let n = mesh.vertex_count();
    if let Some(numbers) = cache.load(&key).filter(|found| found.len() == k + n + n * k) {
        let (eigenvalues, rest) = numbers.split_at(k);
        let (weights, functions) = rest.split_at(n);
        return Ok(Harmonics {
            count: n,
            eigenvalues: eigenvalues.iter().map(|v| f64::from(*v)).collect(),
            functions: functions.to_vec(),
            weights: weights.to_vec(),
        });
    }
    let found = harmonics(mesh, k)?;
    let mut numbers: Vec<f32> = found.eigenvalues.iter().map(|v| *v as f32).collect();
    numbers.extend(&found.weights);
    numbers.extend(&found.functions);
    if let Err(error) = cache.keep(&key, &numbers) {
        tracing::warn!("harmonics are not kept: {error}");
    }
    Ok(found)
}

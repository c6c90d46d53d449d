//! Harmonics of a mesh: the smoothest functions on it.
//!
//! `C phi = lambda V phi`, with cotangent weights C (Pinkall and Polthier 1993) and mixed Voronoi
//! areas V (Meyer et al. 2003); Kavan et al. 2011, sections 3.2 and 4, use the symmetrised form, in
//! which constants are no harmonic unless all areas are equal. The lowest k come from a block Lanczos
//! process with full reorthogonalisation on the shifted inverse, factored by faer's sparse
//! Cholesky.

use cloth::Mesh;
use faer::linalg::solvers::Solve;
use faer::sparse::linalg::solvers::Llt;
use faer::sparse::{SparseColMat, Triplet};
use faer::{Mat, MatRef, Side};

/// Columns of a Lanczos block.
const BLOCK: usize = 16;
/// Pairs have converged when the residual of the inverted problem is below this share.
const TOLERANCE: f64 = 1e-7;

/// The lowest harmonics of a mesh.
#[derive(Debug, Clone)]
pub struct Harmonics {
    /// Vertices.
    pub count: usize,
    /// Eigenvalues (1/m^2), ascending; the first one is 0.
    pub eigenvalues: Vec<f64>,
    /// Vertex after vertex the values of all harmonics; orthonormal with `weights`.
    pub functions: Vec<f32>,
    /// Mixed Voronoi areas over their mean.
    pub weights: Vec<f32>,
}

/// Why no harmonics came out.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum HarmonicsError {
    /// More asked for than a mesh of this size can give.
    #[error("{asked} harmonics of {vertices} vertices; at most half as many can be found")]
    TooMany {
        /// How many were asked for.
        asked: usize,
        /// Vertices of the mesh.
        vertices: usize,
    },
    /// The factorisation or an eigenvalue iteration failed.
    #[error("the mesh's Laplacian could not be {0}; is it degenerate?")]
    Numerical(&'static str),
}

/// The two matrices of the problem.
#[derive(Debug, Clone)]
pub struct Laplacian {
    /// Mixed Voronoi areas (m^2).
    pub areas: Vec<f64>,
    /// Entries of C, the diagonal included; each pair of vertices once (lower triangle).
    pub entries: Vec<(usize, usize, f64)>,
}

impl Laplacian {
    /// Of a mesh in its rest shape.
    pub fn new(mesh: &Mesh) -> Self {
        let p: Vec<[f64; 3]> =
            mesh.rest_positions().iter().map(|p| p.to_array().map(f64::from)).collect();
        let count = p.len();
        let mut areas = vec![0.0; count];
        let mut diagonal = vec![0.0; count];
        let mut pairs = std::collections::BTreeMap::<(usize, usize), f64>::new();
        for t in mesh.triangles() {
            let t = t.map(|v| v as usize);
            let double = norm(cross(sub(p[t[1]], p[t[0]]), sub(p[t[2]], p[t[0]])));
            let dots: [f64; 3] = std::array::from_fn(|k| {
                let (a, b, c) = (p[t[k]], p[t[(k + 1) % 3]], p[t[(k + 2) % 3]]);
                dot(sub(b, a), sub(c, a))
            });
            let obtuse = dots.iter().position(|d| *d < 0.0);
            for k in 0..3 {
                // The cotangent at k belongs to the side opposite to it.
                let cot = dots[k] / double;
                let (a, b) = (t[(k + 1) % 3], t[(k + 2) % 3]);
                *pairs.entry((a.max(b), a.min(b))).or_default() -= 0.5 * cot;
                diagonal[a] += 0.5 * cot;
                diagonal[b] += 0.5 * cot;
                if obtuse.is_none() {
                    let d = sub(p[a], p[b]);
                    areas[a] += cot * dot(d, d) / 8.0;
                    areas[b] += cot * dot(d, d) / 8.0;
                }
            }
            if let Some(blunt) = obtuse {
                for k in 0..3 {
                    areas[t[k]] += double / if k == blunt { 4.0 } else { 8.0 };
                }
            }
        }
        let mut entries: Vec<(usize, usize, f64)> =
            pairs.into_iter().map(|((a, b), value)| (a, b, value)).collect();
        entries.extend(diagonal.into_iter().enumerate().map(|(i, value)| (i, i, value)));
        Self { areas, entries }
    }

    /// `C x`.
    pub fn apply(&self, x: &[f64]) -> Vec<f64> {
        let mut out = vec![0.0; x.len()];
        for (a, b, value) in &self.entries {
            out[*a] += value * x[*b];
            if a != b {
                out[*b] += value * x[*a];
            }
        }
        out
    }

    /// The lowest `k` pairs of V^-1/2 C V^-1/2 without iterating over subspaces: where these would be
    /// nearly the whole space.
    fn dense(&self, roots: &[f64], k: usize) -> Result<Pairs, HarmonicsError> {
        let n = roots.len();
        let mut matrix = Mat::<f64>::zeros(n, n);
        for (a, b, value) in &self.entries {
            matrix[(*a, *b)] = value / (roots[*a] * roots[*b]);
        }
        let eigen = matrix
            .self_adjoint_eigen(Side::Lower)
            .map_err(|_| HarmonicsError::Numerical("solved for its eigenvalues"))?;
        let values = (0..k).map(|j| eigen.S()[j].max(0.0)).collect();
        Ok((values, eigen.U().subcols(0, k).to_owned()))
    }

    /// Cholesky factors of `C + shift V`.
    fn factored(&self, shift: f64) -> Result<Llt<usize, f64>, HarmonicsError> {
        let n = self.areas.len();
        let shifted = |(a, b, value): &(usize, usize, f64)| {
            let more = if a == b { shift * self.areas[*a] } else { 0.0 };
            Triplet::new(*a, *b, value + more)
        };
        let triplets: Vec<_> = self.entries.iter().map(shifted).collect();
        let matrix = SparseColMat::try_new_from_triplets(n, n, &triplets)
            .map_err(|_| HarmonicsError::Numerical("assembled"))?;
        matrix.sp_cholesky(Side::Lower).map_err(|_| HarmonicsError::Numerical("factored"))
    }
}

/// The lowest `k` harmonics of a mesh.
///
/// # Errors
/// More than half as many as vertices, or numerical failure.
pub fn harmonics(mesh: &Mesh, k: usize) -> Result<Harmonics, HarmonicsError> {
    let laplacian = Laplacian::new(mesh);
    let n = laplacian.areas.len();
    if k == 0 || 2 * k > n {
        return Err(HarmonicsError::TooMany { asked: k, vertices: n });
    }
    let area: f64 = laplacian.areas.iter().sum();
    // Well below the first eigenvalue that is not 0, of the order of 10 / area.
    let shift = 1.0 / area;
    let roots: Vec<f64> = laplacian.areas.iter().map(|a| a.sqrt()).collect();
    let (eigenvalues, vectors) = if 4 * k + 8 * BLOCK >= n {
        laplacian.dense(&roots, k)?
    } else {
        let process = Lanczos { factor: laplacian.factored(shift)?, roots };
        let (inverses, vectors) = process.lowest(k)?;
        (inverses.iter().map(|i| (1.0 / i - shift).max(0.0)).collect(), vectors)
    };
    let mean = area / n as f64;
    let mut functions = vec![0.0; n * k];
    for j in 0..k {
        let column: Vec<f64> =
            (0..n).map(|i| vectors[(i, j)] * (mean / laplacian.areas[i]).sqrt()).collect();
        // The sign is free: the largest value is positive, so that it does not depend on rounding.
        let most = column.iter().fold(0.0f64, |m, v| if v.abs() > m.abs() { *v } else { m });
        for (i, value) in column.iter().enumerate() {
            functions[i * k + j] = (value * most.signum()) as f32;
        }
    }
    let weights = laplacian.areas.iter().map(|a| (a / mean) as f32).collect();
    Ok(Harmonics { count: n, eigenvalues, functions, weights })
}

/// Block Lanczos on `V^1/2 (C + shift V)^-1 V^1/2`, whose largest eigenvalues are wanted.
struct Lanczos {
    factor: Llt<usize, f64>,
    roots: Vec<f64>,
}

impl Lanczos {
    fn apply(&self, x: MatRef<'_, f64>) -> Mat<f64> {
        let mut out = Mat::from_fn(x.nrows(), x.ncols(), |i, j| x[(i, j)] * self.roots[i]);
        self.factor.solve_in_place(out.as_mut());
        Mat::from_fn(x.nrows(), x.ncols(), |i, j| out[(i, j)] * self.roots[i])
    }

    /// The `k` largest eigenvalues, falling, with their vectors.
    fn lowest(&self, k: usize) -> Result<Pairs, HarmonicsError> {
        let n = self.roots.len();
        let most = (4 * k + 8 * BLOCK).min(n / BLOCK * BLOCK);
        let mut basis = Mat::<f64>::zeros(n, most + BLOCK);
        let mut projected = Mat::<f64>::zeros(most + BLOCK, most + BLOCK);
        let mut chance = cloth::lab::shapes::Chance::new(2011);
        let first = Mat::from_fn(n, BLOCK, |_, _| f64::from(chance.signed()));
        basis.subcols_mut(0, BLOCK).copy_from(first.qr().compute_thin_Q());
        let mut size = 0;
        let mut check = (k + k / 2 + 2 * BLOCK).div_ceil(BLOCK) * BLOCK;
        while size < most {
            let mut next = self.apply(basis.subcols(size, BLOCK));
            size += BLOCK;
            // Twice is enough (Giraud et al. 2005).
            for _ in 0..2 {
                let known = basis.subcols(0, size);
                let inside = known.transpose() * &next;
                next -= known * &inside;
                let mut sums = projected.submatrix_mut(0, size - BLOCK, size, BLOCK);
                sums += inside;
            }
            let qr = next.qr();
            basis.subcols_mut(size, BLOCK).copy_from(qr.compute_thin_Q());
            if size >= check.min(most) {
                check = size + (k / 4).div_ceil(BLOCK) * BLOCK;
                let found = ritz(projected.submatrix(0, 0, size, size), qr.thin_R(), k)?;
                if let Some((values, vectors)) = found {
                    return Ok((values, basis.subcols(0, size) * vectors));
                }
            }
        }
        Err(HarmonicsError::Numerical("solved for its eigenvalues"))
    }
}

/// Eigenvalues, and their vectors as columns.
type Pairs = (Vec<f64>, Mat<f64>);

/// The largest `k` pairs of the projected problem, if all have converged; `rest` couples its last
/// block with what comes next.
fn ritz(
    projected: MatRef<'_, f64>,
    rest: MatRef<'_, f64>,
    k: usize,
) -> Result<Option<Pairs>, HarmonicsError> {
    let m = projected.nrows();
    // Columns hold what lies above the diagonal; below it is the same.
    let whole = |i: usize, j: usize| projected[(i.min(j), i.max(j))];
    let eigen = Mat::from_fn(m, m, whole)
        .self_adjoint_eigen(Side::Lower)
        .map_err(|_| HarmonicsError::Numerical("solved for its eigenvalues"))?;
    let value = |j: usize| eigen.S()[m - 1 - j];
    let vectors = Mat::from_fn(m, k, |i, j| eigen.U()[(i, m - 1 - j)]);
    let residuals = rest * vectors.subrows(m - BLOCK, BLOCK);
    let converged = (0..k).all(|j| residuals.col(j).norm_l2() <= TOLERANCE * value(j));
    Ok(converged.then(|| ((0..k).map(value).collect(), vectors)))
}

fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|k| a[k] - b[k])
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|k| a[k] * b[k]).sum()
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|k| a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3])
}

fn norm(a: [f64; 3]) -> f64 {
    dot(a, a).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::upsample::patch::Patch;
    use cloth::Vec3;

    fn rectangle() -> Mesh {
        let at = |u: f32, v: f32| Vec3::new(1.5 * u, -v, 0.0);
        Patch::new([48, 32], false, at, |_, _| false).unwrap().mesh
    }

    #[test]
    fn eigenvalues_of_a_rectangle_are_the_analytic_ones() {
        let found = harmonics(&rectangle(), 40).unwrap();
        let pi = std::f64::consts::PI;
        let mut exact: Vec<f64> = (0..12)
            .flat_map(|i| {
                (0..12)
                    .map(move |j| (pi * f64::from(i) / 1.5).powi(2) + (pi * f64::from(j)).powi(2))
            })
            .collect();
        exact.sort_by(f64::total_cmp);
        assert!(found.eigenvalues[0] < 1e-6);
        for (found, exact) in found.eigenvalues.iter().zip(&exact).skip(1) {
            assert!((found / exact - 1.0).abs() < 0.02, "{found} should be {exact}");
        }
    }

    #[test]
    fn harmonics_are_orthonormal_solve_the_problem_and_begin_with_the_constants() {
        let mesh = rectangle();
        let (k, found) = (60, harmonics(&mesh, 60).unwrap());
        let n = found.count;
        let column = |j: usize| (0..n).map(move |i| i * k + j);
        let values =
            |j: usize| -> Vec<f64> { column(j).map(|at| f64::from(found.functions[at])).collect() };
        for j in 0..k {
            for other in 0..=j {
                let (a, b) = (values(j), values(other));
                let sum: f64 = a
                    .iter()
                    .zip(&b)
                    .zip(&found.weights)
                    .map(|((a, b), w)| a * b * f64::from(*w))
                    .sum();
                let wanted = f64::from(u8::from(j == other));
                assert!((sum - wanted).abs() < 1e-5, "{j} {other}: {sum}");
            }
        }
        let first = values(0);
        let even = 1.0 / (n as f64).sqrt();
        assert!(first.iter().all(|v| (v - even).abs() < 1e-6 * even.max(1.0)));
        let laplacian = Laplacian::new(&mesh);
        for j in [1, 17, 59] {
            let phi = values(j);
            let left = laplacian.apply(&phi);
            let right: Vec<f64> = phi
                .iter()
                .zip(&laplacian.areas)
                .map(|(p, a)| p * a * found.eigenvalues[j])
                .collect();
            let size: f64 = right.iter().map(|r| r * r).sum::<f64>().sqrt();
            let off: f64 =
                left.iter().zip(&right).map(|(l, r)| (l - r).powi(2)).sum::<f64>().sqrt();
            assert!(off < 1e-3 * size, "harmonic {j}: residual {off} of {size}");
        }
    }

    #[test]
    fn areas_are_those_of_the_mesh_and_too_many_are_refused() {
        let mesh = rectangle();
        let area: f64 = Laplacian::new(&mesh).areas.iter().sum();
        assert!((area - 1.5).abs() < 1e-5, "{area}");
        let error = harmonics(&mesh, 1000).unwrap_err();
        assert_eq!(error, HarmonicsError::TooMany { asked: 1000, vertices: 49 * 33 });
    }
}

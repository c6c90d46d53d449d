//! Beyond the paper: a prior, compact support, history, operators blended by state.

use cloth::Mesh;
use faer::linalg::solvers::{Llt, Solve};
use faer::{Mat, MatRef, Side};

use super::data::{Frames, narrow, wide};
use super::fit::{FitError, Profile, Training};
use super::harmonics::Harmonics;

/// Coarse points that a row of a sparse operator may use.
pub const SUPPORT: usize = 24;
/// Iterations of k-means.
const ROUNDS: usize = 30;

/// An operator that is a smooth correction of `prior`: what harmonic regularisation pulls towards is
/// not the mean of all coarse points, but what `prior` gives.
///
/// # Errors
/// No convergence.
pub fn corrected(
    frames: &Frames,
    prior: MatRef<'_, f32>,
    harmonics: &Harmonics,
    k: usize,
    profile: &Profile,
) -> Result<Mat<f32>, FitError> {
    let rest = frames.without(prior);
    let correction = Training::new(&rest, harmonics, k)?.of_rest().harmonic(profile);
    let m = prior.ncols();
    Ok(Mat::from_fn(prior.nrows(), correction.ncols(), |i, j| {
        correction[(i, j)] + if j < m { prior[(i, j)] } else { 0.0 }
    }))
}

/// For each fine vertex the [`SUPPORT`] coarse points nearest in the rest shape, ascending.
pub fn supports(coarse: &Mesh, fine: &Mesh) -> Vec<Vec<usize>> {
    let one = |p: &cloth::Vec3| {
        let far = |v: &usize| coarse.rest_positions()[*v].distance_squared(*p);
        let mut all: Vec<usize> = (0..coarse.vertex_count()).collect();
        all.sort_by(|a, b| far(a).total_cmp(&far(b)).then(a.cmp(b)));
        all.truncate(SUPPORT);
        all.sort_unstable();
        all
    };
    fine.rest_positions().iter().map(one).collect()
}

/// Rows of compact support, each by itself, pulled towards `prior` by `gamma`; sums stay those of the
/// prior's rows.
///
/// # Errors
/// A matrix that is not positive.
pub fn sparse(
    frames: &Frames,
    prior: MatRef<'_, f32>,
    supports: &[Vec<usize>],
    gamma: f64,
) -> Result<Mat<f32>, FitError> {
    let rest = frames.without(prior);
    let square = &frames.coarse * frames.coarse.transpose();
    let right = wide((&rest.fine * narrow(frames.coarse.as_ref()).transpose()).as_ref());
    let mut whole = prior.to_owned();
    for (i, support) in supports.iter().enumerate() {
        let n = support.len();
        let own = Mat::from_fn(n, n, |a, b| {
            square[(support[a], support[b])] + if a == b { gamma * gamma } else { 0.0 }
        });
        let factor: Llt<f64> = own.llt(Side::Lower).map_err(|_| FitError::Numerical)?;
        // Two right-hand sides: the second one carries the constraint that corrections sum to zero.
        let mut both = Mat::from_fn(n, 2, |a, c| if c == 0 { right[(i, support[a])] } else { 1.0 });
        factor.solve_in_place(both.as_mut());
        let sum = |c: usize| (0..n).map(|a| both[(a, c)]).sum::<f64>();
        let multiplier = sum(0) / sum(1);
        for (a, point) in support.iter().enumerate() {
            whole[(i, *point)] += (both[(a, 0)] - multiplier * both[(a, 1)]) as f32;
        }
    }
    Ok(whole)
}

/// Several operators, each for states like those it was learnt from.
#[derive(Debug, Clone)]
pub struct Blend {
    operators: Vec<Mat<f32>>,
    centres: Vec<Vec<f64>>,
    /// Distance at which a centre's weight has fallen to a half.
    width: f64,
}

/// What the state of a coarse cloth is told by, wherever it is and however it is turned: squared
/// lengths of its edges over those at rest.
fn features(coarse: &Mesh, frames: &Frames) -> Vec<Vec<f64>> {
    let edges = coarse.edges().iter().zip(coarse.rest_lengths());
    let edges: Vec<([usize; 2], f64)> =
        edges.map(|(e, l)| (e.map(|v| v as usize), f64::from(*l))).collect();
    let one = |frame: usize| {
        let length2 = |e: &([usize; 2], f64)| {
            let way = |axis: usize| {
                let c = 3 * frame + axis;
                frames.coarse[(e.0[0], c)] - frames.coarse[(e.0[1], c)]
            };
            (0..3).map(|axis| way(axis).powi(2)).sum::<f64>() / (e.1 * e.1)
        };
        edges.iter().map(length2).collect()
    };
    (0..frames.count()).map(one).collect()
}

fn apart(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum()
}

impl Blend {
    /// Learns `count` operators of `frames`: each frame counts for each operator by how near it is to
    /// its centre (k-means), and each operator is a correction of `prior`.
    ///
    /// # Errors
    /// No convergence.
    pub fn learn(
        frames: &Frames,
        coarse: &Mesh,
        (prior, count): (MatRef<'_, f32>, usize),
        (harmonics, k): (&Harmonics, usize),
        profile: &Profile,
    ) -> Result<Self, FitError> {
        let features = features(coarse, frames);
        let centres = centres(&features, count);
        let mean = |f: &Vec<f64>| centres.iter().map(|c| apart(f, c)).fold(f64::INFINITY, f64::min);
        let width = features.iter().map(mean).sum::<f64>() / features.len() as f64;
        let mut blend = Self { operators: Vec::new(), centres, width };
        for of in 0..count {
            let mut part = frames.clone();
            for (frame, feature) in features.iter().enumerate() {
                // The share is of the squared error.
                let root = blend.shares(feature)[of].sqrt();
                for axis in 0..3 {
                    let c = 3 * frame + axis;
                    part.coarse.col_mut(c).iter_mut().for_each(|x| *x *= root);
                    part.fine.col_mut(c).iter_mut().for_each(|x| *x *= root as f32);
                }
            }
            blend.operators.push(corrected(&part, prior, harmonics, k, profile)?);
        }
        Ok(blend)
    }

    /// The operators.
    pub fn operators(&self) -> &[Mat<f32>] {
        &self.operators
    }

    fn shares(&self, feature: &[f64]) -> Vec<f64> {
        let far: Vec<f64> = self.centres.iter().map(|c| apart(feature, c)).collect();
        let least = far.iter().copied().fold(f64::INFINITY, f64::min);
        let near: Vec<f64> =
            far.iter().map(|d| 0.5f64.powf((d - least) / self.width.max(1e-12))).collect();
        let sum: f64 = near.iter().sum();
        near.iter().map(|n| n / sum).collect()
    }

    /// Fine positions of all frames.
    pub fn apply(&self, coarse: &Mesh, frames: &Frames) -> Mat<f32> {
        let positions = narrow(frames.coarse.as_ref());
        let shares: Vec<Vec<f64>> =
            features(coarse, frames).iter().map(|f| self.shares(f)).collect();
        let mut out = Mat::zeros(frames.fine.nrows(), frames.fine.ncols());
        for (of, operator) in self.operators.iter().enumerate() {
            let scaled = Mat::from_fn(positions.nrows(), positions.ncols(), |i, c| {
                positions[(i, c)] * shares[c / 3][of] as f32
            });
            out += operator * scaled;
        }
        out
    }
}

fn centres_of_all(features: &[Vec<f64>]) -> Vec<f64> {
    let mut sum = vec![0.0; features.first().map_or(0, Vec::len)];
    features.iter().for_each(|f| sum.iter_mut().zip(f).for_each(|(s, x)| *s += x));
    sum.iter().map(|s| s / features.len().max(1) as f64).collect()
}

/// k-means, begun from frames that are far from each other.
fn centres(features: &[Vec<f64>], count: usize) -> Vec<Vec<f64>> {
    let mut centres = vec![features[0].clone()];
    while centres.len() < count {
        let far = |f: &Vec<f64>| centres.iter().map(|c| apart(f, c)).fold(f64::INFINITY, f64::min);
        let next = features.iter().max_by(|a, b| far(a).total_cmp(&far(b)));
        centres.extend(next.cloned());
    }
    for _ in 0..ROUNDS {
        let nearest = |f: &Vec<f64>| {
            let less =
                |a: &usize, b: &usize| apart(f, &centres[*a]).total_cmp(&apart(f, &centres[*b]));
            (0..count).min_by(less).unwrap_or(0)
        };
        let groups: Vec<usize> = features.iter().map(nearest).collect();
        for (of, centre) in centres.iter_mut().enumerate() {
            let own = features.iter().zip(&groups).filter(|(_, g)| **g == of);
            let own: Vec<Vec<f64>> = own.map(|(f, _)| f.clone()).collect();
            if !own.is_empty() {
                *centre = centres_of_all(&own);
            }
        }
    }
    centres
}

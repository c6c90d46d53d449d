//! Oscillatory modes: travelling waves that the coarse points do not explain (Kavan et al. 2011,
//! section 5).

use cloth::Vec3;
use faer::{Mat, MatRef};

/// Modes, at most.
const MODES_MAX: usize = 4;
/// A pair that explains less of what is left is not worth its bytes.
const WORTH: f64 = 0.02;
/// Shortest period looked for (frames).
const PERIOD_MIN: usize = 4;

/// A pair of modes: displacement along the normal of vertex i in frame j is
/// `e[i][0] sin(j theta) + e[i][1] cos(j theta)`.
#[derive(Debug, Clone, PartialEq)]
pub struct Mode {
    /// Angle between two frames (rad).
    pub theta: f64,
    /// Amplitudes of each vertex (m).
    pub amplitudes: Vec<[f32; 2]>,
    /// Share of what was left that it explains.
    pub explained: f64,
}

/// Vertex normals of a frame, column after column x, y, z.
pub fn normals(positions: MatRef<'_, f32>, triangles: &[[u32; 3]]) -> Vec<Vec3> {
    let n = positions.nrows();
    let at = |i: u32| {
        let i = i as usize;
        Vec3::new(positions[(i, 0)], positions[(i, 1)], positions[(i, 2)])
    };
    let mut sums = vec![Vec3::ZERO; n];
    for t in triangles {
        let [a, b, c] = t.map(at);
        let normal = (b - a).cross(c - a);
        t.iter().for_each(|v| sums[*v as usize] += normal);
    }
    sums.into_iter().map(Vec3::normalize_or_zero).collect()
}

/// Residuals of each frame along the normals of what the operator gives (m): one column a frame.
pub fn along_normals(
    upsampled: MatRef<'_, f32>,
    fine: MatRef<'_, f32>,
    triangles: &[[u32; 3]],
) -> Mat<f64> {
    let frames = fine.ncols() / 3;
    let mut out = Mat::zeros(fine.nrows(), frames);
    for frame in 0..frames {
        let now = upsampled.subcols(3 * frame, 3);
        for (i, normal) in normals(now, triangles).iter().enumerate() {
            let off = |axis: usize| fine[(i, 3 * frame + axis)] - now[(i, axis)];
            out[(i, frame)] = f64::from(Vec3::new(off(0), off(1), off(2)).dot(*normal));
        }
    }
    out
}

/// Pairs of modes of `residuals`, until the next one is not worth it.
pub fn modes(mut residuals: Mat<f64>) -> Vec<Mode> {
    let mut found = Vec::new();
    while found.len() < MODES_MAX {
        let Some(mode) = strongest(&residuals) else { break };
        if mode.explained < WORTH {
            break;
        }
        for j in 0..residuals.ncols() {
            let (s, c) = (mode.theta * j as f64).sin_cos();
            for (i, e) in mode.amplitudes.iter().enumerate() {
                residuals[(i, j)] -= f64::from(e[0]) * s + f64::from(e[1]) * c;
            }
        }
        found.push(mode);
    }
    found
}

/// The strongest periodic part: its frequency by autocorrelation, made exact by how much a sine and
/// a cosine of nearby frequencies explain; its amplitudes by regression.
fn strongest(residuals: &Mat<f64>) -> Option<Mode> {
    let frames = residuals.ncols();
    let gram = residuals.transpose() * residuals;
    let energy: f64 = (0..frames).map(|j| gram[(j, j)]).sum();
    if frames < 4 * PERIOD_MIN || energy <= 0.0 {
        return None;
    }
    let lag = |lag: usize| {
        let sum: f64 = (0..frames - lag).map(|j| gram[(j, j + lag)]).sum();
        sum / (frames - lag) as f64
    };
    let correlation: Vec<f64> = (0..frames / 2).map(lag).collect();
    let peak = |l: &usize| {
        correlation[*l] >= correlation[*l - 1] && correlation[*l] >= correlation[*l + 1]
    };
    let peaks = (PERIOD_MIN..correlation.len() - 1).filter(peak);
    let better = |a: &usize, b: &usize| correlation[*a].total_cmp(&correlation[*b]).then(b.cmp(a));
    let period = peaks.max_by(better)?;
    let centre = std::f64::consts::TAU / period as f64;
    // Power at an angle: how much of the energy the pair of that angle explains.
    let power = |theta: f64| {
        let (sines, cosines) = waves(theta, frames);
        let along = |a: &[f64], b: &[f64]| -> f64 {
            (0..frames).map(|j| a[j] * (0..frames).map(|k| gram[(j, k)] * b[k]).sum::<f64>()).sum()
        };
        along(&sines, &sines) + along(&cosines, &cosines)
    };
    let mut theta = centre;
    for width in [0.012, 0.0012] {
        let angles = (-12..=12).map(|i| theta + centre * width * f64::from(i));
        theta = angles.map(|t| (power(t), t)).max_by(|a, b| a.0.total_cmp(&b.0))?.1;
    }
    let (sines, cosines) = waves(theta, frames);
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let (ss, sc, cc) = (dot(&sines, &sines), dot(&sines, &cosines), dot(&cosines, &cosines));
    let determinant = ss * cc - sc * sc;
    if determinant <= 1e-9 {
        return None;
    }
    let mut explained = 0.0;
    let mut amplitudes = Vec::with_capacity(residuals.nrows());
    for i in 0..residuals.nrows() {
        let row: Vec<f64> = (0..frames).map(|j| residuals[(i, j)]).collect();
        let (s, c) = (dot(&row, &sines), dot(&row, &cosines));
        let e = [(s * cc - c * sc) / determinant, (c * ss - s * sc) / determinant];
        explained += e[0] * s + e[1] * c;
        amplitudes.push(e.map(|e| e as f32));
    }
    Some(Mode { theta, amplitudes, explained: explained / energy })
}

fn waves(theta: f64, frames: usize) -> (Vec<f64>, Vec<f64>) {
    (0..frames).map(|j| (theta * j as f64).sin_cos()).unzip()
}

/// `upsampled` with the modes added along its normals.
pub fn with_modes(upsampled: &Mat<f32>, modes: &[Mode], triangles: &[[u32; 3]]) -> Mat<f32> {
    let mut out = upsampled.clone();
    for frame in 0..upsampled.ncols() / 3 {
        let normals = normals(upsampled.subcols(3 * frame, 3), triangles);
        for mode in modes {
            let (s, c) = (mode.theta * frame as f64).sin_cos();
            for (i, (e, normal)) in mode.amplitudes.iter().zip(&normals).enumerate() {
                let way = *normal * (e[0] * s as f32 + e[1] * c as f32);
                (0..3).for_each(|axis| out[(i, 3 * frame + axis)] += way[axis]);
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_planted_wave_is_found_and_taken_out() {
        let theta = 0.37;
        let wave = |i: usize, j: usize| 0.01 * (theta * j as f64 + 0.3 * i as f64).sin();
        let mut chance = cloth::lab::shapes::Chance::new(9);
        let mut noise = || 1e-3 * f64::from(chance.signed());
        let found = modes(Mat::from_fn(40, 200, |i, j| wave(i, j) + noise()));
        assert_eq!(found.len(), 1, "one wave, one pair of modes");
        assert!((found[0].theta - theta).abs() < 0.01, "{}", found[0].theta);
        assert!(found[0].explained > 0.95);
        let e = found[0].amplitudes[3];
        assert!((e[0].hypot(e[1]) - 0.01).abs() < 1e-3);
    }

    #[test]
    fn noise_has_no_modes() {
        let mut chance = cloth::lab::shapes::Chance::new(5);
        let noise = Mat::from_fn(60, 120, |_, _| f64::from(chance.signed()));
        assert!(modes(noise).len() <= 1);
        assert!(modes(Mat::zeros(4, 100)).is_empty());
    }
}

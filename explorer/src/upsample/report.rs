//! `toile upsample report`: every method on every motion of a scene, and what they cost.

use faer::{Mat, MatRef};
use serde::Serialize;

use super::beyond::{self, Blend};
use super::data::{Frames, narrow};
use super::fair::SecondHalf;
use super::fit::{Profile, Training};
use super::judge::{Errors, Judge};
use super::learn::{LearnError, Lesson};
use super::mirror::Mirror;
use super::modes::{Mode, with_modes};
use super::patch;
use super::stored::Rounding;
use crate::cpu::CpuClock;

/// Ways of going beyond the paper.
const BEYOND: [&str; 6] =
    ["harmonic-lift", "harmonic-mirrored", "sparse", "sparse-mirrored", "history", "blended"];

/// What a scene came to.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    /// Name of the scene.
    pub scene: &'static str,
    /// Coarse points.
    pub m: usize,
    /// Fine points.
    pub n: usize,
    /// Training frames.
    pub f: usize,
    /// Test functions of the tracking constraint.
    pub t: usize,
    /// Harmonics that the fit uses.
    pub k: usize,
    /// Processor time to compute them (s).
    pub harmonics_s: f64,
    /// Processor time to learn the harmonic operator from frames in memory (s).
    pub learn_s: f64,
    /// Processor time to learn it again after a change of the profile (s).
    pub refit_s: f64,
    /// Bits of a weight of U as a client holds it.
    pub bits: u8,
    /// Time of U p with U in cache, as a client holds it (us, median).
    pub apply_hot_us: f64,
    /// Time of U p with U in memory (us, median).
    pub apply_cold_us: f64,
    /// Time of a coarse step of the training motion (us, median).
    pub coarse_step_us: f64,
    /// U as a client holds it (bytes).
    pub memory_bytes: usize,
    /// Largest residual of the tracking constraint in all motions (mm).
    pub tracking_residual_mm: f64,
    /// Parameters, tuned on the training motion.
    pub parameters: Parameters,
    /// Largest distance of a row's sum from 1.
    pub partition_of_unity: f64,
    /// Pairs of oscillatory modes: frequency (Hz) and share explained.
    pub modes: Vec<[f64; 2]>,
    /// What rounding of U costs.
    pub rounding: Vec<Rounding>,
    /// Training motion first.
    pub motions: Vec<MotionReport>,
    /// The harmonic operator against one learnt again on the other motions, and operators blended.
    pub retraining: Vec<Retraining>,
}

/// Parameters of the methods.
#[derive(Debug, Clone, Serialize)]
pub struct Parameters {
    /// alpha of Tikhonov's.
    pub tikhonov: f64,
    /// alpha of the Laplacian's (m^2).
    pub laplacian: f64,
    /// gamma_1, gamma_N and c.
    pub harmonic: [f64; 3],
    /// The same of the correction of the barycentric lift.
    pub harmonic_lift: [f64; 3],
    /// gamma of the sparse operator.
    pub sparse: f64,
    /// gamma_1, gamma_N and c of the one that learns from mirrored frames as well, tuned with them.
    pub harmonic_mirrored: Option<[f64; 3]>,
    /// gamma of the one that learns from mirrored frames as well; `None` where the cloth has no mirror.
    pub sparse_mirrored: Option<f64>,
    /// Whether that one does better on the end of the training motion, which neither has learnt from.
    pub mirror_chosen: bool,
}

/// Errors on one motion.
#[derive(Debug, Clone, Serialize)]
pub struct MotionReport {
    /// Its name.
    pub motion: &'static str,
    /// Whether operators were learnt from it.
    pub training: bool,
    /// Frames.
    pub frames: usize,
    /// One a method.
    pub methods: Vec<MethodReport>,
}

/// Errors of one method.
#[derive(Debug, Clone, Serialize)]
pub struct MethodReport {
    /// Its name.
    pub name: &'static str,
    /// Time to upsample a frame (us, median, weights in cache).
    pub apply_us: f64,
    /// Against the fine simulation that was tracked by the same coarse run.
    #[serde(flatten)]
    pub errors: Errors,
}

/// A motion that the operator was not learnt from, against an operator that was learnt from it (Kavan
/// et al. 2011, Figure 10).
#[derive(Debug, Clone, Serialize)]
pub struct Retraining {
    /// The motion.
    pub motion: &'static str,
    /// Root mean square error of the harmonic operator as it is (mm).
    pub harmonic_rms_mm: f64,
    /// Of one learnt from this motion with the same profile, on the frames that it was learnt from (mm).
    pub retrained_rms_mm: f64,
    /// Both learnt from other frames than they are judged on.
    pub second_half: SecondHalf,
    /// For each way of going beyond the paper, learnt from the training motion alone, the share of
    /// the gap between both that it closes; over 1 where it is better than learning again.
    pub gap_closed: Vec<Closed>,
}

/// How much of a gap a method closes.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Closed {
    /// The method.
    pub name: &'static str,
    /// Share of the gap.
    pub share: f64,
}

/// What turns coarse positions into fine ones.
pub enum Method {
    /// A matrix.
    Linear(Mat<f32>),
    /// A matrix over positions and their changes.
    History(Mat<f32>),
    /// A matrix, then modes along the normals.
    Modes(Mat<f32>, Vec<Mode>),
    /// Matrices blended by state.
    Blended(Blend),
}

/// What was learnt with a mirror.
struct Mirrored {
    harmonic: Mat<f32>,
    sparse: Mat<f32>,
    gamma: f64,
    profile: Profile,
    /// Sum of squares of the sparse one on the end of the training motion (m^2).
    held_out: f64,
}

/// All methods of a scene.
pub struct Methods {
    /// By name.
    pub all: Vec<(&'static str, Method)>,
    /// Their parameters.
    pub parameters: Parameters,
    /// Processor time to learn the harmonic operator, and to learn it again with another profile (s).
    pub seconds: [f64; 2],
}

impl Lesson {
    /// Fine positions that a method gives for frames.
    pub fn upsample(&self, method: &Method, frames: &Frames) -> Mat<f32> {
        let positions = || narrow(frames.coarse.as_ref());
        match method {
            Method::Linear(operator) => operator * positions(),
            Method::History(operator) => operator * narrow(frames.with_history().coarse.as_ref()),
            Method::Modes(operator, modes) => {
                let triangles = self.scene.fine.mesh.triangles();
                with_modes(&(operator * positions()), modes, triangles)
            }
            Method::Blended(blend) => blend.apply(&self.scene.coarse.mesh, frames),
        }
    }

    /// All methods, learnt from the training motion alone.
    ///
    /// # Errors
    /// A fit without a solution.
    pub fn methods(&self) -> Result<Methods, LearnError> {
        let frames = self.training();
        let (harmonics, k) = (&self.harmonics, self.k);
        let table = self.table(frames)?;
        let (alpha, stiff) = (table.tikhonov(), table.laplacian(harmonics));
        let profile = table.profile();
        let clock = CpuClock::start();
        let training = Training::new(frames, harmonics, k)?;
        let learnt = clock.elapsed_s();
        let clock = CpuClock::start();
        let harmonic = training.harmonic(&profile);
        let refit = clock.elapsed_s();
        let prior = self.barycentric();
        let rest = frames.without(prior.as_ref());
        let lift_profile = self.table(&rest)?.profile();
        let corrected = beyond::corrected(frames, prior.as_ref(), harmonics, k, &lift_profile)?;
        let history =
            beyond::corrected(&frames.with_history(), prior.as_ref(), harmonics, k, &lift_profile)?;
        let (gamma, plain) = self.tune_sparse(prior.as_ref(), None)?;
        let sparse = beyond::sparse(frames, prior.as_ref(), &self.supports(), gamma)?;
        let both = (prior.as_ref(), 3);
        let blend =
            Blend::learn(frames, &self.scene.coarse.mesh, both, (harmonics, k), &lift_profile)?;
        let modes = self.modes(&harmonic);
        let mirrored = self.mirrored(prior.as_ref())?;
        let parameters = Parameters {
            tikhonov: alpha,
            laplacian: stiff,
            harmonic: [profile.first, profile.last, profile.exponent],
            harmonic_lift: [lift_profile.first, lift_profile.last, lift_profile.exponent],
            sparse: gamma,
            harmonic_mirrored: mirrored
                .as_ref()
                .map(|m| [m.profile.first, m.profile.last, m.profile.exponent]),
            sparse_mirrored: mirrored.as_ref().map(|m| m.gamma),
            mirror_chosen: mirrored.as_ref().is_some_and(|m| m.held_out < plain),
        };
        let mut methods = vec![
            ("barycentric", Method::Linear(prior)),
            ("loop", Method::Linear(self.subdivision())),
            ("none", Method::Linear(training.tikhonov(0.0)?)),
            ("tikhonov", Method::Linear(training.tikhonov(alpha)?)),
            ("laplacian", Method::Linear(training.laplacian(&self.laplacian(), stiff)?)),
            ("harmonic", Method::Linear(harmonic.clone())),
            ("harmonic-modes", Method::Modes(harmonic, modes)),
            ("harmonic-lift", Method::Linear(corrected)),
            ("sparse", Method::Linear(sparse)),
            ("history", Method::History(history)),
            ("blended", Method::Blended(blend)),
        ];
        if let Some(Mirrored { harmonic, sparse, .. }) = mirrored {
            methods.push(("harmonic-mirrored", Method::Linear(harmonic)));
            methods.push(("sparse-mirrored", Method::Linear(sparse)));
        }
        Ok(Methods { all: methods, parameters, seconds: [learnt + refit, refit] })
    }

    /// Operators that learn from mirrored frames as well, where the cloth has a mirror.
    fn mirrored(&self, prior: MatRef<'_, f32>) -> Result<Option<Mirrored>, LearnError> {
        let Some(mirror) = Mirror::of(&self.scene) else { return Ok(None) };
        let (gamma, held_out) = self.tune_sparse(prior, Some(&mirror))?;
        let both = mirror.both(self.training());
        let sparse = beyond::sparse(&both, prior, &self.supports(), gamma)?;
        let profile = self.table(&both)?.profile();
        let harmonic = Training::new(&both, &self.harmonics, self.k)?.harmonic(&profile);
        Ok(Some(Mirrored { harmonic, sparse, gamma, profile, held_out }))
    }

    /// The whole report.
    ///
    /// # Errors
    /// A fit without a solution, an operator that cannot be rounded.
    pub fn report(&self) -> Result<Report, LearnError> {
        let Methods { all: methods, parameters, seconds: [learn_s, refit_s] } = self.methods()?;
        let judge = Judge::new(&self.harmonics, self.scene.coarse.count());
        let linear = |name: &str| {
            methods.iter().find_map(|(n, m)| match m {
                Method::Linear(operator) if *n == name => Some(operator),
                _ => None,
            })
        };
        let harmonic = linear("harmonic").ok_or(LearnError::NoOperator)?;
        let modes = methods.iter().find_map(|(_, m)| match m {
            Method::Modes(_, modes) => Some(modes.as_slice()),
            _ => None,
        });
        let cost = self.cost(harmonic)?;
        let [first, last, exponent] = parameters.harmonic;
        let profile = Profile { first, last, exponent };
        let (motions, gamma) = (self.judge_all(&judge, &methods)?, parameters.sparse);
        let hertz = |m: &Mode| m.theta / std::f64::consts::TAU / f64::from(self.scene.frame_s);
        Ok(Report {
            scene: self.scene.name,
            m: self.scene.coarse.count(),
            n: self.scene.fine.count(),
            f: self.training().count(),
            t: self.scene.tests,
            k: self.k,
            harmonics_s: self.time_harmonics()?,
            learn_s,
            refit_s,
            bits: cost.bits,
            apply_hot_us: cost.hot_us,
            apply_cold_us: cost.cold_us,
            coarse_step_us: self.coarse_step_us,
            memory_bytes: cost.bytes,
            tracking_residual_mm: 1e3 * self.residual_m,
            parameters,
            partition_of_unity: unity(harmonic.as_ref()),
            modes: modes.unwrap_or_default().iter().map(|m| [hertz(m), m.explained]).collect(),
            rounding: self.rounding(harmonic)?,
            retraining: self.retraining(&judge, (&profile, gamma), &motions)?,
            motions,
        })
    }

    fn judge_all(
        &self,
        judge: &Judge,
        methods: &[(&'static str, Method)],
    ) -> Result<Vec<MotionReport>, LearnError> {
        let times: Result<Vec<f64>, LearnError> =
            methods.iter().map(|(_, method)| self.time(method)).collect();
        let times = times?;
        let one = |(at, frames): (usize, &Frames)| MotionReport {
            motion: self.scene.motions[at].name,
            training: at == 0,
            frames: frames.count(),
            methods: methods
                .iter()
                .zip(&times)
                .map(|((name, method), apply_us)| {
                    let upsampled = self.upsample(method, frames);
                    let errors = judge.judge(upsampled.as_ref(), frames.fine.as_ref());
                    MethodReport { name, apply_us: *apply_us, errors }
                })
                .collect(),
        };
        Ok(self.frames.iter().enumerate().map(one).collect())
    }

    /// What learning again from each of the other motions would bring, and who comes near it.
    fn retraining(
        &self,
        judge: &Judge,
        (profile, gamma): (&Profile, f64),
        motions: &[MotionReport],
    ) -> Result<Vec<Retraining>, LearnError> {
        let mut out = Vec::new();
        for (report, frames) in motions.iter().zip(&self.frames).skip(1) {
            let again = Training::new(frames, &self.harmonics, self.k)?.harmonic(profile);
            let upsampled = self.upsample(&Method::Linear(again), frames);
            let new = judge.judge(upsampled.as_ref(), frames.fine.as_ref()).rms_mm;
            let rms = |name: &str| {
                let found = report.methods.iter().find(|m| m.name == name);
                found.map_or(f64::NAN, |m| m.errors.rms_mm)
            };
            let old = rms("harmonic");
            let close = |name| Closed { name, share: (old - rms(name)) / (old - new) };
            let closed = BEYOND.map(close).into_iter().filter(|closed| closed.share.is_finite());
            out.push(Retraining {
                motion: report.motion,
                harmonic_rms_mm: old,
                retrained_rms_mm: new,
                second_half: self.second_half(judge, profile, gamma, frames)?,
                gap_closed: closed.collect(),
            });
        }
        Ok(out)
    }

    /// The barycentric lift as a matrix.
    pub fn barycentric(&self) -> Mat<f32> {
        let lift = self.scene.coarse.lift(&self.scene.fine);
        matrix(&patch::dense(&lift, self.scene.coarse.count()), self.scene.coarse.count())
    }
}

/// Row after row.
pub fn rows(operator: MatRef<'_, f32>) -> Vec<f32> {
    let (n, m) = (operator.nrows(), operator.ncols());
    (0..n * m).map(|at| operator[(at / m, at % m)]).collect()
}

/// From row after row of `m` numbers.
pub fn matrix(rows: &[f32], m: usize) -> Mat<f32> {
    Mat::from_fn(rows.len() / m, m, |i, j| rows[i * m + j])
}

/// Largest distance of a row's sum from 1.
fn unity(operator: MatRef<'_, f32>) -> f64 {
    let sum = |i: usize| (0..operator.ncols()).map(|j| f64::from(operator[(i, j)])).sum::<f64>();
    (0..operator.nrows()).map(|i| (sum(i) - 1.0).abs()).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::super::harmonics::harmonics;
    use super::super::patch::Patch;
    use super::super::scene::Scene;
    use super::*;
    use cloth::lab::shapes::Chance;
    use cloth::{Environment, Material, Vec3};

    fn sheet(cells: usize) -> Patch {
        let at = |u: f32, v: f32| Vec3::new(u, -v, 0.0);
        Patch::new([cells, cells], false, at, |_, j| j == 0).unwrap()
    }

    /// A sheet that moves by chance in both resolutions.
    fn frames(scene: &Scene, count: usize, seed: u32) -> Frames {
        let mut chance = Chance::new(seed.into());
        let points = scene.coarse.count();
        let mut coarse = Mat::from_fn(points, 3 * count, |_, _| f64::from(chance.signed()));
        for c in 0..3 * count {
            let mean = coarse.col(c).iter().sum::<f64>() / points as f64;
            coarse.col_mut(c).iter_mut().for_each(|x| *x -= mean);
        }
        let lift = matrix(&patch::dense(&scene.coarse.lift(&scene.fine), points), points);
        let noise = Mat::from_fn(scene.fine.count(), 3 * count, |_, _| 0.02 * chance.signed());
        let fine = lift * narrow(coarse.as_ref()) + noise;
        Frames { coarse, fine, points, middles: vec![0.0; 3 * count] }
    }

    #[test]
    fn what_is_learnt_and_tuned_never_sees_another_motion() {
        let scene = Scene {
            name: "flag",
            coarse: sheet(5),
            fine: sheet(12),
            tests: 8,
            material: Material::default(),
            coarse_material: Material::default(),
            environment: Environment::default(),
            settings: cloth::coarse::Settings::default(),
            frame_s: 1.0 / 60.0,
            motions: Vec::new(),
        };
        let harmonics = harmonics(&scene.fine.mesh, 40).unwrap();
        let frames = |seeds: [u32; 3]| seeds.map(|seed| frames(&scene, 40, seed)).to_vec();
        let lesson = |seeds| Lesson {
            frames: frames(seeds),
            scene: scene.clone(),
            harmonics: harmonics.clone(),
            k: 40,
            residual_m: 0.0,
            coarse_step_us: 0.0,
        };
        let learn = |seeds: [u32; 3]| {
            let lesson: Lesson = lesson(seeds);
            let methods = lesson.methods().unwrap();
            let probe = self::frames(&scene, 3, 99);
            let made: Vec<Vec<u32>> = methods
                .all
                .iter()
                .map(|(_, method)| {
                    let made = lesson.upsample(method, &probe);
                    made.col_iter().flat_map(|c| c.iter().map(|x| x.to_bits())).collect()
                })
                .collect();
            (format!("{:?}", methods.parameters), made)
        };
        let first = learn([1, 2, 3]);
        assert!(first == learn([1, 4, 5]), "another motion changed what was learnt");
        assert!(first != learn([6, 2, 3]), "the training motion must");
    }
}

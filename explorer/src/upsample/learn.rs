//! A scene with its motions simulated: what operators are learnt from and judged on.

use cloth::Mesh;
use faer::{Mat, MatRef, Par};

use super::beyond;
use super::cache::Cache;
use super::cached_harmonics;
use super::data::Frames;
use super::fit::{FitError, Training};
use super::harmonics::{Harmonics, HarmonicsError, Laplacian, harmonics};
use super::mirror::Mirror;
use super::modes::{Mode, along_normals, modes};
use super::report::{matrix, rows};
use super::run::{RunError, Simulation, clustered};
use super::scene::{Scene, SceneError};
use super::tune::{Table, held_out};
use crate::cpu::CpuClock;

/// Harmonics that every fit uses unless the user says otherwise.
pub const HARMONICS: usize = 300;

/// Which functions tie the fine cloth to the coarse one.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Tests {
    /// The lowest harmonics (Kavan et al. 2011).
    #[default]
    Harmonic,
    /// Groups of vertices (Bergou et al. 2007).
    Clustered,
}

/// Why nothing was learnt.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LearnError {
    /// No such scene, or no character for it.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The fine mesh has no harmonics.
    #[error(transparent)]
    Harmonics(#[from] HarmonicsError),
    /// A motion could not be simulated.
    #[error(transparent)]
    Run(#[from] RunError),
    /// The fit has no solution.
    #[error(transparent)]
    Fit(#[from] FitError),
    /// The operator cannot be rounded.
    #[error(transparent)]
    Operator(#[from] codec::kernel::operator::OperatorError),
    /// The operator cannot be stored.
    #[error(transparent)]
    Stored(#[from] codec::upsample::UpsampleError),
    /// The harmonic operator is not among the methods.
    #[error("no harmonic operator was learnt")]
    NoOperator,
}

/// A scene, simulated.
pub struct Lesson {
    /// The scene.
    pub scene: Scene,
    /// Frames of each of its motions.
    pub frames: Vec<Frames>,
    /// The fine mesh's lowest harmonics: enough for the fit and for judging.
    pub harmonics: Harmonics,
    /// How many of them the fit uses.
    pub k: usize,
    /// Largest residual of the tracking constraint (m).
    pub residual_m: f64,
    /// Median time of a coarse step of the training motion (us).
    pub coarse_step_us: f64,
}

/// What a game needs of a scene that was learnt.
#[derive(Debug, Clone)]
pub struct Learned {
    /// Coarse mesh with its pins, cloth and liberties; fine mesh.
    pub scene: Scene,
    /// The operator, row-major N x M: rows of compact support, pulled to the barycentric lift.
    pub weights: Vec<f32>,
    /// Pairs of oscillatory modes along the normals.
    pub modes: Vec<Mode>,
    /// How hard it is pulled, tuned on the training motion.
    pub gamma: f64,
    /// Whether it was learnt from mirrored frames as well: where the cloth has a mirror, and that does
    /// better on the end of the training motion.
    pub mirrored: bool,
}

/// Simulates a scene's training motion (or finds it in `cache`) and learns from it. `progress` is told
/// which motion, and how many of how many frames are done.
///
/// # Errors
/// No such scene, a cloth that came apart, a fit without a solution.
pub fn learn(
    name: &str,
    cache: &Cache,
    progress: &mut dyn FnMut(&str, usize, usize),
) -> Result<Learned, LearnError> {
    let lesson = Lesson::new(name, 1, HARMONICS, Tests::Harmonic, cache, progress)?;
    let frames = lesson.training();
    let prior = lesson.barycentric();
    let (mut gamma, plain) = lesson.tune_sparse(prior.as_ref(), None)?;
    let mirror = Mirror::of(&lesson.scene);
    let with =
        mirror.map(|m| Ok::<_, FitError>((lesson.tune_sparse(prior.as_ref(), Some(&m))?, m)));
    let chosen = with.transpose()?.filter(|((_, held_out), _)| *held_out < plain);
    let mirrored = chosen.is_some();
    let known = match chosen {
        Some(((better, _), mirror)) => {
            gamma = better;
            &mirror.both(frames)
        }
        None => frames,
    };
    let operator = beyond::sparse(known, prior.as_ref(), &lesson.supports(), gamma)?;
    let modes = lesson.modes(&operator);
    Ok(Learned { weights: rows(operator.as_ref()), modes, gamma, mirrored, scene: lesson.scene })
}

impl Lesson {
    /// The first `motions` motions of a scene, with `k` harmonics for the fit.
    ///
    /// # Errors
    /// As [`learn`].
    pub fn new(
        name: &str,
        motions: usize,
        k: usize,
        tests: Tests,
        cache: &Cache,
        progress: &mut dyn FnMut(&str, usize, usize),
    ) -> Result<Self, LearnError> {
        // Equal inputs, equal bytes: no work is shared between threads.
        faer::set_global_parallelism(Par::Seq);
        let scene = Scene::named(name)?;
        let mesh = &scene.fine.mesh;
        let functions = match tests {
            Tests::Harmonic => cached_harmonics(mesh, scene.tests, cache)?.functions,
            Tests::Clustered => clustered(mesh.rest_positions(), scene.tests),
        };
        let enough = k.max(scene.coarse.count());
        let harmonics = cached_harmonics(mesh, enough, cache)?;
        let simulation = Simulation::new(&scene, functions)?;
        let (mut frames, mut residual_m) = (Vec::new(), 0.0f64);
        for motion in scene.motions.iter().take(motions) {
            let mut tell = |done: usize, all: usize| progress(motion.name, done, all);
            let run = simulation.run(motion, cache, &mut tell)?;
            frames.push(Frames::new(&run, scene.coarse.count(), scene.fine.count()));
            residual_m = residual_m.max(run.residual_m);
        }
        let coarse_step_us = simulation.time_coarse(&scene.motions[0]).map_err(RunError::from)?;
        drop(simulation);
        Ok(Self { scene, frames, harmonics, k, residual_m, coarse_step_us })
    }

    /// Frames of the training motion.
    pub fn training(&self) -> &Frames {
        &self.frames[0]
    }

    /// Held-out errors of the harmonics' rows.
    ///
    /// # Errors
    /// No convergence.
    pub fn table(&self, frames: &Frames) -> Result<Table, FitError> {
        Table::new(frames, &self.harmonics, self.k)
    }

    /// The training motion, ready to be fitted again and again.
    ///
    /// # Errors
    /// No convergence.
    pub fn fitted(&self) -> Result<Training, FitError> {
        Training::new(self.training(), &self.harmonics, self.k)
    }

    /// Loop's subdivision as a matrix.
    pub fn subdivision(&self) -> Mat<f32> {
        let coarse = &self.scene.coarse;
        matrix(&coarse.subdivision(&self.scene.fine), coarse.count())
    }

    /// For each fine vertex the coarse points that a sparse operator may use.
    pub fn supports(&self) -> Vec<Vec<usize>> {
        let mesh = |patch: &super::patch::Patch| -> Mesh { patch.mesh.clone() };
        beyond::supports(&mesh(&self.scene.coarse), &mesh(&self.scene.fine))
    }

    /// The fine mesh's Laplacian.
    pub fn laplacian(&self) -> Laplacian {
        Laplacian::new(&self.scene.fine.mesh)
    }

    /// Penalty of the sparse operator, chosen on the end of the training motion, and its sum of squares
    /// there (m^2); with a `mirror` it learns from mirrored frames as well.
    ///
    /// # Errors
    /// A fit without a solution.
    pub fn tune_sparse(
        &self,
        prior: MatRef<'_, f32>,
        mirror: Option<&Mirror>,
    ) -> Result<(f64, f64), FitError> {
        let choices: Vec<f64> = (0..7).map(|i| 4f64.powi(i - 5)).collect();
        let supports = self.supports();
        held_out(self.training(), &choices, |frames, gamma| match mirror {
            Some(mirror) => beyond::sparse(&mirror.both(frames), prior, &supports, gamma),
            None => beyond::sparse(frames, prior, &supports, gamma),
        })
    }

    /// Oscillatory modes of what an operator leaves of the training motion.
    pub fn modes(&self, operator: &Mat<f32>) -> Vec<Mode> {
        let frames = self.training();
        let upsampled = operator * super::data::narrow(frames.coarse.as_ref());
        let triangles = self.scene.fine.mesh.triangles();
        modes(along_normals(upsampled.as_ref(), frames.fine.as_ref(), triangles))
    }

    /// Processor time that the harmonics of the fit take when they are not in the cache (s).
    ///
    /// # Errors
    /// No convergence.
    pub fn time_harmonics(&self) -> Result<f64, HarmonicsError> {
        let clock = CpuClock::start();
        harmonics(&self.scene.fine.mesh, self.k)?;
        Ok(clock.elapsed_s())
    }
}

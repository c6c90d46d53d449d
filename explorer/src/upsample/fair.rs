//! Learning again, fairly: operators learnt from the first half of a motion, judged on its second.

use serde::Serialize;

use super::beyond;
use super::data::Frames;
use super::fit::{Profile, Training};
use super::judge::Judge;
use super::learn::{LearnError, Lesson};
use super::report::Method;

/// Root mean square errors (mm) on the second half of a motion, which none of these has seen.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct SecondHalf {
    /// The harmonic operator, learnt from the training motion.
    pub harmonic_rms_mm: f64,
    /// The same, learnt from the first half of this motion.
    pub harmonic_retrained_rms_mm: f64,
    /// The same, learnt from both.
    pub harmonic_both_rms_mm: f64,
    /// The sparse operator, learnt from the training motion.
    pub sparse_rms_mm: f64,
    /// The same, learnt from the first half of this motion.
    pub sparse_retrained_rms_mm: f64,
    /// The same, learnt from both.
    pub sparse_both_rms_mm: f64,
}

impl Lesson {
    /// What learning again from half of `frames` brings, with the same profile and penalty.
    ///
    /// # Errors
    /// A fit without a solution.
    pub(super) fn second_half(
        &self,
        judge: &Judge,
        profile: &Profile,
        gamma: f64,
        frames: &Frames,
    ) -> Result<SecondHalf, LearnError> {
        let half = frames.count() / 2;
        let (first, second) = (frames.part(0, half), frames.part(half, frames.count()));
        let both = self.training().and(&first);
        let (prior, supports) = (self.barycentric(), self.supports());
        let mut found = [[0.0; 2]; 3];
        for (found, known) in found.iter_mut().zip([self.training(), &first, &both]) {
            let harmonic = Training::new(known, &self.harmonics, self.k)?.harmonic(profile);
            let sparse = beyond::sparse(known, prior.as_ref(), &supports, gamma)?;
            for (rms_mm, operator) in found.iter_mut().zip([harmonic, sparse]) {
                let made = self.upsample(&Method::Linear(operator), &second);
                *rms_mm = judge.judge(made.as_ref(), second.fine.as_ref()).rms_mm;
            }
        }
        let [[harmonic, sparse], again, together] = found;
        Ok(SecondHalf {
            harmonic_rms_mm: harmonic,
            harmonic_retrained_rms_mm: again[0],
            harmonic_both_rms_mm: together[0],
            sparse_rms_mm: sparse,
            sparse_retrained_rms_mm: again[1],
            sparse_both_rms_mm: together[1],
        })
    }
}

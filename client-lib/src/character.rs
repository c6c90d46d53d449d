//! One character that wears a garment: `step` once per scene tick, `sample` and `decode` as often
//! as the screen asks.

use std::sync::Arc;
use std::time::Duration;

use cloth::{Pose, Rigid};
use codec::Basis;
use protocol::table::{Entry, Follow};
use protocol::{EdgeId, PoseId, StateId};

use crate::blend::Blend;
use crate::clock::Stopwatch;
use crate::placement::{Placement, between};
use crate::shared::{Cursor, Stage};
use crate::stats::PlayStats;
use crate::telemetry::Batch;
use crate::version::{Version, View};

mod decode;
mod look;
mod outside;
mod overlay;
mod renew;
mod tier;

pub use decode::{Group, decode};
pub use look::Passed;
use outside::Free;
use overlay::Overlay;
use tier::Active;

/// A step that takes longer than this counts as missed (design decision 11).
pub const STEP_LIMIT: Duration = Duration::from_millis(2);
/// Resident states that are compared when a substitute is looked for.
const CANDIDATES_MAX: usize = 256;
/// Frames between two batches of telemetry.
const FRAMES_PER_BATCH: u64 = 30;

/// What a step could show.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum StepOutcome {
    /// The state that the links name is resident and shown.
    Exact,
    /// Another state of the same pose is shown.
    Substituted {
        /// How far it is from what should be seen, in metres: the largest distance of any vertex, when
        /// the two could last be compared.
        error_m: f32,
    },
    /// No state of that pose was resident (the last one is shown on), or the call took over
    /// [`STEP_LIMIT`].
    Missed,
}

/// What stands in for the state that the links name.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Shown {
    /// Nothing: that state itself is shown.
    Named,
    /// Another state of the same pose.
    Substitute { state: StateId, error_m: f32 },
    /// What was shown last.
    Last,
}

/// A character instance.
///
/// All coefficients are fractions of full scale over the garment's basis, in the state frame.
#[derive(Debug)]
pub struct Character {
    stage: Arc<Stage>,
    serial: u64,
    view: Arc<View>,
    cursor: Arc<Cursor>,
    batch: Batch,
    /// Where the links say we are.
    state: StateId,
    shown_by: Shown,
    /// Coefficients of the state that is shown, offsets apart.
    base: Vec<f32>,
    blend: Blend,
    /// With offsets: this frame, the one before, and what `sample` made of the two.
    now: Vec<f32>,
    before: Vec<f32>,
    sampled: Vec<f32>,
    phase: f32,
    overlay: Overlay,
    free: Free,
    /// Whether the basis changed since the last frame.
    just_renewed: bool,
    active: Active,
    placement: Placement,
    placement_before: Placement,
    scratch: Scratch,
    stats: PlayStats,
    passed: Option<Passed>,
    /// Whether what is walked is reported.
    counted: bool,
}

/// Memory for comparing states, kept between calls.
#[derive(Debug, Default)]
struct Scratch {
    state: Vec<f32>,
    best: Vec<f32>,
    difference: Vec<f32>,
    positions: Vec<f32>,
}

impl Character {
    /// Enters at the pose where exploration began; `None` while there is no version to play.
    pub fn enter(stage: &Arc<Stage>) -> Option<Self> {
        let view = stage.view()?;
        let version = &view.version;
        let state = version.links().resume(StateId(0))?;
        let pose = version.links().pose(state)?;
        let columns = version.basis().columns();
        let placement = Placement::at(pose);
        let mut character = Self {
            stage: Arc::clone(stage),
            serial: 0,
            cursor: stage.enter(state),
            batch: Batch::default(),
            state,
            shown_by: Shown::Last,
            base: vec![0.0; columns],
            blend: Blend::new(columns),
            now: vec![0.0; columns],
            before: vec![0.0; columns],
            sampled: vec![0.0; columns],
            phase: 1.0,
            overlay: Overlay::default(),
            free: Free::default(),
            just_renewed: false,
            active: Active::default(),
            placement,
            placement_before: placement,
            scratch: Scratch::default(),
            stats: PlayStats::default(),
            passed: None,
            counted: true,
            view,
        };
        character.make_room();
        if character.view.resident.read(state, &mut character.base) {
            character.shown_by = Shown::Named;
        }
        character.compose();
        character.before.copy_from_slice(&character.now);
        Some(character)
    }

    /// Plays one tick: goes on to `next_pose` and yields cloth for it. Never waits.
    ///
    /// A newer version is taken up first, between two frames; the state being played survives.
    /// A pose that is no successor of the last one is a jump: played on from the resident state
    /// of that pose nearest to what is shown, and counted.
    ///
    /// Cost: a look-up and a few passes over the coefficients; where a substitute begins or ends,
    /// also one reconstruction of all vertices, to state its error.
    pub fn step(&mut self, next_pose: PoseId) -> StepOutcome {
        let watch = Stopwatch::start();
        self.take_newer_view();
        let scene = Arc::clone(self.view.version.scene());
        let edge = scene.edge_between(self.placement.pose(), next_pose);
        self.leave_if_due(edge);
        self.just_renewed = false;
        std::mem::swap(&mut self.before, &mut self.now);
        self.overlay.begin_frame();
        self.free.run.begin_frame();
        self.placement_before = self.placement;
        self.passed = None;
        let mut outcome = match edge {
            _ if self.free.run.is_on() => self.step_outside(edge, next_pose),
            Some(edge) => self.walk(edge),
            None => self.jump(next_pose),
        };
        self.cursor.set(self.state);
        self.compose();
        if let (StepOutcome::Exact, Some(error_m)) = (outcome, self.leading_error_m()) {
            outcome = StepOutcome::Substituted { error_m };
        }
        if watch.exceeds(STEP_LIMIT) {
            outcome = StepOutcome::Missed;
        }
        self.count(outcome, edge);
        outcome
    }

    /// Coefficients between the last frame (`phase` 0) and this one (1), for screens that are
    /// faster than the scene (outside the graph [`decode`] alone says where cloth is); [`decode`], [`Character::placement`] and
    /// [`Character::world_pose`] then speak of the same instant. After a step the phase is 1.
    pub fn sample(&mut self, phase: f32) -> &[f32] {
        self.phase = phase.clamp(0.0, 1.0);
        self.overlay.sample(self.phase);
        for ((out, before), now) in self.sampled.iter_mut().zip(&self.before).zip(&self.now) {
            *out = before + (now - before) * self.phase;
        }
        &self.sampled
    }

    /// What moves the sampled cloth from its state frame (the hips) into the world.
    pub fn placement(&self) -> Rigid {
        let scene = self.view.version.scene();
        between(&self.placement_before.hips(scene), &self.placement.hips(scene), self.phase)
    }

    /// The sampled body pose in the world, for skinning: rotations interpolated, never vertices.
    pub fn world_pose(&self) -> Pose {
        let scene = self.view.version.scene();
        let before = self.placement_before.world_pose(scene);
        before.interpolate(&self.placement.world_pose(scene), self.phase)
    }

    /// The pose of this frame.
    pub fn pose(&self) -> PoseId {
        self.placement.pose()
    }

    /// The state that the links name for this frame.
    pub fn state(&self) -> StateId {
        self.state
    }

    /// The version that this frame was played from.
    pub fn version(&self) -> &Arc<Version> {
        &self.view.version
    }

    /// What was shown so far.
    pub fn stats(&self) -> &PlayStats {
        &self.stats
    }

    /// What is left in this frame of the errors of merges and switches, the error of a substitute,
    /// and that of columns left out or not here yet, in metres. Outside the graph: the upsampler's
    /// largest error on training motion.
    pub fn shown_error_m(&self) -> f32 {
        if let Some(upsampled) = &self.free.run.upsampled {
            return upsampled.upsampler().parts().max_m;
        }
        let substitute = match self.shown_by {
            Shown::Substitute { error_m, .. } => error_m,
            Shown::Named | Shown::Last => 0.0,
        };
        let columns = self.leading_error_m().unwrap_or(0.0).max(self.tier_error_m());
        self.blend.error_m() + substitute + columns
    }

    /// The error of what is shown (m), where only the leading columns of the basis are here.
    fn leading_error_m(&self) -> Option<f32> {
        self.view.resident.leading_error_m(self.shown_state()?)
    }

    /// Goes on along an edge of the primary graph.
    fn walk(&mut self, edge: EdgeId) -> StepOutcome {
        let view = Arc::clone(&self.view);
        let (scene, links) = (view.version.scene(), view.version.links());
        let slot = scene.slot(edge);
        let Some(follow) = links.follow(self.state, slot) else {
            return self.jump(scene.edges()[edge.index()].to);
        };
        let outcome = if view.resident.has(follow.state) {
            self.show_named(&view, slot, follow)
        } else {
            self.show_substitute(&view, slot, edge)
        };
        self.state = follow.state;
        self.passed = follow.via.map(|(dead_end, error_m)| Passed {
            dead_end,
            target: follow.state,
            error_m,
        });
        self.placement.walk(scene, edge);
        outcome
    }

    /// The named state is resident: shows it, with the offset of the merge that led to it, or of
    /// the substitute that ends here.
    fn show_named(&mut self, view: &View, slot: usize, follow: Follow) -> StepOutcome {
        let mut scratch = std::mem::take(&mut self.scratch);
        view.resident.read(follow.state, &mut scratch.best);
        let mut outcome = StepOutcome::Exact;
        if self.shown_by == Shown::Named {
            self.blend.advance();
            if let Some((dead_end, error_m)) = follow.via {
                if view.resident.read(dead_end, &mut scratch.state) {
                    self.blend.add(&scratch.state, &scratch.best);
                    self.add_velocity(view, follow.state, &mut scratch);
                } else {
                    // The links name the dead end for this frame; its target stands in for it.
                    outcome = StepOutcome::Substituted { error_m };
                }
                self.blend.add_error(error_m);
            }
        } else {
            // What the substitute would have shown next starts the blend.
            self.go_on_from_substitute(view, slot);
            let error_m = scratch.best_to_m(&self.base, view.version.basis());
            self.blend.advance();
            self.blend.add(&self.base, &scratch.best);
            self.blend.add_error(error_m);
        }
        self.base.copy_from_slice(&scratch.best);
        self.shown_by = Shown::Named;
        self.scratch = scratch;
        outcome
    }

    /// The velocity of the offset that begins in this frame, where the state before the target is
    /// known: `base` is still the state before the dead end.
    fn add_velocity(&mut self, view: &View, target: StateId, scratch: &mut Scratch) {
        if !self.blend.takes_velocity() || target.0 == 0 {
            return;
        }
        let before = StateId(target.0 - 1);
        let leads = match view.version.links().entry(before) {
            Some(Entry::Interior(next)) => next.contains(&target),
            _ => false,
        };
        let Scratch { state, best, difference, .. } = scratch;
        if leads && view.resident.read(before, difference) {
            let dead_end = state.iter().zip(&self.base).map(|(now, before)| now - before);
            let target = best.iter().zip(&*difference).map(|(now, before)| now - before);
            self.blend.add_velocity(dead_end.zip(target).map(|(a, b)| a - b));
        }
    }

    /// Moves `base` from the substitute to its own successor, where that is resident; says how it
    /// got there.
    fn go_on_from_substitute(&mut self, view: &View, slot: usize) -> Option<Follow> {
        let Shown::Substitute { state, .. } = self.shown_by else { return None };
        let follow = view.version.links().follow(state, slot)?;
        view.resident.read(follow.state, &mut self.base).then_some(follow)
    }

    /// The named state is not resident: goes on with the substitute, or looks for one.
    fn show_substitute(&mut self, view: &View, slot: usize, edge: EdgeId) -> StepOutcome {
        let mut scratch = std::mem::take(&mut self.scratch);
        let outcome = if let Some(follow) = self.go_on_from_substitute(view, slot) {
            self.blend.advance();
            self.pass_merge(view, follow, &mut scratch)
        } else if let Some(state) = self.twin(view, slot, &mut scratch) {
            // A merge as the explorer does it, of states of one pose: full weight before the
            // step, nine tenths after it.
            let error_m = scratch.best_to_m(&self.base, view.version.basis());
            self.blend.add(&self.base, &scratch.best);
            self.blend.advance();
            view.resident.read(state, &mut self.base);
            self.be_substituted(state, error_m)
        } else {
            self.blend.advance();
            let to = view.version.scene().edges()[edge.index()].to;
            match self.enter_nearest(view, to, &mut scratch) {
                Some((state, error_m)) => self.be_substituted(state, error_m),
                None => {
                    self.shown_by = Shown::Last;
                    StepOutcome::Missed
                }
            }
        };
        self.scratch = scratch;
        outcome
    }

    /// The substitute went on; where it passed a merge, that one is blended too and its error
    /// added to the substitute's own.
    fn pass_merge(&mut self, view: &View, follow: Follow, scratch: &mut Scratch) -> StepOutcome {
        let Shown::Substitute { error_m, .. } = self.shown_by else {
            return StepOutcome::Missed;
        };
        let Some((dead_end, merge_m)) = follow.via else {
            return self.be_substituted(follow.state, error_m);
        };
        if view.resident.read(dead_end, &mut scratch.state) {
            self.blend.add(&scratch.state, &self.base);
        }
        self.be_substituted(follow.state, error_m + merge_m)
    }

    /// Of the resident states of this pose whose successor is resident too, the one nearest to
    /// what is shown: its coefficients into `scratch.best`; returns its successor.
    fn twin(&self, view: &View, slot: usize, scratch: &mut Scratch) -> Option<StateId> {
        if self.shown_by == Shown::Last {
            return None;
        }
        let links = view.version.links();
        let next_of = |state: StateId| links.follow(state, slot).map(|follow| follow.state);
        let playable = |state: StateId| next_of(state).is_some_and(|next| view.resident.has(next));
        let twin = scratch.nearest(view, self.placement.pose(), &self.base, playable)?;
        next_of(twin)
    }

    /// Shows the resident state of `pose` nearest to what is shown, the offset decaying; gives
    /// that state and its distance in metres.
    fn enter_nearest(
        &mut self,
        view: &View,
        pose: PoseId,
        scratch: &mut Scratch,
    ) -> Option<(StateId, f32)> {
        let state = scratch.nearest(view, pose, &self.base, |_| true)?;
        let error_m = scratch.best_to_m(&self.base, view.version.basis());
        self.blend.add(&self.base, &scratch.best);
        self.base.copy_from_slice(&scratch.best);
        Some((state, error_m))
    }

    fn be_substituted(&mut self, state: StateId, error_m: f32) -> StepOutcome {
        self.shown_by = Shown::Substitute { state, error_m };
        StepOutcome::Substituted { error_m }
    }

    /// Goes on at a pose that is no successor.
    fn jump(&mut self, pose: PoseId) -> StepOutcome {
        self.stats.jumps += 1;
        self.batch.jumps += 1;
        self.blend.advance();
        let view = Arc::clone(&self.view);
        if pose.index() >= view.version.scene().pose_count() {
            return StepOutcome::Missed;
        }
        self.placement.jump(view.version.scene(), pose);
        self.re_enter(&view)
    }

    /// Goes on at the best state of the current pose, as if the links had named it.
    fn re_enter(&mut self, view: &View) -> StepOutcome {
        let mut scratch = std::mem::take(&mut self.scratch);
        let pose = self.placement.pose();
        let entered = self.enter_nearest(view, pose, &mut scratch);
        self.scratch = scratch;
        if let Some((state, error_m)) = entered {
            self.blend.add_error(error_m);
            self.state = state;
            self.shown_by = Shown::Named;
            return StepOutcome::Substituted { error_m };
        }
        if let Some(first) = view.version.links().interior(pose).first() {
            self.state = *first;
        }
        self.shown_by = Shown::Last;
        StepOutcome::Missed
    }

    /// As many coefficients as the version's basis has columns; appended ones are zero so far.
    fn make_room(&mut self) {
        let columns = self.view.version.basis().columns().max(self.base.len());
        let Scratch { state, best, difference, positions } = &mut self.scratch;
        for coefficients in [
            &mut self.base,
            &mut self.now,
            &mut self.before,
            &mut self.sampled,
            state,
            best,
            difference,
        ] {
            coefficients.resize(columns, 0.0);
        }
        self.blend.grow(columns);
        positions.resize(self.view.version.basis().rows(), 0.0);
    }

    /// The state whose coefficients are in `base`, where it is of this version.
    fn shown_state(&self) -> Option<StateId> {
        match self.shown_by {
            Shown::Named => Some(self.state),
            Shown::Substitute { state, .. } => Some(state),
            Shown::Last => None,
        }
    }

    /// This frame: the shown state and what is left of all offsets.
    fn compose(&mut self) {
        self.now.copy_from_slice(&self.base);
        self.blend.apply(&mut self.now);
        self.overlay.now.clear();
        if let Some(shown) = self.shown_state() {
            self.view.resident.fixes(shown, &mut self.overlay.now);
        }
        self.overlay.sample(1.0);
        self.sampled.copy_from_slice(&self.now);
        self.phase = 1.0;
        self.choose_columns();
    }

    fn count(&mut self, outcome: StepOutcome, edge: Option<EdgeId>) {
        self.stats.frames += 1;
        match outcome {
            StepOutcome::Exact => {
                self.stats.exact += 1;
                self.batch.exact += 1;
            }
            StepOutcome::Substituted { .. } => {
                self.stats.substituted += 1;
                self.batch.substituted += 1;
            }
            StepOutcome::Missed => {
                self.stats.missed += 1;
                self.batch.missed += 1;
            }
        }
        if outcome != StepOutcome::Missed {
            self.stats.shown_error_m.record(f64::from(self.shown_error_m()));
        }
        if let Some(edge) = edge {
            *self.batch.edges.entry(edge).or_default() += 1;
        }
        if !self.counted {
            self.batch = Batch::default();
        } else if self.stats.frames.is_multiple_of(FRAMES_PER_BATCH) {
            self.stage.mailbox().try_post(&mut self.batch);
        }
    }
}

impl Drop for Character {
    fn drop(&mut self) {
        self.stage.mailbox().try_post(&mut self.batch);
    }
}

impl Scratch {
    /// Of the resident interior states of `pose` that satisfy `playable`, the one whose vertices
    /// are nearest to `base` in the mean square; its coefficients go to `best`.
    fn nearest(
        &mut self,
        view: &View,
        pose: PoseId,
        base: &[f32],
        playable: impl Fn(StateId) -> bool,
    ) -> Option<StateId> {
        let states = view.version.links().interior(pose).iter().copied();
        let resident = states.filter(|state| view.resident.has(*state) && playable(*state));
        let mut best = None;
        for state in resident.take(CANDIDATES_MAX) {
            view.resident.read(state, &mut self.state);
            // Columns are orthonormal, so this is the squared distance of all positions.
            let difference = self.state.iter().zip(base).zip(view.version.basis().maxima());
            let square: f32 = difference.map(|((a, b), maximum)| ((a - b) * maximum).powi(2)).sum();
            if best.is_none_or(|(least, _)| square < least) {
                best = Some((square, state));
                std::mem::swap(&mut self.best, &mut self.state);
            }
        }
        best.map(|(_, state)| state)
    }

    /// The largest distance of any vertex between `best` and `base`, in metres.
    ///
    /// Cost: one reconstruction, since positions are linear in coefficients.
    fn best_to_m(&mut self, base: &[f32], basis: &Basis) -> f32 {
        for ((out, a), b) in self.difference.iter_mut().zip(base).zip(&self.best) {
            *out = a - b;
        }
        let (columns, rows) = (basis.columns().min(base.len()), 0..basis.rows());
        let fits = basis.reconstruct(&self.difference, rows, columns, &mut self.positions);
        debug_assert!(fits.is_ok(), "made to measure by make_room");
        let (vertices, _) = self.positions.as_chunks::<3>();
        let square = |v: &[f32; 3]| v.iter().map(|x| x * x).sum::<f32>();
        vertices.iter().map(square).fold(0.0, f32::max).sqrt()
    }
}

#[cfg(test)]
mod tests;

//! Leaving the graph where a force acts that it does not know, and coming back.

use std::sync::Arc;

use protocol::{EdgeId, PoseId, StateId};

use super::{Character, Shown, StepOutcome};
use crate::free::probe::{CANDIDATES, Found, Planes};
use crate::free::run::{Run, Way};
use crate::free::{FORCE_MAX, Forces, Outside, PUSHES_MAX, Push};
use crate::placement::Placement;
use crate::version::View;
use cloth::Vec3;

/// Frames outside before a way back is looked for: what was left of the graph's cloth at leaving has
/// decayed by then.
const FRAMES_MIN: u32 = crate::blend::BLEND_FRAMES as u32;
/// Nearer than this (m) cloth is close to a state whatever the version's merges are like.
const CLOSE_M: f32 = 0.01;
/// Cloth is drawn on to the state that it is drawn to unless another is nearer than this share.
const NEARER: f32 = 0.8;

/// A state that is near the cloth outside.
#[derive(Debug, Clone, Copy)]
struct Nearest {
    state: StateId,
    /// Largest distance of a probed vertex (m), and that of the cursor's state, where it counts.
    distance_m: f32,
    own_m: Option<f32>,
}

/// What a character needs to leave the graph and to come back.
#[derive(Debug)]
pub(super) struct Free {
    pub(super) run: Run,
    forces: Forces,
    /// A merge with an error above this (m) is not played; infinite: every merge is.
    leave_above_m: f32,
    /// How close a state must be (m); `None`: as close as the version's merges are in the mean.
    return_within_m: Option<f32>,
    nearest_m: Option<f32>,
    /// Whether the cursor is at the state that cloth is drawn to; and whether it came there along a
    /// link, not as another state that is nearer.
    aims: bool,
    follows: bool,
    /// Which candidates are compared next.
    turn: usize,
    found: Found,
    planes: Planes,
    joints: Vec<cloth::Rigid>,
    pose: Option<cloth::Pose>,
}

impl Default for Free {
    fn default() -> Self {
        Self {
            run: Run::default(),
            forces: Forces::default(),
            leave_above_m: f32::INFINITY,
            return_within_m: None,
            nearest_m: None,
            aims: false,
            follows: false,
            turn: 0,
            found: Found::default(),
            planes: Planes::default(),
            joints: Vec::new(),
            pose: None,
        }
    }
}

/// # Forces that the graph does not know
///
/// A garment whose version has an upsampler can leave the graph: cloth then goes on from where it is
/// by a coarse simulation and the upsampler. Once no force acts it is drawn towards the nearest
/// resident state of the pose, gently at first, and comes back to it when it is close. Frames outside
/// count as substituted. Without an upsampler forces do nothing.
impl Character {
    /// Whether this version's upsampler is here, so that forces have an effect.
    pub fn can_leave(&self) -> bool {
        self.view.upsampled.is_some()
    }

    /// Velocity of the air in the world (m/s); zero at first. As long as it blows, cloth is outside
    /// the graph.
    pub fn set_wind(&mut self, wind: [f32; 3]) {
        let wind = Vec3::from_array(wind);
        let wind = if wind.is_finite() { wind } else { Vec3::ZERO };
        self.free.forces.wind = wind.clamp_length_max(FORCE_MAX);
    }

    /// Pushes cloth from the next step on. `false`, and nothing happens, where the garment cannot leave
    /// the graph, eight pushes are under way, or this is none.
    pub fn push(&mut self, push: Push) -> bool {
        let Some(push) = push.sound().filter(|_| self.can_leave()) else { return false };
        let room = self.free.forces.pushes.len() < PUSHES_MAX;
        if room {
            self.free.forces.pushes.push(push);
        }
        room
    }

    /// Leaves the graph at the next step and stays outside, in a calm too; `false`, as at first: as
    /// forces and merges have it.
    pub fn stay_outside(&mut self, stay: bool) {
        self.free.forces.stay = stay;
    }

    /// Leaves the graph rather than play a merge whose error (m) is above this; `None`, as at first:
    /// plays every merge.
    pub fn leave_above(&mut self, error_m: Option<f32>) {
        self.free.leave_above_m = error_m.unwrap_or(f32::INFINITY);
    }

    /// How close (m, the largest distance of any vertex) a state must be for coming back; `None`, as
    /// at first: as close as the version's merges are in the mean, for these are blended all the time,
    /// or as the upsampler comes to the states that it was learned from.
    pub fn return_within(&mut self, distance_m: Option<f32>) {
        self.free.return_within_m = distance_m;
    }

    /// Where it stands while it is outside the graph.
    pub fn outside(&self) -> Option<Outside> {
        let run = &self.free.run;
        let nearest_m = self.free.nearest_m;
        run.is_on().then_some(Outside { frames: run.frames, nearest_m })
    }

    /// Before a step, while this frame is still the last one: leaves the graph where it should.
    pub(super) fn leave_if_due(&mut self, edge: Option<EdgeId>) {
        if self.free.run.is_on() || !(self.free.forces.act() || self.merges_badly(edge)) {
            return;
        }
        let Some(upsampled) = self.view.upsampled.clone() else {
            // No upsampler: pushes would pile up.
            return self.free.forces.pushes.clear();
        };
        if self.shown_by == Shown::Last {
            return;
        }
        let view = Arc::clone(&self.view);
        let rows = view.version.basis().rows();
        let mut run = std::mem::take(&mut self.free.run);
        let mut both = true;
        let (shows_before, shows_now) = (run.shows_before, run.shows_now);
        for (phase, is_here, out) in
            [(0.0, shows_before, &mut run.before), (1.0, shows_now, &mut run.now)]
        {
            // It may have come back just now.
            if !is_here {
                out.resize(rows, 0.0);
                both &= self.shown_at(phase, out);
            }
        }
        let way =
            Way { scene: view.version.scene(), from: &self.placement_before, to: &self.placement };
        let velocities = self.now.len() == self.before.len() && !self.just_renewed;
        if both && run.start(&upsampled, &way, velocities) {
            self.stats.left += 1;
            (self.free.nearest_m, self.free.aims) = (None, false);
        }
        self.free.run = run;
    }

    /// Whether the links lead through a merge that the host does not want to see.
    fn merges_badly(&self, edge: Option<EdgeId>) -> bool {
        let Some(edge) = edge.filter(|_| self.free.leave_above_m.is_finite()) else {
            return false;
        };
        let version = &self.view.version;
        let follow = version.links().follow(self.state, version.scene().slot(edge));
        let error_m = follow.and_then(|follow| follow.via).map(|(_, error_m)| error_m);
        error_m.is_some_and(|error_m| error_m > self.free.leave_above_m)
    }

    /// Rows (m) of the cloth shown in the frame before (`phase` 0) or in this one (1), from their
    /// coefficients.
    fn shown_at(&mut self, phase: f32, out: &mut [f32]) -> bool {
        let basis = Arc::clone(self.view.version.basis());
        let coefficients = if phase > 0.5 { &self.now } else { &self.before };
        let columns = basis.columns().min(coefficients.len());
        if basis.reconstruct(coefficients, 0..basis.rows(), columns, out).is_err() {
            return false;
        }
        self.overlay.sample(phase);
        self.overlay.add_to(0..out.len(), out);
        self.overlay.sample(self.phase);
        true
    }

    /// A frame outside the graph.
    pub(super) fn step_outside(&mut self, edge: Option<EdgeId>, next_pose: PoseId) -> StepOutcome {
        let view = Arc::clone(&self.view);
        let scene = view.version.scene();
        if next_pose.index() >= scene.pose_count() {
            self.count_jump();
            self.free.run.shows_now = self.free.run.shows_before;
            let Run { now, before, .. } = &mut self.free.run;
            now.clone_from(before);
            return StepOutcome::Missed;
        }
        let from = self.placement;
        self.free.follows &= self.follow_links(&view, edge, next_pose);
        self.aim(&view, &from);
        let way = Way { scene, from: &from, to: &self.placement };
        if !self.free.run.step(&way, &mut self.free.forces) {
            // Nothing that can be simulated: on in the graph.
            self.free.run.stop();
            return self.re_enter(&view);
        }
        self.stats.outside += 1;
        self.batch.outside += 1;
        let error_m = self.free.run.upsampled.as_ref().map_or(0.0, |u| u.upsampler().parts().max_m);
        if !self.free.forces.act() && self.free.run.frames >= FRAMES_MIN {
            self.come_back(&view);
        } else {
            (self.free.nearest_m, self.free.aims) = (None, false);
        }
        StepOutcome::Substituted { error_m }
    }

    fn count_jump(&mut self) {
        self.stats.jumps += 1;
        self.batch.jumps += 1;
    }

    /// Draws the cloth towards the cursor's state, where that was found near and is resident.
    fn aim(&mut self, view: &View, from: &Placement) {
        let (free, scratch) = (&mut self.free, &mut self.scratch);
        let here = free.aims && !free.forces.act() && view.version.is_interior(self.state);
        let probes = view.probes.as_ref();
        let probes = probes.filter(|_| here && view.resident.read(self.state, &mut scratch.state));
        let Some(probes) = probes else { return free.run.draw.stop() };
        let scene = view.version.scene();
        let way = [&from.hips(scene), &self.placement.hips(scene)];
        free.run.draw.towards(probes, &scratch.state, way, free.follows);
        free.follows = true;
    }

    /// The cursor goes where the links lead, so that regions are fetched as ever; `true` where no
    /// merge lies between.
    fn follow_links(&mut self, view: &View, edge: Option<EdgeId>, next_pose: PoseId) -> bool {
        let (scene, links) = (view.version.scene(), view.version.links());
        let follow = edge.and_then(|edge| links.follow(self.state, scene.slot(edge)));
        match edge {
            Some(edge) => self.placement.walk(scene, edge),
            None => {
                self.count_jump();
                self.placement.jump(scene, next_pose);
            }
        }
        let any = || links.interior(next_pose).first().copied();
        let state = follow.as_ref().map(|follow| follow.state);
        if let Some(state) = state.or_else(any) {
            self.state = state;
        }
        follow.is_some_and(|follow| follow.via.is_none())
    }

    /// Goes back to the nearest resident state of the pose and the class, if one is close; otherwise
    /// the cursor goes there, and the cloth is drawn to it.
    fn come_back(&mut self, view: &View) {
        let Some(Nearest { state, distance_m, own_m }) = self.nearest(view) else {
            self.free.aims = false;
            return;
        };
        // A few vertices tell that it is not close; all of them tell that it is.
        self.free.nearest_m = Some(distance_m);
        if distance_m <= self.close_m(view) && self.enter_state(view, state) {
            return;
        }
        let stays = self.free.aims && own_m.is_some_and(|own_m| NEARER * own_m <= distance_m);
        if !stays {
            (self.state, self.free.follows) = (state, false);
        }
        self.free.aims = true;
    }

    /// Goes back to a state, if that is close at all vertices.
    fn enter_state(&mut self, view: &View, state: StateId) -> bool {
        let mut scratch = std::mem::take(&mut self.scratch);
        view.resident.read(state, &mut scratch.best);
        let basis = view.version.basis();
        let (rows, columns) = (basis.rows(), basis.columns().min(scratch.best.len()));
        let made = basis.reconstruct(&scratch.best, 0..rows, columns, &mut scratch.positions);
        let mut enters = false;
        if made.is_ok() && self.free.run.now.len() == rows {
            self.overlay.now.clear();
            view.resident.fixes(state, &mut self.overlay.now);
            let error_m = self.overlay.offset_m(&self.free.run.now, &mut scratch.positions);
            self.free.nearest_m = Some(error_m);
            enters = error_m <= self.close_m(view);
            if enters {
                self.overlay.carry_offset(&scratch.positions);
                self.blend.clear();
                self.blend.add_error(error_m);
                self.base.copy_from_slice(&scratch.best);
                (self.state, self.shown_by) = (state, Shown::Named);
                self.free.run.upsampled = None;
                self.free.aims = false;
                self.stats.entered += 1;
            }
        }
        self.scratch = scratch;
        enters
    }

    fn close_m(&self, view: &View) -> f32 {
        let mean = view.version.listing().stats.mean_error_m;
        let learned = self.free.run.upsampled.as_ref().map_or(0.0, |u| u.upsampler().parts().max_m);
        self.free.return_within_m.unwrap_or(mean.max(learned).max(CLOSE_M))
    }

    /// Of the candidates whose turn it is, the nearest by probed vertices.
    fn nearest(&mut self, view: &View) -> Option<Nearest> {
        let (probes, upsampled) = (view.probes.as_ref()?, self.free.run.upsampled.clone()?);
        let scene = view.version.scene();
        let free = &mut self.free;
        let pose = free.pose.get_or_insert_with(|| scene.pose(self.placement.pose()));
        self.placement.world_pose_into(scene, pose);
        scene.skeleton().world(pose, &mut free.joints);
        free.planes.place(&upsampled, scene, &free.joints, &self.placement.hips(scene));
        probes.look(&free.run.now, &free.planes, &mut free.found);
        let interior = view.version.links().interior(self.placement.pose());
        let first = if interior.len() > CANDIDATES { free.turn } else { 0 };
        free.turn = free.turn.wrapping_add(CANDIDATES);
        let mut best: Option<Nearest> = None;
        // The state that the links name is looked at in any case.
        let turns =
            (0..interior.len().min(CANDIDATES)).map(|i| interior[(first + i) % interior.len()]);
        for state in std::iter::once(self.state).chain(turns) {
            if !view.version.is_interior(state)
                || !view.resident.read(state, &mut self.scratch.state)
            {
                continue;
            }
            let most = best.map_or(f32::INFINITY, |best| best.distance_m);
            let found = &free.found;
            let distance = probes.distance_m(&self.scratch.state, &free.planes, found, most);
            if let Some(distance_m) = distance {
                let own_m = if state == self.state { Some(distance_m) } else { None };
                let own_m = own_m.or(best.and_then(|best| best.own_m));
                best = Some(Nearest { state, distance_m, own_m });
            }
        }
        best
    }

    /// Adds what is shown of the frames outside to rows of the sampled cloth; `false` where both
    /// frames are of the graph.
    pub(super) fn sample_outside(
        &self,
        rows: std::ops::Range<usize>,
        columns: usize,
        out: &mut [f32],
    ) -> Option<Result<(), codec::ReconstructError>> {
        let run = &self.free.run;
        if !run.shows_now && !run.shows_before {
            return None;
        }
        let basis = self.view.version.basis();
        let expected = basis.rows();
        if rows.end > expected || rows.start > rows.end {
            // Says which rows there are.
            return Some(basis.reconstruct(&self.sampled, rows, columns, out));
        }
        let phase = self.phase;
        let graph = |coefficients: &[f32], now: bool, out: &mut [f32]| {
            let columns = columns.min(basis.columns()).min(coefficients.len());
            basis.reconstruct(coefficients, rows.clone(), columns, out)?;
            self.overlay.add_one(now, rows.clone(), out);
            Ok(())
        };
        let made = match (run.shows_before, run.shows_now) {
            (true, true) => {
                out.copy_from_slice(&run.now[rows.clone()]);
                Ok(())
            }
            (true, false) => graph(&self.now, true, out),
            _ => graph(&self.before, false, out),
        };
        let (other, weight) = match (run.shows_before, run.shows_now) {
            (true, _) => (&run.before, 1.0 - phase),
            _ => (&run.now, phase),
        };
        for (out, other) in out.iter_mut().zip(&other[rows.clone()]) {
            *out += weight * (other - *out);
        }
        Some(made)
    }

    /// Nothing of the cloth outside means anything any more.
    pub(super) fn stop_outside(&mut self) {
        self.free.run.stop();
        self.free.forces.pushes.clear();
    }
}

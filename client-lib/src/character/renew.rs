//! What becomes of the state that is played when the version changes under it.

use std::sync::Arc;

use protocol::StateId;

use super::{Character, Shown};
use crate::placement::Placement;
use crate::version::View;

impl Character {
    /// Takes up a newer view, if there is one, before the step: the state that was played goes on.
    pub(super) fn take_newer_view(&mut self) {
        let Some(view) = self.stage.try_newer(&mut self.serial) else { return };
        let old = std::mem::replace(&mut self.view, Arc::clone(&view));
        self.make_room();
        if Arc::ptr_eq(&old.version, &view.version) {
            return;
        }
        self.stats.switches += u64::from(old.version.number() != view.version.number());
        if self.placement.pose().index() >= view.version.scene().pose_count() {
            return self.start_over(&view);
        }
        if old.version.lineage() != view.version.lineage() {
            self.just_renewed = true;
            return self.change_basis(&old, &view);
        }
        if let Shown::Substitute { state, error_m } = self.shown_by {
            // A substitute that this version merged or retired is looked for anew.
            if !view.version.is_interior(state) {
                self.shown_by = Shown::Substitute { state: StateId(u64::MAX), error_m };
            }
        }
        match view.version.links().resume(self.state) {
            Some(state) if state == self.state => {
                // The rest of the basis has come: what it adds fades in.
                if old.version.columns_to_come() > view.version.columns_to_come() {
                    self.switch_to(&view, state);
                }
            }
            Some(state) => self.switch_to(&view, state),
            // This version has never heard of that state.
            None => {
                self.re_enter(&view);
            }
        }
    }

    /// The version plays another state here: the difference decays.
    fn switch_to(&mut self, view: &View, state: StateId) {
        self.state = state;
        let mut scratch = std::mem::take(&mut self.scratch);
        if self.shown_by == Shown::Named && view.resident.read(state, &mut scratch.best) {
            let error_m = scratch.best_to_m(&self.base, view.version.basis());
            self.blend.add(&self.base, &scratch.best);
            self.blend.add_error(error_m);
            self.base.copy_from_slice(&scratch.best);
        } else if self.shown_by == Shown::Named {
            self.shown_by = Shown::Substitute { state: StateId(u64::MAX), error_m: 0.0 };
        }
        self.scratch = scratch;
    }

    /// The version stands on another basis: the cloth that was shown decays into that of the same
    /// state, vertex by vertex, since no coefficient of the old basis means anything on the new.
    fn change_basis(&mut self, old: &View, view: &View) {
        let was = std::mem::take(&mut self.now);
        let state = view.version.links().resume(self.state);
        let pose = state.and_then(|state| view.version.links().pose(state));
        let Some(state) = state.filter(|_| pose == Some(self.placement.pose())) else {
            self.now = was;
            return self.start_over(view);
        };
        self.blend.clear();
        self.state = state;
        self.base.fill(0.0);
        self.shown_by = Shown::Last;
        if view.resident.read(state, &mut self.base) {
            self.shown_by = Shown::Named;
        } else {
            let mut scratch = std::mem::take(&mut self.scratch);
            let links = view.version.links();
            let mut states = links.interior(self.placement.pose()).iter().copied();
            if let Some(near) = states.find(|near| view.resident.read(*near, &mut scratch.best)) {
                self.base.copy_from_slice(&scratch.best);
                self.shown_by = Shown::Substitute { state: near, error_m: 0.0 };
            }
            self.scratch = scratch;
        }
        let (from, to) = (old.version.basis(), view.version.basis());
        let mut fixes = Vec::new();
        if let Some(shown) = self.shown_state() {
            view.resident.fixes(shown, &mut fixes);
        }
        let error_m = self.overlay.carry((from, &was), (to, &self.base), fixes);
        self.blend.add_error(error_m);
        self.now = was;
        self.now.copy_from_slice(&self.base);
    }

    /// Nothing of the old version means anything in this one: another motion.
    fn start_over(&mut self, view: &View) {
        self.stop_outside();
        self.blend.clear();
        self.state = view.version.links().resume(StateId(0)).unwrap_or(StateId(0));
        self.placement = Placement::at(view.version.start());
        self.shown_by = Shown::Last;
        self.base.fill(0.0);
        if view.resident.read(self.state, &mut self.base) {
            self.shown_by = Shown::Named;
        }
        self.now.copy_from_slice(&self.base);
    }
}

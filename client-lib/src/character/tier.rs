//! The dial: fewer columns, at an error that the publisher measured.

use codec::kernel::Select;

use super::Character;

/// Which columns are decoded.
#[derive(Debug)]
pub(super) struct Active {
    /// Columns of a tier; `usize::MAX`: all.
    tier: usize,
    /// What is decoded in this frame, ascending; empty: everything.
    columns: Vec<u16>,
    /// Those of the state shown, now and in the frame before.
    own: [Vec<u16>; 2],
    /// Energies of what offsets add, by column.
    energies: Vec<(f32, u16)>,
    error_m: f32,
}

impl Default for Active {
    fn default() -> Self {
        let (columns, own, energies) = Default::default();
        Self { tier: usize::MAX, columns, own, energies, error_m: 0.0 }
    }
}

impl Character {
    /// Decodes only the columns that carry most in the region that is shown: 16, 32, 64 or 128 of
    /// them, whichever is the first not below `columns`; more than 128 means all. What offsets of
    /// merges move is decoded beside them. Takes effect with the next step.
    ///
    /// What it costs is stated by the publisher and is part of [`Character::shown_error_m`]. A
    /// garment of a profile without tiers is decoded whole.
    pub fn set_tier(&mut self, columns: usize) {
        self.active.tier = columns;
    }

    /// The stated error of the tier for what is shown (m): the largest distance of any vertex of
    /// the region from what all columns and no fixes show. 0 where all columns are decoded.
    pub fn tier_error_m(&self) -> f32 {
        self.active.error_m
    }

    /// How many columns this frame decodes.
    pub fn active_columns(&self) -> usize {
        let all = self.view.version.basis().columns();
        if self.active.columns.is_empty() { all } else { self.active.columns.len() }
    }

    /// What to decode: at most `columns` leading ones, or those of the tier.
    pub(super) fn select(&self, columns: usize) -> Select<'_> {
        let known = self.view.version.basis().columns();
        let active = &self.active.columns;
        match active.last() {
            Some(last) if usize::from(*last) < known => Select::Only(active),
            _ => Select::First(columns.min(known)),
        }
    }

    /// Chooses the columns of this frame, after it was composed.
    pub(super) fn choose_columns(&mut self) {
        let shown = self.shown_state();
        let Active { tier, columns, own, energies, error_m } = &mut self.active;
        columns.clear();
        own.swap(0, 1);
        own[0].clear();
        *error_m = 0.0;
        let stated = shown.filter(|_| *tier != usize::MAX);
        let stated = stated.and_then(|state| self.view.resident.tier(state, *tier));
        let Some(stated) = stated.filter(|stated| !stated.columns.is_empty()) else { return };
        *error_m = stated.error_m;
        own[0].extend_from_slice(stated.columns);
        columns.extend_from_slice(&own[0]);
        columns.extend_from_slice(&own[1]);
        let maxima = self.view.version.basis().maxima();
        let offsets = self.now.iter().zip(&self.base).zip(maxima);
        energies.clear();
        energies.extend(offsets.zip(0u16..).filter_map(|(((now, base), maximum), column)| {
            let offset_m = (now - base) * maximum;
            (offset_m != 0.0).then_some((offset_m * offset_m, column))
        }));
        let kept = energies.len().min(*tier);
        if kept > 0 {
            energies.select_nth_unstable_by(kept - 1, |a, b| b.0.total_cmp(&a.0));
            columns.extend(energies[..kept].iter().map(|(_, column)| *column));
        }
        columns.sort_unstable();
        columns.dedup();
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::sync::Arc;

    use protocol::{PoseId, StateId};

    use crate::cache::{Cache, Region};
    use crate::character::{Character, StepOutcome, decode};
    use crate::shared::Stage;
    use crate::tiny;
    use crate::version::View;

    /// The initial graph, of whose two columns the second carries most; a tier of 16 is stated to
    /// cost 30 mm.
    fn enter() -> Character {
        let version = tiny::version(1, tiny::initial_links());
        let mut cache = Cache::new(1 << 20);
        let rows = (0..4).flat_map(tiny::coefficients).collect();
        let region =
            Region::new(StateId(0), 2, rows).with_tiers(&[1], Some([0.03, 0.02, 0.01, 0.0]));
        cache.insert(tiny::region_chunk(0), vec![region], true, &BTreeSet::new());
        let stage = Arc::new(Stage::default());
        let resident = Arc::new(cache.snapshot());
        stage.show(Arc::new(View { version, resident, upsampled: None, probes: None }));
        Character::enter(&stage).unwrap()
    }

    #[test]
    fn a_tier_decodes_its_columns_states_its_error_and_keeps_offsets() {
        let mut character = enter();
        character.set_tier(16);
        assert_eq!(character.step(PoseId(1)), StepOutcome::Exact);
        assert_eq!((character.active_columns(), character.tier_error_m()), (1, 0.03));
        assert!((character.shown_error_m() - 0.03).abs() < 1e-6);
        let mut out = [9.0; 3];
        decode(&[&character], 0..3, usize::MAX, &mut out).unwrap();
        let y = tiny::SCALE_M * tiny::fractions(1)[1];
        assert!(out[0] == 0.0 && (out[1] - y).abs() < 1e-3, "{out:?}");
        // A merge: its offset moves both columns.
        character.step(PoseId(0));
        assert_eq!(character.active_columns(), 2);
        character.set_tier(129);
        character.step(PoseId(1));
        assert_eq!((character.active_columns(), character.tier_error_m()), (2, 0.0));
    }
}

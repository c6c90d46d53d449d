//! The dial: fewer columns, at an error that the publisher measured.

use codec::kernel::Select;
use codec::toile::TIERS;
use protocol::StateId;

use super::Character;
use crate::cache::TierColumns;

/// How a tier is chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Choice {
    /// All columns.
    All,
    /// So many columns.
    Columns(usize),
    /// As few as keep within this error (m).
    Within(f32),
}

/// Which columns are decoded.
#[derive(Debug)]
pub(super) struct Active {
    choice: Choice,
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
        Self { choice: Choice::All, columns, own, energies, error_m: 0.0 }
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
        self.active.choice =
            if columns > TIERS[TIERS.len() - 1] { Choice::All } else { Choice::Columns(columns) };
    }

    /// Decodes as few columns as keep within an error (m): region by region the shortest tier whose stated
    /// error is not above it, else all of them; 0 means all. Otherwise as [`Character::set_tier`], which
    /// this replaces.
    pub fn set_error_allowed(&mut self, error_m: f32) {
        self.active.choice = if error_m > 0.0 { Choice::Within(error_m) } else { Choice::All };
    }

    /// The tier of so many columns for a state and what it costs; `None` where the state is not resident or its
    /// publisher states no tiers.
    pub fn tier_of(&self, state: StateId, columns: usize) -> Option<TierColumns<'_>> {
        self.view.resident.tier(state, columns)
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
        let Active { choice, columns, own, energies, error_m } = &mut self.active;
        columns.clear();
        own.swap(0, 1);
        own[0].clear();
        *error_m = 0.0;
        let resident = &self.view.resident;
        let stated = shown.and_then(|state| match *choice {
            Choice::All => None,
            Choice::Columns(columns) => resident.tier(state, columns),
            Choice::Within(error_m) => Some(resident.tier_within(state, error_m)),
        });
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
        let kept = energies.len().min(stated.columns.len());
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
        let mut character = enter();
        for (allowed_m, stated_m) in [(0.03, 0.03), (0.029, 0.02), (0.005, 0.0), (0.0, 0.0)] {
            character.set_error_allowed(allowed_m);
            character.place(StateId(1));
            assert!((character.tier_error_m() - stated_m).abs() < 1e-6, "{allowed_m}");
        }
    }
}

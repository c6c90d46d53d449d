//! From states to the columns of a generation, in either profile.

use codec::toile::{self, Column, GenerationParts, Tree};
use faer::Mat;

use super::basis::{Columns, StreamingSvd};
use super::design::{BOUND_M_MIN, Design, Spectrum};
use super::encode::{EncodeError, EncodeSettings, Profile, Visit};
use super::statistics::Statistics;
use super::wide::wide_columns;
use super::{fixed_bits, order};

/// Largest entry that is aimed at: room is left for what prediction rounds up.
const ENTRY_MAX: f64 = 32_000.0;

/// Columns that span the states, and what the states' coefficients over them do.
pub(super) struct Analysis {
    pub(super) columns: Mat<f64>,
    pub(super) statistics: Statistics,
}

impl Analysis {
    /// At most `rank` columns over all states that `visit` shows, which is called twice.
    pub(super) fn new(
        rows: usize,
        rank: usize,
        visit: &mut Visit<'_>,
    ) -> Result<Self, EncodeError> {
        let mut svd = StreamingSvd::new(rows, rank);
        visit(&mut |region| Ok(region.chunks_exact(rows).try_for_each(|s| svd.push(s))?))?;
        Self::of(rows, svd.finish()?, visit)
    }

    /// The same for many columns; `visit` is called five times.
    pub(super) fn wide(
        rows: usize,
        rank: usize,
        visit: &mut Visit<'_>,
    ) -> Result<Self, EncodeError> {
        let columns = wide_columns(rows, rank, visit)?;
        Self::of(rows, columns, visit)
    }

    fn of(rows: usize, columns: Columns, visit: &mut Visit<'_>) -> Result<Self, EncodeError> {
        let Columns { columns, .. } = columns;
        let mut statistics = Statistics::new(columns.ncols());
        visit(&mut |region| {
            let states = region.len() / rows;
            let block = Mat::from_fn(rows, states, |row, s| f64::from(region[s * rows + row]));
            statistics.push((columns.transpose() * &block).as_ref(), block.squared_norm_l2());
            Ok(())
        })?;
        Ok(Self { columns, statistics })
    }

    /// The order of vertices, by the column that carries most: nearly the mean shape.
    pub(super) fn tree(&self) -> Tree {
        if self.columns.ncols() == 0 {
            return Tree::sequence(self.columns.nrows() / 3);
        }
        let scale = self.statistics.power_m2(0).sqrt();
        let shape: Vec<f64> = self.columns.col_as_slice(0).iter().map(|b| b * scale).collect();
        order::tree(&shape)
    }

    /// What a design needs to know. `states` will share the basis.
    pub(super) fn spectrum(&self, tree: &Tree, states: u64) -> Spectrum {
        let columns = self.columns.ncols();
        let vertices = self.columns.nrows() / 3;
        let power_m2: Vec<f64> = (0..columns).map(|c| self.statistics.power_m2(c)).collect();
        let mean_m2 = self.statistics.energy_m2() / self.statistics.states().max(1) as f64;
        let rest_m2 = (mean_m2 - power_m2.iter().sum::<f64>()).max(0.0) / vertices as f64;
        Spectrum {
            vertices,
            states: states.max(self.statistics.states()),
            rest_m2,
            sizes_m: (0..columns).map(|c| self.statistics.size_m(c)).collect(),
            roughness: (0..columns)
                .map(|c| roughness(tree, self.columns.col_as_slice(c)))
                .collect(),
            power_m2,
        }
    }

    /// A generation of profile `kim2013` of the `rank` leading columns.
    pub(super) fn kim2013(
        &self,
        rank: usize,
        headroom: f32,
    ) -> Result<Option<Vec<u8>>, EncodeError> {
        let rank = rank.min(self.columns.ncols());
        let maxima: Vec<f64> = (0..rank).map(|c| self.statistics.max_m(c)).collect();
        fixed_bits::generation(self.columns.as_ref().subcols(0, rank), &maxima, headroom)
    }

    /// A generation of profile `toile`, columns `from..` of the design's rank.
    pub(super) fn toile(
        &self,
        design: &Design,
        how: &ToileColumns<'_>,
    ) -> Result<Option<Vec<u8>>, EncodeError> {
        let step_m = f64::from(toile::step_m(design.step));
        let exists = |c: &usize| self.statistics.power_m2(*c) > 0.0;
        let chosen: Vec<usize> =
            (how.from..design.rank.min(self.columns.ncols())).filter(exists).collect();
        if chosen.is_empty() {
            return Ok(None);
        }
        let mut columns: Vec<Column> =
            chosen.iter().map(|c| self.statistics.column(*c, how.headroom, step_m)).collect();
        let reach = chosen.iter().zip(&columns).map(|(c, column)| {
            let entries = self.columns.col_as_slice(*c).iter();
            f64::from(column.maximum_m) * entries.fold(0.0f64, |max, b| max.max(b.abs()))
        });
        let entry_m = reach.fold(0.0, f64::max) / ENTRY_MAX;
        let entry_m = entry_m.max(design.share_m).max(f64::from(BOUND_M_MIN) * 1e-3) as f32;
        let mut values_m = Vec::with_capacity(chosen.len() * self.columns.nrows());
        for (c, column) in chosen.iter().zip(&mut columns) {
            let maximum_m = f64::from(column.maximum_m);
            let rounding_m = design.share_m * maximum_m / self.statistics.power_m2(*c).sqrt();
            column.multiple = (rounding_m / f64::from(entry_m)).clamp(1.0, 255.0) as u8;
            let source = self.columns.col_as_slice(*c).iter();
            values_m.extend(source.map(|b| (b * maximum_m) as f32));
        }
        let parts = GenerationParts {
            step_m: entry_m,
            columns: &columns,
            values_m: &values_m,
            step: design.step,
            states: u32::try_from(how.states).unwrap_or(u32::MAX),
            rms_m: how.rms_m as f32,
            tree: how.tree,
            with_tree: how.with_tree,
        };
        let mut bytes = Vec::new();
        toile::encode_generation(&parts, &mut bytes)?;
        Ok(Some(bytes))
    }
}

/// How to write columns in profile `toile`.
pub(super) struct ToileColumns<'a> {
    pub(super) tree: &'a Tree,
    pub(super) with_tree: bool,
    pub(super) headroom: f32,
    /// First column.
    pub(super) from: usize,
    /// The error that is designed for (m).
    pub(super) rms_m: f64,
    /// States at this moment.
    pub(super) states: u64,
}

/// Mean size of an entry's distance from the mean of its parents.
fn roughness(tree: &Tree, column: &[f64]) -> f64 {
    let order = tree.order();
    let mut sum = 0.0;
    for (place, vertex) in order.iter().enumerate() {
        let parents = tree.parents(place);
        for axis in 0..3 {
            let at = |v: u32| column[3 * v as usize + axis];
            let near: f64 = parents.iter().map(|p| at(order[*p as usize])).sum();
            sum += (at(*vertex) - near / parents.len().max(1) as f64).abs();
        }
    }
    sum / column.len() as f64
}

/// The first generations of a garment: one of profile `kim2013`; of profile `toile` one of the
/// leading columns, which is small enough to be there at once, and one of the others.
///
/// # Errors
/// No basis; whatever `visit` returns; states without extent.
pub(super) fn first_generations(
    rows: usize,
    states: u64,
    settings: &EncodeSettings,
    visit: &mut Visit<'_>,
) -> Result<Vec<Vec<u8>>, EncodeError> {
    let analysis = Analysis::new(rows, settings.rank_max, visit)?;
    let made = match settings.profile {
        Profile::Kim2013 => {
            analysis.kim2013(settings.rank_max, settings.headroom)?.into_iter().collect()
        }
        Profile::Toile => {
            let tree = analysis.tree();
            let spectrum = analysis.spectrum(&tree, settings.states_expected);
            let rms_m = settings.bound.design_rms_m();
            let design = spectrum.design(rms_m);
            let headroom = settings.headroom;
            let how =
                ToileColumns { tree: &tree, with_tree: true, headroom, from: 0, rms_m, states };
            toile_generations(&analysis, &design, how)?
        }
    };
    if made.is_empty() { Err(EncodeError::Nothing) } else { Ok(made) }
}

/// Columns of the first of a garment's generations in profile `toile`.
const LEADING_COLUMNS: usize = 24;

/// All columns of a design, in two generations where there are many.
pub(super) fn toile_generations(
    analysis: &Analysis,
    design: &Design,
    mut how: ToileColumns<'_>,
) -> Result<Vec<Vec<u8>>, EncodeError> {
    let leading = Design { rank: design.rank.min(LEADING_COLUMNS), ..*design };
    let mut made: Vec<Vec<u8>> = analysis.toile(&leading, &how)?.into_iter().collect();
    if leading.rank < design.rank && !made.is_empty() {
        (how.with_tree, how.from) = (false, leading.rank);
        made.extend(analysis.toile(design, &how)?);
    }
    Ok(made)
}

/// A generation that is appended for what the columns so far leave of some regions, in order.
/// `None` where nothing is left that is worth a column.
///
/// # Errors
/// As for [`first_generations`].
pub(super) fn appended_generation(
    rows: usize,
    columns_max: usize,
    settings: &EncodeSettings,
    known: Option<(&Tree, u8, f64)>,
    visit: &mut Visit<'_>,
) -> Result<Option<Vec<u8>>, EncodeError> {
    let analysis = Analysis::new(rows, columns_max, visit)?;
    let Some((tree, step, rms_m)) = known else {
        return analysis.kim2013(columns_max, settings.headroom);
    };
    let columns = analysis.columns.ncols();
    // What falls outside is rare: its columns may be as coarse as what they leave.
    let share_m = rms_m * (0.25 / columns.max(1) as f64).sqrt();
    let (basis_bytes, state_bytes) = (0.0, 0.0);
    let design = Design { rank: columns, step, share_m, basis_bytes, state_bytes, rms_m };
    let headroom = settings.headroom;
    let states = analysis.statistics.states();
    let how = ToileColumns { tree, with_tree: false, headroom, from: 0, rms_m, states };
    analysis.toile(&design, &how)
}

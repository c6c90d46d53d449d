//! First cloth: what the leading columns show while the rest of the basis is on its way.

use std::sync::Arc;

use codec::Decoder;
use protocol::VersionNumber;
use protocol::manifest::GarmentVersion;
use protocol::region::RegionEntry;

use super::{GarmentLoader, PartsSoFar};
use crate::cache::{Cache, Region};
use crate::version::{Version, View};

/// What first cloth was shown with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FirstCloth {
    /// Bytes of the generations that were here.
    pub basis_bytes: u64,
    /// Their columns.
    pub columns: usize,
    /// Columns of all generations listed.
    pub all_columns: usize,
    /// Largest vertex error (m) of the initial graph's states with these columns, as the publisher
    /// measured it.
    pub error_m: f32,
}

impl GarmentLoader {
    /// What first cloth was shown with, once.
    pub fn take_first_cloth(&mut self) -> Option<(String, FirstCloth)> {
        let (_, next) = self.next.as_ref()?;
        Some((next.name.clone(), self.first_cloth.take()?))
    }

    /// Shows the leading columns of the first version to come, where all but later generations is
    /// here. What does not fit together is left to the whole version to name.
    pub(super) fn show_first_cloth(&mut self) {
        if self.current.is_some() || self.first_shown {
            return;
        }
        let Some((number, next)) = &self.next else { return };
        let shown = leading_view(&mut self.parts, *number, next, self.budget_bytes);
        if let Some((view, first)) = shown {
            self.first_shown = true;
            self.first_cloth = Some(first);
            self.stage.show(Arc::new(view));
        }
    }
}

/// A view of the leading generations; `None` where anything else is lacking, or where a region does
/// not state what they alone show.
fn leading_view(
    parts: &mut PartsSoFar,
    number: VersionNumber,
    next: &GarmentVersion,
    budget_bytes: usize,
) -> Option<(View, FirstCloth)> {
    let listed = next.generations.iter();
    let here: Vec<&Vec<u8>> = listed.map_while(|g| parts.generations.get(&g.chunk.hash)).collect();
    let later = &next.generations[here.len()..];
    let mut lacking = 0;
    parts.lacking(next, |chunk| lacking += usize::from(later.iter().all(|g| g.chunk != chunk)));
    let initial = || next.regions.iter().filter(|region| region.initial);
    lacking += initial().filter(|r| !parts.regions.contains_key(&r.chunk.hash)).count();
    if here.is_empty() || later.is_empty() || lacking > 0 {
        return None;
    }
    let mut decoder = Decoder::new(&next.codec)?;
    here.iter().try_for_each(|bytes| decoder.append(bytes)).ok()?;
    let basis_bytes = here.iter().map(|bytes| bytes.len() as u64).sum();
    let mut cache = Cache::new(budget_bytes);
    let mut error_m = 0.0f32;
    for region in initial() {
        let chunk = region.chunk.hash;
        let (entries, _) = parts.regions.get(&chunk)?;
        let decode = |entry| leading_region(&decoder, entry);
        let (regions, errors_m): (Vec<Region>, Vec<f32>) =
            entries.regions.iter().map(decode).collect::<Option<Vec<_>>>()?.into_iter().unzip();
        error_m = errors_m.into_iter().fold(error_m, f32::max);
        cache.insert(chunk, regions, true, &std::collections::BTreeSet::new());
    }
    let basis = Arc::new(decoder.basis().clone());
    let columns = basis.columns();
    let version = Version::assemble(parts.with_basis(number, next.clone(), basis).ok()?).ok()?;
    let all_columns = columns + version.columns_to_come();
    let resident = Arc::new(cache.snapshot());
    let first = FirstCloth { basis_bytes, columns, all_columns, error_m };
    let version = Arc::new(version);
    Some((View { version, resident, upsampled: None, probes: None }, first))
}

/// A region's leading columns, and their error (m).
fn leading_region(decoder: &Decoder, entry: &RegionEntry) -> Option<(Region, f32)> {
    let region = decoder.region(&entry.bytes).ok()?;
    if region.states != usize::from(entry.state_count) {
        return None;
    }
    let error_m = if region.is_whole { 0.0 } else { region.leading_error_m? };
    let decoded = Region::new(entry.first_state, region.columns, region.coefficients)
        .with_fixes(region.fixes);
    Some((if region.is_whole { decoded } else { decoded.of_leading_columns(error_m) }, error_m))
}

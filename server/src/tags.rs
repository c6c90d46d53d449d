//! Tags into the store: one object each, never changed, in order of number.

use protocol::message::TagOutcome;
use protocol::tag::Tag;
use protocol::{GarmentId, StateId};

use crate::shared::Shared;

/// Keeps a tag under the next free number.
pub(crate) async fn keep(shared: &Shared, garment: GarmentId, state: StateId) -> TagOutcome {
    let Some(version) = shared.has_state(garment, state) else { return TagOutcome::Unknown };
    let bytes = Tag { garment, state, version }.encode();
    match shared.source.add_tag(&bytes).await {
        Ok(Some(number)) => {
            tracing::info!(number, %garment, %state, %version, "a merge was tagged");
            TagOutcome::Kept { number }
        }
        Ok(None) => TagOutcome::Failed,
        Err(error) => {
            tracing::warn!(%error, "a tag was not kept");
            shared.metrics.store_failures.inc();
            TagOutcome::Failed
        }
    }
}

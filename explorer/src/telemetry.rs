//! What players walked, as servers left it in the store.

use std::collections::BTreeMap;

use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};
use protocol::telemetry::TelemetryBatch;
use protocol::{EdgeId, GarmentId, limits, store};

/// Batches read at once: a store that collected for a month is not read from its beginning.
const BATCHES_MAX: u64 = 360;
/// Batches that [`walked_ever`] reads: of a store that collected for longer, the newest.
const EVER_BATCHES_MAX: u64 = 100_000;

/// Counts of one garment's edges, and the newest batch they come from.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Walked {
    /// Number of the newest batch that was read; 0 for none.
    pub newest: u64,
    /// Traversals by edge.
    pub counts: BTreeMap<EdgeId, u64>,
}

/// Reads the batches behind number `after` of one garment. A batch that cannot be understood is passed over; it
/// costs its counts, never the run.
///
/// # Errors
/// The store cannot be read.
pub async fn walked_since(
    from: &dyn ObjectStore,
    garment: GarmentId,
    after: u64,
) -> Result<Walked, object_store::Error> {
    let mut walked = Walked { newest: after, ..Walked::default() };
    if after == 0 {
        walked.newest = newest(from).await?.saturating_sub(BATCHES_MAX);
    }
    read(from, garment, BATCHES_MAX, walked).await
}

/// Reads all batches of one garment there are, the newest 100,000 at most. One that cannot be understood is
/// passed over.
///
/// # Errors
/// The store cannot be read.
pub async fn walked_ever(
    from: &dyn ObjectStore,
    garment: GarmentId,
) -> Result<Walked, object_store::Error> {
    let before = newest(from).await?.saturating_sub(EVER_BATCHES_MAX);
    let walked = Walked { newest: before, ..Walked::default() };
    read(from, garment, EVER_BATCHES_MAX, walked).await
}

/// Adds the batches behind the newest one of `walked`, at most so many.
async fn read(
    from: &dyn ObjectStore,
    garment: GarmentId,
    most: u64,
    mut walked: Walked,
) -> Result<Walked, object_store::Error> {
    for number in walked.newest + 1..=walked.newest + most {
        let bytes = match from.get(&Path::from(store::telemetry_path(number))).await {
            Ok(found) if found.meta.size <= limits::CHUNK_BYTES_MAX as u64 => found.bytes().await?,
            Ok(_) => Default::default(),
            Err(object_store::Error::NotFound { .. }) => break,
            Err(error) => return Err(error),
        };
        walked.newest = number;
        match TelemetryBatch::decode(&bytes) {
            Ok(batch) => {
                let ours = batch.garments.iter().filter(|counts| counts.garment == garment);
                for (edge, count) in ours.flat_map(|counts| &counts.edges) {
                    let sum = walked.counts.entry(*edge).or_default();
                    *sum = sum.saturating_add(*count);
                }
            }
            Err(error) => tracing::warn!(number, %error, "a batch of telemetry is passed over"),
        }
    }
    Ok(walked)
}

async fn newest(from: &dyn ObjectStore) -> Result<u64, object_store::Error> {
    use futures::TryStreamExt;
    let listed = from.list(Some(&Path::from(store::TELEMETRY)));
    let numbers = listed.try_fold(0, |newest: u64, meta| {
        let number = store::telemetry_of_path(meta.location.as_ref()).unwrap_or(0);
        futures::future::ready(Ok(newest.max(number)))
    });
    numbers.await
}

#[cfg(test)]
mod tests {
    use object_store::memory::InMemory;
    use protocol::telemetry::GarmentCounts;

    use super::*;

    #[tokio::test]
    async fn batches_add_up_and_a_broken_one_is_passed_over() {
        let memory = InMemory::new();
        let batch = |garment: u32, count: u64| {
            let edges = vec![(EdgeId(3), count), (EdgeId(9), 1)];
            let garments = vec![GarmentCounts { garment: GarmentId(garment), edges }];
            TelemetryBatch { garments }.encode()
        };
        let bodies = [batch(0, 5), batch(1, 100), b"?".to_vec(), batch(0, u64::MAX)];
        for (number, bytes) in (1..).zip(bodies) {
            memory.put(&Path::from(store::telemetry_path(number)), bytes.into()).await.unwrap();
        }
        let all = walked_since(&memory, GarmentId(0), 0).await.unwrap();
        assert_eq!((all.newest, all.counts[&EdgeId(3)], all.counts[&EdgeId(9)]), (4, u64::MAX, 2));
        let rest = walked_since(&memory, GarmentId(1), 2).await.unwrap();
        assert_eq!((rest.newest, rest.counts.len()), (4, 0));
        // A certificate tells of all that players walked, not of the last hour.
        for number in 5..=500 {
            let path = Path::from(store::telemetry_path(number));
            memory.put(&path, batch(1, 1).into()).await.unwrap();
        }
        let recent = walked_since(&memory, GarmentId(1), 0).await.unwrap();
        let ever = walked_ever(&memory, GarmentId(1)).await.unwrap();
        assert_eq!((recent.newest, recent.counts[&EdgeId(3)]), (500, BATCHES_MAX));
        assert_eq!((ever.newest, ever.counts[&EdgeId(3)]), (500, 100 + 496));
        let nothing = walked_since(&InMemory::new(), GarmentId(0), 0).await.unwrap();
        assert_eq!(nothing, Walked::default());
    }
}

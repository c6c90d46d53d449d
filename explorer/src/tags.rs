//! Merges that people pointed at, as servers left them in the store.

use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};
use protocol::tag::Tag;
use protocol::{GarmentId, StateId, store};

/// Tags read at once; the others come with the next look.
const TAGS_MAX: u64 = 256;
/// More bytes than any tag has.
const BYTES_MAX: u64 = 4096;

/// Tagged dead ends of one garment, and the number of the newest tag that was read.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Tagged {
    /// Number of the newest tag that was read; 0 for none.
    pub newest: u64,
    /// The dead ends, in order of their tags.
    pub states: Vec<StateId>,
}

/// Reads the tags behind number `after`. One that cannot be understood is passed over.
///
/// # Errors
/// The store cannot be read.
pub async fn tagged_since(
    from: &dyn ObjectStore,
    garment: GarmentId,
    after: u64,
) -> Result<Tagged, object_store::Error> {
    let mut tagged = Tagged { newest: after, states: Vec::new() };
    for number in after + 1..=after.saturating_add(TAGS_MAX) {
        let bytes = match from.get(&Path::from(store::tag_path(number))).await {
            Ok(found) if found.meta.size <= BYTES_MAX => found.bytes().await?,
            Ok(_) => Default::default(),
            Err(object_store::Error::NotFound { .. }) => break,
            Err(error) => return Err(error),
        };
        tagged.newest = number;
        match Tag::decode(&bytes) {
            Ok(tag) if tag.garment == garment => tagged.states.push(tag.state),
            Ok(_) => {}
            Err(error) => tracing::warn!(number, %error, "a tag is passed over"),
        }
    }
    Ok(tagged)
}

#[cfg(test)]
mod tests {
    use object_store::memory::InMemory;
    use protocol::VersionNumber;

    use super::*;

    #[tokio::test]
    async fn tags_come_in_order_and_a_broken_one_is_passed_over() {
        let memory = InMemory::new();
        let tag = |garment, state| {
            let (garment, state) = (GarmentId(garment), StateId(state));
            Tag { garment, state, version: VersionNumber(1) }.encode()
        };
        for (number, bytes) in (1..).zip([tag(0, 9), tag(1, 5), b"?".to_vec(), tag(0, 4)]) {
            memory.put(&Path::from(store::tag_path(number)), bytes.into()).await.unwrap();
        }
        let all = tagged_since(&memory, GarmentId(0), 0).await.unwrap();
        assert_eq!(all, Tagged { newest: 4, states: vec![StateId(9), StateId(4)] });
        let rest = tagged_since(&memory, GarmentId(0), 3).await.unwrap();
        assert_eq!(rest.states, [StateId(4)]);
        let nothing = tagged_since(&InMemory::new(), GarmentId(0), 7).await.unwrap();
        assert_eq!(nothing, Tagged { newest: 7, states: Vec::new() });
    }
}

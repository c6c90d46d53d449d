//! Notices new versions in the store.

use std::time::Duration;

use protocol::{PublisherKey, VersionNumber};

use crate::shared::{Shared, lock};
use crate::store::ReadError;

/// Every so many looks the store is listed, in case numbers were skipped; in between only the next
/// number is tried, which costs the same however many versions there are.
const LOOKS_PER_LISTING: u32 = 40;

/// A store that has not answered for so long has failed.
const PATIENCE: Duration = Duration::from_secs(30);

/// Looks for new versions every `interval`, and whenever `Shared::look` says so.
pub(crate) async fn watch(shared: &Shared, interval: Duration) {
    let mut stop = shared.stop.subscribe();
    let mut looker = Looker { shared, tried: None, looks: 0, failing: false };
    loop {
        looker.look().await;
        tokio::select! {
            _ = stop.wait_for(|stop| *stop) => return,
            () = tokio::time::sleep(interval) => {}
            () = shared.look.notified() => {}
        }
    }
}

struct Looker<'a> {
    shared: &'a Shared,
    /// The newest version that was served or refused.
    tried: Option<VersionNumber>,
    looks: u32,
    /// The store failed last time: say so once, not at every look.
    failing: bool,
}

impl Looker<'_> {
    async fn look(&mut self) {
        let advanced = match tokio::time::timeout(PATIENCE, self.advance()).await {
            Ok(advanced) => advanced.map_err(|error| error.to_string()),
            Err(_) => Err(format!("the store has not answered for {PATIENCE:?}")),
        };
        *lock(&self.shared.failing) = advanced.as_ref().err().cloned();
        match advanced {
            Ok(()) if self.failing => {
                tracing::info!("the store can be read again");
                self.failing = false;
            }
            Ok(()) => {}
            Err(error) => {
                self.shared.metrics.store_failures.inc();
                if !std::mem::replace(&mut self.failing, true) {
                    tracing::warn!(%error, "cannot look for new versions");
                }
            }
        }
    }

    async fn advance(&mut self) -> Result<(), ReadError> {
        let source = &self.shared.source;
        let known = self.shared.head.borrow().publisher;
        let publisher = match known {
            Some(publisher) => publisher,
            None => {
                let Some(found) = source.publisher().await? else { return Ok(()) };
                self.shared.head.send_modify(|head| head.publisher = Some(found));
                found
            }
        };
        if self.looks.is_multiple_of(LOOKS_PER_LISTING) {
            // Newest first: where that one is bad, the one before it is served.
            let listed = source.versions(self.tried).await?;
            for number in &listed {
                if self.try_version(*number, &publisher).await? == Some(true) {
                    break;
                }
            }
            self.tried = self.tried.max(listed.first().copied());
        }
        self.looks = self.looks.wrapping_add(1);
        loop {
            let next = VersionNumber(self.tried.map_or(0, |tried| tried.0).saturating_add(1));
            if self.try_version(next, &publisher).await?.is_none() {
                return Ok(());
            }
            self.tried = Some(next);
        }
    }

    /// Serves a version if it is good; `None` where there is none.
    async fn try_version(
        &self,
        number: VersionNumber,
        publisher: &PublisherKey,
    ) -> Result<Option<bool>, ReadError> {
        match self.shared.source.version(number, publisher).await {
            Ok(None) => Ok(None),
            Ok(Some(signed)) => {
                self.shared.publish(signed);
                Ok(Some(true))
            }
            Err(error @ ReadError::BadManifest { .. }) => {
                tracing::error!(%error, "passed over");
                self.shared.metrics.bad_manifests.inc();
                Ok(Some(false))
            }
            Err(error) => Err(error),
        }
    }
}

//! Where the driver leaves views and the frame loop picks them up, and where the frame loop says
//! where its cursors stand. Neither side ever waits for the other on the frame loop's side.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError, Weak};

use protocol::StateId;

use crate::telemetry::Mailbox;
use crate::version::View;

/// Old views the driver keeps until no character holds them, so that their memory is given back
/// on the driver's thread and not within a frame.
const RETIRED_VIEWS_MAX: usize = 64;

/// The newest view of one garment, and the cursors that play it.
#[derive(Debug, Default)]
pub struct Stage {
    view: Mutex<Option<Arc<View>>>,
    /// Counts up with each view: a character looks no further while it has not changed.
    serial: AtomicU64,
    retired: Mutex<Vec<Arc<View>>>,
    cursors: Mutex<Vec<Weak<Cursor>>>,
    mailbox: Mailbox,
}

/// Where a character stands: read by the driver, written by the frame loop.
#[derive(Debug)]
pub struct Cursor(AtomicU64);

impl Cursor {
    /// Moves it.
    pub fn set(&self, state: StateId) {
        self.0.store(state.0, Ordering::Relaxed);
    }

    /// Where it stands.
    pub fn state(&self) -> StateId {
        StateId(self.0.load(Ordering::Relaxed))
    }
}

impl Stage {
    /// Shows a new view: the next `step` of each character plays it.
    pub fn show(&self, view: Arc<View>) {
        let old = lock(&self.view).replace(view);
        self.serial.fetch_add(1, Ordering::Release);
        let mut retired = lock(&self.retired);
        retired.extend(old);
        retired.retain(|view| Arc::strong_count(view) > 1);
        let excess = retired.len().saturating_sub(RETIRED_VIEWS_MAX);
        retired.drain(..excess);
    }

    /// The view, for anyone who may wait.
    pub fn view(&self) -> Option<Arc<View>> {
        lock(&self.view).clone()
    }

    /// A view newer than the one that was given for `serial`, if there is one and the driver is
    /// not changing it in this very instant. Never waits.
    pub fn try_newer(&self, serial: &mut u64) -> Option<Arc<View>> {
        let newest = self.serial.load(Ordering::Acquire);
        if newest == *serial {
            return None;
        }
        let view = self.view.try_lock().ok()?.clone()?;
        *serial = newest;
        Some(view)
    }

    /// Where characters leave their counts.
    pub fn mailbox(&self) -> &Mailbox {
        &self.mailbox
    }

    /// Adds a cursor; it is gone when the last `Arc` of it is.
    pub fn enter(&self, state: StateId) -> Arc<Cursor> {
        let cursor = Arc::new(Cursor(AtomicU64::new(state.0)));
        lock(&self.cursors).push(Arc::downgrade(&cursor));
        cursor
    }

    /// Where all cursors stand.
    pub fn cursors(&self) -> Vec<StateId> {
        let mut cursors = lock(&self.cursors);
        cursors.retain(|cursor| cursor.strong_count() > 0);
        cursors.iter().filter_map(Weak::upgrade).map(|cursor| cursor.state()).collect()
    }
}

/// A panic elsewhere does not make these values wrong: each is replaced as a whole.
fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Stage {
    /// Holds the view's lock: what a character does meanwhile must not wait.
    #[cfg(test)]
    pub(crate) fn while_locked<T>(&self, act: impl FnOnce() -> T) -> T {
        let _held = lock(&self.view);
        act()
    }
}

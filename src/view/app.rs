//! What all pages share.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use client_lib::Client;

/// Pages at the same time.
const PAGES_MAX: u64 = 16;

/// What all pages share.
#[derive(Debug)]
pub struct App {
    /// The player behind the pages.
    pub client: Client,
    /// The server's own page, where there is one.
    pub server_page: Option<String>,
    pages: AtomicU64,
    exploring: Mutex<String>,
}

impl App {
    /// Pages on a client.
    pub fn new(client: Client, server_page: Option<String>) -> Self {
        Self { client, server_page, pages: AtomicU64::new(0), exploring: Mutex::default() }
    }

    /// The garment that is shown; `None`: the first.
    pub fn garment(&self) -> Option<&str> {
        None
    }

    /// What the explorer in this process last said, for pages that wait.
    pub fn exploring(&self) -> String {
        self.exploring.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// What the explorer in this process says now.
    pub fn set_exploring(&self, said: String) {
        *self.exploring.lock().unwrap_or_else(PoisonError::into_inner) = said;
    }

    /// Pages that are open.
    pub fn pages(&self) -> u64 {
        self.pages.load(Ordering::SeqCst)
    }
}

/// A page's place, left when dropped.
#[derive(Debug)]
pub struct Place(Arc<App>);

impl Place {
    /// `None` where all are taken.
    pub fn take(app: &Arc<App>) -> Option<Self> {
        let taken = app.pages.fetch_add(1, Ordering::SeqCst);
        let place = Self(Arc::clone(app));
        (taken < PAGES_MAX).then_some(place)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.0.pages.fetch_sub(1, Ordering::SeqCst);
    }
}

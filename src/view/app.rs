//! What all pages share: the player behind them, older versions, what was tagged.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use client_lib::{Client, ClientConfig, GarmentId, TagOutcome, VersionNumber};
use serde::Serialize;

use super::stand_in::Bare;
use super::survey::{Loop, Survey};

/// Pages at the same time.
pub const PAGES_MAX: u64 = 16;
/// How long an older version may take to come.
const OLDER_MAX: Duration = Duration::from_secs(20);
/// How long a server may take to answer a tag.
const TAG_MAX: Duration = Duration::from_secs(5);
/// Tags that the pages keep an eye on.
const TAGS_MAX: usize = 64;
/// Less than this is no fall (mm).
const FALL_MM: f32 = 0.05;

/// What all pages share.
#[derive(Debug)]
pub struct App {
    /// The player behind the pages.
    pub client: Client,
    /// The server's own page, where there is one.
    pub server_page: Option<String>,
    connection: ClientConfig,
    may_tag: bool,
    pages: AtomicU64,
    exploring: Mutex<String>,
    bare: Option<Arc<Bare>>,
    older: Mutex<Vec<(u64, Weak<Client>)>>,
    tags: Mutex<Vec<Tag>>,
}

/// A merge that was tagged, and what became of the walk around it.
#[derive(Debug, Clone, Serialize)]
pub struct Tag {
    dead_end: u64,
    /// The worst merge on that walk, when it was tagged (mm),
    first_mm: f32,
    /// and in the newest version (mm).
    now_mm: f32,
    /// How long after the tag the page had the version in which it fell (s).
    after_s: f64,
    /// Its number in the store's audit trail.
    number: u64,
    #[serde(skip)]
    around: Loop,
    #[serde(skip)]
    since: Instant,
}

impl App {
    /// Pages on a connection. `may_tag`: whether its token has that right; `bare`: what walks
    /// until there is a version.
    ///
    /// # Errors
    /// The connection's settings cannot be used.
    pub fn new(
        connection: ClientConfig,
        server_page: Option<String>,
        may_tag: bool,
        bare: Option<Bare>,
    ) -> Result<Self> {
        Ok(Self {
            client: Client::connect(connection.clone())?,
            server_page,
            connection,
            may_tag,
            pages: AtomicU64::new(0),
            exploring: Mutex::default(),
            bare: bare.map(Arc::new),
            older: Mutex::default(),
            tags: Mutex::default(),
        })
    }

    /// The garment that is shown; `None`: the first.
    pub fn garment(&self) -> Option<&str> {
        None
    }

    /// Whether merges can be tagged.
    pub fn may_tag(&self) -> bool {
        self.may_tag
    }

    /// The scene, where it is explored in this process.
    pub fn bare(&self) -> Option<&Arc<Bare>> {
        self.bare.as_ref()
    }

    /// What the explorer in this process last said, for pages that wait.
    pub fn exploring(&self) -> String {
        lock(&self.exploring).clone()
    }

    /// What the explorer in this process says now.
    pub fn set_exploring(&self, said: String) {
        *lock(&self.exploring) = said;
    }

    /// Pages that are open.
    pub fn pages(&self) -> u64 {
        self.pages.load(Ordering::SeqCst)
    }

    /// A connection that plays a version by number, shared by whoever looks at it.
    ///
    /// # Errors
    /// The version does not come in time.
    pub fn pinned(&self, number: u64) -> Result<Arc<Client>> {
        let mut older = lock(&self.older);
        older.retain(|(_, client)| client.strong_count() > 0);
        let known = older.iter().find(|(known, _)| *known == number);
        if let Some(client) = known.and_then(|(_, client)| client.upgrade()) {
            return Ok(client);
        }
        let version = Some(VersionNumber(number));
        let client = Client::connect(ClientConfig { version, ..self.connection.clone() })?;
        client
            .wait_ready(OLDER_MAX)
            .with_context(|| format!("version {number} cannot be shown"))?;
        let client = Arc::new(client);
        older.push((number, Arc::downgrade(&client)));
        Ok(client)
    }

    /// Tags the merge that a walk leads through, and watches the walk from now on. `first_mm`: the
    /// worst merge on it.
    ///
    /// # Errors
    /// The server does not keep the tag.
    pub fn tag(&self, garment: GarmentId, around: Loop, first_mm: f32) -> Result<()> {
        let dead_end = around.dead_end;
        if lock(&self.tags).iter().any(|tag| tag.dead_end == dead_end.0) {
            return Ok(());
        }
        let since = Instant::now();
        let number = match self.client.wait_tagged(garment, dead_end, TAG_MAX) {
            Some(TagOutcome::Kept { number }) => number,
            Some(TagOutcome::NotAllowed) => bail!("this server lets nobody tag with our token"),
            Some(TagOutcome::Unknown) => bail!("the server has no such merge any more"),
            Some(TagOutcome::TooMany) => bail!("too many tags in a row; wait a little"),
            Some(TagOutcome::Failed) => bail!("the server could not keep the tag; try again"),
            None => bail!("the server did not answer; try again"),
        };
        let mut tags = lock(&self.tags);
        if tags.len() >= TAGS_MAX {
            tags.remove(0);
        }
        let (dead_end, now_mm) = (dead_end.0, first_mm);
        tags.push(Tag { dead_end, first_mm, now_mm, after_s: 0.0, number, around, since });
        Ok(())
    }

    /// The tags, brought up to date with a version.
    pub fn tags(&self, survey: Option<&Survey>) -> Vec<Tag> {
        let mut tags = lock(&self.tags);
        for tag in tags.iter_mut() {
            let Some(survey) = survey else { continue };
            tag.now_mm = survey.worst_on(&tag.around);
            if tag.after_s == 0.0 && tag.now_mm < tag.first_mm - FALL_MM {
                tag.after_s = tag.since.elapsed().as_secs_f64();
            }
        }
        tags.clone()
    }
}

/// A panic elsewhere leaves plain values behind: go on with them.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
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

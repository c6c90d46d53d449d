//! The network: a thread of its own that drives the session's state machine over quinn, feeds the
//! loaders, and ends with the handle.

mod link;
mod missing;
mod tls;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use protocol::manifest::ChunkRef;
use protocol::message::{Priority, TagOutcome, Telemetry};
use protocol::session::{self, ClientEvent, Time};
use protocol::{ChunkHash, GarmentId, SignedManifest, VersionNumber};
use tokio::sync::mpsc;

use crate::client::{ClientConfig, Shared};
use crate::loader::{GarmentLoader, LoadError, Memory, Need};
use crate::shared::Stage;

pub use link::quic_config;
use link::{Dialer, Happened, Input, Link};
use missing::Missing;
pub use tls::Fingerprint;

/// How often cursors are looked at: well within a frame at 30 fps.
const TICK: Duration = Duration::from_millis(15);
/// How often counts are reported.
const REPORT: Duration = Duration::from_secs(2);
/// How long a goodbye may take.
const GOODBYE: Duration = Duration::from_millis(500);
/// Things that happened and were not yet looked at; beyond this the network waits.
const INPUTS_MAX: usize = 256;

/// Runs until the handle asks for an end.
pub(crate) fn run(config: ClientConfig, pin: Option<Fingerprint>, shared: &Arc<Shared>) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    match runtime {
        Ok(runtime) => {
            runtime.block_on(Driver::new(config, pin, Arc::clone(shared)).run());
            // A name that is being looked up must not hold the end.
            runtime.shutdown_background();
        }
        Err(error) => shared.update(|status| {
            status.error = Some(format!("the network thread could not be started: {error}"));
            status.is_final = true;
        }),
    }
}

struct Driver {
    config: ClientConfig,
    shared: Arc<Shared>,
    began: Instant,
    session: session::Client,
    dialer: Dialer,
    inputs: mpsc::Receiver<Input>,
    link: Option<Link>,
    /// Tells inputs of the current connection from those of one that is gone.
    epoch: u64,
    loaders: BTreeMap<GarmentId, GarmentLoader>,
    wanted: BTreeMap<ChunkHash, (ChunkRef, Need)>,
    missing: Missing,
    /// The version that all play, as it was told.
    shown: Option<VersionNumber>,
    versions_applied: u64,
    bytes_before: u64,
    reported: Instant,
    /// When it was last looked ahead; `None`: something has changed since.
    planned: Option<Instant>,
    /// The last request to look ahead that was answered.
    answered: u64,
    leaving: Option<Instant>,
    ended: bool,
}

impl Driver {
    fn new(config: ClientConfig, pin: Option<Fingerprint>, shared: Arc<Shared>) -> Self {
        let (sender, inputs) = mpsc::channel(INPUTS_MAX);
        let session = session::Client::new(session::ClientConfig {
            token: config.token.clone(),
            garments: config.garments.clone(),
            publisher: config.publisher,
            jitter_seed: config.jitter_seed,
            pin: config.version,
        });
        Self {
            dialer: Dialer::new(config.address.clone(), pin, sender),
            config,
            shared,
            began: Instant::now(),
            session,
            inputs,
            link: None,
            epoch: 0,
            loaders: BTreeMap::new(),
            wanted: BTreeMap::new(),
            missing: Missing::default(),
            shown: None,
            versions_applied: 0,
            bytes_before: 0,
            reported: Instant::now(),
            planned: None,
            answered: 0,
            leaving: None,
            ended: false,
        }
    }

    async fn run(mut self) {
        let shared = Arc::clone(&self.shared);
        let mut tick = tokio::time::interval(TICK);
        tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        self.session.handle_timeout(self.now());
        while !self.ended {
            self.work();
            if self.ended {
                break;
            }
            let timeout = self.session.poll_timeout().map(|at| self.began + micros(at));
            let timeout = timeout.unwrap_or_else(|| Instant::now() + Duration::from_secs(3600));
            tokio::select! {
                input = self.inputs.recv() => {
                    if let Some(input) = input {
                        self.handle_input(input);
                    }
                    // Take what else is there, so that views are made once for all of it.
                    while let Ok(input) = self.inputs.try_recv() {
                        self.handle_input(input);
                    }
                }
                () = tokio::time::sleep_until(timeout.into()) => {
                    self.session.handle_timeout(self.now());
                }
                _ = tick.tick() => {}
                () = shared.wake.notified() => {}
            }
        }
        if let Some(link) = self.link.take() {
            link.close(protocol::message::CloseCode::Done.number());
        }
        self.dialer.end(GOODBYE).await;
        self.shared.update(|status| {
            status.connected = false;
            status.is_final = true;
        });
    }

    fn now(&self) -> Time {
        Time(self.began.elapsed().as_micros() as u64)
    }

    /// Everything that can be done without waiting.
    fn work(&mut self) {
        let asked = self.shared.asked.load(Ordering::SeqCst);
        self.show_views();
        self.retry_missing();
        let due = self.planned.is_none_or(|at| at.elapsed() >= TICK);
        if due || asked > self.answered {
            self.planned = Some(Instant::now());
            self.plan(asked);
        }
        if self.reported.elapsed() >= REPORT {
            self.report();
        }
        for (garment, state) in self.shared.take_tags() {
            if !self.session.tag(garment, state) {
                self.shared.answer_tag(garment, state, TagOutcome::Failed);
            }
        }
        self.leave_if_asked();
        self.act();
        self.transmit();
        self.act();
        self.tell();
    }

    fn handle_input(&mut self, input: Input) {
        let now = self.now();
        if input.epoch != self.epoch {
            return;
        }
        match input.what {
            Happened::Connected(link) => {
                self.link = Some(link);
                self.session.handle_connected(now);
            }
            Happened::Lost { close, why } => self.lose(close.as_ref(), &why),
            Happened::Control(bytes) => self.session.handle_control(now, &bytes),
            Happened::Chunk { stream, bytes, end } => {
                self.session.handle_chunk(now, stream, &bytes, end);
            }
            Happened::ChunkReset { stream } => self.session.handle_chunk_reset(stream),
            Happened::Written => {}
        }
        self.act();
    }

    fn lose(&mut self, close: Option<&(u64, String)>, why: &str) {
        let now = self.now();
        if let Some(mismatch) = self.dialer.mismatch() {
            // No other try would end differently.
            self.fail(mismatch);
            self.session.close();
            return;
        }
        let close = close.map(|(code, text)| (*code, text.as_str()));
        self.session.handle_disconnected(now, close, why);
    }

    /// Does what the session asks for.
    fn act(&mut self) {
        while let Some(event) = self.session.poll_event() {
            match event {
                ClientEvent::Connect => {
                    self.epoch += 1;
                    self.dialer.dial(self.epoch);
                }
                ClientEvent::Welcome => self.shared.update(|status| {
                    status.connected = true;
                    status.error = None;
                }),
                ClientEvent::Version(signed) => self.take_version(&signed),
                ClientEvent::Chunk { hash, bytes } => self.take_chunk(hash, &bytes),
                ClientEvent::Tagged { garment, state, outcome } => {
                    self.shared.answer_tag(garment, state, outcome);
                }
                ClientEvent::Missing { hash } => {
                    self.wanted.remove(&hash);
                    self.note(not_there(&hash));
                    self.missing.note(hash, Instant::now());
                    self.loaders.values_mut().for_each(|loader| loader.handle_missing(hash));
                }
                ClientEvent::Disconnect { reason } => self.disconnect(&reason),
            }
        }
    }

    fn disconnect(&mut self, reason: &session::SessionError) {
        self.epoch += 1;
        if let Some(link) = self.link.take() {
            self.bytes_before += link.bytes_received();
            link.close(reason.close_code().number());
        }
        self.shared.update(|status| status.connected = false);
        if self.leaving.is_some() {
            self.ended = true;
        } else if reason.is_final() {
            if self.dialer.mismatch().is_none() {
                self.fail(reason.to_string());
            }
        } else {
            self.note(reason.to_string());
        }
    }

    fn take_version(&mut self, signed: &SignedManifest) {
        self.planned = None;
        self.missing.clear();
        let manifest = &signed.manifest;
        let chosen = &self.config.garments;
        let played = |name: &String| chosen.is_empty() || chosen.contains(name);
        for garment in manifest.garments.iter().filter(|garment| played(&garment.name)) {
            let loader = self.loaders.entry(garment.id).or_insert_with(|| {
                let stage = Arc::new(Stage::default());
                GarmentLoader::new(stage, self.config.cache_bytes, self.config.horizon)
            });
            if let Err(error) = loader.handle_version(manifest.number, garment) {
                self.shared.update(|status| status.error = Some(error.to_string()));
            }
        }
    }

    fn take_chunk(&mut self, hash: ChunkHash, bytes: &[u8]) {
        self.wanted.remove(&hash);
        if self.missing.forget(&hash) {
            let mended = Some(not_there(&hash));
            self.shared.update(|status| {
                status.error.take_if(|error| Some(&*error) == mended.as_ref());
            });
        }
        let mut refused: Option<LoadError> = None;
        for loader in self.loaders.values_mut() {
            refused = loader.handle_chunk(hash, bytes).err().or(refused);
        }
        if let Some(error) = refused {
            self.note(error.to_string());
        }
    }

    /// Hands finished views over to the characters.
    fn show_views(&mut self) {
        let mut any_new = false;
        let mut refused = None;
        for loader in self.loaders.values_mut() {
            let shown = loader.show();
            if let Some((garment, first)) = loader.take_first_cloth() {
                self.shared.update(|status| status.first_cloth = Some(first));
                self.shared.add_stage(&garment, loader.stage());
            }
            match shown {
                Ok(false) => {}
                Ok(true) => {
                    any_new = true;
                    if let Some(version) = loader.current() {
                        self.shared.add_stage(&version.listing().name, loader.stage());
                    }
                }
                Err(error) => refused = Some(error.to_string()),
            }
        }
        if let Some(error) = refused {
            self.note(error);
        }
        // A garment that this client cannot play keeps nobody from playing the others.
        let playable = self.loaders.values().filter(|loader| !loader.is_stuck());
        let shown = playable.map(|l| l.current().map(|version| version.number())).min().flatten();
        if any_new {
            self.planned = None;
        } else if shown <= self.shown {
            return;
        }
        if let Some(number) = shown {
            self.shown = shown;
            self.session.applied(number);
            self.versions_applied += 1;
            let applied = self.versions_applied;
            self.shared.update(|status| {
                status.version = Some(number);
                status.versions_applied = applied;
            });
        }
    }

    /// Asks again for what the server did not have a while ago.
    fn retry_missing(&mut self) {
        for chunk in self.missing.due(Instant::now()) {
            self.planned = None;
            self.loaders.values_mut().for_each(|loader| loader.retry_missing(chunk));
        }
    }

    /// Compares what is wanted now with what was wanted before, and tells the session.
    fn plan(&mut self, asked: u64) {
        let mut wants = BTreeMap::new();
        for loader in self.loaders.values_mut() {
            loader.plan(&mut wants);
        }
        for (hash, _) in self.wanted.iter().filter(|(hash, _)| !wants.contains_key(*hash)) {
            self.session.cancel(*hash);
        }
        let mut full = BTreeSet::new();
        for (hash, (chunk, need)) in &wants {
            if self.wanted.get(hash).is_none_or(|(_, before)| before != need)
                && !self.session.want(*chunk, priority(*need))
            {
                full.insert(*hash);
            }
        }
        wants.retain(|hash, _| !full.contains(hash));
        self.wanted = wants;
        if self.loaders.values().all(GarmentLoader::is_ahead) {
            self.answered = asked;
            self.shared.answer(asked);
        }
    }

    fn report(&mut self) {
        self.reported = Instant::now();
        // While the line is down counts stay where they are: there they are added up.
        if !self.session.is_open() {
            return;
        }
        for (id, loader) in &mut self.loaders {
            let batch = loader.stage().mailbox().drain();
            let Some(version) = loader.current().map(|version| version.number()) else { continue };
            if batch.is_empty() {
                continue;
            }
            loader.handle_walked(&batch);
            let count = |n: u64| u32::try_from(n).unwrap_or(u32::MAX);
            self.session.report(Telemetry {
                garment: *id,
                version,
                edges: batch.edges.into_iter().collect(),
                exact: count(batch.exact),
                substituted: count(batch.substituted),
                missed: count(batch.missed),
                jumps: count(batch.jumps),
            });
            self.session.report_outside(*id, version, count(batch.outside));
        }
    }

    fn leave_if_asked(&mut self) {
        match self.leaving {
            None if self.shared.quit.load(Ordering::SeqCst) => {
                self.report();
                self.leaving = Some(Instant::now());
                self.session.close();
                // A session that had already ended has nothing more to say.
                self.ended = self.link.is_none();
            }
            Some(since) if since.elapsed() > GOODBYE => self.ended = true,
            _ => {}
        }
    }

    fn transmit(&mut self) {
        let now = self.now();
        while let Some(slot) = self.link.as_ref().and_then(Link::room) {
            let Some(bytes) = self.session.poll_transmit(now) else { return };
            slot.send(bytes);
            if self.link.is_none() {
                return;
            }
        }
    }

    /// Brings the status up to date.
    fn tell(&self) {
        let mut memory = Memory::default();
        for loader in self.loaders.values() {
            memory = memory.plus(loader.memory());
        }
        let received = self.link.as_ref().map_or(0, Link::bytes_received) + self.bytes_before;
        let (publisher, wanted) = (self.session.publisher(), self.session.wanted());
        self.shared.update(|status| {
            status.memory = memory;
            status.bytes_received = received;
            status.publisher = publisher;
            status.wanted = wanted;
        });
    }

    fn note(&self, error: String) {
        tracing::debug!(%error, address = %self.config.address, "client");
        self.shared.update(|status| status.error = Some(error));
    }

    fn fail(&self, error: String) {
        tracing::debug!(%error, address = %self.config.address, "client gives up");
        self.shared.update(|status| {
            status.error = Some(error);
            status.is_final = true;
        });
    }
}

fn not_there(chunk: &ChunkHash) -> String {
    format!("the server does not have chunk {chunk}")
}

fn micros(at: Time) -> Duration {
    Duration::from_micros(at.0)
}

fn priority(need: Need) -> Priority {
    match need {
        Need::Version => Priority::Scene,
        Need::Urgent => Priority::Urgent,
        Need::Soon => Priority::Soon,
        Need::Idle => Priority::Background,
    }
}

#[cfg(test)]
mod tests;

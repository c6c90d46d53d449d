//! What one page sees: the characters on it, the walk that they take, the frames that it is sent.

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use client_lib::{Character, Client, Histogram, StateId, StepOutcome};
use glam::Vec3;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::actor::{Actor, Blending, Still};
use super::air::{self, Air};
use super::answers;
use super::app::App;
use super::crowd::Crowd;
use super::dial;
use super::stand_in::StandIn;
use super::steering::Steering;
use super::stills::fill_stills;
use super::survey::{Loop, Survey, clip_name};
use super::wire::{self, FrameWriter};

/// A page that was away for longer does not catch up.
const LATE_MAX: Duration = Duration::from_millis(500);
/// Between two reports of figures.
const REPORT: Duration = Duration::from_millis(250);
/// Panes side by side.
pub const PANES_MAX: usize = 4;
/// Characters in a crowd.
pub const CROWD_MAX: usize = 100;
/// Seeded presses by which the page says how soon the graph answers.
const PRESSES: usize = 200;
/// Merges passed that wait for the next report.
const PASSED_MAX: usize = 200;
/// Room for a character in a crowd (m).
const CROWD_SPACING_M: f32 = 1.6;

/// What a page asks for.
#[derive(Debug, Clone, Deserialize)]
#[serde(tag = "do", rename_all = "lowercase", deny_unknown_fields)]
pub enum Command {
    /// Head for a clip; none: wander.
    Steer {
        /// Index of the clip.
        clip: Option<u16>,
    },
    /// Slow down; 0 stops.
    Speed {
        /// Of the scene's own speed, 0 to 2.
        times: f32,
    },
    /// Let a wind blow.
    Wind {
        /// Metres a second.
        m_s: f32,
    },
    /// Leave out columns as far as this error allows.
    Dial {
        /// Millimetres.
        mm: f32,
    },
    /// One character in one pane.
    Play,
    /// The same walk in up to four panes.
    Compare {
        /// What each shows.
        panes: Vec<Pane>,
    },
    /// The walk around a merge.
    Inspect {
        /// Its dead end.
        dead_end: u64,
    },
    /// Many characters.
    Crowd {
        /// How many.
        count: usize,
    },
    /// Ask the explorer to simulate at a merge next.
    Tag {
        /// Its dead end.
        dead_end: u64,
    },
}

/// What one pane of a comparison shows.
#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Pane {
    /// Skin the cloth to the body instead.
    plain: bool,
    /// Outside the graph, by coarse simulation and upsampling alone.
    coarse: bool,
    /// A version by number; none: the current one.
    version: Option<u64>,
    /// Columns of the basis; none: as the dial says.
    columns: Option<usize>,
    /// How merges are blended.
    blend: Blending,
}

/// What is on the page.
#[derive(Debug)]
enum Mode {
    Play,
    Compare(Vec<Pane>),
    Inspect { around: Loop, next: usize },
    Crowd(Vec<Steering>),
}

/// What one page sees.
#[derive(Debug)]
pub struct Show {
    app: Arc<App>,
    mode: Mode,
    actors: Vec<Actor>,
    steering: Option<Steering>,
    /// Who walks while there is no cloth yet.
    stand_in: Option<StandIn>,
    survey: Option<Survey>,
    /// Connections of panes that play older versions.
    older: Vec<Arc<Client>>,
    fixed_columns: Vec<Option<usize>>,
    dial_mm: f32,
    air: Air,
    clock: Clock,
    writer: FrameWriter,
    crowd: Crowd,
    figures: Figures,
    meshes_of: Option<u64>,
}

/// Scene time, in ticks.
#[derive(Debug)]
struct Clock {
    last: Instant,
    ticks: f64,
    played: u64,
    speed: f64,
}

/// What is told of the last quarter of a second.
#[derive(Debug, Default)]
struct Figures {
    reported: Option<Instant>,
    decode_us: Histogram,
    /// Decoding, skinning, normals and quantising, per character.
    write_us: Histogram,
    steps: [u64; 3],
    passed: Vec<Passing>,
    seed: u64,
}

/// A merge that was walked through.
#[derive(Debug, Clone, Serialize)]
struct Passing {
    frame: u64,
    dead_end: u64,
    target: u64,
    mm: f32,
    clip: String,
}

/// What a page is sent.
#[derive(Debug)]
pub enum Said {
    /// Text: an object with `say`.
    Text(Value),
    /// Meshes or a frame.
    Bytes(Vec<u8>),
}

impl Show {
    /// A page that has just come.
    pub fn new(app: Arc<App>, seed: u64) -> Self {
        let clock = Clock { last: Instant::now(), ticks: 0.0, played: 0, speed: 1.0 };
        Self {
            app,
            mode: Mode::Play,
            actors: Vec::new(),
            steering: None,
            stand_in: None,
            survey: None,
            older: Vec::new(),
            fixed_columns: Vec::new(),
            dial_mm: 0.0,
            air: Air::default(),
            clock,
            writer: FrameWriter::default(),
            crowd: Crowd::default(),
            figures: Figures { seed, ..Figures::default() },
            meshes_of: None,
        }
    }

    /// Answers a request for a frame: what changed, then the frame itself.
    ///
    /// # Errors
    /// Cloth that cannot be decoded: the page is closed.
    pub fn frame(&mut self) -> Result<Vec<Said>> {
        let mut said = Vec::new();
        if self.actors.is_empty() && !self.enter()? {
            self.wait(&mut said);
            return Ok(said);
        }
        self.advance()?;
        self.take_version(&mut said)?;
        let phase = self.clock.phase();
        self.writer.begin();
        if let Mode::Crowd(_) = self.mode {
            let figures = (&mut self.figures.decode_us, &mut self.figures.write_us);
            self.crowd.write(&mut self.actors, phase, figures, &mut self.writer)?;
        } else {
            for actor in &mut self.actors {
                let start = Instant::now();
                actor.write(phase, &mut self.figures.decode_us, &mut self.writer)?;
                self.figures.write_us.record(start.elapsed().as_secs_f64() * 1e6);
            }
        }
        said.push(Said::Bytes(self.writer.end()));
        if self.figures.reported.is_none_or(|at| at.elapsed() >= REPORT) {
            said.push(Said::Text(self.report()));
        }
        Ok(said)
    }

    /// Does what a page asks for.
    ///
    /// # Errors
    /// What cannot be done, in words for the page.
    pub fn command(&mut self, command: Command) -> Result<Option<Value>> {
        match command {
            Command::Steer { clip } => {
                if let Some(steering) = &mut self.steering {
                    steering.head_for(clip);
                }
            }
            Command::Speed { times } => {
                ensure!((0.0..=2.0).contains(&times), "a speed from 0 to 2");
                self.clock.speed = f64::from(times);
            }
            Command::Wind { m_s } => {
                ensure!(m_s >= 0.0, "metres a second, at least 0");
                self.air.set(m_s);
            }
            Command::Dial { mm } => {
                ensure!(mm >= 0.0, "millimetres, at least 0");
                self.dial_mm = mm;
                self.set_columns();
            }
            Command::Play => self.arrange(Mode::Play)?,
            Command::Compare { panes } => self.arrange(Mode::Compare(panes))?,
            Command::Crowd { count } => self.crowd(count)?,
            Command::Inspect { dead_end } => return self.inspect(dead_end).map(Some),
            Command::Tag { dead_end } => self.tag(dead_end)?,
        }
        Ok(None)
    }

    /// What is awaited, in words; meanwhile the character walks in plain skinning, where its scene is known.
    fn wait(&mut self, said: &mut Vec<Said>) {
        let bare = self.app.bare();
        if self.figures.reported.is_none_or(|at| at.elapsed() >= REPORT) || bare.is_none() {
            let status = self.app.client.status();
            self.figures.reported = Some(Instant::now());
            said.push(Said::Text(json!({
                "say": "waiting", "connected": status.connected, "error": status.error,
                "exploring": self.app.exploring(),
                "clips": bare.map_or(&[][..], |bare| bare.scene.clips()),
            })));
        }
        let Some(bare) = bare else { return };
        if self.stand_in.is_none() {
            said.push(Said::Bytes(bare.meshes()));
            self.steering = Some(Steering::new(&bare.scene, self.figures.seed));
            self.clock.last = Instant::now();
        }
        let stand_in = self.stand_in.get_or_insert_with(|| StandIn::new(bare));
        for _ in 0..self.clock.due(bare.scene.fps()) {
            let next = self.steering.as_mut().map(|steering| steering.next(stand_in.pose()));
            stand_in.step(next.unwrap_or(stand_in.pose()));
        }
        self.writer.begin();
        stand_in.write(self.clock.phase(), &mut self.writer);
        said.push(Said::Bytes(self.writer.end()));
    }

    /// Takes the stage as soon as there is a version.
    fn enter(&mut self) -> Result<bool> {
        let Ok(character) = self.app.client.character(self.app.garment()) else {
            return Ok(false);
        };
        let scene = Arc::clone(character.version().scene());
        let goal = self.steering.as_ref().and_then(Steering::goal);
        let mut steering = Steering::new(&scene, self.figures.seed);
        steering.head_for(goal);
        self.steering = Some(steering);
        self.stand_in = None;
        self.actors = vec![Actor::new(character, 0)];
        self.fixed_columns = vec![None];
        self.clock.last = Instant::now();
        Ok(true)
    }

    /// Plays as many ticks of the scene as the clock says.
    fn advance(&mut self) -> Result<()> {
        let Some(lead) = self.actors.first() else { return Ok(()) };
        let fps = lead.character.version().scene().fps();
        for _ in 0..self.clock.due(fps) {
            self.tick();
        }
        Ok(())
    }

    fn tick(&mut self) {
        let Some(steering) = &mut self.steering else { return };
        self.air.blow(&mut self.actors);
        match &mut self.mode {
            Mode::Play | Mode::Compare(_) => {
                let next = steering.next(self.actors[0].character.pose());
                for (index, actor) in self.actors.iter_mut().enumerate() {
                    let outcome = actor.character.step(next);
                    if index == 0 {
                        self.figures.count(outcome, &actor.character, self.clock.played);
                    }
                }
            }
            Mode::Crowd(walks) => {
                for (actor, walk) in self.actors.iter_mut().zip(walks) {
                    let next = walk.next(actor.character.pose());
                    let outcome = actor.character.step(next);
                    self.figures.count(outcome, &actor.character, self.clock.played);
                }
            }
            Mode::Inspect { around, next } => {
                let actor = &mut self.actors[0];
                if *next >= around.poses.len() {
                    actor.character.place(around.start);
                    *next = 0;
                }
                let outcome = actor.character.step(around.poses[*next]);
                self.figures.count(outcome, &actor.character, self.clock.played);
                let age = next.saturating_sub(around.at) as f32;
                let is_after = *next >= around.at;
                actor.tint.weight = if is_after { (1.0 - age / 10.0).max(0.0) } else { 0.0 };
                *next += 1;
                fill_stills(&mut self.actors);
            }
        }
    }

    /// Tells the page of a version that was taken up, and looks at it.
    fn take_version(&mut self, said: &mut Vec<Said>) -> Result<()> {
        let lead = &self.actors[0].character;
        let version = Arc::clone(lead.version());
        if self.survey.as_ref().is_some_and(|survey| survey.is_of(lead)) {
            return Ok(());
        }
        let survey = Survey::new(lead);
        let scene = version.scene();
        let steering = self.steering.as_mut().context("there is a walk")?;
        if !Arc::ptr_eq(steering.scene(), scene) {
            // Another version's scene: the player still wants what was asked for.
            let goal = steering.goal();
            *steering = Steering::new(scene, self.figures.seed);
            steering.head_for(goal);
        }
        if self.meshes_of.is_none() {
            self.meshes_of = Some(version.number().0);
            let mesh = version.mesh();
            let bytes = wire::meshes(scene, mesh.vertex_count, &mesh.triangles);
            said.push(Said::Bytes(bytes));
        }
        let tiers = dial::tiers(lead)?;
        said.push(Said::Text(json!({
            "say": "version", "version": version.number().0, "garment": version.mesh().name,
            "vertices": version.mesh().vertex_count, "fps": scene.fps(), "clips": scene.clips(),
            "in_graph": answers::in_graph(scene),
            "poses": scene.pose_count(), "edges": scene.edges().len(),
            "states": version.links().state_count(), "columns": version.basis().columns(),
            "rehearsed": answers::rehearse(scene, PRESSES, 1),
            "merges": survey.merges(), "worst": survey.worst(), "tiers": tiers,
            "server_page": self.app.server_page, "may_tag": self.app.may_tag(),
            "stats": { "worst_mm": version.listing().stats.worst_error_m * 1e3,
                "mean_mm": version.listing().stats.mean_error_m * 1e3,
                "codec_max_mm": version.listing().stats.codec_max_error_m * 1e3 },
        })));
        self.survey = Some(survey);
        self.set_columns();
        if let Mode::Inspect { around, .. } = &self.mode {
            let dead_end = around.dead_end.0;
            said.push(Said::Text(self.inspect(dead_end)?));
        }
        Ok(())
    }

    fn set_columns(&mut self) {
        for (actor, fixed) in self.actors.iter_mut().zip(&self.fixed_columns) {
            actor.columns = fixed.unwrap_or(usize::MAX);
            let allowed_mm = if fixed.is_some() { 0.0 } else { self.dial_mm };
            actor.character.set_error_allowed(allowed_mm / 1e3);
        }
    }

    /// One character, or one per pane, all on the lead's walk.
    fn arrange(&mut self, mode: Mode) -> Result<()> {
        ensure!(!self.actors.is_empty(), "nothing is played yet");
        let panes = match &mode {
            Mode::Compare(panes) => panes.clone(),
            _ => vec![Pane::default()],
        };
        ensure!(!panes.is_empty() && panes.len() <= PANES_MAX, "1 to {PANES_MAX} panes");
        let mut actors = Vec::new();
        let mut older = Vec::new();
        for (index, pane) in panes.iter().enumerate() {
            let character = match pane.version {
                None => self.app.client.character(self.app.garment())?,
                Some(number) => {
                    let client = self.app.pinned(number)?;
                    older.push(Arc::clone(&client));
                    client.character(self.app.garment())?
                }
            };
            let mut actor = Actor::new(character, index as u32);
            actor.character.set_counted(index == 0 && pane.version.is_none());
            actor.character.set_blend(pane.blend.into());
            if pane.plain {
                actor.be_plain()?;
            }
            let can = !pane.coarse || actor.character.can_leave();
            ensure!(
                can,
                "this version has no upsampler (explore with --upsampler), so no coarse cloth"
            );
            actor.character.join(&self.actors[0].character);
            actor.character.stay_outside(pane.coarse);
            actors.push(actor);
        }
        self.actors = actors;
        self.older = older;
        self.fixed_columns = panes.iter().map(|pane| pane.columns.map(|n| n.max(1))).collect();
        self.mode = mode;
        self.set_columns();
        Ok(())
    }

    /// Asks for a simulation at a merge, and keeps an eye on the walk around it.
    fn tag(&mut self, dead_end: u64) -> Result<()> {
        let survey = self.survey.as_ref().context("nothing is played yet")?;
        let lead = self.actors.first().context("nothing is played yet")?;
        let dead_end = StateId(dead_end);
        ensure!(survey.merge(dead_end).is_some(), "state {dead_end} is merged no more");
        let around = survey.around(dead_end);
        let around = around.with_context(|| format!("no way leads to state {dead_end}"))?;
        let first_mm = survey.worst_on(&around);
        self.app.tag(lead.character.version().garment(), around, first_mm)
    }

    fn crowd(&mut self, count: usize) -> Result<()> {
        ensure!((1..=CROWD_MAX).contains(&count), "1 to {CROWD_MAX} characters");
        ensure!(self.steering.is_some(), "nothing is played yet");
        let mut actors = Vec::new();
        let mut walks = Vec::new();
        let side = (count as f32).sqrt().ceil();
        for index in 0..count {
            let character = self.app.client.character(self.app.garment())?;
            let seed = self.figures.seed.wrapping_add(1 + index as u64);
            walks.push(Steering::new(character.version().scene(), seed));
            let mut actor = Actor::new(character, 0);
            actor.character.set_counted(index == 0);
            let (row, column) = ((index as f32 / side).floor(), index as f32 % side);
            let middle = (side - 1.0) / 2.0;
            let spot = Vec3::new(column - middle, 0.0, row - middle) * CROWD_SPACING_M;
            actor.spot = Some(spot);
            actors.push(actor);
        }
        self.fixed_columns = vec![None; count];
        self.actors = actors;
        self.mode = Mode::Crowd(walks);
        self.set_columns();
        Ok(())
    }

    /// The walk around a merge in the first pane, the dead end and its target beside it.
    fn inspect(&mut self, dead_end: u64) -> Result<Value> {
        let survey = self.survey.as_ref().context("nothing is played yet")?;
        let around = match &self.mode {
            // Seen again in a newer version: the same walk, so that the two can be compared.
            Mode::Inspect { around, .. } if around.dead_end.0 == dead_end => around.clone(),
            _ => survey
                .around(StateId(dead_end))
                .with_context(|| format!("no way is known that leads to state {dead_end}"))?,
        };
        let now = survey.merge(StateId(dead_end));
        let worst_mm = survey.worst_on(&around);
        let garment = self.app.garment();
        let character = || -> Result<Character> {
            let mut character = self.app.client.character(garment)?;
            character.set_counted(false);
            Ok(character)
        };
        let mut walker = Actor::new(character()?, 0);
        walker.character.place(around.start);
        let mut actors = vec![walker];
        let target = now.as_ref().map_or(dead_end, |merge| merge.target);
        for (pane, state) in [(1, dead_end), (2, target)] {
            let mut actor = Actor::new(character()?, pane);
            actor.character.place(StateId(state));
            actor.still = Some(Still { state: StateId(state), positions: Vec::new() });
            actors.push(actor);
        }
        fill_stills(&mut actors);
        let said = json!({
            "say": "inspect", "dead_end": dead_end, "merge": now, "worst_mm": worst_mm,
            "frames": around.poses.len(), "at": around.at,
            "version": actors[0].character.version().number().0,
        });
        self.actors = actors;
        self.fixed_columns = vec![None; 3];
        self.mode = Mode::Inspect { around, next: 0 };
        self.set_columns();
        Ok(said)
    }

    /// Figures of the last quarter of a second.
    fn report(&mut self) -> Value {
        let status = self.app.client.status();
        let lead = &self.actors[0].character;
        let scene = lead.version().scene();
        let figures = &mut self.figures;
        figures.reported = Some(Instant::now());
        let report = json!({
            "say": "figures",
            "frame": self.clock.played,
            "version": lead.version().number().0,
            "connected": status.connected,
            "clip": clip_name(scene, lead.pose()),
            "goal": self.steering.as_ref().and_then(Steering::goal),
            "answers": self.steering.as_ref().map(Steering::answers),
            "exact": figures.steps[0], "substituted": figures.steps[1],
            "missed": figures.steps[2], "outside": air::told(lead),
            "shown_mm": lead.shown_error_m() * 1e3,
            "passed": std::mem::take(&mut figures.passed),
            "bytes_received": status.bytes_received,
            "resident_bytes": status.resident_bytes(),
            "basis_bytes": status.memory.basis,
            "decode_us": figures.decode_us.percentile(0.5),
            "write_us": figures.write_us.percentile(0.5),
            "characters": self.actors.len(),
            "columns": self.actors[0].columns.min(lead.active_columns()),
            "tier_mm": lead.tier_error_m() * 1e3,
            "tags": self.app.tags(self.survey.as_ref()),
        });
        figures.decode_us = Histogram::default();
        figures.write_us = Histogram::default();
        report
    }
}

impl Clock {
    /// Ticks of the scene that are to be played by now.
    fn due(&mut self, fps: f32) -> u64 {
        let passed = self.last.elapsed().min(LATE_MAX);
        self.last = Instant::now();
        self.ticks += passed.as_secs_f64() * f64::from(fps) * self.speed;
        let due = (self.ticks.ceil() as u64).saturating_sub(self.played);
        self.played += due;
        due
    }

    /// How far the time is between the last tick and the next.
    fn phase(&self) -> f32 {
        self.ticks.fract() as f32
    }
}

impl Figures {
    fn count(&mut self, outcome: StepOutcome, character: &Character, frame: u64) {
        let kind = match outcome {
            StepOutcome::Exact => 0,
            StepOutcome::Substituted { .. } => 1,
            StepOutcome::Missed => 2,
        };
        self.steps[kind] += 1;
        let Some(passed) = character.passed() else { return };
        if self.passed.len() < PASSED_MAX {
            self.passed.push(Passing {
                frame,
                dead_end: passed.dead_end.0,
                target: passed.target.0,
                mm: passed.error_m * 1e3,
                clip: clip_name(character.version().scene(), character.pose()),
            });
        }
    }
}

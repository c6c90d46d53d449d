//! Where the walk goes: to the clip that was asked for, or wherever it likes.

use std::sync::Arc;

use client_lib::{Histogram, PoseId, Scene, Steer};
use serde::Serialize;

/// A walk, and how soon it answered.
#[derive(Debug)]
pub struct Steering {
    steer: Steer,
    goal: Option<u16>,
    /// Frames since the player asked, until the clip is reached.
    waiting: Option<Waiting>,
    /// State of the generator of aimless walks.
    random: u64,
    begun_s: Histogram,
    arrived_s: Histogram,
    last: Answer,
}

#[derive(Debug, Clone, Copy)]
struct Waiting {
    frames: u32,
    has_begun: bool,
}

/// How soon the last press was answered (s).
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct Answer {
    /// Until the first pose of a transition into the clip.
    begun_s: f32,
    /// Until the first recorded pose of the clip.
    arrived_s: f32,
}

/// How soon presses were answered so far.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Answers {
    count: u64,
    last: Answer,
    begun_median_s: f64,
    arrived_median_s: f64,
    arrived_p90_s: f64,
}

impl Steering {
    /// An aimless walk over a scene.
    pub fn new(scene: &Arc<Scene>, seed: u64) -> Self {
        Self {
            steer: Steer::new(scene),
            goal: None,
            waiting: None,
            random: seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x5851_f42d_4c95_7f2d,
            begun_s: Histogram::default(),
            arrived_s: Histogram::default(),
            last: Answer::default(),
        }
    }

    /// The scene that is walked.
    pub fn scene(&self) -> &Arc<Scene> {
        self.steer.scene()
    }

    /// Heads for a clip from now on; `None`: anywhere. A clip that does not exist is ignored.
    pub fn head_for(&mut self, goal: Option<u16>) {
        let known = |clip: &u16| usize::from(*clip) < self.scene().clips().len();
        self.goal = goal.filter(known);
        self.waiting = self.goal.map(|_| Waiting { frames: 0, has_begun: false });
    }

    /// The clip that is headed for.
    pub fn goal(&self) -> Option<u16> {
        self.goal
    }

    /// The pose after the character's, one frame on.
    pub fn next(&mut self, pose: PoseId) -> PoseId {
        let to_goal = self.goal.and_then(|goal| self.steer.next(pose, goal));
        let next = to_goal.unwrap_or_else(|| self.anywhere(pose));
        self.measure(next);
        next
    }

    /// How soon presses were answered.
    pub fn answers(&self) -> Answers {
        Answers {
            count: self.arrived_s.count(),
            last: self.last,
            begun_median_s: self.begun_s.percentile(0.5),
            arrived_median_s: self.arrived_s.percentile(0.5),
            arrived_p90_s: self.arrived_s.percentile(0.9),
        }
    }

    fn anywhere(&mut self, pose: PoseId) -> PoseId {
        let scene = self.steer.scene();
        let degree = scene.out_degree(pose) as u64;
        // A linear congruence; its high half is random enough to choose a way.
        self.random = self.random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        let choice = ((self.random >> 32) * degree) >> 32;
        let edge = scene.out_edges(pose).nth(choice as usize);
        edge.map_or(pose, |edge| scene.edges()[edge.index()].to)
    }

    fn measure(&mut self, next: PoseId) {
        let (Some(goal), Some(mut waiting)) = (self.goal, self.waiting) else { return };
        let scene = self.steer.scene();
        waiting.frames += 1;
        let (is_goal, is_recorded) = (scene.clip_of(next) == goal, !scene.is_transition(next));
        let seconds = waiting.frames as f32 / scene.fps();
        if is_goal && !waiting.has_begun {
            waiting.has_begun = true;
            self.last.begun_s = seconds;
            self.begun_s.record(f64::from(seconds));
        }
        self.waiting = Some(waiting);
        if is_goal && is_recorded {
            self.last.arrived_s = seconds;
            self.arrived_s.record(f64::from(seconds));
            self.waiting = None;
        }
    }
}

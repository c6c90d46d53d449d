//! How soon a graph answers: seeded presses, played through without cloth.

use std::sync::Arc;

use client_lib::{PoseId, Scene, Steer};
use serde::Serialize;

/// Words in the names of clips by which a character gets about.
const LOCOMOTION: [&str; 9] =
    ["walk", "run", "turn", "step", "jog", "stand", "idle", "strafe", "crouch"];
/// A player who has got a clip watches it for up to this long (s) before the next press.
const DWELL_MAX_S: f32 = 2.0;
/// No way is longer; a graph that needs more is not steered (frames).
const WAY_MAX: u32 = 10_000;

/// Times until presses were answered (s).
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Times {
    /// How many presses.
    pub presses: usize,
    /// Median until the first recorded pose of the clip.
    pub median_s: f32,
    /// 90th percentile of the same.
    pub p90_s: f32,
    /// Median until the first pose of the transition that leads into it.
    pub begins_median_s: f32,
}

/// What presses of all clips, and of those by which one gets about, were answered in.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Answers {
    /// Any clip from any other.
    pub all: Times,
    /// From one clip of locomotion to another; no presses where there are not two.
    pub locomotion: Times,
}

/// For every clip, whether the graph has a pose of it.
pub fn in_graph(scene: &Scene) -> Vec<bool> {
    let mut found = vec![false; scene.clips().len()];
    for pose in (0..scene.pose_count()).map(|pose| PoseId(pose as u32)) {
        found[usize::from(scene.clip_of(pose))] |= !scene.is_transition(pose);
    }
    found
}

/// Presses the key of a random other clip, waits for it, watches it for a while, and so on.
pub fn rehearse(scene: &Arc<Scene>, presses: usize, seed: u64) -> Answers {
    let in_graph = in_graph(scene);
    let clips = (0..scene.clips().len() as u16).filter(|clip| in_graph[usize::from(*clip)]);
    let clips: Vec<u16> = clips.collect();
    let gets_about = |clip: &u16| {
        let name = scene.clips()[usize::from(*clip)].to_lowercase();
        LOCOMOTION.iter().any(|word| name.contains(word))
    };
    let locomotion: Vec<u16> = clips.iter().copied().filter(gets_about).collect();
    let times = |among: &[u16]| Player::new(scene, seed).play(among, presses);
    Answers { all: times(&clips), locomotion: times(&locomotion) }
}

struct Player {
    steer: Steer,
    pose: PoseId,
    random: u64,
}

impl Player {
    fn new(scene: &Arc<Scene>, seed: u64) -> Self {
        Self { steer: Steer::new(scene), pose: PoseId(0), random: seed }
    }

    fn play(&mut self, among: &[u16], presses: usize) -> Times {
        let scene = Arc::clone(self.steer.scene());
        let (mut begun, mut arrived) = (Vec::new(), Vec::new());
        // To begin with, into one of them; that press does not count.
        let mut clip = among.first().copied();
        if let Some(clip) = clip {
            self.go(clip);
        }
        while let Some(now) = clip.filter(|_| arrived.len() < presses && among.len() > 1) {
            for _ in 0..self.below((DWELL_MAX_S * scene.fps()) as u64) {
                self.pose = self.steer.next(self.pose, now).unwrap_or(self.pose);
            }
            let others: Vec<u16> = among.iter().copied().filter(|other| *other != now).collect();
            let next = others[self.below(others.len() as u64) as usize];
            let (begins, arrives) = self.go(next);
            begun.push(begins as f32 / scene.fps());
            arrived.push(arrives as f32 / scene.fps());
            clip = Some(next);
        }
        let at = |times: &mut Vec<f32>, share: f32| {
            times.sort_by(f32::total_cmp);
            let index = (share * times.len() as f32).ceil() as usize;
            times.get(index.saturating_sub(1)).copied().unwrap_or(0.0)
        };
        Times {
            presses: arrived.len(),
            median_s: at(&mut arrived, 0.5),
            p90_s: at(&mut arrived, 0.9),
            begins_median_s: at(&mut begun, 0.5),
        }
    }

    /// Heads for a clip until it is there; frames until it begins, and until it is entered.
    fn go(&mut self, clip: u16) -> (u32, u32) {
        let scene = Arc::clone(self.steer.scene());
        let mut begins = None;
        for frame in 1..=WAY_MAX {
            let Some(next) = self.steer.next(self.pose, clip) else { return (WAY_MAX, WAY_MAX) };
            self.pose = next;
            if scene.clip_of(next) == clip {
                let begins = *begins.get_or_insert(frame);
                if !scene.is_transition(next) {
                    return (begins, frame);
                }
            }
        }
        (WAY_MAX, WAY_MAX)
    }

    /// SplitMix64 (Steele, Lea and Flood 2014).
    fn below(&mut self, bound: u64) -> u64 {
        self.random = self.random.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut bits = self.random;
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (bits ^ (bits >> 31)) % bound.max(1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_robe_answers_every_press_and_the_same_seed_gives_the_same_times() {
        let scene = crate::scene::load("robe").unwrap();
        let chunk = explorer::pack::scene_chunk::scene_chunk(&scene);
        let scene = Arc::new(Scene::new(chunk).unwrap());
        let answers = rehearse(&scene, 200, 1);
        assert_eq!((answers.all.presses, answers.locomotion.presses), (200, 200));
        assert_eq!(answers, rehearse(&scene, 200, 1));
        for times in [answers.all, answers.locomotion] {
            assert!(times.begins_median_s <= times.median_s && times.median_s <= times.p90_s);
            assert!(times.median_s > 0.0 && times.p90_s < 10.0, "{times:?}");
        }
        assert!(answers.locomotion.median_s < 0.65, "{:?}", answers.locomotion);
    }
}

//! Steering: the pose that comes next on the shortest way to the clip a player asks for.
//!
//! A game with a motion graph of its own decides by itself; this is the simplest good way: distances
//! to a clip are found once, by breadth-first search against the edges, and each step then is a look
//! at the out-edges of one pose.

use std::collections::VecDeque;
use std::sync::Arc;

use protocol::PoseId;

use crate::scene::Scene;

/// A pose counts as an entry into a clip if the clip can be played on from there for this many
/// frames, so that arriving at its very end is no answer.
const FRAMES_AFTER_ENTRY: usize = 8;

/// Leads walks to clips. Holds distances per clip that was asked for: four bytes a pose each.
#[derive(Debug, Clone)]
pub struct Steer {
    scene: Arc<Scene>,
    /// Frames from each pose to the clip's nearest entry; `u32::MAX` where no way leads.
    distances: Vec<Option<Vec<u32>>>,
}

impl Steer {
    /// For walks over a scene's primary graph.
    pub fn new(scene: &Arc<Scene>) -> Self {
        Self { scene: Arc::clone(scene), distances: vec![None; scene.clips().len()] }
    }

    /// The scene that is walked.
    pub fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    /// The pose after `pose` on the way to `clip`, and on through it once it is reached: the clip is
    /// played to its end, then entered again by the shortest way. `None` where no way leads there,
    /// or there is no such clip or pose.
    pub fn next(&mut self, pose: PoseId, clip: u16) -> Option<PoseId> {
        let scene = Arc::clone(&self.scene);
        if !scene.has(pose) {
            return None;
        }
        if scene.clip_of(pose) == clip
            && !scene.is_transition(pose)
            && let Some(next) = next_in_clip(&scene, pose)
        {
            return Some(next);
        }
        let distances = self.distances(clip)?;
        let nexts = scene.out_edges(pose).map(|edge| scene.edges()[edge.index()].to);
        let next = nexts.min_by_key(|to| distances[to.index()])?;
        (distances[next.index()] != u32::MAX).then_some(next)
    }

    /// Frames from `pose` until the clip is entered at a recorded pose; 0 where one is in it already.
    /// `None` where no way leads there, or there is no such clip or pose.
    pub fn frames_to(&mut self, pose: PoseId, clip: u16) -> Option<u32> {
        let frames = *self.distances(clip)?.get(pose.index())?;
        (frames != u32::MAX).then_some(frames)
    }

    fn distances(&mut self, clip: u16) -> Option<&[u32]> {
        let slot = self.distances.get_mut(usize::from(clip))?;
        Some(slot.get_or_insert_with(|| distances(&self.scene, clip)))
    }
}

/// The next frame of the same clip; where that is a ring, the first follows the last.
fn next_in_clip(scene: &Scene, pose: PoseId) -> Option<PoseId> {
    let clip = scene.clip_of(pose);
    let nexts = scene.out_edges(pose).map(|edge| scene.edges()[edge.index()].to);
    let inside = nexts.filter(|to| scene.clip_of(*to) == clip && !scene.is_transition(*to));
    // The next frame before any other place in the clip.
    inside.min_by_key(|to| scene.frame_of(*to) != scene.frame_of(pose) + 1)
}

/// Breadth-first against the edges, from all entries of the clip.
fn distances(scene: &Scene, clip: u16) -> Vec<u32> {
    let mut before: Vec<Vec<u32>> = vec![Vec::new(); scene.pose_count()];
    for edge in scene.edges() {
        before[edge.to.index()].push(edge.from.0);
    }
    let mut distances = vec![u32::MAX; scene.pose_count()];
    let mut open: VecDeque<PoseId> = entries(scene, clip).collect();
    open.iter().for_each(|pose| distances[pose.index()] = 0);
    while let Some(pose) = open.pop_front() {
        for from in &before[pose.index()] {
            if distances[*from as usize] == u32::MAX {
                distances[*from as usize] = distances[pose.index()] + 1;
                open.push_back(PoseId(*from));
            }
        }
    }
    distances
}

/// Recorded poses of a clip from which it can be played on for a while; all of them in a clip that
/// is shorter than that.
fn entries(scene: &Scene, clip: u16) -> impl Iterator<Item = PoseId> {
    let recorded = |pose: &PoseId| scene.clip_of(*pose) == clip && !scene.is_transition(*pose);
    let all: Vec<PoseId> =
        (0..scene.pose_count() as u32).map(PoseId).filter(|pose| recorded(pose)).collect();
    let plays_on = |pose: &PoseId| {
        let run = std::iter::successors(Some(*pose), |pose| next_in_clip(scene, *pose));
        run.take(FRAMES_AFTER_ENTRY + 1).count() > FRAMES_AFTER_ENTRY
    };
    let long: Vec<PoseId> = all.iter().copied().filter(plays_on).collect();
    if long.is_empty() { all.into_iter() } else { long.into_iter() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tiny;

    #[test]
    fn the_way_is_the_shortest_and_ends_in_the_clip() {
        let scene = Arc::new(Scene::new(tiny::scene_chunk()).unwrap());
        let mut steer = Steer::new(&scene);
        for clip in 0..scene.clips().len() as u16 {
            for start in 0..scene.pose_count() as u32 {
                let Some(frames) = steer.frames_to(PoseId(start), clip) else { continue };
                let mut pose = PoseId(start);
                for left in (0..frames).rev() {
                    let next = steer.next(pose, clip).unwrap();
                    assert!(scene.edge_between(pose, next).is_some(), "{pose} to {next}");
                    assert_eq!(steer.frames_to(next, clip), Some(left));
                    pose = next;
                }
                assert_eq!((scene.clip_of(pose), scene.is_transition(pose)), (clip, false));
            }
        }
        assert_eq!(steer.next(PoseId(0), 999), None);
        assert_eq!(steer.frames_to(PoseId(0), 999), None);
    }
}

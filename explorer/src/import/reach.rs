//! How long it takes to reach a given clip.

use serde::Serialize;

use super::components::Digraph;
use super::motion_graph::Topology;
use super::transition::Transition;
use crate::primary::PrimaryGraph;

/// Times of the shortest walks from every pose to every clip that it is not in.
///
/// A walk ends at the first frame of the clip itself (not of a transition into it).
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Reach {
    /// Half of all walks are shorter (s); infinite where most clips cannot be reached.
    pub median_s: f32,
    /// Nine tenths are shorter (s).
    pub p90_s: f32,
    /// The longest (s).
    pub worst_s: f32,
}

/// How long it takes to one clip, from every pose that is not in it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ClipReach {
    /// Name of the clip.
    pub clip: String,
    /// The times.
    #[serde(flatten)]
    pub reach: Reach,
}

impl Reach {
    /// Of a primary graph.
    pub fn of_graph(primary: &PrimaryGraph) -> Self {
        let all: Vec<usize> = (0..primary.clips().len()).collect();
        Self::among(primary, &all)
    }

    /// To each clip of a primary graph.
    pub fn of_each_clip(primary: &PrimaryGraph) -> Vec<ClipReach> {
        let (graph, clips) = Self::digraph(primary);
        let names = primary.clips().iter().enumerate();
        let reach = |to| Self::measure(&graph, &clips, |_| true, &[to], primary.fps());
        names.map(|(to, clip)| ClipReach { clip: clip.clone(), reach: reach(to) }).collect()
    }

    /// Of a primary graph, by the ways that [`Reach::to_clips`] speaks of.
    pub fn among(primary: &PrimaryGraph, to: &[usize]) -> Self {
        let (graph, clips) = Self::digraph(primary);
        Self::measure(&graph, &clips, starts(to, primary.clips().len()), to, primary.fps())
    }

    /// The graph's edges, and by pose the clip of which it is a recorded frame.
    fn digraph(primary: &PrimaryGraph) -> (Digraph, Vec<Option<usize>>) {
        let edges: Vec<_> = primary.edges().iter().map(|e| (e.from.0, e.to.0)).collect();
        let clips = primary.poses().iter();
        let clips = clips.map(|pose| (!pose.transition).then_some(usize::from(pose.clip)));
        (Digraph::new(primary.poses().len(), &edges), clips.collect())
    }

    /// Of clips and transitions, over the component that would be kept.
    pub fn of_clips(frames: &[usize], transitions: &[Transition], fps: f32) -> Self {
        let all: Vec<usize> = (0..frames.len()).collect();
        Self::to_clips(frames, transitions, fps, &all)
    }

    /// As [`Reach::of_clips`], of walks from recorded frames of these clips to another of them; where only
    /// one is named, from those of all clips.
    pub fn to_clips(frames: &[usize], transitions: &[Transition], fps: f32, to: &[usize]) -> Self {
        let topology = Topology::new(frames, transitions, true);
        let graph = topology.digraph();
        let kept = graph.largest_cycle_component();
        let mut id = vec![u32::MAX; topology.nodes];
        for (new, old) in kept.iter().enumerate() {
            id[*old as usize] = new as u32;
        }
        let edges = topology.edges.iter().map(|(a, b)| (id[*a as usize], id[*b as usize]));
        let edges: Vec<_> = edges.filter(|(a, b)| *a != u32::MAX && *b != u32::MAX).collect();
        let ends: Vec<u32> =
            (0..frames.len()).map(|clip| topology.clip_first[clip] + frames[clip] as u32).collect();
        let clip_of = |node: usize| ends.iter().position(|end| kept[node] < *end);
        let clips: Vec<_> = (0..kept.len()).map(clip_of).collect();
        let graph = Digraph::new(kept.len(), &edges);
        Self::measure(&graph, &clips, starts(to, frames.len()), to, fps)
    }

    fn measure(
        graph: &Digraph,
        clip: &[Option<usize>],
        starts: impl Fn(Option<usize>) -> bool,
        to: &[usize],
        fps: f32,
    ) -> Self {
        let mut steps = Vec::new();
        for &target in to {
            let inside = |node: &u32| clip[*node as usize] == Some(target);
            let targets: Vec<u32> = (0..graph.node_count() as u32).filter(inside).collect();
            let all = graph.steps_to(&targets).into_iter().zip(clip);
            steps.extend(all.filter(|(s, clip)| *s > 0 && starts(**clip)).map(|(s, _)| s));
        }
        steps.sort_unstable();
        let quantile = |share: f32| match steps.len() {
            0 => 0.0,
            count => match steps[((count - 1) as f32 * share) as usize] {
                u32::MAX => f32::INFINITY,
                frames => frames as f32 / fps,
            },
        };
        Self { median_s: quantile(0.5), p90_s: quantile(0.9), worst_s: quantile(1.0) }
    }
}

/// From where ways to these clips, of so many, are looked at.
fn starts(to: &[usize], clips: usize) -> impl Fn(Option<usize>) -> bool {
    move |clip| match to {
        _ if to.len() == clips => true,
        [_] => clip.is_some(),
        _ => clip.is_some_and(|clip| to.contains(&clip)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_clips_with_one_way_each() {
        // Both of 30 frames, left at their end and entered at frame 0: a ring in which frames
        // 0 to 9 of each are replaced by transitions.
        let way = |from_clip, to_clip| Transition {
            from_clip,
            from_frame: 29,
            to_clip,
            to_frame: 0,
            distance_m: 0.0,
        };
        let reach = Reach::of_clips(&[30, 30], &[way(0, 1), way(1, 0)], 1.0);
        // From frame f of a clip 29 - f frames to its end, 11 to the other clip; from pose k of a
        // transition 10 - k to the clip it leads to and 40 - k to the other.
        let mut all: Vec<u32> = (10..30).map(|f| 29 - f + 11).collect();
        all.extend((0..10).flat_map(|k| [10 - k, 40 - k]));
        all.sort_unstable();
        assert_eq!(reach.median_s as u32, all[(all.len() - 1) / 2]);
        assert_eq!(reach.p90_s as u32, all[((all.len() - 1) as f32 * 0.9) as usize]);
        assert_eq!(reach.worst_s as u32, 40);
    }
}

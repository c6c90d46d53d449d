//! Computes a motion graph from clips: where may one clip go on as another?
//!
//! Kovar, Gleicher and Pighin 2002: the distance of every pair of frames ([`mod@super::align`]),
//! its local minima, and those of them that are good enough. Strong connectivity is built in, not
//! hoped for: every clip gets its two best exits out of its last frames and its two best entries
//! into its first ones, and whatever is still apart is joined at the best place.

use std::collections::BTreeSet;

use cloth::Skeleton;

use super::align::{JointTrack, WINDOW};
use super::character::Clip;
use super::distances::{Columns, MARGIN_FRAMES, Table, nearer, place};
use super::exits::Way;
use super::motion_graph::{FileClip, FileTransition, GraphFile, Topology};
use super::reach::Reach;
use super::transition::{self, Transition};

/// Share of a clip that counts as its beginning or end for the guaranteed entries and exits.
const END_SHARE: f32 = 0.04;
/// At least so many frames of it.
const END_FRAMES_MIN: usize = 6;
/// Guaranteed exits and entries of a clip.
const WAYS: usize = 2;
/// Shortest clip that can be left and entered under these rules.
const CLIP_FRAMES_MIN: usize = 2 * MARGIN_FRAMES;
/// Beyond this distance no transition is taken for the sake of a shorter way (m).
const DISTANCE_M_MAX: f32 = 0.35;
/// Whoever gets into a clip for the sake of a shorter way can stay for so long: the transition, a second.
const STAY_FRAMES: usize = 40;
/// Between two exits to a clip that need not be reached soon, as multiples of the gap between others.
const ACTION_GAPS: usize = 8;
/// Exits further apart than this are not evenly spaced, but few.
const GAP_FRAMES_MAX: usize = 300;

/// How many transitions are asked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Density {
    /// Every local minimum of the distance below this (m).
    Threshold(f32),
    /// As few as bring the median time to reach a given clip to this (s): either the best fits first,
    /// or exits at even intervals ([`mod@super::exits`]), whichever needs fewer.
    Reach(f32),
}

/// Why no motion graph could be computed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ComputeError {
    /// No clip at all.
    #[error("the character has no clip to compute a motion graph from; add animations")]
    NoClip,
    /// A clip that cannot be left and entered.
    #[error(
        "clip {clip:?} has {frames} frames, at least {CLIP_FRAMES_MIN} are needed to leave and \
         enter it; leave it out or make it longer"
    )]
    Short {
        /// Its name.
        clip: String,
        /// Its length.
        frames: usize,
    },
    /// A clip to be reached that is not there.
    #[error("there is no clip {0:?} to reach; the character has {1}")]
    NoSuchClip(String, String),
    /// The density asked for cannot be had.
    #[error(
        "a median of {asked_s} s to reach a clip cannot be had: with all {transitions} transitions \
         under {DISTANCE_M_MAX} m it is {best_s:.2} s; ask for that or more, name the clips that count \
         (--to, or reach_clips), or add clips"
    )]
    Unreachable {
        /// As asked for.
        asked_s: f32,
        /// The best there is.
        best_s: f32,
        /// How many transitions that takes.
        transitions: usize,
    },
}

/// Transitions between clips at a given density, sorted by place.
///
/// Cost: proportional to the square of the number of frames (9.7 million pairs of 27 joints take
/// about two seconds on one core); memory for one pair of clips at a time.
///
/// * `to`: the clips whose reach [`Density::Reach`] speaks of; none: all.
///
/// # Errors
/// No clip, one that is too short or not there, or a density that cannot be had.
pub fn compute(
    skeleton: &Skeleton,
    clips: &[Clip],
    fps: f32,
    density: Density,
    to: &[String],
) -> Result<Vec<Transition>, ComputeError> {
    if clips.is_empty() {
        return Err(ComputeError::NoClip);
    }
    if let Some(clip) = clips.iter().find(|c| c.poses.len() < CLIP_FRAMES_MIN) {
        let (clip, frames) = (clip.name.clone(), clip.poses.len());
        return Err(ComputeError::Short { clip, frames });
    }
    let to = named(clips, to)?;
    let tracks = transition::tracks(skeleton, clips);
    let mut found = Found::search(&tracks);
    let frames: Vec<usize> = clips.iter().map(|c| c.poses.len()).collect();
    let mut chosen = found.ways();
    join(&tracks, &frames, &mut chosen);
    found.minima.sort_by(nearer);
    let taken: BTreeSet<_> = chosen.iter().map(place).collect();
    found.minima.retain(|t| !taken.contains(&place(t)));
    let more = match density {
        Density::Threshold(limit_m) => {
            let more = found.minima.partition_point(|t| t.distance_m < limit_m);
            found.minima[..more].to_vec()
        }
        Density::Reach(asked_s) => {
            let goal = Goal { frames: &frames, fps, to: &to, asked_s };
            found.enough(&chosen, &goal)?
        }
    };
    chosen.extend(more);
    chosen.sort_by_key(place);
    chosen.dedup_by_key(|t| place(t));
    Ok(chosen)
}

/// As a motion graph file.
pub fn to_file(clips: &[Clip], fps: f32, transitions: &[Transition]) -> GraphFile {
    let file_clip = |c: &Clip| FileClip { name: c.name.clone(), frames: c.poses.len() };
    let file_transition = |t: &Transition| FileTransition {
        from_clip: clips[t.from_clip].name.clone(),
        from_frame: t.from_frame,
        to_clip: clips[t.to_clip].name.clone(),
        to_frame: t.to_frame,
        distance_m: (t.distance_m * 1e4).round() / 1e4,
    };
    GraphFile {
        fps,
        metric: format!(
            "RMS distance in metres of the joints' positions (thumbs and finger bases left out) \
             over a {WINDOW}-frame window, after the best turn about the vertical axis and the \
             best horizontal shift (Kovar et al. 2002, uniform weights)"
        ),
        clips: clips.iter().map(file_clip).collect(),
        transitions: transitions.iter().map(file_transition).collect(),
        largest_scc: None,
    }
}

/// Places of the named clips; all where none is named.
fn named(clips: &[Clip], names: &[String]) -> Result<Vec<usize>, ComputeError> {
    if names.is_empty() {
        return Ok((0..clips.len()).collect());
    }
    let place = |name: &String| {
        clips.iter().position(|clip| clip.name == *name).ok_or_else(|| {
            let all: Vec<&str> = clips.iter().map(|clip| clip.name.as_str()).collect();
            ComputeError::NoSuchClip(name.clone(), all.join(", "))
        })
    };
    names.iter().map(place).collect()
}

/// What a density asks for.
struct Goal<'a> {
    frames: &'a [usize],
    fps: f32,
    to: &'a [usize],
    asked_s: f32,
}

impl Goal<'_> {
    fn median_s(&self, chosen: &[Transition], more: &[Transition]) -> f32 {
        let all: Vec<_> = chosen.iter().chain(more).copied().collect();
        Reach::to_clips(self.frames, &all, self.fps, self.to).median_s
    }

    /// The smallest of `0..=most` that `is_met`, where it is met by `most` and by all above the smallest.
    fn least(most: usize, is_met: impl Fn(usize) -> bool) -> usize {
        let (mut low, mut high) = (0, most);
        while low < high {
            let middle = (low + high) / 2;
            if is_met(middle) { high = middle } else { low = middle + 1 }
        }
        high
    }
}

/// What the search over all pairs of frames found.
struct Found {
    clips: usize,
    minima: Vec<Transition>,
    /// Where each frame goes on best, by (from, to),
    ways: Vec<Way>,
    /// and where in the first third.
    begins: Vec<Way>,
    /// The best exit out of the end of a clip into each clip; `clips * clips`, by (from, to).
    exits: Vec<Option<Transition>>,
    /// The best entry into the beginning of a clip from each clip; by (from, to).
    entries: Vec<Option<Transition>>,
}

impl Found {
    fn search(tracks: &[JointTrack]) -> Self {
        let clips = tracks.len();
        let columns: Vec<Columns> = tracks.iter().map(Columns::new).collect();
        let (mut minima, mut ways, mut begins) = (Vec::new(), Vec::new(), Vec::new());
        let (mut exits, mut entries) = (Vec::new(), Vec::new());
        for from in 0..clips {
            for to in 0..clips {
                let table = Table::new(from, to, &columns[from], &columns[to]);
                minima.extend(table.minima());
                let [rows, columns] = [from, to].map(|clip| tracks[clip].frame_count());
                let way = |mut fits: Vec<Transition>| {
                    fits.retain(|t| t.distance_m < DISTANCE_M_MAX);
                    Way { fits, first: MARGIN_FRAMES, frames: rows }
                };
                let stay = STAY_FRAMES.min(columns / 2);
                ways.push(way(table.row_minima(|column| column + stay < columns)));
                begins.push(way(table.row_minima(|column| 3 * column < columns)));
                let [last, first] = [rows, columns].map(end_frames);
                exits.push(table.best(|row, _| row + last >= rows));
                entries.push(table.best(|_, column| column < first));
            }
        }
        Self { clips, minima, ways, begins, exits, entries }
    }

    /// The fewest further transitions that reach the density asked for.
    fn enough(
        &self,
        chosen: &[Transition],
        goal: &Goal<'_>,
    ) -> Result<Vec<Transition>, ComputeError> {
        let near = self.minima.partition_point(|t| t.distance_m < DISTANCE_M_MAX);
        let is_met = |more: &[Transition]| goal.median_s(chosen, more) <= goal.asked_s;
        let best_first = is_met(&self.minima[..near]).then(|| {
            let count = Goal::least(near, |count| is_met(&self.minima[..count]));
            self.minima[..count].to_vec()
        });
        let evenly = is_met(&self.evenly(goal.to, 1)).then(|| {
            let gap = |skipped: usize| GAP_FRAMES_MAX - skipped;
            let skipped = |skipped: usize| is_met(&self.evenly(goal.to, gap(skipped)));
            self.evenly(goal.to, gap(Goal::least(GAP_FRAMES_MAX - 1, skipped)))
        });
        let fewest = [best_first, evenly].into_iter().flatten().min_by_key(Vec::len);
        fewest.ok_or_else(|| {
            let all = self.evenly(goal.to, 1);
            let best_s = goal.median_s(chosen, &all);
            let transitions = chosen.len() + all.len();
            ComputeError::Unreachable { asked_s: goal.asked_s, best_s, transitions }
        })
    }

    /// Exits from each of these clips (or all, where there is one) to each other one, `gap` frames apart, and to the beginning of every
    /// further clip, eight times as far apart; and one way for each from its last third back into its first,
    /// so that it can be played on.
    fn evenly(&self, to: &[usize], gap: usize) -> Vec<Transition> {
        let mut all = Vec::new();
        for pair in 0..self.clips * self.clips {
            let (from, into) = (pair / self.clips, pair % self.clips);
            // One clip alone is to be reached from everywhere.
            if to.len() > 1 && !to.contains(&from) || to.len() == 1 && !to.contains(&into) {
                continue;
            }
            if !to.contains(&into) {
                all.extend(self.begins[pair].exits(ACTION_GAPS * gap));
            } else if from != into {
                all.extend(self.ways[pair].exits(gap));
            } else {
                let way = &self.begins[pair];
                let back = |t: &&Transition| 3 * t.from_frame >= 2 * way.frames;
                all.extend(way.fits.iter().filter(back).copied().min_by(nearer));
            }
        }
        all
    }

    /// The guaranteed exits and entries: the best ones, to and from different clips. Another clip
    /// goes before the clip itself, which is taken only where there is no other.
    fn ways(&self) -> Vec<Transition> {
        let mut all: Vec<Transition> = Vec::new();
        for clip in 0..self.clips {
            let out = (0..self.clips).map(|to| self.exits[clip * self.clips + to]);
            let into = (0..self.clips).map(|from| self.entries[from * self.clips + clip]);
            for ways in [out.collect::<Vec<_>>(), into.collect()] {
                let mut ways: Vec<Transition> = ways.into_iter().flatten().collect();
                let own = |t: &Transition| t.from_clip == t.to_clip;
                ways.sort_by(|a, b| own(a).cmp(&own(b)).then(nearer(a, b)));
                all.extend(ways.iter().take(WAYS));
            }
        }
        all.sort_by_key(place);
        all.dedup_by_key(|t| place(t));
        all
    }
}

/// Joins clips that are outside the largest component to it, at the best places.
fn join(tracks: &[JointTrack], frames: &[usize], chosen: &mut Vec<Transition>) {
    let columns: Vec<Columns> = tracks.iter().map(Columns::new).collect();
    for _ in 0..frames.len() {
        let topology = Topology::new(frames, chosen, true);
        let mut inside = vec![false; topology.nodes];
        for node in topology.digraph().largest_cycle_component() {
            inside[node as usize] = true;
        }
        let is_in = |clip: usize, frame: usize| inside[topology.clip_first[clip] as usize + frame];
        let Some(apart) = (0..frames.len()).find(|c| !is_in(*c, frames[*c] / 2)) else { return };
        let (mut into, mut out): (Option<Transition>, Option<Transition>) = (None, None);
        for clip in (0..frames.len()).filter(|c| *c != apart) {
            let table = Table::new(clip, apart, &columns[clip], &columns[apart]);
            let first = end_frames(frames[apart]);
            into = best_of(into, table.best(|row, column| is_in(clip, row) && column < first));
            let table = Table::new(apart, clip, &columns[apart], &columns[clip]);
            let last = end_frames(frames[apart]);
            let lands = |column: usize| column + transition::run_length(frames[clip], column);
            let leaves = |row: usize| row + last >= frames[apart];
            let way = table.best(|row, column| leaves(row) && is_in(clip, lands(column)));
            out = best_of(out, way);
        }
        chosen.extend(into.into_iter().chain(out));
        chosen.sort_by_key(place);
        chosen.dedup_by_key(|t| place(t));
    }
}

fn best_of(a: Option<Transition>, b: Option<Transition>) -> Option<Transition> {
    a.into_iter().chain(b).min_by(nearer)
}

fn end_frames(frames: usize) -> usize {
    END_FRAMES_MIN.max((frames as f32 * END_SHARE).ceil() as usize)
}

#[cfg(test)]
mod tests {
    use super::super::synthetic;
    use super::*;

    #[test]
    fn any_density_is_strongly_connected_and_denser_reaches_faster() {
        let (skeleton, clips) = synthetic::two_walks();
        let frames: Vec<usize> = clips.iter().map(|c| c.poses.len()).collect();
        let mut last_s = f32::INFINITY;
        for limit_m in [0.0, 0.05, 0.2] {
            let all = compute(&skeleton, &clips, 30.0, Density::Threshold(limit_m), &[]).unwrap();
            let reach = Reach::of_clips(&frames, &all, 30.0);
            assert!(reach.median_s <= last_s);
            last_s = reach.median_s;
            let topology = Topology::new(&frames, &all, true);
            let kept = topology.digraph().largest_cycle_component().len();
            assert!(kept as f32 > 0.6 * topology.nodes as f32, "{kept} of {}", topology.nodes);
            let file = to_file(&clips, 30.0, &all);
            let again = GraphFile::parse(&file.to_json()).unwrap();
            assert_eq!(again.resolve(&clips, 30.0).unwrap().len(), all.len());
        }
        let asked = compute(&skeleton, &clips, 30.0, Density::Reach(last_s), &[]).unwrap();
        assert!(Reach::of_clips(&frames, &asked, 30.0).median_s <= last_s);
        let error = compute(&skeleton, &clips, 30.0, Density::Reach(0.01), &[]).unwrap_err();
        assert!(matches!(error, ComputeError::Unreachable { .. }));
        // One clip alone can be reached faster than both.
        let run = ["run".to_owned()];
        let faster_s = 0.7 * last_s;
        let dense = compute(&skeleton, &clips, 30.0, Density::Reach(faster_s), &run).unwrap();
        assert!(Reach::to_clips(&frames, &dense, 30.0, &[1]).median_s <= faster_s);
        let error = compute(&skeleton, &clips, 30.0, Density::Reach(1.0), &["hop".into()]);
        assert!(error.unwrap_err().to_string().contains("\"hop\""));
    }

    #[test]
    fn short_clips_are_refused_by_name() {
        let (skeleton, mut clips) = synthetic::two_walks();
        clips[1].poses.truncate(20);
        let error = compute(&skeleton, &clips, 30.0, Density::Threshold(0.1), &[]).unwrap_err();
        assert!(error.to_string().contains("clip \"run\" has 20 frames"), "{error}");
    }
}

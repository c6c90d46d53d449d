//! Computes a motion graph from clips: where may one clip go on as another?
//!
//! Kovar, Gleicher and Pighin 2002: the distance of every pair of frames ([`mod@super::align`]),
//! its local minima, and those of them that are good enough. Strong connectivity is built in, not
//! hoped for: every clip gets its two best exits out of its last frames and its two best entries
//! into its first ones, and whatever is still apart is joined at the best place.

use std::cmp::Ordering;
use std::collections::BTreeSet;

use cloth::Skeleton;

use super::align::{JointTrack, WINDOW};
use super::character::Clip;
use super::motion_graph::{FileClip, FileTransition, GraphFile, Topology};
use super::reach::Reach;
use super::transition::{self, Transition};

/// Share of a clip that counts as its beginning or end for the guaranteed entries and exits.
const END_SHARE: f32 = 0.04;
/// At least so many frames of it.
const END_FRAMES_MIN: usize = 6;
/// Guaranteed exits and entries of a clip.
const WAYS: usize = 2;
/// A transition leaves at this frame or later, and arrives with as many left.
const MARGIN_FRAMES: usize = 15;
/// Frames of one clip that are nearer than this are not joined.
const SAME_CLIP_FRAMES: usize = 20;
/// Shortest clip that can be left and entered under these rules.
const CLIP_FRAMES_MIN: usize = 2 * MARGIN_FRAMES;
/// Beyond this distance no transition is taken for the sake of a shorter way (m).
const DISTANCE_M_MAX: f32 = 0.35;

/// How many transitions are asked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Density {
    /// Every local minimum of the distance below this (m).
    Threshold(f32),
    /// As few, best first, as bring the median time to reach a given clip to this (s).
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
         under {DISTANCE_M_MAX} m it is {best_s:.2} s; ask for that or more, or add clips"
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
    let mut taken: BTreeSet<_> = chosen.iter().map(place).collect();
    found.minima.retain(|t| !taken.contains(&place(t)));
    if let Density::Reach(asked_s) = density {
        let near = found.minima.partition_point(|t| t.distance_m < DISTANCE_M_MAX);
        let all: Vec<_> = chosen.iter().chain(&found.minima[..near]).copied().collect();
        if Reach::to_clips(&frames, &all, fps, &to).median_s > asked_s {
            // Then also where each frame fits best, whether or not its neighbours fit better.
            taken.extend(found.minima.iter().map(place));
            found.minima.truncate(near);
            let rows = found.rows.iter().filter(|t| to.contains(&t.to_clip));
            let mut rows: Vec<_> = rows.filter(|t| !taken.contains(&place(t))).copied().collect();
            rows.sort_by(nearer);
            found.minima.extend(rows);
        }
    }
    let more = match density {
        Density::Threshold(limit_m) => found.minima.partition_point(|t| t.distance_m < limit_m),
        Density::Reach(asked_s) => {
            let candidates = (&found.minima[..], &chosen[..]);
            enough(candidates, (&frames, fps), &to, asked_s)?
        }
    };
    chosen.extend_from_slice(&found.minima[..more]);
    chosen.sort_by_key(place);
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

fn place(t: &Transition) -> (usize, usize, usize, usize) {
    (t.from_clip, t.from_frame, t.to_clip, t.to_frame)
}

fn nearer(a: &Transition, b: &Transition) -> Ordering {
    a.distance_m.total_cmp(&b.distance_m).then(place(a).cmp(&place(b)))
}

/// The smallest number of further transitions that reaches the density asked for.
fn enough(
    (minima, chosen): (&[Transition], &[Transition]),
    (frames, fps): (&[usize], f32),
    to: &[usize],
    asked_s: f32,
) -> Result<usize, ComputeError> {
    let most = minima.iter().filter(|t| t.distance_m < DISTANCE_M_MAX).count();
    let median_s = |more: usize| {
        let all: Vec<_> = chosen.iter().chain(&minima[..more]).copied().collect();
        Reach::to_clips(frames, &all, fps, to).median_s
    };
    let best_s = median_s(most);
    if best_s > asked_s {
        let transitions = chosen.len() + most;
        return Err(ComputeError::Unreachable { asked_s, best_s, transitions });
    }
    let (mut low, mut high) = (0, most);
    while low < high {
        let middle = (low + high) / 2;
        if median_s(middle) <= asked_s { high = middle } else { low = middle + 1 }
    }
    Ok(high)
}

/// What the search over all pairs of frames found.
struct Found {
    clips: usize,
    minima: Vec<Transition>,
    /// Where each frame goes on best in each other clip.
    rows: Vec<Transition>,
    /// The best exit out of the end of a clip into each clip; `clips * clips`, by (from, to).
    exits: Vec<Option<Transition>>,
    /// The best entry into the beginning of a clip from each clip; by (from, to).
    entries: Vec<Option<Transition>>,
}

impl Found {
    fn search(tracks: &[JointTrack]) -> Self {
        let clips = tracks.len();
        let columns: Vec<Columns> = tracks.iter().map(Columns::new).collect();
        let (mut minima, mut rows) = (Vec::new(), Vec::new());
        let (mut exits, mut entries) = (Vec::new(), Vec::new());
        for from in 0..clips {
            for to in 0..clips {
                let table = Table::new(from, to, &columns[from], &columns[to]);
                minima.extend(table.minima());
                if from != to {
                    rows.extend(table.row_minima());
                }
                let (last, first) = (end_frames(table.rows), end_frames(table.columns));
                exits.push(table.best(|row, _| row + last >= table.rows));
                entries.push(table.best(|_, column| column < first));
            }
        }
        Self { clips, minima, rows, exits, entries }
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

/// Joint coordinates of a clip, one run of frames per joint, and the sums that a fit needs.
struct Columns {
    frames: usize,
    joints: usize,
    /// Frames that are stored: extrapolated ones included.
    stored: usize,
    coordinates: [Vec<f64>; 3],
    /// Sums over the joints of a window: x, z and squares.
    sums: Vec<[f64; 3]>,
}

impl Columns {
    fn new(track: &JointTrack) -> Self {
        let (joints, stored) = (track.joint_count(), track.stored_count());
        let mut columns = Self {
            frames: track.frame_count(),
            joints,
            stored,
            coordinates: [(); 3].map(|()| vec![0.0; joints * stored]),
            sums: Vec::new(),
        };
        // Near the origin fewer digits cancel.
        let middle = track.stored(stored / 2)[0];
        let mut per_frame = Vec::new();
        for frame in 0..stored {
            let mut sums = [0.0; 3];
            for (joint, p) in track.stored(frame).iter().enumerate() {
                let [x, y, z] = [p.x - middle.x, p.y, p.z - middle.z].map(f64::from);
                for (axis, value) in [x, y, z].into_iter().enumerate() {
                    columns.coordinates[axis][joint * stored + frame] = value;
                }
                sums[0] += x;
                sums[1] += z;
                sums[2] += x * x + y * y + z * z;
            }
            per_frame.push(sums);
        }
        let add = |a: [f64; 3], b: &[f64; 3]| [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
        columns.sums = per_frame.windows(WINDOW).map(|w| w.iter().fold([0.0; 3], add)).collect();
        columns
    }
}

/// Distances of one ordered pair of clips: row is `from_frame`, column is `to_frame`.
struct Table {
    from: usize,
    to: usize,
    rows: usize,
    columns: usize,
    distances: Vec<f32>,
}

impl Table {
    fn new(from: usize, to: usize, a: &Columns, b: &Columns) -> Self {
        let products = Products::new(a, b);
        let n = (a.joints * WINDOW) as f64;
        let mut distances = Vec::with_capacity(a.frames * b.frames);
        for row in 0..a.frames {
            // The window around the frame that would follow.
            let [sx, sz, source] = a.sums[row + 1];
            for column in 0..b.frames {
                let [tx, tz, target] = b.sums[column];
                let [cos, sin, up] = products.window(row + 1, column);
                let cos = cos - (sx * tx + sz * tz) / n;
                let sin = sin - (sx * tz - sz * tx) / n;
                let means = (sx * sx + sz * sz + tx * tx + tz * tz) / n;
                let squares = source + target - 2.0 * up - means;
                let left = (squares - 2.0 * cos.hypot(sin)).max(0.0);
                distances.push((left / n).sqrt() as f32);
            }
        }
        Self { from, to, rows: a.frames, columns: b.frames, distances }
    }

    fn at(&self, row: usize, column: usize) -> f32 {
        self.distances[row * self.columns + column]
    }

    fn transition(&self, row: usize, column: usize) -> Transition {
        Transition {
            from_clip: self.from,
            from_frame: row,
            to_clip: self.to,
            to_frame: column,
            distance_m: self.at(row, column),
        }
    }

    /// Whether a transition may be there at all.
    fn allowed(&self, row: usize, column: usize) -> bool {
        let far = self.from != self.to || (row + 1).abs_diff(column) >= SAME_CLIP_FRAMES;
        far && row >= MARGIN_FRAMES && column + MARGIN_FRAMES < self.columns
    }

    fn best(&self, inside: impl Fn(usize, usize) -> bool) -> Option<Transition> {
        let cells = (0..self.rows).flat_map(|row| (0..self.columns).map(move |c| (row, c)));
        let cells = cells.filter(|(row, column)| self.allowed(*row, *column));
        let cells = cells.filter(|(row, column)| inside(*row, *column));
        cells.map(|(row, column)| self.transition(row, column)).min_by(nearer)
    }

    fn minima(&self) -> Vec<Transition> {
        let mut minima = Vec::new();
        for row in 0..self.rows {
            for column in 0..self.columns {
                if self.allowed(row, column) && self.is_minimum(row, column) {
                    minima.push(self.transition(row, column));
                }
            }
        }
        minima
    }

    /// The best place to go on, of every row that has one near enough.
    fn row_minima(&self) -> Vec<Transition> {
        let best = |row: usize| {
            let columns = (0..self.columns).filter(|column| self.allowed(row, *column));
            columns.map(|column| self.transition(row, column)).min_by(nearer)
        };
        let near = |t: &Transition| t.distance_m < DISTANCE_M_MAX;
        (0..self.rows).filter_map(best).filter(near).collect()
    }

    /// Smaller than its eight neighbours; of equals the first counts.
    fn is_minimum(&self, row: usize, column: usize) -> bool {
        let here = self.at(row, column);
        let rows = row.saturating_sub(1)..=(row + 1).min(self.rows - 1);
        rows.into_iter().all(|r| {
            let columns = column.saturating_sub(1)..=(column + 1).min(self.columns - 1);
            columns.into_iter().all(|c| match (r, c).cmp(&(row, column)) {
                Ordering::Equal => true,
                Ordering::Less => here < self.at(r, c),
                Ordering::Greater => here <= self.at(r, c),
            })
        })
    }
}

/// Per pair of stored frames, sums over the joints: x x' + z z', x z' - z x', y y'.
struct Products {
    stored: usize,
    sums: Vec<[f64; 3]>,
}

impl Products {
    fn new(a: &Columns, b: &Columns) -> Self {
        let mut sums = Vec::with_capacity(a.stored * b.stored);
        let [mut cos, mut sin, mut up] = [(); 3].map(|()| vec![0.0f64; b.stored]);
        for frame in 0..a.stored {
            for total in [&mut cos, &mut sin, &mut up] {
                total.fill(0.0);
            }
            for joint in 0..a.joints {
                let [x, y, z] = [0, 1, 2].map(|c| a.coordinates[c][joint * a.stored + frame]);
                let of_b = |c: usize| &b.coordinates[c][joint * b.stored..][..b.stored];
                let (bx, by, bz) = (of_b(0), of_b(1), of_b(2));
                for i in 0..b.stored {
                    cos[i] += x * bx[i] + z * bz[i];
                    sin[i] += x * bz[i] - z * bx[i];
                    up[i] += y * by[i];
                }
            }
            sums.extend((0..b.stored).map(|i| [cos[i], sin[i], up[i]]));
        }
        Self { stored: b.stored, sums }
    }

    /// Summed over the windows that begin at these stored frames.
    fn window(&self, a: usize, b: usize) -> [f64; 3] {
        let mut total = [0.0; 3];
        for k in 0..WINDOW {
            let sums = self.sums[(a + k) * self.stored + b + k];
            for (t, s) in total.iter_mut().zip(sums) {
                *t += s;
            }
        }
        total
    }
}

#[cfg(test)]
mod tests {
    use super::super::{align, synthetic};
    use super::*;

    #[test]
    fn the_table_holds_the_distances_of_the_fit() {
        let (skeleton, clips) = synthetic::two_walks();
        let tracks = transition::tracks(&skeleton, &clips);
        let columns: Vec<_> = tracks.iter().map(Columns::new).collect();
        let table = Table::new(0, 1, &columns[0], &columns[1]);
        for (row, column) in [(0, 0), (17, 3), (59, 40), (30, 59)] {
            let fit = align::fit(tracks[0].window(row + 1), tracks[1].window(column));
            assert!((table.at(row, column) - fit.distance_m).abs() < 1e-5);
        }
    }

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

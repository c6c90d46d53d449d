//! Distances of all pairs of frames of two clips, and where they are small.
//!
//! The distance is that of [`mod@super::align`] (Kovar, Gleicher and Pighin 2002, section 3.1); its sums
//! over joints and windows are shared between pairs of frames.

use std::cmp::Ordering;

use super::align::{JointTrack, WINDOW};
use super::transition::Transition;

/// A transition leaves at this frame or later, and arrives with as many left.
pub const MARGIN_FRAMES: usize = 15;
/// Frames of one clip that are nearer than this are not joined.
const SAME_CLIP_FRAMES: usize = 20;

/// Order by distance, of equals by place.
pub fn nearer(a: &Transition, b: &Transition) -> Ordering {
    a.distance_m.total_cmp(&b.distance_m).then(place(a).cmp(&place(b)))
}

/// What makes a transition another one than its neighbours.
pub fn place(t: &Transition) -> (usize, usize, usize, usize) {
    (t.from_clip, t.from_frame, t.to_clip, t.to_frame)
}

/// Joint coordinates of a clip, one run of frames per joint, and the sums that a fit needs.
pub struct Columns {
    frames: usize,
    joints: usize,
    /// Frames that are stored: extrapolated ones included.
    stored: usize,
    coordinates: [Vec<f64>; 3],
    /// Sums over the joints of a window: x, z and squares.
    sums: Vec<[f64; 3]>,
}

impl Columns {
    pub fn new(track: &JointTrack) -> Self {
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
pub struct Table {
    from: usize,
    to: usize,
    rows: usize,
    columns: usize,
    distances: Vec<f32>,
}

impl Table {
    pub fn new(from: usize, to: usize, a: &Columns, b: &Columns) -> Self {
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

    pub fn at(&self, row: usize, column: usize) -> f32 {
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

    pub fn best(&self, inside: impl Fn(usize, usize) -> bool) -> Option<Transition> {
        let cells = (0..self.rows).flat_map(|row| (0..self.columns).map(move |c| (row, c)));
        let cells = cells.filter(|(row, column)| self.allowed(*row, *column));
        let cells = cells.filter(|(row, column)| inside(*row, *column));
        cells.map(|(row, column)| self.transition(row, column)).min_by(nearer)
    }

    pub fn minima(&self) -> Vec<Transition> {
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

    /// The best place to go on, of every frame that may be left and has one; only at these columns.
    pub fn row_minima(&self, inside: impl Fn(usize) -> bool) -> Vec<Transition> {
        let best = |row: usize| {
            let columns = (0..self.columns).filter(|c| self.allowed(row, *c) && inside(*c));
            columns.map(|column| self.transition(row, column)).min_by(nearer)
        };
        (0..self.rows).filter_map(best).collect()
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
    use super::super::{align, synthetic, transition};
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
}

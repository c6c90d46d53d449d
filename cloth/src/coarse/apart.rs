//! Contact of the points with each other: those that are no neighbours keep a distance.
//!
//! Balls around points instead of triangles: what passes between balls is not seen, but layers of a
//! mesh whose edges are no longer than a ball is wide stay apart, at a cost that a frame can bear. Which
//! points may meet is listed once a step; in the sweeps those that are too near go apart along the
//! line between them, on the sides on which they were at its beginning.

use glam::Vec3A;

use super::{Coarse, Workspace};
use crate::solver::simd::{self, Task};

/// Pairs that are listed, at most, for each point.
const PAIRS_MAX: usize = 24;
/// Of their distance in the rest shape, neighbours are let so near.
const REST_SHARE: f32 = 0.7;
/// What was too near at the beginning goes apart by at most this share of the distance in a step.
const OPENS: f32 = 0.04;
const LANES: usize = 8;

/// Points that may meet in a step.
#[derive(Debug, Clone, Default)]
pub(super) struct Pairs {
    /// Axis after axis, at the beginning (m); filled up with points far away.
    at: [Vec<f32>; 3],
    /// How far each may go besides what all go (m), with half the distance that is kept.
    room: Vec<f32>,
    list: Vec<Pair>,
}

#[derive(Debug, Clone, Copy)]
struct Pair {
    points: [u16; 2],
    /// What keeps them apart in this step (m), and on which side the first one was.
    most: f32,
    side: Vec3A,
}

impl Coarse {
    pub(super) fn find_pairs(&self, ws: &mut Workspace) {
        let apart = self.settings.apart_m;
        if apart <= 0.0 {
            return;
        }
        let count = ws.start.len();
        let (start, aim, pairs) = (&ws.start, &ws.aim, &mut ws.apart);
        let ways = aim.iter().zip(start).map(|(a, s)| *a - *s);
        let common = ways.sum::<Vec3A>() / count as f32;
        let padded = count.next_multiple_of(LANES);
        for (axis, list) in pairs.at.iter_mut().enumerate() {
            list.clear();
            list.extend(start.iter().map(|x| x[axis]));
            list.resize(padded, f32::MAX.sqrt() * 1e-3);
        }
        pairs.room.clear();
        let room = |(a, s): (&Vec3A, &Vec3A)| 0.5 * apart + (*a - *s - common).length().min(apart);
        pairs.room.extend(aim.iter().zip(start).map(room));
        pairs.room.resize(padded, 0.0);
        pairs.list.clear();
        pairs.list.reserve(PAIRS_MAX * count);
        let rest = self.mesh.rest_positions();
        let Pairs { at, room, list } = pairs;
        let mut meet = |i: usize, j: usize| {
            let led = self.places[i] == usize::MAX && self.places[j] == usize::MAX;
            let most = apart.min(REST_SHARE * rest[i].distance(rest[j]));
            let side = start[i] - start[j];
            let most = most.min(side.length() + OPENS * apart);
            if !led && list.len() < PAIRS_MAX * count {
                list.push(Pair { points: [i as u16, j as u16], most, side });
            }
        };
        simd::run(Search { at, room, count, meet: &mut meet });
    }

    /// Pairs that are too near go apart, each by its share of their masses.
    pub(super) fn keep_apart(&self, ws: &mut Workspace) {
        if self.settings.apart_m <= 0.0 {
            return;
        }
        let weight =
            |i: usize| if self.places[i] == usize::MAX { 0.0 } else { 1.0 / self.masses[i] };
        for pair in &ws.apart.list {
            let [a, b] = pair.points.map(usize::from);
            let way = ws.x[a] - ws.x[b];
            let passed = way.dot(pair.side) < 0.0;
            if !passed && way.length_squared() >= pair.most * pair.most {
                continue;
            }
            let along = if passed { pair.side } else { way };
            let Some(along) = along.try_normalize() else { continue };
            let (wa, wb) = (weight(a), weight(b));
            let short = (pair.most - along.dot(way)).clamp(0.0, 2.0 * pair.most);
            let push = along * (short / (wa + wb).max(f32::MIN_POSITIVE));
            ws.x[a] += push * wa;
            ws.x[b] -= push * wb;
        }
    }
}

/// Every pair nearer than the room of both.
struct Search<'a, F> {
    at: &'a [Vec<f32>; 3],
    room: &'a [f32],
    count: usize,
    meet: &'a mut F,
}

impl<F: FnMut(usize, usize)> Task for Search<'_, F> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let [x, y, z] = self.at.each_ref().map(|list| list.as_chunks::<LANES>().0);
        let rooms = self.room.as_chunks::<LANES>().0;
        for i in 0..self.count {
            let [px, py, pz] = self.at.each_ref().map(|list| list[i]);
            let own = self.room[i];
            for block in i / LANES..rooms.len() {
                let mut near = [false; LANES];
                for lane in 0..LANES {
                    let (dx, dy) = (x[block][lane] - px, y[block][lane] - py);
                    let (dz, room) = (z[block][lane] - pz, rooms[block][lane] + own);
                    near[lane] = dx * dx + dy * dy + dz * dz < room * room;
                }
                if near.iter().any(|n| *n) {
                    for (lane, near) in near.iter().enumerate() {
                        let j = block * LANES + lane;
                        if *near && j > i && j < self.count {
                            (self.meet)(i, j);
                        }
                    }
                }
            }
        }
    }
}

//! Contact of points with colliders and the ground.

use glam::Vec3A;

use super::collide::Swept;
use super::{Coarse, Input, NEAREST, Workspace};

impl Coarse {
    /// For each point the colliders that it may meet, nearest first.
    pub(super) fn find_near(&self, input: &Input<'_>, shift: Vec3A, ws: &mut Workspace) {
        let offset = self.material.offset + self.settings.expansion_m;
        ws.swept.clear();
        ws.swept.extend(input.colliders.iter().map(|c| Swept::new(c, offset, shift)));
        ws.near.clear();
        ws.clear.clear();
        ws.contacts.clear();
        ws.contacts.resize(self.masses.len(), None);
        for (i, place) in self.places.iter().enumerate() {
            let x = ws.start[i];
            // The strain limit and neighbours may carry a point further than its own aim.
            let way = 2.0 * (ws.aim[i] - x).length() + 0.1;
            let led = *place == usize::MAX;
            let near = if led { [u16::MAX; NEAREST] } else { nearest(&ws.swept, x, way) };
            ws.near.push(near);
            ws.clear.push(near.map(|c| ws.swept.get(usize::from(c)).map_or(0.0, |c| c.clear(x))));
        }
        self.find_near_between(ws);
    }

    /// Leads points out of colliders and off the ground.
    pub(super) fn push_out(&self, ws: &mut Workspace) {
        let friction = self.material.friction;
        for (i, (near, clear)) in ws.near.iter().zip(&ws.clear).enumerate() {
            for (c, clear) in near.iter().zip(clear).take_while(|(c, _)| **c != u16::MAX) {
                let way2 = (ws.x[i] - ws.start[i]).length_squared();
                if *clear > 0.0 && way2 < clear * clear {
                    continue;
                }
                let swept = &ws.swept[usize::from(*c)];
                let Some(hit) = swept.hit(ws.start[i], ws.x[i]) else { continue };
                ws.x[i] += hit.normal * hit.depth;
                let slip = ws.x[i] - ws.start[i] - hit.travel;
                let slip = slip - hit.normal * hit.normal.dot(slip);
                let most = friction * hit.depth;
                let share = most / slip.length().max(most).max(1e-12);
                ws.x[i] -= slip * share;
                ws.contacts[i] = Some((hit.normal, hit.travel));
            }
        }
        if self.environment.ground {
            let least = self.material.offset;
            for (i, x) in ws.x.iter_mut().enumerate() {
                let depth = least - x.y;
                if depth > 0.0 && self.places[i] != usize::MAX {
                    let slip = (*x - ws.start[i]) * Vec3A::new(1.0, 0.0, 1.0);
                    let most = self.environment.ground_friction * depth;
                    *x -= slip * (most / slip.length().max(most).max(1e-12));
                    x.y = least;
                    ws.contacts[i] = Some((Vec3A::Y, Vec3A::ZERO));
                }
            }
        }
    }
}

/// The colliders nearest to `x` that something within `way` of it may meet (m), nearest first.
pub(super) fn nearest(colliders: &[Swept], x: Vec3A, way: f32) -> [u16; NEAREST] {
    let mut near = [u16::MAX; NEAREST];
    let mut distances = [f32::INFINITY; NEAREST];
    for (c, swept) in colliders.iter().enumerate() {
        if swept.misses(x, way) > 0.0 {
            continue;
        }
        let distance = swept.distance(x);
        if distance < distances[0] {
            (distances[1], near[1]) = (distances[0], near[0]);
            (distances[0], near[0]) = (distance, c as u16);
        } else if distance < distances[1] {
            (distances[1], near[1]) = (distance, c as u16);
        }
    }
    near
}

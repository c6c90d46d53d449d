//! What has got to the wrong side of a limb is led home, without history.
//!
//! Contact leads any vertex out of the body within a frame unless the cloth around it pulls the
//! other way. So a vertex that is deep inside when a frame begins is part of a tangle: the cloth
//! crosses a limb there. For that frame such vertices, and the patches that they cut off from the
//! rest of the garment, feel no contact and are drawn to their place on the body as it was in the
//! rest pose, at a bounded speed (compare Baraff et al. 2003, "Untangling Cloth").

use super::contact::Near;
use crate::model::Model;

/// A vertex deeper than this at a frame's beginning is led home (m).
const DEEP_M: f32 = 0.004;

/// A vertex further from the body in the rest pose has no home there: a skirt's hem.
const HOME_M: f32 = 0.05;

/// Marks of the vertices that are led home, and the scratch to find them.
#[derive(Debug, Clone, Default)]
pub(crate) struct Recovery {
    /// For each vertex whether it is led home in this frame.
    pub(crate) led: Vec<bool>,
    part: Vec<u32>,
    stack: Vec<u32>,
    sizes: Vec<u32>,
}

const UNSEEN: u32 = u32::MAX;

impl Recovery {
    /// Marks deep vertices and all parts of the garment that they cut off but the largest.
    pub(crate) fn mark(&mut self, model: &Model, near: &[Near], held: &[bool]) {
        self.led.clear();
        let homely = |i: usize| model.homes.get(i).is_some_and(|h| h.offset.length() < HOME_M);
        let deep = |(i, n): (usize, &Near)| n.is_deeper_than(DEEP_M) && !held[i] && homely(i);
        self.led.extend(near.iter().enumerate().map(deep));
        if !self.led.contains(&true) {
            return;
        }
        self.part.clear();
        self.part.resize(near.len(), UNSEEN);
        self.sizes.clear();
        for start in 0..near.len() {
            if !self.led[start] && self.part[start] == UNSEEN {
                let size = self.fill(model, start as u32);
                self.sizes.push(size);
            }
        }
        let largest = self.sizes.iter().copied().max().unwrap_or(0);
        for (i, led) in self.led.iter_mut().enumerate() {
            let cut_off = !*led && homely(i) && self.sizes[self.part[i] as usize] < largest;
            *led = (*led || cut_off) && !held[i];
        }
    }

    /// Gives the next number to all vertices connected to `start`; returns how many they are.
    fn fill(&mut self, model: &Model, start: u32) -> u32 {
        let number = self.sizes.len() as u32;
        let mut size = 0;
        self.part[start as usize] = number;
        self.stack.push(start);
        while let Some(v) = self.stack.pop() {
            size += 1;
            for slot in model.pattern.near.row(v as usize) {
                let to = model.pattern.near.columns[slot];
                if !self.led[to as usize] && self.part[to as usize] == UNSEEN {
                    self.part[to as usize] = number;
                    self.stack.push(to);
                }
            }
        }
        size
    }
}

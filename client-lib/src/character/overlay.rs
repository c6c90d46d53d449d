//! What is added to vertices after reconstruction: a state's own fixes, and what is left of the
//! change from one basis to another.

use std::ops::Range;

use codec::Basis;

use crate::blend::BLEND_FRAMES;

/// A vertex and by how much it is moved (m).
pub type VertexOffset = (u32, [f32; 3]);

/// Offsets of this frame and the one before.
#[derive(Debug, Default)]
pub(super) struct Overlay {
    pub(super) now: Vec<VertexOffset>,
    before: Vec<VertexOffset>,
    phase: f32,
    /// By row (m): where the cloth was on another basis, less where it is on this one.
    carried: Vec<f32>,
    /// Frames since the basis changed.
    age: usize,
}

impl Overlay {
    /// The frame at hand becomes the one before.
    pub(super) fn begin_frame(&mut self) {
        std::mem::swap(&mut self.before, &mut self.now);
        self.now.clear();
        if !self.carried.is_empty() {
            self.age += 1;
            // Between the tenth frame and the one before something is left.
            if self.age > BLEND_FRAMES {
                self.carried.clear();
            }
        }
    }

    pub(super) fn sample(&mut self, phase: f32) {
        self.phase = phase;
    }

    /// The same cloth on another basis, with the fixes that it has there: keeps the difference, which
    /// decays over ten frames. Gives the largest one (m).
    pub(super) fn carry(
        &mut self,
        old: (&Basis, &[f32]),
        new: (&Basis, &[f32]),
        fixes: Vec<VertexOffset>,
    ) -> f32 {
        let positions = |(basis, coefficients): (&Basis, &[f32])| {
            let mut out = vec![0.0; basis.rows()];
            let columns = basis.columns().min(coefficients.len());
            basis.reconstruct(coefficients, 0..basis.rows(), columns, &mut out).map(|()| out)
        };
        let (Ok(mut was), Ok(mut is)) = (positions(old), positions(new)) else { return 0.0 };
        if was.len() != is.len() {
            return 0.0;
        }
        self.add_to(0..was.len(), &mut was);
        *self = Self { now: fixes, phase: 1.0, ..Self::default() };
        self.add_to(0..is.len(), &mut is);
        was.iter_mut().zip(&is).for_each(|(was, is)| *was -= is);
        (self.carried, self.age) = (was, 0);
        largest_m(&self.carried)
    }

    /// Replaces rows (m) of reconstructed cloth, to which this frame's fixes are still to be added, by
    /// what leads from there to `shown`; gives the largest distance of a vertex (m).
    pub(super) fn offset_m(&self, shown: &[f32], rows: &mut [f32]) -> f32 {
        for (vertex, offset) in &self.now {
            let at = 3 * *vertex as usize;
            if let Some(rows) = rows.get_mut(at..at + 3) {
                rows.iter_mut().zip(offset).for_each(|(row, x)| *row += x);
            }
        }
        rows.iter_mut().zip(shown).for_each(|(row, shown)| *row = shown - *row);
        largest_m(rows)
    }

    /// From the next frame on these offsets (m, by row) decay; in this frame they are whole.
    pub(super) fn carry_offset(&mut self, rows: &[f32]) {
        self.carried.clear();
        self.carried.extend_from_slice(rows);
        self.age = 0;
    }

    /// Adds what belongs to this frame, or to the one before, as it is shown there.
    pub(super) fn add_one(&self, now: bool, rows: Range<usize>, out: &mut [f32]) {
        let (offsets, phase) = if now { (&self.now, 1.0) } else { (&self.before, 0.0) };
        self.add(&[(offsets, 1.0)], phase, rows, out);
    }

    /// Adds everything to these rows of the sampled cloth (m).
    pub(super) fn add_to(&self, rows: Range<usize>, out: &mut [f32]) {
        let both = [(&self.before, 1.0 - self.phase), (&self.now, self.phase)];
        self.add(&both, self.phase, rows, out);
    }

    fn add(
        &self,
        parts: &[(&Vec<VertexOffset>, f32)],
        phase: f32,
        rows: Range<usize>,
        out: &mut [f32],
    ) {
        for (offsets, weight) in parts.iter().copied() {
            if weight <= 0.0 {
                continue;
            }
            for (vertex, offset) in offsets {
                for (axis, offset) in offset.iter().enumerate() {
                    let row = 3 * *vertex as usize + axis;
                    if rows.contains(&row) {
                        out[row - rows.start] += weight * offset;
                    }
                }
            }
        }
        if let Some(carried) = self.carried.get(rows) {
            let age = (self.age as f32 - (1.0 - phase)).max(0.0);
            let weight = (BLEND_FRAMES as f32 - age).max(0.0) / BLEND_FRAMES as f32;
            out.iter_mut().zip(carried).for_each(|(out, x)| *out += weight * x);
        }
    }
}

/// The longest of offsets given by row (m).
fn largest_m(rows: &[f32]) -> f32 {
    let (vertices, _) = rows.as_chunks::<3>();
    let square = |v: &[f32; 3]| v.iter().map(|x| x * x).sum::<f32>();
    vertices.iter().map(square).fold(0.0, f32::max).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fixes_are_interpolated_and_cut_to_the_rows_asked_for() {
        let mut overlay = Overlay { now: vec![(1, [1.0, 2.0, 3.0])], ..Overlay::default() };
        overlay.begin_frame();
        overlay.now.push((0, [8.0, 8.0, 8.0]));
        overlay.sample(0.25);
        let mut out = [0.0; 3];
        overlay.add_to(2..5, &mut out);
        assert_eq!(out, [2.0, 0.75, 1.5]);
    }

    #[test]
    fn a_change_of_basis_is_not_seen_at_first_and_gone_after_ten_frames() {
        let basis = crate::tiny::basis();
        let mut overlay = Overlay::default();
        overlay.sample(1.0);
        let moved_m = overlay.carry((&basis, &[0.5, 0.0]), (&basis, &[0.0, 0.0]), Vec::new());
        assert!((moved_m - 0.5 * crate::tiny::SCALE_M).abs() < 1e-3);
        let mut out = [0.0; 3];
        overlay.add_to(0..3, &mut out);
        assert!((out[0] - moved_m).abs() < 1e-6);
        (0..BLEND_FRAMES).for_each(|_| overlay.begin_frame());
        let mut out = [0.0; 3];
        overlay.add_to(0..3, &mut out);
        assert_eq!(out, [0.0; 3]);
    }
}

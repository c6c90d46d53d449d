//! Many characters on one basis, decoded together.

use std::time::Instant;

use anyhow::Result;
use client_lib::{Group, Histogram};

use super::actor::Actor;
use super::wire::FrameWriter;

/// Characters whose positions are in memory at once: as many as one walk over the basis serves.
const TOGETHER: usize = 16;

/// What decoding a crowd needs, kept between frames.
#[derive(Debug, Default)]
pub struct Crowd {
    group: Group,
    positions: Vec<f32>,
}

impl Crowd {
    /// Writes all actors at `phase` between the last frame and this one. A character's part of the time goes
    /// into the histograms (us): of decoding, and of all.
    ///
    /// # Errors
    /// Cloth that cannot be decoded.
    pub fn write(
        &mut self,
        actors: &mut [Actor],
        phase: f32,
        (decode_us, all_us): (&mut Histogram, &mut Histogram),
        writer: &mut FrameWriter,
    ) -> Result<()> {
        for actors in actors.chunks_mut(TOGETHER) {
            let start = Instant::now();
            actors.iter_mut().for_each(|actor| _ = actor.character.sample(phase));
            let rows = actors[0].character.version().basis().rows();
            let columns = actors[0].columns;
            self.positions.resize(actors.len() * rows, 0.0);
            let characters: Vec<_> = actors.iter().map(|actor| &actor.character).collect();
            self.group.decode(&characters, 0..rows, columns, &mut self.positions)?;
            let each_us = start.elapsed().as_secs_f64() * 1e6 / actors.len() as f64;
            for (actor, positions) in actors.iter_mut().zip(self.positions.chunks(rows.max(1))) {
                let start = Instant::now();
                actor.write_decoded(positions, writer);
                decode_us.record(each_us);
                all_us.record(each_us + start.elapsed().as_secs_f64() * 1e6);
            }
        }
        Ok(())
    }
}

//! Both sides of a merge, standing still, coloured by their distance.

use glam::Vec3;

use super::actor::{Actor, Tint};

/// Reads what stills show once it has been streamed, and colours the cloth by their distance.
pub fn fill_stills(actors: &mut [Actor]) {
    let [walker, before, after] = actors else { return };
    let waits = |actor: &Actor| actor.still.as_ref().is_some_and(|s| s.positions.is_empty());
    if !waits(before) && !waits(after) {
        return;
    }
    for actor in [&mut *before, &mut *after] {
        actor.character.refresh();
        let Some(still) = &mut actor.still else { continue };
        if !matches!(actor.character.cloth_of(still.state, &mut still.positions), Ok(true)) {
            still.positions.clear();
        }
    }
    if waits(before) || waits(after) {
        return;
    }
    let tint = tint(before, after);
    walker.tint = Tint { weight: 0.0, ..tint.clone() };
    before.tint = tint.clone();
    after.tint = tint;
}

/// Distances between the cloth of two stills, by vertex, as shares of the largest.
fn tint(a: &Actor, b: &Actor) -> Tint {
    let (Some(a), Some(b)) = (&a.still, &b.still) else { return Tint::default() };
    let ((a, _), (b, _)) = (a.positions.as_chunks::<3>(), b.positions.as_chunks::<3>());
    let apart = a.iter().zip(b).map(|(a, b)| Vec3::from_array(*a).distance(Vec3::from_array(*b)));
    let distances: Vec<f32> = apart.collect();
    let largest = distances.iter().copied().fold(0.0f32, f32::max);
    if largest < 1e-5 {
        return Tint::default();
    }
    Tint { shares: distances.iter().map(|d| d / largest).collect(), weight: 1.0 }
}

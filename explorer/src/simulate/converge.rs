//! How far the simulator is from its own limit: the same walk at finer steps and on finer meshes,
//! beside what chaos alone makes of a micrometre.

use glam::Vec3;
use protocol::PoseId;
use serde::Serialize;

use super::{Options, Straight};
use crate::grid::GridState;
use crate::scene::Scene;
use crate::simulator::SimulateError;

/// How far the start is moved to find the floor that chaos sets (m).
pub const NUDGE_M: f32 = 1e-6;

/// Vertices that two meshes share may lie this far apart in the rest shape (m): a tailor's ease goes
/// along normals, and those of a finer mesh differ a little.
const ALIKE_M: f32 = 0.01;

/// The distance between two answers after some time, over the vertices that both have.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// Which two, such as `dt - dt/2`.
    pub what: String,
    /// Since the start of the walk (s).
    pub horizon_s: f32,
    /// Root of the mean square (mm).
    pub rms_mm: f32,
    /// Of 95 of 100 vertices (mm).
    pub p95_mm: f32,
    /// Of the worst vertex (mm).
    pub max_mm: f32,
}

/// The states of one run at the horizons.
type Answer = Vec<GridState>;

/// Runs a walk's poses again and again and compares.
///
/// * `scenes`: the same scene on ever finer meshes, each beginning with the vertices of the one
///   before (as [`crate::import::refine::refine_to`] makes them).
/// * `walk`: the poses after the start.
/// * `horizons`: frames at which answers are compared, ascending; 0 is the drape.
/// * `note`: told which run begins.
///
/// # Errors
/// A run that cannot be simulated.
pub fn converge(
    scenes: &[Scene],
    walk: &[PoseId],
    horizons: &[usize],
    note: &mut dyn FnMut(&str),
) -> Result<Vec<Row>, SimulateError> {
    let Some(first) = scenes.first() else { return Ok(Vec::new()) };
    let rest: Vec<&[Vec3]> = scenes.iter().map(|scene| &scene.garment.positions[..]).collect();
    let apart_m = rest.windows(2).map(|pair| apart_m(pair[0], pair[1])).fold(0.0, f32::max);
    if apart_m > ALIKE_M {
        let text = format!(
            "the garment is made anew for every number of vertices: the first vertices of its finer \
             meshes lie up to {:.1} mm from the coarser one's; take one that is a file, such as dress",
            apart_m * 1e3
        );
        return Err(SimulateError(text));
    }
    let fps = first.primary.fps();
    let mut rows = Vec::new();
    let mut add = |what: &str, a: &Answer, b: &Answer| {
        for ((a, b), frame) in a.iter().zip(b).zip(horizons) {
            rows.push(row(what, *frame as f32 / fps, a, b));
        }
    };
    note("draping");
    let start = Straight::new(first, Options::default())?;
    let mut run = |what: &str, options| {
        note(what);
        answer(start.again(options)?, walk, horizons)
    };
    let plain = run("dt", Options::default())?;
    let nudged = run("dt, moved", Options { nudge_m: NUDGE_M, ..Options::default() })?;
    let half = run("dt/2", Options { refine: 2, ..Options::default() })?;
    let quarter = run("dt/4", Options { refine: 4, ..Options::default() })?;
    add("floor: moved by 1 micrometre", &plain, &nudged);
    add("dt - dt/2", &plain, &half);
    add("dt/2 - dt/4", &half, &quarter);
    let mut coarse = (first, plain);
    for scene in &scenes[1..] {
        let count = |scene: &Scene| scene.garment.positions.len();
        let what = format!("{} - {} vertices", count(coarse.0), count(scene));
        note(&what);
        let fine = answer(Straight::new(scene, Options::default())?, walk, horizons)?;
        add(&what, &coarse.1, &fine);
        coarse = (scene, fine);
    }
    Ok(rows)
}

/// The largest distance of a vertex from the one with its number in a finer mesh (m); infinite where
/// there is none.
fn apart_m(coarse: &[Vec3], fine: &[Vec3]) -> f32 {
    if fine.len() < coarse.len() {
        return f32::INFINITY;
    }
    coarse.iter().zip(fine).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max)
}

fn answer(
    mut straight: Straight<'_>,
    walk: &[PoseId],
    horizons: &[usize],
) -> Result<Answer, SimulateError> {
    let mut states = Vec::new();
    for frame in 0..=walk.len() {
        if horizons.contains(&frame) {
            states.push(straight.state().clone());
        }
        if let Some(next) = walk.get(frame) {
            straight.step(*next)?;
        }
    }
    Ok(states)
}

/// States are in the frame of the same pose, so that distances are those in the world.
fn row(what: &str, horizon_s: f32, a: &GridState, b: &GridState) -> Row {
    let common = a.vertex_count().min(b.vertex_count());
    let mut far: Vec<f32> =
        (0..common).map(|v| a.position(v).distance(b.position(v)) * 1e3).collect();
    far.sort_unstable_by(f32::total_cmp);
    let mean_square = far.iter().map(|d| d * d).sum::<f32>() / common.max(1) as f32;
    let at = |share: f32| far[((common - 1) as f32 * share) as usize];
    Row {
        what: what.into(),
        horizon_s,
        rms_mm: mean_square.sqrt(),
        p95_mm: at(0.95),
        max_mm: at(1.0),
    }
}

/// The rows as a Markdown table, one line per pair of answers.
pub fn markdown(rows: &[Row]) -> String {
    let mut text = String::new();
    for group in rows.chunk_by(|a, b| a.what == b.what) {
        if text.is_empty() {
            text.push_str("| answers |");
            group.iter().for_each(|r| text += &format!(" {} s |", r.horizon_s));
            text.push_str("\n| --- |");
            group.iter().for_each(|_| text.push_str(" --- |"));
            text.push('\n');
        }
        text += &format!("| {} |", group[0].what);
        for r in group {
            text += &format!(" {:.2} / {:.2} / {:.1} |", r.rms_mm, r.p95_mm, r.max_mm);
        }
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_finer_mesh_has_the_coarser_ones_vertices_first() {
        let coarse = [Vec3::ZERO, Vec3::X];
        let moved = apart_m(&coarse, &[Vec3::ZERO, Vec3::X * 1.25, Vec3::Y]);
        assert!((moved - 0.25).abs() < 1e-6);
        assert!(apart_m(&coarse, &[Vec3::ZERO]).is_infinite());
    }

    #[test]
    fn distances_are_of_the_vertices_that_both_have() {
        let state = |steps: &[i16]| GridState {
            positions: steps.iter().map(|s| [*s, 0, 0]).collect(),
            velocities: vec![[0; 3]; steps.len()],
        };
        // A step of the grid is 2^-14 m.
        let row = row("x", 0.5, &state(&[0, 0]), &state(&[0, 16_384, 77]));
        assert!((row.max_mm - 1000.0).abs() < 1e-3 && row.p95_mm.abs() < 1e-6, "{row:?}");
        assert!((row.rms_mm - 707.107).abs() < 1e-2, "{row:?}");
        let table = markdown(&[row]);
        assert_eq!(table, "| answers | 0.5 s |\n| --- | --- |\n| x | 707.11 / 0.00 / 1000.0 |\n");
    }
}

//! D4: what S1 and S2 cost at the sizes that garments have.

use super::sheets::{ball_sheet, pinned_material, pinned_sheet};
use super::{Bench, LabError, Limit, Setting, Stage};

pub(crate) const D4: Bench = Bench {
    name: "D4",
    about: "cost of S1 and S2 at 5,041, 10,000 and 29,929 vertices",
    reference: "0.05, 0.1, 0.3 s per 1/30 s; the peers: docs/results/peers.md",
    fast: false,
    reads: &[Setting::Fabric, Setting::Dt],
    run: costs,
};

/// Frames of 1/60 s: the sheet falls, lands and folds.
const FRAMES: u32 = 72;

fn costs(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let sizes = [(71u32, 0.05f64), (100, 0.1), (173, 0.3)];
    let chosen = if stage.quick() { 1 } else { sizes.len() };
    for (n, most) in sizes.into_iter().take(chosen) {
        for on_ball in [false, true] {
            let (mut sim, pose) = if on_ball {
                let (sim, pose) = ball_sheet(stage, n)?;
                (sim, Some(pose))
            } else {
                let material = pinned_material(stage);
                (pinned_sheet(stage, n, material, 1.0 / 60.0)?, None)
            };
            let mut costs = Vec::new();
            for _ in 0..FRAMES {
                let before = stage.tally.cpu_s;
                stage.step(&mut sim, pose.as_ref().map(|p| (p, p)))?;
                costs.push(2.0 * (stage.tally.cpu_s - before));
            }
            costs.sort_by(f64::total_cmp);
            let name = if on_ball { "S2" } else { "S1" };
            let vertices = n * n;
            let median = costs[costs.len() / 2];
            let what = format!("{name}, {vertices} vertices, median per 1/30 s");
            stage.row(what, median, "CPU s", "goal", Limit::AtMost(most));
            let high = costs[costs.len() * 99 / 100];
            let what = format!("{name}, {vertices} vertices, 99th percentile over the median");
            stage.row(what, high / median.max(1e-9), "", "goal", Limit::AtMost(5.0));
        }
    }
    Ok(())
}

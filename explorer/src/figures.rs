//! Plots and drawings of an exploration, in the manner of Kim et al. 2013, Figures 2, 6 and 7.

use std::collections::BTreeMap;

use picture::{Drawing, Plot, Rgb};
use protocol::StateId;

use crate::compare::PAPER_STAGES;
use crate::grow::class;
use crate::grow::graph::Graph;
use crate::grow::view::{KindAt, View};
use crate::scene::Scene;

/// Side of a drawn graph (drawing units).
const SIDE: f32 = 1400.0;
/// Room at the left for the legend.
const LEGEND: f32 = 150.0;
const INK: Rgb = [50, 52, 58];
const MERGE: Rgb = [222, 222, 226];
/// Colours that stay apart for sixteen clips.
const COLOURS: [Rgb; 16] = [
    [0, 114, 178],
    [213, 94, 0],
    [0, 158, 115],
    [204, 60, 140],
    [230, 159, 0],
    [86, 180, 233],
    [120, 80, 200],
    [150, 75, 30],
    [90, 160, 20],
    [200, 30, 40],
    [0, 90, 90],
    [255, 120, 120],
    [70, 70, 150],
    [160, 150, 0],
    [240, 130, 200],
    [100, 100, 100],
];

/// What a state's colour says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ColourBy {
    /// The clip of its pose, as in Figure 2.
    Clip,
    /// Its class, as in Figure 6.
    Class,
}

/// The worst merge error over simulated frames, and the best prefix so far (Figure 7), with the paper's
/// stages marked as far as they were reached.
pub fn error_curve(graph: &Graph) -> Plot {
    let first = graph.initialised().unwrap_or(0) as usize;
    let (mut worst, mut best) = (Vec::new(), Vec::new());
    // The best prefix is chosen by cost, penalties included; errors are free of them.
    let mut least: Option<(f32, f64)> = None;
    for moment in &graph.moments()[first..] {
        let frames = moment.states as f64 - 1.0;
        let error_mm = 1e3 * f64::from(moment.worst_error_m);
        worst.push([frames, error_mm]);
        if least.is_none_or(|(cost_m, _)| moment.worst_cost_m <= cost_m) {
            least = Some((moment.worst_cost_m, error_mm));
        }
        best.push([frames, least.map_or(f64::NAN, |(_, error_mm)| error_mm)]);
    }
    let initial = worst.first().map(|[frames, _]| (*frames, "initialised".to_owned()));
    let last = worst.last().map_or(0.0, |[frames, _]| *frames);
    let paper = PAPER_STAGES.map(|states| (states as f64, format!("{states} states")));
    let plot = Plot::new("largest merge error", "frames simulated", "error (mm)")
        .with("of the graph", worst)
        .with("of the best prefix", best);
    let reached = initial.into_iter().chain(paper).filter(|(at, _)| *at <= last);
    reached.fold(plot, |plot, (at, what)| plot.at_stage(at, &what))
}

/// How many merges have which error.
pub fn merge_histogram(view: &View<'_>) -> Plot {
    const BINS: usize = 60;
    let errors: Vec<f64> = (0..view.state_count())
        .filter_map(|id| match view.kind(StateId(id)) {
            KindAt::DeadEnd(_, error_m) => Some(1e3 * f64::from(error_m)),
            _ => None,
        })
        .collect();
    let largest = errors.iter().copied().fold(1e-3, f64::max);
    let mut counts = [0u64; BINS];
    for error in &errors {
        counts[((error / largest * BINS as f64) as usize).min(BINS - 1)] += 1;
    }
    let mut outline = vec![[0.0, 0.0]];
    for (bin, count) in counts.iter().enumerate() {
        let edge = |bin: usize| bin as f64 / BINS as f64 * largest;
        outline.extend([[edge(bin), *count as f64], [edge(bin + 1), *count as f64]]);
    }
    outline.push([largest, 0.0]);
    let title = format!("{} merges by their error", errors.len());
    Plot::new(&title, "error (mm)", "merges").with("", outline)
}

/// How many states each pose has, the poses in order of it.
pub fn states_per_pose(view: &View<'_>) -> Plot {
    let poses = view.graph().primary().poses().len();
    let (mut all, mut interior) = (vec![0u64; poses], vec![0u64; poses]);
    for id in (0..view.state_count()).map(StateId) {
        let pose = view.graph().state(id).pose.index();
        all[pose] += 1;
        interior[pose] += u64::from(matches!(view.kind(id), KindAt::Interior(_)));
    }
    let ordered = |mut counts: Vec<u64>| {
        counts.sort_unstable_by(|a, b| b.cmp(a));
        (1..).zip(counts).map(|(pose, count)| [f64::from(pose), count as f64]).collect()
    };
    Plot::new("states of a pose", "poses, the richest first", "states")
        .with("all", ordered(all))
        .with("interior", ordered(interior))
}

/// The graph as the tree that was simulated, its root in the middle, a ring a frame; merges light
/// grey across.
pub fn graph_drawing(view: &View<'_>, scene: &Scene, by: ColourBy) -> Drawing {
    let graph = view.graph();
    let count = view.state_count() as usize;
    let places = layout(graph, count);
    let mut drawing = Drawing::new([(SIDE + LEGEND) as u32, SIDE as u32]);
    let merges = (0..count).filter_map(|id| match view.kind(StateId(id as u64)) {
        KindAt::DeadEnd(target, _) => Some(vec![places[id], places[target.index()]]),
        _ => None,
    });
    let merges: Vec<_> = merges.collect();
    let merge_count = merges.len();
    // Many lines over one another would hide the tree: they grow thinner.
    let thickness = (3000.0 / merge_count.max(1) as f32).clamp(0.15, 0.7);
    drawing.lines(merges, thickness, MERGE);
    let group = |id: StateId| match by {
        ColourBy::Clip => u32::from(graph.primary().pose(graph.state(id).pose).clip),
        ColourBy::Class => u32::from(graph.state(id).class & !class::FLAGGED),
    };
    let mut lines: BTreeMap<u32, Vec<Vec<[f32; 2]>>> = BTreeMap::new();
    for id in 1..count {
        let this = StateId(id as u64);
        let Some((parent, _)) = graph.state(this).parent else { continue };
        let of_group = lines.entry(group(this)).or_default();
        let goes_on = parent.index() + 1 == id && group(parent) == group(this);
        match of_group.last_mut().filter(|_| goes_on) {
            Some(line) => line.push(places[id]),
            None => of_group.push(vec![places[parent.index()], places[id]]),
        }
    }
    let thickness = (20_000.0 / count.max(1) as f32).clamp(0.4, 1.2);
    let name = |group: u32| match by {
        ColourBy::Clip => graph.primary().clips()[group as usize].clone(),
        ColourBy::Class => match class::name(&scene.metric.classes, group as u8) {
            name if name.is_empty() => "states".to_owned(),
            name => name,
        },
    };
    let title = format!("{}: {count} states, {merge_count} merges", scene.garment.name);
    drawing.text([12.0, 10.0], &title, INK, true);
    for (row, (group, lines)) in (0..).zip(lines) {
        let colour = COLOURS[group as usize % COLOURS.len()];
        drawing.lines(lines, thickness, colour);
        let y = 34.0 + 16.0 * row as f32;
        drawing.disc([18.0, y + 4.0], 5.0, colour);
        drawing.text([30.0, y], &name(group), INK, false);
    }
    drawing.disc(places[0], 3.0, INK);
    drawing
}

/// Every state's place: around the root by how many leaves lie before it, outwards by its frames.
fn layout(graph: &Graph, count: usize) -> Vec<[f32; 2]> {
    let parent =
        |id: usize| graph.state(StateId(id as u64)).parent.map_or(0, |(parent, _)| parent.index());
    let mut depth = vec![0u32; count];
    let mut leaves = vec![0u32; count];
    for id in 1..count {
        depth[id] = depth[parent(id)] + 1;
    }
    // Children have larger ids than their parents.
    for id in (1..count).rev() {
        leaves[id] = leaves[id].max(1);
        leaves[parent(id)] += leaves[id];
    }
    let deepest = depth.iter().copied().max().unwrap_or(1).max(1) as f32;
    let total = leaves[0].max(1) as f32;
    let mut begins = vec![0u32; count];
    let mut given = vec![0u32; count];
    let mut places = vec![[0.0; 2]; count];
    for id in 0..count {
        if id > 0 {
            let above = parent(id);
            begins[id] = begins[above] + given[above];
            given[above] += leaves[id];
        }
        let turn = (begins[id] as f32 + 0.5 * leaves[id] as f32) / total;
        let (sin, cos) = (turn * std::f32::consts::TAU).sin_cos();
        let radius = (0.5 * SIDE - 20.0) * depth[id] as f32 / deepest;
        places[id] = [LEGEND + 0.5 * SIDE + radius * cos, 0.5 * SIDE + radius * sin];
    }
    places
}

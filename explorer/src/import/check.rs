//! What a scene holds, measured, and why a garment is refused.

use std::fmt;
use std::path::Path;

use cloth::measure::clearance;
use cloth::mesh::{Mesh, MeshError};
use cloth::{Body, Vec3};
use serde::Serialize;

use super::components::Digraph;
use super::garment::GarmentError;
use super::motion_graph::GraphReport;
use super::reach::{ClipReach, Reach};
use super::{AskedReach, Loaded, SceneError};
use crate::primary::PrimaryGraph;

/// A garment vertex may be this deep inside the body in the rest pose (m).
pub const INSIDE_M_MAX: f32 = 1e-3;
/// How far along a normal it is looked whether the way leads to the body or from it (m).
const NORMAL_STEP_M: f32 = 2e-3;

/// What was read, for people and machines.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SceneReport {
    /// Name of the scene.
    pub name: String,
    /// Frames per second.
    pub fps: f32,
    /// Names of the clips.
    pub clips: Vec<String>,
    /// Poses of the primary graph, those of transitions included.
    pub poses: usize,
    /// Edges of the primary graph.
    pub edges: usize,
    /// Transitions that were kept.
    pub transitions: usize,
    /// Poses in the largest strongly connected component of what was read.
    pub largest_component: usize,
    /// Poses of what was read.
    pub poses_read: usize,
    /// Frames that fell outside.
    pub outside: Vec<super::motion_graph::FrameRange>,
    /// Dead ends of a breadth-first walk over every edge: edges - poses + 1.
    pub initial_dead_ends: usize,
    /// Median, 90th percentile and worst time to reach a given clip.
    pub reach: Reach,
    /// The same of each clip.
    pub reach_by_clip: Vec<ClipReach>,
    /// What the scene asks for by `reach_s`, and what it got.
    pub reach_asked: Option<ReachAsked>,
    /// Clips of which the graph has no pose.
    pub unreached: Vec<String>,
    /// Vertices of the body.
    pub body_vertices: usize,
    /// Triangles of the body.
    pub body_triangles: usize,
    /// Joints of the skeleton.
    pub joints: usize,
    /// Height of the body in the rest pose (m).
    pub body_height_m: f32,
    /// Name of the garment.
    pub garment: String,
    /// Its figures.
    pub cloth: GarmentFigures,
    /// Vertices held to the body.
    pub attached: usize,
    /// Lowest and highest vertex that the body carries, in the rest pose (m).
    pub attached_height_m: Option<[f32; 2]>,
}

/// What a scene asks of its motion graph, and what it got.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ReachAsked {
    /// Median time that it asks for (s).
    pub asked_s: f32,
    /// Among these clips.
    pub clips: Vec<String>,
    /// The times among them.
    #[serde(flatten)]
    pub reach: Reach,
    /// Whether the median is at most what was asked for.
    pub met: bool,
}

/// A garment's mesh, measured in the rest pose.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct GarmentFigures {
    /// Vertices.
    pub vertices: usize,
    /// Triangles.
    pub triangles: usize,
    /// Area (m^2).
    pub area_m2: f32,
    /// Longest edge (mm).
    pub edge_length_max_mm: f32,
    /// Least distance of a vertex to the body (mm), negative inside.
    pub clearance_min_mm: f32,
}

/// Loads a scene as [`super::load_scene`] does, and measures it.
///
/// # Errors
/// As for [`super::load_scene`]; every refusal is one of loading, so that nothing that is refused
/// here can be explored.
pub fn check_scene(name_or_path: &str, data_dir: Option<&Path>) -> Result<SceneReport, SceneError> {
    let loaded = super::load(name_or_path, data_dir)?;
    report(&loaded)
        .map_err(|source| SceneError::Garment { path: Path::new(name_or_path).into(), source })
}

/// Measures a loaded scene.
///
/// # Errors
/// A garment that [`check_garment`] refuses.
pub fn report(loaded: &Loaded) -> Result<SceneReport, GarmentError> {
    let Loaded { scene, graph, asked } = loaded;
    let (primary, body) = (&scene.primary, &scene.body);
    let (poses, edges) = (primary.poses().len(), primary.edges().len());
    let pairs: Vec<_> = primary.edges().iter().map(|e| (e.from.0, e.to.0)).collect();
    let starts = primary
        .edges()
        .iter()
        .filter(|e| primary.pose(e.to).transition && !primary.pose(e.from).transition);
    let held = scene.garment.attached.iter().map(|v| scene.garment.positions[*v as usize].y);
    let attached_height_m = held.fold(None, |range: Option<[f32; 2]>, y| {
        let [low, high] = range.unwrap_or([y, y]);
        Some([low.min(y), high.max(y)])
    });
    let heights = || body.rest_positions.iter().map(|p| p.y);
    Ok(SceneReport {
        name: scene.name.clone(),
        fps: primary.fps(),
        clips: primary.clips().to_vec(),
        poses,
        edges,
        transitions: starts.count(),
        largest_component: Digraph::new(poses, &pairs).largest_cycle_component().len(),
        poses_read: graph.as_ref().map_or(poses, |g: &GraphReport| g.poses_before),
        outside: graph.as_ref().map(|g| g.outside.clone()).unwrap_or_default(),
        initial_dead_ends: (edges + 1).saturating_sub(poses),
        reach: Reach::of_graph(primary),
        reach_by_clip: Reach::of_each_clip(primary),
        reach_asked: asked.as_ref().map(|asked| reach_asked(asked, primary)),
        unreached: unreached(primary),
        body_vertices: body.rest_positions.len(),
        body_triangles: body.triangles.len(),
        joints: body.skeleton.joint_count(),
        body_height_m: heights().fold(f32::MIN, f32::max) - heights().fold(f32::MAX, f32::min),
        garment: scene.garment.name.clone(),
        cloth: check_garment(body, &scene.garment.positions, &scene.garment.triangles)?,
        attached: scene.garment.attached.len(),
        attached_height_m,
    })
}

fn reach_asked(asked: &AskedReach, primary: &PrimaryGraph) -> ReachAsked {
    let named = |clip: &String| asked.clips.is_empty() || asked.clips.contains(clip);
    let clips = primary.clips().iter().enumerate().filter(|(_, clip)| named(clip));
    let (to, clips): (Vec<usize>, Vec<String>) = clips.map(|(i, c)| (i, c.clone())).unzip();
    let reach = Reach::among(primary, &to);
    let asked_s = asked.reach_s;
    ReachAsked { asked_s, clips, reach, met: reach.median_s <= asked_s }
}

fn unreached(primary: &PrimaryGraph) -> Vec<String> {
    let mut found = vec![false; primary.clips().len()];
    let recorded = primary.poses().iter().filter(|pose| !pose.transition);
    recorded.for_each(|pose| found[usize::from(pose.clip)] = true);
    let missing = primary.clips().iter().zip(found).filter(|(_, found)| !found);
    missing.map(|(clip, _)| clip.clone()).collect()
}

impl fmt::Display for SceneReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = |s: f32| if s.is_finite() { format!("{s:.1} s") } else { "never".to_owned() };
        writeln!(f, "scene {} at {} fps", self.name, self.fps)?;
        writeln!(
            f,
            "  body      {} vertices, {} triangles, {} joints, {:.3} m high",
            self.body_vertices, self.body_triangles, self.joints, self.body_height_m
        )?;
        writeln!(f, "  clips     {}: {}", self.clips.len(), self.clips.join(", "))?;
        writeln!(
            f,
            "  graph     {} poses, {} edges, {} transitions, {} initial dead ends",
            self.poses, self.edges, self.transitions, self.initial_dead_ends
        )?;
        writeln!(
            f,
            "  component {} of {} poses are in the largest strongly connected component",
            self.largest_component, self.poses_read
        )?;
        let outside: Vec<String> =
            self.outside.iter().map(|r| format!("{} {}..{}", r.clip, r.first, r.last)).collect();
        if !outside.is_empty() {
            writeln!(f, "  outside   {}", outside.join(", "))?;
        }
        writeln!(
            f,
            "  reach     a given clip in {} (median), {} (90th percentile), {} at worst",
            seconds(self.reach.median_s),
            seconds(self.reach.p90_s),
            seconds(self.reach.worst_s)
        )?;
        for ClipReach { clip, reach } in &self.reach_by_clip {
            let (median, worst) = (seconds(reach.median_s), seconds(reach.worst_s));
            writeln!(f, "            {clip}: {median}, at worst {worst}")?;
        }
        if let Some(asked) = &self.reach_asked {
            writeln!(
                f,
                "  reach_s   {:.2} s asked for among {}: {:.2} s, {}",
                asked.asked_s,
                asked.clips.join(", "),
                asked.reach.median_s,
                if asked.met { "met" } else { "NOT met" }
            )?;
        }
        if !self.unreached.is_empty() {
            writeln!(f, "  unreached {}: no way leads there", self.unreached.join(", "))?;
        }
        let c = &self.cloth;
        writeln!(
            f,
            "  garment   {}: {} vertices, {} triangles, {:.3} m^2, longest edge {:.1} mm",
            self.garment, c.vertices, c.triangles, c.area_m2, c.edge_length_max_mm
        )?;
        match self.attached_height_m {
            Some([low, high]) => {
                writeln!(f, "  held      {} vertices, {low:.2} to {high:.2} m high", self.attached)?
            }
            None => writeln!(f, "  held      none: it may slide off; see `attach`")?,
        }
        writeln!(f, "  clearance {:.1} mm at least, in the rest pose", c.clearance_min_mm)
    }
}

/// Measures a garment in the rest pose of its body.
///
/// # Errors
/// What cannot be simulated: not manifold, neighbours wound against each other, degenerate
/// triangles, normals towards the body, a vertex more than [`INSIDE_M_MAX`] inside the body.
pub fn check_garment(
    body: &Body,
    positions: &[Vec3],
    triangles: &[[u32; 3]],
) -> Result<GarmentFigures, GarmentError> {
    let mesh = check_mesh(positions, triangles)?;
    let at = clearance(&body.rest_positions, &body.triangles, positions);
    check_side(body, &mesh, &at)?;
    let nearest = (0..at.len()).min_by(|a, b| at[*a].total_cmp(&at[*b])).unwrap_or(0);
    if at[nearest] < -INSIDE_M_MAX {
        let count = at.iter().filter(|d| **d < -INSIDE_M_MAX).count();
        return Err(GarmentError::Surface(format!(
            "{count} vertices are inside the body in its rest pose, vertex {nearest} near {:.3} \
             the deepest with {:.1} mm; fit the garment to the rest pose of this character, at \
             most {:.0} mm inside",
            positions[nearest],
            -at[nearest] * 1e3,
            INSIDE_M_MAX * 1e3
        )));
    }
    Ok(GarmentFigures {
        vertices: positions.len(),
        triangles: triangles.len(),
        area_m2: mesh.rest_areas().iter().sum(),
        edge_length_max_mm: mesh.rest_lengths().iter().fold(0.0, |a: f32, b| a.max(*b)) * 1e3,
        clearance_min_mm: at[nearest] * 1e3,
    })
}

/// Checks what needs no body, and says where it fails.
///
/// # Errors
/// As `cloth::mesh::Mesh::new`, with the place and what to do.
pub fn check_mesh(positions: &[Vec3], triangles: &[[u32; 3]]) -> Result<Mesh, GarmentError> {
    Mesh::new(positions.to_vec(), triangles.to_vec()).map_err(|error| {
        let (vertex, remedy) = match &error {
            MeshError::NonManifold { a, .. } => (Some(*a), "separate the layers that meet there"),
            MeshError::Inverted { a, .. } => {
                (Some(*a), "make the normals consistent, pointing outwards")
            }
            MeshError::Degenerate { triangle, .. } | MeshError::BadTriangle { triangle, .. } => {
                (triangles.get(*triangle).map(|t| t[0]), "dissolve degenerate faces")
            }
            MeshError::Isolated { vertex } => (Some(*vertex as u32), "delete loose vertices"),
            _ => (None, "export the mesh again"),
        };
        let place = vertex.and_then(|v| positions.get(v as usize));
        let near = place.map(|p| format!(" (near {p:.3})")).unwrap_or_default();
        GarmentError::Surface(format!("{error}{near}; {remedy}"))
    })
}

/// Normals lead away from the body over most of the surface, or the garment is inside out.
fn check_side(body: &Body, mesh: &Mesh, at: &[f32]) -> Result<(), GarmentError> {
    let mut normals = vec![Vec3::ZERO; mesh.vertex_count()];
    for t in mesh.triangles() {
        let [a, b, c] = t.map(|v| mesh.rest_positions()[v as usize]);
        for v in t {
            normals[*v as usize] += (b - a).cross(c - a) * 0.5;
        }
    }
    let step = |(p, n): (&Vec3, &Vec3)| *p + n.normalize_or_zero() * NORMAL_STEP_M;
    let ahead: Vec<Vec3> = mesh.rest_positions().iter().zip(&normals).map(step).collect();
    let ahead = clearance(&body.rest_positions, &body.triangles, &ahead);
    let area = |towards: bool| -> f32 {
        let vertices = (0..at.len()).filter(|v| (ahead[*v] < at[*v]) == towards);
        vertices.map(|v| normals[v].length()).sum()
    };
    let (towards, away) = (area(true), area(false));
    if towards <= away {
        return Ok(());
    }
    Err(GarmentError::Surface(format!(
        "the garment is inverted: over {:.0} % of its area the normals point towards the body; \
         flip the normals",
        100.0 * towards / (towards + away)
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_built_in_scene_passes_the_same_check() {
        let report = check_scene("robe", None).unwrap();
        assert!(report.cloth.vertices >= 3000 && report.initial_dead_ends >= 20, "{report}");
        assert!(report.edges <= 700 && report.largest_component == report.poses, "{report}");
    }
}

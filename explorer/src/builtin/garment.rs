//! The hooded robe: a loose shell around the character, cut open at hem, cuffs and face.

use cloth::{Body, Vec3};

use super::character;
use super::field::{RoundCone, Union, join};
use super::remesh::{INSIDE, Target, remesh, settle};
use super::surface::{Grid, Mesh, directed_edges, surface_nets};
use super::{BuiltinError, check};
use crate::import::refine::refine_to;
use crate::scene::{Fabric, Garment};

/// Least distance of the shell's field from the body's (m); triangles cut corners, so that the
/// garment comes a little nearer.
const EASE_M: f32 = 0.018;
/// Length of the robe's edges (m): gives 3,000 to 3,400 vertices.
const EDGE_M: f32 = 0.030;
/// How many vertices that gives, a little above.
const VERTICES_AT_EDGE: f32 = 3150.0;
/// Fewest and most vertices that can be asked for: below, the openings close; above, the field's
/// own rounding shows.
const VERTICES: [usize; 2] = [1_500, 200_000];
/// Fillet between the parts of the shell (m).
const FILLET_M: f32 = 0.06;
/// Height of the hem (m): at the calf.
const HEM_Y_M: f32 = 0.34;
/// Radius around the crown within which the hood is held to the head (m).
const PIN_RADIUS_M: f32 = 0.045;

/// Wide parts: ends (m) and radii (m); all but the hood are mirrored.
const SLEEVE: ([f32; 3], [f32; 3], f32, f32) =
    ([0.150, 1.385, -0.015], [0.600, 0.935, -0.015], 0.074, 0.128);
const SKIRT: ([f32; 3], [f32; 3], f32, f32) =
    ([0.065, 1.230, 0.0], [0.120, 0.150, 0.0], 0.120, 0.290);
const HOOD: [([f32; 3], [f32; 3], f32, f32); 2] = [
    ([0.0, 1.575, 0.015], [0.0, 1.600, -0.010], 0.118, 0.125),
    ([0.0, 1.600, -0.010], [0.0, 1.590, -0.070], 0.125, 0.105),
];
/// Middle of the cuff's opening and the direction out of it.
const CUFF: [f32; 3] = [0.520, 1.015, -0.015];

/// The robe in the rest pose.
///
/// The crown of the hood is held to the head, as by a pin: no motion of the character could raise
/// a hood again that has slid off, so that states with it would never find similar ones to merge
/// into. All else hangs from the shoulders by contact and friction alone.
///
/// # Errors
/// The mesh is no manifold with four openings.
pub(super) fn robe(body: &Body, vertices: Option<usize>) -> Result<Garment, BuiltinError> {
    let mesh = match vertices {
        None => mesh(EDGE_M)?,
        Some(vertices) => mesh_of(vertices)?,
    };
    let attached = crown(&mesh, body);
    Ok(Garment {
        name: "robe".into(),
        positions: mesh.positions,
        triangles: mesh.triangles,
        layers: Vec::new(),
        attached,
        fabric: Fabric {
            density: 0.18,
            stretch: 900.0,
            weft: None,
            shear: 350.0,
            bend: 4e-5,
            friction: 0.3,
            drag: 1.28,
            damping_s: 0.002,
            offset: 0.004,
        },
    })
}

/// A mesh of a few vertices less, then the longest edges cut.
fn mesh_of(vertices: usize) -> Result<Mesh, BuiltinError> {
    let [least, most] = VERTICES;
    let refused = BuiltinError::Vertices { asked: vertices, least, most };
    if !(least..=most).contains(&vertices) {
        return Err(refused);
    }
    let mut edge_m = EDGE_M * (VERTICES_AT_EDGE / vertices as f32).sqrt();
    for _ in 0..8 {
        let mut mesh = mesh(edge_m)?;
        if refine_to(&mut mesh.positions, &mut mesh.triangles, vertices).is_ok() {
            return Ok(mesh);
        }
        edge_m *= 1.02;
    }
    Err(refused)
}

fn mesh(edge_m: f32) -> Result<Mesh, BuiltinError> {
    let shell = Shell::new();
    let surface = |p: Vec3| shell.distance(p);
    let grid =
        Grid { low: Vec3::new(-0.80, 0.10, -0.46), high: Vec3::new(0.80, 1.85, 0.46), cell: 0.025 };
    let mut mesh = surface_nets(&surface, grid);
    let cuts: [&dyn Fn(Vec3) -> f32; 4] =
        [&hem, &|p: Vec3| cuff(p), &|p: Vec3| cuff(p * Vec3::new(-1.0, 1.0, 1.0)), &face];
    let mut cut_of = cut_open(&mut mesh, &cuts);
    let target = Target { surface: &surface, cuts: &cuts, edge_m, passes: 12 };
    for (p, cut) in mesh.positions.iter_mut().zip(&cut_of) {
        *p = settle(*p, *cut, &target);
    }
    remesh(&mut mesh, &mut cut_of, &target);
    check(&mesh, "robe", 4)?;
    Ok(mesh)
}

/// The closed surface from which the robe is cut.
struct Shell {
    close: Union,
    loose: Union,
}

impl Shell {
    fn new() -> Self {
        let close: Vec<_> = character::cones().iter().map(|c| c.inflated(EASE_M)).collect();
        let mut loose = Vec::new();
        for (mirrored, (a, b, radius_a, radius_b)) in
            [(true, SLEEVE), (true, SKIRT), (false, HOOD[0]), (false, HOOD[1])]
        {
            let (a, b) = (Vec3::from_array(a), Vec3::from_array(b));
            loose.push(RoundCone { joint: 0, a, b, radius_a, radius_b });
            if mirrored {
                let flip = Vec3::new(-1.0, 1.0, 1.0);
                loose.push(RoundCone { joint: 0, a: a * flip, b: b * flip, radius_a, radius_b });
            }
        }
        Self { close: Union::new(&close, character::FILLET_M), loose: Union::new(&loose, FILLET_M) }
    }

    fn distance(&self, p: Vec3) -> f32 {
        join(self.close.distance(p), self.loose.distance(p), FILLET_M)
    }
}

/// Cuts are positive where the shell is taken away.
fn hem(p: Vec3) -> f32 {
    HEM_Y_M - p.y
}

/// Across the left sleeve; only near the hand, because the plane would cut the skirt as well.
fn cuff(p: Vec3) -> f32 {
    let outward = Vec3::new(1.0, -1.0, 0.0) * std::f32::consts::FRAC_1_SQRT_2;
    let middle = Vec3::from_array(CUFF);
    let beyond = (p - middle).dot(outward);
    beyond.min(0.30 - p.distance(middle + outward * 0.2))
}

/// An upright oval before the face.
fn face(p: Vec3) -> f32 {
    let oval = ((p.x / 0.088).powi(2) + ((p.y - 1.570) / 0.105).powi(2)).sqrt();
    (0.09 * (1.0 - oval)).min(p.z - 0.02)
}

/// Takes away what lies beyond a cut and keeps the largest piece; returns each vertex's cut.
pub(crate) fn cut_open(mesh: &mut Mesh, cuts: &[&dyn Fn(Vec3) -> f32]) -> Vec<u8> {
    let beyond = |p: Vec3| cuts.iter().any(|cut| cut(p) > 0.0);
    let positions = &mesh.positions;
    let centre = |t: &[u32; 3]| t.iter().map(|v| positions[*v as usize]).sum::<Vec3>() / 3.0;
    mesh.triangles.retain(|t| !beyond(centre(t)));
    keep_largest_piece(mesh);
    trim(mesh);
    mesh.compact();
    let mut cut_of = vec![INSIDE; mesh.positions.len()];
    for v in mesh.boundary().unwrap_or_default().into_iter().flatten() {
        let p = mesh.positions[v as usize];
        let nearest =
            (0..cuts.len()).min_by(|a, b| cuts[*a](p).abs().total_cmp(&cuts[*b](p).abs()));
        cut_of[v as usize] = nearest.map_or(INSIDE, |cut| cut as u8);
    }
    cut_of
}

fn keep_largest_piece(mesh: &mut Mesh) {
    let mut piece: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    // Least index of a piece spreads along triangles until nothing changes.
    loop {
        let mut changed = false;
        for t in &mesh.triangles {
            let least = t.iter().map(|v| piece[*v as usize]).min().unwrap_or(0);
            for v in t {
                changed |= piece[*v as usize] != least;
                piece[*v as usize] = least;
            }
        }
        if !changed {
            break;
        }
    }
    let mut size = vec![0usize; mesh.positions.len()];
    mesh.triangles.iter().for_each(|t| size[piece[t[0] as usize] as usize] += 1);
    let largest = (0..size.len()).max_by_key(|p| (size[*p], usize::MAX - p)).unwrap_or(0) as u32;
    mesh.triangles.retain(|t| piece[t[0] as usize] == largest);
}

/// Takes away triangles that hang on by one edge or one vertex, until the boundary is a set of
/// plain loops whose triangles do not fold when they are moved onto the cut.
fn trim(mesh: &mut Mesh) {
    loop {
        let boundary = mesh.boundary().unwrap_or_default();
        let mut starts = vec![0u8; mesh.positions.len()];
        boundary.iter().for_each(|e| starts[e[0] as usize] += 1);
        let before = mesh.triangles.len();
        mesh.triangles.retain(|t| {
            let lone = directed_edges(t).into_iter().filter(|e| boundary.binary_search(e).is_ok());
            lone.count() < 2 && t.iter().all(|v| starts[*v as usize] < 2)
        });
        if mesh.triangles.len() == before {
            return;
        }
    }
}

/// Vertices around the crown of the head, sorted.
fn crown(mesh: &Mesh, body: &Body) -> Vec<u32> {
    let top = body.rest_positions.iter().copied().max_by(|a, b| a.y.total_cmp(&b.y));
    let top = top.unwrap_or(Vec3::ZERO);
    let flat = |p: Vec3| Vec3::new(p.x - top.x, 0.0, p.z - top.z);
    (0..mesh.positions.len() as u32)
        .filter(|v| {
            let p = mesh.positions[*v as usize];
            p.y > top.y && flat(p).length() < PIN_RADIUS_M
        })
        .collect()
}

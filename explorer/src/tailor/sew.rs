//! From a design to a mesh.

use cloth::Vec3;

use super::design::Design;
use super::fill::fill;
use super::form::{Form, Worn};
use super::{Fineness, Piece, TailorError};
use crate::builtin::garment::cut_open;
use crate::builtin::remesh::{Target, remesh, settle};
use crate::builtin::surface::{Grid, nets_of, nodes};
use crate::import::garment::Surface;
use crate::import::refine::refine_to;

/// Least distance from the body, and from one layer to the next (m): contact keeps 4 mm.
pub const GAP_M: f32 = 0.006;
/// How far a layer below is looked for (m).
const BELOW_M: f32 = 0.03;
/// Fewest and longest edges (m).
const EDGE_M: [f32; 2] = [0.005, 0.06];
/// The edge that is tried first where a number of vertices is asked for (m),
const FIRST_EDGE_M: f32 = 0.03;
/// how often another is tried,
const TRIES: usize = 8;
/// how much longer than that which would give the number by area,
const LONGER: f32 = 1.01;
/// and the share of the vertices that remeshing must give, so that edges are of one length.
const FEWEST: f32 = 0.9;

/// Makes the mesh.
///
/// # Errors
/// A mesh that is no manifold or has other openings than the design, or a fineness out of range.
pub(super) fn sew(
    design: &Design<'_>,
    form: &Form,
    below: &[Piece],
    fineness: Fineness,
) -> Result<Piece, TailorError> {
    let refused = TailorError::Fineness { piece: design.name, asked: fineness };
    let mut piece = match fineness {
        Fineness::Edge(edge_m) => mesh(design, edge_m)?,
        Fineness::Vertices(vertices) => of_vertices(design, vertices)?.ok_or(refused)?,
    };
    fit(&mut piece, form, below);
    Ok(piece)
}

/// A mesh of a few vertices less, then the longest edges cut; `None` where there is none.
fn of_vertices(design: &Design<'_>, vertices: usize) -> Result<Option<Piece>, TailorError> {
    let mut edge_m = FIRST_EDGE_M;
    for _ in 0..TRIES {
        let mut piece = mesh(design, edge_m)?;
        let made = piece.positions.len();
        if made as f32 >= FEWEST * vertices as f32
            && refine_to(&mut piece.positions, &mut piece.triangles, vertices).is_ok()
        {
            return Ok(Some(piece));
        }
        // A little longer, so that cutting has something left to do.
        edge_m *= (made as f32 / vertices.max(1) as f32).sqrt() * LONGER;
    }
    Ok(None)
}

/// Moves vertices away from the body until every one keeps the gap, and lies outside what is
/// worn below it.
pub fn fit(piece: &mut Piece, form: &Form, below: &[Piece]) {
    let worn: Vec<Worn> = below.iter().map(Worn::new).collect();
    for p in &mut piece.positions {
        for _ in 0..4 {
            let (distance, out) = form.exact(*p);
            let mut least = GAP_M;
            for worn in &worn {
                if let Some(inner) = worn.nearest(*p, BELOW_M) {
                    least = least.max(form.exact(inner).0 + GAP_M);
                }
            }
            if distance >= least - 1e-4 {
                break;
            }
            *p += out * (least - distance);
        }
    }
}

fn mesh(design: &Design<'_>, edge_m: f32) -> Result<Piece, TailorError> {
    let [least, most] = EDGE_M;
    if !(least..=most).contains(&edge_m) {
        let asked = Fineness::Edge(edge_m);
        return Err(TailorError::Fineness { piece: design.name, asked });
    }
    let surface = |p: Vec3| design.distance(p);
    let cuts: Vec<&dyn Fn(Vec3) -> f32> = design.cuts.iter().map(|cut| &**cut as _).collect();
    let [low, high] = design.bounds;
    let grid = Grid { low, high, cell: design.cell_m };
    let mut values: Vec<f32> = nodes(grid.nodes()).map(|i| surface(grid.place(i))).collect();
    fill(&mut values, grid.nodes());
    let mut mesh = nets_of(&values, grid);
    let mut cut_of = cut_open(&mut mesh, &cuts);
    // A pass collapses only edges that do not touch each other: fine grids need more of them.
    let finer = (edge_m / design.cell_m).max(1.0).log2();
    let passes = 12 + (6.0 * finer) as usize;
    let target = Target { surface: &surface, cuts: &cuts, edge_m, passes };
    for (p, cut) in mesh.positions.iter_mut().zip(&cut_of) {
        *p = settle(*p, *cut, &target);
    }
    remesh(&mut mesh, &mut cut_of, &target);
    let piece = design.name;
    let found = mesh
        .boundary_loops()
        .map_err(|[v, _]| TailorError::NotManifold { piece, near: mesh.positions[v as usize] })?;
    let surface = Surface { positions: mesh.positions, triangles: mesh.triangles };
    if found != design.openings {
        let middle = |vertices: &Vec<u32>| {
            let sum: Vec3 = vertices.iter().map(|v| surface.positions[*v as usize]).sum();
            sum / vertices.len() as f32
        };
        let found = surface.boundary_loops().iter().map(middle).collect();
        return Err(TailorError::Openings { piece, found, wanted: design.openings });
    }
    Ok(Piece { positions: surface.positions, triangles: surface.triangles })
}

/// Area of a piece (m^2).
pub fn area(piece: &Piece) -> f32 {
    let of = |t: &[u32; 3]| {
        let [a, b, c] = t.map(|v| piece.positions[v as usize]);
        (b - a).cross(c - a).length() * 0.5
    };
    piece.triangles.iter().map(of).sum()
}

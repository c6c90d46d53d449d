//! Garments made by code for the character's own body: cut from shells around its rest pose.
//!
//! A [`design`] says where a garment's shell lies, as a field of distances around the body and
//! whatever is worn below, and where it is cut open; [`sew`] makes a mesh of it, of any fineness;
//! [`form`] is the tailor's dummy, which knows the body's distances and measures. Nothing is random:
//! equal bodies get equal garments.

pub mod design;
mod fill;
pub mod form;
pub mod sew;

use cloth::Vec3;

pub use form::Form;

/// Names of all pieces that can be made.
pub const PIECES: [&str; 5] = ["coat", "robe", "trousers", "shirt", "vest"];

/// How fine a garment is to be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Fineness {
    /// Edges of about this length (m).
    Edge(f32),
    /// Exactly so many vertices.
    Vertices(usize),
}

/// A layer of clothing: a surface in the body's rest pose.
#[derive(Debug, Clone, PartialEq)]
pub struct Piece {
    /// Vertices (m).
    pub positions: Vec<Vec3>,
    /// Counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

/// Why a garment could not be made.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TailorError {
    /// No such piece.
    #[error("there is no piece {name:?}; there are {}", PIECES.join(", "))]
    Unknown {
        /// As asked for.
        name: String,
    },
    /// The body lacks what it is measured at.
    #[error("the character has no joint {0:?}, at which the garment is measured")]
    Joint(&'static str),
    /// More or fewer openings came out than the design has.
    #[error(
        "{piece}: {} openings instead of {wanted}, around {found:.2?}; the body is not of a shape \
         it fits", .found.len()
    )]
    Openings {
        /// Which piece.
        piece: &'static str,
        /// Middles of the openings that were found (m).
        found: Vec<Vec3>,
        /// How many there shall be.
        wanted: usize,
    },
    /// An edge that two triangles run the same way, or where openings meet.
    #[error("{piece}: no manifold near {near:.3}; the body is not of a shape it fits")]
    NotManifold {
        /// Which piece.
        piece: &'static str,
        /// Where (m).
        near: Vec3,
    },
    /// A fineness that cannot be.
    #[error("{piece}: {asked:?} cannot be sewn; ask for edges of 5 to 60 mm")]
    Fineness {
        /// Which piece.
        piece: &'static str,
        /// What was asked for.
        asked: Fineness,
    },
}

/// Makes a piece for a body, worn over what is `below` (innermost first).
///
/// # Errors
/// No such piece, or a body of another build than a person's.
pub fn make(
    name: &str,
    form: &Form,
    below: &[Piece],
    fineness: Fineness,
) -> Result<Piece, TailorError> {
    let design = design::named(name, form, below)?;
    sew::sew(&design, form, below, fineness)
}

#[cfg(test)]
mod tests;

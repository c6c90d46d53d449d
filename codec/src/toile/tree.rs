//! Vertices from coarse to fine, and from which coarser ones each is predicted.

use crate::ROWS_MAX;
use crate::entropy::{Reader, Writer};

/// Coarser vertices that predict one, at most.
pub const PARENTS: usize = 4;

/// An order of vertices in which any prefix covers the garment evenly, and for each vertex up to
/// [`PARENTS`] of those before it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tree {
    /// Vertex at each place.
    order: Vec<u32>,
    /// Places before; `parents[place][..min(place, PARENTS)]` count.
    parents: Vec<[u32; PARENTS]>,
}

/// Why an order could not be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum TreeError {
    /// Too few, too many, or not as many parents as vertices.
    #[error("an order of {order} vertices with parents for {parents}")]
    Count {
        /// Vertices.
        order: usize,
        /// Sets of parents.
        parents: usize,
    },
    /// A vertex twice, or beyond the last.
    #[error("place {place} of the order is vertex {vertex}, which is no vertex or met before")]
    Vertex {
        /// Where.
        place: usize,
        /// Which.
        vertex: u32,
    },
    /// A parent that is not before its child.
    #[error("the vertex at place {place} has a parent at place {parent}")]
    Parent {
        /// The child's place.
        place: usize,
        /// The parent's.
        parent: u32,
    },
}

impl Tree {
    /// Checks an order and parents (places, the first `min(place, PARENTS)` of each count).
    ///
    /// # Errors
    /// Not an order of all vertices, or a parent that is not before its child.
    pub fn new(order: Vec<u32>, parents: Vec<[u32; PARENTS]>) -> Result<Self, TreeError> {
        let count = order.len();
        if count == 0 || count > ROWS_MAX / 3 || parents.len() != count {
            return Err(TreeError::Count { order: count, parents: parents.len() });
        }
        let mut met = vec![false; count];
        for (place, vertex) in order.iter().enumerate() {
            match met.get_mut(*vertex as usize) {
                Some(met) if !*met => *met = true,
                _ => return Err(TreeError::Vertex { place, vertex: *vertex }),
            }
        }
        for (place, parents) in parents.iter().enumerate() {
            let used = &parents[..place.min(PARENTS)];
            if let Some(parent) = used.iter().find(|p| **p as usize >= place) {
                return Err(TreeError::Parent { place, parent: *parent });
            }
        }
        Ok(Self { order, parents })
    }

    /// Vertices in the order given, each predicted from those just before it: for garments of
    /// which nothing is known.
    ///
    /// # Panics
    /// `vertices` must be 1 to a third of `ROWS_MAX`.
    pub fn sequence(vertices: usize) -> Self {
        assert!((1..=ROWS_MAX / 3).contains(&vertices), "{vertices} vertices");
        let parents = |place: usize| [1, 2, 3, 4].map(|back| place.saturating_sub(back) as u32);
        let order = (0..vertices as u32).collect();
        Self { order, parents: (0..vertices).map(parents).collect() }
    }

    /// Vertex at each place, coarse before fine.
    pub fn order(&self) -> &[u32] {
        &self.order
    }

    /// Number of vertices.
    pub fn vertices(&self) -> usize {
        self.order.len()
    }

    /// Places from which the vertex at `place` is predicted.
    pub fn parents(&self, place: usize) -> &[u32] {
        &self.parents[place][..place.min(PARENTS)]
    }

    pub(super) fn write(&self, writer: &mut Writer) {
        let width = bits(self.vertices());
        for (place, vertex) in self.order.iter().enumerate() {
            writer.raw(*vertex, width);
            self.parents(place).iter().for_each(|parent| writer.raw(*parent, bits(place)));
        }
    }

    pub(super) fn read(reader: &mut Reader<'_>, vertices: usize) -> Result<Self, TreeError> {
        let width = bits(vertices);
        let mut order = Vec::with_capacity(vertices);
        let mut parents = Vec::with_capacity(vertices);
        for place in 0..vertices {
            order.push(reader.raw(width));
            let mut own = [0; PARENTS];
            own[..place.min(PARENTS)].iter_mut().for_each(|p| *p = reader.raw(bits(place)));
            parents.push(own);
        }
        Self::new(order, parents)
    }
}

/// Bits that hold any number below `count`.
fn bits(count: usize) -> u32 {
    usize::BITS - count.saturating_sub(1).leading_zeros()
}

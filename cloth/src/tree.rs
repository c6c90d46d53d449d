//! A binary tree of boxes over a cloth's own triangles: which of them may meet while they move.
//!
//! Each box carries the interval of its vertices' displacements besides. Two boxes may meet if
//! they do after the *relative* displacement of their contents: what moves together, as the cloth
//! of a fast sleeve does, stays apart however far it goes.

use std::array::from_fn;

use glam::{Mat4, Vec3, Vec3A, Vec4};

use crate::bvh::{self, Node};
use crate::mesh::Mesh;
use crate::solver::simd::{self, Set};

const NONE: u32 = u32::MAX;
/// Most triangles of a leaf.
const LEAF_TRIANGLES: usize = 4;
/// Largest patch that counts as smooth as a whole: too small for its outline to meet itself.
const PATCH_TRIANGLES: u32 = 32;
/// In a patch that counts as smooth as a whole, the way within it between two vertices is at most
/// this much longer than the straight one in the rest shape: a patch with a notch, as between a
/// sleeve and the chest, can close its notch while all its normals are alike.
const DETOUR: f32 = 1.3;
/// Smallest cosine between a smooth patch's normals and their mean: no two are a right angle apart. With a
/// wider cone (66 degrees) a patch of coarse cloth, pressed together and sheared, was
/// called smooth that cut itself a few edges on.
const SMOOTH: f32 = 0.71;
/// Smallest cosine between a triangle's normals as it was foreseen and as it ends.
const TURNED: f32 = 0.5;

/// The tree's shape. Triangles are called by their slot: their place in the order of the leaves.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Tree {
    nodes: Vec<Node>,
    vertices: usize,
    /// Triangles by slot.
    pub(crate) order: Vec<u32>,
    /// Vertices by slot.
    pub(crate) corners: Vec<[u32; 3]>,
    /// Slots across the three sides, or `NONE`.
    across: Vec<[u32; 3]>,
    /// Bit k: corner k counts as this slot's; bit 3 + k: the side from corner k to k + 1 does.
    /// Each vertex and each edge belongs to one slot, so that no pair is met twice.
    pub(crate) owns: Vec<u8>,
    /// The vertices of each slot that count as its own come first, then how many those are.
    own_vertices: Vec<([u32; 3], u32)>,
    /// The same of its sides.
    own_sides: Vec<([[u32; 2]; 3], u32)>,
    /// For each edge of the mesh the vertices of its triangles that it does not have.
    opposites: Vec<[Option<u32>; 2]>,
    /// First slot of each node, and the one after its last.
    slots: Vec<[u32; 2]>,
    /// For each node whether it is a patch of at most [`PATCH_TRIANGLES`] that hang together by
    /// their sides.
    whole: Vec<bool>,
    /// Patches that share a side with patch n and have greater numbers:
    /// `beside[first_beside[n]..first_beside[n + 1]]`. Only such as are met together on the way
    /// down.
    beside: Vec<u32>,
    first_beside: Vec<u32>,
}

/// The tree fitted to a motion.
#[derive(Debug, Clone, Default)]
pub(crate) struct Fit {
    nodes: Vec<Bounds>,
    slots: Vec<Bounds>,
    /// The slots of each node that is a leaf, side by side.
    leaves: Vec<Leaf>,
    /// Unit normals at the beginning and at the end; zero where a triangle has none.
    pub(crate) normals: Vec<[Vec3A; 2]>,
    /// For each vertex the sum of the normals around it, and whether they all lie near that.
    around: Vec<(Vec3A, bool)>,
    /// For each patch the sum of its normals.
    axes: Vec<Vec3A>,
    /// For each node whether something below it is to be met; empty: all is.
    busy: Vec<bool>,
    stack: Vec<[u32; 2]>,
}

/// Where something begins, and how far it goes.
#[derive(Debug, Clone, Copy, Default)]
struct Bounds {
    low: Vec3A,
    high: Vec3A,
    way_low: Vec3A,
    way_high: Vec3A,
}

/// The bounds of a leaf's slots: x, y, z of `low`, `high`, `way_low` and `way_high`.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Leaf(pub(crate) [[f32; LEAF_TRIANGLES]; 12]);

impl Leaf {
    fn of(bounds: &[Bounds]) -> Self {
        // Of what is not there the first slot stands, and is not asked for.
        let all: [&Bounds; LEAF_TRIANGLES] = from_fn(|k| bounds.get(k).unwrap_or(&bounds[0]));
        let mut leaf = Self::default();
        for (part, three) in leaf.0.chunks_exact_mut(3).enumerate() {
            let of = |b: &Bounds| [b.low, b.high, b.way_low, b.way_high][part];
            let [a, b, c, d] = all.map(|b| Vec4::from((of(b), 0.0)));
            let side_by_side = Mat4::from_cols(a, b, c, d).transpose().to_cols_array_2d();
            three.copy_from_slice(&side_by_side[..3]);
        }
        leaf
    }

    fn bounds(&self, lane: usize) -> Bounds {
        let part = |p: usize| Vec3A::from_array(std::array::from_fn(|k| self.0[3 * p + k][lane]));
        Bounds { low: part(0), high: part(1), way_low: part(2), way_high: part(3) }
    }

    /// Bit `4 i + j`: whether this leaf's slot i meets the other one's slot j.
    pub(crate) fn meets(&self, other: &Self, reach: f32) -> u32 {
        let mut bits = 0;
        for i in 0..LEAF_TRIANGLES {
            for j in 0..LEAF_TRIANGLES {
                let near = self.bounds(i).meets(&other.bounds(j), Vec3A::splat(reach));
                bits |= u32::from(near) << (LEAF_TRIANGLES * i + j);
            }
        }
        bits
    }
}

impl Bounds {
    fn of(points: [Vec3A; 3], ways: [Vec3A; 3]) -> Self {
        let ([a, b, c], [u, v, w]) = (points, ways);
        Self {
            low: a.min(b).min(c),
            high: a.max(b).max(c),
            way_low: u.min(v).min(w),
            way_high: u.max(v).max(w),
        }
    }

    fn with(&self, other: &Self) -> Self {
        Self {
            low: self.low.min(other.low),
            high: self.high.max(other.high),
            way_low: self.way_low.min(other.way_low),
            way_high: self.way_high.max(other.way_high),
        }
    }

    fn meets(&self, other: &Self, reach: Vec3A) -> bool {
        let down = (self.way_low - other.way_high).min(Vec3A::ZERO) - reach;
        let up = (self.way_high - other.way_low).max(Vec3A::ZERO) + reach;
        let apart = (self.low + down).cmpgt(other.high) | (self.high + up).cmplt(other.low);
        !apart.any()
    }
}

impl Tree {
    /// The tree of a mesh, split by its rest shape.
    pub(crate) fn new(mesh: &Mesh) -> Self {
        let (nodes, order) = bvh::split(mesh.rest_positions(), mesh.triangles(), LEAF_TRIANGLES);
        let corners: Vec<[u32; 3]> = order.iter().map(|t| mesh.triangles()[*t as usize]).collect();
        let owns = owners(mesh, &corners);
        let mut tree = Self {
            across: across(mesh, &corners),
            own_vertices: own(&corners, &owns, 0, |t, k| t[k]),
            own_sides: own(&corners, &owns, 3, |t, k| [t[k], t[(k + 1) % 3]]),
            owns,
            opposites: opposites(mesh),
            slots: slots_of(&nodes),
            whole: Vec::new(),
            beside: Vec::new(),
            first_beside: Vec::new(),
            vertices: mesh.vertex_count(),
            nodes,
            order,
            corners,
        };
        let rest = mesh.rest_positions();
        let is_patch = |range: &[u32; 2]| {
            tree.hangs_together(*range) && !tree.has_notch(rest, [*range, [0; 2]])
        };
        let whole = tree.slots.iter().map(is_patch).collect();
        tree.whole = whole;
        tree.find_beside(rest);
        tree
    }

    /// Lists the patches that share sides, depth by depth. Leaves are opened no further, so they
    /// are met with all that is deeper, too.
    fn find_beside(&mut self, rest: &[Vec3]) {
        let mut pairs: Vec<[u32; 2]> = Vec::new();
        let mut level = if self.nodes.is_empty() { Vec::new() } else { vec![0u32] };
        let mut owner = vec![0u32; self.corners.len()];
        loop {
            for node in &level {
                let [first, end] = self.slots[*node as usize];
                owner[first as usize..end as usize].fill(*node);
            }
            for (slot, across) in self.across.iter().enumerate() {
                for other in across.iter().filter(|other| **other != NONE) {
                    let [a, b] = [owner[slot], owner[*other as usize]];
                    if a < b && self.whole[a as usize] && self.whole[b as usize] {
                        pairs.push([a, b]);
                    }
                }
            }
            if level.iter().all(|n| self.nodes[*n as usize].count > 0) {
                break;
            }
            let open = |n: &u32| {
                let node = self.nodes[*n as usize];
                if node.count > 0 { vec![*n] } else { vec![*n + 1, node.link] }
            };
            level = level.iter().flat_map(open).collect();
        }
        pairs.sort_unstable();
        pairs.dedup();
        pairs.retain(|pair| !self.has_notch(rest, pair.map(|n| self.slots[n as usize])));
        self.first_beside = vec![0; self.nodes.len() + 1];
        for [a, _] in &pairs {
            self.first_beside[*a as usize + 1] += 1;
        }
        for n in 0..self.nodes.len() {
            self.first_beside[n + 1] += self.first_beside[n];
        }
        self.beside = pairs.into_iter().map(|[_, b]| b).collect();
    }

    /// The vertices that belong to a slot.
    #[inline(always)]
    pub(crate) fn own_vertices(&self, slot: u32) -> &[u32] {
        let (all, count) = &self.own_vertices[slot as usize];
        &all[..*count as usize]
    }

    /// The sides that belong to a slot.
    #[inline(always)]
    pub(crate) fn own_sides(&self, slot: u32) -> &[[u32; 2]] {
        let (all, count) = &self.own_sides[slot as usize];
        &all[..*count as usize]
    }

    /// The vertices opposite to an edge in its one or two triangles.
    pub(crate) fn opposites(&self, mesh: &Mesh, edge: [u32; 2]) -> [Option<u32>; 2] {
        self.opposites[edge_of(mesh, edge[0], edge[1])]
    }

    fn hangs_together(&self, [first, end]: [u32; 2]) -> bool {
        if end - first > PATCH_TRIANGLES {
            return false;
        }
        let mut seen = [false; PATCH_TRIANGLES as usize];
        let mut todo = vec![first];
        while let Some(slot) = todo.pop() {
            if !std::mem::replace(&mut seen[(slot - first) as usize], true) {
                let inside = |s: &&u32| (first..end).contains(*s);
                todo.extend(self.across[slot as usize].iter().filter(inside));
            }
        }
        seen.iter().filter(|s| **s).count() == (end - first) as usize
    }

    /// Whether the way between two vertices within two patches together is a detour.
    fn has_notch(&self, rest: &[Vec3], ranges: [[u32; 2]; 2]) -> bool {
        let slots = || ranges.into_iter().flat_map(|[first, end]| first..end);
        let mut vertices: Vec<u32> = slots().flat_map(|s| self.corners[s as usize]).collect();
        vertices.sort_unstable();
        vertices.dedup();
        let count = vertices.len();
        // Every vertex of the patch is in the list.
        let place = |v: u32| vertices.binary_search(&v).unwrap_or(0);
        let straight = |a: u32, b: u32| rest[a as usize].distance(rest[b as usize]);
        let mut ways = vec![f32::INFINITY; count * count];
        for slot in slots() {
            let corners = self.corners[slot as usize];
            let inside = |s: &&u32| ranges.iter().any(|[first, end]| (*first..*end).contains(*s));
            // Along the sides, and straight over them to the next triangle's corner.
            let beyond = self.across[slot as usize].iter().filter(inside);
            let far = beyond.flat_map(|s| self.corners[*s as usize]);
            for to in corners.into_iter().chain(far) {
                for from in corners {
                    let (a, b) = (place(from), place(to));
                    let way = straight(from, to);
                    ways[a * count + b] = way;
                    ways[b * count + a] = way;
                }
            }
        }
        for over in 0..count {
            for a in 0..count {
                let first = ways[a * count + over];
                for b in 0..count {
                    let way = first + ways[over * count + b];
                    let known = &mut ways[a * count + b];
                    *known = known.min(way);
                }
            }
        }
        (0..count * count).any(|at| {
            let straight = straight(vertices[at / count], vertices[at % count]);
            ways[at] > DETOUR * straight && at / count != at % count
        })
    }

    /// Fits the tree to vertices that begin at `at` and go by `way`; no allocation once warm.
    pub(crate) fn fit(&self, at: impl Fn(u32) -> Vec3A, way: impl Fn(u32) -> Vec3A, fit: &mut Fit) {
        fit.slots.clear();
        fit.normals.clear();
        fit.busy.clear();
        for corners in &self.corners {
            let (p, w) = (corners.map(&at), corners.map(&way));
            fit.slots.push(Bounds::of(p, w));
            let normal = |[a, b, c]: [Vec3A; 3]| (b - a).cross(c - a).normalize_or_zero();
            fit.normals.push([normal(p), normal(std::array::from_fn(|k| p[k] + w[k]))]);
        }
        self.fit_fans(fit);
        fit.nodes.resize(self.nodes.len(), Bounds::default());
        fit.leaves.resize(self.nodes.len(), Leaf::default());
        fit.axes.resize(self.nodes.len(), Vec3A::ZERO);
        for i in (0..self.nodes.len()).rev() {
            let node = self.nodes[i];
            if node.count == 0 {
                let right = node.link as usize;
                fit.nodes[i] = fit.nodes[i + 1].with(&fit.nodes[right]);
                fit.axes[i] = fit.axes[i + 1] + fit.axes[right];
            } else {
                let slots = node.link as usize..(node.link + node.count) as usize;
                let leaf = &fit.slots[slots.clone()];
                fit.nodes[i] = leaf[1..].iter().fold(leaf[0], |sum, b| sum.with(b));
                fit.leaves[i] = Leaf::of(leaf);
                fit.axes[i] = fit.normals[slots].iter().map(|[n, m]| *n + *m).sum();
            }
        }
    }

    /// Lets [`Tree::pairs`] meet only such pairs of which one has a busy vertex, until the next
    /// fit.
    pub(crate) fn restrict(&self, busy: &[bool], fit: &mut Fit) {
        fit.busy.clear();
        fit.busy.resize(self.nodes.len(), false);
        for i in (0..self.nodes.len()).rev() {
            let node = self.nodes[i];
            fit.busy[i] = if node.count == 0 {
                fit.busy[i + 1] || fit.busy[node.link as usize]
            } else {
                let leaf = &self.corners[node.link as usize..][..node.count as usize];
                leaf.iter().flatten().any(|v| busy[*v as usize])
            };
        }
    }

    /// Calls `turned` with the corners of each triangle whose normal at `ends` is further than 60 degrees from
    /// that at the end for which the tree was fitted: what was found smooth there may not be.
    pub(crate) fn turned(&self, fit: &Fit, ends: &[Vec3A], mut turned: impl FnMut(&[u32; 3])) {
        for (corners, normals) in self.corners.iter().zip(&fit.normals) {
            let [a, b, c] = corners.map(|v| ends[v as usize]);
            let normal = (b - a).cross(c - a);
            if normal.dot(normals[1]) < TURNED * normal.length() {
                turned(corners);
            }
        }
    }

    /// Unit normal of the cloth around a vertex, between beginning and end.
    pub(crate) fn vertex_normal(fit: &Fit, vertex: u32) -> Vec3A {
        fit.around[vertex as usize].0
    }

    /// Finds the vertices around which the cloth is smooth before and after.
    fn fit_fans(&self, fit: &mut Fit) {
        fit.around.clear();
        fit.around.resize(self.vertices, (Vec3A::ZERO, true));
        for (corners, normals) in self.corners.iter().zip(&fit.normals) {
            for v in corners {
                fit.around[*v as usize].0 += normals[0] + normals[1];
            }
        }
        for (sum, _) in &mut fit.around {
            *sum = sum.normalize_or_zero();
        }
        for (corners, normals) in self.corners.iter().zip(&fit.normals) {
            for v in corners {
                let (axis, smooth) = &mut fit.around[*v as usize];
                *smooth &= normals[0].dot(*axis).min(normals[1].dot(*axis)) > SMOOTH;
            }
        }
    }

    /// Calls `met` for every two slots which may come within `reach` (m) of each other during the
    /// motion.
    ///
    /// With `smooth`, triangles of a smooth patch are not compared: one or two small patches that
    /// share a side, or the triangles around a vertex, while all their normals, before and after,
    /// lie within 45 degrees of their mean. Such a patch projects on its mean plane without folding, so nothing
    /// in it meets (Volino & Magnenat-Thalmann 1994; it is too small for its outline to close on
    /// itself). Two triangles at a common side are not compared while they are folded by less than
    /// a right angle and turn by less than one.
    pub(crate) fn pairs(
        &self,
        fit: &mut Fit,
        reach: f32,
        smooth: bool,
        mut met: impl FnMut(&Fit, u32, u32),
    ) {
        let (set, reach) = (Set::detect(), Vec3A::splat(reach));
        let mut stack = std::mem::take(&mut fit.stack);
        stack.clear();
        stack.push([0, 0]);
        while let Some([a, b]) = stack.pop() {
            let idle = !fit.busy.is_empty() && !fit.busy[a as usize] && !fit.busy[b as usize];
            if idle || smooth && self.is_smooth(fit, a, b) {
                continue;
            }
            let (na, nb) = (self.nodes[a as usize], self.nodes[b as usize]);
            if na.count > 0 && nb.count > 0 {
                let near =
                    simd::meets(set, &fit.leaves[a as usize], &fit.leaves[b as usize], reach.x);
                self.leaves(fit, [na, nb], (near, smooth), &mut met);
                continue;
            }
            if a == b {
                let (left, right) = (a + 1, na.link);
                stack.extend([[left, left], [right, right]]);
                if fit.nodes[left as usize].meets(&fit.nodes[right as usize], reach) {
                    stack.push([left, right]);
                }
                continue;
            }
            // Both are opened where they can be.
            let open = |i: u32, n: Node| if n.count > 0 { [i, NONE] } else { [i + 1, n.link] };
            for i in open(a, na) {
                for j in open(b, nb) {
                    let known = i != NONE && j != NONE;
                    if known && fit.nodes[i as usize].meets(&fit.nodes[j as usize], reach) {
                        stack.push([i, j]);
                    }
                }
            }
        }
        fit.stack = stack;
    }

    fn leaves(
        &self,
        fit: &Fit,
        [a, b]: [Node; 2],
        (mut near, smooth): (u32, bool),
        met: &mut impl FnMut(&Fit, u32, u32),
    ) {
        while near != 0 {
            let bit = near.trailing_zeros();
            near &= near - 1;
            let (i, j) = (bit / LEAF_TRIANGLES as u32, bit % LEAF_TRIANGLES as u32);
            let known = i < a.count && j < b.count && (a.link != b.link || i < j);
            let (i, j) = (a.link + i, b.link + j);
            if known && !(smooth && self.is_fan(fit, i as usize, j as usize)) {
                met(fit, i, j);
            }
        }
    }

    /// Whether two triangles belong to one smooth fan, or are hardly folded at their common side.
    fn is_fan(&self, fit: &Fit, i: usize, j: usize) -> bool {
        if self.across[i].contains(&(j as u32)) {
            // What turns over on the way may pass through what it hangs on, however both end.
            let (a, b) = (fit.normals[i], fit.normals[j]);
            let folded = a[0].dot(b[0]).min(a[1].dot(b[1]));
            if folded.min(a[0].dot(a[1])).min(b[0].dot(b[1])) > 0.0 {
                return true;
            }
        }
        let shared = |v: &&u32| self.corners[j].contains(*v);
        self.corners[i].iter().filter(shared).any(|v| fit.around[*v as usize].1)
    }

    fn is_smooth(&self, fit: &Fit, a: u32, b: u32) -> bool {
        if !self.whole[a as usize] || !self.whole[b as usize] {
            return false;
        }
        let of = |n: u32| {
            let [first, end] = self.slots[n as usize];
            first as usize..end as usize
        };
        let (mut sum, mut count) = (fit.axes[a as usize], 2 * of(a).len());
        if a != b {
            let range = self.first_beside[a as usize]..self.first_beside[a as usize + 1];
            if !self.beside[range.start as usize..range.end as usize].contains(&b) {
                return false;
            }
            sum += fit.axes[b as usize];
            count += 2 * of(b).len();
        }
        let length = sum.length();
        if length <= SMOOTH * count as f32 {
            return false;
        }
        let axis = sum / length;
        let flat = |[n, m]: &[Vec3A; 2]| n.dot(axis).min(m.dot(axis)) > SMOOTH;
        fit.normals[of(a)].iter().all(flat) && (a == b || fit.normals[of(b)].iter().all(flat))
    }
}

/// The slots below each node.
fn slots_of(nodes: &[Node]) -> Vec<[u32; 2]> {
    let mut slots = vec![[0; 2]; nodes.len()];
    for (i, node) in nodes.iter().enumerate().rev() {
        slots[i] = if node.count > 0 {
            [node.link, node.link + node.count]
        } else {
            [slots[i + 1][0], slots[node.link as usize][1]]
        };
    }
    slots
}

fn across(mesh: &Mesh, corners: &[[u32; 3]]) -> Vec<[u32; 3]> {
    let mut first = vec![[NONE; 2]; mesh.edges().len()];
    let edge = |t: &[u32; 3], k: usize| edge_of(mesh, t[k], t[(k + 1) % 3]);
    for (slot, t) in corners.iter().enumerate() {
        for k in 0..3 {
            let sides = &mut first[edge(t, k)];
            sides[usize::from(sides[0] != NONE)] = slot as u32;
        }
    }
    let other = |slot: usize, t: &[u32; 3], k: usize| {
        let [a, b] = first[edge(t, k)];
        if a == slot as u32 { b } else { a }
    };
    let all = |(slot, t): (usize, &[u32; 3])| std::array::from_fn(|k| other(slot, t, k));
    corners.iter().enumerate().map(all).collect()
}

fn owners(mesh: &Mesh, corners: &[[u32; 3]]) -> Vec<u8> {
    let mut vertices = vec![false; mesh.vertex_count()];
    let mut edges = vec![false; mesh.edges().len()];
    let own = |t: &[u32; 3]| {
        let mut bits = 0;
        for k in 0..3 {
            let vertex = &mut vertices[t[k] as usize];
            let edge = &mut edges[edge_of(mesh, t[k], t[(k + 1) % 3])];
            bits |= u8::from(!std::mem::replace(vertex, true)) << k;
            bits |= u8::from(!std::mem::replace(edge, true)) << (3 + k);
        }
        bits
    };
    corners.iter().map(own).collect()
}

/// What belongs to each slot, by bits from `first` on, and how many those are.
fn own<T: Copy + Default>(
    corners: &[[u32; 3]],
    owns: &[u8],
    first: usize,
    of: impl Fn(&[u32; 3], usize) -> T,
) -> Vec<([T; 3], u32)> {
    let of_slot = |(t, bits): (&[u32; 3], &u8)| {
        let (mut all, mut count) = ([T::default(); 3], 0);
        for k in (0..3).filter(|k| bits >> (first + k) & 1 == 1) {
            all[count] = of(t, k);
            count += 1;
        }
        (all, count as u32)
    };
    corners.iter().zip(owns).map(of_slot).collect()
}

fn opposites(mesh: &Mesh) -> Vec<[Option<u32>; 2]> {
    let mut all = vec![[None; 2]; mesh.edges().len()];
    for t in mesh.triangles() {
        for k in 0..3 {
            let two = &mut all[edge_of(mesh, t[k], t[(k + 1) % 3])];
            two[usize::from(two[0].is_some())] = Some(t[(k + 2) % 3]);
        }
    }
    all
}

/// Index of the edge between two vertices of one triangle.
fn edge_of(mesh: &Mesh, a: u32, b: u32) -> usize {
    // Every side of a triangle is an edge of its mesh.
    mesh.edges().binary_search(&[a.min(b), a.max(b)]).unwrap_or(0)
}

/// Positions for [`Tree::fit`].
pub(crate) fn at(positions: &[Vec3]) -> impl Fn(u32) -> Vec3A {
    |v| Vec3A::from(positions[v as usize])
}

#[cfg(test)]
#[path = "tree_tests.rs"]
mod tests;

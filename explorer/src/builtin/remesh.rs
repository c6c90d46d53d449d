//! Makes the triangles of a mesh on a zero set nearly equilateral: split, collapse, flip, relax
//! (Botsch and Kobbelt 2004, "A remeshing approach to multiresolution modeling").

use std::collections::HashSet;

use cloth::Vec3;

use super::field::project;
use super::surface::{Mesh, directed_edges};

/// What the mesh lies on, and how fine it shall be.
pub(crate) struct Target<'a> {
    /// The surface: the zero set.
    pub surface: &'a dyn Fn(Vec3) -> f32,
    /// Boundaries lie where one of these is zero as well.
    pub cuts: &'a [&'a dyn Fn(Vec3) -> f32],
    /// Wanted length of an edge (m).
    pub edge_m: f32,
    /// Passes.
    pub passes: usize,
}

/// A vertex that lies on no cut.
pub(crate) const INSIDE: u8 = u8::MAX;

/// Remeshes. `cut_of` names for each vertex the cut whose boundary it lies on, or `INSIDE`.
pub(crate) fn remesh(mesh: &mut Mesh, cut_of: &mut Vec<u8>, target: &Target<'_>) {
    for pass in 0..target.passes {
        // Changing connectivity to the end would leave the last triangles unrelaxed.
        if pass + 4 < target.passes {
            split(mesh, cut_of, target);
            (0..3).for_each(|_| collapse(mesh, cut_of, target));
        }
        flip(mesh, cut_of);
        flip(mesh, cut_of);
        for _ in 0..3 {
            relax(mesh, cut_of, target);
        }
    }
}

/// Puts a vertex back where it belongs: on the surface, and on its cut.
pub(crate) fn settle(p: Vec3, cut: u8, target: &Target<'_>) -> Vec3 {
    let Some(cut) = target.cuts.get(cut as usize) else {
        return project(target.surface, p);
    };
    (0..4).fold(p, |p, _| project(cut, project(target.surface, p)))
}

/// An undirected edge with the triangles on its two sides (`u32::MAX` where there is none) and
/// the vertices opposite.
struct Edge {
    ends: [u32; 2],
    triangles: [u32; 2],
    opposite: [u32; 2],
}

fn edges(mesh: &Mesh) -> Vec<Edge> {
    let mut halves = Vec::with_capacity(mesh.triangles.len() * 3);
    for (index, t) in mesh.triangles.iter().enumerate() {
        for (k, [a, b]) in directed_edges(t).into_iter().enumerate() {
            halves.push((a.min(b), a.max(b), a > b, index as u32, t[(k + 2) % 3]));
        }
    }
    halves.sort_unstable();
    let mut edges: Vec<Edge> = Vec::with_capacity(halves.len() / 2 + 64);
    for (a, b, backward, triangle, opposite) in halves {
        match edges.last_mut() {
            Some(edge) if edge.ends == [a, b] => {
                edge.triangles[1] = triangle;
                edge.opposite[1] = opposite;
            }
            _ => edges.push(Edge {
                ends: if backward { [b, a] } else { [a, b] },
                triangles: [triangle, u32::MAX],
                opposite: [opposite, u32::MAX],
            }),
        }
        // A lone half-edge keeps its own direction; a pair is told from low to high index.
        if let Some(edge) = edges.last_mut()
            && edge.triangles[1] != u32::MAX
        {
            edge.ends = [a, b];
        }
    }
    edges
}

fn length(mesh: &Mesh, [a, b]: [u32; 2]) -> f32 {
    mesh.positions[a as usize].distance(mesh.positions[b as usize])
}

fn split(mesh: &mut Mesh, cut_of: &mut Vec<u8>, target: &Target<'_>) {
    let mut long: Vec<Edge> = edges(mesh);
    long.retain(|e| length(mesh, e.ends) > target.edge_m * 4.0 / 3.0);
    long.sort_by(|a, b| length(mesh, b.ends).total_cmp(&length(mesh, a.ends)));
    let mut touched = vec![false; mesh.triangles.len()];
    for edge in long {
        let sides = edge.triangles.iter().filter(|t| **t != u32::MAX);
        if sides.clone().any(|t| touched[*t as usize]) {
            continue;
        }
        let [a, b] = edge.ends;
        let boundary = edge.triangles[1] == u32::MAX;
        let cut = if boundary { cut_of[a as usize] } else { INSIDE };
        let middle = (mesh.positions[a as usize] + mesh.positions[b as usize]) / 2.0;
        let new = mesh.positions.len() as u32;
        mesh.positions.push(settle(middle, cut, target));
        cut_of.push(cut);
        for side in sides {
            touched[*side as usize] = true;
            let old = mesh.triangles[*side as usize];
            mesh.triangles[*side as usize] = old.map(|v| if v == b { new } else { v });
            mesh.triangles.push(old.map(|v| if v == a { new } else { v }));
            touched.push(true);
        }
    }
}

/// For each vertex, the triangles around it.
fn fans(mesh: &Mesh) -> Vec<Vec<u32>> {
    let mut fans = vec![Vec::with_capacity(8); mesh.positions.len()];
    for (index, t) in mesh.triangles.iter().enumerate() {
        t.iter().for_each(|v| fans[*v as usize].push(index as u32));
    }
    fans
}

fn ring(mesh: &Mesh, fan: &[u32], of: u32) -> Vec<u32> {
    let corners = fan.iter().flat_map(|t| mesh.triangles[*t as usize]);
    let mut ring: Vec<u32> = corners.filter(|v| *v != of).collect();
    ring.sort_unstable();
    ring.dedup();
    ring
}

fn collapse(mesh: &mut Mesh, cut_of: &mut Vec<u8>, target: &Target<'_>) {
    let mut short: Vec<Edge> = edges(mesh);
    short.retain(|e| length(mesh, e.ends) < target.edge_m * 0.8);
    short.sort_by(|a, b| length(mesh, a.ends).total_cmp(&length(mesh, b.ends)));
    let fans = fans(mesh);
    let mut touched = vec![false; mesh.positions.len()];
    let mut removed = vec![false; mesh.triangles.len()];
    for edge in short {
        let on_boundary = edge.triangles[1] == u32::MAX;
        let [mut keep, mut drop] = edge.ends;
        if cut_of[keep as usize] == INSIDE {
            std::mem::swap(&mut keep, &mut drop);
        }
        let both = cut_of[keep as usize] != INSIDE && cut_of[drop as usize] != INSIDE;
        let rings = [keep, drop].map(|v| ring(mesh, &fans[v as usize], v));
        let shared = rings[0].iter().filter(|v| rings[1].binary_search(v).is_ok()).count();
        if (both && !on_boundary)
            || shared != if on_boundary { 1 } else { 2 }
            || rings.iter().flatten().any(|v| touched[*v as usize])
        {
            continue;
        }
        let middle = (mesh.positions[keep as usize] + mesh.positions[drop as usize]) / 2.0;
        let one_end = cut_of[keep as usize] != INSIDE && !both;
        let place = if one_end {
            mesh.positions[keep as usize]
        } else {
            settle(middle, cut_of[keep as usize], target)
        };
        let longest = |v: &u32| mesh.positions[*v as usize].distance(place) < target.edge_m * 1.33;
        let mut around = fans[keep as usize].iter().chain(&fans[drop as usize]);
        let stays_flat = |t: &u32| {
            let old = mesh.triangles[*t as usize];
            let gone = old.contains(&keep) && old.contains(&drop);
            let moved = old
                .map(|v| if v == keep || v == drop { place } else { mesh.positions[v as usize] });
            let normal = (moved[1] - moved[0]).cross(moved[2] - moved[0]);
            gone || normal.normalize_or_zero().dot(mesh.normal(&old).normalize_or_zero()) > 0.7
        };
        if !rings.iter().flatten().all(longest) || !around.all(stays_flat) {
            continue;
        }
        rings.iter().flatten().for_each(|v| touched[*v as usize] = true);
        mesh.positions[keep as usize] = place;
        for t in &fans[drop as usize] {
            let triangle = &mut mesh.triangles[*t as usize];
            removed[*t as usize] = triangle.contains(&keep);
            triangle.iter_mut().filter(|v| **v == drop).for_each(|v| *v = keep);
        }
    }
    let mut at = removed.iter();
    mesh.triangles.retain(|_| !at.next().copied().unwrap_or(false));
    let kept = mesh.compact();
    *cut_of = kept.iter().map(|old| cut_of[*old as usize]).collect();
}

/// Flips edges where that brings the number of neighbours nearer to six (four at a boundary).
fn flip(mesh: &mut Mesh, cut_of: &[u8]) {
    let all = edges(mesh);
    let mut degree = vec![0i32; mesh.positions.len()];
    let mut known = HashSet::with_capacity(all.len());
    for edge in &all {
        edge.ends.iter().for_each(|v| degree[*v as usize] += 1);
        known.insert([edge.ends[0].min(edge.ends[1]), edge.ends[0].max(edge.ends[1])]);
    }
    let mut touched = vec![false; mesh.triangles.len()];
    for edge in all {
        let [left, right] = edge.triangles;
        if right == u32::MAX || touched[left as usize] || touched[right as usize] {
            continue;
        }
        let ([a, b], [c, d]) = (edge.ends, edge.opposite);
        // The triangle that runs from a to b lies left of the edge.
        let forward = directed_edges(&mesh.triangles[left as usize]).contains(&[a, b]);
        let (c, d) = if forward { (c, d) } else { (d, c) };
        let excess = |v: u32, change: i32| {
            let ideal = if cut_of[v as usize] == INSIDE { 6 } else { 4 };
            let off = degree[v as usize] + change - ideal;
            off * off
        };
        let before: i32 = [a, b, c, d].iter().map(|v| excess(*v, 0)).sum();
        let after = excess(a, -1) + excess(b, -1) + excess(c, 1) + excess(d, 1);
        let new = [[a, d, c], [d, b, c]];
        if after >= before
            || known.contains(&[c.min(d), c.max(d)])
            || degree[a as usize] <= 3
            || degree[b as usize] <= 3
            || !is_flat(mesh, [left, right], &new)
        {
            continue;
        }
        known.remove(&[a.min(b), a.max(b)]);
        known.insert([c.min(d), c.max(d)]);
        for (v, change) in [(a, -1), (b, -1), (c, 1), (d, 1)] {
            degree[v as usize] += change;
        }
        for (side, triangle) in [left, right].into_iter().zip(new) {
            touched[side as usize] = true;
            mesh.triangles[side as usize] = triangle;
        }
    }
}

/// Whether two triangles may stand for two others: they face as these did, and neither is a
/// sliver.
fn is_flat(mesh: &Mesh, old: [u32; 2], new: &[[u32; 3]; 2]) -> bool {
    let facing: Vec3 = old.iter().map(|t| mesh.normal(&mesh.triangles[*t as usize])).sum();
    new.iter().all(|t| {
        let normal = mesh.normal(t);
        let longest = directed_edges(t).into_iter().map(|e| length(mesh, e)).fold(0.0, f32::max);
        normal.normalize_or_zero().dot(facing.normalize_or_zero()) > 0.6
            && normal.length() > 0.2 * longest * longest
    })
}

/// Moves every vertex towards the mean of its neighbours, then back onto the surface; boundary
/// vertices slide along their boundary.
fn relax(mesh: &mut Mesh, cut_of: &[u8], target: &Target<'_>) {
    let mut sums = vec![(Vec3::ZERO, 0.0f32); mesh.positions.len()];
    for edge in edges(mesh) {
        let boundary = edge.triangles[1] == u32::MAX;
        for [v, other] in [edge.ends, [edge.ends[1], edge.ends[0]]] {
            if boundary || cut_of[v as usize] == INSIDE {
                sums[v as usize].0 += mesh.positions[other as usize];
                sums[v as usize].1 += 1.0;
            }
        }
    }
    let normals = mesh.vertex_normals();
    for (v, (sum, count)) in sums.into_iter().enumerate() {
        let p = mesh.positions[v];
        let step = (sum / count.max(1.0) - p) * 0.6;
        let along = step - normals[v] * step.dot(normals[v]);
        let moved = if cut_of[v] == INSIDE { along } else { step };
        mesh.positions[v] = settle(p + moved, cut_of[v], target);
    }
}

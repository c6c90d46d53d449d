//! A thin plate's energy on any triangulation: where the Hessian of bending comes from.
//!
//! A triangle's curvature is that of Morley's plate element: with the slope `f_i` across the
//! middle of each side i against the triangle's own plane,
//! `K = (1/A) sum_i l_i f_i n_i n_i^T` (n_i normal to the side in the plane, l_i its length, A the
//! area), and the energy is `bend/2 sum A |K|^2` in Frobenius' norm: Poisson's ratio 0, so that a
//! strip bends as a beam. Morley has the slopes as unknowns of their own. Here they follow from
//! the vertices: two triangles share one slope at their common side, so `f + f' = J`, the jump of
//! the planes' slopes across it, and the difference `f - f'` is what it is for the constant
//! curvature that fits the five hinges of both triangles best.
//!
//! Hence the two properties that make a plate element right on every mesh: a quadratic surface has
//! its exact curvature in every triangle, and, because slopes are shared, constant curvature is in
//! equilibrium at every inner vertex. At a free side the energy takes its least value over the
//! unknown slope: no moment there.
//!
//! All lengths and angles are those of the rest shape unfolded around each triangle.

use glam::Vec3;

use crate::mesh::Mesh;

const NONE: u32 = u32::MAX;
/// Share of its mean eigenvalue that is added to the fit's matrix, so that hinges which tell one
/// curvature badly (they lie on a conic) leave it small instead of large.
const REGULAR: f64 = 1e-3;
/// The difference of slopes may weigh so many jumps at most: slivers would ask for more.
const DIFFERENCE_MAX: f64 = 3.0;

/// A sum over vertices or hinges.
type Sum = Vec<(u32, f64)>;
type Point = [f64; 2];

/// The energy's Hessian for a stiffness of 1 N m.
pub(super) struct Plate {
    /// Row by row, ascending, with the diagonal (1/m^2).
    pub(super) rows: Vec<Sum>,
    /// For each hinge a weight: half the sum of weight times squared `length * jump` is, as a form,
    /// nowhere less than the energy (1/m^2).
    pub(super) hinge_bounds: Vec<f64>,
}

struct Sides<'a> {
    rest: &'a [Vec3],
    triangles: &'a [[u32; 3]],
    /// Hinge at each triangle's side k, from corner k to k + 1.
    hinges: Vec<[u32; 3]>,
    /// Triangles along and against each hinge.
    of_hinge: Vec<[u32; 2]>,
    /// Vertices of each hinge and how much they weigh in the jump of slopes (1/m).
    jumps: Vec<[(u32, f64); 4]>,
}

impl Plate {
    /// The Hessian of a mesh that is flat at rest.
    pub(super) fn new(mesh: &Mesh) -> Self {
        let sides = Sides::new(mesh);
        let differences: Vec<Sum> =
            (0..sides.of_hinge.len()).map(|h| sides.difference(h)).collect();
        let mut rows: Vec<Sum> = vec![Vec::with_capacity(36); mesh.vertex_count()];
        let mut hinge_bounds = vec![0.0; sides.of_hinge.len()];
        for (t, at) in sides.hinges.iter().enumerate() {
            let products = sides.products(t);
            let mut slopes: [Sum; 3] = Default::default();
            for (slope, hinge) in slopes.iter_mut().zip(at) {
                if *hinge != NONE {
                    let along = sides.of_hinge[*hinge as usize][0] == t as u32;
                    let sign = if along { 1.0 } else { -1.0 };
                    slope.push((*hinge, 0.5));
                    for (other, weight) in &differences[*hinge as usize] {
                        add(slope, *other, sign * weight);
                    }
                }
            }
            spread(&slopes, &products, |hinge, _, value| {
                hinge_bounds[hinge as usize] += value.abs();
            });
            let slopes = slopes.map(|s| sides.by_vertex(&s));
            spread(&slopes, &products, |row, column, value| {
                add(&mut rows[row as usize], column, value);
            });
        }
        for (bound, hinge) in hinge_bounds.iter_mut().zip(mesh.hinges()) {
            let [a, b, ..] = hinge.vertices.map(|v| mesh.rest_positions()[v as usize]);
            *bound /= f64::from(a.distance_squared(b));
        }
        for row in &mut rows {
            row.sort_unstable_by_key(|(column, _)| *column);
        }
        Self { rows, hinge_bounds }
    }
}

/// Adds `value` at `key`.
fn add(sum: &mut Sum, key: u32, value: f64) {
    match sum.iter_mut().find(|(k, _)| *k == key) {
        Some((_, old)) => *old += value,
        None => sum.push((key, value)),
    }
}

/// The form `sum_ij w_ij f_i f_j`, entry by entry.
fn spread(f: &[Sum; 3], w: &[[f64; 3]; 3], mut at: impl FnMut(u32, u32, f64)) {
    let mut all: Vec<(u32, [f64; 3])> = Vec::with_capacity(12);
    for (i, sum) in f.iter().enumerate() {
        for (key, value) in sum {
            match all.iter_mut().find(|(k, _)| k == key) {
                Some((_, values)) => values[i] += value,
                None => {
                    let mut values = [0.0; 3];
                    values[i] = *value;
                    all.push((*key, values));
                }
            }
        }
    }
    for (row, x) in &all {
        let y: [f64; 3] = std::array::from_fn(|j| (0..3).map(|i| x[i] * w[i][j]).sum());
        for (column, z) in &all {
            at(*row, *column, y[0] * z[0] + y[1] * z[1] + y[2] * z[2]);
        }
    }
}

impl<'a> Sides<'a> {
    fn new(mesh: &'a Mesh) -> Self {
        let (rest, triangles) = (mesh.rest_positions(), mesh.triangles());
        let mut hinges = vec![[NONE; 3]; triangles.len()];
        let mut of_hinge = vec![[NONE; 2]; mesh.hinges().len()];
        let key = |h: &crate::mesh::Hinge| (h.vertices[0], h.vertices[1]);
        for (t, corners) in triangles.iter().enumerate() {
            for k in 0..3 {
                let (a, b) = (corners[k], corners[(k + 1) % 3]);
                // Hinges are in the order of their edges.
                let found = mesh.hinges().binary_search_by_key(&(a.min(b), a.max(b)), key);
                if let Ok(hinge) = found {
                    hinges[t][k] = hinge as u32;
                    of_hinge[hinge][usize::from(a > b)] = t as u32;
                }
            }
        }
        let jump = |h: &crate::mesh::Hinge| {
            let [a, b, c, d] = h.vertices.map(|v| rest[v as usize]);
            let [(sc, hc), (sd, hd)] = [apex(a, b, c), apex(a, b, d)];
            let l = f64::from(a.distance(b));
            let at_b = -sc / (l * hc) - sd / (l * hd);
            let at_a = -1.0 / hc - 1.0 / hd - at_b;
            let [a, b, c, d] = h.vertices;
            [(a, at_a), (b, at_b), (c, 1.0 / hc), (d, 1.0 / hd)]
        };
        let jumps = mesh.hinges().iter().map(jump).collect();
        Self { rest, triangles, hinges, of_hinge, jumps }
    }

    fn at(&self, v: u32) -> Vec3 {
        self.rest[v as usize]
    }

    /// A sum of jumps as a sum over vertices.
    fn by_vertex(&self, jumps: &Sum) -> Sum {
        let mut sum = Vec::with_capacity(8);
        for (hinge, weight) in jumps {
            for (vertex, k) in self.jumps[*hinge as usize] {
                add(&mut sum, vertex, weight * k);
            }
        }
        sum
    }

    /// `l_i l_j (n_i . n_j)^2 / A` for the sides of a triangle, free sides' slopes eliminated.
    fn products(&self, t: usize) -> [[f64; 3]; 3] {
        let p = self.triangles[t].map(|v| self.at(v).as_dvec());
        let side: [[f64; 3]; 3] = std::array::from_fn(|k| minus(p[(k + 1) % 3], p[k]));
        let area = 0.5 * length(cross(side[0], side[1]));
        let l = side.map(length);
        let mut w: [[f64; 3]; 3] = std::array::from_fn(|i| {
            std::array::from_fn(|j| {
                let cosine = dot(side[i], side[j]) / (l[i] * l[j]);
                l[i] * l[j] * cosine * cosine / area
            })
        });
        for free in (0..3).filter(|k| self.hinges[t][*k] == NONE) {
            let own = w[free];
            if own[free] > 0.0 {
                for (i, row) in w.iter_mut().enumerate() {
                    for (value, column) in row.iter_mut().zip(own) {
                        *value -= own[i] * column / own[free];
                    }
                }
            }
            w[free] = [0.0; 3];
            w.iter_mut().for_each(|row| row[free] = 0.0);
        }
        w
    }

    /// Half the difference of the slopes of the two triangles at a hinge, as a sum of jumps.
    fn difference(&self, hinge: usize) -> Sum {
        let [(a, _), (b, _), (c, _), (d, _)] = self.jumps[hinge];
        let l = f64::from(self.at(a).distance(self.at(b)));
        let [(sc, hc), (sd, hd)] = [c, d].map(|v| apex(self.at(a), self.at(b), self.at(v)));
        let (pa, pb, pc, pd) = ([0.0, 0.0], [l, 0.0], [sc, hc], [sd, -hd]);
        let mut fit = Fit::default();
        fit.hinge(hinge as u32, [pa, pb, pc, pd]);
        let [along, against] = self.of_hinge[hinge];
        let pairs = [(along, [a, b, c], [pa, pb, pc]), (against, [b, a, d], [pb, pa, pd])];
        for (t, corners, points) in pairs {
            for k in 1..3 {
                self.add_side(&mut fit, t, k, corners, points);
            }
        }
        // For a curvature K the slope of a triangle at this side is -(l / 4A) e K f, with e and f
        // its other two sides.
        let slope = |[p, q, r]: [Point; 3], height: f64| {
            let (e, f) = (minus2(r, q), minus2(p, r));
            let scale = -0.5 / height;
            [e[0] * f[0], e[1] * f[1], (e[0] * f[1] + e[1] * f[0]) / SQRT_2].map(|x| x * scale)
        };
        let (one, two) = (slope([pa, pb, pc], hc), slope([pb, pa, pd], hd));
        let asked = std::array::from_fn(|k| 0.5 * (one[k] - two[k]));
        fit.read(asked)
    }

    /// Adds what the side from corner k to k + 1 of triangle `t` tells, corners counted as given.
    fn add_side(&self, fit: &mut Fit, t: u32, k: usize, corners: [u32; 3], points: [Point; 3]) {
        let (p, q, r) = (corners[k], corners[(k + 1) % 3], corners[(k + 2) % 3]);
        let (pp, pq, pr) = (points[k], points[(k + 1) % 3], points[(k + 2) % 3]);
        let along = minus2(pq, pp);
        let l = along[0].hypot(along[1]);
        let (u, out) = ([along[0] / l, along[1] / l], [along[1] / l, -along[0] / l]);
        let own = &self.triangles[t as usize];
        let side = own.iter().position(|v| *v == p).unwrap_or(0);
        let hinge = self.hinges[t as usize][side];
        if hinge == NONE {
            fit.free(out);
            return;
        }
        let ends = self.jumps[hinge as usize];
        let far = if ends[2].0 == r { ends[3].0 } else { ends[2].0 };
        let (s, h) = apex(self.at(p), self.at(q), self.at(far));
        let pf = [pp[0] + s * u[0] + h * out[0], pp[1] + s * u[1] + h * out[1]];
        fit.hinge(hinge, [pp, pq, pr, pf]);
    }
}

use std::f64::consts::SQRT_2;

/// A constant curvature fitted to jumps: coordinates xx, yy and sqrt(2) xy.
#[derive(Default)]
struct Fit {
    /// Hinge, what its scaled jump is for each coordinate, and the scale (1/m).
    told: Vec<(u32, [f64; 3], f64)>,
}

impl Fit {
    /// A hinge with its ends, and the apexes on both sides.
    fn hinge(&mut self, hinge: u32, [p, q, r, f]: [Point; 4]) {
        let along = minus2(q, p);
        let l = along[0].hypot(along[1]);
        let place = |x: Point| {
            let d = minus2(x, p);
            let s = (d[0] * along[0] + d[1] * along[1]) / l;
            (s, ((d[0] * along[1] - d[1] * along[0]) / l).abs())
        };
        let ((sr, hr), (sf, hf)) = (place(r), place(f));
        let at_q = -sr / (l * hr) - sf / (l * hf);
        let at_p = -1.0 / hr - 1.0 / hf - at_q;
        let mut jump = [0.0; 3];
        for (weight, x) in [(at_p, p), (at_q, q), (1.0 / hr, r), (1.0 / hf, f)] {
            jump[0] += 0.5 * weight * x[0] * x[0];
            jump[1] += 0.5 * weight * x[1] * x[1];
            jump[2] += weight * x[0] * x[1] / SQRT_2;
        }
        let scale = 2.0 / (hr + hf);
        self.told.push((hinge, jump.map(|x| x * scale), scale));
    }

    /// A free side with normal `n`: no curvature across it.
    fn free(&mut self, n: Point) {
        self.told.push((NONE, [n[0] * n[0], n[1] * n[1], SQRT_2 * n[0] * n[1]], 0.0));
    }

    /// The value of the form `asked` at the fitted curvature, as a sum of jumps.
    fn read(&self, asked: [f64; 3]) -> Sum {
        let mut m = [[0.0; 3]; 3];
        for (_, row, _) in &self.told {
            for i in 0..3 {
                for j in 0..3 {
                    m[i][j] += row[i] * row[j];
                }
            }
        }
        let more = REGULAR * (m[0][0] + m[1][1] + m[2][2]) / 3.0;
        (0..3).for_each(|k| m[k][k] += more);
        let columns = [cross(m[1], m[2]), cross(m[2], m[0]), cross(m[0], m[1])];
        let determinant = dot(m[0], columns[0]);
        let y: [f64; 3] = std::array::from_fn(|k| {
            (0..3).map(|i| columns[i][k] * asked[i]).sum::<f64>() / determinant
        });
        let told = self.told.iter().filter(|(hinge, ..)| *hinge != NONE);
        let mut sum: Sum = told.map(|(hinge, row, scale)| (*hinge, dot(y, *row) * scale)).collect();
        let weight: f64 = sum.iter().map(|(_, x)| x.abs()).sum();
        if weight > DIFFERENCE_MAX {
            sum.iter_mut().for_each(|(_, x)| *x *= DIFFERENCE_MAX / weight);
        }
        sum
    }
}

/// Where the apex lies against the edge from `a` to `b`: along it and off it (m).
fn apex(a: Vec3, b: Vec3, c: Vec3) -> (f64, f64) {
    let (e, d) = (minus(b.as_dvec(), a.as_dvec()), minus(c.as_dvec(), a.as_dvec()));
    let l = length(e);
    (dot(d, e) / l, length(cross(d, e)) / l)
}

/// Three numbers in f64.
trait Wide {
    fn as_dvec(&self) -> [f64; 3];
}

impl Wide for Vec3 {
    fn as_dvec(&self) -> [f64; 3] {
        self.to_array().map(f64::from)
    }
}

fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

fn minus2(a: Point, b: Point) -> Point {
    [a[0] - b[0], a[1] - b[1]]
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn length(a: [f64; 3]) -> f64 {
    dot(a, a).sqrt()
}

//! Cholesky factors of a small sparse matrix, row by row from each row's first entry.

use glam::Vec3A;

/// A symmetric positive matrix of scalars, then its factor, in an order that keeps rows short.
#[derive(Debug, Clone, Default)]
pub(super) struct Envelope {
    /// First column of each row.
    first: Vec<usize>,
    /// Where each row begins; one more at the end.
    starts: Vec<usize>,
    /// Rows from their first column to the diagonal, one after the other.
    values: Vec<f32>,
    inverse_diagonal: Vec<f32>,
}

/// An order in which neighbours stand close together (reverse Cuthill-McKee): place to vertex.
///
/// * `neighbours`: of each vertex; every vertex takes part.
pub(super) fn order(neighbours: &[Vec<u32>]) -> Vec<u32> {
    let mut done = vec![false; neighbours.len()];
    let mut order: Vec<u32> = Vec::with_capacity(neighbours.len());
    let degree = |v: &u32| (neighbours[*v as usize].len(), *v);
    let mut seeds: Vec<u32> = (0..neighbours.len() as u32).collect();
    seeds.sort_unstable_by_key(degree);
    for seed in seeds {
        if done[seed as usize] {
            continue;
        }
        done[seed as usize] = true;
        let mut next = order.len();
        order.push(seed);
        while next < order.len() {
            let mut found: Vec<u32> = neighbours[order[next] as usize].clone();
            found.retain(|v| !std::mem::replace(&mut done[*v as usize], true));
            found.sort_unstable_by_key(degree);
            order.extend(found);
            next += 1;
        }
    }
    order.reverse();
    order
}

impl Envelope {
    /// All zero, with room for the given entries below the diagonal.
    pub(super) fn new(count: usize, below: impl Iterator<Item = (usize, usize)>) -> Self {
        let mut first: Vec<usize> = (0..count).collect();
        for (row, column) in below {
            first[row] = first[row].min(column);
        }
        let mut starts = vec![0];
        for (row, first) in first.iter().enumerate() {
            starts.push(starts[row] + row - first + 1);
        }
        let values = vec![0.0; starts[count]];
        Self { first, starts, values, inverse_diagonal: vec![0.0; count] }
    }

    /// Sets every entry to 0, before a new matrix is put in.
    pub(super) fn clear(&mut self) {
        self.values.fill(0.0);
    }

    /// Adds to an entry on or below the diagonal.
    pub(super) fn add(&mut self, row: usize, column: usize, value: f32) {
        self.values[self.starts[row] + column - self.first[row]] += value;
    }

    /// Replaces the matrix by its factor. Cost: the squares of the rows' lengths.
    pub(super) fn factor(&mut self) {
        for row in 0..self.first.len() {
            let (before, rest) = self.values.split_at_mut(self.starts[row]);
            let from = self.first[row];
            let own = &mut rest[..row - from + 1];
            for column in from..row {
                let other_first = self.first[column];
                let shared = from.max(other_first);
                let other = &before[self.starts[column] + shared - other_first..];
                let length = column - shared;
                let sum = dot(&own[shared - from..][..length], &other[..length]);
                own[column - from] = (own[column - from] - sum) * self.inverse_diagonal[column];
            }
            let (left, diagonal) = own.split_at_mut(row - from);
            let pivot = (diagonal[0] - dot(left, left)).max(f32::MIN_POSITIVE).sqrt();
            diagonal[0] = pivot;
            self.inverse_diagonal[row] = 1.0 / pivot;
        }
    }

    /// Solves for three right-hand sides at once, in place.
    pub(super) fn solve(&self, x: &mut [Vec3A]) {
        for row in 0..self.first.len() {
            let (done, rest) = x.split_at_mut(row);
            let factors = &self.values[self.starts[row]..self.starts[row + 1] - 1];
            let known = &done[self.first[row]..];
            let (fours, last) = factors.as_chunks::<4>();
            let (known_fours, known_last) = known.as_chunks::<4>();
            let mut sums = [Vec3A::ZERO; 4];
            for (l, y) in fours.iter().zip(known_fours) {
                for i in 0..4 {
                    sums[i] += y[i] * l[i];
                }
            }
            for (l, y) in last.iter().zip(known_last) {
                sums[0] += *y * *l;
            }
            let sum = (sums[0] + sums[1]) + (sums[2] + sums[3]);
            rest[0] = (rest[0] - sum) * self.inverse_diagonal[row];
        }
        for row in (0..self.first.len()).rev() {
            let (before, rest) = x.split_at_mut(row);
            let value = rest[0] * self.inverse_diagonal[row];
            rest[0] = value;
            let factors = &self.values[self.starts[row]..self.starts[row + 1] - 1];
            for (y, l) in before[self.first[row]..].iter_mut().zip(factors) {
                *y -= value * *l;
            }
        }
    }
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    const LANES: usize = 8;
    let (a8, a_last) = a.as_chunks::<LANES>();
    let (b8, b_last) = b.as_chunks::<LANES>();
    let mut sums = [0.0f32; LANES];
    for (a, b) in a8.iter().zip(b8) {
        for i in 0..LANES {
            sums[i] += a[i] * b[i];
        }
    }
    let last: f32 = a_last.iter().zip(b_last).map(|(a, b)| a * b).sum();
    sums.iter().sum::<f32>() + last
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_solved_system_gives_back_its_right_hand_side() {
        // A ring of 30 with chords, shifted to be positive.
        let count = 30usize;
        let pairs: Vec<(usize, usize)> =
            (0..count).flat_map(|i| [(i, (i + 1) % count), (i, (i + 7) % count)]).collect();
        let mut neighbours = vec![Vec::new(); count];
        for (a, b) in &pairs {
            neighbours[*a].push(*b as u32);
            neighbours[*b].push(*a as u32);
        }
        let order = order(&neighbours);
        let mut place = vec![usize::MAX; count];
        order.iter().enumerate().for_each(|(p, v)| place[*v as usize] = p);
        assert!(place.iter().all(|p| *p < count), "every vertex once");
        let at = |a: usize, b: usize| (place[a].max(place[b]), place[a].min(place[b]));
        let mut envelope = Envelope::new(count, pairs.iter().map(|(a, b)| at(*a, *b)));
        let mut dense = vec![vec![0.0f32; count]; count];
        for (a, b) in pairs {
            let (row, column) = at(a, b);
            envelope.add(row, column, -1.0);
            (dense[row][column], dense[column][row]) = (-1.0, -1.0);
        }
        for (i, row) in dense.iter_mut().enumerate() {
            envelope.add(i, i, 4.5);
            row[i] = 4.5;
        }
        let b: Vec<Vec3A> =
            (0..count).map(|i| Vec3A::new(i as f32, (i % 5) as f32, -1.0)).collect();
        let mut x = b.clone();
        envelope.factor();
        envelope.solve(&mut x);
        for (row, b) in dense.iter().zip(&b) {
            let product: Vec3A = row.iter().zip(&x).map(|(a, x)| *x * *a).sum();
            assert!((product - *b).length() < 1e-3, "{product} {b}");
        }
    }
}

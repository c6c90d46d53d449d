//! Makes the inside of a sampled shell plain: no cavities, and no cell that two sheets share, so
//! that surface nets are a manifold.

/// What a node is set to that is to be inside (m).
const INSIDE: f32 = -1e-4;

/// Fills hollows that cannot be reached from the grid's first node, then every cell in which two
/// sheets meet, until none is left.
///
/// * `values`: by node, x fastest; negative inside.
pub(super) fn fill(values: &mut [f32], n: [usize; 3]) {
    fill_hollows(values, n);
    while fill_pinches(values, n) {}
}

fn fill_hollows(values: &mut [f32], n: [usize; 3]) {
    let strides = [1, n[0], n[0] * n[1]];
    let mut outside = vec![false; values.len()];
    let mut open = vec![0usize];
    outside[0] = true;
    while let Some(at) = open.pop() {
        let place = [at % n[0], at / n[0] % n[1], at / strides[2]];
        for axis in 0..3 {
            for up in [false, true] {
                if place[axis] == if up { n[axis] - 1 } else { 0 } {
                    continue;
                }
                let next = if up { at + strides[axis] } else { at - strides[axis] };
                if values[next] >= 0.0 && !outside[next] {
                    outside[next] = true;
                    open.push(next);
                }
            }
        }
    }
    for (value, outside) in values.iter_mut().zip(outside) {
        if !outside {
            *value = value.min(INSIDE);
        }
    }
}

/// One sweep; whether anything was filled.
fn fill_pinches(values: &mut [f32], n: [usize; 3]) -> bool {
    let mut changed = false;
    for z in 0..n[2] - 1 {
        for y in 0..n[1] - 1 {
            for x in 0..n[0] - 1 {
                let at = |c: usize| ((z + (c >> 2)) * n[1] + y + (c >> 1 & 1)) * n[0] + x + (c & 1);
                let mask = (0..8).fold(0u8, |m, c| m | u8::from(values[at(c)] < 0.0) << c);
                if is_joined(mask) && is_joined(!mask) {
                    continue;
                }
                changed = true;
                for c in 0..8 {
                    values[at(c)] = values[at(c)].min(INSIDE);
                }
            }
        }
    }
    changed
}

/// Whether these corners of a cube hang together along its edges; none do.
fn is_joined(mask: u8) -> bool {
    let mut reached = mask & mask.wrapping_neg();
    loop {
        let grown = (0..8).fold(reached, |g, c| {
            let beside = 1 << (c ^ 1) | 1 << (c ^ 2) | 1 << (c ^ 4);
            if mask >> c & 1 == 1 && reached & beside != 0 { g | 1 << c } else { g }
        });
        if grown == reached {
            return reached == mask;
        }
        reached = grown;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_hang_together_along_edges_only() {
        assert!(is_joined(0) && is_joined(1) && is_joined(0b11) && is_joined(0xff));
        assert!(!is_joined(0b1001), "across a face");
        assert!(!is_joined(0b1000_0001), "across the cube");
        assert!(is_joined(0b1011));
    }

    #[test]
    fn hollows_and_pinches_are_filled() {
        let n = [7, 7, 7];
        let mut values = vec![1.0; 343];
        let at = |x: usize, y: usize, z: usize| (z * 7 + y) * 7 + x;
        for (x, y, z) in (0..27).map(|i| (2 + i % 3, 2 + i / 3 % 3, 2 + i / 9)) {
            values[at(x, y, z)] = -1.0;
        }
        values[at(3, 3, 3)] = 1.0;
        values[at(5, 5, 4)] = -1.0;
        fill(&mut values, n);
        assert!(values[at(3, 3, 3)] < 0.0, "the hollow");
        assert!(values[at(5, 4, 4)] < 0.0 || values[at(4, 5, 4)] < 0.0, "the pinch");
        assert!(values[at(1, 1, 1)] > 0.0);
    }
}

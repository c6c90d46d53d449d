use super::*;

/// A cylinder of n x n vertices, open at both ends, wavy.
fn tube(n: u32) -> (Vec<Vec3>, Vec<[u32; 3]>) {
    let at = |i: u32| {
        let (turn, y) = ((i % n) as f32 / n as f32 * std::f32::consts::TAU, (i / n) as f32);
        let radius = 0.3 + 0.02 * (5.0 * turn).sin();
        Vec3::new(radius * turn.cos(), 1.0 - 0.8 * y / n as f32, radius * turn.sin())
    };
    let next = |i: u32| i - i % n + (i + 1) % n;
    let cell = |i: u32| [[i, next(i), i + n], [next(i), next(i) + n, i + n]];
    let triangles = (0..n * (n - 1)).flat_map(cell).collect();
    ((0..n * n).map(at).collect(), triangles)
}

#[test]
fn a_decimated_tube_is_a_tube_still() {
    let (positions, triangles) = tube(30);
    let coarse = coarsen::coarsen(&positions, &triangles, 80);
    assert!((80..=84).contains(&coarse.vertices.len()), "{}", coarse.vertices.len());
    let points = coarse.vertices.iter().map(|v| positions[*v as usize]).collect();
    let mesh = Mesh::new(points, coarse.triangles).unwrap();
    let euler =
        mesh.vertex_count() as i64 - mesh.edges().len() as i64 + mesh.triangles().len() as i64;
    assert_eq!(euler, 0, "a cylinder");
    let boundary = 3 * mesh.triangles().len() - 2 * mesh.hinges().len();
    assert!(boundary >= 8, "both ends are open: {boundary}");
    let area = |m: &Mesh| m.rest_areas().iter().sum::<f32>();
    let whole = Mesh::new(positions, triangles).unwrap();
    assert!((area(&mesh) / area(&whole) - 1.0).abs() < 0.12);
}

#[test]
fn a_planted_operator_is_found_and_rows_sum_to_one() {
    let (positions, triangles) = tube(20);
    let coarse = coarsen::coarsen(&positions, &triangles, 40);
    let points = coarse.vertices.iter().map(|v| positions[*v as usize]).collect();
    let mesh = Mesh::new(points, coarse.triangles.clone()).unwrap();
    let lift = fit::lift(&positions, &mesh);
    let m = coarse.vertices.len();
    assert!(lift.chunks(m).all(|row| (row.iter().sum::<f32>() - 1.0).abs() < 1e-5));
    // States: coarse points at places of a fixed random sequence, fine ones by another operator.
    let mut seed = 1u32;
    let mut random = move || {
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (seed >> 8) as f32 / (1 << 24) as f32 - 0.5
    };
    let planted: Vec<f32> = lift
        .chunks(m)
        .enumerate()
        .flat_map(|(v, row)| {
            let is_coarse = coarse.vertices.binary_search(&(v as u32)).is_ok();
            let bend = if is_coarse { 0.0 } else { 0.2 };
            let mut row = row.to_vec();
            (row[v % m], row[(v + 7) % m]) = (row[v % m] + bend, row[(v + 7) % m] - bend);
            row
        })
        .collect();
    let states: Vec<Vec<f32>> = (0..80)
        .map(|_| {
            let moved: Vec<f32> = (0..3 * m).map(|_| random()).collect();
            let row = |row: &[f32]| {
                [0, 1, 2].map(|a| row.iter().zip(moved.chunks(3)).map(|(u, p)| u * p[a]).sum())
            };
            planted.chunks(m).flat_map(row).collect::<Vec<f32>>()
        })
        .collect();
    let samples = fit::Samples::new(&coarse.vertices, states.iter().map(|s| &s[..]));
    let fitted = fit::fit(&samples, &lift, &vec![0.0; positions.len()]);
    assert!(fitted.held_out_m < 1e-3 && fitted.lift_m > 0.05, "{}", fitted.held_out_m);
    for (row, planted) in fitted.weights.chunks(m).zip(planted.chunks(m)) {
        assert!((row.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        assert!(row.iter().zip(planted).all(|(a, b)| (a - b).abs() < 1e-3));
    }
}

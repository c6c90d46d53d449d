//! The stored upsampler: golden bytes, hostile bytes, what rounding costs, and one frame of it.

use allocation_counter::measure;
use codec::kernel::Set;
use codec::kernel::normals::Faces;
use codec::upsample::{
    Binding, Capsule, Class, Drive, Fabric, Mode, Parts, Pin, Place, Skin, Stepping, Tether,
    Transform, UpsampleError, Upsampler, WHOLE, Weights, Workspace,
};
use proptest::prelude::*;

/// Two by two coarse points, and five by five fine ones that lie bilinearly between them.
const FINE: usize = 5;
/// Of the mode's amplitudes.
const UNIT_M: f32 = 1.0 / 8192.0;

fn grid(n: usize) -> Vec<[f32; 3]> {
    let at = |i: usize| i as f32 / (n - 1) as f32;
    (0..n * n).map(|i| [at(i % n), 1.0 - at(i / n), 0.0]).collect()
}

fn fine_triangles() -> Vec<[u32; 3]> {
    let n = FINE as u32;
    let cells = (0..n * (n - 1)).filter(|i| i % n + 1 < n);
    cells.flat_map(|i| [[i, i + n, i + 1], [i + 1, i + n, i + n + 1]]).collect()
}

fn bilinear() -> Vec<f32> {
    let row = |p: [f32; 3]| {
        let (u, v) = (p[0], 1.0 - p[1]);
        [(1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v]
    };
    grid(FINE).into_iter().flat_map(row).collect()
}

fn skin(vertex: u32, share: u16, binding: Binding) -> Skin {
    let rest = grid(FINE)[vertex as usize];
    Skin { vertex, share, binding, rest, normal: [0.0; 3], floor_m: 0.0 }
}

fn sample(bits: u8) -> Parts {
    let corner = |v: u32| Place { vertices: [v, v, v], weights: [1.0, 0.0] };
    let binding = Binding::new([0, 1, 0, 0], [0.75, 0.25, 0.0, 0.0]);
    Parts {
        points: grid(2),
        triangles: vec![[0, 2, 1], [1, 2, 3]],
        places: [0, 4, 20, 24].map(corner).to_vec(),
        pins: vec![Pin { point: 0, binding: Binding::of(0) }, Pin { point: 1, binding }],
        tethers: vec![],
        capsules: vec![Capsule { joint: 1, ends: [[0.0; 3], [0.0, 0.5, 0.0]], radius: 0.125 }],
        fabric: Fabric {
            density: 0.25,
            stretch: 1000.0,
            weft: None,
            shear: 400.0,
            bend: 0.0,
            friction: 0.5,
            drag: 1.25,
            damping_s: 0.0,
            offset: 0.0,
        },
        stepping: Stepping {
            steps: 2,
            passes: 6,
            sweeps: 4,
            ground: true,
            compression: 0.5,
            damping_per_s: 0.5,
            expansion_m: 0.25,
            spacing_m: 0.0,
            apart_m: 0.0,
        },
        skins: (0..5)
            .map(|v| skin(v, WHOLE, binding))
            .chain((5..10).map(|v| skin(v, WHOLE / 2, Binding::of(0))))
            .collect(),
        modes: vec![Mode {
            frequency_hz: 2.0,
            damping_per_s: 4.0,
            wind_m_s: 8.0,
            unit_m: UNIT_M,
            amplitudes: (0..25).map(|v| if v < 15 { [0, 0] } else { [100, v] }).collect(),
        }],
        classes: vec![Class {
            joint: 1,
            axis: [0.0, 1.0, 0.0],
            threshold_m: 0.125,
            vertices: vec![20, 24],
        }],
        rms_m: 0.0078125,
        max_m: 0.03125,
        weights: Weights::round(4, &bilinear(), bits).unwrap(),
    }
}

/// With what the second version has more.
fn held() -> Parts {
    let mut parts = sample(8);
    parts.stepping.apart_m = 0.0625;
    let binding = Binding::new([0, 1, 0, 0], [0.5, 0.5, 0.0, 0.0]);
    let normal = [0.0, 0.0, 1.0];
    parts.tethers.push(Tether { point: 2, binding, reach_m: 0.25, normal, floor_m: -0.125 });
    parts.skins[9].normal = [0.0, 1.0, 0.0];
    parts.skins[9].floor_m = 0.5;
    parts
}

const IDENTITY: Transform = [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., 0.]];

#[test]
fn the_bytes_are_a_promise() {
    for (bits, expected) in
        [(8, "988 c8131fca14093565"), (12, "1038 c44b3cf73a60216a"), (16, "1088 6641e513fe2f6a67")]
    {
        let bytes = sample(bits).encode().unwrap();
        assert_eq!(Parts::decode(&bytes).unwrap(), sample(bits));
        let head: String = bytes[..34].iter().map(|b| format!("{b:02x}")).collect();
        let golden = concat!(
            "54557073",                 // TUps
            "0100",                     // version 1
            "BB00",                     // bits
            "04000200",                 // points, triangles
            "0200010001000100",         // pins, capsules, modes, classes
            "190000000a00000002000000", // fine vertices, skinned, members of classes
            "0000"                      // the density begins
        );
        assert_eq!(head, golden.replace("BB", &format!("{bits:02x}")));
        // FNV-1a of all bytes.
        let digest = bytes.iter().fold(0xcbf2_9ce4_8422_2325u64, |h, b| {
            (h ^ u64::from(*b)).wrapping_mul(0x0100_0000_01b3)
        });
        assert_eq!(format!("{} {digest:016x}", bytes.len()), expected);
    }
}

#[test]
fn every_truncation_and_every_flipped_byte_is_survived() {
    for parts in [sample(8), sample(11), sample(13), sample(16), held()] {
        let bytes = parts.encode().unwrap();
        for end in 0..bytes.len() {
            assert!(Parts::decode(&bytes[..end]).is_err(), "cut to {end}");
        }
        assert!(Parts::decode(&[&bytes[..], &[0]].concat()).is_err(), "a byte too many");
        for index in 0..bytes.len() {
            for mask in [0x01, 0x80, 0xff] {
                let mut damaged = bytes.clone();
                damaged[index] ^= mask;
                if let Ok(upsampler) = Upsampler::decode(&damaged) {
                    assert!(index >= 32, "a damaged count or magic was believed: {index}");
                    frame(&upsampler, Set::Scalar);
                }
            }
        }
    }
}

#[test]
fn what_makes_no_sense_is_refused_by_name() {
    type Spoil = fn(&mut Parts);
    let spoils: [(&str, Spoil); 13] = [
        ("tether 0", |p| p.tethers = vec![Tether { point: 0, ..held().tethers[0] }]),
        ("tether 0", |p| p.tethers = vec![Tether { reach_m: -1.0, ..held().tethers[0] }]),
        ("tether 1", |p| p.tethers = vec![held().tethers[0]; 2]),
        ("skinned vertex 9", |p| p.skins[9].normal = [1.0, 1.0, 0.0]),
        ("pin 1", |p| p.pins[1].point = 0),
        ("pin 0", |p| p.pins[0].binding.shares[0] = 7),
        ("place 2", |p| p.places[2].vertices[1] = 25),
        ("coarse triangle 1", |p| p.triangles[1] = [1, 1, 2]),
        ("skinned vertex 9", |p| p.skins[9].vertex = 25),
        ("mode 0", |p| p.modes[0].frequency_hz = f32::NAN),
        ("class 0", |p| p.classes[0].vertices.clear()),
        ("constant", |p| p.stepping.steps = 0),
        ("row of weights 3", |p| p.weights.units[3] = 0.0),
    ];
    for (part, spoil) in spoils {
        let mut parts = sample(16);
        spoil(&mut parts);
        let error = parts.encode().unwrap_err().to_string();
        assert!(error.contains(part), "{error:?} should speak of {part:?}");
    }
    assert!(matches!(Parts::decode(b"TBgX"), Err(UpsampleError::Magic(_))));
    let mut newer = sample(16).encode().unwrap();
    newer[4] = 3;
    assert_eq!(Parts::decode(&newer), Err(UpsampleError::Version(3)));
    assert!(Weights::round(4, &[0.0; 8], 7).is_err() && Weights::round(4, &[0.0; 7], 12).is_err());
}

#[test]
fn the_second_version_is_a_promise_as_well() {
    let bytes = held().encode().unwrap();
    assert_eq!(Parts::decode(&bytes).unwrap(), held());
    assert_eq!(bytes[4..6], [2, 0]);
    // What keeps apart, and one tether, after the first version's header.
    assert_eq!(bytes[96..104], [0, 0, 0x80, 0x3d, 1, 0, 0, 0]);
    assert_eq!(bytes.len(), sample(8).encode().unwrap().len() + 8 + 38 + 16 * 10);
}

#[test]
fn what_is_held_comes_with_the_skin_and_stays_above_its_floor() {
    let upsampler = Upsampler::new(held()).unwrap();
    let (free, _) = frame(&Upsampler::new(sample(8)).unwrap(), Set::Scalar);
    let (guarded, _) = frame(&upsampler, Set::Scalar);
    // Vertex 9 is half on joint 0, which rests, and half 2 m higher; its floor is half a metre up.
    let rest = grid(FINE)[9];
    assert!((free[28] - rest[1] - 1.0).abs() < 1e-3, "{}", free[28]);
    assert_eq!(guarded[28].to_bits(), free[28].to_bits(), "it is above already");
    let mut parts = held();
    parts.skins[9].floor_m = 1.5;
    let (lifted, _) = frame(&Upsampler::new(parts).unwrap(), Set::Scalar);
    assert!((lifted[28] - rest[1] - 1.5).abs() < 1e-3, "{}", lifted[28]);
    assert!((lifted[27] - free[27]).abs() < 1e-6);
    let raised = [[1., 0., 0., 0.], [0., 1., 0., 1.], [0., 0., 1., 0.]];
    let mut found = Vec::new();
    upsampler.tethers(&[IDENTITY, raised], &mut found);
    assert_eq!(found.len(), 1);
    let corner = grid(2)[2];
    assert!((found[0].at[1] - corner[1] - 0.5).abs() < 1e-4 && found[0].normal[2] > 0.999);
}

/// One frame: points moved by (1, 2, 3), joint 1 lifted by 1 m.
fn frame(upsampler: &Upsampler, set: Set) -> (Vec<f32>, Vec<f32>) {
    let faces = Faces::new(upsampler.fine(), fine_triangles()).unwrap();
    let coarse: Vec<f32> =
        grid(2).iter().flat_map(|p| [p[0] + 1.0, p[1] + 2.0, p[2] + 3.0]).collect();
    let mut joints = vec![IDENTITY; upsampler.joints()];
    if let Some(lifted) = joints.get_mut(1) {
        lifted[1][3] = 1.0;
    }
    let mut workspace = Workspace::default();
    let (mut positions, mut normals) = (vec![0.0; 75], vec![0.0; 75]);
    workspace.advance(upsampler, 0.0, 8.0);
    let drive = Drive { coarse_m: &coarse, joints: &joints };
    let out = (&mut positions[..], &mut normals[..]);
    let applied = upsampler.apply_with(set, &drive, &faces, &mut workspace, out);
    if applied.is_err() {
        positions.fill(0.0);
    }
    (positions, normals)
}

#[test]
fn a_frame_is_u_p_and_goes_over_into_skinning() {
    let upsampler = Upsampler::new(sample(16)).unwrap();
    let (positions, normals) = frame(&upsampler, Set::detect());
    let (points, _) = positions.as_chunks::<3>();
    for (v, (p, rest)) in points.iter().zip(grid(FINE)).enumerate() {
        let moved = [rest[0] + 1.0, rest[1] + 2.0, rest[2] + 3.0];
        // Rows 0 to 4 are skin (a quarter of joint 1's metre); 5 to 9 half of it.
        let expected = match v {
            0..5 => [rest[0], rest[1] + 0.25, rest[2]],
            5..10 => std::array::from_fn(|a| 0.5 * (moved[a] + rest[a])),
            _ => moved,
        };
        for (x, e) in p.iter().zip(expected) {
            assert!((x - e).abs() < 1e-4, "{v}: {p:?} {expected:?}");
        }
    }
    let (normals, _) = normals.as_chunks::<3>();
    assert!((normals[22][2] - 1.0).abs() < 1e-4, "{:?}", normals[22]);
    let mut coarse = [0.0; 12];
    upsampler.restrict(&positions, &mut coarse).unwrap();
    assert_eq!(coarse[9..], positions[72..]);
    let mut pins = Vec::new();
    let mut lifted = IDENTITY;
    lifted[1][3] = 1.0;
    upsampler.pins(&[IDENTITY, lifted], &mut pins);
    assert!(pins[0].iter().zip([0.0, 1.0, 0.0]).all(|(a, b)| (a - b).abs() < 1e-6));
    assert!((pins[1][1] - 1.25).abs() < 1e-4);
}

#[test]
fn modes_swing_at_their_frequency_and_follow_the_wind() {
    let upsampler = Upsampler::new(sample(16)).unwrap();
    let faces = Faces::new(25, fine_triangles()).unwrap();
    let coarse: Vec<f32> = grid(2).concat();
    let mut workspace = Workspace::default();
    let (mut out, joints) = (vec![0.0; 75], [IDENTITY; 2]);
    let mut at = |seconds: f32, wind: f32, steps: u32| {
        (0..steps).for_each(|_| workspace.advance(&upsampler, seconds, wind));
        let drive = Drive { coarse_m: &coarse, joints: &joints };
        upsampler.apply(&drive, &faces, &mut workspace, &mut out, &mut []).unwrap();
        out[3 * 20 + 2]
    };
    assert!(at(0.0, 8.0, 1).abs() < 1e-5, "no wind has blown yet");
    // Long in the wind: amplitude 1, a whole number of turns; then an eighth of a second further.
    let (whole, quarter) = (at(0.5, 8.0, 40), at(0.125, 8.0, 1));
    let unit = UNIT_M;
    assert!((whole - 20.0 * unit).abs() < 1e-4, "the cosine: {whole}");
    assert!((quarter - 100.0 * unit).abs() < 1e-4, "the sine: {quarter}");
    let half = at(0.5, 4.0, 40);
    assert!((half.abs() - 0.5 * 100.0 * unit).abs() < 1e-4, "half the wind: {half}");
    assert!(at(0.5, 0.0, 40).abs() < 1e-5, "a calm");
}

#[test]
fn a_warm_frame_allocates_nothing_and_all_sets_agree() {
    let upsampler = Upsampler::new(sample(12)).unwrap();
    let twin = frame(&upsampler, Set::Scalar);
    for set in Set::available() {
        assert_eq!(frame(&upsampler, *set), twin, "{set:?}");
    }
    let faces = Faces::new(25, fine_triangles()).unwrap();
    let (coarse, joints) = (grid(2).concat(), [IDENTITY; 2]);
    let (mut out, mut normals, mut back) = (vec![0.0; 75], vec![0.0; 75], vec![0.0; 12]);
    let (mut workspace, mut pins) = (Workspace::default(), Vec::new());
    let mut step = || {
        workspace.advance(&upsampler, 0.02, 5.0);
        let drive = Drive { coarse_m: &coarse, joints: &joints };
        upsampler.apply(&drive, &faces, &mut workspace, &mut out, &mut normals).unwrap();
        upsampler.restrict(&out, &mut back).unwrap();
        upsampler.pins(&joints, &mut pins);
    };
    step();
    let asked = measure(|| (0..20).for_each(|_| step()));
    assert_eq!(asked.count_total, 0, "allocations in 20 frames");
}

proptest! {
    /// What rounding to `bits` costs is bounded by half a step a weight and the box's half extent.
    #[test]
    fn rounding_costs_at_most_half_a_step_a_weight(
        weights in proptest::collection::vec(-1.0f32..1.0, 25 * 4),
        bits in 8u8..=16,
    ) {
        let mut rows = weights;
        for row in rows.chunks_mut(4) {
            let sum: f32 = row[..3].iter().sum();
            row[3] = 1.0 - sum;
        }
        let mut parts = sample(bits);
        parts.skins.clear();
        parts.modes.clear();
        parts.weights = Weights::round(4, &rows, bits).unwrap();
        let most = parts.weights.units.iter().fold(0.0f32, |m, u| m.max(*u));
        let stored = Parts::decode(&parts.encode().unwrap()).unwrap();
        let upsampler = Upsampler::new(stored).unwrap();
        let (positions, _) = frame(&upsampler, Set::detect());
        for (row, p) in rows.chunks(4).zip(positions.chunks(3)) {
            for axis in 0..3 {
                let exact: f32 = row.iter().zip(grid(2)).map(|(w, q)| w * q[axis]).sum();
                let exact = exact + [1.0, 2.0, 3.0][axis];
                // Four weights, half an extent of 0.5 m; positions are rounded to 16 bits besides.
                let bound = 4.0 * 0.5 * most * 0.5 + 4.0 * 2e-5 + 1e-5;
                prop_assert!((p[axis] - exact).abs() <= bound, "{} {exact} {bound}", p[axis]);
            }
        }
    }

    /// Along positions in which points move together, rounding loses a fraction of what it does weight
    /// by weight; against any others it is no worse than a few steps.
    #[test]
    fn rounding_along_what_points_do_loses_less(seed in 0u32..1000) {
        let (coarse, fine, frames) = (40usize, 60usize, 50usize);
        let mut state = seed.wrapping_mul(2_654_435_761).wrapping_add(1);
        let mut chance = move || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(state >> 8) / f64::from(1u32 << 23) - 1.0
        };
        // A string that swings in four ways.
        let swing = |way: usize, point: usize| {
            ((way + 1) as f64 * 1.7 * point as f64 / coarse as f64).cos()
        };
        let positions: Vec<Vec<f64>> = (0..frames)
            .map(|_| {
                let amounts: Vec<f64> = (0..4).map(|_| chance()).collect();
                let at = |p: usize| (0..4).map(|way| amounts[way] * swing(way, p)).sum::<f64>();
                let all: Vec<f64> = (0..coarse).map(at).collect();
                let mean = all.iter().sum::<f64>() / coarse as f64;
                all.into_iter().map(|x| x - mean).collect()
            })
            .collect();
        let gram: Vec<f64> = (0..coarse * coarse)
            .map(|at| positions.iter().map(|p| p[at / coarse] * p[at % coarse]).sum())
            .collect();
        let weights: Vec<f32> = (0..coarse * fine).map(|_| chance() as f32 * 0.1).collect();
        let lost = |w: &Weights, positions: &[Vec<f64>]| -> f64 {
            let off = |row: usize, p: &Vec<f64>| {
                let one = |j: usize| {
                    let at = row * coarse + j;
                    let step = f64::from(w.steps[at]) * f64::from(w.units[row]);
                    (step - f64::from(weights[at])) * p[j]
                };
                (0..coarse).map(one).sum::<f64>().powi(2)
            };
            (0..fine).map(|row| positions.iter().map(|p| off(row, p)).sum::<f64>()).sum()
        };
        let plain = Weights::round(coarse, &weights, 8).unwrap();
        let along = Weights::round_along(coarse, &weights, 8, &gram).unwrap();
        prop_assert!(lost(&along, &positions) < 0.1 * lost(&plain, &positions));
        let any: Vec<Vec<f64>> =
            (0..frames).map(|_| (0..coarse).map(|_| chance()).collect()).collect();
        prop_assert!(lost(&along, &any) < 4.0 * lost(&plain, &any));
        prop_assert!(along.steps.iter().all(|s| s.abs() <= 127));
        let bad = Weights::round_along(coarse, &weights, 8, &gram[1..]);
        prop_assert!(bad.is_err());
    }

    #[test]
    fn several_damaged_bytes_never_panic(
        damage in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..8),
    ) {
        let mut bytes = sample(13).encode().unwrap();
        for (place, byte) in damage {
            let index = place.index(bytes.len());
            bytes[index] = byte;
        }
        let _ = Upsampler::decode(&bytes);
    }
}

//! The run-time face: what it must survive (wind, shaking, fast balls, any step, teleports, any
//! material, long runs), and that it hangs, swings and rests as cloth does.
//!
//! Every threshold is derived from the scene, never from what the solver did: see the constants.

use allocation_counter::measure;
use cloth::coarse::{Capsule, Coarse, CoarseError, Input, Moving, Settings, Tether, Workspace};
use cloth::{Environment, Material, Mesh, State, Vec3};
use rand_core::Rng;
use rand_pcg::Pcg64Mcg;

const DT: f32 = 1.0 / 60.0;
const GRAVITY: f32 = 9.81;
/// What counts as rest (m/s).
const REST_M_S: f32 = 0.1;
/// Seconds after which it must be reached, whatever happened. A sheet of 1 m goes fastest after a fall
/// from straight up to straight down, sqrt(2 g 2 m) = 6.3 m/s (what is faster, air stops at once);
/// the default damping of 0.5 a second takes half of that from a swing's amplitude, so its speed falls
/// as exp(-t / 4 s): ln(6.3 / 0.1) * 4 s.
const REST_S: f32 = 16.6;
/// However it comes to hang (wound about itself too: it does not meet itself), no edge can carry more than
/// the whole sheet: its weight, 0.2 * 9.81 N, on the width of one edge, 1/13 m, of 1000 N/m.
const REST_STRETCH: f32 = 0.2 * GRAVITY * 13.0 / 1000.0;

/// A hanging sheet of n x n points and one square metre, held along its top edge.
struct Flag {
    model: Coarse,
    state: State,
    workspace: Workspace,
    pins: Vec<Vec3>,
    n: u32,
}

fn sheet(n: u32) -> Mesh {
    let at = |i: u32| {
        Vec3::new((i % n) as f32 / (n - 1) as f32, 2.0 - (i / n) as f32 / (n - 1) as f32, 0.0)
    };
    let cell = |i: u32| [[i, i + n, i + 1], [i + 1, i + n, i + n + 1]];
    let cells = (0..n * (n - 1)).filter(|i| i % n + 1 < n);
    Mesh::new((0..n * n).map(at).collect(), cells.flat_map(cell).collect()).unwrap()
}

impl Flag {
    fn new(n: u32, material: Material) -> Self {
        let pinned: Vec<u32> = (0..n).collect();
        let environment = Environment::default();
        let settings = Settings::default();
        let model = Coarse::new(sheet(n), material, environment, &pinned, settings).unwrap();
        let state = model.rest_state();
        let pins = state.positions[..n as usize].to_vec();
        Self { model, state, workspace: Workspace::default(), pins, n }
    }

    fn step(&mut self, seconds: f32, wind: Vec3, colliders: &[Moving]) {
        let input = Input { pins: &self.pins, colliders, wind, push: &[], tethers: &[], seconds };
        self.model.step(&input, &mut self.state, &mut self.workspace).unwrap();
    }

    /// Largest distance of a point from the pins' middle (m).
    fn extent(&self) -> f32 {
        let middle = self.pins.iter().sum::<Vec3>() / self.pins.len() as f32;
        let far = |p: &Vec3| if p.is_finite() { p.distance(middle) } else { f32::INFINITY };
        self.state.positions.iter().map(far).fold(0.0, f32::max)
    }

    /// Largest stretch of an edge.
    fn stretch(&self) -> f32 {
        let mesh = self.model.mesh();
        let x = &self.state.positions;
        let one =
            |(e, rest): (&[u32; 2], &f32)| x[e[0] as usize].distance(x[e[1] as usize]) / rest - 1.0;
        mesh.edges().iter().zip(mesh.rest_lengths()).map(one).fold(0.0, f32::max)
    }

    fn speed(&self) -> f32 {
        self.state.velocities.iter().map(|v| v.length()).fold(0.0, f32::max)
    }

    /// Lets it hang in calm air; returns the seconds until nothing moves faster than `REST_M_S`.
    fn rest(&mut self, most_s: f32) -> f32 {
        let steps = (most_s / DT) as u32;
        let mut since = 0;
        for step in 0..steps {
            self.step(DT, Vec3::ZERO, &[]);
            if self.speed() > REST_M_S {
                since = step + 1;
            }
        }
        since as f32 * DT
    }
}

/// A sheet of 1 m held along 1 m: half of that to the last pin, and from there the sheet at the strain
/// limit of a tenth (m); a millimetre for rounding.
const EXTENT_MAX: f32 = 0.5 + 1.1 + 0.001;

#[test]
fn a_hanging_sheet_stretches_by_its_weight_and_no_more() {
    let mut flag = Flag::new(14, Material { drag: 8.0, ..Material::default() });
    for _ in 0..600 {
        flag.step(DT, Vec3::ZERO, &[]);
    }
    let lowest = flag.state.positions.iter().map(|p| p.y).fold(f32::INFINITY, f32::min);
    // w L^2 / (2 Eh) = 0.2 * 9.81 / 2000 m.
    let expected = 0.2 * 9.81 / 2000.0;
    // Masses lumped at the vertices give the same elongation; a tenth is for swinging that is left.
    assert!((1.0 - lowest - expected).abs() < 0.1 * expected, "{lowest}");
}

#[test]
fn a_swinging_sheet_never_gains_energy_and_keeps_its_size() {
    for n in [7, 14] {
        let mut flag = Flag::new(n, Material { drag: 0.0, ..Material::default() });
        // Held level, let go.
        for (i, p) in flag.state.positions.iter_mut().enumerate() {
            *p = Vec3::new(p.x, 2.0, (i as u32 / n) as f32 / (n - 1) as f32);
        }
        let first = flag.model.energy(&flag.state);
        let (mut energy, mut lowest) = (first, f32::INFINITY);
        for step in 0..240 {
            flag.step(DT, Vec3::ZERO, &[]);
            energy = flag.model.energy(&flag.state);
            // It began unstretched and at rest, so motion and height never have more than at first;
            // 0.1 % of its weight times its length a second for rounding.
            let rounding = 0.001 * 0.2 * GRAVITY * (step + 1) as f32 * DT;
            assert!(energy <= first + rounding, "{n} {step}: {first} {energy} J");
            lowest = flag.state.positions.iter().fold(lowest, |l, p| l.min(p.y));
        }
        // Its lower edge passes straight below the pins, 1 m, no lower than the strain limit; between
        // two frames it goes 6.3 m/s * DT at most, so that one of them is this near to the lowest point.
        let missed = 0.5 * (6.3 * DT).powi(2);
        assert!(energy < first && (0.9 - 1e-3..=1.0 + missed).contains(&lowest), "{n}: {lowest} m");
    }
}

#[test]
fn strong_wind_and_a_shaken_pole_leave_it_bounded_and_it_comes_to_rest() {
    let mut flag = Flag::new(14, Material::default());
    // The air presses with 0.5 rho Cd w^2 on a metre of cloth that stretches by 1 m per 1000 N/m, the
    // pole pulls with its mass times 0.15 m (2 pi 5 Hz)^2.
    let (wind_m_s, shaken_m_s) = (33.6f32, 0.15 * std::f32::consts::TAU * 5.0);
    let pressure = 0.5 * 1.225 * 1.28 * wind_m_s * wind_m_s;
    let pull = 0.2 * shaken_m_s * std::f32::consts::TAU * 5.0;
    let stretch_max = (pressure + pull) / 1000.0;
    // Nothing drives a point faster than air, pole and a fall from straight up to straight down.
    let speed_max = wind_m_s + shaken_m_s + (2.0 * GRAVITY * 2.0f32).sqrt();
    let energy_max = 0.5 * 0.2 * speed_max * speed_max + 0.2 * GRAVITY * (2.0 + EXTENT_MAX);
    for step in 0..600 {
        let t = step as f32 * DT;
        // Four times a strong breeze of 8 m/s, and a pole shaken by 15 cm at 5 Hz.
        flag.step(DT, Vec3::new(10.0 * t.sin(), 0.0, 32.0), &[]);
        let sway = 0.15 * (std::f32::consts::TAU * 5.0 * t).sin();
        for (i, pin) in flag.pins.iter_mut().enumerate() {
            *pin = Vec3::new(i as f32 / 13.0 + sway, 2.0, 0.0);
        }
        assert!(flag.extent() < EXTENT_MAX, "{step}: {}", flag.extent());
        assert!(flag.stretch() < stretch_max, "{step}: {}", flag.stretch());
        let energy = flag.model.energy(&flag.state);
        assert!(energy < energy_max, "{step}: {energy} J of {energy_max} J");
    }
    let seconds = flag.rest(25.0);
    assert!(seconds < REST_S, "still moving after {seconds} s");
}

#[test]
fn a_ball_of_thirty_metres_a_second_takes_it_along_not_apart() {
    for dt in [1.0 / 20.0, 1.0 / 60.0, 1.0 / 240.0] {
        let mut flag = Flag::new(14, Material::default());
        for step in 0..(2.0 / dt) as i32 {
            let at = |s: f32| Vec3::new(0.5, 1.5, -3.0 + 30.0 * s * dt);
            let ball = |s| Capsule::sphere(at(s), 0.15);
            let moving = Moving { from: ball(step as f32), to: ball(step as f32 + 1.0) };
            flag.step(dt, Vec3::ZERO, &[moving]);
            assert!(flag.extent() < EXTENT_MAX, "{dt} {step}: {}", flag.extent());
        }
        let seconds = flag.rest(25.0);
        assert!(seconds < REST_S, "{dt}: still moving after {seconds} s");
        assert!(flag.stretch() < REST_STRETCH, "{dt}: {}", flag.stretch());
    }
}

#[test]
fn a_sheet_dropped_on_a_sphere_stays_outside_of_it() {
    let n = 14;
    let settings = Settings { expansion_m: 0.01, ..Settings::default() };
    let material = Material::default();
    let environment = Environment { ground: true, ..Environment::default() };
    let model = Coarse::new(sheet(n), material, environment, &[], settings).unwrap();
    let mut state = model.rest_state();
    for (i, p) in state.positions.iter_mut().enumerate() {
        *p = Vec3::new(p.x - 0.5, 0.85, (i as u32 / n) as f32 / (n - 1) as f32 - 0.5);
    }
    let ball = Moving::resting(Capsule::sphere(Vec3::new(0.0, 0.5, 0.0), 0.3));
    let mut workspace = Workspace::default();
    for step in 0..600 {
        let input = Input {
            pins: &[],
            colliders: &[ball],
            wind: Vec3::ZERO,
            push: &[],
            tethers: &[],
            seconds: DT,
        };
        model.step(&input, &mut state, &mut workspace).unwrap();
        for p in &state.positions {
            let depth = 0.3 - p.distance(Vec3::new(0.0, 0.5, 0.0));
            // The offset and the expansion are kept, so the sphere itself is never touched.
            assert!(depth <= 0.0 && p.y > 0.0, "{step}: {depth} m deep");
        }
    }
    let speed = state.velocities.iter().map(|v| v.length()).fold(0.0, f32::max);
    assert!(speed < REST_M_S, "it lies still: {speed} m/s");
}

#[test]
fn any_length_of_step_and_any_material_stay_bounded() {
    let m = Material::default;
    let materials = [
        Material { stretch: 1e5, shear: 4e4, bend: 1e-2, ..m() },
        Material { stretch: 10.0, shear: 3.0, bend: 0.0, ..m() },
        Material { density: 0.05, stretch: 2000.0, weft: Some(200.0), ..m() },
        Material { density: 0.6, drag: 20.0, ..m() },
    ];
    for material in materials {
        for dt in [1.0 / 20.0, 1.0 / 30.0, 1.0 / 120.0, 1.0 / 240.0] {
            let mut flag = Flag::new(10, material);
            for step in 0..(3.0 / dt) as i32 {
                let t = step as f32 * dt;
                flag.step(dt, Vec3::new(0.0, 3.0, 15.0 * (2.0 * t).sin()), &[]);
                assert!(flag.extent() < EXTENT_MAX, "{material:?} {dt} {t}: {}", flag.extent());
            }
        }
    }
}

#[test]
fn a_teleport_takes_the_cloth_along() {
    let mut flag = Flag::new(14, Material::default());
    for _ in 0..60 {
        flag.step(DT, Vec3::new(1.0, 0.0, 5.0), &[]);
    }
    flag.rest(3.0);
    let before = flag.state.clone();
    let far = Vec3::new(100.0, -20.0, 300.0);
    // A step goes on as it would have: its speed, and what gravity adds if nothing holds it.
    let speed_max = flag.speed() + GRAVITY * DT;
    flag.pins.iter_mut().for_each(|p| *p += far);
    flag.step(DT, Vec3::ZERO, &[]);
    for (p, old) in flag.state.positions.iter().zip(&before.positions) {
        assert!((*p - *old - far).length() < speed_max * DT + 1e-4, "{p} {old}");
    }
    assert!(flag.speed() <= speed_max, "{}", flag.speed());
    // Turned on the spot as well: bounded, and at rest again soon.
    let middle = flag.pins.iter().sum::<Vec3>() / 14.0;
    flag.pins.iter_mut().for_each(|p| *p = middle - (*p - middle));
    flag.step(DT, Vec3::ZERO, &[]);
    assert!(flag.extent() < EXTENT_MAX, "{}", flag.extent());
    let seconds = flag.rest(25.0);
    assert!(seconds < REST_S && flag.stretch() < REST_STRETCH, "{seconds} {}", flag.stretch());
}

#[test]
fn pins_torn_apart_leave_numbers() {
    let mut flag = Flag::new(14, Material::default());
    for (i, pin) in flag.pins.iter_mut().enumerate() {
        pin.x += 10.0 * i as f32;
    }
    (0..30).for_each(|_| flag.step(DT, Vec3::ZERO, &[]));
    assert!(flag.extent() < 200.0, "{}", flag.extent());
}

/// Random wind, shaking, balls, lengths of step and teleports; bounded at every step.
fn unattended(n: u32, steps: u32) {
    let mut rng = Pcg64Mcg::new(5);
    let mut unit = move || (rng.next_u32() >> 8) as f32 / (1 << 24) as f32;
    let mut flag = Flag::new(n, Material::default());
    let (mut wind, mut dt, mut ball) = (Vec3::ZERO, DT, Vec3::new(0.5, 1.4, -50.0));
    let mut speed = Vec3::ZERO;
    for step in 0..steps {
        if step % 97 == 0 {
            wind = Vec3::new(unit() - 0.5, 0.3 * (unit() - 0.5), unit() - 0.5) * 64.0;
            dt = 1.0 / (20.0 + 220.0 * unit());
        }
        if step % 211 == 0 {
            ball = Vec3::new(unit(), 1.0 + unit(), -3.0) + flag.pins[0];
            speed = Vec3::new(0.0, 0.0, 30.0 * unit());
        }
        if step % 5003 == 0 {
            let far = Vec3::new(unit(), unit(), unit()) * 100.0 - 50.0;
            flag.pins.iter_mut().for_each(|p| *p += far);
        }
        let sway = 0.1 * (step as f32 * 0.5).sin() - 0.1 * ((step as f32 - 1.0) * 0.5).sin();
        flag.pins.iter_mut().for_each(|p| p.x += sway);
        let to = ball + speed * dt;
        let moving = Moving { from: Capsule::sphere(ball, 0.1), to: Capsule::sphere(to, 0.1) };
        ball = to;
        flag.step(dt, wind, &[moving]);
        assert!(flag.extent() < EXTENT_MAX && flag.speed() <= 40.001, "{step}: {}", flag.extent());
    }
    let seconds = flag.rest(25.0);
    assert!(seconds < REST_S && flag.stretch() < REST_STRETCH, "{seconds} s, {}", flag.stretch());
}

#[test]
fn a_hundred_thousand_steps_unattended() {
    unattended(5, 100_000);
}

#[test]
#[ignore = "half a minute; run with --ignored"]
fn a_hundred_thousand_steps_of_196_points_unattended() {
    unattended(14, 100_000);
}

#[test]
fn equal_inputs_give_equal_bits_and_nothing_is_allocated() {
    let run = |warm: u32| {
        let mut flag = Flag::new(9, Material::default());
        let mut workspace = Workspace::default();
        for _ in 0..warm {
            // A workspace that served another length of step before.
            let mut other = flag.state.clone();
            let (pins, wind) = (&flag.pins[..], Vec3::Z);
            let input =
                Input { pins, colliders: &[], wind, push: &[], tethers: &[], seconds: 0.03 };
            flag.model.step(&input, &mut other, &mut workspace).unwrap();
        }
        flag.workspace = workspace;
        let ball = Moving::resting(Capsule::sphere(Vec3::new(0.4, 1.3, 0.05), 0.2));
        flag.step(DT, Vec3::new(1.0, 0.0, 6.0), &[ball]);
        let asked = measure(|| {
            for _ in 0..50 {
                flag.step(DT, Vec3::new(1.0, 0.0, 6.0), &[ball]);
            }
        });
        assert_eq!(asked.count_total, 0, "allocations in 50 steps");
        assert_eq!(flag.n, 9);
        flag.state
    };
    assert_eq!(run(0), run(3));
}

#[test]
fn what_makes_no_sense_is_refused_and_changes_nothing() {
    let pinned = [3, 2];
    let made = |pins: &[u32], settings: Settings| {
        Coarse::new(sheet(5), Material::default(), Environment::default(), pins, settings).err()
    };
    assert_eq!(made(&pinned, Settings::default()), Some(CoarseError::Pinned(2)));
    assert_eq!(made(&[25], Settings::default()), Some(CoarseError::Pinned(25)));
    let bad = Settings { compression: f32::NAN, ..Settings::default() };
    assert!(matches!(made(&[], bad), Some(CoarseError::Settings(_))));
    let mut flag = Flag::new(5, Material::default());
    let before = flag.state.clone();
    let good = Input {
        pins: &flag.pins,
        colliders: &[],
        wind: Vec3::ZERO,
        push: &[],
        tethers: &[],
        seconds: DT,
    };
    let ball = [Moving::resting(Capsule::sphere(Vec3::NAN, 0.1))];
    let pins = vec![Vec3::splat(f32::INFINITY); 5];
    for input in [
        Input { pins: &[], ..good },
        Input { pins: &pins, ..good },
        Input { colliders: &ball, ..good },
        Input { wind: Vec3::NAN, ..good },
        Input { push: &[Vec3::ZERO], ..good },
        Input { seconds: 0.0, ..good },
        Input { seconds: f32::NAN, ..good },
    ] {
        let refused = flag.model.step(&input, &mut flag.state, &mut flag.workspace);
        assert!(refused.is_err(), "{input:?}");
        assert_eq!(flag.state, before);
    }
}

#[test]
fn a_thin_rod_does_not_slip_between_the_points() {
    // Points 33 cm apart, a rod of 4 cm through the middle of a cell at 3 m/s: with places along the
    // edges it takes the sheet along, by its radius at least; without, it goes through.
    for (spacing_m, takes_along) in [(0.0, false), (0.05, true)] {
        let mut flag = Flag::new(4, Material::default());
        let settings = Settings { spacing_m, ..Settings::default() };
        let pinned: Vec<u32> = (0..4).collect();
        let environment = Environment::default();
        flag.model =
            Coarse::new(sheet(4), Material::default(), environment, &pinned, settings).unwrap();
        let rod = |step: i32| {
            let z = -0.3 + 0.05 * step as f32;
            Capsule { ends: [Vec3::new(-1.0, 1.5, z), Vec3::new(2.0, 1.5, z)], radius: 0.02 }
        };
        let mut ahead = 0.0f32;
        for step in 0..10 {
            flag.step(DT, Vec3::ZERO, &[Moving { from: rod(step), to: rod(step + 1) }]);
            let middle = flag.state.positions[5..7].iter().chain(&flag.state.positions[9..11]);
            ahead = middle.map(|p| p.z).sum::<f32>() / 4.0 - rod(step + 1).ends[0].z;
        }
        assert_eq!(ahead > 0.0, takes_along, "{spacing_m}: {ahead} m before the rod");
    }
}

#[test]
fn a_tether_holds_a_point_in_its_room_and_on_its_side() {
    let mut flag = Flag::new(8, Material::default());
    let (corner, wind) = (63, Vec3::new(0.0, 0.0, 12.0));
    let at = flag.state.positions[corner];
    let tether =
        Tether { point: corner as u32, at, reach_m: 0.1, normal: Vec3::NEG_Z, floor_m: -0.02 };
    for _ in 0..120 {
        let (pins, tethers) = (&flag.pins[..], &[tether][..]);
        let input = Input { pins, colliders: &[], wind, push: &[], tethers, seconds: DT };
        flag.model.step(&input, &mut flag.state, &mut flag.workspace).unwrap();
        let off = flag.state.positions[corner] - at;
        assert!(off.length() <= 0.1 + 1e-5 && off.z <= 0.02 + 1e-5, "{off}");
    }
    assert!(flag.state.positions[60].z > 0.1, "what is not held flies");
    // One that is pinned is led, whatever holds it.
    let led = Tether { point: 0, at: at + Vec3::X, ..tether };
    let (pins, tethers) = (&flag.pins[..], &[led][..]);
    let input = Input { pins, colliders: &[], wind, push: &[], tethers, seconds: DT };
    flag.model.step(&input, &mut flag.state, &mut flag.workspace).unwrap();
    assert!(flag.state.positions[0].distance(flag.pins[0]) < 1e-6);
    for bad in [
        Tether { point: 64, ..tether },
        Tether { at: Vec3::NAN, ..tether },
        Tether { reach_m: -1.0, ..tether },
        Tether { normal: Vec3::splat(2.0), ..tether },
        Tether { floor_m: f32::INFINITY, ..tether },
    ] {
        let input = Input { tethers: &[bad], ..input };
        let refused = flag.model.step(&input, &mut flag.state, &mut flag.workspace);
        assert!(matches!(refused, Err(CoarseError::Unsound { what: "tether", .. })), "{bad:?}");
    }
}

/// Two sheets, one above the other, that are thrown at each other.
#[test]
fn layers_that_keep_apart_do_not_pass_through_each_other() {
    const N: u32 = 8;
    let lower = sheet(N);
    let flat = |p: &Vec3, y: f32| Vec3::new(p.x, y, p.y);
    let mut points: Vec<Vec3> = lower.rest_positions().iter().map(|p| flat(p, 1.0)).collect();
    points.extend(lower.rest_positions().iter().map(|p| flat(p, 1.3)));
    let mut triangles = lower.triangles().to_vec();
    triangles.extend(lower.triangles().iter().map(|t| t.map(|v| v + N * N)));
    let mesh = Mesh::new(points, triangles).unwrap();
    let environment = Environment { gravity: Vec3::ZERO, ..Environment::default() };
    let lowest_gap = |apart_m: f32| {
        let settings = Settings { apart_m, ..Settings::default() };
        let material = Material { drag: 0.0, ..Material::default() };
        let model = Coarse::new(mesh.clone(), material, environment, &[], settings).unwrap();
        let mut state = model.rest_state();
        let (half, mut workspace) = ((N * N) as usize, Workspace::default());
        for (i, v) in state.velocities.iter_mut().enumerate() {
            *v = Vec3::Y * if i < half { 2.0 } else { -2.0 };
        }
        let (none, wind) = (&[][..], Vec3::ZERO);
        let mut least = f32::INFINITY;
        for step in 0..60 {
            let input =
                Input { pins: &[], colliders: &[], wind, push: none, tethers: &[], seconds: DT };
            let run = |state: &mut State, ws: &mut Workspace| model.step(&input, state, ws);
            let asked = measure(|| run(&mut state, &mut workspace).unwrap());
            assert!(step < 20 || asked.count_total == 0, "it allocates");
            let gap = |i: usize| state.positions[half + i].y - state.positions[i].y;
            least = (0..half).map(gap).fold(least, f32::min);
        }
        least
    };
    assert!(lowest_gap(0.0) < -0.3, "they pass through each other if let");
    let least = lowest_gap(0.1);
    assert!(least > 0.05, "{least} m");
}

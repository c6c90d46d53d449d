//! The stability table. The fast part runs with every test; the rest on demand:
//! `cargo test --release -p cloth --test lab -- --ignored`.

use std::time::Instant;

use cloth::lab::{BENCHES, Limit, Report, Row, Settings, find};

/// Figures that miss their threshold today, by bench and beginning of the row, with the worst that each may
/// become and the reason. docs/results/stability.md has the figures. What none of these names must pass.
const KNOWN_MISSES: &[(&str, &str, f64)] = &[
    // The linear solver's iterations end before a stiff panel turns as one piece.
    ("A4", "error of the period from 90 deg", 2.0),
    // What f32 leaves of stiff forces that should cancel; damping acts on turning too.
    ("A12", "linear momentum", 1e-3),
    ("A12", "angular momentum lost per s at 6.28 rad/s, default damping", 35.0),
    // Backward Euler, and wrinkles whose motion it swallows.
    ("A13", "lost in", 17.0),
    ("A13", "loss per halving", 1.5),
    // Cloth of 10 N/m lies against the strain limit, whose last word adds energy.
    ("B3", "fastest vertex of all", 9.3),
    // Single vertices hop.
    ("C1", "ball: speed at the end", 0.4),
    ("C1", "spike: speed at the end", 0.4),
    ("C3", "fastest vertex against the ball", 6.0),
];

fn run(name: &str, quick: bool) -> Report {
    let start = Instant::now();
    let mut clock = || start.elapsed().as_secs_f64();
    let settings = Settings { quick, ..Settings::default() };
    let report = find(name).unwrap().run(settings, &mut clock, &mut |_| true).unwrap();
    println!("{name}: {:.1} s", start.elapsed().as_secs_f64());
    for row in &report.rows {
        let verdict = if row.passes() { "pass" } else { "MISS" };
        println!(
            "  {verdict} {}: {:.5} {}, {:?} ({})",
            row.what, row.figure, row.unit, row.limit, row.reference
        );
    }
    report
}

/// What does not pass and is no known miss within its bound.
fn failures(name: &str, quick: bool) -> Vec<String> {
    let report = run(name, quick);
    assert!(!report.rows.is_empty());
    let known = |row: &Row| {
        let found =
            KNOWN_MISSES.iter().find(|(b, what, _)| *b == name && row.what.starts_with(what));
        found.is_some_and(|(.., worst)| match row.limit {
            Limit::AtMost(_) => row.figure <= *worst,
            Limit::AtLeast(_) => row.figure >= *worst,
        })
    };
    let failed = report.rows.iter().filter(|row| !row.passes() && !known(row));
    failed
        .map(|r| format!("{name}, {}: {} {} against {:?}", r.what, r.figure, r.unit, r.limit))
        .collect()
}

/// Every figure passes, but for known misses.
fn check(name: &str, quick: bool) {
    let failed = failures(name, quick);
    assert!(failed.is_empty(), "{failed:#?}");
}

/// Where in a substep a rod meets cloth is chance, and so is where its triangles lie. Coarser sheets, with
/// edges of 6 cm, let single vertices pass at 20 m/s.
#[test]
fn a_rod_sweeps_sheets_whatever_their_fineness() {
    for n in [20, 22, 28, 35] {
        let settings = Settings { quick: true, n: Some(n), ..Settings::default() };
        let report = find("C2").unwrap().run(settings, &mut || 0.0, &mut |_| true).unwrap();
        for row in report.rows.iter().filter(|row| row.what.ends_with("passed")) {
            assert!(row.passes(), "{n} vertices a side, {}: {}", row.what, row.figure);
        }
    }
}

macro_rules! benches {
    ($($test:ident $name:literal)*) => {
        $(#[test]
        fn $test() {
            check($name, true);
        })*

        #[test]
        fn every_fast_bench_is_tested() {
            let tested = [$($name),*];
            for bench in BENCHES.iter().filter(|b| b.fast) {
                assert!(tested.contains(&bench.name), "{} has no test", bench.name);
            }
        }
    };
}

benches! {
    a1_free_fall "A1"
    a2_hanging_strip "A2"
    a3_swinging_strip "A3"
    a4_pendulum "A4"
    a5_catenary "A5"
    a6_cantilever "A6"
    a7_fixed_angle "A7"
    a9_terminal_speed "A9"
    a10_incline "A10"
    a12_momentum "A12"
    a13_energy "A13"
    b2_resolution "B2"
    b3_stiffness_sweep "B3"
    b4_bad_meshes "B4"
    d2_restart "D2"
    d3_repeat "D3"
}

#[test]
fn d3_two_threads_give_the_same_bits() {
    let runs: Vec<Report> = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..2).map(|_| scope.spawn(|| run("A12", true))).collect();
        threads.into_iter().map(|t| t.join().unwrap()).collect()
    });
    let bits = |r: &Report| r.rows.iter().map(|row| row.figure.to_bits()).collect::<Vec<_>>();
    assert_eq!(bits(&runs[0]), bits(&runs[1]));
}

#[test]
#[ignore = "minutes: the whole table"]
fn the_whole_table() {
    // What D4 measures is time, and no test's business.
    let benches = BENCHES.iter().filter(|bench| bench.name != "D4");
    let failed: Vec<String> = benches.flat_map(|bench| failures(bench.name, false)).collect();
    assert!(failed.is_empty(), "{failed:#?}");
}

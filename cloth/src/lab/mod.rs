//! The test bench: scenes with known answers, and a figure with its threshold for each.
//!
//! A bench is a plain function over a [`Stage`]: it builds what it needs, lets the stage step it,
//! and says what it found. The stage times every step with the caller's clock, shows every frame
//! to the caller, and measures stretch, depth, crossings and the lowest point on the way. Nothing
//! here reads a clock or a file.
//!
//! Names: A1.. accuracy against analytic answers; B1.. convergence and robustness; C1.. contact;
//! D1.. what a secondary motion graph depends on; S1 and S2 the scenes on which other simulators
//! were measured.

mod bending;
mod contact;
mod drape;
mod energy;
mod fall;
mod hang;
mod mesh_faults;
mod momentum;
mod repeat;
pub mod shapes;
mod sheets;
mod slide;
mod soak;
mod speed;
mod stage;
mod sweep;
mod swing;

pub use stage::{Setting, Settings, Shot, Sim, Stage, Tally};

use crate::mesh::MeshError;
use crate::model::ModelError;
use crate::solver::StepError;

/// A bench.
#[derive(Clone, Copy)]
pub struct Bench {
    /// Its name: a letter and a number.
    pub name: &'static str,
    /// What is simulated.
    pub about: &'static str,
    /// What the answer is compared with.
    pub reference: &'static str,
    /// Whether it belongs to the part that runs with every test.
    pub fast: bool,
    /// What it can be asked for; anything else is refused, not ignored.
    pub reads: &'static [Setting],
    run: fn(&mut Stage<'_>) -> Result<(), LabError>,
}

/// Why a bench could not be run. (A bench that runs and misses its threshold is no error.)
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum LabError {
    /// No bench of that name.
    #[error("there is no bench `{name}`; there are {known}")]
    Unknown {
        /// What was asked for.
        name: String,
        /// What there is.
        known: String,
    },
    /// A parameter out of range.
    #[error("--{name} {value}: give {least} to {most}")]
    Parameter {
        /// Which.
        name: &'static str,
        /// What was given.
        value: f64,
        /// Smallest.
        least: f64,
        /// Largest.
        most: f64,
    },
    /// A parameter that the bench does not read.
    #[error("{bench} does not read --{name}; it reads {reads}")]
    Unread {
        /// The bench.
        bench: &'static str,
        /// The parameter.
        name: &'static str,
        /// What it reads, for a message.
        reads: String,
    },
    /// The size of the mesh was given twice.
    #[error("--n and --vertices both say how large the mesh is; give one of them")]
    Both,
    /// The bench's mesh was refused.
    #[error(transparent)]
    Mesh(#[from] MeshError),
    /// The bench's model was refused.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A step left the finite numbers.
    #[error(transparent)]
    Step(#[from] StepError),
    /// The caller asked to stop.
    #[error("stopped")]
    Stopped,
}

/// On which side of its threshold a figure must lie.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Limit {
    /// At most so much.
    AtMost(f64),
    /// At least so much.
    AtLeast(f64),
}

/// A figure of a bench.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// What was measured.
    pub what: String,
    /// The figure.
    pub figure: f64,
    /// Its unit; empty for counts and ratios.
    pub unit: &'static str,
    /// The answer or the law that it is held against.
    pub reference: String,
    /// Its threshold.
    pub limit: Limit,
}

impl Row {
    /// Whether the figure is on the right side of its threshold; NaN never is.
    pub fn passes(&self) -> bool {
        match self.limit {
            Limit::AtMost(most) => self.figure <= most,
            Limit::AtLeast(least) => self.figure >= least,
        }
    }

    /// The threshold's number.
    pub fn threshold(&self) -> f64 {
        match self.limit {
            Limit::AtMost(x) | Limit::AtLeast(x) => x,
        }
    }

    /// How much of the threshold is used up: over 1 is a miss.
    fn strain(&self) -> f64 {
        let used = match self.limit {
            Limit::AtMost(most) if most > 0.0 => self.figure / most,
            Limit::AtLeast(least) if self.figure > 0.0 => least / self.figure,
            _ => f64::from(u8::from(!self.passes())) * 2.0,
        };
        if used.is_nan() { f64::INFINITY } else { used }
    }
}

/// What a bench found.
#[derive(Debug, Clone, PartialEq)]
pub struct Report {
    /// Name of the bench.
    pub name: &'static str,
    /// Name of the fabric, where one was asked for.
    pub fabric: Option<&'static str>,
    /// Its figures, at least one.
    pub rows: Vec<Row>,
    /// What the stage measured on the way.
    pub tally: Tally,
}

impl Report {
    /// Whether every figure passes.
    pub fn pass(&self) -> bool {
        self.rows.iter().all(Row::passes)
    }

    /// The figure nearest to its threshold, or furthest beyond it.
    pub fn decisive(&self) -> &Row {
        let worst = |a: &&Row, b: &&Row| a.strain().total_cmp(&b.strain());
        // A bench without figures is a fault of the bench, seen by the test that runs them all.
        self.rows.iter().max_by(worst).expect("a bench has at least one figure")
    }
}

/// All benches, in the order of the table.
#[rustfmt::skip]
pub const BENCHES: &[Bench] = &[
    fall::A1, hang::A2, swing::A3, swing::A4, hang::A5, bending::A6, bending::A7, drape::A8,
    fall::A9, slide::A10, momentum::A12, energy::A13,
    sheets::B1, sheets::B2, sweep::B3, mesh_faults::B4,
    contact::C1, contact::C2, contact::C3, contact::C4, contact::C5, contact::C6,
    soak::D1, repeat::D2, repeat::D3, speed::D4,
    sheets::S1, sheets::S2,
];

/// The bench of that name, in either case.
///
/// # Errors
/// Names all there are.
pub fn find(name: &str) -> Result<&'static Bench, LabError> {
    let known = || BENCHES.iter().map(|b| b.name).collect::<Vec<_>>().join(", ");
    BENCHES
        .iter()
        .find(|b| b.name.eq_ignore_ascii_case(name.trim()))
        .ok_or_else(|| LabError::Unknown { name: name.to_owned(), known: known() })
}

impl Bench {
    /// The options that it reads, for people: `--n, --dt`.
    pub fn options(&self) -> String {
        self.reads.iter().map(|s| format!("--{}", s.name())).collect::<Vec<_>>().join(", ")
    }

    /// Runs the bench.
    ///
    /// * `clock`: the processor time used so far (s), or anything that rises evenly.
    /// * `watch`: is shown every frame; to return false stops the bench.
    ///
    /// # Errors
    /// A parameter out of range or not read, a step that is not finite, or the caller's wish to stop.
    pub fn run(
        &self,
        settings: Settings,
        clock: &mut dyn FnMut() -> f64,
        watch: &mut dyn FnMut(&Shot<'_>) -> bool,
    ) -> Result<Report, LabError> {
        settings.check(self)?;
        let mut stage = Stage::new(settings, clock, watch);
        (self.run)(&mut stage)?;
        let (rows, tally) = stage.finish();
        let fabric = settings.fabric.map(|f| f.name);
        Ok(Report { name: self.name, fabric, rows, tally })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn benches_are_found_in_either_case_and_others_are_named() {
        assert_eq!(find("s1").unwrap().name, "S1");
        assert_eq!(find("a10").unwrap().name, "A10");
        let text = find("z9").map(|b| b.name).unwrap_err().to_string();
        assert!(text.contains("z9") && text.contains("A13"), "{text}");
    }

    #[test]
    fn the_decisive_figure_is_the_worst_of_both_kinds() {
        let row = |figure, limit| Row {
            what: String::new(),
            figure,
            unit: "",
            reference: String::new(),
            limit,
        };
        let rows = vec![
            row(0.5, Limit::AtMost(1.0)),
            row(2.0, Limit::AtLeast(1.6)),
            row(0.0, Limit::AtMost(0.0)),
        ];
        let mut report = Report { name: "A1", fabric: None, rows, tally: Tally::default() };
        assert!(report.pass());
        assert_eq!(report.decisive().limit, Limit::AtLeast(1.6));
        report.rows.push(row(f64::NAN, Limit::AtMost(1.0)));
        assert!(!report.pass() && report.decisive().figure.is_nan());
        report.rows[2].figure = 1.0;
        assert!(!report.rows[2].passes());
    }

    #[test]
    fn parameters_out_of_range_are_refused_before_anything_runs() {
        let settings = Settings { n: Some(1), ..Settings::default() };
        let error = find("S1").unwrap().run(settings, &mut || 0.0, &mut |_| true).unwrap_err();
        assert!(error.to_string().starts_with("--n 1"), "{error}");
        let dt = Settings { dt_s: Some(f32::NAN), ..Settings::default() };
        assert!(find("S1").unwrap().run(dt, &mut || 0.0, &mut |_| true).is_err());
    }

    /// Asked for everything, up to its first frame.
    fn began(bench: &Bench, settings: Settings) -> (Vec<Setting>, Result<(), LabError>) {
        let (mut clock, mut watch) = (|| 0.0, |_: &Shot<'_>| false);
        let mut stage = Stage::new(settings, &mut clock, &mut watch);
        let ended = (bench.run)(&mut stage);
        (stage.read(), ended)
    }

    #[test]
    fn a_bench_reads_what_it_says_and_refuses_the_rest() {
        let dt_s = Some(1.0 / 170.0);
        let fabric = crate::fabrics::find("sweater");
        for bench in BENCHES {
            let by_n = Settings { n: Some(20), fabric, dt_s, ..Settings::default() };
            let by_count = Settings { vertices: Some(900), n: None, ..by_n };
            let mut read = began(bench, by_n).0;
            read.extend(began(bench, by_count).0);
            for setting in Setting::ALL {
                let name = bench.name;
                let reads = bench.reads.contains(setting);
                assert_eq!(read.contains(setting), reads, "{name} and --{}", setting.name());
                if !reads {
                    let only = setting.only(&by_n, &by_count);
                    let error = bench.run(only, &mut || 0.0, &mut |_| true).unwrap_err();
                    let (said, options) = (error.to_string(), bench.options());
                    let refused = format!("{name} does not read --{}; it", setting.name());
                    assert!(said.starts_with(&refused) && said.ends_with(&options), "{said}");
                }
            }
        }
    }

    #[test]
    fn the_coarsest_mesh_is_refused_or_simulated() {
        for bench in BENCHES.iter().filter(|bench| bench.reads.contains(&Setting::N)) {
            for n in [2, 3, 5] {
                let settings = Settings { n: Some(n), ..Settings::default() };
                match began(bench, settings).1 {
                    Err(LabError::Stopped) => {}
                    Err(LabError::Parameter { name: "n", least, most, .. }) => {
                        assert!(!(least..=most).contains(&f64::from(n)), "{} {n}", bench.name);
                    }
                    other => panic!("{} --n {n}: {other:?}", bench.name),
                }
            }
        }
    }
}

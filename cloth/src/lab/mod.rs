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

pub use stage::{Settings, Shot, Sim, Stage, Tally};

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
    /// Runs the bench.
    ///
    /// * `clock`: the processor time used so far (s), or anything that rises evenly.
    /// * `watch`: is shown every frame; to return false stops the bench.
    ///
    /// # Errors
    /// A parameter out of range, a step that is not finite, or the caller's wish to stop.
    pub fn run(
        &self,
        settings: Settings,
        clock: &mut dyn FnMut() -> f64,
        watch: &mut dyn FnMut(&Shot<'_>) -> bool,
    ) -> Result<Report, LabError> {
        settings.check()?;
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
}

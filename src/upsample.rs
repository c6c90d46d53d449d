//! `toile upsample`: learn what a coarse simulation lacks, and measure it.

mod pictures;

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, bail, ensure};
use clap::{Args, Subcommand};
use explorer::upsample::cache::Cache;
use explorer::upsample::fit::Profile;
use explorer::upsample::judge::{Errors, Judge};
use explorer::upsample::learn::{HARMONICS, Lesson, Tests};
use explorer::upsample::report::{Method, Report, Retraining};
use explorer::upsample::scene::NAMES;
use picture::Plot;
use serde::Serialize;

use crate::args;
use crate::format;
use crate::live::Live;

/// `toile upsample`.
#[derive(Debug, Args)]
pub struct Upsample {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// The commands of `toile upsample`.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Learn every kind of operator from a scene's training motion and judge them on all its motions.
    Report(ReportArgs),
    /// Learn the harmonic operator alone, with a profile of your own.
    Fit(FitArgs),
}

/// What both commands take.
#[derive(Debug, Args)]
pub struct Common {
    /// flag, curtain, skirt or cape (these two need the real character: `TOILE_DATA`).
    pub scene: String,
    /// Where simulated frames and harmonics are kept.
    #[arg(long, value_name = "DIR", default_value = "work/upsample")]
    pub work: PathBuf,
    /// Harmonics used by the fit.
    #[arg(long, value_name = "K", default_value_t = HARMONICS)]
    pub harmonics: usize,
    /// Test functions of the tracking constraint are groups of vertices instead of harmonics.
    #[arg(long)]
    pub clustered: bool,
    /// One JSON object on the last line of stdout.
    #[arg(long)]
    pub json: bool,
}

/// `toile upsample report`.
#[derive(Debug, Args)]
pub struct ReportArgs {
    /// Which scene.
    #[command(flatten)]
    pub common: Common,
    /// Write pictures: motions side by side, shape functions, harmonics, modes.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
}

/// `toile upsample fit`.
#[derive(Debug, Args)]
pub struct FitArgs {
    /// Which scene.
    #[command(flatten)]
    pub common: Common,
    /// gamma_1, gamma_N and c [default: tuned on the training motion].
    #[arg(long, value_name = "G1,GN,C", value_parser = profile)]
    pub profile: Option<Profile>,
}

fn profile(text: &str) -> Result<Profile, String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|n| n.trim().parse()).collect();
    match numbers.unwrap_or_default()[..] {
        [first, last, exponent]
            if first > 0.0 && last >= first && (0.0..=64.0).contains(&exponent) =>
        {
            let finite = last.is_finite();
            if finite {
                Ok(Profile { first, last, exponent })
            } else {
                Err("finite numbers".into())
            }
        }
        _ => Err("three numbers G1,GN,C with 0 < G1 <= GN and C in 0..=64, such as 1,1e5,4".into()),
    }
}

/// Runs the command.
pub fn run(a: &Upsample) -> Result<()> {
    match &a.command {
        Command::Report(a) => {
            let lesson = lesson(&a.common)?;
            let report = lesson.report()?;
            if let Some(folder) = &a.out {
                pictures::write(&lesson, folder)?;
            }
            if a.common.json {
                return format::print_json(&report);
            }
            print!("{}", table(&report));
            Ok(())
        }
        Command::Fit(a) => fit(a),
    }
}

/// Simulates, or takes from the work folder, all motions of a scene.
fn lesson(a: &Common) -> Result<Lesson> {
    if !NAMES.contains(&a.scene.as_str()) {
        bail!("there is no scene {}; there are {}", a.scene, NAMES.join(", "));
    }
    ensure!((8..=2000).contains(&a.harmonics), "--harmonics {}: from 8 to 2000", a.harmonics);
    let tests = if a.clustered { Tests::Clustered } else { Tests::Harmonic };
    let mut live = Live::new(Some(0));
    let mut motion = String::new();
    let start = Instant::now();
    let lesson = Lesson::new(
        &a.scene,
        usize::MAX,
        a.harmonics,
        tests,
        &Cache::new(&a.work),
        &mut |name, done, all| {
            if motion != name {
                name.clone_into(&mut motion);
                live = Live::new(Some(all as u64));
            }
            live.tell(done as u64, || format!("{}, {name}: frame {done} of {all}", a.scene));
        },
    );
    live.done();
    let lesson = lesson?;
    eprintln!("{}: motions are there after {:.1} s", a.scene, start.elapsed().as_secs_f64());
    Ok(lesson)
}

/// What `fit` prints with `--json`.
#[derive(Debug, Serialize)]
struct Fitted {
    scene: &'static str,
    k: usize,
    profile: [f64; 3],
    /// Products of the training frames (s).
    prepare_s: f64,
    /// The operator for a profile (s).
    fit_s: f64,
    motions: Vec<FittedMotion>,
}

#[derive(Debug, Serialize)]
struct FittedMotion {
    motion: &'static str,
    training: bool,
    #[serde(flatten)]
    errors: Errors,
}

fn fit(a: &FitArgs) -> Result<()> {
    let lesson = lesson(&a.common)?;
    let start = Instant::now();
    let training = lesson.fitted()?;
    let prepare_s = start.elapsed().as_secs_f64();
    let profile = match a.profile {
        Some(profile) => profile,
        None => lesson.table(lesson.training())?.profile(),
    };
    let start = Instant::now();
    let operator = Method::Linear(training.harmonic(&profile));
    let fit_s = start.elapsed().as_secs_f64();
    let judge = Judge::new(&lesson.harmonics, lesson.scene.coarse.count());
    let motions = lesson.scene.motions.iter().zip(&lesson.frames).enumerate();
    let motions = motions.map(|(at, (motion, frames))| {
        let upsampled = lesson.upsample(&operator, frames);
        let errors = judge.judge(upsampled.as_ref(), frames.fine.as_ref());
        FittedMotion { motion: motion.name, training: at == 0, errors }
    });
    let fitted = Fitted {
        scene: lesson.scene.name,
        k: lesson.k,
        profile: [profile.first, profile.last, profile.exponent],
        prepare_s,
        fit_s,
        motions: motions.collect(),
    };
    if a.common.json {
        return format::print_json(&fitted);
    }
    let [first, last, exponent] = fitted.profile;
    println!("{}, {} harmonics, profile {first:.3e},{last:.3e},{exponent}", fitted.scene, fitted.k);
    println!("products {prepare_s:.3} s, operator {fit_s:.3} s");
    for m in &fitted.motions {
        let Errors { rms_mm, max_mm, high_frequency_mm } = m.errors;
        let name = m.motion;
        println!(
            "{name:<16} rms {rms_mm:>7.3} mm, max {max_mm:>7.2}, high {high_frequency_mm:>7.3}"
        );
    }
    Ok(())
}

/// The report for people.
fn table(r: &Report) -> String {
    let mut out = String::new();
    let _ = writeln!(out, "{}: M {}, N {}, F {}, T {}, k {}", r.scene, r.m, r.n, r.f, r.t, r.k);
    let _ = writeln!(
        out,
        "harmonics {:.2} s, learn {:.2} s (again {:.3}) of processor time, U p {:.0} us hot, {:.0} cold, coarse step \
         {:.0} us, {} of weights",
        r.harmonics_s,
        r.learn_s,
        r.refit_s,
        r.apply_hot_us,
        r.apply_cold_us,
        r.coarse_step_us,
        format::bytes(r.memory_bytes as u64)
    );
    let _ = writeln!(
        out,
        "tracking residual {:.1e} mm, rows sum to 1 within {:.1e}",
        r.tracking_residual_mm, r.partition_of_unity
    );
    let _ = write!(out, "{:<16}{:>10}", "rms / max / high", "us");
    for m in &r.motions {
        let mark = if m.training { " (training)" } else { "" };
        let _ = write!(out, "{:>28}", format!("{}{mark}", m.motion));
    }
    let _ = writeln!(out, "  (mm)");
    for (at, method) in r.motions[0].methods.iter().enumerate() {
        let _ = write!(out, "{:<16}{:>10.0}", method.name, method.apply_us);
        for m in &r.motions {
            let e = &m.methods[at].errors;
            let (rms, max, high) = (e.rms_mm, e.max_mm, e.high_frequency_mm);
            let _ = write!(out, "{:>28}", format!("{rms:.2} / {max:.1} / {high:.2}"));
        }
        let _ = writeln!(out);
    }
    for b in &r.rounding {
        let how = if b.along { ", rounded along the training motion" } else { "" };
        let _ = writeln!(
            out,
            "{} bits{how}: rms {:.4} mm, max {:.3}; other motions {:.4}",
            b.bits, b.rms_mm, b.max_mm, b.others_rms_mm
        );
    }
    for [hertz, share] in &r.modes {
        let _ = writeln!(out, "modes: {hertz:.2} Hz, {:.1} % of what was left", 100.0 * share);
    }
    r.retraining.iter().for_each(|x| tell_retraining(x, &mut out));
    out
}

/// What learning again from one motion brings, in words.
fn tell_retraining(x: &Retraining, out: &mut String) {
    let closed: Vec<String> =
        x.gap_closed.iter().map(|c| format!("{} {:.0} %", c.name, 100.0 * c.share)).collect();
    let _ = writeln!(
        out,
        "{}: harmonic {:.2} mm, learnt again from it {:.2} mm; of that gap close: {}",
        x.motion,
        x.harmonic_rms_mm,
        x.retrained_rms_mm,
        closed.join(", ")
    );
    let s = &x.second_half;
    let _ = writeln!(
        out,
        "  its second half: harmonic {:.2} mm, learnt again from the first half {:.2}, from both {:.2}; \
         sparse {:.2}, {:.2}, {:.2}",
        s.harmonic_rms_mm,
        s.harmonic_retrained_rms_mm,
        s.harmonic_both_rms_mm,
        s.sparse_rms_mm,
        s.sparse_retrained_rms_mm,
        s.sparse_both_rms_mm
    );
}

/// `toile chart` of a scene: every method as a point of time against error.
pub fn chart(scene: &str, a: &args::Chart) -> Result<()> {
    let common = Common {
        scene: scene.into(),
        work: a.work.clone().unwrap_or_else(|| Path::new("work/upsample").into()),
        harmonics: HARMONICS,
        clustered: false,
        json: false,
    };
    let report = lesson(&common)?.report()?;
    std::fs::create_dir_all(&a.out)
        .with_context(|| format!("the folder {} cannot be made", a.out.display()))?;
    let mut csv = "motion,training,name,frame_us,rms_mm,max_mm,high_frequency_mm\n".to_string();
    let mut files = Vec::new();
    for m in &report.motions {
        let title = format!("{scene}, {}: error over time a frame", m.motion);
        let mut plot =
            Plot::new(&title, "coarse step and upsampling (us)", "rms error (mm)").logarithmic();
        for method in &m.methods {
            let Errors { rms_mm, max_mm, high_frequency_mm } = method.errors;
            let us = report.coarse_step_us + method.apply_us;
            plot = plot.with(method.name, vec![[us, rms_mm]]);
            let (name, training) = (method.name, m.training);
            let _ = writeln!(
                csv,
                "{},{training},{name},{us:.1},{rms_mm:.4},{max_mm:.3},{high_frequency_mm:.4}",
                m.motion
            );
        }
        let name = m.motion.replace(' ', "-");
        files.push((format!("{scene}-{name}.svg"), plot.svg().into_bytes()));
        files.push((format!("{scene}-{name}.png"), plot.png(2)?));
    }
    files.push((format!("{scene}.csv"), csv.into_bytes()));
    for (name, content) in files {
        let path = a.out.join(name);
        std::fs::write(&path, content).with_context(|| format!("writing {}", path.display()))?;
        println!("{}", path.display());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn profiles_are_three_numbers_that_rise() {
        let found = profile("1, 1e5,4").unwrap();
        assert_eq!(found, Profile { first: 1.0, last: 1e5, exponent: 4.0 });
        for wrong in
            ["", "1,2", "0,1,4", "2,1,4", "1,inf,4", "1,2,-1", "1,2,x", "1,x,1e5,4", "1,2,3,4"]
        {
            assert!(profile(wrong).is_err(), "{wrong}");
        }
    }
}

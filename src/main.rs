//! `toile`: one binary for everything. This file parses and dispatches; each command has a module.

mod args;
mod chart;
mod codec;
mod compare;
mod decode_bench;
mod explore;
mod format;
mod inspect;
mod lab;
mod lab_record;
mod live;
mod place;
mod play;
mod play_forces;
mod plot;
mod recall;
mod record;
mod scene;
mod serve;
mod simulate;
mod store;
mod up;
mod upsample;
mod view;

use std::process::ExitCode;

use args::{Arguments, Command};
use clap::Parser;

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    end_where_nobody_reads();
    start_log(arguments.verbose);
    let done = match arguments.command {
        Command::Up(a) => up::run(&a),
        Command::Explore(a) => explore::run(a),
        Command::Serve(a) => serve::run(a),
        Command::Play(a) => play::run(&a),
        Command::View(a) => view::run(&a),
        Command::Inspect(a) => inspect::run(&a),
        Command::Plot(a) => plot::run(&a),
        Command::Compare(a) => compare::run(a),
        Command::Simulate(a) => simulate::run(&a),
        Command::Scene(a) => scene::run(a),
        Command::Lab(a) => lab::run(a),
        Command::Upsample(a) => upsample::run(&a),
        Command::Chart(a) => chart::run(&a),
        Command::Codec(a) => match a.command {
            args::CodecCommand::DecodeBench(a) => decode_bench::run(&a),
            args::CodecCommand::Bench(a) => codec::bench(&a),
            args::CodecCommand::Contact(a) => codec::contact::run(&a),
        },
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {}", said_once(&error));
            ExitCode::FAILURE
        }
    }
}

/// A reader that closes the pipe early, as `head` does, wants no more: that is no fault to report.
fn end_where_nobody_reads() {
    let report = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        let said = panic.payload().downcast_ref::<String>().map_or("", String::as_str);
        if said.starts_with("failed printing to") && said.contains("Broken pipe") {
            // As a program ends that SIGPIPE ends.
            std::process::exit(141);
        }
        report(panic);
    }));
}

/// The error and its causes, without those that the sentence before them says already.
fn said_once(error: &anyhow::Error) -> String {
    error.chain().map(ToString::to_string).fold(String::new(), |said, cause| match said {
        said if said.is_empty() => cause,
        said if said.contains(cause.trim_end()) => said,
        said => format!("{said}: {cause}"),
    })
}

/// Logs go to stderr, warnings and errors only unless asked; `RUST_LOG` overrides.
fn start_log(verbose: u8) {
    let level = match verbose {
        0 => "warn",
        1 => "info",
        _ => "debug",
    };
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new(level));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
}

#[cfg(test)]
mod tests {
    use super::*;
    use anyhow::Context;

    #[test]
    fn a_cause_is_said_once() {
        let inner = std::io::Error::other("disk full");
        let repeated = anyhow::Error::new(inner).context("writing x: disk full");
        assert_eq!(said_once(&repeated), "writing x: disk full");
        let inner = Err::<(), _>(std::io::Error::other("disk full"));
        let added = inner.context("writing x").context("publishing").unwrap_err();
        assert_eq!(said_once(&added), "publishing: writing x: disk full");
    }
}

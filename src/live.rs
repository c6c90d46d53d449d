//! One line that tells how the work goes: redrawn in place on a terminal, printed now and then
//! elsewhere. It goes to stderr; stdout is for results.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// Between two lines where there is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(5);

/// A live line.
pub struct Live {
    bar: Option<ProgressBar>,
    printed: Option<Instant>,
    said: String,
}

impl Live {
    /// A bar up to `total` where there is one, else a spinner.
    pub fn new(total: Option<u64>) -> Self {
        if !std::io::stderr().is_terminal() {
            return Self { bar: None, printed: None, said: String::new() };
        }
        let bar = ProgressBar::with_draw_target(total, ProgressDrawTarget::stderr_with_hz(8));
        let template = match total {
            Some(_) => "[{elapsed_precise}] {bar:24} {pos}/{len} {wide_msg}",
            // The prefix is the second line of what is told, where there is one.
            None => "[{elapsed_precise}] {spinner} {wide_msg}{prefix}",
        };
        if let Ok(style) = ProgressStyle::with_template(template) {
            bar.set_style(style);
        }
        bar.enable_steady_tick(Duration::from_millis(120));
        Self { bar: Some(bar), printed: None, said: String::new() }
    }

    /// Tells how far the work is. On a terminal a spinner shows a second line of the message below the
    /// first, so that 80 columns are enough for both.
    pub fn tell(&mut self, position: u64, message: impl FnOnce() -> String) {
        if let Some(bar) = &self.bar {
            bar.set_position(position);
            let message = message();
            let (first, second) = message.split_once('\n').unwrap_or((&message, ""));
            let gap = if second.is_empty() { "" } else { "\n             " };
            bar.set_message(first.to_owned());
            bar.set_prefix(format!("{gap}{second}"));
        } else if self.printed.is_none_or(|at| at.elapsed() >= LINE_EVERY) {
            let message = message().replace('\n', " | ");
            if message != self.said {
                eprintln!("{message}");
            }
            self.said = message;
            self.printed = Some(Instant::now());
        }
    }

    /// Prints a line that stays.
    pub fn note(&mut self, line: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln!("{line}")),
            None if line == self.said => {}
            None => {
                eprintln!("{line}");
                line.clone_into(&mut self.said);
                self.printed = Some(Instant::now());
            }
        }
    }

    /// Clears the line.
    pub fn done(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

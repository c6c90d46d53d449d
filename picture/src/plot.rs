//! Small line plots, as SVG text and as a picture.
//!
//! A plot is laid out once into marks (lines and words); two painters draw the same marks.

mod axis;
mod paint;

pub(crate) use paint::escaped;

use crate::image::{Image, ImageError, Rgb};
use axis::Axis;
use paint::{Anchor, Mark};

const INK: Rgb = [50, 52, 58];
const GRID: Rgb = [226, 228, 232];
const STAGE: Rgb = [150, 152, 158];
/// Colours that stay apart for colour-blind eyes (Okabe and Ito 2008), in order of use.
const COLOURS: [Rgb; 6] =
    [[0, 114, 178], [213, 94, 0], [0, 158, 115], [204, 121, 167], [230, 159, 0], [86, 180, 233]];
/// Height of a line of words, in plot units.
const LINE: f32 = 16.0;
/// Width of a letter, in plot units, for laying out.
const LETTER: f32 = 6.0;

/// A line plot. Its size is in plot units: pixels of the SVG.
#[derive(Clone, Debug)]
pub struct Plot {
    /// Line at the top.
    pub title: String,
    /// What runs along, with its unit: "frames".
    pub x_label: String,
    /// What runs upwards, with its unit: "worst error (mm)".
    pub y_label: String,
    /// Whether values upwards are spaced by their logarithm. What is not above zero is left out.
    pub y_log: bool,
    /// The same for values along.
    pub x_log: bool,
    /// Width and height, in plot units (at least 160 x 120).
    pub size: [u32; 2],
    /// The lines, drawn in order; the first six have colours of their own.
    pub series: Vec<Series>,
    /// Values along at which something was reached, and what: a line upwards each.
    pub stages: Vec<(f64, String)>,
}

/// One line of a plot.
#[derive(Clone, Debug)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// Points from left to right. One that is not finite leaves a gap.
    pub points: Vec<[f64; 2]>,
}

impl Plot {
    /// An empty plot of 640 x 360 with linear axes.
    pub fn new(title: &str, x_label: &str, y_label: &str) -> Self {
        let [title, x_label, y_label] = [title, x_label, y_label].map(str::to_owned);
        Self {
            title,
            x_label,
            y_label,
            y_log: false,
            x_log: false,
            size: [640, 360],
            series: Vec::new(),
            stages: Vec::new(),
        }
    }

    /// The same plot with logarithmic values.
    pub fn logarithmic(mut self) -> Self {
        self.y_log = true;
        self
    }

    /// The same plot with logarithmic values along too.
    pub fn logarithmic_along(mut self) -> Self {
        self.x_log = true;
        self
    }

    /// The same plot with one more line.
    pub fn with(mut self, name: &str, points: Vec<[f64; 2]>) -> Self {
        self.series.push(Series { name: name.to_owned(), points });
        self
    }

    /// The same plot with a stage marked.
    pub fn at_stage(mut self, along: f64, what: &str) -> Self {
        self.stages.push((along, what.to_owned()));
        self
    }

    /// The plot as an SVG document.
    pub fn svg(&self) -> String {
        paint::svg(self.extent(), &self.marks())
    }

    /// The plot as a picture; `scale` pixels to a plot unit (2 is good to read).
    ///
    /// # Errors
    /// [`ImageError::Size`] when the picture is larger than one may be.
    pub fn image(&self, scale: u32) -> Result<Image, ImageError> {
        paint::image(self.extent(), scale, &self.marks())
    }

    /// The plot as a PNG file, as [`Plot::image`].
    ///
    /// # Errors
    /// [`ImageError`] when the picture is too large or the encoder refuses.
    pub fn png(&self, scale: u32) -> Result<Vec<u8>, ImageError> {
        self.image(scale)?.png()
    }

    fn extent(&self) -> [u32; 2] {
        [self.size[0].max(160), self.size[1].max(120)]
    }

    fn shown(&self, point: &[f64; 2]) -> bool {
        let logs = [self.x_log, self.y_log];
        point.iter().zip(logs).all(|(value, log)| value.is_finite() && (!log || *value > 0.0))
    }

    fn axis(&self, which: usize, from: f32, to: f32) -> Axis {
        let points = self.series.iter().flat_map(|series| &series.points);
        let values = points.filter(|point| self.shown(point)).map(|point| point[which]);
        let ends = values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], value| {
            [low.min(value), high.max(value)]
        });
        if [self.x_log, self.y_log][which] {
            return Axis::logarithmic(ends, from, to);
        }
        Axis::linear(ends, from, to)
    }

    fn marks(&self) -> Vec<Mark> {
        let [width, height] = self.extent().map(|side| side as f32);
        let mut marks = vec![Mark::text([12.0, 8.0], Anchor::Left, INK, &self.title).bold()];
        let legend = self.legend(width, &mut marks);
        marks.push(Mark::text([12.0, legend + 2.0], Anchor::Left, INK, &self.y_label));
        let (top, bottom) = (legend + LINE + 8.0, height - 2.0 * LINE - 10.0);
        let up = self.axis(1, bottom, top);
        let widest = up.ticks.iter().map(|tick| tick.label.len()).max().unwrap_or(1);
        let (left, right) = (20.0 + LETTER * widest as f32, width - 20.0);
        let along = self.axis(0, left, right);

        for tick in &up.ticks {
            marks.push(Mark::line(vec![[left, tick.place], [right, tick.place]], 1.0, GRID));
            let corner = [left - 6.0, tick.place - 4.0];
            marks.push(Mark::text(corner, Anchor::Right, INK, &tick.label));
        }
        for tick in &along.ticks {
            marks.push(Mark::line(
                vec![[tick.place, bottom], [tick.place, bottom + 4.0]],
                1.0,
                INK,
            ));
            let corner = [tick.place, bottom + 8.0];
            marks.push(Mark::text(corner, Anchor::Middle, INK, &tick.label));
        }
        marks.push(Mark::line(vec![[left, bottom], [right, bottom]], 1.0, INK));
        let corner = [0.5 * (left + right), height - LINE];
        marks.push(Mark::text(corner, Anchor::Middle, INK, &self.x_label));
        self.draw_stages([left, right], [top, bottom], &along, &mut marks);
        for (series, colour) in self.series.iter().zip(COLOURS.iter().cycle()) {
            self.draw(series, *colour, [&along, &up], &mut marks);
        }
        marks
    }

    /// Lines upwards at stages; their words above the axis, one above the other, on the side with room.
    fn draw_stages(
        &self,
        [left, right]: [f32; 2],
        [top, bottom]: [f32; 2],
        along: &Axis,
        marks: &mut Vec<Mark>,
    ) {
        let shown = self.stages.iter().filter(|(at, _)| !self.x_log || *at > 0.0);
        for (row, (at, what)) in shown.enumerate() {
            let x = along.place(*at);
            if !(left..=right).contains(&x) {
                continue;
            }
            marks.push(Mark::line(vec![[x, top], [x, bottom]], 1.0, STAGE));
            let is_late = x > 0.5 * (left + right);
            let (anchor, gap) = if is_late { (Anchor::Right, -4.0) } else { (Anchor::Left, 4.0) };
            let corner = [x + gap, bottom - 12.0 - LINE * row as f32];
            marks.push(Mark::text(corner, anchor, STAGE, what));
        }
    }

    /// Names and colours under the title, in as many rows as they need; returns where they end.
    fn legend(&self, width: f32, marks: &mut Vec<Mark>) -> f32 {
        let (mut x, mut y) = (12.0, 8.0 + LINE);
        if self.series.len() < 2 && self.series.iter().all(|series| series.name.is_empty()) {
            return y;
        }
        for (series, colour) in self.series.iter().zip(COLOURS.iter().cycle()) {
            let wide = 24.0 + LETTER * (series.name.chars().count() + 3) as f32;
            if x + wide > width && x > 12.0 {
                (x, y) = (12.0, y + LINE);
            }
            marks.push(Mark::line(vec![[x, y + 5.0], [x + 16.0, y + 5.0]], 2.5, *colour));
            marks.push(Mark::text([x + 22.0, y + 1.0], Anchor::Left, INK, &series.name));
            x += wide;
        }
        y + LINE + 2.0
    }

    /// A line for each run of points without a gap.
    fn draw(&self, series: &Series, colour: Rgb, axes: [&Axis; 2], marks: &mut Vec<Mark>) {
        let points = thinned(&series.points, 2 * self.extent()[0] as usize);
        for run in points.split(|point| !self.shown(point)).filter(|run| !run.is_empty()) {
            let place = |point: &[f64; 2]| [axes[0].place(point[0]), axes[1].place(point[1])];
            let mut line: Vec<_> = run.iter().map(place).collect();
            // A lone point is a dot.
            if let [only] = line[..] {
                line.push(only);
            }
            marks.push(Mark::line(line, 1.8, colour));
        }
    }
}

/// At most about twice `buckets` points: of each bucket the lowest and the highest, so that no
/// peak is lost.
fn thinned(points: &[[f64; 2]], buckets: usize) -> Vec<[f64; 2]> {
    if points.len() <= 2 * buckets {
        return points.to_vec();
    }
    let mut kept = Vec::new();
    for bucket in points.chunks(points.len().div_ceil(buckets)) {
        let by_value = |a: &&[f64; 2], b: &&[f64; 2]| a[1].total_cmp(&b[1]);
        let finite = || bucket.iter().filter(|point| point[1].is_finite());
        let ends = [finite().min_by(by_value), finite().max_by(by_value)];
        let mut ends: Vec<_> = ends.into_iter().flatten().copied().collect();
        ends.sort_by(|a, b| a[0].total_cmp(&b[0]));
        kept.extend(ends);
    }
    kept
}

#[cfg(test)]
mod tests;

//! A free drawing of very many lines, as SVG and as a picture: graphs, not charts.
//!
//! What shares a colour shares a mark, and thin lines are drawn by stepping along them, so that a
//! hundred thousand lines take seconds and tens of bytes each.

use std::fmt::Write;

use crate::image::{Image, ImageError, Rgb};
use crate::plot::escaped;

/// Lines of one colour, and words. Places are in drawing units, y downwards.
#[derive(Clone, Debug)]
pub struct Drawing {
    size: [u32; 2],
    marks: Vec<Mark>,
}

#[derive(Clone, Debug)]
enum Mark {
    Lines { lines: Vec<Vec<[f32; 2]>>, thickness: f32, colour: Rgb },
    Disc { place: [f32; 2], radius: f32, colour: Rgb },
    Text { place: [f32; 2], text: String, colour: Rgb, bold: bool },
}

impl Drawing {
    /// An empty, white drawing of this width and height (drawing units: pixels of the SVG).
    pub fn new(size: [u32; 2]) -> Self {
        Self { size, marks: Vec::new() }
    }

    /// Adds runs of straight lines, of a thickness in drawing units. Runs with a place that is not
    /// finite are left out.
    pub fn lines(&mut self, lines: Vec<Vec<[f32; 2]>>, thickness: f32, colour: Rgb) {
        let finite = |line: &Vec<[f32; 2]>| line.iter().flatten().all(|value| value.is_finite());
        let lines = lines.into_iter().filter(finite).collect();
        self.marks.push(Mark::Lines { lines, thickness, colour });
    }

    /// Adds a filled circle.
    pub fn disc(&mut self, place: [f32; 2], radius: f32, colour: Rgb) {
        self.marks.push(Mark::Disc { place, radius, colour });
    }

    /// Adds a line of words; the place is its upper left corner.
    pub fn text(&mut self, place: [f32; 2], text: &str, colour: Rgb, bold: bool) {
        self.marks.push(Mark::Text { place, text: text.to_owned(), colour, bold });
    }

    /// The drawing as an SVG document.
    pub fn svg(&self) -> String {
        let [width, height] = self.size;
        let mut out = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
             viewBox=\"0 0 {width} {height}\" font-family=\"system-ui, sans-serif\" \
             font-size=\"11\">\n<rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\n"
        );
        for mark in &self.marks {
            // Writing to a string cannot fail.
            let _ = match mark {
                Mark::Lines { lines, thickness, colour } => writeln!(
                    out,
                    "<path d=\"{}\" fill=\"none\" stroke=\"{}\" stroke-width=\"{thickness}\" \
                     stroke-linejoin=\"round\"/>",
                    path(lines),
                    hex(*colour)
                ),
                Mark::Disc { place: [x, y], radius, colour } => writeln!(
                    out,
                    "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\" fill=\"{}\"/>",
                    hex(*colour)
                ),
                Mark::Text { place: [x, y], text, colour, bold } => writeln!(
                    out,
                    "<text x=\"{x:.1}\" y=\"{:.1}\" fill=\"{}\"{}>{}</text>",
                    y + 8.5,
                    hex(*colour),
                    if *bold { " font-weight=\"600\" font-size=\"13\"" } else { "" },
                    escaped(text)
                ),
            };
        }
        out.push_str("</svg>\n");
        out
    }

    /// The drawing as a picture; `scale` pixels to a drawing unit.
    ///
    /// # Errors
    /// [`ImageError::Size`] when the picture is larger than one may be.
    pub fn image(&self, scale: u32) -> Result<Image, ImageError> {
        let scale = scale.max(1);
        let [width, height] = self.size.map(|side| side.saturating_mul(scale));
        let mut image = Image::new(width, height, [255; 3])?;
        let pixels = scale as f32;
        for mark in &self.marks {
            match mark {
                Mark::Lines { lines, thickness, colour } => {
                    let strength = (thickness * pixels).clamp(0.05, 1.0);
                    for line in lines {
                        for pair in line.windows(2) {
                            let [from, to] = [pair[0], pair[1]].map(|p| p.map(|v| v * pixels));
                            match thickness * pixels <= 1.5 {
                                true => thin(&mut image, from, to, *colour, strength),
                                false => image.line(from, to, thickness * pixels, *colour),
                            }
                        }
                    }
                }
                Mark::Disc { place, radius, colour } => {
                    let at = place.map(|v| v * pixels);
                    image.line(at, at, 2.0 * radius * pixels, *colour);
                }
                Mark::Text { place, text, colour, bold } => {
                    let corner = place.map(|v| (v * pixels).max(0.0) as u32);
                    image.text(corner, scale, *colour, text);
                    if *bold {
                        image.text([corner[0] + 1, corner[1]], scale, *colour, text);
                    }
                }
            }
        }
        Ok(image)
    }

    /// The drawing as a PNG file, as [`Drawing::image`].
    ///
    /// # Errors
    /// [`ImageError`] when the picture is too large or the encoder refuses.
    pub fn png(&self, scale: u32) -> Result<Vec<u8>, ImageError> {
        self.image(scale)?.png()
    }
}

fn path(lines: &[Vec<[f32; 2]>]) -> String {
    let mut path = String::new();
    for line in lines {
        for (place, [x, y]) in line.iter().enumerate() {
            let _ = write!(path, "{}{x:.1} {y:.1}", if place == 0 { "M" } else { "L" });
        }
    }
    path
}

/// A line about one pixel thick: one step a pixel along the longer way, each step's ink shared by
/// the two pixels across (Wu 1991).
fn thin(image: &mut Image, from: [f32; 2], to: [f32; 2], colour: Rgb, strength: f32) {
    let along = [to[0] - from[0], to[1] - from[1]];
    let steps = along[0].abs().max(along[1].abs()).ceil().clamp(1.0, 1e5);
    let across = usize::from(along[0].abs() >= along[1].abs());
    for step in 0..=steps as u32 {
        let t = step as f32 / steps;
        let place = [from[0] + t * along[0] - 0.5, from[1] + t * along[1] - 0.5];
        let mut first = place.map(f32::floor);
        first[1 - across] = place[1 - across].round();
        let share = place[across] - first[across];
        for (offset, cover) in [(0.0, 1.0 - share), (1.0, share)] {
            let mut pixel = first;
            pixel[across] += offset;
            blend(image, pixel, colour, cover * strength);
        }
    }
}

fn blend(image: &mut Image, [x, y]: [f32; 2], colour: Rgb, cover: f32) {
    let (width, height) = (image.width(), image.height());
    if x < 0.0 || y < 0.0 || x >= width as f32 || y >= height as f32 {
        return;
    }
    let pixel = &mut image.pixels_mut()[y as usize * width as usize + x as usize];
    for (old, new) in pixel.iter_mut().zip(colour) {
        let mixed = f32::from(*old) + (f32::from(new) - f32::from(*old)) * cover;
        *old = mixed.round().clamp(0.0, 255.0) as u8;
    }
}

fn hex([r, g, b]: Rgb) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_appear_where_they_are_drawn_in_both_forms() {
        let mut drawing = Drawing::new([40, 20]);
        let line = vec![[2.0, 10.5], [38.0, 10.5]];
        drawing.lines(vec![line, vec![[f32::NAN, 0.0], [1.0, 1.0]]], 1.0, [200, 0, 0]);
        drawing.disc([20.0, 4.0], 2.0, [0, 0, 200]);
        drawing.text([1.0, 1.0], "a<b", [0; 3], false);
        let image = drawing.image(1).unwrap();
        assert_eq!(image.at(20, 10), [200, 0, 0]);
        assert_eq!(image.at(20, 14), [255; 3]);
        assert_eq!(image.at(20, 4), [0, 0, 200]);
        let svg = drawing.svg();
        assert!(svg.contains("M2.0 10.5L38.0 10.5\""), "{svg}");
        assert!(svg.contains("a&lt;b") && !svg.contains("NaN"));
    }

    #[test]
    fn lines_that_leave_the_picture_are_cut() {
        let mut drawing = Drawing::new([10, 10]);
        drawing.lines(vec![vec![[-500.0, -500.0], [500.0, 500.0]]], 1.0, [0; 3]);
        // A diagonal as wide as a pixel covers most of it, and nothing of the corners beside it.
        let image = drawing.image(1).unwrap();
        assert!(image.at(5, 5)[0] < 100, "{:?}", image.at(5, 5));
        assert_eq!(image.at(9, 0), [255; 3]);
    }
}

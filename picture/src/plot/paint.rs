//! The two painters of a plot's marks.

use std::fmt::Write;

use crate::image::{Image, ImageError, Rgb};

const PAPER: Rgb = [255; 3];

/// Which end of a text its place names.
#[derive(Clone, Copy)]
pub(super) enum Anchor {
    Left,
    Middle,
    Right,
}

/// What a plot is made of; places in plot units, y downwards.
pub(super) enum Mark {
    /// A run of straight lines.
    Line { points: Vec<[f32; 2]>, thickness: f32, colour: Rgb },
    /// One line of text; the place is at the top of its letters.
    Text { place: [f32; 2], anchor: Anchor, colour: Rgb, text: String, bold: bool },
}

impl Mark {
    pub(super) fn line(points: Vec<[f32; 2]>, thickness: f32, colour: Rgb) -> Self {
        Self::Line { points, thickness, colour }
    }

    pub(super) fn text(place: [f32; 2], anchor: Anchor, colour: Rgb, text: &str) -> Self {
        Self::Text { place, anchor, colour, text: text.to_owned(), bold: false }
    }

    pub(super) fn bold(mut self) -> Self {
        if let Self::Text { bold, .. } = &mut self {
            *bold = true;
        }
        self
    }
}

pub(super) fn svg([width, height]: [u32; 2], marks: &[Mark]) -> String {
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
         viewBox=\"0 0 {width} {height}\" font-family=\"system-ui, sans-serif\" font-size=\"11\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\n"
    );
    for mark in marks {
        // Writing to a string cannot fail.
        let _ = match mark {
            Mark::Line { points, thickness, colour } => {
                let list: Vec<_> = points.iter().map(|[x, y]| format!("{x:.1},{y:.1}")).collect();
                writeln!(
                    out,
                    "<polyline points=\"{}\" fill=\"none\" stroke=\"{}\" \
                     stroke-width=\"{thickness}\" stroke-linejoin=\"round\" \
                     stroke-linecap=\"round\"/>",
                    list.join(" "),
                    hex(*colour)
                )
            }
            Mark::Text { place: [x, y], anchor, colour, text, bold } => {
                let anchor = match anchor {
                    Anchor::Left => "start",
                    Anchor::Middle => "middle",
                    Anchor::Right => "end",
                };
                let weight = if *bold { " font-weight=\"600\" font-size=\"13\"" } else { "" };
                writeln!(
                    out,
                    "<text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"{anchor}\" fill=\"{}\"{weight}>\
                     {}</text>",
                    y + 8.5,
                    hex(*colour),
                    escaped(text)
                )
            }
        };
    }
    out.push_str("</svg>\n");
    out
}

pub(super) fn image(size: [u32; 2], scale: u32, marks: &[Mark]) -> Result<Image, ImageError> {
    let scale = scale.max(1);
    let [width, height] = size.map(|side| side.saturating_mul(scale));
    let mut image = Image::new(width, height, PAPER)?;
    let pixels = scale as f32;
    for mark in marks {
        match mark {
            Mark::Line { points, thickness, colour } => {
                let points: Vec<_> = points.iter().map(|[x, y]| [x * pixels, y * pixels]).collect();
                for pair in points.windows(2) {
                    image.line(pair[0], pair[1], thickness * pixels, *colour);
                }
            }
            Mark::Text { place: [x, y], anchor, colour, text, bold } => {
                let wide = Image::text_size(scale, text)[0] as f32;
                let shift = match anchor {
                    Anchor::Left => 0.0,
                    Anchor::Middle => 0.5 * wide,
                    Anchor::Right => wide,
                };
                let corner = [(x * pixels - shift).max(0.0) as u32, (y * pixels).max(0.0) as u32];
                image.text(corner, scale, *colour, text);
                if *bold {
                    image.text([corner[0] + 1, corner[1]], scale, *colour, text);
                }
            }
        }
    }
    Ok(image)
}

fn hex([r, g, b]: Rgb) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

/// Text that no name can turn into markup; control characters, which XML forbids, become spaces.
pub(crate) fn escaped(text: &str) -> String {
    let mut out = String::new();
    for character in text.chars() {
        match character {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            control if control.is_control() => out.push(' '),
            plain => out.push(plain),
        }
    }
    out
}

//! An RGB picture in memory: what all others draw into.

use std::io::Cursor;

use crate::font;

/// A colour: red, green, blue, 8 bits each, sRGB.
pub type Rgb = [u8; 3];

/// Largest width or height of a picture, in pixels.
pub const SIDE_PIXELS_MAX: u32 = 16_384;
/// Most pixels of a picture.
pub const PIXELS_MAX: usize = 64 << 20;

/// A picture: `width * height` pixels, row by row, the top row first.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    width: u32,
    height: u32,
    pixels: Vec<Rgb>,
}

/// Why a picture could not be made, written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImageError {
    /// No pixels, or more than the limits allow.
    #[error(
        "a picture of {width} x {height} pixels is out of range; each side is 1 to \
         {SIDE_PIXELS_MAX} and the whole at most {PIXELS_MAX} pixels"
    )]
    Size {
        /// Width asked for, in pixels.
        width: u32,
        /// Height asked for, in pixels.
        height: u32,
    },
    /// The PNG encoder failed.
    #[error("the picture could not be written as PNG: {0}")]
    Encode(#[from] png::EncodingError),
    /// The bytes are not a PNG.
    #[error("the bytes could not be read as PNG: {0}")]
    Decode(#[from] png::DecodingError),
    /// A PNG, but not of the one kind that is written here.
    #[error("a PNG with 8-bit RGB pixels was expected, found {found}")]
    Format {
        /// Colour type and bit depth found.
        found: String,
    },
}

impl Image {
    /// A picture of one colour.
    ///
    /// # Errors
    /// [`ImageError::Size`] when a side is zero or a limit is passed.
    pub fn new(width: u32, height: u32, colour: Rgb) -> Result<Self, ImageError> {
        let count = width as usize * height as usize;
        if count == 0 || width.max(height) > SIDE_PIXELS_MAX || count > PIXELS_MAX {
            return Err(ImageError::Size { width, height });
        }
        Ok(Self { width, height, pixels: vec![colour; count] })
    }

    /// Width in pixels.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Height in pixels.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// All pixels, row by row, the top row first.
    pub fn pixels(&self) -> &[Rgb] {
        &self.pixels
    }

    /// All pixels, to be changed.
    pub fn pixels_mut(&mut self) -> &mut [Rgb] {
        &mut self.pixels
    }

    /// One pixel; black outside the picture.
    pub fn at(&self, x: u32, y: u32) -> Rgb {
        if x >= self.width || y >= self.height {
            return [0; 3];
        }
        self.pixels[(y * self.width + x) as usize]
    }

    /// Copies `from` into this picture, its upper left corner at `(x, y)`; what falls outside is
    /// left out.
    pub fn paste(&mut self, from: &Self, x: u32, y: u32) {
        let columns = from.width.min(self.width.saturating_sub(x)) as usize;
        let rows = from.height.min(self.height.saturating_sub(y));
        for row in 0..rows {
            let source = (row * from.width) as usize;
            let target = ((y + row) * self.width + x) as usize;
            self.pixels[target..target + columns]
                .copy_from_slice(&from.pixels[source..source + columns]);
        }
    }

    /// Fills a rectangle: upper left corner and size in pixels; what falls outside is left out.
    pub fn fill(&mut self, corner: [u32; 2], size: [u32; 2], colour: Rgb) {
        let right = corner[0].saturating_add(size[0]).min(self.width);
        let bottom = corner[1].saturating_add(size[1]).min(self.height);
        for y in corner[1]..bottom {
            for x in corner[0]..right {
                self.pixels[(y * self.width + x) as usize] = colour;
            }
        }
    }

    /// A straight line with soft edges and round ends; `from` and `to` in pixels, `thickness` in
    /// pixels. Ends that are not finite draw nothing.
    pub fn line(&mut self, from: [f32; 2], to: [f32; 2], thickness: f32, colour: Rgb) {
        if from.iter().chain(&to).any(|value| !value.is_finite()) {
            return;
        }
        let reach = 0.5 * thickness + 1.0;
        let span = |axis: usize, size: u32| {
            let low = (from[axis].min(to[axis]) - reach).max(0.0) as u32;
            let high = (from[axis].max(to[axis]) + reach).ceil().clamp(0.0, size as f32) as u32;
            low..high
        };
        let along = [to[0] - from[0], to[1] - from[1]];
        let square = (along[0] * along[0] + along[1] * along[1]).max(1e-12);
        for y in span(1, self.height) {
            for x in span(0, self.width) {
                let offset = [x as f32 + 0.5 - from[0], y as f32 + 0.5 - from[1]];
                let t = ((offset[0] * along[0] + offset[1] * along[1]) / square).clamp(0.0, 1.0);
                let distance = (offset[0] - t * along[0]).hypot(offset[1] - t * along[1]);
                let cover = (0.5 * thickness + 0.5 - distance).clamp(0.0, 1.0);
                self.mix(x, y, colour, cover);
            }
        }
    }

    /// One line of text, its upper left corner at `(x, y)`; `scale` pixels to a dot. Printable
    /// ASCII; anything else is drawn as a question mark.
    pub fn text(&mut self, corner: [u32; 2], scale: u32, colour: Rgb, text: &str) {
        let mut x = corner[0];
        for character in text.chars() {
            for (column, bits) in (0..).zip(font::glyph(character)) {
                for row in (0..8).filter(|row| bits >> row & 1 == 1) {
                    let dot = [x + column * scale, corner[1] + row * scale];
                    self.fill(dot, [scale, scale], colour);
                }
            }
            x = x.saturating_add(font::ADVANCE * scale);
            if x >= self.width {
                return;
            }
        }
    }

    /// Width and height of a line of text at this scale, in pixels.
    pub fn text_size(scale: u32, text: &str) -> [u32; 2] {
        let count = text.chars().count() as u32;
        [(count * font::ADVANCE).saturating_sub(1) * scale, font::HEIGHT * scale]
    }

    /// The picture as a PNG file, 8-bit RGB.
    ///
    /// # Errors
    /// [`ImageError::Encode`] when the encoder refuses.
    pub fn png(&self) -> Result<Vec<u8>, ImageError> {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, self.width, self.height);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(self.pixels.as_flattened())?;
        writer.finish()?;
        Ok(bytes)
    }

    /// Reads a PNG as [`Image::png`] writes it.
    ///
    /// # Errors
    /// [`ImageError::Decode`] when it is no PNG, [`ImageError::Format`] when its pixels are not
    /// 8-bit RGB, [`ImageError::Size`] when a limit is passed (before memory is taken).
    pub fn from_png(bytes: &[u8]) -> Result<Self, ImageError> {
        let mut reader = png::Decoder::new(Cursor::new(bytes)).read_info()?;
        let (width, height) = reader.info().size();
        let (colour, depth) = reader.output_color_type();
        if (colour, depth) != (png::ColorType::Rgb, png::BitDepth::Eight) {
            return Err(ImageError::Format { found: format!("{colour:?} {depth:?}") });
        }
        let mut image = Self::new(width, height, [0; 3])?;
        reader.next_frame(image.pixels.as_flattened_mut())?;
        Ok(image)
    }

    /// Mixes a colour into a pixel of the picture; `cover` from 0 (nothing) to 1 (all of it).
    fn mix(&mut self, x: u32, y: u32, colour: Rgb, cover: f32) {
        let pixel = &mut self.pixels[(y * self.width + x) as usize];
        for (old, new) in pixel.iter_mut().zip(colour) {
            *old = (f32::from(*old) + cover * (f32::from(new) - f32::from(*old))).round() as u8;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn png_reads_back() {
        let mut image = Image::new(37, 11, [1, 2, 3]).unwrap();
        image.line([2.0, 2.0], [30.0, 9.0], 1.5, [250, 128, 7]);
        assert_eq!(Image::from_png(&image.png().unwrap()).unwrap(), image);
    }

    #[test]
    fn damaged_png_is_refused() {
        let png = Image::new(20, 20, [9; 3]).unwrap().png().unwrap();
        for length in 0..png.len() - 12 {
            assert!(Image::from_png(&png[..length]).is_err(), "{length} bytes were accepted");
        }
        let mut wide = png;
        wide[16..20].copy_from_slice(&0x7fff_ffff_u32.to_be_bytes());
        assert!(Image::from_png(&wide).is_err());
    }

    #[test]
    fn sizes_out_of_range_are_refused() {
        assert!(matches!(Image::new(0, 4, [0; 3]), Err(ImageError::Size { .. })));
        assert!(Image::new(SIDE_PIXELS_MAX + 1, 1, [0; 3]).is_err());
        assert!(Image::new(SIDE_PIXELS_MAX, SIDE_PIXELS_MAX, [0; 3]).is_err());
    }

    #[test]
    fn text_is_legible() {
        let mut image = Image::new(11, 7, [0; 3]).unwrap();
        image.text([0, 0], 1, [255; 3], "E2");
        let drawn: Vec<String> = image
            .pixels()
            .chunks(11)
            .map(|row| row.iter().map(|pixel| if pixel[0] > 0 { '#' } else { '.' }).collect())
            .collect();
        let expected = [
            "#####..###.",
            "#.....#...#",
            "#.........#",
            "####.....#.",
            "#.......#..",
            "#......#...",
            "#####.#####",
        ];
        assert_eq!(drawn, expected);
        assert_eq!(Image::text_size(1, "E2"), [11, 7]);
    }

    #[test]
    fn drawing_stays_inside() {
        let mut image = Image::new(8, 8, [0; 3]).unwrap();
        image.text([5, 6], 3, [255; 3], "clipped");
        image.fill([7, 7], [u32::MAX, u32::MAX], [1; 3]);
        image.line([-1e9, -4.0], [1e9, 40.0], 2.0, [2; 3]);
        image.line([f32::NAN, 0.0], [1.0, 1.0], 2.0, [3; 3]);
        let other = image.clone();
        image.paste(&other, 6, 7);
        image.paste(&other, 60, 70);
        assert_eq!(image.at(90, 90), [0; 3]);
    }
}

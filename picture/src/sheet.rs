//! Contact sheets: many small pictures side by side, each with a caption.

use crate::image::{Image, ImageError, Rgb};

const GAP: u32 = 4;
const CAPTION: u32 = 13;
const PAPER: Rgb = [250, 250, 248];
const INK: Rgb = [40, 40, 44];

/// Pictures in the order they were pushed, row by row; a cell is as large as the largest picture.
#[derive(Clone, Debug)]
pub struct Sheet {
    columns: u32,
    title: String,
    cells: Vec<(Image, String)>,
}

impl Sheet {
    /// An empty sheet with that many columns (at least one).
    pub fn new(columns: u32) -> Self {
        Self { columns: columns.max(1), title: String::new(), cells: Vec::new() }
    }

    /// Puts a line in large letters above the pictures.
    pub fn titled(mut self, title: impl Into<String>) -> Self {
        self.title = title.into();
        self
    }

    /// Adds a picture and the line under it. A caption wider than its cell is cut.
    pub fn push(&mut self, picture: Image, caption: impl Into<String>) {
        self.cells.push((picture, caption.into()));
    }

    /// Pictures so far.
    pub fn count(&self) -> usize {
        self.cells.len()
    }

    /// The whole sheet as one picture.
    ///
    /// # Errors
    /// [`ImageError::Size`] when the sheet is larger than a picture may be.
    pub fn image(&self) -> Result<Image, ImageError> {
        let widest = self.cells.iter().map(|(image, _)| image.width()).max().unwrap_or(1);
        let highest = self.cells.iter().map(|(image, _)| image.height()).max().unwrap_or(1);
        let (wide, high) = (widest + GAP, highest + CAPTION + GAP);
        let count = u32::try_from(self.cells.len()).unwrap_or(u32::MAX);
        let columns = self.columns.min(count.max(1));
        let rows = count.div_ceil(columns);
        let head = if self.title.is_empty() { 0 } else { 22 };
        let width = columns.saturating_mul(wide).saturating_add(GAP);
        let height = rows.saturating_mul(high).saturating_add(GAP + head);
        let mut sheet = Image::new(width, height, PAPER)?;
        sheet.text([GAP, GAP], 2, INK, &self.title);
        for (index, (image, caption)) in (0..).zip(&self.cells) {
            let x = GAP + index % columns * wide;
            let y = GAP + head + index / columns * high;
            sheet.paste(image, x, y);
            let fit = widest.saturating_sub(2) as usize / crate::font::ADVANCE as usize;
            let line: String = caption.chars().take(fit).collect();
            sheet.text([x + 2, y + highest + 3], 1, INK, &line);
        }
        Ok(sheet)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_and_captions_land_in_their_cells() {
        let mut sheet = Sheet::new(3);
        for shade in 0..5 {
            sheet.push(Image::new(40, 30, [shade, 0, 0]).unwrap(), format!("n {shade}"));
        }
        let whole = sheet.image().unwrap();
        assert_eq!((whole.width(), whole.height()), (3 * 44 + 4, 2 * 47 + 4));
        for shade in 0..5_u8 {
            let (column, row) = (u32::from(shade) % 3, u32::from(shade) / 3);
            let (x, y) = (4 + column * 44, 4 + row * 47);
            assert_eq!(whole.at(x + 20, y + 15), [shade, 0, 0]);
            let size = Image::text_size(1, "n 0");
            let caption = (0..size[1]).flat_map(|dy| (0..size[0]).map(move |dx| (dx, dy)));
            let drawn = caption.filter(|(dx, dy)| whole.at(x + 2 + dx, y + 33 + dy) == INK);
            assert!(drawn.count() > 20, "no caption under picture {shade}");
        }
        assert_eq!(whole.at(4 + 2 * 44 + 20, 4 + 47 + 15), PAPER);
    }

    #[test]
    fn long_captions_are_cut_and_empty_sheets_are_paper() {
        let mut sheet = Sheet::new(1).titled("title");
        assert!(sheet.image().is_ok());
        sheet.push(Image::new(20, 10, [0; 3]).unwrap(), "x".repeat(10_000));
        assert_eq!(sheet.image().unwrap().width(), 28);
        assert_eq!(sheet.count(), 1);
    }
}

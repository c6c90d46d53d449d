//! A basis generation in bytes: columns predicted from coarse to fine and range-coded.

use super::ENTRIES_MAX;
use super::model::{COLUMN_BYTES, Column};
use super::tree::{Tree, TreeError};
use crate::entropy::{Integers, Reader, Writer, scale_of};
use crate::{COLUMNS_MAX, ROWS_MAX, kim2013};

const MAGIC: [u8; 4] = *b"TtBg";
const VERSION: u16 = 1;
const HEADER_BYTES: usize = 32;
const ENTRY_MAX: i32 = 32_767;

/// Why a generation could not be encoded or decoded.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum GenerationError {
    /// Another number of bytes than the header asks for.
    #[error("toile basis generation of {actual} bytes, but its header asks for {expected}")]
    Length {
        /// Bytes that the header asks for.
        expected: u64,
        /// Bytes given.
        actual: u64,
    },
    /// Not a basis generation of this profile.
    #[error("not a toile basis generation: it begins with {0:02x?}")]
    Magic([u8; 4]),
    /// A version that this build does not know.
    #[error("toile basis generation of version {0}; this build reads version {VERSION}")]
    Version(u16),
    /// Rows or columns outside the limits, or not three rows a vertex.
    #[error(
        "toile basis generation of {rows} rows and {columns} columns; allowed are whole vertices \
             up to {ROWS_MAX} rows, 1..={COLUMNS_MAX} columns and {ENTRIES_MAX} entries"
    )]
    Shape {
        /// Rows.
        rows: u64,
        /// Columns.
        columns: u64,
    },
    /// A step that is not positive and finite.
    #[error("toile basis generation with a step of {0} m")]
    Step(f32),
    /// A column whose maximum is not positive and finite, or whose multiple is 0.
    #[error("column {column} has the maximum {maximum_m} m and the multiple {multiple}")]
    Column {
        /// Which column.
        column: usize,
        /// Its maximum (m).
        maximum_m: f32,
        /// Its multiple.
        multiple: u8,
    },
    /// An entry that is not finite or does not fit 16 bits.
    #[error("column {column}: entry {entry} is {value_m} m, more than 32,767 steps or no number")]
    Entry {
        /// Which column.
        column: usize,
        /// Which row.
        entry: usize,
        /// What stands there (m).
        value_m: f32,
    },
    /// Generations after the first need the order of the first.
    #[error("an appended generation needs the vertex order of the first one")]
    NoTree,
    /// The order of another garment.
    #[error("a vertex order of {tree} vertices for a basis of {rows} rows")]
    OtherTree {
        /// Vertices of the order.
        tree: usize,
        /// Rows of the basis.
        rows: usize,
    },
    /// An order that is none.
    #[error(transparent)]
    Tree(#[from] TreeError),
}

/// What a generation is made from.
#[derive(Debug, Clone, Copy)]
pub struct GenerationParts<'a> {
    /// Metres of one step of an entry.
    pub step_m: f32,
    /// What is known of each column.
    pub columns: &'a [Column],
    /// Column after column, `3 * vertices` numbers each: contribution of each row (m) where the
    /// coefficient is at full scale (the orthonormal column times its maximum).
    pub values_m: &'a [f32],
    /// Code of the coefficients' step that was chosen with these columns, see
    /// [`super::step_m`]. Regions state their own.
    pub step: u8,
    /// States that the columns were made from.
    pub states: u32,
    /// Root mean square vertex error (m) that the columns were made for.
    pub rms_m: f32,
    /// Coarse to fine.
    pub tree: &'a Tree,
    /// Whether the order is part of the bytes, as in a first generation.
    pub with_tree: bool,
}

/// A decoded generation.
#[derive(Debug, Clone, PartialEq)]
pub struct Generation {
    rows: usize,
    step_m: f32,
    step: u8,
    made: (u32, f32),
    columns: Vec<Column>,
    entries: Vec<i16>,
    tree: Option<Tree>,
}

impl Generation {
    /// Rows: three per vertex.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// What is known of each column.
    pub fn columns(&self) -> &[Column] {
        &self.columns
    }

    /// Metres of one step of an entry.
    pub fn step_m(&self) -> f32 {
        self.step_m
    }

    /// Code of the coefficients' step that was chosen with these columns.
    pub fn step(&self) -> u8 {
        self.step
    }

    /// States that the columns were made from.
    pub fn states(&self) -> u32 {
        self.made.0
    }

    /// Root mean square vertex error (m) that the columns were made for.
    pub fn rms_m(&self) -> f32 {
        self.made.1
    }

    /// Column after column, `rows` entries each, in steps where the coefficient is at full scale.
    pub fn entries(&self) -> &[i16] {
        &self.entries
    }

    /// The vertex order, where these bytes hold it.
    pub fn tree(&self) -> Option<&Tree> {
        self.tree.as_ref()
    }

    /// The same columns as a generation of profile `kim2013`, which is the resident form.
    pub fn to_resident(&self) -> Vec<u8> {
        let maxima: Vec<f32> = self.columns.iter().map(|column| column.maximum_m).collect();
        let mut bytes = Vec::new();
        let (rows, step_m) = (self.rows as u32, self.step_m);
        kim2013::encode_generation(rows, step_m, &maxima, &self.entries, &mut bytes)
            .expect("whatever decodes here is within the limits of the resident form");
        bytes
    }
}

/// Writes a generation to the end of `out`. The entries are rounded as they are predicted: read
/// them back with [`parse_generation`].
///
/// # Errors
/// Parts outside the limits or that do not fit each other. `out` is then as before.
pub fn encode_generation(
    parts: &GenerationParts<'_>,
    out: &mut Vec<u8>,
) -> Result<(), GenerationError> {
    let rows = 3 * parts.tree.vertices();
    check_shape(rows, parts.columns.len())?;
    check_columns(parts.step_m, parts.columns)?;
    if parts.values_m.len() != rows * parts.columns.len() {
        let (expected, actual) = (rows * parts.columns.len(), parts.values_m.len());
        return Err(GenerationError::Length { expected: expected as u64, actual: actual as u64 });
    }
    for (at, value_m) in parts.values_m.iter().enumerate() {
        let fits = (value_m / parts.step_m).abs() <= ENTRY_MAX as f32 - 256.0;
        if !fits {
            let (column, entry, value_m) = (at / rows, at % rows, *value_m);
            return Err(GenerationError::Entry { column, entry, value_m });
        }
    }
    let mut writer = Writer::new();
    if parts.with_tree {
        parts.tree.write(&mut writer);
    }
    let mut coder = Coder::new(parts.tree);
    for (column, values_m) in parts.columns.iter().zip(parts.values_m.chunks_exact(rows)) {
        let multiple = i32::from(column.multiple);
        coder.column(|vertex, axis, predicted, model, scale| {
            let exact = values_m[3 * vertex + axis] / parts.step_m;
            let rest = ((exact - predicted as f32) / multiple as f32).round() as i32;
            model.write(&mut writer, scale, rest);
            (rest, (predicted + rest * multiple).clamp(-ENTRY_MAX, ENTRY_MAX))
        });
    }
    let payload = writer.finish();
    out.extend_from_slice(&MAGIC);
    out.extend_from_slice(&VERSION.to_le_bytes());
    out.extend_from_slice(&(parts.columns.len() as u16).to_le_bytes());
    out.extend_from_slice(&(rows as u32).to_le_bytes());
    out.extend_from_slice(&parts.step_m.to_le_bytes());
    out.extend_from_slice(&[u8::from(parts.with_tree), parts.step, 0, 0]);
    out.extend_from_slice(&(payload.len() as u32).to_le_bytes());
    out.extend_from_slice(&parts.states.to_le_bytes());
    out.extend_from_slice(&parts.rms_m.to_le_bytes());
    parts.columns.iter().for_each(|column| out.extend_from_slice(&column.to_bytes()));
    out.extend_from_slice(&payload);
    Ok(())
}

/// Reads a generation. `tree` is the order of the garment's first generation, where it is not
/// this one.
///
/// Cost: some 20 ns an entry. Memory: two bytes an entry, at most 256 MiB.
///
/// # Errors
/// Bytes that are not exactly one generation of this version.
pub fn parse_generation(bytes: &[u8], tree: Option<&Tree>) -> Result<Generation, GenerationError> {
    let actual = bytes.len() as u64;
    let short = |expected: usize| GenerationError::Length { expected: expected as u64, actual };
    let (header, rest) = bytes.split_first_chunk::<HEADER_BYTES>().ok_or(short(HEADER_BYTES))?;
    let word =
        |at: usize| -> [u8; 4] { [header[at], header[at + 1], header[at + 2], header[at + 3]] };
    if word(0) != MAGIC {
        return Err(GenerationError::Magic(word(0)));
    }
    let version = u16::from_le_bytes([header[4], header[5]]);
    if version != VERSION {
        return Err(GenerationError::Version(version));
    }
    let count = usize::from(u16::from_le_bytes([header[6], header[7]]));
    let rows = u32::from_le_bytes(word(8)) as usize;
    let step_m = f32::from_le_bytes(word(12));
    let [flags, step, reserved @ ..] = word(16);
    let payload_bytes = u32::from_le_bytes(word(20)) as usize;
    let states = u32::from_le_bytes(word(24));
    let rms_m = f32::from_le_bytes(word(28));
    check_shape(rows, count)?;
    let expected = HEADER_BYTES + COLUMN_BYTES * count + payload_bytes;
    if bytes.len() != expected || flags > 1 || reserved != [0, 0] {
        return Err(short(expected));
    }
    let (columns, payload) = rest.split_at(COLUMN_BYTES * count);
    let columns: Vec<Column> =
        columns.as_chunks::<COLUMN_BYTES>().0.iter().map(Column::from_bytes).collect();
    check_columns(step_m, &columns)?;
    let mut reader = Reader::new(payload);
    let own = if flags == 1 { Some(Tree::read(&mut reader, rows / 3)?) } else { None };
    let tree = own.as_ref().or(tree).ok_or(GenerationError::NoTree)?;
    if 3 * tree.vertices() != rows {
        return Err(GenerationError::OtherTree { tree: tree.vertices(), rows });
    }
    let mut entries = vec![0i16; rows * count];
    let mut coder = Coder::new(tree);
    for (column, entries) in columns.iter().zip(entries.chunks_exact_mut(rows)) {
        let multiple = i32::from(column.multiple);
        coder.column(|vertex, axis, predicted, model, scale| {
            let rest = model.read(&mut reader, scale).clamp(-2 * ENTRY_MAX, 2 * ENTRY_MAX);
            let entry = (predicted + rest * multiple).clamp(-ENTRY_MAX, ENTRY_MAX);
            entries[3 * vertex + axis] = entry as i16;
            (rest, entry)
        });
    }
    let made = (states, rms_m);
    Ok(Generation { rows, step_m, step, made, columns, entries, tree: own })
}

/// What predicts, the same for both directions.
struct Coder<'a> {
    tree: &'a Tree,
    model: Integers,
    /// By place and axis: entries of the column at hand.
    entries: Vec<i32>,
    /// Sizes of what prediction left: of this column, the one before, and the one before that.
    sizes: [Vec<u32>; 3],
}

impl<'a> Coder<'a> {
    fn new(tree: &'a Tree) -> Self {
        let rows = 3 * tree.vertices();
        let sizes = [vec![0; rows], vec![0; rows], vec![0; rows]];
        Self { tree, model: Integers::new(), entries: vec![0; rows], sizes }
    }

    /// Goes over a column. `code` gets vertex, axis, prediction, model and scale, and returns what
    /// was left and the entry.
    fn column(
        &mut self,
        mut code: impl FnMut(usize, usize, i32, &mut Integers, usize) -> (i32, i32),
    ) {
        self.sizes.rotate_right(1);
        let [now, before, older] = &mut self.sizes;
        for (place, vertex) in self.tree.order().iter().enumerate() {
            let parents = self.tree.parents(place);
            let count = parents.len().max(1) as i32;
            let mut axes = 0;
            for axis in 0..3 {
                let at = 3 * place + axis;
                let of = |parent: &u32| 3 * *parent as usize + axis;
                let sum: i32 = parents.iter().map(|p| self.entries[of(p)]).sum();
                let near: u32 = parents.iter().map(|p| now[of(p)]).sum();
                let expected =
                    128 * near / count as u32 + 64 * before[at] + 26 * older[at] + axes + 8;
                let predicted = (sum + count / 2).div_euclid(count);
                let scale = scale_of(expected);
                let (rest, entry) = code(*vertex as usize, axis, predicted, &mut self.model, scale);
                now[at] = rest.unsigned_abs().min(1 << 16);
                self.entries[at] = entry;
                axes = 38 * now[at];
            }
        }
    }
}

fn check_shape(rows: usize, columns: usize) -> Result<(), GenerationError> {
    let fits = rows > 0
        && rows.is_multiple_of(3)
        && rows <= ROWS_MAX
        && (1..=COLUMNS_MAX).contains(&columns)
        && rows * columns <= ENTRIES_MAX;
    if fits {
        return Ok(());
    }
    Err(GenerationError::Shape { rows: rows as u64, columns: columns as u64 })
}

fn check_columns(step_m: f32, columns: &[Column]) -> Result<(), GenerationError> {
    if !(step_m.is_finite() && step_m > 0.0) {
        return Err(GenerationError::Step(step_m));
    }
    for (index, column) in columns.iter().enumerate() {
        let (maximum_m, multiple) = (column.maximum_m, column.multiple);
        if !(maximum_m.is_finite() && maximum_m > 0.0 && multiple > 0) {
            return Err(GenerationError::Column { column: index, maximum_m, multiple });
        }
    }
    Ok(())
}

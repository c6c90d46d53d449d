//! A region in bytes: predicted, range-coded coefficients of consecutive states, their fixes, and
//! what shorter lists of columns cost.

use super::model::{FrameKind, Model};
use super::{FIXES_MAX, UNIT_M};
use crate::entropy::{self, Bit, Integers, Reader, SCALE_ONE, Writer};
use crate::kim2013::FULL_SCALE;
use crate::{COLUMNS_MAX, REGION_STATES_MAX};

const VERSION: u16 = 2;
/// The header of version 1, which lacks the error of the leading columns.
const HEADER_BYTES_1: usize = 18;
const HEADER_BYTES: usize = 20;
/// Columns of the tiers: the 16, 32, 64, 128 that carry most in the region at hand.
pub const TIERS: [usize; 4] = [16, 32, 64, 128];
/// Unit of the errors of tiers (m): an eighth of a millimetre and less.
const TIER_UNIT_M: f32 = 1.0 / 8192.0;
/// Expected sizes of fixes and of their number, as scales.
const FIX_SCALE: usize = SCALE_ONE + 2;
const COUNT_SCALE: usize = SCALE_ONE + 8;
/// Activity beyond this many times the expected one is taken for this.
const ACTIVITY_MAX: u32 = 6;
/// A coefficient is within this many steps.
const STEPS_MAX: i32 = 1 << 28;

/// Why a region could not be encoded or decoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RegionError {
    /// More or fewer bytes than the header asks for.
    #[error("toile region of {actual} bytes, which is not what its header asks for")]
    Length {
        /// Bytes given.
        actual: usize,
    },
    /// A version that this build does not know.
    #[error("toile region of version {0}; this build reads versions 1 and {VERSION}")]
    Version(u16),
    /// Outside the limits, or more columns than the basis has.
    #[error(
        "toile region of {states} states and {columns} columns; allowed are \
             1..={REGION_STATES_MAX} states, and columns up to the {known} of the basis"
    )]
    Shape {
        /// States.
        states: usize,
        /// Columns.
        columns: usize,
        /// Columns of the basis.
        known: usize,
    },
    /// A coefficient too large for its step.
    #[error("coefficient {0} does not fit; take a larger step")]
    Steps(usize),
    /// A fix of a state or vertex that is not there, out of order, or too many of them.
    #[error("fix {0} is of no state or vertex, out of order, or one too many")]
    Fix(usize),
}

/// A vertex of a state that is moved after reconstruction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fix {
    /// Place in the region.
    pub state: u16,
    /// Which vertex.
    pub vertex: u32,
    /// By how much, in steps of the region's fixes.
    pub steps: [i32; 3],
}

/// What a region is made from.
#[derive(Debug, Clone, Copy)]
pub struct RegionParts<'a> {
    /// Columns of all generations up to the region's.
    pub columns: usize,
    /// Code of the coefficients' step, see [`step_m`].
    pub step: u8,
    /// State after state, in steps over the orthonormal columns.
    pub coefficients: &'a [i32],
    /// Code of the fixes' step, see [`step_m`].
    pub fix_step: u8,
    /// By state, then vertex.
    pub fixes: &'a [Fix],
    /// Largest vertex error (m) with the [`TIERS`] columns that carry most, fixes left out.
    pub tier_errors_m: [f32; TIERS.len()],
    /// Largest vertex error (m) with the columns of the garment's first generation alone.
    pub leading_error_m: f32,
}

/// A decoded region.
#[derive(Debug, Clone, PartialEq)]
pub struct Region {
    states: usize,
    columns: usize,
    whole: bool,
    coefficients: Vec<i16>,
    by_energy: Vec<u16>,
    fix_step_m: f32,
    fixes: Vec<Fix>,
    tier_errors_m: [f32; TIERS.len()],
    leading_error_m: Option<f32>,
}

impl Region {
    /// How many states.
    pub fn states(&self) -> usize {
        self.states
    }

    /// Columns of all generations up to the region's, as far as the reader knows them.
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// Whether the reader knew all of its columns; else only the leading ones were read, and no
    /// fix.
    pub fn is_whole(&self) -> bool {
        self.whole
    }

    /// State after state: fractions of full scale in steps of 1/32,767, as `kim2013` has them.
    pub fn coefficients(&self) -> &[i16] {
        &self.coefficients
    }

    /// Gives the coefficients away, as [`Region::coefficients`] shows them.
    pub fn into_coefficients(self) -> Vec<i16> {
        self.coefficients
    }

    /// The columns that are not zero here, those that carry most first.
    pub fn by_energy(&self) -> &[u16] {
        &self.by_energy
    }

    /// Metres of a step of a fix.
    pub fn fix_step_m(&self) -> f32 {
        self.fix_step_m
    }

    /// Vertices to be moved after reconstruction, by state, then vertex.
    pub fn fixes(&self) -> &[Fix] {
        &self.fixes
    }

    /// Largest vertex error (m) with the first [`TIERS`] columns of [`Region::by_energy`], fixes
    /// left out; rounded up.
    pub fn tier_errors_m(&self) -> [f32; TIERS.len()] {
        self.tier_errors_m
    }

    /// Largest vertex error (m) with the columns of the garment's first generation alone, fixes
    /// left out; rounded up. `None` in regions of version 1, and where it is 8 m and more.
    pub fn leading_error_m(&self) -> Option<f32> {
        self.leading_error_m
    }

    /// Adds a state's fixes to its positions (m).
    ///
    /// # Panics
    /// `positions` must hold all vertices.
    pub fn fix(&self, state: usize, positions: &mut [f32]) {
        let first = self.fixes.partition_point(|fix| usize::from(fix.state) < state);
        for fix in self.fixes[first..].iter().take_while(|fix| usize::from(fix.state) == state) {
            let vertex = &mut positions[3 * fix.vertex as usize..][..3];
            for (x, steps) in vertex.iter_mut().zip(fix.steps) {
                *x += steps as f32 * self.fix_step_m;
            }
        }
    }
}

/// Metres of a step of this code: quarter octaves of 2^-20 m.
pub fn step_m(code: u8) -> f32 {
    (f64::from(UNIT_M) * entropy::from_quarter_octaves(i32::from(code))) as f32
}

/// Writes a region to the end of `out`.
///
/// # Errors
/// A shape outside the limits, numbers too large, fixes out of order. `out` is then as before.
pub fn encode_region(
    model: &Model,
    parts: &RegionParts<'_>,
    out: &mut Vec<u8>,
) -> Result<(), RegionError> {
    let columns = parts.columns;
    let states = parts.coefficients.len().checked_div(columns).unwrap_or(0);
    check_shape(states, columns, model.columns().len())?;
    if parts.coefficients.len() != states * columns {
        return Err(RegionError::Shape { states, columns, known: model.columns().len() });
    }
    if let Some(at) = parts.coefficients.iter().position(|q| q.unsigned_abs() > STEPS_MAX as u32) {
        return Err(RegionError::Steps(at));
    }
    check_fixes(parts.fixes, states, model.vertices())?;
    let mut writer = Writer::new();
    let mut integers = Integers::new();
    let mut flags = Flags::new();
    let mut walk = Walk::new(model, parts.step, states);
    for column in 0..columns {
        let of_column = || parts.coefficients.iter().skip(column).step_by(columns);
        let used = of_column().any(|steps| *steps != 0);
        writer.bit(used, flags.of(model, column, parts.step));
        if !used {
            continue;
        }
        walk.begin(column);
        for (state, steps) in of_column().enumerate() {
            let (predicted, scale) = walk.expect(state);
            let rest = steps - predicted;
            integers.write(&mut writer, scale, rest);
            walk.meet(state, rest, *steps);
        }
    }
    write_fixes(&mut writer, &mut integers, parts.fixes, states, model.vertices());
    let payload = writer.finish();
    out.extend_from_slice(&VERSION.to_le_bytes());
    out.extend_from_slice(&(columns as u16).to_le_bytes());
    out.push(states as u8);
    out.push(parts.step);
    out.push(parts.fix_step);
    out.push(u8::from(!parts.fixes.is_empty()));
    for error_m in parts.tier_errors_m.into_iter().chain([parts.leading_error_m]) {
        let code = (error_m / TIER_UNIT_M).ceil().clamp(0.0, f32::from(u16::MAX)) as u16;
        out.extend_from_slice(&code.to_le_bytes());
    }
    out.extend_from_slice(&(payload.len() as u16).to_le_bytes());
    out.extend_from_slice(&payload);
    Ok(())
}

/// Reads a region of a basis whose columns `model` knows, or whose leading columns it knows.
///
/// # Errors
/// Bytes that are no region of this version and basis.
pub fn parse_region(bytes: &[u8], model: &Model) -> Result<Region, RegionError> {
    let length = RegionError::Length { actual: bytes.len() };
    let version = bytes.first_chunk::<2>().map(|b| u16::from_le_bytes(*b)).ok_or(length)?;
    let header_bytes = match version {
        1 => HEADER_BYTES_1,
        VERSION => HEADER_BYTES,
        _ => return Err(RegionError::Version(version)),
    };
    let (header, payload) = bytes.split_at_checked(header_bytes).ok_or(length)?;
    let number = |at: usize| u16::from_le_bytes([header[at], header[at + 1]]);
    let (columns, states) = (usize::from(number(2)), usize::from(header[4]));
    check_shape(states, columns, COLUMNS_MAX)?;
    if number(header_bytes - 2) != payload.len() as u16 || header[7] > 1 {
        return Err(length);
    }
    let step = header[5];
    let tier = |i: usize| f32::from(number(8 + 2 * i)) * TIER_UNIT_M;
    let tier_errors_m = [tier(0), tier(1), tier(2), tier(3)];
    let stated = version > 1 && number(16) < u16::MAX;
    let leading_error_m = stated.then(|| tier(4));
    let mut reader = Reader::new(payload);
    let mut integers = Integers::new();
    let mut flags = Flags::new();
    let mut walk = Walk::new(model, step, states);
    let known = columns.min(model.columns().len());
    let mut coefficients = vec![0i16; states * known];
    let mut energies: Vec<(u64, u16)> = Vec::new();
    for column in 0..known {
        if !reader.bit(flags.of(model, column, step)) {
            continue;
        }
        walk.begin(column);
        let full = full_scale(model, column, step);
        let mut energy = 0u64;
        for state in 0..states {
            let (predicted, scale) = walk.expect(state);
            let rest = integers.read(&mut reader, scale);
            let steps = predicted.saturating_add(rest).clamp(-STEPS_MAX, STEPS_MAX);
            walk.meet(state, rest, steps);
            coefficients[state * known + column] = in_full_scale(steps, full);
            energy = energy.saturating_add(u64::from(steps.unsigned_abs()).pow(2));
        }
        energies.push((energy, column as u16));
    }
    let whole = known == columns;
    let fixes = match header[7] {
        1 if whole => read_fixes(&mut reader, &mut integers, states, model.vertices())?,
        _ => Vec::new(),
    };
    energies.sort_by_key(|(energy, column)| (std::cmp::Reverse(*energy), *column));
    let by_energy = energies.into_iter().map(|(_, column)| column).collect();
    let fix_step_m = step_m(header[6]);
    let columns = known;
    Ok(Region {
        states,
        columns,
        whole,
        coefficients,
        by_energy,
        fix_step_m,
        fixes,
        tier_errors_m,
        leading_error_m,
    })
}

/// Fractions of full scale (in steps of 1/32,767) of one step of a column's coefficient.
fn full_scale(model: &Model, column: usize, step: u8) -> f64 {
    let step_m = f64::from(UNIT_M) * entropy::from_quarter_octaves(i32::from(step));
    step_m * f64::from(FULL_SCALE) / f64::from(model.columns()[column].maximum_m)
}

fn in_full_scale(steps: i32, full: f64) -> i16 {
    let exact = f64::from(steps) * full;
    exact.round().clamp(-f64::from(FULL_SCALE), f64::from(FULL_SCALE)) as i16
}

/// Probabilities that a column is used at all, by its size.
struct Flags([Bit; 8]);

impl Flags {
    fn new() -> Self {
        Self([0.97, 0.9, 0.75, 0.5, 0.25, 0.1, 0.03, 0.01].map(Bit::new))
    }

    fn of(&mut self, model: &Model, column: usize, step: u8) -> &mut Bit {
        let size = i32::from(model.columns()[column].sizes[0]) - i32::from(step);
        &mut self.0[(size + 16).clamp(0, 31) as usize / 4]
    }
}

/// What comes next, the same for both directions: column after column, so that who knows only the
/// leading ones reads these.
struct Walk<'a> {
    model: &'a Model,
    step: i32,
    column: usize,
    /// The two states before in this column, the newest first, and what prediction left there.
    before: [i32; 2],
    rest: u32,
    /// By state: sizes met over sizes expected, in 256ths, over the last columns.
    activity: Vec<i32>,
    expected: u32,
}

impl<'a> Walk<'a> {
    fn new(model: &'a Model, step: u8, states: usize) -> Self {
        let (step, activity) = (i32::from(step), vec![256; states]);
        Self { model, step, column: 0, before: [0; 2], rest: 0, activity, expected: 0 }
    }

    fn begin(&mut self, column: usize) {
        (self.column, self.before, self.rest) = (column, [0; 2], 0);
    }

    /// The prediction of a state's coefficient, and the scale of what it leaves.
    fn expect(&mut self, state: usize) -> (i32, usize) {
        let kind = FrameKind::at(state);
        let known = &self.model.columns()[self.column];
        let predicted = known.predict(kind, self.before);
        let scale = SCALE_ONE as i32 + i32::from(known.sizes[kind as usize]) - self.step;
        let scale = scale.clamp(0, entropy::SCALES as i32 - 1) as usize;
        self.expected = entropy::size_256ths(scale);
        let mut size = (u64::from(self.expected) * self.activity[state] as u64) >> 8;
        if state > 2 {
            size = (13 * size + 3 * (u64::from(self.rest) << 8)) >> 4;
        }
        (predicted, entropy::scale_of(u32::try_from(size).unwrap_or(u32::MAX)))
    }

    fn meet(&mut self, state: usize, rest: i32, value: i32) {
        self.before = [value, self.before[0]];
        self.rest = rest.unsigned_abs().min(1 << 20);
        // Columns that are mostly zero say little.
        if self.expected >= 64 {
            let ratio = (u64::from(self.rest) << 16) / u64::from(self.expected);
            let ratio = ratio.min(u64::from(256 * ACTIVITY_MAX)) as i32;
            self.activity[state] += (ratio - self.activity[state]) >> 5;
        }
    }
}

fn write_fixes(
    writer: &mut Writer,
    integers: &mut Integers,
    fixes: &[Fix],
    states: usize,
    vertices: usize,
) {
    if fixes.is_empty() {
        return;
    }
    let mut rest = fixes;
    for state in 0..states {
        let count = rest.partition_point(|fix| usize::from(fix.state) <= state);
        let (own, after) = rest.split_at(count);
        rest = after;
        integers.write(writer, COUNT_SCALE, count as i32);
        let scale = gap_scale(vertices, count);
        let mut next = 0;
        for fix in own {
            integers.write(writer, scale, (fix.vertex - next) as i32);
            fix.steps.iter().for_each(|s| integers.write(writer, FIX_SCALE, *s));
            next = fix.vertex + 1;
        }
    }
}

fn read_fixes(
    reader: &mut Reader<'_>,
    integers: &mut Integers,
    states: usize,
    vertices: usize,
) -> Result<Vec<Fix>, RegionError> {
    let mut fixes = Vec::new();
    for state in 0..states as u16 {
        let count = integers.read(reader, COUNT_SCALE);
        let count = usize::try_from(count).unwrap_or(usize::MAX);
        if count > vertices || fixes.len() + count > FIXES_MAX {
            return Err(RegionError::Fix(fixes.len()));
        }
        let scale = gap_scale(vertices, count);
        let mut next = 0u32;
        for _ in 0..count {
            let gap = u32::try_from(integers.read(reader, scale)).unwrap_or(u32::MAX);
            let vertex = next.saturating_add(gap);
            if vertex as usize >= vertices {
                return Err(RegionError::Fix(fixes.len()));
            }
            let mut read = || integers.read(reader, FIX_SCALE);
            fixes.push(Fix { state, vertex, steps: [read(), read(), read()] });
            next = vertex + 1;
        }
    }
    Ok(fixes)
}

fn gap_scale(vertices: usize, count: usize) -> usize {
    let mean = (256 * vertices as u64) / (count as u64 + 1);
    entropy::scale_of(mean.min(u64::from(u32::MAX)) as u32)
}

fn check_shape(states: usize, columns: usize, known: usize) -> Result<(), RegionError> {
    let fits = (1..=REGION_STATES_MAX).contains(&states)
        && (1..=COLUMNS_MAX).contains(&columns)
        && columns <= known;
    if fits { Ok(()) } else { Err(RegionError::Shape { states, columns, known }) }
}

fn check_fixes(fixes: &[Fix], states: usize, vertices: usize) -> Result<(), RegionError> {
    let key = |fix: &Fix| (fix.state, fix.vertex);
    for (at, fix) in fixes.iter().enumerate() {
        let there = usize::from(fix.state) < states && (fix.vertex as usize) < vertices;
        let sorted = at == 0 || key(&fixes[at - 1]) < key(fix);
        if !(there && sorted && at < FIXES_MAX) {
            return Err(RegionError::Fix(at));
        }
    }
    Ok(())
}

//! A learned upsampler as a client holds it (Kavan et al. 2011, sections 3, 5 and 6).
//!
//! Fine positions are `U p_c`, plus oscillatory modes along the normals, and where a garment follows
//! the body they go over into skinning. Beside U this keeps what the coarse simulation needs:
//! mesh, pins, capsules and constants, as plain numbers; what simulates is not this crate's matter.
//! [`Parts::encode`] and [`Upsampler::decode`] are the stored form (docs/formats.md).

mod bytes;
mod rounding;
mod run;

pub use run::{Drive, Workspace};

use crate::kernel::normals::Faces;
use crate::kernel::operator::{COARSE_MAX, FINE_MAX, Operator, OperatorError};

/// Steps of U, all rows together.
pub const STEPS_MAX: usize = 1 << 24;
/// Capsules that the coarse cloth keeps off.
pub const CAPSULES_MAX: usize = 64;
/// Oscillatory modes.
pub const MODES_MAX: usize = 16;
/// Rules that divide states into classes.
pub const CLASSES_MAX: usize = 7;
/// Joints that a pin, capsule or vertex may name.
pub const JOINTS_MAX: usize = 1024;
/// Full weight of a joint, and full share of the skin.
pub const WHOLE: u16 = u16::MAX;
/// Largest coordinate of a rest shape (m).
const FAR_M: f32 = 1e3;
/// Largest sum of absolute weights of a row that is worth applying.
const ROW_WEIGHTS_MAX: f32 = 1e3;

/// A 3 x 4 transform, row after row: rotation and translation (m).
pub type Transform = [[f32; 4]; 3];

/// Up to four joints and their shares, which sum to [`WHOLE`].
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Binding {
    /// The joints.
    pub joints: [u16; 4],
    /// Their shares.
    pub shares: [u16; 4],
}

/// Where a coarse point lies on the fine cloth: the way from a fine state to a coarse one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// Three fine vertices.
    pub vertices: [u32; 3],
    /// Weights of the first two; the third has what is left to 1.
    pub weights: [f32; 2],
}

/// A coarse point that is led by the body.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pin {
    /// The point.
    pub point: u16,
    /// What leads it from its rest position.
    pub binding: Binding,
}

/// A capsule in its joint's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Capsule {
    /// The joint.
    pub joint: u16,
    /// Both ends (m).
    pub ends: [[f32; 3]; 2],
    /// Radius (m).
    pub radius: f32,
}

/// A fine vertex that goes over into skinning.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Skin {
    /// The vertex.
    pub vertex: u32,
    /// How much of it follows the skin; [`WHOLE`]: all.
    pub share: u16,
    /// What leads it.
    pub binding: Binding,
    /// Where it lies in the rest pose (m).
    pub rest: [f32; 3],
    /// Out of the body, in the rest pose; zero where nothing holds the vertex off it.
    pub normal: [f32; 3],
    /// Along it from where the skin leads the vertex, it never lies lower (m).
    pub floor_m: f32,
}

impl Skin {
    /// Whether something holds the vertex off the body.
    pub fn is_guarded(&self) -> bool {
        self.normal.iter().any(|x| *x != 0.0)
    }
}

/// A coarse point that the skin leaves some room: cloth near the body neither leaves it nor gets
/// into it, whatever gap there is between colliders.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tether {
    /// Which point.
    pub point: u16,
    /// What leads its rest position.
    pub binding: Binding,
    /// How far from there it gets (m).
    pub reach_m: f32,
    /// Out of the body, in the rest pose.
    pub normal: [f32; 3],
    /// Along it from there, it never lies lower (m).
    pub floor_m: f32,
}

/// Where a tether is in a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Held {
    /// Where the skin leads the point (m).
    pub at: [f32; 3],
    /// Unit vector out of the body; zero where there is none.
    pub normal: [f32; 3],
}

/// A pair of oscillatory modes (Kavan et al. 2011, section 5).
#[derive(Debug, Clone, PartialEq)]
pub struct Mode {
    /// Oscillations a second (Hz).
    pub frequency_hz: f32,
    /// How fast its amplitude follows the wind (1/s).
    pub damping_per_s: f32,
    /// Speed of the air at which it was learned (m/s): below it the amplitude is less in proportion,
    /// above it no more. 0: it is there in a calm as well.
    pub wind_m_s: f32,
    /// What a step of an amplitude stands for (m).
    pub unit_m: f32,
    /// For each fine vertex the amplitudes of sine and cosine along its normal (steps).
    pub amplitudes: Vec<[i16; 2]>,
}

/// A rule that divides states into two: on which side of a plane the mean place of some vertices
/// lies. A client re-enters the graph within a class only.
#[derive(Debug, Clone, PartialEq)]
pub struct Class {
    /// The joint that carries the plane.
    pub joint: u16,
    /// Unit vector in the axes of the rest pose.
    pub axis: [f32; 3],
    /// How far from the joint the plane lies along it (m).
    pub threshold_m: f32,
    /// The vertices; not empty.
    pub vertices: Vec<u32>,
}

/// Constants of the coarse cloth; SI units, as for a scene's material.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fabric {
    /// Areal density (kg/m^2).
    pub density: f32,
    /// Membrane stiffness along the warp (N/m).
    pub stretch: f32,
    /// Across it (N/m).
    pub weft: Option<f32>,
    /// Against shear (N/m).
    pub shear: f32,
    /// Bending stiffness per width (N m).
    pub bend: f32,
    /// Coulomb friction.
    pub friction: f32,
    /// Drag coefficient.
    pub drag: f32,
    /// Damping time (s).
    pub damping_s: f32,
    /// Distance kept from capsules (m).
    pub offset: f32,
}

/// How the coarse cloth is stepped.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stepping {
    /// Steps a frame.
    pub steps: u8,
    /// Passes a step.
    pub passes: u8,
    /// Sweeps of the strain limit a step.
    pub sweeps: u8,
    /// Whether there is a ground at y = 0.
    pub ground: bool,
    /// How much of its resistance the cloth has against compression (0..=1).
    pub compression: f32,
    /// Share of speed lost a second (1/s).
    pub damping_per_s: f32,
    /// Added to every radius (m).
    pub expansion_m: f32,
    /// Places along coarse edges keep off capsules as well, no further apart than this (m); 0: points
    /// alone.
    pub spacing_m: f32,
    /// Coarse points that are no neighbours keep this far apart (m); 0: they do not mind each other.
    pub apart_m: f32,
}

/// Everything that is stored of an upsampler.
#[derive(Debug, Clone, PartialEq)]
pub struct Parts {
    /// Coarse points in the rest pose (m).
    pub points: Vec<[f32; 3]>,
    /// Coarse triangles.
    pub triangles: Vec<[u16; 3]>,
    /// Where each coarse point lies on the fine cloth.
    pub places: Vec<Place>,
    /// Coarse points that are led; ascending.
    pub pins: Vec<Pin>,
    /// Coarse points that the skin leaves some room; ascending, none of them a pin.
    pub tethers: Vec<Tether>,
    /// What the coarse cloth keeps off.
    pub capsules: Vec<Capsule>,
    /// Its constants.
    pub fabric: Fabric,
    /// How it is stepped.
    pub stepping: Stepping,
    /// Fine vertices that go over into skinning; ascending.
    pub skins: Vec<Skin>,
    /// Oscillatory modes.
    pub modes: Vec<Mode>,
    /// Rules of classes.
    pub classes: Vec<Class>,
    /// Root mean square distance of a fine vertex on training motion (m).
    pub rms_m: f32,
    /// Largest distance of a fine vertex on training motion (m).
    pub max_m: f32,
    /// U.
    pub weights: Weights,
}

/// U in steps, row after row; every row sums to 1 before rounding.
#[derive(Debug, Clone, PartialEq)]
pub struct Weights {
    /// Bits of a step in store, 8..=16.
    pub bits: u8,
    /// What a step of each row stands for; one number a fine vertex.
    pub units: Vec<f32>,
    /// As many steps a row as there are coarse points.
    pub steps: Vec<i16>,
}

/// Why an upsampler could not be stored, read or applied.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum UpsampleError {
    /// Not an upsampler.
    #[error("not an upsampler: it begins with {0:02x?}")]
    Magic([u8; 4]),
    /// A version that this build does not know.
    #[error("upsampler of version {0}; this build reads up to {known}", known = bytes::VERSIONS[1])]
    Version(u16),
    /// Another number of bytes than the header asks for.
    #[error("upsampler of {actual} bytes, but its header asks for {expected}")]
    Length {
        /// Bytes that the header asks for.
        expected: u64,
        /// Bytes given.
        actual: u64,
    },
    /// A count outside its range.
    #[error("upsampler: {count} {what}; allowed are {least}..={most}")]
    Count {
        /// Of what.
        what: &'static str,
        /// How many.
        count: usize,
        /// At least.
        least: usize,
        /// At most.
        most: usize,
    },
    /// Something impossible.
    #[error("upsampler: {what} {index} is not finite, out of range or out of order")]
    Invalid {
        /// Of which list.
        what: &'static str,
        /// Place in it.
        index: usize,
    },
    /// Weights that cannot be applied.
    #[error("upsampler: {0}")]
    Operator(#[from] OperatorError),
}

/// A learned upsampler, checked and ready.
#[derive(Debug, Clone)]
pub struct Upsampler {
    /// Without the steps, which are in `operator`.
    parts: Parts,
    operator: Operator,
    /// One more than the last joint that is named.
    joints: usize,
}

impl Weights {
    /// Rounds a dense U (row after row) to `bits`. Half a step is lost a weight at most; a step of
    /// a row is its largest weight over `2^(bits-1) - 1`.
    ///
    /// # Errors
    /// Other than 8..=16 bits, a weight that is not finite, no whole rows.
    pub fn round(coarse: usize, weights: &[f32], bits: u8) -> Result<Self, UpsampleError> {
        check_count("bits of a weight", usize::from(bits), 8, 16)?;
        check_count("coarse points", coarse, 1, COARSE_MAX)?;
        if !weights.len().is_multiple_of(coarse) {
            return Err(UpsampleError::Invalid { what: "row of weights", index: 0 });
        }
        let most = ((1i32 << (bits - 1)) - 1) as f32;
        let mut steps = vec![0i16; weights.len()];
        let mut units = Vec::with_capacity(weights.len() / coarse);
        for (row, out) in weights.chunks(coarse).zip(steps.chunks_mut(coarse)) {
            let fits = crate::kernel::operator::quantise_row(row, out)?;
            let largest = row.iter().fold(0.0f32, |m, w| m.max(w.abs()));
            let unit = fits.max(largest / most).max(f32::MIN_POSITIVE);
            for (out, weight) in out.iter_mut().zip(row) {
                *out = (weight / unit).round_ties_even().clamp(-most, most) as i16;
            }
            units.push(unit);
        }
        Ok(Self { bits, units, steps })
    }
}

impl Parts {
    /// Every list within its limits, every number finite and in range, every index in range.
    ///
    /// # Errors
    /// The first rule that is broken, with its place.
    pub fn check(&self) -> Result<(), UpsampleError> {
        let (coarse, fine) = (self.points.len(), self.weights.units.len());
        check_count("coarse points", coarse, 3, COARSE_MAX)?;
        check_count("fine vertices", fine, 1, FINE_MAX)?;
        check_count("weights", coarse * fine, 1, STEPS_MAX)?;
        check_count("steps", self.weights.steps.len(), coarse * fine, coarse * fine)?;
        check_count("places", self.places.len(), coarse, coarse)?;
        check_count("coarse triangles", self.triangles.len(), 1, 2 * COARSE_MAX)?;
        check_count("pins", self.pins.len(), 0, coarse)?;
        check_count("tethers", self.tethers.len(), 0, coarse)?;
        check_count("capsules", self.capsules.len(), 0, CAPSULES_MAX)?;
        check_count("skinned vertices", self.skins.len(), 0, fine)?;
        check_count("modes", self.modes.len(), 0, MODES_MAX)?;
        check_count("classes", self.classes.len(), 0, CLASSES_MAX)?;
        check_count("bits of a weight", usize::from(self.weights.bits), 8, 16)?;
        self.check_coarse(coarse, fine)?;
        self.check_fine(fine)?;
        self.check_weights(coarse)
    }

    fn check_coarse(&self, coarse: usize, fine: usize) -> Result<(), UpsampleError> {
        all("coarse point", &self.points, near)?;
        all("coarse triangle", &self.triangles, |[a, b, c]| {
            a != b && b != c && c != a && [a, b, c].iter().all(|v| usize::from(**v) < coarse)
        })?;
        all("place", &self.places, |place| {
            place.vertices.iter().all(|v| (*v as usize) < fine)
                && place.weights.iter().all(|w| (-2.0..=3.0).contains(w))
        })?;
        all("pin", &self.pins, |pin| usize::from(pin.point) < coarse && pin.binding.is_sound())?;
        ascending("pin", &self.pins, |pin| pin.point.into())?;
        all("tether", &self.tethers, |t| {
            let led = self.pins.binary_search_by_key(&t.point, |pin| pin.point).is_ok();
            let sound = t.binding.is_sound() && is_guard(&t.normal, t.floor_m);
            usize::from(t.point) < coarse && !led && sound && (0.0..=FAR_M).contains(&t.reach_m)
        })?;
        ascending("tether", &self.tethers, |t| t.point.into())?;
        all("capsule", &self.capsules, |c| {
            let placed = usize::from(c.joint) < JOINTS_MAX && c.ends.iter().all(near);
            placed && (0.0..=FAR_M).contains(&c.radius)
        })?;
        let s = &self.stepping;
        let counts = (1..=8).contains(&s.steps) && (1..=64).contains(&s.passes) && s.sweeps <= 64;
        let numbers = (0.0..=1.0).contains(&s.compression)
            && (0.0..=100.0).contains(&s.damping_per_s)
            && (0.0..=1.0).contains(&s.expansion_m)
            && (0.0..=1.0).contains(&s.spacing_m)
            && (0.0..=1.0).contains(&s.apart_m);
        let f = &self.fabric;
        let weft = f.weft.unwrap_or(f.stretch);
        let fabric = [f.density, f.stretch, weft, f.shear, f.bend, f.friction, f.drag]
            .iter()
            .chain(&[f.damping_s, f.offset])
            .all(|x| (0.0..=1e6).contains(x));
        let errors = [self.rms_m, self.max_m].iter().all(|e| (0.0..=FAR_M).contains(e));
        if counts && numbers && fabric && errors && weft > 0.0 {
            return Ok(());
        }
        Err(UpsampleError::Invalid { what: "constant", index: 0 })
    }

    fn check_fine(&self, fine: usize) -> Result<(), UpsampleError> {
        all("skinned vertex", &self.skins, |s| {
            let guard = is_guard(&s.normal, s.floor_m);
            (s.vertex as usize) < fine && s.binding.is_sound() && near(&s.rest) && guard
        })?;
        ascending("skinned vertex", &self.skins, |s| s.vertex)?;
        all("mode", &self.modes, |m| {
            (0.0..=1e3).contains(&m.frequency_hz)
                && (0.0..=1e3).contains(&m.damping_per_s)
                && (0.0..=1e3).contains(&m.wind_m_s)
                && (0.0..=1.0).contains(&m.unit_m)
                && m.amplitudes.len() == fine
        })?;
        all("class", &self.classes, |c| {
            let square: f32 = c.axis.iter().map(|x| x * x).sum();
            usize::from(c.joint) < JOINTS_MAX
                && (0.99..=1.01).contains(&square)
                && c.threshold_m.abs() <= FAR_M
                && !c.vertices.is_empty()
                && c.vertices.len() <= fine
                && c.vertices.iter().all(|v| (*v as usize) < fine)
        })
    }

    fn check_weights(&self, coarse: usize) -> Result<(), UpsampleError> {
        let most = (1i32 << (self.weights.bits - 1)) - 1;
        let rows = self.weights.units.iter().zip(self.weights.steps.chunks(coarse));
        for (index, (unit, steps)) in rows.enumerate() {
            let sum: f32 = steps.iter().map(|s| f32::from(*s).abs()).sum();
            let narrow = steps.iter().all(|s| i32::from(*s).abs() <= most);
            if !(*unit > 0.0 && unit * sum <= ROW_WEIGHTS_MAX && *unit <= 1.0 && narrow) {
                return Err(UpsampleError::Invalid { what: "row of weights", index });
            }
        }
        Ok(())
    }
}

impl Binding {
    /// All on one joint.
    pub fn of(joint: u16) -> Self {
        Self { joints: [joint, 0, 0, 0], shares: [WHOLE, 0, 0, 0] }
    }

    /// From weights, which need not sum to 1; the largest share takes what rounding leaves.
    pub fn new(joints: [u16; 4], weights: [f32; 4]) -> Self {
        let sum: f32 = weights.iter().map(|w| w.max(0.0)).sum();
        let scale = if sum > 0.0 { f32::from(WHOLE) / sum } else { 0.0 };
        let mut shares = weights.map(|w| (w.max(0.0) * scale).floor() as u16);
        let largest = (0..4).fold(0, |best, i| if shares[i] > shares[best] { i } else { best });
        let given: u32 = shares.iter().map(|s| u32::from(*s)).sum();
        let left = i64::from(shares[largest]) + i64::from(WHOLE) - i64::from(given);
        shares[largest] = left.clamp(0, i64::from(WHOLE)) as u16;
        Self { joints, shares }
    }

    fn is_sound(&self) -> bool {
        let sum: u32 = self.shares.iter().map(|s| u32::from(*s)).sum();
        sum == u32::from(WHOLE) && self.joints.iter().all(|j| usize::from(*j) < JOINTS_MAX)
    }
}

impl Upsampler {
    /// Checks the parts and lays U out for the kernels.
    ///
    /// # Errors
    /// The first rule that is broken.
    pub fn new(mut parts: Parts) -> Result<Self, UpsampleError> {
        parts.check()?;
        let (coarse, fine) = (parts.points.len(), parts.weights.units.len());
        let steps = std::mem::take(&mut parts.weights.steps);
        let units = std::mem::take(&mut parts.weights.units);
        let operator = Operator::from_steps(coarse, &steps, units, vec![1.0; fine])?;
        let joints = joints_named(&parts);
        Ok(Self { parts, operator, joints })
    }

    /// All but the weights.
    pub fn parts(&self) -> &Parts {
        &self.parts
    }

    /// U.
    pub fn operator(&self) -> &Operator {
        &self.operator
    }

    /// Fine vertices.
    pub fn fine(&self) -> usize {
        self.operator.fine()
    }

    /// Coarse points.
    pub fn coarse(&self) -> usize {
        self.operator.coarse()
    }

    /// One more than the last joint that is named.
    pub fn joints(&self) -> usize {
        self.joints
    }

    /// Memory held (bytes), about.
    pub fn resident_bytes(&self) -> usize {
        let p = &self.parts;
        let modes: usize = p.modes.iter().map(|m| size_of_val(&m.amplitudes[..])).sum();
        self.operator.resident_bytes()
            + modes
            + size_of_val(&p.skins[..])
            + size_of_val(&p.tethers[..])
            + size_of_val(&p.places[..])
            + size_of_val(&p.points[..])
            + size_of_val(&p.triangles[..])
    }

    /// Whether `faces` are of as many vertices as this makes.
    pub fn fits(&self, faces: &Faces) -> bool {
        faces.vertices() == self.fine()
    }
}

/// A unit vector or none, and a height that is a number.
fn is_guard(normal: &[f32; 3], floor_m: f32) -> bool {
    let square: f32 = normal.iter().map(|x| x * x).sum();
    (square.to_bits() == 0 || (0.98..=1.02).contains(&square)) && floor_m.abs() <= FAR_M
}

fn joints_named(parts: &Parts) -> usize {
    let pins = parts.pins.iter().map(|pin| &pin.binding);
    let bound = pins.chain(parts.skins.iter().map(|skin| &skin.binding));
    let bound = bound.chain(parts.tethers.iter().map(|t| &t.binding)).flat_map(|b| b.joints);
    let carried = parts.capsules.iter().map(|c| c.joint);
    let carried = carried.chain(parts.classes.iter().map(|c| c.joint));
    bound.chain(carried).map(|joint| usize::from(joint) + 1).max().unwrap_or(0)
}

fn near(p: &[f32; 3]) -> bool {
    p.iter().all(|x| x.abs() <= FAR_M)
}

fn check_count(
    what: &'static str,
    count: usize,
    least: usize,
    most: usize,
) -> Result<(), UpsampleError> {
    if (least..=most).contains(&count) {
        return Ok(());
    }
    Err(UpsampleError::Count { what, count, least, most })
}

fn all<T>(what: &'static str, list: &[T], sound: impl Fn(&T) -> bool) -> Result<(), UpsampleError> {
    match list.iter().position(|item| !sound(item)) {
        Some(index) => Err(UpsampleError::Invalid { what, index }),
        None => Ok(()),
    }
}

fn ascending<T>(
    what: &'static str,
    list: &[T],
    key: impl Fn(&T) -> u32,
) -> Result<(), UpsampleError> {
    match list.windows(2).position(|pair| key(&pair[0]) >= key(&pair[1])) {
        Some(index) => Err(UpsampleError::Invalid { what, index: index + 1 }),
        None => Ok(()),
    }
}

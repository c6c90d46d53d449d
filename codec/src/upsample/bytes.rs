//! The stored form of an upsampler; byte table in docs/formats.md.

use super::{
    Binding, CAPSULES_MAX, CLASSES_MAX, COARSE_MAX, Capsule, Class, FINE_MAX, Fabric, MODES_MAX,
    Mode, Parts, Pin, Place, STEPS_MAX, Skin, Stepping, Tether, UpsampleError, Upsampler, Weights,
    check_count,
};

const MAGIC: [u8; 4] = *b"TUps";
/// The first has no tethers, floors or points that keep apart, and is still written where there are none.
pub(super) const VERSIONS: [u16; 2] = [1, 2];
const HEADER_BYTES: usize = 96;
/// What the second version's header has more.
const MORE_BYTES: usize = 8;

/// Counts of a header: what the number of bytes depends on.
#[derive(Debug, Clone, Copy)]
struct Counts {
    version: u16,
    bits: usize,
    coarse: usize,
    fine: usize,
    triangles: usize,
    pins: usize,
    tethers: usize,
    capsules: usize,
    skins: usize,
    modes: usize,
    classes: usize,
    /// Vertices of all classes together.
    members: usize,
}

impl Counts {
    fn of(parts: &Parts) -> Self {
        let held = |s: &Skin| s.normal.iter().chain([&s.floor_m]).any(|x| x.to_bits() != 0);
        let apart = parts.stepping.apart_m.to_bits() != 0;
        let newer = apart || !parts.tethers.is_empty() || parts.skins.iter().any(held);
        Self {
            version: VERSIONS[usize::from(newer)],
            bits: usize::from(parts.weights.bits),
            coarse: parts.points.len(),
            fine: parts.weights.units.len(),
            triangles: parts.triangles.len(),
            pins: parts.pins.len(),
            tethers: parts.tethers.len(),
            capsules: parts.capsules.len(),
            skins: parts.skins.len(),
            modes: parts.modes.len(),
            classes: parts.classes.len(),
            members: parts.classes.iter().map(|class| class.vertices.len()).sum(),
        }
    }

    fn check(&self) -> Result<(), UpsampleError> {
        check_count("bits of a weight", self.bits, 8, 16)?;
        check_count("coarse points", self.coarse, 3, COARSE_MAX)?;
        check_count("fine vertices", self.fine, 1, FINE_MAX)?;
        check_count("weights", self.coarse * self.fine, 1, STEPS_MAX)?;
        check_count("coarse triangles", self.triangles, 1, 2 * COARSE_MAX)?;
        check_count("pins", self.pins, 0, self.coarse)?;
        check_count("tethers", self.tethers, 0, self.coarse)?;
        check_count("capsules", self.capsules, 0, CAPSULES_MAX)?;
        check_count("skinned vertices", self.skins, 0, self.fine)?;
        check_count("modes", self.modes, 0, MODES_MAX)?;
        check_count("classes", self.classes, 0, CLASSES_MAX)?;
        check_count("vertices of classes", self.members, 0, self.classes * self.fine)
    }

    /// Every count is within its limit, so this cannot overflow.
    fn bytes(&self) -> usize {
        let more = if self.version == VERSIONS[0] { 0 } else { MORE_BYTES + 16 * self.skins };
        HEADER_BYTES
            + more
            + self.tethers * 38
            + self.coarse * (12 + 20)
            + self.triangles * 6
            + self.pins * 18
            + self.capsules * 30
            + self.skins * 34
            + self.modes * (16 + 4 * self.fine)
            + self.classes * 22
            + self.members * 4
            + self.fine * 4
            + (self.coarse * self.fine * self.bits).div_ceil(8)
    }
}

impl Parts {
    /// Bytes to store, checked.
    ///
    /// # Errors
    /// A rule of [`Parts::check`] is broken.
    pub fn encode(&self) -> Result<Vec<u8>, UpsampleError> {
        self.check()?;
        let counts = Counts::of(self);
        counts.check()?;
        let mut out = Vec::with_capacity(counts.bytes());
        self.put_header(&counts, &mut out);
        let newer = counts.version != VERSIONS[0];
        if newer {
            floats(&mut out, &[self.stepping.apart_m]);
            out.extend((counts.tethers as u32).to_le_bytes());
        }
        self.points.iter().for_each(|p| floats(&mut out, p));
        for place in &self.places {
            place.vertices.iter().for_each(|v| out.extend(v.to_le_bytes()));
            floats(&mut out, &place.weights);
        }
        self.triangles.iter().for_each(|t| shorts(&mut out, t));
        for pin in &self.pins {
            shorts(&mut out, &[pin.point]);
            put_binding(&mut out, &pin.binding);
        }
        for t in &self.tethers {
            shorts(&mut out, &[t.point]);
            put_binding(&mut out, &t.binding);
            floats(&mut out, &[t.reach_m]);
            put_guard(&mut out, &t.normal, t.floor_m);
        }
        for c in &self.capsules {
            shorts(&mut out, &[c.joint]);
            c.ends.iter().for_each(|end| floats(&mut out, end));
            floats(&mut out, &[c.radius]);
        }
        for s in &self.skins {
            out.extend(s.vertex.to_le_bytes());
            shorts(&mut out, &[s.share]);
            put_binding(&mut out, &s.binding);
            floats(&mut out, &s.rest);
            if newer {
                put_guard(&mut out, &s.normal, s.floor_m);
            }
        }
        for m in &self.modes {
            floats(&mut out, &[m.frequency_hz, m.damping_per_s, m.wind_m_s, m.unit_m]);
            m.amplitudes.iter().flatten().for_each(|a| out.extend(a.to_le_bytes()));
        }
        for c in &self.classes {
            shorts(&mut out, &[c.joint]);
            floats(&mut out, &c.axis);
            floats(&mut out, &[c.threshold_m]);
            out.extend((c.vertices.len() as u32).to_le_bytes());
            c.vertices.iter().for_each(|v| out.extend(v.to_le_bytes()));
        }
        floats(&mut out, &self.weights.units);
        pack(&self.weights.steps, u32::from(self.weights.bits), &mut out);
        assert_eq!(out.len(), counts.bytes(), "the table of docs/formats.md");
        Ok(out)
    }

    fn put_header(&self, c: &Counts, out: &mut Vec<u8>) {
        out.extend(MAGIC);
        shorts(out, &[c.version, c.bits as u16, c.coarse as u16, c.triangles as u16]);
        shorts(out, &[c.pins as u16, c.capsules as u16, c.modes as u16, c.classes as u16]);
        for count in [c.fine, c.skins, c.members] {
            out.extend((count as u32).to_le_bytes());
        }
        let f = &self.fabric;
        floats(out, &[f.density, f.stretch, f.weft.unwrap_or(0.0), f.shear, f.bend]);
        floats(out, &[f.friction, f.drag, f.damping_s, f.offset]);
        let s = &self.stepping;
        out.extend([s.steps, s.passes, s.sweeps, u8::from(s.ground)]);
        floats(out, &[s.compression, s.damping_per_s, s.expansion_m]);
        floats(out, &[self.rms_m, self.max_m, s.spacing_m]);
        assert_eq!(out.len(), HEADER_BYTES);
    }

    /// Reads and checks.
    ///
    /// # Errors
    /// Damaged bytes, another version, or a rule of [`Parts::check`] that is broken. Memory is taken
    /// only once the number of bytes is what the header asks for.
    pub fn decode(bytes: &[u8]) -> Result<Self, UpsampleError> {
        let mut at = Bytes(bytes);
        let magic = at.take();
        if magic != MAGIC || bytes.len() < HEADER_BYTES {
            return Err(UpsampleError::Magic(magic));
        }
        let version = at.short();
        if !VERSIONS.contains(&version) {
            return Err(UpsampleError::Version(version));
        }
        let [bits, coarse, triangles, pins, capsules, modes, classes] =
            std::array::from_fn(|_| usize::from(at.short()));
        let [fine, skins, members] = std::array::from_fn(|_| at.long() as usize);
        let mut more = Bytes(bytes.get(HEADER_BYTES..).unwrap_or_default());
        let newer = version != VERSIONS[0];
        let (apart_m, tethers) =
            if newer { (more.float(), more.long() as usize) } else { (0.0, 0) };
        let counts = Counts {
            version,
            tethers,
            bits,
            coarse,
            fine,
            triangles,
            pins,
            capsules,
            skins,
            modes,
            classes,
            members,
        };
        counts.check()?;
        if counts.bytes() != bytes.len() {
            let (expected, actual) = (counts.bytes() as u64, bytes.len() as u64);
            return Err(UpsampleError::Length { expected, actual });
        }
        let mut parts = Self::take(&counts, &mut at)?;
        parts.stepping.apart_m = apart_m;
        parts.check()?;
        Ok(parts)
    }

    fn take(counts: &Counts, at: &mut Bytes<'_>) -> Result<Self, UpsampleError> {
        let (fabric, mut stepping) = (at.fabric(), at.stepping()?);
        let [rms_m, max_m, spacing_m] = at.floats();
        stepping.spacing_m = spacing_m;
        let newer = counts.version != VERSIONS[0];
        if newer {
            let _: [u8; MORE_BYTES] = at.take();
        }
        let points = at.list(counts.coarse, Bytes::floats);
        let places = at.list(counts.coarse, |at| Place {
            vertices: std::array::from_fn(|_| at.long()),
            weights: at.floats(),
        });
        let triangles = at.list(counts.triangles, |at| std::array::from_fn(|_| at.short()));
        let pins = at.list(counts.pins, |at| Pin { point: at.short(), binding: at.binding() });
        let tethers = at.list(counts.tethers, |at| {
            let (point, binding, reach_m) = (at.short(), at.binding(), at.float());
            Tether { point, binding, reach_m, normal: at.floats(), floor_m: at.float() }
        });
        let capsules = at.list(counts.capsules, |at| Capsule {
            joint: at.short(),
            ends: std::array::from_fn(|_| at.floats()),
            radius: at.float(),
        });
        let skins = at.list(counts.skins, |at| Skin {
            vertex: at.long(),
            share: at.short(),
            binding: at.binding(),
            rest: at.floats(),
            normal: if newer { at.floats() } else { [0.0; 3] },
            floor_m: if newer { at.float() } else { 0.0 },
        });
        let modes = at.list(counts.modes, |at| {
            let [frequency_hz, damping_per_s, wind_m_s, unit_m] = at.floats();
            let amplitudes = at.list(counts.fine, |at| std::array::from_fn(|_| at.short() as i16));
            Mode { frequency_hz, damping_per_s, wind_m_s, unit_m, amplitudes }
        });
        let classes = at.classes(counts)?;
        let units = at.list(counts.fine, Bytes::float);
        let steps = unpack(at.0, counts.coarse * counts.fine, counts.bits as u32)?;
        let weights = Weights { bits: counts.bits as u8, units, steps };
        Ok(Self {
            points,
            triangles,
            places,
            pins,
            tethers,
            capsules,
            fabric,
            stepping,
            skins,
            modes,
            classes,
            rms_m,
            max_m,
            weights,
        })
    }
}

impl Upsampler {
    /// Reads the stored form.
    ///
    /// # Errors
    /// As for [`Parts::decode`].
    pub fn decode(bytes: &[u8]) -> Result<Self, UpsampleError> {
        Self::new(Parts::decode(bytes)?)
    }
}

/// What is still to be read; past the end there are zeros, but lengths are checked before.
struct Bytes<'a>(&'a [u8]);

impl Bytes<'_> {
    fn take<const N: usize>(&mut self) -> [u8; N] {
        let Some((head, rest)) = self.0.split_first_chunk() else {
            self.0 = &[];
            return [0; N];
        };
        self.0 = rest;
        *head
    }

    fn short(&mut self) -> u16 {
        u16::from_le_bytes(self.take())
    }

    fn long(&mut self) -> u32 {
        u32::from_le_bytes(self.take())
    }

    fn float(&mut self) -> f32 {
        f32::from_le_bytes(self.take())
    }

    fn floats<const N: usize>(&mut self) -> [f32; N] {
        std::array::from_fn(|_| self.float())
    }

    fn list<T>(&mut self, count: usize, mut item: impl FnMut(&mut Self) -> T) -> Vec<T> {
        (0..count).map(|_| item(self)).collect()
    }

    fn binding(&mut self) -> Binding {
        Binding {
            joints: std::array::from_fn(|_| self.short()),
            shares: std::array::from_fn(|_| self.short()),
        }
    }

    fn fabric(&mut self) -> Fabric {
        let [density, stretch, weft, shear, bend] = self.floats();
        let [friction, drag, damping_s, offset] = self.floats();
        let weft = (weft.to_bits() != 0).then_some(weft);
        Fabric { density, stretch, weft, shear, bend, friction, drag, damping_s, offset }
    }

    fn stepping(&mut self) -> Result<Stepping, UpsampleError> {
        let [steps, passes, sweeps, ground] = self.take();
        if ground > 1 {
            return Err(UpsampleError::Invalid { what: "ground flag", index: 0 });
        }
        let [compression, damping_per_s, expansion_m] = self.floats();
        let ground = ground == 1;
        let (spacing_m, apart_m) = (0.0, 0.0);
        Ok(Stepping {
            steps,
            passes,
            sweeps,
            ground,
            compression,
            damping_per_s,
            expansion_m,
            spacing_m,
            apart_m,
        })
    }

    fn classes(&mut self, counts: &Counts) -> Result<Vec<Class>, UpsampleError> {
        let mut left = counts.members;
        let mut classes = Vec::with_capacity(counts.classes);
        for index in 0..counts.classes {
            let (joint, axis, threshold_m) = (self.short(), self.floats(), self.float());
            let count = self.long() as usize;
            left =
                left.checked_sub(count).ok_or(UpsampleError::Invalid { what: "class", index })?;
            let vertices = self.list(count, Bytes::long);
            classes.push(Class { joint, axis, threshold_m, vertices });
        }
        if left > 0 {
            return Err(UpsampleError::Invalid { what: "class", index: counts.classes });
        }
        Ok(classes)
    }
}

fn floats(out: &mut Vec<u8>, numbers: &[f32]) {
    numbers.iter().for_each(|x| out.extend(x.to_le_bytes()));
}

fn shorts(out: &mut Vec<u8>, numbers: &[u16]) {
    numbers.iter().for_each(|x| out.extend(x.to_le_bytes()));
}

fn put_binding(out: &mut Vec<u8>, binding: &Binding) {
    shorts(out, &binding.joints);
    shorts(out, &binding.shares);
}

fn put_guard(out: &mut Vec<u8>, normal: &[f32; 3], floor_m: f32) {
    floats(out, normal);
    floats(out, &[floor_m]);
}

/// Two's complement of `bits` each, the lowest bit first; zeros up to the last byte's end.
fn pack(steps: &[i16], bits: u32, out: &mut Vec<u8>) {
    let (mut held, mut count) = (0u32, 0);
    for step in steps {
        held |= (*step as u16 as u32 & ((1 << bits) - 1)) << count;
        count += bits;
        while count >= 8 {
            out.push(held as u8);
            (held, count) = (held >> 8, count - 8);
        }
    }
    if count > 0 {
        out.push(held as u8);
    }
}

fn unpack(mut bytes: &[u8], count: usize, bits: u32) -> Result<Vec<i16>, UpsampleError> {
    let (mut held, mut held_bits) = (0u32, 0);
    let mut steps = Vec::with_capacity(count);
    for _ in 0..count {
        while held_bits < bits {
            let (first, rest) = bytes.split_first().map_or((0, bytes), |(b, rest)| (*b, rest));
            bytes = rest;
            held |= u32::from(first) << held_bits;
            held_bits += 8;
        }
        let low = (held & ((1 << bits) - 1)) as u16;
        steps.push(((low << (16 - bits)) as i16) >> (16 - bits));
        (held, held_bits) = (held >> bits, held_bits - bits);
    }
    if held == 0 { Ok(steps) } else { Err(UpsampleError::Invalid { what: "last byte", index: 0 }) }
}

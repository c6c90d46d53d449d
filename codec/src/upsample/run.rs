//! Applying an upsampler, once a frame.

use super::{Binding, Held, Mode, Transform, UpsampleError, Upsampler, WHOLE};
use crate::kernel::Set;
use crate::kernel::normals::Faces;

/// What fine positions are made from in one frame.
#[derive(Debug, Clone, Copy)]
pub struct Drive<'a> {
    /// Coarse positions (m) in the frame in which fine ones are wanted: x0, y0, z0, x1, ...
    pub coarse_m: &'a [f32],
    /// For each joint what moves a point of the rest pose into that frame.
    pub joints: &'a [Transform],
}

/// What is kept between frames: where the modes are, and scratch.
#[derive(Debug, Clone, Default)]
pub struct Workspace {
    /// By mode: how far into its oscillation (turns), and its amplitude (0..=1).
    waves: Vec<(f32, f32)>,
    normals: Vec<f32>,
}

impl Workspace {
    /// Lets the modes go on for `seconds` in air of `wind_m_s`.
    pub fn advance(&mut self, upsampler: &Upsampler, seconds: f32, wind_m_s: f32) {
        let modes = &upsampler.parts.modes;
        self.waves.resize(modes.len(), (0.0, 0.0));
        for ((turns, amplitude), mode) in self.waves.iter_mut().zip(modes) {
            *turns = (*turns + mode.frequency_hz * seconds).fract();
            let calm = mode.wind_m_s <= 0.0;
            let aim = if calm { 1.0 } else { (wind_m_s.abs() / mode.wind_m_s).min(1.0) };
            *amplitude += (aim - *amplitude) * -(-mode.damping_per_s * seconds).exp_m1();
        }
    }

    /// Begins anew: no oscillation yet.
    pub fn reset(&mut self) {
        self.waves.clear();
    }
}

impl Upsampler {
    /// Fine positions (m) and unit normals, both x0, y0, z0, x1, ...: `U p_c`, modes, hand-over to
    /// skinning, normals of the result. Allocates nothing after the first call.
    ///
    /// * `normals`: as long as `positions`, or empty where they are not wanted.
    ///
    /// # Errors
    /// Slices of other lengths, fewer joints than are named, faces of another mesh, a coarse position
    /// that is not finite.
    pub fn apply(
        &self,
        drive: &Drive<'_>,
        faces: &Faces,
        workspace: &mut Workspace,
        positions: &mut [f32],
        normals: &mut [f32],
    ) -> Result<(), UpsampleError> {
        self.apply_with(Set::detect(), drive, faces, workspace, (positions, normals))
    }

    /// As [`Upsampler::apply`], with a given instruction set.
    ///
    /// # Errors
    /// As for `apply`.
    pub fn apply_with(
        &self,
        set: Set,
        drive: &Drive<'_>,
        faces: &Faces,
        workspace: &mut Workspace,
        (positions, normals): (&mut [f32], &mut [f32]),
    ) -> Result<(), UpsampleError> {
        if drive.joints.len() < self.joints {
            return Err(UpsampleError::Invalid { what: "joint", index: drive.joints.len() });
        }
        let fits = normals.is_empty() || normals.len() == 3 * self.fine();
        if !self.fits(faces) || !fits {
            return Err(UpsampleError::Invalid { what: "face or normal", index: 0 });
        }
        self.operator.apply_with(set, drive.coarse_m, positions)?;
        if !self.parts.modes.is_empty() {
            workspace.waves.resize(self.parts.modes.len(), (0.0, 0.0));
            workspace.normals.resize(positions.len(), 0.0);
            let fits = faces.normals(positions, &mut workspace.normals);
            debug_assert!(fits.is_ok(), "three numbers a vertex");
            for (mode, (turns, amplitude)) in self.parts.modes.iter().zip(&workspace.waves) {
                add_mode(mode, *turns, *amplitude, &workspace.normals, positions);
            }
        }
        self.hand_over(drive.joints, positions);
        if !normals.is_empty() {
            let fits = faces.normals(positions, normals);
            debug_assert!(fits.is_ok(), "three numbers a vertex");
        }
        Ok(())
    }

    /// Where the pinned points are led (m), in order.
    pub fn pins(&self, joints: &[Transform], out: &mut Vec<[f32; 3]>) {
        out.clear();
        let point = |pin: &super::Pin| self.parts.points[usize::from(pin.point)];
        out.extend(self.parts.pins.iter().map(|pin| skinned(&pin.binding, joints, point(pin))));
    }

    /// Where the tethers are, in order.
    pub fn tethers(&self, joints: &[Transform], out: &mut Vec<Held>) {
        out.clear();
        out.extend(self.parts.tethers.iter().map(|t| Held {
            at: skinned(&t.binding, joints, self.parts.points[usize::from(t.point)]),
            normal: turned(&t.binding, joints, t.normal),
        }));
    }

    /// Coarse positions of a fine cloth (m), both three numbers a point.
    ///
    /// # Errors
    /// Slices of other lengths.
    pub fn restrict(&self, fine_m: &[f32], coarse_m: &mut [f32]) -> Result<(), UpsampleError> {
        for (what, actual, expected) in [
            ("fine number", fine_m.len(), 3 * self.fine()),
            ("coarse number", coarse_m.len(), 3 * self.coarse()),
        ] {
            if actual != expected {
                return Err(UpsampleError::Invalid { what, index: actual });
            }
        }
        for (out, place) in coarse_m.chunks_exact_mut(3).zip(&self.parts.places) {
            let [a, b] = place.weights;
            let weights = [a, b, 1.0 - a - b];
            for (axis, out) in out.iter_mut().enumerate() {
                let at = |v: u32| fine_m[3 * v as usize + axis];
                *out = place.vertices.iter().zip(weights).map(|(v, w)| w * at(*v)).sum();
            }
        }
        Ok(())
    }

    /// Where the garment follows the body it goes over into skinning (Kavan et al. 2011, section 6), and
    /// where it lies on the body it does not get into it.
    fn hand_over(&self, joints: &[Transform], positions: &mut [f32]) {
        let (points, _) = positions.as_chunks_mut::<3>();
        for skin in &self.parts.skins {
            let at = skinned(&skin.binding, joints, skin.rest);
            let share = f32::from(skin.share) / f32::from(WHOLE);
            for (x, at) in points[skin.vertex as usize].iter_mut().zip(at) {
                *x += share * (at - *x);
            }
            if skin.is_guarded() {
                let normal = turned(&skin.binding, joints, skin.normal);
                let x = &mut points[skin.vertex as usize];
                let height: f32 = (0..3).map(|a| normal[a] * (x[a] - at[a])).sum();
                let lift = (skin.floor_m - height).max(0.0);
                x.iter_mut().zip(normal).for_each(|(x, n)| *x += lift * n);
            }
        }
    }
}

/// Displacement along normals by a sine and a cosine (Kavan et al. 2011, equation 7).
fn add_mode(mode: &Mode, turns: f32, amplitude: f32, normals: &[f32], positions: &mut [f32]) {
    if amplitude <= 0.0 {
        return;
    }
    let (sine, cosine) = (std::f32::consts::TAU * turns).sin_cos();
    let (sine, cosine) = (amplitude * mode.unit_m * sine, amplitude * mode.unit_m * cosine);
    let (points, _) = positions.as_chunks_mut::<3>();
    let (normals, _) = normals.as_chunks::<3>();
    for ((x, n), [s, c]) in points.iter_mut().zip(normals).zip(&mode.amplitudes) {
        let along = sine * f32::from(*s) + cosine * f32::from(*c);
        for (x, n) in x.iter_mut().zip(n) {
            *x += along * n;
        }
    }
}

/// A point of the rest pose, skinned.
fn skinned(binding: &Binding, joints: &[Transform], p: [f32; 3]) -> [f32; 3] {
    let mut sum = [0.0f32; 3];
    for (joint, share) in binding.joints.iter().zip(binding.shares) {
        if share > 0 {
            let weight = f32::from(share) / f32::from(WHOLE);
            for (sum, [x, y, z, t]) in sum.iter_mut().zip(&joints[usize::from(*joint)]) {
                *sum += weight * (x * p[0] + y * p[1] + z * p[2] + t);
            }
        }
    }
    sum
}

/// A unit vector of the rest pose, carried along; zero where the joints turn it away in equal parts.
fn turned(binding: &Binding, joints: &[Transform], n: [f32; 3]) -> [f32; 3] {
    let mut sum = [0.0f32; 3];
    for (joint, share) in binding.joints.iter().zip(binding.shares) {
        if share > 0 {
            let weight = f32::from(share) / f32::from(WHOLE);
            for (sum, [x, y, z, _]) in sum.iter_mut().zip(&joints[usize::from(*joint)]) {
                *sum += weight * (x * n[0] + y * n[1] + z * n[2]);
            }
        }
    }
    let length = sum.iter().map(|x| x * x).sum::<f32>().sqrt();
    if length > 1e-6 { sum.map(|x| x / length) } else { [0.0; 3] }
}

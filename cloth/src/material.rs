//! Physical constants of a cloth.

/// Physical constants of a cloth, as a scene file gives them. Units: SI.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Material {
    /// Areal density (kg/m^2).
    pub density: f32,
    /// Membrane stiffness E h (N/m).
    pub stretch: f32,
    /// Shear stiffness G h (N/m).
    pub shear: f32,
    /// Bending stiffness per width (N m).
    pub bend: f32,
    /// Coulomb friction against the body.
    pub friction: f32,
    /// Drag coefficient of a sheet normal to the flow (1.28 for a plate).
    pub drag: f32,
    /// Stiffness-proportional damping time (s).
    pub damping_s: f32,
    /// Distance kept from the body (m).
    pub offset: f32,
}

impl Default for Material {
    /// A medium woven fabric (between the pants and the tablecloth of Wang et al. 2011).
    fn default() -> Self {
        Self {
            density: 0.2,
            stretch: 1000.0,
            shear: 400.0,
            bend: 5e-5,
            friction: 0.3,
            drag: 1.28,
            damping_s: 0.002,
            offset: 0.004,
        }
    }
}

/// A constant outside its range.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("material: {name} is {value}, it must lie in {least}..={most}")]
pub struct MaterialError {
    /// Field name.
    pub name: &'static str,
    /// What it was.
    pub value: f32,
    /// Smallest legal value.
    pub least: f32,
    /// Largest legal value.
    pub most: f32,
}

impl Material {
    /// Checks that every constant is finite and in the range for which the solver is meant.
    ///
    /// # Errors
    /// Names the first constant outside its range.
    pub fn check(&self) -> Result<(), MaterialError> {
        let ranges = [
            ("density", self.density, 1e-3, 10.0),
            ("stretch", self.stretch, 1.0, 1e6),
            ("shear", self.shear, 0.1, 1e6),
            ("bend", self.bend, 0.0, 1.0),
            ("friction", self.friction, 0.0, 10.0),
            ("drag", self.drag, 0.0, 100.0),
            ("damping_s", self.damping_s, 0.0, 1.0),
            ("offset", self.offset, 0.0, 0.1),
        ];
        for (name, value, least, most) in ranges {
            if !(value >= least && value <= most) {
                return Err(MaterialError { name, value, least, most });
            }
        }
        Ok(())
    }

    /// Isotropic plane-stress constants `(mu, lambda)` (N/m). Poisson's ratio follows from
    /// `E = 2 G (1 + nu)` and is held in 0..=0.5, where `stretch` is honoured before `shear`.
    pub fn lame(&self) -> (f32, f32) {
        let nu = (self.stretch / (2.0 * self.shear) - 1.0).clamp(0.0, 0.5);
        let mu = self.stretch / (2.0 * (1.0 + nu));
        (mu, self.stretch * nu / (1.0 - nu * nu))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plane_stress_constants_give_back_young_and_shear() {
        let m = Material::default();
        let (mu, lambda) = m.lame();
        assert!((mu - m.shear).abs() < 1e-2);
        let young = 4.0 * mu * (mu + lambda) / (2.0 * mu + lambda);
        assert!((young - m.stretch).abs() < 0.1, "{young}");
    }

    #[test]
    fn a_constant_out_of_range_is_named() {
        assert!(Material::default().check().is_ok());
        let bad = Material { bend: f32::NAN, ..Material::default() };
        assert_eq!(bad.check().unwrap_err().name, "bend");
    }
}

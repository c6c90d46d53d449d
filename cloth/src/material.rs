//! Physical constants of a cloth.

/// Physical constants of a cloth, as a scene file gives them. Units: SI.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Material {
    /// Areal density (kg/m^2).
    pub density: f32,
    /// Membrane stiffness E h (N/m); of an orthotropic cloth along the warp, which is the grain of
    /// [`crate::Mesh::with_grain`].
    pub stretch: f32,
    /// Membrane stiffness across the warp (N/m). `None`: as along it.
    pub weft: Option<f32>,
    /// Shear stiffness G h (N/m) between warp and weft. Where `weft` is `None` and Poisson's ratio
    /// `stretch / (2 shear) - 1` lies in 0..=0.5, the cloth is isotropic.
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
            weft: None,
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
            ("weft", self.weft.unwrap_or(self.stretch), 1.0, 1e6),
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

    /// The membrane's constants.
    pub fn membrane(&self) -> MembraneStiffness {
        let nu = self.stretch / (2.0 * self.shear) - 1.0;
        if self.weft.is_none() && (-1e-3..=0.501).contains(&nu) {
            let nu = nu.clamp(0.0, 0.5);
            let mu = self.stretch / (2.0 * (1.0 + nu));
            let lambda = self.stretch * nu / (1.0 - nu * nu);
            return MembraneStiffness { mu, lambda, ..MembraneStiffness::default() };
        }
        let weft = self.weft.unwrap_or(self.stretch);
        // As much as possible is isotropic (without lateral contraction), the rest along the axes.
        let mu = self.shear.min(0.5 * self.stretch).min(0.5 * weft);
        let [warp, weft] = [self.stretch - 2.0 * mu, weft - 2.0 * mu];
        MembraneStiffness { mu, lambda: 0.0, warp, weft, shear: self.shear - mu }
    }
}

/// Constants of a membrane energy that is the sum of an isotropic part and of what an orthotropic
/// cloth has besides along its axes (N/m); none is negative.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct MembraneStiffness {
    /// Lame's second constant in plane stress.
    pub mu: f32,
    /// Lame's first constant in plane stress.
    pub lambda: f32,
    /// Stretch along the warp, besides.
    pub warp: f32,
    /// Stretch along the weft, besides.
    pub weft: f32,
    /// Shear between both, besides.
    pub shear: f32,
}

#[cfg(test)]
#[allow(clippy::float_cmp)] // constants that are not computed
mod tests {
    use super::*;

    #[test]
    fn plane_stress_constants_give_back_young_and_shear() {
        let m = Material::default();
        let c = m.membrane();
        assert!((c.mu - m.shear).abs() < 1e-2);
        let young = 4.0 * c.mu * (c.mu + c.lambda) / (2.0 * c.mu + c.lambda);
        assert!((young - m.stretch).abs() < 0.1, "{young}");
        assert!(c.warp == 0.0 && c.weft == 0.0 && c.shear == 0.0);
    }

    #[test]
    fn any_shear_can_be_had_beside_any_stretch() {
        for (stretch, weft, shear) in
            [(1000.0, None, 50.0), (200.0, Some(1000.0), 30.0), (100.0, None, 400.0)]
        {
            let c = Material { stretch, weft, shear, ..Material::default() }.membrane();
            assert!([c.mu, c.warp, c.weft, c.shear].iter().all(|k| *k >= 0.0) && c.lambda == 0.0);
            assert!((2.0 * c.mu + c.warp - stretch).abs() < 1e-3);
            assert!((2.0 * c.mu + c.weft - weft.unwrap_or(stretch)).abs() < 1e-3);
            assert!((c.mu + c.shear - shear).abs() < 1e-3);
        }
    }

    #[test]
    fn a_constant_out_of_range_is_named() {
        assert!(Material::default().check().is_ok());
        let bad = Material { bend: f32::NAN, ..Material::default() };
        assert_eq!(bad.check().unwrap_err().name, "bend");
    }
}

//! The ten measured fabrics of Wang, O'Brien & Ramamoorthi 2011, "Data-Driven Elastic Models for
//! Cloth", by name.
//!
//! The paper gives tables of samples (six stretching angles and strains, three bending angles at
//! five curvatures). Here each is a range, smallest to largest sample, and a constant is the
//! **geometric mean** of its range's ends: the samples span up to two decades. Warp is the second
//! direction of the measurement (the stiffer one in nine fabrics), weft the first. Shear was not
//! measured apart from stretch; it is taken as 0.4 of the mean stiffness, as in
//! [`Material::default`]. Friction, drag, damping and offset are the default's.

use crate::material::Material;

/// Share of the mean stiffness that shear stiffness is taken as.
const SHEAR_SHARE: f32 = 0.4;

/// A measured fabric.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fabric {
    /// Name in scene files and on the command line.
    pub name: &'static str,
    /// Areal density (kg/m^2).
    pub density: f32,
    /// Stiffness in the first direction, least and most (N/m).
    pub weft: [f32; 2],
    /// Stiffness in the second direction, least and most (N/m).
    pub warp: [f32; 2],
    /// Bending stiffness per width, least and most (N m).
    pub bend: [f32; 2],
}

const fn fabric(
    name: &'static str,
    density: f32,
    weft: [f32; 2],
    warp: [f32; 2],
    bend: [f32; 2],
) -> Fabric {
    Fabric { name, density, weft, warp, bend }
}

/// All ten, in the order of their names.
pub const FABRICS: [Fabric; 10] = [
    fabric("denim", 0.324, [205.0, 232.0], [1014.0, 1060.0], [20e-6, 121e-6]),
    fabric("fleece-blanket", 0.228, [97.0, 210.0], [211.0, 360.0], [36e-6, 299e-6]),
    fabric("interlock-tshirt", 0.187, [17.0, 140.0], [34.0, 414.0], [7e-6, 39e-6]),
    fabric("pants", 0.220, [2017.0, 2110.0], [2035.0, 2174.0], [108e-6, 228e-6]),
    fabric("ponte-roma-jacket", 0.284, [31.0, 144.0], [44.0, 269.0], [10e-6, 50e-6]),
    fabric("red-jacket", 0.113, [43.0, 227.0], [171.0, 405.0], [8e-6, 36e-6]),
    fabric("rib-knit", 0.276, [30.0, 106.0], [65.0, 255.0], [25e-6, 98e-6]),
    fabric("sweater", 0.224, [13.0, 126.0], [3.0, 305.0], [9e-6, 60e-6]),
    fabric("swimsuit", 0.204, [40.0, 69.0], [64.0, 170.0], [19e-6, 70e-6]),
    fabric("tablecloth", 0.128, [2002.0, 2108.0], [2028.0, 2172.0], [10e-6, 66e-6]),
];

/// The fabric of that name, in either case, with `_` or spaces for `-`.
pub fn find(name: &str) -> Option<&'static Fabric> {
    let plain = name.trim().to_ascii_lowercase().replace(['_', ' '], "-");
    FABRICS.iter().find(|f| f.name == plain)
}

/// All names, for messages: `denim, fleece-blanket, ...`.
pub fn names() -> String {
    FABRICS.map(|f| f.name).join(", ")
}

impl Fabric {
    /// Warp stiffness (N/m).
    pub fn warp_mean(&self) -> f32 {
        middle(self.warp)
    }

    /// Weft stiffness (N/m).
    pub fn weft_mean(&self) -> f32 {
        middle(self.weft)
    }

    /// Bending stiffness per width (N m).
    pub fn bend_mean(&self) -> f32 {
        middle(self.bend)
    }

    /// The fabric as constants of the solver.
    pub fn material(&self) -> Material {
        let (warp, weft) = (self.warp_mean(), self.weft_mean());
        Material {
            density: self.density,
            stretch: warp,
            weft: Some(weft),
            shear: SHEAR_SHARE * middle([warp, weft]),
            bend: self.bend_mean(),
            ..Material::default()
        }
    }
}

/// The geometric mean.
fn middle([low, high]: [f32; 2]) -> f32 {
    (low * high).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_fabric_is_found_and_can_be_simulated() {
        for f in &FABRICS {
            assert_eq!(find(f.name), Some(f));
            f.material().check().unwrap();
            for [low, high] in [f.weft, f.warp, f.bend] {
                assert!(low < high && low > 0.0, "{}", f.name);
            }
        }
        assert!(FABRICS.is_sorted_by_key(|f| f.name));
        assert_eq!(find("Rib_Knit").unwrap().name, "rib-knit");
        assert_eq!(find("rib knit").unwrap().name, "rib-knit");
        assert_eq!(find("velvet"), None);
    }

    #[test]
    fn a_constant_is_the_middle_of_its_range() {
        let denim = find("denim").unwrap();
        assert!((denim.bend_mean() - 49.2e-6).abs() < 0.1e-6);
        assert!((denim.warp_mean() - 1036.7).abs() < 0.1);
    }
}

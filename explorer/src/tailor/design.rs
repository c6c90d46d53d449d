//! Where the shells of the pieces lie and where they are cut open, in the body's own measures.

use cloth::Vec3;

use super::form::{Form, Worn};
use super::{Piece, TailorError};
use crate::builtin::field::{RoundCone, Union, join};

/// A distance (m) at every place.
type Field<'a> = Box<dyn Fn(Vec3) -> f32 + 'a>;

/// Fillet between parts of a shell (m).
const FILLET_M: f32 = 0.05;
/// Cells of the grid in which a shell is found (m).
const CELL_M: f32 = 0.02;
/// The same where two sheets lie near each other, as between trouser legs (m).
const FINE_CELL_M: f32 = 0.009;

/// A garment as it is to be sewn.
pub(super) struct Design<'a> {
    pub name: &'static str,
    shell: Field<'a>,
    /// Positive where the shell is taken away.
    pub cuts: Vec<Field<'a>>,
    /// Openings that this leaves.
    pub openings: usize,
    /// Lowest and highest corner of a box around it (m).
    pub bounds: [Vec3; 2],
    pub cell_m: f32,
}

impl Design<'_> {
    /// Distance to the shell (m).
    pub fn distance(&self, p: Vec3) -> f32 {
        (self.shell)(p)
    }
}

/// The design of this name.
pub(super) fn named<'a>(
    name: &str,
    form: &'a Form,
    below: &[Piece],
) -> Result<Design<'a>, TailorError> {
    let worn: Vec<Worn> = below.iter().map(Worn::new).collect();
    match name {
        "coat" => coat(form, worn),
        "robe" => robe(form, worn),
        "trousers" => trousers(form, worn),
        "shirt" => shirt(form, worn),
        "vest" => vest(form, worn),
        other => Err(TailorError::Unknown { name: other.to_owned() }),
    }
}

/// A long coat with sleeves, closed in front, to the knee.
fn coat(form: &Form, worn: Vec<Worn>) -> Result<Design<'_>, TailorError> {
    let (hips, knee) = (form.joint("Hips")?, form.joint("LeftLeg")?);
    let [low, high] = form.skin_of(&["Hips", "LHipJoint", "RHipJoint", "LowerBack"])?;
    let depth = (high.z - low.z) * 0.5;
    let (middle, side) = ((high.z + low.z) * 0.5, (high.x - depth).max(0.02));
    let top = Vec3::new(side * 0.5, hips.y + 0.12, middle);
    let bottom = Vec3::new(side * 1.6, knee.y - 0.08, middle);
    let mut loose = mirrored(top, bottom, [depth + 0.01, depth + 0.06]);
    loose.extend(sleeves(form, [0.066, 0.062, 0.062])?);
    let hem = knee.y - 0.04;
    Ok(Design {
        name: "coat",
        shell: shell(form, worn, [0.018, 0.014], &loose),
        cuts: vec![below_height(hem), collar(form, 0.092)?, cuff(form, 1.0)?, cuff(form, -1.0)?],
        openings: 4,
        bounds: around(form),
        cell_m: CELL_M,
    })
}

/// A hooded robe with wide sleeves, to the calf, of one piece; the hood can fall.
///
/// The hood is a bag much wider than the head and deep behind it. Its opening runs over the crown
/// and ends at the chin, so that only the crown holds it: once the rim has slid off, the bag's weight
/// takes it down the back.
fn robe(form: &Form, worn: Vec<Worn>) -> Result<Design<'_>, TailorError> {
    let (chest, ankle) = (form.joint("Spine1")?, form.joint("LeftFoot")?);
    let [low, high] = form.skin_of(&["Head"])?;
    let head = (low + high) * 0.5;
    let half = (high - low) * 0.5;
    let top = Vec3::new(0.06, chest.y - 0.06, chest.z);
    let bottom = Vec3::new(0.12, ankle.y + 0.05, chest.z);
    let mut loose = mirrored(top, bottom, [0.11, 0.27]);
    loose.extend(sleeves(form, [0.075, 0.095, 0.125])?);
    let around_head = Vec3::new(0.0, head.y + 0.03, head.z - 0.02);
    let behind = Vec3::new(0.0, head.y - 0.05, head.z - 0.20);
    loose.push(cone(around_head, behind, [half.x.max(half.z) + 0.06, 0.11]));
    let hem = ankle.y + 0.20;
    let chin = low.y - 0.03;
    let outward = Vec3::new(0.0, 0.3, 1.0).normalize();
    let face = move |p: Vec3| outward.dot(p - head).min(p.y - chin);
    Ok(Design {
        name: "robe",
        shell: shell(form, worn, [0.018, 0.014], &loose),
        cuts: vec![below_height(hem), cuff(form, 1.0)?, cuff(form, -1.0)?, Box::new(face)],
        openings: 4,
        bounds: around(form),
        cell_m: CELL_M,
    })
}

/// Baggy trousers from the waist to the ankles, with a low crotch.
fn trousers(form: &Form, worn: Vec<Worn>) -> Result<Design<'_>, TailorError> {
    let (hips, hip) = (form.joint("Hips")?, form.joint("LeftUpLeg")?);
    let (knee, ankle) = (form.joint("LeftLeg")?, form.joint("LeftFoot")?);
    let mut loose = mirrored(hip.lerp(knee, 0.35), knee, [0.095, 0.085]);
    loose.extend(mirrored(knee, ankle, [0.085, 0.085]));
    let whole = shell(form, worn, [0.014, 0.012], &loose);
    let crotch = hip.lerp(knee, 0.45).y;
    // Below the crotch the legs are kept apart: a wedge is taken out of the shell.
    let wedge = move |p: Vec3| (CROTCH_GAP_M - p.x.abs()).min(crotch - p.y);
    let waist = hips.y + 0.10;
    Ok(Design {
        name: "trousers",
        shell: Box::new(move |p| -join(-whole(p), -wedge(p), 0.02)),
        cuts: vec![Box::new(move |p: Vec3| p.y - waist), below_height(ankle.y + 0.05)],
        openings: 3,
        bounds: around(form),
        cell_m: FINE_CELL_M,
    })
}

/// Half the gap between trouser legs (m): two layers of cloth pass each other.
const CROTCH_GAP_M: f32 = 0.012;

/// A shirt with sleeves to the wrist, worn loose over the hips.
fn shirt(form: &Form, worn: Vec<Worn>) -> Result<Design<'_>, TailorError> {
    let hip = form.joint("LeftUpLeg")?;
    let loose = sleeves(form, [0.060, 0.056, 0.054])?;
    Ok(Design {
        name: "shirt",
        shell: shell(form, worn, [0.016, 0.013], &loose),
        cuts: vec![
            below_height(hip.y - 0.02),
            collar(form, 0.085)?,
            cuff(form, 1.0)?,
            cuff(form, -1.0)?,
        ],
        openings: 4,
        bounds: around(form),
        cell_m: CELL_M,
    })
}

/// A loose vest without sleeves.
fn vest(form: &Form, worn: Vec<Worn>) -> Result<Design<'_>, TailorError> {
    let hips = form.joint("Hips")?;
    let chest = form.joint("Spine1")?;
    let [low, high] = form.skin_of(&["Hips", "LHipJoint", "RHipJoint", "LowerBack"])?;
    let depth = (high.z - low.z) * 0.5;
    let (middle, side) = ((high.z + low.z) * 0.5, (high.x - depth).max(0.02));
    let top = Vec3::new(side * 0.3, chest.y - 0.06, middle);
    let bottom = Vec3::new(side, hips.y, middle);
    let loose = mirrored(top, bottom, [depth, depth + 0.045]);
    Ok(Design {
        name: "vest",
        shell: shell(form, worn, [0.030, 0.016], &loose),
        cuts: vec![
            below_height(hips.y + 0.03),
            collar(form, 0.105)?,
            armhole(form, 1.0)?,
            armhole(form, -1.0)?,
        ],
        openings: 4,
        bounds: around(form),
        cell_m: CELL_M,
    })
}

/// Around the body at `eases[0]` (m), around all that is worn at `eases[1]`, and around `loose`.
fn shell<'a>(
    form: &'a Form,
    worn: Vec<Worn>,
    [ease, over]: [f32; 2],
    loose: &[RoundCone],
) -> Field<'a> {
    let loose = Union::new(loose, FILLET_M);
    Box::new(move |p| {
        let close = form.distance(p) - ease;
        let close = worn.iter().fold(close, |d, worn| join(d, worn.distance(p) - over, 0.02));
        join(close, loose.distance(p), FILLET_M)
    })
}

fn cone(a: Vec3, b: Vec3, [radius_a, radius_b]: [f32; 2]) -> RoundCone {
    RoundCone { joint: 0, a, b, radius_a, radius_b }
}

/// A cone on the left and its mirror image.
fn mirrored(a: Vec3, b: Vec3, radii: [f32; 2]) -> Vec<RoundCone> {
    let flip = Vec3::new(-1.0, 1.0, 1.0);
    vec![cone(a, b, radii), cone(a * flip, b * flip, radii)]
}

/// Both sleeves: radii (m) at shoulder, elbow and wrist.
fn sleeves(form: &Form, radii: [f32; 3]) -> Result<Vec<RoundCone>, TailorError> {
    let mut all = Vec::new();
    for [arm, elbow, hand] in ARMS {
        let [arm, elbow, hand] = [form.joint(arm)?, form.joint(elbow)?, form.joint(hand)?];
        all.push(cone(arm, elbow, [radii[0], radii[1]]));
        all.push(cone(elbow, hand, [radii[1], radii[2]]));
    }
    Ok(all)
}

/// Left, then right.
const ARMS: [[&str; 3]; 2] =
    [["LeftArm", "LeftForeArm", "LeftHand"], ["RightArm", "RightForeArm", "RightHand"]];

fn side_of(side: f32) -> [&'static str; 3] {
    ARMS[usize::from(side < 0.0)]
}

fn below_height<'a>(height: f32) -> Field<'a> {
    Box::new(move |p| height - p.y)
}

/// The head, and a tube of this radius (m) around the neck: it meets the shoulders squarely, where
/// a plane would graze them.
fn collar(form: &Form, radius: f32) -> Result<Field<'_>, TailorError> {
    let (neck, top) = (form.joint("Neck")?, form.joint("Neck1")?);
    let axis = (top - neck).normalize_or_zero();
    let up = Vec3::new(0.0, 0.9, 0.436);
    Ok(Box::new(move |p| {
        let from = p - neck;
        let tube = radius - (from - axis * from.dot(axis)).length();
        // Only the neck's end of the tube, not the chest and the back.
        tube.min(from.dot(axis) + 0.08).max((p - top).dot(up))
    }))
}

/// Across a sleeve near the wrist; only around the hand.
fn cuff(form: &Form, side: f32) -> Result<Field<'_>, TailorError> {
    let [_, elbow, hand] = side_of(side);
    let (elbow, hand) = (form.joint(elbow)?, form.joint(hand)?);
    let outward = (hand - elbow).normalize_or_zero();
    let middle = elbow.lerp(hand, 0.86);
    Ok(Box::new(move |p| {
        let beyond = (p - middle).dot(outward);
        beyond.min(0.28 - p.distance(middle + outward * 0.16))
    }))
}

/// Across a shoulder; only around the arm.
fn armhole(form: &Form, side: f32) -> Result<Field<'_>, TailorError> {
    let [arm, elbow, _] = side_of(side);
    let (arm, elbow) = (form.joint(arm)?, form.joint(elbow)?);
    let outward = (elbow - arm).normalize_or_zero();
    Ok(Box::new(move |p| {
        let along = (p - arm).dot(outward);
        let across = (p - arm - outward * along).length();
        // Beyond the elbow nothing of the sleeve is to be left, however wide it is there.
        let wide = 0.105 + 0.5 * (along - 0.12).max(0.0);
        (along - 0.005).min(wide - across)
    }))
}

/// A box around body and garment (m).
fn around(form: &Form) -> [Vec3; 2] {
    let [low, high] = form.bounds();
    let room = Vec3::new(0.2, 0.12, 0.25);
    [low - room, high + room]
}

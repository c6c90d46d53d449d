//! The joints of the built-in character: 1.7 m tall, facing +z, its left at +x, soles at y = 0.

use cloth::{Rigid, Skeleton, Vec3};

/// Indices of the joints; those of the right side follow the left one's by `SIDE`.
pub(super) mod joint {
    pub const HIPS: usize = 0;
    pub const SPINE: usize = 1;
    pub const CHEST: usize = 2;
    pub const NECK: usize = 3;
    pub const HEAD: usize = 4;
    pub const SHOULDER: usize = 5;
    pub const ARM: usize = 6;
    pub const FOREARM: usize = 7;
    pub const HAND: usize = 8;
    pub const THIGH: usize = 9;
    pub const SHIN: usize = 10;
    pub const FOOT: usize = 11;
    pub const TOES: usize = 12;
    /// From a joint of the left to that of the right.
    pub const SIDE: usize = 8;
    /// How many there are.
    pub const COUNT: usize = 21;
}

/// Name without side, parent (of the left side), place in the rest pose (m) (of the left side).
const JOINTS: [(&str, usize, [f32; 3]); 13] = [
    ("Hips", 0, [0.0, 0.94, 0.0]),
    ("Spine", 0, [0.0, 1.04, 0.0]),
    ("Chest", 1, [0.0, 1.18, -0.005]),
    ("Neck", 2, [0.0, 1.42, -0.015]),
    ("Head", 3, [0.0, 1.51, 0.0]),
    ("Shoulder", 2, [0.03, 1.385, -0.01]),
    ("Arm", 5, [0.165, 1.375, -0.015]),
    ("Forearm", 6, [0.360, 1.180, -0.015]),
    ("Hand", 7, [0.537, 1.003, -0.015]),
    ("Thigh", 0, [0.090, 0.90, 0.0]),
    ("Shin", 9, [0.105, 0.49, 0.004]),
    ("Foot", 10, [0.120, 0.08, -0.012]),
    ("Toes", 11, [0.125, 0.025, 0.105]),
];

/// The skeleton in its rest pose: arms 45 degrees below horizontal, legs slightly apart, and every
/// joint's frame parallel to the world's.
pub(super) fn skeleton() -> Skeleton {
    let mut skeleton =
        Skeleton { names: Vec::new(), parents: Vec::new(), offsets: Vec::new(), rest: Vec::new() };
    for right in [false, true] {
        for (index, (name, parent, [x, y, z])) in JOINTS.iter().enumerate() {
            let sided = index >= joint::SHOULDER;
            if right && !sided {
                continue;
            }
            let parent =
                if right && *parent >= joint::SHOULDER { parent + joint::SIDE } else { *parent };
            let place = Vec3::new(if right { -x } else { *x }, *y, *z);
            let prefix = match (sided, right) {
                (false, _) => "",
                (true, false) => "Left",
                (true, true) => "Right",
            };
            skeleton.names.push(format!("{prefix}{name}"));
            let from = skeleton.rest.get(parent).map_or(Vec3::ZERO, |p: &Rigid| p.translation);
            skeleton.parents.push((index > 0).then_some(parent as u16));
            skeleton.offsets.push(if index > 0 { place - from } else { place });
            skeleton.rest.push(Rigid { translation: place, ..Rigid::IDENTITY });
        }
    }
    skeleton
}

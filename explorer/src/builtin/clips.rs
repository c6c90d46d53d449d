//! The clips of the built-in character. Gaits come from a formula, actions from keys.

use std::f32::consts::{FRAC_PI_2, TAU};

use cloth::{Pose, Rigid, Skeleton, Vec3};

use super::curve::Curve;
use super::figure::Figure;
use super::gait::Gait;

/// Frames per second of all clips.
pub(super) const FPS: f32 = 30.0;

/// A clip that leads back into itself.
pub(super) struct Cycle {
    pub name: &'static str,
    pub poses: Vec<Pose>,
    /// Where the clip is in the world when it begins its next round.
    pub round: Rigid,
}

/// One number of a figure.
type Channel = fn(&mut Figure) -> &mut f32;
/// A number of a figure through (frame, value) keys.
type Track = (Channel, &'static [(f32, f32)]);

/// All clips, in the order of the scene.
pub(super) fn clips(skeleton: &Skeleton) -> Vec<Cycle> {
    let gait = |name, frames, gait: &Gait| {
        cycle(name, frames, skeleton, &|frame| gait.figure(frame / FPS))
    };
    let keyed = |name, frames, tracks: &[Track]| {
        cycle(name, frames, skeleton, &|frame| keyed_figure(tracks, frame))
    };
    vec![
        gait("walk", 32, &WALK),
        gait("run", 22, &RUN),
        gait("turn", 28, &TURN),
        keyed("jump", 44, JUMP),
        keyed("kick", 44, KICK),
        cycle("spin", 44, skeleton, &|frame| {
            let mut figure = keyed_figure(SPIN, frame);
            figure.pivot(0);
            figure
        }),
    ]
}

fn cycle(
    name: &'static str,
    frames: u16,
    skeleton: &Skeleton,
    figure: &dyn Fn(f32) -> Figure,
) -> Cycle {
    let end = figure(f32::from(frames)).carriage;
    let poses = (0..frames).map(|frame| figure(f32::from(frame)).pose(skeleton)).collect();
    Cycle { name, poses, round: Rigid::from_yaw(end.yaw, end.place(Vec3::ZERO)) }
}

fn keyed_figure(tracks: &[Track], frame: f32) -> Figure {
    let mut figure = Figure::default();
    for (channel, keys) in tracks {
        *channel(&mut figure) = Curve::new(keys).at(frame);
    }
    figure
}

const WALK: Gait = Gait {
    cycle_s: 32.0 / FPS,
    speed: 1.2,
    turn: 0.0,
    duty: 0.60,
    width: 0.085,
    lift: 0.07,
    heel: 0.55,
    toes: 0.28,
    drop: 0.036,
    bounce: 0.020,
    lean: 0.05,
    twist: 0.12,
    swing: 0.42,
    elbow: 0.25,
};

const RUN: Gait = Gait {
    cycle_s: 22.0 / FPS,
    speed: 3.1,
    turn: 0.0,
    duty: 0.36,
    width: 0.06,
    lift: 0.26,
    heel: 0.95,
    toes: 0.12,
    drop: 0.075,
    bounce: -0.040,
    lean: 0.24,
    twist: 0.20,
    swing: 0.80,
    elbow: 1.25,
};

/// A third of a turn to the left per cycle.
const TURN: Gait = Gait {
    cycle_s: 28.0 / FPS,
    speed: 0.25,
    turn: TAU / 3.0 * FPS / 28.0,
    duty: 0.62,
    width: 0.115,
    lift: 0.09,
    heel: 0.35,
    toes: 0.05,
    drop: 0.035,
    bounce: 0.012,
    lean: 0.03,
    twist: 0.05,
    swing: 0.22,
    elbow: 0.35,
};

/// Crouch, leap with the arms thrown up, tuck, land deep, rise.
const JUMP: &[Track] = &[
    (|f| &mut f.carriage.z, &[(15.0, 0.0), (19.0, 0.14), (25.0, 0.62), (28.0, 0.76)]),
    (
        |f| &mut f.hips.y,
        &[
            (0.0, -0.02),
            (9.0, -0.30),
            (12.0, -0.24),
            (16.0, 0.08),
            (18.0, 0.24),
            (22.0, 0.38),
            (26.0, 0.22),
            (28.0, 0.03),
            (33.0, -0.33),
            (36.0, -0.31),
            (44.0, -0.02),
        ],
    ),
    (
        |f| &mut f.hips.z,
        &[
            (0.0, 0.0),
            (9.0, -0.06),
            (15.0, 0.06),
            (22.0, 0.0),
            (28.0, -0.10),
            (33.0, -0.04),
            (44.0, 0.0),
        ],
    ),
    (
        |f| &mut f.hips_turn.pitch,
        &[
            (0.0, 0.0),
            (9.0, 0.45),
            (16.0, 0.02),
            (22.0, 0.15),
            (28.0, 0.12),
            (33.0, 0.50),
            (44.0, 0.0),
        ],
    ),
    (
        |f| &mut f.spine.pitch,
        &[
            (0.0, 0.0),
            (9.0, 0.40),
            (16.0, -0.18),
            (22.0, 0.15),
            (28.0, 0.10),
            (33.0, 0.40),
            (44.0, 0.0),
        ],
    ),
    (|f| &mut f.head.pitch, &[(0.0, 0.0), (9.0, -0.5), (16.0, -0.1), (33.0, -0.5), (44.0, 0.0)]),
    (|f| &mut f.arms[0].swing, JUMP_SWING),
    (|f| &mut f.arms[1].swing, JUMP_SWING),
    (|f| &mut f.arms[0].lift, JUMP_LIFT),
    (|f| &mut f.arms[1].lift, JUMP_LIFT),
    (|f| &mut f.feet[0].y, JUMP_FEET),
    (|f| &mut f.feet[1].y, JUMP_FEET),
    (|f| &mut f.feet[0].pitch, JUMP_TOES),
    (|f| &mut f.feet[1].pitch, JUMP_TOES),
    (|f| &mut f.feet[0].z, JUMP_REACH),
    (|f| &mut f.feet[1].z, JUMP_REACH),
];
const JUMP_SWING: &[(f32, f32)] =
    &[(0.0, 0.05), (8.0, -0.80), (20.0, 2.2), (24.0, 2.0), (33.0, 0.3), (44.0, 0.05)];
const JUMP_LIFT: &[(f32, f32)] =
    &[(0.0, 0.36), (9.0, 0.45), (19.0, 0.55), (30.0, 0.75), (44.0, 0.36)];
const JUMP_FEET: &[(f32, f32)] =
    &[(15.0, 0.0), (18.0, 0.14), (22.0, 0.42), (25.0, 0.30), (28.0, 0.0)];
const JUMP_TOES: &[(f32, f32)] =
    &[(9.0, 0.0), (15.0, 0.75), (18.0, 0.85), (23.0, 0.25), (27.0, 0.1), (29.0, 0.0)];
const JUMP_REACH: &[(f32, f32)] = &[(15.0, 0.095), (19.0, -0.03), (23.0, 0.12), (28.0, 0.095)];

/// A high front kick with the right foot.
const KICK: &[Track] = &[
    (|f| &mut f.hips.x, &[(0.0, 0.0), (8.0, 0.105), (29.0, 0.105), (40.0, 0.0)]),
    (
        |f| &mut f.hips.y,
        &[(0.0, -0.02), (7.0, -0.08), (16.0, -0.015), (22.0, -0.03), (30.0, -0.07), (44.0, -0.02)],
    ),
    (|f| &mut f.hips.z, &[(0.0, 0.0), (8.0, 0.05), (16.0, 0.10), (26.0, 0.03), (38.0, 0.0)]),
    (
        |f| &mut f.hips_turn.pitch,
        &[(0.0, 0.0), (8.0, 0.08), (18.0, -0.50), (22.0, -0.42), (33.0, 0.05), (44.0, 0.0)],
    ),
    (
        |f| &mut f.hips_turn.yaw,
        &[(0.0, 0.0), (7.0, -0.25), (18.0, 0.40), (23.0, 0.30), (36.0, 0.0)],
    ),
    (|f| &mut f.spine.pitch, &[(0.0, 0.0), (8.0, 0.15), (16.0, 0.30), (30.0, 0.12), (44.0, 0.0)]),
    (|f| &mut f.spine.yaw, &[(0.0, 0.0), (7.0, 0.30), (16.0, -0.50), (22.0, -0.35), (36.0, 0.0)]),
    (|f| &mut f.head.pitch, &[(0.0, 0.0), (16.0, 0.25), (30.0, 0.0)]),
    (|f| &mut f.feet[1].x, &[(9.0, -0.125), (18.0, -0.04), (22.0, -0.06), (32.0, -0.125)]),
    (
        |f| &mut f.feet[1].y,
        &[
            (4.0, 0.0),
            (9.0, 0.14),
            (13.0, 0.45),
            (18.0, 1.18),
            (20.0, 1.14),
            (26.0, 0.42),
            (33.0, 0.0),
        ],
    ),
    (
        |f| &mut f.feet[1].z,
        &[
            (5.0, 0.095),
            (9.0, -0.26),
            (13.0, 0.30),
            (18.0, 0.92),
            (20.0, 0.90),
            (26.0, 0.42),
            (31.0, 0.095),
        ],
    ),
    (
        |f| &mut f.feet[1].pitch,
        &[
            (2.0, 0.0),
            (8.0, 0.9),
            (13.0, 0.35),
            (18.0, -0.7),
            (20.0, -0.65),
            (28.0, 0.15),
            (33.0, 0.0),
        ],
    ),
    (|f| &mut f.arms[0].swing, &[(0.0, 0.05), (8.0, 0.5), (16.0, 0.95), (24.0, 0.7), (38.0, 0.05)]),
    (|f| &mut f.arms[0].lift, &[(0.0, 0.36), (12.0, 0.75), (22.0, 0.75), (40.0, 0.36)]),
    (|f| &mut f.arms[0].elbow, &[(0.0, 0.25), (8.0, 1.2), (16.0, 1.0), (38.0, 0.25)]),
    (
        |f| &mut f.arms[1].swing,
        &[(0.0, 0.05), (8.0, 0.35), (16.0, -0.75), (24.0, -0.4), (40.0, 0.05)],
    ),
    (|f| &mut f.arms[1].lift, &[(0.0, 0.36), (10.0, 0.7), (18.0, 0.95), (40.0, 0.36)]),
    (|f| &mut f.arms[1].elbow, &[(0.0, 0.25), (8.0, 1.1), (16.0, 0.35), (38.0, 0.25)]),
];

/// Once round to the left on the left foot, arms out, the right leg trailing.
const SPIN: &[Track] = &[
    (|f| &mut f.carriage.yaw, &[(7.0, 0.0), (13.0, 0.55), (30.0, 5.85), (35.0, TAU)]),
    (|f| &mut f.hips.x, &[(0.0, 0.0), (6.0, -0.05), (12.0, 0.10), (29.0, 0.10), (38.0, 0.0)]),
    (
        |f| &mut f.hips.y,
        &[(0.0, -0.02), (8.0, -0.16), (14.0, 0.0), (28.0, 0.0), (34.0, -0.10), (44.0, -0.02)],
    ),
    (|f| &mut f.hips_turn.yaw, &[(0.0, 0.0), (7.0, -0.35), (13.0, 0.15), (20.0, 0.0)]),
    (|f| &mut f.hips_turn.roll, &[(0.0, 0.0), (14.0, 0.10), (28.0, 0.10), (36.0, 0.0)]),
    (
        |f| &mut f.spine.yaw,
        &[(0.0, 0.0), (8.0, -0.50), (15.0, 0.35), (27.0, 0.25), (33.0, -0.10), (42.0, 0.0)],
    ),
    (|f| &mut f.head.yaw, &[(0.0, 0.0), (8.0, 0.30), (14.0, 0.40), (28.0, 0.30), (38.0, 0.0)]),
    (|f| &mut f.feet[0].yaw, &[(0.0, 0.08), (8.0, 0.25), (12.0, 0.08)]),
    (|f| &mut f.feet[0].x, &[(5.0, 0.125), (12.0, 0.10), (29.0, 0.10), (38.0, 0.125)]),
    (|f| &mut f.feet[0].pitch, &[(9.0, 0.0), (14.0, 0.45), (28.0, 0.45), (33.0, 0.0)]),
    (|f| &mut f.feet[1].x, &[(8.0, -0.125), (14.0, -0.26), (26.0, -0.20), (33.0, -0.125)]),
    (|f| &mut f.feet[1].y, &[(7.0, 0.0), (13.0, 0.26), (26.0, 0.22), (35.0, 0.0)]),
    (|f| &mut f.feet[1].z, &[(8.0, 0.095), (14.0, -0.26), (26.0, -0.10), (33.0, 0.095)]),
    (|f| &mut f.feet[1].pitch, &[(6.0, 0.0), (13.0, 0.80), (27.0, 0.55), (34.0, 0.0)]),
    (|f| &mut f.arms[0].lift, SPIN_LIFT),
    (|f| &mut f.arms[1].lift, SPIN_LIFT),
    (
        |f| &mut f.arms[0].swing,
        &[(0.0, 0.05), (8.0, 0.55), (14.0, -0.25), (27.0, 0.0), (40.0, 0.05)],
    ),
    (
        |f| &mut f.arms[1].swing,
        &[(0.0, 0.05), (8.0, -0.50), (14.0, 0.45), (27.0, 0.20), (40.0, 0.05)],
    ),
    (|f| &mut f.arms[0].elbow, &[(0.0, 0.25), (8.0, 0.7), (15.0, 0.15), (40.0, 0.25)]),
];
const SPIN_LIFT: &[(f32, f32)] =
    &[(0.0, 0.36), (7.0, 0.60), (15.0, FRAC_PI_2), (27.0, 1.45), (36.0, 0.60), (43.0, 0.36)];

use std::sync::Arc;

use allocation_counter::measure;
use cloth::Vec3;
use protocol::PoseId;

use super::sheet::{self, FINE};
use super::*;
use crate::character::{Character, StepOutcome, decode};
use crate::shared::Stage;
use crate::tiny;
use crate::version::View;

const ROWS: usize = 3 * FINE * FINE;

struct Play {
    stage: Arc<Stage>,
    character: Character,
    frame: u32,
}

impl Play {
    fn new(view: Arc<View>) -> Self {
        let stage = Arc::new(Stage::default());
        stage.show(view);
        let character = Character::enter(&stage).unwrap();
        Self { stage, character, frame: 0 }
    }

    /// To and fro between the two poses, for ever.
    fn step(&mut self) -> StepOutcome {
        self.frame += 1;
        self.character.step(PoseId(self.frame % 2))
    }

    fn shown(&mut self, phase: f32) -> Vec<f32> {
        self.character.sample(phase);
        let mut out = vec![0.0; ROWS];
        decode(&[&self.character], 0..ROWS, usize::MAX, &mut out).unwrap();
        out
    }

    fn push(&mut self) -> bool {
        let at = self.character.placement().translation - Vec3::Y * 0.4;
        let acceleration = Vec3::new(2.0, 0.0, -20.0);
        self.character.push(Push { at, radius_m: 0.8, acceleration, frames: 3 })
    }
}

/// Largest distance of a vertex (m).
fn apart(a: &[f32], b: &[f32]) -> f32 {
    let square =
        |(a, b): (&[f32], &[f32])| a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f32>();
    a.chunks(3).zip(b.chunks(3)).map(square).fold(0.0, f32::max).sqrt()
}

#[test]
fn a_push_leaves_the_graph_and_comes_back_without_a_jump() {
    let mut play = Play::new(sheet::view(tiny::initial_links(), Some(&sheet::stored()), true));
    for _ in 0..20 {
        assert_eq!(play.step(), StepOutcome::Exact);
    }
    assert!(play.character.can_leave() && play.character.outside().is_none());
    assert!(play.push());
    let before = play.shown(1.0);
    assert_eq!(play.step(), StepOutcome::Substituted { error_m: 0.003 });
    assert!(apart(&play.shown(0.0), &before) < 1e-5, "it begins where it was");
    let (mut frames, mut furthest, mut largest) = (1u64, 0.0f32, 0.0f32);
    let mut last = play.shown(1.0);
    while play.character.outside().is_some() {
        assert!(matches!(play.step(), StepOutcome::Substituted { .. }));
        frames += 1;
        let now = play.shown(1.0);
        largest = largest.max(apart(&now, &last));
        furthest = furthest.max(apart(&now, &before));
        last = now;
        assert!(frames < 600, "it never comes back: {:?}", play.character.outside());
    }
    assert!(furthest > 0.1, "the push was felt: {furthest} m");
    // Back in the graph: from what was shown, by a tenth of the difference a frame.
    assert_eq!(play.step(), StepOutcome::Exact);
    assert!(apart(&play.shown(0.0), &last) < 1e-5, "no jump between the frames");
    let entered = apart(&play.shown(1.0), &last);
    assert!(entered < 0.02 * 0.1 + 0.012, "at most a tenth of what is close, and the graph's own");
    assert!(entered < largest, "{entered} m where ordinary frames go {largest} m");
    for _ in 0..12 {
        assert_eq!(play.step(), StepOutcome::Exact);
    }
    assert!(play.character.shown_error_m() < 0.1, "merges of 10 mm alone");
    let stats = play.character.stats();
    assert_eq!((stats.outside, stats.left, stats.entered), (frames, 1, 1));
    assert_eq!(stats.substituted, frames, "frames outside are substituted");
    assert_eq!(stats.exact + stats.substituted + stats.missed, stats.frames);
    drop(play.character);
    assert_eq!(play.stage.mailbox().drain().outside, frames, "and reported");
}

#[test]
fn what_is_shown_has_no_jump_between_frames_at_any_time() {
    let mut play = Play::new(sheet::view(tiny::initial_links(), Some(&sheet::stored()), true));
    let mut last = play.shown(1.0);
    for frame in 0..400 {
        if frame % 97 == 13 {
            assert!(play.push());
        }
        let wind = if (150..200).contains(&frame) { [0.0, 0.0, 3.0] } else { [0.0; 3] };
        play.character.set_wind(wind);
        play.step();
        assert!(apart(&play.shown(0.0), &last) < 2e-4, "{frame}");
        last = play.shown(1.0);
        assert!(last.iter().all(|x| x.abs() < 1.0), "{frame}");
        // Rows apart are the same rows.
        let mut part = vec![0.0; 9];
        decode(&[&play.character], 60..69, usize::MAX, &mut part).unwrap();
        assert!(part.iter().zip(&last[60..69]).all(|(a, b)| (a - b).abs() < 1e-6));
        // A crowd is decoded as each alone.
        let mut both = vec![0.0; 2 * ROWS];
        let crowd = [&play.character, &play.character];
        decode(&crowd, 0..ROWS, usize::MAX, &mut both).unwrap();
        assert!(apart(&both[ROWS..], &last) < 1e-5);
    }
    let (left, entered) = (play.character.stats().left, play.character.stats().entered);
    assert!(left >= 3 && left - entered <= 1, "{left} {entered} {:?}", play.character.outside());
}

#[test]
fn without_an_upsampler_nothing_leaves() {
    let mut play = Play::new(sheet::view(tiny::initial_links(), None, true));
    assert!(!play.character.can_leave() && !play.push());
    play.character.set_wind([9.0, 0.0, 0.0]);
    for _ in 0..20 {
        assert_eq!(play.step(), StepOutcome::Exact);
    }
    // It arrives with the next view: the wind is felt from then on.
    play.stage.show(sheet::view(tiny::initial_links(), Some(&sheet::stored()), true));
    assert!(matches!(play.step(), StepOutcome::Substituted { .. }));
    assert!(play.character.outside().is_some());
}

#[test]
fn nonsense_pushes_nothing_and_pushes_have_an_end() {
    let mut play = Play::new(sheet::view(tiny::initial_links(), Some(&sheet::stored()), true));
    let good = Push { at: Vec3::ZERO, radius_m: 1.0, acceleration: Vec3::X, frames: 3 };
    for bad in [
        Push { at: Vec3::NAN, ..good },
        Push { radius_m: 0.0, ..good },
        Push { acceleration: Vec3::INFINITY, ..good },
        Push { frames: 0, ..good },
    ] {
        assert!(!play.character.push(bad), "{bad:?}");
    }
    play.character.set_wind([f32::NAN, 0.0, 0.0]);
    assert_eq!(play.step(), StepOutcome::Exact);
    for index in 0..PUSHES_MAX + 2 {
        assert_eq!(play.character.push(good), index < PUSHES_MAX);
    }
    (0..3).for_each(|_| _ = play.step());
    assert!(play.push(), "the others are over");
}

#[test]
fn a_merge_above_the_hosts_limit_is_not_played() {
    let mut play = Play::new(sheet::view(tiny::initial_links(), Some(&sheet::stored()), true));
    play.character.leave_above(Some(0.02));
    for _ in 0..6 {
        assert_eq!(play.step(), StepOutcome::Exact);
    }
    // The links' merges have 10 mm.
    play.character.leave_above(Some(0.005));
    let outside = (0..6).filter(|_| matches!(play.step(), StepOutcome::Substituted { .. })).count();
    assert!(outside >= 5, "{outside}");
    play.character.leave_above(None);
    let back = (0..60).any(|_| play.step() == StepOutcome::Exact);
    assert!(back, "{:?}", play.character.outside());
}

#[test]
fn where_nothing_is_close_it_stays_outside_and_says_so() {
    // No state is resident.
    let mut play = Play::new(sheet::view(tiny::initial_links(), Some(&sheet::stored()), true));
    assert!(play.push());
    play.step();
    play.stage.show(sheet::view(tiny::initial_links(), Some(&sheet::stored()), false));
    for _ in 0..100 {
        assert!(matches!(play.step(), StepOutcome::Substituted { .. }));
    }
    assert_eq!(play.character.outside(), Some(Outside { frames: 101, nearest_m: None }));
    // Resident, but not within what the host takes for close.
    play.stage.show(sheet::view(tiny::initial_links(), Some(&sheet::stored()), true));
    play.character.return_within(Some(0.0));
    (0..20).for_each(|_| _ = play.step());
    let nearest_m = play.character.outside().and_then(|outside| outside.nearest_m);
    assert!(nearest_m.is_some_and(|m| (0.0..0.05).contains(&m)), "{nearest_m:?}");
    play.character.return_within(None);
    (0..2).for_each(|_| _ = play.step());
    assert!(play.character.outside().is_none());
}

#[test]
fn it_comes_back_within_its_class_only() {
    // By itself the cloth would creep for ten seconds; states 0 and 1 hang 14 and 11 mm behind, and
    // from the tenth frame on the cloth is in front of the last plane.
    for (threshold_m, comes_back) in [(0.5, true), (-0.5, true), (-0.0108, false)] {
        let mut stored = sheet::stored();
        stored.stepping.damping_per_s = 40.0;
        stored.classes = vec![codec::upsample::Class { threshold_m, ..sheet::class() }];
        let mut play = Play::new(sheet::view(tiny::initial_links(), Some(&stored), true));
        let at = play.character.placement().translation - Vec3::Y * 0.4;
        let acceleration = Vec3::new(0.0, 0.0, 60.0);
        assert!(play.character.push(Push { at, radius_m: 0.5, acceleration, frames: 5 }));
        let back = (0..60).any(|_| play.step() == StepOutcome::Exact);
        assert_eq!(back, comes_back, "{threshold_m}: {:?}", play.character.outside());
    }
}

#[test]
fn jumps_and_poses_that_do_not_exist_are_survived_outside() {
    let mut play = Play::new(sheet::view(tiny::initial_links(), Some(&sheet::stored()), true));
    assert!(play.push());
    play.step();
    // Pose 1 does not follow pose 1.
    assert!(matches!(play.character.step(PoseId(1)), StepOutcome::Substituted { .. }));
    let last = play.shown(1.0);
    assert_eq!(play.character.step(PoseId(77)), StepOutcome::Missed);
    assert_eq!(play.character.stats().jumps, 2);
    assert!(apart(&play.shown(1.0), &last) < 1e-6, "the last cloth is shown on");
    assert!(matches!(play.character.step(PoseId(0)), StepOutcome::Substituted { .. }));
    assert!(play.shown(1.0).iter().all(|x| x.is_finite()));
}

#[test]
fn a_warm_frame_outside_allocates_nothing() {
    let mut play = Play::new(sheet::view(tiny::initial_links(), Some(&sheet::stored()), true));
    play.character.return_within(Some(0.0));
    let mut out = vec![0.0; ROWS];
    let mut frame = |play: &mut Play| {
        play.step();
        play.character.sample(0.5);
        decode(&[&play.character], 0..ROWS, usize::MAX, &mut out).unwrap();
    };
    // A batch of telemetry ends with every thirtieth frame; edges are counted in a map.
    play.push();
    (0..92).for_each(|_| frame(&mut play));
    play.push();
    let asked = measure(|| (0..25).for_each(|_| frame(&mut play)));
    assert_eq!(asked.count_total, 0, "allocations in 25 frames");
    assert!(play.character.outside().is_some_and(|o| o.nearest_m.is_some()), "the search was on");
}

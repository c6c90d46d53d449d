use super::*;
use crate::tiny;
use codec::VertexFix;

fn at(pose: u32) -> PoseId {
    PoseId(pose)
}

/// A stage that shows `view`, and a character on it.
fn enter(view: &Arc<View>) -> (Arc<Stage>, Character) {
    let stage = Arc::new(Stage::default());
    stage.show(Arc::clone(view));
    let character = Character::enter(&stage).unwrap();
    (stage, character)
}

fn shown(character: &mut Character) -> [f32; 2] {
    let coefficients = character.sample(1.0);
    [coefficients[0], coefficients[1]]
}

fn assert_near(found: [f32; 2], expected: [f32; 2]) {
    let near = found.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-6);
    assert!(near, "{found:?} instead of {expected:?}");
}

/// `weight` of the offset between two states on top of a third.
fn with_offset(base: u64, from: u64, to: u64, weight: f32) -> [f32; 2] {
    let (base, from, to) = (tiny::fractions(base), tiny::fractions(from), tiny::fractions(to));
    [0, 1].map(|i| base[i] + weight * (from[i] - to[i]))
}

#[test]
fn a_merge_fades_by_a_tenth_a_frame() {
    let version = tiny::version(1, tiny::initial_links());
    let (_stage, mut character) = enter(&tiny::view(&version, &[0]));
    assert_near(shown(&mut character), tiny::fractions(0));
    assert_eq!(character.step(at(1)), StepOutcome::Exact);
    assert_near(shown(&mut character), tiny::fractions(1));
    // 1 -> dead end 3, merged into 0: first the dead end itself.
    assert_eq!(character.step(at(0)), StepOutcome::Exact);
    assert_near(shown(&mut character), tiny::fractions(3));
    assert!((character.shown_error_m() - 0.01).abs() < 1e-7);
    // 0 -> 1, where nine tenths of the offset are left; then 0 by the same dead end, where the
    // two offsets overlap.
    assert_eq!(character.step(at(1)), StepOutcome::Exact);
    assert_near(shown(&mut character), with_offset(1, 3, 0, 0.9));
    assert_eq!(character.step(at(0)), StepOutcome::Exact);
    assert_near(shown(&mut character), with_offset(0, 3, 0, 0.8 + 1.0));
    assert!((character.shown_error_m() - 0.018).abs() < 1e-7);
    assert_eq!(character.stats().exact, 4);
}

#[test]
fn an_offset_is_gone_after_ten_frames() {
    let mut links = tiny::initial_links();
    // No merge but the first: 1 -> 3 -> (0 -> 0 -> ... by state 0 itself).
    links[0] = tiny::interior(0, &[0, 1]);
    links[2] = tiny::retired(0, 0);
    let version = tiny::version(1, links);
    let (_stage, mut character) = enter(&tiny::view(&version, &[0]));
    character.step(at(1));
    for frame in 0..13u8 {
        character.step(at(0));
        let weight = f32::from(10u8.saturating_sub(frame)) / 10.0;
        assert_near(shown(&mut character), with_offset(0, 3, 0, weight));
        assert!((character.shown_error_m() - 0.01 * weight).abs() < 1e-7);
    }
}

#[test]
fn samples_lie_between_the_last_two_frames() {
    let version = tiny::version(1, tiny::initial_links());
    let (_stage, mut character) = enter(&tiny::view(&version, &[0]));
    character.step(at(1));
    let (from, to) = (tiny::fractions(0), tiny::fractions(1));
    for phase in [0.0, 0.25, 1.0] {
        let sampled = character.sample(phase);
        let expected = [0, 1].map(|i| from[i] + phase * (to[i] - from[i]));
        assert_near([sampled[0], sampled[1]], expected);
        let place = character.placement().translation;
        assert!((place.z - phase * tiny::STRIDE_M).abs() < 1e-6);
        assert!((character.world_pose().root - place).length() < 1e-6);
        let mut out = [0.0; 6];
        decode(&[&character, &character], 0..3, usize::MAX, &mut out).unwrap();
        assert!((out[0] - expected[0] * tiny::SCALE_M).abs() < 1e-4, "{out:?}");
        assert!((out[4] - expected[1] * tiny::SCALE_M).abs() < 1e-4, "{out:?}");
    }
    let mut short = [0.0; 5];
    assert!(decode(&[&character, &character], 0..3, 2, &mut short).is_err());
    assert!(decode(&[], 0..3, 2, &mut []).is_ok());
}

#[test]
fn a_switch_keeps_the_state_and_changes_where_it_leads() {
    let old = tiny::version(1, tiny::initial_links());
    let (stage, mut character) = enter(&tiny::view(&old, &[0]));
    character.step(at(1));
    let new = tiny::version(2, tiny::grown_links());
    stage.show(tiny::view(&new, &[0, 1]));
    assert_eq!(character.version().number(), old.number(), "not before the next step");
    // Dead end 3 was expanded: no merge any more.
    assert_eq!(character.step(at(0)), StepOutcome::Exact);
    assert_eq!(character.version().number(), new.number());
    assert_eq!(character.state(), StateId(3));
    assert_near(shown(&mut character), tiny::fractions(3));
    assert_eq!(character.shown_error_m(), 0.0);
    assert_eq!(character.stats().switches, 1);
    assert_eq!(character.step(at(1)), StepOutcome::Exact);
    assert_eq!(character.state(), StateId(5));
}

#[test]
fn a_retired_state_goes_on_at_its_successor_and_the_difference_fades() {
    let new = tiny::version(2, tiny::grown_links());
    let (stage, mut character) = enter(&tiny::view(&new, &[0, 1]));
    for pose in [1, 0, 1] {
        character.step(at(pose));
    }
    assert_eq!(character.state(), StateId(5));
    // Rollback: 4, 5 and 6 are of another version, 3 a dead end again.
    let mut links = tiny::initial_links();
    links.extend([tiny::retired(0, 0), tiny::retired(1, 1), tiny::retired(0, 0)]);
    let old = tiny::version(3, links);
    stage.show(tiny::view(&old, &[0]));
    assert_eq!(character.step(at(0)), StepOutcome::Exact);
    // 5 became 1; 1 leads to dead end 3 in 0. Offsets: 5 - 1 at nine tenths, 3 - 0 at full.
    assert_eq!(character.state(), StateId(0));
    let merged = with_offset(0, 3, 0, 1.0);
    let switched = with_offset(0, 5, 1, 0.9);
    let base = tiny::fractions(0);
    assert_near(shown(&mut character), [0, 1].map(|i| merged[i] + switched[i] - base[i]));
    let (a, b) = (tiny::fractions(5), tiny::fractions(1));
    let distance = tiny::SCALE_M * ((a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2)).sqrt();
    assert!((character.shown_error_m() - (0.01 + 0.9 * distance)).abs() < 1e-5);
}

#[test]
fn a_version_that_never_heard_of_the_state_goes_on_at_the_same_pose() {
    let new = tiny::version(2, tiny::grown_links());
    let (stage, mut character) = enter(&tiny::view(&new, &[0, 1]));
    for pose in [1, 0, 1] {
        character.step(at(pose));
    }
    let old = tiny::version(3, tiny::initial_links());
    stage.show(tiny::view(&old, &[0]));
    assert_eq!(character.step(at(0)), StepOutcome::Exact);
    assert_eq!(character.pose(), at(0));
    assert_eq!(character.stats().jumps, 0);
}

#[test]
fn a_missing_region_is_substituted_with_its_error_then_exact_when_it_arrives() {
    let version = tiny::version(2, tiny::grown_links());
    let (stage, mut character) = enter(&tiny::view(&version, &[0]));
    character.step(at(1));
    assert_eq!(character.step(at(0)), StepOutcome::Exact);
    assert_eq!(character.state(), StateId(3));
    // 3 -> 5 is not resident. Of pose 0's states, 0 goes on to 1, which is: the twin of 3.
    let outcome = character.step(at(1));
    let (a, b) = (tiny::fractions(3), tiny::fractions(0));
    let distance = tiny::SCALE_M * ((a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2)).sqrt();
    let StepOutcome::Substituted { error_m } = outcome else { panic!("{outcome:?}") };
    assert!((error_m - distance).abs() < 1e-4, "{error_m} instead of {distance}");
    assert!((character.shown_error_m() - distance).abs() < 1e-4);
    assert_eq!(character.state(), StateId(5), "the links are followed all the same");
    assert_near(shown(&mut character), with_offset(1, 3, 0, 0.9));
    stage.show(tiny::view(&version, &[0, 1]));
    // The named way: 5 -> dead end 6 in 0; the substitute's way: 1 -> 3. Both are of pose 0.
    assert_eq!(character.step(at(0)), StepOutcome::Exact);
    assert_eq!(character.state(), StateId(0));
    let expected = [with_offset(0, 3, 0, 1.0), with_offset(0, 3, 0, 0.8)];
    let base = tiny::fractions(0);
    assert_near(shown(&mut character), [0, 1].map(|i| expected[0][i] + expected[1][i] - base[i]));
    let stats = character.stats();
    assert_eq!((stats.exact, stats.substituted, stats.missed), (3, 1, 0));
    assert_eq!(stats.frames, 4);
}

#[test]
fn a_jump_enters_at_the_nearest_state_and_is_counted() {
    let version = tiny::version(2, tiny::grown_links());
    let (_stage, mut character) = enter(&tiny::view(&version, &[0, 1]));
    for pose in [1, 0, 1] {
        character.step(at(pose));
    }
    // Pose 1 does not follow pose 1; of its states, 5 itself is the nearest.
    let before = character.placement();
    let outcome = character.step(at(1));
    assert!(matches!(outcome, StepOutcome::Substituted { .. }), "{outcome:?}");
    assert_eq!((character.stats().jumps, character.state()), (1, StateId(5)));
    assert!((character.placement().translation - before.translation).length() < 1e-5);
    assert_eq!(character.step(at(0)), StepOutcome::Exact, "and it goes on as ever");
    // A pose that does not exist moves nothing.
    assert_eq!(character.step(at(77)), StepOutcome::Missed);
    assert_eq!((character.pose(), character.stats().jumps), (at(0), 2));
}

#[test]
fn without_any_state_a_step_is_missed_and_cloth_is_shown_all_the_same() {
    let version = tiny::version(1, tiny::initial_links());
    let (stage, mut character) = enter(&tiny::view(&version, &[]));
    assert_eq!(character.step(at(1)), StepOutcome::Missed);
    assert_eq!(character.step(at(0)), StepOutcome::Missed);
    assert_near(shown(&mut character), [0.0, 0.0]);
    stage.show(tiny::view(&version, &[0]));
    assert_eq!(character.step(at(1)), StepOutcome::Exact);
    assert_eq!(character.stats().missed, 2);
}

#[test]
fn a_step_does_not_wait_for_the_driver() {
    let version = tiny::version(1, tiny::initial_links());
    let (stage, mut character) = enter(&tiny::view(&version, &[0]));
    stage.show(tiny::view(&tiny::version(2, tiny::grown_links()), &[0]));
    let number = stage.while_locked(|| {
        assert_eq!(character.step(at(1)), StepOutcome::Exact);
        character.version().number()
    });
    assert_eq!(number, version.number(), "the new version waits, not the frame");
    character.step(at(0));
    assert_eq!(character.version().number(), protocol::VersionNumber(2));
}

#[test]
fn walked_edges_are_reported_in_batches() {
    let version = tiny::version(1, tiny::initial_links());
    let (stage, mut character) = enter(&tiny::view(&version, &[0]));
    for frame in 0..45u32 {
        character.step(at((frame + 1) % 2));
    }
    let first = stage.mailbox().drain();
    assert_eq!(first.edges[&EdgeId(1)] + first.edges[&EdgeId(2)], 30);
    assert_eq!(first.exact, 30);
    drop(character);
    assert_eq!(stage.mailbox().drain().edges.values().sum::<u32>(), 15, "the rest at the end");
    assert!(stage.cursors().is_empty());
}

#[test]
fn a_character_can_be_placed_before_a_merge_and_says_what_it_passes() {
    let version = tiny::version(1, tiny::initial_links());
    let (_stage, mut character) = enter(&tiny::view(&version, &[0]));
    assert!(character.place(StateId(1)));
    assert_eq!((character.pose(), character.state()), (at(1), StateId(1)));
    assert_eq!(character.passed(), None);
    character.step(at(0));
    let passed = character.passed().unwrap();
    assert_eq!((passed.dead_end, passed.target), (StateId(3), StateId(0)));
    assert!((passed.error_m - 0.01).abs() < 1e-7);
    assert!(character.place(StateId(3)), "a dead end stands for its target");
    assert_eq!(character.state(), StateId(0));
    assert_near(shown(&mut character), tiny::fractions(0));
    assert!(!character.place(StateId(999)));
    let mut coefficients = [9.0; 2];
    assert!(character.read(StateId(3), &mut coefficients));
    assert_near(coefficients, tiny::fractions(3));
}

#[test]
fn a_state_of_its_own_is_shown_with_the_fixes_that_keep_its_bound() {
    let version = tiny::version(1, tiny::initial_links());
    let fix = VertexFix { state: 1, vertex: 0, offset_m: [0.5, 0.0, -0.25] };
    let (_stage, mut character) = enter(&tiny::view_with(&version, &[0], &[fix]));
    let (_plain_stage, plain) = enter(&tiny::view(&version, &[0]));
    let cloth = |character: &Character, state| {
        let mut out = Vec::new();
        assert!(character.cloth_of(StateId(state), &mut out).unwrap());
        out
    };
    assert_eq!(cloth(&character, 0), cloth(&plain, 0));
    let expected: Vec<f32> =
        cloth(&plain, 1).iter().zip(fix.offset_m).map(|(p, o)| p + o).collect();
    assert_eq!(cloth(&character, 1), expected);
    // What is played is the same cloth.
    character.step(at(1));
    let mut played = vec![0.0; 3];
    decode(&[&character], 0..3, usize::MAX, &mut played).unwrap();
    assert_eq!(played, expected);
    assert!(!character.cloth_of(StateId(5), &mut Vec::new()).unwrap(), "not resident");
}

#[test]
fn without_a_blend_the_jump_is_seen_and_without_counting_nothing_is_reported() {
    let version = tiny::version(1, tiny::initial_links());
    let (stage, mut character) = enter(&tiny::view(&version, &[0]));
    character.set_blend(crate::BlendMode::Off);
    character.set_counted(false);
    for frame in 0..60 {
        character.step(at((frame + 1) % 2));
    }
    assert_near(shown(&mut character), tiny::fractions(0));
    drop(character);
    assert!(stage.mailbox().drain().is_empty());
}

/// Characters at different places of the graph, decoded together, with and without a tier: every bit as
/// if each were decoded alone.
#[test]
fn a_group_gets_what_each_would_get_alone() {
    let version = tiny::version(1, tiny::initial_links());
    let fixes = [VertexFix { state: 1, vertex: 0, offset_m: [0.0, 0.0, 0.25] }];
    let view = tiny::view_with(&version, &[0], &fixes);
    let stage = Arc::new(Stage::default());
    stage.show(view);
    let mut crowd: Vec<Character> = (0..37).map(|_| Character::enter(&stage).unwrap()).collect();
    for (index, character) in crowd.iter_mut().enumerate() {
        if index % 5 == 3 {
            character.set_tier(16);
        }
        for step in 0..index {
            character.step(at(1 - (step % 2) as u32));
        }
        character.sample(index as f32 / 37.0);
    }
    let all: Vec<&Character> = crowd.iter().collect();
    let mut group = Group::default();
    for columns in [usize::MAX, 1] {
        let mut together = vec![9.0; 3 * all.len()];
        group.decode(&all, 0..3, columns, &mut together).unwrap();
        for (character, together) in all.iter().zip(together.chunks(3)) {
            let mut alone = [7.0; 3];
            decode(&[character], 0..3, columns, &mut alone).unwrap();
            assert_eq!(together, alone);
        }
    }
    assert!(group.decode(&all, 0..3, 1, &mut [0.0; 3]).is_err());
}

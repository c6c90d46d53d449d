//! Differences between manifests, and the transition table.

use crate::samples;

use proptest::prelude::*;
use protocol::difference::ApplyError;
use protocol::links::{LinkEntry, LinkPage};
use protocol::table::{Entry, Follow};
use protocol::{LinkTable, ManifestDifference, NotTotal, PoseId, SigningKey, StateId};

#[test]
fn a_new_version_costs_only_what_changed() {
    let base = samples::manifest(1, 2000, 500, 0);
    let to = samples::manifest(2, 2003, 500, 9).sign(&samples::key());
    let difference = ManifestDifference::compute(&base, &to);
    let bytes = difference.encode();
    assert!(to.encode().len() > 80_000);
    assert!(bytes.len() < 700, "{} bytes for 3 region chunks and 2 pages", bytes.len());
    let received = ManifestDifference::decode(&bytes).unwrap();
    assert_eq!(received.apply(&base, &samples::key().public()).unwrap(), to);
}

#[test]
fn a_difference_needs_its_base_and_its_signature() {
    let base = samples::manifest(1, 3, 3, 0);
    let to = samples::manifest(2, 4, 3, 1).sign(&samples::key());
    let difference = ManifestDifference::compute(&base, &to);
    let publisher = samples::key().public();
    let other = samples::manifest(1, 3, 3, 5);
    let error = difference.apply(&other, &publisher).unwrap_err();
    assert!(matches!(error, ApplyError::OtherBase { .. }), "{error}");
    let stranger = SigningKey::from_seed(&[9; 32]).public();
    let error = difference.apply(&base, &stranger).unwrap_err();
    assert!(matches!(error, ApplyError::Manifest(_)), "{error}");
}

/// Every flipped byte of a difference is refused when it is applied, or changes nothing.
#[test]
fn a_damaged_difference_never_applies() {
    let base = samples::manifest(1, 3, 3, 0);
    let to = samples::manifest(2, 4, 3, 1).sign(&samples::key());
    let bytes = ManifestDifference::compute(&base, &to).encode();
    for index in 0..bytes.len() {
        let mut damaged = bytes.clone();
        damaged[index] ^= 1;
        let Ok(difference) = ManifestDifference::decode(&damaged) else { continue };
        if let Ok(result) = difference.apply(&base, &samples::key().public()) {
            assert_eq!(result, to, "byte {index}");
        }
    }
}

proptest! {
    #[test]
    fn any_manifest_leads_to_any_other(
        a in (0u64..40, 0u64..40, 0u64..3),
        b in (0u64..40, 0u64..40, 0u64..3),
        shuffle in any::<prop::sample::Index>(),
    ) {
        let base = samples::manifest(5, a.0, a.1, a.2);
        let mut to = samples::manifest(6, b.0, b.1, b.2);
        let links = &mut to.garments[0].links;
        if !links.is_empty() {
            links.rotate_left(shuffle.index(b.1 as usize));
        }
        let to = to.sign(&samples::key());
        let difference = ManifestDifference::compute(&base, &to);
        let received = ManifestDifference::decode(&difference.encode()).unwrap();
        prop_assert_eq!(received.apply(&base, &samples::key().public()).unwrap(), to);
    }
}

fn table(entries: &[LinkEntry]) -> Result<LinkTable, NotTotal> {
    let scene = samples::scene();
    LinkTable::new(&LinkPage::split(entries), scene.poses.len(), &scene.edges)
}

#[test]
fn a_total_table_can_be_walked_for_ever() {
    let table = table(&samples::entries()).unwrap();
    let scene = samples::scene();
    let mut state = StateId(0);
    for step in 0..1000 {
        let pose = table.pose(state).unwrap();
        let out: Vec<_> = scene.edges.iter().filter(|edge| edge.from == pose).collect();
        let choice = step * 7 % out.len();
        let follow = table.follow(state, choice).unwrap();
        assert_eq!(table.pose(follow.state), Some(out[choice].to));
        assert!(matches!(table.entry(follow.state), Some(Entry::Interior(_))));
        state = follow.state;
    }
    let merged = table.follow(StateId(1), 0);
    assert_eq!(merged, Some(Follow { state: StateId(0), via: Some((StateId(2), 0.005)) }));
    assert_eq!(table.follow(StateId(0), 2), None);
    assert_eq!(table.follow(StateId(2), 0), None);
    assert_eq!(table.interior(PoseId(1)), [StateId(1)]);
    assert!(table.interior(PoseId(3)).is_empty());
    assert_eq!(table.resume(StateId(5)), Some(StateId(1)));
    assert_eq!(table.resume(StateId(2)), Some(StateId(0)));
    assert_eq!(table.resume(StateId(6)), None);
}

#[test]
fn what_is_not_total_is_named() {
    type Spoil = fn(&mut Vec<LinkEntry>);
    let dead = |pose, target| LinkEntry::DeadEnd {
        pose: PoseId(pose),
        target: StateId(target),
        error_m: 0.0,
    };
    let cases: [(&str, Spoil); 6] = [
        ("1 links for 2 out-edges", |e| {
            e[0] = LinkEntry::Interior { pose: PoseId(0), next: vec![StateId(1)] }
        }),
        ("does not have", |e| {
            e[1] = LinkEntry::Interior { pose: PoseId(1), next: vec![StateId(99)] }
        }),
        ("state 1 leads to state 3 of pose 2, where pose 0", |e| {
            e[1] = LinkEntry::Interior { pose: PoseId(1), next: vec![StateId(3)] }
        }),
        ("not interior", |e| e[5] = LinkEntry::Retired { pose: PoseId(0), successor: StateId(2) }),
        ("does not have", |e| e[4] = LinkEntry::Retired { pose: PoseId(0), successor: StateId(0) }),
        ("pose 7, but", |e| e[5] = LinkEntry::Retired { pose: PoseId(7), successor: StateId(0) }),
    ];
    for (part, spoil) in cases {
        let mut entries = samples::entries();
        spoil(&mut entries);
        let error = table(&entries).unwrap_err().to_string();
        assert!(error.contains(part), "{error:?} should speak of {part:?}");
    }
    let mut empty = samples::entries();
    empty[3] = dead(2, 3);
    assert_eq!(table(&empty), Err(NotTotal::EmptyPose(PoseId(2))));
    let pages = [LinkPage { first_state: StateId(256), entries: samples::entries() }];
    let gap = LinkTable::new(&pages, 3, &samples::scene().edges);
    assert!(matches!(gap, Err(NotTotal::PageGap { page: 0, .. })));
}

#[test]
fn pages_split_and_join() {
    let entry =
        |id: u64| LinkEntry::Interior { pose: PoseId(0), next: vec![StateId((id + 1) % 600)] };
    let entries: Vec<_> = (0..600).map(entry).collect();
    let pages = LinkPage::split(&entries);
    assert_eq!(pages.iter().map(|p| p.entries.len()).collect::<Vec<_>>(), [256, 256, 88]);
    let edge = protocol::scene::Edge { from: PoseId(0), to: PoseId(0), yaw: 0.0, shift: [0.0; 2] };
    assert_eq!(LinkTable::new(&pages, 1, &[edge]).unwrap().state_count(), 600);
    let missing = LinkTable::new(&[pages[0].clone(), pages[2].clone()], 1, &[edge]);
    assert!(matches!(missing, Err(NotTotal::PageGap { page: 1, .. })));
}

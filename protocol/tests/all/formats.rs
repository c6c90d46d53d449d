//! Every stored type: round trip, golden bytes, and hostile input.

use crate::samples;

use proptest::prelude::*;
use protocol::links::{LinkEntry, LinkPage};
use protocol::manifest::ManifestError;
use protocol::region::RegionChunk;
use protocol::scene::{GarmentChunk, SceneChunk};
use protocol::tag::Tag;
use protocol::telemetry::TelemetryBatch;
use protocol::{
    ChunkHash, DecodeError, Manifest, ManifestDifference, PoseId, SignedManifest, SigningKey,
    StateId,
};

fn difference() -> ManifestDifference {
    let to = samples::manifest(2, 3, 3, 9).sign(&samples::key());
    ManifestDifference::compute(&samples::manifest(1, 2, 3, 0), &to)
}

fn upsampled_difference() -> ManifestDifference {
    let to = samples::upsampled(2, 9).sign(&samples::key());
    ManifestDifference::compute(&samples::manifest(1, 2, 3, 0), &to)
}

/// Name, bytes, and whether bytes are accepted by that type's decoder.
type Sample = (&'static str, Vec<u8>, fn(&[u8]) -> bool);

fn stored() -> Vec<Sample> {
    let manifest = samples::manifest(1, 2, 3, 0).sign(&samples::key());
    vec![
        ("scene", samples::scene().encode(), |b| SceneChunk::decode(b).is_ok()),
        ("garment", samples::garment().encode(), |b| GarmentChunk::decode(b).is_ok()),
        ("regions", samples::regions().encode(), |b| RegionChunk::decode(b).is_ok()),
        ("page", samples::page().encode(), |b| LinkPage::decode(b).is_ok()),
        ("manifest", manifest.encode(), |b| {
            SignedManifest::open(b, &samples::key().public()).is_ok()
        }),
        ("difference", difference().encode(), |b| ManifestDifference::decode(b).is_ok()),
        ("upsampled manifest", samples::upsampled(1, 9).sign(&samples::key()).encode(), |b| {
            SignedManifest::open(b, &samples::key().public()).is_ok()
        }),
        ("upsampled difference", upsampled_difference().encode(), |b| {
            ManifestDifference::decode(b).is_ok()
        }),
        ("telemetry", samples::telemetry().encode(), |b| TelemetryBatch::decode(b).is_ok()),
        ("tag", samples::tag().encode(), |b| Tag::decode(b).is_ok()),
    ]
}

#[test]
fn round_trips() {
    assert_eq!(SceneChunk::decode(&samples::scene().encode()).unwrap(), samples::scene());
    assert_eq!(GarmentChunk::decode(&samples::garment().encode()).unwrap(), samples::garment());
    let telemetry = samples::telemetry();
    assert_eq!(TelemetryBatch::decode(&telemetry.encode()).unwrap(), telemetry);
    assert_eq!(Tag::decode(&samples::tag().encode()).unwrap(), samples::tag());
    assert_eq!(RegionChunk::decode(&samples::regions().encode()).unwrap(), samples::regions());
    assert_eq!(LinkPage::decode(&samples::page().encode()).unwrap(), samples::page());
    let signed = samples::manifest(1, 2, 3, 0).sign(&samples::key());
    assert_eq!(SignedManifest::open(&signed.encode(), &samples::key().public()).unwrap(), signed);
    for difference in [difference(), upsampled_difference()] {
        assert_eq!(ManifestDifference::decode(&difference.encode()).unwrap(), difference);
    }
    let signed = samples::upsampled(1, 9).sign(&samples::key());
    assert_eq!(SignedManifest::open(&signed.encode(), &samples::key().public()).unwrap(), signed);
}

/// An upsampler comes, is replaced and goes again; each way the difference leads to what was signed.
#[test]
fn an_upsampler_comes_with_a_version_and_goes_with_another() {
    let key = samples::key();
    let line = [
        samples::manifest(1, 2, 3, 0),
        samples::upsampled(2, 9),
        samples::upsampled(3, 9),
        samples::upsampled(4, 10),
        samples::manifest(5, 2, 3, 0),
    ];
    for pair in line.windows(2) {
        let to = pair[1].clone().sign(&key);
        let difference = ManifestDifference::compute(&pair[0], &to);
        let read = ManifestDifference::decode(&difference.encode()).unwrap();
        assert_eq!(read.apply(&pair[0], &key.public()).unwrap(), to);
    }
    let plain = line[0].encode();
    assert_eq!(plain[4], 1, "without an upsampler it is what older programs read");
    let mut newer = line[1].encode();
    assert_eq!(newer[4], 2);
    assert!(line[1].garments[0].chunks().any(|chunk| chunk == samples::chunk(9)));
    newer[4] = 3;
    let error = Manifest::decode(&newer).unwrap_err();
    assert!(matches!(error, DecodeError::UnknownVersion { found: 3, known: 2, .. }), "{error}");
    // An empty list would be a second form of version 1.
    let empty = [b"TMAN\x02\x00", &plain[6..], &[0]].concat();
    assert!(Manifest::decode(&empty).is_err());
}

/// Formats are promises: these change only together with a format's version number.
#[test]
fn golden_bytes() {
    let page = samples::page().encode();
    let hex: String = page.iter().map(|b| format!("{b:02x}")).collect();
    let golden = concat!(
        "544c4e4b0100",   // TLNK, version 1
        "0006",           // from state 0, six entries
        "0000020206",     // interior, pose 0, two links: +1, +3
        "00020102",       // interior, pose +1, one link: +1
        "0101030ad7a33b", // dead end, pose -1, merged into -2, 0.005 m
        "00040102",       // interior, pose +2, one link: +1
        "01030700000000", // dead end, pose -2, merged into -4, 0 m
        "020207",         // retired, pose +1, goes on at -4
    );
    assert_eq!(hex, golden);
    let digests: Vec<_> = stored()
        .iter()
        .map(|(name, bytes, _)| {
            format!("{name} {} {:.16}", bytes.len(), ChunkHash::of(bytes).to_string())
        })
        .collect();
    let golden = [
        "scene 393 55d8665b80705737",
        "garment 19 42f05a749016ca65",
        "regions 29 8b5749e7be869411",
        "page 38 6ad86041a59c2373",
        "manifest 396 cc6e53307ded4867",
        "difference 368 c12553a3b55bdd9d",
        "upsampled manifest 432 32ae1383bad3c5e5",
        "upsampled difference 292 a1aa0b1d798e5675",
        "telemetry 14 870948e974c6b945",
        "tag 10 82561d246f31ebfb",
    ];
    assert_eq!(digests, golden);
}

#[test]
fn every_truncation_and_extra_bytes_are_refused() {
    for (name, bytes, accepts) in stored() {
        assert!(accepts(&bytes), "{name}");
        for end in 0..bytes.len() {
            assert!(!accepts(&bytes[..end]), "{name} cut to {end}");
        }
        assert!(!accepts(&[&bytes[..], &[0]].concat()), "{name} with a byte too many");
    }
}

#[test]
fn a_flipped_byte_never_panics_and_never_passes_the_signature() {
    for (name, bytes, accepts) in stored() {
        for index in 0..bytes.len() {
            for mask in [0x01, 0x80, 0xff] {
                let mut damaged = bytes.clone();
                damaged[index] ^= mask;
                let accepted = accepts(&damaged);
                let sealed = index < 6 || name.ends_with("manifest");
                assert!(!(sealed && accepted), "{name}: byte {index} ^ {mask:#x} was accepted");
            }
        }
    }
}

#[test]
fn kind_version_and_length_are_named_in_the_error() {
    let mut bytes = samples::garment().encode();
    let other = SceneChunk::decode(&bytes).unwrap_err();
    assert!(matches!(other, DecodeError::NotThis { what: "scene chunk", .. }));
    bytes[4] = 9;
    let newer = GarmentChunk::decode(&bytes).unwrap_err();
    assert!(matches!(newer, DecodeError::UnknownVersion { found: 9, known: 1, .. }));
    let long = vec![0; protocol::limits::MANIFEST_BYTES_MAX + 100];
    assert!(matches!(Manifest::decode(&long), Err(DecodeError::TooLong { .. })));
}

/// A length of 2^60 in a nine-byte file must not take memory.
#[test]
fn a_huge_count_is_refused_without_memory() {
    for (name, bytes, accepts) in stored() {
        let huge = [0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0x0f];
        // This one ends with a hash, which may be any bytes; a difference is believed once applied.
        let open = if name == "upsampled difference" { 34 } else { 9 };
        for at in 6..bytes.len().saturating_sub(open) {
            let hostile = [&bytes[..at], &huge[..]].concat();
            assert!(!accepts(&hostile), "{name} with a huge number at {at}");
        }
    }
}

#[test]
fn a_manifest_of_someone_else_is_refused() {
    let forged = samples::manifest(1, 1, 1, 0).sign(&SigningKey::from_seed(&[8; 32]));
    let error = SignedManifest::open(&forged.encode(), &samples::key().public()).unwrap_err();
    assert!(matches!(error, ManifestError::NotSigned { .. }), "{error}");
}

#[test]
fn impossible_scenes_are_refused() {
    type Spoil = fn(&mut SceneChunk);
    let spoils: [(&str, Spoil); 9] = [
        ("has parent", |s| s.joints[1].parent = Some(1)),
        ("not finite", |s| s.poses[1].root[1] = f32::NAN),
        ("out-edge", |s| s.edges.truncate(3)),
        ("out-edge", |s| s.edges[2].from = PoseId(2)),
        ("out of order", |s| s.edges.swap(0, 1)),
        ("leads from", |s| s.edges[3].to = PoseId(3)),
        ("has length", |s| s.poses[0].rotations[0] = [0; 4]),
        ("rotations for", |s| s.poses[0].rotations.truncate(1)),
        ("names vertices", |s| s.body.as_mut().unwrap().triangles[0][0] = 3),
    ];
    for (part, spoil) in spoils {
        let mut scene = samples::scene();
        spoil(&mut scene);
        let error = scene.check().unwrap_err().to_string();
        assert!(error.contains(part), "{error:?} should speak of {part:?}");
    }
}

#[test]
fn a_trajectory_takes_four_bytes_a_state() {
    let first = 5_000_192;
    let interior = |id: u64| LinkEntry::Interior {
        pose: PoseId(1000 + id as u32),
        next: vec![StateId(first + id + 1)],
    };
    let entries: Vec<_> = (0..256).map(interior).collect();
    let page = LinkPage { first_state: StateId(first), entries };
    assert!(page.encode().len() < 4 * 256 + 20);
    assert_eq!(LinkPage::decode(&page.encode()).unwrap(), page);
}

proptest! {
    #[test]
    fn random_bytes_never_panic(
        bytes in proptest::collection::vec(any::<u8>(), 0..300),
        kind in 0usize..10,
    ) {
        let (_, good, accepts) = &stored()[kind];
        accepts(&bytes);
        accepts(&[&good[..6], &bytes[..]].concat());
    }

    #[test]
    fn several_damaged_bytes_never_panic(
        kind in 0usize..10,
        damage in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..8),
    ) {
        let (_, mut bytes, accepts) = stored().swap_remove(kind);
        for (place, byte) in damage {
            let index = place.index(bytes.len());
            bytes[index] = byte;
        }
        accepts(&bytes);
    }
}

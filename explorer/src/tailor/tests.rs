//! Pieces for the built-in character, whose joints bear other names, and for the real one.

use std::sync::Arc;

use super::*;
use crate::import::data_dir;

/// The body of the data folder; `None` with a word why, where it is not there.
fn real_form() -> Option<Form> {
    let data = data_dir().filter(|d| d.join("character.glb").is_file());
    if data.is_none() {
        assert!(std::env::var_os("TOILE_REQUIRE_DATA").is_none(), "the data folder is missing");
        eprintln!("skipped: needs the data folder (TOILE_DATA)");
    }
    let bytes = std::fs::read(data?.join("character.glb")).unwrap();
    let character = crate::import::character::read_character(&bytes, None, 30.0).unwrap();
    Some(Form::new(&Arc::new(character.body)))
}

#[test]
fn what_cannot_be_made_is_refused() {
    let scene = crate::builtin::robe(Some(1600)).unwrap();
    let form = Form::new(&scene.body);
    let fineness = Fineness::Edge(0.03);
    let error = make("cape", &form, &[], fineness).unwrap_err();
    assert!(error.to_string().contains("coat, robe, trousers"), "{error}");
    let error = make("coat", &form, &[], fineness).unwrap_err();
    assert!(matches!(error, TailorError::Joint(_)), "{error}");
}

#[test]
fn every_piece_is_a_manifold_off_the_body_and_as_fine_as_asked() {
    let Some(form) = real_form() else { return };
    for name in PIECES {
        let piece = make(name, &form, &[], Fineness::Vertices(2000)).unwrap();
        assert_eq!(piece.positions.len(), 2000, "{name}");
        let mesh = cloth::Mesh::new(piece.positions.clone(), piece.triangles.clone()).unwrap();
        for p in &piece.positions {
            let distance = form.exact(*p).0;
            assert!(distance >= sew::GAP_M - 1.1e-4, "{name}: {distance} at {p}");
        }
        // Sliver-free, or the solver pays: no edge is a fifth of the mean.
        let lengths = mesh.rest_lengths();
        let mean = lengths.iter().sum::<f32>() / lengths.len() as f32;
        let least = lengths.iter().copied().fold(f32::MAX, f32::min);
        assert!(least > 0.2 * mean, "{name}: {least} of {mean}");
    }
}

#[test]
fn layers_lie_outside_what_is_below() {
    let Some(form) = real_form() else { return };
    let fineness = Fineness::Edge(0.028);
    let mut worn = Vec::new();
    for name in ["trousers", "shirt", "vest"] {
        let piece = make(name, &form, &worn, fineness).unwrap();
        for below in &worn {
            let below = form::Worn::new(below);
            for p in &piece.positions {
                let Some(inner) = below.nearest(*p, 0.02) else { continue };
                let (outer, inner) = (form.exact(*p).0, form.exact(inner).0);
                assert!(outer > inner + 0.5 * sew::GAP_M, "{name}: {outer} over {inner} at {p}");
            }
        }
        worn.push(piece);
    }
}

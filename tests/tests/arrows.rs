//! Who may depend on whom (ARCHITECTURE.md, "Arrows").

use std::collections::BTreeSet;

use toile_tests::root;

/// Crate folder, and the crates of ours that it may name as dependencies.
const ARROWS: &[(&str, &[&str])] = &[
    ("protocol", &[]),
    ("codec", &[]),
    ("cloth", &[]),
    ("picture", &[]),
    ("server", &["protocol"]),
    ("explorer", &["protocol", "codec", "cloth", "picture"]),
    ("client-lib", &["protocol", "codec", "cloth"]),
    ("loadtest", &["protocol", "client-lib", "picture"]),
    ("tests", &[]),
    (".", &["explorer", "server", "client-lib", "loadtest", "picture"]),
];

/// Libraries that a crate must not link, with the reason.
const BANNED: &[(&str, &[&str])] = &[
    ("protocol", &["tokio", "quinn", "object_store", "faer", "glam"]),
    ("codec", &["tokio", "quinn", "object_store", "faer", "glam"]),
    ("cloth", &["tokio", "quinn", "object_store", "faer", "serde"]),
    ("picture", &["tokio", "quinn", "object_store", "faer"]),
    ("server", &["faer", "glam"]),
    ("client-lib", &["faer", "object_store", "axum"]),
];

fn dependencies(folder: &str) -> BTreeSet<String> {
    let file = root().join(folder).join("Cargo.toml");
    let text = std::fs::read_to_string(&file).expect("every crate has a Cargo.toml");
    let manifest: toml::Table = text.parse().expect("Cargo.toml parses");
    let table = manifest.get("dependencies").and_then(|d| d.as_table());
    table.map(|t| t.keys().cloned().collect()).unwrap_or_default()
}

#[test]
fn arrows_point_the_right_way() {
    let ours: BTreeSet<&str> = ARROWS.iter().map(|(folder, _)| *folder).collect();
    for (folder, allowed) in ARROWS {
        for dependency in dependencies(folder) {
            let known = ours.contains(dependency.as_str());
            assert!(
                !known || allowed.contains(&dependency.as_str()),
                "{folder} must not depend on {dependency}"
            );
        }
    }
}

#[test]
fn every_crate_of_the_workspace_has_its_arrows_listed() {
    let text = std::fs::read_to_string(root().join("Cargo.toml")).unwrap();
    let manifest: toml::Table = text.parse().unwrap();
    for member in manifest["workspace"]["members"].as_array().unwrap() {
        let member = member.as_str().unwrap();
        assert!(ARROWS.iter().any(|(folder, _)| *folder == member), "{member} is not in ARROWS");
    }
}

#[test]
fn cores_link_no_sockets_no_stores_no_linear_algebra() {
    for (folder, banned) in BANNED {
        let dependencies = dependencies(folder);
        for library in *banned {
            assert!(!dependencies.contains(*library), "{folder} must not link {library}");
        }
    }
}

//! Rules that a machine can check: sizes of files and functions, words that mark unfinished work.

use toile_tests::{files, root};

const FILE_LINES_MAX: usize = 600;
const FUNCTION_LINES_MAX: usize = 70;

#[test]
fn files_stay_short() {
    let long: Vec<_> = files(&root(), "rs")
        .into_iter()
        .map(|file| (std::fs::read_to_string(&file).unwrap().lines().count(), file))
        .filter(|(lines, _)| *lines > FILE_LINES_MAX)
        .collect();
    assert!(long.is_empty(), "files over {FILE_LINES_MAX} lines: {long:?}");
}

#[test]
fn functions_stay_short() {
    let mut long = Vec::new();
    for file in files(&root(), "rs") {
        let text = std::fs::read_to_string(&file).unwrap();
        for (name, lines) in functions(&text) {
            if lines > FUNCTION_LINES_MAX {
                long.push(format!("{}: {name} has {lines} lines", file.display()));
            }
        }
    }
    assert!(long.is_empty(), "functions over {FUNCTION_LINES_MAX} lines:\n{}", long.join("\n"));
}

#[test]
fn nothing_is_left_unfinished() {
    let marks: Vec<String> =
        ["TODO", "FIXME", "XXX"].iter().map(|word| format!("{word}:")).collect();
    for file in files(&root(), "rs") {
        let text = std::fs::read_to_string(&file).unwrap();
        for mark in &marks {
            assert!(!text.contains(mark.as_str()), "{} says {mark}", file.display());
        }
    }
}

/// Name and length of each function, by the indentation that rustfmt guarantees: a function ends
/// at the closing brace in the column where its line begins.
fn functions(text: &str) -> Vec<(String, usize)> {
    let lines: Vec<&str> = text.lines().collect();
    let mut found = Vec::new();
    for (start, line) in lines.iter().enumerate() {
        let code = line.trim_start();
        let indent = line.len() - code.len();
        let Some(name) = function_name(code) else { continue };
        let end = lines[start..].iter().position(|l| {
            l.len() > indent && l[..indent].trim().is_empty() && l[indent..].starts_with('}')
        });
        if let Some(end) = end {
            found.push((name, end + 1));
        }
    }
    found
}

fn function_name(code: &str) -> Option<String> {
    let words = ["pub(crate) ", "pub(super) ", "pub ", "const ", "async ", "unsafe "];
    let mut rest = code;
    while let Some(shorter) = words.iter().find_map(|w| rest.strip_prefix(w)) {
        rest = shorter;
    }
    let rest = rest.strip_prefix("fn ")?;
    if code.ends_with(';') {
        return None;
    }
    Some(rest.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect())
}

#[test]
fn the_function_counter_counts() {
    let text = "fn a() {\n    if true {\n    }\n}\nimpl X {\n    pub fn b(\n        x: u8,\n    ) {\n    }\n}\n";
    assert_eq!(functions(text), vec![("a".to_string(), 4), ("b".to_string(), 4)]);
}

//! Holds the direction of the modules: who may know what.

#![allow(clippy::unwrap_used)] // helpers of tests

use std::fs;
use std::path::{Path, PathBuf};

/// (where, what must not stand there, the exceptions).
const RULES: &[(&str, &[&str], &[&str])] = &[
    (
        "src/recon",
        &[
            "axum",
            "sqlx",
            "tokio",
            "crate::http",
            "crate::store",
            "crate::pipeline",
            "crate::intake",
            "crate::worker",
            "crate::job",
            "crate::formats",
            "crate::cli",
        ],
        &[],
    ),
    ("src/recon", &["std::path", "std::fs"], &["src/recon/prior/onnx.rs"]),
    (
        "src/optics",
        &[
            "axum",
            "sqlx",
            "tokio",
            "serde",
            "std::path",
            "std::fs",
            "crate::http",
            "crate::store",
            "crate::pipeline",
            "crate::intake",
            "crate::worker",
            "crate::job",
            "crate::cli",
        ],
        &[],
    ),
    (
        "src/formats",
        &["axum", "sqlx", "tokio", "crate::http", "crate::store", "crate::intake", "crate::cli"],
        &[],
    ),
    (
        "src/job",
        &[
            "axum",
            "sqlx",
            "tokio",
            "std::fs",
            "crate::http",
            "crate::store",
            "crate::intake",
            "crate::cli",
        ],
        &[],
    ),
    (
        "src/pipeline",
        &["axum", "sqlx", "tokio", "crate::http", "crate::store", "crate::worker", "crate::cli"],
        &[],
    ),
    ("src/http", &["sqlx", "ort", "crate::worker", "crate::cli"], &[]),
    (
        "src/store",
        &["axum", "crate::http", "crate::pipeline", "crate::intake", "crate::worker", "crate::cli"],
        &[],
    ),
    (
        "src/intake",
        &[
            "axum",
            "sqlx",
            "tokio",
            "crate::http",
            "crate::store",
            "crate::recon",
            "crate::pipeline",
            "crate::worker",
            "crate::cli",
        ],
        &[],
    ),
    ("src/worker", &["axum", "sqlx", "crate::http", "crate::cli"], &[]),
    ("src", &["ort"], &["src/recon/prior/onnx.rs"]),
];

fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    for entry in entries {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
}

/// Lines that name a path of `root`: `use root::...`, or `root::` inside an expression.
fn names(line: &str, root: &str) -> bool {
    let code = line.split("//").next().unwrap_or_default();
    code.match_indices(root).any(|(at, _)| {
        let before = code[..at].chars().next_back();
        let after = &code[at + root.len()..];
        let starts = !before.is_some_and(|c| c.is_alphanumeric() || c == '_' || c == ':');
        starts && (after.starts_with("::") || after.starts_with(';') && code.contains("use "))
    })
}

#[test]
fn modules_know_only_what_they_may() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut broken = Vec::new();
    for (folder, forbidden, exceptions) in RULES {
        let mut files = Vec::new();
        sources(&root.join(folder), &mut files);
        for file in files {
            let name = file.strip_prefix(root).unwrap().to_string_lossy().into_owned();
            if exceptions.contains(&name.as_str()) {
                continue;
            }
            let text = fs::read_to_string(&file).unwrap();
            // Unit tests stand at the end of a file and may use what they like.
            let code = text.split("#[cfg(test)]\nmod tests").next().unwrap_or_default();
            for (number, line) in code.lines().enumerate() {
                for word in forbidden.iter().filter(|word| names(line, word)) {
                    broken.push(format!("{name}:{}: {folder} must not know {word}", number + 1));
                }
            }
        }
    }
    assert!(broken.is_empty(), "{}", broken.join("\n"));
}

#[test]
fn the_check_sees_what_it_should() {
    assert!(names("use sqlx::Row;", "sqlx"));
    assert!(names("    let x = tokio::spawn(y);", "tokio"));
    assert!(names("use crate::store::Store;", "crate::store"));
    assert!(!names("use my_sqlx::Row;", "sqlx"));
    assert!(!names("// use sqlx::Row;", "sqlx"));
    assert!(!names("import::ort_like::x()", "ort"));
}

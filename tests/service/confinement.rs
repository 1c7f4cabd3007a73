//! Native code that comes with a network of a user tries to leave its process.

use std::path::PathBuf;
use std::process::Command;

/// Compiles the library whose constructor makes the attempts.
fn escaping_library(folder: &std::path::Path) -> PathBuf {
    let library = folder.join("libonnxruntime.so");
    let status = Command::new("cc")
        .args(["-shared", "-fPIC", "-o"])
        .arg(&library)
        .args(["tests/service/shim/escape.c", "-lpthread"])
        .status()
        .expect("a C compiler, which Rust's linker needs as well");
    assert!(status.success());
    library
}

#[test]
fn a_network_can_neither_reach_other_processes_nor_outlive_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let library = escaping_library(folder.path());
    let model = folder.path().join("network.onnx");
    std::fs::write(&model, "no network").unwrap();
    let attempts = |more: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_sci-recon"))
            .arg("check-model")
            .arg(&model)
            .args(["--frames", "4", "--height", "48", "--width", "64", "--onnxruntime"])
            .arg(&library)
            .args(more)
            .env("ESCAPE_TARGET", std::process::id().to_string())
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        let lines: Vec<(String, bool)> = text
            .lines()
            .filter_map(|line| line.split_once(' '))
            .map(|(name, result)| (name.to_owned(), result == "done"))
            .collect();
        assert!(lines.len() >= 20, "{text}\n{}", String::from_utf8_lossy(&output.stderr));
        lines
    };
    for (name, done) in attempts(&["--memory-bytes", "536870912"]) {
        assert_eq!(done, name.starts_with("need_"), "{name}");
    }
    // Without the confinement the same attempts succeed, so that the test can fail.
    let free = attempts(&["--unconfined"]);
    let names = ["tgkill", "fork", "mmap_shared", "memfd_create", "setpriority"];
    let memory = ["memory_over_limit", "memory_by_mprotect", "memory_by_brk"];
    for name in names.into_iter().chain(memory) {
        assert!(free.contains(&(name.to_owned(), true)), "{name}: {free:?}");
    }
}

//! The experiments, run as a researcher runs them.

#![allow(clippy::unwrap_used)] // tests may panic

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

fn experiment(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_sci-recon-experiments")).args(arguments).output().unwrap()
}

/// Runs `sci-recon`, which `cargo test --workspace` builds into the same folder.
fn sci_recon(arguments: &[&str]) -> Output {
    let program =
        Path::new(env!("CARGO_BIN_EXE_sci-recon-experiments")).with_file_name("sci-recon");
    let output = Command::new(&program).args(arguments).output();
    let output = output.unwrap_or_else(|error| panic!("{}: {error}", program.display()));
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    output
}

/// The message of a command that rejects its input.
fn refusal(output: &Output) -> String {
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{message}");
    message
}

/// Writes six frames of 48x48 in which a bright square moves.
fn write_square_clip(path: &Path) {
    let frames = ndarray::Array3::from_shape_fn((6, 48, 48), |(k, row, column)| {
        let inside = (10 + 2 * k..26 + 2 * k).contains(&column) && (16..32).contains(&row);
        if inside { 0.9_f32 } else { 0.2 + 0.004 * row as f32 }
    });
    formats::npy::write_f32(path, frames.view()).unwrap();
}

struct Files {
    folder: tempfile::TempDir,
}

impl Files {
    fn new() -> Self {
        Self { folder: tempfile::tempdir().unwrap() }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn text(&self, name: &str) -> String {
        self.path(name).to_str().unwrap().to_owned()
    }
}

fn bytes(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap()
}

#[test]
fn multiplexing_loses_without_noise_and_wins_with_noise() {
    let files = Files::new();
    let (clip, out) =
        (concat!(env!("CARGO_MANIFEST_DIR"), "/../../demo/clip"), files.text("bench"));
    let line = ["noise", "--clips", clip, "--cr", "8", "--scale", "128", "--out", &out];
    let output = experiment(&[&line[..], &["--sigmas", "0,20"]].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let record: Value =
        serde_json::from_slice(&bytes(&files.path("bench").join("noise.json"))).unwrap();
    let psnr =
        |curve: usize, level: usize| record["curves"][curve]["psnr_db"][level].as_f64().unwrap();
    assert!(psnr(0, 0) < psnr(1, 0), "single apertures win without noise: {record:#}");
    assert!(psnr(0, 1) > psnr(1, 1), "multiplexed masks win with noise: {record:#}");
    let sigma = record["crossing_sigma"].as_f64().unwrap();
    assert!((0.0..20.0).contains(&sigma));
    let shares = [0, 1].map(|curve| record["curves"][curve]["light_throughput"].as_f64().unwrap());
    assert!((shares[0] / shares[1] - 6.0).abs() < 0.3, "{shares:?}");
    let chart = String::from_utf8(bytes(&files.path("bench").join("noise.svg"))).unwrap();
    assert!(chart.starts_with("<svg") && chart.matches("<polyline").count() == 2);
}

#[test]
fn interrupted_tables_are_continued() {
    let files = Files::new();
    let (clip, out) =
        (concat!(env!("CARGO_MANIFEST_DIR"), "/../../demo/clip"), files.text("tables"));
    let base = ["tables", "--clips", clip, "--scales", "64", "--out", &out, "--cr"];
    let run = |more: &[&str]| {
        let output = experiment(&[&base[..], more].concat());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    };
    let rows = || -> Vec<Value> {
        let file: Value =
            serde_json::from_slice(&bytes(&files.path("tables/tables.json"))).unwrap();
        file["rows"].as_array().unwrap().clone()
    };
    run(&["4", "--algorithms", "gap-tv"]);
    let first = rows();
    let text = run(&["4,6", "--algorithms", "gap-tv,pnp-nonlocal", "--by-frame", "--by-zone"]);
    assert_eq!(text.as_bytes(), bytes(&files.path("tables/tables.md")));
    let all = rows();
    assert_eq!(all[0], first[0], "an existing row is not computed again, and keeps its times");
    let name = |row: &Value| format!("{} {}", row["compression_ratio"], row["algorithm"]);
    assert_eq!(
        all.iter().map(name).collect::<Vec<_>>(),
        ["4 \"gap-tv\"", "4 \"pnp-nonlocal\"", "6 \"gap-tv\"", "6 \"pnp-nonlocal\""]
    );
    let psnr = |row: usize| all[row]["psnr_db"].as_f64().unwrap();
    assert!(psnr(1) > psnr(0) && psnr(3) > psnr(2) && psnr(0) > psnr(2), "{text}");
    assert!(text.contains(&format!("{:.2}", psnr(3))), "{text}");
    let frames: Vec<f64> =
        all[2]["psnr_db_by_frame"].as_array().unwrap().iter().filter_map(Value::as_f64).collect();
    assert!((frames.iter().sum::<f64>() / 6.0 - psnr(2)).abs() < 1e-9);
    assert_eq!(all[2]["psnr_db_by_zone"].as_array().unwrap().len(), 5);
    // Another seed adds rows and keeps these.
    run(&["4", "--algorithms", "gap-tv", "--seed", "1"]);
    assert_eq!((&rows()[..4], rows().len()), (&all[..], 5));
}

#[test]
fn a_row_of_the_tables_equals_the_result_of_reconstruct() {
    let files = Files::new();
    std::fs::create_dir(files.path("clips")).unwrap();
    write_square_clip(&files.path("clips/square.npy"));
    write_square_clip(&files.path("clip.npy"));
    let shared = ["--noise-sigma", "5", "--seed", "3"];
    let (frames, out) = (files.text("clip.npy"), files.text("s"));
    let line = ["simulate", "--frames", &frames, "--pattern", "iid", "--out", &out];
    sci_recon(&[&line[..], &["--compression-ratio", "6"], &shared].concat());
    let [masks, measurement, truth] =
        ["masks", "measurement", "truth"].map(|name| files.text(&format!("s/{name}.npy")));
    let line = ["reconstruct", "--masks", &masks, "--measurement", &measurement];
    let more = ["--truth", &truth, "--algorithm", "gap-tv", "--json"];
    let report: Value = serde_json::from_slice(&sci_recon(&[line, more].concat()).stdout).unwrap();
    let (clips, out) = (files.text("clips"), files.text("out"));
    let line = ["tables", "--clips", &clips, "--scales", "48", "--cr", "6", "--out", &out];
    let more = ["--algorithms", "gap-tv", "--pattern", "iid"];
    let output = experiment(&[&line[..], &more, &shared].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let file: Value = serde_json::from_slice(&bytes(&files.path("out/tables.json"))).unwrap();
    let row = &file["rows"][0];
    assert_eq!((&row["psnr_db"], &row["ssim"]), (&report["psnr_unit_db"], &report["ssim"]));
    assert_eq!(row["clip"], "square");

    let refuse = |more: &[&str]| refusal(&experiment(&[&line[..], more].concat()));
    let message = refuse(&["--cr", "7", "--algorithms", "gap-tv"]);
    assert!(message.contains("square.npy") && message.contains("7 are needed"), "{message}");
    let message = refuse(&["--scales", "48,64"]);
    assert!(message.contains("48x48 are smaller than 64x64"), "{message}");
    let message = refuse(&["--algorithms", "gap-tv,magic"]);
    assert!(message.contains("magic") && message.contains("pnp-ffdnet"), "{message}");
    std::fs::write(files.path("out/tables.json"), "{}").unwrap();
    assert!(refuse(&[]).contains("tables.json is not what this version writes"));
}

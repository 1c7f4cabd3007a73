//! The white level of a job: peak of the expected PSNR, and white in pictures, whatever the scale of the files.

use std::process::Command;

use rand::{RngExt, SeedableRng};
use serde_json::{Value, json};

use crate::app::TestApp;
use crate::pictures::decode;
use crate::pipeline::values;
use crate::samples::{Scene, npy};

/// A bead that covers 0.6 % of the picture on a dim background.
const SCENE: Scene = Scene { frames: 8, height: 64, width: 96, snapshots: 2 };

fn pixel(snapshot: usize, frame: usize, row: usize, column: usize) -> f32 {
    let centre = 20 + 2 * (8 * snapshot + frame);
    let is_bead = row.abs_diff(30).pow(2) + column.abs_diff(centre).pow(2) < 12;
    let dim = 0.1 + 0.1 * ((row as f32 * 0.3).sin() * (column as f32 * 0.2).cos());
    if is_bead { 0.9 - 0.3 * snapshot as f32 } else { dim }
}

/// The masks multiplied by `a`, and the snapshots by `b`.
fn files(a: f32, b: f32) -> (Vec<u8>, Vec<u8>) {
    let Scene { frames, height, width, snapshots } = SCENE;
    let masks = values(&SCENE.masks());
    let y = |s: usize, at: usize| -> f32 {
        let (row, column) = (at / width, at % width);
        (0..frames).map(|k| masks[k * height * width + at] * pixel(s, k, row, column)).sum()
    };
    let snapshot = |s: usize| (0..height * width).map(move |at| b * y(s, at));
    let y = npy(&[snapshots, height, width], (0..snapshots).flat_map(snapshot));
    (npy(&[frames, height, width], masks.iter().map(|c| c * a)), y)
}

/// Reconstructs the files at these full scales.
fn reconstruct((a, b): (f32, f32), (full_a, full_b): (f32, f32)) -> (Value, Vec<f32>) {
    let folder = tempfile::tempdir().unwrap();
    let (masks, y) = files(a, b);
    std::fs::write(folder.path().join("masks.npy"), masks).unwrap();
    std::fs::write(folder.path().join("y.npy"), y).unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_sci-recon"))
        .args(["reconstruct", "--masks", "masks.npy", "--measurement", "y.npy", "--json"])
        .args(["--algorithm", "gap-tv", "--iterations", "30", "--out", "out"])
        .args(["--masks-full-scale", &full_a.to_string()])
        .args(["--measurement-full-scale", &full_b.to_string()])
        .current_dir(folder.path())
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert!([Some(0), Some(3)].contains(&output.status.code()), "{text}");
    let frames = std::fs::read(folder.path().join("out/frames.npy")).unwrap();
    (serde_json::from_slice(&output.stdout).unwrap(), values(&frames))
}

/// Random factors from 1e-4 to 1e6, evenly spread over the magnitudes.
fn factors(seed: u64) -> impl Iterator<Item = f32> {
    let mut random = rand::rngs::ChaCha8Rng::seed_from_u64(seed);
    std::iter::repeat_with(move || 10f32.powf(random.random_range(-4.0..6.0)))
}

#[test]
fn the_expected_psnr_does_not_depend_on_the_scale_of_the_files() {
    let (plain, frames) = reconstruct((1.0, 1.0), (1.0, 1.0));
    let expected = |report: &Value| report["assessment"]["psnr_db"].as_f64().unwrap();
    for (a, b) in factors(1).zip(factors(2)).take(8) {
        let (scaled, same) = reconstruct((a, b), (a, b));
        let far =
            frames.iter().zip(&same).map(|(one, other)| (one - other).abs()).fold(0.0, f32::max);
        assert!(far < 1e-5, "masks times {a}, measurement times {b}: {far}");
        assert!((expected(&scaled) - expected(&plain)).abs() < 0.1, "{a} {b}: {scaled}");
    }
    for b in factors(3).take(8) {
        let (scaled, brighter) = reconstruct((1.0, b), (1.0, 1.0));
        let white = |report: &Value| report["white_level"].as_f64().unwrap();
        assert!((white(&scaled) / white(&plain) / f64::from(b) - 1.0).abs() < 2e-3, "{scaled}");
        let peak = white(&plain) as f32;
        let far = frames.iter().zip(&brighter).map(|(one, other)| (one - other / b).abs());
        assert!(far.fold(0.0, f32::max) < 1e-3 * peak, "measurement times {b}");
        assert!((expected(&scaled) - expected(&plain)).abs() < 0.1, "{b}: {scaled}");
    }
}

#[tokio::test]
async fn pictures_movies_and_quality_share_the_white_level_of_the_job() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (masks, y) = files(1.0, 1.0);
    let masks = app.upload(masks).await;
    let calibration = app.post("/v1/calibrations", &json!({"masks": masks})).await.expect(201);
    let data = app.upload(y).await;
    let measurement = json!({"calibration": crate::app::id(&calibration), "data": data});
    let measurement = crate::app::id(&app.post("/v1/measurements", &measurement).await.expect(201));
    let job = app.submit(&json!({"measurement": measurement, "algorithm": "gap-tv"})).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded");

    // The white level is the 99.9th percentile of the frames of both snapshots.
    let file =
        |snapshot: usize, name: &str| format!("/v1/jobs/{job}/snapshots/{snapshot}/exports/{name}");
    let view = |snapshot: usize, name: &str| {
        format!("/view/jobs/{job}/snapshots/{snapshot}/pictures/{name}")
    };
    let mut all = Vec::new();
    for snapshot in 0..2 {
        all.extend(values(&app.get(&file(snapshot, "npy")).await.expect(200).bytes));
    }
    let first = all[..all.len() / 2].to_vec();
    all.sort_by(f32::total_cmp);
    let expected = all[all.len() - all.len() / 1000 - 1];
    let mut whites = Vec::new();
    for snapshot in 0..2 {
        let manifest = app.get(&file(snapshot, "manifest")).await.expect(200).json();
        let scale = &manifest["content"]["scale"];
        let white = scale["white_level"].as_f64().unwrap() as f32;
        assert!((white / expected - 1.0).abs() < 0.01, "{white}, not {expected}");
        assert!(scale["normalisation"].as_f64().unwrap() < 0.5, "{scale}");
        whites.push(white);
    }
    assert_eq!(whites[0], whites[1]);

    // Pictures and PNG show it as white; a request may state other values.
    let spread = app.get(&view(1, "frame-1/spread")).await.expect(200).json();
    assert_eq!(
        (&spread["low"], spread["high"].as_f64().map(|high| high as f32)),
        (&json!(0.0), Some(whites[0]))
    );
    let bright = (0..first.len() / 8).find(|at| first[*at] > 0.5).unwrap();
    for (query, white) in [("", whites[0]), ("?white=2", 2.0), ("?black=0&white=1", 1.0)] {
        let picture = app.get(&view(0, &format!("frame-1{query}"))).await.expect(200);
        let (_, _, shown) = decode(&picture);
        let level = (255.0 * first[bright] / white).round().min(255.0);
        assert!(
            (f32::from(shown[bright]) - level).abs() <= 1.0,
            "{query}: {} {level}",
            shown[bright]
        );
    }
    let movie = async |window: Value| {
        let mut request = json!({"format": "mp4", "snapshot": 0});
        request.as_object_mut().unwrap().extend(window.as_object().unwrap().clone());
        let created = app.post(&format!("/v1/jobs/{job}/exports"), &request).await;
        assert!([200, 202].contains(&created.status.as_u16()), "{created:?}");
        app.get_until(&file(0, "mp4"), 200).await.bytes
    };
    let plain = movie(json!({})).await;
    let dark = movie(json!({"white": 20.0})).await;
    assert_ne!(plain, dark);
    assert_eq!(movie(json!({})).await, plain);
    let wrong = json!({"format": "mp4", "snapshot": 0, "white": -1.0});
    let refused = app.post(&format!("/v1/jobs/{job}/exports"), &wrong).await;
    assert!(refused.problem(422, "invalid_request").contains("black must be below white"));

    // A measured PSNR has the same peak as the expected one.
    let truth = (0..8).flat_map(|k| (0..64 * 96).map(move |at| pixel(0, k, at / 96, at % 96)));
    let truth: Vec<f32> = truth.collect();
    let sha256 = app.upload(npy(&[8, 64, 96], truth.iter().copied())).await;
    let quality = app
        .get(&format!("/v1/jobs/{job}/snapshots/0/quality?truth={sha256}"))
        .await
        .expect(200)
        .json();
    assert_eq!(quality["peak"].as_f64().map(|peak| peak as f32), Some(whites[0]));
    let mse = |k: usize| {
        let frame = k * 64 * 96..(k + 1) * 64 * 96;
        let squares = first[frame.clone()].iter().zip(&truth[frame]).map(|(a, b)| (a - b).powi(2));
        f64::from(squares.sum::<f32>()) / (64.0 * 96.0)
    };
    let peak = f64::from(whites[0]);
    let psnr = (0..8).map(|k| 10.0 * (peak.powi(2) / mse(k)).log10()).sum::<f64>() / 8.0;
    assert!((quality["psnr"].as_f64().unwrap() - psnr).abs() < 0.01, "{quality}: {psnr}");
}

/// Masks of another place explain nothing: there is no figure, and the result is not called good.
#[test]
fn masks_that_are_flipped_get_no_figure() {
    let folder = tempfile::tempdir().unwrap();
    let (masks, y) = files(1.0, 1.0);
    let mut flipped = values(&masks);
    flipped.chunks_mut(96).for_each(<[f32]>::reverse);
    let path = |name: &str| folder.path().join(name);
    std::fs::write(path("masks.npy"), npy(&[8, 64, 96], flipped.into_iter())).unwrap();
    std::fs::write(path("y.npy"), y).unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_sci-recon"))
        .args(["reconstruct", "--masks", "masks.npy", "--measurement", "y.npy"])
        .args(["--algorithm", "gap-tv", "--iterations", "30", "--json"])
        .current_dir(folder.path())
        .output()
        .unwrap();
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["assessment"]["psnr_db"], Value::Null, "{report:#}");
    assert_eq!(report["assessment"]["grade"], "bad");
    let findings = report["findings"].as_array().unwrap();
    assert!(findings.iter().any(|one| one["code"] == "unexplained_pixels"), "{findings:?}");
}

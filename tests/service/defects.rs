//! Saturated and bad pixels, and values that were not measured.

use std::process::Command;

use serde_json::{Value, json};

use crate::app::{TestApp, id};
use crate::pipeline::values;
use crate::samples::{Scene, npy, npy_header};

const SCENE: Scene = Scene { frames: 8, height: 64, width: 96, snapshots: 1 };
const PIXELS: usize = 64 * 96;

/// A bright disc that moves over waves.
fn pixel(frame: usize, at: usize) -> f32 {
    let (row, column) = ((at / 96) as f32, (at % 96) as f32);
    let disc = (row - 30.0).hypot(column - 30.0 - 3.0 * frame as f32) < 12.0;
    if disc { 0.9 } else { 0.3 + 0.15 * (row * 0.2).sin() * (column * 0.15).cos() }
}

fn masks() -> Vec<f32> {
    values(&SCENE.masks())
}

fn snapshot() -> Vec<f32> {
    let masks = masks();
    (0..PIXELS).map(|at| (0..8).map(|k| masks[k * PIXELS + at] * pixel(k, at)).sum()).collect()
}

/// The result of a command on these files: the report, and the PSNR for a data range of 1.
fn reconstruct(masks: &[f32], y: Vec<u8>, more: &[&str]) -> (Value, f64) {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    std::fs::write(path("masks.npy"), npy(&[8, 64, 96], masks.iter().copied())).unwrap();
    std::fs::write(path("y.npy"), y).unwrap();
    let truth = (0..8).flat_map(|k| (0..PIXELS).map(move |at| pixel(k, at)));
    std::fs::write(path("truth.npy"), npy(&[8, 64, 96], truth)).unwrap();
    let bad = (0..PIXELS).map(|at| f32::from(u8::from(at % 97 == 5)));
    std::fs::write(path("bad.npy"), npy(&[64, 96], bad)).unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_sci-recon"))
        .args(["reconstruct", "--masks", "masks.npy", "--measurement", "y.npy", "--json"])
        .args(["--truth", "truth.npy", "--truth-full-scale", "1"])
        .args(more)
        .current_dir(folder.path())
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert!([Some(0), Some(3)].contains(&output.status.code()), "{text}");
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    let psnr = report["psnr_unit_db"].as_f64().unwrap();
    (report, psnr)
}

fn float(values: impl Iterator<Item = f32>) -> Vec<u8> {
    npy(&[64, 96], values)
}

fn codes(findings: &Value) -> Vec<&str> {
    findings.as_array().unwrap().iter().map(|one| one["code"].as_str().unwrap()).collect()
}

const TV: [&str; 4] = ["--algorithm", "gap-tv", "--iterations", "60"];

#[test]
fn saturated_pixels_are_found_at_any_depth_and_left_out() {
    let (masks, y) = (masks(), snapshot());
    let (plain, whole) = reconstruct(&masks, float(y.iter().copied()), &TV);
    assert!(!codes(&plain["findings"]).contains(&"saturated"), "{plain:#}");
    let mut sorted = y.clone();
    sorted.sort_by(f32::total_cmp);
    let clip = sorted[PIXELS * 87 / 100];
    let (clipped, found) = reconstruct(&masks, float(y.iter().map(|y| y.min(clip))), &TV);
    assert_eq!(codes(&clipped["findings"])[0], "saturated", "{clipped:#}");
    let kept = [&TV[..], &["--saturation", "65535"]].concat();
    let (_, kept) = reconstruct(&masks, float(y.iter().map(|y| y.min(clip))), &kept);
    assert!(found > kept + 4.0, "{found} dB, {kept} dB with the clipped values");
    // The bright disc, where half of the pixels are lost, costs most.
    assert!(found > whole - 5.0, "{found} dB, {whole} dB without saturation");
    // 12 bits in 16, with a full scale that is not the limit of the sensor.
    let mut file = npy_header("<u2", &[64, 96]);
    let stored = y.iter().map(|y| (y / clip * 4095.0).min(4095.0).round() as u16);
    file.extend(stored.flat_map(u16::to_le_bytes));
    let scale = (4095.0 / clip).to_string();
    let more = [&TV[..], &["--measurement-full-scale", &scale]].concat();
    let (camera, found) = reconstruct(&masks, file, &more);
    let first =
        camera["findings"].as_array().unwrap().iter().find(|one| one["code"] == "saturated");
    let detail = first.unwrap()["detail"].as_str().unwrap();
    assert!(detail.contains("4095") && detail.contains("13."), "{detail}");
    assert!(found > whole - 5.0, "{found} dB, {whole} dB without saturation");
}

#[test]
fn bad_pixels_are_left_out_in_every_algorithm() {
    let (masks, y) = (masks(), snapshot());
    let bad = |at: usize| at % 307 == 11;
    let hot = || float(y.iter().enumerate().map(|(at, y)| if bad(at) { 16.0 } else { *y }));
    let nan = || float(y.iter().enumerate().map(|(at, y)| if bad(at) { f32::NAN } else { *y }));
    for algorithm in ["gap-tv", "gap-tv3d", "admm-tv", "pnp-nonlocal"] {
        let more = ["--algorithm", algorithm, "--iterations", "40"];
        let (_, whole) = reconstruct(&masks, float(y.iter().copied()), &more);
        for file in [hot(), nan()] {
            let (report, found) = reconstruct(&masks, file, &more);
            let codes = codes(&report["findings"]);
            assert!(codes.contains(&"bad_pixels"), "{algorithm}: {codes:?}");
            assert!(found > whole - 1.0, "{algorithm}: {found} dB, {whole} dB without bad pixels");
        }
    }
    // A dead column, whose pixels have dead neighbours.
    let (_, whole) = reconstruct(&masks, float(y.iter().copied()), &TV);
    let dead = y.iter().enumerate().map(|(at, y)| if at % 96 == 50 { 0.0 } else { *y });
    let (report, found) = reconstruct(&masks, float(dead), &TV);
    assert_eq!(codes(&report["findings"])[0], "bad_pixels", "{report:#}");
    assert!(found > whole - 1.0, "a dead column: {found} dB, {whole} dB");
    // A map, and NaN in one mask.
    let marked = |at: usize| at % 97 == 5;
    let noise = y.iter().enumerate().map(|(at, y)| if marked(at) { 0.7 * y } else { *y });
    let (_, whole) = reconstruct(&masks, float(y.iter().copied()), &TV);
    let more = [&TV[..], &["--bad-pixels", "bad.npy"]].concat();
    let (_, found) = reconstruct(&masks, float(noise.clone()), &more);
    assert!(found > whole - 1.0, "{found} dB, {whole} dB");
    let mut holes = masks.clone();
    (0..PIXELS).filter(|at| marked(*at)).for_each(|at| holes[3 * PIXELS + at] = f32::NAN);
    let (report, found) = reconstruct(&holes, float(noise), &TV);
    assert!(found > whole - 1.0, "{found} dB, {whole} dB");
    assert!(codes(&report["findings"]).contains(&"bad_pixels"), "{report:#}");
}

#[tokio::test]
async fn the_service_leaves_out_what_was_not_measured() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (masks, y) = (masks(), snapshot());
    let masks = app.upload(npy(&[8, 64, 96], masks.into_iter())).await;
    let map = (0..PIXELS).map(|at| f32::from(u8::from(at % 97 == 5)));
    let map = app.upload(npy(&[64, 96], map)).await;
    let wrong = app.upload(npy(&[2, 64, 96], (0..2 * PIXELS).map(|_| 0.0))).await;
    let refused = json!({"masks": masks, "bad_pixels": wrong});
    let why = app.post("/v1/calibrations", &refused).await.problem(422, "size_mismatch");
    assert!(why.contains("bad pixels"), "{why}");
    let asked = json!({"masks": masks, "bad_pixels": map});
    let calibration = id(&app.post("/v1/calibrations", &asked).await.expect(201));
    // Three snapshots: with a hot pixel, empty, and with wrong values at the pixels of the map.
    let first = y.iter().enumerate().map(|(at, y)| if at == 3000 { 16.0 } else { *y });
    let last = y.iter().enumerate().map(|(at, y)| if at % 97 == 5 { 0.7 * y } else { *y });
    let all = first.chain(y.iter().map(|_| 0.0)).chain(last);
    let data = app.upload(npy(&[3, 64, 96], all)).await;
    let asked = json!({"calibration": calibration, "data": data, "sequence": "separate"});
    let measurement = app.post("/v1/measurements", &asked).await.expect(201).json();
    let warnings = measurement["warnings"].as_array().unwrap();
    let of = |snapshot: u64| -> Vec<&str> {
        let own = warnings.iter().filter(|one| one["snapshot"] == snapshot);
        own.map(|one| one["code"].as_str().unwrap()).collect()
    };
    assert!(of(0).contains(&"bad_pixels") && of(1).contains(&"empty_snapshot"), "{warnings:#?}");
    let job = json!({"measurement": measurement["id"], "algorithm": "gap-tv",
        "tile": {"size": 48, "overlap": 16}});
    let job = app.submit(&job).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    for snapshot in 0..3 {
        let path = format!("/v1/jobs/{job}/snapshots/{snapshot}/exports/npy");
        let frames = values(&app.get(&path).await.expect(200).bytes);
        let truth = |index: usize| match snapshot {
            1 => 0.0,
            _ => pixel(index / PIXELS, index % PIXELS),
        };
        let squares = frames.iter().enumerate().map(|(at, x)| f64::from(x - truth(at)).powi(2));
        let psnr = -10.0 * (squares.sum::<f64>() / frames.len() as f64).log10();
        assert!(psnr > 24.0, "snapshot {snapshot}: {psnr} dB");
        let brightest = frames.iter().copied().fold(0.0, f32::max);
        assert!(brightest < 1.5, "snapshot {snapshot}: {brightest}");
    }
}

//! Saturated and bad pixels, and values that were not measured.

use std::process::Command;

use serde_json::{Value, json};

use crate::app::{TestApp, id};
use crate::cluster::nodes::{Nats, RemoteWorker};
use crate::faults::results_of;
use crate::learned;
use crate::pipeline::{psnr, values};
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

/// The solver would amplify the noise of a leak, which would set the white level and with it the expected PSNR.
#[test]
fn pixels_that_hardly_any_mask_lights_are_left_out() {
    let found = |is_dim: fn(usize, usize) -> bool, leak: f32| {
        let mut masks = masks();
        let dim = |at: usize| is_dim(at % PIXELS / 96, at % 96);
        masks.iter_mut().enumerate().filter(|(at, _)| dim(*at)).for_each(|(_, c)| *c *= leak);
        let y = |at: usize| -> f32 {
            let noise = (at * 7919 % 1013) as f32 / 1013.0 - 0.5;
            (0..8).map(|k| masks[k * PIXELS + at] * pixel(k, at)).sum::<f32>() + 0.2 * noise
        };
        reconstruct(&masks, float((0..PIXELS).map(y)), &TV).0
    };
    let plain = found(|_, _| false, 1.0);
    let areas: [fn(usize, usize) -> bool; 3] = [
        |row, column| row < 3 || column == 95,
        |_, column| column >= 64,
        |row, column| (row as f32 - 32.0).hypot(column as f32 - 48.0) > 36.0,
    ];
    for (which, is_dim) in areas.into_iter().enumerate() {
        // A narrow border is no area.
        let is_area = which > 0;
        for leak in [0.005, 0.02] {
            let dim = found(is_dim, leak);
            let figure = |report: &Value, name: &str| report[name].as_f64().unwrap();
            let rise = figure(&dim, "white_level") / figure(&plain, "white_level");
            assert!((0.9..1.1).contains(&rise), "area {which}, {leak}: {rise}");
            let expected = |report: &Value| report["assessment"]["psnr_db"].as_f64().unwrap();
            let gain = expected(&dim) - expected(&plain);
            assert!(gain < 1.0, "area {which}, {leak}: {gain} dB");
            let reported = codes(&dim["findings"]).contains(&"dead_pixels");
            assert_eq!(reported, is_area, "area {which}, {leak}: {dim:#}");
        }
    }
}

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

/// Frames are a guess where a part of the sensor is frozen or was not measured, and the verdict says so.
#[test]
fn the_expected_psnr_counts_parts_that_were_not_measured() {
    let (masks, y) = (masks(), snapshot());
    let lost = |height: usize, value: f32| {
        let is_lost = move |at: usize| at / 96 < height && at % 96 < 64;
        float(y.iter().enumerate().map(|(at, y)| if is_lost(at) { value } else { *y }))
    };
    let expected = |report: &Value| {
        let assessment = &report["assessment"];
        ["psnr_low_db", "psnr_db", "psnr_high_db"].map(|name| assessment[name].as_f64().unwrap())
    };
    let (plain, _) = reconstruct(&masks, float(y.iter().copied()), &TV);
    let [_, whole, _] = expected(&plain);
    for (height, value, words) in [
        (18, 1.7, "was frozen"),
        (32, f32::NAN, "33.3 % of the picture lies in areas without a measured pixel"),
        (64, f32::NAN, "pixels are marked as not measured"),
    ] {
        let (report, found) = reconstruct(&masks, lost(height, value), &TV);
        let text = report["findings"].to_string();
        assert!(text.contains(words), "{text}");
        let [low, stated, high] = expected(&report);
        assert!(stated < whole - 3.0, "{stated} dB, {whole} dB of the whole picture");
        assert!(low < found && found < high, "{low} to {high} dB, {found} dB found");
        assert!(report["verdict"] != "good", "{report:#}");
    }
    // Masks that are not known there leave the same gap.
    let mut unknown = masks.clone();
    let is_lost = |at: &usize| at % PIXELS / 96 < 32 && at % 96 < 64;
    (0..unknown.len()).filter(is_lost).for_each(|at| unknown[at] = f32::NAN);
    let (of_masks, _) = reconstruct(&unknown, float(y.iter().copied()), &TV);
    let (of_pixels, _) = reconstruct(&masks, lost(32, f32::NAN), &TV);
    let [_, of_masks, _] = expected(&of_masks);
    let [_, of_pixels, _] = expected(&of_pixels);
    assert!((of_masks - of_pixels).abs() < 1.0, "{of_masks} dB, {of_pixels} dB");
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
    let all = app.upload(npy(&[64, 96], (0..PIXELS).map(|_| 1.0))).await;
    let refused = json!({"masks": masks, "bad_pixels": all});
    let why = app.post("/v1/calibrations", &refused).await.problem(422, "invalid_content");
    assert!(why.contains("every pixel"), "{why}");
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
    let ended = app.ended(&job).await;
    assert_eq!(ended["state"], "succeeded");
    // The empty snapshot has no expected PSNR, and doesn't raise that of the job.
    let mut stated = Vec::new();
    for snapshot in 0..3 {
        let path = format!("/v1/jobs/{job}/snapshots/{snapshot}/exports/manifest");
        let manifest = app.get(&path).await.expect(200).json();
        stated.push(manifest["content"]["assessment"]["psnr_db"].clone());
    }
    let mean = (stated[0].as_f64().unwrap() + stated[2].as_f64().unwrap()) / 2.0;
    assert_eq!(stated[1], Value::Null);
    let whole_job = ended["assessment"]["psnr_db"].as_f64().unwrap();
    assert!((whole_job - mean).abs() < 0.11, "{stated:?}: {whole_job} dB");
    assert_eq!(ended["verdict"], "usable");
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

/// The square of such light is 0, so its pixels are as dark as those without light.
#[tokio::test]
async fn masks_with_traces_of_light_around_the_aperture_have_a_report() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let inside =
        |at: usize| (at % 96).abs_diff(48).pow(2) + (at % PIXELS / 96).abs_diff(32).pow(2) < 900;
    let traces = masks().into_iter().enumerate();
    let traces = traces.map(|(at, mask)| if inside(at) { mask } else { 1e-24 });
    let masks = app.upload(npy(&[8, 64, 96], traces)).await;
    let calibration = id(&app.post("/v1/calibrations", &json!({"masks": masks})).await.expect(201));
    let path = format!("/v1/calibrations/{calibration}/report");
    let shares = app.get_until(&path, 200).await.json()["findings"].to_string();
    assert!(!shares.contains("000000000"), "{shares}");
}

/// True for the pixels that [`spoiled`] takes from a snapshot.
fn is_lost(at: usize) -> bool {
    at % 307 == 11
}

/// Snapshots without some pixels, on a sensor that saturates at `clip`.
pub fn spoiled(file: &[u8], shape: &[usize], clip: f32) -> Vec<u8> {
    let values = values(file).into_iter().enumerate();
    npy(shape, values.map(|(at, y)| if is_lost(at) { f32::NAN } else { y.min(clip) }))
}

/// All frames of a job, snapshot by snapshot.
async fn frames_of(app: &TestApp, job: &str, snapshots: usize) -> Vec<Vec<f32>> {
    let mut all = Vec::new();
    for snapshot in 0..snapshots {
        let path = format!("/v1/jobs/{job}/snapshots/{snapshot}/exports/npy");
        all.push(values(&app.get(&path).await.expect(200).bytes));
    }
    all
}

async fn succeeded(app: &TestApp, body: &Value) -> String {
    let job = app.submit(body).await;
    let ended = app.ended(&job).await;
    assert_eq!(ended["state"], "succeeded", "{ended:#}");
    job
}

#[tokio::test]
async fn sequences_and_networks_leave_out_what_was_not_measured_here_and_elsewhere() {
    let Some(python) = learned::python() else { return };
    let scene = Scene { snapshots: 3, ..Scene::SMALL };
    let shape = [scene.snapshots, scene.height, scene.width];
    let app = TestApp::with(&["--workers", "2"]).await;
    let (calibration, whole) = app.scene(&scene).await;
    let file = spoiled(&scene.snapshots(), &shape, 2.5);
    let measurement = app.measure(&calibration, file).await.expect(201).json();
    let warnings = codes(&measurement["warnings"]);
    assert!(warnings.contains(&"bad_pixels") && warnings.contains(&"saturated"), "{warnings:?}");
    let folder = tempfile::tempdir().unwrap();
    let network = learned::train(&python, folder.path(), scene, "free");
    let model = id(&learned::register(&app, &calibration, &network).await.expect(201));

    let denoised = json!({"stages": [
        {"prior": "tv", "iterations": 20, "tv_weight": 0.1},
        {"prior": "ffdnet", "iterations": 3, "sigma": [0.2, 0.05]}]});
    let joint = json!({"stages": [
        {"prior": "tv", "iterations": 20, "tv_weight": 0.1, "temporal_weight": 0.004},
        {"prior": "nonlocal", "iterations": 4, "sigma": [0.2, 0.02], "memory": 0.6}]});
    let bodies = [
        json!({"algorithm": "pnp-nonlocal", "schedule": joint}),
        json!({"algorithm": "gap-tv3d"}),
        json!({"algorithm": "pnp-ffdnet", "schedule": denoised}),
        json!({"algorithm": "learned", "model": model}),
    ];
    let of = |body: &Value, measurement: &Value| {
        let mut body = body.clone();
        body["measurement"] = measurement.clone();
        body["tile"] = json!({"size": 40, "overlap": 8});
        body
    };
    let mut expected = Vec::new();
    for body in &bodies {
        let name = &body["algorithm"];
        let complete = succeeded(&app, &of(body, &json!(whole))).await;
        let job = succeeded(&app, &of(body, &measurement["id"])).await;
        let before = frames_of(&app, &complete, scene.snapshots).await;
        let after = frames_of(&app, &job, scene.snapshots).await;
        for (snapshot, (before, after)) in before.iter().zip(&after).enumerate() {
            assert!(after.iter().all(|value| value.is_finite()), "{name}");
            let (before, after) = (psnr(scene, snapshot, before), psnr(scene, snapshot, after));
            eprintln!(
                "{name}, snapshot {snapshot}: {after:.2} dB, {before:.2} dB if all is measured"
            );
            // A third of the bright square is saturated, so some of its quality is lost.
            assert!(after > before - 6.0, "{name}, snapshot {snapshot}: {after} dB, {before} dB");
        }
        expected.push(results_of(&app, &job, scene.snapshots).await);
    }
    let Some(nats) = Nats::start(1) else { return };
    let url = nats.url();
    let app = app.again(&["--workers", "0", "--nats", &url, "--ack-wait", "5"]).await;
    let _workers = [(); 2].map(|()| RemoteWorker::start(&["--nats", &url, "--pool", "test"]));
    // Those with networks are compared in `cluster::deep`, behind complete snapshots.
    for (body, expected) in bodies[..2].iter().zip(&expected) {
        let job = succeeded(&app, &of(body, &measurement["id"])).await;
        let found = results_of(&app, &job, scene.snapshots).await;
        assert_eq!(found, *expected, "{}", body["algorithm"]);
    }
}

/// A network knows no missing pixels, so it gets the mean of their neighbours.
#[tokio::test]
async fn a_network_gets_the_mean_of_the_neighbours() {
    let Some(python) = learned::python() else { return };
    let scene = Scene { snapshots: 1, ..Scene::SMALL };
    let (height, width) = (scene.height, scene.width);
    let shape = [1, height, width];
    let y = values(&scene.snapshots());
    let mean = |at: usize| {
        let around = |at: usize, length: usize| at.saturating_sub(1)..length.min(at + 2);
        let (row, column) = (at / width, at % width);
        let square = around(row, height)
            .flat_map(|row| around(column, width).map(move |column| row * width + column));
        let known: Vec<f32> = square.filter(|near| *near != at).map(|near| y[near]).collect();
        known.iter().sum::<f32>() / known.len() as f32
    };
    let with = |lost: &dyn Fn(usize) -> f32| {
        npy(&shape, (0..y.len()).map(|at| if is_lost(at) { lost(at) } else { y[at] }))
    };
    let folder = tempfile::tempdir().unwrap();
    let network = learned::train(&python, folder.path(), scene, "fixed");
    let app = TestApp::with(&["--workers", "1"]).await;
    let (calibration, _) = app.scene(&scene).await;
    let model = id(&learned::register(&app, &calibration, &network).await.expect(201));
    let mut results = Vec::new();
    for file in [with(&|_| f32::NAN), with(&mean), with(&|_| 0.0)] {
        let measurement = app.measure(&calibration, file).await.expect(201).json();
        let body =
            json!({"measurement": measurement["id"], "algorithm": "learned", "model": model});
        let job = succeeded(&app, &body).await;
        results.push((measurement, frames_of(&app, &job, 1).await.remove(0)));
    }
    let codes = codes(&results[0].0["warnings"]);
    assert!(codes.contains(&"bad_pixels"), "{codes:?}");
    let far = |other: usize| {
        let pairs = results[0].1.iter().zip(&results[other].1);
        pairs.map(|(one, other)| (one - other).abs()).fold(0.0, f32::max)
    };
    eprintln!("largest difference: {} from the means, {} from zeros", far(1), far(2));
    assert!(far(1) < 0.02, "{}", far(1));
}

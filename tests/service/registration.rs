//! Registration of masks that have moved since their calibration.

use reqwest::Method;
use serde_json::{Value, json};

use crate::app::{TestApp, id};
use crate::faults::sha256;
use crate::pipeline::{psnr, values};
use crate::samples::{Scene, npy};

const SCENE: Scene = Scene { frames: 4, height: 104, width: 112, snapshots: 1 };

/// A motion of masks: pixels down and to the right, degrees clockwise and a factor about the centre.
#[derive(Clone, Copy)]
struct Motion {
    shift: [f64; 2],
    rotation: f64,
    scale: f64,
}

const UNMOVED: Motion = Motion { shift: [0.0; 2], rotation: 0.0, scale: 1.0 };
const SHIFTED: Motion = Motion { shift: [1.5, 0.75], ..UNMOVED };

impl Motion {
    /// The place in the unmoved pattern of a place in a picture.
    fn source(self, scene: Scene, [row, column]: [f64; 2]) -> [f64; 2] {
        let (sine, cosine) = self.rotation.to_radians().sin_cos();
        let centre = [scene.height, scene.width].map(|side| (side as f64 - 1.0) / 2.0);
        let [row, column] = [row - centre[0] - self.shift[0], column - centre[1] - self.shift[1]];
        [
            centre[0] + (cosine * row - sine * column) / self.scale,
            centre[1] + (cosine * column + sine * row) / self.scale,
        ]
    }
}

/// A mask's pixel as the area of a pattern that has moved, on a grid of quarters of a pixel.
fn mask(scene: Scene, frame: usize, row: usize, column: usize, motion: Motion) -> f32 {
    let cells = (0..16).map(|cell| {
        let quarter = |cell: usize| (cell as f64 + 0.5) / 4.0 - 0.5;
        let place = [row as f64 + quarter(cell / 4), column as f64 + quarter(cell % 4)];
        let [row, column] = motion.source(scene, place).map(|at| (at + 8.5) as usize);
        scene.mask(frame, row, column)
    });
    cells.sum::<f32>() / 16.0
}

/// The calibrated masks [B,H,W].
fn masks(scene: Scene) -> Vec<u8> {
    let Scene { frames, height, width, .. } = scene;
    let places =
        (0..frames * height * width).map(|at| (at / width / height, at / width, at % width));
    let values = places.map(|(k, line, column)| mask(scene, k, line % height, column, UNMOVED));
    npy(&[frames, height, width], values)
}

/// A snapshot [H,W] behind masks that have moved.
fn snapshot(scene: Scene, motion: Motion) -> Vec<u8> {
    let Scene { frames, height, width, .. } = scene;
    let value = |at: usize| {
        let (row, column) = (at / width, at % width);
        let light = |k| mask(scene, k, row, column, motion) * scene.pixel(0, k, row, column);
        (0..frames).map(light).sum()
    };
    npy(&[height, width], (0..height * width).map(value))
}

/// Runs a job to its end, and returns it with its frames.
async fn run(app: &TestApp, measurement: &str, registration: &Value) -> (Value, Vec<u8>) {
    let body = json!({
        "measurement": measurement,
        "algorithm": "gap-tv",
        "tile": {"size": 72, "overlap": 16},
        "registration": registration,
    });
    let job = app.submit(&body).await;
    let ended = app.ended(&job).await;
    assert_eq!(ended["state"], "succeeded", "{ended:#}");
    let frames = app.get(&format!("/v1/jobs/{job}/snapshots/0/exports/npy")).await.expect(200);
    (ended, frames.bytes)
}

/// The finding of a job with this code.
fn finding<'a>(job: &'a Value, code: &str) -> Option<&'a Value> {
    job["warnings"].as_array().unwrap().iter().find(|finding| finding["code"] == code)
}

fn has_moved_masks(job: &Value) -> bool {
    finding(job, "moved_masks").is_some()
}

#[tokio::test]
async fn moved_masks_are_corrected_and_reported() {
    let app = TestApp::with(&["--workers", "2"]).await;
    let calibration = id(&app.calibrate(masks(SCENE)).await.expect(201));
    let moved = id(&app.measure(&calibration, snapshot(SCENE, SHIFTED)).await.expect(201));
    let (off, uncorrected) = run(&app, &moved, &json!("off")).await;
    assert!(off["registered"].is_null() && !has_moved_masks(&off), "{off:#}");
    let (auto, corrected) = run(&app, &moved, &json!("auto")).await;
    let registered = &auto["registered"];
    assert!(registered["applied"] == true && has_moved_masks(&auto), "{auto:#}");
    for (axis, expected) in [(0, 1.5), (1, 0.75)] {
        let shift = registered["shift"][axis].as_f64().unwrap();
        assert!((shift - expected).abs() < 0.1, "{registered:#}");
    }
    assert!(
        registered["error_after"].as_f64().unwrap() < registered["error_before"].as_f64().unwrap()
    );
    // The check of the measurement sees the drift, but the corrected job is not doubted.
    let seen = |job: &Value, list: &Value| {
        assert!(list.is_array(), "{job:#}");
        list.as_array().unwrap().iter().any(|finding| {
            ["drifted_masks", "shifted_masks", "foreign_masks"]
                .iter()
                .any(|code| finding["code"] == *code)
        })
    };
    assert!(seen(&off, &off["assessment"]["reasons"]), "{off:#}");
    assert!(!seen(&auto, &auto["assessment"]["reasons"]), "{auto:#}");
    assert!(seen(&off, &off["warnings"]) && !seen(&auto, &auto["warnings"]), "{auto:#}");
    let (_, stated) = run(&app, &moved, &json!({"shift": [1.5, 0.75]})).await;
    let quality = [&uncorrected, &corrected, &stated].map(|file| psnr(SCENE, 0, &values(file)));
    assert!(quality[1] > quality[0] + 3.0 && quality[2] > quality[0] + 3.0, "{quality:?}");
    // A stated motion is tested. One with wrong signs is an error, and one that does nothing leaves that of the check.
    let (wrong, _) = run(&app, &moved, &json!({"shift": [-1.5, -0.75]})).await;
    assert!(finding(&wrong, "misplaced_masks").is_some(), "{wrong:#}");
    let (tiny, _) = run(&app, &moved, &json!({"shift": [1e-9, 0]})).await;
    for job in [&wrong, &tiny] {
        assert!(seen(job, &job["warnings"]), "{job:#}");
        assert_eq!(job["assessment"]["grade"], "bad", "{job:#}");
    }
    let path = format!("/v1/jobs/{}/exports/manifest", auto["id"].as_str().unwrap());
    let manifest = app.get(&path).await.expect(200).json();
    assert_eq!(manifest["content"]["registration"], *registered);

    for (registration, pointer) in [
        (json!({"shift": [9, 0]}), "/registration/shift"),
        (json!({"rotation": 1}), "/registration/rotation"),
        (json!({"scale": 1.1}), "/registration/scale"),
        (json!({"angle": 0.1}), "/registration"),
        (json!("on"), "/registration"),
    ] {
        let wrong =
            json!({"measurement": moved, "algorithm": "gap-tv", "registration": registration});
        let refused = app.post("/v1/jobs", &wrong).await;
        refused.problem(422, "invalid_request");
        assert_eq!(refused.json()["errors"][0]["pointer"], pointer, "{refused:?}");
    }
}

#[tokio::test]
async fn the_command_moves_masks_with_bad_pixels_as_a_job_does() {
    let Scene { height, width, .. } = SCENE;
    let is_bad = |at: usize| {
        let (row, column) = (at / width, at % width);
        (30..50).contains(&row) && (40..60).contains(&column) || at % 211 == 7
    };
    let map = npy(&[height, width], (0..height * width).map(|at| f32::from(u8::from(is_bad(at)))));
    let files = [("m.npy", masks(SCENE)), ("y.npy", snapshot(SCENE, SHIFTED)), ("bad.npy", map)];
    let app = TestApp::with(&["--workers", "1"]).await;
    let folder = tempfile::tempdir().unwrap();
    let mut uploads = Vec::new();
    for (name, bytes) in files {
        std::fs::write(folder.path().join(name), &bytes).unwrap();
        uploads.push(app.upload(bytes).await);
    }
    let body = json!({"masks": uploads[0], "bad_pixels": uploads[2]});
    let calibration = id(&app.post("/v1/calibrations", &body).await.expect(201));
    let body = json!({"calibration": calibration, "data": uploads[1]});
    let measurement = id(&app.post("/v1/measurements", &body).await.expect(201));
    let (job, expected) = run(&app, &measurement, &json!({"shift": [1.5, 0.75]})).await;
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_sci-recon"))
        .args(["reconstruct", "--masks", "m.npy", "--measurement", "y.npy", "--out", "out"])
        .args(["--bad-pixels", "bad.npy", "--algorithm", "gap-tv", "--tile", "72"])
        .args(["--overlap", "16", "--registration", "1.5,0.75", "--threads", "1"])
        .current_dir(folder.path())
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert!([Some(0), Some(3)].contains(&output.status.code()), "{text}");
    let manifest = std::fs::read(folder.path().join("out/manifest.json")).unwrap();
    let manifest: Value = serde_json::from_slice(&manifest).unwrap();
    let path = format!("/v1/jobs/{}/snapshots/0/exports/manifest", job["id"].as_str().unwrap());
    let recorded = app.get(&path).await.expect(200).json();
    for part in ["scale", "inputs", "registration"] {
        assert_eq!(manifest["content"][part], recorded["content"][part], "{part}");
    }
    let frames = values(&std::fs::read(folder.path().join("out/frames.npy")).unwrap());
    let pairs = frames.iter().zip(values(&expected));
    let largest = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(largest < 1e-4, "the frames differ by {largest}");
}

#[tokio::test]
async fn masks_that_have_turned_and_grown_are_corrected() {
    const WIDE: Scene = Scene { frames: 4, height: 184, width: 180, snapshots: 1 };
    let motion = Motion { shift: [0.75, -0.5], rotation: 0.12, scale: 1.001 };
    let app = TestApp::with(&["--workers", "2"]).await;
    let calibration = id(&app.calibrate(masks(WIDE)).await.expect(201));
    let moved = id(&app.measure(&calibration, snapshot(WIDE, motion)).await.expect(201));
    let (auto, found) = run(&app, &moved, &json!("auto")).await;
    let registered = &auto["registered"];
    assert!(registered["applied"] == true && has_moved_masks(&auto), "{auto:#}");
    let number = |name: &str| registered[name].as_f64().unwrap();
    assert!((number("rotation") - 0.12).abs() < 0.05, "{registered:#}");
    assert!((number("scale") - 1.001).abs() < 0.0008, "{registered:#}");
    let detail = finding(&auto, "moved_masks").unwrap()["detail"].as_str().unwrap().to_owned();
    assert!(detail.contains("degrees (clockwise)"), "{detail}");
    let all = json!({"shift": motion.shift, "rotation": motion.rotation, "scale": motion.scale});
    let (job, stated) = run(&app, &moved, &all).await;
    assert_eq!(job["registration"], all, "{job:#}");
    for name in ["shift", "rotation", "scale"] {
        assert_eq!(job["registered"][name], all[name], "{job:#}");
    }
    let (_, shifted) = run(&app, &moved, &json!({"shift": motion.shift})).await;
    let quality = [&shifted, &found, &stated].map(|file| psnr(WIDE, 0, &values(file)));
    assert!(quality[1] > quality[0] + 1.0 && quality[2] > quality[0] + 1.0, "{quality:?}");
}

#[tokio::test]
async fn corrected_masks_become_a_calibration() {
    let app = TestApp::with(&["--workers", "2"]).await;
    let calibration = id(&app.calibrate(masks(SCENE)).await.expect(201));
    let moved = id(&app.measure(&calibration, snapshot(SCENE, SHIFTED)).await.expect(201));
    let (auto, corrected) = run(&app, &moved, &json!("auto")).await;
    let save = async |job: &Value| {
        let body = json!({"registration_of": job["id"], "name": "after the drift"});
        app.post("/v1/calibrations", &body).await
    };
    let saved = save(&auto).await.expect(201).json();
    let Scene { frames, height, width, .. } = SCENE;
    for (fact, expected) in [
        ("name", json!("after the drift")),
        ("frames", json!(frames)),
        ("height", json!(height)),
        ("width", json!(width)),
        ("format", json!("registration")),
    ] {
        assert_eq!(saved[fact], expected, "{saved:#}");
    }
    assert_eq!(saved["registration_of"], auto["id"]);
    let path = format!("/v1/calibrations/{}", saved["id"].as_str().unwrap());
    let report = app.get_until(&format!("{path}/report"), 200).await.json();
    assert_eq!(report["registration_of"], auto["id"]);
    // The recorded hash is that of the masks that a lab can download.
    let npy = app.get(&format!("{path}/masks")).await.expect(200).bytes;
    assert_eq!(saved["masks"], sha256(&npy));
    let whole = values(&npy);
    assert_eq!(whole.len(), frames * height * width);
    let range = app.request(Method::GET, &format!("{path}/masks")).header("Range", "bytes=100-299");
    assert_eq!(app.send(range).await.expect(206).bytes, npy[100..300]);
    // The saved masks fit the measurement, and serve it as well as the correction within the job.
    let saved = saved["id"].as_str().unwrap();
    let again = id(&app.measure(saved, snapshot(SCENE, SHIFTED)).await.expect(201));
    let (fits, frames) = run(&app, &again, &json!("auto")).await;
    assert!(fits["registered"]["applied"] == false && !has_moved_masks(&fits), "{fits:#}");
    let quality = [&corrected, &frames].map(|file| psnr(SCENE, 0, &values(file)));
    assert!(quality[1] > quality[0] - 0.3, "{quality:?}");
    let manifest = format!("/v1/jobs/{}/exports/manifest", fits["id"].as_str().unwrap());
    let inputs = &app.get(&manifest).await.expect(200).json()["content"]["inputs"];
    assert_eq!(inputs["masks_sha256"], sha256(&npy));
    let origin = &inputs["registration_of"];
    assert_eq!(origin["job"], auto["id"], "{inputs:#}");
    assert_eq!(origin["motion"]["shift"], auto["registered"]["shift"], "{inputs:#}");
    assert_eq!(origin["masks_sha256"], sha256(&masks(SCENE)), "{inputs:#}");

    let (off, _) = run(&app, &moved, &json!("off")).await;
    let cancelled = app
        .submit(&json!({"measurement": moved, "algorithm": "gap-tv", "registration": "auto"}))
        .await;
    // A job that has started ends a little later.
    app.post(&format!("/v1/jobs/{cancelled}/cancel"), &json!({})).await;
    let cancelled = app.ended(&cancelled).await;
    assert_eq!(cancelled["state"], "cancelled", "{cancelled:#}");
    let refused = [(&off, 422, "invalid_request"), (&cancelled, 409, "illegal_state")];
    for (job, status, code) in refused {
        let answer = save(job).await;
        answer.problem(status, code);
        assert_eq!(answer.json()["errors"][0]["pointer"], "/registration_of", "{answer:?}");
    }
    let body = json!({"registration_of": auto["id"], "full_scale": 255});
    app.post("/v1/calibrations", &body).await.problem(422, "invalid_request");
    // The job can't be deleted while the calibration is not made.
    let pending = "UPDATE requests SET prepared = NULL, facts = NULL WHERE id = ?";
    let mut database = app.database().await;
    sqlx::query(pending).bind(saved).execute(&mut database).await.unwrap();
    let job = format!("/v1/jobs/{}", auto["id"].as_str().unwrap());
    let detail = app.delete(&job).await.problem(409, "in_use");
    assert!(detail.contains(saved), "{detail}");
    app.sign_in(&app.token(&["create", "--lab", "another"]));
    let unknown = save(&auto).await;
    unknown.problem(422, "invalid_request");
    assert_eq!(unknown.json()["errors"][0]["pointer"], "/registration_of");
}

#[tokio::test]
async fn masks_that_fit_are_used_unchanged() {
    let app = TestApp::with(&["--workers", "2"]).await;
    let calibration = id(&app.calibrate(masks(SCENE)).await.expect(201));
    let measurement = id(&app.measure(&calibration, snapshot(SCENE, UNMOVED)).await.expect(201));
    let (_, expected) = run(&app, &measurement, &json!("off")).await;
    let (auto, frames) = run(&app, &measurement, &json!("auto")).await;
    assert!(auto["registered"]["applied"] == false && !has_moved_masks(&auto), "{auto:#}");
    assert!(frames == expected, "the frames differ");
}

/// A stated shift can put the masks where the measurement has no light.
#[tokio::test]
async fn masks_that_are_moved_off_the_light_are_reported() {
    let app = TestApp::with(&["--workers", "2"]).await;
    // Masks open in three rows at the upper border, masks of 4 rows, and masks that cover the picture.
    let cases = [([4, 64, 64], 3, true), ([4, 4, 200], 4, true), ([4, 64, 64], 64, false)];
    for (shape, open_rows, is_lost) in cases {
        let [frames, height, width] = shape;
        let mask = |k: usize, row: usize, column: usize| {
            if row < open_rows { SCENE.mask(k, row, column) } else { 0.0 }
        };
        let masks = npy(
            &shape,
            (0..frames * height * width)
                .map(|at| mask(at / width / height, at / width % height, at % width)),
        );
        let snapshot = npy(
            &shape[1..],
            (0..height * width)
                .map(|at| (0..frames).map(|k| 0.5 * mask(k, at / width, at % width)).sum()),
        );
        let calibration = id(&app.calibrate(masks).await.expect(201));
        let measurement = id(&app.measure(&calibration, snapshot).await.expect(201));
        let job = app
            .submit(&json!({
                "measurement": measurement,
                "algorithm": "gap-tv",
                "registration": {"shift": [3.999, -3.999]},
            }))
            .await;
        let ended = app.ended(&job).await;
        let misplaced = finding(&ended, "misplaced_masks");
        assert_eq!(misplaced.is_some(), is_lost, "{shape:?}: {ended:#}");
        assert!(misplaced.is_none_or(|finding| finding["severity"] == "error"), "{ended:#}");
        let moved = finding(&ended, "moved_masks").unwrap_or(&Value::Null).to_string();
        assert!(moved.contains("states") && !moved.contains("corrected"), "{moved}");
    }
}

//! From raw captures to masks over HTTP: a simulated lab with noise, and typical errors.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use reqwest::Method;
use serde_json::{Value, json};

use crate::app::{TestApp, id};
use crate::faults::sha256;
use crate::pipeline::values;
use crate::samples::npy;

const FRAMES: usize = 8;
pub const SIDE: usize = 96;

/// The files of a simulated lab.
pub struct Lab {
    folder: tempfile::TempDir,
}

impl Lab {
    /// A lab with these optics (TOML) and random squares.
    pub fn new(optics: &str) -> Self {
        Self::with("random-squares", optics)
    }

    fn with(pattern: &str, optics: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        // A disc that moves over a textured background.
        let pixel = |k: usize, i: usize, j: usize| {
            let texture = 0.4 + 0.1 * ((i as f32 / 5.0).sin() + (j as f32 / 7.0).cos());
            let away = (i as f32 - 40.0 - 2.0 * k as f32).hypot(j as f32 - 50.0);
            if away < 15.0 { 0.9 } else { texture }
        };
        let pixels = (0..FRAMES * SIDE * SIDE)
            .map(|at| pixel(at / (SIDE * SIDE), at / SIDE % SIDE, at % SIDE));
        let clip = folder.path().join("clip.npy");
        std::fs::write(&clip, npy(&[FRAMES, SIDE, SIDE], pixels)).unwrap();
        let toml = folder.path().join("optics.toml");
        std::fs::write(&toml, optics).unwrap();
        let output = Command::new(env!("CARGO_BIN_EXE_sci-recon"))
            .args([
                "simulate",
                "--compression-ratio",
                "8",
                "--captures",
                "12",
                "--pattern",
                pattern,
            ])
            .args(["--frames".as_ref(), clip.as_os_str(), "--optics".as_ref(), toml.as_os_str()])
            .args(["--out".as_ref(), folder.path().join("sim").as_os_str()])
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        Self { folder }
    }

    pub fn file(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.folder.path().join("sim").join(name)).unwrap()
    }

    pub fn json(&self, name: &str) -> Value {
        serde_json::from_slice(&self.file(name)).unwrap()
    }

    /// The patterns shown on the LCoS, as .npy.
    fn patterns(&self) -> Vec<u8> {
        let record = self.json("simulation.json");
        let (rows, columns) = (&record["apertures"]["rows"], &record["apertures"]["columns"]);
        let shape = [rows, columns].map(|side| side.as_u64().unwrap() as usize);
        let open: String = record["apertures"]["open"]
            .as_array()
            .unwrap()
            .iter()
            .map(|row| row.as_str().unwrap())
            .collect();
        let values: Vec<f32> = open.bytes().map(|digit| f32::from(digit - b'0')).collect();
        npy(&[FRAMES, shape[0], shape[1]], values.into_iter())
    }

    /// Uploads all captures; returns the `captures` of a request.
    pub async fn send(&self, app: &TestApp) -> Value {
        let index = self.json("captures/captures.json");
        let mut captures = json!({"saturation": index["saturation"]});
        for role in ["white", "black", "black_with_mask"] {
            captures[role] = json!([self.upload(app, &index[role][0]).await]);
        }
        let mut masks = Vec::new();
        for list in index["masks"].as_array().unwrap() {
            masks.push(json!([self.upload(app, &list[0]).await]));
        }
        captures["masks"] = Value::from(masks);
        captures["patterns"] = json!(app.upload(self.patterns()).await);
        captures
    }

    pub async fn upload(&self, app: &TestApp, name: &Value) -> String {
        app.upload(self.file(&format!("captures/{}", name.as_str().unwrap()))).await
    }
}

impl TestApp {
    /// Creates a calibration from captures, waits until it has ended, and returns it.
    pub async fn calibrate_captures(&self, captures: &Value) -> Value {
        // A calibration that fails within its request would leave no resource.
        let request = self.request(Method::POST, "/v1/calibrations").header("prefer", "wait=0");
        let answer = self.send(request.json(&json!({"captures": captures}))).await.expect(202);
        assert_eq!(answer.json()["state"], "preparing");
        self.calibrated(&id(&answer)).await
    }

    async fn calibrated(&self, calibration: &str) -> Value {
        let start = Instant::now();
        loop {
            let body =
                self.get(&format!("/v1/calibrations/{calibration}")).await.expect(200).json();
            if body["state"] != "preparing" {
                return body;
            }
            assert!(start.elapsed() < Duration::from_secs(120), "{body:#}");
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }

    async fn report(&self, calibration: &Value) -> Value {
        let id = calibration["id"].as_str().unwrap();
        let start = Instant::now();
        loop {
            let answer = self.get(&format!("/v1/calibrations/{id}/report")).await;
            if answer.status == 200 {
                return answer.json();
            }
            answer.problem(404, "not_ready");
            assert!(start.elapsed() < Duration::from_secs(120));
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }
}

/// The codes of findings, with the frames that each concerns.
pub fn codes_and_frames(findings: &Value) -> Vec<(String, Vec<u64>)> {
    let finding = |finding: &Value| {
        let frames = finding["frames"].as_array().unwrap();
        let frames = frames.iter().map(|frame| frame.as_u64().unwrap()).collect();
        (finding["code"].as_str().unwrap().to_owned(), frames)
    };
    findings.as_array().unwrap().iter().map(finding).collect()
}

/// The masks of a calibration, which must have the recorded hash.
async fn masks(app: &TestApp, calibration: &Value) -> Vec<f32> {
    let path = format!("/v1/calibrations/{}/masks", calibration["id"].as_str().unwrap());
    let file = app.get(&path).await.expect(200).bytes;
    assert_eq!(calibration["masks"], sha256(&file));
    values(&file)
}

#[tokio::test]
async fn captures_give_masks_within_their_statistical_error() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let lab = Lab::new("[light]\nvignetting = 0.3\n");
    let mut captures = lab.send(&app).await;
    for black_with_mask in [true, false] {
        let calibration = app.calibrate_captures(&captures).await;
        assert_eq!(calibration["state"], "ready", "{calibration:#}");
        let report = app.report(&calibration).await;
        let figures = &report["captures"];
        let scale = figures["mask_scale"].as_f64().unwrap();
        let truth = values(&lab.file("masks.npy"));
        let true_scale = lab.json("simulation.json")["mask_scale"].as_f64().unwrap();
        let computed = masks(&app, &calibration).await;
        assert_eq!(computed.len(), truth.len());
        let errors = computed.iter().zip(&truth);
        let errors: Vec<f64> = errors
            .map(|(computed, truth)| f64::from(*computed) * scale - f64::from(*truth) * true_scale)
            .collect();
        let rms = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
        let expected = figures["noise"].as_f64().unwrap() * scale;
        if black_with_mask {
            // Values below 0 are set to 0, which slightly reduces the error.
            assert!((0.85..1.15).contains(&(rms / expected)), "{rms} and {expected} expected");
            let bias = errors.iter().sum::<f64>() / errors.len() as f64;
            assert!(bias.abs() < 0.2 * expected, "{bias}");
            assert_eq!(report["grade"], "good", "{report:#}");
            let flat = figures["illumination_flatness"].as_f64().unwrap();
            assert!((0.7..0.8).contains(&flat), "{flat}");
            let share = figures["light_throughput"].as_f64().unwrap();
            let true_share = lab.json("simulation.json")["light_throughput"].as_f64().unwrap();
            assert!((share / true_share - 1.0).abs() < 0.01, "{share} and {true_share}");
        } else {
            // Without a black capture with mask, equation 7 takes the brighter one without it as
            // background.
            assert!(rms > expected && rms < 0.01, "{rms} and {expected}");
        }
        captures["black_with_mask"] = json!([]);
    }
}

#[test]
fn the_command_line_calibrates_like_the_service() {
    let lab = Lab::new("");
    let index = lab.folder.path().join("sim/captures/captures.json");
    let out = lab.folder.path().join("calibration");
    let map = lab.folder.path().join("bad.npy");
    let first_row = |at: usize| f32::from(u8::from(at < SIDE));
    std::fs::write(&map, npy(&[SIDE, SIDE], (0..SIDE * SIDE).map(first_row))).unwrap();
    let run = |index: &Path| {
        let line =
            ["calibrate".as_ref(), "--json".as_ref(), "--captures".as_ref(), index.as_os_str()];
        Command::new(env!("CARGO_BIN_EXE_sci-recon"))
            .args(line)
            .args(["--bad-pixels".as_ref(), map.as_os_str()])
            .args(["--out".as_ref(), out.as_os_str()])
            .output()
            .unwrap()
    };
    let output = run(&index);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["grade"], "good", "{report:#}");
    let masks = values(&std::fs::read(out.join("masks.npy")).unwrap());
    assert_eq!(masks.len(), FRAMES * SIDE * SIDE);
    assert_eq!(masks.iter().copied().fold(0.0, f32::max), 1.0);
    for (at, mask) in masks.iter().enumerate() {
        assert_eq!(mask.is_nan(), at % (SIDE * SIDE) < SIDE, "{at}");
    }
    for file in ["report.json", "report.html", "maps/gram.png"] {
        assert!(out.join(file).is_file(), "{file}");
    }
    let bad = lab.folder.path().join("sim/captures/bad.json");
    std::fs::write(
        &bad,
        r#"{"masks": [["mask_01.npy"], []], "white": ["white.npy"], "black": []}"#,
    )
    .unwrap();
    let refused = run(&bad);
    assert_eq!(refused.status.code(), Some(2));
    let text = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(text.contains("pattern 1") && text.contains("no captures"), "{text}");
}

#[tokio::test]
async fn the_report_has_maps_and_a_page() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let lab = Lab::new("");
    let captures = lab.send(&app).await;
    let calibration = app.calibrate_captures(&captures).await;
    let report = app.report(&calibration).await;
    let base = format!("/v1/calibrations/{}", calibration["id"].as_str().unwrap());
    let view = base.replace("/v1/", "/view/");
    assert_eq!(report["maps"], json!(["mean", "deviation", "gram", "illumination"]));
    for map in report["maps"].as_array().unwrap() {
        let answer =
            app.get(&format!("{view}/maps/{}.png", map.as_str().unwrap())).await.expect(200);
        assert_eq!(answer.header("content-type"), "image/png");
        let picture = image::load_from_memory(&answer.bytes).unwrap();
        assert_eq!((picture.width(), picture.height()), (SIDE as u32, SIDE as u32));
    }
    app.get(&format!("{view}/maps/nothing.png")).await.problem(404, "not_found");
    let page = app.get(&format!("{view}/report.html")).await.expect(200);
    assert!(page.header("content-security-policy").contains("default-src 'none'"));
    let text = String::from_utf8(page.bytes).unwrap();
    assert!(text.contains("maps/gram.png") && !text.contains("<script"), "{text}");
    // Uploaded masks have a report without the figures of captures.
    let sent = app.calibrate(lab.file("masks.npy")).await.expect(201).json();
    let report = app.report(&sent).await;
    assert_eq!(report["captures"], Value::Null);
    assert_eq!(report["maps"], json!(["mean", "deviation", "gram"]));
    let mean = report["masks"]["correlation_mean"].as_f64().unwrap();
    assert!((0.4..0.6).contains(&mean), "{mean}");
}

#[tokio::test]
async fn typical_errors_of_a_lab_are_found() {
    let app = TestApp::with(&["--workers", "2"]).await;
    let lab = Lab::new("");
    let good = lab.send(&app).await;
    let codes = async |captures: &Value| {
        let calibration = app.calibrate_captures(captures).await;
        codes_and_frames(&app.report(&calibration).await["findings"])
    };
    assert_eq!(codes(&good).await, []);
    let mut wrong = good.clone();
    wrong["black_with_mask"] = good["masks"][0].clone();
    let found_codes = codes(&wrong).await;
    assert!(found_codes.iter().any(|(code, _)| code == "wrong_dark"), "{found_codes:?}");
    let mut missing = good.clone();
    missing["masks"][3] = good["black_with_mask"].clone();
    let found_codes = codes(&missing).await;
    assert!(found_codes.contains(&("missing_pattern".into(), vec![3])), "{found_codes:?}");
    let mut twice = good.clone();
    twice["masks"][3] = good["masks"][2].clone();
    let found_codes = codes(&twice).await;
    assert!(found_codes.contains(&("repeated_pattern".into(), vec![2, 3])), "{found_codes:?}");
    let mut swapped = good.clone();
    swapped["masks"][1] = good["masks"][5].clone();
    swapped["masks"][5] = good["masks"][1].clone();
    let found_codes = codes(&swapped).await;
    assert_eq!(found_codes, [("swapped_order".into(), vec![1, 5])]);
    let bright = Lab::new("[camera]\ncalibration_exposure = 1.2\n").send(&app).await;
    let found_codes = codes(&bright).await;
    assert!(found_codes.iter().any(|(code, _)| code == "saturated_white"), "{found_codes:?}");
}

#[tokio::test]
async fn invalid_captures_are_rejected() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let lab = Lab::new("");
    let good = lab.send(&app).await;
    let post = async |change: &dyn Fn(&mut Value)| {
        let mut captures = good.clone();
        change(&mut captures);
        app.post("/v1/calibrations", &json!({"captures": captures})).await
    };
    let answer = post(&|captures| captures["masks"][2] = json!([])).await;
    let detail = answer.problem(422, "invalid_request");
    assert!(detail.contains("0 uploads"), "{detail}");
    assert_eq!(answer.json()["pointer"], "/captures/masks/2");
    let small = app.upload(npy(&[20, 30], (0..600).map(|_| 1.0))).await;
    let answer = post(&|captures| captures["masks"][1] = json!([small])).await;
    let detail = answer.problem(422, "size_mismatch");
    assert!(detail.contains("20x30") && detail.contains("96x96"), "{detail}");
    assert_eq!(answer.json()["pointer"], "/captures/masks/1/0");
    let nowhere = "0".repeat(64);
    let answer = post(&|captures| captures["white"] = json!([nowhere])).await;
    assert_eq!(answer.json()["pointer"], "/captures/white/0");
    let both = json!({"captures": good, "masks": small});
    app.post("/v1/calibrations", &both).await.problem(422, "invalid_request");
    // An error that only the calculation detects makes the calibration fail with a reason.
    let mut confused = good.clone();
    confused["white"] = good["black"].clone();
    let failed = app.calibrate_captures(&confused).await;
    assert_eq!(failed["state"], "failed");
    let error = failed["error"].as_str().unwrap();
    assert!(error.contains("nowhere brighter"), "{error}");
    let body = json!({"calibration": failed["id"], "data": small});
    let refused = app.post("/v1/measurements", &body).await;
    let detail = refused.problem(409, "calibration_not_ready");
    assert!(detail.contains("nowhere brighter"), "{detail}");
    assert_eq!(refused.json()["retryable"], false, "a failed calibration is never ready");
    // Squares of such differences are 0 in 32 bits.
    let (height, width) = (96, 96);
    let faint = |value: f32| npy(&[height, width], (0..height * width).map(move |_| value));
    let mut faintly = good.clone();
    for (name, value) in [("white", 1e-40), ("black", 0.0), ("black_with_mask", 0.0)] {
        if !faintly[name].is_null() {
            faintly[name] = json!([app.upload(faint(value)).await]);
        }
    }
    let refused = app.calibrate_captures(&faintly).await;
    let error = refused["error"].as_str().unwrap();
    assert!(error.contains("brighter than black by only"), "{error}");
    let listed = app.get("/v1/calibrations").await.expect(200).json();
    assert_eq!(listed["items"][1]["state"], "failed");
    let path = format!("/v1/calibrations/{}", failed["id"].as_str().unwrap());
    app.delete(&path).await.expect(204);
    app.get(&path).await.problem(404, "not_found");
}

#[tokio::test]
async fn a_calibration_without_a_worker_is_not_ready() {
    let mut app = TestApp::start().await;
    let captures = Lab::new("").send(&app).await;
    let answer = app.post("/v1/calibrations", &json!({"captures": captures})).await.expect(202);
    let calibration = id(&answer);
    let body = json!({"calibration": calibration, "data": captures["white"][0]});
    let refused = app.post("/v1/measurements", &body).await;
    refused.problem(409, "calibration_not_ready");
    assert_eq!(refused.json()["retryable"], true, "the calibration is still queued");
    let report = app.get(&format!("/v1/calibrations/{calibration}/report")).await;
    report.problem(409, "calibration_not_ready");
    app.restart_with(&["--workers", "1"]);
    assert_eq!(app.calibrated(&calibration).await["state"], "ready");
}

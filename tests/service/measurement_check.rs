//! Checks of a raw measurement against its calibration.

use serde_json::{Value, json};

use crate::app::TestApp;
use crate::app::id;
use crate::calibration::{Lab, SIDE, codes_and_frames};
use crate::samples::{Scene, npy, npy_header};

impl Lab {
    /// Uploads the measurement; returns the body of a request.
    async fn measurement(&self, app: &TestApp, calibration: &Value) -> Value {
        let index = &self.json("captures/captures.json")["measurement"];
        json!({
            "calibration": calibration["id"],
            "data": self.upload(app, &index["data"]).await,
            "dark": [self.upload(app, &index["dark"][0]).await],
            "full_scale": index["full_scale"],
            "saturation": index["saturation"],
        })
    }

    /// The measurement, cyclically shifted by some rows and columns.
    fn moved(&self, rows: usize, columns: usize) -> Vec<u8> {
        let mut file = self.file("captures/measurement.npy");
        let start = file.len() - 2 * SIDE * SIDE;
        let pixels = file.split_off(start);
        for at in 0..SIDE * SIDE {
            let (row, column) = ((at / SIDE + rows) % SIDE, (at % SIDE + columns) % SIDE);
            let from = 2 * (row * SIDE + column);
            file.extend(&pixels[from..from + 2]);
        }
        file
    }
}

#[tokio::test]
async fn a_measurement_is_checked_against_its_calibration() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let lab = Lab::new("[camera]\nbackground = 0.1\nmeasurement_exposure = 0.15\n");
    let captures = lab.send(&app).await;
    let calibration = app.calibrate_captures(&captures).await;
    let good = lab.measurement(&app, &calibration).await;
    let post = async |change: &dyn Fn(&mut Value)| {
        let mut body = good.clone();
        change(&mut body);
        app.post("/v1/measurements", &body).await.expect(201).json()
    };
    let codes = |measurement: &Value| {
        codes_and_frames(&measurement["warnings"])
            .into_iter()
            .map(|(code, _)| code)
            .collect::<Vec<_>>()
    };
    let fine = post(&|_| ()).await;
    assert_eq!(codes(&fine), Vec::<String>::new(), "{fine:#}");
    let undarkened = post(&|body| body["dark"] = json!([])).await;
    assert_eq!(codes(&undarkened), ["no_dark"]);
    let too_dark = post(&|body| body["dark"] = captures["white"].clone()).await;
    assert!(codes(&too_dark).contains(&"negative".to_owned()), "{too_dark:#}");
    let data = app.upload(lab.moved(2, 1)).await;
    let moved = post(&|body| body["data"] = json!(data)).await;
    assert_eq!(codes(&moved), ["shifted_masks"]);
    assert!(moved["warnings"][0]["detail"].as_str().unwrap().contains("-2 rows and -1 columns"));
    let full = post(&|body| body["saturation"] = json!(900)).await;
    assert!(codes(&full).contains(&"saturated".to_owned()), "{full:#}");
    // The measurement lacks one of the calibration's patterns.
    let mut lacking = captures.clone();
    let other = Lab::new("[camera]\nbackground = 0.1\n[sub_apertures]\nopen_share = 0.25\n");
    lacking["masks"][4] = other.send(&app).await["masks"][4].clone();
    lacking.as_object_mut().unwrap().remove("patterns");
    let wrong = app.calibrate_captures(&lacking).await;
    let lost = post(&|body| body["calibration"] = wrong["id"].clone()).await;
    let found_codes = codes_and_frames(&lost["warnings"]);
    assert!(found_codes.contains(&("missing_pattern".into(), vec![4])), "{lost:#}");
    // Warnings are copied to the job and its manifest.
    let off = json!({"measurement": moved["id"], "algorithm": "gap-tv", "registration": "off"});
    let job = app.submit(&off).await;
    let done = app.ended(&job).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    assert_eq!(codes(&done), ["shifted_masks"]);
    for path in ["exports/manifest", "snapshots/0/exports/manifest"] {
        let manifest = app.get(&format!("/v1/jobs/{job}/{path}")).await.expect(200).json();
        assert_eq!(codes(&manifest["content"]), ["shifted_masks"], "{path}");
    }
    let small = app.upload(npy(&[20, 30], (0..600).map(|_| 1.0))).await;
    let mut body = good.clone();
    body["dark"] = json!([small]);
    let answer = app.post("/v1/measurements", &body).await;
    answer.problem(422, "size_mismatch");
    assert_eq!(answer.json()["pointer"], "/dark/0");
}

/// Large enough for the detection of small errors.
const SCENE: Scene = Scene { frames: 4, height: 256, width: 256, snapshots: 1 };

/// The values of a float32 .npy file after a change, as another such file.
fn changed(file: &[u8], values: usize, change: impl Fn(usize, f32) -> f32) -> Vec<u8> {
    let (head, data) = file.split_at(file.len() - 4 * values);
    let value = |bytes: &[u8]| f32::from_le_bytes(bytes.try_into().unwrap());
    let new = data.chunks_exact(4).map(value).enumerate();
    let new = new.flat_map(|(at, value)| change(at, value).to_le_bytes());
    head.iter().copied().chain(new).collect()
}

#[tokio::test]
async fn silent_errors_of_the_optics_are_detected() {
    let app = TestApp::start().await;
    let calibration = id(&app.calibrate(SCENE.masks()).await.expect(201));
    let pixels = SCENE.height * SCENE.width;
    let codes = async |change: &dyn Fn(usize, f32) -> f32| {
        let data = changed(&SCENE.snapshots(), pixels, change);
        let measurement = app.measure(&calibration, data).await.expect(201).json();
        codes_and_frames(&measurement["warnings"])
            .into_iter()
            .map(|(code, _)| code)
            .collect::<Vec<_>>()
    };
    assert_eq!(codes(&|_, value| value).await, Vec::<String>::new());
    // No dark is reported if none was given.
    assert_eq!(codes(&|_, value| value + 0.05).await, ["no_dark"]);
    assert_eq!(codes(&|_, value| value * 10.0).await, ["level"]);
    assert_eq!(codes(&|_, value| value / 10.0).await, ["level"]);
    let gain = |at: usize| [0.7, 1.0, 1.0, 0.8][at / SCENE.width % 2 * 2 + at % 2];
    assert!(codes(&|at, value| value * gain(at)).await.contains(&"mosaic".to_owned()));
}

#[tokio::test]
async fn a_job_warns_of_a_bad_calibration_and_of_shifted_masks() {
    let mut app = TestApp::start().await;
    // One pattern is shown twice, and the values have 12 bits in 16.
    let masks = changed(&SCENE.masks(), 4 * SCENE.height * SCENE.width, |_, value| value);
    let plane = SCENE.height * SCENE.width;
    let values: Vec<f32> = masks[masks.len() - 16 * plane..]
        .chunks_exact(4)
        .map(|bytes| f32::from_le_bytes(bytes.try_into().unwrap()))
        .collect();
    let twice = (0..4 * plane).map(|at| values[if at / plane == 3 { at - plane } else { at }]);
    let mut file = npy_header("<u2", &[4, SCENE.height, SCENE.width]);
    file.extend(twice.flat_map(|value| ((value * 4095.0) as u16).to_le_bytes()));
    let calibration = id(&app.calibrate(file).await.expect(201));
    let measurement = id(&app.measure(&calibration, SCENE.snapshots()).await.expect(201));
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    let early = app.submit(&body).await;
    app.restart_with(&["--workers", "1"]);
    let warned = |job: &Value| {
        let codes = codes_and_frames(&job["warnings"]).into_iter().map(|(code, _)| code);
        codes.filter(|code| code == "bad_calibration").count()
    };
    assert_eq!(warned(&app.ended(&early).await), 1, "the report is finished after the job");
    let report = app.get(&format!("/v1/calibrations/{calibration}/report")).await.expect(200);
    assert_eq!(report.json()["grade"], "bad");
    let codes: Vec<String> =
        codes_and_frames(&report.json()["findings"]).into_iter().map(|(code, _)| code).collect();
    assert!(codes.contains(&"mask_scale".into()), "{codes:?}");
    assert!(codes.contains(&"repeated_pattern".into()), "{codes:?}");
    assert!(
        !codes.contains(&"weak_modulation".into()),
        "no finding concerns the optics: {codes:?}"
    );
    let late = app.ended(&app.submit(&body).await).await;
    assert_eq!(warned(&late), 1);
    // The bad calibration comes first, and the scale of the masks counts in the verdict.
    assert_eq!(late["warnings"][0]["code"], "bad_calibration", "{late:#}");
    assert_eq!(late["warnings"][1]["code"], "mask_scale", "{late:#}");
    assert_eq!(late["assessment"]["psnr_db"], Value::Null, "{late:#}");
}

#[tokio::test]
async fn twelve_bits_in_sixteen_are_detected() {
    let app = TestApp::start().await;
    let calibration = id(&app.calibrate(Scene::SMALL.masks()).await.expect(201));
    for (shift, code, full_scale) in [(4, "left_aligned", 65_520), (0, "right_aligned", 4095)] {
        let values = (0..48 * 64u16).map(|k| (k.wrapping_mul(37) % 4096) << shift);
        let mut file = npy_header("<u2", &[48, 64]);
        file.extend(values.flat_map(u16::to_le_bytes));
        let sha256 = app.upload(file).await;
        let mut body = json!({ "calibration": calibration, "data": sha256 });
        let codes = async |body: &Value| {
            let created = app.post("/v1/measurements", body).await.expect(201).json();
            codes_and_frames(&created["warnings"])
                .into_iter()
                .map(|(code, _)| code)
                .collect::<Vec<_>>()
        };
        assert!(codes(&body).await.contains(&code.to_owned()), "{code}");
        body["full_scale"] = json!(full_scale);
        body["saturation"] = json!(full_scale);
        assert!(!codes(&body).await.contains(&code.to_owned()), "{code}");
    }
}

//! Colour sensors: from a colour clip through a mosaic to frames in colour.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::{Value, json};

use crate::app::{Answer, TestApp, id, judges};
use crate::cluster::nodes::{Nats, RemoteWorker};
use crate::exports::judge_movies;
use crate::faults::results_of;
use crate::pipeline::values;
use crate::samples::npy;

const SIDE: usize = 64;
/// Frames per snapshot.
const FRAMES: usize = 4;
const SNAPSHOTS: usize = 2;

/// A lab with a colour sensor: the files of `simulate` for a clip.
struct Lab {
    folder: tempfile::TempDir,
}

impl Lab {
    /// A lab for a clip with these pixel colours.
    fn new(mosaic: &str, colour: impl Fn(usize, usize, usize) -> [f32; 3]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let pixel = |at: usize| colour(at / (SIDE * SIDE), at / SIDE % SIDE, at % SIDE);
        let pixels = (0..SNAPSHOTS * FRAMES * SIDE * SIDE).flat_map(pixel);
        let clip = npy(&[SNAPSHOTS * FRAMES, SIDE, SIDE, 3], pixels);
        std::fs::write(folder.path().join("clip.npy"), clip).unwrap();
        let lab = Self { folder };
        lab.run(&[
            "simulate",
            "--frames",
            "clip.npy",
            "--mosaic",
            mosaic,
            "--pattern",
            "iid",
            "--snapshots",
            "2",
            "--compression-ratio",
            "4",
            "--captures",
            "2",
            "--out",
            "sim",
        ]);
        lab
    }

    /// A textured disc that moves over a textured background.
    fn coloured(mosaic: &str) -> Self {
        Self::new(mosaic, |k, i, j| {
            let texture = 0.045 * ((i as f32 / 5.0).sin() + (j as f32 / 7.0).cos());
            let away = (i as f32 - 30.0).hypot(j as f32 - 14.0 - 3.0 * k as f32);
            let rgb = if away < 13.0 { [0.8, 0.3, 0.1] } else { [0.15, 0.3, 0.6] };
            rgb.map(|colour| colour + texture)
        })
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn file(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.path("sim").join(name)).unwrap()
    }

    fn command(&self, arguments: &[&str]) -> std::process::Output {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        command.args(arguments).current_dir(self.folder.path()).output().unwrap()
    }

    /// Runs a command that must do its work. The checks may find errors in the small scene, which gives status 3.
    fn run(&self, arguments: &[&str]) -> String {
        let output = self.command(arguments);
        let done = [Some(0), Some(3)].contains(&output.status.code());
        assert!(done, "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    }

    /// Creates the calibration of the lab.
    async fn calibrate(&self, app: &TestApp, mosaic: &str) -> Answer {
        let masks = app.upload(self.file("masks.npy")).await;
        app.post("/v1/calibrations", &json!({"masks": masks, "mosaic": mosaic})).await
    }

    /// Creates a measurement with its calibration.
    async fn measure(&self, app: &TestApp, mosaic: &str) -> String {
        let calibration = id(&self.calibrate(app, mosaic).await.expect(201));
        let created = app.measure(&calibration, self.file("measurement.npy")).await.expect(201);
        assert_eq!(created.json()["warnings"], json!([]), "a stated mosaic gives no warning");
        id(&created)
    }
}

fn tv(measurement: &str) -> Value {
    json!({"measurement": measurement, "algorithm": "gap-tv", "tile": {"size": 24, "overlap": 8}})
}

/// Rows, columns and values of an 8-bit colour PNG.
fn decode(answer: &Answer) -> (usize, usize, Vec<u8>) {
    let picture = image::load_from_memory(&answer.bytes).unwrap();
    let image::DynamicImage::ImageRgb8(colours) = picture else { panic!("not in 8-bit colours") };
    (colours.height() as usize, colours.width() as usize, colours.into_raw())
}

/// Checks all EXR files of a snapshot with the official reader.
fn judge_exr(folder: &Path) {
    let Some(python) = judges() else { return };
    let mut judge = Command::new(python);
    judge.arg("tests/judges/read_exr.py").arg(folder).args(["--attribute", "demosaicking"]);
    let output = judge.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stdout));
}

#[tokio::test]
async fn a_mosaic_is_reconstructed_in_colour() {
    let lab = Lab::coloured("grbg");
    let app = TestApp::with(&["--workers", "2"]).await;
    let token = app.token(&["create", "--lab", "a"]);
    app.sign_in(&token);
    let measurement = lab.measure(&app, "grbg").await;
    let job = app.submit(&tv(&measurement)).await;
    let ended = app.ended(&job).await;
    assert_eq!(ended["state"], "succeeded", "{ended:#}");
    assert_eq!(ended["shape"]["mosaic"], "grbg");
    let calibration = ended["calibration"].as_str().unwrap();
    let calibration = app.get(&format!("/v1/calibrations/{calibration}")).await.expect(200).json();
    assert_eq!(calibration["mosaic"], "grbg");
    let base = format!("/v1/jobs/{job}/snapshots/1");

    // At each of four positions, there is one tile per sub-image.
    let tiles =
        app.get(&format!("{base}/tiles").replace("/v1/", "/view/")).await.expect(200).json();
    let places = tiles["items"].as_array().unwrap().iter().map(|tile| {
        let field = |name: &str| tile[name].as_u64().unwrap();
        (field("row"), field("column"), field("height"), field("width"), field("plane"))
    });
    let expected = [0, 16].into_iter().flat_map(|row| [0, 16].map(|column| (row, column)));
    let expected =
        expected.flat_map(|(row, column)| [0, 1, 2, 3].map(|plane| (row, column, 48, 48, plane)));
    assert_eq!(places.collect::<Vec<_>>(), expected.collect::<Vec<_>>());

    // The truth may be in colour or in the mosaic of the sensor.
    let truth = app.upload(lab.file("truth.npy")).await;
    let quality = app.get(&format!("{base}/quality?truth={truth}")).await.expect(200).json();
    // The peak is the white level of the job; a bound for a data range of 1 does not depend on it.
    let psnr = quality["psnr"].as_f64().unwrap();
    let unit = psnr - 20.0 * quality["peak"].as_f64().unwrap().log10();
    assert!(unit > 25.0 && quality["ssim"].as_f64().unwrap() > 0.8, "{quality}");
    let colours = values(&lab.file("truth.npy"));
    let green = [[1, 0], [2, 1]];
    let at = |at: usize| 3 * at + green[at / SIDE % 2][at % 2];
    let raw = (0..colours.len() / 3).map(|pixel| colours[at(pixel)]);
    let raw = app.upload(npy(&[SNAPSHOTS * FRAMES, SIDE, SIDE], raw)).await;
    let quality = app.get(&format!("{base}/quality?truth={raw}")).await.expect(200).json();
    assert!((quality["psnr"].as_f64().unwrap() - psnr).abs() < 3.0, "{quality}");
    let grey = app.upload(npy(&[4, 64, 32, 3], std::iter::repeat_n(0.5, 4 * 64 * 32 * 3))).await;
    let refused = app.get(&format!("{base}/quality?truth={grey}")).await;
    assert!(refused.problem(422, "size_mismatch").contains("4 frames of 64x32"));

    // Arrays, and images of them.
    let frames = app.get(&format!("{base}/exports/npy")).await.expect(200).bytes;
    assert!(String::from_utf8_lossy(&frames[..128]).contains("(4, 64, 64, 3)"));
    let frames = values(&frames);
    let sensor = values(&app.get(&format!("{base}/exports/mosaic")).await.expect(200).bytes);
    assert!(sensor.iter().enumerate().all(|(pixel, value)| frames[at(pixel)] == *value));
    let picture = app
        .get(
            &format!("{base}/pictures/frame-2/tiles/0/0/0?black=0&white=1")
                .replace("/v1/", "/view/"),
        )
        .await;
    let (rows, columns, shown) = decode(&picture.expect(200));
    assert_eq!((rows, columns), (SIDE, SIDE));
    for (&shown, &value) in shown.iter().zip(&frames[3 * SIDE * SIDE..]) {
        assert!((f32::from(shown) - (value * 255.0).clamp(0.0, 255.0)).abs() <= 0.51);
    }
    // The middle of the disc.
    let disc = &frames[3 * (30 * SIDE + 14 + 3 * FRAMES)..][..3];
    assert!(disc[0] > disc[1] + 0.2 && disc[1] > disc[2], "{disc:?}");
    for name in ["difference-2", "slice-30"] {
        decode(
            &app.get(&format!("{base}/pictures/{name}").replace("/v1/", "/view/"))
                .await
                .expect(200),
        );
    }
    let rest = app
        .get(&format!("{base}/pictures/residual/spread").replace("/v1/", "/view/"))
        .await
        .expect(200)
        .json();
    assert!(rest["maximum"].as_f64().unwrap() < 0.1, "{rest}");
    let manifest = app.get(&format!("{base}/exports/manifest")).await.expect(200).json();
    assert_eq!(
        manifest["content"]["colour"],
        json!({"mosaic": "grbg", "demosaicking": "malvar-he-cutler-2004"})
    );
    assert_eq!(manifest["content"]["tile_plan"]["tiles"][5], json!([0, 16, 48, 48]));
    let folder = app.download(&job, 1).await;
    judge_exr(folder.path());
    let stored = app.data().join("results").join(&job).join("snapshot_0001");
    assert!(!stored.join("mosaic.npy").exists() && folder.path().join("mosaic.npy").exists());

    // Export formats.
    let zarr = app.get(&format!("{base}/exports/zarr/0/zarr.json")).await.expect(200).json();
    assert_eq!(zarr["shape"], json!([4, 3, 64, 64]));
    app.get(&format!("{base}/exports/zarr/0/c/0/0/0")).await.problem(404, "not_found");
    let chunk = app.get(&format!("{base}/exports/zarr/0/c/3/0/0/0")).await.expect(200).bytes;
    assert_eq!(chunk.len(), SIDE * SIDE * 3 * 4);
    judge_movies(&app, (&job, SNAPSHOTS), &token).await;
    if let Some(python) = judges() {
        let mut judge = tokio::process::Command::new(python);
        judge.arg("tests/judges/read_exports.py").arg(format!("http://{}", app.address()));
        let output = judge.args([&job, "2"]).env("SCI_RECON_TOKEN", &token).output().await.unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
}

#[tokio::test]
async fn workers_and_the_command_line_give_the_same_colours() {
    let lab = Lab::coloured("rggb");
    // The job solves both snapshots jointly, with a pilot.
    let job = |measurement: &str| {
        let mut job = tv(measurement);
        job["algorithm"] = json!("gap-tv3d");
        job
    };
    let run = async |app: &TestApp| {
        let measurement = lab.measure(app, "rggb").await;
        let job = app.submit(&job(&measurement)).await;
        let ended = app.ended(&job).await;
        assert_eq!(ended["state"], "succeeded", "{ended:#}");
        (job, ended)
    };
    let app = TestApp::with(&["--workers", "2"]).await;
    let (id, ended) = run(&app).await;
    // The plan has four positions with four sub-images each, in one run of both snapshots.
    assert_eq!(ended["progress"]["tiles_total"], 16, "{ended:#}");
    let expected = results_of(&app, &id, SNAPSHOTS).await;
    // Each snapshot has frames, images, stack, array and mosaic.
    assert_eq!(expected.len(), SNAPSHOTS * (2 * FRAMES + 3));

    let line = [
        "reconstruct",
        "--masks",
        "sim/masks.npy",
        "--measurement",
        "sim/measurement.npy",
        "--mosaic",
        "rggb",
        "--snapshots",
        "all",
        "--algorithm",
        "gap-tv3d",
        "--tile",
        "24",
        "--overlap",
        "8",
        "--truth",
        "sim/truth.npy",
    ];
    let report = lab.run(&[&line[..], &["--out", "out", "--json"]].concat());
    let report: Value = serde_json::from_str(&report).unwrap();
    assert!(report["psnr_unit_db"].as_f64().unwrap() > 25.0, "{report}");
    for (name, sha256) in &expected {
        let file = lab.path("out").join(format!("snapshot_000{name}"));
        assert_eq!(crate::faults::sha256(&std::fs::read(file).unwrap()), *sha256, "{name}");
    }
    if let Some(nats) = Nats::start(1) {
        let app =
            TestApp::with(&["--workers", "0", "--nats", &nats.url(), "--ack-wait", "5"]).await;
        let url = nats.url();
        let _workers =
            [(); 2].map(|()| RemoteWorker::start(&["--nats", url.as_str(), "--pool", "test"]));
        let (id, _) = run(&app).await;
        assert_eq!(results_of(&app, &id, SNAPSHOTS).await, expected);
    }
}

#[tokio::test]
async fn a_mosaic_leaves_out_what_was_not_measured_here_and_elsewhere() {
    let lab = Lab::coloured("gbrg");
    let y = lab.file("measurement.npy");
    let mut sorted = values(&y);
    sorted.sort_by(f32::total_cmp);
    let clip = sorted[sorted.len() * 95 / 100];
    let file = crate::defects::spoiled(&y, &[SNAPSHOTS, SIDE, SIDE], clip);
    let app = TestApp::with(&["--workers", "2"]).await;
    let truth = app.upload(lab.file("truth.npy")).await;
    let whole = lab.measure(&app, "gbrg").await;
    let calibration = id(&lab.calibrate(&app, "gbrg").await);
    let measurement = app.measure(&calibration, file).await.expect(201).json();
    for code in ["bad_pixels", "saturated"] {
        let mut warnings = measurement["warnings"].as_array().unwrap().iter();
        assert!(warnings.any(|warning| warning["code"] == code), "{measurement:#}");
    }
    let measurement = measurement["id"].as_str().unwrap();
    let mut quality = Vec::new();
    let mut expected = BTreeMap::new();
    for measurement in [whole.as_str(), measurement] {
        let job = app.submit(&tv(measurement)).await;
        assert_eq!(app.ended(&job).await["state"], "succeeded");
        for snapshot in 0..SNAPSHOTS {
            let base = format!("/v1/jobs/{job}/snapshots/{snapshot}");
            let frames = app.get(&format!("{base}/exports/npy")).await.expect(200).bytes;
            assert!(values(&frames).iter().all(|value| value.is_finite()));
            let path = format!("{base}/quality?truth={truth}");
            let report = app.get(&path).await.expect(200).json();
            let unit = 20.0 * report["peak"].as_f64().unwrap().log10();
            quality.push(report["psnr"].as_f64().unwrap() - unit);
        }
        expected = results_of(&app, &job, SNAPSHOTS).await;
    }
    let (before, after) = quality.split_at(SNAPSHOTS);
    eprintln!("{after:.2?} dB, {before:.2?} dB if all is measured");
    assert!(before.iter().zip(after).all(|(before, after)| after > &(before - 4.0)), "{quality:?}");
    let Some(nats) = Nats::start(1) else { return };
    let url = nats.url();
    let app = app.again(&["--workers", "0", "--nats", &url, "--ack-wait", "5"]).await;
    let _worker = RemoteWorker::start(&["--nats", &url, "--pool", "test"]);
    let job = app.submit(&tv(measurement)).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    assert_eq!(results_of(&app, &job, SNAPSHOTS).await, expected);
}

#[tokio::test]
async fn a_grey_scene_behind_a_mosaic_stays_grey() {
    let lab = Lab::new("bggr", |k, i, j| {
        let away = (i as f32 - 30.0).hypot(j as f32 - 14.0 - 3.0 * k as f32);
        let texture = 0.1 * ((i as f32 / 5.0).sin() + (j as f32 / 7.0).cos());
        [if away < 13.0 { 0.8 } else { 0.4 + texture }; 3]
    });
    let app = TestApp::with(&["--workers", "1"]).await;
    let measurement = lab.measure(&app, "bggr").await;
    let job = app.submit(&tv(&measurement)).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    let frames = app.get(&format!("/v1/jobs/{job}/snapshots/0/exports/npy")).await.expect(200);
    let frames = values(&frames.bytes);
    let pixels = frames.chunks_exact(3);
    let mut means = [0.0; 3];
    let mut chroma = 0.0;
    for pixel in pixels {
        let grey = pixel.iter().sum::<f32>() / 3.0;
        for (mean, value) in means.iter_mut().zip(pixel) {
            *mean += f64::from(value - grey) * 3.0 / frames.len() as f64;
            chroma += f64::from((value - grey).abs()) / frames.len() as f64;
        }
    }
    assert!(means.iter().all(|mean| mean.abs() < 0.003), "{means:?}");
    assert!(chroma < 0.02, "{chroma}");
}

#[tokio::test]
async fn an_invalid_mosaic_is_rejected_and_captures_can_have_one() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let odd = app.upload(npy(&[2, 6, 7], std::iter::repeat_n(1.0, 84))).await;
    let body = json!({"masks": odd, "mosaic": "rggb"});
    let refused = app.post("/v1/calibrations", &body).await;
    refused.problem(422, "invalid_request");
    let error = refused.json()["errors"][0].clone();
    assert_eq!(error["pointer"], "/mosaic");
    assert!(error["detail"].as_str().unwrap().contains("6x7"), "{error}");
    let refused = app.post("/v1/calibrations", &json!({"masks": odd, "mosaic": "rgbg"})).await;
    assert!(refused.status.is_client_error());
    assert!(String::from_utf8_lossy(&refused.bytes).contains("rggb"));

    let lab = Lab::coloured("gbrg");
    let index: Value = serde_json::from_slice(&lab.file("captures/captures.json")).unwrap();
    let send = async |names: &Value| {
        let mut sent = Vec::new();
        for name in names.as_array().unwrap() {
            sent.push(app.upload(lab.file(&format!("captures/{}", name.as_str().unwrap()))).await);
        }
        json!(sent)
    };
    let mut masks = Vec::new();
    for names in index["masks"].as_array().unwrap() {
        masks.push(send(names).await);
    }
    let captures = json!({"masks": masks, "white": send(&index["white"]).await,
        "black": send(&index["black"]).await});
    let body = json!({"captures": captures, "mosaic": "gbrg"});
    let created = app.post("/v1/calibrations", &body).await;
    // The worker may prepare the masks before the answer.
    assert!([201, 202].contains(&created.status.as_u16()), "{}", created.json());
    let created = created.json();
    assert_eq!(created["mosaic"], "gbrg");
    let path = format!("/v1/calibrations/{}", created["id"].as_str().unwrap());
    let ready = async || app.get(&path).await.expect(200).json();
    while ready().await["state"] == "preparing" {
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
    let ready = ready().await;
    assert_eq!((&ready["state"], &ready["mosaic"]), (&json!("ready"), &json!("gbrg")));

    let refusal = lab.command(&[
        "simulate",
        "--frames",
        "sim/measurement.npy",
        "--mosaic",
        "rggb",
        "--compression-ratio",
        "2",
        "--out",
        "none",
    ]);
    let text = String::from_utf8_lossy(&refusal.stderr).into_owned();
    assert!(refusal.status.code() == Some(2) && text.contains("not in colour"), "{text}");
}

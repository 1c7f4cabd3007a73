//! End-to-end networks: a script fits a tiny one, and the service uses it.

use std::path::{Path, PathBuf};
use std::process::Command;

use engine::pipeline::usage::peak_rss_of;
use serde_json::{Value, json};

use crate::app::{TestApp, has_onnxruntime, id, judges};
use crate::faults::children;
use crate::pipeline::{psnr, values};
use crate::samples::Scene;

/// Python with the packages of the tests, if libonnxruntime is available as well.
pub fn python() -> Option<String> {
    if has_onnxruntime() { judges() } else { None }
}

/// Fits a network for the scene's masks, with a fixed or free image size.
pub fn train(python: &str, folder: &Path, scene: Scene, size: &str) -> PathBuf {
    let (masks, network) = (folder.join("masks.npy"), folder.join(format!("{size}.onnx")));
    std::fs::write(&masks, scene.masks()).unwrap();
    let mut command = Command::new(python);
    command.arg("tests/judges/train_network.py").args([&masks, &network]).arg(size);
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    network
}

/// PSNR in dB of the trivial reconstruction: the measurement divided by the sum of masks.
fn trivial(scene: Scene) -> f64 {
    let (masks, snapshots) = (values(&scene.masks()), values(&scene.snapshots()));
    let pixels = scene.height * scene.width;
    let light = |at: usize| (0..scene.frames).map(|k| masks[k * pixels + at]).sum::<f32>();
    let frame: Vec<f32> = (0..pixels).map(|at| snapshots[at] / light(at).max(1e-6)).collect();
    psnr(scene, 0, &frame.repeat(scene.frames))
}

pub async fn register(app: &TestApp, calibration: &str, file: &Path) -> crate::app::Answer {
    let file = app.upload(std::fs::read(file).unwrap()).await;
    app.post("/v1/models", &json!({"calibration": calibration, "file": file, "name": "tiny"})).await
}

/// Checks that the worker's network process is confined, and has no file of the service open.
fn assert_confined(app: &TestApp) {
    let worker = app.workers()[0].as_raw_nonzero().get().unsigned_abs();
    let [network] = children(worker)[..] else { panic!("one process of a network should exist") };
    let proc = PathBuf::from(format!("/proc/{network}"));
    let status = std::fs::read_to_string(proc.join("status")).unwrap();
    let has_line = |line: &str| status.lines().any(|line_text| line_text == line);
    assert!(has_line("NoNewPrivs:\t1") && has_line("Seccomp:\t2"), "{status}");
    let open: Vec<PathBuf> = std::fs::read_dir(proc.join("fd"))
        .unwrap()
        .map(|entry| std::fs::read_link(entry.unwrap().path()).unwrap())
        .collect();
    let data = app.data().canonicalize().unwrap();
    assert!(open.iter().all(|file| !file.starts_with(&data)), "{open:?}");
    let sockets = open.iter().filter(|file| file.to_string_lossy().starts_with("socket:"));
    assert_eq!(sockets.count(), 0, "{open:?}");
}

#[tokio::test]
async fn a_labs_network_reconstructs_frames() {
    let Some(python) = python() else { return };
    let (folder, scene) = (tempfile::tempdir().unwrap(), Scene::SMALL);
    let fixed = train(&python, folder.path(), scene, "fixed");
    let free = train(&python, folder.path(), scene, "free");
    let app = TestApp::with(&["--workers", "1"]).await;
    let (calibration, measurement) = app.scene(&scene).await;
    let created = register(&app, &calibration, &fixed).await.expect(201);
    let model = created.json();
    assert_eq!(created.header("location"), format!("/v1/models/{}", id(&created)));
    assert_eq!((&model["fixed_size"], &model["trial"]["width"]), (&json!(true), &json!(64)));
    assert_eq!(app.get(created.header("location")).await.expect(200).json(), model);
    let free = register(&app, &calibration, &free).await.expect(201).json();
    assert_eq!(free["fixed_size"], false);
    let list = app.get(&format!("/v1/models?calibration={calibration}")).await.expect(200).json();
    assert_eq!(list["items"], json!([free, model]));

    let mut quality = Vec::new();
    for (model, tile, tiles) in
        [(&model, Value::Null, 1), (&free, json!({"size": 32, "overlap": 16}), 6)]
    {
        let body = json!({"measurement": measurement, "algorithm": "learned", "model": model["id"],
            "snapshots": 0, "tile": tile});
        let job = app.submit(&body).await;
        let done = app.ended(&job).await;
        assert_eq!(done["state"], "succeeded", "{done:#}");
        assert_eq!(
            (&done["model"], &done["progress"]["tiles_total"]),
            (&model["id"], &json!(tiles))
        );
        let base = format!("/v1/jobs/{job}/snapshots/0");
        let manifest = app.get(&format!("{base}/manifest.json")).await.expect(200).json();
        let recorded = json!([{"name": "tiny", "sha256": model["file"]}]);
        assert_eq!(manifest["content"]["models"], recorded);
        assert_eq!(manifest["run"]["provider"], "CPUExecutionProvider");
        let frames = app.get(&format!("{base}/frames.npy")).await.expect(200);
        quality.push(psnr(scene, 0, &values(&frames.bytes)));
        app.get(&format!("{base}/frames/4.exr")).await.expect(200);
        let used = app.delete(&format!("/v1/models/{}", model["id"].as_str().unwrap())).await;
        assert!(used.problem(409, "in_use").contains("1 jobs"));
        app.delete(&format!("/v1/jobs/{job}")).await.expect(204);
    }
    assert_confined(&app);
    eprintln!("{:.2} dB by the trivial reconstruction, {quality:.2?} by networks", trivial(scene));
    assert!(quality.iter().all(|quality| *quality > trivial(scene) + 1.0), "{quality:?}");
    for model in [&model, &free] {
        let path = format!("/v1/models/{}", model["id"].as_str().unwrap());
        app.delete(&path).await.expect(204);
        app.get(&path).await.problem(404, "not_found");
    }
}

#[tokio::test]
async fn a_file_that_is_no_network_for_these_masks_is_rejected() {
    let Some(python) = python() else { return };
    let (folder, scene) = (tempfile::tempdir().unwrap(), Scene::SMALL);
    let network = train(&python, folder.path(), scene, "fixed");
    let app = TestApp::with(&["--workers", "0"]).await;
    let (calibration, measurement) = app.scene(&scene).await;
    let more = Scene { frames: 6, ..scene };
    let (other, other_measurement) = app.scene(&more).await;
    let refused = register(&app, &other, &network).await;
    let detail = refused.problem(422, "invalid_content");
    assert!(detail.contains("[1,4,48,64]") && detail.contains("[1,6,48,64]"), "{detail}");
    assert_eq!(refused.json()["pointer"], "/file");
    let masks = folder.path().join("masks.npy");
    let detail = register(&app, &calibration, &masks).await.problem(422, "invalid_content");
    assert!(detail.contains("can't be loaded"), "{detail}");
    // A network must not load weights from files of the service's machine.
    let outside = train(&python, folder.path(), scene, "outside");
    let detail = register(&app, &calibration, &outside).await.problem(422, "invalid_content");
    assert!(detail.contains("weights"), "{detail}");
    let greedy = train(&python, folder.path(), scene, "greedy");
    let detail = register(&app, &calibration, &greedy).await.problem(422, "invalid_content");
    assert!(detail.contains("memory"), "{detail}");
    let body = json!({"calibration": calibration, "file": "0".repeat(64)});
    assert_eq!(app.post("/v1/models", &body).await.json()["pointer"], "/file");
    app.get("/livez").await.expect(200);

    let model = id(&register(&app, &calibration, &network).await.expect(201));
    for (body, pointer) in [
        (json!({"measurement": measurement, "algorithm": "learned"}), "/model"),
        (json!({"measurement": measurement, "algorithm": "gap-tv", "model": model}), "/model"),
        (
            json!({"measurement": other_measurement, "algorithm": "learned", "model": model}),
            "/model",
        ),
        (json!({"measurement": measurement, "algorithm": "learned", "model": other}), "/model"),
        (
            json!({"measurement": measurement, "algorithm": "learned", "model": model,
                "tile": {"size": 32, "overlap": 8}}),
            "/tile",
        ),
        (
            json!({"measurement": measurement, "algorithm": "learned", "model": model,
                "schedule": {"stages": [{"prior": "tv", "iterations": 5, "tv_weight": 0.1}]}}),
            "/schedule",
        ),
    ] {
        let refused = app.post("/v1/jobs", &body).await;
        refused.problem(422, "invalid_request");
        assert_eq!(refused.json()["pointer"], pointer, "{body}");
    }
    let used = app.delete(&format!("/v1/calibrations/{calibration}")).await;
    assert!(used.problem(409, "in_use").contains("measurements"));
    app.delete(&format!("/v1/measurements/{measurement}")).await.expect(204);
    let used = app.delete(&format!("/v1/calibrations/{calibration}")).await;
    assert!(used.problem(409, "in_use").contains("1 models"));
    // Another lab cannot see or use the model.
    app.sign_in(&app.token(&["create", "--lab", "other"]));
    app.get(&format!("/v1/models/{model}")).await.problem(404, "not_found");
    assert_eq!(app.get("/v1/models").await.json()["items"], json!([]));
    app.delete(&format!("/v1/models/{model}")).await.problem(404, "not_found");
}

/// The network uses little memory for the dark input of its check, and much for a bright one.
#[tokio::test]
async fn a_network_that_exceeds_its_memory_fails_only_its_job() {
    let Some(python) = python() else { return };
    let (folder, scene) = (tempfile::tempdir().unwrap(), Scene::SMALL);
    let sly = train(&python, folder.path(), scene, "sly");
    let app = TestApp::with(&["--workers", "1", "--worker-memory-bytes", "1073741824"]).await;
    let (calibration, measurement) = app.scene(&scene).await;
    let model = register(&app, &calibration, &sly).await.expect(201).json();
    let body = json!({"measurement": measurement, "algorithm": "learned", "model": model["id"]});
    let job = app.submit(&body).await;
    let (mut peak, workers) = (0, app.workers());
    let done = loop {
        for process in children(workers[0].as_raw_nonzero().get().unsigned_abs()) {
            let process = process.as_raw_nonzero().get().unsigned_abs();
            peak = peak.max(peak_rss_of(process) >> 20);
        }
        let shown = app.get(&format!("/v1/jobs/{job}")).await.expect(200).json();
        if shown["state"] == "failed" || shown["state"] == "succeeded" {
            break shown;
        }
        tokio::time::sleep(std::time::Duration::from_millis(5)).await;
    };
    let error = done["error"].as_str().unwrap_or_default();
    eprintln!("the network had {peak} MiB at most; the job says: {error}");
    assert_eq!(done["state"], "failed", "{done:#}");
    let words = error.to_lowercase();
    assert!(words.contains("alloc") || words.contains("memory"), "{error}");
    assert!((1..1600).contains(&peak), "{peak} MiB");
    let job = app.submit(&json!({"measurement": measurement, "algorithm": "gap-tv"})).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    assert_eq!(app.workers(), workers, "the worker is still running");
}

#[test]
fn the_command_line_runs_a_network() {
    let Some(python) = python() else { return };
    let (folder, scene) = (tempfile::tempdir().unwrap(), Scene::SMALL);
    let network = train(&python, folder.path(), scene, "fixed");
    let file = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    std::fs::write(file("snapshots.npy"), scene.snapshots()).unwrap();
    let (masks, measurement, out) = (file("masks.npy"), file("snapshots.npy"), file("out"));
    let network = network.to_str().unwrap();
    let run = |more: &[&str]| {
        let line = ["reconstruct", "--masks", &masks, "--measurement", &measurement, "--json"];
        let command = &mut Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        command.args(line).args(more).output().unwrap()
    };
    let learned = ["--algorithm", "learned", "--model", network];
    let output = run(&[&learned[..], &["--out", &out]].concat());
    // The checks may find errors in the small scene, which gives status 3.
    let done = [Some(0), Some(3)].contains(&output.status.code());
    assert!(done, "{}", String::from_utf8_lossy(&output.stderr));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&report["denoiser_passes"], &report["algorithm"]), (&json!(1), &json!("learned")));
    let frames = std::fs::read(folder.path().join("out/frames.npy")).unwrap();
    assert!(psnr(scene, 0, &values(&frames)) > trivial(scene) + 1.0);
    for (more, word) in [
        (&["--algorithm", "learned"][..], "--model"),
        (&["--algorithm", "gap-tv", "--model", network], "takes no --model"),
        (&[&learned[..], &["--tile", "32"]].concat(), "leave --tile out"),
        (&[&learned[..], &["--iterations", "3"]].concat(), "--iterations"),
        (&["--algorithm", "learned", "--model", "/nowhere.onnx"], "/nowhere.onnx"),
    ] {
        let output = run(more);
        let message = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert!(message.contains(word), "{message}");
    }
    let outside = train(&python, folder.path(), scene, "outside");
    let output = Command::new(env!("CARGO_BIN_EXE_sci-recon"))
        .current_dir(folder.path())
        .arg("check-model")
        .arg(&outside)
        .args(["--frames", "4", "--height", "48", "--width", "64", "--onnxruntime"])
        .arg(Path::new(&std::env::var("ORT_DYLIB_PATH").unwrap()).canonicalize().unwrap())
        .output()
        .unwrap();
    let verdict: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(verdict["refused"].is_string(), "the weights are in its working folder: {verdict}");
}

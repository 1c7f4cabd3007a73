//! The records of workers, and the reports of their failures.

use std::process::Command;

use serde_json::{Value, json};

use crate::app::{TestApp, has_programs, id};
use crate::samples::{Scene, constant};

fn tv(measurement: &str) -> Value {
    json!({
        "measurement": measurement,
        "algorithm": "gap-tv",
        "schedule": {"stages": [{"prior": "tv", "iterations": 60, "tv_weight": 0.1}]},
        "tile": {"size": 32, "overlap": 8},
        "snapshots": 1,
    })
}

#[tokio::test]
async fn the_manifest_is_complete_and_the_command_line_reproduces_the_frames() {
    let app = TestApp::with(&["--workers", "2"]).await;
    let scene = Scene::SMALL;
    let calibration = id(&app.calibrate(scene.masks()).await.expect(201));
    let data = app.upload(scene.snapshots()).await;
    let times = json!({"camera_fps": 50.0, "exposure_s": 0.016});
    let mut body = json!({"calibration": calibration, "data": data});
    body.as_object_mut().unwrap().extend(times.as_object().unwrap().clone());
    let measurement = id(&app.post("/v1/measurements", &body).await.expect(201));
    let job = app.submit(&tv(&measurement)).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded");

    let snapshot = format!("/v1/jobs/{job}/snapshots/1");
    let manifest = app.get(&format!("{snapshot}/exports/manifest")).await.expect(200).json();
    let content = &manifest["content"];
    assert_eq!(content["inputs"]["measurement"]["data"], data);
    assert_eq!(content["inputs"]["measurement_axes"], "frame-row-column");
    assert_eq!(content["models"], json!([]), "total variation has no network");
    assert_eq!(content["summary"]["tv_iterations"], 60);
    assert_eq!(content["schedule"]["stages"][0]["tv_updates"], 4, "defaults are filled in");
    assert_eq!(content["tiles"].as_array().unwrap().len(), 6);
    let starts: Vec<f64> =
        serde_json::from_value(content["camera"]["frame_times_s"].clone()).unwrap();
    let expected = [0.02, 0.024, 0.028, 0.032];
    assert!(starts.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-9), "{starts:?}");
    assert_eq!(manifest["run"]["job"], job);
    let job_manifest =
        app.get(&format!("/v1/jobs/{job}/exports/manifest")).await.expect(200).json();
    assert_eq!(job_manifest["content"]["snapshots"][0]["summary"], content["summary"]);
    // The tasks are prepare, preview, six tiles, white level, assemble and manifest.
    assert_eq!(job_manifest["run"]["tasks"], 11);

    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    std::fs::write(path("masks.npy"), scene.masks()).unwrap();
    std::fs::write(path("snapshots.npy"), scene.snapshots()).unwrap();
    std::fs::write(path("schedule.json"), tv("")["schedule"].to_string()).unwrap();
    let line = Command::new(env!("CARGO_BIN_EXE_sci-recon"))
        .args(["reconstruct", "--algorithm", "gap-tv", "--snapshot", "1", "--tile", "32"])
        .args(["--overlap", "8", "--masks", "masks.npy", "--measurement", "snapshots.npy"])
        .args(["--schedule", "schedule.json", "--out", "out"])
        .current_dir(folder.path())
        .output()
        .unwrap();
    // The checks may find errors in the small scene, which gives status 3.
    assert!(
        [Some(0), Some(3)].contains(&line.status.code()),
        "{}",
        String::from_utf8_lossy(&line.stderr)
    );
    let served = app.get(&format!("{snapshot}/exports/npy")).await.expect(200).bytes;
    assert!(served == std::fs::read(path("out/frames.npy")).unwrap(), "bit for bit");
}

#[tokio::test]
async fn a_measurement_without_light_fails_at_once_with_its_reason() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let calibration = id(&app.calibrate(Scene::SMALL.masks()).await.expect(201));
    let dark = constant(&[2, 48, 64], -0.5);
    let measurement = id(&app.measure(&calibration, dark).await.expect(201));
    let job = app.submit(&tv(&measurement)).await;
    let ended = app.ended(&job).await;
    assert_eq!(ended["state"], "failed");
    let error = ended["error"].as_str().unwrap();
    assert!(error.contains("snapshot 1") && error.contains("holds no light"), "{error}");
    assert!(!error.contains("attempts"), "a retry is useless: {error}");
    let problem = &ended["problem"];
    assert_eq!((&problem["code"], &problem["stage"]), (&json!("task_failed"), &json!("prepare")));
    assert_eq!((&problem["snapshot"], &problem["tile"]), (&Value::Null, &Value::Null));
}

/// The metrics pass the linter of Prometheus.
#[tokio::test]
async fn metrics_pass_the_linter_of_prometheus() {
    use std::io::Write;
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    assert_eq!(app.ended(&app.submit(&tv(&measurement)).await).await["state"], "succeeded");
    let text = app.get("/metrics").await.expect(200).bytes;
    let lines = String::from_utf8(text.clone()).unwrap();
    for name in ["sci_recon_tasks_done_total{kind=\"tile\"}", "sci_recon_solver_iterations_total"] {
        let line = lines.lines().find(|line| line.starts_with(name)).unwrap();
        assert!(line.rsplit(' ').next().unwrap().parse::<u64>().unwrap() > 0, "{line}");
    }
    if !has_programs(&["promtool"], "prometheus") {
        return;
    }
    let mut linter = std::process::Command::new("promtool");
    linter.args(["check", "metrics"]).stdin(std::process::Stdio::piped());
    let mut linter = linter.spawn().unwrap();
    linter.stdin.take().unwrap().write_all(&text).unwrap();
    assert!(linter.wait().unwrap().success());
}

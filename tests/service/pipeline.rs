//! Whole jobs, from the upload to the download, with real worker processes.

use std::time::{Duration, Instant};

use reqwest::Method;
use serde_json::{Value, json};

use crate::app::{Answer, TestApp, id};
use crate::samples::Scene;

impl TestApp {
    /// Waits until the job has ended, and returns it.
    pub async fn ended(&self, job: &str) -> Value {
        self.when(job, |job| {
            ["succeeded", "failed", "cancelled"].contains(&job["state"].as_str().unwrap())
        })
        .await
    }

    /// Waits until the job satisfies a condition, and returns it.
    pub async fn when(&self, job: &str, reached: impl Fn(&Value) -> bool) -> Value {
        let start = Instant::now();
        loop {
            let job = self.get(&format!("/v1/jobs/{job}")).await.expect(200).json();
            if reached(&job) {
                return job;
            }
            assert!(start.elapsed() < Duration::from_secs(600), "{job:#}");
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }

    /// Submits a job and returns its identifier.
    pub async fn submit(&self, body: &Value) -> String {
        id(&self.post("/v1/jobs", body).await.expect(201))
    }
}

/// Values of a float32 .npy file.
pub fn values(file: &[u8]) -> Vec<f32> {
    let header = 10 + usize::from(file[8]) + 256 * usize::from(file[9]);
    file[header..].chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
}

/// PSNR of a snapshot's frames against the scene, in dB.
pub fn psnr(scene: Scene, snapshot: usize, frames: &[f32]) -> f64 {
    let places = (0..scene.frames)
        .flat_map(|k| (0..scene.height).map(move |i| (k, i)))
        .flat_map(|(k, i)| (0..scene.width).map(move |j| (k, i, j)));
    let squares: f64 = places
        .zip(frames)
        .map(|((k, i, j), value)| f64::from(value - scene.pixel(snapshot, k, i, j)).powi(2))
        .sum();
    -10.0 * (squares / frames.len() as f64).log10()
}

#[tokio::test]
async fn a_job_reconstructs_the_scene() {
    let app = TestApp::with(&["--workers", "2"]).await;
    let scene = Scene::SMALL;
    let (_, measurement) = app.scene(&scene).await;
    let tile = json!({"size": 32, "overlap": 8});
    let body = json!({"measurement": measurement, "algorithm": "gap-tv", "tile": tile});
    let job = app.submit(&body).await;
    let done = app.ended(&job).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    assert_eq!(done["progress"]["percent"], 100.0);
    assert_eq!(done["progress"]["snapshots_done"], 2);
    assert_eq!(done["progress"]["tiles_done"], done["progress"]["tiles_total"]);
    assert_eq!(done["progress"]["eta_seconds"], Value::Null);
    for snapshot in 0..2 {
        let base = format!("/v1/jobs/{job}/snapshots/{snapshot}");
        let frames = values(&app.get(&format!("{base}/exports/npy")).await.expect(200).bytes);
        assert_eq!(frames.len(), 4 * 48 * 64);
        let psnr = psnr(scene, snapshot, &frames);
        assert!(psnr > 24.0, "{psnr} dB");
        let listed = app.get(&base).await.expect(200).json();
        assert_eq!(listed["ready"], true);
        let files = listed["files"].as_array().unwrap();
        // The files are EXR and PNG of each frame, the stack, the array and the manifest.
        assert_eq!(files.len(), 4 + 4 + 4);
        for file in files {
            // Relative to the address of the snapshot.
            let href = format!("/v1/jobs/{job}/snapshots/{}", file["href"].as_str().unwrap());
            let answer = app.get(&href).await.expect(200);
            assert_eq!(answer.bytes.len() as u64, file["size"].as_u64().unwrap());
            assert_eq!(
                answer.header("etag"),
                format!("{}", json!(file["sha256"].as_str().unwrap()))
            );
        }
    }
    let manifest = app.get(&format!("/v1/jobs/{job}/exports/manifest")).await.expect(200);
    assert!(manifest.json().is_object());
    assert_eq!(manifest.header("content-type"), "application/json");
    // A succeeded job keeps uploads, prepared arrays and results, but no tiles.
    let text = String::from_utf8(app.get("/metrics").await.bytes).unwrap();
    assert!(text.contains("sci_recon_blobs 4\n"), "{text}");
    app.get("/readyz").await.expect(200);
    app.delete(&format!("/v1/jobs/{job}")).await.expect(204);
    assert_eq!(std::fs::read_dir(app.data().join("results")).unwrap().count(), 0);
}

#[tokio::test]
async fn results_are_downloaded_in_ranges() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv", "snapshots": 1});
    let job = app.submit(&body).await;
    app.ended(&job).await;
    let path = format!("/v1/jobs/{job}/snapshots/1/exports/frames/2.exr");
    app.get(&format!("/v1/jobs/{job}/snapshots/0/exports/frames/2.exr"))
        .await
        .problem(404, "not_found");
    let complete = app.get(&path).await.expect(200);
    assert_eq!(complete.header("content-type"), "image/x-exr");
    assert_eq!(complete.header("accept-ranges"), "bytes");
    assert_eq!(complete.bytes[..4], [0x76, 0x2f, 0x31, 0x01], "the magic number of EXR");
    let size = complete.bytes.len();
    let etag = complete.header("etag").to_owned();
    let ask = |headers: &[(&'static str, String)]| {
        let mut request = app.request(Method::GET, &path);
        for (name, value) in headers {
            request = request.header(*name, value);
        }
        app.send(request)
    };
    let head = app.send(app.request(Method::HEAD, &path)).await.expect(200);
    assert_eq!(head.header("content-length"), size.to_string());
    assert_eq!(head.header("etag"), etag);
    let part = ask(&[("range", "bytes=100-199".into())]).await.expect(206);
    assert_eq!(part.bytes, complete.bytes[100..200]);
    assert_eq!(part.header("content-range"), format!("bytes 100-199/{size}"));
    let tail = ask(&[("range", "bytes=-10".into()), ("if-range", etag.clone())]).await.expect(206);
    assert_eq!(tail.bytes, complete.bytes[size - 10..]);
    let stale = ask(&[("range", "bytes=-10".into()), ("if-range", "\"x\"".into())]).await;
    assert_eq!(stale.expect(200).bytes.len(), size);
    let beyond: Answer = ask(&[("range", format!("bytes={size}-"))]).await;
    beyond.problem(416, "range_not_satisfiable");
    assert_eq!(beyond.header("content-range"), format!("bytes */{size}"));
    ask(&[("if-none-match", etag.clone())]).await.expect(304);
    let first = ask(&[("range", format!("bytes=0-{}", size / 2))]).await.expect(206).bytes;
    let second = ask(&[("range", format!("bytes={}-", size / 2 + 1))]).await.expect(206).bytes;
    assert_eq!([first, second].concat(), complete.bytes);
}

/// A schedule that keeps a worker busy for seconds with each tile.
fn long_schedule() -> Value {
    json!({"stages": [{"prior": "tv", "iterations": 10_000, "tv_weight": 0.05, "tv_updates": 40}]})
}

#[tokio::test]
async fn cancel_stops_a_running_job_and_retry_resumes_it() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body =
        json!({"measurement": measurement, "algorithm": "gap-tv", "schedule": long_schedule()});
    let job = app.submit(&body).await;
    let running =
        app.when(&job, |job| job["progress"]["iterations_done"].as_u64().unwrap() > 0).await;
    assert_eq!(running["state"], "running");
    assert_eq!(running["progress"]["stage"], "tv");
    let (percent, eta) = (&running["progress"]["percent"], &running["progress"]["eta_seconds"]);
    assert!(percent.as_f64().unwrap() < 100.0 && eta.as_f64().unwrap() > 0.0, "{running:#}");
    app.delete(&format!("/v1/jobs/{job}")).await.problem(409, "illegal_state");
    let start = Instant::now();
    app.post(&format!("/v1/jobs/{job}/cancel"), &json!({})).await.expect(202);
    let cancelled = app.ended(&job).await;
    assert_eq!(cancelled["state"], "cancelled");
    assert!(start.elapsed() < Duration::from_secs(30), "{:?}", start.elapsed());
    app.post(&format!("/v1/jobs/{job}/retry"), &json!({})).await.expect(202);
    app.when(&job, |job| job["state"] == "running").await;
    app.post(&format!("/v1/jobs/{job}/cancel"), &json!({})).await.expect(202);
    app.ended(&job).await;
    app.delete(&format!("/v1/jobs/{job}")).await.expect(204);
}

#[tokio::test]
async fn a_stopped_server_returns_its_tasks_and_a_restart_continues() {
    let mut app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body =
        json!({"measurement": measurement, "algorithm": "gap-tv", "schedule": long_schedule()});
    let job = app.submit(&body).await;
    app.when(&job, |job| job["progress"]["tiles_running"] == 1).await;
    assert!(app.stop().success());
    app.restart();
    let resumed = app.when(&job, |job| job["progress"]["tiles_running"] == 1).await;
    assert_eq!(resumed["error"], Value::Null);
}

//! Results in the forms of other programs.

use reqwest::Method;
use serde_json::{Value, json};

use crate::app::{TestApp, id, judges};
use crate::samples::Scene;

/// A job of two snapshots that has succeeded: 50 snapshots a second, exposed for 16 ms.
async fn done(app: &TestApp) -> String {
    let calibration = id(&app.calibrate(Scene::SMALL.masks()).await.expect(201));
    let data = app.upload(Scene::SMALL.snapshots()).await;
    let body =
        json!({"calibration": calibration, "data": data, "camera_fps": 50, "exposure_s": 0.016});
    let measurement = id(&app.post("/v1/measurements", &body).await.expect(201));
    let job = app.submit(&json!({"measurement": measurement, "algorithm": "gap-tv"})).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    job
}

#[tokio::test]
async fn other_programs_read_all_exports_bit_for_bit() {
    let Some(python) = judges() else { return };
    let app = TestApp::with(&["--workers", "1"]).await;
    let token = app.token(&["create", "--lab", "a"]);
    app.sign_in(&token);
    let job = done(&app).await;
    let mut judge = tokio::process::Command::new(python);
    judge.arg("tests/judges/read_exports.py").arg(format!("http://{}", app.address()));
    judge.args([&job, "2"]).env("SCI_RECON_TOKEN", &token);
    let output = judge.output().await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let told: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(told["intervals"]["/snapshots/1"], json!([0.004, 0.004]));
    // Between the snapshots the camera pauses.
    assert_eq!(told["intervals"]["/sequence"], json!([null, null]));
    assert_eq!(told["members"], 2 * 11 + 1);
}

#[tokio::test]
async fn exports_are_there_with_the_results_and_are_cached_and_cut_like_files() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let stuck = json!({"measurement": measurement, "algorithm": "gap-tv", "schedule": {"stages": [
        {"prior": "tv", "iterations": 10_000, "tv_weight": 0.05, "tv_updates": 40}]}});
    let stuck = app.submit(&stuck).await;
    let paths = ["sequence/stack.tif", "sequence/frames.npy", "results.zip"];
    let zarr = ["sequence/frames.zarr/zarr.json", "snapshots/0/frames.zarr/c/0/0/0"];
    for path in paths.iter().chain(&zarr) {
        app.get(&format!("/v1/jobs/{stuck}/{path}")).await.problem(404, "not_ready");
    }
    app.post(&format!("/v1/jobs/{stuck}/cancel"), &json!({})).await.expect(202);
    let job = done(&app).await;
    app.get(&format!("/v1/jobs/{job}/snapshots/2/stack.tif")).await.problem(404, "not_found");
    for chunk in ["c/8/0/0", "c/-1/0/0", "c/0/1/0", ".zarray"] {
        let path = format!("/v1/jobs/{job}/sequence/frames.zarr/{chunk}");
        app.get(&path).await.problem(404, "not_found");
    }
    for path in paths.iter().chain(&zarr[1..]).chain(&["snapshots/1/stack.tif"]) {
        let path = format!("/v1/jobs/{job}/{path}");
        let whole = app.get(&path).await.expect(200);
        let (size, etag) = (whole.bytes.len(), whole.header("etag").to_owned());
        let head = app.send(app.request(Method::HEAD, &path)).await.expect(200);
        assert_eq!(
            (head.header("content-length"), head.header("etag")),
            (&*size.to_string(), &*etag)
        );
        let known = app.request(Method::GET, &path).header("if-none-match", &etag);
        app.send(known).await.expect(304);
        // In pieces that begin and end anywhere.
        let mut joined = Vec::new();
        while joined.len() < size {
            let (first, last) = (joined.len(), joined.len() + size / 7 + 13);
            let part =
                app.request(Method::GET, &path).header("range", format!("bytes={first}-{last}"));
            joined.extend(app.send(part.header("if-range", &etag)).await.expect(206).bytes);
        }
        assert!(joined == whole.bytes, "{path}");
    }
    // The same results give the same bytes.
    let archive = app.get(&format!("/v1/jobs/{job}/results.zip")).await.bytes;
    assert_eq!(archive, app.get(&format!("/v1/jobs/{job}/results.zip")).await.bytes);

    // What is damaged is not sent.
    let results = app.data().join("results").join(&job);
    let array = results.join("snapshot_0001/frames.npy");
    let mut bytes = std::fs::read(&array).unwrap();
    let last = bytes.len() - 1;
    bytes[last] ^= 1;
    std::fs::write(&array, bytes).unwrap();
    for path in ["snapshots/1/stack.tif", "snapshots/1/frames.zarr/c/3/0/0"] {
        app.get(&format!("/v1/jobs/{job}/{path}")).await.problem(500, "file_damaged");
    }
    app.get(&format!("/v1/jobs/{job}/snapshots/0/stack.tif")).await.expect(200);
    let cut =
        app.request(Method::GET, &format!("/v1/jobs/{job}/results.zip")).send().await.unwrap();
    assert!(cut.bytes().await.is_err(), "the archive breaks off before the damaged file");
}

//! Jobs with the deep denoiser, where libonnxruntime is available (`ORT_DYLIB_PATH`).

use std::path::Path;

use serde_json::json;

use crate::app::{TestApp, has_onnxruntime};
use crate::faults::sha256;
use crate::pipeline::values;
use crate::samples::Scene;

#[tokio::test]
async fn a_deep_job_runs_and_records_model_and_provider() {
    if !has_onnxruntime() {
        return;
    }
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({
        "measurement": measurement,
        "algorithm": "pnp-tv-fastdvdnet",
        "snapshots": 0,
        "schedule": {"stages": [
            {"prior": "tv", "iterations": 20, "tv_weight": 0.1},
            {"prior": "tv+fastdvdnet", "iterations": 3, "sigma": [0.2, 0.05], "tv_weight": 0.02},
        ]},
    });
    let job = app.submit(&body).await;
    let done = app.ended(&job).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    assert_eq!(done["progress"]["passes_done"], 3);
    let base = format!("/v1/jobs/{job}/snapshots/0");
    let manifest =
        app.get(&format!("{base}/exports/manifest")).await.expect(200).json().to_string();
    assert!(manifest.contains("fastdvdnet") && manifest.contains("CPU"), "{manifest}");
    let frames = values(&app.get(&format!("{base}/exports/npy")).await.expect(200).bytes);
    assert!(frames.iter().all(|value| value.is_finite()));
}

#[tokio::test]
async fn without_the_library_a_deep_job_is_rejected() {
    let app = TestApp::with(&["--workers", "1", "--onnxruntime", "/nowhere/lib.so"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "pnp-tv-fastdvdnet"});
    let detail = app.post("/v1/jobs", &body).await.problem(422, "invalid_request");
    assert!(detail.contains("lib.so") && !detail.contains("/nowhere"), "{detail}");
    assert!(
        detail.contains("scripts/fetch") && detail.contains("gap-tv3d needs no network"),
        "{detail}"
    );
    // Jobs without a network still run.
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    assert_eq!(app.ended(&app.submit(&body).await).await["state"], "succeeded");
}

/// Copies the float network of the source tree into `folder/fastdvdnet-gray`, with a comment, which changes its hash.
fn commented_network(folder: &Path) {
    let name = "fastdvdnet-gray";
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("models").join(name);
    std::fs::create_dir_all(folder.join(name)).unwrap();
    for file in ["stage1.onnx", "stage2.onnx"] {
        let mut content = std::fs::read(source.join(file)).unwrap();
        // Field 6 of an ONNX model is its documentation.
        content.extend(b"\x32\x04mine");
        std::fs::write(folder.join(name).join(file), content).unwrap();
    }
}

#[tokio::test]
async fn a_folder_of_networks_replaces_the_embedded_ones_in_jobs() {
    if !has_onnxruntime() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let models = folder.path().to_str().unwrap();
    let empty = TestApp::try_in_environment(&["--workers", "1", "--models", models], &[]).await;
    assert!(empty.is_none(), "a folder without networks is refused");

    commented_network(folder.path());
    let mut app = TestApp::with(&["--workers", "1", "--models", models]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({
        "measurement": measurement,
        "algorithm": "pnp-tv-fastdvdnet",
        "snapshots": 0,
        "schedule": {"stages": [
            {"prior": "tv", "iterations": 5, "tv_weight": 0.1},
            {"prior": "fastdvdnet-int8", "iterations": 1, "sigma": [0.1, 0.1]},
        ]},
    });
    let job = app.submit(&body).await;
    let done = app.ended(&job).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    // The folder has no 8-bit version.
    assert_eq!(done["schedule"]["stages"][1]["prior"], "fastdvdnet");
    let manifest = format!("/v1/jobs/{job}/snapshots/0/exports/manifest");
    let manifest = app.get(&manifest).await.expect(200).json();
    let model = &manifest["content"]["models"][0];
    assert_eq!(model["name"], "fastdvdnet-gray");
    let files = ["stage1.onnx", "stage2.onnx"];
    let files =
        files.map(|file| std::fs::read(folder.path().join("fastdvdnet-gray").join(file)).unwrap());
    assert_eq!(model["sha256"], sha256(&files.concat()));
    // The quality model is fitted to the embedded network.
    assert!(manifest["content"]["assessment"].is_null(), "{manifest:#}");

    // A job of this network is not continued with another one.
    app.restart_with(&["--workers", "0", "--models", models]);
    let job = app.submit(&body).await;
    app.restart_with(&["--workers", "1"]);
    let failed = app.ended(&job).await;
    assert_eq!(failed["state"], "failed", "{failed:#}");
    let detail = failed["problem"]["detail"].as_str().unwrap();
    assert!(detail.contains("(fastdvdnet-gray)") && detail.contains("--models"), "{detail}");
}

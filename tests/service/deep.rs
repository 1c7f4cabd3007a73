//! Jobs with the deep denoiser, where libonnxruntime is available (`ORT_DYLIB_PATH`).

use serde_json::json;

use crate::app::{TestApp, has_onnxruntime};
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

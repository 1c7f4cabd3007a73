//! Adaptive schedules, which decide how many iterations to run.

use serde_json::{Value, json};

use crate::app::TestApp;
use crate::faults::results;
use crate::samples::Scene;

#[tokio::test]
async fn an_adaptive_schedule_is_decided_once_and_can_be_repeated() {
    let app = TestApp::with(&["--workers", "2"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let adaptive = json!({"adaptive": true, "stages": [
        {"prior": "tv", "iterations": 20, "tv_weight": 0.1, "temporal_weight": 0.004},
        {"prior": "nonlocal", "iterations": 40, "sigma": [0.2, 0.02], "memory": 0.6},
    ]});
    let (first, content) = run(&app, &measurement, &adaptive).await;
    let stages = content["pilot"]["stages"].as_array().unwrap();
    let tv = &stages[0]["stage"];
    assert_eq!((&stages[0]["end"], &tv["iterations"]), (&json!("fixed"), &json!(20)));
    let iterations = stages[1]["stage"]["iterations"].as_u64().unwrap();
    assert!(iterations > 0, "the stage has run: {stages:#?}");
    let temporal = tv["temporal_weight"].as_f64().unwrap() as f32;
    let planned = stages[0]["planned"]["temporal_weight"].as_f64().unwrap() as f32;
    assert_eq!(
        (planned, temporal),
        (0.004, 0.004),
        "temporal weight is kept, because the scene moves slowly"
    );
    let decided = content["schedule"]["stages"][0]["temporal_weight"].as_f64();
    assert_eq!(
        decided.map(|weight| weight as f32),
        Some(temporal),
        "the schedule has the same weight"
    );
    assert!(stages[0]["error_after"].as_f64() < stages[0]["error_before"].as_f64());
    let decided = &content["schedule"];
    assert_eq!(decided["adaptive"], false);
    assert_eq!(decided["stages"][1]["iterations"], iterations);

    let (second, content) = run(&app, &measurement, decided).await;
    assert_eq!(content["pilot"], Value::Null);
    assert!(first == second, "the schedule in the manifest gives the same frames");
}

/// The hashes of all result files, and the content of the job's manifest.
async fn run(
    app: &TestApp,
    measurement: &str,
    schedule: &Value,
) -> (std::collections::BTreeMap<String, String>, Value) {
    let body = json!({"measurement": measurement, "algorithm": "pnp-nonlocal",
        "schedule": schedule, "tile": {"size": 32, "overlap": 8}, "sequence": "separate"});
    let job = app.submit(&body).await;
    let ended = app.ended(&job).await;
    assert_eq!(ended["state"], "succeeded", "{ended:#}");
    let manifest = app.get(&format!("/v1/jobs/{job}/exports/manifest")).await.expect(200).json();
    let content = manifest["content"].clone();
    let stages = content["schedule"]["stages"].as_array().unwrap();
    let decided: u64 = stages.iter().filter_map(|stage| stage["iterations"].as_u64()).sum();
    let last = app.get(&format!("/view/jobs/{job}/snapshots/0/tiles/0/history")).await.expect(200);
    let last = last.json()["points"].as_array().unwrap().last().unwrap()[0].clone();
    assert_eq!(last, decided, "the tiles run the iterations of the schedule");
    let mut files = results(app, &job).await;
    // A fixed schedule has no pilot, which refines the expected error.
    files.retain(|name, _| !name.ends_with("error.npy"));
    (files, content)
}

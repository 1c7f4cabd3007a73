//! Consecutive snapshots: joint reconstruction, blending in time, and killed workers.

use std::time::Duration;

use serde_json::{Value, json};

use crate::app::{TestApp, id};
use crate::faults::results_of;
use crate::samples::Scene;

const SCENE: Scene = Scene { frames: 4, height: 48, width: 64, snapshots: 7 };

/// A job with two tiles in each of two runs.
fn job(measurement: &str, iterations: u32) -> Value {
    json!({
        "measurement": measurement,
        "algorithm": "pnp-nonlocal",
        "tile": {"size": 40, "overlap": 8},
        "schedule": {"stages": [
            {"prior": "tv", "iterations": 20, "tv_weight": 0.1, "temporal_weight": 0.004},
            {"prior": "nonlocal", "iterations": iterations, "sigma": [0.2, 0.02], "memory": 0.6},
        ]},
    })
}

async fn done(app: &TestApp, body: &Value) -> (String, Value) {
    let job = app.submit(body).await;
    let ended = app.ended(&job).await;
    assert_eq!(ended["state"], "succeeded", "{ended:#}");
    let manifest = app.get(&format!("/v1/jobs/{job}/exports/manifest")).await.expect(200).json();
    (job, manifest["content"].clone())
}

#[tokio::test]
async fn a_sequence_is_reconstructed_jointly_and_blended() {
    let app = TestApp::with(&["--workers", "2"]).await;
    let (calibration, measurement) = app.scene(&SCENE).await;
    let path = format!("/v1/measurements/{measurement}");
    assert_eq!(app.get(&path).await.expect(200).json()["sequence"], "contiguous");
    let (together, content) = done(&app, &job(&measurement, 6)).await;
    assert_eq!(content["runs"], json!([[0, 3], [3, 6]]));
    let joints = content["pilot"]["joints"].as_array().unwrap();
    assert_eq!(joints.len(), 6, "{joints:#?}");
    assert!(joints.iter().any(|joint| joint["together"] == true), "{joints:#?}");
    let shown = app.get(&format!("/v1/jobs/{together}")).await.expect(200).json();
    assert_eq!((&shown["sequence"], &shown["run"]["length"]), (&json!("contiguous"), &json!(5)));
    let tiles =
        app.get(&format!("/view/jobs/{together}/snapshots/3/tiles")).await.expect(200).json();
    let tiles = tiles["items"].as_array().unwrap();
    let runs: Vec<_> = tiles.iter().map(|tile| &tile["snapshots"]["first"]).collect();
    assert_eq!(runs.len() % 2, 0);
    assert_eq!((runs[0], runs[runs.len() - 1]), (&json!(0), &json!(3)));

    // The result is independent of the number of workers.
    let alone = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = alone.scene(&SCENE).await;
    let (again, _) = done(&alone, &job(&measurement, 6)).await;
    let expected = results_of(&app, &together, 7).await;
    assert_eq!(results_of(&alone, &again, 7).await, expected);

    // Separate snapshots equal the ones reconstructed one by one, and differ from the joint result.
    let mut separate = job(&measurement, 6);
    separate["sequence"] = json!("separate");
    let (each, content) = done(&alone, &separate).await;
    assert_eq!((&content["pilot"], &content["runs"][6]), (&Value::Null, &json!([6, 6])));
    let each = results_of(&alone, &each, 7).await;
    assert_ne!(each, expected);
    let mut single_body = job(&measurement, 6);
    single_body["snapshots"] = json!(0);
    let (single_body, _) = done(&alone, &single_body).await;
    let single_body = results_of(&alone, &single_body, 1).await;
    // EXR and PNG files contain the white level of the whole job.
    let files = single_body.iter().filter(|(name, _)| name.ends_with(".npy"));
    let different: Vec<_> = files.filter(|(name, hash)| each.get(*name) != Some(*hash)).collect();
    assert!(different.is_empty(), "{different:?}");

    // The camera's times show a pause.
    let data = app.upload(SCENE.snapshots()).await;
    let body =
        json!({"calibration": calibration, "data": data, "camera_fps": 10, "exposure_s": 0.02});
    let paused = app.post("/v1/measurements", &body).await.expect(201).json();
    assert_eq!(paused["sequence"], "separate");
}

#[tokio::test]
async fn a_cut_is_detected_and_recorded_in_the_manifest() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let calibration = id(&app.calibrate(SCENE.masks()).await);
    let measurement = id(&app.measure(&calibration, SCENE.with_a_cut(3)).await);
    let (_, content) = done(&app, &job(&measurement, 12)).await;
    let joints = content["pilot"]["joints"].as_array().unwrap();
    assert_eq!((&joints[2]["after"], &joints[2]["together"]), (&json!(2), &json!(false)));
}

#[tokio::test]
async fn kills_do_not_change_a_sequence() {
    let mut app = TestApp::with(&["--workers", "2"]).await;
    let (_, measurement) = app.scene(&SCENE).await;
    let body = job(&measurement, 40);
    let (undisturbed, _) = done(&app, &body).await;
    let expected = results_of(&app, &undisturbed, 7).await;
    let disturbed = app.submit(&body).await;
    for kill in 0..4 {
        tokio::time::sleep(Duration::from_millis(400)).await;
        if kill % 2 == 0 {
            app.kill_worker(kill);
        } else {
            app.restart();
        }
    }
    assert_eq!(app.ended(&disturbed).await["state"], "succeeded");
    assert_eq!(results_of(&app, &disturbed, 7).await, expected);
}

//! Networks on other machines: those that the program includes, and a lab's network, which is sent
//! by its hash.

use serde_json::json;

use super::nodes::Nats;
use super::rounds::rounds;
use super::{worker, workers};
use crate::app::{TestApp, has_onnxruntime};
use crate::faults::results_of;
use crate::learned;
use crate::samples::Scene;

#[tokio::test]
async fn networks_give_the_same_bytes_on_other_machines() {
    if !has_onnxruntime() {
        return;
    }
    let Some(nats) = Nats::start(1) else { return };
    let app = TestApp::with(&["--workers", "2"]).await;
    let (calibration, measurement) = app.scene(&Scene::SMALL).await;
    // The job has two tiles. It runs a few passes here, and the default schedule with its pilot in `make cluster`.
    let mut deep = json!({
        "measurement": measurement, "algorithm": "pnp-tv-fastdvdnet", "snapshots": 0,
        "tile": {"size": 48, "overlap": 16},
    });
    if rounds().is_none() {
        deep["schedule"] = json!({"stages": [
            {"prior": "tv", "iterations": 20, "tv_weight": 0.1},
            {"prior": "tv+fastdvdnet", "iterations": 3, "sigma": [0.2, 0.05], "tv_weight": 0.02}]});
    }
    let mut bodies = vec![deep];
    let mut own_model = None;
    if let Some(python) = learned::python() {
        let folder = tempfile::tempdir().unwrap();
        let file = learned::train(&python, folder.path(), Scene::SMALL, "free");
        let model = learned::register(&app, &calibration, &file).await.expect(201).json();
        bodies.push(json!({
            "measurement": measurement, "algorithm": "learned", "model": model["id"], "snapshots": 0,
            "tile": {"size": 32, "overlap": 16},
        }));
        own_model = Some(model["file"].as_str().unwrap().to_owned());
    }
    let run = async |app: &TestApp| {
        let mut hashes = Vec::new();
        for body in &bodies {
            let job = app.submit(body).await;
            let done = app.ended(&job).await;
            assert_eq!(done["state"], "succeeded", "{done:#}");
            hashes.push(results_of(app, &job, 1).await);
        }
        hashes
    };
    let expected = run(&app).await;
    let url = nats.url();
    let app = app.again(&["--workers", "0", "--nats", &url, "--ack-wait", "5"]).await;
    let both = [worker(&nats, &[]), worker(&nats, &[])];
    assert_eq!(run(&app).await, expected);
    assert_eq!(workers(&app).await.len(), 2);
    if let Some(sha256) = own_model {
        let cached = |folder: &std::path::Path| folder.join("cache").join(&sha256).exists();
        assert!(
            both.iter().any(|worker| cached(worker.folder.path())),
            "the network is sent by its hash"
        );
    }
    nats.emptied().await;
}

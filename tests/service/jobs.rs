//! Jobs without a worker: submission, watching, cancellation, deletion.

use reqwest::Method;
use serde_json::{Value, json};

use crate::app::{Answer, TestApp, id};
use crate::samples::Scene;

async fn with_key(app: &TestApp, key: &str, body: &Value) -> Answer {
    let request = app.request(Method::POST, "/v1/jobs").header("idempotency-key", key);
    app.send(request.json(body)).await
}

#[tokio::test]
async fn an_accepted_job_has_all_defaults_filled_in() {
    let app = TestApp::start().await;
    let (calibration, measurement) = app.scene(&Scene::SMALL).await;
    let body =
        json!({"measurement": measurement, "algorithm": "pnp-tv-fastdvdnet", "label": "run 1"});
    let created = app.post("/v1/jobs", &body).await.expect(201);
    let job = created.json();
    assert_eq!(created.header("location"), format!("/v1/jobs/{}", job["id"].as_str().unwrap()));
    assert_eq!(job["state"], "queued");
    assert_eq!(job["calibration"], calibration);
    let shape = json!({"frames": 4, "height": 48, "width": 64, "snapshots": 2, "mosaic": null});
    assert_eq!(job["shape"], shape);
    assert_eq!(job["snapshots"], json!({"first": 0, "count": 2}));
    assert_eq!(job["progress"]["tiles_total"], 1, "both snapshots are reconstructed together");
    assert_eq!(job["progress"]["stage"], "waiting");
    assert_eq!(job["progress"]["eta_seconds"], Value::Null, "no worker lives");
    let algorithms = app.get("/v1/algorithms").await.expect(200).json();
    let items = algorithms["items"].as_array().unwrap();
    let named = items.iter().find(|item| item["name"] == job["algorithm"]).unwrap();
    assert_eq!(job["schedule"], named["schedule"]);
    let snapshot = format!("/v1/jobs/{}/snapshots/1", id(&created));
    assert_eq!(app.get(&snapshot).await.expect(200).json()["ready"], false);
    for file in ["frames/1.exr", "frames/4.png", "exr", "npy", "manifest"] {
        app.get(&format!("{snapshot}/exports/{file}")).await.problem(404, "not_ready");
    }
    for file in ["frames/5.exr", "frames/0.exr", "frames/1.tiff", "frames/..%2F..%2F1.exr"] {
        app.get(&format!("{snapshot}/exports/{file}")).await.problem(404, "not_found");
    }
    let beyond = format!("/v1/jobs/{}/snapshots/2/exports/exr", id(&created));
    app.get(&beyond).await.problem(404, "not_found");
}

#[tokio::test]
async fn invalid_requests_are_rejected_with_all_errors() {
    let app = TestApp::start().await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({
        "measurement": measurement,
        "algorithm": "gap-tv",
        "snapshots": [1, 2],
        "tile": {"size": 64, "overlap": 60},
        "schedule": {"stages": [{"prior": "tv", "iterations": 0, "tv_weight": 0.1}]},
        "priority": 1000,
    });
    let refused = app.post("/v1/jobs", &body).await;
    refused.problem(422, "invalid_request");
    let errors = refused.json()["errors"].clone();
    let pointers: Vec<&str> =
        errors.as_array().unwrap().iter().map(|error| error["pointer"].as_str().unwrap()).collect();
    assert_eq!(pointers, ["/snapshots", "/schedule/stages/0/iterations", "/tile", "/priority"]);
    for (field, value, pointer) in [
        ("algorithm", json!("magic"), "/algorithm"),
        ("snapshots", json!("some"), "/snapshots"),
        ("schedule", json!({"stages": [{"prior": "tv", "steps": 5}]}), "/schedule/stages/0/steps"),
        ("measurement", json!("019ae4f0-6e5c-7c3a-9d1e-0d5f0a1b2c3d"), "/measurement"),
    ] {
        let mut body = json!({"measurement": measurement, "algorithm": "gap-tv"});
        body[field] = value;
        let refused = app.post("/v1/jobs", &body).await;
        refused.problem(422, "invalid_request");
        assert_eq!(refused.json()["pointer"], pointer, "{body}");
    }
    assert_eq!(app.get("/v1/jobs").await.json()["items"], json!([]));
}

#[tokio::test]
async fn a_key_belongs_to_one_job() {
    let app = TestApp::start().await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    let first = with_key(&app, "run-1", &body).await.expect(201);
    let repeated = with_key(&app, "run-1", &body).await.expect(200);
    assert_eq!(id(&first), id(&repeated));
    assert_eq!(first.header("location"), repeated.header("location"));
    // Defaults that are written out do not make another request.
    let mut spelled = body.clone();
    spelled["snapshots"] = json!("all");
    spelled["priority"] = json!(0);
    assert_eq!(id(&with_key(&app, "run-1", &spelled).await.expect(200)), id(&first));
    let mut other = body.clone();
    other["priority"] = json!(1);
    let refused = with_key(&app, "run-1", &other).await;
    let detail = refused.problem(422, "idempotency_key_reused");
    assert!(detail.contains(&id(&first)), "{detail}");
    assert_ne!(id(&with_key(&app, "run-2", &body).await.expect(201)), id(&first));
    assert_ne!(id(&app.post("/v1/jobs", &body).await.expect(201)), id(&first));
    with_key(&app, &"k".repeat(256), &body).await.problem(400, "malformed_request");
}

#[tokio::test]
async fn ten_concurrent_requests_with_one_key_create_one_job() {
    let app = TestApp::start().await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    let answers = futures_util::future::join_all((0..10).map(|_| with_key(&app, "k", &body))).await;
    let created = answers.iter().filter(|answer| answer.status == 201).count();
    assert_eq!(created, 1);
    assert!(answers.iter().all(|answer| id(answer) == id(&answers[0])));
}

#[tokio::test]
async fn lists_are_filtered_and_paged() {
    let app = TestApp::start().await;
    let (calibration, measurement) = app.scene(&Scene::SMALL).await;
    let mut ids = Vec::new();
    for number in 0..5 {
        let label = format!("run {}", number % 2);
        let body = json!({"measurement": measurement, "algorithm": "gap-tv", "label": label});
        ids.push(id(&app.post("/v1/jobs", &body).await.expect(201)));
    }
    ids.reverse();
    let (mut found_ids, mut path) = (Vec::new(), "/v1/jobs?limit=2".to_owned());
    loop {
        let page = app.get(&path).await.expect(200).json();
        for item in page["items"].as_array().unwrap() {
            found_ids.push(item["id"].as_str().unwrap().to_owned());
        }
        let Some(cursor) = page["next_cursor"].as_str() else { break };
        path = format!("/v1/jobs?limit=2&cursor={cursor}");
    }
    assert_eq!(found_ids, ids);
    app.post(&format!("/v1/jobs/{}/cancel", ids[0]), &json!({})).await.expect(202);
    for (query, count) in [
        ("state=queued", 4),
        ("state=cancelled", 1),
        ("state=running", 0),
        ("label=run%200", 3),
        ("label=run+1&state=queued", 2),
        ("label=run", 0),
        (&format!("calibration={calibration}"), 5),
        (&format!("measurement={measurement}&limit=3"), 3),
        ("calibration=019ae4f0-6e5c-7c3a-9d1e-0d5f0a1b2c3d", 0),
    ] {
        let page = app.get(&format!("/v1/jobs?{query}")).await.expect(200).json();
        assert_eq!(page["items"].as_array().unwrap().len(), count, "{query}");
    }
    let list = app.get("/v1/calibrations").await.expect(200).json();
    assert_eq!(list["items"][0], app.get(&format!("/v1/calibrations/{calibration}")).await.json());
    let list = app.get(&format!("/v1/measurements?calibration={calibration}")).await.expect(200);
    assert_eq!(list.json()["items"].as_array().unwrap().len(), 1);
}

#[tokio::test]
async fn watching_an_unchanged_job_is_cheap() {
    let app = TestApp::start().await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    let path = format!("/v1/jobs/{}", id(&app.post("/v1/jobs", &body).await.expect(201)));
    let etag = app.get(&path).await.expect(200).header("etag").to_owned();
    assert_eq!(etag.len(), 66, "strong and a hash: {etag}");
    let ask = || app.request(Method::GET, &path).header("if-none-match", &etag);
    let same = app.send(ask()).await.expect(304);
    assert!(same.bytes.is_empty());
    assert_eq!(same.header("etag"), etag);
    app.post(&format!("{path}/cancel"), &json!({})).await.expect(202);
    let changed = app.send(ask()).await.expect(200);
    assert_ne!(changed.header("etag"), etag);
    assert_eq!(changed.json()["state"], "cancelled");
}

#[tokio::test]
async fn cancel_retry_and_delete_follow_the_states() {
    let app = TestApp::start().await;
    let (calibration, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    let path = format!("/v1/jobs/{}", id(&app.post("/v1/jobs", &body).await.expect(201)));
    let act = |action: &'static str| {
        let path = format!("{path}/{action}");
        let app = &app;
        async move { app.send(app.request(Method::POST, &path)).await }
    };
    act("retry").await.problem(409, "illegal_state");
    app.delete(&path).await.problem(409, "illegal_state");
    assert_eq!(act("cancel").await.expect(202).json()["state"], "cancelled");
    assert_eq!(act("cancel").await.expect(202).json()["state"], "cancelled");
    assert_eq!(act("retry").await.expect(202).json()["state"], "queued");
    assert_eq!(act("cancel").await.expect(202).json()["state"], "cancelled");
    // Dependent resources must be deleted first.
    let (calibration, measurement) =
        (format!("/v1/calibrations/{calibration}"), format!("/v1/measurements/{measurement}"));
    app.delete(&calibration).await.problem(409, "in_use");
    app.delete(&measurement).await.problem(409, "in_use");
    for path in [&path, &measurement, &calibration] {
        assert!(app.delete(path).await.expect(204).bytes.is_empty());
        app.delete(path).await.problem(404, "not_found");
        app.get(path).await.problem(404, "not_found");
    }
    act("cancel").await.problem(404, "not_found");
}

#[tokio::test]
async fn accepted_resources_survive_a_kill_of_the_server() {
    let mut app = TestApp::start().await;
    let (calibration, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    let before = with_key(&app, "k", &body).await.expect(201).json();
    app.restart();
    let path = format!("/v1/jobs/{}", before["id"].as_str().unwrap());
    assert_eq!(app.get(&path).await.expect(200).json(), before);
    assert_eq!(with_key(&app, "k", &body).await.expect(200).json()["id"], before["id"]);
    app.get(&format!("/v1/calibrations/{calibration}")).await.expect(200);
}

#[tokio::test]
async fn a_job_that_needs_too_much_memory_is_rejected_with_both_sizes() {
    let app = TestApp::with(&["--workers", "0", "--worker-memory-bytes", "400000000"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let mut body = json!({"measurement": measurement, "algorithm": "pnp-tv-fastdvdnet"});
    let refused = app.post("/v1/jobs", &body).await;
    let detail = refused.problem(422, "invalid_request");
    assert!(detail.contains("381 MiB") && detail.contains("320x320"), "{detail}");
    assert_eq!(refused.json()["pointer"], "/tile/size");
    body["algorithm"] = json!("gap-tv");
    app.post("/v1/jobs", &body).await.expect(201);
}

//! Checks that outlast the requests for calibrations and measurements.

use std::time::Duration;

use reqwest::Method;
use serde_json::{Value, json};

use crate::app::{Answer, TestApp, id};
use crate::samples::{Scene, constant, npy_header};

const CALIBRATIONS: &str = "/v1/calibrations";
const MEASUREMENTS: &str = "/v1/measurements";

/// Masks of 32 MB with half of the pixels open. Their check takes several seconds.
fn large_masks() -> Vec<u8> {
    let mut file = npy_header("|u1", &[64, 512, 1024]);
    let mut state = 1_u64;
    file.extend((0..32 << 20).map(|_| {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        if state >> 63 == 1 { 255 } else { 0 }
    }));
    file
}

impl TestApp {
    /// Sends a request without waiting for its check.
    async fn ask(&self, path: &str, body: &Value, key: &str) -> Answer {
        let request = self.request(Method::POST, path).json(body);
        self.send(request.header("Prefer", "respond-async").header("Idempotency-Key", key)).await
    }

    /// Waits for the end of a check, and returns the resource.
    async fn checked(&self, path: &str, id: &str) -> Value {
        for _ in 0..6 {
            let shown = self.get(&format!("{path}/{id}?wait=20")).await.expect(200).json();
            if shown["state"] != "preparing" {
                return shown;
            }
        }
        panic!("{path}/{id} is still checked");
    }
}

#[tokio::test]
async fn a_long_check_continues_after_the_answer() {
    let app = TestApp::start().await;
    let masks = app.upload(large_masks()).await;
    let body = json!({"masks": masks, "name": "before"});
    let accepted = app.ask(CALIBRATIONS, &body, "k").await.expect(202);
    let calibration = id(&accepted);
    assert_eq!(accepted.header("location"), format!("{CALIBRATIONS}/{calibration}"));
    let shown = accepted.json();
    assert_eq!((&shown["state"], &shown["frames"]), (&json!("preparing"), &Value::Null));
    // Uses the key, dependent resources, the file, the name and the list during the check.
    let repeated = app.ask(CALIBRATIONS, &body, "k").await.expect(202);
    assert_eq!(id(&repeated), calibration);
    let other = app.ask(CALIBRATIONS, &json!({"masks": masks}), "k").await;
    other.problem(422, "idempotency_key_reused");
    let data = app.upload(constant(&[1, 512, 1024], 8.0)).await;
    let measurement = json!({"calibration": calibration, "data": data});
    let early = app.post(MEASUREMENTS, &measurement).await;
    early.problem(409, "calibration_not_ready");
    assert_eq!(early.json()["retryable"], true);
    app.delete(&format!("/v1/blobs/{masks}")).await.problem(409, "in_use");
    let path = format!("{CALIBRATIONS}/{calibration}");
    let named = app.request(Method::PATCH, &path).json(&json!({"name": "after"}));
    assert_eq!(app.send(named).await.expect(200).json()["state"], "preparing");
    let listed = app.get(CALIBRATIONS).await.expect(200).json();
    assert_eq!(listed["items"][0]["state"], "preparing", "the check is too short for this test");

    let shown = app.checked(CALIBRATIONS, &calibration).await;
    assert_eq!((&shown["state"], &shown["frames"]), (&json!("ready"), &json!(64)));
    assert_eq!((&shown["name"], &shown["problem"]), (&json!("after"), &Value::Null));
    assert_eq!(shown["created_at"], accepted.json()["created_at"]);
    let listed = app.get(CALIBRATIONS).await.expect(200).json();
    assert_eq!(listed["items"].as_array().unwrap().len(), 1);
    assert_eq!(id(&app.ask(CALIBRATIONS, &body, "k").await.expect(200)), calibration);

    // A measurement is checked in the same way.
    let accepted = app.ask(MEASUREMENTS, &measurement, "k").await.expect(202);
    assert_eq!(accepted.json()["state"], "preparing");
    let job = json!({"measurement": id(&accepted), "algorithm": "gap-tv"});
    let early = app.post("/v1/jobs", &job).await;
    early.problem(409, "measurement_not_ready");
    assert_eq!(early.json()["retryable"], true);
    app.delete(&path).await.problem(409, "in_use");
    let listed = app.get(&format!("{MEASUREMENTS}?calibration={calibration}")).await.expect(200);
    assert_eq!(listed.json()["items"][0]["id"], accepted.json()["id"]);
    let shown = app.checked(MEASUREMENTS, &id(&accepted)).await;
    assert_eq!((&shown["state"], &shown["snapshots"]), (&json!("ready"), &json!(1)));
    app.post("/v1/jobs", &job).await.expect(201);
    assert_eq!(id(&app.ask(MEASUREMENTS, &measurement, "k").await.expect(200)), id(&accepted));
}

#[tokio::test]
async fn a_failed_check_has_the_same_problem_as_a_direct_answer() {
    let app = TestApp::start().await;
    let masks = app.upload(constant(&[4, 48, 64], 3.0)).await;
    let body = json!({"masks": masks});
    let direct = app.post(CALIBRATIONS, &body).await;
    direct.problem(422, "invalid_content");
    let accepted = app.ask(CALIBRATIONS, &body, "k").await.expect(202);
    let failed = app.checked(CALIBRATIONS, &id(&accepted)).await;
    assert_eq!((&failed["state"], &failed["error"]), (&json!("failed"), &direct.json()["detail"]));
    let same = |problem: &Value| {
        let mut problem = problem.clone();
        let instance = problem.as_object_mut().unwrap().remove("instance");
        (problem, instance.unwrap().as_str().unwrap().to_owned())
    };
    let (later, request) = same(&failed["problem"]);
    assert_eq!(later, same(&direct.json()).0);
    assert_eq!(request, format!("urn:sci-recon:request:{}", accepted.header("x-request-id")));
    // Waiting for a failed calibration is useless.
    let data = app.upload(constant(&[48, 64], 1.0)).await;
    let needs = json!({"calibration": id(&accepted), "data": data});
    let refused = app.post(MEASUREMENTS, &needs).await;
    refused.problem(409, "calibration_not_ready");
    assert_eq!(refused.json()["retryable"], false);
    // The key and the file can be used again.
    let repeated = app.ask(CALIBRATIONS, &body, "k").await.expect(202);
    assert_ne!(id(&repeated), id(&accepted));
    app.checked(CALIBRATIONS, &id(&repeated)).await;
    app.delete(&format!("/v1/blobs/{masks}")).await.expect(204);
    app.delete(&format!("{CALIBRATIONS}/{}", id(&accepted))).await.expect(204);
    app.get(&format!("{CALIBRATIONS}/{}", id(&accepted))).await.problem(404, "not_found");

    let calibration = id(&app.calibrate(Scene::SMALL.masks()).await.expect(201));
    let data = app.upload(constant(&[48, 48], 1.0)).await;
    let body = json!({"calibration": calibration, "data": data});
    let direct = app.post(MEASUREMENTS, &body).await;
    direct.problem(422, "size_mismatch");
    let accepted = app.ask(MEASUREMENTS, &body, "k").await.expect(202);
    let failed = app.checked(MEASUREMENTS, &id(&accepted)).await;
    assert_eq!(same(&failed["problem"]).0, same(&direct.json()).0);
    let job = json!({"measurement": id(&accepted), "algorithm": "gap-tv"});
    let refused = app.post("/v1/jobs", &job).await;
    refused.problem(409, "measurement_not_ready");
    assert_eq!(refused.json()["retryable"], false);
    app.delete(&format!("{CALIBRATIONS}/{calibration}")).await.expect(204);
    let place = format!("{MEASUREMENTS}/{}", id(&accepted));
    app.delete(&place).await.expect(204);
    app.get(&place).await.problem(404, "not_found");
}

#[tokio::test]
async fn a_check_survives_a_killed_server_but_not_its_deletion() {
    let mut app = TestApp::start().await;
    let masks = app.upload(large_masks()).await;
    let body = json!({"masks": masks});
    let calibration = id(&app.ask(CALIBRATIONS, &body, "k").await.expect(202));
    app.restart();
    let path = format!("{CALIBRATIONS}/{calibration}");
    let shown = app.get(&path).await.expect(200).json();
    assert_eq!(shown["state"], "preparing", "the check is too short for this test");
    assert_eq!(app.checked(CALIBRATIONS, &calibration).await["state"], "ready");
    assert_eq!(id(&app.ask(CALIBRATIONS, &body, "k").await.expect(200)), calibration);
    app.delete(&path).await.expect(204);

    // A deleted resource is not checked, and its key can be used again.
    let first = id(&app.ask(CALIBRATIONS, &body, "k").await.expect(202));
    app.delete(&format!("{CALIBRATIONS}/{first}")).await.expect(204);
    let second = app.ask(CALIBRATIONS, &body, "k").await.expect(202);
    assert_ne!(id(&second), first);
    // A stopped server leaves the check to the next one.
    assert!(app.stop().success());
    app.restart();
    assert_eq!(app.checked(CALIBRATIONS, &id(&second)).await["state"], "ready");
    let listed = app.get(CALIBRATIONS).await.expect(200).json();
    assert_eq!(listed["items"].as_array().unwrap().len(), 1);
    app.get(&format!("{CALIBRATIONS}/{first}")).await.problem(404, "not_found");
}

#[tokio::test]
async fn a_check_is_abandoned_if_its_workers_die() {
    let app = TestApp::start().await;
    let masks = app.upload(large_masks()).await;
    let calibration = id(&app.ask(CALIBRATIONS, &json!({"masks": masks}), "k").await.expect(202));
    let path = format!("{CALIBRATIONS}/{calibration}");
    let mut killed = Vec::new();
    for _ in 0..10_000 {
        let shown = app.get(&path).await.expect(200).json();
        match shown["state"].as_str().unwrap() {
            "preparing" => {}
            "failed" => {
                assert_eq!(shown["problem"]["code"], "internal");
                assert!(shown["error"].as_str().unwrap().contains("ended 5 times"), "{shown}");
                assert!(killed.len() >= 5, "{killed:?}");
                app.get("/livez").await.expect(200);
                return;
            }
            state => panic!("{state}: the check is too short for this test"),
        }
        // A worker that performs the check has the file open.
        if let Some(worker) = app.light_worker()
            && reads(worker, &masks)
        {
            let _ = rustix::process::kill_process(worker, rustix::process::Signal::KILL);
            killed.push(worker);
        }
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    panic!("the check is never abandoned");
}

/// True if a process has this upload open.
fn reads(process: rustix::process::Pid, upload: &str) -> bool {
    let files = std::fs::read_dir(format!("/proc/{process}/fd"));
    let mut links = files.into_iter().flatten().flatten();
    links.any(|file| std::fs::read_link(file.path()).is_ok_and(|path| path.ends_with(&upload[2..])))
}

#[tokio::test]
async fn an_upload_is_checked_while_all_workers_are_busy_with_tiles() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let scene = Scene { frames: 8, height: 256, width: 256, snapshots: 1 };
    let (calibration, measurement) = app.scene(&scene).await;
    let long = json!({
        "measurement": measurement,
        "algorithm": "gap-tv",
        "tile": {"size": 256, "overlap": 0},
        "schedule": {"stages": [{"prior": "tv", "iterations": 2000, "tv_weight": 0.1}]},
    });
    let job = app.submit(&long).await;
    app.when(&job, |job| job["progress"]["tiles_running"] == 1).await;
    let before = app.get(&format!("/v1/jobs/{job}")).await.expect(200).json();
    // The masks have 1 MB.
    let body = json!({"masks": app.upload(constant(&[4, 256, 256], 1.0)).await});
    let start = std::time::Instant::now();
    app.post(CALIBRATIONS, &body).await.expect(201);
    let data = app.upload(constant(&[4, 256, 256], 8.0)).await;
    let body = json!({"calibration": calibration, "data": data});
    app.post(MEASUREMENTS, &body).await.expect(201);
    eprintln!("two checks took {:?}", start.elapsed());
    let after = app.get(&format!("/v1/jobs/{job}")).await.expect(200).json();
    assert_eq!((&after["state"], &after["progress"]["tiles_done"]), (&json!("running"), &json!(0)));
    assert_eq!(after["progress"]["tiles_running"], 1, "{before:#} {after:#}");
    let cancelled = app.post(&format!("/v1/jobs/{job}/cancel"), &json!({})).await;
    assert!(cancelled.status.is_success(), "{}", cancelled.status);
}

#[tokio::test]
async fn a_refusal_within_the_request_leaves_no_resource() {
    let app = TestApp::start().await;
    let masks = app.upload(constant(&[4, 48, 64], 3.0)).await;
    let request = || {
        let request = app.request(Method::POST, CALIBRATIONS).json(&json!({"masks": masks}));
        app.send(request.header("Idempotency-Key", "k"))
    };
    // Two concurrent requests with one key get the same answer.
    let answers = futures_util::future::join_all([request(), request()]).await;
    for answer in answers {
        answer.problem(422, "invalid_content");
    }
    let listed = app.get(CALIBRATIONS).await.expect(200).json();
    assert_eq!(listed["items"], json!([]));
    app.delete(&format!("/v1/blobs/{masks}")).await.expect(204);
}

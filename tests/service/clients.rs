//! Features that clients rely on: keys, waiting, changes, lists, files, estimates, samples.

use std::time::{Duration, Instant};

use reqwest::Method;
use serde_json::{Value, json};

use crate::app::{Answer, TestApp, id};
use crate::samples::{Scene, npy};

async fn with_key(app: &TestApp, path: &str, key: &str, body: &Value) -> Answer {
    let request = app.request(Method::POST, path).header("idempotency-key", key);
    app.send(request.json(body)).await
}

async fn patch(app: &TestApp, path: &str, body: &Value) -> Answer {
    app.send(app.request(Method::PATCH, path).json(body)).await
}

async fn count(app: &TestApp, path: &str) -> usize {
    app.get(path).await.expect(200).json()["items"].as_array().unwrap().len()
}

#[tokio::test]
async fn a_repeated_request_creates_one_resource() {
    let app = TestApp::start().await;
    let masks = app.upload(Scene::SMALL.masks()).await;
    let data = app.upload(Scene::SMALL.snapshots()).await;
    let body = json!({ "masks": masks });
    let calibration = id(&with_key(&app, "/v1/calibrations", "k", &body).await.expect(201));
    let repeated = with_key(&app, "/v1/calibrations", "k", &body).await.expect(200);
    assert_eq!(id(&repeated), calibration);
    assert_eq!(repeated.header("location"), format!("/v1/calibrations/{calibration}"));
    let other = json!({ "masks": masks, "name": "another" });
    let refused = with_key(&app, "/v1/calibrations", "k", &other).await;
    let detail = refused.problem(422, "idempotency_key_reused");
    assert!(detail.contains(&calibration), "{detail}");
    // Each kind of resource has separate keys.
    let body = json!({ "calibration": calibration, "data": data });
    let answers = futures_util::future::join_all(
        (0..4).map(|_| with_key(&app, "/v1/measurements", "k", &body)),
    );
    let answers = answers.await;
    assert!(answers.iter().all(|answer| id(answer) == id(&answers[0])));
    assert_eq!(answers.iter().filter(|answer| answer.status == 201).count(), 1);
    assert_eq!(count(&app, "/v1/measurements").await, 1);
    // The key is forgotten when its resource is deleted.
    app.delete(&format!("/v1/measurements/{}", id(&answers[0]))).await.expect(204);
    let recreated = with_key(&app, "/v1/measurements", "k", &body).await.expect(201);
    assert_ne!(id(&recreated), id(&answers[0]));
    let begin = || {
        let request = app.request(Method::POST, "/v1/uploads").header("idempotency-key", "k");
        request.header("tus-resumable", "1.0.0").header("upload-length", "10")
    };
    let first = app.send(begin()).await.expect(201).header("location").to_owned();
    assert_eq!(app.send(begin()).await.expect(201).header("location"), first);
    assert_eq!(count(&app, "/v1/uploads").await, 1);
}

#[tokio::test]
async fn a_client_can_wait_for_a_job() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({ "measurement": measurement, "algorithm": "gap-tv" });
    let job = id(&app.post("/v1/jobs", &body).await.expect(201));
    let path = format!("/v1/jobs/{job}");
    let start = Instant::now();
    while app.wait(&path, "10").await.expect(200).json()["state"] != "succeeded" {
        assert!(start.elapsed() < Duration::from_secs(100), "the job does not end");
    }
    let start = Instant::now();
    let ended = app.wait(&path, "20").await.expect(200);
    assert!(start.elapsed() < Duration::from_secs(3), "the job had ended");
    assert_eq!(ended.header("preference-applied"), "wait=20");
    let capped = app.wait(&path, "1000").await.expect(200);
    assert_eq!(capped.header("preference-applied"), "wait=20");
    for ignored in ["-1", "long", "nan"] {
        let answer = app.wait(&path, ignored).await.expect(200);
        assert_eq!(answer.header("preference-applied"), "", "{ignored}");
    }
    app.get(&format!("{path}?wait=1")).await.problem(400, "invalid_query");
}

#[tokio::test]
async fn waiting_clients_do_not_block_others() {
    let mut app = TestApp::start().await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({ "measurement": measurement, "algorithm": "gap-tv" });
    let path = format!("/v1/jobs/{}", id(&app.post("/v1/jobs", &body).await.expect(201)));
    let waiting = |count: usize| {
        let requests: Vec<_> = (0..count)
            .map(|_| app.request(Method::GET, &path).header("prefer", "wait=20"))
            .collect();
        let sent = requests.into_iter().map(|request| async move { request.send().await.unwrap() });
        tokio::spawn(futures_util::future::join_all(sent))
    };
    // More clients wait than there are database connections. The next one of the lab is rejected.
    let held = waiting(64);
    tokio::time::sleep(Duration::from_millis(500)).await;
    let start = Instant::now();
    app.get(&path).await.expect(200);
    assert!(start.elapsed() < Duration::from_secs(2), "{:?}", start.elapsed());
    let refused = app.wait(&path, "20").await;
    refused.problem(429, "too_many_waiters");
    // The first of them ends after its 20 seconds.
    let seconds: u64 = refused.header("retry-after").parse().unwrap();
    assert!((10..=20).contains(&seconds), "{seconds}");
    // A change wakes all of them.
    app.post(&format!("{path}/cancel"), &json!({})).await.expect(202);
    for answer in held.await.unwrap() {
        assert_eq!(answer.json::<Value>().await.unwrap()["state"], "cancelled");
    }
    // A shutdown does not wait for them.
    app.post(&format!("{path}/retry"), &json!({})).await.expect(202);
    let held = waiting(3);
    tokio::time::sleep(Duration::from_millis(500)).await;
    let start = Instant::now();
    assert!(app.stop().success());
    assert!(start.elapsed() < Duration::from_secs(10), "{:?}", start.elapsed());
    for answer in held.await.unwrap() {
        assert_eq!(answer.json::<Value>().await.unwrap()["state"], "queued");
    }
}

#[tokio::test]
async fn labels_names_and_priorities_can_be_changed() {
    let app = TestApp::start().await;
    let (calibration, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({ "measurement": measurement, "algorithm": "gap-tv", "label": "first" });
    let early = id(&app.post("/v1/jobs", &body).await.expect(201));
    let late = id(&app.post("/v1/jobs", &body).await.expect(201));
    let path = format!("/v1/jobs/{late}");
    let changed = patch(&app, &path, &json!({ "priority": 7 })).await.expect(200).json();
    assert_eq!((&changed["priority"], &changed["label"]), (&json!(7), &json!("first")));
    let position = async |job: &str| {
        let job = app.get(&format!("/v1/jobs/{job}")).await.expect(200).json();
        job["progress"]["queue_position"].clone()
    };
    // The forecast may be up to a second old.
    let start = Instant::now();
    while (position(&late).await, position(&early).await) != (json!(1), json!(2)) {
        assert!(
            start.elapsed() < Duration::from_secs(20),
            "the priority does not change the order"
        );
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    let changed = patch(&app, &path, &json!({ "label": "second" })).await.expect(200).json();
    assert_eq!((&changed["priority"], &changed["label"]), (&json!(7), &json!("second")));
    assert_eq!(count(&app, "/v1/jobs?label=second").await, 1);
    let changed = patch(&app, &path, &json!({ "label": null })).await.expect(200).json();
    assert_eq!(changed["label"], Value::Null);
    let refused = patch(&app, &path, &json!({ "priority": 101 })).await;
    refused.problem(422, "invalid_request");
    assert_eq!(refused.json()["pointer"], "/priority");
    patch(&app, &path, &json!({ "state": "succeeded" })).await.problem(422, "invalid_request");
    app.post(&format!("{path}/cancel"), &json!({})).await.expect(202);
    patch(&app, &path, &json!({ "priority": 1 })).await.problem(409, "illegal_state");
    patch(&app, &path, &json!({ "label": "kept" })).await.expect(200);
    for path in
        [format!("/v1/calibrations/{calibration}"), format!("/v1/measurements/{measurement}")]
    {
        let renamed = patch(&app, &path, &json!({ "name": "bench 3" })).await.expect(200).json();
        assert_eq!(renamed["name"], "bench 3");
        assert_eq!(app.get(&path).await.expect(200).json()["name"], "bench 3");
        assert_eq!(
            patch(&app, &path, &json!({ "name": null })).await.expect(200).json()["name"],
            Value::Null
        );
        patch(&app, &path, &json!({})).await.problem(422, "invalid_request");
        patch(&app, &path, &json!({ "name": " " })).await.problem(422, "invalid_request");
    }
}

#[tokio::test]
async fn lists_are_filtered_by_state_and_date() {
    let app = TestApp::start().await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({ "measurement": measurement, "algorithm": "gap-tv" });
    let first = app.post("/v1/jobs", &body).await.expect(201).json();
    tokio::time::sleep(Duration::from_millis(20)).await;
    let second = app.post("/v1/jobs", &body).await.expect(201).json();
    let cancel = format!("/v1/jobs/{}/cancel", first["id"].as_str().unwrap());
    app.post(&cancel, &json!({})).await.expect(202);
    let moment = second["created_at"].as_str().unwrap();
    for (query, expected) in [
        ("state=queued,cancelled".to_owned(), 2),
        ("state=queued,running".to_owned(), 1),
        ("state=failed,succeeded".to_owned(), 0),
        (format!("created_after={moment}"), 1),
        (format!("created_before={moment}"), 1),
        (format!("created_before={moment}&state=queued"), 0),
        ("created_after=2001-01-01T00:00:00Z".to_owned(), 2),
    ] {
        assert_eq!(count(&app, &format!("/v1/jobs?{query}")).await, expected, "{query}");
    }
    for list in ["calibrations", "measurements"] {
        assert_eq!(count(&app, &format!("/v1/{list}?created_before={moment}")).await, 1, "{list}");
        assert_eq!(count(&app, &format!("/v1/{list}?created_after={moment}")).await, 0, "{list}");
    }
    for bad in ["state=queued,gone", "state=", "created_after=yesterday"] {
        app.get(&format!("/v1/jobs?{bad}")).await.problem(400, "invalid_query");
    }
    let path = "/v1/calibrations";
    let etag = app.get(path).await.expect(200).header("etag").to_owned();
    app.send(app.request(Method::GET, path).header("if-none-match", etag)).await.expect(304);
}

#[tokio::test]
async fn files_belong_to_their_lab() {
    let app = TestApp::start().await;
    let (a, b) = (app.token(&["create", "--lab", "a"]), app.token(&["create", "--lab", "b"]));
    app.sign_in(&a);
    let masks = app.upload(Scene::SMALL.masks()).await;
    let page = app.upload(b"<script>alert(1)</script>".to_vec()).await;
    app.post("/v1/calibrations", &json!({ "masks": masks })).await.expect(201);
    let content = format!("/v1/blobs/{page}/content");
    let file = app.get(&content).await.expect(200);
    assert_eq!(file.bytes, b"<script>alert(1)</script>");
    for (name, value) in [
        ("content-type", "application/octet-stream"),
        ("content-disposition", &format!("attachment; filename=\"{page}.bin\"")),
        ("x-content-type-options", "nosniff"),
        ("content-security-policy", "sandbox"),
        ("etag", &format!("\"{page}\"")),
    ] {
        assert_eq!(file.header(name), value);
    }
    let part = app.request(Method::GET, &content).header("range", "bytes=1-6");
    assert_eq!(app.send(part).await.expect(206).bytes, b"script");
    let first = app.get("/v1/blobs?limit=1").await.expect(200).json();
    assert_eq!(
        (&first["items"][0]["sha256"], &first["items"][0]["in_use"]),
        (&json!(page), &json!(false))
    );
    let next = format!("/v1/blobs?limit=1&cursor={}", first["next_cursor"].as_str().unwrap());
    let last = app.get(&next).await.expect(200).json();
    assert_eq!(
        (&last["items"][0]["sha256"], &last["items"][0]["in_use"]),
        (&json!(masks), &json!(true))
    );
    assert_eq!(last["next_cursor"], Value::Null);
    app.get("/v1/blobs?cursor=x").await.problem(400, "invalid_query");
    // Another lab does not see the files, and its files do not block their deletion.
    app.sign_in(&b);
    for path in [content.clone(), format!("/v1/blobs/{masks}/content")] {
        app.get(&path).await.problem(404, "not_found");
    }
    assert_eq!(count(&app, "/v1/blobs").await, 0);
    app.delete(&format!("/v1/blobs/{page}")).await.problem(404, "not_found");
    assert_eq!(app.upload(Scene::SMALL.masks()).await, masks);
    app.delete(&format!("/v1/blobs/{masks}")).await.expect(204);
    app.sign_in(&a);
    app.delete(&format!("/v1/blobs/{masks}")).await.problem(409, "in_use");
    app.get(&format!("/v1/blobs/{masks}/content")).await.expect(200);
    app.delete(&format!("/v1/blobs/{page}")).await.expect(204);
    app.get(&content).await.problem(404, "not_found");
    let me = app.get("/v1/me").await.expect(200).json();
    assert_eq!((&me["lab"], &me["role"]), (&json!("a"), &json!("submit")));
    assert_eq!(me["limits"]["token_bytes"], Value::Null);
    assert_eq!(me["use"]["uploads"], 1);
    assert_eq!(me["use"]["upload_bytes"], Scene::SMALL.masks().len());
    // The prepared masks are deleted as well.
    assert_eq!(me["use"]["token_bytes"], Scene::SMALL.masks().len() + 32 + 4 * 4 * 48 * 64);
}

#[tokio::test]
async fn a_job_is_estimated_without_creating_it() {
    let app = TestApp::start().await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({ "measurement": measurement, "algorithm": "gap-tv", "snapshots": 0 });
    let estimate = app.post("/v1/jobs/estimate", &body).await.expect(200).json();
    assert_eq!((&estimate["tiles"], &estimate["queue_position"]), (&json!(1), &json!(1)));
    assert_eq!(estimate["eta_seconds"], Value::Null, "no worker lives");
    for field in ["cpu_seconds", "disk_bytes", "worker_memory_bytes"] {
        assert!(estimate[field].as_f64().unwrap() > 0.0, "{field}: {estimate}");
    }
    assert_eq!(count(&app, "/v1/jobs").await, 0, "the estimate creates nothing");
    let mut wrong = body.clone();
    wrong["snapshots"] = json!(9);
    app.post("/v1/jobs/estimate", &wrong).await.problem(422, "invalid_request");
}

#[tokio::test]
async fn a_sample_runs_without_uploads() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let body = json!({ "algorithm": "gap-tv", "label": "try" });
    let created = with_key(&app, "/v1/samples", "k", &body).await.expect(201);
    let sample = created.json();
    let job = sample["job"]["id"].as_str().unwrap();
    assert_eq!(created.header("location"), format!("/v1/jobs/{job}"));
    let repeated = with_key(&app, "/v1/samples", "k", &body).await.expect(200).json();
    assert_eq!(repeated["job"]["id"], job);
    assert_eq!(count(&app, "/v1/calibrations").await, 1);
    assert_eq!(count(&app, "/v1/measurements").await, 1);
    with_key(&app, "/v1/samples", "k", &json!({})).await.problem(422, "idempotency_key_reused");
    assert_eq!(app.ended(job).await["state"], "succeeded");
    assert_eq!(sample["job"]["truth"], sample["truth"]);
    let path = format!("/v1/jobs/{job}/snapshots/0/quality");
    let psnr = app.get(&path).await.expect(200).json()["psnr"].as_f64().unwrap();
    assert!(psnr > 18.0, "{psnr} dB");
    // A truth with a value that is no number would have no PSNR.
    let value = |at| if at == 70_000 { f32::NAN } else { 0.5 };
    let odd = app.upload(npy(&[8, 256, 256], (0..8 * 65_536).map(value))).await;
    let job = format!("/v1/jobs/{job}");
    let refused = patch(&app, &job, &json!({ "truth": odd })).await;
    let detail = refused.problem(422, "invalid_content");
    assert!(detail.contains("frame 1, row 17, column 112"), "{detail}");
    app.get(&format!("{path}?truth={odd}")).await.problem(422, "invalid_content");
}

//! Monitoring of labs, calibrations and files of a running service.

use std::time::Duration;

use futures_util::StreamExt;
use reqwest::Method;
use serde_json::{Value, json};

use crate::app::{TestApp, id};
use crate::samples::{Scene, constant, npy};

/// The value of a metric with these labels.
fn figure(text: &str, name: &str) -> f64 {
    let line = text.lines().find(|line| line.split(' ').next() == Some(name));
    let line = line.unwrap_or_else(|| panic!("no {name} in {text}"));
    line.rsplit(' ').next().unwrap().parse().unwrap()
}

#[tokio::test]
async fn metrics_of_labs_require_a_token_for_all_labs() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let a = app.token(&["create", "--lab", "a", "--role", "admin"]);
    let b = app.token(&["create", "--lab", "b", "--role", "admin"]);
    let all_labs = app.token(&["create", "--lab", "ops", "--role", "admin", "--all-labs"]);
    app.sign_in(&a);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    assert_eq!(app.ended(&app.submit(&body).await).await["state"], "succeeded");
    let read = async || String::from_utf8(app.get("/metrics").await.expect(200).bytes).unwrap();
    app.sign_in(&all_labs);
    let text = read().await;
    assert_eq!(figure(&text, "sci_recon_lab_jobs{lab=\"a\",state=\"succeeded\"}"), 1.0);
    assert_eq!(figure(&text, "sci_recon_lab_jobs{lab=\"b\",state=\"succeeded\"}"), 0.0);
    assert_eq!(figure(&text, "sci_recon_lab_jobs_begun_total{lab=\"a\"}"), 1.0);
    assert!(figure(&text, "sci_recon_lab_cpu_seconds_total{lab=\"a\"}") > 0.0);
    assert!(figure(&text, "sci_recon_lab_wait_seconds_total{lab=\"a\"}") >= 0.0);
    assert!(figure(&text, "sci_recon_lab_result_bytes{lab=\"a\"}") > 10_000.0);
    assert_eq!(figure(&text, "sci_recon_lab_longest_wait_seconds{lab=\"a\"}"), 0.0);
    let seconds = figure(&text, "sci_recon_task_seconds_total{kind=\"tile\"}");
    assert!(seconds > 0.0 && seconds.fract() > 0.0, "{seconds} is cut to whole seconds");
    app.sign_in(&b);
    let text = read().await;
    assert!(!text.contains("lab=\"a\"") && text.contains("lab=\"b\""), "{text}");
}

#[tokio::test]
async fn a_service_without_workers_for_tiles_reports_it() {
    let app = TestApp::start().await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let job = app.submit(&json!({"measurement": measurement, "algorithm": "gap-tv"})).await;
    let start = std::time::Instant::now();
    let system = loop {
        let system = app.get("/v1/system").await.expect(200).json();
        if system["degraded"] != json!([]) {
            break system;
        }
        assert!(start.elapsed().as_secs() < 60, "{system}");
        tokio::time::sleep(Duration::from_millis(500)).await;
    };
    let text = system["degraded"][0].as_str().unwrap();
    assert!(text.starts_with("no worker has taken tiles for"), "{text}");
    let ready = app.get("/readyz").await.json();
    assert_eq!(ready["degraded"], json!(true));
    assert!(ready["tiles"].as_str().unwrap().starts_with("no worker has taken tiles"), "{ready}");
    let list = app.get("/v1/jobs").await.expect(200).json();
    for job in
        [app.get(&format!("/v1/jobs/{job}")).await.expect(200).json(), list["items"][0].clone()]
    {
        assert_eq!(job["progress"]["eta_seconds"], Value::Null);
        let finding = job["warnings"].as_array().unwrap().last().unwrap();
        assert_eq!(finding["code"], "no_tile_workers");
        assert!(finding["remedy"].as_str().unwrap().contains("--workers"), "{finding}");
    }
    let text = String::from_utf8(app.get("/metrics").await.expect(200).bytes).unwrap();
    assert_eq!(figure(&text, "sci_recon_tile_workers"), 0.0);
    // With a worker, the warnings disappear.
    let app = app.again(&["--workers", "1"]).await;
    let done = app.ended(&job).await;
    assert!(done["warnings"].as_array().unwrap().iter().all(|it| it["code"] != "no_tile_workers"));
    let system = app.get("/v1/system").await.expect(200).json();
    assert!(!system["degraded"].to_string().contains("no worker"), "{system}");
    assert_eq!(app.get("/readyz").await.expect(200).json()["tiles"], "ok");
}

#[tokio::test]
async fn listeners_receive_changes_of_calibrations() {
    let app = TestApp::start().await;
    app.calibrate(Scene::SMALL.masks()).await.expect(201);
    let response = app.request(Method::GET, "/v1/events").send().await.unwrap();
    let mut stream = response.bytes_stream();
    let mut text = String::new();
    let mut heard = async |mark: &str| -> Value {
        loop {
            let event = text.split_once(mark).and_then(|(_, rest)| rest.split_once("\n\n"));
            if let Some((data, rest)) = event {
                let data = data.lines().next().unwrap_or_default();
                let data = serde_json::from_str(data).unwrap_or(Value::Null);
                text = rest.to_owned();
                return data;
            }
            text += std::str::from_utf8(&stream.next().await.unwrap().unwrap()).unwrap();
        }
    };
    heard("event: hello").await;
    let calibration = id(&app.calibrate(Scene::SMALL.masks()).await.expect(201));
    let change = loop {
        let change = heard("event: calibrations\ndata: ").await;
        // The first event may name the calibration that was created before.
        if change["changed"][0] == json!(calibration) {
            break change;
        }
    };
    assert_eq!((&change["deleted"], &change["more"]), (&json!([]), &json!(false)));
    let path = format!("/v1/calibrations/{calibration}");
    let rename = app.request(Method::PATCH, &path).json(&json!({"name": "May"}));
    app.send(rename).await.expect(200);
    let change = heard("event: calibrations\ndata: ").await;
    assert_eq!(change["changed"], json!([calibration]));
    let data = app.upload(constant(&[16, 16], 1.0)).await;
    let body = json!({"calibration": calibration, "data": data});
    let ask = app.request(Method::POST, "/v1/measurements").json(&body);
    let measurement = id(&app.send(ask.header("Prefer", "respond-async")).await.expect(202));
    let change = heard("event: measurements\ndata: ").await;
    assert_eq!(change, json!({"changed": [measurement], "deleted": [], "more": false}));
    // Events about the check arrive until it has ended.
    app.delete(&format!("/v1/measurements/{measurement}")).await.expect(204);
    while heard("event: measurements\ndata: ").await["deleted"] != json!([measurement]) {}
    app.delete(&path).await.expect(204);
    while heard("event: calibrations\ndata: ").await["deleted"] != json!([calibration]) {}
}

#[tokio::test]
async fn an_upload_has_a_preview_before_it_is_used() {
    let app = TestApp::start().await;
    let (a, b) = (app.token(&["create", "--lab", "a"]), app.token(&["create", "--lab", "b"]));
    app.sign_in(&a);
    let frame = |k: usize, at: usize| if k == 1 { at as f32 / 6000.0 } else { 0.0 };
    let values = (0..3).flat_map(|k| (0..60 * 100).map(move |at| frame(k, at)));
    let sha256 = app.upload(npy(&[3, 60, 100], values)).await;
    let path = format!("/view/blobs/{sha256}/pictures");
    let picture = app.get(&format!("{path}/frame-2?size=64&black=0&white=1")).await.expect(200);
    let shown = image::load_from_memory(&picture.bytes).unwrap().to_luma8();
    assert_eq!(shown.dimensions(), (50, 30), "no side above 64");
    assert!(shown.get_pixel(0, 0).0[0] < 5 && shown.get_pixel(49, 29).0[0] > 250);
    let tag = picture.header("etag").to_owned();
    let again = app.request(Method::GET, &format!("{path}/frame-2?size=64&black=0&white=1"));
    app.send(again.header("if-none-match", tag)).await.expect(304);
    app.get(&format!("{path}/frame-1")).await.expect(200);
    let outside = app.get(&format!("{path}/frame-4")).await.problem(404, "not_found");
    assert!(outside.contains("1 to 3"), "{outside}");
    app.get(&format!("{path}/frame-0")).await.problem(404, "not_found");
    for (file, array, size) in [
        ("names.h5", "calibrated%2Fmasks", (5, 4)),
        ("names.mat", "shots", (5, 4)),
        ("matlab73.mat", "meas", (5, 4)),
    ] {
        let several = std::fs::read(format!("tests/data/formats/{file}")).unwrap();
        let several = format!("/view/blobs/{}/pictures", app.upload(several).await);
        let picture = app.get(&format!("{several}/array-{array}")).await.expect(200);
        let shown = image::load_from_memory(&picture.bytes).unwrap().to_luma8();
        assert_eq!(shown.dimensions(), size, "{file}");
        app.get(&format!("{several}/array-nothing")).await.problem(422, "invalid_content");
    }
    let text = app.upload(b"no picture at all".to_vec()).await;
    let refused = app.get(&format!("/view/blobs/{text}/pictures/frame-1")).await;
    refused.problem(422, "invalid_content");
    app.sign_in(&b);
    app.get(&format!("{path}/frame-2")).await.problem(404, "not_found");
}

#[tokio::test]
async fn a_check_that_takes_too_long_ends_and_frees_its_lab() {
    let app = TestApp::with(&["--workers", "0", "--check-seconds", "0.000001"]).await;
    let masks = app.upload(Scene::SMALL.masks()).await;
    for _ in 0..3 {
        let late = app.post("/v1/calibrations", &json!({"masks": masks})).await;
        let detail = late.problem(503, "timed_out");
        assert!(detail.contains("--check-seconds"), "{detail}");
    }
    let app = app.again(&["--workers", "0"]).await;
    app.post("/v1/calibrations", &json!({"masks": masks})).await.expect(201);
}

#[tokio::test]
async fn masks_that_code_only_one_direction_are_not_good() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let noise = |k: usize, i: usize| ((k * 7919 + i * 104_729 + i * i * 31) % 97) as f32 / 96.0;
    let values = (0..8).flat_map(|k| (0..64 * 80).map(move |at| noise(k, at / 80)));
    let calibration = id(&app.calibrate(npy(&[8, 64, 80], values)).await.expect(201));
    let path = format!("/v1/calibrations/{calibration}/report");
    let report = app.get_until(&path, 200).await.json();
    assert_ne!(report["grade"], "good");
    let findings = report["findings"].as_array().unwrap();
    let finding_found = findings.iter().find(|finding| finding["code"] == "one_dimensional");
    let detail = finding_found.unwrap_or_else(|| panic!("{report:#}"))["detail"].as_str().unwrap();
    assert!(detail.contains("between rows"), "{detail}");
}

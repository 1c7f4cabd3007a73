//! The service beside its contract, and what watches it.

use serde_json::Value;

use crate::app::TestApp;
use crate::samples::Scene;

#[tokio::test]
async fn the_contract_is_served_and_every_status_of_the_code_stands_in_it() {
    let app = TestApp::start().await;
    let answer = app.get("/openapi.yaml").await.expect(200);
    let contract: Value = serde_yaml_ng::from_slice(&answer.bytes).unwrap();
    assert!(contract["openapi"].as_str().unwrap().starts_with("3."));
    // Every reference leads somewhere.
    let text = String::from_utf8(answer.bytes).unwrap();
    for reference in text.split("$ref: \"#/").skip(1) {
        let path = reference.split('"').next().unwrap();
        let found = path.split('/').fold(&contract, |at, key| &at[key]);
        assert!(!found.is_null(), "{path} leads nowhere");
    }
}

#[test]
fn the_dashboard_has_words_for_every_stage_of_the_contract() {
    let read = |path: &str| {
        std::fs::read_to_string(format!("{}/{path}", env!("CARGO_MANIFEST_DIR"))).unwrap()
    };
    let contract: Value = serde_yaml_ng::from_str(&read("openapi.yaml")).unwrap();
    let stages = &contract["components"]["schemas"]["Progress"]["properties"]["stage"]["enum"];
    let script = read("src/http/dashboard/format.js");
    let (_, words) = script.split_once("const words = {").unwrap();
    let (words, _) = words.split_once('}').unwrap();
    for stage in stages.as_array().unwrap() {
        let key = format!("{}: \"", stage.as_str().unwrap());
        assert!(words.lines().any(|line| line.trim().starts_with(&key)), "no words for {stage}");
    }
}

#[tokio::test]
async fn health_says_what_is_missing() {
    let app = TestApp::start().await;
    app.get("/livez").await.expect(200);
    let ready = app.get("/readyz").await.expect(503).json();
    assert_eq!(ready["database"], "ok");
    assert_eq!(ready["disk"], "ok");
    assert_eq!(ready["workers"], "no worker lives");
}

#[tokio::test]
async fn figures_are_counted() {
    let app = TestApp::start().await;
    app.scene(&Scene::SMALL).await;
    app.get("/v1/nowhere").await.problem(404, "not_found");
    let answer = app.get("/metrics").await.expect(200);
    let text = String::from_utf8(answer.bytes).unwrap();
    for line in [
        "sci_recon_http_requests_total{method=\"POST\",route=\"/v1/calibrations\",status=\"201\"} 1",
        "sci_recon_http_requests_total{method=\"GET\",route=\"none\",status=\"404\"} 1",
        "sci_recon_blobs 4",
        "sci_recon_jobs{state=\"queued\"} 0",
        "sci_recon_workers 0",
    ] {
        assert!(text.lines().any(|found| found == line), "no {line} in\n{text}");
    }
}

#[tokio::test]
async fn a_second_server_on_the_same_folder_is_refused() {
    let app = TestApp::start().await;
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_sci-recon"))
        .args(["serve", "--listen", "127.0.0.1:0", "--workers", "0", "--data"])
        .arg(app.data())
        .output()
        .unwrap();
    assert!(!output.status.success());
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(text.contains("another server uses"), "{text}");
    app.get("/livez").await.expect(200);
}

#[tokio::test]
async fn a_stop_is_clean() {
    let mut app = TestApp::start().await;
    assert!(app.data().join("server.json").exists());
    assert!(app.stop().success());
    assert!(!app.data().join("server.json").exists());
}

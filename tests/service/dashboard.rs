//! The dashboard's files, and the parts of the API that serve it.

use futures_util::StreamExt;
use reqwest::Method;
use serde_json::{Value, json};

use crate::app::{TestApp, id};
use crate::samples::Scene;

#[tokio::test]
async fn the_page_is_compressed_cached_and_allows_no_foreign_code() {
    let app = TestApp::start().await;
    let ask = |path: &str, name: &'static str, value: String| {
        app.send(app.request(Method::GET, path).header(name, value))
    };
    let plain = app.get("/").await.expect(200);
    assert!(plain.header("content-type").starts_with("text/html"));
    assert_eq!(plain.header("content-encoding"), "");
    let policy = plain.header("content-security-policy");
    assert!(policy.contains("default-src 'none'") && policy.contains("script-src 'self'"));
    assert!(!policy.contains("unsafe") && !policy.contains('*'), "{policy}");
    let text = String::from_utf8(plain.bytes.clone()).unwrap();
    assert!(!text.contains("<style") && !text.contains(" style=") && !text.contains("onclick"));
    // Each representation has its own tag, and a known tag avoids sending it again.
    let packed = ask("/dashboard/style.css", "accept-encoding", "gzip".into()).await.expect(200);
    assert_eq!(packed.header("content-encoding"), "gzip");
    assert_eq!(packed.bytes[..2], [0x1f, 0x8b]);
    let whole = app.get("/dashboard/style.css").await.expect(200);
    assert!(whole.bytes.len() > 2 * packed.bytes.len());
    assert_ne!(whole.header("etag"), packed.header("etag"));
    let etag = whole.header("etag").to_owned();
    ask("/dashboard/style.css", "if-none-match", etag).await.expect(304);
    for missing in ["/dashboard/mod.rs", "/dashboard/..%2fmod.rs", "/dashboard/none.js"] {
        app.get(missing).await.problem(404, "not_found");
    }
}

#[tokio::test]
async fn the_system_view_reports_workers_queue_disk_and_versions() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let system = app.get("/v1/system").await.expect(200).json();
    assert_eq!(system["device"], "cpu");
    assert_eq!(system["provider"], "CPUExecutionProvider");
    assert_eq!(system["version"], env!("CARGO_PKG_VERSION"));
    assert_eq!(system["workers_wanted"], 1);
    assert_eq!(system["jobs"]["queued"], 0);
    assert!(system["disk"]["free_bytes"].as_u64().unwrap() > 0);
}

#[tokio::test]
async fn queued_jobs_have_a_position_and_can_be_searched() {
    let app = TestApp::start().await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let submit = async |label: &str, priority: i32| {
        let body = json!({"measurement": measurement, "algorithm": "gap-tv", "label": label,
            "priority": priority});
        id(&app.post("/v1/jobs", &body).await.expect(201))
    };
    let hostile = "<img src=x onerror=alert(1)>";
    let (first, second) = (submit("Milk 1", 0).await, submit("milk_2", 0).await);
    let urgent = submit(hostile, 5).await;
    for (job, place) in [(&urgent, 1), (&first, 2), (&second, 3)] {
        let found = app.get(&format!("/v1/jobs/{job}")).await.expect(200).json();
        assert_eq!(found["progress"]["queue_position"], place);
    }
    app.post(&format!("/v1/jobs/{urgent}/cancel"), &json!({})).await.expect(202);
    let found = app.get(&format!("/v1/jobs/{second}")).await.json();
    assert_eq!(found["progress"]["queue_position"], 2);
    let labels = async |query: &str| {
        let list = app.get(&format!("/v1/jobs?search={query}")).await.expect(200).json();
        let items = list["items"].as_array().unwrap().clone();
        items.iter().map(|job| job["label"].as_str().unwrap().to_owned()).collect::<Vec<_>>()
    };
    assert_eq!(labels("MILK").await, ["milk_2", "Milk 1"]);
    assert_eq!(labels("_").await, ["milk_2"], "no character is a wildcard");
    assert_eq!(labels("%25").await, Vec::<String>::new());
    assert_eq!(labels("onerror%3Dalert").await, [hostile]);
    assert_eq!(labels(&first[20..]).await, ["Milk 1"]);
    app.get("/v1/jobs?search=").await.problem(400, "invalid_query");
    // An unchanged list is not sent again.
    let list = app.get("/v1/jobs").await.expect(200);
    let again = || {
        app.send(app.request(Method::GET, "/v1/jobs").header("if-none-match", list.header("etag")))
    };
    again().await.expect(304);
    app.delete(&format!("/v1/jobs/{urgent}")).await.expect(204);
    again().await.expect(200);
}

#[tokio::test]
async fn a_first_listener_reads_again_after_the_first_poll() {
    let mut app = TestApp::start().await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    app.submit(&json!({"measurement": measurement, "algorithm": "gap-tv"})).await;
    // Requests that wait make the service follow changes, so a new service has to be asked.
    app.restart();
    let mut stream = app.request(Method::GET, "/v1/events").send().await.unwrap().bytes_stream();
    let mut text = String::new();
    // Otherwise a change between the greeting and the first poll would be lost.
    while !text.contains(r#"{"changed":[],"deleted":[],"more":true}"#) {
        text += std::str::from_utf8(&stream.next().await.unwrap().unwrap()).unwrap();
        assert!(text.len() < 10_000, "{text}");
    }
}

#[tokio::test]
async fn listeners_receive_changes_and_do_not_delay_a_stop() {
    let mut app = TestApp::start().await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let response = app.request(Method::GET, "/v1/events").send().await.unwrap();
    assert_eq!(response.headers()["content-type"], "text/event-stream");
    let mut stream = response.bytes_stream();
    let mut text = String::new();
    let mut read_until = async |mark: &str| {
        while !text.contains(mark) {
            text += std::str::from_utf8(&stream.next().await.unwrap().unwrap()).unwrap();
        }
        text.clone()
    };
    read_until("event: hello").await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    let job = id(&app.post("/v1/jobs", &body).await.expect(201));
    let heard = read_until("event: jobs\ndata: {").await;
    let (_, data) = heard.split_once("event: jobs\ndata: ").unwrap();
    let change: Value = serde_json::from_str(data.lines().next().unwrap()).unwrap();
    assert_eq!(change, json!({"changed": [job], "deleted": [], "more": false}));
    let start = std::time::Instant::now();
    assert!(app.stop().success());
    assert!(start.elapsed() < std::time::Duration::from_secs(5), "{:?}", start.elapsed());
    assert!(stream.next().await.is_none_or(|last| last.is_err()));
}

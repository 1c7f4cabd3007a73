//! Notifications at the end of jobs: webhooks, and commands of `watch` and `watch-folder`.

use std::io::Write;
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use serde_json::{Value, json};
use tokio::net::TcpListener;

use crate::app::{TestApp, judges};
use crate::samples::{Scene, constant};

/// Requests that a receiver got: headers and bodies.
type Received = Arc<Mutex<Vec<(HeaderMap, String)>>>;

/// Receives notifications at this listener. It refuses the first.
fn receive(listener: TcpListener) -> Received {
    let received = Received::default();
    let take = async |State(received): State<Received>, headers: HeaderMap, body: String| {
        let mut received = received.lock().unwrap();
        received.push((headers, body));
        if received.len() == 1 { StatusCode::BAD_GATEWAY } else { StatusCode::NO_CONTENT }
    };
    let router = axum::Router::new().fallback(take).with_state(received.clone());
    tokio::spawn(async move { axum::serve(listener, router).await });
    received
}

async fn job_when(app: &TestApp, job: &str, state: &str) -> Value {
    let start = Instant::now();
    loop {
        let found = app.get(&format!("/v1/jobs/{job}")).await.expect(200).json();
        if found["webhook"]["state"] == state && found["webhook"]["error"].is_string() {
            return found;
        }
        assert!(start.elapsed() < Duration::from_secs(60), "{found}");
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
}

#[tokio::test]
async fn the_end_of_a_job_is_notified_with_a_signature_after_failures_and_a_kill() {
    // A port where nothing listens yet.
    let address = TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap();
    let host = address.to_string();
    let arguments = ["--workers", "1", "--webhook-host", &host];
    let mut app = TestApp::with(&arguments).await;
    let token = app.token(&["create", "--lab", "optics"]);
    app.sign_in(&token);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let hook = format!("http://{host}/hook?key=k");
    let body = json!({"measurement": measurement, "algorithm": "gap-tv", "label": "drop", "webhook": hook});
    let job = app.submit(&body).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    let waiting = job_when(&app, &job, "sending").await;
    let error = waiting["webhook"]["error"].as_str().unwrap();
    assert!(error.contains("refused") && !error.contains("key=k"), "{error}");
    app.kill();
    let received = receive(TcpListener::bind(address).await.unwrap());
    app.restart();
    let start = Instant::now();
    while app.get(&format!("/v1/jobs/{job}")).await.json()["webhook"]["state"] != "delivered" {
        assert!(start.elapsed() < Duration::from_secs(120));
        tokio::time::sleep(Duration::from_millis(500)).await;
    }
    let received = received.lock().unwrap().clone();
    let [(refused, _), (headers, body)] = &received[..] else { panic!("{received:?}") };
    assert_eq!(refused["webhook-id"], headers["webhook-id"], "a repetition is recognised");
    let message: Value = serde_json::from_str(body).unwrap();
    assert_eq!(message["type"], "job.ended");
    let data = &message["data"];
    assert_eq!(
        (&data["id"], &data["state"], &data["label"]),
        (&json!(job), &json!("succeeded"), &json!("drop"))
    );
    assert_eq!(data["lab"], "optics");
    let mut secret = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
    secret.args(["lab", "--data"]).arg(app.data()).args(["webhook-secret", "optics"]);
    let secret = String::from_utf8(secret.output().unwrap().stdout).unwrap();
    let Some(python) = judges() else { return };
    let named: serde_json::Map<String, Value> = headers
        .iter()
        .map(|(name, value)| (name.to_string(), json!(value.to_str().unwrap())))
        .collect();
    let mut judge = Command::new(python);
    judge.arg("tests/judges/read_webhook.py").arg(secret.trim());
    let mut judge = judge.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    writeln!(judge.stdin.take().unwrap(), "{}", json!([named, body])).unwrap();
    let output = judge.wait_with_output().unwrap();
    assert!(output.status.success());
    assert_eq!(serde_json::from_slice::<Value>(&output.stdout).unwrap(), message);
}

#[tokio::test]
async fn webhooks_reach_only_hosts_that_the_administrator_allows() {
    let app = TestApp::with(&["--workers", "0", "--webhook-host", "hooks.lab.example"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let submit = async |hook: &str| {
        let body = json!({"measurement": measurement, "algorithm": "gap-tv", "webhook": hook});
        app.post("/v1/jobs", &body).await
    };
    for hook in
        ["http://127.0.0.1:9/", "https://hooks.lab.example:8443/", "http://169.254.169.254/"]
    {
        let answer = submit(hook).await;
        assert!(answer.problem(422, "invalid_request").contains("--webhook-host"), "{hook}");
        assert_eq!(answer.json()["errors"][0]["pointer"], "/webhook");
    }
    for hook in ["ftp://hooks.lab.example/", "https://me:secret@hooks.lab.example/", "", "hooks"] {
        let answer = submit(hook).await;
        assert_eq!(answer.status.as_u16(), 422, "{hook}: {answer:?}");
    }
    let job = submit("https://hooks.lab.example/sci").await.expect(201).json();
    assert_eq!(job["webhook"]["state"], "pending");
    assert_eq!(job["webhook"]["url"], "https://hooks.lab.example/sci");
}

#[tokio::test]
async fn a_command_runs_when_a_job_has_ended() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv", "label": "it's"});
    let job = app.submit(&body).await;
    let folder = tempfile::tempdir().unwrap();
    let run = |command: &str| {
        let mut watch = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        watch.args(["watch", &job, "--exec", command]).current_dir(&folder);
        watch.env("SCI_RECON_URL", format!("http://{}", app.address())).output().unwrap()
    };
    let output = run("echo \"$JOB_ID $JOB_STATE $JOB_LABEL $JOB_VERDICT\" > ended");
    let text = std::fs::read_to_string(folder.path().join("ended")).unwrap();
    assert!(text.starts_with(&format!("{job} succeeded it's ")), "{text} {output:?}");
    // A watched folder runs it for a refused file, too, once the reason is written.
    std::fs::write(folder.path().join("masks.npy"), Scene::SMALL.masks()).unwrap();
    std::fs::write(folder.path().join("small.npy"), constant(&[1, 8, 8], 0.5)).unwrap();
    let exec = "cat \"$JOB_RESULTS\" > refused; echo \"$JOB_STATE $JOB_FILE\" >> refused";
    let mut watch = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
    watch.args(["watch-folder", ".", "--once", "--settle-seconds", "0.1", "--exec", exec]);
    watch.args(["--masks", "masks.npy", "--algorithm", "gap-tv"]).current_dir(&folder);
    watch.env("SCI_RECON_URL", format!("http://{}", app.address()));
    let output = watch.output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let text = std::fs::read_to_string(folder.path().join("refused")).unwrap();
    assert!(text.contains("size_mismatch") && text.contains("failed /"), "{text}");
    let output = run("exit 7");
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert!(String::from_utf8_lossy(&output.stderr).contains("exit status: 7"), "{output:?}");
}

#[tokio::test]
async fn a_silent_receiver_delays_no_other_lab() {
    let silent = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let other = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let [dead, live] = [&silent, &other].map(|listener| listener.local_addr().unwrap().to_string());
    let app = TestApp::with(&["--workers", "0", "--webhook-host", &format!("{dead},{live}")]).await;
    let [red, blue] =
        ["red", "blue"].map(|lab| app.token(&["create", "--lab", lab, "--role", "submit"]));
    let end_jobs = async |token: &str, host: &str, jobs: usize| {
        app.sign_in(token);
        let (_, measurement) = app.scene(&Scene::SMALL).await;
        let body = json!({"measurement": measurement, "algorithm": "gap-tv", "webhook": format!("http://{host}/")});
        for _ in 0..jobs {
            let job = app.submit(&body).await;
            app.post(&format!("/v1/jobs/{job}/cancel"), &json!({})).await.expect(202);
        }
    };
    tokio::spawn(async move {
        let mut connections = Vec::new();
        while let Ok((connection, _)) = silent.accept().await {
            connections.push(connection);
        }
    });
    end_jobs(&red, &dead, 80).await;
    let received = receive(other);
    let start = Instant::now();
    end_jobs(&blue, &live, 1).await;
    while received.lock().unwrap().is_empty() {
        assert!(start.elapsed() < Duration::from_secs(30), "it waits for the other lab");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

//! Workers on other machines, simulated by real message servers on local ports.

mod deep;
mod hostile;
mod lies;
mod losses;
mod namespaces;
pub mod nodes;
mod proxy;
mod rounds;
mod scale;

use std::collections::BTreeMap;
use std::os::unix::fs::PermissionsExt;
use std::time::{Duration, Instant};

use rustix::process::Signal;
use serde_json::{Value, json};
use tokio::sync::OnceCell;

use self::nodes::{Nats, RemoteWorker};
use crate::app::TestApp;
use crate::faults::results;
use crate::samples::Scene;

/// A job with sixteen tiles, which take a fraction of a second each.
fn job(measurement: &str) -> Value {
    with_iterations(measurement, 700)
}

fn with_iterations(measurement: &str, iterations: u32) -> Value {
    json!({
        "measurement": measurement,
        "algorithm": "gap-tv",
        "tile": {"size": 24, "overlap": 8},
        "schedule": {"stages": [
            {"prior": "tv", "iterations": iterations, "tv_weight": 0.05, "tv_updates": 20},
        ]},
    })
}

/// Results of that job without remote workers.
async fn local() -> &'static BTreeMap<String, String> {
    static RESULTS: OnceCell<BTreeMap<String, String>> = OnceCell::const_new();
    RESULTS.get_or_init(|| alone(job)).await
}

/// Results of a job for the measurement of [`Scene::SMALL`] without remote workers.
async fn alone(job: impl Fn(&str) -> Value) -> BTreeMap<String, String> {
    let app = TestApp::with(&["--workers", "2"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let id = app.submit(&job(&measurement)).await;
    assert_eq!(app.ended(&id).await["state"], "succeeded");
    results(&app, &id).await
}

/// Starts a server whose tiles are computed by remote workers.
async fn served(nats: &Nats, ack_wait: &str) -> TestApp {
    let url = nats.url();
    let nats = ["--workers", "0", "--nats", &url, "--ack-wait", ack_wait];
    TestApp::with(&[nats.as_slice(), &["--verify-fraction", "0"]].concat()).await
}

fn worker(nats: &Nats, more: &[&str]) -> RemoteWorker {
    let url = nats.url();
    RemoteWorker::start(&[&["--nats", url.as_str(), "--pool", "test"], more].concat())
}

/// A metric of the server.
async fn figure(app: &TestApp, name: &str) -> f64 {
    let text = String::from_utf8(app.get("/metrics").await.expect(200).bytes).unwrap();
    let line = text.lines().find_map(|line| line.strip_prefix(name));
    line.unwrap_or_else(|| panic!("no figure {name}")).trim().parse().unwrap()
}

/// The remote workers that the server knows.
async fn workers(app: &TestApp) -> Vec<Value> {
    let system = app.get("/v1/system").await.expect(200).json();
    let listed = system["workers"].as_array().unwrap().clone();
    listed.into_iter().filter(|worker| !worker["pool"].is_null()).collect()
}

/// Waits until a condition holds.
async fn until<F: Future<Output = bool>>(what: &str, mut holds: impl FnMut() -> F) {
    let start = Instant::now();
    while !holds().await {
        assert!(start.elapsed() < Duration::from_secs(60), "{what}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

async fn busy(app: &TestApp) {
    until("a worker has a tile", || async {
        workers(app).await.iter().any(|worker| !worker["task"].is_null())
    })
    .await;
}

/// `sync_interval: always` keeps messages through a power cut. Servers before 2.10 reject it.
#[test]
fn the_configuration_suits_the_version_of_the_message_server() {
    for (version, is_known) in [("2.9.25", false), ("2.10", true), ("2.12.5", true)] {
        let folder = tempfile::tempdir().unwrap();
        let keys = folder.path().join("keys");
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        command.args(["cluster", "init", "--nats-version", version, "--keys"]).arg(&keys);
        // The configuration is for servers elsewhere, so none of this machine tests it.
        let output = command.env("NATS_SERVER", "/nowhere").env("PATH", "").output().unwrap();
        let warnings = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{warnings}");
        let text = std::fs::read_to_string(keys.join("nats-server.conf")).unwrap();
        let is_set = text.lines().any(|line| line.trim() == "sync_interval: always");
        assert_eq!(is_set, is_known, "{version}: {text}");
        assert_eq!(warnings.contains("a power cut may lose"), !is_known, "{version}: {warnings}");
    }
}

#[tokio::test]
async fn a_job_on_remote_workers_gives_the_same_bytes() {
    let Some(nats) = Nats::start(1) else { return };
    let expected = local().await;
    let app = served(&nats, "5").await;
    let _workers = [worker(&nats, &[]), worker(&nats, &[])];
    until("both workers are known", || async { workers(&app).await.len() == 2 }).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let id = app.submit(&job(&measurement)).await;
    busy(&app).await;
    let known = workers(&app).await;
    assert_eq!(known.len(), 2, "{known:#?}");
    let busy_worker = known.iter().find(|worker| !worker["task"].is_null()).unwrap();
    assert_eq!(
        (&busy_worker["pool"], &busy_worker["device"]),
        (&json!("test"), &json!("cpu")),
        "{busy_worker:#}"
    );
    assert!(!busy_worker["host"].as_str().unwrap().is_empty(), "{busy_worker:#}");
    assert_eq!(busy_worker["task"]["kind"], "tile");
    assert_eq!(busy_worker["task"]["job"], id);
    let done = app.ended(&id).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    assert_eq!(results(&app, &id).await, *expected);
    let history = app.get(&format!("/view/jobs/{id}/snapshots/0/tiles/0/history")).await;
    assert!(!history.expect(200).json()["points"].as_array().unwrap().is_empty());
    assert_eq!(figure(&app, "sci_recon_cluster_refused_total").await, 0.0);
    assert_eq!(figure(&app, "sci_recon_cluster_redelivered_total").await, 0.0);
    assert!(figure(&app, "sci_recon_cluster_blob_bytes_total{direction=\"in\"}").await > 0.0);
    nats.emptied().await;
}

#[tokio::test]
async fn moved_masks_give_the_same_bytes_on_remote_workers() {
    fn moved(measurement: &str) -> Value {
        let mut job = with_iterations(measurement, 50);
        job["registration"] = json!({"shift": [0.5, -1.25], "rotation": 0.2, "scale": 0.998});
        job
    }
    let Some(nats) = Nats::start(1) else { return };
    let expected = alone(moved).await;
    let unmoved = alone(|measurement| with_iterations(measurement, 50)).await;
    assert_ne!(expected, unmoved);
    let app = served(&nats, "5").await;
    let _worker = worker(&nats, &[]);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    // The second job finds the first one's windows of masks in the stream, the third one must not.
    for (job, expected) in [
        (moved(&measurement), &expected),
        (moved(&measurement), &expected),
        (with_iterations(&measurement, 50), &unmoved),
    ] {
        let id = app.submit(&job).await;
        let ended = app.ended(&id).await;
        assert_eq!(ended["state"], "succeeded", "{ended:#}");
        assert_eq!(results(&app, &id).await, *expected);
    }
}

#[tokio::test]
async fn each_process_uses_only_the_settings_for_it() {
    let Some(nats) = Nats::start(1) else { return };
    // The server's environment has the address of NATS. Its local workers ignore it, and compute the tiles.
    let environment = [("SCI_RECON_NATS", nats.url())];
    let environment = environment.each_ref().map(|(name, url)| (*name, url.as_str()));
    let app = TestApp::in_environment(&["--workers", "1", "--ack-wait", "5"], &environment).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let id = app.submit(&with_iterations(&measurement, 50)).await;
    let done = app.ended(&id).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    drop(app);
    // A configuration file names a data folder for all commands. A worker on another machine ignores it.
    let app = served(&nats, "5").await;
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("sci.toml");
    std::fs::write(&file, "data = \"/var/lib/sci-recon\"\n").unwrap();
    std::fs::set_permissions(folder.path(), std::fs::Permissions::from_mode(0o755)).unwrap();
    let _worker = worker(&nats, &["--config", file.to_str().unwrap()]);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let id = app.submit(&with_iterations(&measurement, 50)).await;
    let done = app.ended(&id).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
}

#[tokio::test]
async fn a_worker_keeps_a_priority_that_is_lower_than_the_setting() {
    let Some(nats) = Nats::start(1) else { return };
    let app = served(&nats, "5").await;
    let url = nats.url();
    let line = ["--nats", url.as_str(), "--pool", "test"];
    // Only root may raise a priority. `nice` adds to the value of the test.
    let own_priority = rustix::process::getpriority_process(None).unwrap();
    for added in [15, 5] {
        let started = added.to_string();
        let expected = (own_priority + added).clamp(10, 19).to_string();
        let mut worker = RemoteWorker::within(&["nice", "-n", &started], &line);
        until("the worker comes in", || async { workers(&app).await.len() == 1 }).await;
        let stat = format!("/proc/{}/stat", worker.inner().unwrap().as_raw_nonzero());
        let stat = std::fs::read_to_string(stat).unwrap();
        let (_, fields) = stat.rsplit_once(") ").unwrap();
        assert_eq!(fields.split(' ').nth(16), Some(&*expected), "{stat}");
        worker.process.signal(Signal::TERM);
        assert_eq!(worker.process.ended(Duration::from_secs(5)), Some(0));
        until("the worker has ended", || async { workers(&app).await.is_empty() }).await;
    }
}

#[tokio::test]
async fn a_worker_that_is_killed_during_a_tile_costs_one_attempt() {
    let Some(nats) = Nats::start(1) else { return };
    let expected = local().await;
    let app = served(&nats, "2").await;
    let mut first = worker(&nats, &[]);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let id = app.submit(&job(&measurement)).await;
    busy(&app).await;
    first.kill();
    let _second = worker(&nats, &[]);
    let done = app.ended(&id).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    assert_eq!(results(&app, &id).await, *expected);
    assert!(figure(&app, "sci_recon_cluster_redelivered_total").await >= 1.0);
    assert_eq!(figure(&app, "sci_recon_cluster_refused_total").await, 0.0);
}

#[tokio::test]
async fn a_stopping_worker_returns_its_tile() {
    let Some(nats) = Nats::start(1) else { return };
    let app = served(&nats, "60").await;
    let mut first = worker(&nats, &[]);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    app.submit(&with_iterations(&measurement, 9000)).await;
    busy(&app).await;
    let start = Instant::now();
    first.process.signal(Signal::TERM);
    assert_eq!(first.process.ended(Duration::from_secs(5)), Some(0));
    eprintln!("the worker ended after {:?}", start.elapsed());
    until("the worker is removed from the list", || async { workers(&app).await.is_empty() }).await;
    // The tile returns long before its message would be redelivered.
    let _second = worker(&nats, &[]);
    busy(&app).await;
    assert!(start.elapsed() < Duration::from_secs(20), "{:?}", start.elapsed());
    assert_eq!(figure(&app, "sci_recon_cluster_redelivered_total").await, 0.0);
}

#[tokio::test]
async fn a_killed_server_recovers_its_tiles() {
    let Some(nats) = Nats::start(1) else { return };
    let expected = local().await;
    let mut app = served(&nats, "5").await;
    let _workers = [worker(&nats, &[]), worker(&nats, &[])];
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let id = app.submit(&job(&measurement)).await;
    for _ in 0..3 {
        busy(&app).await;
        tokio::time::sleep(Duration::from_millis(rand::random_range(0..400))).await;
        app.restart();
    }
    let done = app.ended(&id).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    assert_eq!(results(&app, &id).await, *expected);
    nats.emptied().await;
}

#[tokio::test]
async fn a_cancellation_reaches_the_worker() {
    let Some(nats) = Nats::start(1) else { return };
    let app = served(&nats, "5").await;
    let _worker = worker(&nats, &[]);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let id = app.submit(&with_iterations(&measurement, 9000)).await;
    busy(&app).await;
    let start = Instant::now();
    app.post(&format!("/v1/jobs/{id}/cancel"), &json!({})).await.expect(202);
    assert_eq!(app.ended(&id).await["state"], "cancelled");
    let took = start.elapsed();
    eprintln!("cancelled after {took:?}");
    assert!(took < Duration::from_secs(5), "{took:?}");
    // The worker is free for the next job.
    let next = app.submit(&with_iterations(&measurement, 50)).await;
    assert_eq!(app.ended(&next).await["state"], "succeeded");
    nats.emptied().await;
}

#[tokio::test]
async fn a_worker_of_another_version_is_rejected_with_both_versions() {
    let Some(nats) = Nats::start(1) else { return };
    let client = nats.client().await;
    // The greeting of a worker of this version.
    let mut hellos = client.subscribe("sci.v1.hello.test").await.unwrap();
    let mut waiting = worker(&nats, &[]);
    let hello = futures_util::StreamExt::next(&mut hellos).await.unwrap();
    drop(hellos);
    let app = served(&nats, "5").await;
    let mut body: Value = serde_json::from_slice(&hello.payload).unwrap();
    body["program"]["version"] = json!("0.0.7");
    let refused = {
        let text = body.to_string();
        let mut answer = None;
        let start = Instant::now();
        while answer.is_none() && start.elapsed() < Duration::from_secs(20) {
            answer = client.request("sci.v1.hello.test", text.clone().into()).await.ok();
        }
        String::from_utf8(answer.unwrap().payload.to_vec()).unwrap()
    };
    assert!(refused.contains("0.0.7") && refused.contains(env!("CARGO_PKG_VERSION")), "{refused}");
    // The waiting worker is accepted.
    until("the worker is accepted", || async { workers(&app).await.len() == 1 }).await;
    assert!(waiting.process.is_running());
    drop(app);
    // A rejected worker ends with the reason.
    let mut hellos = client.subscribe("sci.v1.hello.other").await.unwrap();
    let url = nats.url();
    let mut unwelcome = RemoteWorker::start(&["--nats", &url, "--pool", "other"]);
    let greeting = futures_util::StreamExt::next(&mut hellos).await.unwrap();
    client.publish(greeting.reply.unwrap(), refused.into()).await.unwrap();
    client.flush().await.unwrap();
    assert_eq!(unwelcome.process.ended(Duration::from_secs(10)), Some(2));
    assert!(unwelcome.log().contains("0.0.7"), "{}", unwelcome.log());
}

#[tokio::test]
async fn a_tile_that_fails_on_every_worker_fails_its_job() {
    let Some(nats) = Nats::start(1) else { return };
    let app = served(&nats, "5").await;
    let _worker = worker(&nats, &["--onnxruntime", "/nowhere/lib.so"]);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({
        "measurement": measurement,
        "algorithm": "pnp-tv-fastdvdnet",
        "snapshots": 0,
        "schedule": {"stages": [{"prior": "fastdvdnet", "iterations": 1, "sigma": [0.2, 0.1]}]},
    });
    let done = app.ended(&app.submit(&body).await).await;
    assert_eq!(done["state"], "failed", "{done:#}");
    let error = done["error"].as_str().unwrap();
    assert!(error.contains("lib.so") && !error.contains("/nowhere"), "{error}");
    // The worker is still running and does other tasks.
    let next = app.submit(&with_iterations(&measurement, 50)).await;
    assert_eq!(app.ended(&next).await["state"], "succeeded");
    nats.emptied().await;
}

#[tokio::test]
async fn a_tile_that_kills_its_workers_is_abandoned() {
    let Some(nats) = Nats::start(1) else { return };
    let folder = tempfile::tempdir().unwrap();
    let library = crate::hangs::library(folder.path(), "abort();");
    // The worker runs as another user.
    std::fs::set_permissions(folder.path(), std::fs::Permissions::from_mode(0o755)).unwrap();
    // The time is far longer than the test, so silence redelivers no tile.
    let app = served(&nats, "600").await;
    let mut worker = worker(&nats, &["--onnxruntime", library.to_str().unwrap()]);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({
        "measurement": measurement,
        "algorithm": "pnp-tv-fastdvdnet",
        "snapshots": 0,
        "schedule": {"stages": [{"prior": "fastdvdnet", "iterations": 1, "sigma": [0.2, 0.1]}]},
    });
    let done = app.ended(&app.submit(&body).await).await;
    assert_eq!(done["state"], "failed", "{done:#}");
    let error = done["error"].as_str().unwrap();
    assert!(error.contains("SIGABRT") && error.contains("(3 attempts)"), "{error}");
    // A process killed from outside is also replaced, and its tile is taken up again at once. The
    // job has one long tile: a process that dies between two tiles leaves the next one to
    // `ack_wait`.
    let mut job = with_iterations(&measurement, 3000);
    job["tile"] = json!({"size": 64, "overlap": 8});
    let job = app.submit(&job).await;
    busy(&app).await;
    rustix::process::kill_process(worker.inner().unwrap(), Signal::KILL).unwrap();
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    assert!(worker.process.is_running());
}

#[tokio::test]
async fn an_idle_worker_ends_and_its_cache_serves_the_next() {
    let Some(nats) = Nats::start(1) else { return };
    let app = served(&nats, "5").await;
    let mut first = worker(&nats, &["--exit-when-idle", "2"]);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let id = app.submit(&with_iterations(&measurement, 50)).await;
    assert_eq!(app.ended(&id).await["state"], "succeeded");
    assert_eq!(first.process.ended(Duration::from_secs(20)), Some(0));
    let cached = std::fs::read_dir(first.folder.path().join("cache")).unwrap().count();
    assert!(cached >= 8, "windows of masks: {cached}");
}

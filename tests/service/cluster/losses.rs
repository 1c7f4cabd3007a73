//! Losses on the side of the message server.

use rustix::process::{Pid, Signal, kill_process};
use serde_json::{Value, json};

use super::nodes::Nats;
use super::{alone, busy, figure, served, until, with_iterations, worker};
use crate::app::TestApp;
use crate::faults::results;
use crate::samples::Scene;

async fn repaired(app: &TestApp) -> f64 {
    figure(app, "sci_recon_cluster_repaired_total").await
}

#[tokio::test]
async fn tiles_lost_by_the_message_server_are_sent_again() {
    let Some(mut nats) = Nats::start(1) else { return };
    let long = |measurement: &str| with_iterations(measurement, 2_000);
    let expected = alone(long).await;
    let app = served(&nats, "2").await;
    let _workers = [worker(&nats, &[]), worker(&nats, &[])];
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let id = app.submit(&long(&measurement)).await;
    // There are always more tiles than the workers hold, even if the sweep comes late.
    let behind = app.submit(&with_iterations(&measurement, 9000)).await;
    // Each worker holds one tile, and one waits for it.
    let wait = async || until("tiles wait", || async { nats.messages().await[0].1 >= 4 }).await;
    wait().await;
    // Remove the waiting tiles and all windows.
    nats.purge("SCI_TASKS").await;
    nats.purge("SCI_IN").await;
    until("the sweep finds the missing tiles", || async { repaired(&app).await >= 1.0 }).await;
    wait().await;
    let before = repaired(&app).await;
    // Remove everything, including the streams.
    nats.end(0);
    nats.wipe(0);
    nats.begin(0);
    until("the sweep finds that all tiles are missing", || async { repaired(&app).await > before })
        .await;
    let done = app.ended(&id).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    assert_eq!(results(&app, &id).await, expected);
    eprintln!("{} tiles were sent again", repaired(&app).await);
    app.post(&format!("/v1/jobs/{behind}/cancel"), &json!({})).await.expect(202);
    nats.emptied().await;
}

#[tokio::test]
async fn a_tile_is_sent_again_if_its_report_is_lost() {
    let Some(mut nats) = Nats::start(1) else { return };
    let app = served(&nats, "2").await;
    let _worker = worker(&nats, &[]);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let id = app.submit(&with_iterations(&measurement, 1000)).await;
    busy(&app).await;
    // The message server's disk is lost after the worker's report and before the server reads it.
    let server = Pid::from_raw(app.pid() as i32).unwrap();
    kill_process(server, Signal::STOP).unwrap();
    until("a report waits", || async { nats.messages().await[1].1 > 0 }).await;
    nats.end(0);
    nats.wipe(0);
    nats.begin(0);
    kill_process(server, Signal::CONT).unwrap();
    assert_eq!(app.ended(&id).await["state"], "succeeded");
}

#[tokio::test]
async fn messages_without_a_tile_are_removed() {
    let Some(nats) = Nats::start(1) else { return };
    let _app = served(&nats, "2").await;
    let context = async_nats::jetstream::new(nats.client().await);
    until("the stream of tiles stores the message", async || {
        let Ok(sent) = context.publish("sci.v1.task.test", "of no tile".into()).await else {
            return false;
        };
        sent.await.is_ok()
    })
    .await;
    nats.emptied().await;
}

#[tokio::test]
async fn a_worker_without_a_message_server_stops_on_request() {
    let Some(mut nats) = Nats::start(1) else { return };
    let app = served(&nats, "5").await;
    let mut worker = worker(&nats, &[]);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    app.submit(&with_iterations(&measurement, 9000)).await;
    busy(&app).await;
    nats.end(0);
    let inner = worker.inner().unwrap();
    // The supervisor is killed too, so nothing kills a process that does not stop.
    worker.process.kill();
    let lives = || rustix::process::test_kill_process(inner).is_ok();
    until("it ends", || async { !lives() }).await;
}

async fn ready(app: &TestApp) -> (u16, Value) {
    let answer = app.get("/readyz").await;
    (answer.status.as_u16(), answer.json())
}

#[tokio::test]
async fn a_server_connects_when_the_message_server_appears() {
    let Some(mut nats) = Nats::start(1) else { return };
    nats.end(0);
    let url = nats.url();
    let app = TestApp::with(&["--workers", "1", "--nats", &url, "--ack-wait", "2"]).await;
    until("the worker of this machine is ready", || async { ready(&app).await.0 == 200 }).await;
    let (_, report) = ready(&app).await;
    assert_eq!(report["ready"], true);
    until("readiness names the problem", || async {
        ready(&app).await.1["cluster"].as_str().unwrap().contains("no NATS server answers at")
    })
    .await;
    assert_eq!(ready(&app).await.1["degraded"], true);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let id = app.submit(&with_iterations(&measurement, 50)).await;
    assert_eq!(app.ended(&id).await["state"], "succeeded");
    // Without local workers, the tiles wait for other machines.
    let app = app.again(&["--workers", "0", "--nats", &url, "--ack-wait", "2"]).await;
    until("the local process for other tasks is ready", || async {
        ready(&app).await.1["workers"] == "ok"
    })
    .await;
    let (status, report) = ready(&app).await;
    assert_eq!((status, &report["ready"]), (503, &Value::Bool(false)), "{report}");
    nats.begin(0);
    until("the server connects", || async { ready(&app).await.0 == 200 }).await;
    assert_eq!(ready(&app).await.1["cluster"], "ok");
    let _worker = worker(&nats, &[]);
    let id = app.submit(&with_iterations(&measurement, 50)).await;
    assert_eq!(app.ended(&id).await["state"], "succeeded");
    // The connection may be lost again and restored.
    nats.end(0);
    until("readiness reports the loss", || async { ready(&app).await.0 == 503 }).await;
    assert_eq!(ready(&app).await.1["cluster"], "the connection to NATS is lost");
    nats.begin(0);
    until("the server reconnects", || async { ready(&app).await.0 == 200 }).await;
}

#[tokio::test]
async fn an_invalid_address_or_credential_stops_the_server() {
    let serve = |line: &[&str]| {
        let folder = tempfile::tempdir().unwrap();
        let mut command = crate::app::bounded_program();
        let data = folder.path().join("data");
        let ran = command.args(["serve", "--data"]).arg(data).args(line).output().unwrap();
        assert!(!ran.status.success());
        String::from_utf8(ran.stderr).unwrap()
    };
    let report = serve(&["--listen", "127.0.0.1:0", "--nats", "nowhere at all"]);
    assert!(report.contains("is not an address of a NATS server"), "{report}");
    let report = serve(&["--listen", "127.0.0.1:0", "--nats-creds", "/nowhere/hub.creds"]);
    assert!(report.contains("hub.creds"), "{report}");
}

//! What is not there, or gets lost on the side of the message server.

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
async fn what_the_message_server_loses_is_handed_out_again() {
    let Some(mut nats) = Nats::start(1) else { return };
    let long = |measurement: &str| with_iterations(measurement, 2_000);
    let expected = alone(long).await;
    let app = served(&nats, "2").await;
    let _workers = [worker(&nats, &[]), worker(&nats, &[])];
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let id = app.submit(&long(&measurement)).await;
    // Until the end there are more tiles than the workers hold, however late the sweep comes.
    let behind = app.submit(&with_iterations(&measurement, 9000)).await;
    // Two for each worker: one that it holds, and one that waits for it.
    let wait = async || until("tiles wait", || async { nats.messages().await[0].1 >= 4 }).await;
    wait().await;
    // Tiles that wait, and the windows of all.
    nats.purge("SCI_TASKS").await;
    nats.purge("SCI_IN").await;
    until("the sweep finds what is missing", || async { repaired(&app).await >= 1.0 }).await;
    wait().await;
    let before = repaired(&app).await;
    // All that there is, with the streams themselves.
    nats.end(0);
    nats.wipe(0);
    nats.begin(0);
    until("the sweep finds that all is missing", || async { repaired(&app).await > before }).await;
    let done = app.ended(&id).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    assert_eq!(results(&app, &id).await, expected);
    eprintln!("{} tiles were handed out again", repaired(&app).await);
    app.post(&format!("/v1/jobs/{behind}/cancel"), &json!({})).await.expect(202);
    nats.emptied().await;
}

#[tokio::test]
async fn a_tile_whose_report_is_lost_is_handed_out_again_though_its_worker_lives() {
    let Some(mut nats) = Nats::start(1) else { return };
    let app = served(&nats, "2").await;
    let _worker = worker(&nats, &[]);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let id = app.submit(&with_iterations(&measurement, 1000)).await;
    busy(&app).await;
    // The worker reports to a message server whose disk is lost before the server hears of it.
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
async fn messages_of_no_tile_are_removed() {
    let Some(nats) = Nats::start(1) else { return };
    let _app = served(&nats, "2").await;
    let context = async_nats::jetstream::new(nats.client().await);
    until("a message is taken by the stream of tiles", async || {
        let Ok(sent) = context.publish("sci.v1.task.test", "of no tile".into()).await else {
            return false;
        };
        sent.await.is_ok()
    })
    .await;
    nats.emptied().await;
}

#[tokio::test]
async fn a_worker_without_a_message_server_ends_when_it_is_told_to() {
    let Some(mut nats) = Nats::start(1) else { return };
    let app = served(&nats, "5").await;
    let mut worker = worker(&nats, &[]);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    app.submit(&with_iterations(&measurement, 9000)).await;
    busy(&app).await;
    nats.end(0);
    let inner = worker.inner().unwrap();
    // The process that watches over it is gone as well: nobody kills what does not end.
    worker.process.kill();
    let lives = || rustix::process::test_kill_process(inner).is_ok();
    until("it ends", || async { !lives() }).await;
}

async fn ready(app: &TestApp) -> (u16, Value) {
    let answer = app.get("/readyz").await;
    (answer.status.as_u16(), answer.json())
}

#[tokio::test]
async fn a_server_that_finds_no_message_server_goes_on_and_finds_it_later() {
    let Some(mut nats) = Nats::start(1) else { return };
    nats.end(0);
    let url = nats.url();
    let app = TestApp::with(&["--workers", "1", "--nats", &url, "--ack-wait", "2"]).await;
    until("the worker of this machine is there", || async { ready(&app).await.0 == 200 }).await;
    let (_, said) = ready(&app).await;
    assert_eq!(said["ready"], true);
    until("it says what is wrong", || async {
        ready(&app).await.1["cluster"].as_str().unwrap().contains("no NATS server answers at")
    })
    .await;
    assert_eq!(ready(&app).await.1["degraded"], true);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let id = app.submit(&with_iterations(&measurement, 50)).await;
    assert_eq!(app.ended(&id).await["state"], "succeeded");
    // Where all tiles are left to others, nothing goes on.
    let app = app.again(&["--workers", "0", "--nats", &url, "--ack-wait", "2"]).await;
    until("the process for all else is there", || async { ready(&app).await.1["workers"] == "ok" })
        .await;
    let (status, said) = ready(&app).await;
    assert_eq!((status, &said["ready"]), (503, &Value::Bool(false)), "{said}");
    nats.begin(0);
    until("the server finds it", || async { ready(&app).await.0 == 200 }).await;
    assert_eq!(ready(&app).await.1["cluster"], "ok");
    let _worker = worker(&nats, &[]);
    let id = app.submit(&with_iterations(&measurement, 50)).await;
    assert_eq!(app.ended(&id).await["state"], "succeeded");
    // It may be lost again, and found.
    nats.end(0);
    until("the loss is said", || async { ready(&app).await.0 == 503 }).await;
    assert_eq!(ready(&app).await.1["cluster"], "the connection to NATS is lost");
    nats.begin(0);
    until("it is found again", || async { ready(&app).await.0 == 200 }).await;
}

#[tokio::test]
async fn an_address_or_a_credential_that_can_not_be_ends_the_server() {
    let serve = |line: &[&str]| {
        let folder = tempfile::tempdir().unwrap();
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        let data = folder.path().join("data");
        let ran = command.args(["serve", "--data"]).arg(data).args(line).output().unwrap();
        assert!(!ran.status.success());
        String::from_utf8(ran.stderr).unwrap()
    };
    let said = serve(&["--listen", "127.0.0.1:0", "--nats", "nowhere at all"]);
    assert!(said.contains("is no address of a NATS server"), "{said}");
    let said = serve(&["--listen", "127.0.0.1:0", "--nats-creds", "/nowhere/hub.creds"]);
    assert!(said.contains("hub.creds"), "{said}");
}

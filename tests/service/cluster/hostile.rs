//! Rights of a pool's credential against other pools, over TLS.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use async_nats::{Client, ConnectOptions, Event, HeaderMap};
use serde_json::json;

use super::nodes::{Nats, RemoteWorker};
use super::{busy, until, with_iterations, workers};
use crate::app::TestApp;
use crate::samples::Scene;

/// Starts the server over TLS with its own credential.
async fn secured(nats: &Nats) -> TestApp {
    let hub = nats.hub();
    TestApp::with(&["--workers", "0", "--nats-creds", hub.to_str().unwrap(), "--ack-wait", "5"])
        .await
}

/// Connects with a worker's credential; returns the client and the rejections of the message
/// server.
async fn intruder(nats: &Nats, pool: &str) -> (Client, Arc<Mutex<Vec<String>>>) {
    let path = nats.credential(pool);
    let text = std::fs::read_to_string(&path).unwrap();
    let inbox = text.lines().find_map(|line| line.strip_prefix("inbox: ")).unwrap().to_owned();
    let refused: Arc<Mutex<Vec<String>>> = Arc::default();
    let heard = refused.clone();
    let client = ConnectOptions::with_credentials(&text)
        .unwrap()
        .custom_inbox_prefix(inbox)
        .request_timeout(Some(Duration::from_millis(700)))
        .add_root_certificates(nats.keys().join("ca.pem"))
        .event_callback(move |event| {
            let heard = heard.clone();
            async move {
                if let Event::ServerError(error) = event {
                    heard.lock().unwrap().push(error.to_string().to_lowercase());
                }
            }
        })
        .connect(format!("tls://127.0.0.1:{}", nats.ports[0]))
        .await
        .unwrap();
    (client, refused)
}

#[tokio::test]
async fn a_credential_is_limited_to_the_subjects_of_its_pool() {
    let Some(nats) = Nats::secured(1, &[]) else { return };
    let app = secured(&nats).await;
    let _worker = RemoteWorker::with_credential(&nats.credential("a"), &[]);
    // A tile of the whole picture lasts longer than the checks of one attempt.
    let (_, measurement) =
        app.scene(&Scene { snapshots: 1, height: 96, width: 128, frames: 8 }).await;
    let mut long = with_iterations(&measurement, 9000);
    long["tile"] = json!({"size": 128, "overlap": 8});
    let job = app.submit(&long).await;
    busy(&app).await;
    let input_subject = nats.subject_in("SCI_IN").await;
    let worker = workers(&app).await[0]["id"].as_str().unwrap().to_owned();
    let (client, refused) = intruder(&nats, "b").await;

    // Messages that only the pool's workers may publish. Each publication is rejected by name.
    let direct = format!("$JS.API.DIRECT.GET.SCI_IN.{input_subject}");
    let publish = [
        "sci.v1.task.a",
        "sci.v1.task.b",
        "sci.v1.event.a",
        "sci.v1.begin.a",
        "sci.v1.beat.a",
        "sci.v1.want.a",
        "sci.v1.hello.a",
        "sci.v1.tell.a.x",
        "sci.v1.tell.b.x",
        &input_subject,
        "sci.v1.in.b.x.0",
        "sci.v1.out.a.x.1.y.0",
        &direct,
        "$JS.API.CONSUMER.MSG.NEXT.SCI_TASKS.a",
        "$JS.API.CONSUMER.INFO.SCI_TASKS.a",
        "$JS.API.CONSUMER.MSG.NEXT.SCI_EVENTS.hub-b",
        "$JS.API.CONSUMER.LIST.SCI_TASKS",
        "$JS.API.CONSUMER.CREATE.SCI_TASKS",
        "$JS.API.CONSUMER.DURABLE.CREATE.SCI_TASKS.b",
        "$JS.API.CONSUMER.CREATE.SCI_TASKS.x.sci.v1.task.a",
        "$JS.API.CONSUMER.DELETE.SCI_TASKS.a",
        "$JS.API.STREAM.MSG.GET.SCI_TASKS",
        "$JS.API.STREAM.MSG.GET.SCI_IN",
        "$JS.API.DIRECT.GET.SCI_IN",
        "$JS.API.DIRECT.GET.SCI_OUT.sci.v1.out.b.x",
        "$JS.API.STREAM.PURGE.SCI_TASKS",
        "$JS.API.STREAM.PURGE.SCI_IN",
        "$JS.API.STREAM.PURGE.SCI_OUT",
        "$JS.API.STREAM.DELETE.SCI_TASKS",
        "$JS.API.STREAM.MSG.DELETE.SCI_TASKS",
        "$JS.API.STREAM.INFO.SCI_TASKS",
        "$JS.API.STREAM.LIST",
        "$JS.API.STREAM.NAMES",
        "$JS.API.STREAM.CREATE.MINE",
        "$JS.API.STREAM.UPDATE.SCI_IN",
        "$JS.API.INFO",
        "$JS.ACK.SCI_TASKS.a.1.1.1.1.0",
        "$JS.ACK.SCI_EVENTS.hub-b.1.1.1.1.0",
        "$SYS.REQ.CLAIMS.UPDATE",
        "$SYS.REQ.SERVER.PING",
        "_INBOX.x",
    ];
    for subject in publish {
        client.publish(subject.to_owned(), "{}".into()).await.unwrap();
        client.flush().await.unwrap();
    }
    let wanted =
        ["sci.v1.>", "sci.v1.tell.a.>", "sci.v1.out.>", "_INBOX.>", "$JS.>", "$SYS.>", ">"];
    for subject in wanted {
        let _ = client.subscribe(subject).await.unwrap();
        client.flush().await.unwrap();
    }
    until("all rejections have arrived", || async {
        refused.lock().unwrap().len() >= publish.len() + wanted.len()
    })
    .await;
    let report = refused.lock().unwrap().join("\n");
    for subject in publish {
        let line = format!("publish to \"{}\"", subject.to_lowercase());
        assert!(report.contains(&line), "{subject} was not rejected:\n{report}");
        eprintln!("refused: publish to {subject}");
    }
    for subject in wanted {
        let line = format!("subscription to \"{}\"", subject.to_lowercase());
        assert!(report.contains(&line), "{subject} was not rejected:\n{report}");
        eprintln!("refused: subscribe to {subject}");
    }

    // Valid messages in the name of one pool do not affect the other.
    let task = workers(&app).await[0].clone();
    let (task_id, attempt) = running(app.data(), &job).await;
    let forged = json!({"task": task_id, "attempt": attempt, "worker": worker,
        "end": {"failed": {"reason": "forged", "retry": false}}});
    let context = async_nats::jetstream::new(client.clone());
    let mut headers = HeaderMap::new();
    headers.insert("Nats-Msg-Id", "forged");
    let sent = context.publish_with_headers("sci.v1.event.b", headers, forged.to_string().into());
    sent.await.unwrap().await.unwrap();
    let forged =
        json!({"task": task_id, "attempt": attempt, "seq": 1, "delivery": 9, "worker": worker});
    let answer = client.request("sci.v1.begin.b", forged.to_string().into()).await.unwrap();
    assert_eq!(&answer.payload[..], b"\"over\"", "the attempt belongs to another pool");
    let forged = json!({"worker": worker, "tile": null, "leaves": true});
    client.publish("sci.v1.beat.b", forged.to_string().into()).await.unwrap();
    client.flush().await.unwrap();
    until("the forged event is dropped", || async {
        nats.messages().await.contains(&("SCI_EVENTS".to_owned(), 0))
    })
    .await;
    tokio::time::sleep(Duration::from_millis(300)).await;
    assert_eq!(workers(&app).await.len(), 1, "the worker is still known: {task:#}");
    assert_eq!(running(app.data(), &job).await, (task_id, attempt), "nobody has ended it");
    app.post(&format!("/v1/jobs/{job}/cancel"), &json!({})).await.expect(202);
    assert_eq!(app.ended(&job).await["state"], "cancelled");
}

/// The identifier and attempt of a tile that a worker holds.
async fn running(data: &std::path::Path, job: &str) -> (String, i64) {
    use sqlx::Connection;
    let path = data.join("sci-recon.db");
    let options = sqlx::sqlite::SqliteConnectOptions::new().filename(path).read_only(true);
    let mut connection = sqlx::SqliteConnection::connect_with(&options).await.unwrap();
    let query = "SELECT id, tasks.attempt FROM tasks JOIN remote_tasks ON task = id
                 WHERE job = ? AND delivery > 0";
    sqlx::query_as(query).bind(job).fetch_one(&mut connection).await.unwrap()
}

#[tokio::test]
async fn a_revoked_credential_is_disconnected() {
    let Some(nats) = Nats::secured(1, &[]) else { return };
    let app = secured(&nats).await;
    let (kept, lost) = (nats.credential("kept"), nats.credential("lost"));
    use std::os::unix::fs::PermissionsExt;
    assert_eq!(std::fs::metadata(&lost).unwrap().permissions().mode() & 0o777, 0o600);
    let mut first = RemoteWorker::with_credential(&kept, &[]);
    let mut second = RemoteWorker::with_credential(&lost, &[]);
    until("both workers are known", || async { workers(&app).await.len() == 2 }).await;
    let listed = nats.cluster(&["worker", "list"]).unwrap();
    assert_eq!(listed.matches(" valid ").count(), 2, "{listed}");
    let start = Instant::now();
    let revoked = nats.cluster(&["worker", "revoke", "--pool", "lost"]).unwrap();
    assert_eq!(revoked, "revoked lost\n");
    let (client, _) = (nats.client().await, ());
    let mut beats = client.subscribe("sci.v1.beat.lost").await.unwrap();
    client.flush().await.unwrap();
    // A connected worker sends a heartbeat every five seconds. The disconnected one sends none.
    let heard =
        tokio::time::timeout(Duration::from_secs(7), futures_util::StreamExt::next(&mut beats));
    assert!(heard.await.is_err(), "the worker still sends heartbeats");
    eprintln!("disconnected at most {:?} after the start of the revocation", start.elapsed());
    let text = std::fs::read_to_string(&lost).unwrap();
    let reconnected = ConnectOptions::with_credentials(&text)
        .unwrap()
        .add_root_certificates(nats.keys().join("ca.pem"))
        .connect(format!("tls://127.0.0.1:{}", nats.ports[0]))
        .await;
    assert!(reconnected.is_err(), "a revoked credential can't connect");
    // The worker ends with the reason, and so does one that is started with the credential.
    let mut third = RemoteWorker::with_credential(&lost, &[]);
    for worker in [&mut second, &mut third] {
        assert_eq!(worker.process.ended(Duration::from_secs(40)), Some(2));
        assert!(worker.log().contains("refuses the credential"), "{}", worker.log());
    }
    let mut check = std::process::Command::new(env!("CARGO_BIN_EXE_sci-recon"));
    let ran = check.args(["cluster", "check", "--nats-creds"]).arg(&lost).output().unwrap();
    let stderr = String::from_utf8(ran.stderr).unwrap();
    assert!(ran.status.code() == Some(2) && stderr.contains("authorization violation"), "{stderr}");
    assert!(first.process.is_running());
    let listed = nats.cluster(&["worker", "list"]).unwrap();
    assert!(listed.contains("revoked") && listed.matches(" valid ").count() == 1, "{listed}");
    // The hub drops a silent worker after fifteen seconds. Tiles sent to a pool without workers
    // return later.
    until("the disconnected worker is dropped", || async { workers(&app).await.len() == 1 }).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let job = app.submit(&with_iterations(&measurement, 50)).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded", "the other pool works");
}

#[tokio::test]
async fn the_check_command_names_missing_parts() {
    let Some(nats) = Nats::secured(1, &["--no-tls"]) else { return };
    let hub = nats.hub();
    let program = env!("CARGO_BIN_EXE_sci-recon");
    let check = |path: &std::path::Path| {
        let mut command = std::process::Command::new(program);
        let ran = command.args(["cluster", "check", "--nats-creds"]).arg(path).output().unwrap();
        (ran.status.success(), String::from_utf8(ran.stdout).unwrap())
    };
    let worker = nats.credential("a");
    let (good, report) = check(&worker);
    assert!(
        !good && report.contains("missing welcome") && report.contains("sci-recon serve"),
        "{report}"
    );
    let (good, report) = check(&hub);
    assert!(
        good && report.contains("MB/s") && report.contains("clocks") && report.contains("ms"),
        "{report}"
    );
    let app = TestApp::with(&["--workers", "0", "--nats-creds", hub.to_str().unwrap()]).await;
    until("the check of a worker succeeds", || async {
        let (good, report) = check(&worker);
        eprintln!("{report}");
        good && report.contains("clocks")
    })
    .await;
    drop(app);
}

//! The audit log: who changed what, from which address.

use std::path::Path;
use std::process::Command;

use futures_util::future::join_all;
use reqwest::Method;
use serde_json::{Value, json};

use crate::app::{TestApp, id};
use crate::limits::entitle;
use crate::samples::Scene;

fn lines(path: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(path).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// The only line with this action.
#[track_caller]
fn only(lines: &[Value], action: &str) -> Value {
    let found: Vec<_> = lines.iter().filter(|line| line["action"] == action).collect();
    assert_eq!(found.len(), 1, "{action}: {lines:#?}");
    found[0].clone()
}

#[tokio::test]
async fn each_change_leaves_one_line_with_its_author_address_and_object() {
    let folder = tempfile::tempdir().unwrap();
    let (file, log) = (folder.path().join("audit.jsonl"), folder.path().join("server.log"));
    let path = file.to_str().unwrap();
    let arguments = ["--workers", "0", "--trusted-proxies", "127.0.0.1", "--audit-log", path];
    let logged = [&arguments[..], &["--log-format", "json"]].concat();
    let app = TestApp::logging(&log, "info", &logged).await;
    // The commands find the file of the running service.
    let secret = app.token(&["create", "--lab", "optics", "--note", "bench \"3\""]);
    let created = only(&lines(&file), "token create");
    assert_eq!((&created["actor"], &created["lab"]), (&json!("command"), &json!("optics")));
    assert!(created["user"].as_str().unwrap().starts_with("uid "), "{created}");
    let token = created["object"].clone();
    entitle(&app, &["spare", "--new", "--share", "2"]);
    let reader = app.token(&["create", "--lab", "spare", "--role", "read"]);
    app.sign_in(&secret);
    let (calibration, measurement) = app.scene(&Scene::SMALL).await;
    let unused = app.upload(b"sent and not used".to_vec()).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    let before = lines(&file).len();
    app.post("/v1/jobs/estimate", &body).await.expect(200);
    app.get("/v1/jobs").await.expect(200);
    assert_eq!(lines(&file).len(), before, "nothing was changed");
    let from = |request: reqwest::RequestBuilder| request.header("x-forwarded-for", "192.0.2.7");
    let submit = from(app.request(Method::POST, "/v1/jobs")).header("x-request-id", "r-1");
    let job = id(&app.send(submit.json(&body)).await.expect(201));
    let rename =
        app.request(Method::PATCH, &format!("/v1/jobs/{job}")).json(&json!({"label": "b"}));
    app.send(rename).await.expect(200);
    app.delete(&format!("/v1/jobs/{job}")).await.problem(409, "illegal_state");
    app.sign_in(&reader);
    app.post(&format!("/v1/jobs/{job}/cancel"), &json!({})).await.problem(403, "forbidden");
    app.sign_out();
    let session = app.send(app.request(Method::POST, "/view/session").bearer_auth(&secret)).await;
    let cookie = session.header("set-cookie").split(';').next().unwrap().to_owned();
    let cancel =
        app.request(Method::POST, &format!("/v1/jobs/{job}/retry")).header("cookie", cookie);
    app.send(cancel.header("x-requested-with", "page")).await.problem(409, "illegal_state");

    let found = lines(&file);
    let submitted = only(&found, "POST /v1/jobs");
    for (name, value) in [
        ("actor", json!("token")),
        ("token", token.clone()),
        ("note", json!("bench \"3\"")),
        ("lab", json!("optics")),
        ("address", json!("192.0.2.7")),
        ("object", json!(job)),
        ("outcome", json!("done")),
        ("status", json!(201)),
        ("request", json!("r-1")),
    ] {
        assert_eq!(submitted[name], value, "{name} in {submitted}");
    }
    assert_eq!(only(&found, "POST /v1/calibrations")["object"], json!(calibration));
    assert_eq!(only(&found, "PATCH /v1/jobs/{job}")["object"], json!(job));
    assert_eq!(only(&found, "lab set")["object"], "spare");
    let deleted = only(&found, "DELETE /v1/jobs/{job}");
    assert_eq!((&deleted["outcome"], &deleted["status"]), (&json!("refused"), &json!(409)));
    let forbidden = only(&found, "POST /v1/jobs/{job}/cancel");
    assert_eq!((&forbidden["status"], &forbidden["lab"]), (&json!(403), &json!("spare")));
    let retried = only(&found, "POST /v1/jobs/{job}/retry");
    assert_eq!((&retried["actor"], &retried["token"]), (&json!("session"), &token));

    // The log of the service has the same lines, and each line its span once.
    let text = std::fs::read_to_string(&log).unwrap();
    for secret in [&secret, &reader] {
        assert!(!text.contains(secret.as_str()), "a secret in the log");
        assert!(!std::fs::read_to_string(&file).unwrap().contains(secret.as_str()));
    }
    let logged = lines(&log);
    let audits: Vec<_> = logged.iter().filter(|line| line["target"] == "audit").collect();
    let by_requests = found.iter().filter(|line| line["actor"] != "command").count();
    assert_eq!(audits.len(), by_requests);
    let submitted_line =
        audits.iter().find(|line| line["fields"]["action"] == "POST /v1/jobs").unwrap();
    assert_eq!(submitted_line["fields"]["object"], json!(job));
    assert_eq!(submitted_line["span"]["id"], "r-1");
    assert!(logged.iter().all(|line| line.get("spans").is_none()), "the span is repeated");

    // A rotated file is made again.
    std::fs::rename(&file, folder.path().join("audit.jsonl.1")).unwrap();
    app.sign_in(&secret);
    app.post(&format!("/v1/jobs/{job}/cancel"), &json!({})).await.expect(202);
    app.token(&["revoke", token.as_str().unwrap()]);
    let found = lines(&file);
    assert_eq!(found.len(), 2);
    let revoked = only(&found, "token revoke");
    assert_eq!((&revoked["object"], &revoked["lab"]), (&token, &json!("optics")));

    // The service deletes expired data. Its age counts the time for which the service ran, which is set to the present.
    let mut database = app.database().await;
    let present = sqlx::query("UPDATE clock SET wall = (unixepoch() + 1) * 1000");
    present.execute(&mut database).await.unwrap();
    drop(database);
    let expired = ["--upload-hours", "0", "--job-days", "0"];
    let app = app.again(&[&arguments[..], &expired].concat()).await;
    let start = std::time::Instant::now();
    let found = loop {
        let found = lines(&file);
        if found.iter().any(|line| line["action"] == "delete ended job") {
            break found;
        }
        assert!(start.elapsed().as_secs() < 30, "{found:#?}");
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    };
    for (action, object) in [("delete ended job", &job), ("delete unused upload", &unused)] {
        let deletion = only(&found, action);
        assert_eq!(deletion["object"], json!(object));
        assert_eq!((&deletion["actor"], &deletion["lab"]), (&json!("service"), &json!("optics")));
    }
    drop(app);
}

#[tokio::test]
async fn without_a_writable_audit_log_nothing_is_changed() {
    let app = TestApp::start().await;
    let token = |file: &Path| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        command.args(["token", "--data"]).arg(app.data()).arg("--audit-log").arg(file);
        command.args(["create", "--lab", "a"]).output().unwrap()
    };
    let output = token(app.data());
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(2) && text.contains("nothing was changed"), "{text}");
    app.get("/v1/jobs").await.expect(200);
    let file = app.data().join("audit.jsonl");
    assert!(token(&file).status.success());
    only(&lines(&file), "token create");
    let nowhere = app.data().join("no/folder").display().to_string();
    let none = TestApp::try_in_environment(&["--workers", "0", "--audit-log", &nowhere], &[]).await;
    assert!(none.is_none(), "the service starts without its audit log");
}

#[tokio::test]
async fn failed_sign_ins_are_recorded_and_bounded() {
    let folder = tempfile::tempdir().unwrap();
    let (file, log) = (folder.path().join("audit.jsonl"), folder.path().join("server.log"));
    let path = file.to_str().unwrap();
    let arguments = ["--workers", "0", "--trusted-proxies", "127.0.0.1", "--audit-log", path];
    let app = TestApp::logging(&log, "info", &arguments).await;
    let token = app.token(&["create", "--lab", "a"]);
    let before = std::fs::metadata(&log).unwrap().len();
    let wrong = format!("sci_{}", "0".repeat(64));
    let ask = |token: &str, address: &str| {
        let request = app.request(Method::GET, "/v1/jobs").bearer_auth(token);
        app.send(request.header("x-forwarded-for", address))
    };
    const FLOOD: usize = 2000;
    let mut refused = [0; 2];
    for _ in 0..FLOOD / 20 {
        for answer in join_all((0..20).map(|_| ask(&wrong, "192.0.2.1"))).await {
            match answer.status.as_u16() {
                401 => refused[0] += 1,
                429 => {
                    answer.problem(429, "rate_limited");
                    assert!(!answer.header("retry-after").is_empty());
                    refused[1] += 1;
                }
                other => panic!("{other}"),
            }
        }
    }
    assert!(refused[0] >= 100 && refused[1] > FLOOD / 2, "{refused:?}");
    // Neither the owner of a token at this address nor anyone elsewhere suffers.
    ask(&token, "192.0.2.1").await.expect(200);
    ask(&wrong, "192.0.2.2").await.problem(401, "unauthorized");
    // Requests without any credential are no sign-ins, but strangers can flood the log by them as well.
    for _ in 0..500 {
        let request =
            app.request(Method::POST, "/v1/nowhere").header("x-forwarded-for", "192.0.2.3");
        app.send(request).await.problem(404, "not_found");
    }
    tokio::time::sleep(std::time::Duration::from_millis(1500)).await;
    let written = std::fs::metadata(&log).unwrap().len() - before;
    assert!(written < 100_000, "{written} bytes of log");
    let found = lines(&file);
    let sign_ins: Vec<_> = found.iter().filter(|line| line["action"] == "sign-in").collect();
    let first = sign_ins[0];
    assert_eq!((&first["address"], &first["status"]), (&json!("192.0.2.1"), &json!(401)));
    assert_eq!(first["object"], "GET /v1/jobs");
    let left_out: u64 = sign_ins.iter().filter_map(|line| line["left_out"].as_u64()).sum();
    let written = sign_ins.iter().filter(|line| line["left_out"].is_null()).count();
    assert_eq!(written + left_out as usize, FLOOD + 1, "each sign-in is written or counted");
    assert!(!std::fs::read_to_string(&file).unwrap().contains(&wrong));
}

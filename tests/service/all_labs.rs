//! Tokens for all labs, expiring tokens, and browser sessions.

use std::time::Duration;

use reqwest::{Method, RequestBuilder};
use serde_json::{Value, json};

use crate::app::{Answer, TestApp, id};
use crate::samples::Scene;

/// A service, its tokens (of lab `a`, of lab `b`, for all labs), and a job of the lab `a`.
async fn three_tokens() -> (TestApp, [String; 3], String) {
    let app = TestApp::start().await;
    let a = app.token(&["create", "--lab", "a"]);
    let b = app.token(&["create", "--lab", "b", "--role", "admin"]);
    let all_labs = app.token(&["create", "--lab", "ops", "--role", "admin", "--all-labs"]);
    app.sign_in(&a);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    let job = id(&app.post("/v1/jobs", &body).await.expect(201));
    (app, [a, b, all_labs], job)
}

#[tokio::test]
async fn only_a_token_for_all_labs_sets_a_high_priority() {
    let (app, [a, _, all], job) = three_tokens().await;
    app.sign_in(&a);
    let path = format!("/v1/jobs/{job}");
    let measurement = app.get(&path).await.json()["measurement"].clone();
    let with = |priority: i32| json!({"measurement": measurement, "algorithm": "gap-tv", "priority": priority});
    for priority in [1, 100] {
        for refused in [
            app.post("/v1/jobs", &with(priority)).await,
            app.post("/v1/jobs/estimate", &with(priority)).await,
            app.send(app.request(Method::PATCH, &path).json(&json!({"priority": priority}))).await,
        ] {
            let detail = refused.problem(422, "invalid_request");
            assert!(detail.contains("-100 to 0"), "{detail}");
            assert_eq!(refused.json()["pointer"], "/priority");
        }
    }
    app.post("/v1/jobs", &with(-3)).await.expect(201);
    app.sign_in(&all);
    app.post("/v1/jobs/estimate?lab=a", &with(100)).await.expect(200);
}

#[tokio::test]
async fn only_a_token_for_all_labs_sees_and_changes_other_labs() {
    let (app, [a, b, all], job) = three_tokens().await;
    app.sign_in(&all);
    assert_eq!(app.get("/v1/jobs").await.json()["items"], json!([]), "its own lab has none");
    let listed = app.get("/v1/jobs?lab=*").await.expect(200).json();
    assert_eq!(listed["items"][0]["id"], job.as_str());
    assert_eq!(listed["items"][0]["lab"], "a");
    assert_eq!(app.get("/v1/jobs?state=queued&lab=%2A").await.json(), listed);
    assert_eq!(app.get("/v1/jobs?lab=a&limit=5").await.json(), listed);
    assert_eq!(app.get("/v1/jobs?lab=b").await.json()["items"], json!([]));
    app.get("/v1/jobs?lab=nowhere").await.problem(404, "not_found");
    app.get("/v1/blobs?lab=*").await.problem(404, "not_found");
    assert_eq!(app.get("/v1/blobs?lab=a").await.json()["items"].as_array().unwrap().len(), 2);
    // It may change a priority, cancel, and set a limit.
    let job_path = format!("/v1/jobs/{job}");
    app.get(&job_path).await.problem(404, "not_found");
    let change = app.request(Method::PATCH, &format!("{job_path}?lab=a"));
    let changed = app.send(change.json(&json!({"priority": 7}))).await.expect(200);
    assert_eq!(changed.json()["priority"], 7);
    app.post(&format!("{job_path}/cancel?lab=a"), &json!({})).await.expect(202);
    assert_eq!(app.get(&format!("{job_path}?lab=a")).await.json()["state"], "cancelled");
    let set = |body: Value| app.send(app.request(Method::PATCH, "/v1/labs/a").json(&body));
    let lab =
        set(json!({"share": 2.5, "bytes": 1_000_000_000, "jobs": 3})).await.expect(200).json();
    assert_eq!(lab["share"], 2.5);
    assert_eq!(lab["limits"], json!({"bytes": 1_000_000_000, "jobs": 3}));
    assert!(lab["use"]["bytes"].as_u64().unwrap() > 0, "{lab}");
    let lab = set(json!({"bytes": null})).await.expect(200).json();
    assert_eq!(lab["limits"], json!({"bytes": null, "jobs": 3}));
    set(json!({"share": 0})).await.problem(422, "invalid_request");
    let names = |answer: Answer| -> Vec<String> {
        let items = answer.json()["items"].as_array().unwrap().clone();
        items.iter().map(|lab| lab["lab"].as_str().unwrap().to_owned()).collect()
    };
    assert_eq!(names(app.get("/v1/labs").await.expect(200)), ["a", "b", "ops"]);
    app.get("/v1/labs/nowhere").await.problem(404, "not_found");
    // A token for all labs with the role `read` changes nothing.
    app.sign_in(&app.token(&["create", "--lab", "ops", "--role", "read", "--all-labs"]));
    app.get("/v1/labs").await.expect(200);
    set(json!({"share": 9})).await.problem(403, "forbidden");
    app.delete(&format!("{job_path}?lab=a")).await.problem(403, "forbidden");
    // An admin of one lab has no access to other labs, whether they exist or not.
    app.sign_in(&b);
    for path in
        ["/v1/jobs?lab=a", "/v1/jobs?lab=*", "/v1/jobs?lab=nowhere", "/v1/labs", "/v1/labs/a"]
    {
        app.get(path).await.problem(403, "forbidden");
    }
    assert_eq!(app.get("/v1/jobs?lab=b").await.json()["items"], json!([]));
    app.delete(&format!("{job_path}?lab=a")).await.problem(403, "forbidden");
    app.sign_in(&a);
    assert_eq!(app.get("/v1/me").await.json()["limits"]["lab_jobs"], 3);
}

#[tokio::test]
async fn the_command_line_sees_and_changes_all_labs() {
    let (app, [a, ..], job) = three_tokens().await;
    let command = |arguments: &[&str]| {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        let output = command.args(arguments).env("SCI_RECON_DATA", app.data()).output().unwrap();
        let text = [output.stdout, output.stderr].concat();
        (output.status.code().unwrap(), String::from_utf8(text).unwrap())
    };
    let (code, listed) = command(&["job", "list"]);
    assert!(code == 0 && listed.contains(&job) && listed.contains("queued"), "{listed}");
    assert_eq!(command(&["job", "list", "--lab", "b"]).1.lines().count(), 1);
    assert_eq!(command(&["job", "list", "--state", "running,failed"]).1.lines().count(), 1);
    assert_eq!(command(&["job", "priority", &job, "-5"]).0, 0);
    assert_eq!(command(&["job", "priority", &job, "500"]).0, 2);
    app.sign_in(&a);
    let path = format!("/v1/jobs/{job}");
    let found = app.get(&path).await.json();
    assert_eq!(found["priority"], -5);
    let body = json!({"measurement": found["measurement"], "algorithm": "gap-tv"});
    assert_eq!(command(&["job", "delete", &job]).0, 2, "it has not ended");
    assert!(command(&["job", "cancel", &job]).1.contains("cancelled"));
    assert_eq!(app.get(&path).await.json()["state"], "cancelled");
    assert!(command(&["job", "retry", &job]).1.contains("queued"));
    command(&["job", "cancel", &job]);
    assert_eq!(command(&["job", "delete", &job]).0, 0);
    app.get(&path).await.problem(404, "not_found");
    assert_eq!(command(&["job", "cancel", &job]).0, 2);

    let all = ["job", "delete", "--all", "--lab", "a"];
    let submit = async || id(&app.post("/v1/jobs", &body).await.expect(201));
    let jobs = [submit().await, submit().await, submit().await];
    jobs[..2].iter().for_each(|job| drop(command(&["job", "cancel", job])));
    for wrong in
        [&["job", "delete"][..], &["job", "delete", "--all"], &["job", "delete", &jobs[0], "--all"]]
    {
        assert_eq!(command(wrong).0, 2, "{wrong:?}");
    }
    let (code, text) = command(&[&all[..], &["--state", "queued", "--yes"]].concat());
    assert!(code == 2 && text.contains("cancel them first"), "{text}");
    let (code, text) = command(&all);
    assert!(code == 2 && text.contains("2 jobs of a") && text.contains("--yes"), "{text}");
    let (_, text) = command(&[&all[..], &["--state", "failed", "--yes"]].concat());
    assert!(text.contains("deleted 0 jobs of a (failed)"), "{text}");
    assert!(command(&[&all[..], &["--yes"]].concat()).1.contains("deleted 2 jobs of a"));
    let (code, text) = command(&["job", "delete", "--all", "--lab", "nope", "--yes"]);
    assert!(code == 2 && text.contains("nope"), "{text}");
    app.get(&format!("/v1/jobs/{}", jobs[0])).await.problem(404, "not_found");
    app.get(&format!("/v1/jobs/{}", jobs[2])).await.expect(200);
    command(&["job", "cancel", &jobs[2]]);
    assert_eq!(command(&["job", "delete", &jobs[2]]).0, 0);
    let unused = app.upload(vec![7; 5000]).await;
    let (_, uploads) = command(&["lab", "uploads", "a"]);
    let line_of = |sha256: &str| uploads.lines().find(|line| line.starts_with(sha256)).unwrap();
    assert!(line_of(&unused).ends_with("no"), "{uploads}");
    assert_eq!(uploads.lines().filter(|line| line.ends_with("yes")).count(), 2, "{uploads}");
    assert_eq!(command(&["lab", "delete-upload", "a", &unused]).0, 0);
    app.get(&format!("/v1/blobs/{unused}")).await.problem(404, "not_found");

    // A mistyped name creates no lab, and an empty lab can be removed.
    let (code, message) = command(&["lab", "set", "c", "--share", "2"]);
    assert!(code == 2 && message.contains("--new"), "{message}");
    let listed = command(&["lab", "set", "c", "--new", "--share", "2"]).1;
    assert!(listed.lines().any(|line| line.starts_with("c ")), "{listed}");
    assert_eq!(command(&["lab", "remove", "c"]).0, 0);
    assert_eq!(command(&["lab", "remove", "c"]).0, 2, "the lab was removed");
    let listed = command(&["lab", "list"]).1;
    assert!(!listed.lines().any(|line| line.starts_with("c ")), "{listed}");
    let tokens = app.token(&["list"]);
    let token = tokens.lines().find(|line| line.contains(" b ")).unwrap();
    let (code, message) = command(&["lab", "remove", "b"]);
    assert!(code == 2 && message.contains("tokens"), "{message}");
    app.token(&["revoke", token.split_whitespace().next().unwrap()]);
    assert_eq!(command(&["lab", "remove", "b"]).0, 0);
    app.upload(vec![8; 5000]).await;
    for token in tokens.lines().filter(|line| line.contains(" a ")) {
        app.token(&["revoke", token.split_whitespace().next().unwrap()]);
    }
    let (code, message) = command(&["lab", "remove", "a"]);
    assert!(code == 2 && message.contains("delete those first"), "{message}");
}

#[tokio::test]
async fn a_token_expires_and_records_its_last_use() {
    let app = TestApp::start().await;
    let soon = time_after(3);
    let token = app.token(&["create", "--lab", "a", "--expires", &soon]);
    let lasting = app.token(&["create", "--lab", "a", "--expires", "90d"]);
    app.sign_in(&token);
    let me = app.get("/v1/me").await.expect(200).json();
    assert_eq!(me["expires_at"].as_str().unwrap()[..19], soon[..19]);
    let session = app.send(app.request(Method::POST, "/view/session")).await.expect(201);
    assert_eq!(session.json()["expires_at"], me["expires_at"], "the session ends with its token");
    let session = session.header("set-cookie").split(';').next().unwrap().to_owned();
    let mut events = app.request(Method::GET, "/v1/events").send().await.unwrap();
    assert_eq!(events.status(), 200);
    let mut used = false;
    for _ in 0..50 {
        let listed = app.token(&["list"]);
        used = listed.lines().nth(1).unwrap().matches("never").count() == 0;
        if used {
            break;
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    assert!(used, "the last use is not recorded");
    // The stream of events ends with the token.
    let rest = async { while events.chunk().await.unwrap().is_some() {} };
    tokio::time::timeout(Duration::from_secs(20), rest).await.expect("the stream ends");
    app.get("/v1/me").await.problem(401, "unauthorized");
    app.sign_out();
    let request = app.request(Method::GET, "/v1/jobs").header("cookie", session);
    app.send(request).await.problem(401, "unauthorized");
    app.sign_in(&lasting);
    app.get("/v1/me").await.expect(200);
}

/// The time in `seconds` seconds, as text.
fn time_after(seconds: i64) -> String {
    let now = engine::job::Timestamp::now();
    engine::job::Timestamp(now.0 + 1000 * seconds).to_string()
}

#[tokio::test]
async fn a_session_replaces_the_token_and_is_safe_from_other_sites() {
    let (app, [a, ..], job) = three_tokens().await;
    app.sign_in(&a);
    let begin = || app.request(Method::POST, "/view/session");
    let session = app.send(begin().header("origin", "https://bench.example")).await.expect(201);
    let cookie = session.header("set-cookie").to_owned();
    for part in ["; HttpOnly", "; SameSite=Strict", "; Secure", "; Path=/", "; Max-Age=60480"] {
        assert!(cookie.contains(part), "{part}: {cookie}");
    }
    assert!(cookie.starts_with("__Host-sci_recon_session="), "{cookie}");
    let plain = app.send(begin()).await.header("set-cookie").to_owned();
    assert!(plain.starts_with("sci_recon_session=") && !plain.contains("Secure"), "{plain}");
    let below = app.request(Method::POST, "/view/session?path=/sci/");
    let below = app.send(below.header("origin", "https://bench.example")).await;
    let below = below.header("set-cookie");
    assert!(below.starts_with("__Secure-sci_recon_session="), "{below}");
    app.sign_out();
    let session = cookie.split(';').next().unwrap().to_owned();
    assert!(!session.contains(a.trim_start_matches("sci_")));
    let ask = |method: Method, path: &str, lines: &[(&str, &str)]| -> RequestBuilder {
        let request = app.request(method, path).header("cookie", &session);
        lines.iter().fold(request, |request, (name, value)| request.header(*name, *value))
    };
    let jobs = app.send(ask(Method::GET, "/v1/jobs", &[])).await.expect(200);
    assert_eq!(jobs.json()["items"][0]["id"], job.as_str());
    let cancel = format!("/v1/jobs/{job}/cancel");
    let header = ("x-requested-with", "page");
    for lines in [
        &[][..],
        &[header, ("origin", "http://evil.example")],
        &[header, ("sec-fetch-site", "cross-site")],
        &[("sec-fetch-site", "same-origin")],
    ] {
        let refused = app.send(ask(Method::POST, &cancel, lines)).await;
        refused.problem(403, "foreign_site");
    }
    app.send(ask(Method::POST, "/view/session", &[header])).await.problem(401, "unauthorized");
    let same = [header, ("sec-fetch-site", "same-origin")];
    app.send(ask(Method::POST, &cancel, &same)).await.expect(202);
    let other = app.send(app.request(Method::POST, "/view/session").bearer_auth(&a)).await;
    let ended = app.send(ask(Method::DELETE, "/view/session", &same)).await.expect(204);
    assert!(ended.header("set-cookie").contains("sci_recon_session=; "));
    app.send(ask(Method::GET, "/v1/jobs", &[])).await.problem(401, "unauthorized");
    // Revoking a token ends its sessions.
    let session = other.header("set-cookie").split(';').next().unwrap().to_owned();
    let list_jobs = || app.request(Method::GET, "/v1/jobs").header("cookie", &session);
    app.send(list_jobs()).await.expect(200);
    let listed = app.token(&["list"]);
    let row = listed.lines().find(|line| line.contains("submit")).unwrap();
    app.token(&["revoke", row.split(' ').next().unwrap()]);
    app.send(list_jobs()).await.problem(401, "unauthorized");
}

/// Another host of the domain can set a cookie without a prefix, and so sign somebody in as itself.
#[tokio::test]
async fn behind_a_trusted_proxy_with_https_only_a_prefixed_cookie_counts() {
    let app = TestApp::with(&["--workers", "0", "--trusted-proxies", "127.0.0.1"]).await;
    let token = app.token(&["create", "--lab", "a"]);
    let ask = |method: Method, path: &str, https: bool| {
        let request = app.request(method, path).header("x-forwarded-for", "192.0.2.1");
        if https { request.header("x-forwarded-proto", "https") } else { request }
    };
    let begin = async |https| {
        let session = ask(Method::POST, "/view/session", https).bearer_auth(&token);
        let session = app.send(session).await.expect(201);
        session.header("set-cookie").split(';').next().unwrap().to_owned()
    };
    let (plain, prefixed) = (begin(false).await, begin(true).await);
    assert!(prefixed.starts_with("__Host-"), "{prefixed}");
    for (cookie, https, status) in [
        (&plain, false, 200),
        (&plain, true, 401),
        (&prefixed, true, 200),
        (&format!("{plain}; {prefixed}"), true, 200),
    ] {
        let list = ask(Method::GET, "/v1/jobs", https).header("cookie", cookie);
        let answer = app.send(list).await;
        assert_eq!(answer.status.as_u16(), status, "{cookie} {https}");
        if status == 200 {
            // A browser asks again, so it shows nothing after the end of the session.
            assert_eq!(answer.header("cache-control"), "private, no-cache");
        }
    }
}

#[tokio::test]
async fn a_token_begins_few_sessions_in_a_minute() {
    let app = TestApp::start().await;
    let [a, b] = ["a", "b"].map(|lab| app.token(&["create", "--lab", lab]));
    let begin = |token: &str| app.request(Method::POST, "/view/session").bearer_auth(token);
    let mut accepted = 0;
    let refused = loop {
        let answer = app.send(begin(&a)).await;
        if answer.status != 201 {
            break answer;
        }
        accepted += 1;
        assert!(accepted < 100, "sessions are not limited");
    };
    assert!(accepted >= 20, "{accepted}");
    let detail = refused.problem(429, "rate_limited");
    assert!(detail.contains("sessions") && !refused.header("retry-after").is_empty(), "{detail}");
    app.send(begin(&b)).await.expect(201);
    app.send(app.request(Method::GET, "/v1/jobs").bearer_auth(&a)).await.expect(200);
}

#[tokio::test]
async fn a_service_without_tokens_needs_no_session() {
    let app = TestApp::start().await;
    let session = app.send(app.request(Method::POST, "/view/session")).await;
    session.problem(409, "illegal_state");
    assert_eq!(app.get("/v1/me").await.json()["all_labs"], true);
    app.send(app.request(Method::DELETE, "/view/session")).await.expect(204);
}

#[tokio::test]
async fn a_download_ends_with_its_token() {
    let app = TestApp::start().await;
    app.sign_in(&app.token(&["create", "--lab", "a"]));
    // The file is larger than the buffers of a connection.
    let sha256 = app.upload(vec![3; 40_000_000]).await;
    let path = format!("/v1/blobs/{sha256}/content");
    let mut download = app.request(Method::GET, &path).send().await.unwrap();
    assert_eq!(download.status(), 200);
    let mut got = download.chunk().await.unwrap().unwrap().len();
    let listed = app.token(&["list"]);
    app.token(&["revoke", listed.lines().nth(1).unwrap().split(' ').next().unwrap()]);
    tokio::time::sleep(Duration::from_secs(4)).await;
    while let Ok(Some(bytes)) = download.chunk().await {
        got += bytes.len();
    }
    assert!(got < 40_000_000, "{got} bytes came");
}

//! Tokens and roles, their permissions, and the isolation of labs.

use std::process::{Command, Stdio};

use reqwest::Method;
use serde_json::{Value, json};

use crate::app::{TestApp, id};
use crate::samples::Scene;

const PUBLIC: [&str; 9] = [
    "/livez",
    "/readyz",
    "/openapi.yaml",
    "/openapi.json",
    "/",
    "/dashboard/{file}",
    "/docs",
    "/docs/{file}",
    "/problems/{code}",
];

/// The path of a route with values for its parameters.
fn with_parameters(path: &str) -> String {
    let nothing = "019ae4f0-6e5c-7c3a-9d1e-0d5f0a1b2c3d";
    path.replace("{sha256}", &"0".repeat(64))
        .replace("{snapshot}", "0")
        .replace("{frame}", "1.exr")
        .split('/')
        .map(|part| if part.starts_with('{') { nothing } else { part })
        .collect::<Vec<_>>()
        .join("/")
}

#[tokio::test]
async fn only_public_routes_answer_without_a_token() {
    let app = TestApp::with(&["--workers", "0", "--trusted-proxies", "127.0.0.1"]).await;
    app.get("/v1/jobs").await.expect(200);
    let token = app.token(&["create", "--lab", "a", "--role", "admin"]);
    let routes = sci_recon::http::routes();
    assert!(routes.len() > 20);
    for bad in [None, Some("sci_wrong".to_owned()), Some(format!("sci_{}", "0".repeat(64)))] {
        if let Some(bad) = &bad {
            app.sign_in(bad);
        }
        for (number, route) in routes.iter().enumerate() {
            // One address may fail to sign in a limited number of times.
            let address = format!("192.0.2.{number}");
            for method in &route.methods {
                let method: Method = method.to_uppercase().parse().unwrap();
                let request = app.request(method, &with_parameters(route.path));
                let answer = app.send(request.header("x-forwarded-for", &address)).await;
                if PUBLIC.contains(&route.path) {
                    assert_ne!(answer.status, 401, "{}", route.path);
                } else {
                    // The answer to HEAD has no body.
                    if route.methods != ["head"] && !answer.bytes.is_empty() {
                        answer.problem(401, "unauthorized");
                    }
                    assert_eq!(answer.status, 401, "{}", route.path);
                    assert!(answer.header("www-authenticate").starts_with("Bearer"));
                }
            }
        }
    }
    app.sign_in(&token);
    app.get("/v1/jobs").await.expect(200);
    app.get("/metrics").await.expect(200);
    // A revoked token loses its rights at once, and the service still requires a token.
    let listed = app.token(&["list"]);
    assert!(!listed.contains(&token));
    let revoked = listed.lines().nth(1).unwrap().split(' ').next().unwrap().to_owned();
    app.token(&["revoke", &revoked]);
    app.get("/v1/jobs").await.problem(401, "unauthorized");
    app.sign_out();
    app.get("/v1/jobs").await.problem(401, "unauthorized");
}

#[tokio::test]
async fn a_role_allows_its_actions_and_no_others() {
    let app = TestApp::start().await;
    let read = app.token(&["create", "--lab", "a", "--role", "read"]);
    let submit = app.token(&["create", "--lab", "a"]);
    app.sign_in(&submit);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    let job = id(&app.post("/v1/jobs", &body).await.expect(201));
    app.get("/metrics").await.problem(403, "forbidden");
    app.sign_in(&read);
    app.get(&format!("/v1/jobs/{job}")).await.expect(200);
    app.post("/v1/jobs", &body).await.problem(403, "forbidden");
    app.delete(&format!("/v1/jobs/{job}")).await.problem(403, "forbidden");
    let movie = app.post(&format!("/v1/jobs/{job}/exports"), &json!({"format": "mp4"})).await;
    movie.problem(403, "forbidden");
    let upload = app.send(app.request(Method::POST, "/v1/blobs").body("x")).await;
    assert!(upload.problem(403, "forbidden").contains("submit"));
    assert_eq!(upload.header("connection"), "close");
}

#[tokio::test]
async fn data_of_another_lab_look_nonexistent() {
    let app = TestApp::start().await;
    let (a, b) = (app.token(&["create", "--lab", "a"]), app.token(&["create", "--lab", "b"]));
    app.sign_in(&a);
    let masks = app.upload(Scene::SMALL.masks()).await;
    let (calibration, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    let keyed = || app.request(Method::POST, "/v1/jobs").header("idempotency-key", "k");
    let job = id(&app.send(keyed().json(&body)).await.expect(201));
    let nowhere = "019ae4f0-6e5c-7c3a-9d1e-0d5f0a1b2c3d";
    app.sign_in(&b);
    // Each answer equals the one for a resource that does not exist, word for word.
    let same = |theirs: crate::app::Answer, unknown: crate::app::Answer, (x, y): (&str, &str)| {
        assert_eq!(theirs.status, unknown.status);
        let text = String::from_utf8(theirs.bytes.clone()).unwrap().replace(x, y);
        // Only the identifier of the request differs.
        let [one, other] = [&theirs, &unknown].map(|answer| answer.header("x-request-id"));
        assert_eq!(text.replace(one, other), String::from_utf8(unknown.bytes.clone()).unwrap());
    };
    let ids = [("calibrations", &calibration), ("measurements", &measurement), ("jobs", &job)];
    for (kind, id) in ids {
        for method in [Method::GET, Method::DELETE] {
            let ask = |id: &str| app.request(method.clone(), &format!("/v1/{kind}/{id}"));
            let theirs = app.send(ask(id)).await;
            theirs.problem(404, "not_found");
            same(theirs, app.send(ask(nowhere)).await, (id, nowhere));
        }
        assert_eq!(app.get(&format!("/v1/{kind}")).await.json()["items"], json!([]));
    }
    for (method, end) in [
        (Method::POST, "/cancel"),
        (Method::POST, "/retry"),
        (Method::GET, "/exports/manifest"),
        (Method::GET, "/snapshots/0"),
        (Method::GET, "/snapshots/0/exports/manifest"),
        (Method::GET, "/snapshots/0/exports/exr"),
        (Method::GET, "/snapshots/0/exports/npy"),
        (Method::GET, "/snapshots/0/exports/frames/1.exr"),
    ] {
        let ask = |id: &str| app.request(method.clone(), &format!("/v1/jobs/{id}{end}"));
        let theirs = app.send(ask(&job)).await;
        theirs.problem(404, "not_found");
        same(theirs, app.send(ask(nowhere)).await, (&job, nowhere));
    }
    let zeros = "0".repeat(64);
    let named = |masks: &str| json!({ "masks": masks });
    let theirs = app.post("/v1/calibrations", &named(&masks)).await;
    theirs.problem(422, "invalid_request");
    same(theirs, app.post("/v1/calibrations", &named(&zeros)).await, (&masks, &zeros));
    let body_for = |calibration: &str| json!({"calibration": calibration, "data": zeros});
    let theirs = app.post("/v1/measurements", &body_for(&calibration)).await;
    same(theirs, app.post("/v1/measurements", &body_for(nowhere)).await, (&calibration, nowhere));
    let theirs = app.post("/v1/jobs", &body).await;
    let unknown = json!({"measurement": nowhere, "algorithm": "gap-tv"});
    same(theirs, app.post("/v1/jobs", &unknown).await, (&measurement, nowhere));
    // A file that another lab has stored is new to this lab.
    app.get(&format!("/v1/blobs/{masks}")).await.problem(404, "not_found");
    let sent = app.send(app.request(Method::POST, "/v1/blobs").body(Scene::SMALL.masks())).await;
    assert_eq!(sent.expect(201).json()["sha256"], masks);
    // Idempotency keys are separate as well.
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let own_job = json!({"measurement": measurement, "algorithm": "gap-tv"});
    assert_ne!(id(&app.send(keyed().json(&own_job)).await.expect(201)), job);
    // The bytes are stored once, and remain until no lab needs them.
    let blobs = std::fs::read_dir(app.data().join("blobs")).unwrap().count();
    assert_eq!(blobs, 4, "masks, data, and the arrays prepared from them");
}

#[tokio::test]
async fn a_token_stores_no_more_than_its_quota() {
    let app = TestApp::start().await;
    app.sign_in(&app.token(&["create", "--lab", "a", "--max-bytes", "1000"]));
    app.upload(vec![1; 600]).await;
    let send = |bytes: Vec<u8>| app.send(app.request(Method::POST, "/v1/blobs").body(bytes));
    let detail = send(vec![2; 600]).await.problem(403, "quota_exceeded");
    assert!(detail.contains("600") && detail.contains("1000"), "{detail}");
    // The quota also applies to an upload without a length.
    let chunks = futures_util::stream::iter([Ok::<_, std::io::Error>(vec![3u8; 600])]);
    let body = reqwest::Body::wrap_stream(chunks);
    let answer = app.send(app.request(Method::POST, "/v1/blobs").body(body)).await;
    answer.problem(403, "quota_exceeded");
    send(vec![4; 400]).await.expect(201);
}

#[test]
fn a_service_on_a_public_address_requires_tokens() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
    command.args(["serve", "--listen", "0.0.0.0:0", "--workers", "0", "--data"]).arg(folder.path());
    let refused = command.output().unwrap();
    assert_eq!(refused.status.code(), Some(2));
    let text = String::from_utf8(refused.stderr).unwrap();
    assert!(text.contains("token create"), "{text}");
    let mut create = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
    create.args(["token", "--data"]).arg(folder.path()).args(["create", "--lab", "a"]);
    assert!(create.output().unwrap().status.success());
    let mut served = command.stdout(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    let stdout = served.stdout.take().unwrap();
    std::io::BufRead::read_line(&mut std::io::BufReader::new(stdout), &mut line).unwrap();
    served.kill().unwrap();
    served.wait().unwrap();
    assert!(serde_json::from_str::<Value>(&line).is_ok(), "{line}");
}

#[tokio::test]
async fn a_token_appears_in_no_log_and_no_file() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("log");
    let mut app = TestApp::logging(&log, "trace", &["--workers", "1"]).await;
    let token = app.token(&["create", "--lab", "a", "--role", "admin"]);
    app.sign_in(&token);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    let job = app.submit(&body).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    app.get("/v1/nowhere").await.expect(404);
    app.stop();
    let secret = token.trim_start_matches("sci_").as_bytes().to_owned();
    let mut files = vec![log];
    let mut folders = vec![app.data().to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() { folders.push(path) } else { files.push(path) }
        }
    }
    assert!(files.len() > 10);
    for file in files {
        let bytes = std::fs::read(&file).unwrap();
        assert!(!bytes.is_empty() || file.ends_with("server.lock"));
        let contains_token = bytes.windows(secret.len()).any(|window| window == secret);
        assert!(!contains_token, "{} holds the token", file.display());
    }
}

#[tokio::test]
async fn a_page_of_another_site_has_no_access_to_an_open_service() {
    let app = TestApp::with(&["--workers", "0", "--host", "bench.example"]).await;
    let ask = |method: Method, lines: &[(&str, &str)]| {
        let mut request = app.request(method, "/v1/jobs").json(&json!({}));
        for (name, value) in lines {
            request = request.header(*name, *value);
        }
        async { request.send().await.unwrap().status().as_u16() }
    };
    // DNS rebinding: the other site's name resolves to this machine.
    assert_eq!(ask(Method::GET, &[("host", "evil.example")]).await, 403);
    assert_eq!(ask(Method::GET, &[("host", "bench.example")]).await, 200);
    assert_eq!(ask(Method::POST, &[("origin", "http://evil.example")]).await, 403);
    assert_eq!(ask(Method::POST, &[("sec-fetch-site", "cross-site")]).await, 403);
    assert_eq!(ask(Method::POST, &[]).await, 422, "only the check of its body rejects the request");
    app.token(&["create", "--lab", "optics"]);
    assert_eq!(ask(Method::GET, &[("host", "evil.example")]).await, 401, "a token is required now");
}

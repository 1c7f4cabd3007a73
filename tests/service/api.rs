//! Features that all resources of the API share: conditions, references, pages, origins, rates and events.

use std::time::Duration;

use reqwest::header::HeaderMap;
use reqwest::{Method, Response};
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::app::{TestApp, id};
use crate::contract::matches_schema;
use crate::learned;
use crate::samples::Scene;

#[tokio::test]
async fn every_resource_has_an_etag_and_every_change_a_condition() {
    let app = TestApp::start().await;
    let (calibration, measurement) = app.scene(&Scene::SMALL).await;
    let job = app.submit(&json!({"measurement": measurement, "algorithm": "gap-tv"})).await;
    let blob = app.upload(b"alone".to_vec()).await;
    let begin = app.request(Method::POST, "/v1/uploads").header("tus-resumable", "1.0.0");
    let upload = app.send(begin.header("upload-length", "10")).await.expect(201);
    let lists =
        ["me", "labs", "blobs", "uploads", "calibrations", "measurements", "models", "jobs"];
    let lists = lists.map(|name| format!("/v1/{name}"));
    let singles = [
        format!("/v1/jobs/{job}"),
        format!("/v1/measurements/{measurement}"),
        format!("/v1/calibrations/{calibration}"),
        format!("/v1/blobs/{blob}"),
        "/v1/labs/local".to_owned(),
    ];
    let others = [
        "/v1/algorithms".into(),
        format!("/v1/jobs/{job}/snapshots"),
        format!("/v1/jobs/{job}/snapshots/0"),
        "/openapi.yaml".into(),
    ];
    for path in lists.iter().chain(&singles).chain(&others) {
        let etag = app.get(path).await.expect(200).header("etag").to_owned();
        assert!(etag.starts_with('"'), "{path}: {etag:?}");
        let known = app.request(Method::GET, path).header("if-none-match", &etag);
        app.send(known).await.expect(304);
    }
    for path in &singles {
        check_conditions(&app, path).await;
    }
    app.post(&format!("/v1/jobs/{job}/cancel"), &json!({})).await.expect(202);
    for path in &singles[..4] {
        let etag = app.get(path).await.header("etag").to_owned();
        app.send(app.request(Method::DELETE, path).header("if-match", etag)).await.expect(204);
    }
    let place = upload.header("location").to_owned();
    let tus = |method| app.request(method, &place).header("tus-resumable", "1.0.0");
    let etag = app.send(tus(Method::HEAD)).await.expect(200).header("etag").to_owned();
    let piece = |tag: &str| {
        let piece = tus(Method::PATCH).header("upload-offset", "0").header("if-match", tag);
        piece.header("content-type", "application/offset+octet-stream").body("abc")
    };
    app.send(piece("\"old\"")).await.problem(412, "precondition_failed");
    app.send(piece(&etag)).await.expect(204);
    app.send(tus(Method::DELETE).header("if-match", etag))
        .await
        .problem(412, "precondition_failed");
    app.send(tus(Method::DELETE)).await.expect(204);
}

/// Changes a resource, and fails unless each change and its deletion honour `If-Match`.
async fn check_conditions(app: &TestApp, path: &str) {
    let etag = app.get(path).await.header("etag").to_owned();
    let body = match path {
        _ if path.contains("labs") => json!({"share": 2.0}),
        _ if path.contains("jobs") => json!({"label": "other"}),
        _ => json!({"name": "other"}),
    };
    let change = |tag: &str| app.request(Method::PATCH, path).header("if-match", tag).json(&body);
    if !path.contains("blobs") {
        app.send(change("\"old\"")).await.problem(412, "precondition_failed");
        let changed = app.send(change(&etag)).await.expect(200);
        assert_eq!(changed.header("etag"), app.get(path).await.header("etag"), "{path}");
        app.send(change(&etag)).await.problem(412, "precondition_failed");
    }
    if !path.contains("labs") {
        let delete = app.request(Method::DELETE, path).header("if-match", "\"old\"");
        app.send(delete).await.problem(412, "precondition_failed");
    }
}

#[tokio::test]
async fn a_model_has_an_etag_and_its_changes_have_a_condition() {
    let Some(python) = learned::python() else { return };
    let (folder, scene) = (tempfile::tempdir().unwrap(), Scene::SMALL);
    let network = learned::train(&python, folder.path(), scene, "free");
    let app = TestApp::with(&["--workers", "1"]).await;
    let calibration = id(&app.calibrate(scene.masks()).await.expect(201));
    let model = id(&learned::register(&app, &calibration, &network).await.expect(201));
    let path = format!("/v1/models/{model}");
    check_conditions(&app, &path).await;
    let etag = app.get(&path).await.header("etag").to_owned();
    let known = app.request(Method::GET, &path).header("if-none-match", &etag);
    app.send(known).await.expect(304);
    app.send(app.request(Method::DELETE, &path).header("if-match", etag)).await.expect(204);
}

#[tokio::test]
async fn no_request_takes_an_array_for_an_object() {
    let app = TestApp::start().await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let job = format!(
        "/v1/jobs/{}",
        app.submit(&json!({"measurement": measurement, "algorithm": "gap-tv"})).await
    );
    for body in [json!([2.0, null]), json!([2.0, null, null]), json!([])] {
        for (method, path) in [
            (Method::PATCH, "/v1/labs/local"),
            (Method::PATCH, job.as_str()),
            (Method::POST, "/v1/jobs"),
            (Method::POST, "/v1/jobs/estimate"),
            (Method::POST, "/v1/samples"),
            (Method::POST, "/v1/calibrations"),
            (Method::POST, "/v1/measurements"),
            (Method::POST, "/v1/models"),
        ] {
            let refused = app.send(app.request(method, path).json(&body)).await;
            let detail = refused.problem(422, "invalid_request");
            assert!(detail.contains("expected"), "{path}: {detail}");
        }
    }
    assert_eq!(app.get("/v1/labs/local").await.json()["share"], 1.0);
    for (pointer, tile) in [("/tile", json!([64, 8])), ("/schedule", json!([[]]))] {
        let mut body = json!({"measurement": measurement, "algorithm": "gap-tv"});
        body[&pointer[1..]] = tile;
        let refused = app.post("/v1/jobs", &body).await;
        refused.problem(422, "invalid_request");
        assert_eq!(refused.json()["pointer"], pointer);
    }
}

#[tokio::test]
async fn pages_link_to_the_next_one() {
    let app = TestApp::start().await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv", "label": "a b"});
    let jobs = [app.submit(&body).await, app.submit(&body).await, app.submit(&body).await];
    let mut found: Vec<String> = Vec::new();
    let mut path = "/v1/jobs?limit=1&label=a%20b".to_owned();
    loop {
        let page = app.get(&path).await.expect(200);
        let items = page.json();
        found.extend(
            items["items"]
                .as_array()
                .unwrap()
                .iter()
                .map(|job| job["id"].as_str().unwrap().to_owned()),
        );
        let Some(link) = page.headers.get("link") else { break };
        let (query, rest) = link.to_str().unwrap().split_once('>').unwrap();
        assert_eq!(rest, "; rel=\"next\"");
        path = format!("/v1/jobs{}", query.strip_prefix('<').unwrap());
        assert!(path.contains("label=a%20b") && path.contains("limit=1"), "{path}");
        let cursor = items["next_cursor"].as_str().unwrap();
        assert!(
            !jobs.iter().any(|job| cursor.contains(job.as_str())),
            "a cursor is opaque: {cursor}"
        );
    }
    assert_eq!(found, jobs.iter().rev().cloned().collect::<Vec<_>>());
    // The snapshots of a job are a list, too.
    let base = format!("/v1/jobs/{}/snapshots", jobs[0]);
    let first = app.get(&format!("{base}?limit=1")).await.expect(200).json();
    assert_eq!(first["items"][0]["snapshot"], 0);
    let next = first["next_cursor"].as_str().unwrap();
    let second = app.get(&format!("{base}?limit=1&cursor={next}")).await.expect(200).json();
    assert_eq!(
        (&second["items"][0]["snapshot"], &second["next_cursor"]),
        (&json!(1), &Value::Null)
    );
}

/// A service below the prefix `/sci` of a proxy that knows nothing about it.
async fn proxied(app: &TestApp) -> String {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let service = app.address();
    tokio::spawn(async move {
        while let Ok((mut client, _)) = listener.accept().await {
            let service = service.clone();
            tokio::spawn(async move {
                let mut head = Vec::new();
                while !head.ends_with(b"\r\n\r\n") {
                    head.push(client.read_u8().await?);
                }
                let head = String::from_utf8(head).unwrap();
                assert!(head.split(' ').nth(1).unwrap().starts_with("/sci/"), "{head}");
                let head = head.replacen(" /sci/", " /", 1).replacen(
                    "\r\n",
                    "\r\nConnection: close\r\n",
                    1,
                );
                let mut server = TcpStream::connect(service).await?;
                server.write_all(head.as_bytes()).await?;
                tokio::io::copy_bidirectional(&mut client, &mut server).await
            });
        }
    });
    format!("http://{address}/sci")
}

#[tokio::test]
async fn references_hold_below_a_prefix() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let base = proxied(&app).await;
    let http = sci_recon::http_client().unwrap().pool_max_idle_per_host(0).build().unwrap();
    let follow = |response: &Response, header: &str| {
        let place = response.headers()[header].to_str().unwrap();
        response.url().join(place).unwrap()
    };
    // Uploads in pieces.
    let created = http.get(format!("{base}/v1/uploads/")).header("tus-resumable", "1.0.0");
    // The service ignores the actual method.
    let created = created.header("x-http-method-override", "POST").header("upload-length", "3");
    let created = created.send().await.unwrap();
    assert_eq!(created.status(), 201);
    let place = follow(&created, "location");
    assert!(place.as_str().starts_with(&format!("{base}/v1/uploads/")), "{place}");
    let piece = http.post(place.clone()).header("x-http-method-override", "PATCH");
    let piece = piece.header("tus-resumable", "1.0.0").header("upload-offset", "0");
    let piece = piece.header("content-type", "application/offset+octet-stream").body("abc");
    let stored = piece.send().await.unwrap();
    assert_eq!(stored.status(), 204, "{}", stored.text().await.unwrap());
    assert_eq!(http.get(follow(&stored, "content-location")).send().await.unwrap().status(), 200);
    // Jobs and their files.
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    let made = http.post(format!("{base}/v1/jobs")).json(&body).send().await.unwrap();
    let job = follow(&made, "location");
    app.ended(job.path().rsplit('/').next().unwrap()).await;
    let list = http.get(format!("{job}/snapshots")).send().await.unwrap();
    let list_url = list.url().clone();
    let files: Value = list.json().await.unwrap();
    for file in files["items"][1]["files"].as_array().unwrap() {
        let href = list_url.join(file["href"].as_str().unwrap()).unwrap();
        let file = http.get(href.clone()).send().await.unwrap();
        assert_eq!(file.status(), 200, "{href}");
    }
    // Errors and the session of a page.
    let refused = http.get(format!("{base}/v1/jobs/none")).send().await.unwrap();
    let link = refused.headers()["link"].to_str().unwrap();
    let (page, _) = link.strip_prefix('<').unwrap().split_once('>').unwrap();
    let page = http.get(refused.url().join(page).unwrap()).send().await.unwrap();
    assert!(page.text().await.unwrap().contains("not_found"));
    let token = app.token(&["create", "--lab", "a"]);
    let session = http.post(format!("{base}/view/session?path=/sci/")).bearer_auth(token);
    let session = session.send().await.unwrap();
    let cookie = session.headers()["set-cookie"].to_str().unwrap();
    assert!(cookie.contains("; Path=/sci/;"), "{cookie}");
    for bad in ["sci", "/;Domain=x", "/%22 a"] {
        app.send(app.request(Method::POST, &format!("/view/session?path={bad}")))
            .await
            .problem(401, "unauthorized");
    }
}

#[tokio::test]
async fn pages_of_allowed_origins_upload_and_read() {
    let origin = "http://pages.example:3000";
    let app = TestApp::with(&["--workers", "0", "--cors-origin", origin]).await;
    let preflight = |origin: &str| {
        let ask = app.request(Method::OPTIONS, "/v1/uploads").header("origin", origin);
        let ask = ask.header("access-control-request-method", "POST");
        ask.header("access-control-request-headers", "tus-resumable,upload-length,authorization")
    };
    let allowed = preflight(origin).send().await.unwrap();
    let headers = |fields: &HeaderMap, name: &str| {
        fields.get(name).map_or(String::new(), |value| value.to_str().unwrap().to_lowercase())
    };
    assert_eq!(headers(allowed.headers(), "access-control-allow-origin"), origin);
    assert!(headers(allowed.headers(), "access-control-allow-headers").contains("upload-length"));
    assert!(headers(allowed.headers(), "access-control-allow-methods").contains("patch"));
    let other = preflight("http://evil.example").send().await.unwrap();
    assert_eq!(headers(other.headers(), "access-control-allow-origin"), "");
    let begin = |origin: &str| {
        let begin = app.request(Method::POST, "/v1/uploads").header("origin", origin);
        begin.header("tus-resumable", "1.0.0").header("upload-length", "3")
    };
    let created = begin(origin).send().await.unwrap();
    assert_eq!(created.status(), 201);
    let exposed = headers(created.headers(), "access-control-expose-headers");
    for name in [
        "location",
        "content-location",
        "etag",
        "content-range",
        "upload-offset",
        "tus-resumable",
        "upload-expires",
    ] {
        assert!(exposed.split(',').any(|found| found.trim() == name), "{name} in {exposed}");
    }
    app.send(begin("http://evil.example")).await.problem(403, "foreign_site");
    // Questions of tus are no preflights.
    let options = app
        .send(app.request(Method::OPTIONS, "/v1/uploads").header("origin", origin))
        .await
        .expect(204);
    assert_eq!(options.header("tus-version"), "1.0.0");
}

#[tokio::test]
async fn concatenation_is_refused_and_a_stalled_piece_is_cut() {
    let app = TestApp::with(&["--workers", "0", "--upload-idle-seconds", "1"]).await;
    let begin = || app.request(Method::POST, "/v1/uploads").header("tus-resumable", "1.0.0");
    let part = begin().header("upload-length", "3").header("upload-concat", "partial");
    let detail = app.send(part).await.problem(400, "malformed_request");
    assert!(detail.contains("parallelUploads"), "{detail}");
    let created = app.send(begin().header("upload-length", "10")).await.expect(201);
    let place = created.header("location").to_owned();
    let mut socket = TcpStream::connect(app.address()).await.unwrap();
    let head = format!(
        "PATCH {place} HTTP/1.1\r\nHost: {}\r\nTus-Resumable: 1.0.0\r\nUpload-Offset: 0\r\n\
         Content-Type: application/offset+octet-stream\r\nContent-Length: 10\r\n\r\nabc",
        app.address()
    );
    socket.write_all(head.as_bytes()).await.unwrap();
    let mut answer = Vec::new();
    // A reset is an end, too.
    let _ = tokio::time::timeout(Duration::from_secs(20), socket.read_to_end(&mut answer))
        .await
        .expect("it ends");
    assert!(answer.is_empty(), "{}", String::from_utf8_lossy(&answer));
    let head = app.request(Method::HEAD, &place).header("tus-resumable", "1.0.0");
    assert_eq!(app.send(head).await.expect(200).header("upload-offset"), "3");
}

#[tokio::test]
async fn every_answer_restricts_browsers() {
    let app = TestApp::start().await;
    let paths = [
        "/",
        "/dashboard/main.js",
        "/docs",
        "/livez",
        "/v1/me",
        "/v1/nothing",
        "/problems/too_large",
    ];
    for path in paths {
        let answer = app.get(path).await;
        assert_eq!(answer.header("x-content-type-options"), "nosniff", "{path}");
        assert_eq!(answer.header("referrer-policy"), "no-referrer", "{path}");
        let policy = answer.header("content-security-policy");
        assert!(policy.contains("frame-ancestors 'none'"), "{path}: {policy}");
    }
}

#[tokio::test]
async fn log_lines_name_the_trace_of_the_caller() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("log");
    let app = TestApp::logging(&log, "info", &["--workers", "0", "--log-format", "json"]).await;
    let (trace, parent) = ("4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7");
    let request = app.request(Method::POST, "/v1/blobs").header("x-request-id", "traced");
    let request = request.header("traceparent", format!("00-{trace}-{parent}-01"));
    app.send(request.body("abc")).await.expect(201);
    app.send(app.request(Method::POST, "/v1/blobs").header("x-request-id", "alone").body("abc"))
        .await;
    let lines = std::fs::read_to_string(&log).unwrap();
    let line = |id: &str| {
        let mut lines = lines.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
        let answered =
            |line: &Value| line["span"]["id"] == id && line["fields"]["message"] == "answered";
        lines.find(answered).unwrap_or_else(|| panic!("{id}"))
    };
    assert_eq!(line("traced")["span"]["trace_id"], trace);
    assert_eq!(line("traced")["span"]["parent_id"], parent);
    assert_eq!(line("traced")["span"]["lab"], "local");
    assert_eq!(line("alone")["span"]["trace_id"], Value::Null);
}

#[cfg(feature = "otel")]
#[tokio::test]
async fn a_collector_gets_the_span_of_a_request() {
    use std::io::{Read, Write};

    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let endpoint = format!("http://{}", listener.local_addr().unwrap());
    let (sender, collected) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        let (mut socket, _) = listener.accept().unwrap();
        let (mut received, mut part) = (Vec::new(), [0; 4096]);
        // The spans follow the name of the service.
        while !received.windows(9).any(|bytes| bytes == b"sci-recon") {
            let count = socket.read(&mut part).unwrap();
            received.extend_from_slice(&part[..count]);
        }
        socket.write_all(b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\n\r\n").unwrap();
        sender.send(received).unwrap();
    });
    let environment = [("OTEL_EXPORTER_OTLP_ENDPOINT", endpoint.as_str()), ("RUST_LOG", "info")];
    let mut app = TestApp::in_environment(&["--workers", "0"], &environment).await;
    let trace = "4bf92f3577b34da6a3ce929d0e0e4736";
    let request = app.request(Method::GET, "/v1/me");
    app.send(request.header("traceparent", format!("00-{trace}-00f067aa0ba902b7-01"))).await;
    assert!(app.stop().success());
    let received = collected.recv_timeout(Duration::from_secs(60)).expect("the spans come");
    assert!(received.starts_with(b"POST /v1/traces "), "{:?}", String::from_utf8_lossy(&received));
    let trace = hex::decode(trace).unwrap();
    assert!(received.windows(16).any(|bytes| bytes == trace), "the span continues the trace");
}

#[tokio::test]
async fn a_token_has_a_rate() {
    let app = TestApp::with(&["--workers", "0", "--requests-per-minute", "20"]).await;
    let (a, b) = (app.token(&["create", "--lab", "a"]), app.token(&["create", "--lab", "b"]));
    app.sign_in(&a);
    let first = app.get("/v1/me").await.expect(200);
    assert_eq!(first.header("ratelimit-policy"), "\"token\";q=20;w=60");
    assert_eq!(first.header("ratelimit"), "\"token\";r=19;t=3");
    for _ in 0..19 {
        app.get("/v1/me").await;
    }
    let refused = app.get("/v1/me").await;
    refused.problem(429, "rate_limited");
    let seconds: u64 = refused.header("retry-after").parse().unwrap();
    assert!((1..=3).contains(&seconds), "{seconds}");
    app.sign_in(&b);
    app.get("/v1/me").await.expect(200);
    app.sign_in(&a);
    tokio::time::sleep(Duration::from_secs(seconds)).await;
    app.get("/v1/me").await.expect(200);
}

/// Reads events until this text has come; gives the last id.
async fn until(events: &mut Response, text: &str) -> String {
    let mut all = String::new();
    while !all.contains(text) || !all.ends_with("\n\n") {
        let chunk = tokio::time::timeout(Duration::from_secs(20), events.chunk()).await;
        all += std::str::from_utf8(&chunk.expect("an event").unwrap().expect("no end")).unwrap();
    }
    all.lines().rev().find_map(|line| line.strip_prefix("id: ")).unwrap().to_owned()
}

#[tokio::test]
async fn events_go_on_after_a_cut() {
    let app = TestApp::start().await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let listen = |last: Option<&str>| {
        let request = app.request(Method::GET, "/v1/events");
        last.iter().fold(request, |request, last| request.header("last-event-id", *last))
    };
    let mut events = listen(None).send().await.unwrap();
    until(&mut events, "event: hello").await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    let first = app.submit(&body).await;
    let mut last = until(&mut events, "event: jobs").await;
    if let Ok(Ok(Some(chunk))) = tokio::time::timeout(Duration::from_secs(3), events.chunk()).await
    {
        let text = String::from_utf8(chunk.to_vec()).unwrap();
        let newer = text.lines().rev().find_map(|line| line.strip_prefix("id: "));
        last = newer.map_or(last, str::to_owned);
    }
    drop(events);
    let second = app.submit(&body).await;
    tokio::time::sleep(Duration::from_secs(3)).await;
    let mut events = listen(Some(&last)).send().await.unwrap();
    let chunk = tokio::time::timeout(Duration::from_secs(20), events.chunk()).await.unwrap();
    let missed = String::from_utf8(chunk.unwrap().unwrap().to_vec()).unwrap();
    assert!(missed.starts_with("event: jobs\n") && missed.contains(&second), "{missed}");
    assert!(!missed.contains(&first), "{missed}");
    for unknown in ["nothing", "0-1", "1-99999999999999999999"] {
        let mut events = listen(Some(unknown)).send().await.unwrap();
        let chunk = events.chunk().await.unwrap().unwrap();
        assert!(chunk.starts_with(b"event: hello"), "{unknown}: {chunk:?}");
    }
}

/// The next blocks of a stream of events, each with its name, id and data.
async fn blocks(events: &mut Response, count: usize) -> Vec<[String; 3]> {
    let mut all = String::new();
    while all.matches("\n\n").count() < count || !all.ends_with("\n\n") {
        let chunk = tokio::time::timeout(Duration::from_secs(20), events.chunk()).await;
        all += std::str::from_utf8(&chunk.expect("an event").unwrap().expect("no end")).unwrap();
    }
    let field = |block: &str, name: &str| {
        let mut lines = block.lines().filter_map(|line| line.strip_prefix(name));
        lines.next().unwrap_or_else(|| panic!("no {name:?} in {block:?}")).to_owned()
    };
    let blocks = all.split_terminator("\n\n");
    blocks.map(|block| ["event: ", "id: ", "data: "].map(|name| field(block, name))).collect()
}

#[tokio::test]
async fn every_event_has_an_id_from_which_a_client_goes_on() {
    let app = TestApp::start().await;
    let listen = async |last: Option<&str>| {
        let request = app.request(Method::GET, "/v1/events");
        let request =
            last.iter().fold(request, |request, last| request.header("last-event-id", *last));
        request.send().await.unwrap()
    };
    let [[name, start, hello]] = &blocks(&mut listen(None).await, 1).await[..] else {
        panic!("one event")
    };
    assert_eq!(name, "hello");
    let hello: Value = serde_json::from_str(hello).unwrap();
    assert!(matches_schema("Change", &hello), "{hello}");
    assert_eq!(hello["more"], true, "the client reads the lists");
    let (calibration, measurement) = app.scene(&Scene::SMALL).await;
    let job = app.submit(&json!({"measurement": measurement, "algorithm": "gap-tv"})).await;
    let missed = blocks(&mut listen(Some(start)).await, 3).await;
    let names = ["jobs", "calibrations", "measurements"];
    for ((name, id), [event, _, data]) in
        names.iter().zip([job, calibration, measurement]).zip(&missed)
    {
        assert!(event == name && data.contains(&id), "{missed:?}");
        assert!(matches_schema("Change", &serde_json::from_str(data).unwrap()), "{data}");
    }
    // A client that has the first two alone gets all of them again, one that has the last gets none.
    for [_, id, _] in &missed[..2] {
        assert_eq!(blocks(&mut listen(Some(id)).await, 3).await, missed);
    }
    let mut events = listen(Some(&missed[2][1])).await;
    assert!(tokio::time::timeout(Duration::from_secs(2), events.chunk()).await.is_err());
}

#[tokio::test]
async fn a_full_queue_names_the_time_until_a_job_ends() {
    let app = TestApp::with(&["--workers", "1", "--max-jobs", "2"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv", "schedule": {"stages": [
        {"prior": "tv", "iterations": 10_000, "tv_weight": 0.05, "tv_updates": 40}]}});
    let jobs = [app.submit(&body).await, app.submit(&body).await];
    let path = |job: &str| format!("/v1/jobs/{job}");
    while app.get(&path(&jobs[0])).await.json()["state"] != "running" {
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    // The time for both jobs, which end one after the other.
    let both = async || {
        let last = app.get(&path(&jobs[1])).await.json();
        last["progress"]["eta_seconds"].as_f64().unwrap()
    };
    let before = both().await;
    let full = app.post("/v1/jobs", &body).await;
    full.problem(429, "queue_full");
    let seconds: f64 = full.header("retry-after").parse().unwrap();
    let after = both().await;
    let (least, most) = (before.min(after) / 2.0, before.max(after) / 2.0);
    let expected = least.min(600.0).floor().max(1.0)..=most.min(600.0).ceil().max(1.0);
    assert!(expected.contains(&seconds), "{seconds} is not in {expected:?}");
    // A job that waits is cancelled at once. Its next turn is when its predecessor has ended.
    let cancelled = app.post(&format!("{}/cancel", path(&jobs[1])), &json!({})).await.expect(202);
    assert_eq!(
        (&cancelled.json()["state"], cancelled.header("retry-after")),
        (&json!("cancelled"), "")
    );
    let again = app.post(&format!("{}/retry", path(&jobs[1])), &json!({})).await.expect(202);
    let eta = again.json()["progress"]["eta_seconds"].as_f64().unwrap();
    assert_eq!(again.header("retry-after"), eta.clamp(1.0, 600.0).ceil().to_string());
}

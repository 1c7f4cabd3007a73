//! Limits hold for concurrent requests, and one lab cannot exhaust those of others.

use std::process::Command;
use std::time::{Duration, Instant};

use futures_util::future::join_all;
use reqwest::{Method, RequestBuilder, StatusCode};
use serde_json::json;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::app::{Answer, TestApp};
use crate::samples::{Scene, npy_header};

/// Starts a service with two labs; returns a token of each.
async fn two_labs(arguments: &[&str]) -> (TestApp, String, String) {
    let app = TestApp::with(arguments).await;
    let (a, b) = (app.token(&["create", "--lab", "a"]), app.token(&["create", "--lab", "b"]));
    (app, a, b)
}

fn as_lab(app: &TestApp, token: &str, method: Method, path: &str) -> RequestBuilder {
    app.sign_out();
    app.request(method, path).bearer_auth(token)
}

pub fn entitle(app: &TestApp, arguments: &[&str]) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
    let output = command.args(["lab", "--data"]).arg(app.data()).arg("set").args(arguments);
    let output = output.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

fn announce(app: &TestApp, length: u64) -> RequestBuilder {
    let request = app.request(Method::POST, "/v1/uploads").header("tus-resumable", "1.0.0");
    request.header("upload-length", length)
}

fn count_created(answers: &[Answer]) -> usize {
    answers.iter().filter(|answer| answer.status == StatusCode::CREATED).count()
}

#[tokio::test]
async fn concurrent_requests_do_not_exceed_the_limit() {
    let app = TestApp::start().await;
    app.sign_in(&app.token(&["create", "--lab", "a", "--max-bytes", "1000000"]));
    let upload = |number: u8| {
        let request = app.request(Method::POST, "/v1/blobs").body(vec![number; 300_000]);
        app.send(request)
    };
    let answers = join_all((0..14).map(upload)).await;
    assert_eq!(count_created(&answers), 3);
    for answer in answers.iter().filter(|answer| answer.status.as_u16() != 201) {
        answer.problem(403, "quota_exceeded");
    }
    let answers = join_all((0..20).map(|_| app.send(announce(&app, 90_000)))).await;
    assert_eq!(count_created(&answers), 1, "100,000 bytes were free");
}

#[tokio::test]
async fn prepared_arrays_count_towards_the_quota() {
    let app = TestApp::start().await;
    app.sign_in(&app.token(&["create", "--lab", "a", "--max-bytes", "200000"]));
    // A value has 8 bits in the upload, and 32 in the prepared array.
    let masks = [npy_header("|u1", &[8, 96, 96]), vec![200; 8 * 96 * 96]].concat();
    let answer = app.calibrate(masks.clone()).await;
    let detail = answer.problem(403, "quota_exceeded");
    assert!(detail.contains("294944"), "{detail}");
    assert_eq!(std::fs::read_dir(app.data().join("tmp")).unwrap().count(), 0);
    app.sign_in(&app.token(&["create", "--lab", "b", "--max-bytes", "400000"]));
    app.calibrate(masks).await.expect(201);
    app.send(announce(&app, 50_000)).await.problem(403, "quota_exceeded");
    app.send(announce(&app, 30_000)).await.expect(201);
}

#[tokio::test]
async fn empty_announcements_do_not_exhaust_the_disk() {
    let most = "1000000000000000";
    let limits = ["--workers", "0", "--max-upload-bytes", most, "--lab-bytes", most];
    let (app, a, b) = two_labs(&limits).await;
    let disk = rustix::fs::statvfs(app.data()).unwrap();
    let free = disk.f_bavail * disk.f_frsize;
    app.sign_in(&a);
    for _ in 0..20 {
        app.send(announce(&app, free / 2)).await.expect(201);
    }
    app.sign_in(&b);
    app.upload(vec![1; 1000]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    app.submit(&json!({"measurement": measurement, "algorithm": "gap-tv"})).await;
    // One lab can announce this many uploads.
    app.sign_in(&a);
    let mut announced = 20;
    let refused = loop {
        let answer = app.send(announce(&app, 10)).await;
        if answer.status != StatusCode::CREATED {
            break answer;
        }
        announced += 1;
    };
    assert!(refused.problem(429, "too_many_uploads").contains("64"));
    // The first one expires in an hour.
    assert_eq!(refused.header("retry-after"), "600");
    assert_eq!(announced, 64);
    app.sign_in(&b);
    app.send(announce(&app, 10)).await.expect(201);
}

#[tokio::test]
async fn a_lab_has_quotas_that_do_not_affect_other_labs() {
    let (app, a, b) = two_labs(&["--workers", "0", "--max-jobs", "4"]).await;
    let mut jobs = Vec::new();
    for token in [&a, &b] {
        app.sign_in(token);
        let (_, measurement) = app.scene(&Scene::SMALL).await;
        jobs.push(json!({"measurement": measurement, "algorithm": "gap-tv"}));
    }
    app.sign_in(&a);
    for _ in 0..4 {
        app.submit(&jobs[0]).await;
    }
    app.post("/v1/jobs", &jobs[0]).await.problem(429, "queue_full");
    // The lab a has used all its places, but none of b's.
    app.sign_in(&b);
    app.submit(&jobs[1]).await;
    app.submit(&jobs[1]).await;
    app.post("/v1/jobs", &jobs[1]).await.problem(429, "queue_full");
    entitle(&app, &["b", "--jobs", "2"]);
    let app = app.again(&["--workers", "0", "--max-jobs", "1000"]).await;
    app.sign_in(&b);
    let detail = app.post("/v1/jobs", &jobs[1]).await.problem(429, "queue_full");
    assert!(detail.contains("of this lab"), "{detail}");
    entitle(&app, &["b", "--jobs", "none", "--bytes", "1000000"]);
    let detail = app.post("/v1/jobs", &jobs[1]).await.problem(403, "quota_exceeded");
    assert!(detail.contains("the lab keeps"), "{detail}");
    entitle(&app, &["b", "--bytes", "none", "--share", "2"]);
    app.submit(&jobs[1]).await;
}

#[tokio::test]
async fn jobs_of_one_lab_reserve_no_disk_of_others() {
    let (app, a, b) = two_labs(&["--workers", "0"]).await;
    let disk = rustix::fs::statvfs(app.data()).unwrap();
    let free = disk.f_bavail * disk.f_frsize;
    let mut jobs = Vec::new();
    for token in [&a, &b] {
        app.sign_in(token);
        let (_, measurement) = app.scene(&Scene::SMALL).await;
        jobs.push(json!({"measurement": measurement, "algorithm": "gap-tv"}));
    }
    // A waiting job may reserve any number of bytes, depending on the size of its scene.
    app.sign_in(&a);
    app.submit(&jobs[0]).await;
    let mut database = app.database().await;
    let reserve = async |database: &mut sqlx::SqliteConnection, bytes: u64| {
        let update = sqlx::query("UPDATE jobs SET disk_bytes = ? WHERE lab = 'a'");
        update.bind(bytes as i64).execute(database).await.unwrap();
    };
    reserve(&mut database, free / 4).await;
    app.submit(&jobs[0]).await;
    // The jobs reserve more than half of the free bytes, which change while other tests run.
    reserve(&mut database, free * 3 / 10).await;
    let detail = app.post("/v1/jobs", &jobs[0]).await.problem(507, "insufficient_storage");
    assert!(detail.contains("this lab has reserved"), "{detail}");
    let upload = app.request(Method::POST, "/v1/blobs").body(vec![1; 1000]);
    app.send(upload).await.problem(507, "insufficient_storage");
    app.sign_in(&b);
    app.upload(vec![2; 1000]).await;
    app.submit(&jobs[1]).await;
    app.send(announce(&app, free / 8)).await.expect(201);
    // The lab can continue when its jobs reserve less.
    reserve(&mut database, 1000).await;
    app.sign_in(&a);
    app.submit(&jobs[0]).await;
}

#[tokio::test]
async fn labs_without_quotas_have_default_ones() {
    let limits = ["--workers", "0", "--lab-jobs", "2", "--lab-bytes", "1000000"];
    let app = TestApp::with(&limits).await;
    app.sign_in(&app.token(&["create", "--lab", "a"]));
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let job = json!({"measurement": measurement, "algorithm": "gap-tv"});
    // There is no other lab yet.
    for _ in 0..3 {
        app.submit(&job).await;
    }
    app.token(&["create", "--lab", "b"]);
    let detail = app.post("/v1/jobs", &job).await.problem(429, "queue_full");
    assert!(detail.contains("of this lab"), "{detail}");
    let upload = app.request(Method::POST, "/v1/blobs").body(vec![1; 1_000_000]);
    app.send(upload).await.problem(403, "quota_exceeded");
    let me = app.get("/v1/me").await.expect(200).json();
    assert_eq!(
        (&me["limits"]["lab_jobs"], &me["limits"]["lab_bytes"]),
        (&json!(2), &json!(1_000_000))
    );
    entitle(&app, &["a", "--jobs", "10", "--bytes", "100000000"]);
    app.submit(&job).await;
}

/// Starts an upload that then sends nothing.
async fn stalled_upload(app: &TestApp, token: &str, length: usize) -> TcpStream {
    let mut socket = TcpStream::connect(app.address()).await.unwrap();
    let head = format!(
        "POST /v1/blobs HTTP/1.1\r\nHost: {}\r\nAuthorization: Bearer {token}\r\n\
         Content-Length: {length}\r\n\r\nabc",
        app.address()
    );
    socket.write_all(head.as_bytes()).await.unwrap();
    socket
}

#[tokio::test]
async fn slow_uploads_leave_places_for_other_labs_and_end() {
    let arguments = ["--workers", "0", "--max-uploads", "4", "--upload-idle-seconds", "2"];
    let (app, a, b) = two_labs(&arguments).await;
    let mut slow = Vec::new();
    for _ in 0..4 {
        slow.push(stalled_upload(&app, &a, 1_000_000).await);
    }
    let start = Instant::now();
    while std::fs::read_dir(app.data().join("tmp")).unwrap().count() < 2 {
        assert!(start.elapsed().as_secs() < 10);
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let send = |token: &str| as_lab(&app, token, Method::POST, "/v1/blobs").body("abc");
    app.send(send(&a)).await.problem(429, "too_many_uploads");
    app.send(send(&b)).await.expect(201);
    // Single bytes within the idle time do not keep an upload alive.
    let mut dripping = stalled_upload(&app, &b, 1_000_000).await;
    let mut answer = [0; 12];
    let start = Instant::now();
    loop {
        assert!(start.elapsed().as_secs() < 30, "the upload is never ended");
        let _ = dripping.write_all(b"x").await;
        let read = dripping.read_exact(&mut answer);
        if let Ok(read) = tokio::time::timeout(Duration::from_millis(500), read).await {
            read.unwrap();
            break;
        }
    }
    assert_eq!(&answer, b"HTTP/1.1 408");
}

#[tokio::test]
async fn listeners_leave_places_for_other_labs_and_end_with_their_token() {
    let (app, a, b) = two_labs(&["--workers", "0"]).await;
    let mut listening = Vec::new();
    let refused = loop {
        let answer = as_lab(&app, &a, Method::GET, "/v1/events").send().await.unwrap();
        if answer.status() != 200 {
            break answer;
        }
        listening.push(answer);
        assert!(listening.len() <= 64, "a lab has at most half of the places");
    };
    Answer::read(refused).await.problem(503, "unavailable");
    let mut others = as_lab(&app, &b, Method::GET, "/v1/events").send().await.unwrap();
    assert_eq!(others.status(), 200);
    let listed = app.token(&["list"]);
    let revoked = listed.lines().nth(1).unwrap().split(' ').next().unwrap().to_owned();
    app.token(&["revoke", &revoked]);
    let start = Instant::now();
    for mut stream in listening {
        let end = async { while stream.chunk().await.is_ok_and(|chunk| chunk.is_some()) {} };
        tokio::time::timeout(Duration::from_secs(20), end).await.unwrap();
    }
    assert!(start.elapsed().as_secs() < 20, "the streams of a revoked token continue");
    others.chunk().await.unwrap().unwrap();
    let more = tokio::time::timeout(Duration::from_secs(1), others.chunk()).await;
    assert!(more.is_err(), "the streams of another token continue");
}

/// True if the service answers on this connection.
async fn answers(socket: &mut TcpStream, address: &str) -> bool {
    let request = format!("GET /livez HTTP/1.1\r\nHost: {address}\r\n\r\n");
    let mut head = [0; 12];
    let exchanged = async {
        socket.write_all(request.as_bytes()).await?;
        socket.read_exact(&mut head).await
    };
    let exchanged = tokio::time::timeout(Duration::from_secs(10), exchanged).await.unwrap();
    exchanged.is_ok() && head.starts_with(b"HTTP/1.1 200")
}

/// 44 of 300 files are for connections.
#[tokio::test]
async fn one_address_has_at_most_half_of_the_connections() {
    let app = TestApp::with_few_files(300, &[]).await;
    let mut open = Vec::new();
    for _ in 0..44 {
        let mut socket = TcpStream::connect(app.address()).await.unwrap();
        if answers(&mut socket, &app.address()).await {
            open.push(socket);
        }
    }
    assert_eq!(open.len(), 22, "half of the connections");
    let port = app.address().rsplit(':').next().unwrap().parse().unwrap();
    let other = tokio::net::TcpSocket::new_v4().unwrap();
    other.bind("127.0.0.2:0".parse().unwrap()).unwrap();
    let mut other =
        other.connect(std::net::SocketAddr::from(([127, 0, 0, 1], port))).await.unwrap();
    assert!(answers(&mut other, &app.address()).await, "another address gets a connection");
    open.pop();
    tokio::time::sleep(Duration::from_millis(500)).await;
    let mut again = TcpStream::connect(app.address()).await.unwrap();
    assert!(answers(&mut again, &app.address()).await);
}

#[tokio::test]
async fn behind_a_trusted_proxy_the_limit_holds_for_each_client() {
    let app = TestApp::with_few_files(300, &["--trusted-proxies", "127.0.0.0/8"]).await;
    let listen = |client: &str| {
        // A client can send an address of its choice; the proxy appends the true one.
        let forwarded = format!("198.51.100.1, {client}");
        app.request(Method::GET, "/v1/events").header("x-forwarded-for", forwarded)
    };
    let mut listening = Vec::new();
    for _ in 0..22 {
        let events = listen("192.0.2.1").send().await.unwrap();
        assert_eq!(events.status(), 200);
        listening.push(events);
    }
    let refused = Answer::read(listen("192.0.2.1").send().await.unwrap()).await;
    let detail = refused.problem(429, "rate_limited");
    assert!(detail.contains("192.0.2.1 has 22 requests in progress"), "{detail}");
    assert_eq!(listen("192.0.2.2").send().await.unwrap().status(), 200);
    drop(listening);
    let start = Instant::now();
    while listen("192.0.2.1").send().await.unwrap().status() != 200 {
        assert!(start.elapsed().as_secs() < 10, "the places are not freed");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

//! Resumable uploads: the protocol step by step, and a published client over connections that are
//! cut.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use rand::{Rng, RngExt, SeedableRng};
use reqwest::{Method, RequestBuilder};
use serde_json::{Value, json};
use store::{Purpose, Store};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

use crate::app::{Answer, TestApp, judges};
use crate::faults::{kills, sha256};

const ABC: &str = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
const ABC_BASE64: &str =
    "YmE3ODE2YmY4ZjAxY2ZlYTQxNDE0MGRlNWRhZTIyMjNiMDAzNjFhMzk2MTc3YTljYjQxMGZmNjFmMjAwMTVhZA==";

fn tus(app: &TestApp, method: Method, path: &str) -> RequestBuilder {
    app.request(method, path).header("tus-resumable", "1.0.0")
}

async fn begin(app: &TestApp, length: usize, metadata: &str) -> String {
    let request = tus(app, Method::POST, "/v1/uploads").header("upload-length", length);
    let answer = app.send(request.header("upload-metadata", metadata)).await.expect(201);
    assert_eq!(answer.header("upload-offset"), "0");
    assert!(answer.header("upload-expires").ends_with(" GMT"));
    answer.header("location").to_owned()
}

fn piece(app: &TestApp, path: &str, offset: usize, bytes: &'static [u8]) -> RequestBuilder {
    tus(app, Method::PATCH, path)
        .header("upload-offset", offset)
        .header("content-type", "application/offset+octet-stream")
        .body(bytes)
}

async fn offset(app: &TestApp, path: &str) -> String {
    let answer = app.send(tus(app, Method::HEAD, path)).await.expect(200);
    assert_eq!(answer.header("cache-control"), "no-store");
    assert_eq!(answer.header("tus-resumable"), "1.0.0");
    answer.header("upload-offset").to_owned()
}

#[tokio::test]
async fn pieces_are_joined_to_a_blob() {
    let mut app = TestApp::start().await;
    let options = app.send(app.request(Method::OPTIONS, "/v1/uploads")).await.expect(204);
    assert_eq!(options.header("tus-version"), "1.0.0");
    assert_eq!(
        options.header("tus-extension"),
        "creation,creation-defer-length,checksum,expiration,termination"
    );
    assert_eq!(options.header("tus-checksum-algorithm"), "sha1,sha256");
    let path = begin(&app, 3, &format!("filename YQ==,sha256 {ABC_BASE64}")).await;
    assert_eq!(
        app.send(piece(&app, &path, 0, b"a")).await.expect(204).header("upload-offset"),
        "1"
    );
    app.restart();
    assert_eq!(offset(&app, &path).await, "1");
    app.send(piece(&app, &path, 0, b"a")).await.problem(409, "offset_mismatch");
    app.send(piece(&app, &path, 1, b"bcd")).await.problem(413, "too_large");
    let last = app.send(piece(&app, &path, 1, b"bc")).await.expect(204);
    assert_eq!(last.header("content-location"), format!("/v1/blobs/{ABC}"));
    app.send(piece(&app, &path, 3, b"d")).await.problem(413, "too_large");
    app.send(piece(&app, &path, 3, b"")).await.expect(204);
    let known = app.send(tus(&app, Method::HEAD, &path)).await.expect(200);
    assert_eq!(known.header("upload-length"), "3");
    assert!(known.header("upload-metadata").starts_with("filename YQ==,"));
    assert_eq!(known.header("content-location"), format!("/v1/blobs/{ABC}"));
    assert_eq!(app.get(&format!("/v1/blobs/{ABC}")).await.expect(200).json()["size"], 3);
    // The file is stored once, and deleting the upload does not affect it.
    app.send(tus(&app, Method::DELETE, &path)).await.expect(204);
    app.send(tus(&app, Method::HEAD, &path)).await.expect(404);
    app.get(&format!("/v1/blobs/{ABC}")).await.expect(200);
    assert_eq!(std::fs::read_dir(app.data().join("partial")).unwrap().count(), 0);
}

#[tokio::test]
async fn a_later_piece_states_the_length() {
    let mut app = TestApp::start().await;
    let defer =
        |app: &TestApp| tus(app, Method::POST, "/v1/uploads").header("upload-defer-length", 1);
    let both = defer(&app).header("upload-length", 3);
    app.send(both).await.problem(400, "malformed_request");
    let request = defer(&app).header("upload-metadata", format!("sha256 {ABC_BASE64}"));
    let path = app.send(request).await.expect(201).header("location").to_owned();
    app.send(piece(&app, &path, 0, b"a")).await.expect(204);
    app.send(piece(&app, &path, 1, b"b")).await.expect(204);
    app.restart();
    let known = app.send(tus(&app, Method::HEAD, &path)).await.expect(200);
    assert_eq!(known.header("upload-defer-length"), "1");
    assert_eq!((known.header("upload-length"), known.header("upload-offset")), ("", "2"));
    let list = app.get("/v1/uploads").await.expect(200).json();
    assert_eq!(list["items"][0]["length"], Value::Null);
    // A length below the number of received bytes is refused, and nothing is recorded.
    for length in ["1", "0", "x"] {
        let last = piece(&app, &path, 2, b"c").header("upload-length", length);
        assert_eq!(app.send(last).await.status, 400, "{length}");
    }
    let long = piece(&app, &path, 2, b"c").header("upload-length", 1u64 << 40);
    app.send(long).await.problem(413, "too_large");
    let known = app.send(tus(&app, Method::HEAD, &path)).await.expect(200);
    assert_eq!((known.header("upload-length"), known.header("upload-offset")), ("", "2"));
    // The last piece states the length, which can't change then.
    let stated = piece(&app, &path, 2, b"").header("upload-length", 3);
    app.send(stated).await.expect(204);
    let other = piece(&app, &path, 2, b"c").header("upload-length", 4);
    app.send(other).await.problem(400, "malformed_request");
    let known = app.send(tus(&app, Method::HEAD, &path)).await.expect(200);
    assert_eq!((known.header("upload-length"), known.header("upload-defer-length")), ("3", ""));
    app.send(piece(&app, &path, 2, b"cd")).await.problem(413, "too_large");
    let last = app.send(piece(&app, &path, 2, b"c").header("upload-length", 3)).await.expect(204);
    assert_eq!(last.header("content-location"), format!("/v1/blobs/{ABC}"));
    // All has come before the length is stated.
    let path = app.send(defer(&app)).await.expect(201).header("location").to_owned();
    app.send(piece(&app, &path, 0, b"abc")).await.expect(204);
    let last = app.send(piece(&app, &path, 3, b"").header("upload-length", 3)).await.expect(204);
    assert!(last.header("content-location").ends_with(ABC));
}

#[tokio::test]
async fn limits_hold_for_uploads_of_unknown_length() {
    let app = TestApp::with(&["--workers", "0", "--max-upload-bytes", "1000000"]).await;
    let token = app.token(&["create", "--lab", "a", "--max-bytes", "600000"]);
    app.sign_in(&token);
    let begin = async || {
        let request = tus(&app, Method::POST, "/v1/uploads").header("upload-defer-length", 1);
        app.send(request).await
    };
    let path = begin().await.expect(201).header("location").to_owned();
    let bytes: &'static [u8] = vec![7; 500_000].leak();
    app.send(piece(&app, &path, 0, bytes)).await.expect(204);
    // The bytes that have come count, and so do those of other uploads.
    app.send(piece(&app, &path, 500_000, bytes)).await.problem(403, "quota_exceeded");
    assert_eq!(offset(&app, &path).await, "500000");
    let length = piece(&app, &path, 500_000, b"").header("upload-length", 700_000);
    app.send(length).await.problem(403, "quota_exceeded");
    let length = piece(&app, &path, 500_000, b"").header("upload-length", 600_000);
    app.send(length).await.expect(204);
    begin().await.problem(403, "quota_exceeded");
    // The limit on the size of an upload.
    app.sign_in(&app.token(&["create", "--lab", "b"]));
    let path = begin().await.expect(201).header("location").to_owned();
    let bytes: &'static [u8] = vec![7; 1_000_001].leak();
    app.send(piece(&app, &path, 0, bytes)).await.problem(413, "too_large");
}

#[tokio::test]
async fn damaged_pieces_and_files_are_rejected() {
    let app = TestApp::start().await;
    let path = begin(&app, 3, &format!("sha256 {ABC_BASE64}")).await;
    let sum = |request: RequestBuilder, sum: &str| request.header("upload-checksum", sum);
    // SHA-1 of "abc".
    let good = "sha1 qZk+NkcGgWq6PiVxeFDCbJzQ2J0=";
    app.send(sum(piece(&app, &path, 0, b"abd"), good)).await.problem(460, "checksum_mismatch");
    assert_eq!(offset(&app, &path).await, "0");
    app.send(sum(piece(&app, &path, 0, b"abc"), "md5 x")).await.problem(400, "malformed_request");
    app.send(sum(piece(&app, &path, 0, b"abc"), good)).await.expect(204);
    // The whole file is compared with the hash named at the start.
    let path = begin(&app, 3, &format!("sha256 {ABC_BASE64}")).await;
    let wrong = app.send(piece(&app, &path, 0, b"abd")).await;
    assert!(wrong.problem(422, "hash_mismatch").contains(ABC));
    app.send(tus(&app, Method::HEAD, &path)).await.expect(404);
}

#[tokio::test]
async fn requests_that_violate_tus_are_rejected() {
    let app = TestApp::start().await;
    let plain = app.request(Method::POST, "/v1/uploads").header("upload-length", 3);
    let answer = app.send(plain).await;
    answer.problem(412, "tus_version");
    assert_eq!(answer.header("tus-version"), "1.0.0");
    for (name, value) in [
        ("upload-length", "-1"),
        ("upload-length", "1e3"),
        ("upload-length", "99999999999999999999"),
        ("upload-length", "0"),
        ("upload-defer-length", "2"),
    ] {
        let request = tus(&app, Method::POST, "/v1/uploads").header(name, value);
        assert_eq!(app.send(request).await.status, 400, "{name}: {value}");
    }
    for metadata in ["a ***", "sha256 YWJj", "a YQ==,a YQ=="] {
        let request = tus(&app, Method::POST, "/v1/uploads").header("upload-length", 3);
        let answer = app.send(request.header("upload-metadata", metadata)).await;
        answer.problem(400, "malformed_request");
    }
    let path = begin(&app, 3, "").await;
    let typed = tus(&app, Method::PATCH, &path).header("upload-offset", 0).body("abc");
    app.send(typed).await.problem(415, "unsupported_media_type");
    let large = tus(&app, Method::POST, "/v1/uploads").header("upload-length", 1u64 << 40);
    app.send(large).await.problem(413, "too_large");
}

#[tokio::test]
async fn an_upload_is_visible_only_to_its_lab() {
    let app = TestApp::start().await;
    let (a, b) = (app.token(&["create", "--lab", "a"]), app.token(&["create", "--lab", "b"]));
    app.sign_in(&a);
    let path = begin(&app, 3, "").await;
    app.sign_in(&b);
    app.send(tus(&app, Method::HEAD, &path)).await.expect(404);
    app.send(piece(&app, &path, 0, b"abc")).await.problem(404, "not_found");
    app.send(tus(&app, Method::DELETE, &path)).await.problem(404, "not_found");
    app.sign_in(&a);
    assert_eq!(offset(&app, &path).await, "0");
}

#[tokio::test]
async fn announced_uploads_reserve_disk_and_the_queue_is_limited() {
    let app = TestApp::with(&["--workers", "0", "--max-jobs", "2"]).await;
    // An announcement reserves little space, and more as data arrive.
    for _ in 0..5 {
        let request = tus(&app, Method::POST, "/v1/uploads").header("upload-length", 8u64 << 30);
        app.send(request).await.expect(201);
    }
    let figures = String::from_utf8(app.get("/metrics").await.expect(200).bytes).unwrap();
    let promised = format!("sci_recon_disk_promised_bytes {}", 5u64 << 26);
    assert!(figures.lines().any(|line| line == promised), "{figures}");
    // A full queue is no server error, and an accepted job is found again by its key.
    let list = app.data().join("partial");
    for entry in std::fs::read_dir(list).unwrap() {
        let name = entry.unwrap().file_name().into_string().unwrap();
        let path = format!("/v1/uploads/{name}");
        app.send(tus(&app, Method::DELETE, &path)).await.expect(204);
    }
    let (_, measurement) = app.scene(&crate::samples::Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    let keyed = || {
        let request = app.request(Method::POST, "/v1/jobs").header("idempotency-key", "k");
        app.send(request.json(&body))
    };
    keyed().await.expect(201);
    app.post("/v1/jobs", &body).await.expect(201);
    let full = app.post("/v1/jobs", &body).await;
    assert!(full.problem(429, "queue_full").contains('2'));
    assert_eq!(full.header("retry-after"), "600", "without a worker no job ends");
    keyed().await.expect(200);
    let ready = app.get("/readyz").await.json();
    assert_eq!((&ready["database"], &ready["disk"]), (&json!("ok"), &json!("ok")));
}

/// Forwards connections to the service, and cuts each after a varying number of bytes in either
/// direction.
pub async fn cutting(service: String) -> (SocketAddr, Arc<AtomicU64>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let cuts = Arc::new(AtomicU64::new(0));
    let counter = cuts.clone();
    tokio::spawn(async move {
        for number in 0u64.. {
            let (mut client, _) = listener.accept().await.unwrap();
            let (service, cuts) = (service.clone(), counter.clone());
            let budget = AtomicU64::new(1_000 + (number * 7_919_000) % 900_000);
            tokio::spawn(async move {
                let mut server = TcpStream::connect(&service).await.unwrap();
                let (from_client, to_client) = client.split();
                let (from_server, to_server) = server.split();
                tokio::select! {
                    () = pump(from_client, to_server, &budget) => {}
                    () = pump(from_server, to_client, &budget) => {}
                }
                cuts.fetch_add(u64::from(budget.into_inner() == 0), Ordering::Relaxed);
            });
        }
    });
    (address, cuts)
}

/// Forwards bytes until the end, or until `left` is used up.
async fn pump(mut from: impl AsyncRead + Unpin, mut to: impl AsyncWrite + Unpin, left: &AtomicU64) {
    let mut buffer = vec![0; 16 * 1024];
    while let Ok(count @ 1..) = from.read(&mut buffer).await {
        let before = left.load(Ordering::Relaxed);
        let count = (count as u64).min(before);
        if to.write_all(&buffer[..count as usize]).await.is_err() {
            return;
        }
        left.store(before - count, Ordering::Relaxed);
        if before == count {
            return;
        }
    }
}

#[tokio::test]
async fn a_published_client_uploads_over_cut_connections() {
    let Some(python) = judges() else { return };
    let app = TestApp::start().await;
    let token = app.token(&["create", "--lab", "a"]);
    app.sign_in(&token);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("masks.npy");
    let bytes: Vec<u8> = (0u32..3_000_000).flat_map(u32::to_le_bytes).collect();
    std::fs::write(&file, &bytes).unwrap();
    let hash = sha256(&bytes);
    let (proxy, cuts) = cutting(app.address()).await;
    let mut command = tokio::process::Command::new(&python);
    command.arg("tests/judges/tus_upload.py").arg(format!("http://{proxy}/v1/uploads"));
    command.arg(&file).arg(&hash).arg(&token);
    let output = command.output().await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["offset"], bytes.len());
    let cut = cuts.load(Ordering::Relaxed);
    eprintln!("{cut} connections were cut");
    assert!(cut >= 5, "{cut} connections were cut");
    let stored = app.get(&format!("/v1/blobs/{hash}")).await.expect(200);
    assert_eq!(stored.json()["size"], bytes.len());
    let blob = app.data().join("blobs").join(&hash[..2]).join(&hash[2..]);
    assert!(std::fs::read(blob).unwrap() == bytes, "the blob has the bytes that were sent");
}

#[tokio::test]
async fn the_documented_python_uploads_a_file() {
    let Some(python) = judges() else { return };
    let app = TestApp::start().await;
    let token = app.token(&["create", "--lab", "a"]);
    app.sign_in(&token);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("masks.npy");
    std::fs::write(&file, b"0123456789").unwrap();
    let document = std::fs::read_to_string("docs/DATA.md").unwrap();
    let (_, section) = document.split_once("## Upload large files over a bad network").unwrap();
    let (_, after) = section.split_once("```python\n").unwrap();
    let (recipe, _) = after.split_once("```").unwrap();
    let call = "import sys\nprint(upload(*sys.argv[1:]))";
    let mut command = tokio::process::Command::new(&python);
    command.arg("-c").arg(format!("{recipe}\n{call}"));
    command.arg(format!("http://{}", app.address())).arg(&file).arg(&token);
    let output = command.output().await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let hash = String::from_utf8(output.stdout).unwrap();
    let stored = app.get(&format!("/v1/blobs/{}", hash.trim())).await.expect(200);
    assert_eq!(stored.json()["size"], 10);
}

/// Sends `body` of a piece of `announced` bytes over a new connection; returns the acknowledged
/// offset, if there is one. A shorter body is cut.
async fn raw_piece(
    address: String,
    path: String,
    offset: usize,
    announced: usize,
    body: Vec<u8>,
) -> Option<usize> {
    let mut socket = TcpStream::connect(&address).await.ok()?;
    let head = format!(
        "PATCH {path} HTTP/1.1\r\nHost: {address}\r\nTus-Resumable: 1.0.0\r\nUpload-Offset: {offset}\r\n\
         Content-Type: application/offset+octet-stream\r\nContent-Length: {announced}\r\n\
         Connection: close\r\n\r\n"
    );
    socket.write_all(head.as_bytes()).await.ok()?;
    socket.write_all(&body).await.ok()?;
    if body.len() < announced {
        return None;
    }
    let mut answer = String::new();
    socket.read_to_string(&mut answer).await.ok()?;
    let rest = answer.strip_prefix("HTTP/1.1 204 ")?.split("upload-offset: ").nth(1)?;
    rest.split("\r\n").next()?.parse().ok()
}

/// Sends each piece again around the moment at which it ends, whole and cut, like a client that has
/// lost its connection. During every other upload the server is killed as well. `make faults` does
/// so 200 times.
#[tokio::test]
async fn repeated_pieces_lose_no_byte() {
    let (rounds, seed) = (kills().max(20), rand::random::<u64>());
    eprintln!("seed of the repeats: {seed}");
    let mut random = rand::rngs::ChaCha8Rng::seed_from_u64(seed);
    let mut app = TestApp::start().await;
    let (mut repeats, mut servers, mut lost, mut wrong) = (0, 0, 0, 0);
    for round in 0..rounds {
        let mut bytes = vec![0; random.random_range(200_000..600_000)];
        random.fill_bytes(&mut bytes);
        let path = begin(&app, bytes.len(), "").await;
        let ends = [bytes.len() / 3, bytes.len() / 3 * 2, bytes.len()];
        let fatal = (round % 2 == 1).then(|| random.random_range(0..ends.len()));
        for (number, end) in ends.into_iter().enumerate() {
            let mut acknowledged = Vec::new();
            let start: usize = offset(&app, &path).await.parse().unwrap();
            let piece = bytes[start.min(end)..end].to_vec();
            let send = |body: Vec<u8>| {
                let (announced, path) = (piece.len(), path.clone());
                tokio::spawn(raw_piece(app.address(), path, start, announced, body))
            };
            let mut sent = vec![send(piece.clone())];
            for _ in 0..random.random_range(3..8) {
                let pause = random.random_range(0..3_000);
                tokio::time::sleep(std::time::Duration::from_micros(pause)).await;
                let short = random.random_range(1..2_000).min(piece.len());
                sent.push(send(if random.random() {
                    piece.clone()
                } else {
                    piece[..short].to_vec()
                }));
                repeats += 1;
            }
            if fatal == Some(number) {
                let pause = random.random_range(0..8_000);
                tokio::time::sleep(std::time::Duration::from_micros(pause)).await;
                servers += 1;
                app.restart();
            }
            for answer in sent {
                acknowledged.extend(answer.await.unwrap());
            }
            // All acknowledged bytes are stored, and any client can send the rest.
            let due = acknowledged.into_iter().max().unwrap_or(0);
            let mut now = offset(&app, &path).await.parse::<usize>().unwrap();
            lost += usize::from(now < due);
            let start = std::time::Instant::now();
            while now < end && start.elapsed().as_secs() < 10 {
                raw_piece(app.address(), path.clone(), now, end - now, bytes[now..end].to_vec())
                    .await;
                now = offset(&app, &path).await.parse().unwrap();
            }
        }
        let hash = sha256(&bytes);
        let start = std::time::Instant::now();
        let stored = loop {
            let known = app.send(tus(&app, Method::HEAD, &path)).await.expect(200);
            let stored = known.header("content-location").to_owned();
            // An earlier request may still be writing.
            if !stored.is_empty() || start.elapsed().as_secs() > 10 {
                break stored;
            }
            tokio::time::sleep(std::time::Duration::from_millis(5)).await;
        };
        let blob = app.data().join("blobs").join(&hash[..2]).join(&hash[2..]);
        let right = std::fs::read(blob).is_ok_and(|stored| stored == bytes);
        wrong += usize::from(stored != format!("/v1/blobs/{hash}") || !right);
    }
    let ok = lost + wrong == 0;
    println!(
        "{}",
        json!({"target": "repeated_pieces", "ok": ok, "uploads": rounds, "repeats": repeats,
               "kills": servers, "lost_acknowledged": lost, "wrong_blobs": wrong, "seed": seed})
    );
    assert!(ok);
}

/// A file that is shorter than its record is reported, not filled up with zeros.
#[tokio::test]
async fn an_upload_that_has_lost_bytes_is_rejected() {
    let app = TestApp::start().await;
    let path = begin(&app, 6, "").await;
    app.send(piece(&app, &path, 0, b"abcd")).await.expect(204);
    let file = app.data().join("partial").join(path.rsplit('/').next().unwrap());
    std::fs::write(&file, b"ab").unwrap();
    let refused = app.send(piece(&app, &path, 4, b"ef")).await.problem(410, "upload_damaged");
    assert!(refused.contains("2 bytes") && refused.contains("the 4 on record"), "{refused}");
    app.send(tus(&app, Method::HEAD, &path)).await.expect(410);
    assert_eq!(std::fs::read(&file).unwrap(), b"ab");
    app.send(tus(&app, Method::DELETE, &path)).await.expect(204);
    assert!(!file.exists());
}

/// A slow client does not delay other uploads, and its upload does not expire while bytes arrive.
#[tokio::test]
async fn a_slow_piece_blocks_no_other_and_does_not_expire() {
    let app = TestApp::start().await;
    let path = begin(&app, 1000, "").await;
    let address = app.address();
    let mut slow = TcpStream::connect(&address).await.unwrap();
    let head = format!(
        "PATCH {path} HTTP/1.1\r\nHost: {address}\r\nTus-Resumable: 1.0.0\r\nUpload-Offset: 0\r\n\
         Content-Type: application/offset+octet-stream\r\nContent-Length: 1000\r\n\
         Connection: close\r\n\r\n"
    );
    slow.write_all(head.as_bytes()).await.unwrap();
    slow.write_all(&[7; 500]).await.unwrap();
    let other = begin(&app, 3, "").await;
    app.send(piece(&app, &other, 0, b"abc")).await.expect(204);
    assert_eq!(offset(&app, &path).await, "0");
    app.send(tus(&app, Method::DELETE, &path)).await.problem(423, "upload_busy");
    // The upload's lifetime is over, but the cleanup spares it.
    let store = Store::open(app.data(), Purpose::Use).await.unwrap();
    let mut database = app.database().await;
    sqlx::query("UPDATE partials SET expires_at = 1").execute(&mut database).await.unwrap();
    let age = std::time::Duration::from_secs(259_200);
    let mut expired = Vec::new();
    store.expire_partials(age, |upload| expired.push(upload)).await.unwrap();
    assert_eq!(expired.len(), 1, "only the stored upload expires");
    slow.write_all(&[7; 500]).await.unwrap();
    let mut answer = String::new();
    slow.read_to_string(&mut answer).await.unwrap();
    assert!(answer.starts_with("HTTP/1.1 204 "), "{answer}");
    assert_eq!(offset(&app, &path).await, "1000");
}

/// The bytes received before a client disconnects are kept.
#[tokio::test]
async fn bytes_before_a_disconnect_are_kept() {
    let app = TestApp::start().await;
    let path = begin(&app, 1_000_000, "").await;
    let address = app.address();
    let mut socket = TcpStream::connect(&address).await.unwrap();
    let head = format!(
        "PATCH {path} HTTP/1.1\r\nHost: {address}\r\nTus-Resumable: 1.0.0\r\nUpload-Offset: 0\r\n\
         Content-Type: application/offset+octet-stream\r\nContent-Length: 1000000\r\n\r\n"
    );
    socket.write_all(head.as_bytes()).await.unwrap();
    socket.write_all(&[7; 300_000]).await.unwrap();
    let file = app.data().join("partial").join(path.rsplit('/').next().unwrap());
    let start = std::time::Instant::now();
    while std::fs::metadata(&file).map_or(0, |file| file.len()) == 0 {
        assert!(start.elapsed().as_secs() < 10, "no byte arrives");
        tokio::time::sleep(std::time::Duration::from_millis(5)).await;
    }
    // A concurrent request does not write to the same file.
    let busy: Answer = app.send(piece(&app, &path, 0, b"x")).await;
    busy.problem(423, "upload_busy");
    drop(socket);
    let start = std::time::Instant::now();
    while offset(&app, &path).await != "300000" {
        assert!(start.elapsed().as_secs() < 10, "{}", offset(&app, &path).await);
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
}

/// A piece that is not complete: the connection stays open after these bytes.
async fn open_piece(app: &TestApp, path: &str, offset: usize, bytes: usize) -> TcpStream {
    let address = app.address();
    let mut socket = TcpStream::connect(&address).await.unwrap();
    let head = format!(
        "PATCH {path} HTTP/1.1\r\nHost: {address}\r\nTus-Resumable: 1.0.0\r\nUpload-Offset: {offset}\r\n\
         Content-Type: application/offset+octet-stream\r\nContent-Length: {}\r\n\r\n",
        1_000_000 - offset
    );
    socket.write_all(head.as_bytes()).await.unwrap();
    socket.write_all(&vec![7; bytes]).await.unwrap();
    let file = app.data().join("partial").join(path.rsplit('/').next().unwrap());
    let start = std::time::Instant::now();
    while std::fs::metadata(&file).map_or(0, |file| file.len()) < (offset + bytes) as u64 {
        assert!(start.elapsed().as_secs() < 20, "the bytes do not arrive");
        tokio::time::sleep(std::time::Duration::from_millis(5)).await;
    }
    socket
}

/// The client sends its file as one piece, as most do by default.
#[tokio::test]
async fn a_stop_and_a_crash_keep_the_received_part_of_a_piece() {
    let mut app = TestApp::start().await;
    let path = begin(&app, 1_000_000, "").await;
    let mut cut = open_piece(&app, &path, 0, 300_000).await;
    let start = std::time::Instant::now();
    assert!(app.stop().success());
    let seconds = start.elapsed().as_secs_f64();
    assert!(seconds < 15.0, "the stop waited {seconds} s for the upload");
    let mut answer = String::new();
    cut.read_to_string(&mut answer).await.unwrap();
    assert!(answer.starts_with("HTTP/1.1 503 "), "{answer}");
    app.restart();
    assert_eq!(offset(&app, &path).await, "300000");
    let _open = open_piece(&app, &path, 300_000, 300_000).await;
    let start = std::time::Instant::now();
    while offset(&app, &path).await != "600000" {
        assert!(start.elapsed().as_secs() < 20, "{}", offset(&app, &path).await);
        tokio::time::sleep(std::time::Duration::from_millis(100)).await;
    }
    app.restart();
    assert_eq!(offset(&app, &path).await, "600000");
    let rest = piece(&app, &path, 600_000, &[7; 400_000]);
    assert!(!app.send(rest).await.expect(204).header("content-location").is_empty());
}

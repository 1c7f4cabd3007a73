//! Request headers are honoured, and failures of the machine are reported correctly.

use std::os::unix::fs::PermissionsExt;
use std::time::{Duration, Instant};

use reqwest::{Method, RequestBuilder};
use serde_json::json;
use sqlx::Connection;
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};

use crate::app::TestApp;
use crate::crashes::Shim;
use crate::faults::sha256;
use crate::samples::Scene;

/// SHA-256 of "abc" in base64.
const ABC: &str = "sha-256=:ungWv48Bz+pBQUDeXa4iI7ADYaOWF3qctBD/YfIAFa0=:";
const OTHER: &str = "sha-256=:AAAWv48Bz+pBQUDeXa4iI7ADYaOWF3qctBD/YfIAFa0=:";

#[tokio::test]
async fn if_match_makes_a_request_conditional() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let job = app.submit(&json!({"measurement": measurement, "algorithm": "gap-tv"})).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    let frames = format!("/v1/jobs/{job}/snapshots/0/exports/npy");
    for path in [frames.clone(), format!("/v1/jobs/{job}")] {
        let etag = app.get(&path).await.expect(200).header("etag").to_owned();
        let with = |tag: &str| app.request(Method::GET, &path).header("if-match", tag);
        app.send(with(&etag)).await.expect(200);
        app.send(with("*")).await.expect(200);
        app.send(with("\"old\"")).await.problem(412, "precondition_failed");
    }
    let delete = app.request(Method::DELETE, &format!("/v1/jobs/{job}"));
    app.send(delete.header("if-match", "\"old\"")).await.problem(412, "precondition_failed");
    // HEAD has no ranges (RFC 9110, 14.2).
    let head = app.request(Method::HEAD, &frames).header("range", "bytes=0-9");
    let head = app.send(head).await.expect(200);
    let length = app.get(&frames).await.expect(200).bytes.len();
    assert_eq!(head.header("content-length"), length.to_string());
    let part = app.request(Method::GET, &frames).header("range", "bytes=0-9");
    assert_eq!(app.send(part).await.expect(206).bytes.len(), 10);
}

#[tokio::test]
async fn a_body_must_match_its_headers() {
    let app = TestApp::start().await;
    let post = || app.request(Method::POST, "/v1/blobs").body("abc");
    let hash = sha256(b"abc");
    for encoding in ["gzip", "identity, br"] {
        let refused = app.send(post().header("content-encoding", encoding)).await;
        let detail = refused.problem(415, "unsupported_media_type");
        assert!(detail.contains("gzip") || encoding != "gzip", "{detail}");
        assert_eq!(refused.header("accept-encoding"), "identity");
    }
    let digest = |request: RequestBuilder, value: &str| request.header("content-digest", value);
    let detail = app.send(digest(post(), OTHER)).await.problem(422, "hash_mismatch");
    assert!(detail.contains(&hash), "{detail}");
    for unchecked in ["sha-256=:x:", "sha-512=:AA==:", "SHA-256=:AA==:", "nonsense", ""] {
        let refused = app.send(digest(post(), unchecked)).await;
        assert!(refused.problem(400, "malformed_request").contains("sha-256=:"), "{unchecked}");
    }
    app.get(&format!("/v1/blobs/{hash}")).await.problem(404, "not_found");
    app.send(digest(post(), &format!("sha-512=:AA==:, {ABC}"))).await.expect(201);
    app.send(digest(post(), ABC)).await.expect(200);
    let json = |value: &str| {
        let request = app.request(Method::POST, "/v1/calibrations").json(&json!({"masks": hash}));
        digest(request, value)
    };
    app.send(json(OTHER)).await.problem(422, "hash_mismatch");
    let zipped = app.request(Method::POST, "/v1/jobs").json(&json!({}));
    app.send(zipped.header("content-encoding", "gzip"))
        .await
        .problem(415, "unsupported_media_type");
    // The digest of a piece is its checksum.
    let tus = |method, path: &str| app.request(method, path).header("tus-resumable", "1.0.0");
    let created = app.send(tus(Method::POST, "/v1/uploads").header("upload-length", 3)).await;
    let path = created.expect(201).header("location").to_owned();
    let piece = || {
        let kind = "application/offset+octet-stream";
        let request = tus(Method::PATCH, &path).header("upload-offset", 0).body("abc");
        request.header("content-type", kind)
    };
    app.send(digest(piece(), OTHER)).await.problem(460, "checksum_mismatch");
    app.send(digest(piece(), ABC)).await.expect(204);
}

/// A server may send plain content against the wish of the client, but must not refuse after the effect.
#[tokio::test]
async fn the_encoding_of_an_answer_is_never_a_reason_to_refuse() {
    let app = TestApp::start().await;
    for (at, encodings) in ["identity;q=0", "*;q=0", "br, *;q=0", ""].into_iter().enumerate() {
        let post = app.request(Method::POST, "/v1/blobs").body(at.to_string());
        let made = app.send(post.header("accept-encoding", encodings)).await.expect(201);
        assert_eq!(made.header("content-encoding"), "", "{encodings}");
    }
    let page = |encodings: &str| {
        app.request(Method::GET, "/openapi.yaml").header("accept-encoding", encodings)
    };
    let packed = app.send(page("gzip;q=0.5, identity;q=0")).await.expect(200);
    assert_eq!(packed.header("content-encoding"), "gzip");
    let tag = packed.header("etag").to_owned();
    let known = app.send(page("gzip").header("if-none-match", tag)).await.expect(304);
    assert!(known.header("vary").contains("accept-encoding"), "{}", known.header("vary"));
}

#[tokio::test]
async fn a_busy_database_is_reported_as_temporary() {
    let app = TestApp::with(&["--workers", "0", "--request-seconds", "60"]).await;
    let mut database = app.database().await;
    let lock = database.begin_with("BEGIN IMMEDIATE").await.unwrap();
    let busy = app.send(app.request(Method::POST, "/v1/blobs").body("abc")).await;
    busy.problem(503, "unavailable");
    assert_eq!(busy.header("retry-after"), "15", "the lock has been held for as long");
    lock.rollback().await.unwrap();
    app.upload(b"abc".to_vec()).await;
}

#[tokio::test]
async fn only_its_owner_can_read_the_folder() {
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("data");
    std::fs::create_dir(&data).unwrap();
    std::fs::set_permissions(&data, std::fs::Permissions::from_mode(0o755)).unwrap();
    let app = TestApp::on(folder, "data", &["--workers", "0"]).await;
    let mode = |name: &str| {
        let path = app.data().join(name);
        std::fs::metadata(path).unwrap().permissions().mode() & 0o777
    };
    assert_eq!((mode(""), mode("sci-recon.db")), (0o700, 0o600));
}

#[tokio::test]
async fn readiness_is_tested_by_writing() {
    let shim = Shim::build();
    let full = shim.file("full");
    let faults = [("FAULT_FULL", full.to_str().unwrap())];
    let mut app = shim.service(&["--workers", "1"], &faults).await;
    app.get_until("/readyz", 200).await;
    // Nothing can be written although there is free space, as on a read-only disk or one without
    // inodes.
    std::fs::write(&full, "").unwrap();
    let ready = app.get_until("/readyz", 503).await.json();
    assert!(ready["disk"].as_str().unwrap().contains("no file can be written"), "{ready}");
    std::fs::remove_file(&full).unwrap();
    app.get_until("/readyz", 200).await;
    // A page of the database that is not needed for the start is overwritten.
    app.stop();
    let path = app.data().join("sci-recon.db");
    // Checks ignore free pages, so there must be none.
    let options = SqliteConnectOptions::new().filename(&path);
    let mut records = SqliteConnection::connect_with(&options).await.unwrap();
    sqlx::query("VACUUM").execute(&mut records).await.unwrap();
    records.close().await.unwrap();
    let original = std::fs::read(&path).unwrap();
    let mut is_found = false;
    for page in (original.len() / 8192..original.len() / 4096).rev().step_by(3) {
        // Only pages of trees have a structure that a check reads; the first byte is their kind.
        if ![2, 5, 10, 13].contains(&original[page * 4096]) {
            continue;
        }
        let mut bytes = original.clone();
        bytes[page * 4096..page * 4096 + 64].fill(0xa5);
        std::fs::write(&path, bytes).unwrap();
        if !app.try_restart() {
            continue;
        }
        let start = Instant::now();
        let health = loop {
            let ready = app.get("/readyz").await.json();
            if ready["database"] != "ok" || start.elapsed().as_secs() > 20 {
                break ready["database"].as_str().unwrap().to_owned();
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        };
        assert!(health != "ok", "page {page} is damaged, and the database is {health}");
        is_found = true;
        app.kill();
    }
    assert!(is_found, "the service starts with no damage at all");
}

#[tokio::test]
async fn changes_are_refused_while_the_database_is_missing_or_another() {
    let app = TestApp::with(&["--workers", "1"]).await;
    app.get_until("/readyz", 200).await;
    let aside = app.data().join("tmp");
    let names = ["sci-recon.db", "sci-recon.db-wal", "sci-recon.db-shm"];
    let refused = async || {
        let ready = app.get_until("/readyz", 503).await.json();
        assert!(ready["database"].as_str().unwrap().contains("removed, replaced"), "{ready}");
        let upload = app.request(Method::POST, "/v1/blobs").body("important");
        app.send(upload).await.problem(503, "unavailable");
        let begin = app.request(Method::POST, "/v1/uploads").header("tus-resumable", "1.0.0");
        app.send(begin.header("upload-length", 10)).await.problem(503, "unavailable");
    };
    for name in names {
        std::fs::rename(app.data().join(name), aside.join(name)).unwrap();
        refused().await;
        // A command must not create the file: the service would not see its changes.
        let mut create = std::process::Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        create.args(["token", "--data"]).arg(app.data()).args(["create", "--lab", "a"]);
        let output = create.output().unwrap();
        let text = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && text.contains("removed, replaced"), "{name}: {text}");
        assert!(!app.data().join(name).exists(), "{name}");
        std::fs::rename(aside.join(name), app.data().join(name)).unwrap();
        app.get_until("/readyz", 200).await;
    }
    for name in names {
        std::fs::rename(app.data().join(name), aside.join(name)).unwrap();
    }
    refused().await;
    for name in names {
        std::fs::copy(aside.join(name), app.data().join(name)).unwrap();
    }
    refused().await;
    for name in names {
        std::fs::rename(aside.join(name), app.data().join(name)).unwrap();
    }
    app.get_until("/readyz", 200).await;
    app.upload(b"important".to_vec()).await;
}

#[tokio::test]
async fn a_corrected_clock_deletes_no_recent_upload() {
    let shim = Shim::build();
    let clock = shim.file("clock");
    let year: i64 = 365 * 86_400;
    std::fs::write(&clock, (-year).to_le_bytes()).unwrap();
    let faults = [("FAULT_CLOCK", clock.to_str().unwrap())];
    let mut app = shim.service(&["--workers", "0", "--job-days", "1"], &faults).await;
    let upload = app.upload(b"sent a moment ago".to_vec()).await;
    let begin = app.request(Method::POST, "/v1/uploads").header("tus-resumable", "1.0.0");
    let created = app.send(begin.header("upload-length", 10)).await.expect(201);
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let job = app.submit(&json!({"measurement": measurement, "algorithm": "gap-tv"})).await;
    app.post(&format!("/v1/jobs/{job}/cancel"), &json!({})).await.expect(202);
    // The next server has the right time, and cleans up at its start.
    app.restart();
    tokio::time::sleep(Duration::from_secs(2)).await;
    app.get(&format!("/v1/blobs/{upload}")).await.expect(200);
    app.get(&format!("/v1/jobs/{job}")).await.expect(200);
    let path = created.header("location").to_owned();
    let head = app.request(Method::HEAD, &path).header("tus-resumable", "1.0.0");
    app.send(head).await.expect(200);
}

#[tokio::test]
async fn deleting_a_large_job_does_not_block_others() {
    let app = TestApp::start().await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let job = app.submit(&json!({"measurement": measurement, "algorithm": "gap-tv"})).await;
    app.post(&format!("/v1/jobs/{job}/cancel"), &json!({})).await.expect(202);
    let folder = app.data().join("results").join(&job).join("snapshot_0000/frames");
    std::fs::create_dir_all(&folder).unwrap();
    for number in 0..60_000 {
        std::fs::write(folder.join(number.to_string()), "").unwrap();
    }
    let start = Instant::now();
    app.delete(&format!("/v1/jobs/{job}")).await.expect(204);
    let took = start.elapsed();
    assert!(!app.data().join("results").join(&job).exists());
    let start = Instant::now();
    while std::fs::read_dir(app.data().join("tmp")).unwrap().count() > 0 {
        assert!(start.elapsed().as_secs() < 60, "the files remain");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    eprintln!("the delete took {took:?}, its files {:?} more", start.elapsed());
}

/// An administrator may move the folder by mistake, or its disk may be unmounted.
#[tokio::test]
async fn without_the_data_folder_the_answers_name_it_and_nothing_is_lost() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let request = json!({"measurement": measurement, "algorithm": "gap-tv"});
    let job = app.submit(&request).await;
    app.ended(&job).await;
    let result = format!("/v1/jobs/{job}/snapshots/0/exports/npy");
    let frames = app.get(&result).await.expect(200);
    let aside = app.data().with_extension("aside");
    std::fs::rename(app.data(), &aside).unwrap();
    for request in [
        app.request(Method::POST, "/v1/blobs").body("important"),
        app.request(Method::POST, "/v1/jobs").json(&request),
        app.request(Method::GET, &result),
    ] {
        let detail = app.send(request).await.problem(503, "unavailable");
        assert!(detail.contains("data folder"), "{detail}");
    }
    std::fs::rename(&aside, app.data()).unwrap();
    assert_eq!(app.get_until(&result, 200).await.bytes, frames.bytes);
}

/// Files that nobody may change, not even root, until this is dropped.
struct Immutable(Vec<std::path::PathBuf>);

impl Immutable {
    /// Prints a message and returns `None` if the disk or the user can't do this.
    fn new(files: Vec<std::path::PathBuf>) -> Option<Self> {
        let immutable = Self(files);
        if immutable.set("+i") {
            return Some(immutable);
        }
        eprintln!("SKIPPED: chattr +i needs root, and a disk that knows it");
        None
    }

    fn set(&self, flag: &str) -> bool {
        let mut command = std::process::Command::new("chattr");
        let output = command.arg(flag).args(&self.0).output();
        output.is_ok_and(|output| output.status.success())
    }
}

impl Drop for Immutable {
    fn drop(&mut self) {
        self.set("-i");
    }
}

/// A connection that SQLite has opened while the file was read-only stays read-only.
#[tokio::test]
async fn changes_are_possible_again_after_the_database_was_read_only() {
    let app = TestApp::with(&["--workers", "0"]).await;
    app.upload(b"before".to_vec()).await;
    let files = ["sci-recon.db", "sci-recon.db-wal"].map(|name| app.data().join(name));
    let Some(immutable) = Immutable::new(files.into()) else { return };
    for _ in 0..3 {
        let upload = app.request(Method::POST, "/v1/blobs").body("during");
        app.send(upload).await.problem(503, "unavailable");
    }
    drop(immutable);
    let start = std::time::Instant::now();
    loop {
        let upload = app.request(Method::POST, "/v1/blobs").body("after");
        let answer = app.send(upload).await;
        if answer.status.is_success() {
            break;
        }
        assert!(start.elapsed().as_secs() < 60, "{}", answer.json());
        tokio::time::sleep(std::time::Duration::from_millis(100)).await;
    }
    assert_eq!(app.get("/readyz").await.json()["disk"], "ok");
}

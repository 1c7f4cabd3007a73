//! Uploads in one request.

use std::time::Duration;

use reqwest::{Body, Method, multipart};
use serde_json::json;

use crate::app::{TestApp, id};

/// SHA-256 of "abc".
const ABC: &str = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";

#[tokio::test]
async fn a_file_is_stored_once_under_its_hash() {
    let app = TestApp::start().await;
    let post = || app.request(Method::POST, "/v1/blobs").body("abc");
    let first = app.send(post()).await.expect(201);
    assert_eq!(first.json()["sha256"], ABC);
    assert_eq!(first.json()["size"], 3);
    assert_eq!(first.header("location"), format!("/v1/blobs/{ABC}"));
    assert_eq!(app.send(post()).await.expect(200).json(), first.json());
    let form = multipart::Form::new()
        .text("note", "before the file")
        .part("file", multipart::Part::bytes(b"abc".to_vec()).file_name("../../etc/passwd"));
    app.send(app.request(Method::POST, "/v1/blobs").multipart(form)).await.expect(200);
    assert_eq!(app.get(&format!("/v1/blobs/{ABC}")).await.expect(200).json(), first.json());
    let head = app.request(Method::HEAD, &format!("/v1/blobs/{ABC}"));
    assert!(app.send(head).await.expect(200).bytes.is_empty());
    let path = app.data().join("blobs").join(&ABC[..2]).join(&ABC[2..]);
    assert_eq!(std::fs::read(path).unwrap(), b"abc");
}

#[tokio::test]
async fn a_bad_upload_is_rejected_with_the_reason_and_leaves_no_file() {
    let app = TestApp::with(&["--workers", "0", "--max-upload-bytes", "100000"]).await;
    let post = |body: Body| app.request(Method::POST, "/v1/blobs").body(body);
    // A part of a file must not be stored as a file.
    let part = post(Body::from("abc")).header("content-range", "bytes 0-2/9");
    let detail = app.send(part).await.problem(400, "malformed_request");
    assert!(detail.contains("/v1/uploads"), "{detail}");
    app.send(post(Body::from(""))).await.problem(400, "empty_body");
    app.send(post(Body::from(vec![0; 100_001]))).await.problem(413, "too_large");
    // Without a Content-Length, the limit applies to the bytes received.
    let chunks = (0..20).map(|_| Ok::<_, std::io::Error>(vec![0u8; 10_000]));
    let stream = Body::wrap_stream(futures_util::stream::iter(chunks));
    app.send(post(stream)).await.problem(413, "too_large");
    // The rest of a rejected body must not be read as the next request on the connection.
    let refused = post(Body::from(vec![0; 100_001])).send().await.unwrap();
    assert_eq!(refused.headers()["connection"], "close");
    let form = multipart::Form::new().text("other", "field");
    let answer = app.send(app.request(Method::POST, "/v1/blobs").multipart(form)).await;
    assert!(answer.problem(400, "malformed_request").contains("file"));
    let broken = app
        .request(Method::POST, "/v1/blobs")
        .header("content-type", "multipart/form-data; boundary=x")
        .body("--x\r\nContent-Disposition: form-data; name=\"file\"\r\n\r\nno end");
    app.send(broken).await.problem(400, "malformed_request");
    app.get(&format!("/v1/blobs/{ABC}")).await.problem(404, "not_found");
    for bad in ["abc", "..%2F..%2Fetc%2Fpasswd", &ABC.to_uppercase()] {
        app.get(&format!("/v1/blobs/{bad}")).await.problem(404, "not_found");
    }
    assert_eq!(std::fs::read_dir(app.data().join("tmp")).unwrap().count(), 0);
}

#[tokio::test]
async fn a_cut_connection_leaves_no_file() {
    use tokio::io::AsyncWriteExt;
    let app = TestApp::start().await;
    let address = app.address();
    let mut socket = tokio::net::TcpStream::connect(&address).await.unwrap();
    let head =
        format!("POST /v1/blobs HTTP/1.1\r\nHost: {address}\r\nContent-Length: 1000000\r\n\r\n");
    socket.write_all(head.as_bytes()).await.unwrap();
    socket.write_all(&[7; 200_000]).await.unwrap();
    let tmp = app.data().join("tmp");
    let count = || std::fs::read_dir(&tmp).unwrap().count();
    while count() == 0 {
        tokio::time::sleep(std::time::Duration::from_millis(5)).await;
    }
    drop(socket);
    let start = std::time::Instant::now();
    while count() > 0 {
        assert!(start.elapsed().as_secs() < 60, "the file of a cut upload is not removed");
        tokio::time::sleep(std::time::Duration::from_millis(5)).await;
    }
}

#[tokio::test]
async fn a_stalled_upload_is_ended() {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    let app = TestApp::with(&["--workers", "0", "--upload-idle-seconds", "1"]).await;
    let address = app.address();
    let mut socket = tokio::net::TcpStream::connect(&address).await.unwrap();
    let head =
        format!("POST /v1/blobs HTTP/1.1\r\nHost: {address}\r\nContent-Length: 10\r\n\r\nabc");
    socket.write_all(head.as_bytes()).await.unwrap();
    let mut answer = vec![0; 20];
    socket.read_exact(&mut answer).await.unwrap();
    assert!(answer.starts_with(b"HTTP/1.1 408"), "{}", String::from_utf8_lossy(&answer));
}

#[tokio::test]
async fn too_many_concurrent_uploads_are_asked_to_retry() {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    let app = TestApp::with(&["--workers", "0", "--max-uploads", "1"]).await;
    let address = app.address();
    let head = format!(
        "POST /v1/blobs HTTP/1.1\r\nHost: {address}\r\nContent-Length: 10\r\n\
         Expect: 100-continue\r\n\r\n"
    );
    let begin = async || {
        let mut socket = tokio::net::TcpStream::connect(&address).await.unwrap();
        socket.write_all(head.as_bytes()).await.unwrap();
        // The server requests the body when the upload has the only place.
        let mut answer = vec![0; 12];
        socket.read_exact(&mut answer).await.unwrap();
        assert_eq!(answer, b"HTTP/1.1 100", "{}", String::from_utf8_lossy(&answer));
        socket
    };
    let refused = async || {
        let second = app.send(app.request(Method::POST, "/v1/blobs").body("abc")).await;
        second.problem(429, "too_many_uploads");
        second.header("retry-after").parse::<u64>().unwrap()
    };
    let mut first = begin().await;
    assert!(refused().await < 7, "the first upload has just begun");
    tokio::time::sleep(Duration::from_secs(7)).await;
    let seconds = refused().await;
    assert!((7..30).contains(&seconds), "none has ended, and the first has taken 7 s: {seconds}");
    first.write_all(b"0123456789").await.unwrap();
    let (mut answer, mut part) = (String::new(), vec![0; 1000]);
    while !answer.contains("HTTP/1.1 201") {
        let count = first.read(&mut part).await.unwrap();
        assert!(count > 0, "{answer}");
        answer += &String::from_utf8_lossy(&part[..count]);
    }
    // The estimate follows the time that the first upload took.
    let _second = begin().await;
    let seconds = refused().await;
    assert!((7..30).contains(&seconds), "{seconds}");
}

/// The server's memory stays below 200 MiB while a 600 MB mask stack is uploaded and checked.
#[tokio::test]
async fn memory_is_bounded_while_a_large_stack_is_uploaded() {
    const FRAMES: usize = 60;
    const SIDE: usize = 2240;
    let app = TestApp::start().await;
    let header = crate::samples::npy_header("<u2", &[FRAMES, SIDE, SIDE]);
    let frame = bytes::Bytes::from(
        (0..SIDE * SIDE)
            .flat_map(|at| ((at * 2_654_435_761) as u16).to_le_bytes())
            .collect::<Vec<u8>>(),
    );
    let size = header.len() + FRAMES * frame.len();
    assert!(size > 600_000_000);
    let mut chunks = vec![Ok::<_, std::io::Error>(bytes::Bytes::from(header))];
    chunks.extend((0..FRAMES).map(|_| Ok(frame.clone())));
    let body = Body::wrap_stream(futures_util::stream::iter(chunks));
    let answer = app.send(app.request(Method::POST, "/v1/blobs").body(body)).await.expect(201);
    assert_eq!(answer.json()["size"], size);
    let uploaded = app.peak_memory();
    let masks = json!({ "masks": answer.json()["sha256"] });
    let created = app.post("/v1/calibrations", &masks).await;
    assert!([201, 202].contains(&created.status.as_u16()), "{}", created.json());
    let path = format!("/v1/calibrations/{}", id(&created));
    while app.wait(&path, "20").await.expect(200).json()["state"] != "ready" {}
    let checked = app.peak_memory();
    eprintln!("peak of the server: {uploaded} MiB after the upload, {checked} MiB after the check");
    assert!(checked < 200, "{checked} MiB");
}

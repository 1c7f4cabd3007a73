//! Slow downloads, caused by clients or by the disk.

use std::path::Path;
use std::time::{Duration, Instant, SystemTime};

use futures_util::future::join_all;
use reqwest::{Method, StatusCode};
use serde_json::json;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpSocket, TcpStream};

use crate::app::TestApp;
use crate::crashes::Shim;
use crate::samples::Scene;

/// Time between two reads of a client.
const STEP: Duration = Duration::from_millis(100);

/// A client with a small receive buffer that reads at a chosen rate.
pub struct Reader {
    socket: TcpStream,
    /// Bytes of the body read so far.
    pub body: Vec<u8>,
    /// True once the service has closed the connection.
    pub ended: bool,
}

impl Reader {
    /// Sends a request and reads the head of the answer, which must be 200.
    pub async fn begin(app: &TestApp, path: &str, token: Option<&str>) -> Self {
        let address = app.address();
        let socket = TcpSocket::new_v4().unwrap();
        socket.set_recv_buffer_size(4096).unwrap();
        let mut socket = socket.connect(address.parse().unwrap()).await.unwrap();
        let bearer = token.map(|token| format!("Authorization: Bearer {token}\r\n"));
        let bearer = bearer.unwrap_or_default();
        let head = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\n{bearer}\r\n");
        socket.write_all(head.as_bytes()).await.unwrap();
        let mut head = Vec::new();
        while !head.ends_with(b"\r\n\r\n") {
            head.push(socket.read_u8().await.unwrap());
        }
        let head = String::from_utf8(head).unwrap();
        assert!(head.starts_with("HTTP/1.1 200"), "{head}");
        Self { socket, body: Vec::new(), ended: false }
    }

    /// Reads at this rate for `time`.
    pub async fn take(&mut self, bytes_per_second: usize, time: Duration) {
        let end = Instant::now() + time;
        let share = bytes_per_second * STEP.as_millis() as usize / 1000;
        while Instant::now() < end && !self.ended {
            self.read(share).await;
            tokio::time::sleep(STEP).await;
        }
    }

    /// Reads `bytes` at full speed, or until the connection ends.
    pub async fn read(&mut self, mut bytes: usize) {
        let mut piece = vec![0; 64 * 1024];
        while bytes > 0 {
            let most = bytes.min(piece.len());
            // A closed connection may be reset.
            match self.socket.read(&mut piece[..most]).await {
                Ok(0) | Err(_) => {
                    self.ended = true;
                    return;
                }
                Ok(count) => {
                    self.body.extend_from_slice(&piece[..count]);
                    bytes -= count;
                }
            }
        }
    }
}

/// Lets `readers` clients of one lab download at 4 kB/s for `time`, while another lab sends a request every 20 ms.
/// Returns the status and the duration of each answer to the other lab.
pub async fn ask_during_slow_downloads(
    readers: usize,
    time: Duration,
) -> Vec<(StatusCode, Duration)> {
    let app = TestApp::with(&["--workers", "0"]).await;
    let (a, b) = (app.token(&["create", "--lab", "a"]), app.token(&["create", "--lab", "b"]));
    app.sign_in(&a);
    // The file is larger than the buffers of a connection.
    let sha256 = app.upload(vec![3; 40_000_000]).await;
    app.sign_in(&b);
    let path = format!("/v1/blobs/{sha256}/content");
    let (app, path, a) = (&app, &path, &a);
    let end = Instant::now() + time;
    let read = |_| async move {
        let mut reader = Reader::begin(app, path, Some(a)).await;
        for _ in 0..2 {
            reader.take(4000, Duration::from_secs(4)).await;
            // Empties the buffers, so that the service continues all bodies at the same moment.
            reader.read(2_000_000).await;
        }
        reader.take(4000, end.saturating_duration_since(Instant::now())).await;
        assert!(!reader.ended, "4 kB/s is enough");
    };
    let ask = async {
        let mut answers = Vec::new();
        while Instant::now() < end {
            let path = ["/v1/jobs", "/v1/blobs", "/v1/me"][answers.len() % 3];
            let start = Instant::now();
            let answer = app.request(Method::GET, path).send().await.unwrap();
            let status = answer.status();
            answer.bytes().await.unwrap();
            answers.push((status, start.elapsed()));
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        answers
    };
    futures_util::future::join(join_all((0..readers).map(read)), ask).await.1
}

#[tokio::test]
async fn slow_clients_do_not_block_others() {
    let answers = ask_during_slow_downloads(200, Duration::from_secs(14)).await;
    assert!(answers.len() > 20, "{}", answers.len());
    for (status, took) in answers {
        assert_eq!(status, 200);
        // The fault made answers wait for 30 s. A busy machine may need some of this time.
        assert!(took < Duration::from_secs(15), "an answer took {took:?}");
    }
}

#[tokio::test]
async fn a_client_that_reads_too_slowly_is_disconnected_and_can_resume() {
    const SIZE: usize = 8_000_000;
    let limits = ["--download-stall-seconds", "3", "--download-bytes-per-second", "20000"];
    let app = TestApp::with(&[&["--workers", "0"], &limits[..]].concat()).await;
    let content: Vec<u8> = (0..SIZE).map(|at| (at % 251) as u8).collect();
    let path = format!("/v1/blobs/{}/content", app.upload(content.clone()).await);
    let mut events = app.request(Method::GET, "/v1/events").send().await.unwrap();
    let hello = events.chunk().await.unwrap().unwrap();
    assert!(hello.starts_with(b"event: hello\n"), "{hello:?}");
    let mut idle = Reader::begin(&app, "/livez", None).await;
    let slow = async {
        let mut reader = Reader::begin(&app, &path, None).await;
        reader.take(2000, Duration::from_secs(9)).await;
        // Bytes in the kernel's buffers still arrive.
        reader.read(SIZE).await;
        reader
    };
    let quick = async {
        let mut reader = Reader::begin(&app, &path, None).await;
        reader.take(60_000, Duration::from_secs(9)).await;
        reader.read(SIZE - reader.body.len()).await;
        reader
    };
    let (slow, quick) = tokio::join!(slow, quick);
    assert!(!quick.ended && quick.body == content);
    assert!(slow.ended && slow.body.len() < SIZE, "{} bytes came", slow.body.len());
    let range = format!("bytes={}-", slow.body.len());
    let rest = app.send(app.request(Method::GET, &path).header("range", range)).await.expect(206);
    assert!([slow.body, rest.bytes].concat() == content);
    // A connection without data to send is kept.
    assert!(tokio::time::timeout(STEP, events.chunk()).await.is_err());
    let body = idle.body.len();
    assert!(tokio::time::timeout(STEP, idle.read(1000)).await.is_err(), "{body}");
}

#[tokio::test]
async fn an_answer_ends_with_its_session() {
    let app = TestApp::start().await;
    let ends = async |mut events: reqwest::Response| {
        let rest = async { while events.chunk().await.unwrap().is_some() {} };
        tokio::time::timeout(Duration::from_secs(20), rest).await.expect("the answer ends");
    };
    let listen = || app.request(Method::GET, "/v1/events");
    let open = listen().send().await.unwrap();
    let token = app.token(&["create", "--lab", "a"]);
    ends(open).await;
    let begin = app.request(Method::POST, "/view/session").bearer_auth(&token);
    let session = app.send(begin).await.expect(201);
    let session = session.header("set-cookie").split(';').next().unwrap().to_owned();
    let signed_in = listen().header("cookie", &session).send().await.unwrap();
    assert_eq!(signed_in.status(), 200);
    let mut other = listen().bearer_auth(&token).send().await.unwrap();
    other.chunk().await.unwrap().unwrap();
    let end = app.request(Method::DELETE, "/view/session").header("cookie", &session);
    app.send(end.header("x-requested-with", "page")).await.expect(204);
    ends(signed_in).await;
    let more = tokio::time::timeout(Duration::from_secs(4), other.chunk()).await;
    assert!(more.is_err(), "the token is still valid");
}

/// Makes all stored files look as if they had been changed, so that their hashes are not known.
pub fn touch_all(folder: &Path) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            touch_all(&path);
        } else {
            let file = std::fs::File::options().write(true).open(path).unwrap();
            file.set_modified(SystemTime::now()).unwrap();
        }
    }
}

#[tokio::test]
async fn a_file_on_a_slow_disk_is_read_once_without_time_limit() {
    // Reads of 48 kB and more take 6 s.
    const RATE: &str = "8000";
    let shim = Shim::build();
    let slow = shim.file("slow");
    let faults = [("FAULT_SLOW", slow.to_str().unwrap()), ("FAULT_RATE", RATE)];
    let arguments = ["--workers", "1", "--request-seconds", "3", "--scrub-bytes", "0"];
    let app = shim.service(&arguments, &faults).await;
    let (calibration, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    let job = app.submit(&body).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    let upload = app.upload(vec![7; 48_000]).await;
    let masks = app.upload(Scene::SMALL.masks()).await;
    let head = async |path: &str| {
        let start = Instant::now();
        let answer = app.request(Method::HEAD, path).send().await.unwrap();
        assert_eq!(answer.status(), 200, "{path}");
        start.elapsed().as_secs_f64()
    };
    std::fs::write(&slow, []).unwrap();
    let content = format!("/v1/blobs/{upload}/content");
    let took = head(&content).await;
    assert!(took < 3.0, "the hash is known from the upload: {took} s");
    let forget = || {
        touch_all(&app.data().join("blobs"));
        touch_all(&app.data().join("results"));
    };
    // The read continues after its client has disconnected.
    forget();
    let impatient = app.request(Method::GET, &content).timeout(Duration::from_millis(500));
    assert!(impatient.send().await.unwrap_err().is_timeout());
    tokio::time::sleep(Duration::from_secs(7)).await;
    let took = head(&content).await;
    assert!(took < 3.0, "the file is read again: {took} s");
    // These routes read a whole file before they send the first byte.
    forget();
    let snapshot = format!("/v1/jobs/{job}/snapshots/0");
    let paths = [
        content,
        format!("/view/blobs/{masks}/pictures/frame-1"),
        format!("/view/calibrations/{calibration}/pictures/mask-1"),
        format!("/view/measurements/{measurement}/pictures/snapshot-1"),
        format!("/view/measurements/{measurement}/pictures/snapshot-1/spread"),
        format!("/v1/jobs/{job}/exports/manifest"),
        format!("/v1/jobs/{job}/exports/zip"),
        format!("/v1/jobs/{job}/exports/npy"),
        format!("/v1/jobs/{job}/exports/tiff"),
        format!("/v1/jobs/{job}/exports/zarr/0/c/5/0/0"),
        format!("{snapshot}/exports/manifest"),
        format!("{snapshot}/exports/exr"),
        format!("{snapshot}/exports/tiff"),
        format!("{snapshot}/exports/npy"),
        format!("{snapshot}/exports/frames/1.exr"),
        format!("{snapshot}/exports/frames/1.png"),
        format!("{snapshot}/exports/zarr/0/c/0/0/0"),
        format!("/view/jobs/{job}/snapshots/0/pictures/frame-1"),
        format!("/view/jobs/{job}/snapshots/0/pictures/residual"),
    ];
    let times = join_all(paths.iter().map(|path| head(path))).await;
    let longest = times.iter().fold(0.0, |longest: f64, took| longest.max(*took));
    assert!(longest > 3.0, "the disk is not slow: {longest} s");
}

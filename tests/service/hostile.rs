//! Malicious or mistaken input. Each request gets a 4xx with a clear message, and the service
//! continues.

use reqwest::Method;
use serde_json::{Value, json};

use crate::app::{Answer, TestApp, id};
use crate::samples::{self, Scene, constant, npy, npy_header};

#[tokio::test]
async fn bad_masks_are_rejected_with_the_reason() {
    let app = TestApp::start().await;
    let mut infinite = vec![0.5f32; 4 * 8 * 8];
    infinite[2 * 64 + 3 * 8 + 5] = f32::INFINITY;
    let mut dark_frame = vec![0.5f32; 2 * 8 * 8];
    dark_frame[64..].fill(0.0);
    let truncated = |mut file: Vec<u8>, by: usize| {
        file.truncate(file.len() - by);
        file
    };
    let two_gigabytes = [npy_header("<f4", &[50, 3277, 3277]), vec![0; 900]].concat();
    let fields_of = |text: &str| {
        [b"\x93NUMPY\x01\x00".to_vec(), vec![text.len() as u8, 0], text.into()].concat()
    };
    let cases: Vec<(&str, Vec<u8>, &str, &[&str])> = vec![
        ("a truncated TIFF", truncated(samples::tiff(64, 64), 2000), "truncated", &["TIFF"]),
        ("a TIFF cut in its header", truncated(samples::tiff(8, 8), 100), "", &["TIFF"]),
        ("2 GB promised in 1 kB", two_gigabytes, "truncated", &["promises"]),
        ("a truncated npy", truncated(constant(&[2, 8, 8], 0.5), 1), "truncated", &[]),
        ("a huge side", npy_header("<f4", &[1, 1 << 40, 8]), "over_limit", &["height"]),
        ("sides that overflow", npy_header("<f4", &[1 << 40, 1 << 40, 1 << 40]), "over_limit", &[]),
        (
            "infinity",
            npy(&[4, 8, 8], infinite.into_iter()),
            "not_finite",
            &["frame 2", "row 3", "column 5"],
        ),
        ("zero masks", constant(&[2, 8, 8], 0.0), "all_masks_zero", &["open"]),
        (
            "masks without light",
            constant(&[2, 8, 8], 1e-30),
            "all_masks_zero",
            &["1e-30", "full_scale"],
        ),
        ("one zero mask", npy(&[2, 8, 8], dark_frame.into_iter()), "mask_frame_zero", &["frame 1"]),
        ("values above 1", constant(&[2, 8, 8], 200.0), "above_full_scale", &["200", "full_scale"]),
        (
            "complex numbers",
            [npy_header("<c8", &[1, 8, 8]), vec![0; 512]].concat(),
            "",
            &["complex64"],
        ),
        ("strings", [npy_header("<U8", &[1, 8, 8]), vec![0; 2048]].concat(), "", &["U8"]),
        (
            "objects",
            fields_of("{'descr': '|O', 'fortran_order': False, 'shape': (1,), }\n"),
            "",
            &[],
        ),
        ("a header of nonsense", fields_of("__import__('os').system('true')\n"), "", &["npy"]),
        ("no axes", npy_header("<f4", &[]), "", &[]),
        ("an empty axis", npy_header("<f4", &[0, 8, 8]), "malformed", &["empty"]),
        ("text", b"hello, these are my masks".to_vec(), "unknown_format", &["npy"]),
        ("one byte", b"x".to_vec(), "unknown_format", &[]),
        ("a colour PNG", colour_png(), "unsupported_content", &["PNG"]),
        ("half a PNG", colour_png()[..40].to_vec(), "", &[]),
        ("a zip", b"PK\x03\x04 and so on".to_vec(), "malformed", &["ZIP", "directory"]),
    ];
    for (name, file, reason, words) in cases {
        let answer = app.calibrate(file).await;
        let detail = answer.problem(422, "invalid_content");
        assert!(detail.len() > 20, "{name}: {detail}");
        if !reason.is_empty() {
            assert_eq!(answer.json()["reason"], reason, "{name}: {detail}");
        }
        for word in words {
            assert!(detail.contains(word), "{name}: {detail:?} does not say {word:?}");
        }
        assert!(!detail.contains(app.data().to_str().unwrap()), "{name} shows a path: {detail}");
    }
    // The service is running, and has kept nothing.
    app.calibrate(Scene::SMALL.masks()).await.expect(201);
    assert_eq!(std::fs::read_dir(app.data().join("tmp")).unwrap().count(), 0);
}

/// A PNG of one red pixel.
fn colour_png() -> Vec<u8> {
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, 1, 1);
    encoder.set_color(png::ColorType::Rgb);
    encoder.write_header().unwrap().write_image_data(&[255, 0, 0]).unwrap();
    file
}

#[tokio::test]
async fn masks_with_ambiguous_axes_are_rejected_until_the_order_is_stated() {
    let app = TestApp::start().await;
    for shape in [[96, 128, 8], [64, 64, 8]] {
        let answer = app.calibrate(constant(&shape, 0.5)).await;
        let detail = answer.problem(422, "invalid_content");
        let turned = format!("row-column-frame (8 of {}x{}), column-row-frame", shape[0], shape[1]);
        assert!(detail.contains(&turned) && detail.contains("moveaxis"), "{detail}");
        assert_eq!(answer.json()["reason"], "axes_ambiguous");
        assert_eq!(answer.json()["pointer"], "/axes");
    }
    // A file with that many masks would keep a worker busy for hours.
    for shape in [[4096, 8, 8], [65, 72, 72]] {
        let detail = app.calibrate(constant(&shape, 0.5)).await.problem(422, "size_mismatch");
        assert!(
            detail.contains("read as frame-row-column") && detail.contains("at most 64"),
            "{detail}"
        );
    }
    app.calibrate(constant(&[64, 8, 8], 0.5)).await.expect(201);
}

#[tokio::test]
async fn mismatched_measurements_are_rejected_with_both_sizes() {
    let app = TestApp::start().await;
    let calibration = id(&app.calibrate(Scene::SMALL.masks()).await.expect(201));
    let wrong = app.measure(&calibration, constant(&[1, 32, 64], 1.0)).await;
    let detail = wrong.problem(422, "size_mismatch");
    assert!(detail.contains("32x64") && detail.contains("48x64"), "{detail}");
    assert_eq!(wrong.json()["pointer"], "/data");
    let turned = app.measure(&calibration, constant(&[64, 48], 1.0)).await;
    turned.problem(422, "size_mismatch");
    let dark = app.measure(&calibration, constant(&[2, 48, 64], 0.0)).await;
    assert!(dark.problem(422, "invalid_content").contains("snapshot 0"));
    let infinite = app.measure(&calibration, constant(&[48, 64], f32::INFINITY)).await;
    assert_eq!(infinite.json()["reason"], "not_finite");
}

#[tokio::test]
async fn bad_fields_are_rejected_with_their_pointer() {
    let app = TestApp::start().await;
    let masks = app.upload(Scene::SMALL.masks()).await;
    let nowhere = "0".repeat(64);
    let calibrations: Vec<(Value, &str)> = vec![
        (json!({}), ""),
        (json!({"masks": nowhere}), "/masks"),
        (json!({"masks": "../../etc/passwd"}), "/masks"),
        (json!({"masks": masks, "name": "a\nb"}), "/name"),
        (json!({"masks": masks, "name": "x".repeat(201)}), "/name"),
        (json!({"masks": masks, "name": ""}), "/name"),
        (json!({"masks": masks, "frames": 8}), "/frames"),
        (json!({"masks": masks, "full_scale": "255"}), "/full_scale"),
        (json!([masks]), ""),
    ];
    for (body, pointer) in calibrations {
        let answer = app.post("/v1/calibrations", &body).await;
        answer.problem(422, "invalid_request");
        assert_eq!(answer.json()["pointer"], pointer, "{body}");
    }
    for scale in [json!(0), json!(-1), json!(1e-45), json!(1e39)] {
        let answer =
            app.post("/v1/calibrations", &json!({"masks": masks, "full_scale": scale})).await;
        assert_eq!(
            (answer.status.as_u16(), &answer.json()["pointer"]),
            (422, &json!("/full_scale"))
        );
    }
    // A path is a valid name.
    let body = json!({"masks": masks, "name": "../../etc/passwd"});
    let named = app.post("/v1/calibrations", &body).await.expect(201);
    assert_eq!(named.json()["name"], "../../etc/passwd");
    let calibration = id(&named);
    let data = app.upload(Scene::SMALL.snapshots()).await;
    let good = json!({"calibration": calibration, "data": data});
    for (field, value) in [
        ("camera_fps", json!(0)),
        ("camera_fps", json!(1e300)),
        ("exposure_s", json!(-0.1)),
        ("saturation", json!(0)),
        ("dark", json!(vec![&nowhere; 2049])),
        ("calibration", json!("019ae4f0-6e5c-7c3a-9d1e-0d5f0a1b2c3d")),
        ("calibration", json!("mine")),
        ("data", json!(nowhere)),
    ] {
        let mut body = good.clone();
        body[field] = value;
        let answer = app.post("/v1/measurements", &body).await;
        answer.problem(422, "invalid_request");
        assert_eq!(answer.json()["pointer"], format!("/{field}"));
    }
}

#[tokio::test]
async fn bodies_that_are_not_json_are_distinguished() {
    let app = TestApp::start().await;
    let post = |kind: &'static str, body: Vec<u8>| {
        app.send(app.request(Method::POST, "/v1/jobs").header("content-type", kind).body(body))
    };
    post("application/json", Vec::new()).await.problem(400, "empty_body");
    post("application/json", b"{".to_vec()).await.problem(400, "malformed_json");
    post("application/json", b"{} {}".to_vec()).await.problem(422, "invalid_request");
    post("application/json", vec![0xff, 0xfe]).await.problem(400, "malformed_json");
    post("text/plain", b"{}".to_vec()).await.problem(415, "unsupported_media_type");
    post("application/json", vec![b' '; 300_000]).await.problem(413, "too_large");
    let deep = "[".repeat(100_000).into_bytes();
    let nested: Answer = post("application/json", deep).await;
    assert_eq!(nested.status.as_u16() / 100, 4, "{nested:?}");
}

#[tokio::test]
async fn unusual_requests_are_answered() {
    let app = TestApp::start().await;
    app.get("/nowhere").await.problem(404, "not_found");
    app.get("/v1/jobs/").await.problem(404, "not_found");
    app.get("/v1/jobs/mine").await.problem(404, "not_found");
    app.get("/v1/jobs/%ff").await.problem(404, "not_found");
    app.get("/v1/jobs?limit=0").await.problem(400, "invalid_query");
    app.get("/v1/jobs?limit=many").await.problem(400, "invalid_query");
    app.get("/v1/jobs?state=lost").await.problem(400, "invalid_query");
    app.get("/v1/jobs?colour=red").await.problem(400, "invalid_query");
    app.get("/v1/jobs?cursor=1").await.problem(400, "invalid_query");
    app.get("/v1/jobs?label=%00").await.problem(400, "invalid_query");
    for (method, path, allow) in [
        (Method::PATCH, "/v1/jobs", "GET,HEAD,POST"),
        (Method::PUT, "/v1/blobs", "GET,HEAD,POST"),
        (Method::DELETE, "/livez", "GET,HEAD"),
        (Method::from_bytes(b"BREW").unwrap(), "/v1/calibrations", "GET,HEAD,POST"),
        (Method::TRACE, "/metrics", "GET,HEAD"),
    ] {
        let answer = app.send(app.request(method, path)).await;
        answer.problem(405, "method_not_allowed");
        assert_eq!(answer.header("allow"), allow, "{path}");
    }
    let mine = app.request(Method::GET, "/livez").header("x-request-id", "lab-7.42");
    assert_eq!(app.send(mine).await.header("x-request-id"), "lab-7.42");
    let odd = app.request(Method::GET, "/livez").header("x-request-id", "a b\u{e9}");
    assert_ne!(app.send(odd).await.header("x-request-id").len(), 0);
}

#[tokio::test]
async fn silent_connections_do_not_block_the_service_and_end() {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpStream;

    let app = TestApp::with(&["--workers", "0"]).await;
    let address = app.address();
    let limits = std::fs::read_to_string(format!("/proc/{}/limits", app.pid())).unwrap();
    let files = limits.lines().find(|line| line.starts_with("Max open files")).unwrap();
    let figures: Vec<&str> = files.split_whitespace().collect();
    assert_eq!(figures[3], figures[4], "the soft limit on files is raised to the hard one");
    let mut silent = Vec::new();
    for _ in 0..900 {
        silent.push(TcpStream::connect(&address).await.unwrap());
    }
    app.get("/v1/jobs").await.expect(200);
    let half = silent.last_mut().unwrap();
    half.write_all(b"GET /livez HTTP/1.1\r\nHost: x\r\nX-Slow: ").await.unwrap();
    let limit = std::time::Duration::from_secs(60);
    let mut answer = Vec::new();
    let ended = tokio::time::timeout(limit, half.read_to_end(&mut answer)).await;
    assert!(ended.is_ok(), "a connection with an endless head is not closed");
}

#[tokio::test]
async fn a_request_with_two_hosts_is_rejected() {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpStream;

    let app = TestApp::start().await;
    let address = app.address();
    for (lines, status) in [
        (String::new(), "400"),
        (format!("Host: {address}\r\nHost: evil.example\r\n"), "400"),
        (format!("Host: {address}\r\n"), "200"),
    ] {
        let mut socket = TcpStream::connect(&address).await.unwrap();
        let request = format!("GET /livez HTTP/1.1\r\n{lines}Connection: close\r\n\r\n");
        socket.write_all(request.as_bytes()).await.unwrap();
        let mut answer = String::new();
        socket.read_to_string(&mut answer).await.unwrap();
        assert!(answer.starts_with(&format!("HTTP/1.1 {status}")), "{lines:?}: {answer}");
    }
}

/// The messages name the field, its value and the accepted ones, in the terms of the user.
#[tokio::test]
async fn messages_say_which_value_is_wrong_and_which_are_accepted() {
    let app = TestApp::with(&["--workers", "1", "--webhook-host", "lab.example"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let job = app.submit(&json!({"measurement": measurement, "algorithm": "gap-tv"})).await;
    app.ended(&job).await;
    let long = "x".repeat(3000);
    let gets = [
        ("/v1/jobs?limit=-1".to_owned(), 400, "whole number"),
        ("/v1/jobs?limit=99999999999999999999".to_owned(), 400, "whole number"),
        ("/v1/jobs?created_after=9999-12-31T23:59:59Z".to_owned(), 400, "is not from"),
        ("/v1/jobs?created_after=2026-02-30T00:00:00Z".to_owned(), 400, "RFC 3339"),
        (format!("/v1/jobs?search={long}"), 400, "the text has 3000 characters"),
        ("/v1/jobs?lab=*&lab=local".to_owned(), 400, "more than once"),
        (format!("/v1/jobs/{job}/snapshots/+0/exports/npy"), 404, "snapshot is +0"),
        (format!("/v1/jobs/{job}/snapshots/00"), 404, "snapshot is 00"),
        ("/v1/jobs/%FF".to_owned(), 404, "UTF-8"),
    ];
    for (path, status, expected) in gets {
        let answer = app.get(&path).await;
        let code = if status == 400 { "invalid_query" } else { "not_found" };
        let detail = answer.problem(status, code);
        assert!(detail.contains(expected), "{path}: {detail}");
    }
    let exports = format!("/v1/jobs/{job}/exports");
    let with = |field: &str, value: Value| {
        let mut body = json!({"measurement": measurement, "algorithm": "gap-tv"});
        body[field] = value;
        body
    };
    let window = |black: f64, white: f64| json!({"format": "gif", "black": black, "white": white});
    for (path, body, expected) in [
        (&*exports, window(-3.4e38, 3.4e38), "black is -3.4e38 and white is 3.4e38; both and"),
        (&*exports, window(2.0, 1.0), "black must be below white"),
        ("/v1/jobs", with("label", json!(long)), "the text has 3000 characters; at most 200"),
        ("/v1/jobs", with("webhook", json!("lab")), "such as https://lab.example/hooks/sci-recon"),
        ("/v1/jobs", with("snapshots", json!({"first": 0, "last": 1})), "[first, last]"),
    ] {
        let answer = app.post(path, &body).await;
        let detail = answer.problem(422, "invalid_request");
        assert!(detail.contains(expected) && !detail.contains("at line"), "{path}: {detail}");
    }
    let across = app.post("/v1/jobs?lab=*", &with("priority", json!(0))).await;
    assert!(across.problem(404, "not_found").contains("there is no lab"), "{across:?}");
}

//! Images of results, and the convergence history.

use reqwest::Method;
use serde_json::{Value, json};

use crate::app::{Answer, TestApp, judges};
use crate::pipeline::values;
use crate::samples::{Scene, npy};

/// Rows, columns and values of an 8-bit grey PNG.
pub fn decode(answer: &Answer) -> (usize, usize, Vec<u8>) {
    assert_eq!(answer.header("content-type"), "image/png");
    let picture = image::load_from_memory(&answer.bytes).unwrap();
    let image::DynamicImage::ImageLuma8(grey) = picture else { panic!("not 8-bit grey") };
    (grey.height() as usize, grey.width() as usize, grey.into_raw())
}

async fn job(app: &TestApp, schedule: Value) -> String {
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv", "snapshots": 1,
        "tile": {"size": 32, "overlap": 8}, "schedule": schedule});
    app.submit(&body).await
}

fn tv(iterations: u32, updates: u32) -> Value {
    json!({"stages": [{"prior": "tv", "iterations": iterations, "tv_weight": 0.1,
        "tv_updates": updates, "tolerance": 0.0}]})
}

#[tokio::test]
async fn images_show_the_frames_unchanged() {
    let app = TestApp::with(&["--workers", "2"]).await;
    let job = job(&app, tv(200, 4)).await;
    let done = app.ended(&job).await;
    let base = format!("/v1/jobs/{job}/snapshots/1");
    let frames = values(&app.get(&format!("{base}/exports/npy")).await.expect(200).bytes);
    let (height, width) = (Scene::SMALL.height, Scene::SMALL.width);
    let plane = height * width;
    let pictures = format!("{base}/pictures").replace("/v1/", "/view/");

    // A tile at full resolution has every pixel, on the scale of the window.
    let address = format!("{pictures}/frame-2/tiles/0/0/0?black=0.1&white=0.9");
    let tile = app.get(&address).await.expect(200);
    let (rows, columns, shown) = decode(&tile);
    assert_eq!((rows, columns), (height, width));
    for (&shown, &value) in shown.iter().zip(&frames[plane..2 * plane]) {
        let expected = ((value - 0.1) / 0.8 * 255.0).clamp(0.0, 255.0);
        assert!((f32::from(shown) - expected).abs() <= 0.51, "{shown} {expected}");
    }
    assert_eq!(tile.header("cache-control"), "private, no-cache");
    let known = app.request(Method::GET, &address).header("if-none-match", tile.header("etag"));
    app.send(known).await.expect(304);

    // The values of the same tile are exact.
    let address = format!("{pictures}/frame-2/values/0/0/0");
    let exact = app.get(&address).await.expect(200);
    let expected: Vec<u8> =
        frames[plane..2 * plane].iter().flat_map(|value| value.to_le_bytes()).collect();
    assert_eq!(exact.bytes[..], expected[..]);
    let known = app.request(Method::GET, &address).header("if-none-match", exact.header("etag"));
    app.send(known).await.expect(304);

    // A preview is reduced by a power of two; a slice has one row of every frame.
    let small = app.get(&format!("{pictures}/frame-1?size=32&black=0&white=1")).await.expect(200);
    let (rows, columns, shown) = decode(&small);
    assert_eq!((rows, columns), (height / 2, width / 2));
    let mean = (frames[0] + frames[1] + frames[width] + frames[width + 1]) / 4.0;
    assert!((f32::from(shown[0]) - mean * 255.0).abs() <= 0.51);
    let slice = app.get(&format!("{pictures}/slice-5/tiles/0/0/0?black=0&white=1")).await;
    let (rows, columns, shown) = decode(&slice.expect(200));
    assert_eq!((rows, columns), (Scene::SMALL.frames, width));
    let value = frames[3 * plane + 5 * width + 7] * 255.0;
    assert!((f32::from(shown[3 * width + 7]) - value).abs() <= 0.51);

    // The range of values gives a suitable window; the residual is small.
    let spread = app.get(&format!("{pictures}/frame-1/spread")).await.expect(200).json();
    assert_eq!((&spread["height"], &spread["levels"]), (&json!(height), &json!(0)));
    assert!(spread["low"].as_f64().unwrap() < spread["high"].as_f64().unwrap());
    let rest = app.get(&format!("{pictures}/residual/spread")).await.expect(200).json();
    assert!(rest["maximum"].as_f64().unwrap() < 0.1, "{rest}");
    app.get(&format!("{pictures}/difference-2")).await.expect(200);

    // The true error is the frame minus the true frame, of this snapshot or of all.
    app.get(&format!("{pictures}/deviation-1")).await.problem(404, "not_found");
    for first in [0, Scene::SMALL.frames] {
        let shape = [first + Scene::SMALL.frames, height, width];
        let true_value = |at: usize| if at < first * plane { 9.0 } else { (at % plane) as f32 };
        let truth = npy(&shape, (0..shape[0] * plane).map(true_value));
        let truth = json!({"truth": app.upload(truth).await});
        let change = app.request(Method::PATCH, &format!("/v1/jobs/{job}")).json(&truth);
        app.send(change).await.expect(200);
        let error = app.get(&format!("{pictures}/deviation-2/values/0/0/0")).await.expect(200);
        for (at, error) in error.bytes.chunks(4).enumerate() {
            let error = f32::from_le_bytes(error.try_into().unwrap());
            let expected = frames[plane + at] - at as f32;
            assert!((error - expected).abs() < 1e-3, "{at}: {error} {expected}");
        }
    }
    app.get(&format!("{pictures}/colours")).await.problem(404, "not_found");

    // Masks and measurement have images too.
    let (calibration, measurement) = (&done["calibration"], &done["measurement"]);
    let masks = format!("/view/calibrations/{}/pictures", calibration.as_str().unwrap());
    for name in ["mask-4", "mean", "gram", "dead"] {
        decode(&app.get(&format!("{masks}/{name}")).await.expect(200));
    }
    let measured = format!("/view/measurements/{}/pictures", measurement.as_str().unwrap());
    decode(&app.get(&format!("{measured}/snapshot-1")).await.expect(200));

    for (path, status, code) in [
        (format!("{pictures}/frame-0"), 404, "not_found"),
        (format!("{pictures}/frame-5"), 404, "not_found"),
        (format!("{pictures}/difference-1"), 404, "not_found"),
        (format!("{pictures}/slice-48"), 404, "not_found"),
        (format!("{pictures}/secret"), 404, "not_found"),
        (format!("{masks}/mask-5"), 404, "not_found"),
        (format!("{measured}/snapshot-2"), 404, "not_found"),
        (format!("{pictures}/frame-1/tiles/0/1/0?black=0&white=1"), 404, "not_found"),
        (format!("{pictures}/frame-1/tiles/1/0/0?black=0&white=1"), 404, "not_found"),
        (format!("{pictures}/frame-1/values/0/0/1"), 404, "not_found"),
        (format!("{measured}/snapshot-2/values/0/0/0"), 404, "not_found"),
        (format!("{masks}/mask-5/values/0/0/0"), 404, "not_found"),
        (format!("{pictures}/frame-1/tiles/0/0/0"), 400, "invalid_query"),
        (format!("{pictures}/frame-1/tiles/0/0/0?black=1&white=1"), 400, "invalid_query"),
        (format!("{pictures}/frame-1/tiles/0/0/0?black=NaN&white=1"), 400, "invalid_query"),
        (format!("{pictures}/frame-1?size=5000"), 400, "invalid_query"),
    ] {
        app.get(&path).await.problem(status, code);
    }
}

#[tokio::test]
async fn frames_are_compared_with_a_known_truth() {
    let app = TestApp::with(&["--workers", "2"]).await;
    let job = job(&app, tv(60, 4)).await;
    let path = format!("/v1/jobs/{job}/snapshots/1/quality?truth=");
    let scene = Scene::SMALL;
    let truth = |snapshots: std::ops::Range<usize>| {
        let (frames, height, width) = (scene.frames, scene.height, scene.width);
        let shape = [snapshots.len() * frames, height, width];
        let pixels = snapshots.flat_map(move |snapshot| {
            (0..frames * height * width).map(move |at| {
                let (row, column) = (at / width % height, at % width);
                scene.pixel(snapshot, at / (height * width), row, column)
            })
        });
        crate::samples::npy(&shape, pixels)
    };
    let one_snapshot = app.upload(truth(1..2)).await;
    app.ended(&job).await;
    let quality = app.get(&format!("{path}{one_snapshot}")).await.expect(200).json();
    let psnr = quality["psnr"].as_f64().unwrap();
    assert!((24.0..60.0).contains(&psnr), "{quality:#}");
    assert!((0.5..1.0).contains(&quality["ssim"].as_f64().unwrap()), "{quality:#}");
    let frames = quality["frames"].as_array().unwrap();
    let mean = frames.iter().map(|frame| frame["psnr"].as_f64().unwrap()).sum::<f64>() / 4.0;
    assert!((mean - psnr).abs() < 1e-9);
    // The true frames of all snapshots give the same result; those of another snapshot do not.
    let all_snapshots = app.upload(truth(0..2)).await;
    assert_eq!(app.get(&format!("{path}{all_snapshots}")).await.json()["psnr"], quality["psnr"]);
    let other = app.upload(truth(0..1)).await;
    assert!(app.get(&format!("{path}{other}")).await.json()["psnr"].as_f64().unwrap() < psnr);
    let three = app.upload(crate::samples::constant(&[3, 48, 64], 0.5)).await;
    app.get(&format!("{path}{three}")).await.problem(422, "size_mismatch");
    app.get(&format!("{path}{}", "0".repeat(64))).await.problem(404, "not_found");
    let own = path.trim_end_matches("?truth=");
    app.get(own).await.problem(400, "invalid_query");

    // Attached to the job, the true frames hold for every reader, and the file is kept.
    let address = format!("/v1/jobs/{job}");
    assert_eq!(app.get(&address).await.json()["truth"], Value::Null);
    let attach = |truth: Value| app.request(Method::PATCH, &address).json(&json!({"truth": truth}));
    let attached = app.send(attach(json!(all_snapshots))).await.expect(200).json();
    assert_eq!(attached["truth"], json!(all_snapshots));
    assert_eq!(app.get(own).await.expect(200).json()["psnr"], quality["psnr"]);
    let upload = format!("/v1/blobs/{all_snapshots}");
    app.send(app.request(Method::DELETE, &upload)).await.problem(409, "in_use");
    for (unfit, code) in
        [(json!(three), "size_mismatch"), (json!("0".repeat(64)), "invalid_request")]
    {
        let refused = app.send(attach(unfit)).await;
        refused.problem(422, code);
        assert_eq!(refused.json()["errors"][0]["pointer"], "/truth");
    }
    assert_eq!(app.send(attach(Value::Null)).await.expect(200).json()["truth"], Value::Null);
    app.send(app.request(Method::DELETE, &upload)).await.expect(204);
}

#[tokio::test]
async fn the_truth_of_a_request_belongs_to_the_job_and_its_manifest() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let truth = app.upload(crate::samples::constant(&[4, 48, 64], 0.5)).await;
    let mut body = json!({"measurement": measurement, "algorithm": "gap-tv", "snapshots": 0,
        "schedule": tv(4, 2), "truth": truth});
    let job = app.submit(&body).await;
    assert_eq!(app.ended(&job).await["truth"], json!(truth));
    let manifest = app.get(&format!("/v1/jobs/{job}/exports/manifest")).await.expect(200).json();
    assert_eq!(manifest["run"]["truth_sha256"], json!(truth));
    let quality = app.get(&format!("/v1/jobs/{job}/snapshots/0/quality")).await.expect(200).json();
    assert_eq!(quality["truth"], json!(truth));
    body["truth"] = json!(app.upload(crate::samples::constant(&[4, 48, 63], 0.5)).await);
    let refused = app.post("/v1/jobs", &body).await;
    refused.problem(422, "size_mismatch");
    assert_eq!(refused.json()["errors"][0]["pointer"], "/truth");
    app.send(app.request(Method::DELETE, &format!("/v1/jobs/{job}"))).await.expect(204);
    app.send(app.request(Method::DELETE, &format!("/v1/blobs/{truth}"))).await.expect(204);
}

#[tokio::test]
async fn running_jobs_show_tiles_and_their_convergence() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let job = job(&app, tv(5_000, 8)).await;
    let base = format!("/v1/jobs/{job}/snapshots/1");
    let waits = self::job(&app, tv(5_000, 8)).await;
    let picture = format!("/view/jobs/{waits}/snapshots/1/pictures/frame-1");
    app.get(&picture).await.problem(404, "not_ready");
    app.when(&job, |job| {
        job["progress"]["tiles_done"].as_u64() >= Some(1)
            && job["progress"]["tiles_running"] == 1
            && job["progress"]["percent"].as_f64() < Some(90.0)
    })
    .await;
    let part =
        app.get(&format!("{base}/pictures/frame-1").replace("/v1/", "/view/")).await.expect(200);
    assert_eq!(part.header("cache-control"), "private, no-cache");
    let tiles =
        app.get(&format!("{base}/tiles").replace("/v1/", "/view/")).await.expect(200).json();
    let tiles = tiles["items"].as_array().unwrap();
    assert_eq!(tiles.len(), 6);
    assert_eq!(tiles[0]["state"], "done");
    assert!(tiles[0]["residual"].as_f64().unwrap() < 1.0);
    assert_eq!(tiles[5]["residual"], Value::Null);
    let history = app
        .get(&format!("{base}/tiles/0/history").replace("/v1/", "/view/"))
        .await
        .expect(200)
        .json();
    let points = history["points"].as_array().unwrap();
    assert!((64..=129).contains(&points.len()), "{}", points.len());
    assert_eq!((&points[0][0], &points[0][3]), (&json!(1), &Value::Null));
    assert_eq!(points.last().unwrap()[0], 5_000);
    assert!(points[0][1].as_f64() > points.last().unwrap()[1].as_f64(), "the residual falls");
    app.get(&format!("{base}/tiles/6/history").replace("/v1/", "/view/"))
        .await
        .problem(404, "not_found");
    for job in [waits, job] {
        app.post(&format!("/v1/jobs/{job}/cancel"), &json!({})).await.expect(202);
        app.ended(&job).await;
    }
}

#[tokio::test]
async fn a_coarse_preview_precedes_the_tiles() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let job = job(&app, tv(10_000, 50)).await;
    let preview = |job: &Value| job["progress"]["previews_done"] == 1;
    let early = app.when(&job, preview).await;
    assert_eq!(early["progress"]["tiles_done"], 0, "{early:#}");
    let base = format!("/view/jobs/{job}/snapshots/1/pictures/frame-3");
    let picture = app
        .get(&format!("{base}/tiles/0/0/0?black=0&white=1").replace("/v1/", "/view/"))
        .await
        .expect(200);
    assert_eq!(picture.header("cache-control"), "private, no-cache");
    let (height, width, shown) = decode(&picture);
    let difference = |i: usize, j: usize| {
        f64::from(shown[i * width + j]) / 255.0 - f64::from(Scene::SMALL.pixel(1, 2, i, j))
    };
    let pixels = (0..height).flat_map(|i| (0..width).map(move |j| (i, j)));
    let error = pixels.map(|(i, j)| difference(i, j).powi(2)).sum::<f64>() / shown.len() as f64;
    assert!(error < 0.02, "the preview shows the scene: {error}");
    app.post(&format!("/v1/jobs/{job}/cancel"), &json!({})).await.expect(202);
    let ended = app.ended(&job).await;
    assert_eq!(ended["state"], "cancelled");
}

/// Runs `tests/judges/pictures.py`, and returns what it prints.
fn judge(python: &str, action: &str, folder: &std::path::Path) -> String {
    let mut judge = std::process::Command::new(python);
    let output = judge.arg("tests/judges/pictures.py").arg(action).arg(folder).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

#[tokio::test]
async fn accept_chooses_the_encoding_of_a_picture() {
    let app = TestApp::start().await;
    let ramp = (0..60 * 100).map(|at| (at % 100) as f32 / 100.0);
    let sha256 = app.upload(npy(&[1, 60, 100], ramp)).await;
    let address = format!("/view/blobs/{sha256}/pictures/frame-1?black=0&white=1");
    let get = |accept: &str| app.request(Method::GET, &address).header("accept", accept);
    let folder = tempfile::tempdir().unwrap();
    let mut tags = std::collections::BTreeSet::new();
    for kind in ["png", "webp", "jpeg"] {
        let answer = app.send(get(&format!("image/{kind}, text/html"))).await.expect(200);
        assert_eq!(answer.header("content-type"), format!("image/{kind}"));
        assert_eq!(answer.header("vary"), "accept");
        let tag = answer.header("etag").to_owned();
        let known = get(&format!("image/{kind}")).header("if-none-match", &tag);
        let known = app.send(known).await.expect(304);
        assert_eq!((known.header("etag"), known.header("vary")), (&*tag, "accept"));
        assert!(tags.insert(tag), "each encoding has its ETag");
        std::fs::write(folder.path().join(format!("picture.{kind}")), &answer.bytes).unwrap();
    }
    for any in ["*/*", "image/*", "text/html, */*;q=0.1", "image/webp;q=0.2, image/png"] {
        let answer = app.send(get(any)).await.expect(200);
        assert_eq!(answer.header("content-type"), "image/png", "{any}");
    }
    for none in ["text/html", "application/json", "image/avif", "*/*;q=0"] {
        let refused = app.send(get(none)).await;
        let detail = refused.problem(406, "not_acceptable");
        assert!(detail.contains("image/webp"), "{detail}");
        assert_eq!(refused.header("vary"), "accept");
    }
    let Some(python) = judges() else { return };
    let report: Value = serde_json::from_str(&judge(&python, "read", folder.path())).unwrap();
    assert_eq!(report["png"], json!(["PNG", 100, 60, "L", 0.0]), "{report}");
    assert_eq!(report["webp"][4], 0.0, "lossless: {report}");
    assert_eq!((&report["webp"][0], &report["webp"][1]), (&json!("WEBP"), &json!(100)));
    assert_eq!(
        report["jpeg"].as_array().unwrap()[..4],
        json!(["JPEG", 100, 60, "L"]).as_array().unwrap()[..]
    );
    assert!(report["jpeg"][4].as_f64().unwrap() < 16.0, "{report}");
}

#[tokio::test]
async fn true_frames_may_be_8_bit_pictures_and_measurements_may_not() {
    let Some(python) = judges() else { return };
    let app = TestApp::with(&["--workers", "1"]).await;
    let folder = tempfile::tempdir().unwrap();
    let scene = Scene::SMALL;
    let shape = [scene.frames, scene.height, scene.width];
    let frames = (0..shape.iter().product()).map(|at: usize| {
        let (row, column) = (at / scene.width % scene.height, at % scene.width);
        scene.pixel(1, at / (scene.height * scene.width), row, column)
    });
    std::fs::write(folder.path().join("truth.npy"), npy(&shape, frames)).unwrap();
    judge(&python, "write", folder.path());
    let upload =
        async |name: &str| app.upload(std::fs::read(folder.path().join(name)).unwrap()).await;
    let job = job(&app, tv(60, 4)).await;
    app.ended(&job).await;
    let psnr = async |truth: String| {
        let path = format!("/v1/jobs/{job}/snapshots/1/quality?truth={truth}");
        app.get(&path).await.expect(200).json()["psnr"].as_f64().unwrap()
    };
    let expected = psnr(upload("truth8.npy").await).await;
    for (name, tolerance) in [("bmp.zip", 0.0), ("pgm.zip", 0.0), ("jpg.zip", 1.0)] {
        let found = psnr(upload(name).await).await;
        assert!((found - expected).abs() <= tolerance, "{name}: {found} {expected}");
    }
    let picture = upload("frame.jpg").await;
    let detail = app
        .post("/v1/calibrations", &json!({"masks": picture}))
        .await
        .problem(422, "invalid_content");
    assert!(detail.contains("JPEG") && detail.contains("lossy"), "{detail}");
    let shown = app.get(&format!("/view/blobs/{picture}/pictures/frame-1")).await.expect(200);
    assert_eq!(decode(&shown).0, scene.height);
    // A truth of one frame does not fit.
    let path = format!("/v1/jobs/{job}/snapshots/1/quality?truth={picture}");
    app.get(&path).await.problem(422, "size_mismatch");
    let archive = app.post("/v1/calibrations", &json!({"masks": upload("jpg.zip").await})).await;
    let detail = archive.problem(422, "invalid_content");
    assert!(detail.contains("neither PNG nor TIFF"), "{detail}");
}

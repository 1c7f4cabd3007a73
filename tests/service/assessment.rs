//! The expected quality of frames without true frames.

use reqwest::Method;
use serde_json::{Value, json};

use crate::app::{TestApp, judges};
use crate::pictures::decode;
use crate::samples::Scene;

#[tokio::test]
async fn a_result_has_an_expected_psnr_and_an_error_map() {
    let app = TestApp::with(&["--workers", "1"]).await;
    // Of fewer masks too many pixels are closed, which puts the calibration in doubt.
    let scene = Scene { frames: 10, ..Scene::SMALL };
    let (_, measurement) = app.scene(&scene).await;
    // Two tiles, so that their error maps are joined.
    let wanted = json!({"measurement": measurement, "algorithm": "gap-tv", "tile": {"size": 32, "overlap": 8}});
    let job = app.submit(&wanted).await;
    let before = app.get(&format!("/v1/jobs/{job}")).await.json();
    if before["state"] != "succeeded" {
        assert_eq!(before["assessment"], Value::Null);
    }
    let ended = app.ended(&job).await;
    let expected_quality = &ended["assessment"];
    let figure = |name: &str| expected_quality[name].as_f64().unwrap();
    assert!(
        figure("psnr_low_db") < figure("psnr_db") && figure("psnr_db") <= figure("psnr_high_db")
    );
    assert!(figure("psnr_db") > 5.0 && figure("psnr_high_db") <= 40.0, "{expected_quality}");
    assert!(
        ["good", "usable", "doubtful", "bad"]
            .contains(&expected_quality["grade"].as_str().unwrap()),
        "{expected_quality}"
    );
    let job_manifest =
        app.get(&format!("/v1/jobs/{job}/exports/manifest")).await.expect(200).json();
    let snapshots = job_manifest["content"]["snapshots"].as_array().unwrap();
    let mean =
        snapshots.iter().map(|one| one["assessment"]["psnr_db"].as_f64().unwrap()).sum::<f64>();
    assert!((mean / snapshots.len() as f64 - figure("psnr_db")).abs() < 0.06, "{job_manifest}");

    let base = format!("/v1/jobs/{job}/snapshots/0");
    let manifest = app.get(&format!("{base}/exports/manifest")).await.expect(200).json();
    assert_eq!(manifest["content"]["assessment"], snapshots[0]["assessment"]);
    let Scene { frames, height, width, .. } = scene;
    let blocks = (height.div_ceil(16), width.div_ceil(16));
    let array = app.get(&format!("{base}/exports/error")).await.expect(200).bytes;
    let header = String::from_utf8_lossy(&array[..128]).into_owned();
    let shape = format!("({frames}, {}, {})", blocks.0, blocks.1);
    assert!(header.contains(&shape), "{header}: {shape}");
    let values: Vec<f32> =
        array[128..].chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    assert_eq!(values.len(), frames * blocks.0 * blocks.1);
    assert!(values.iter().all(|error| *error > 0.0 && *error < 1.0), "{values:?}");

    // Each pixel of the image shows its block.
    let spread = app
        .get(&format!("{base}/pictures/error-2/spread").replace("/v1/", "/view/"))
        .await
        .expect(200)
        .json();
    assert_eq!(
        (spread["height"].as_u64(), spread["width"].as_u64()),
        (Some(height as u64), Some(width as u64))
    );
    let picture =
        format!("{base}/pictures/error-2/tiles/0/0/0?black=0&white=0.5").replace("/v1/", "/view/");
    let (_, columns, shown) = decode(&app.get(&picture).await.expect(200));
    let second = &values[blocks.0 * blocks.1..];
    for (row, column) in [(0, 0), (17, 3), (height - 1, width - 1)] {
        let expected = (second[row / 16 * blocks.1 + column / 16] * 510.0).min(255.0);
        let actual = f32::from(shown[row * columns + column]);
        assert!((actual - expected).abs() <= 0.51, "{row}, {column}: {actual} for {expected}");
    }
    app.get(&format!("{base}/pictures/error-{}", frames + 1).replace("/v1/", "/view/"))
        .await
        .problem(404, "not_found");
}

#[tokio::test]
async fn an_error_is_not_predicted_without_a_model_for_it() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let job = app.submit(&json!({"measurement": measurement, "algorithm": "admm-tv"})).await;
    assert_eq!(app.ended(&job).await["assessment"], Value::Null);
    let base = format!("/v1/jobs/{job}/snapshots/0");
    let manifest = app.get(&format!("{base}/exports/manifest")).await.expect(200).json();
    assert_eq!(manifest["content"]["assessment"], Value::Null);
    let view = base.replace("/v1/", "/view/");
    for path in [
        format!("{base}/exports/error"),
        format!("{view}/pictures/error-1"),
        format!("{base}/exports/exr?layers=sigma"),
    ] {
        let why = app.get(&path).await.problem(404, "not_found");
        assert!(why.contains("no error can be predicted"), "{why}");
    }
}

#[tokio::test]
async fn the_expected_error_is_an_optional_layer_of_the_exr() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let scene = Scene { height: 41, width: 35, ..Scene::SMALL };
    let (_, measurement) = app.scene(&scene).await;
    let job = app.submit(&json!({"measurement": measurement, "algorithm": "gap-tv"})).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    let folder = app.download(&job, 1).await;
    let plain = format!("/v1/jobs/{job}/snapshots/1/exports/exr");
    let path = format!("{plain}?layers=sigma");
    let complete = app.get(&path).await.expect(200);
    let (size, etag) = (complete.bytes.len(), complete.header("etag").to_owned());
    assert_eq!(complete.header("content-type"), "image/x-exr");
    assert!(
        complete.header("content-disposition").ends_with("_0001_stack-sigma.exr\""),
        "{complete:?}"
    );

    // Other readers find the original frames, and the layer in addition.
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), &complete.bytes).unwrap();
    if let Some(python) = judges() {
        let mut judge = tokio::process::Command::new(python);
        judge.arg("tests/judges/read_exr.py").arg(folder.path()).args(["--attribute", "algorithm"]);
        let output = judge.arg("--sigma").arg(file.path()).output().await.unwrap();
        let report = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(output.status.success(), "{report}{}", String::from_utf8_lossy(&output.stderr));
    }

    // The file with the layer supports caching and ranges.
    let head = app.send(app.request(Method::HEAD, &path)).await.expect(200);
    assert_eq!((head.header("content-length"), head.header("etag")), (&*size.to_string(), &*etag));
    app.send(app.request(Method::GET, &path).header("if-none-match", &etag)).await.expect(304);
    for first in [0, 1, size / 3, size / 2 + 5, size - 2] {
        let last = (first + size / 4).min(size - 1);
        let part = app.request(Method::GET, &path).header("range", format!("bytes={first}-{last}"));
        let part = app.send(part.header("if-range", &etag)).await.expect(206);
        assert!(part.bytes == complete.bytes[first..=last], "{first} to {last}");
    }

    // Without the parameter, the original file is sent.
    let stored = app.get(&plain).await.expect(200);
    assert!(stored.bytes == std::fs::read(folder.path().join("stack.exr")).unwrap());
    assert_ne!(stored.header("etag"), etag);
    for wrong in ["layers=depth", "layers=", "layer=sigma"] {
        let why = app.get(&format!("{plain}?{wrong}")).await.problem(400, "invalid_query");
        assert!(why.contains("sigma") || why.contains("layers"), "{why}");
    }

    // A damaged file is not sent.
    let errors = app.data().join("results").join(&job).join("snapshot_0001/error.npy");
    let mut bytes = std::fs::read(&errors).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    std::fs::write(errors, bytes).unwrap();
    app.get(&path).await.problem(500, "file_damaged");
    app.get(&plain).await.expect(200);
}

//! Manifests record everything that determined a result, and the service keeps it.

use std::process::Command;

use serde_json::{Value, json};

use crate::app::{TestApp, id};
use crate::samples::{Scene, constant, npy};

const SCENE: Scene = Scene { frames: 4, height: 64, width: 96, snapshots: 1 };

/// The inputs in the manifests of a new job of this measurement, and the job.
async fn inputs(app: &TestApp, measurement: &str) -> (Value, String) {
    let body = json!({"measurement": measurement, "algorithm": "gap-tv", "registration": "off"});
    let job = app.submit(&body).await;
    let ended = app.ended(&job).await;
    assert_eq!(ended["state"], "succeeded", "{ended:#}");
    let manifest = async |place: &str| {
        let manifest = app.get(&format!("/v1/jobs/{job}{place}/exports/manifest")).await;
        manifest.expect(200).json()["content"]["inputs"].take()
    };
    let inputs = manifest("").await;
    assert_eq!(manifest("/snapshots/0").await, inputs);
    (inputs, job)
}

#[tokio::test]
async fn manifests_record_all_inputs_and_the_service_keeps_them() {
    let app = TestApp::with(&["--workers", "2"]).await;
    let masks = app.upload(SCENE.masks()).await;
    let data = app.upload(SCENE.snapshots()).await;
    let made = async |calibration: Value, measurement: Value| {
        let calibration = id(&app.post("/v1/calibrations", &calibration).await.expect(201));
        let mut body = measurement;
        body["calibration"] = json!(calibration);
        (calibration, id(&app.post("/v1/measurements", &body).await.expect(201)))
    };
    let (_, measurement) = made(json!({"masks": masks}), json!({"data": data})).await;
    let axes = "frame-row-column";
    let mut expected = json!({
        "masks_sha256": masks,
        "masks_axes": axes,
        "calibration": {"masks": masks},
        "measurement_axes": axes,
        "measurement": {"data": data},
    });
    assert_eq!(inputs(&app, &measurement).await.0, expected);

    let files = [
        ("bad.npy", npy(&[64, 80], (0..64 * 80).map(|at| f32::from(u8::from(at == 99))))),
        ("dark1.npy", constant(&[64, 96], 0.01)),
        ("dark2.npy", constant(&[64, 96], 0.02)),
    ];
    let mut hashes = Vec::new();
    for (_, bytes) in &files {
        hashes.push(app.upload(bytes.clone()).await);
    }
    let [bad, dark @ ..] = &hashes[..] else { panic!() };
    let crop = json!({"row": 0, "column": 8, "height": 64, "width": 80});
    let (calibration, measurement) = made(
        json!({"masks": masks, "crop": crop, "frames": [0, 2], "bad_pixels": bad}),
        json!({"data": data, "crop": crop, "dark": dark, "saturation": 60000}),
    )
    .await;
    let shown = app.get(&format!("/v1/calibrations/{calibration}")).await.expect(200).json();
    assert_eq!(shown["bad_pixels"], *bad, "{shown:#}");
    expected["calibration"] =
        json!({"masks": masks, "crop": crop, "frames": [0, 2], "bad_pixels": bad});
    expected["measurement"] =
        json!({"data": data, "crop": crop, "dark": dark, "saturation": 60000});
    let (recorded, job) = inputs(&app, &measurement).await;
    assert_eq!(recorded, expected);

    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    for (name, bytes) in &files {
        std::fs::write(path(name), bytes).unwrap();
    }
    std::fs::write(path("masks.npy"), SCENE.masks()).unwrap();
    std::fs::write(path("y.npy"), SCENE.snapshots()).unwrap();
    let line = Command::new(env!("CARGO_BIN_EXE_sci-recon"))
        .args(["reconstruct", "--algorithm", "gap-tv", "--masks", "masks.npy", "--out", "out"])
        .args(["--measurement", "y.npy", "--registration", "off", "--bad-pixels", "bad.npy"])
        .args(["--masks-crop", "0,8,64,80", "--crop", "0,8,64,80", "--masks-frames", "0-2"])
        .args(["--dark", "dark1.npy", "--dark", "dark2.npy", "--saturation", "60000"])
        .current_dir(folder.path())
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&line.stderr);
    assert!([Some(0), Some(3)].contains(&line.status.code()), "{errors}");
    let manifest: Value =
        serde_json::from_slice(&std::fs::read(path("out/manifest.json")).unwrap()).unwrap();
    assert_eq!(manifest["content"]["inputs"], expected);

    let blob = |hash: &str| format!("/v1/blobs/{hash}");
    for hash in &hashes {
        app.delete(&blob(hash)).await.problem(409, "in_use");
    }
    app.delete(&format!("/v1/jobs/{job}")).await.expect(204);
    app.delete(&format!("/v1/measurements/{measurement}")).await.expect(204);
    app.delete(&blob(&dark[0])).await.expect(204);
    app.delete(&blob(bad)).await.problem(409, "in_use");
    app.delete(&format!("/v1/calibrations/{calibration}")).await.expect(204);
    app.delete(&blob(bad)).await.expect(204);
}

//! A data folder of an earlier version is taken over with all that it holds.

use std::path::Path;

use serde_json::Value;

use crate::app::TestApp;

/// What `tests/data/README.md` tells of.
const FINISHED: &str = "01a203ed-21a9-7450-a74f-e4fb868ae6b9";
const WAITING: &str = "01a203ed-2533-7639-93c7-462b39336fba";
const CANCELLED: &str = "01a203ed-2546-71f3-b4ab-ca5b00c198cd";
const CALIBRATION: &str = "01a203ed-1eb5-7233-9b4e-f1ce3b3ade4c";
const CAPTURES: &str = "01a203ed-25aa-72b2-bcff-e27c3cbb0cfe";

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let target = to.join(path.file_name().unwrap());
        if path.is_dir() {
            copy(&path, &target);
        } else {
            std::fs::copy(&path, &target).unwrap();
        }
    }
}

#[tokio::test]
async fn a_folder_of_the_version_before_finishes_its_waiting_job() {
    let folder = tempfile::tempdir().unwrap();
    let old = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/version-0.1");
    copy(&old, &folder.path().join("data"));
    let app = TestApp::on(folder, "data", &["--workers", "1"]).await;
    assert_eq!(app.ended(WAITING).await["state"], "succeeded");
    for (job, state) in [(FINISHED, "succeeded"), (CANCELLED, "cancelled")] {
        assert_eq!(app.get(&format!("/v1/jobs/{job}")).await.json()["state"], state);
    }
    // The old result is still served, and the new one is the same work done again.
    for snapshot in 0..2 {
        let frames = async |job| {
            let path = format!("/v1/jobs/{job}/snapshots/{snapshot}/frames.npy");
            let bytes = app.get(&path).await.expect(200).bytes;
            let values = bytes[bytes.len() - 4 * 4 * 32 * 32..].chunks_exact(4);
            values.map(|v| f32::from_le_bytes(v.try_into().unwrap())).collect::<Vec<f32>>()
        };
        let (before, after) = (frames(FINISHED).await, frames(WAITING).await);
        // To the bit on one kind of processor; the old folder may be from another.
        let difference =
            before.iter().zip(&after).fold(0.0f32, |worst, (a, b)| worst.max((a - b).abs()));
        assert!(difference < 1e-4, "{difference}");
    }
    let schedule = async |job| -> Value {
        let manifest = app.get(&format!("/v1/jobs/{job}/manifest.json")).await.expect(200).json();
        manifest["content"]["schedule"].clone()
    };
    assert_eq!(schedule(FINISHED).await, schedule(WAITING).await);
    // Calibrations keep their report, and the one that waited is made.
    app.get(&format!("/v1/calibrations/{CALIBRATION}/report.json")).await.expect(200);
    let made = async || app.get(&format!("/v1/calibrations/{CAPTURES}")).await.expect(200).json();
    let limit = std::time::Instant::now() + std::time::Duration::from_secs(60);
    while made().await["state"] == "preparing" {
        assert!(std::time::Instant::now() < limit, "the calibration is not made");
        tokio::time::sleep(std::time::Duration::from_millis(100)).await;
    }
    assert_eq!(made().await["state"], "ready");
}

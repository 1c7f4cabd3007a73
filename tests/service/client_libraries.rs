//! The clients that labs write programs with, against the real service.

use std::sync::atomic::Ordering;

use serde_json::Value;

use crate::app::{TestApp, judges};
use crate::resumable::cutting;
use crate::samples::Scene;

/// What a client makes of a service that is reached over connections that are cut, and how many were.
async fn over_cuts(app: &TestApp, mut client: tokio::process::Command) -> Value {
    let token = app.token(&["create", "--lab", "a"]);
    app.sign_in(&token);
    let (proxy, cuts) = cutting(app.address()).await;
    client.env("SCI_RECON_URL", format!("http://{proxy}")).env("SCI_RECON_TOKEN", &token);
    let output = client.output().await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let told: Value = serde_json::from_slice(&output.stdout).unwrap();
    let cut = cuts.load(Ordering::Relaxed);
    eprintln!("{cut} connections were cut; {told}");
    assert!(cut >= 3, "{cut} connections were cut");
    // No request that was sent again has made a second job.
    let jobs = app.get("/v1/jobs").await.expect(200).json();
    assert_eq!(jobs["items"].as_array().unwrap().len(), 1, "{jobs}");
    assert_eq!(jobs["items"][0]["id"], told["job"]);
    told
}

#[tokio::test]
async fn python_makes_the_round_trip_over_connections_that_are_cut() {
    let Some(python) = judges() else { return };
    let app = TestApp::with(&["--workers", "1"]).await;
    let folder = tempfile::tempdir().unwrap();
    let scene = Scene { frames: 8, height: 384, width: 384, snapshots: 2 };
    std::fs::write(folder.path().join("masks.npy"), scene.masks()).unwrap();
    std::fs::write(folder.path().join("measurement.npy"), scene.snapshots()).unwrap();
    let mut client = tokio::process::Command::new(python);
    client.env("PYTHONPATH", "clients/python/src");
    client.arg("tests/judges/python_client.py").arg(folder.path());
    let told = over_cuts(&app, client).await;
    assert_eq!(told["frames"], serde_json::json!([16, 384, 384]));
}

#[tokio::test]
async fn octave_makes_the_round_trip_over_connections_that_are_cut() {
    let mut client = tokio::process::Command::new("octave-cli");
    client.args(["--quiet", "--no-init-file", "tests/judges/octave_client.m"]);
    if tokio::process::Command::new("octave-cli").arg("--version").output().await.is_err() {
        eprintln!("SKIPPED: there is no octave-cli");
        return;
    }
    over_cuts(&TestApp::with(&["--workers", "1"]).await, client).await;
}

//! Damaged files, a busy database, and backups.

use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use serde_json::{Value, json};
use sqlx::Connection;

use crate::app::{TestApp, id};
use crate::faults::results;
use crate::samples::Scene;

fn slow(measurement: &str) -> Value {
    json!({
        "measurement": measurement,
        "algorithm": "gap-tv",
        "tile": {"size": 24, "overlap": 8},
        "schedule": {"stages": [
            {"prior": "tv", "iterations": 2000, "tv_weight": 0.05, "tv_updates": 20},
        ]},
    })
}

impl TestApp {
    /// Paths of the blobs, newest last.
    fn blobs(&self) -> Vec<PathBuf> {
        let mut files = Vec::new();
        for folder in std::fs::read_dir(self.data().join("blobs")).unwrap() {
            for entry in std::fs::read_dir(folder.unwrap().path()).unwrap() {
                let entry = entry.unwrap();
                files.push((entry.metadata().unwrap().modified().unwrap(), entry.path()));
            }
        }
        files.sort();
        files.into_iter().map(|(_, path)| path).collect()
    }

    pub async fn database(&self) -> sqlx::SqliteConnection {
        let path = self.data().join("sci-recon.db");
        sqlx::SqliteConnection::connect(path.to_str().unwrap()).await.unwrap()
    }

    fn back_up(&self, to: &std::path::Path) -> (bool, Value) {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        command.args(["backup", "--data"]).arg(self.data()).arg("--out").arg(to);
        let output = command.output().unwrap();
        let text = String::from_utf8(output.stdout).unwrap();
        let figures = serde_json::from_str(&text);
        let figures =
            figures.unwrap_or_else(|_| panic!("{}", String::from_utf8_lossy(&output.stderr)));
        (output.status.success(), figures)
    }
}

/// Flips one bit in the middle of a file.
fn damage(file: &std::path::Path) {
    let mut bytes = std::fs::read(file).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0x10;
    std::fs::write(file, bytes).unwrap();
}

#[tokio::test]
async fn a_damaged_tile_is_computed_again() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let first = app.submit(&slow(&measurement)).await;
    assert_eq!(app.ended(&first).await["state"], "succeeded");
    let job = app.submit(&slow(&measurement)).await;
    app.when(&job, |job| job["progress"]["tiles_done"].as_u64() >= Some(2)).await;
    let mut database = app.database().await;
    let tile: String = sqlx::query_scalar(
        "SELECT result FROM tasks WHERE job = ? AND kind = 'tile' AND result IS NOT NULL LIMIT 1",
    )
    .bind(&job)
    .fetch_one(&mut database)
    .await
    .unwrap();
    let (folder, name) = tile.split_at(2);
    damage(&app.data().join("blobs").join(folder).join(name));
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    assert_eq!(results(&app, &job).await, results(&app, &first).await);
    let redone: i64 =
        sqlx::query_scalar("SELECT count(*) FROM tasks WHERE attempt > 1 AND job = ?")
            .bind(&job)
            .fetch_one(&mut database)
            .await
            .unwrap();
    assert!(redone >= 1, "the tile was computed again");
}

#[tokio::test]
async fn damaged_masks_are_named_before_the_computation() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let calibration = app.calibrate(Scene::SMALL.masks()).await.expect(201);
    let upload = calibration.json()["masks"].as_str().unwrap().replace('"', "");
    let prepared =
        app.blobs().into_iter().find(|path| !name(path).ends_with(&upload[2..])).unwrap();
    let measurement =
        id(&app.measure(&id(&calibration), Scene::SMALL.snapshots()).await.expect(201));
    damage(&prepared);
    let done = app.ended(&app.submit(&slow(&measurement)).await).await;
    assert_eq!(done["state"], "failed");
    let error = done["error"].as_str().unwrap();
    assert!(error.contains("masks") && error.contains(&name(&prepared)[2..]), "{error}");
    // A backup names the file as well.
    let folder = tempfile::tempdir().unwrap();
    let (good, figures) = app.back_up(&folder.path().join("copy"));
    assert!(!good);
    assert_eq!(figures["damaged"].as_array().unwrap().len(), 1, "{figures}");
    // After another upload, the job succeeds.
    let calibration = id(&app.calibrate(Scene::SMALL.masks()).await.expect(201));
    let measurement = id(&app.measure(&calibration, Scene::SMALL.snapshots()).await.expect(201));
    assert_eq!(app.ended(&app.submit(&slow(&measurement)).await).await["state"], "succeeded");
}

/// The hash that a blob's path contains.
fn name(path: &std::path::Path) -> String {
    let last = path.file_name().unwrap().to_str().unwrap();
    let folder = path.parent().unwrap().file_name().unwrap().to_str().unwrap();
    format!("{folder}{last}")
}

#[tokio::test]
async fn a_busy_database_causes_delays_without_errors() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let job = app.submit(&slow(&measurement)).await;
    let mut database = app.database().await;
    for _ in 0..3 {
        let lock = database.begin_with("BEGIN IMMEDIATE").await.unwrap();
        // Reads continue in the meantime.
        app.get(&format!("/v1/jobs/{job}")).await.expect(200);
        tokio::time::sleep(Duration::from_secs(2)).await;
        lock.rollback().await.unwrap();
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
    assert_eq!(app.ended(&job).await["state"], "succeeded");
}

#[tokio::test]
async fn a_backup_of_running_jobs_continues_them() {
    let app = TestApp::with(&["--workers", "2"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let first = app.submit(&slow(&measurement)).await;
    assert_eq!(app.ended(&first).await["state"], "succeeded");
    let expected = results(&app, &first).await;
    let job = app.submit(&slow(&measurement)).await;
    app.when(&job, |job| job["progress"]["tiles_done"].as_u64() >= Some(1)).await;
    let folder = tempfile::tempdir().unwrap();
    let copy = folder.path().join("copy");
    let (good, figures) = app.back_up(&copy);
    assert!(good, "{figures}");
    assert!(figures["files"].as_u64() > Some(20) && figures["bytes"].as_u64() > Some(100_000));
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    // The backup can be served, and the job continues from its last tile.
    let restored = TestApp::on(folder, "copy", &["--workers", "2"]).await;
    assert_eq!(results(&restored, &first).await, expected);
    let done = restored.ended(&job).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    assert_eq!(results(&restored, &job).await, expected);
}

#[tokio::test]
async fn a_nearly_full_disk_removes_the_oldest_unneeded_jobs() {
    let app = TestApp::start().await;
    let (calibration, measurement) = app.scene(&Scene::SMALL).await;
    let body = json!({"measurement": measurement, "algorithm": "gap-tv"});
    let (old, new, waiting) =
        (app.submit(&body).await, app.submit(&body).await, app.submit(&body).await);
    for job in [&old, &new] {
        app.post(&format!("/v1/jobs/{job}/cancel"), &json!({})).await.expect(202);
    }
    let unused = app.upload(b"unneeded blob".to_vec()).await;
    let mut database = app.database().await;
    for sql in [
        "UPDATE jobs SET finished_at = finished_at - 7200000 WHERE id = ?",
        "UPDATE holdings SET touched_at = touched_at - 7200000 WHERE ? <> ''",
        "UPDATE blobs SET touched_at = touched_at - 7200000 WHERE ? <> ''",
    ] {
        sqlx::query(sql).bind(&old).execute(&mut database).await.unwrap();
    }
    let app = app.again(&["--workers", "0", "--low-water-bytes", "1000000000000000"]).await;
    let start = std::time::Instant::now();
    while app.get(&format!("/v1/jobs/{old}")).await.status != 404 {
        assert!(start.elapsed().as_secs() < 10, "the old job is not deleted");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    app.get(&format!("/v1/blobs/{unused}")).await.problem(404, "not_found");
    // Blobs that are young, queued, or needed by queued jobs:
    for path in [format!("jobs/{new}"), format!("jobs/{waiting}")] {
        app.get(&format!("/v1/{path}")).await.expect(200);
    }
    let shown = app.get(&format!("/v1/calibrations/{calibration}")).await.expect(200).json();
    app.get(&format!("/v1/blobs/{}", shown["masks"].as_str().unwrap())).await.expect(200);
    assert_eq!(app.blobs().len(), 4);
}

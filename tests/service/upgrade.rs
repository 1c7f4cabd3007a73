//! A data folder of an earlier version is taken over with all that it holds.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

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
    // What is there is charged, also what was made before that was counted.
    let sums = "SELECT (SELECT sum(result_bytes) FROM jobs), (SELECT sum(size) FROM result_files)";
    let mut database = app.database().await;
    let (charged, there): (i64, i64) = sqlx::query_as(sums).fetch_one(&mut database).await.unwrap();
    assert!(charged == there && there > 0, "{charged} {there}");
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

/// Names and contents of all files below a folder.
fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = PathBuf::from(path.file_name().unwrap());
        if path.is_dir() {
            found.extend(files(&path).into_iter().map(|(rest, bytes)| (name.join(rest), bytes)));
        } else {
            found.insert(name, std::fs::read(&path).unwrap());
        }
    }
    found
}

#[tokio::test]
async fn files_deleted_after_an_update_are_kept_for_a_rollback() {
    let old = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/version-0.1");
    for days in ["7", "0"] {
        let folder = tempfile::tempdir().unwrap();
        copy(&old, &folder.path().join("data"));
        let line = ["--workers", "1", "--rollback-days", days, "--upload-hours", "0"];
        let app = TestApp::on(folder, "data", &line).await;
        // The job that waited takes the tiles with it that were done, ...
        assert_eq!(app.ended(WAITING).await["state"], "succeeded");
        // ... people delete, ...
        for job in [FINISHED, WAITING, CANCELLED] {
            app.delete(&format!("/v1/jobs/{job}")).await.expect(204);
        }
        for kind in ["measurements", "calibrations"] {
            let items = app.get(&format!("/v1/{kind}?limit=100")).await.expect(200).json();
            for item in items["items"].as_array().unwrap() {
                let path = format!("/v1/{kind}/{}", item["id"].as_str().unwrap());
                app.delete(&path).await.expect(204);
            }
        }
        // ... and what nobody uses any more is cleared away at the next start.
        let app = app.again(&line).await;
        let start = Instant::now();
        let blobs = || files(&app.data().join("blobs")).len();
        while blobs() > 0 {
            assert!(start.elapsed() < Duration::from_secs(60), "{} files stay", blobs());
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
        let kept = app.data().join("before-updates/kept");
        if days == "0" {
            assert!(!kept.exists(), "{:?}", files(&kept).keys());
            continue;
        }
        let kept = files(&kept);
        for place in ["blobs", "results"] {
            for (name, bytes) in files(&old.join(place)) {
                let name = Path::new(place).join(name);
                assert!(kept.get(&name) == Some(&bytes), "{}: {:?}", name.display(), kept.keys());
            }
        }
    }
}

/// What a command says of a folder, and whether it ended well.
fn said(arguments: &[&str], data: &Path) -> (bool, String) {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_sci-recon"));
    let output = command.args(&arguments[..1]).arg("--data").arg(data).args(&arguments[1..]);
    let output = output.output().unwrap();
    (output.status.success(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[tokio::test]
async fn a_copy_is_restored_by_a_newer_version_and_refused_by_an_older_one() {
    let serve = ["serve", "--listen", "127.0.0.1:0", "--workers", "0", "--min-free-bytes", "0"];
    // A copy by the version before is a folder like this one.
    let folder = tempfile::tempdir().unwrap();
    let old = folder.path().join("old");
    copy(&Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/version-0.1"), &old);
    let before = std::fs::read(old.join("sci-recon.db")).unwrap();
    for arguments in [&["verify"][..], &["token", "list"]] {
        let (good, text) = said(arguments, &old);
        assert!(!good && text.contains("older version of this program"), "{arguments:?}: {text}");
    }
    assert_eq!(std::fs::read(old.join("sci-recon.db")).unwrap(), before, "nothing was changed");
    let restored = TestApp::on(folder, "old", &["--workers", "1"]).await;
    assert_eq!(restored.ended(WAITING).await["state"], "succeeded");
    assert!(said(&["verify"], restored.data()).0);

    // A copy of that, as a later version would have made it.
    let folder = tempfile::tempdir().unwrap();
    let new = folder.path().join("new");
    let out = new.display().to_string();
    assert!(said(&["backup", "--out", &out], restored.data()).0);
    let options = sqlx::sqlite::SqliteConnectOptions::new().filename(new.join("sci-recon.db"));
    let mut database = sqlx::ConnectOptions::connect(&options).await.unwrap();
    let later =
        "INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time)
                 VALUES (9999, 'later', 1, x'00', 0)";
    sqlx::query(later).execute(&mut database).await.unwrap();
    sqlx::Connection::close(database).await.unwrap();
    let marker = new.join("sci-recon.json");
    let mut mark: Value = serde_json::from_slice(&std::fs::read(&marker).unwrap()).unwrap();
    (mark["schema"], mark["version"]) = (9999.into(), "9.9.9".into());
    std::fs::write(&marker, mark.to_string()).unwrap();
    let before = std::fs::read(new.join("sci-recon.db")).unwrap();
    let again = folder.path().join("again").display().to_string();
    for arguments in [&serve[..], &["verify"], &["backup", "--out", &again], &["token", "list"]] {
        let (good, text) = said(arguments, &new);
        assert!(!good && text.contains("by version 9.9.9 (schema 9999)"), "{arguments:?}: {text}");
        assert!(text.contains("Nothing was changed"), "{arguments:?}: {text}");
    }
    assert_eq!(std::fs::read(new.join("sci-recon.db")).unwrap(), before);
}

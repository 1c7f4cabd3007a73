//! A data folder with a missing, empty, older or foreign database. The server rejects it with the
//! reason, and keeps every file.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Output;

use crate::app::{TestApp, bounded_program};
use crate::faults::sha256;

fn run(arguments: &[&str], data: &Path) -> Output {
    let mut command = bounded_program();
    command.args(&arguments[..1]).arg("--data").arg(data).args(&arguments[1..]);
    command.env("RUST_LOG", "error").output().unwrap()
}

/// Files of users, with their hashes.
fn files(data: &Path) -> BTreeMap<String, String> {
    let (mut hashes, mut folders) = (BTreeMap::new(), Vec::new());
    folders.extend(["blobs", "results", "partial"].map(|name| data.join(name)));
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(data).unwrap().display().to_string();
                hashes.insert(name, sha256(&std::fs::read(&path).unwrap()));
            }
        }
    }
    hashes
}

/// Uploads `count` distinct files.
async fn send(app: &TestApp, count: usize, seed: &str) {
    for number in 0..count {
        app.upload(format!("{seed} {number}").into_bytes()).await;
    }
}

/// The server and all commands reject the folder and do not change it.
fn refused(data: &Path, sentence: &str) {
    let before = files(data);
    let serve = ["serve", "--listen", "127.0.0.1:0", "--workers", "0", "--min-free-bytes", "0"];
    let copy = data.with_extension("copy").display().to_string();
    for arguments in [
        &serve[..],
        &["worker"],
        &["backup", "--out", &copy],
        &["token", "list"],
        &["token", "create", "--lab", "a", "--new"],
    ] {
        let output = run(arguments, data);
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success(), "{arguments:?}");
        assert!(output.stdout.is_empty(), "{arguments:?} announces something");
        assert!(text.contains(sentence), "{arguments:?}: {text}");
        assert!(text.contains("Nothing was changed. To go on, "), "{arguments:?}: {text}");
        assert_eq!(files(data), before, "{arguments:?}");
        assert!(!data.join("quarantine").exists());
    }
}

fn database(data: &Path) -> std::path::PathBuf {
    data.join("sci-recon.db")
}

fn remove_log(data: &Path) {
    for name in ["sci-recon.db-wal", "sci-recon.db-shm"] {
        // The file is removed by a clean end.
        let _ = std::fs::remove_file(data.join(name));
    }
}

#[tokio::test]
async fn a_folder_without_its_database_is_rejected() {
    let mut app = TestApp::start().await;
    send(&app, 2, "a").await;
    app.stop();
    let data = app.data().to_owned();
    let bytes = std::fs::read(database(&data)).unwrap();
    let marker = data.join("sci-recon.json");
    // The database is missing, with and without the marker.
    std::fs::remove_file(database(&data)).unwrap();
    refused(
        &data,
        "the database sci-recon.db is missing, though there are a marker and files here",
    );
    let mark = std::fs::read(&marker).unwrap();
    std::fs::remove_file(&marker).unwrap();
    refused(&data, "the database sci-recon.db is missing, though there are files here");
    assert!(!database(&data).exists(), "no database is created");
    // The database is empty.
    std::fs::write(&marker, mark).unwrap();
    std::fs::write(database(&data), b"").unwrap();
    refused(&data, "the database sci-recon.db is empty, though there are a marker and files here");
    // Only the marker exists.
    std::fs::write(database(&data), bytes).unwrap();
    std::fs::remove_file(&marker).unwrap();
    refused(&data, "the marker sci-recon.json is missing");
    // The option accepts the folder.
    let app = app.again(&["--workers", "0", "--accept-database"]).await;
    assert_eq!(files(&data).len(), 2);
    app.get("/v1/jobs").await.expect(200);
    assert!(marker.exists());
}

#[tokio::test]
async fn a_foreign_or_older_database_is_rejected() {
    let mut app = TestApp::start().await;
    send(&app, 2, "a").await;
    app.stop();
    let data = app.data().to_owned();
    let older = std::fs::read(database(&data)).unwrap();
    app.restart();
    send(&app, 2, "b").await;
    app.stop();
    let newer = std::fs::read(database(&data)).unwrap();
    std::fs::write(database(&data), older).unwrap();
    refused(&data, "the database is older than the folder");
    // The folder has the database of another service.
    let mut other = TestApp::start().await;
    other.stop();
    std::fs::copy(database(other.data()), database(&data)).unwrap();
    refused(&data, "the database belongs to another folder");
    // The folder's database is accepted again.
    std::fs::write(database(&data), newer).unwrap();
    app.restart();
    assert_eq!(files(&data).len(), 4);
    // The write-ahead log is lost. After a power cut, only the log has the last records.
    send(&app, 1, "c").await;
    app.cut_power();
    remove_log(&data);
    refused(&data, "the database is older than the folder, or has lost its -wal file");
    let app = app.again(&["--workers", "0", "--accept-database"]).await;
    assert_eq!((files(&data).len(), app.blobs_in("quarantine")), (4, 1));
}

/// A token changes the generation, so an earlier copy of the database cannot open the service.
#[tokio::test]
async fn a_database_from_before_a_token_is_rejected() {
    let mut app = TestApp::start().await;
    app.cut_power();
    let older = ["sci-recon.db", "sci-recon.db-wal"].map(|name| (name, app.data().join(name)));
    let older = older.map(|(name, path)| (name, std::fs::read(path).unwrap()));
    app.token(&["create", "--lab", "a"]);
    remove_log(app.data());
    for (name, bytes) in older {
        std::fs::write(app.data().join(name), bytes).unwrap();
    }
    refused(app.data(), "the database is older than the folder");
}

/// A database that is older within one generation lacks records of files.
#[tokio::test]
async fn many_orphans_are_rejected_and_few_are_quarantined() {
    let mut app = TestApp::start().await;
    send(&app, 10, "a").await;
    let mut connection = app.database().await;
    let mut forget = async |count: i64| {
        for sql in [
            "DELETE FROM holdings WHERE sha256 IN (SELECT sha256 FROM blobs ORDER BY sha256 LIMIT ?)",
            "DELETE FROM blobs WHERE sha256 IN (SELECT sha256 FROM blobs ORDER BY sha256 LIMIT ?)",
        ] {
            sqlx::query(sql).bind(count).execute(&mut connection).await.unwrap();
        }
    };
    // A crash leaves one orphan.
    forget(1).await;
    app.restart();
    assert_eq!((app.blobs_in("blobs"), app.blobs_in("quarantine")), (9, 1));
    // Many orphans indicate a wrong database.
    forget(4).await;
    app.cut_power();
    let data = app.data().to_owned();
    let before = files(&data);
    let output = run(&["serve", "--listen", "127.0.0.1:0", "--workers", "0"], &data);
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success() && output.stdout.is_empty());
    assert!(text.contains("the database does not know of 4 of the 9 files"), "{text}");
    assert_eq!(files(&data), before);
    let app = app.again(&["--workers", "0", "--accept-database"]).await;
    assert_eq!((app.blobs_in("blobs"), app.blobs_in("quarantine")), (5, 5));
    // Orphans stay in quarantine for days, and are then deleted.
    let old = data.join("quarantine/2020-01-01T00-00-00.000Z");
    std::fs::create_dir_all(&old).unwrap();
    std::fs::write(old.join("something"), b"old").unwrap();
    let app = app.again(&["--workers", "0"]).await;
    let start = std::time::Instant::now();
    while old.exists() {
        assert!(start.elapsed().as_secs() < 10, "the quarantine has an end");
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
    assert_eq!(app.blobs_in("quarantine"), 5);
}

#[tokio::test]
async fn an_interrupted_first_start_can_be_completed_and_copied() {
    let mut app = TestApp::start().await;
    send(&app, 5, "a").await;
    app.stop();
    std::fs::remove_file(app.data().join("sci-recon.json")).unwrap();
    let mut connection = app.database().await;
    sqlx::query("DELETE FROM folder").execute(&mut connection).await.unwrap();
    drop(connection);
    let output = run(&["token", "list"], app.data());
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(text.contains("older version of this program. Nothing was changed"), "{text}");
    app.restart();
    assert_eq!(app.blobs_in("blobs"), 5);
    assert!(app.data().join("sci-recon.json").exists());
    // A copy is an older database together with its files.
    let folder = tempfile::tempdir().unwrap();
    let copy = folder.path().join("copy").display().to_string();
    assert!(run(&["backup", "--out", &copy], app.data()).status.success());
    app.restart();
    let mut restored = TestApp::on(folder, "copy", &["--workers", "0"]).await;
    assert_eq!(restored.blobs_in("blobs"), 5);
    restored.restart();
    // An interrupted copy is not a data folder.
    restored.stop();
    std::fs::remove_file(restored.data().join("sci-recon.json")).unwrap();
    refused(restored.data(), "the marker sci-recon.json is missing");
}

#[test]
fn only_the_server_creates_a_folder_by_default() {
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("data");
    for path in [folder.path(), &data] {
        for arguments in [
            &["worker"][..],
            &["backup", "--out", "/nowhere/copy"],
            &["token", "list"],
            &["token", "create", "--lab", "a"],
        ] {
            let output = run(arguments, path);
            let text = String::from_utf8_lossy(&output.stderr).into_owned();
            assert_eq!(output.status.code(), Some(2), "{arguments:?}: {text}");
            assert!(text.contains("is no data folder of a service"), "{arguments:?}: {text}");
        }
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    assert!(run(&["token", "create", "--lab", "a", "--new"], &data).status.success());
    assert!(run(&["token", "list"], &data).status.success());
}

impl TestApp {
    fn blobs_in(&self, folder: &str) -> usize {
        let (mut count, mut folders) = (0, vec![self.data().join(folder)]);
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                if path.is_dir() { folders.push(path) } else { count += 1 }
            }
        }
        count
    }
}

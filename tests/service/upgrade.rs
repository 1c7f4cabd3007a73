//! Backups of other versions.

use std::path::Path;

use serde_json::Value;

use crate::app::{TestApp, bounded_program};

/// The error output of a command on a folder, and whether the command succeeded.
fn run(arguments: &[&str], data: &Path) -> (bool, String) {
    let mut command = bounded_program();
    let output = command.args(&arguments[..1]).arg("--data").arg(data).args(&arguments[1..]);
    let output = output.output().unwrap();
    (output.status.success(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[tokio::test]
async fn a_copy_of_a_newer_version_is_refused_unchanged() {
    let serve = ["serve", "--listen", "127.0.0.1:0", "--workers", "0", "--min-free-bytes", "0"];
    let app = TestApp::start().await;
    let folder = tempfile::tempdir().unwrap();
    let new = folder.path().join("new");
    let out = new.display().to_string();
    assert!(run(&["backup", "--out", &out], app.data()).0);
    // A later version leaves a database like this.
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
    let second = folder.path().join("again").display().to_string();
    for arguments in [&serve[..], &["verify"], &["backup", "--out", &second], &["token", "list"]] {
        let (succeeded, text) = run(arguments, &new);
        assert!(!succeeded, "{arguments:?}");
        assert!(text.contains("by version 9.9.9 (schema 9999)"), "{arguments:?}: {text}");
        assert!(text.contains("Nothing was changed"), "{arguments:?}: {text}");
    }
    assert_eq!(std::fs::read(new.join("sci-recon.db")).unwrap(), before);
}

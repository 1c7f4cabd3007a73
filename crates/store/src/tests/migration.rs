//! A database is copied before a migration, and one of another version is refused.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Duration;

use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions, Connection, SqliteConnection};
use strum::VariantArray;
use tempfile::TempDir;

use super::keeping::walk;
use crate::migrations::Schema;
use crate::{Purpose, Store, StoreError};
use engine::job::{Lab, TaskState, Timestamp};

const SERVE: Purpose = Purpose::Serve { accept_database: false };
const ACCEPT: Purpose = Purpose::Serve { accept_database: true };

/// The checks of the tables know the states that the program knows.
#[tokio::test]
async fn the_states_of_tasks_are_those_of_the_table() {
    let (_folder, store) = served().await;
    let names =
        TaskState::VARIANTS.iter().map(|state| format!("'{state}'")).collect::<Vec<_>>().join(", ");
    let table: String = sqlx::query_scalar("SELECT sql FROM sqlite_master WHERE name = 'tasks'")
        .fetch_one(&store.readers)
        .await
        .unwrap();
    assert!(table.contains(&names), "{table}");
}

async fn served() -> (TempDir, Store) {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::open(folder.path(), SERVE).await.unwrap();
    (folder, store)
}

/// A folder with a database of this version.
async fn folder() -> TempDir {
    let (folder, store) = served().await;
    store.close().await;
    folder
}

/// Opens a folder as the version with one more migration does.
async fn open_next(folder: &Path, text: &'static str) -> Result<Store, StoreError> {
    Store::open_with(folder, SERVE, &Schema::next(text)).await
}

async fn connect(database: &Path) -> SqliteConnection {
    SqliteConnectOptions::new().filename(database).connect().await.unwrap()
}

fn saved(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder.join("before-updates"));
    let paths = entries.into_iter().flatten().map(|entry| entry.unwrap().path());
    paths.filter(|path| path.extension().is_some_and(|extension| extension == "db")).collect()
}

#[tokio::test]
async fn the_rates_of_the_baseline_are_those_of_the_cpu() {
    let folder = tempfile::tempdir().unwrap();
    let baseline = Store::open_with(folder.path(), SERVE, &Schema::first()).await;
    baseline.unwrap().close().await;
    let mut connection = connect(&folder.path().join("sci-recon.db")).await;
    let total =
        "INSERT INTO totals (kind, tasks, seconds, iterations, passes, recent_seconds, recent_cost)
                 VALUES ('tile', 3, 9.0, 1, 1, 6.0, 4.0)";
    sqlx::query(total).execute(&mut connection).await.unwrap();
    connection.close().await.unwrap();
    let store = Store::open(folder.path(), SERVE).await.unwrap();
    let rates = sqlx::query_as("SELECT kind, device, seconds, cost FROM rates");
    let rates: Vec<(String, String, f64, f64)> = rates.fetch_all(&store.readers).await.unwrap();
    assert_eq!(rates, [("tile".to_owned(), "cpu".to_owned(), 6.0, 4.0)]);
    assert_eq!(saved(folder.path()).len(), 1);
}

#[tokio::test]
async fn the_database_is_saved_before_it_is_brought_up_to_date() {
    let folder = folder().await;
    assert!(saved(folder.path()).is_empty(), "nothing is saved that is up to date");
    let add = "ALTER TABLE jobs ADD COLUMN mood TEXT";
    open_next(folder.path(), add).await.unwrap().close().await;
    let copies = saved(folder.path());
    assert_eq!(copies.len(), 1);
    let newest = Schema::current().newest();
    assert!(copies[0].to_str().unwrap().ends_with(&format!("-schema-{newest:04}.db")));
    open_next(folder.path(), add).await.unwrap().close().await;
    assert_eq!(saved(folder.path()), copies);
    // A rollback: one start that takes the database for right.
    let refused = Store::open(folder.path(), SERVE).await.unwrap_err().to_string();
    assert!(refused.contains(copies[0].to_str().unwrap()), "{refused}");
    std::fs::copy(&copies[0], folder.path().join("sci-recon.db")).unwrap();
    assert!(Store::open(folder.path(), SERVE).await.is_err(), "it is older than its folder");
    Store::open(folder.path(), ACCEPT).await.unwrap().close().await;
    // The next update replaces the copy.
    open_next(folder.path(), add).await.unwrap().close().await;
    assert_eq!(saved(folder.path()).len(), 1);
    assert_ne!(saved(folder.path()), copies);
}

/// A file that the copy of the database knows outlives its deletion until the update is old.
#[tokio::test]
async fn deleted_files_are_kept_for_a_return_to_the_copy() {
    let (folder, store) = served().await;
    let upload = async |store: &Store, bytes: &[u8]| {
        let mut writer = store.blob_writer().unwrap();
        writer.write_all(bytes).unwrap();
        let staged = writer.finish().unwrap();
        store.store_upload(&Lab::local(), None, staged).await.unwrap();
        // The times of files and of the update have milliseconds.
        tokio::time::sleep(Duration::from_millis(20)).await;
    };
    upload(&store, b"before").await;
    store.close().await;
    drop(store);
    let add = "ALTER TABLE jobs ADD COLUMN mood TEXT";
    let store = open_next(folder.path(), add).await.unwrap();
    tokio::time::sleep(Duration::from_millis(20)).await;
    upload(&store, b"after").await;
    let soon = || Timestamp(Timestamp::now().0 + 1000);
    assert_eq!(store.collect(soon()).await.unwrap().len(), 2, "both uploads are deleted");
    assert!(walk(&folder.path().join("blobs")).is_empty());
    let kept = folder.path().join("before-updates/kept");
    let contents = || -> Vec<Vec<u8>> {
        walk(&kept).iter().map(|file| std::fs::read(file).unwrap()).collect()
    };
    assert_eq!(contents(), [b"before"], "the copy knows only the first file");

    assert!(!store.release_kept(Timestamp(Timestamp::now().0 - 60_000)).await.unwrap());
    assert_eq!(contents(), [b"before"], "the update is younger than a minute");
    assert!(store.release_kept(soon()).await.unwrap());
    assert!(!kept.exists());
    assert!(!store.release_kept(soon()).await.unwrap(), "no file is left");
    // From then on, deleted files are not kept.
    upload(&store, b"later").await;
    store.collect(soon()).await.unwrap();
    assert!(!kept.exists() && saved(folder.path()).len() == 1);
}

#[tokio::test]
async fn an_update_that_fails_names_the_copy_and_changes_nothing() {
    let folder = folder().await;
    let text = "DELETE FROM folder; CREATE TABLE labs (lab TEXT)";
    let error = open_next(folder.path(), text).await.unwrap_err().to_string();
    let copy = saved(folder.path()).pop().unwrap();
    assert!(error.contains("can't be brought up to date"), "{error}");
    assert!(error.contains(copy.to_str().unwrap()), "{error}");
    for database in [copy, folder.path().join("sci-recon.db")] {
        let newest = "SELECT max(version) FROM _sqlx_migrations, folder";
        let mut connection = connect(&database).await;
        let newest: i64 = sqlx::query_scalar(newest).fetch_one(&mut connection).await.unwrap();
        assert_eq!(newest, Schema::current().newest());
    }
    Store::open(folder.path(), SERVE).await.unwrap();
}

#[tokio::test]
async fn a_newer_database_is_refused_in_words() {
    let folder = folder().await;
    let add = "ALTER TABLE jobs ADD COLUMN mood TEXT";
    open_next(folder.path(), add).await.unwrap().close().await;
    let (newest, kept) = (Schema::current().newest(), saved(folder.path()).pop().unwrap());
    std::fs::write(folder.path().join("before-updates/2-schema-9998.db"), "").unwrap();
    for purpose in [SERVE, ACCEPT, Purpose::Use] {
        let error = Store::open(folder.path(), purpose).await.unwrap_err().to_string();
        assert!(error.contains(&format!("schema {}", newest + 1)), "{error}");
        assert!(error.contains("Nothing was changed"), "{error}");
        assert!(error.contains(env!("CARGO_PKG_VERSION")), "{error}");
        assert!(error.contains(kept.to_str().unwrap()) && !error.contains("9998"), "{error}");
    }
}

#[tokio::test]
async fn a_database_from_before_the_baseline_is_refused_unchanged() {
    let folder = tempfile::tempdir().unwrap();
    let database = folder.path().join("sci-recon.db");
    let options = SqliteConnectOptions::new().filename(&database).create_if_missing(true);
    let mut connection = options.connect().await.unwrap();
    for text in [
        "CREATE TABLE _sqlx_migrations (version BIGINT PRIMARY KEY, description TEXT NOT NULL)",
        "INSERT INTO _sqlx_migrations VALUES (1, 'init'), (20, 'lists')",
    ] {
        sqlx::query(text).execute(&mut connection).await.unwrap();
    }
    connection.close().await.unwrap();
    let before = std::fs::read(&database).unwrap();
    for purpose in [SERVE, ACCEPT, Purpose::Use] {
        let error = Store::open(folder.path(), purpose).await.unwrap_err().to_string();
        assert!(error.contains("before version 0.1.0") && error.contains("c69346f"), "{error}");
        assert!(error.contains("Nothing was changed"), "{error}");
    }
    assert_eq!(std::fs::read(&database).unwrap(), before);
    assert!(saved(folder.path()).is_empty() && !folder.path().join("blobs").exists());
}

//! Data of the version before.

use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions, Connection};
use strum::VariantArray;

use crate::job::{Lab, TaskState, WorkerId};
use crate::store::{Filter, Purpose, Store, Work};

/// The last migration before calibrations became tasks.
const BEFORE: i64 = 70;

/// One calibration in each state (the last digit tells which), and a job with one task of two attempts.
const ROWS: &str = "
    INSERT INTO blobs (sha256, size, origin, created_at, touched_at) VALUES
        (printf('%064d', 1), 1, 'upload', 1, 1), (printf('%064d', 2), 1, 'prepared', 1, 1);
    INSERT INTO calibrations (id, lab, name, masks, prepared, format, sample, frames, height, width,
        full_scale, mask_mean, dead_pixels, clipped_negatives, created_at)
    VALUES ('019a0000-0000-7000-8000-000000000004', 'local', NULL, printf('%064d', 1),
        printf('%064d', 2), 'npy', 'uint8', 2, 4, 4, 1, 0.5, 0, 0, 50);
    INSERT INTO calibration_tasks (calibration, lab, name, captures, state, attempt, worker,
        lease_until, fraction, failures, losses, ready_at, error, created_at)
    VALUES
        ('019a0000-0000-7000-8000-000000000001', 'local', 'one', '{captures}', 'ready', 1, NULL, NULL, 0,
            1, 0, 7, NULL, 10),
        ('019a0000-0000-7000-8000-000000000002', 'local', 'two', '{captures}', 'running', 2, 'w', 1, 0.5,
            0, 1, 0, NULL, 20),
        ('019a0000-0000-7000-8000-000000000003', 'local', 'three', '{captures}', 'failed', 3, NULL, NULL,
            0, 3, 0, 0, 'no light', 30),
        ('019a0000-0000-7000-8000-000000000004', 'local', NULL, NULL, 'done', 1, NULL, NULL, 1, 0, 0, 0,
            NULL, 40),
        ('019a0000-0000-7000-8000-000000000005', 'other', NULL, '{captures}', 'ready', 0, NULL, NULL, 0,
            0, 0, 0, NULL, 50);
    INSERT INTO calibration_captures (calibration, sha256)
        VALUES ('019a0000-0000-7000-8000-000000000001', printf('%064d', 1));
    INSERT INTO measurements (id, calibration, data, prepared, format, sample, snapshots, height, width,
        full_scale, created_at)
    VALUES ('m', '019a0000-0000-7000-8000-000000000004', printf('%064d', 1), printf('%064d', 2), 'npy',
        'uint8', 1, 4, 4, 1, 60);
    INSERT INTO jobs (id, calibration, measurement, spec, state, priority, request, created_at)
        VALUES ('j', '019a0000-0000-7000-8000-000000000004', 'm', '{}', 'cancelled', 0, 'r', 70);
    INSERT INTO tasks (id, job, ordinal, kind, snapshot, tile, state, priority, cost, attempt, history)
        VALUES ('t', 'j', 0, 'tile', 0, 0, 'cancelled', 5, 1.5, 2, '[[1,2,3,null]]');
    INSERT INTO attempts (task, attempt, worker, started_at, ended_at, outcome, reason)
        VALUES ('t', 1, 'w', 80, 81, 'lost', 'silence'), ('t', 2, 'w', 82, 83, 'cancelled', NULL);
";

fn id(digit: u32) -> String {
    format!("019a0000-0000-7000-8000-00000000000{digit}")
}

#[tokio::test]
async fn calibrations_become_tasks_and_nothing_else_changes() {
    let folder = tempfile::tempdir().unwrap();
    let options = SqliteConnectOptions::new()
        .filename(folder.path().join("sci-recon.db"))
        .create_if_missing(true)
        .foreign_keys(true);
    let mut connection = options.connect().await.unwrap();
    sqlx::migrate!().run_to(BEFORE, &mut connection).await.unwrap();
    let upload = format!("{:064}", 1);
    let captures =
        format!(r#"{{"masks": [["{upload}"]], "white": ["{upload}"], "black": ["{upload}"]}}"#);
    let rows = sqlx::AssertSqlSafe(ROWS.replace("{captures}", &captures));
    sqlx::raw_sql(rows).execute(&mut connection).await.unwrap();
    connection.close().await.unwrap();

    let store =
        Store::open(folder.path(), Purpose::Serve { accept_database: false }).await.unwrap();
    let broken = sqlx::query("PRAGMA foreign_key_check").fetch_all(&store.readers).await.unwrap();
    assert!(broken.is_empty());
    let states: Vec<(String, String, u32, u32, u32)> = sqlx::query_as(
        "SELECT calibration, state, attempt, failures, losses FROM tasks WHERE kind = 'calibration'
         ORDER BY calibration",
    )
    .fetch_all(&store.readers)
    .await
    .unwrap();
    let expected = [
        (id(1), "ready".to_owned(), 1, 1, 0),
        (id(2), "running".into(), 2, 0, 1),
        (id(3), "failed".into(), 3, 3, 0),
        (id(4), "done".into(), 1, 0, 0),
        (id(5), "ready".into(), 0, 0, 0),
    ];
    assert_eq!(states, expected);

    // As users see them.
    let (local, other) = (Lab::local(), "other".parse::<Lab>().unwrap());
    let all = store.all_unready(&local, Filter::default(), 10).await.unwrap().items;
    let seen: Vec<_> = all
        .iter()
        .map(|unready| {
            let name = unready.name.as_ref().unwrap().as_str();
            (unready.id.to_string(), name, unready.created_at.0, unready.error.as_deref())
        })
        .collect();
    let three = (id(3), "three", 30, Some("no light"));
    assert_eq!(seen, [three, (id(2), "two", 20, None), (id(1), "one", 10, None)]);
    assert_eq!((all[1].fraction, all[1].frames), (0.5, Some(1)));
    assert_eq!(store.all_unready(&other, Filter::default(), 10).await.unwrap().items.len(), 1);
    assert!(store.calibration(&local, id(4).parse().unwrap()).await.is_ok());

    // As workers see them: what a silent one holds comes back, too.
    let mut claimed = Vec::new();
    let lease = std::time::Duration::from_secs(60);
    while let Some(task) = store.claim(WorkerId::new(), lease).await.unwrap() {
        let Work::Calibration(calibration) = task.work else { panic!() };
        assert!(calibration.captures.is_some());
        claimed.push((calibration.calibration.to_string(), task.lease.attempt));
    }
    assert_eq!(claimed, [(id(1), 2), (id(2), 3), (id(5), 1)]);

    // The tasks of jobs, their attempts, and captures that are still needed are as they were.
    let tile: (String, u32, i32, String) =
        sqlx::query_as("SELECT state, attempt, priority, history FROM tasks WHERE id = 't'")
            .fetch_one(&store.readers)
            .await
            .unwrap();
    assert_eq!(tile, ("cancelled".into(), 2, 5, "[[1,2,3,null]]".into()));
    let attempts: Vec<(u32, i64, String)> = sqlx::query_as(
        "SELECT attempt, ended_at, outcome FROM attempts WHERE task = 't' ORDER BY attempt",
    )
    .fetch_all(&store.readers)
    .await
    .unwrap();
    assert_eq!(attempts, [(1, 81, "lost".into()), (2, 83, "cancelled".into())]);
    store.delete_calibration(&local, id(1).parse().unwrap()).await.unwrap();
    let left: i64 = sqlx::query_scalar("SELECT count(*) FROM calibration_captures")
        .fetch_one(&store.readers)
        .await
        .unwrap();
    assert_eq!(left, 0);
}

/// The checks of the tables know the states that the program knows.
#[tokio::test]
async fn the_states_of_tasks_are_those_of_the_table() {
    let folder = tempfile::tempdir().unwrap();
    let store =
        Store::open(folder.path(), Purpose::Serve { accept_database: false }).await.unwrap();
    let names =
        TaskState::VARIANTS.iter().map(|state| format!("'{state}'")).collect::<Vec<_>>().join(", ");
    let table: String = sqlx::query_scalar("SELECT sql FROM sqlite_master WHERE name = 'tasks'")
        .fetch_one(&store.readers)
        .await
        .unwrap();
    assert!(table.contains(&names), "{table}");
}

/// A folder with the database of the version before, and a connection to it.
async fn old_folder() -> (tempfile::TempDir, sqlx::SqliteConnection) {
    let folder = tempfile::tempdir().unwrap();
    let options = SqliteConnectOptions::new()
        .filename(folder.path().join("sci-recon.db"))
        .create_if_missing(true)
        .foreign_keys(true);
    let mut connection = options.connect().await.unwrap();
    sqlx::migrate!().run_to(BEFORE, &mut connection).await.unwrap();
    (folder, connection)
}

fn saved(folder: &std::path::Path) -> Vec<std::path::PathBuf> {
    let entries = std::fs::read_dir(folder.join("before-updates"));
    let paths = entries.into_iter().flatten().map(|entry| entry.unwrap().path());
    paths.filter(|path| path.extension().is_some_and(|extension| extension == "db")).collect()
}

const SERVE: Purpose = Purpose::Serve { accept_database: false };

#[tokio::test]
async fn the_database_is_saved_before_it_is_brought_up_to_date() {
    let (folder, connection) = old_folder().await;
    connection.close().await.unwrap();
    Store::open(folder.path(), SERVE).await.unwrap().close().await;
    let copies = saved(folder.path());
    assert_eq!(copies.len(), 1);
    assert!(copies[0].to_str().unwrap().ends_with(&format!("-schema-{BEFORE:04}.db")));
    // Nothing is saved that is up to date.
    Store::open(folder.path(), SERVE).await.unwrap().close().await;
    assert_eq!(saved(folder.path()), copies);
    // Back to it, for one start that takes the database for right.
    let database = folder.path().join("sci-recon.db");
    std::fs::copy(&copies[0], &database).unwrap();
    assert!(Store::open(folder.path(), SERVE).await.is_err(), "it is older than its folder");
    let accept = Purpose::Serve { accept_database: true };
    Store::open(folder.path(), accept).await.unwrap().close().await;
}

#[tokio::test]
async fn an_update_that_fails_names_the_copy() {
    let (folder, mut connection) = old_folder().await;
    // In the way of a later migration.
    sqlx::query("CREATE TABLE labs (lab TEXT)").execute(&mut connection).await.unwrap();
    connection.close().await.unwrap();
    let error = Store::open(folder.path(), SERVE).await.unwrap_err().to_string();
    let copy = saved(folder.path()).pop().unwrap();
    assert!(error.contains("can't be brought up to date"), "{error}");
    assert!(error.contains(copy.to_str().unwrap()), "{error}");
    let options = SqliteConnectOptions::new().filename(&copy).read_only(true);
    let mut connection = options.connect().await.unwrap();
    let newest = "SELECT max(version) FROM _sqlx_migrations";
    let newest: i64 = sqlx::query_scalar(newest).fetch_one(&mut connection).await.unwrap();
    assert_eq!(newest, BEFORE);
}

#[tokio::test]
async fn a_newer_database_is_refused_in_words() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::open(folder.path(), SERVE).await.unwrap();
    let newer =
        "INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time)
                 VALUES (9999, 'later', 1, x'00', 0)";
    sqlx::query(newer).execute(&store.writer).await.unwrap();
    store.close().await;
    drop(store);
    let kept = folder.path().join("before-updates");
    std::fs::create_dir(&kept).unwrap();
    for name in ["1-schema-0070.db", "2-schema-9998.db"] {
        std::fs::write(kept.join(name), "").unwrap();
    }
    for purpose in [SERVE, Purpose::Serve { accept_database: true }, Purpose::Use] {
        let error = Store::open(folder.path(), purpose).await.unwrap_err().to_string();
        assert!(error.contains("schema 9999") && error.contains("Nothing was changed"), "{error}");
        assert!(error.contains(env!("CARGO_PKG_VERSION")), "{error}");
        assert!(error.contains("1-schema-0070.db") && !error.contains("9998"), "{error}");
    }
}

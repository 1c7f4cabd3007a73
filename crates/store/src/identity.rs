//! Verification that a database and a folder belong together.
//!
//! With an empty, older or foreign database, all files of the folder would count as orphans. So the folder has an
//! identifier and a generation, in its marker `sci-recon.json` and in the database. The generation only rises, first in
//! the database and then in the marker: at the start and the end of a server, every ten minutes, and whenever a token
//! is made or revoked. A database behind its marker is an older copy, or has lost its write-ahead log.

use std::fs::{self, File};
use std::io::{ErrorKind, Write};
use std::os::unix::ffi::OsStrExt;
use std::path::Path;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use sqlx::{ConnectOptions, Connection};
use uuid::Uuid;

use super::dir::{self, DataDir, on_files};
use super::error::{Result, StoreError};
use super::migrations::BEFORE_BASELINE;
use super::upgrade;
use crate::columns::{sql, sql_as};

/// The purpose for which a data folder is opened. It decides what may change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// For a worker, a backup or a token: the folder exists and is not changed.
    Use,
    /// The server: has the folder for itself, makes it where there is none, and brings it up to date.
    Serve {
        /// Takes the database for right where folder and database disagree.
        accept_database: bool,
    },
}

/// The marker of the folder.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Marker {
    id: Uuid,
    generation: i64,
    /// The newest migration, and the version of the program: for people.
    schema: i64,
    version: String,
}

#[derive(Debug, PartialEq, Eq)]
enum Database {
    Missing,
    /// Without tables of ours.
    Blank,
    /// Made before the baseline of the migrations.
    Former,
    /// Without an identifier, as a first start leaves it that was interrupted.
    Unnamed,
    Named {
        id: Uuid,
        generation: i64,
        schema: i64,
    },
}

/// Refuses a folder whose database is not its own. Changes nothing.
pub(super) async fn check(dir: &DataDir, purpose: Purpose, schema: i64) -> Result<()> {
    // The marker first: it never runs ahead of its database.
    let folder = dir.clone();
    let (marker, has_files) = on_files(move || {
        let marker = read(&folder)?;
        let mut has_files = false;
        for path in [folder.blobs(), folder.all_results(), folder.partials(), folder.quarantine()] {
            has_files = has_files || holds_files(&path)?;
        }
        Ok((marker, has_files))
    })
    .await?;
    let database = look(&dir.database()).await?;
    if let Database::Named { schema: found, .. } = database
        && found > schema
    {
        let by = marker.and_then(Result::ok).map_or_else(|| "?".into(), |marker| marker.version);
        let copy = upgrade::last_copy(dir, schema)?;
        let folder = dir.root().to_owned();
        return Err(StoreError::Newer { folder, by, found, schema, copy });
    }
    judge(marker.as_ref(), &database, has_files, purpose, schema).map_err(|refusal| match refusal {
        None => StoreError::NoFolder(dir.root().to_owned()),
        Some((found, remedy)) => {
            StoreError::Refused { folder: dir.root().to_owned(), found, remedy }
        }
    })
}

/// The problem and the remedy; `None` if the folder is not a data folder.
type Refusal = Option<(String, &'static str)>;

const RESTORE: &str = "put the folder's own database back, with its -wal file, or serve a backup; for \
                       a new service name an empty folder";
const FORMER: &str = "name an empty folder; to read this one, build the program from commit c69346f, the last that \
                      reads it, and serve the folder with that";
pub(super) const ACCEPT: &str = "put back what belongs together, or serve a backup; `serve --accept-database` goes \
                      on with this database, and moves files that it does not know to quarantine/";

fn judge(
    marker: Option<&Result<Marker, String>>,
    database: &Database,
    has_files: bool,
    purpose: Purpose,
    schema: i64,
) -> Result<(), Refusal> {
    let folder = match (marker, has_files) {
        (Some(_), true) => "a marker and files",
        (Some(_), false) => "a marker",
        (None, true) => "files",
        (None, false) => "",
    };
    let accepts = purpose == Purpose::Serve { accept_database: true };
    let refuse = |found: String, remedy| Err(Some((found, remedy)));
    match (database, marker) {
        (Database::Missing | Database::Blank, None) if !has_files => match purpose {
            Purpose::Serve { .. } => Ok(()),
            Purpose::Use => Err(None),
        },
        (Database::Missing, _) => refuse(
            format!("the database sci-recon.db is missing, though there are {folder} here"),
            RESTORE,
        ),
        (Database::Blank, _) => refuse(
            format!("the database sci-recon.db is empty, though there are {folder} here"),
            RESTORE,
        ),
        (Database::Former, _) => {
            refuse("the database was made before version 0.1.0".into(), FORMER)
        }
        (Database::Unnamed, None) if purpose != Purpose::Use => Ok(()),
        (Database::Named { schema: found, .. }, _)
            if purpose == Purpose::Use && *found < schema =>
        {
            outdated()
        }
        (Database::Unnamed, None) => outdated(),
        _ if accepts => Ok(()),
        (_, Some(Err(error))) => {
            refuse(format!("the marker sci-recon.json can't be read: {error}"), ACCEPT)
        }
        (Database::Unnamed, Some(Ok(_))) => {
            refuse("the database is older than the folder: it has no identifier yet".into(), ACCEPT)
        }
        // Only a start that was interrupted leaves this.
        (Database::Named { generation: 0, .. }, None) => Ok(()),
        (Database::Named { .. }, None) => refuse(
            "the marker sci-recon.json is missing, though the database names one".into(),
            ACCEPT,
        ),
        (Database::Named { id, generation, .. }, Some(Ok(marker))) => {
            if *id != marker.id {
                let found = "the database belongs to another folder";
                return refuse(format!("{found}: it names {id}, the marker {}", marker.id), ACCEPT);
            }
            if *generation < marker.generation {
                let found = "the database is older than the folder, or has lost its -wal file";
                let (had, last) = (generation, marker.generation);
                return refuse(
                    format!("{found}: generation {had}, where the marker has {last}"),
                    ACCEPT,
                );
            }
            Ok(())
        }
    }
}

fn outdated() -> Result<(), Refusal> {
    let found = "the database is of an older version of this program".into();
    Err(Some((found, "start the service once with this version, which brings it up to date")))
}

async fn look(path: &Path) -> Result<Database> {
    match fs::metadata(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Database::Missing),
        // Not opened: SQLite would remove its write-ahead log.
        Ok(meta) if meta.len() == 0 => return Ok(Database::Blank),
        meta => meta.map_err(StoreError::io("look at", path))?,
    };
    let options = SqliteConnectOptions::new().filename(path).read_only(true);
    let mut connection = options.busy_timeout(Duration::from_secs(15)).connect().await?;
    let database = ask(&mut connection).await;
    connection.close().await?;
    database
}

async fn ask(connection: &mut SqliteConnection) -> Result<Database> {
    let tables = "SELECT name FROM sqlite_master WHERE name IN ('_sqlx_migrations', 'folder')";
    let tables: Vec<String> = sql_as!(tables).fetch_all(&mut *connection).await?;
    if !tables.iter().any(|name| name == "_sqlx_migrations") {
        return Ok(Database::Blank);
    }
    let schema = "SELECT max(version) FROM _sqlx_migrations";
    let Some(schema) = sql_as!(schema).fetch_one(&mut *connection).await? else {
        return Ok(Database::Blank);
    };
    let former = "SELECT count(*) FROM _sqlx_migrations WHERE version = 1 AND description = ?";
    let former: i64 = sql_as!(former, [BEFORE_BASELINE]).fetch_one(&mut *connection).await?;
    if former > 0 {
        return Ok(Database::Former);
    }
    if tables.len() < 2 {
        return Ok(Database::Unnamed);
    }
    Ok(match identity(connection).await? {
        Some((id, generation)) => Database::Named { id, generation, schema },
        None => Database::Unnamed,
    })
}

async fn identity(connection: &mut SqliteConnection) -> Result<Option<(Uuid, i64)>> {
    let row: Option<(String, i64)> =
        sql_as!("SELECT id, generation FROM folder").fetch_optional(connection).await?;
    let read = |(id, generation): (String, _)| match id.parse() {
        Ok(id) => Ok((id, generation)),
        Err(_) => Err(StoreError::Corrupt { column: "id", value: id }),
    };
    row.map(read).transpose()
}

/// Gives a folder without an identifier one, and takes the database for right in any case.
pub(super) async fn settle(dir: &DataDir, connection: &mut SqliteConnection) -> Result<()> {
    let last = read(dir)?.and_then(Result::ok).map_or(0, |marker| marker.generation);
    sql!(
        "INSERT INTO folder (one, id, generation) VALUES (1, ?, 0) ON CONFLICT DO NOTHING",
        [Uuid::now_v7().to_string()]
    )
    .execute(&mut *connection)
    .await?;
    sql!("UPDATE folder SET generation = max(generation, ?)", [last])
        .execute(&mut *connection)
        .await?;
    // The identifier is then in the database itself, also if its write-ahead log is lost.
    sql!("PRAGMA wal_checkpoint(TRUNCATE)").execute(connection).await?;
    Ok(())
}

/// The marker that belongs to this database.
pub(super) async fn marker(connection: &mut SqliteConnection, schema: i64) -> Result<Marker> {
    let (id, generation) = identity(connection)
        .await?
        .ok_or(StoreError::Corrupt { column: "folder", value: "no row".into() })?;
    Ok(Marker { id, generation, schema, version: env!("CARGO_PKG_VERSION").into() })
}

/// Writes the marker into the folder durably; `draft` is on the same disk.
pub(super) fn write(folder: &Path, draft: &Path, marker: &Marker) -> Result<()> {
    let text =
        serde_json::to_vec(marker).map_err(|error| StoreError::io("write", draft)(error.into()))?;
    File::create(draft)
        .and_then(|mut file| file.write_all(&text).and_then(|()| file.sync_all()))
        .map_err(StoreError::io("write", draft))?;
    dir::rename_durably(draft, &folder.join("sci-recon.json"))
}

/// What stands in the place of the marker until a copy is whole: no service starts with it, whatever it accepts.
pub(super) const UNFINISHED: &str = "a copy that is not finished";
/// Suffix of the folder's name until then. It has the marker a moment before its own name.
pub(super) const UNFINISHED_NAME: &str = ".unfinished";

fn is_unfinished(folder: &Path) -> bool {
    folder.file_name().is_some_and(|name| name.as_bytes().ends_with(UNFINISHED_NAME.as_bytes()))
}

pub(super) fn is_marker(bytes: &[u8]) -> bool {
    serde_json::from_slice::<Marker>(bytes).is_ok()
}

fn read(dir: &DataDir) -> Result<Option<Result<Marker, String>>> {
    let path = dir.root().join("sci-recon.json");
    match fs::read(&path) {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Ok(bytes) if bytes == UNFINISHED.as_bytes() || is_unfinished(dir.root()) => {
            Err(StoreError::Refused {
                folder: dir.root().to_owned(),
                found: "this is a copy that was not finished".into(),
                remedy: "make it again, or serve another one",
            })
        }
        bytes => {
            let bytes = bytes.map_err(StoreError::io("read", &path))?;
            Ok(Some(serde_json::from_slice(&bytes).map_err(|error| error.to_string())))
        }
    }
}

/// True if there is a file somewhere below.
fn holds_files(folder: &Path) -> Result<bool> {
    for path in dir::children(folder)? {
        if !path.is_dir() || holds_files(&path)? {
            return Ok(true);
        }
    }
    Ok(false)
}

#[cfg(test)]
mod tests {
    use super::{Database, Marker, Purpose, Uuid, judge};

    #[test]
    fn only_what_belongs_together_is_taken() {
        let (id, other) = (Uuid::now_v7(), Uuid::now_v7());
        let serve = Purpose::Serve { accept_database: false };
        let accept = Purpose::Serve { accept_database: true };
        let marker = Some(Ok(Marker { id, generation: 5, schema: 9, version: "1".into() }));
        let torn = Some(Err("no JSON".to_owned()));
        let named = |id, generation| Database::Named { id, generation, schema: 9 };
        // Each row has the verdicts for a server without and with the flag, and for a worker.
        for (marker, database, files, verdicts) in [
            (&None, Database::Missing, false, [true, true, false]),
            (&None, Database::Blank, false, [true, true, false]),
            (&None, Database::Missing, true, [false; 3]),
            (&None, Database::Blank, true, [false; 3]),
            (&marker, Database::Missing, false, [false; 3]),
            (&marker, Database::Blank, true, [false; 3]),
            (&None, Database::Unnamed, true, [true, true, false]),
            (&marker, Database::Unnamed, true, [false, true, false]),
            (&None, Database::Former, true, [false; 3]),
            (&marker, Database::Former, true, [false; 3]),
            (&None, named(id, 0), false, [true; 3]),
            (&None, named(id, 5), true, [false, true, false]),
            (&torn, named(id, 5), true, [false, true, false]),
            (&marker, named(other, 9), true, [false, true, false]),
            (&marker, named(id, 4), true, [false, true, false]),
            (&marker, named(id, 5), true, [true; 3]),
            (&marker, named(id, 6), true, [true; 3]),
        ] {
            let found = [serve, accept, Purpose::Use]
                .map(|purpose| judge(marker.as_ref(), &database, files, purpose, 9).is_ok());
            assert_eq!(found, verdicts, "{marker:?} {database:?} {files}");
        }
        assert!(judge(marker.as_ref(), &named(id, 5), true, Purpose::Use, 10).is_err(), "outdated");
        assert!(
            judge(marker.as_ref(), &named(id, 5), true, serve, 10).is_ok(),
            "brought up to date"
        );
    }
}

//! Upgrade of a database: never without a copy of the old one, and never of one that a newer version has changed.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions, Connection};

use super::DataDir;
use super::dir::{self, on_files};
use super::error::{Result, StoreError};
use crate::columns::{sql, sql_as};
use engine::job::Timestamp;

/// Copies a database that is older than this program, whose newest migration is `schema`, to
/// `before-updates/`, in place of an earlier copy, and says where. Nothing is done if it is up to date, or if there
/// is none.
/// Errors: the database; the disk, which may be full.
pub(super) async fn save(dir: &DataDir, schema: i64) -> Result<Option<PathBuf>> {
    let database = dir.database();
    if !fs::metadata(&database).is_ok_and(|meta| meta.len() > 0) {
        return Ok(None);
    }
    let options = SqliteConnectOptions::new().filename(&database).read_only(true);
    let mut connection = options.connect().await?;
    let tables = "SELECT count(*) FROM sqlite_master WHERE name = '_sqlx_migrations'";
    let ours: i64 = sql_as!(tables).fetch_one(&mut connection).await?;
    let found: Option<i64> = if ours == 0 {
        None
    } else {
        let newest = "SELECT max(version) FROM _sqlx_migrations";
        sql_as!(newest).fetch_one(&mut connection).await?
    };
    let Some(found) = found.filter(|found| *found < schema) else {
        connection.close().await?;
        return Ok(None);
    };
    let folder = dir.before_updates();
    fs::create_dir_all(&folder).map_err(StoreError::io("make the folder", &folder))?;
    let copy = folder.join(format!("{}-schema-{found:04}.db", Timestamp::now().0));
    sql!("VACUUM INTO ?", [copy.to_string_lossy().into_owned()]).execute(&mut connection).await?;
    connection.close().await?;
    let synced = copy.clone();
    let kept = dir.kept();
    on_files(move || {
        dir::make_dir_durably(&kept)?;
        let file = File::open(&synced).map_err(StoreError::io("open", &synced))?;
        file.sync_all().map_err(StoreError::io("write to the disk", &synced))?;
        dir::sync_dir(&folder)?;
        let others = copies(&folder)?.into_iter().filter(|path| *path != synced);
        others.into_iter().try_for_each(|path| dir::remove(&path))
    })
    .await?;
    tracing::info!(from = found, to = schema, copy = %copy.display(), "the database is brought up to date");
    Ok(Some(copy))
}

/// Path at which a deleted file or folder at `place` is kept for a return to the last copy of the database. `None` if
/// there was no recent upgrade, or if the file was made after it. `since` is its time of creation, if that is not the
/// time of its last change.
pub(super) fn keep_as(
    dir: &DataDir,
    place: &Path,
    since: Option<Timestamp>,
) -> Result<Option<PathBuf>> {
    let kept = dir.kept();
    if !kept.is_dir() || !place.exists() {
        return Ok(None);
    }
    let Some(updated) = last_update(dir)? else { return Ok(None) };
    let since = match since {
        Some(since) => since,
        None => last_change(place)?,
    };
    let name = place.strip_prefix(dir.root()).ok().filter(|_| since < updated);
    Ok(name.map(|name| kept.join(name)))
}

fn last_change(place: &Path) -> Result<Timestamp> {
    let changed = fs::metadata(place).and_then(|meta| meta.modified());
    let changed = changed.map_err(StoreError::io("look at", place))?;
    let age = changed.duration_since(UNIX_EPOCH).unwrap_or_default();
    Ok(Timestamp(i64::try_from(age.as_millis()).unwrap_or(i64::MAX)))
}

/// Removes the files that are kept, unless the last update is younger than `before`. True if there were any.
pub(super) fn release_kept(dir: &DataDir, before: Timestamp, draft: &Path) -> Result<bool> {
    if !dir.kept().is_dir() || last_update(dir)?.is_some_and(|updated| updated >= before) {
        return Ok(false);
    }
    // Moved as a whole, since workers may be about to add to it.
    dir::rename_durably(&dir.kept(), draft)?;
    dir::remove(draft)?;
    Ok(true)
}

/// When the database was last brought up to date.
fn last_update(dir: &DataDir) -> Result<Option<Timestamp>> {
    let times = copies(&dir.before_updates())?
        .into_iter()
        .filter_map(|path| path.file_stem()?.to_str()?.split_once("-schema-")?.0.parse().ok());
    Ok(times.max().map(Timestamp))
}

/// The last copy of a database that this program, whose newest migration is `schema`, can serve.
pub(super) fn last_copy(dir: &DataDir, schema: i64) -> Result<Option<PathBuf>> {
    let mut copies = copies(&dir.before_updates())?;
    copies.retain(|path| schema_of(path).is_some_and(|found| found <= schema));
    copies.sort();
    Ok(copies.pop())
}

fn copies(folder: &Path) -> Result<Vec<PathBuf>> {
    let mut copies = if folder.is_dir() { dir::children(folder)? } else { Vec::new() };
    copies.retain(|path| schema_of(path).is_some());
    Ok(copies)
}

/// The newest migration of a copy, by its name.
fn schema_of(path: &Path) -> Option<i64> {
    path.file_stem()?.to_str()?.split_once("-schema-")?.1.parse().ok()
}

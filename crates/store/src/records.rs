//! All stored files with a recorded hash, page by page: blobs by hash, then results by job.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use sqlx::SqliteConnection;

use super::DataDir;
use super::error::Result;
use super::tables::results::WHOLE_JOB;
use crate::columns::{from_row, sql, sql_as};
use engine::job::{JobId, PartialId, Sha256};

/// Records of a page.
const PAGE: i64 = 500;

/// Place of a stored file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Place {
    Blob(Sha256),
    /// `snapshot` is [`WHOLE_JOB`] for a file of the whole job.
    Result {
        job: JobId,
        snapshot: i64,
        name: String,
    },
}

/// A file as it should be.
#[derive(Debug, Clone)]
pub(super) struct Record {
    pub(super) place: Place,
    pub(super) sha256: Sha256,
}

#[derive(Debug)]
struct ResultRow {
    job: JobId,
    snapshot: i64,
    name: String,
    sha256: Sha256,
}

from_row!(ResultRow, row => { job, snapshot, name, sha256 });

impl Record {
    /// The path of the file below a data folder.
    pub(super) fn path(&self, dir: &DataDir) -> PathBuf {
        match &self.place {
            Place::Blob(sha256) => dir.blob(sha256),
            Place::Result { job, snapshot, name } => {
                let folder = match u32::try_from(*snapshot) {
                    Ok(snapshot) => dir.snapshot_results(*job, snapshot),
                    Err(_) => dir.results(*job),
                };
                folder.join(name)
            }
        }
    }

    /// How it is called in reports: its place below the data folder.
    pub(super) fn name(&self, dir: &DataDir) -> String {
        let path = self.path(dir);
        path.strip_prefix(dir.root()).unwrap_or(&path).display().to_string()
    }
}

/// The next page of records, after whose last one `after` stands then. `None` at the end.
pub(super) async fn next_page(
    connection: &mut SqliteConnection,
    after: &mut Option<Place>,
) -> Result<Option<Vec<Record>>> {
    let page = page(connection, after.as_ref()).await?;
    *after = page.last().map(|last| last.place.clone());
    Ok(after.is_some().then_some(page))
}

/// The records after this place, or the first ones; none at the end.
pub(super) async fn page(
    connection: &mut SqliteConnection,
    after: Option<&Place>,
) -> Result<Vec<Record>> {
    if let None | Some(Place::Blob(_)) = after {
        let last = match after {
            Some(Place::Blob(sha256)) => sha256.to_string(),
            _ => String::new(),
        };
        let blobs: Vec<Sha256> = sql_as!(
            "SELECT sha256 FROM blobs WHERE sha256 > ? ORDER BY sha256 LIMIT ?",
            [last, PAGE]
        )
        .fetch_all(&mut *connection)
        .await?;
        if !blobs.is_empty() {
            let record = |sha256| Record { place: Place::Blob(sha256), sha256 };
            return Ok(blobs.into_iter().map(record).collect());
        }
    }
    let (job, snapshot, name) = match after {
        Some(Place::Result { job, snapshot, name }) => (job.to_string(), *snapshot, name.as_str()),
        _ => (String::new(), WHOLE_JOB, ""),
    };
    let results: Vec<ResultRow> = sql_as!(
        "SELECT job, snapshot, name, sha256 FROM result_files
         WHERE (job, snapshot, name) > (?, ?, ?) AND NOT derived ORDER BY job, snapshot, name LIMIT ?",
        [job, snapshot, name, PAGE]
    )
    .fetch_all(connection)
    .await?;
    let record = |ResultRow { job, snapshot, name, sha256 }| Record {
        place: Place::Result { job, snapshot, name },
        sha256,
    };
    Ok(results.into_iter().map(record).collect())
}

/// True if a file has an unchanged record.
pub(super) async fn stands(connection: &mut SqliteConnection, record: &Record) -> Result<bool> {
    let query = match &record.place {
        Place::Blob(sha256) => sql!("SELECT 1 FROM blobs WHERE sha256 = ?", [sha256]),
        Place::Result { job, snapshot, name } => {
            let query = "SELECT 1 FROM result_files
                         WHERE job = ? AND snapshot = ? AND name = ? AND sha256 = ?";
            sql!(query, [job, snapshot, name, record.sha256])
        }
    };
    Ok(query.fetch_optional(connection).await?.is_some())
}

/// Uploads in pieces that are not stored yet, and the bytes that are known to have come.
pub(super) async fn partials(connection: &mut SqliteConnection) -> Result<Vec<(PartialId, u64)>> {
    let partials = "SELECT id, received FROM partials WHERE result IS NULL";
    sql_as!(partials).fetch_all(connection).await
}

/// The snapshots of a job with a damaged file; [`WHOLE_JOB`] stands for the files of the whole job.
pub(super) async fn damaged_snapshots(
    connection: &mut SqliteConnection,
    job: JobId,
) -> Result<Vec<i64>> {
    let snapshots = "SELECT DISTINCT snapshot FROM result_files
                     WHERE job = ? AND damaged_at IS NOT NULL";
    sql_as!(snapshots, [job]).fetch_all(connection).await
}

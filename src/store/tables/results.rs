//! Table `result_files`: what a job has made.

use std::path::PathBuf;

use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use crate::job::{JobId, ResultFile};
use crate::store::error::StoreError;
use crate::store::rows::{integer, number, parsed};
use crate::store::{Job, Store};

/// The snapshot of files that belong to the whole job.
const WHOLE_JOB: i64 = -1;

impl Store {
    /// A result file of a snapshot (or, with none, of the whole job), and where it lies.
    ///
    /// # Errors
    /// [`StoreError::NotFound`] if the job has not made it, or not yet.
    pub async fn result_file(
        &self,
        job: &Job,
        snapshot: Option<u32>,
        name: &str,
    ) -> Result<(ResultFile, PathBuf), StoreError> {
        let row =
            sqlx::query("SELECT * FROM result_files WHERE job = ? AND snapshot = ? AND name = ?")
                .bind(job.id.to_string())
                .bind(snapshot.map_or(WHOLE_JOB, i64::from))
                .bind(name)
                .fetch_optional(&self.readers)
                .await?;
        let not_found = || StoreError::NotFound { what: "result file", id: name.to_owned() };
        let file = row.as_ref().map(result_file).transpose()?.ok_or_else(not_found)?;
        let folder = match snapshot {
            Some(snapshot) => self.dir().snapshot_results(job.id, snapshot),
            None => self.dir().results(job.id),
        };
        // The name is the one on record, which a worker wrote: not the one in the request.
        let path = folder.join(&file.name);
        Ok((file, path))
    }

    /// The result files of a snapshot (or, with none, of the whole job), by name.
    pub async fn result_files(
        &self,
        job: &Job,
        snapshot: Option<u32>,
    ) -> Result<Vec<ResultFile>, StoreError> {
        let rows =
            sqlx::query("SELECT * FROM result_files WHERE job = ? AND snapshot = ? ORDER BY name")
                .bind(job.id.to_string())
                .bind(snapshot.map_or(WHOLE_JOB, i64::from))
                .fetch_all(&self.readers)
                .await?;
        rows.iter().map(result_file).collect()
    }
}

/// Replaces the list of files of a snapshot (or of the whole job).
pub(in crate::store) async fn record(
    connection: &mut SqliteConnection,
    job: JobId,
    snapshot: Option<u32>,
    files: &[ResultFile],
) -> Result<(), StoreError> {
    let snapshot = snapshot.map_or(WHOLE_JOB, i64::from);
    sqlx::query("DELETE FROM result_files WHERE job = ? AND snapshot = ?")
        .bind(job.to_string())
        .bind(snapshot)
        .execute(&mut *connection)
        .await?;
    for file in files {
        sqlx::query(
            "INSERT INTO result_files (job, snapshot, name, size, sha256) VALUES (?, ?, ?, ?, ?)",
        )
        .bind(job.to_string())
        .bind(snapshot)
        .bind(&file.name)
        .bind(integer(file.size))
        .bind(file.sha256.to_string())
        .execute(&mut *connection)
        .await?;
    }
    Ok(())
}

fn result_file(row: &SqliteRow) -> Result<ResultFile, StoreError> {
    Ok(ResultFile {
        name: row.try_get("name")?,
        size: number(row, "size")?,
        sha256: parsed(row, "sha256")?,
    })
}

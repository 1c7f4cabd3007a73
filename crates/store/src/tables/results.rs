//! Table `result_files`: what a job has made.

use std::path::PathBuf;

use sqlx::SqliteConnection;
use sqlx::sqlite::SqliteRow;

use crate::columns::{Columns, sql};
use crate::error::{Result, StoreError};
use crate::{Job, Store};
use engine::job::{JobId, ResultFile, WrittenFile};

/// The snapshot of files that belong to the whole job.
pub(crate) const WHOLE_JOB: i64 = -1;

impl Store {
    /// A result file of a snapshot (or, with none, of the whole job), and where it lies unless it is derived.
    /// Errors: [`StoreError::NotFound`] if the job has not made it, or not yet.
    pub async fn result_file(
        &self,
        job: &Job,
        snapshot: Option<u32>,
        name: &str,
    ) -> Result<(WrittenFile, PathBuf)> {
        let row = sql!(
            "SELECT * FROM result_files WHERE job = ? AND snapshot = ? AND name = ?",
            [job.id, snapshot.map_or(WHOLE_JOB, i64::from), name]
        )
        .fetch_optional(&self.readers)
        .await?;
        let file = written_file(&row.ok_or_else(|| StoreError::missing("result file", name))?)?;
        let folder = match snapshot {
            Some(snapshot) => self.dir().snapshot_results(job.id, snapshot),
            None => self.dir().results(job.id),
        };
        // The name comes from the record that a worker wrote, not from the request.
        let path = folder.join(&file.file.name);
        Ok((file, path))
    }

    /// The result files of a snapshot (or, with none, of the whole job), by name.
    pub async fn result_files(&self, job: &Job, snapshot: Option<u32>) -> Result<Vec<WrittenFile>> {
        let rows = sql!(
            "SELECT * FROM result_files WHERE job = ? AND snapshot = ? ORDER BY name",
            [job.id, snapshot.map_or(WHOLE_JOB, i64::from)]
        )
        .fetch_all(&self.readers)
        .await?;
        rows.iter().map(written_file).collect()
    }
}

/// Replaces the list of files of a snapshot (or of the whole job).
pub async fn record(
    connection: &mut SqliteConnection,
    job: JobId,
    snapshot: Option<u32>,
    files: &[WrittenFile],
) -> Result<()> {
    let snapshot = snapshot.map_or(WHOLE_JOB, i64::from);
    sql!("DELETE FROM result_files WHERE job = ? AND snapshot = ?", [job, snapshot])
        .execute(&mut *connection)
        .await?;
    for WrittenFile { file, crc32, is_derived } in files {
        sql!(
            "INSERT INTO result_files (job, snapshot, name, size, sha256, crc32, derived)
             VALUES (?, ?, ?, ?, ?, ?, ?)",
            [job, snapshot, &file.name, file.size, file.sha256, crc32, is_derived]
        )
        .execute(&mut *connection)
        .await?;
    }
    Ok(())
}

fn written_file(row: &SqliteRow) -> Result<WrittenFile> {
    let file = ResultFile {
        name: row.read("name")?,
        size: row.read("size")?,
        sha256: row.read("sha256")?,
    };
    Ok(WrittenFile { file, crc32: row.read("crc32")?, is_derived: row.read("derived")? })
}

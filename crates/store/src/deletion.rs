//! Removal of stored files: first the row, then the file.
//!
//! The transaction that deletes a row notes its file in the table `removals`. Once it is committed, the file leaves its
//! place under the lock of the database, unless a row names it again. A kill in between leaves a file without a row,
//! which the next start removes, and never a row without its file. The bytes go in the background, since large files
//! take long, and others wait for the lock.

use sqlx::SqliteConnection;

use super::error::{Result, StoreError};
use super::{Store, WriteTransaction};
use crate::columns::{Columns, sql};
use engine::job::{JobId, Sha256, Timestamp};

/// Files that leave their places under one lock.
const PAGE: i64 = 100;

/// Notes in the transaction that deletes the row of a blob that its file is to be removed. `created_at` is the time
/// of the row.
pub async fn note_blob(
    connection: &mut SqliteConnection,
    sha256: Sha256,
    created_at: Timestamp,
) -> Result<()> {
    let note = "INSERT OR REPLACE INTO removals (kind, id, created_at) VALUES ('blob', ?, ?)";
    sql!(note, [sha256, created_at]).execute(connection).await?;
    Ok(())
}

/// Notes in the transaction that deletes a job that its results are to be removed.
pub async fn note_results(connection: &mut SqliteConnection, job: JobId) -> Result<()> {
    let note = "INSERT OR REPLACE INTO removals (kind, id) VALUES ('results', ?)";
    sql!(note, [job]).execute(connection).await?;
    Ok(())
}

impl Store {
    /// Commits a transaction that has deleted rows, and removes their files.
    pub(crate) async fn commit_removals(&self, transaction: WriteTransaction) -> Result<()> {
        transaction.commit().await?;
        if let Err(error) = self.finish_removals().await {
            tracing::warn!(%error, "files of deleted things stay until the next cleaning");
        }
        Ok(())
    }

    /// Removes the files whose rows are deleted.
    /// Errors: the first failure; the other files are removed nevertheless.
    pub async fn finish_removals(&self) -> Result<()> {
        let mut last = (String::new(), String::new());
        let mut failure = None;
        loop {
            let noted = sql!(
                "SELECT kind, id, created_at FROM removals WHERE (kind, id) > (?, ?)
                 ORDER BY kind, id LIMIT ?",
                [last.0, last.1, PAGE]
            )
            .fetch_all(&self.readers)
            .await?;
            if noted.is_empty() {
                return failure.map_or(Ok(()), Err);
            }
            let mut transaction = self.write().await?;
            for row in &noted {
                last = (row.read("kind")?, row.read("id")?);
                let removed = self.remove_noted(&mut transaction, &last, row.read("created_at")?);
                match removed.await {
                    Ok(()) => {
                        sql!("DELETE FROM removals WHERE kind = ? AND id = ?", [last.0, last.1])
                            .execute(&mut *transaction)
                            .await?;
                    }
                    Err(error) => failure = failure.or(Some(error)),
                }
            }
            transaction.commit().await?;
        }
    }

    /// Takes a file out of its place, unless it has a row again. The lock of the database must be held.
    async fn remove_noted(
        &self,
        transaction: &mut SqliteConnection,
        (kind, id): &(String, String),
        created_at: Option<Timestamp>,
    ) -> Result<()> {
        let corrupt = || StoreError::Corrupt { column: "id", value: id.clone() };
        let (place, row) = if kind == "blob" {
            let sha256: Sha256 = id.parse().map_err(|_| corrupt())?;
            (self.dir().blob(&sha256), "SELECT 1 FROM blobs WHERE sha256 = ?")
        } else {
            let job: JobId = id.parse().map_err(|_| corrupt())?;
            (self.dir().results(job), "SELECT 1 FROM jobs WHERE id = ?")
        };
        let has_row = sql!(row, [id.as_str()]).fetch_optional(transaction).await?.is_some();
        if has_row { Ok(()) } else { self.discard(place, created_at).await }
    }
}

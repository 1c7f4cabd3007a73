//! Table `blobs`: files by the hash of their bytes.

use serde::Serialize;
use sqlx::{Row, SqliteConnection};

use super::error::StoreError;
use super::rows::{integer, number, parsed};
use super::staging::StagedBlob;
use super::{Store, dir, on_files};
use crate::job::{Sha256, Timestamp};

/// A stored file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Blob {
    /// The hash of its bytes, which is its address.
    pub sha256: Sha256,
    /// Its size in bytes.
    pub size: u64,
    /// When it was first stored.
    pub created_at: Timestamp,
}

/// Where a file comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// A user sent it.
    Upload,
    /// It was derived from an upload.
    Prepared,
    /// A task made it.
    Tile,
}

impl Origin {
    fn name(self) -> &'static str {
        match self {
            Self::Upload => "upload",
            Self::Prepared => "prepared",
            Self::Tile => "tile",
        }
    }
}

impl Store {
    /// Stores an upload. Says whether it is new.
    ///
    /// # Errors
    /// If the file or its row can't be written.
    pub async fn store_upload(&self, staged: StagedBlob) -> Result<(Blob, bool), StoreError> {
        let sha256 = staged.sha256();
        let mut transaction = self.write().await?;
        let before = sqlx::query("SELECT 1 FROM blobs WHERE sha256 = ? AND origin = 'upload'")
            .bind(sha256.to_string())
            .fetch_optional(&mut *transaction)
            .await?;
        self.publish(&mut transaction, staged, Origin::Upload).await?;
        let blob = find(&mut transaction, sha256).await?;
        transaction.commit().await?;
        let blob = blob.ok_or_else(|| not_found(sha256))?;
        Ok((blob, before.is_none()))
    }

    /// The uploaded file with this hash.
    ///
    /// # Errors
    /// [`StoreError::NotFound`].
    pub async fn upload(&self, sha256: Sha256) -> Result<Blob, StoreError> {
        let row = sqlx::query("SELECT * FROM blobs WHERE sha256 = ? AND origin = 'upload'")
            .bind(sha256.to_string())
            .fetch_optional(&self.readers)
            .await?;
        row.as_ref().map(blob).transpose()?.ok_or_else(|| not_found(sha256))
    }

    /// Puts a file in its place and writes its row, in one step for all other processes.
    pub(super) async fn publish(
        &self,
        transaction: &mut SqliteConnection,
        staged: StagedBlob,
        origin: Origin,
    ) -> Result<(), StoreError> {
        let (sha256, size) = (staged.sha256(), staged.size());
        let place = self.dir().blob(&sha256);
        on_files(move || staged.put(&place)).await?;
        let now = Timestamp::now();
        sqlx::query(
            "INSERT INTO blobs (sha256, size, origin, created_at, touched_at) VALUES (?, ?, ?, ?, ?)
             ON CONFLICT (sha256) DO UPDATE SET
                 touched_at = excluded.touched_at,
                 origin = CASE excluded.origin WHEN 'upload' THEN 'upload' ELSE origin END",
        )
        .bind(sha256.to_string())
        .bind(integer(size))
        .bind(origin.name())
        .bind(now.0)
        .bind(now.0)
        .execute(transaction)
        .await?;
        Ok(())
    }

    /// Removes a derived file if nothing refers to it any more. Uploads are left to [`Self::collect`].
    pub(super) async fn release(
        &self,
        transaction: &mut SqliteConnection,
        sha256: Sha256,
    ) -> Result<(), StoreError> {
        let removed = sqlx::query(
            "DELETE FROM blobs WHERE sha256 = ?1 AND origin <> 'upload'
                 AND NOT EXISTS (SELECT 1 FROM calibrations WHERE prepared = ?1 OR masks = ?1)
                 AND NOT EXISTS (SELECT 1 FROM measurements WHERE prepared = ?1 OR data = ?1)
                 AND NOT EXISTS (SELECT 1 FROM tasks WHERE result = ?1)",
        )
        .bind(sha256.to_string())
        .execute(transaction)
        .await?;
        if removed.rows_affected() == 0 {
            return Ok(());
        }
        // Before the commit: after it, another process could put the same content in place.
        let place = self.dir().blob(&sha256);
        on_files(move || dir::remove(&place)).await
    }

    /// Removes the uploads that nothing refers to and nobody has sent since `before`. Says how many.
    ///
    /// # Errors
    /// If the database or a file can't be written.
    pub async fn collect(&self, before: Timestamp) -> Result<usize, StoreError> {
        let mut transaction = self.write().await?;
        let rows = sqlx::query(
            "DELETE FROM blobs WHERE touched_at < ?
                 AND NOT EXISTS (SELECT 1 FROM calibrations WHERE masks = sha256 OR prepared = sha256)
                 AND NOT EXISTS (SELECT 1 FROM measurements WHERE data = sha256 OR prepared = sha256)
                 AND NOT EXISTS (SELECT 1 FROM tasks WHERE result = sha256)
             RETURNING sha256",
        )
        .bind(before.0)
        .fetch_all(&mut *transaction)
        .await?;
        for row in &rows {
            let place = self.dir().blob(&parsed(row, "sha256")?);
            on_files(move || dir::remove(&place)).await?;
        }
        transaction.commit().await?;
        Ok(rows.len())
    }

    /// Number and bytes of all stored files.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn blob_totals(&self) -> Result<(u64, u64), StoreError> {
        let row =
            sqlx::query("SELECT count(*) AS files, coalesce(sum(size), 0) AS bytes FROM blobs")
                .fetch_one(&self.readers)
                .await?;
        Ok((number(&row, "files")?, number(&row, "bytes")?))
    }
}

async fn find(
    connection: &mut SqliteConnection,
    sha256: Sha256,
) -> Result<Option<Blob>, StoreError> {
    let row = sqlx::query("SELECT * FROM blobs WHERE sha256 = ?")
        .bind(sha256.to_string())
        .fetch_optional(connection)
        .await?;
    row.as_ref().map(blob).transpose()
}

fn blob(row: &sqlx::sqlite::SqliteRow) -> Result<Blob, StoreError> {
    Ok(Blob {
        sha256: parsed(row, "sha256")?,
        size: number(row, "size")?,
        created_at: Timestamp(row.try_get("created_at")?),
    })
}

fn not_found(sha256: Sha256) -> StoreError {
    StoreError::NotFound { what: "blob", id: sha256.to_string() }
}

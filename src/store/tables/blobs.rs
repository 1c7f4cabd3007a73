//! Table `blobs`: files by the hash of their bytes.

use serde::Serialize;
use sqlx::{Row, SqliteConnection};

use crate::job::{Lab, Sha256, Timestamp, TokenId};
use crate::store::error::StoreError;
use crate::store::rows::{integer, number, parsed};
use crate::store::staging::StagedBlob;
use crate::store::{Store, dir, on_files};

/// A stored file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Blob {
    /// The hash of its bytes, which is its address.
    pub sha256: Sha256,
    /// Its size in bytes.
    pub size: u64,
    /// When the lab first sent it.
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
    /// Stores an upload of a lab. Says whether it is new to the lab: that another one has it shows
    /// nowhere. It counts against the limit of the token that sent it first.
    pub async fn store_upload(
        &self,
        lab: &Lab,
        token: Option<TokenId>,
        staged: StagedBlob,
    ) -> Result<(Blob, bool), StoreError> {
        let sha256 = staged.sha256();
        let mut transaction = self.write().await?;
        let before = held(&mut transaction, lab, sha256).await?;
        self.publish(&mut transaction, staged, Origin::Upload).await?;
        let now = Timestamp::now().0;
        sqlx::query(
            "INSERT INTO holdings (lab, sha256, token, created_at, touched_at) VALUES (?, ?, ?, ?, ?)
             ON CONFLICT (lab, sha256) DO UPDATE SET touched_at = excluded.touched_at",
        )
        .bind(lab.as_str())
        .bind(sha256.to_string())
        .bind(token.map(|id| id.to_string()))
        .bind(now)
        .bind(now)
        .execute(&mut *transaction)
        .await?;
        let blob = held(&mut transaction, lab, sha256).await?;
        transaction.commit().await?;
        let blob = blob.ok_or_else(|| not_found(sha256))?;
        Ok((blob, before.is_none()))
    }

    /// The file with this hash, if the lab has uploaded it.
    ///
    /// # Errors
    /// [`StoreError::NotFound`].
    pub async fn upload(&self, lab: &Lab, sha256: Sha256) -> Result<Blob, StoreError> {
        let mut connection = self.readers.acquire().await?;
        held(&mut connection, lab, sha256).await?.ok_or_else(|| not_found(sha256))
    }

    /// Puts a file in its place and writes its row, in one step for all other processes.
    pub(in crate::store) async fn publish(
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
    pub(in crate::store) async fn release(
        &self,
        transaction: &mut SqliteConnection,
        sha256: Sha256,
    ) -> Result<(), StoreError> {
        let removed = sqlx::query(
            "DELETE FROM blobs WHERE sha256 = ?1
                 AND NOT EXISTS (SELECT 1 FROM holdings WHERE sha256 = ?1)
                 AND NOT EXISTS (SELECT 1 FROM calibrations WHERE prepared = ?1 OR masks = ?1)
                 AND NOT EXISTS (SELECT 1 FROM measurements WHERE prepared = ?1 OR data = ?1)
                 AND NOT EXISTS (SELECT 1 FROM calibration_captures WHERE sha256 = ?1)
                 AND NOT EXISTS (SELECT 1 FROM models WHERE file = ?1)
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
    pub async fn collect(&self, before: Timestamp) -> Result<usize, StoreError> {
        let mut transaction = self.write().await?;
        sqlx::query(
            "DELETE FROM holdings AS h WHERE touched_at < ?
                 AND NOT EXISTS (SELECT 1 FROM calibrations AS c WHERE c.lab = h.lab AND masks = sha256)
                 AND NOT EXISTS (SELECT 1 FROM measurements AS m WHERE m.lab = h.lab AND data = sha256)
                 AND NOT EXISTS (SELECT 1 FROM calibration_captures AS c WHERE c.sha256 = h.sha256)
                 AND NOT EXISTS (SELECT 1 FROM models AS m WHERE m.lab = h.lab AND file = sha256)",
        )
        .bind(before.0)
        .execute(&mut *transaction)
        .await?;
        let rows = sqlx::query(
            "DELETE FROM blobs WHERE touched_at < ?
                 AND NOT EXISTS (SELECT 1 FROM holdings AS h WHERE h.sha256 = blobs.sha256)
                 AND NOT EXISTS (SELECT 1 FROM calibrations WHERE masks = sha256 OR prepared = sha256)
                 AND NOT EXISTS (SELECT 1 FROM measurements WHERE data = sha256 OR prepared = sha256)
                 AND NOT EXISTS (SELECT 1 FROM calibration_captures AS c WHERE c.sha256 = blobs.sha256)
                 AND NOT EXISTS (SELECT 1 FROM models WHERE file = sha256)
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
    pub async fn blob_totals(&self) -> Result<(u64, u64), StoreError> {
        let row =
            sqlx::query("SELECT count(*) AS files, coalesce(sum(size), 0) AS bytes FROM blobs")
                .fetch_one(&self.readers)
                .await?;
        Ok((number(&row, "files")?, number(&row, "bytes")?))
    }
}

/// The file, if the lab has uploaded it.
async fn held(
    connection: &mut SqliteConnection,
    lab: &Lab,
    sha256: Sha256,
) -> Result<Option<Blob>, StoreError> {
    let row = sqlx::query(
        "SELECT sha256, size, holdings.created_at FROM holdings JOIN blobs USING (sha256)
         WHERE lab = ? AND sha256 = ?",
    )
    .bind(lab.as_str())
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

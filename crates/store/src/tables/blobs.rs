//! Table `blobs`: files by the hash of their bytes.

use serde::Serialize;
use sqlx::SqliteConnection;
use strum::Display;

use crate::columns::{from_row, sql, sql_as};
use crate::error::{Result, StoreError};
use crate::rows::{Expired, Page};
use crate::staging::StagedBlob;
use crate::tables::quota;
use crate::{Store, deletion, on_files};
use engine::job::{Lab, Sha256, Timestamp, TokenId};

#[derive(Debug, Clone, PartialEq, Eq, Serialize, schemars::JsonSchema)]
pub struct Blob {
    /// Hash of the bytes, which is the address of the file.
    pub sha256: Sha256,
    /// Bytes.
    pub size: u64,
    /// When the lab first sent it.
    pub created_at: Timestamp,
}

from_row!(Blob, row => { sha256, size, created_at });

/// An upload in a list.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, schemars::JsonSchema)]
#[schemars(rename = "BlobItem")]
pub struct BlobRow {
    #[serde(flatten)]
    pub blob: Blob,
    /// True while a resource of the lab refers to the file, which prevents its deletion.
    pub in_use: bool,
}

from_row!(BlobRow, row => { blob = Blob::from_row(row)?, in_use });

/// The condition under which something of a lab refers to an upload of its, named as columns of `h`. The sign keeps SQLite
/// from searching everything of the lab: few rows refer to a file.
macro_rules! in_use {
    () => {
        "(EXISTS (SELECT 1 FROM request_files AS f JOIN requests USING (id)
                  WHERE +requests.lab = h.lab AND f.sha256 = h.sha256)
          OR EXISTS (SELECT 1 FROM jobs AS j WHERE +j.lab = h.lab AND truth = h.sha256))"
    };
}

/// The condition under which no lab and no row refers to a file of `blobs`.
macro_rules! unused {
    () => {
        "NOT EXISTS (SELECT 1 FROM holdings AS h WHERE h.sha256 = blobs.sha256)
         AND NOT EXISTS (SELECT 1 FROM requests WHERE prepared = blobs.sha256)
         AND NOT EXISTS (SELECT 1 FROM request_files AS f WHERE f.sha256 = blobs.sha256)
         AND NOT EXISTS (SELECT 1 FROM jobs WHERE truth = blobs.sha256)
         AND NOT EXISTS (SELECT 1 FROM tasks WHERE result = blobs.sha256)"
    };
}

/// Origin of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display)]
#[strum(serialize_all = "snake_case")]
pub enum Origin {
    Upload,
    /// It was derived from an upload.
    Prepared,
    /// A task made it.
    Tile,
}

impl Store {
    /// Stores an upload of a lab. Says whether it is new to the lab: that another one has it shows
    /// nowhere. It counts against the limit of the token that sent it first.
    /// Errors: [`StoreError::Quota`].
    pub async fn store_upload(
        &self,
        lab: &Lab,
        token: Option<TokenId>,
        staged: StagedBlob,
    ) -> Result<(Blob, bool)> {
        let sha256 = staged.sha256();
        let mut transaction = self.write().await?;
        let before = held(&mut transaction, lab, sha256).await?;
        if before.is_none() {
            quota::check(&mut transaction, lab, token, staged.size()).await?;
        }
        self.hold(&mut transaction, lab, token, staged).await?;
        let blob = held(&mut transaction, lab, sha256).await?;
        transaction.commit().await?;
        let blob = blob.ok_or_else(|| StoreError::missing("blob", sha256))?;
        Ok((blob, before.is_none()))
    }

    /// Puts an upload in its place and writes down that the lab has sent it.
    pub(super) async fn hold(
        &self,
        transaction: &mut SqliteConnection,
        lab: &Lab,
        token: Option<TokenId>,
        staged: StagedBlob,
    ) -> Result<()> {
        let (sha256, now) = (staged.sha256(), Timestamp::now());
        self.publish(transaction, staged, Origin::Upload).await?;
        sql!(
            "INSERT INTO holdings (lab, sha256, token, created_at, touched_at)
             VALUES (?, ?, ?, ?, ?)
             ON CONFLICT (lab, sha256) DO UPDATE SET touched_at = excluded.touched_at",
            [lab, sha256, token, now, now]
        )
        .execute(transaction)
        .await?;
        Ok(())
    }

    pub async fn upload(&self, lab: &Lab, sha256: Sha256) -> Result<Blob> {
        let mut connection = self.readers.acquire().await?;
        held(&mut connection, lab, sha256).await?.ok_or_else(|| StoreError::missing("blob", sha256))
    }

    /// A page of the lab's uploads, newest first. `after` has the time and the hash of the last one of the page before.
    pub async fn uploads(
        &self,
        lab: &Lab,
        after: Option<(Timestamp, Sha256)>,
        limit: u32,
    ) -> Result<Page<BlobRow>> {
        let (time, sha256) = after.unzip();
        let items = sql_as!(
            concat!(
                "SELECT h.sha256, size, h.created_at, ",
                in_use!(),
                " AS in_use
                 FROM holdings AS h JOIN blobs USING (sha256)
                 WHERE h.lab = ?1 AND (?2 IS NULL OR (h.created_at, h.sha256) < (?2, ?3))
                 ORDER BY h.created_at DESC, h.sha256 DESC LIMIT ?4"
            ),
            [lab, time, sha256, i64::from(limit) + 1]
        )
        .fetch_all(&self.readers)
        .await?;
        Ok(Page::cut(items, limit))
    }

    /// Deletes an upload of a lab to which nothing of the lab refers. Its bytes go with it if nobody else
    /// has them.
    pub async fn delete_upload(&self, lab: &Lab, sha256: Sha256) -> Result<()> {
        let mut transaction = self.write().await?;
        let used: Option<bool> = sql_as!(
            concat!("SELECT ", in_use!(), " FROM holdings AS h WHERE lab = ? AND sha256 = ?"),
            [lab, sha256]
        )
        .fetch_optional(&mut *transaction)
        .await?;
        match used {
            None => return Err(StoreError::missing("blob", sha256)),
            Some(true) => return Err(StoreError::FileInUse(sha256)),
            Some(false) => {}
        }
        sql!("DELETE FROM holdings WHERE lab = ? AND sha256 = ?", [lab, sha256])
            .execute(&mut *transaction)
            .await?;
        self.release(&mut transaction, sha256).await?;
        self.commit_removals(transaction).await
    }

    /// Puts a file in its place and writes its row, in one step for all other processes.
    pub(crate) async fn publish(
        &self,
        transaction: &mut SqliteConnection,
        staged: StagedBlob,
        origin: Origin,
    ) -> Result<()> {
        let (sha256, size) = (staged.sha256(), staged.size());
        let place = self.dir().blob(&sha256);
        let (identity, replaced) = on_files(move || staged.put(&place)).await?;
        replaced.into_iter().for_each(|path| self.removals.begin(path));
        self.hashes.remember(identity, sha256);
        let now = Timestamp::now();
        sql!(
            "INSERT INTO blobs (sha256, size, origin, created_at, touched_at)
             VALUES (?, ?, ?, ?, ?)
             ON CONFLICT (sha256) DO UPDATE SET
                 touched_at = excluded.touched_at, damaged_at = NULL,
                 origin = CASE excluded.origin WHEN 'upload' THEN 'upload' ELSE origin END",
            [sha256, size, origin.to_string(), now, now]
        )
        .execute(transaction)
        .await?;
        Ok(())
    }

    /// Deletes the row of a derived file if nothing refers to it. Uploads are left to [`Self::collect`]. The
    /// transaction must end with [`Self::commit_removals`].
    pub(crate) async fn release(
        &self,
        transaction: &mut SqliteConnection,
        sha256: Sha256,
    ) -> Result<()> {
        let removed: Option<Timestamp> = sql_as!(
            concat!("DELETE FROM blobs WHERE sha256 = ? AND ", unused!(), " RETURNING created_at"),
            [sha256]
        )
        .fetch_optional(&mut *transaction)
        .await?;
        match removed {
            Some(created_at) => deletion::note_blob(transaction, sha256, created_at).await,
            None => Ok(()),
        }
    }

    /// Removes the uploads that nothing refers to and nobody has sent since `before`, and requests from before that
    /// were refused. Returns the labs' uploads; arrays that were prepared from uploads go as well.
    pub async fn collect(&self, before: Timestamp) -> Result<Vec<Expired<Sha256>>> {
        let mut transaction = self.write().await?;
        sql!("DELETE FROM requests WHERE refusal IS NOT NULL AND created_at < ?", [before])
            .execute(&mut *transaction)
            .await?;
        let uploads = sql_as!(
            concat!(
                "DELETE FROM holdings AS h WHERE touched_at < ? AND NOT ",
                in_use!(),
                " RETURNING lab, sha256 AS id"
            ),
            [before]
        )
        .fetch_all(&mut *transaction)
        .await?;
        let removed = sql_as!(
            concat!(
                "DELETE FROM blobs WHERE touched_at < ? AND ",
                unused!(),
                " RETURNING sha256, created_at"
            ),
            [before]
        );
        let removed: Vec<(Sha256, Timestamp)> = removed.fetch_all(&mut *transaction).await?;
        for (sha256, created_at) in &removed {
            deletion::note_blob(&mut transaction, *sha256, *created_at).await?;
        }
        self.commit_removals(transaction).await?;
        Ok(uploads)
    }

    /// Number and bytes of all stored files.
    pub async fn blob_totals(&self) -> Result<(u64, u64)> {
        let totals = "SELECT coalesce(sum(files), 0), coalesce(sum(bytes), 0) FROM stored_files";
        sql_as!(totals).fetch_one(&self.readers).await
    }
}

/// The file, if the lab has uploaded it.
async fn held(
    connection: &mut SqliteConnection,
    lab: &Lab,
    sha256: Sha256,
) -> Result<Option<Blob>> {
    let blob = sql_as!(
        "SELECT sha256, size, holdings.created_at FROM holdings JOIN blobs USING (sha256)
         WHERE lab = ? AND sha256 = ?",
        [lab, sha256]
    )
    .fetch_optional(connection)
    .await?;
    Ok(blob)
}

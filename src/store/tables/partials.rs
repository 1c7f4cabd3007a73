//! Table `partials`: uploads that come in pieces, and may go on after a cut or a crash.

use std::fs::{File, TryLockError};
use std::io::{Seek, SeekFrom, Write};
use std::path::PathBuf;
use std::time::Duration;

use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use crate::job::{Lab, PartialId, Sha256, Timestamp, TokenId};
use crate::store::error::StoreError;
use crate::store::rows::{integer, number, parsed, parsed_if};
use crate::store::{Blob, Store, dir, on_files};

/// An upload to be begun.
#[derive(Debug, Clone)]
pub struct NewPartial {
    /// Whose it is.
    pub lab: Lab,
    /// Whose limit it counts against.
    pub token: Option<TokenId>,
    /// Bytes of the whole file.
    pub length: u64,
    /// What the client tells of the file, as it was sent.
    pub metadata: String,
    /// The hash that the client says the whole file has.
    pub expected: Option<Sha256>,
}

/// An upload that was begun.
#[derive(Debug, Clone)]
pub struct Partial {
    /// Its identifier.
    pub id: PartialId,
    /// What was said when it was begun.
    pub facts: NewPartial,
    /// Bytes that are on the disk.
    pub received: u64,
    /// The hash of the stored file, once all is there.
    pub result: Option<Sha256>,
    /// When it is given up if nothing more comes.
    pub expires_at: Timestamp,
}

/// The file of a partial upload, locked: one request writes to it.
#[derive(Debug)]
pub struct PartialFile {
    file: File,
    path: PathBuf,
}

impl PartialFile {
    /// Appends bytes. Blocks.
    ///
    /// # Errors
    /// If they can't be written.
    pub fn append(&mut self, bytes: &[u8]) -> Result<(), StoreError> {
        self.file.write_all(bytes).map_err(StoreError::io("write", &self.path))
    }

    /// Brings all to the disk. Blocks.
    ///
    /// # Errors
    /// If that fails.
    pub fn sync(&self) -> Result<(), StoreError> {
        self.file.sync_data().map_err(StoreError::io("write to the disk", &self.path))
    }
}

impl Store {
    /// Begins an upload, which is given up when nothing more has come for `age`.
    ///
    /// # Errors
    /// If the file or its row can't be written.
    pub async fn begin_partial(
        &self,
        facts: NewPartial,
        age: Duration,
    ) -> Result<Partial, StoreError> {
        let id = PartialId::new();
        let expires_at = after(age);
        let path = self.dir().partial(id);
        on_files(move || {
            File::create_new(&path).map_err(StoreError::io("make", &path))?;
            path.parent().map_or(Ok(()), dir::sync_dir)
        })
        .await?;
        sqlx::query(
            "INSERT INTO partials (id, lab, token, length, metadata, expected, expires_at)
             VALUES (?, ?, ?, ?, ?, ?, ?)",
        )
        .bind(id.to_string())
        .bind(facts.lab.as_str())
        .bind(facts.token.map(|id| id.to_string()))
        .bind(integer(facts.length))
        .bind(&facts.metadata)
        .bind(facts.expected.map(|hash| hash.to_string()))
        .bind(expires_at.0)
        .execute(&self.writer)
        .await?;
        Ok(Partial { id, facts, received: 0, result: None, expires_at })
    }

    /// The lab's upload with this identifier, unless it has expired.
    ///
    /// # Errors
    /// [`StoreError::NotFound`].
    pub async fn partial(&self, lab: &Lab, id: PartialId) -> Result<Partial, StoreError> {
        let row = sqlx::query("SELECT * FROM partials WHERE id = ? AND lab = ? AND expires_at > ?")
            .bind(id.to_string())
            .bind(lab.as_str())
            .bind(Timestamp::now().0)
            .fetch_optional(&self.readers)
            .await?;
        row.as_ref().map(partial).transpose()?.ok_or_else(|| not_found(id))
    }

    /// Opens the file of an upload behind the last byte that is known to be on the disk; none if
    /// another request writes to it.
    ///
    /// # Errors
    /// [`StoreError::NotFound`] if it is gone; or if it can't be opened.
    pub async fn open_partial(&self, upload: &Partial) -> Result<Option<PartialFile>, StoreError> {
        let (path, received, id) = (self.dir().partial(upload.id), upload.received, upload.id);
        on_files(move || {
            let file = match File::options().write(true).open(&path) {
                Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
                    return Err(not_found(id));
                }
                file => file.map_err(StoreError::io("open", &path))?,
            };
            match file.try_lock() {
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => return Ok(None),
                Err(TryLockError::Error(error)) => {
                    return Err(StoreError::io("lock", &path)(error));
                }
            }
            let mut partial = PartialFile { file, path };
            // What an earlier request wrote without the end of it being recorded.
            partial
                .file
                .set_len(received)
                .and_then(|()| partial.file.seek(SeekFrom::Start(received)))
                .map_err(StoreError::io("shorten", &partial.path))?;
            Ok(Some(partial))
        })
        .await
    }

    /// Records that so many bytes are on the disk, and puts off the end.
    ///
    /// # Errors
    /// [`StoreError::NotFound`] if the upload was ended meanwhile.
    pub async fn advance_partial(
        &self,
        upload: &mut Partial,
        received: u64,
        age: Duration,
    ) -> Result<(), StoreError> {
        let expires_at = after(age);
        let changed = sqlx::query("UPDATE partials SET received = ?, expires_at = ? WHERE id = ?")
            .bind(integer(received))
            .bind(expires_at.0)
            .bind(upload.id.to_string())
            .execute(&self.writer)
            .await?;
        if changed.rows_affected() == 0 {
            return Err(not_found(upload.id));
        }
        (upload.received, upload.expires_at) = (received, expires_at);
        Ok(())
    }

    /// Moves an upload of which all bytes are there into the store, as an upload of its lab. Its
    /// hash is that of the file as it lies on the disk.
    ///
    /// # Errors
    /// [`StoreError::HashMismatch`] if the client named another hash; the upload is ended then.
    pub async fn finish_partial(&self, upload: &mut Partial) -> Result<Blob, StoreError> {
        let (store, path) = (self.clone(), self.dir().partial(upload.id));
        // Under a second name, so that the bytes are not lost if the rest fails.
        let staged = on_files(move || store.staged_link(&path)?.finish()).await?;
        let found = staged.sha256();
        if let Some(expected) = upload.facts.expected.filter(|expected| *expected != found) {
            self.end_partial(upload.id).await?;
            return Err(StoreError::HashMismatch { expected, found });
        }
        let (blob, _) = self.store_upload(&upload.facts.lab, upload.facts.token, staged).await?;
        sqlx::query("UPDATE partials SET result = ? WHERE id = ?")
            .bind(found.to_string())
            .bind(upload.id.to_string())
            .execute(&self.writer)
            .await?;
        let path = self.dir().partial(upload.id);
        on_files(move || dir::remove(&path)).await?;
        upload.result = Some(found);
        Ok(blob)
    }

    /// Ends an upload; what has come of it goes.
    ///
    /// # Errors
    /// If the row or the file can't be removed.
    pub async fn end_partial(&self, id: PartialId) -> Result<(), StoreError> {
        sqlx::query("DELETE FROM partials WHERE id = ?")
            .bind(id.to_string())
            .execute(&self.writer)
            .await?;
        let path = self.dir().partial(id);
        on_files(move || dir::remove(&path)).await
    }

    /// Ends the uploads that have expired. Says how many.
    ///
    /// # Errors
    /// If a row or a file can't be removed.
    pub async fn expire_partials(&self) -> Result<usize, StoreError> {
        let rows = sqlx::query("SELECT id FROM partials WHERE expires_at <= ?")
            .bind(Timestamp::now().0)
            .fetch_all(&self.readers)
            .await?;
        for row in &rows {
            self.end_partial(parsed(row, "id")?).await?;
        }
        Ok(rows.len())
    }

    /// Bytes of the disk that were promised and are not written: the rest of uploads in pieces, and
    /// of jobs what is not assembled.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn promised_bytes(&self) -> Result<u64, StoreError> {
        let row = sqlx::query(
            "SELECT (SELECT coalesce(sum(length - received), 0) FROM partials WHERE result IS NULL)
                  + (SELECT coalesce(sum(disk_bytes * (
                         SELECT count(*) FILTER (WHERE state <> 'done') * 1.0 / count(*)
                         FROM tasks WHERE job = jobs.id AND kind = 'assemble')), 0.0)
                     FROM jobs WHERE state IN ('queued', 'running', 'cancelling')) AS bytes",
        )
        .fetch_one(&self.readers)
        .await?;
        let bytes: f64 = row.try_get("bytes")?;
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // a sum of bytes
        Ok(bytes as u64)
    }
}

fn after(age: Duration) -> Timestamp {
    let age = i64::try_from(age.as_millis()).unwrap_or(i64::MAX / 2);
    Timestamp(Timestamp::now().0.saturating_add(age))
}

fn partial(row: &SqliteRow) -> Result<Partial, StoreError> {
    Ok(Partial {
        id: parsed(row, "id")?,
        facts: NewPartial {
            lab: parsed(row, "lab")?,
            token: parsed_if(row, "token")?,
            length: number(row, "length")?,
            metadata: row.try_get("metadata")?,
            expected: parsed_if(row, "expected")?,
        },
        received: number(row, "received")?,
        result: parsed_if(row, "result")?,
        expires_at: Timestamp(row.try_get("expires_at")?),
    })
}

fn not_found(id: PartialId) -> StoreError {
    StoreError::NotFound { what: "upload", id: id.to_string() }
}

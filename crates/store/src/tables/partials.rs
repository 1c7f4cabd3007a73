//! Table `partials`: uploads that come in pieces, and may go on after a cut or a crash.

use std::fs::{File, TryLockError};
use std::io::{Seek, SeekFrom, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use crate::columns::{from_row, sql, sql_as};
use crate::error::{Result, StoreError};
use crate::locked::LockedFile;
use crate::rows::{Expired, Page};
use crate::tables::keys::{self, Inserted, RequestKey, ResourceKind};
use crate::tables::quota;
use crate::{Store, dir, on_files};
use engine::job::{Lab, PartialId, Sha256, Timestamp, TokenId};

#[derive(Debug, Clone)]
pub struct NewPartial {
    pub lab: Lab,
    /// The token against whose limit it counts.
    pub token: Option<TokenId>,
    /// Bytes of the whole file; `None` until the client states them.
    pub length: Option<u64>,
    /// The client's metadata of the file, unchanged.
    pub metadata: String,
    /// The hash that the client says the whole file has.
    pub expected: Option<Sha256>,
}

from_row!(NewPartial, row => { lab, token, length, metadata, expected });

#[derive(Debug, Clone)]
pub struct Partial {
    pub id: PartialId,
    /// The facts from its announcement.
    pub facts: NewPartial,
    /// Bytes that are on the disk.
    pub received: u64,
    /// The hash of the stored file, once it is complete.
    pub result: Option<Sha256>,
    /// When it is given up if nothing more comes.
    pub expires_at: Timestamp,
}

from_row!(Partial, row => {
    id,
    facts = NewPartial::from_row(row)?,
    received,
    result,
    expires_at,
});

impl Partial {
    /// True if all bytes are received. They may not be stored yet.
    pub fn is_complete(&self) -> bool {
        self.facts.length == Some(self.received)
    }
}

/// Bytes that are reserved for a new upload. More are reserved as it grows, so that an announcement does not fill the
/// disk.
pub const FIRST_RESERVE: u64 = 64 << 20;
/// Time for which an empty upload is kept.
const EMPTY: Duration = Duration::from_secs(3600);

/// The file and the row of a partial upload, for one request. The lock of the file protects both until this is dropped,
/// so that no other request appends at an outdated offset.
#[derive(Debug)]
pub struct PartialFile {
    upload: Partial,
    file: LockedFile,
    path: PathBuf,
}

/// The upload that a request wants to continue.
#[derive(Debug)]
pub enum FoundPartial {
    /// The file, positioned after the last recorded byte.
    Open(PartialFile),
    /// Another request has it.
    Busy,
    /// All has come and is stored.
    Stored(Partial),
}

impl PartialFile {
    /// The row as read under the lock.
    pub fn upload(&self) -> &Partial {
        &self.upload
    }

    /// True if all bytes are received.
    pub fn is_complete(&self) -> bool {
        self.upload.is_complete()
    }

    /// Cuts off bytes that were written but not recorded. A file that lacks recorded bytes is refused: extending it
    /// would fill them with zeros.
    fn ready(mut file: LockedFile, path: PathBuf, upload: Partial) -> Result<Self> {
        let bytes = file.metadata().map_err(StoreError::io("read", &path))?.len();
        if bytes < upload.received {
            return Err(short(&upload, bytes));
        }
        if bytes > upload.received {
            file.set_len(upload.received).map_err(StoreError::io("shorten", &path))?;
        }
        file.seek(SeekFrom::Start(upload.received)).map_err(StoreError::io("read", &path))?;
        Ok(Self { upload, file, path })
    }

    /// Appends bytes. Blocks.
    pub fn append(&mut self, bytes: &[u8]) -> Result<()> {
        self.file.write_all(bytes).map_err(StoreError::io("write", &self.path))
    }

    /// Brings all to the disk. Blocks.
    pub fn sync(&self) -> Result<()> {
        self.file.sync_data().map_err(StoreError::io("write to the disk", &self.path))
    }
}

/// The lock of a partial file.
enum Lock {
    Taken(LockedFile),
    Busy,
    Gone,
}

fn lock(path: &Path) -> Result<Lock> {
    let file = match File::options().write(true).open(path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Lock::Gone),
        file => file.map_err(StoreError::io("open", path))?,
    };
    let file = match LockedFile::take(file) {
        Ok(file) => file,
        Err(TryLockError::WouldBlock) => return Ok(Lock::Busy),
        Err(TryLockError::Error(error)) => return Err(StoreError::io("lock", path)(error)),
    };
    // The last holder of the lock may have stored or ended the upload. The opened file may be a blob by now, which must
    // not be written.
    let opened = file.metadata().map_err(StoreError::io("read", path))?;
    let same = std::fs::metadata(path)
        .is_ok_and(|now| (now.dev(), now.ino()) == (opened.dev(), opened.ino()));
    Ok(if same { Lock::Taken(file) } else { Lock::Gone })
}

impl Store {
    /// Begins an upload, which is given up when nothing more has come for `age`; sooner if nothing has at all.
    /// Errors: [`StoreError::KeyReused`]; [`StoreError::Quota`]; [`StoreError::ManyPartials`].
    pub async fn begin_partial(
        &self,
        facts: NewPartial,
        age: Duration,
        key: Option<&RequestKey>,
    ) -> Result<Inserted<PartialId>> {
        let id = PartialId::new();
        let expires_at = after(age.min(EMPTY));
        let path = self.dir().partial(id);
        // Locked until its row exists, so that no other request takes it.
        let made = path.clone();
        let _lock = on_files(move || {
            let file = File::create_new(&path).map_err(StoreError::io("make", &path))?;
            let file = LockedFile::wait(file).map_err(StoreError::io("lock", &path))?;
            path.parent().map_or(Ok(()), dir::sync_dir)?;
            Ok(file)
        })
        .await?;
        let written = self.write_partial(id, &facts, expires_at, key).await;
        if !matches!(written, Ok(Inserted::New(_))) {
            on_files(move || dir::remove(&made)).await?;
        }
        written
    }

    async fn write_partial(
        &self,
        id: PartialId,
        facts: &NewPartial,
        expires_at: Timestamp,
        key: Option<&RequestKey>,
    ) -> Result<Inserted<PartialId>> {
        let mut transaction = self.write().await?;
        if let Some(before) =
            keys::found(&mut transaction, &facts.lab, ResourceKind::Upload, key).await?
        {
            return Ok(Inserted::Before(before));
        }
        quota::check_partials(&mut transaction, &facts.lab).await?;
        quota::check(&mut transaction, &facts.lab, facts.token, facts.length.unwrap_or(1)).await?;
        sql!(
            "INSERT INTO partials (id, lab, token, length, metadata, expected, expires_at)
             VALUES (?, ?, ?, ?, ?, ?, ?)",
            [
                id,
                &facts.lab,
                facts.token,
                facts.length,
                &facts.metadata,
                facts.expected,
                expires_at
            ]
        )
        .execute(&mut *transaction)
        .await?;
        keys::insert(&mut transaction, &facts.lab, ResourceKind::Upload, key, id).await?;
        transaction.commit().await?;
        Ok(Inserted::New(id))
    }

    /// A page of the lab's uploads in pieces that have not expired, newest first, older than `after`.
    pub async fn partials(
        &self,
        lab: &Lab,
        after: Option<PartialId>,
        limit: u32,
    ) -> Result<Page<Partial>> {
        let items = sql_as!(
            "SELECT * FROM partials
             WHERE lab = ?1 AND expires_at > ?2 AND (?3 IS NULL OR id < ?3)
             ORDER BY id DESC LIMIT ?4",
            [lab, Timestamp::now(), after, i64::from(limit) + 1]
        )
        .fetch_all(&self.readers)
        .await?;
        Ok(Page::cut(items, limit))
    }

    /// The lab's upload with this identifier, also if it has expired and was not removed yet.
    pub async fn partial(&self, lab: &Lab, id: PartialId) -> Result<Partial> {
        let partial = sql_as!("SELECT * FROM partials WHERE id = ? AND lab = ?", [id, lab])
            .fetch_optional(&self.readers)
            .await?;
        partial.ok_or_else(|| StoreError::missing("upload", id))
    }

    /// Takes an upload for this request alone, unless another one has it.
    /// Errors: [`StoreError::NotFound`] if it was deleted; [`StoreError::Short`] if recorded bytes are lost.
    pub async fn open_partial(&self, lab: &Lab, id: PartialId) -> Result<FoundPartial> {
        let upload = self.partial(lab, id).await?;
        if upload.result.is_some() {
            return Ok(FoundPartial::Stored(upload));
        }
        let path = self.dir().partial(id);
        let locked = path.clone();
        let file = match on_files(move || lock(&locked)).await? {
            Lock::Taken(file) => Some(file),
            Lock::Busy => return Ok(FoundPartial::Busy),
            Lock::Gone => None,
        };
        // Again, now that nobody changes it.
        let upload = self.partial(lab, id).await?;
        if upload.result.is_some() {
            return Ok(FoundPartial::Stored(upload));
        }
        let file = file.ok_or_else(|| short(&upload, 0))?;
        let ready = on_files(move || PartialFile::ready(file, path, upload)).await?;
        Ok(FoundPartial::Open(ready))
    }

    /// Bytes of an upload's file as it lies on the disk; 0 if there is none.
    pub async fn partial_bytes(&self, id: PartialId) -> Result<u64> {
        let path = self.dir().partial(id);
        on_files(move || match std::fs::metadata(&path) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(0),
            meta => Ok(meta.map_err(StoreError::io("read", &path))?.len()),
        })
        .await
    }

    /// Records the length of an upload that began without one.
    /// Errors: [`StoreError::Quota`]; [`StoreError::NotFound`] if it was deleted.
    pub async fn set_partial_length(&self, partial: &mut PartialFile, length: u64) -> Result<()> {
        let Partial { id, facts, received, .. } = &mut partial.upload;
        let mut transaction = self.write().await?;
        let more = length.saturating_sub(*received);
        quota::check(&mut transaction, &facts.lab, facts.token, more).await?;
        let changed =
            sql!("UPDATE partials SET length = ? WHERE id = ? AND length IS NULL", [length, *id])
                .execute(&mut *transaction)
                .await?;
        if changed.rows_affected() == 0 {
            return Err(StoreError::missing("upload", *id));
        }
        transaction.commit().await?;
        facts.length = Some(length);
        Ok(())
    }

    /// Records that `bytes` more are on the disk, and puts off the end. A known length was counted against the quotas when
    /// it was stated; without one, the bytes are.
    /// Errors: [`StoreError::Quota`]; [`StoreError::NotFound`] if it was deleted.
    pub async fn advance_partial(
        &self,
        partial: &mut PartialFile,
        bytes: u64,
        age: Duration,
    ) -> Result<()> {
        let upload = &mut partial.upload;
        let (received, expires_at) = (upload.received + bytes, after(age));
        let mut transaction = self.write().await?;
        if upload.facts.length.is_none() {
            let facts = &upload.facts;
            quota::check(&mut transaction, &facts.lab, facts.token, bytes).await?;
        }
        let changed = sql!(
            "UPDATE partials SET received = ?, expires_at = ? WHERE id = ? AND received = ?",
            [received, expires_at, upload.id, upload.received]
        )
        .execute(&mut *transaction)
        .await?;
        if changed.rows_affected() == 0 {
            return Err(StoreError::missing("upload", upload.id));
        }
        transaction.commit().await?;
        (upload.received, upload.expires_at) = (received, expires_at);
        Ok(())
    }

    /// Moves a complete upload into the store, as an upload of its lab. Its hash is that of the file as it lies on the
    /// disk.
    /// Errors: [`StoreError::HashMismatch`] if the client named another hash; the upload is ended then.
    /// [`StoreError::Short`] if the file has not the length that was announced.
    pub async fn finish_partial(&self, partial: PartialFile) -> Result<Partial> {
        // The file is open, and so locked, until the upload is stored and its row says so.
        let PartialFile { mut upload, file, path } = partial;
        let lock = file.try_clone().map_err(StoreError::io("open", &path))?;
        let (store, original) = (self.clone(), path.clone());
        // Under a second name, so that the bytes are not lost if the rest fails.
        let staged = on_files(move || store.staged_link(&original, lock)?.finish()).await?;
        if Some(staged.size()) != upload.facts.length {
            return Err(short(&upload, staged.size()));
        }
        let found = staged.sha256();
        if let Some(expected) = upload.facts.expected.filter(|expected| *expected != found) {
            self.end_partial(upload.id).await?;
            return Err(StoreError::HashMismatch { expected, found });
        }
        // Its bytes were counted from its announcement on: no limit is asked again.
        let mut transaction = self.write().await?;
        self.hold(&mut transaction, &upload.facts.lab, upload.facts.token, staged).await?;
        sql!("UPDATE partials SET result = ? WHERE id = ?", [found, upload.id])
            .execute(&mut *transaction)
            .await?;
        transaction.commit().await?;
        self.discard(path, None).await?;
        upload.result = Some(found);
        Ok(upload)
    }

    /// Ends an upload that no other request has, and removes its bytes. False if it is busy.
    pub async fn delete_partial(&self, id: PartialId) -> Result<bool> {
        let path = self.dir().partial(id);
        let lock = on_files(move || lock(&path)).await?;
        if !matches!(lock, Lock::Busy) {
            self.end_partial(id).await?;
            return Ok(true);
        }
        Ok(false)
    }

    /// Removes the row and the file, whose lock must be held.
    async fn end_partial(&self, id: PartialId) -> Result<()> {
        sql!("DELETE FROM partials WHERE id = ?", [id]).execute(self.writer()?).await?;
        self.discard(self.dir().partial(id), None).await
    }

    /// Ends the uploads that have expired, but none to which a piece is being written, nor one that only a clock
    /// that was wrong made old. Calls `ended` for each. `age` is how long an upload is kept after its last piece.
    pub async fn expire_partials(
        &self,
        age: Duration,
        mut ended: impl FnMut(Expired<PartialId>),
    ) -> Result<()> {
        let empty = age.min(EMPTY);
        // What ends now began its age so long ago.
        let (last_empty, last) = (self.ago(empty).await?, self.ago(age).await?);
        let due = sql_as!(
            "SELECT lab, id FROM partials WHERE expires_at <= iif(received = 0, ?, ?)",
            [later(last_empty, empty), later(last, age)]
        );
        let due: Vec<Expired<PartialId>> = due.fetch_all(&self.readers).await?;
        for upload in due {
            let id = upload.id;
            let path = self.dir().partial(id);
            let lock = on_files(move || lock(&path)).await?;
            // A piece may have come before the lock was taken.
            let is_due = sql!(
                "SELECT 1 FROM partials WHERE id = ? AND expires_at <= ?",
                [id, Timestamp::now()]
            )
            .fetch_optional(&self.readers)
            .await?
            .is_some();
            if is_due && !matches!(lock, Lock::Busy) {
                self.end_partial(id).await?;
                ended(upload);
            }
        }
        Ok(())
    }
}

fn after(age: Duration) -> Timestamp {
    later(Timestamp::now(), age)
}

fn later(moment: Timestamp, age: Duration) -> Timestamp {
    let age = i64::try_from(age.as_millis()).unwrap_or(i64::MAX / 2);
    Timestamp(moment.0.saturating_add(age))
}

fn short(upload: &Partial, found: u64) -> StoreError {
    StoreError::Short { id: upload.id, found, recorded: upload.received }
}

//! Verification of stored files against their recorded hashes: before a file is sent, and by a slow scan of all files.
//!
//! A file is read whole before it is first sent, unless this process has written it. The verdict holds until its inode,
//! size or time changes, or until the scan finds damage.

use std::fs::File;
use std::io::Seek;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::fs::{Advice, fadvise};

use super::error::{Result, StoreError};
use super::hashes::{Hashing, Identity, digest, open};
use super::records::{self, Place, Record};
use super::{DataDir, Job, Store, on_files};
use crate::columns::{sql, sql_as};
use engine::job::{ResultFile, Sha256, Timestamp, WrittenFile};

/// Time from the begin of a slow look to that of the next.
const ROUND: Duration = Duration::from_secs(86_400);
/// Pause of the slow look when the database or the disk has failed, or when it is done.
const PAUSE: Duration = Duration::from_secs(10);

/// The result of a comparison of all records with the disk.
#[derive(Debug, Default, serde::Serialize)]
pub struct Audit {
    /// Recorded files.
    pub files: u64,
    /// Bytes that were read of them.
    pub bytes: u64,
    /// What SQLite says of the database: `ok`, or what is wrong.
    pub database: String,
    /// Files whose bytes differ from the recorded hash.
    pub damaged: Vec<String>,
    /// Recorded files that are missing.
    pub missing: Vec<String>,
    /// Blobs, results of jobs and uploads in pieces that no record knows of.
    pub unknown: usize,
}

impl Audit {
    /// True if all recorded files are intact and the database is sound.
    pub fn is_good(&self) -> bool {
        self.damaged.is_empty() && self.missing.is_empty() && self.database == "ok"
    }
}

impl Store {
    /// Opens a result file of a snapshot (or, with none, of the whole job).
    /// Errors: [`StoreError::NotFound`] if the job has not made it, or not yet, and for a derived file;
    /// [`StoreError::Damaged`] if it is missing or damaged.
    pub async fn open_result(
        &self,
        job: &Job,
        snapshot: Option<u32>,
        name: &str,
    ) -> Result<(ResultFile, PathBuf, File)> {
        let (WrittenFile { file, is_derived, .. }, path) =
            self.result_file(job, snapshot, name).await?;
        if is_derived {
            return Err(StoreError::missing("stored result file", name));
        }
        let opened = self.open_intact(&result_record(job, snapshot, &file)).await?;
        Ok((file, path, opened))
    }

    /// Opens a stored file, whose bytes are those of its name.
    /// Errors: [`StoreError::Damaged`] if it is missing or damaged.
    pub async fn open_blob(&self, sha256: Sha256) -> Result<File> {
        self.open_intact(&Record { place: Place::Blob(sha256), sha256 }).await
    }

    /// Path of a stored file that has the hash in its name.
    /// Errors: [`StoreError::Damaged`] if it is missing or damaged.
    pub async fn intact_blob(&self, sha256: Sha256) -> Result<PathBuf> {
        self.open_blob(sha256).await?;
        Ok(self.dir().blob(&sha256))
    }

    async fn open_intact(&self, record: &Record) -> Result<File> {
        let path = record.path(self.dir());
        let opened = on_files(move || open(&path)).await?;
        let Some((mut file, meta)) = opened else { return Err(self.damaged(record).await) };
        let found = self.hashes.of(&file, &meta).await?;
        if found != record.sha256 {
            return Err(self.damaged(record).await);
        }
        on_files(move || {
            file.rewind().map_err(StoreError::io("read", Path::new("a stored file")))?;
            Ok(file)
        })
        .await
    }

    /// Marks a file as damaged, unless its record was deleted, and returns the error for it. Without the data folder no file
    /// can be judged.
    async fn damaged(&self, record: &Record) -> StoreError {
        let name = record.name(self.dir());
        if let Err(error) = self.mark(record).await {
            if matches!(error, StoreError::DatabaseGone(_)) {
                return error;
            }
            tracing::error!(file = name, %error, "that a file is damaged can't be noted");
        }
        match &record.place {
            Place::Blob(sha256) => StoreError::Damaged { what: "upload", name: sha256.to_string() },
            Place::Result { name, .. } => {
                StoreError::Damaged { what: "result", name: name.clone() }
            }
        }
    }

    async fn mark(&self, record: &Record) -> Result<()> {
        let now = Timestamp::now();
        let marked = match &record.place {
            Place::Blob(sha256) => {
                let mark =
                    "UPDATE blobs SET damaged_at = ? WHERE sha256 = ? AND damaged_at IS NULL";
                sql!(mark, [now, sha256])
            }
            Place::Result { job, snapshot, name } => sql!(
                "UPDATE result_files SET damaged_at = ?
                 WHERE job = ? AND snapshot = ? AND name = ? AND sha256 = ? AND damaged_at IS NULL",
                [now, job, snapshot, name, record.sha256]
            ),
        };
        if marked.execute(self.writer()?).await?.rows_affected() > 0 {
            let file = record.name(self.dir());
            tracing::error!(
                file,
                "a stored file is missing or has other bytes than those on record"
            );
        }
        Ok(())
    }

    /// Stored files that are known to be damaged or missing.
    pub async fn damaged_files(&self) -> Result<u64> {
        let count = "SELECT (SELECT count(*) FROM blobs WHERE damaged_at IS NOT NULL)
                          + (SELECT count(*) FROM result_files WHERE damaged_at IS NOT NULL)";
        sql_as!(count, []).fetch_one(&self.readers).await
    }

    /// Compares all records with the disk, and asks SQLite whether the database is sound. Changes nothing.
    pub async fn verify(&self) -> Result<Audit> {
        let mut audit = Audit::default();
        let verdicts: Vec<String> =
            sql_as!("PRAGMA integrity_check(10)", []).fetch_all(&self.readers).await?;
        audit.database = verdicts.join("; ");
        let wrong = self.wrong_totals().await?;
        if audit.database == "ok" && !wrong.is_empty() {
            audit.database = format!(
                "running totals differ from a new sum: {}; `serve --accept-database` repairs them",
                wrong.join(", ")
            );
        }
        let mut after = None;
        while let Some(page) =
            records::next_page(&mut *self.readers.acquire().await?, &mut after).await?
        {
            for record in page {
                let path = record.path(self.dir());
                let found = on_files(move || {
                    let Some((file, meta)) = open(&path)? else { return Ok(None) };
                    Ok(Some((digest(file)?, meta.len())))
                })
                .await?;
                self.compare(&record, found, &mut audit).await?;
            }
        }
        let partials = records::partials(&mut *self.readers.acquire().await?).await?;
        for (id, received) in partials {
            let bytes = self.partial_bytes(id).await?;
            let still = records::partials(&mut *self.readers.acquire().await?).await?;
            if bytes < received && still.iter().any(|(other, _)| *other == id) {
                audit.damaged.push(format!("partial/{id}"));
            }
        }
        audit.unknown = self.unknown_things().await?;
        Ok(audit)
    }

    async fn compare(
        &self,
        record: &Record,
        found: Option<(Sha256, u64)>,
        audit: &mut Audit,
    ) -> Result<()> {
        audit.files += 1;
        audit.bytes += found.map_or(0, |(_, bytes)| bytes);
        if found.is_some_and(|(sha256, _)| sha256 == record.sha256)
            // It may have been deleted or replaced in between.
            || !records::stands(&mut *self.readers.acquire().await?, record).await?
        {
            return Ok(());
        }
        let list = if found.is_some() { &mut audit.damaged } else { &mut audit.missing };
        list.push(record.name(self.dir()));
        Ok(())
    }

    /// Looks at all stored files again and again, at most once a day, reading `rate` bytes in a second, and notes what
    /// is damaged. The position is recorded, so that a restart continues there.
    pub async fn scrub(&self, rate: u64) {
        loop {
            let pause = match self.scrub_page(rate).await {
                Ok(pause) => pause,
                Err(error) => {
                    tracing::error!(%error, "the look at the stored files was interrupted");
                    PAUSE
                }
            };
            tokio::time::sleep(pause).await;
        }
    }

    /// Looks at the next page of files; says how long to wait for the page after it.
    async fn scrub_page(&self, rate: u64) -> Result<Duration> {
        let now = Timestamp::now();
        sql!("INSERT INTO scrub (one, started_at) VALUES (1, ?) ON CONFLICT DO NOTHING", [now])
            .execute(self.writer()?)
            .await?;
        let row: (Timestamp, Option<crate::columns::Json<Place>>) =
            sql_as!("SELECT started_at, place FROM scrub").fetch_one(&self.readers).await?;
        let (started_at, place) = (row.0, row.1.map(|json| json.0));
        let page = records::page(&mut *self.readers.acquire().await?, place.as_ref()).await?;
        let Some(last) = page.last() else {
            // A clock that was set back does not hold it up for longer than a round.
            let since = Duration::from_millis(now.0.abs_diff(started_at.0));
            let left = ROUND.saturating_sub(since);
            if !left.is_zero() {
                return Ok(left.min(PAUSE));
            }
            sql!("UPDATE scrub SET started_at = ?, place = NULL", [now])
                .execute(self.writer()?)
                .await?;
            return Ok(PAUSE);
        };
        for record in &page {
            self.scrub_file(record, rate).await?;
        }
        sql!("UPDATE scrub SET place = ?", [crate::columns::Json(&last.place)])
            .execute(self.writer()?)
            .await?;
        Ok(Duration::ZERO)
    }

    async fn scrub_file(&self, record: &Record, rate: u64) -> Result<()> {
        let path = record.path(self.dir());
        let opened = on_files(move || open(&path)).await?;
        let found = match opened {
            None => None,
            Some((file, meta)) => {
                let sha256 = read_slowly(file, rate).await?;
                self.hashes.remember(Identity::of(&meta), sha256);
                Some(sha256)
            }
        };
        if found != Some(record.sha256)
            && records::stands(&mut *self.readers.acquire().await?, record).await?
        {
            self.mark(record).await?;
        }
        Ok(())
    }
}

fn result_record(job: &Job, snapshot: Option<u32>, file: &ResultFile) -> Record {
    let place = Place::Result {
        job: job.id,
        snapshot: snapshot.map_or(super::tables::results::WHOLE_JOB, i64::from),
        name: file.name.clone(),
    };
    Record { place, sha256: file.sha256 }
}

/// Hashes a file as it lies on the disk, not as the kernel remembers it, and stays below this rate. Between
/// slices it can be broken off.
async fn read_slowly(file: File, rate: u64) -> Result<Sha256> {
    // Advice alone: where it is not taken, what the kernel remembers is hashed.
    let _ = fadvise(&file, 0, None, Advice::DontNeed);
    let mut hashing = Hashing::new(file);
    loop {
        let (read, count) = hashing.advance().await?;
        hashing = read;
        if count == 0 {
            break;
        }
        #[allow(clippy::cast_precision_loss)] // a pause
        tokio::time::sleep(Duration::from_secs_f64(count as f64 / rate.max(1) as f64)).await;
    }
    let _ = fadvise(&hashing.file, 0, None, Advice::DontNeed);
    Ok(hashing.finish())
}

impl Record {
    /// True if the file at this path has the recorded hash.
    pub(super) fn is_at(&self, dir: &DataDir) -> Result<bool> {
        match open(&self.path(dir))? {
            Some((file, _)) => Ok(digest(file)? == self.sha256),
            None => Ok(false),
        }
    }
}

//! What can go wrong in the store.

use std::path::{Path, PathBuf};

use crate::job::IllegalTransition;

/// An error of the store.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// SQLite failed.
    #[error("the database failed: {0}")]
    Database(#[from] sqlx::Error),
    /// The database has another form than this version of the program knows.
    #[error("the database can't be brought up to date: {0}")]
    Migrate(#[from] sqlx::migrate::MigrateError),
    /// A file operation failed.
    #[error("can't {action} {path}: {source}", path = path.display())]
    Io {
        /// What was tried.
        action: &'static str,
        /// On what.
        path: PathBuf,
        /// Why it failed.
        source: std::io::Error,
    },
    /// A row holds what this program did not write.
    #[error("the database holds {value:?} as {column}, which can't be")]
    Corrupt {
        /// The column.
        column: &'static str,
        /// The value, as text.
        value: String,
    },
    /// There is no data folder.
    #[error("{path} is no data folder of a service", path = .0.display())]
    NoFolder(PathBuf),
    /// Another server has the folder.
    #[error(
        "another server uses {path}; stop it first, or give this one its own --data",
        path = .0.display()
    )]
    Taken(PathBuf),
    /// Database and folder do not belong together, or files are too many for the records.
    #[error("{folder}: {found}. Nothing was changed. To go on, {remedy}", folder = folder.display())]
    Refused {
        /// The folder.
        folder: PathBuf,
        /// What was found.
        found: String,
        /// What to do.
        remedy: &'static str,
    },
    /// There is no such thing.
    #[error("there is no {what} {id}")]
    NotFound {
        /// The kind of thing.
        what: &'static str,
        /// Its identifier.
        id: String,
    },
    /// The masks of a calibration are not there.
    #[error("{}", unready(*.id, .error.as_deref()))]
    Unready {
        /// The calibration.
        id: crate::job::CalibrationId,
        /// Why there will be none; none while they are made.
        error: Option<String>,
    },
    /// It can't be deleted, because something else needs it.
    #[error("the {what} is used by {users} {by}; delete those first")]
    InUse {
        /// The kind of thing.
        what: &'static str,
        /// What uses it.
        by: &'static str,
        /// How many do.
        users: u64,
    },
    /// The job is not in a state for this.
    #[error("{0}")]
    State(#[from] IllegalTransition),
    /// The job still runs.
    #[error("the job is {0}; cancel it before it is deleted")]
    NotFinal(crate::job::JobState),
    /// The bytes are not those that were named.
    #[error("the hash should be {expected}, the bytes have {found}")]
    HashMismatch {
        /// What was named.
        expected: crate::job::Sha256,
        /// What came.
        found: crate::job::Sha256,
    },
    /// Of an upload in pieces, bytes are lost that were on the disk.
    #[error(
        "{found} bytes of upload {id} are on the disk, fewer than the {recorded} on record: delete it \
         and send the file again"
    )]
    Short {
        /// The upload.
        id: crate::job::PartialId,
        /// Bytes that are there.
        found: u64,
        /// Bytes that should be.
        recorded: u64,
    },
    /// No more jobs are taken before some have ended.
    #[error("{jobs} jobs wait or run, and no more than {most} may")]
    QueueFull {
        /// Jobs that have not ended.
        jobs: u64,
        /// How many there may be.
        most: u64,
    },
    /// The key was used for another request.
    #[error("the Idempotency-Key {key:?} was used for another request, which made job {job}")]
    KeyReused {
        /// The key.
        key: String,
        /// The job made with it.
        job: crate::job::JobId,
    },
    /// A task that blocks was broken off, as at shutdown.
    #[error("the work was broken off")]
    Interrupted,
}

fn unready(id: crate::job::CalibrationId, error: Option<&str>) -> String {
    match error {
        None => {
            format!("the masks of calibration {id} are still being made; ask again in a moment")
        }
        Some(error) => format!("calibration {id} has failed: {error}"),
    }
}

impl StoreError {
    /// There is no such thing of this kind.
    pub(super) fn missing(what: &'static str, id: impl ToString) -> Self {
        Self::NotFound { what, id: id.to_string() }
    }

    /// Wraps an I/O error with what was tried on what.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }

    /// True if the disk is full or a quota is used up.
    #[must_use]
    pub fn is_disk_full(&self) -> bool {
        use std::io::ErrorKind::{QuotaExceeded, StorageFull};
        match self {
            Self::Io { source, .. } => matches!(source.kind(), StorageFull | QuotaExceeded),
            // SQLITE_FULL
            Self::Database(sqlx::Error::Database(error)) => error.code().as_deref() == Some("13"),
            _ => false,
        }
    }
}

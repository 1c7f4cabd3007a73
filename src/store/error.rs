//! What can go wrong in the store.

use std::path::{Path, PathBuf};

use crate::job::IllegalTransition;

pub type Result<T, E = StoreError> = std::result::Result<T, E>;

#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    #[error("the database failed: {0}")]
    Database(#[from] sqlx::Error),
    #[error("the database can't be brought up to date: {0}")]
    Migrate(#[from] sqlx::migrate::MigrateError),
    #[error(
        "the database can't be brought up to date: {error}. Its copy from before is {copy}; the version \
         before serves it (docs/operations.md, upgrade and rollback)",
        copy = copy.display()
    )]
    Upgrade { error: sqlx::migrate::MigrateError, copy: PathBuf },
    #[error(
        "{folder}: the database was brought up to date by version {by} (schema {found}); this is version \
         {own} (schema {schema}). Nothing was changed. To go on, start that version again, or go back{copy} \
         (docs/operations.md, upgrade and rollback)",
        folder = folder.display(),
        own = env!("CARGO_PKG_VERSION"),
        copy = copy.as_ref().map_or(String::new(), |path| format!(" to {}", path.display()))
    )]
    Newer {
        folder: PathBuf,
        /// The version that wrote the marker.
        by: String,
        found: i64,
        schema: i64,
        /// The last copy from before that this program can serve.
        copy: Option<PathBuf>,
    },
    #[error("can't {action} {path}: {source}", path = path.display())]
    Io { action: &'static str, path: PathBuf, source: std::io::Error },
    #[error("the database holds {value:?} as {column}, which can't be")]
    Corrupt { column: &'static str, value: String },
    #[error("{path} is no data folder of a service", path = .0.display())]
    NoFolder(PathBuf),
    #[error(
        "another server uses {path}; stop it first, or give this one its own --data",
        path = .0.display()
    )]
    Taken(PathBuf),
    #[error("{folder}: {found}. Nothing was changed. To go on, {remedy}", folder = folder.display())]
    Refused { folder: PathBuf, found: String, remedy: &'static str },
    #[error("there is no {what} {id}")]
    NotFound { what: &'static str, id: String },
    #[error("{}", unready(*.id, .error.as_deref()))]
    Unready {
        id: crate::job::CalibrationId,
        /// Why there will be none; none while they are made.
        error: Option<String>,
    },
    #[error("the {what} is used by {users} {by}; delete those first")]
    InUse { what: &'static str, by: &'static str, users: u64 },
    #[error("a calibration, a measurement or a model needs the file {0}; delete that first")]
    FileInUse(crate::job::Sha256),
    #[error("{0}")]
    State(#[from] IllegalTransition),
    #[error("the job is {0}; cancel it before it is deleted")]
    NotFinal(crate::job::JobState),
    #[error("the job is {0}: its priority no longer matters")]
    Ended(crate::job::JobState),
    #[error("the hash should be {expected}, the bytes have {found}")]
    HashMismatch { expected: crate::job::Sha256, found: crate::job::Sha256 },
    /// Of an upload in pieces, bytes are lost that were on the disk.
    #[error(
        "{found} bytes of upload {id} are on the disk, fewer than the {recorded} on record: delete it \
         and send the file again"
    )]
    Short { id: crate::job::PartialId, found: u64, recorded: u64 },
    #[error("{jobs} jobs wait or run, and no more than {most} may")]
    QueueFull { jobs: u64, most: u64 },
    #[error("the Idempotency-Key {key:?} was used for another request, which made {what} {id}")]
    KeyReused { key: String, what: &'static str, id: String },
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

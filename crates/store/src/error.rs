//! Errors of the store.

use std::path::{Path, PathBuf};
use std::time::Duration;

use engine::job::IllegalTransition;
use formats::DiskTrouble;

/// Longest wait of a change for another connection that holds the lock of the database.
pub(crate) const BUSY_TIMEOUT: Duration = Duration::from_secs(15);

/// Result codes of SQLite.
const BUSY: u32 = 5;
const LOCKED: u32 = 6;
const READ_ONLY: u32 = 8;
const DAMAGED: u32 = 11;
const FULL: u32 = 13;
const NO_DATABASE: u32 = 26;

pub type Result<T, E = StoreError> = std::result::Result<T, E>;

#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    #[error("{}", database_failure(.0))]
    Database(#[from] sqlx::Error),
    #[error("the database can't be brought up to date: {0}")]
    Migrate(#[from] sqlx::migrate::MigrateError),
    #[error(
        "the database can't be brought up to date: {error}. Its copy from before is {copy}; the version \
         before serves it (docs/OPERATIONS.md, section Update and roll back)",
        copy = copy.display()
    )]
    Upgrade { error: sqlx::migrate::MigrateError, copy: PathBuf },
    #[error(
        "{folder}: the database was brought up to date by version {by} (schema {found}); this is version \
         {own} (schema {schema}). Nothing was changed. To go on, start that version again, or go back{copy} \
         (docs/OPERATIONS.md, section Update and roll back)",
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
    /// Changes of the open database would be lost.
    #[error(
        "{path} was removed, replaced or truncated while the service runs, so nothing is changed: stop the service, \
         and put the database back with its -wal file, or serve a backup",
        path = .0.display()
    )]
    DatabaseGone(PathBuf),
    #[error("there is no {what} {id}")]
    NotFound { what: &'static str, id: String },
    #[error("{what} {id} {}", not_ready(.error.as_deref()))]
    NotReady {
        /// A calibration or a measurement.
        what: &'static str,
        id: String,
        /// Why it did not pass its check; none while it is checked or made.
        error: Option<String>,
    },
    #[error("the {what} is used by {users} {by}; delete those first")]
    InUse { what: &'static str, by: &'static str, users: u64 },
    #[error(
        "calibration {0} is being made from the job; wait until it is made, or delete it first"
    )]
    JobInUse(engine::job::CalibrationId),
    #[error("a calibration, a measurement or a model needs the file {0}; delete that first")]
    FileInUse(engine::job::Sha256),
    #[error("{0}")]
    State(#[from] IllegalTransition),
    #[error("the job is {0}; cancel it before it is deleted")]
    NotFinal(engine::job::JobState),
    #[error("the job is {0}: its priority no longer matters")]
    Ended(engine::job::JobState),
    #[error("the hash should be {expected}, the bytes have {found}")]
    HashMismatch { expected: engine::job::Sha256, found: engine::job::Sha256 },
    /// An upload in pieces has lost recorded bytes.
    #[error(
        "{found} bytes of upload {id} are on the disk, fewer than the {recorded} on record: delete it \
         and send the file again"
    )]
    Short { id: engine::job::PartialId, found: u64, recorded: u64 },
    /// A stored file is missing or differs from its recorded hash.
    #[error("the {what} {name} is damaged on the disk of the service; {}", if *what == "result" {
        "retry its job, and it is made again"
    } else {
        "send it, or what it was made of, again"
    })]
    Damaged { what: &'static str, name: String },
    /// The data changed faster than they could be written out.
    #[error(
        "in {0} tries no moment was found at which nothing was deleted; try again when less is done"
    )]
    Restless(u32),
    #[error("{jobs} jobs {whose}wait or run, and no more than {most} may")]
    QueueFull { whose: &'static str, jobs: u64, most: u64 },
    #[error("it needs {needed} bytes, and the {whose} keeps {kept} of the {limit} it may")]
    Quota { whose: &'static str, kept: u64, needed: u64, limit: u64 },
    /// A lab has enough incomplete uploads. The first of them expires in `seconds`.
    #[error("{uploads} uploads of this lab are not complete; end some before another is begun")]
    ManyPartials { uploads: u64, seconds: f64 },
    /// A lab has enough checks that wait or run. One of them takes about `seconds`.
    #[error("{checks} files of this lab wait to be checked; try again when some are done")]
    ManyChecks { checks: u64, seconds: f64 },
    /// The disk has no room for something that is about to be written.
    #[error(
        "{what} needs {needed} bytes; {free} are free, of which {promised} are promised to others and {reserve} \
         are kept in reserve"
    )]
    NoRoom { what: &'static str, needed: u64, free: u64, promised: u64, reserve: u64 },
    /// The lab has reserved its share of the disk.
    #[error(
        "{what} needs {needed} bytes; this lab has reserved {own}, and may reserve {share}, half of the bytes that \
         other labs leave free: wait until some of its jobs are done, or select fewer snapshots"
    )]
    NoShare { what: &'static str, needed: u64, own: u64, share: u64 },
    #[error("the Idempotency-Key {key:?} was used for another request, which made {what} {id}")]
    KeyReused { key: String, what: &'static str, id: String },
    /// A task that blocks was broken off, as at shutdown.
    #[error("the work was broken off")]
    Interrupted,
}

/// The primary code of SQLite, whose reason is in the upper bits.
fn sqlite_code(error: &sqlx::Error) -> Option<u32> {
    let sqlx::Error::Database(error) = error else { return None };
    Some(error.code()?.parse::<u32>().ok()? & 0xff)
}

fn database_failure(error: &sqlx::Error) -> String {
    match sqlite_code(error) {
        Some(DAMAGED | NO_DATABASE) => format!(
            "the database is damaged ({error}): stop the service and serve a backup (docs/OPERATIONS.md, section \
             Back up and restore)"
        ),
        Some(FULL) => {
            "the disk is full, so the database can't be changed: delete jobs or other files"
                .to_owned()
        }
        _ => format!("the database failed: {error}"),
    }
}

fn not_ready(error: Option<&str>) -> String {
    match error {
        None => "is still being made or checked; ask again in a moment".to_owned(),
        Some(error) => format!("has failed: {error}"),
    }
}

impl StoreError {
    /// The error for an identifier that does not exist.
    pub(super) fn missing(what: &'static str, id: impl ToString) -> Self {
        Self::NotFound { what, id: id.to_string() }
    }

    /// Adds the action and the path to an I/O error.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }

    /// True if others had the database for too long.
    pub fn is_busy(&self) -> bool {
        match self {
            Self::Database(sqlx::Error::PoolTimedOut) => true,
            Self::Database(error) => matches!(sqlite_code(error), Some(BUSY | LOCKED)),
            _ => false,
        }
    }

    /// Estimated seconds after which the same request may succeed.
    pub fn retry_seconds(&self) -> Option<f64> {
        match self {
            Self::ManyPartials { seconds, .. } | Self::ManyChecks { seconds, .. } => Some(*seconds),
            // The lock has been held for that long, and is expected to be held as long again.
            busy if busy.is_busy() => Some(BUSY_TIMEOUT.as_secs_f64()),
            _ => None,
        }
    }

    /// True if SQLite has found damage in the database.
    pub fn is_damage(&self) -> bool {
        matches!(self, Self::Database(error) if matches!(sqlite_code(error), Some(DAMAGED | NO_DATABASE)))
    }

    /// The state of the disk that is the cause, if it is.
    pub fn disk_trouble(&self) -> Option<DiskTrouble> {
        match self {
            Self::Io { source, .. } => DiskTrouble::of(source),
            Self::Database(sqlx::Error::Database(error)) => {
                match error.code()?.parse::<u32>().ok()? {
                    FULL => Some(DiskTrouble::Full),
                    // The last two are the errors of SQLite for a write (SQLITE_IOERR_WRITE) or a sync
                    // (SQLITE_IOERR_FSYNC) that a read-only file system refuses.
                    code if code & 0xff == READ_ONLY || matches!(code, 778 | 1034) => {
                        Some(DiskTrouble::ReadOnly)
                    }
                    _ => None,
                }
            }
            _ => None,
        }
    }
}

//! All that lasts: SQLite for the records, content-addressed files for the arrays.
//!
//! The server and every worker process open the same folder. Files move under the writer's lock of the database. So a
//! file and its row stay together when two processes work on the same content: the database is the only mutex of the
//! service. No transaction is open while anything is computed or uploaded.
//!
//! Requests go through `submit` to the `queue`, and from there to the `tables`. Nothing goes the other way.
//!
//! # Errors
//! Every function that asks the database fails if the database does, and every one that changes files
//! fails if the disk does ([`StoreError`]). What a lab has nothing under is `NotFound`, and what others
//! refer to is not deleted (`InUse`). Their descriptions name only what else can go wrong.

use crate::columns::{sql, sql_as};
use crate::error::{BUSY_TIMEOUT, Result};
mod backup;
mod cleaning;
mod clock;
mod columns;
mod database_file;
mod deletion;
mod dir;
mod error;
mod hashes;
mod identity;
mod integrity;
mod locked;
mod migrations;
mod queue;
mod records;
mod removal;
mod rows;
mod staging;
mod submit;
mod tables;
#[cfg(test)]
mod tests;
mod upgrade;
mod watch;

use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use sqlx::sqlite::{
    Sqlite, SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous,
};
use sqlx::{Connection, SqlitePool};

pub use backup::Backup;
pub(crate) use dir::on_files;
pub use dir::{DataDir, Reserved};
pub use error::StoreError;
pub use identity::Purpose;
pub use integrity::Audit;
pub use locked::LockedFile;
use migrations::Schema;
pub use queue::{
    Begun, CalibrationDone, CalibrationTask, CheckTask, Checked, ClaimedTask, Completion, Estimate,
    Heartbeat, JobProgress, JobTask, Lease, MAX_FAILURES, MAX_LOSSES, MAX_STARVED, MessagePlace,
    Movie, MovieWork, Product, ProgressStage, RemoteBeat, RemoteTask, Work, WorkerEnd,
};
pub use rows::{Expired, Filter, Page, Span};
pub use staging::{BlobWriter, StagedBlob, StagedDir, StagedPath};
pub use submit::{NewJob, NewRequest};
pub use tables::{
    Blob, BlobRow, Calibration, Change, Changes, Claimant, Delivery, Entitlement, FIRST_RESERVE,
    FailedTask, FailureCause, FoundPartial, FoundResource, Inserted, Job, JobChanges, JobFilter,
    LabFigures, LabRow, LabUse, Measurement, Model, NewCalibration, NewMeasurement, NewModel,
    NewPartial, Notification, Origin, Partial, PartialFile, ReadyResource, Request, RequestKey,
    Reservations, Resource, ResourceKind, TaskCounts, TaskRecord, TaskTotals, TileHistory,
    TileResult, TileState, Token, WorkerPlace, WorkerRow, WorkerTask, share_error,
};
pub use watch::Watcher;

/// The store: a handle that is cheap to clone.
#[derive(Debug, Clone)]
pub struct Store {
    dir: DataDir,
    /// One connection: within a process, writers wait for each other here and not in SQLite.
    writer: SqlitePool,
    readers: SqlitePool,
    forecasts: Arc<queue::Forecasts>,
    /// Hashes of files that were read before they were handed out.
    hashes: Arc<hashes::Hashes>,
    removals: removal::Removals,
    /// The files of the open database.
    files: database_file::DatabaseFiles,
    /// Damage of the database that the last check found.
    damage: Arc<Mutex<Option<String>>>,
    /// The number of the newest migration.
    schema: i64,
    /// The lock of the server, if this is its store.
    _server: Option<Arc<LockedFile>>,
}

/// A transaction that holds the writer's lock from its start, so that it can't fail half-way
/// because another process began to write.
pub(crate) type WriteTransaction = sqlx::Transaction<'static, Sqlite>;

impl Store {
    /// Opens the store in `root`.
    /// Errors: if the folder is none, is another server's, or does not belong to its database; if
    /// it can't be written; or if a newer version of this program has changed the database.
    pub async fn open(root: &Path, purpose: Purpose) -> Result<Self> {
        Self::open_with(root, purpose, &Schema::current()).await
    }

    async fn open_with(root: &Path, purpose: Purpose, schema: &Schema) -> Result<Self> {
        let serves = purpose != Purpose::Use;
        let dir = if serves { DataDir::create(root)? } else { DataDir::find(root)? };
        let server = if serves { Some(Arc::new(dir.lock_server()?)) } else { None };
        if serves && dir.is_full()? {
            dir.give_up_reserve()?;
        }
        if !serves {
            dir.check_files_of_server()?;
        }
        identity::check(&dir, purpose, schema.newest()).await?;
        dir.fill()?;
        let copy = if serves { upgrade::save(&dir, schema.newest()).await? } else { None };
        let options = SqliteConnectOptions::new()
            .filename(dir.database())
            .create_if_missing(serves)
            .foreign_keys(true)
            .busy_timeout(BUSY_TIMEOUT)
            .journal_mode(SqliteJournalMode::Wal)
            // Rows of jobs and tasks have one to two kilobytes. In smaller pages they would overflow.
            .page_size(8192)
            // A worker may write to the data folder alone, and not where SQLite puts its temporary files.
            .pragma("temp_store", "memory")
            // NORMAL survives a killed process, but a power cut could take back the last commits,
            // and an answered request must not be lost. Commits are few (a heartbeat of each
            // worker every two seconds), so a sync for each costs nothing that is felt.
            .synchronous(SqliteSynchronous::Full);
        let writer = SqlitePoolOptions::new()
            .max_connections(1)
            .idle_timeout(None)
            // After a disk that was read-only for a moment a connection may stay read-only.
            .max_lifetime(Duration::from_secs(10))
            // After some errors, such as a full disk, SQLite has rolled back already. sqlx then fails to roll back
            // again and takes the transaction for open.
            .before_acquire(|connection, _| Box::pin(async { Ok(!connection.is_in_transaction()) }))
            .connect_with(options.clone());
        let writer = writer.await?;
        // A connection that is made later must not create a database where the file is missing.
        let options = options.create_if_missing(false);
        writer.set_connect_options(options.clone());
        schema.apply(&writer).await.map_err(|error| match copy {
            Some(copy) => StoreError::Upgrade { error, copy },
            None => error.into(),
        })?;
        let readers = SqlitePoolOptions::new()
            .max_connections(4)
            .idle_timeout(None)
            .max_lifetime(None)
            .connect_with(options.read_only(true))
            .await?;
        let files = database_file::DatabaseFiles::open(&dir.database())?;
        if let Some(lock) = &server {
            dir.record_files(lock, &files)?;
        }
        let store = Self {
            dir,
            writer,
            readers,
            forecasts: Arc::default(),
            hashes: Arc::default(),
            removals: removal::Removals::default(),
            files,
            damage: Arc::default(),
            schema: schema.newest(),
            _server: server,
        };
        if serves {
            for path in [store.dir.root().to_owned(), store.dir.database()] {
                if let Err(error) = dir::restrict(&path) {
                    tracing::warn!(%error, "others may look into the data");
                }
            }
            store.note_time(Duration::ZERO).await?;
            identity::settle(&store.dir, &mut *store.writer()?.acquire().await?).await?;
            store.write_marker().await?;
            if purpose == (Purpose::Serve { accept_database: true }) {
                store.recount_totals().await?;
            }
            store.advance_generation().await?;
        }
        Ok(store)
    }

    /// Lets the database and the marker be newer than all copies of them; see `identity.rs`.
    pub async fn advance_generation(&self) -> Result<()> {
        sql!("UPDATE folder SET generation = generation + 1").execute(self.writer()?).await?;
        self.write_marker().await
    }

    async fn write_marker(&self) -> Result<()> {
        let marker = identity::marker(&mut *self.writer()?.acquire().await?, self.schema).await?;
        let (root, draft) = (self.dir.root().to_owned(), self.temporary_path());
        on_files(move || identity::write(&root, &draft, &marker)).await
    }

    pub fn dir(&self) -> &DataDir {
        &self.dir
    }

    /// Waits for running statements and removals, and closes all connections.
    pub async fn close(&self) {
        self.removals.finished().await;
        self.readers.close().await;
        self.writer.close().await;
    }

    /// Gives up the reserve of a full disk, so that a deletion can be tried again. False if there is none.
    pub async fn give_up_reserve(&self) -> Result<bool> {
        let dir = self.dir.clone();
        on_files(move || dir.give_up_reserve()).await
    }

    /// Asks the database for an answer.
    pub async fn ping(&self) -> Result<()> {
        sql!("SELECT count(*) FROM workers").fetch_one(&self.readers).await?;
        Ok(())
    }

    /// Has SQLite look for damage in the whole database, and remembers what it says.
    pub async fn look_at_database(&self) -> Result<()> {
        let verdict: String = sql_as!("PRAGMA quick_check(1)").fetch_one(&self.readers).await?;
        let damage = Some(verdict).filter(|verdict| verdict != "ok");
        if let Some(damage) = &damage {
            tracing::error!(damage, "the database is damaged");
        }
        *self.damage.lock().unwrap_or_else(PoisonError::into_inner) = damage;
        Ok(())
    }

    /// Damage of the database, if the last check found any.
    pub fn database_damage(&self) -> Option<String> {
        self.damage.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Tries whether the database can be changed, and files can be made and written.
    pub async fn try_disk(&self) -> Result<()> {
        match self.try_change().await {
            Err(error) if !error.is_busy() => return Err(error),
            _ => {}
        }
        let (store, byte) = (self.clone(), b"?");
        on_files(move || {
            let mut file = store.blob_writer()?;
            let written = std::io::Write::write_all(&mut file, byte);
            written.map_err(StoreError::io("write to", &store.dir().tmp()))?;
            // Dropped, and so removed.
            file.finish().map(|_| ())
        })
        .await
    }

    async fn try_change(&self) -> Result<()> {
        let mut transaction = self.write().await?;
        sql!("UPDATE folder SET generation = generation").execute(&mut *transaction).await?;
        Ok(transaction.rollback().await?)
    }

    /// Errors: [`StoreError::DatabaseGone`] if a file of the database was removed, replaced or truncated since it was opened.
    pub fn check_database_file(&self) -> Result<()> {
        self.files.check(&self.dir.database())
    }

    /// The connection for changes. Changes of a removed file would be lost, so they are refused.
    /// Errors: [`StoreError::DatabaseGone`].
    pub(crate) fn writer(&self) -> Result<&SqlitePool> {
        self.check_database_file()?;
        Ok(&self.writer)
    }

    pub(crate) async fn write(&self) -> Result<WriteTransaction> {
        Ok(self.writer()?.begin_with("BEGIN IMMEDIATE").await?)
    }
}

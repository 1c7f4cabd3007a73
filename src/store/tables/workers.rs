//! Table `workers`: which worker processes live.

use std::time::Duration;

use serde::Serialize;
use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use crate::job::{CalibrationId, JobId, TaskState, Timestamp, WorkerId};
use crate::store::Store;
use crate::store::error::StoreError;
use crate::store::rows::{number, number_if, parsed, parsed_if};

/// A worker process on record.
#[derive(Debug, Clone, Serialize)]
pub struct WorkerRow {
    /// Its identifier.
    pub id: WorkerId,
    /// Its process.
    pub pid: u32,
    /// The version of its program.
    pub version: String,
    /// When it started.
    pub started_at: Timestamp,
    /// Its last sign of life.
    pub seen_at: Timestamp,
    /// What it has in hand.
    pub task: Option<WorkerTask>,
}

/// A task in a worker's hands.
#[derive(Debug, Clone, Serialize)]
pub struct WorkerTask {
    /// The job; none for a calibration's.
    pub job: Option<JobId>,
    /// The calibration; none for a job's.
    pub calibration: Option<CalibrationId>,
    /// The kind of task.
    pub kind: String,
    /// The snapshot, if it is about one.
    pub snapshot: Option<u32>,
    /// The tile, if it is one.
    pub tile: Option<u32>,
    /// What it is doing.
    pub stage: Option<String>,
}

impl Store {
    /// Records that a worker has started.
    pub async fn worker_started(&self, id: WorkerId, pid: u32) -> Result<(), StoreError> {
        let now = Timestamp::now().0;
        sqlx::query(
            "INSERT INTO workers (id, pid, version, started_at, seen_at) VALUES (?, ?, ?, ?, ?)
             ON CONFLICT (id) DO UPDATE SET seen_at = excluded.seen_at",
        )
        .bind(id.to_string())
        .bind(i64::from(pid))
        .bind(env!("CARGO_PKG_VERSION"))
        .bind(now)
        .bind(now)
        .execute(&self.writer)
        .await?;
        Ok(())
    }

    /// Records that a worker lives though it has no task; a heartbeat says the same of one that has.
    pub async fn worker_seen(&self, id: WorkerId) -> Result<(), StoreError> {
        seen(&mut *self.writer.acquire().await?, id).await
    }

    /// The workers that gave a sign of life within `age`.
    pub async fn live_workers(&self, age: Duration) -> Result<Vec<WorkerRow>, StoreError> {
        let rows = sqlx::query(
            "SELECT workers.id, pid, version, started_at, seen_at, job, calibration, kind, snapshot, tile, stage
             FROM workers LEFT JOIN tasks ON worker = workers.id AND state = ?
             WHERE seen_at >= ? ORDER BY workers.id",
        )
        .bind(TaskState::Running.name())
        .bind(since(age))
        .fetch_all(&self.readers)
        .await?;
        rows.iter().map(worker).collect()
    }

    /// The last sign of life of a worker; none if it is not on record.
    pub async fn last_sign(&self, id: WorkerId) -> Result<Option<Timestamp>, StoreError> {
        let row = sqlx::query("SELECT seen_at FROM workers WHERE id = ?")
            .bind(id.to_string())
            .fetch_optional(&self.readers)
            .await?;
        row.map(|row| Ok(Timestamp(row.try_get("seen_at")?))).transpose()
    }

    /// Forgets the workers that gave no sign of life within `age`: nobody saw their end.
    pub async fn forget_workers(&self, age: Duration) -> Result<(), StoreError> {
        sqlx::query("DELETE FROM workers WHERE seen_at < ?")
            .bind(since(age))
            .execute(&self.writer)
            .await?;
        Ok(())
    }
}

/// Forgets a worker that has ended.
pub(in crate::store) async fn remove(
    connection: &mut SqliteConnection,
    id: WorkerId,
) -> Result<(), StoreError> {
    sqlx::query("DELETE FROM workers WHERE id = ?")
        .bind(id.to_string())
        .execute(connection)
        .await?;
    Ok(())
}

/// Notes a sign of life.
pub(in crate::store) async fn seen(
    connection: &mut SqliteConnection,
    id: WorkerId,
) -> Result<(), StoreError> {
    sqlx::query("UPDATE workers SET seen_at = ? WHERE id = ?")
        .bind(Timestamp::now().0)
        .bind(id.to_string())
        .execute(connection)
        .await?;
    Ok(())
}

fn since(age: Duration) -> i64 {
    Timestamp::now().0 - i64::try_from(age.as_millis()).unwrap_or(i64::MAX / 2)
}

fn worker(row: &SqliteRow) -> Result<WorkerRow, StoreError> {
    Ok(WorkerRow {
        id: parsed(row, "id")?,
        pid: number(row, "pid")?,
        version: row.try_get("version")?,
        started_at: Timestamp(row.try_get("started_at")?),
        seen_at: Timestamp(row.try_get("seen_at")?),
        task: row.try_get::<Option<_>, _>("kind")?.map(|kind| task(row, kind)).transpose()?,
    })
}

fn task(row: &SqliteRow, kind: String) -> Result<WorkerTask, StoreError> {
    Ok(WorkerTask {
        job: parsed_if(row, "job")?,
        calibration: parsed_if(row, "calibration")?,
        kind,
        snapshot: number_if(row, "snapshot")?,
        tile: number_if(row, "tile")?,
        stage: row.try_get("stage")?,
    })
}

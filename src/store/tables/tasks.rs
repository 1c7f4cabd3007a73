//! Table `tasks`: what they are, what they have made, and how they go. Only the queue changes it.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::Serialize;
use serde_json::Value;
use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use crate::job::{CalibrationId, JobId, Sha256, TaskKind, TaskState};
use crate::store::Store;
use crate::store::error::StoreError;
use crate::store::rows::{json, number, number_if, parsed, parsed_if};

/// What a task belongs to, and goes with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::store) enum Owner {
    Job(JobId),
    Calibration(CalibrationId),
}

/// The stored result of a tile.
#[derive(Debug, Clone)]
pub struct TileResult {
    /// The tile's index in the plan.
    pub tile: u32,
    /// Where its file lies.
    pub path: PathBuf,
    /// The hash that the file should have.
    pub sha256: Sha256,
    /// What the worker told about it.
    pub record: Value,
}

/// What is known of a task that is done.
#[derive(Debug, Clone)]
pub struct TaskRecord {
    /// What it was.
    pub kind: TaskKind,
    /// What the worker told about it.
    pub record: Value,
    /// Seconds of the successful attempt.
    pub seconds: f64,
    /// The number of the successful attempt, from 1.
    pub attempt: u32,
}

/// A tile as it is worked on.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TileState {
    /// Its index in the plan.
    pub tile: u32,
    /// State of its task.
    pub state: TaskState,
    /// What its worker is doing.
    pub stage: Option<String>,
    /// Iterations of the attempt that runs or ran last.
    pub iterations: u32,
    /// Deep passes of that attempt.
    pub passes: u32,
    /// The share of the planned cost that is behind it.
    pub fraction: f64,
    /// How often workers took it up.
    pub attempts: u32,
    /// `||y - H v|| / ||y||` of a tile that is done.
    pub residual: Option<f64>,
}

/// How the solver went on a tile.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TileHistory {
    /// The tile's index in the plan.
    pub tile: u32,
    /// State of its task.
    pub state: TaskState,
    /// \[iteration, residual, change, sigma or null\], by iteration; many iterations are thinned out.
    pub points: Vec<Value>,
}

/// What has been done in all by tasks of a kind, those of deleted jobs with them.
#[derive(Debug, Clone, PartialEq)]
pub struct TaskTotals {
    /// The kind of task.
    pub kind: String,
    /// Tasks done.
    pub tasks: u64,
    /// Seconds of their successful attempts.
    pub seconds: f64,
    /// Solver iterations.
    pub iterations: u64,
    /// Passes of the deep denoiser.
    pub passes: u64,
}

/// Numbers of tasks by kind and state.
pub type TaskCounts = BTreeMap<(String, TaskState), u64>;

impl Store {
    /// The stored preview of a snapshot, while there is one: a prepared array of coarse frames.
    pub async fn preview(
        &self,
        job: JobId,
        snapshot: u32,
    ) -> Result<Option<(Sha256, PathBuf)>, StoreError> {
        let row = sqlx::query(
            "SELECT result FROM tasks
             WHERE job = ? AND kind = 'preview' AND snapshot = ? AND result IS NOT NULL",
        )
        .bind(job.to_string())
        .bind(snapshot)
        .fetch_optional(&self.readers)
        .await?;
        let Some(row) = row else { return Ok(None) };
        let sha256 = parsed(&row, "result")?;
        Ok(Some((sha256, self.dir().blob(&sha256))))
    }

    /// The stored tiles of a snapshot, in the order of the plan. The job's assembly has the right to
    /// count on all of them being there.
    pub async fn tile_results(
        &self,
        job: JobId,
        snapshot: u32,
    ) -> Result<Vec<TileResult>, StoreError> {
        let rows = sqlx::query(
            "SELECT tile, result, record FROM tasks
             WHERE job = ? AND kind = 'tile' AND snapshot = ? AND state = ? ORDER BY tile",
        )
        .bind(job.to_string())
        .bind(snapshot)
        .bind(TaskState::Done.name())
        .fetch_all(&self.readers)
        .await?;
        let read = |row: &SqliteRow| {
            let sha256 = parsed(row, "result")?;
            Ok(TileResult {
                tile: number(row, "tile")?,
                path: self.dir().blob(&sha256),
                sha256,
                record: json(row, "record")?,
            })
        };
        rows.iter().map(read).collect()
    }

    /// What is known of all tasks of a job that are done, in order.
    pub async fn task_records(&self, job: JobId) -> Result<Vec<TaskRecord>, StoreError> {
        let rows = sqlx::query(
            "SELECT kind, snapshot, tile, record, seconds, attempt FROM tasks
             WHERE job = ? AND state = ? ORDER BY ordinal",
        )
        .bind(job.to_string())
        .bind(TaskState::Done.name())
        .fetch_all(&self.readers)
        .await?;
        let read = |row: &SqliteRow| {
            Ok(TaskRecord {
                kind: kind(row)?,
                record: json(row, "record")?,
                seconds: row.try_get::<Option<f64>, _>("seconds")?.unwrap_or(0.0),
                attempt: number(row, "attempt")?,
            })
        };
        rows.iter().map(read).collect()
    }

    /// The tiles of a snapshot, in the order of the plan.
    pub async fn tile_states(
        &self,
        job: JobId,
        snapshot: u32,
    ) -> Result<Vec<TileState>, StoreError> {
        let rows = sqlx::query(
            "SELECT tile, state, stage, iterations, passes, fraction, attempt,
                 CASE state WHEN ? THEN record ->> 'residual' END AS residual
             FROM tasks WHERE job = ? AND kind = 'tile' AND snapshot = ? ORDER BY tile",
        )
        .bind(TaskState::Done.name())
        .bind(job.to_string())
        .bind(snapshot)
        .fetch_all(&self.readers)
        .await?;
        let read = |row: &SqliteRow| {
            Ok(TileState {
                tile: number(row, "tile")?,
                state: parsed(row, "state")?,
                stage: row.try_get("stage")?,
                iterations: number(row, "iterations")?,
                passes: number(row, "passes")?,
                fraction: row.try_get("fraction")?,
                attempts: number(row, "attempt")?,
                residual: row.try_get("residual")?,
            })
        };
        rows.iter().map(read).collect()
    }

    /// How the solver went on a tile; none if there is no such tile.
    pub async fn tile_history(
        &self,
        job: JobId,
        snapshot: u32,
        tile: u32,
    ) -> Result<Option<TileHistory>, StoreError> {
        let row = sqlx::query(
            "SELECT tile, state, coalesce(history, '[]') AS history
             FROM tasks WHERE job = ? AND kind = 'tile' AND snapshot = ? AND tile = ?",
        )
        .bind(job.to_string())
        .bind(snapshot)
        .bind(tile)
        .fetch_optional(&self.readers)
        .await?;
        let read = |row: &SqliteRow| {
            let (tile, state) = (number(row, "tile")?, parsed(row, "state")?);
            Ok(TileHistory { tile, state, points: json(row, "history")? })
        };
        row.as_ref().map(read).transpose()
    }

    /// Version of ONNX Runtime that the last worker told that finished a tile with it; none before.
    pub async fn last_onnxruntime(&self) -> Result<Option<String>, StoreError> {
        let row = sqlx::query(
            "SELECT record ->> 'onnxruntime' AS version FROM tasks
             WHERE state = ? AND kind = 'tile' AND record ->> 'onnxruntime' IS NOT NULL
             ORDER BY job DESC LIMIT 1",
        )
        .bind(TaskState::Done.name())
        .fetch_optional(&self.readers)
        .await?;
        row.map(|row| row.try_get("version").map_err(StoreError::from)).transpose()
    }

    /// What has been done in all, by kind of task.
    pub async fn totals(&self) -> Result<Vec<TaskTotals>, StoreError> {
        let rows =
            sqlx::query("SELECT * FROM totals ORDER BY kind").fetch_all(&self.readers).await?;
        let read = |row: &SqliteRow| {
            Ok(TaskTotals {
                kind: row.try_get("kind")?,
                tasks: number(row, "tasks")?,
                seconds: row.try_get("seconds")?,
                iterations: number(row, "iterations")?,
                passes: number(row, "passes")?,
            })
        };
        rows.iter().map(read).collect()
    }

    /// The number of tasks by kind and state, with zeros for what there is none of.
    pub async fn task_counts(&self) -> Result<TaskCounts, StoreError> {
        let rows = sqlx::query("SELECT kind, state, count(*) AS n FROM tasks GROUP BY kind, state")
            .fetch_all(&self.readers)
            .await?;
        let mut counts = TaskCounts::new();
        for kind in TaskKind::NAMES {
            counts.extend(TaskState::ALL.map(|state| ((kind.to_owned(), state), 0)));
        }
        for row in &rows {
            counts.insert((row.try_get("kind")?, parsed(row, "state")?), number(row, "n")?);
        }
        Ok(counts)
    }
}

/// The kind of the task in this row.
pub(in crate::store) fn kind(row: &SqliteRow) -> Result<TaskKind, StoreError> {
    let name: String = row.try_get("kind")?;
    TaskKind::from_parts(&name, number_if(row, "snapshot")?, number_if(row, "tile")?)
        .ok_or(StoreError::Corrupt { column: "kind", value: name })
}

/// What the task in this row belongs to.
pub(in crate::store) fn owner(row: &SqliteRow) -> Result<Owner, StoreError> {
    match parsed_if(row, "job")? {
        Some(job) => Ok(Owner::Job(job)),
        None => parsed(row, "calibration").map(Owner::Calibration),
    }
}

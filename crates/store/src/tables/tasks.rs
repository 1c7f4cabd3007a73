//! Table `tasks`: their kinds, products and progress. Only the queue changes it.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::Serialize;
use serde_json::Value;
use sqlx::sqlite::SqliteRow;
use strum::{VariantArray, VariantNames};

use crate::Store;
use crate::columns::{Columns, Json, from_row, sql, sql_as};
use crate::error::{Result, StoreError};
use engine::job::{JobId, ResourceId, RunSpec, Sha256, TaskKind, TaskState};

/// Owner of a task, with which it is deleted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Owner {
    /// The job that it belongs to.
    Job(JobId),
    /// The calibration, measurement, model or job for which it makes something. A job's state does not follow it.
    Resource(ResourceId),
}

#[derive(Debug, Clone)]
pub struct TileResult {
    /// The first snapshot of its run.
    pub run: u32,
    pub tile: u32,
    /// The hash that its file should have.
    pub sha256: Sha256,
    pub record: Value,
}

from_row!(TileResult, row => {
    run = row.read("snapshot")?,
    tile,
    sha256 = row.read("result")?,
    record = row.read::<Json<_>>("record")?.0,
});

/// Record of a task that is done.
#[derive(Debug, Clone)]
pub struct TaskRecord {
    pub kind: TaskKind,
    pub record: Value,
    /// Seconds of the successful attempt.
    pub seconds: f64,
    /// The number of the successful attempt, from 1.
    pub attempt: u32,
}

#[derive(Debug, Clone, PartialEq, Serialize, schemars::JsonSchema)]
#[schemars(rename = "TileProgress")]
pub struct TileState {
    /// The first snapshot of its run.
    #[serde(skip)]
    pub run: u32,
    /// The number of snapshots in its run.
    #[serde(skip)]
    pub snapshots: u32,
    /// Index of the tile in the plan.
    pub tile: u32,
    pub state: TaskState,
    /// Activity of the worker.
    pub stage: Option<String>,
    /// Iterations of the attempt that runs or ran last.
    pub iterations: u32,
    /// Deep passes of that attempt.
    pub passes: u32,
    /// Share of the planned cost that is done, from 0 to 1.
    pub fraction: f64,
    pub attempts: u32,
    /// `||y - H v|| / ||y||` of a tile that is done.
    pub residual: Option<f64>,
}

from_row!(TileState, row => {
    run = row.read("snapshot")?,
    snapshots,
    tile,
    state,
    stage,
    iterations,
    passes,
    fraction,
    attempts = row.read("attempt")?,
    residual,
});

/// Convergence history of a tile.
#[derive(Debug, Clone, PartialEq, Serialize, schemars::JsonSchema)]
pub struct TileHistory {
    pub tile: u32,
    pub state: TaskState,
    /// The iteration, its residual, the relative change, and sigma or null; at most 129 points.
    #[schemars(with = "Vec<[Option<f64>; 4]>")]
    pub points: Vec<Value>,
}

from_row!(TileHistory, row => { tile, state, points = row.read::<Json<_>>("history")?.0 });

/// The task for which a job has failed.
#[derive(Debug, Clone, PartialEq)]
pub struct FailedTask {
    pub kind: TaskKind,
    pub cause: FailureCause,
    /// Attempts that have ended badly.
    pub attempts: u32,
}

/// Why the last attempt at a task has ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FailureCause {
    /// The task reported an error.
    Task,
    /// Workers were killed for lack of memory.
    Memory,
    /// The worker crashed.
    Crash,
    /// Workers were killed or fell silent.
    Loss,
}

/// Totals of the completed tasks of a kind, deleted jobs included.
#[derive(Debug, Clone, PartialEq)]
pub struct TaskTotals {
    pub kind: String,
    pub tasks: u64,
    /// Seconds of their successful attempts.
    pub seconds: f64,
    pub iterations: u64,
    pub passes: u64,
}

from_row!(TaskTotals, row => { kind, tasks, seconds, iterations, passes });

/// Numbers of tasks by kind and state.
pub type TaskCounts = BTreeMap<(String, TaskState), u64>;

impl Store {
    /// The task for which a job has failed; none unless it has.
    pub async fn failed_task(&self, job: JobId) -> Result<Option<FailedTask>> {
        let row = sql!(
            "SELECT job, thing, kind, snapshot, snapshots, tile, failures, losses, starved,
                 (SELECT outcome FROM attempts WHERE task = id AND attempt = tasks.attempt) AS outcome
             FROM tasks WHERE job = ? AND state = ? ORDER BY id LIMIT 1",
            [job, TaskState::Failed]
        )
        .fetch_optional(&self.readers)
        .await?;
        let Some(row) = row else { return Ok(None) };
        let (failures, losses, starved): (u32, u32, u32) =
            (row.read("failures")?, row.read("losses")?, row.read("starved")?);
        let outcome: Option<String> = row.read("outcome")?;
        let cause = match outcome.as_deref() {
            Some("crashed") => FailureCause::Crash,
            Some("lost") if starved > 0 => FailureCause::Memory,
            Some("lost") => FailureCause::Loss,
            _ => FailureCause::Task,
        };
        Ok(Some(FailedTask { kind: kind(&row)?, cause, attempts: failures + losses + starved }))
    }

    /// The stored preview of a snapshot, while there is one: a prepared array of coarse frames.
    pub async fn preview(&self, job: JobId, snapshot: u32) -> Result<Option<(Sha256, PathBuf)>> {
        let sha256: Option<Sha256> = sql_as!(
            "SELECT result FROM tasks
             WHERE job = ? AND kind = 'preview' AND snapshot = ? AND result IS NOT NULL",
            [job, snapshot]
        )
        .fetch_optional(&self.readers)
        .await?;
        Ok(sha256.map(|sha256| (sha256, self.dir().blob(&sha256))))
    }

    /// The stored tiles of the runs that hold a snapshot, run by run in the order of the plan. The job's
    /// assembly has the right to count on all of them being there.
    pub async fn tile_results(&self, job: JobId, snapshot: u32) -> Result<Vec<TileResult>> {
        let tiles = sql_as!(
            "SELECT snapshot, tile, result, record FROM tasks
             WHERE job = ?1 AND kind = 'tile' AND snapshot BETWEEN ?2 - ?4 + 1 AND ?2
               AND ?2 < snapshot + snapshots AND state = ?3 ORDER BY snapshot, tile",
            [job, snapshot, TaskState::Done, RunSpec::LONGEST]
        )
        .fetch_all(&self.readers)
        .await?;
        Ok(tiles)
    }

    /// The record of a job's white level; `None` before it is determined.
    pub async fn white_record(&self, job: JobId) -> Result<Option<Value>> {
        let found: Option<Option<Json<Value>>> =
            sql_as!("SELECT record FROM tasks WHERE job = ? AND kind = 'white'", [job])
                .fetch_optional(&self.readers)
                .await?;
        Ok(found.flatten().map(|record| record.0))
    }

    /// All tiles of a job that are done, run by run in the order of the plan, without their assessments, which are large.
    pub async fn all_tile_results(&self, job: JobId) -> Result<Vec<TileResult>> {
        let tiles = sql_as!(
            "SELECT snapshot, tile, result, json_remove(record, '$.assessment') AS record FROM tasks
             WHERE job = ? AND kind = 'tile' AND state = ? ORDER BY snapshot, tile",
            [job, TaskState::Done]
        )
        .fetch_all(&self.readers)
        .await?;
        Ok(tiles)
    }

    /// Records of all tasks of a job that are done, in order.
    pub async fn task_records(&self, job: JobId) -> Result<Vec<TaskRecord>> {
        let rows = sql!(
            // A record that was shortened gets its files back.
            "SELECT kind, snapshot, snapshots, tile, seconds, attempt,
                 iif(kind = 'assemble' AND record ->> '$.summary' IS NOT NULL
                         AND record ->> '$.files' IS NULL,
                     json_set(record, '$.files',
                         (SELECT json_group_array(json_object('name', name, 'size', size, 'sha256', sha256))
                          FROM result_files
                          WHERE result_files.job = tasks.job AND result_files.snapshot = tasks.snapshot)),
                     record) AS record
             FROM tasks WHERE job = ? AND state = ? ORDER BY ordinal",
            [job, TaskState::Done]
        )
        .fetch_all(&self.readers)
        .await?;
        let read = |row: &SqliteRow| {
            Ok(TaskRecord {
                kind: kind(row)?,
                record: row.read::<Json<_>>("record")?.0,
                seconds: row.read::<Option<f64>>("seconds")?.unwrap_or(0.0),
                attempt: row.read("attempt")?,
            })
        };
        rows.iter().map(read).collect()
    }

    /// The tiles of the runs that hold a snapshot, run by run in the order of the plan.
    pub async fn tile_states(&self, job: JobId, snapshot: u32) -> Result<Vec<TileState>> {
        let tiles = sql_as!(
            "SELECT snapshot, snapshots, tile, state, stage, iterations, passes,
                 fraction, attempt, CASE state WHEN ?3 THEN record ->> 'residual' END AS residual
             FROM tasks WHERE job = ?1 AND kind = 'tile' AND snapshot BETWEEN ?2 - ?4 + 1 AND ?2
               AND ?2 < snapshot + snapshots ORDER BY snapshot, tile",
            [job, snapshot, TaskState::Done, RunSpec::LONGEST]
        )
        .fetch_all(&self.readers)
        .await?;
        Ok(tiles)
    }

    /// Convergence history of a tile of the last run that holds a snapshot (that which begins with it, if one does);
    /// none if there is no such tile.
    pub async fn tile_history(
        &self,
        job: JobId,
        snapshot: u32,
        tile: u32,
    ) -> Result<Option<TileHistory>> {
        let history = sql_as!(
            "SELECT tile, state, coalesce(history, '[]') AS history
             FROM tasks WHERE job = ?1 AND kind = 'tile' AND tile = ?3
               AND snapshot BETWEEN ?2 - ?4 + 1 AND ?2 AND ?2 < snapshot + snapshots
             ORDER BY snapshot DESC LIMIT 1",
            [job, snapshot, tile, RunSpec::LONGEST]
        )
        .fetch_optional(&self.readers)
        .await?;
        Ok(history)
    }

    /// Version of ONNX Runtime that the last worker reported which finished a tile with it; none before.
    pub async fn last_onnxruntime(&self) -> Result<Option<String>> {
        let version = sql_as!(
            "SELECT onnxruntime FROM totals WHERE kind = 'tile' AND onnxruntime IS NOT NULL"
        )
        .fetch_optional(&self.readers)
        .await?;
        Ok(version)
    }

    /// Totals of completed tasks, by kind.
    pub async fn totals(&self) -> Result<Vec<TaskTotals>> {
        sql_as!("SELECT * FROM totals ORDER BY kind").fetch_all(&self.readers).await
    }

    /// The number of tasks by kind and state, zeros included.
    pub async fn task_counts(&self) -> Result<TaskCounts> {
        let found: Vec<(String, TaskState, u64)> =
            sql_as!("SELECT kind, state, tasks FROM tasks_by_state")
                .fetch_all(&self.readers)
                .await?;
        let mut counts = TaskCounts::new();
        for kind in TaskKind::VARIANTS {
            counts
                .extend(TaskState::VARIANTS.iter().map(|&state| (((*kind).to_owned(), state), 0)));
        }
        counts.extend(found.into_iter().map(|(kind, state, count)| ((kind, state), count)));
        Ok(counts)
    }
}

pub fn kind(row: &SqliteRow) -> Result<TaskKind> {
    let name: String = row.read("kind")?;
    let snapshots = (row.read("snapshot")?, row.read("snapshots")?);
    TaskKind::from_parts(&name, snapshots, row.read("tile")?)
        .ok_or(StoreError::Corrupt { column: "kind", value: name })
}

/// Owner of the task in this row.
pub fn owner(row: &SqliteRow) -> Result<Owner> {
    Ok(match row.read("job")? {
        Some(job) => Owner::Job(job),
        None => Owner::Resource(row.read("thing")?),
    })
}

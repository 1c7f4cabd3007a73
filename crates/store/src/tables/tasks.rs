//! Table `tasks`: what they are, what they have made, and how they go. Only the queue changes it.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::Serialize;
use serde_json::Value;
use sqlx::sqlite::SqliteRow;
use strum::{VariantArray, VariantNames};

use crate::Store;
use crate::columns::{Columns, Json, from_row, sql, sql_as};
use crate::error::{Result, StoreError};
use engine::job::{JobId, RunSpec, Sha256, TaskKind, TaskState, ThingId};

/// What a task belongs to, and goes with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Owner {
    /// The job that it belongs to.
    Job(JobId),
    /// The calibration, measurement, model or job for which it makes something. A job's state does not follow it.
    Thing(ThingId),
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

/// What is known of a task that is done.
#[derive(Debug, Clone)]
pub struct TaskRecord {
    pub kind: TaskKind,
    pub record: Value,
    /// Seconds of the successful attempt.
    pub seconds: f64,
    /// The number of the successful attempt, from 1.
    pub attempt: u32,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TileState {
    /// The first snapshot of its run.
    #[serde(skip)]
    pub run: u32,
    /// The number of snapshots in its run.
    #[serde(skip)]
    pub snapshots: u32,
    pub tile: u32,
    pub state: TaskState,
    pub stage: Option<String>,
    /// Iterations of the attempt that runs or ran last.
    pub iterations: u32,
    /// Deep passes of that attempt.
    pub passes: u32,
    /// The share of the planned cost that is behind it.
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

/// How the solver went on a tile.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TileHistory {
    pub tile: u32,
    pub state: TaskState,
    /// \[iteration, residual, change, sigma or null\], by iteration; many iterations are thinned out.
    pub points: Vec<Value>,
}

from_row!(TileHistory, row => { tile, state, points = row.read::<Json<_>>("history")?.0 });

/// What has been done in all by tasks of a kind, those of deleted jobs with them.
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

    /// What is known of all tasks of a job that are done, in order.
    pub async fn task_records(&self, job: JobId) -> Result<Vec<TaskRecord>> {
        let rows = sql!(
            "SELECT kind, snapshot, snapshots, tile, record, seconds, attempt FROM tasks
             WHERE job = ? AND state = ? ORDER BY ordinal",
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

    /// How the solver went on a tile of the last run that holds a snapshot (that which begins with it, if
    /// one does); none if there is no such tile.
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

    /// Version of ONNX Runtime that the last worker told that finished a tile with it; none before.
    pub async fn last_onnxruntime(&self) -> Result<Option<String>> {
        let version = sql_as!(
            "SELECT record ->> 'onnxruntime' FROM tasks
             WHERE state = ? AND kind = 'tile' AND record ->> 'onnxruntime' IS NOT NULL
             ORDER BY job DESC LIMIT 1",
            [TaskState::Done]
        )
        .fetch_optional(&self.readers)
        .await?;
        Ok(version)
    }

    /// What has been done in all, by kind of task.
    pub async fn totals(&self) -> Result<Vec<TaskTotals>> {
        sql_as!("SELECT * FROM totals ORDER BY kind").fetch_all(&self.readers).await
    }

    /// The number of tasks by kind and state, with zeros for what there is none of.
    pub async fn task_counts(&self) -> Result<TaskCounts> {
        let found: Vec<(String, TaskState, u64)> =
            sql_as!("SELECT kind, state, count(*) FROM tasks GROUP BY kind, state")
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

/// What the task in this row belongs to.
pub fn owner(row: &SqliteRow) -> Result<Owner> {
    Ok(match row.read("job")? {
        Some(job) => Owner::Job(job),
        None => Owner::Thing(row.read("thing")?),
    })
}

//! How far a job is and how long it may still take, from what its tasks have reported.
//!
//! All shares are by planned cost. The time left is an upper bound in the sense of Graham: `m`
//! workers need at most `work / m + (1 - 1/m) * longest task`, with all stages at their most
//! iterations; it shrinks when the solver converges early.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Serialize;
use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use super::error::StoreError;
use super::rows::number;
use super::{Job, Store};
use crate::job::JobState;

/// What a job is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ProgressStage {
    /// No worker has taken it up.
    Waiting,
    /// The scale of the scene is estimated.
    Preparing,
    /// Tiles run, all of those running with TV.
    Tv,
    /// Tiles run, at least one with the deep denoiser.
    Deep,
    /// Frames are blended and written.
    Assembling,
    /// The job has come to its end.
    Ended,
}

/// How far a job is.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct JobProgress {
    /// What it is doing.
    pub stage: ProgressStage,
    /// The share of the planned cost that is behind it, in percent.
    pub percent: f64,
    /// Seconds until it ends, at most; none if it has ended or no worker lives.
    pub eta_seconds: Option<f64>,
    /// Tiles done.
    pub tiles_done: u64,
    /// Tiles in all.
    pub tiles_total: u64,
    /// Tiles that a worker has in hand.
    pub tiles_running: u64,
    /// Snapshots that can be downloaded.
    pub snapshots_done: u64,
    /// Solver iterations done, over all tiles.
    pub iterations_done: u64,
    /// Deep passes done, over all tiles.
    pub passes_done: u64,
}

/// Numbers of tasks by kind and state.
pub type TaskCounts = BTreeMap<(String, String), u64>;

/// Workers that were silent for longer do not count.
const WORKER_AGE: Duration = Duration::from_secs(15);

impl Store {
    /// How far a job is.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn progress(&self, job: &Job) -> Result<JobProgress, StoreError> {
        let row = sqlx::query(
            "SELECT
                 coalesce(sum(cost), 0) AS cost,
                 coalesce(sum(CASE state WHEN 'done' THEN cost WHEN 'running' THEN cost * fraction
                                         ELSE 0.0 END), 0) AS cost_done,
                 coalesce(max(CASE state WHEN 'done' THEN 0.0 ELSE cost * (1 - fraction) END), 0)
                     AS longest,
                 count(*) FILTER (WHERE kind = 'tile') AS tiles_total,
                 count(*) FILTER (WHERE kind = 'tile' AND state = 'done') AS tiles_done,
                 count(*) FILTER (WHERE kind = 'tile' AND state = 'running') AS tiles_running,
                 count(*) FILTER (WHERE kind = 'assemble' AND state = 'done') AS snapshots_done,
                 count(*) FILTER (WHERE kind = 'prepare' AND state = 'done') AS prepared,
                 count(*) FILTER (WHERE state = 'running' AND stage = 'deep') AS deep,
                 coalesce(sum(iterations), 0) AS iterations,
                 coalesce(sum(passes), 0) AS passes
             FROM tasks WHERE job = ?",
        )
        .bind(job.id.to_string())
        .fetch_one(&self.readers)
        .await?;
        let (cost, done): (f64, f64) = (row.try_get("cost")?, row.try_get("cost_done")?);
        let left = (cost - done).max(0.0);
        let eta = self.eta_seconds(job, left, row.try_get("longest")?).await?;
        let share = if cost > 0.0 { done / cost } else { 0.0 };
        Ok(JobProgress {
            stage: stage(job.state, &row)?,
            // Two digits: an ETag should not change with what nobody sees.
            percent: if job.state == JobState::Succeeded { 100.0 } else { round(share * 100.0, 2) },
            eta_seconds: eta.map(|seconds| round(seconds, 1)),
            tiles_done: number(&row, "tiles_done")?,
            tiles_total: number(&row, "tiles_total")?,
            tiles_running: number(&row, "tiles_running")?,
            snapshots_done: number(&row, "snapshots_done")?,
            iterations_done: number(&row, "iterations")?,
            passes_done: number(&row, "passes")?,
        })
    }

    async fn eta_seconds(
        &self,
        job: &Job,
        left: f64,
        longest: f64,
    ) -> Result<Option<f64>, StoreError> {
        if !matches!(job.state, JobState::Queued | JobState::Running) {
            return Ok(None);
        }
        let workers = self.live_workers(WORKER_AGE).await?.len();
        let Ok(workers @ 1..) = u32::try_from(workers) else { return Ok(None) };
        let workers = f64::from(workers);
        let work = left + self.cost_ahead(job).await?;
        let rate = self.seconds_per_cost().await?;
        Ok(Some(rate * (work / workers + (1.0 - 1.0 / workers) * longest)))
    }

    /// What is left of the jobs that are served before this one.
    async fn cost_ahead(&self, job: &Job) -> Result<f64, StoreError> {
        let row = sqlx::query(
            "SELECT coalesce(sum(cost * (1 - fraction)), 0.0) AS cost FROM tasks
             WHERE state IN ('blocked', 'ready', 'running')
               AND (priority > ?1 OR (priority = ?1 AND job < ?2))",
        )
        .bind(job.spec.priority)
        .bind(job.id.to_string())
        .fetch_one(&self.readers)
        .await?;
        Ok(row.try_get("cost")?)
    }

    /// Seconds that a planned CPU-second takes on this machine: measured on the last tiles done, by
    /// what they really did and not by what was planned; 1 before there are any.
    async fn seconds_per_cost(&self) -> Result<f64, StoreError> {
        let row = sqlx::query(
            "SELECT sum(seconds) AS seconds, sum(spent) AS spent FROM (
                 SELECT seconds, cost * fraction AS spent FROM tasks
                 WHERE state = 'done' AND kind = 'tile' ORDER BY job DESC, ordinal DESC LIMIT 32)",
        )
        .fetch_one(&self.readers)
        .await?;
        let seconds: Option<f64> = row.try_get("seconds")?;
        let spent: Option<f64> = row.try_get("spent")?;
        Ok(match (seconds, spent) {
            (Some(seconds), Some(spent)) if spent > 0.0 && seconds > 0.0 => seconds / spent,
            _ => 1.0,
        })
    }

    /// The number of tasks by kind and state, with zeros for what there is none of.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn task_counts(&self) -> Result<TaskCounts, StoreError> {
        let rows = sqlx::query("SELECT kind, state, count(*) AS n FROM tasks GROUP BY kind, state")
            .fetch_all(&self.readers)
            .await?;
        let mut counts = TaskCounts::new();
        for kind in ["prepare", "tile", "assemble", "manifest"] {
            for state in ["blocked", "ready", "running", "done", "failed", "cancelled"] {
                counts.insert((kind.to_owned(), state.to_owned()), 0);
            }
        }
        for row in &rows {
            counts.insert((row.try_get("kind")?, row.try_get("state")?), number(row, "n")?);
        }
        Ok(counts)
    }
}

fn stage(state: JobState, row: &SqliteRow) -> Result<ProgressStage, StoreError> {
    let count = |column| number::<u64>(row, column);
    Ok(match state {
        JobState::Queued => ProgressStage::Waiting,
        JobState::Succeeded | JobState::Failed | JobState::Cancelled => ProgressStage::Ended,
        JobState::Running | JobState::Cancelling => {
            if count("prepared")? == 0 {
                ProgressStage::Preparing
            } else if count("deep")? > 0 {
                ProgressStage::Deep
            } else if count("tiles_done")? == count("tiles_total")? {
                ProgressStage::Assembling
            } else {
                ProgressStage::Tv
            }
        }
    })
}

fn round(value: f64, digits: i32) -> f64 {
    let unit = 10f64.powi(digits);
    (value * unit).round() / unit
}

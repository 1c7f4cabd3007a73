//! Progress of jobs and the time they still take, from the reports of their tasks.
//!
//! All shares are by planned cost. For the time left, `m` workers need at most `work / m + (1 - 1/m) *
//! longest task` (Graham); tiles are taken to cost what those of the same job that are done did.

use std::collections::HashMap;

use serde::Serialize;
use serde_json::Value;
use sqlx::sqlite::SqliteRow;

use super::forecast::{Forecast, Left};
use crate::Store;
use crate::columns::{Columns, sql};
use crate::error::{Result, StoreError};
use crate::tables::jobs::Job;
use engine::job::{JobId, JobState, TaskKind, TaskStage};

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
#[derive(schemars::JsonSchema)]
pub enum ProgressStage {
    /// No worker has claimed a task of the job.
    Waiting,
    /// A worker estimates the scale of the scene.
    Preparing,
    /// All running tiles are in a stage with total variation.
    Tv,
    /// A running tile is in a stage with a learned denoiser.
    Deep,
    /// A running tile is in a stage with the nonlocal prior, and none with a learned denoiser.
    Nonlocal,
    /// A worker blends and writes frames.
    Assembling,
    /// The job has ended.
    Ended,
}

#[derive(Debug, Clone, PartialEq, Serialize, schemars::JsonSchema)]
#[schemars(rename = "Progress")]
pub struct JobProgress {
    pub stage: ProgressStage,
    /// Share of the planned cost that is done, in percent.
    pub percent: f64,
    /// Seconds until the end; null if the job has ended or no worker lives.
    pub eta_seconds: Option<f64>,
    /// Place among the waiting jobs, from 1; null if the job does not wait.
    pub queue_position: Option<usize>,
    pub tiles_done: u64,
    pub tiles_total: u64,
    /// Tiles that workers are computing.
    pub tiles_running: u64,
    /// Snapshots with results.
    pub snapshots_done: u64,
    /// Snapshots with a preview; 0 once the job has succeeded.
    pub previews_done: u64,
    /// Solver iterations done, over all tiles and the pilot.
    pub iterations_done: u64,
    /// Deep passes done, over all tiles and the pilot.
    pub passes_done: u64,
}

/// The queue as a new job would find it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, schemars::JsonSchema)]
#[schemars(rename = "Forecast")]
pub struct Estimate {
    /// Seconds until the job would end, behind all present jobs; null if no worker lives.
    pub eta_seconds: Option<f64>,
    /// Place among the waiting jobs, from 1.
    pub queue_position: usize,
}

impl Store {
    pub async fn progress(&self, job: &Job) -> Result<JobProgress> {
        let mut all = self.progress_of(std::slice::from_ref(job)).await?;
        all.pop().ok_or(StoreError::missing("job", job.id))
    }

    /// Progress of each of these jobs, in their order. Reads what their tasks add up to, and the tasks that run: how
    /// many tasks there are, and how many jobs wait, makes no difference.
    pub async fn progress_of(&self, jobs: &[Job]) -> Result<Vec<JobProgress>> {
        let ids: Vec<Value> = jobs.iter().map(|job| job.id.to_string().into()).collect();
        let rows = sql!(
            "WITH running AS (
                 SELECT job, sum(cost * fraction) AS spent,
                     sum(iif(kind IN ('tile', 'pilot'), cost * fraction, 0.0)) AS tiles_spent,
                     sum(kind = 'tile' AND delivery IS NOT 0) AS tiles_running,
                     sum(stage = ?2) AS deep, sum(stage = ?3) AS nonlocal,
                     sum(iterations) AS iterations, sum(passes) AS passes
                 FROM tasks LEFT JOIN remote_tasks ON task = id
                 WHERE state = 'running' AND job IS NOT NULL GROUP BY job)
             SELECT sums.*, coalesce(spent, 0.0) AS spent, coalesce(tiles_spent, 0.0) AS tiles_spent,
                 coalesce(tiles_running, 0) AS tiles_running,
                 coalesce(deep, 0) AS deep, coalesce(nonlocal, 0) AS nonlocal,
                 sums.iterations + coalesce(running.iterations, 0) AS all_iterations,
                 sums.passes + coalesce(running.passes, 0) AS all_passes
             FROM json_each(?1) JOIN job_sums AS sums ON sums.job = value
             LEFT JOIN running ON running.job = sums.job",
            [Value::from(ids).to_string(), TaskStage::Deep, TaskStage::Nonlocal]
        )
        .fetch_all(&self.readers)
        .await?;
        let by_job: Result<HashMap<JobId, &SqliteRow>> =
            rows.iter().map(|row| Ok((row.read("job")?, row))).collect();
        let by_job = by_job?;
        let forecast = if jobs.iter().any(|job| has_eta(job.state)) {
            Some(self.forecast().await?)
        } else {
            None
        };
        let missing = |id: JobId| StoreError::missing("job", id);
        jobs.iter()
            .map(|job| {
                let row = by_job.get(&job.id).ok_or_else(|| missing(job.id))?;
                progress(job, row, forecast.as_deref())
            })
            .collect()
    }

    /// Forecast for a new job with these tasks and the default priority.
    pub async fn estimate(&self, tasks: &[(TaskKind, f64)]) -> Result<Estimate> {
        let forecast = self.forecast().await?;
        let left = |of_tiles: bool| {
            let is_tile = |kind| matches!(kind, TaskKind::Tile { .. } | TaskKind::Pilot);
            let is_wanted = |kind: TaskKind| is_tile(kind) == of_tiles;
            let costs = tasks.iter().filter(|(kind, _)| is_wanted(*kind)).map(|(_, cost)| *cost);
            costs.fold(Left { sum: 0.0, longest: 0.0 }, |left, cost| Left {
                sum: left.sum + cost,
                longest: left.longest.max(cost),
            })
        };
        // An unknown job is behind all others.
        let job = JobId::new();
        let seconds = forecast.eta_seconds(job, (left(true), left(false)), None);
        Ok(Estimate {
            eta_seconds: seconds.map(|seconds| round(seconds, 1)),
            queue_position: forecast.position(job),
        })
    }
}

fn has_eta(state: JobState) -> bool {
    matches!(state, JobState::Queued | JobState::Running)
}

fn progress(job: &Job, row: &SqliteRow, forecast: Option<&Forecast>) -> Result<JobProgress> {
    let figure = |column| row.read::<f64>(column);
    let (cost, spent, tiles_spent) = (figure("cost")?, figure("spent")?, figure("tiles_spent")?);
    let (tiles, others) = (figure("tiles_left")?, figure("others_left")?);
    let done = cost - tiles - others + spent;
    let left = |sum: f64, longest: f64| {
        let sum = sum.max(0.0);
        Left { sum, longest: longest.min(sum) }
    };
    let left = (
        left(tiles - tiles_spent, figure("tiles_longest")?),
        left(others - (spent - tiles_spent), figure("others_longest")?),
    );
    let (tile_seconds, tile_cost) = (figure("tile_seconds")?, figure("tile_cost")?);
    let own_rate = (tile_seconds > 0.0 && tile_cost > 0.0).then(|| tile_seconds / tile_cost);
    let forecast = forecast.filter(|_| has_eta(job.state));
    let eta = forecast.and_then(|forecast| forecast.eta_seconds(job.id, left, own_rate));
    let waits = forecast.filter(|_| job.state == JobState::Queued);
    // Sums of fractions miss by a little.
    let share = if cost > 0.0 { (done / cost).clamp(0.0, 1.0) } else { 0.0 };
    Ok(JobProgress {
        stage: stage(job.state, row)?,
        // Two digits: an ETag should not change with what nobody sees.
        percent: if job.state == JobState::Succeeded { 100.0 } else { round(share * 100.0, 2) },
        eta_seconds: eta.map(|seconds| round(seconds, 1)),
        queue_position: waits.map(|forecast| forecast.position(job.id)),
        tiles_done: row.read("tiles_done")?,
        tiles_total: row.read("tiles_total")?,
        tiles_running: row.read("tiles_running")?,
        snapshots_done: row.read("snapshots_done")?,
        previews_done: row.read("previews_done")?,
        iterations_done: row.read("all_iterations")?,
        passes_done: row.read("all_passes")?,
    })
}

fn stage(state: JobState, row: &SqliteRow) -> Result<ProgressStage> {
    let count = |column| row.read::<u64>(column);
    Ok(match state {
        JobState::Queued => ProgressStage::Waiting,
        JobState::Succeeded | JobState::Failed | JobState::Cancelled => ProgressStage::Ended,
        JobState::Running | JobState::Cancelling => {
            if count("prepared")? == 0 {
                ProgressStage::Preparing
            } else if count("deep")? > 0 {
                ProgressStage::Deep
            } else if count("nonlocal")? > 0 {
                ProgressStage::Nonlocal
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

//! How far jobs are, what of them has changed, and how long they may still take, from what their tasks
//! have reported.
//!
//! All shares are by planned cost. For the time left, `m` workers need at most `work / m + (1 - 1/m) *
//! longest task` (Graham); tiles are taken to cost what those of the same job that are done did.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use serde::Serialize;
use serde_json::Value;
use sqlx::sqlite::SqliteRow;

use super::forecast::{Forecast, Left, Unfinished};
use crate::Store;
use crate::columns::{Columns, sql};
use crate::error::{Result, StoreError};
use crate::tables::jobs::Job;
use engine::job::{JobId, JobState, Lab, TaskKind, TaskStage, TaskState};

/// Workers that were silent for longer do not count.
const WORKER_AGE: Duration = Duration::from_secs(15);

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ProgressStage {
    /// No worker has taken it up.
    Waiting,
    /// The scale of the scene is estimated.
    Preparing,
    /// Tiles run, all of those running with TV.
    Tv,
    /// Tiles run, at least one with a learned denoiser.
    Deep,
    /// Tiles run, none with a learned denoiser, at least one with the nonlocal prior.
    Nonlocal,
    /// Frames are blended and written.
    Assembling,
    /// The job has come to its end.
    Ended,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct JobProgress {
    pub stage: ProgressStage,
    /// The share of the planned cost that is behind it, in percent.
    pub percent: f64,
    /// Seconds until it ends; none if it has ended or no worker lives.
    pub eta_seconds: Option<f64>,
    /// Its place among the jobs that wait, from 1 for the next to be taken up; none if it does not
    /// wait.
    pub queue_position: Option<usize>,
    pub tiles_done: u64,
    pub tiles_total: u64,
    /// Tiles that a worker has in hand; one that is out with other machines and waits for a worker is none.
    pub tiles_running: u64,
    /// Snapshots that can be downloaded.
    pub snapshots_done: u64,
    /// Snapshots with a preview; previews go when the job has succeeded.
    pub previews_done: u64,
    /// Solver iterations done, over all tiles and the pilot.
    pub iterations_done: u64,
    /// Deep passes done, over all tiles and the pilot.
    pub passes_done: u64,
}

/// What a job that is not there yet would wait for.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Estimate {
    /// Seconds until it would end; none if no worker lives.
    pub eta_seconds: Option<f64>,
    /// Its place among the jobs that wait, from 1.
    pub queue_position: usize,
}

/// The mark of a job: it differs when the job's state or what its workers have told differs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JobMark {
    state: JobState,
    tasks: i64,
    iterations: i64,
    fraction: f64,
}

impl Store {
    pub async fn progress(&self, job: &Job) -> Result<JobProgress> {
        let mut all = self.progress_of(std::slice::from_ref(job)).await?;
        all.pop().ok_or(StoreError::missing("job", job.id))
    }

    /// How far each of these jobs is, in their order. Reads what their tasks add up to, and the tasks that
    /// run: how many tasks there are, and how many jobs wait, makes no difference.
    pub async fn progress_of(&self, jobs: &[Job]) -> Result<Vec<JobProgress>> {
        let ids: Vec<Value> = jobs.iter().map(|job| job.id.to_string().into()).collect();
        let rows = sql!(
            "WITH running AS (
                 SELECT job, sum(cost * fraction) AS spent,
                     sum(iif(kind = 'tile', cost * fraction, 0.0)) AS tiles_spent,
                     sum(kind = 'tile' AND delivery IS NOT 0) AS tiles_running,
                     sum(stage = ?3) AS deep, sum(stage = ?4) AS nonlocal,
                     sum(iterations) AS iterations, sum(passes) AS passes
                 FROM tasks LEFT JOIN remote_tasks ON task = id
                 WHERE state = ?2 AND job IS NOT NULL GROUP BY job)
             SELECT sums.*, coalesce(spent, 0.0) AS spent, coalesce(tiles_spent, 0.0) AS tiles_spent,
                 coalesce(tiles_running, 0) AS tiles_running,
                 coalesce(deep, 0) AS deep, coalesce(nonlocal, 0) AS nonlocal,
                 sums.iterations + coalesce(running.iterations, 0) AS all_iterations,
                 sums.passes + coalesce(running.passes, 0) AS all_passes
             FROM json_each(?1) JOIN job_sums AS sums ON sums.job = value
             LEFT JOIN running ON running.job = sums.job",
            [
                Value::from(ids).to_string(),
                TaskState::Running,
                TaskStage::Deep,
                TaskStage::Nonlocal
            ]
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
        let gone = |id: JobId| StoreError::missing("job", id);
        jobs.iter()
            .map(|job| {
                let row = by_job.get(&job.id).ok_or_else(|| gone(job.id))?;
                progress(job, row, forecast.as_deref())
            })
            .collect()
    }

    /// The marks of all jobs, and whose they are. Reads indexes and the tasks that run.
    pub async fn job_marks(&self) -> Result<HashMap<(Lab, JobId), JobMark>> {
        let rows = sql!("SELECT id, lab, state FROM jobs").fetch_all(&self.readers).await?;
        let mut marks = HashMap::with_capacity(rows.len());
        for row in &rows {
            let state = row.read("state")?;
            marks.insert(
                (row.read("lab")?, row.read("id")?),
                JobMark { state, tasks: 0, iterations: 0, fraction: 0.0 },
            );
        }
        let rows = sql!(
            "SELECT job, (SELECT lab FROM jobs WHERE id = job) AS lab, count(*) AS tasks,
                 sum(ordinal + iif(delivery = 0, 1 << 24, 0)) AS ordinals,
                 sum(iterations) AS iterations, sum(fraction) AS fraction
             FROM tasks LEFT JOIN remote_tasks ON task = id
             WHERE state = ? AND job IS NOT NULL GROUP BY job",
            [TaskState::Running]
        )
        .fetch_all(&self.readers)
        .await?;
        for row in &rows {
            if let Some(mark) = marks.get_mut(&(row.read("lab")?, row.read("job")?)) {
                // Which tasks run, and not only how many: one may have ended and another begun. One that
                // waits elsewhere differs from one that is in hand.
                mark.tasks = row.read::<i64>("tasks")? << 32 ^ row.read::<i64>("ordinals")?;
                mark.iterations = row.read("iterations")?;
                mark.fraction = row.read("fraction")?;
            }
        }
        Ok(marks)
    }

    /// What a job with these tasks would wait for if it came now, at the priority that most have.
    pub async fn estimate(&self, tasks: &[(TaskKind, f64)]) -> Result<Estimate> {
        let forecast = self.forecast().await?;
        let left = |of_tiles: bool| {
            let of_kind = |kind: TaskKind| kind.tile().is_some() == of_tiles;
            let costs = tasks.iter().filter(|(kind, _)| of_kind(*kind)).map(|(_, cost)| *cost);
            costs.fold(Left { sum: 0.0, longest: 0.0 }, |left, cost| Left {
                sum: left.sum + cost,
                longest: left.longest.max(cost),
            })
        };
        // One that is not on record yet stands behind all others.
        let job = JobId::new();
        let seconds = forecast.eta_seconds(job, (left(true), left(false)), None);
        Ok(Estimate {
            eta_seconds: seconds.map(|seconds| round(seconds, 1)),
            queue_position: forecast.position(job),
        })
    }

    /// What is ahead of every unfinished job, a moment ago or now.
    async fn forecast(&self) -> Result<Arc<Forecast>> {
        let mut kept = self.forecast.lock().await;
        if let Some(forecast) = kept.as_ref().filter(|forecast| forecast.is_good()) {
            return Ok(forecast.clone());
        }
        Ok(kept.insert(self.new_forecast().await?.into()).clone())
    }

    async fn new_forecast(&self) -> Result<Forecast> {
        let rows = sql!(
            "SELECT id, lab, priority, state, tiles_left + others_left AS left
             FROM jobs INDEXED BY jobs_unfinished JOIN job_sums ON job = id
             WHERE finished_at IS NULL ORDER BY id",
        )
        .fetch_all(&self.readers)
        .await?;
        let (mut names, mut unfinished) = (HashMap::new(), Vec::with_capacity(rows.len()));
        for row in &rows {
            let lab: String = row.read("lab")?;
            let next = names.len();
            unfinished.push(Unfinished {
                id: row.read("id")?,
                lab: *names.entry(lab).or_insert(next),
                priority: row.read("priority")?,
                waits: row.read::<JobState>("state")? == JobState::Queued,
                left: row.read("left")?,
            });
        }
        let mut shares = vec![1.0; names.len()];
        for row in sql!("SELECT lab, share FROM labs").fetch_all(&self.readers).await? {
            if let Some(lab) = names.get(&row.read::<String>("lab")?) {
                shares[*lab] = row.read("share")?;
            }
        }
        let workers = self.live_workers(WORKER_AGE).await?.len();
        Ok(Forecast::new(&unfinished, &shares, workers, self.rates().await?))
    }

    /// Seconds that a planned CPU-second of tiles and of other tasks takes on this machine: measured on
    /// the last tasks of a kind, by what they really did and not by what was planned; 1 before there are
    /// any.
    async fn rates(&self) -> Result<(f64, f64)> {
        let row = sql!(
            "SELECT sum(recent_seconds) FILTER (WHERE kind = 'tile')
                    / sum(recent_cost) FILTER (WHERE kind = 'tile') AS tiles,
                 sum(recent_seconds) FILTER (WHERE kind IN ('prepare', 'preview', 'white', 'assemble'))
                    / sum(recent_cost) FILTER (WHERE kind IN ('prepare', 'preview', 'white', 'assemble')) AS others
             FROM totals",
        )
        .fetch_one(&self.readers)
        .await?;
        let rate = |rate: Option<f64>| rate.filter(|rate| *rate > 0.0).unwrap_or(1.0);
        Ok((rate(row.read("tiles")?), rate(row.read("others")?)))
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

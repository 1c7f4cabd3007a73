//! How a worker gets a task, with all that it needs to do it.

use std::path::PathBuf;
use std::time::Duration;

use serde_json::Value;
use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use super::lease::{self, LONGEST_LEASE, Lease, Loss};
use crate::job::{
    CalibrationId, Captures, JobId, JobSpec, JobState, Label, TaskKind, TaskStage, TaskState,
    Timestamp, WorkerId,
};
use crate::store::Store;
use crate::store::error::StoreError;
use crate::store::rows::{json, json_if, number, parsed, parsed_if};
use crate::store::tables::calibrations::Calibration;
use crate::store::tables::measurements::Measurement;
use crate::store::tables::tasks::{self, Owner, TaskRecord, TileResult};
use crate::store::tables::{jobs, workers};

/// The longest pause of a task after a failure, in milliseconds: one that ends later was noted before
/// the clock was set back.
const LONGEST_PAUSE: i64 = 60_000;

/// A task with all that a worker needs to do it.
#[derive(Debug, Clone)]
pub struct ClaimedTask {
    /// The right to it, to be shown with every message about it.
    pub lease: Lease,
    /// What it is, for logs.
    pub kind: TaskKind,
    /// Its planned processor time in seconds; 0 for a calibration.
    pub cost: f64,
    /// What is to be done.
    pub work: Work,
}

/// What is to be done.
#[derive(Debug, Clone)]
pub enum Work {
    /// A step of a job.
    Job(Box<JobTask>),
    /// A calibration's masks, or the report on them.
    Calibration(CalibrationTask),
}

/// A step of a job.
#[derive(Debug, Clone)]
pub struct JobTask {
    /// The job.
    pub job: JobId,
    /// What the job is.
    pub spec: JobSpec,
    /// The calibration's record.
    pub calibration: Calibration,
    /// The measurement's record.
    pub measurement: Measurement,
    /// What the job's prepare task recorded; none for that task itself.
    pub prepared: Option<Value>,
    /// What its pilot recorded, if it has one that is done.
    pub pilot: Option<Value>,
    /// Which step.
    pub step: Step,
}

/// Which step of a job, with what it needs of the steps before it.
#[derive(Debug, Clone)]
pub enum Step {
    /// Estimate the scale of the scene.
    Prepare,
    /// Reconstruct a snapshot coarsely.
    Preview {
        /// The snapshot's index.
        snapshot: u32,
    },
    /// Find out how many iterations pay.
    Pilot,
    /// Reconstruct a tile.
    Tile {
        /// The snapshot's index.
        snapshot: u32,
        /// The tile's index in the plan.
        tile: u32,
    },
    /// Blend the tiles of a snapshot and write its frames.
    Assemble {
        /// The snapshot's index.
        snapshot: u32,
        /// All its tiles, in the order of the plan.
        tiles: Vec<TileResult>,
    },
    /// Write the manifest.
    Manifest {
        /// Of all other tasks of the job, in order.
        records: Vec<TaskRecord>,
    },
}

/// What is to be done for a calibration.
#[derive(Debug, Clone)]
pub struct CalibrationTask {
    /// The calibration.
    pub calibration: CalibrationId,
    /// The user's name for it.
    pub name: Option<Label>,
    /// What there is to begin with.
    pub inputs: CalibrationInputs,
}

/// What a calibration begins with.
#[derive(Debug, Clone)]
pub enum CalibrationInputs {
    /// Captures: masks are to be made of them, and a report.
    Captures(Captures),
    /// Masks, a planar array at this place: a report is to be made.
    Masks(PathBuf),
}

impl Store {
    /// Hands out the next task, if there is one.
    pub async fn claim(
        &self,
        worker: WorkerId,
        length: Duration,
    ) -> Result<Option<ClaimedTask>, StoreError> {
        let now = Timestamp::now().0;
        if !self.may_have_work(now).await? {
            return Ok(None);
        }
        let mut transaction = self.write().await?;
        lease::reap(&mut transaction, now).await?;
        let claimed = take(&mut transaction, worker, length, now).await?;
        let Some(row) = claimed else {
            transaction.commit().await?;
            return Ok(None);
        };
        let lease =
            Lease { task: parsed(&row, "id")?, attempt: number(&row, "attempt")?, worker, length };
        let (owner, kind) = (tasks::owner(&row)?, tasks::kind(&row)?);
        sqlx::query("INSERT INTO attempts (task, attempt, worker, started_at) VALUES (?, ?, ?, ?)")
            .bind(lease.task.to_string())
            .bind(lease.attempt)
            .bind(worker.to_string())
            .bind(now)
            .execute(&mut *transaction)
            .await?;
        if let Owner::Job(job) = owner
            && jobs::state(&mut transaction, job).await? == JobState::Queued
        {
            jobs::set_state(&mut transaction, job, JobState::Running, None).await?;
        }
        workers::seen(&mut transaction, worker).await?;
        transaction.commit().await?;
        let work = match owner {
            Owner::Job(job) => self.job_task(job, kind).await,
            Owner::Calibration(id) => self.calibration_task(id).await,
        };
        match work {
            Ok(work) => Ok(Some(ClaimedTask { lease, kind, cost: row.try_get("cost")?, work })),
            Err(error) => {
                self.part(&lease, &Loss::Lost(error.to_string())).await?;
                Err(error)
            }
        }
    }

    /// Looks without the lock: most of the time there is nothing to do.
    async fn may_have_work(&self, now: i64) -> Result<bool, StoreError> {
        let found = sqlx::query(
            "SELECT 1 WHERE EXISTS (SELECT 1 FROM tasks WHERE state = ?1
                                        AND ready_at NOT BETWEEN ?3 + 1 AND ?3 + ?4)
                 OR EXISTS (SELECT 1 FROM tasks WHERE state = ?2
                                AND lease_until NOT BETWEEN ?3 AND ?3 + ?5)",
        )
        .bind(TaskState::Ready.name())
        .bind(TaskState::Running.name())
        .bind(now)
        .bind(LONGEST_PAUSE)
        .bind(LONGEST_LEASE)
        .fetch_optional(&self.readers)
        .await?;
        Ok(found.is_some())
    }

    async fn job_task(&self, job: JobId, kind: TaskKind) -> Result<Work, StoreError> {
        let found = sqlx::query(
            "SELECT spec, (SELECT record FROM tasks WHERE job = jobs.id AND kind = 'prepare') AS prepared,
                 (SELECT record FROM tasks WHERE job = jobs.id AND kind = 'pilot') AS pilot
             FROM jobs WHERE id = ?",
        )
        .bind(job.to_string())
        .fetch_one(&self.readers)
        .await?;
        let spec: JobSpec = json(&found, "spec")?;
        let calibration = self.find_calibration(None, spec.calibration).await?;
        let measurement = self.find_measurement(None, spec.measurement).await?;
        let record = |column| {
            let text: Option<String> = found.try_get(column)?;
            Ok::<_, StoreError>(text.and_then(|text| serde_json::from_str(&text).ok()))
        };
        let step = match kind {
            TaskKind::Prepare => Step::Prepare,
            TaskKind::Preview { snapshot } => Step::Preview { snapshot },
            TaskKind::Pilot => Step::Pilot,
            TaskKind::Tile { snapshot, tile } => Step::Tile { snapshot, tile },
            TaskKind::Assemble { snapshot } => {
                Step::Assemble { snapshot, tiles: self.tile_results(job, snapshot).await? }
            }
            TaskKind::Manifest => Step::Manifest { records: self.task_records(job).await? },
            TaskKind::Calibration => {
                let value = kind.name().to_owned();
                return Err(StoreError::Corrupt { column: "kind", value });
            }
        };
        Ok(Work::Job(Box::new(JobTask {
            job,
            spec,
            calibration,
            measurement,
            prepared: record("prepared")?,
            pilot: record("pilot")?,
            step,
        })))
    }

    async fn calibration_task(&self, id: CalibrationId) -> Result<Work, StoreError> {
        let row = sqlx::query(
            "SELECT name, captures, (SELECT prepared FROM calibrations WHERE id = calibration) AS masks
             FROM calibration_requests WHERE calibration = ?",
        )
        .bind(id.to_string())
        .fetch_optional(&self.readers)
        .await?
        .ok_or_else(|| StoreError::NotFound { what: "calibration", id: id.to_string() })?;
        let inputs = match json_if(&row, "captures")? {
            Some(captures) => CalibrationInputs::Captures(captures),
            None => CalibrationInputs::Masks(self.dir().blob(&parsed(&row, "masks")?)),
        };
        let name = parsed_if(&row, "name")?;
        Ok(Work::Calibration(CalibrationTask { calibration: id, name, inputs }))
    }
}

/// One statement finds the next task, marks it and counts the attempt.
async fn take(
    connection: &mut SqliteConnection,
    worker: WorkerId,
    length: Duration,
    now: i64,
) -> Result<Option<SqliteRow>, StoreError> {
    let row = sqlx::query(
        "UPDATE tasks SET state = ?1, worker = ?2, lease_until = ?3, attempt = attempt + 1,
             stage = ?4, iterations = 0, passes = 0, fraction = 0, history = NULL
         WHERE id = (SELECT id FROM tasks
                     WHERE state = ?5 AND ready_at NOT BETWEEN ?6 + 1 AND ?6 + ?7
                     ORDER BY priority DESC, job, ordinal, id LIMIT 1)
         RETURNING id, job, calibration, kind, snapshot, tile, attempt, cost",
    )
    .bind(TaskState::Running.name())
    .bind(worker.to_string())
    .bind(Lease::until(length, now))
    .bind(TaskStage::Reading.name())
    .bind(TaskState::Ready.name())
    .bind(now)
    .bind(LONGEST_PAUSE)
    .fetch_optional(connection)
    .await?;
    Ok(row)
}

//! The queue: how tasks get to workers and come back.
//!
//! A worker *claims* a task and holds it under a *lease* that its heartbeats renew. A lease that
//! runs out makes the task ready again, so a dead worker costs one attempt. Each claim has a number,
//! and what an earlier attempt says later is refused: that is the fence. Everything that changes a
//! task also settles its job, in the same transaction.

use std::time::Duration;

use serde_json::Value;
use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use super::claim::{ClaimedTask, Completion, Heartbeat, Lease, Product};
use super::graph;
use super::lease;
use crate::job::{JobId, JobSpec, JobState, TaskKind, TaskProgress, Timestamp, WorkerId};
use crate::store::error::StoreError;
use crate::store::rows::{json, number, parsed};
use crate::store::tables::blobs::Origin;
use crate::store::tables::jobs;
use crate::store::tables::results;
use crate::store::tables::workers;
use crate::store::{StagedDir, Store, dir, on_files};

impl Store {
    /// Hands out the next task, if there is one.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn claim(
        &self,
        worker: WorkerId,
        length: Duration,
    ) -> Result<Option<ClaimedTask>, StoreError> {
        let now = Timestamp::now().0;
        // 1. Look without the lock: most of the time there is nothing to do.
        let work = sqlx::query(
            "SELECT 1 WHERE EXISTS (SELECT 1 FROM tasks WHERE state = 'ready'
                               AND ready_at NOT BETWEEN ?1 + 1 AND ?1 + 60000)
                OR EXISTS (SELECT 1 FROM tasks WHERE state = 'running'
                              AND lease_until NOT BETWEEN ?1 AND ?1 + 600000)",
        )
        .bind(now)
        .fetch_optional(&self.readers)
        .await?;
        if work.is_none() {
            return Ok(None);
        }
        let mut transaction = self.write().await?;
        // 2. Take back what silent workers hold.
        lease::reap(&mut transaction, now).await?;
        // 3. Claim: one statement finds the task, marks it and counts the attempt.
        let claimed = sqlx::query(
            "UPDATE tasks SET state = 'running', worker = ?1, lease_until = ?2, attempt = attempt + 1,
                 stage = 'reading', iterations = 0, passes = 0, fraction = 0, history = NULL
             WHERE id = (SELECT id FROM tasks WHERE state = 'ready'
                             -- A pause is seconds: what lies further ahead was noted before the
                             -- clock was set back.
                             AND ready_at NOT BETWEEN ?3 + 1 AND ?3 + 60000
                         ORDER BY priority DESC, job, ordinal LIMIT 1)
             RETURNING id, job, kind, snapshot, tile, attempt, cost",
        )
        .bind(worker.to_string())
        .bind(now + millis(length))
        .bind(now)
        .fetch_optional(&mut *transaction)
        .await?;
        let Some(row) = claimed else {
            transaction.commit().await?;
            return Ok(None);
        };
        let lease =
            Lease { task: parsed(&row, "id")?, attempt: number(&row, "attempt")?, worker, length };
        let job = parsed(&row, "job")?;
        // 4. Keep a record of the attempt, and move the job on.
        sqlx::query("INSERT INTO attempts (task, attempt, worker, started_at) VALUES (?, ?, ?, ?)")
            .bind(lease.task.to_string())
            .bind(lease.attempt)
            .bind(worker.to_string())
            .bind(now)
            .execute(&mut *transaction)
            .await?;
        if jobs::state(&mut transaction, job).await? == JobState::Queued {
            jobs::set_state(&mut transaction, job, JobState::Running, None).await?;
        }
        workers::seen(&mut transaction, worker).await?;
        transaction.commit().await?;
        // 5. Fetch what the worker needs. If this fails, the lease runs out.
        self.claimed_task(lease, job, &row).await.map(Some)
    }

    async fn claimed_task(
        &self,
        lease: Lease,
        job: JobId,
        row: &SqliteRow,
    ) -> Result<ClaimedTask, StoreError> {
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
        Ok(ClaimedTask {
            lease,
            kind: graph::kind(row)?,
            job,
            cost: row.try_get("cost")?,
            masks: self.dir().blob(&calibration.prepared),
            snapshots: self.dir().blob(&measurement.prepared),
            model: spec.model.as_ref().map(|model| self.dir().blob(&model.sha256)),
            spec,
            calibration,
            measurement,
            prepared: record("prepared")?,
            pilot: record("pilot")?,
        })
    }

    /// Renews a lease, notes the progress, and asks whether to go on.
    ///
    /// # Errors
    /// If the database fails; the lease is not renewed then.
    pub async fn heartbeat(
        &self,
        lease: &Lease,
        progress: TaskProgress,
    ) -> Result<Heartbeat, StoreError> {
        self.heartbeat_with(lease, progress, None).await
    }

    /// As [`Store::heartbeat`], and notes how the solver went: JSON as
    /// [`TileHistory::points`](crate::store::TileHistory) has it. Without one, what was noted stays.
    ///
    /// # Errors
    /// If the database fails; the lease is not renewed then.
    pub async fn heartbeat_with(
        &self,
        lease: &Lease,
        progress: TaskProgress,
        history: Option<&str>,
    ) -> Result<Heartbeat, StoreError> {
        let mut transaction = self.write().await?;
        workers::seen(&mut transaction, lease.worker).await?;
        let row = sqlx::query(
            "UPDATE tasks SET lease_until = ?, stage = ?, iterations = ?, passes = ?, fraction = ?,
                 history = coalesce(?, history)
             WHERE id = ? AND attempt = ? AND state = 'running'
             RETURNING (SELECT state FROM jobs WHERE id = tasks.job) AS job_state",
        )
        .bind(Timestamp::now().0 + millis(lease.length))
        .bind(progress.stage.name())
        .bind(progress.iterations)
        .bind(progress.passes)
        .bind(progress.fraction.clamp(0.0, 1.0))
        .bind(history)
        .bind(lease.task.to_string())
        .bind(lease.attempt)
        .fetch_optional(&mut *transaction)
        .await?;
        transaction.commit().await?;
        Ok(match row {
            None => Heartbeat::Lost,
            Some(row) => match parsed(&row, "job_state")? {
                JobState::Queued | JobState::Running => Heartbeat::Continue,
                _ => Heartbeat::Cancelled,
            },
        })
    }

    /// Stores what a task has made and moves its job on. Says [`Heartbeat::Lost`] if the lease has
    /// run out and the task was claimed again; nothing is stored then.
    ///
    /// # Errors
    /// If a file or the database can't be written; the task is still the worker's then.
    pub async fn complete(
        &self,
        lease: &Lease,
        completion: Completion,
    ) -> Result<Heartbeat, StoreError> {
        // Hashing and syncing files takes long, so it is done before the lock is taken.
        let (files, product) = match completion.product {
            Product::Files(staged) => on_files(move || Ok((staged.seal()?, staged)))
                .await
                .map(|(files, staged)| (files, Product::Files(staged)))?,
            other => (Vec::new(), other),
        };
        let mut transaction = self.write().await?;
        let Some((job, kind)) = held(&mut transaction, lease).await? else {
            return Ok(Heartbeat::Lost);
        };
        let mut result = None;
        match product {
            Product::Record => {}
            Product::TileCost(share) => {
                graph::scale_tiles(&mut transaction, job, share).await?;
            }
            Product::Tile(staged) => {
                result = Some(staged.sha256().to_string());
                self.publish(&mut transaction, staged, Origin::Tile).await?;
            }
            Product::Files(staged) => {
                results::record(&mut transaction, job, kind.snapshot(), &files).await?;
                self.put_files(job, kind, staged, files).await?;
            }
        }
        finish(&mut transaction, lease, &completion.progress, &completion.record, result).await?;
        graph::unblock(&mut transaction, job, kind).await?;
        if kind == TaskKind::Manifest
            && jobs::state(&mut transaction, job).await? == JobState::Running
        {
            jobs::set_state(&mut transaction, job, JobState::Succeeded, None).await?;
            self.drop_tiles(&mut transaction, job).await?;
        }
        jobs::settle(&mut transaction, job).await?;
        transaction.commit().await?;
        Ok(Heartbeat::Continue)
    }

    /// Moves result files to their place, under the lock of the caller's transaction.
    async fn put_files(
        &self,
        job: JobId,
        kind: TaskKind,
        staged: StagedDir,
        files: Vec<crate::store::ResultFile>,
    ) -> Result<(), StoreError> {
        let folder = self.dir().results(job);
        let place = kind.snapshot().map(|snapshot| self.dir().snapshot_results(job, snapshot));
        on_files(move || {
            dir::make_dir_durably(&folder)?;
            match place {
                Some(place) => staged.put(&place),
                None => staged.put_files(&folder, &files),
            }
        })
        .await
    }

    /// Removes the tiles of a job that needs them no more.
    pub(in crate::store) async fn drop_tiles(
        &self,
        transaction: &mut SqliteConnection,
        job: JobId,
    ) -> Result<(), StoreError> {
        let rows =
            sqlx::query("SELECT DISTINCT result FROM tasks WHERE job = ? AND result IS NOT NULL")
                .bind(job.to_string())
                .fetch_all(&mut *transaction)
                .await?;
        sqlx::query("UPDATE tasks SET result = NULL WHERE job = ?")
            .bind(job.to_string())
            .execute(&mut *transaction)
            .await?;
        for row in &rows {
            self.release(transaction, parsed(row, "result")?).await?;
        }
        Ok(())
    }
}

pub(in crate::store) fn millis(length: Duration) -> i64 {
    i64::try_from(length.as_millis()).unwrap_or(i64::MAX / 2)
}

/// The job and kind of the task, if the lease is still good. A lease that ran out but was not
/// claimed by anyone else is good: the work is done, so it may as well count.
pub(in crate::store) async fn held(
    connection: &mut SqliteConnection,
    lease: &Lease,
) -> Result<Option<(JobId, TaskKind)>, StoreError> {
    let row = sqlx::query(
        "SELECT job, kind, snapshot, tile FROM tasks WHERE id = ? AND attempt = ? AND state = 'running'",
    )
    .bind(lease.task.to_string())
    .bind(lease.attempt)
    .fetch_optional(connection)
    .await?;
    row.map(|row| Ok((parsed(&row, "job")?, graph::kind(&row)?))).transpose()
}

/// Marks a task done.
async fn finish(
    connection: &mut SqliteConnection,
    lease: &Lease,
    progress: &TaskProgress,
    record: &Value,
    result: Option<String>,
) -> Result<(), StoreError> {
    let now = Timestamp::now().0;
    sqlx::query(
        "UPDATE tasks SET state = 'done', worker = NULL, lease_until = NULL, stage = NULL,
             iterations = ?1, passes = ?2, fraction = ?3, record = ?4, result = ?5,
             seconds = (?6 - (SELECT started_at FROM attempts WHERE task = id AND attempt = ?8)) / 1000.0
         WHERE id = ?7",
    )
    .bind(progress.iterations)
    .bind(progress.passes)
    .bind(progress.fraction.clamp(0.0, 1.0))
    .bind(record.to_string())
    .bind(result)
    .bind(now)
    .bind(lease.task.to_string())
    .bind(lease.attempt)
    .execute(&mut *connection)
    .await?;
    sqlx::query(
        "INSERT INTO totals (kind, tasks, seconds, iterations, passes)
             SELECT kind, 1, coalesce(seconds, 0), iterations, passes FROM tasks WHERE id = ?
         ON CONFLICT (kind) DO UPDATE SET tasks = tasks + 1, seconds = seconds + excluded.seconds,
             iterations = iterations + excluded.iterations, passes = passes + excluded.passes",
    )
    .bind(lease.task.to_string())
    .execute(&mut *connection)
    .await?;
    lease::end_attempt(connection, lease.task, "done", None).await
}

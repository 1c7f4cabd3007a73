//! Table `jobs`: accepting, listing, cancelling, retrying and deleting.

use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use crate::job::{
    CalibrationId, JobId, JobSpec, JobState, Lab, Label, MeasurementId, TaskKind, Timestamp,
};
use crate::store::error::StoreError;
use crate::store::queue::graph;
use crate::store::rows::{json, number, parsed};
use crate::store::{Page, Store, dir, on_files};

/// A job on record.
#[derive(Debug, Clone, PartialEq)]
pub struct Job {
    /// Its identifier.
    pub id: JobId,
    /// Whose it is.
    pub lab: Lab,
    /// What is to be done.
    pub spec: JobSpec,
    /// Where it stands.
    pub state: JobState,
    /// Why it failed.
    pub error: Option<String>,
    /// When it was accepted.
    pub created_at: Timestamp,
    /// When its first task was claimed.
    pub started_at: Option<Timestamp>,
    /// When it came to an end.
    pub finished_at: Option<Timestamp>,
}

/// Which jobs a list holds.
#[derive(Debug, Clone, Default)]
pub struct JobFilter {
    /// Only those in this state.
    pub state: Option<JobState>,
    /// Only those of this calibration.
    pub calibration: Option<CalibrationId>,
    /// Only those of this measurement.
    pub measurement: Option<MeasurementId>,
    /// Only those with this very label.
    pub label: Option<Label>,
    /// Only those with this text in the label or the identifier, in upper or lower case.
    pub search: Option<Label>,
    /// Only those older than this one.
    pub after: Option<JobId>,
}

impl Store {
    /// The lab's job with this identifier.
    ///
    /// # Errors
    /// [`StoreError::NotFound`].
    pub async fn job(&self, lab: &Lab, id: JobId) -> Result<Job, StoreError> {
        let row = sqlx::query("SELECT * FROM jobs WHERE id = ? AND lab = ?")
            .bind(id.to_string())
            .bind(lab.as_str())
            .fetch_optional(&self.readers)
            .await?;
        row.as_ref().map(job).transpose()?.ok_or_else(|| not_found(id))
    }

    /// A page of the lab's jobs, newest first.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn jobs(
        &self,
        lab: &Lab,
        filter: &JobFilter,
        limit: u32,
    ) -> Result<Page<Job>, StoreError> {
        let rows = sqlx::query(
            "SELECT * FROM jobs
             WHERE (?1 IS NULL OR id < ?1) AND (?2 IS NULL OR state = ?2)
               AND (?3 IS NULL OR calibration = ?3) AND (?4 IS NULL OR measurement = ?4)
               AND (?5 IS NULL OR label = ?5)
               AND (?6 IS NULL OR instr(lower(label), lower(?6)) OR instr(id, lower(?6)))
             AND lab = ?8
             ORDER BY id DESC LIMIT ?7",
        )
        .bind(filter.after.map(|id| id.to_string()))
        .bind(filter.state.map(JobState::name))
        .bind(filter.calibration.map(|id| id.to_string()))
        .bind(filter.measurement.map(|id| id.to_string()))
        .bind(filter.label.as_ref().map(Label::as_str))
        .bind(filter.search.as_ref().map(Label::as_str))
        .bind(i64::from(limit) + 1)
        .bind(lab.as_str())
        .fetch_all(&self.readers)
        .await?;
        Page::cut(&rows, limit, job)
    }

    /// Cancels a job: at once if no worker is at it, else as soon as the workers have heard of it.
    /// Cancelling twice is no error.
    ///
    /// # Errors
    /// [`StoreError::NotFound`]; [`StoreError::State`] if the job has succeeded or failed.
    pub async fn cancel_job(&self, lab: &Lab, id: JobId) -> Result<(), StoreError> {
        self.job(lab, id).await?;
        let mut transaction = self.write().await?;
        let before = state(&mut transaction, id).await?;
        if matches!(before, JobState::Cancelling | JobState::Cancelled) {
            return Ok(());
        }
        let running = running_tasks(&mut transaction, id).await? > 0;
        let to = if running { JobState::Cancelling } else { JobState::Cancelled };
        set_state(&mut transaction, id, to, None).await?;
        cancel_waiting_tasks(&mut transaction, id).await?;
        transaction.commit().await?;
        Ok(())
    }

    /// Takes up a failed or cancelled job again. What is done stays done.
    ///
    /// # Errors
    /// [`StoreError::NotFound`]; [`StoreError::State`] if the job has not failed or been cancelled.
    pub async fn retry_job(&self, lab: &Lab, id: JobId) -> Result<(), StoreError> {
        self.job(lab, id).await?;
        let mut transaction = self.write().await?;
        set_state(&mut transaction, id, JobState::Queued, None).await?;
        sqlx::query(
            "UPDATE tasks SET failures = 0, losses = 0, ready_at = 0,
                 state = CASE kind WHEN 'prepare' THEN 'ready' ELSE 'blocked' END
             WHERE job = ? AND state IN ('failed', 'cancelled')",
        )
        .bind(id.to_string())
        .execute(&mut *transaction)
        .await?;
        if prepared(&mut transaction, id).await? {
            graph::unblock(&mut transaction, id, TaskKind::Prepare).await?;
        }
        for snapshot in snapshots(&mut transaction, id).await? {
            let tile = TaskKind::Tile { snapshot, tile: 0 };
            graph::unblock(&mut transaction, id, tile).await?;
        }
        graph::unblock(&mut transaction, id, TaskKind::Assemble { snapshot: 0 }).await?;
        transaction.commit().await?;
        Ok(())
    }

    /// Deletes a job that has come to its end, with all that it has made.
    ///
    /// # Errors
    /// [`StoreError::NotFound`]; [`StoreError::NotFinal`] if it still runs or waits.
    pub async fn delete_job(&self, lab: &Lab, id: JobId) -> Result<(), StoreError> {
        self.job(lab, id).await?;
        self.remove_job(id).await
    }

    /// As [`Self::delete_job`], whosever it is.
    pub(in crate::store) async fn remove_job(&self, id: JobId) -> Result<(), StoreError> {
        let mut transaction = self.write().await?;
        let state = state(&mut transaction, id).await?;
        if !state.is_final() || running_tasks(&mut transaction, id).await? > 0 {
            return Err(StoreError::NotFinal(state));
        }
        self.drop_tiles(&mut transaction, id).await?;
        sqlx::query("DELETE FROM jobs WHERE id = ?")
            .bind(id.to_string())
            .execute(&mut *transaction)
            .await?;
        let folder = self.dir().results(id);
        // Under the lock and before the commit, so that no row is left whose files are gone for
        // longer than a crash takes; a second DELETE then removes the row.
        on_files(move || dir::remove(&folder)).await?;
        transaction.commit().await?;
        Ok(())
    }

    /// The number of jobs in each state.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn job_counts(&self) -> Result<Vec<(JobState, u64)>, StoreError> {
        let rows = sqlx::query("SELECT state, count(*) AS jobs FROM jobs GROUP BY state")
            .fetch_all(&self.readers)
            .await?;
        rows.iter().map(|row| Ok((parsed(row, "state")?, number(row, "jobs")?))).collect()
    }
}

/// The job's state.
pub(in crate::store) async fn state(
    connection: &mut SqliteConnection,
    id: JobId,
) -> Result<JobState, StoreError> {
    let row = sqlx::query("SELECT state FROM jobs WHERE id = ?")
        .bind(id.to_string())
        .fetch_optional(connection)
        .await?
        .ok_or_else(|| not_found(id))?;
    parsed(&row, "state")
}

/// Takes a legal step to another state and notes the time.
pub(in crate::store) async fn set_state(
    connection: &mut SqliteConnection,
    id: JobId,
    to: JobState,
    error: Option<&str>,
) -> Result<(), StoreError> {
    let to = state(connection, id).await?.step(to)?;
    let now = Timestamp::now().0;
    sqlx::query(
        "UPDATE jobs SET state = ?1, error = ?2,
             started_at = CASE ?1 WHEN 'running' THEN coalesce(started_at, ?3) ELSE started_at END,
             finished_at = CASE WHEN ?1 IN ('succeeded', 'failed', 'cancelled') THEN ?3 END
         WHERE id = ?4",
    )
    .bind(to.name())
    .bind(error)
    .bind(now)
    .bind(id.to_string())
    .execute(connection)
    .await?;
    Ok(())
}

/// Cancels the tasks of a job that no worker has.
pub(in crate::store) async fn cancel_waiting_tasks(
    connection: &mut SqliteConnection,
    id: JobId,
) -> Result<(), StoreError> {
    sqlx::query(
        "UPDATE tasks SET state = 'cancelled' WHERE job = ? AND state IN ('blocked', 'ready')",
    )
    .bind(id.to_string())
    .execute(connection)
    .await?;
    Ok(())
}

/// Ends a job that was being cancelled, once no worker is at it any more.
pub(in crate::store) async fn settle(
    connection: &mut SqliteConnection,
    id: JobId,
) -> Result<(), StoreError> {
    if state(connection, id).await? != JobState::Cancelling {
        return Ok(());
    }
    // A task that was completed a moment ago has made others ready: they are not wanted.
    cancel_waiting_tasks(connection, id).await?;
    if running_tasks(connection, id).await? == 0 {
        set_state(connection, id, JobState::Cancelled, None).await?;
    }
    Ok(())
}

async fn running_tasks(connection: &mut SqliteConnection, id: JobId) -> Result<u64, StoreError> {
    let row = sqlx::query("SELECT count(*) AS n FROM tasks WHERE job = ? AND state = 'running'")
        .bind(id.to_string())
        .fetch_one(connection)
        .await?;
    number(&row, "n")
}

async fn prepared(connection: &mut SqliteConnection, id: JobId) -> Result<bool, StoreError> {
    let row =
        sqlx::query("SELECT 1 FROM tasks WHERE job = ? AND kind = 'prepare' AND state = 'done'")
            .bind(id.to_string())
            .fetch_optional(connection)
            .await?;
    Ok(row.is_some())
}

/// The snapshots of a job that are not assembled.
async fn snapshots(connection: &mut SqliteConnection, id: JobId) -> Result<Vec<u32>, StoreError> {
    let rows = sqlx::query(
        "SELECT snapshot FROM tasks WHERE job = ? AND kind = 'assemble' AND state = 'blocked'",
    )
    .bind(id.to_string())
    .fetch_all(connection)
    .await?;
    rows.iter().map(|row| number(row, "snapshot")).collect()
}

fn job(row: &SqliteRow) -> Result<Job, StoreError> {
    Ok(Job {
        id: parsed(row, "id")?,
        lab: parsed(row, "lab")?,
        spec: json(row, "spec")?,
        state: parsed(row, "state")?,
        error: row.try_get("error")?,
        created_at: Timestamp(row.try_get("created_at")?),
        started_at: row.try_get::<Option<i64>, _>("started_at")?.map(Timestamp),
        finished_at: row.try_get::<Option<i64>, _>("finished_at")?.map(Timestamp),
    })
}

fn not_found(id: JobId) -> StoreError {
    StoreError::NotFound { what: "job", id: id.to_string() }
}

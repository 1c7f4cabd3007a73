//! Table `jobs`. What becomes of a job is the queue's business.

use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use crate::job::{
    CalibrationId, JobId, JobSpec, JobState, Lab, Label, MeasurementId, Sha256, Timestamp,
};
use crate::store::Store;
use crate::store::error::StoreError;
use crate::store::rows::{Page, integer, json, number, parsed, to_json};

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

    /// The number of jobs in each state.
    pub async fn job_counts(&self) -> Result<Vec<(JobState, u64)>, StoreError> {
        let rows = sqlx::query("SELECT state, count(*) AS jobs FROM jobs GROUP BY state")
            .fetch_all(&self.readers)
            .await?;
        rows.iter().map(|row| Ok((parsed(row, "state")?, number(row, "jobs")?))).collect()
    }
}

/// Writes the row of a job with the hash of its request, and the user's key if there is one.
pub(in crate::store) async fn insert(
    connection: &mut SqliteConnection,
    id: JobId,
    lab: &Lab,
    spec: &JobSpec,
    (request, key): (Sha256, Option<String>),
) -> Result<(), StoreError> {
    sqlx::query(
        "INSERT INTO jobs (id, calibration, measurement, label, spec, state, priority,
             idempotency_key, request, created_at, lab, disk_bytes, model)
         VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
    )
    .bind(id.to_string())
    .bind(spec.calibration.to_string())
    .bind(spec.measurement.to_string())
    .bind(spec.label.as_ref().map(Label::as_str))
    .bind(to_json("spec", spec)?)
    .bind(JobState::Queued.name())
    .bind(spec.priority)
    .bind(key)
    .bind(request.to_string())
    .bind(Timestamp::now().0)
    .bind(lab.as_str())
    .bind(integer(spec.disk_bytes()))
    .bind(spec.model.as_ref().map(|model| model.id.to_string()))
    .execute(connection)
    .await?;
    Ok(())
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
             started_at = coalesce(started_at, ?3),
             finished_at = ?4
         WHERE id = ?5",
    )
    .bind(to.name())
    .bind(error)
    .bind((to == JobState::Running).then_some(now))
    .bind(to.is_final().then_some(now))
    .bind(id.to_string())
    .execute(connection)
    .await?;
    Ok(())
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

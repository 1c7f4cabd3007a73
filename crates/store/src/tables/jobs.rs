//! Table `jobs`. The queue changes their states.

use sqlx::SqliteConnection;

use crate::Store;
use crate::columns::{Json, from_row, sql, sql_as};
use crate::error::{Result, StoreError};
use crate::rows::{Page, Span};
use engine::job::{
    Assessment, CalibrationId, Finding, Grade, JobId, JobSpec, JobState, Lab, Label, MeasurementId,
    Sha256, Timestamp,
};

#[derive(Debug, Clone, PartialEq)]
pub struct Job {
    pub id: JobId,
    pub lab: Lab,
    pub spec: JobSpec,
    pub state: JobState,
    pub error: Option<String>,
    pub created_at: Timestamp,
    /// When its first task was claimed.
    pub started_at: Option<Timestamp>,
    pub finished_at: Option<Timestamp>,
    /// Predicted quality of its frames; `None` before the job has succeeded, and where no prediction exists.
    pub assessment: Option<Assessment>,
}

impl Job {
    /// The verdict on its frames. Before its end only findings count that the job does not answer itself; a job without a
    /// result has none.
    pub fn verdict(&self) -> Option<Grade> {
        let Self { spec, state, assessment, .. } = self;
        let findings = match state {
            JobState::Failed | JobState::Cancelled => return None,
            JobState::Succeeded => spec.warnings.clone(),
            JobState::Queued | JobState::Running | JobState::Cancelling => {
                let answered = spec.registration.answers();
                let remains = |finding: &&Finding| !answered.iter().any(|code| finding.is(*code));
                spec.warnings.iter().filter(remains).cloned().collect()
            }
        };
        Assessment::verdict(&findings, assessment.as_ref())
    }

    /// The verdict in a line; `None` until it has succeeded.
    pub fn verdict_text(&self) -> Option<String> {
        (self.state == JobState::Succeeded)
            .then(|| Assessment::verdict_text(self.verdict(), self.assessment.as_ref()))
    }
}

from_row!(Job, row => {
    id,
    lab,
    spec = row.read::<Json<_>>("spec")?.0,
    state,
    error,
    created_at,
    started_at,
    finished_at,
    assessment = row.read_json("assessment")?,
});

#[derive(Debug, Clone, Default)]
pub struct JobFilter {
    /// Only those in one of these states; none for all.
    pub states: Option<Vec<JobState>>,
    pub calibration: Option<CalibrationId>,
    pub measurement: Option<MeasurementId>,
    pub label: Option<Label>,
    /// Only those with this text in the label or the identifier, in upper or lower case.
    pub search: Option<Label>,
    pub created: Span,
    /// Only those older than this one.
    pub after: Option<JobId>,
}

/// Changes of a job by a user.
#[derive(Debug, Clone, Default)]
pub struct JobChanges {
    /// The new label; `Some(None)` removes it.
    pub label: Option<Option<Label>>,
    pub priority: Option<i32>,
    /// The upload with the true frames; `Some(None)` removes it.
    pub truth: Option<Option<Sha256>>,
}

/// The list of jobs that meet the condition `$whose`, for which there is an index. Identifiers are below 'g', since
/// they are hexadecimal.
macro_rules! list_text {
    ($index:literal, $whose:literal) => {
        concat!(
            "SELECT * FROM jobs WHERE id IN (SELECT id FROM jobs INDEXED BY ",
            $index,
            " WHERE id < coalesce(?1, 'g') AND (?2 IS NULL OR state IN (SELECT value FROM json_each(?2)))
               AND (?3 IS NULL OR calibration = ?3) AND (?4 IS NULL OR measurement = ?4)
               AND (?5 IS NULL OR label = ?5)
               AND (?6 IS NULL OR instr(lower(label), lower(?6)) OR instr(id, ?11))
               AND (?12 IS NULL OR state = ?12)
               AND (?9 IS NULL OR created_at >= ?9) AND (?10 IS NULL OR created_at < ?10)
               AND ",
            $whose,
            " ORDER BY id DESC LIMIT ?7) ORDER BY id DESC"
        )
    };
}

impl Store {
    pub async fn job(&self, lab: &Lab, id: JobId) -> Result<Job> {
        let job = sql_as!("SELECT * FROM jobs WHERE id = ? AND lab = ?", [id, lab]);
        job.fetch_optional(&self.readers).await?.ok_or_else(|| StoreError::missing("job", id))
    }

    /// A job of any lab.
    pub async fn job_of_any_lab(&self, id: JobId) -> Result<Job> {
        let job = sql_as!("SELECT * FROM jobs WHERE id = ?", [id]);
        job.fetch_optional(&self.readers).await?.ok_or_else(|| StoreError::missing("job", id))
    }

    /// The jobs of a lab, or of all labs, newest first.
    pub async fn jobs(
        &self,
        lab: Option<&Lab>,
        filter: &JobFilter,
        limit: u32,
    ) -> Result<Page<Job>> {
        let state =
            filter.states.as_ref().filter(|states| states.len() == 1).map(|states| states[0]);
        // One text for all would use no index.
        let text = match (lab, state) {
            (Some(_), Some(_)) => list_text!("jobs_in_state", "lab = ?8 AND state = ?12"),
            (Some(_), None) => list_text!("jobs_of_lab", "lab = ?8"),
            (None, _) => list_text!("jobs_of_all", "?8 IS NULL"),
        };
        // Identifiers hold no other characters.
        let in_id = filter.search.as_ref().map(|text| text.as_str().to_lowercase());
        let in_id = in_id.filter(|text| text.chars().all(|c| c.is_ascii_hexdigit() || c == '-'));
        let items = sql_as!(
            text,
            [
                filter.after,
                filter.states.as_ref().map(Json),
                filter.calibration,
                filter.measurement,
                &filter.label,
                &filter.search,
                i64::from(limit) + 1,
                lab,
                filter.created.from,
                filter.created.before,
                in_id,
                state
            ]
        )
        .fetch_all(&self.readers)
        .await?;
        Ok(Page::cut(items, limit))
    }

    /// The state of the lab's job.
    pub async fn job_state(&self, lab: &Lab, id: JobId) -> Result<JobState> {
        let state = sql_as!("SELECT state FROM jobs WHERE id = ? AND lab = ?", [id, lab]);
        state.fetch_optional(&self.readers).await?.ok_or_else(|| StoreError::missing("job", id))
    }

    pub async fn job_counts(&self) -> Result<Vec<(JobState, u64)>> {
        let counts = "SELECT state, sum(jobs) FROM jobs_by_state GROUP BY state";
        sql_as!(counts).fetch_all(&self.readers).await
    }
}

/// Writes the row of a job.
pub async fn insert(
    connection: &mut SqliteConnection,
    id: JobId,
    lab: &Lab,
    spec: &JobSpec,
) -> Result<()> {
    sql!(
        "INSERT INTO jobs (id, calibration, measurement, label, spec, state, priority,
             created_at, lab, disk_bytes, model, truth)
         VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        [
            id,
            spec.calibration,
            spec.measurement,
            &spec.label,
            Json(spec),
            JobState::Queued,
            spec.priority,
            Timestamp::now(),
            lab,
            spec.disk_bytes(),
            spec.model.as_ref().map(|model| model.id),
            spec.truth
        ]
    )
    .execute(connection)
    .await?;
    Ok(())
}

pub async fn state(connection: &mut SqliteConnection, id: JobId) -> Result<JobState> {
    let state = sql_as!("SELECT state FROM jobs WHERE id = ?", [id]);
    state.fetch_optional(connection).await?.ok_or_else(|| StoreError::missing("job", id))
}

/// Takes a legal step to another state and notes the time.
pub async fn set_state(
    connection: &mut SqliteConnection,
    id: JobId,
    to: JobState,
    error: Option<&str>,
) -> Result<()> {
    let to = state(connection, id).await?.step(to)?;
    let now = Timestamp::now();
    if to == JobState::Running {
        // Before `started_at` is set: a job that is taken up again has waited once.
        sql!(
            "INSERT INTO lab_totals (lab, jobs_begun, wait_seconds)
                 SELECT lab, 1, max(?1 - created_at, 0) / 1000.0 FROM jobs
                 WHERE id = ?2 AND started_at IS NULL
             ON CONFLICT (lab) DO UPDATE SET jobs_begun = jobs_begun + 1,
                 wait_seconds = wait_seconds + excluded.wait_seconds",
            [now, id]
        )
        .execute(&mut *connection)
        .await?;
    }
    sql!(
        "UPDATE jobs SET state = ?1, error = ?2,
             started_at = coalesce(started_at, ?3),
             finished_at = ?4
         WHERE id = ?5",
        [to, error, (to == JobState::Running).then_some(now), to.is_final().then_some(now), id]
    )
    .execute(connection)
    .await?;
    Ok(())
}

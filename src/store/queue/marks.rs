//! What has changed: a small mark of every job, to be compared with the one before.

use std::collections::HashMap;

use sqlx::Row;

use crate::job::{JobId, JobState, Lab};
use crate::store::Store;
use crate::store::error::StoreError;
use crate::store::rows::parsed;

/// The mark of a job: it differs when the job's state or what its workers have told differs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JobMark {
    state: JobState,
    tasks: i64,
    iterations: i64,
    fraction: f64,
}

impl Store {
    /// The marks of all jobs, and whose they are. Reads indexes and the tasks that run.
    ///
    /// # Errors
    /// If the database fails.
    pub async fn job_marks(&self) -> Result<HashMap<(Lab, JobId), JobMark>, StoreError> {
        let mut marks = HashMap::new();
        let rows = sqlx::query("SELECT id, lab, state FROM jobs").fetch_all(&self.readers).await?;
        for row in &rows {
            let state = parsed(row, "state")?;
            marks.insert(
                (parsed(row, "lab")?, parsed(row, "id")?),
                JobMark { state, tasks: 0, iterations: 0, fraction: 0.0 },
            );
        }
        let rows = sqlx::query(
            "SELECT job, (SELECT lab FROM jobs WHERE id = job) AS lab, count(*) AS tasks, sum(ordinal) AS ordinals, sum(iterations) AS iterations,
                 sum(fraction) AS fraction
             FROM tasks WHERE state = 'running' GROUP BY job",
        )
        .fetch_all(&self.readers)
        .await?;
        for row in &rows {
            if let Some(mark) = marks.get_mut(&(parsed(row, "lab")?, parsed(row, "job")?)) {
                // Which tasks run, and not only how many: one may have ended and another begun.
                mark.tasks =
                    row.try_get::<i64, _>("tasks")? << 32 ^ row.try_get::<i64, _>("ordinals")?;
                mark.iterations = row.try_get("iterations")?;
                mark.fraction = row.try_get("fraction")?;
            }
        }
        Ok(marks)
    }
}

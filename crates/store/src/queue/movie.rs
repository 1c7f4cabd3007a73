//! Movies of results: asked for, made by a worker when nothing else is to be done, and kept with their job.

use serde_json::Value;
use sqlx::SqliteConnection;

use super::graph;
use crate::columns::{Columns, Json, sql, sql_as};
use crate::error::{Result, StoreError};
use crate::tables::quota;
use crate::tables::results::WHOLE_JOB;
use crate::{Job, Store};
use engine::job::{JobId, MovieFormat, Sha256, TaskKind, TaskState};

/// State of the movie of a snapshot, or of a whole job.
#[derive(Debug, Clone, PartialEq)]
pub enum Movie {
    Ready {
        sha256: Sha256,
        size: u64,
    },
    /// Share of the work that is done, on \[0,1\]; none until a worker begins.
    Asked(Option<f64>),
    /// It could not be made, for this reason. [`Store::create_movie`] tries again.
    Failed(String),
}

impl Store {
    /// The movie of a snapshot of a job (or, with none, of all); none if nobody has asked for it, or if it is damaged.
    pub async fn movie(
        &self,
        job: &Job,
        snapshot: Option<u32>,
        format: MovieFormat,
    ) -> Result<Option<Movie>> {
        Ok(self.find_movie(job, format.task(snapshot)).await?.map(|(movie, _)| movie))
    }

    /// The movie that a task makes, with its display window.
    async fn find_movie(&self, job: &Job, task: TaskKind) -> Result<Option<(Movie, Value)>> {
        let found = sql!(FIND, [job.id, task.into_str(), place(task)])
            .fetch_optional(&self.readers)
            .await?;
        let Some(row) = found else { return Ok(None) };
        let (sha256, size): (Option<Sha256>, Option<u64>) =
            (row.read("result")?, row.read("size")?);
        let movie = match (row.read("state")?, sha256.zip(size)) {
            (TaskState::Done, Some((sha256, size))) => Movie::Ready { sha256, size },
            (TaskState::Running, _) => Movie::Asked(Some(row.read("fraction")?)),
            (TaskState::Ready, _) => Movie::Asked(None),
            (TaskState::Failed, _) => {
                let reason: Option<String> = row.read("reason")?;
                Movie::Failed(reason.unwrap_or_else(|| "no reason is known".into()))
            }
            _ => return Ok(None),
        };
        Ok(Some((movie, row.read_json::<Value>("record")?.unwrap_or_default())))
    }

    /// Asks for a movie, unless it exists or is being made. A failed one is tried again, and one of another display
    /// window is replaced. `window` is null for the job's white level. The frames must exist.
    /// Errors: [`StoreError::Quota`]; [`StoreError::NotFound`] if the job was deleted.
    pub async fn create_movie(
        &self,
        job: &Job,
        snapshot: Option<u32>,
        format: MovieFormat,
        window: &Value,
    ) -> Result<Movie> {
        let task = format.task(snapshot);
        if let Some((found @ (Movie::Ready { .. } | Movie::Asked(_)), shown)) =
            self.find_movie(job, task).await?
            && shown == *window
        {
            return Ok(found);
        }
        let mut transaction = self.write().await?;
        self.drop_movies(&mut transaction, job.id, Some(task)).await?;
        let bytes = job.spec.movie_bytes(format, snapshot);
        quota::check(&mut transaction, &job.lab, None, bytes).await?;
        let known = sql!("SELECT 1 FROM jobs WHERE id = ?", [job.id]);
        let known = known.fetch_optional(&mut *transaction).await?;
        known.ok_or_else(|| StoreError::missing("job", job.id))?;
        let cost = job.spec.movie_cost(format, snapshot);
        graph::insert_for(&mut transaction, &job.lab, job.id.into(), task, cost).await?;
        sql!(
            "UPDATE tasks SET record = ? WHERE thing = ? AND kind = ? AND coalesce(snapshot, -1) = ?",
            [Json(window), job.id, task.into_str(), place(task)]
        )
        .execute(&mut *transaction)
        .await?;
        self.commit_removals(transaction).await?;
        Ok(Movie::Asked(None))
    }

    /// Estimated seconds of a worker for the rest of a movie, from the share that is done; `None` if no worker lives. A
    /// movie precedes the jobs of its lab, so the estimate leaves out the queue.
    pub async fn movie_seconds(
        &self,
        job: &Job,
        (snapshot, format): (Option<u32>, MovieFormat),
        done: Option<f64>,
    ) -> Result<Option<f64>> {
        let left = job.spec.movie_cost(format, snapshot) * (1.0 - done.unwrap_or(0.0));
        Ok(self.forecast().await?.other_seconds(left))
    }

    /// The values to show as black and as white in a movie; `None` for the job's white level.
    pub(super) async fn movie_window(&self, job: JobId, task: TaskKind) -> Result<Option<Value>> {
        let found =
            sql!(FIND, [job, task.into_str(), place(task)]).fetch_optional(&self.readers).await?;
        let window = found.map(|row| row.read_json::<Value>("record")).transpose()?.flatten();
        Ok(window.filter(|window| !window.is_null()))
    }

    /// Removes the movies of a job, or the one of a task, with the tasks that make them.
    pub(super) async fn drop_movies(
        &self,
        transaction: &mut SqliteConnection,
        job: JobId,
        task: Option<TaskKind>,
    ) -> Result<()> {
        let results: Vec<Option<Sha256>> = sql_as!(
            "DELETE FROM tasks
             WHERE thing = ?1 AND (?2 IS NULL OR (kind = ?2 AND coalesce(snapshot, -1) = ?3))
             RETURNING result",
            [job, task.map(|task| task.into_str()), task.map(place)]
        )
        .fetch_all(&mut *transaction)
        .await?;
        for result in results.into_iter().flatten() {
            self.release(transaction, result).await?;
        }
        Ok(())
    }
}

/// A damaged one is as good as none.
const FIND: &str = "SELECT state, fraction, result, size, record,
        (SELECT reason FROM attempts WHERE task = id AND attempt = tasks.attempt) AS reason
    FROM tasks
    LEFT JOIN blobs ON sha256 = result AND damaged_at IS NULL
    WHERE thing = ? AND kind = ? AND coalesce(snapshot, -1) = ?";

/// The snapshot of a movie, as queries compare it.
fn place(task: TaskKind) -> i64 {
    task.snapshot().map_or(WHOLE_JOB, i64::from)
}

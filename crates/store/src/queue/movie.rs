//! Movies of results: asked for, made by a worker when nothing else is to be done, and kept with their job.

use serde_json::Value;
use sqlx::SqliteConnection;

use super::graph;
use crate::columns::{Columns, Json, sql, sql_as};
use crate::error::{Result, StoreError};
use crate::tables::quota;
use crate::tables::results::WHOLE_JOB;
use crate::{Job, Store};
use engine::job::{JobId, Sha256, TaskKind, TaskState};

/// Where the movie of a snapshot, or of all of a job, stands.
#[derive(Debug, Clone, PartialEq)]
pub enum Movie {
    Ready {
        sha256: Sha256,
        size: u64,
    },
    /// A worker is at it, so far (on \[0,1\]); none before one is.
    Asked(Option<f64>),
    /// It could not be made, for this reason; who asks again has it tried again.
    Failed(String),
}

impl Store {
    /// Finds the movie of a snapshot of a job (or, with none, of all), or asks for it if nobody has, or if it is
    /// damaged. The frames must be there. A movie of another display window is replaced; `window` is null for the job's
    /// white level.
    /// Errors: [`StoreError::Quota`]; [`StoreError::NotFound`] if the job is gone.
    pub async fn movie(&self, job: &Job, snapshot: Option<u32>, window: &Value) -> Result<Movie> {
        let place = place(snapshot);
        let found = sql!(FIND, [job.id, place]).fetch_optional(&self.readers).await?;
        if let Some(row) = found
            && row.read_json::<Value>("record")?.unwrap_or_default() == *window
            && let state @ (TaskState::Ready | TaskState::Running | TaskState::Done) =
                row.read("state")?
        {
            let (sha256, size): (Option<Sha256>, Option<u64>) =
                (row.read("result")?, row.read("size")?);
            let fraction: f64 = row.read("fraction")?;
            match (state, sha256.zip(size)) {
                (TaskState::Done, None) => {}
                (_, Some((sha256, size))) => return Ok(Movie::Ready { sha256, size }),
                (TaskState::Running, None) => return Ok(Movie::Asked(Some(fraction))),
                (_, None) => return Ok(Movie::Asked(None)),
            }
        }
        self.ask_movie(job, snapshot, window).await
    }

    /// Asks for a movie anew, or tells why the last one failed.
    async fn ask_movie(&self, job: &Job, snapshot: Option<u32>, window: &Value) -> Result<Movie> {
        let place = place(snapshot);
        let mut transaction = self.write().await?;
        let failed: Option<Option<String>> = sql_as!(
            "SELECT (SELECT reason FROM attempts WHERE task = id AND attempt = tasks.attempt)
             FROM tasks WHERE thing = ? AND coalesce(snapshot, -1) = ? AND state = ?
                 AND coalesce(record, 'null') = ?",
            [job.id, place, TaskState::Failed, Json(window)]
        )
        .fetch_optional(&mut *transaction)
        .await?;
        self.drop_movies(&mut transaction, job.id, Some(place)).await?;
        if let Some(reason) = failed {
            transaction.commit().await?;
            return Ok(Movie::Failed(reason.unwrap_or_else(|| "no reason is known".into())));
        }
        quota::check(&mut transaction, &job.lab, None, job.spec.movie_bytes(snapshot)).await?;
        let known = sql!("SELECT 1 FROM jobs WHERE id = ?", [job.id]);
        let known = known.fetch_optional(&mut *transaction).await?;
        known.ok_or_else(|| StoreError::missing("job", job.id))?;
        let (kind, cost) = (TaskKind::Movie { snapshot }, job.spec.movie_cost(snapshot));
        graph::insert_for(&mut transaction, (&job.lab, job.id.into()), kind, cost).await?;
        sql!(
            "UPDATE tasks SET record = ? WHERE thing = ? AND coalesce(snapshot, -1) = ?",
            [Json(window), job.id, place]
        )
        .execute(&mut *transaction)
        .await?;
        transaction.commit().await?;
        Ok(Movie::Asked(None))
    }

    /// The values to show as black and as white in a movie; `None` for the job's white level.
    pub(super) async fn movie_window(
        &self,
        job: JobId,
        snapshot: Option<u32>,
    ) -> Result<Option<Value>> {
        let found = sql!(FIND, [job, place(snapshot)]).fetch_optional(&self.readers).await?;
        let window = found.map(|row| row.read_json::<Value>("record")).transpose()?.flatten();
        Ok(window.filter(|window| !window.is_null()))
    }

    /// Removes the movies of a job, or that of one snapshot of it, with the tasks that make them.
    pub(super) async fn drop_movies(
        &self,
        transaction: &mut SqliteConnection,
        job: JobId,
        place: Option<i64>,
    ) -> Result<()> {
        let results: Vec<Option<Sha256>> = sql_as!(
            "DELETE FROM tasks WHERE thing = ?1 AND (?2 IS NULL OR coalesce(snapshot, -1) = ?2)
             RETURNING result",
            [job, place]
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
const FIND: &str = "SELECT state, fraction, result, size, record FROM tasks
    LEFT JOIN blobs ON sha256 = result AND damaged_at IS NULL
    WHERE thing = ? AND coalesce(snapshot, -1) = ?";

/// The snapshot of a movie as it is looked for.
fn place(snapshot: Option<u32>) -> i64 {
    snapshot.map_or(WHOLE_JOB, i64::from)
}

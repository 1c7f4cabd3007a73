//! Movies of results: asked for, made by a worker when nothing else is to be done, and kept with their job.

use sqlx::SqliteConnection;

use super::graph;
use crate::columns::{Columns, sql, sql_as};
use crate::error::{Result, StoreError};
use crate::tables::quota;
use crate::tables::results::WHOLE_JOB;
use crate::{Job, Store};
use engine::job::{JobId, Sha256, TaskKind, TaskState};

/// State of the movie of a snapshot, or of a whole job.
#[derive(Debug, Clone, PartialEq)]
pub enum Movie {
    Ready {
        sha256: Sha256,
        size: u64,
    },
    /// The share that is done, on \[0,1\]; `None` until a worker has begun.
    Asked(Option<f64>),
    /// It failed, for this reason; the next request tries again.
    Failed(String),
}

impl Store {
    /// Finds the movie of a snapshot of a job (or, with none, of all), or asks for it if nobody has, or if it is
    /// damaged. The frames must be there.
    /// Errors: [`StoreError::Quota`]; [`StoreError::NotFound`] if the job was deleted.
    pub async fn movie(&self, job: &Job, snapshot: Option<u32>) -> Result<Movie> {
        let place = place(snapshot);
        let found = sql!(FIND, [job.id, place]).fetch_optional(&self.readers).await?;
        if let Some(row) = found
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
        self.ask_movie(job, snapshot).await
    }

    /// Requests a movie, or reports why the last attempt failed.
    async fn ask_movie(&self, job: &Job, snapshot: Option<u32>) -> Result<Movie> {
        let place = place(snapshot);
        let mut transaction = self.write().await?;
        let failed: Option<Option<String>> = sql_as!(
            "SELECT (SELECT reason FROM attempts WHERE task = id AND attempt = tasks.attempt)
             FROM tasks WHERE thing = ? AND coalesce(snapshot, -1) = ? AND state = ?",
            [job.id, place, TaskState::Failed]
        )
        .fetch_optional(&mut *transaction)
        .await?;
        self.drop_movies(&mut transaction, job.id, Some(place)).await?;
        if let Some(reason) = failed {
            self.commit_removals(transaction).await?;
            return Ok(Movie::Failed(reason.unwrap_or_else(|| "no reason is known".into())));
        }
        quota::check(&mut transaction, &job.lab, None, job.spec.movie_bytes(snapshot)).await?;
        let known = sql!("SELECT 1 FROM jobs WHERE id = ?", [job.id]);
        let known = known.fetch_optional(&mut *transaction).await?;
        known.ok_or_else(|| StoreError::missing("job", job.id))?;
        let (kind, cost) = (TaskKind::Movie { snapshot }, job.spec.movie_cost(snapshot));
        graph::insert_for(&mut transaction, (&job.lab, job.id.into()), kind, cost).await?;
        self.commit_removals(transaction).await?;
        Ok(Movie::Asked(None))
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
const FIND: &str = "SELECT state, fraction, result, size FROM tasks
    LEFT JOIN blobs ON sha256 = result AND damaged_at IS NULL
    WHERE thing = ? AND coalesce(snapshot, -1) = ?";

/// The snapshot of a movie as it is looked for.
fn place(snapshot: Option<u32>) -> i64 {
    snapshot.map_or(WHOLE_JOB, i64::from)
}

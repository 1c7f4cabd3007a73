//! Movies of results: asked for, made by a worker when nothing else is to be done, and kept with their job.

use sqlx::SqliteConnection;

use crate::columns::{Columns, sql, sql_as};
use crate::error::{Result, StoreError};
use crate::tables::results::WHOLE_JOB;
use crate::tables::{labs, quota};
use crate::{Job, Store};
use engine::job::{JobId, Sha256, TaskId, TaskKind, TaskState};

/// Below that of every job: nobody waits for a reconstruction because somebody wants to look at another.
const MOVIE_PRIORITY: i32 = -1000;

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
    /// damaged. The frames must be there.
    /// Errors: [`StoreError::Quota`]; [`StoreError::NotFound`] if the job is gone.
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

    /// Asks for a movie anew, or tells why the last one failed.
    async fn ask_movie(&self, job: &Job, snapshot: Option<u32>) -> Result<Movie> {
        let place = place(snapshot);
        let mut transaction = self.write().await?;
        let failed: Option<Option<String>> = sql_as!(
            "SELECT (SELECT reason FROM attempts WHERE task = id AND attempt = tasks.attempt)
             FROM tasks WHERE movie = ? AND coalesce(snapshot, -1) = ? AND state = ?",
            [job.id, place, TaskState::Failed]
        )
        .fetch_optional(&mut *transaction)
        .await?;
        self.drop_movies(&mut transaction, job.id, Some(place)).await?;
        if let Some(reason) = failed {
            transaction.commit().await?;
            return Ok(Movie::Failed(reason.unwrap_or_else(|| "no reason is known".into())));
        }
        quota::check(&mut transaction, &job.lab, None, job.spec.movie_bytes(snapshot)).await?;
        insert(&mut transaction, job, snapshot).await?;
        transaction.commit().await?;
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
            "DELETE FROM tasks WHERE movie = ?1 AND (?2 IS NULL OR coalesce(snapshot, -1) = ?2)
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
    WHERE movie = ? AND coalesce(snapshot, -1) = ?";

/// The snapshot of a movie as it is looked for.
fn place(snapshot: Option<u32>) -> i64 {
    snapshot.map_or(WHOLE_JOB, i64::from)
}

async fn insert(connection: &mut SqliteConnection, job: &Job, snapshot: Option<u32>) -> Result<()> {
    let kind = TaskKind::Movie { snapshot };
    let inserted = sql!(
        "INSERT INTO tasks (id, movie, lab, ordinal, kind, snapshot, state, priority, cost)
         SELECT ?, id, lab, 0, ?, ?, ?, ?, ? FROM jobs WHERE id = ?",
        [
            TaskId::new(),
            kind.into_str(),
            snapshot,
            TaskState::Ready,
            MOVIE_PRIORITY,
            job.spec.movie_cost(snapshot),
            job.id
        ]
    )
    .execute(&mut *connection)
    .await?;
    if inserted.rows_affected() == 0 {
        return Err(StoreError::missing("job", job.id));
    }
    labs::know(connection, &job.lab).await
}

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
    /// Share of the work that is done, on \[0,1\]; none until a worker begins.
    Asked(Option<f64>),
    /// It could not be made, for this reason. [`Store::create_movie`] tries again.
    Failed(String),
}

impl Store {
    /// The movie of a snapshot of a job (or, with none, of all); none if nobody has asked for it, or if it is damaged.
    pub async fn movie(&self, job: &Job, snapshot: Option<u32>) -> Result<Option<Movie>> {
        let found = sql!(FIND, [job.id, place(snapshot)]).fetch_optional(&self.readers).await?;
        let Some(row) = found else { return Ok(None) };
        let (sha256, size): (Option<Sha256>, Option<u64>) =
            (row.read("result")?, row.read("size")?);
        Ok(match (row.read("state")?, sha256.zip(size)) {
            (TaskState::Done, Some((sha256, size))) => Some(Movie::Ready { sha256, size }),
            (TaskState::Running, _) => Some(Movie::Asked(Some(row.read("fraction")?))),
            (TaskState::Ready, _) => Some(Movie::Asked(None)),
            (TaskState::Failed, _) => {
                let reason: Option<String> = row.read("reason")?;
                Some(Movie::Failed(reason.unwrap_or_else(|| "no reason is known".into())))
            }
            _ => None,
        })
    }

    /// Asks for a movie, unless it exists or is being made. A failed one is tried again. The frames must exist.
    /// Errors: [`StoreError::Quota`]; [`StoreError::NotFound`] if the job was deleted.
    pub async fn create_movie(&self, job: &Job, snapshot: Option<u32>) -> Result<Movie> {
        if let Some(found @ (Movie::Ready { .. } | Movie::Asked(_))) =
            self.movie(job, snapshot).await?
        {
            return Ok(found);
        }
        let mut transaction = self.write().await?;
        self.drop_movies(&mut transaction, job.id, Some(place(snapshot))).await?;
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
const FIND: &str = "SELECT state, fraction, result, size,
        (SELECT reason FROM attempts WHERE task = id AND attempt = tasks.attempt) AS reason
    FROM tasks
    LEFT JOIN blobs ON sha256 = result AND damaged_at IS NULL
    WHERE thing = ? AND coalesce(snapshot, -1) = ?";

/// The snapshot of a movie as it is looked for.
fn place(snapshot: Option<u32>) -> i64 {
    snapshot.map_or(WHOLE_JOB, i64::from)
}

//! What labs and tokens keep here, and how much they may. Asked again in the transaction in which something is
//! added, so that of many requests at once no two get the last room.

use sqlx::SqliteConnection;

use crate::Store;
use crate::columns::sql_as;
use crate::error::{Result, StoreError};
use crate::tables::labs;
use engine::job::{Lab, Timestamp, TokenId};

/// Checks of a lab that may wait and run at a time.
const MOST_CHECKS: u64 = 32;
/// Uploads in pieces of a lab that may be unfinished at a time.
pub(crate) const MOST_PARTIALS: u64 = 64;

impl Store {
    /// Refuses `needed` more bytes if the lab, or the token, would keep more than it may.
    /// Errors: [`StoreError::Quota`].
    pub async fn check_quota(&self, lab: &Lab, token: Option<TokenId>, needed: u64) -> Result<()> {
        check(&mut *self.readers.acquire().await?, lab, token, needed).await
    }

    /// Bytes of uploads that a token keeps here or has begun, and of arrays that were prepared for it.
    pub async fn token_bytes(&self, token: TokenId) -> Result<u64> {
        token_bytes(&mut *self.readers.acquire().await?, token).await
    }

    /// Bytes that a lab keeps here: uploads, prepared arrays and results, and bytes reserved for it.
    pub async fn lab_bytes(&self, lab: &Lab) -> Result<u64> {
        lab_bytes(&mut *self.readers.acquire().await?, lab).await
    }
}

/// As [`Store::check_quota`], in a transaction.
pub async fn check(
    connection: &mut SqliteConnection,
    lab: &Lab,
    token: Option<TokenId>,
    needed: u64,
) -> Result<()> {
    if let (Some(limit), _) = labs::limits(connection, lab).await? {
        let kept = lab_bytes(connection, lab).await?;
        within("lab", kept, needed, limit)?;
    }
    let Some(token) = token else { return Ok(()) };
    let limit = "SELECT max_bytes FROM tokens WHERE id = ? AND max_bytes IS NOT NULL";
    if let Some(limit) = sql_as!(limit, [token]).fetch_optional(&mut *connection).await? {
        let kept = token_bytes(connection, token).await?;
        within("token", kept, needed, limit)?;
    }
    Ok(())
}

fn within(whose: &'static str, kept: u64, needed: u64, limit: u64) -> Result<()> {
    if kept.saturating_add(needed) <= limit {
        return Ok(());
    }
    Err(StoreError::Quota { whose, kept, needed, limit })
}

/// Bytes of uploads, whole and begun, and of prepared arrays, that count against a token.
async fn token_bytes(connection: &mut SqliteConnection, token: TokenId) -> Result<u64> {
    sql_as!(
        "SELECT (SELECT coalesce(sum(size), 0) FROM holdings JOIN blobs USING (sha256)
                 WHERE token = ?1)
              + (SELECT coalesce(sum(coalesce(length, received)), 0) FROM partials
                 WHERE token = ?1 AND result IS NULL)
              + (SELECT coalesce(sum(size), 0) FROM blobs
                 WHERE sha256 IN (SELECT prepared FROM requests WHERE token = ?1 AND what <> 'model'))
              + (SELECT coalesce(sum(prepared_bytes), 0) FROM requests
                 WHERE token = ?1 AND prepared_bytes > 0)",
        [token]
    )
    .fetch_one(connection)
    .await
}

/// Bytes of all files of a lab, and bytes reserved for its uploads and jobs.
async fn lab_bytes(connection: &mut SqliteConnection, lab: &Lab) -> Result<u64> {
    sql_as!(
        "SELECT (SELECT coalesce(sum(bytes), 0) FROM files_of_labs WHERE lab = ?1)
              + (SELECT coalesce(sum(coalesce(length, received)), 0) FROM partials
                 WHERE lab = ?1 AND result IS NULL)
              + (SELECT coalesce(sum(prepared_bytes), 0) FROM requests
                 WHERE lab = ?1 AND prepared_bytes > 0)
              + (SELECT coalesce(sum(iif(state IN ('queued', 'running', 'cancelling'),
                                         disk_bytes, result_bytes)), 0)
                 FROM jobs_by_state WHERE lab = ?1)",
        [lab]
    )
    .fetch_one(connection)
    .await
}

/// Refuses a job if enough wait and run. A lab has its own limit, if one was set. When all places are taken, a lab with
/// less than an equal part of them is accepted nevertheless, so that no lab excludes the others.
/// Errors: [`StoreError::QueueFull`].
pub async fn check_jobs(connection: &mut SqliteConnection, lab: &Lab, most: u64) -> Result<()> {
    let (_, limit) = labs::limits(connection, lab).await?;
    let (all, own): (u64, u64) = sql_as!(
        "SELECT coalesce(sum(jobs), 0), coalesce(sum(jobs) FILTER (WHERE lab = ?1), 0)
         FROM jobs_by_state WHERE state IN ('queued', 'running', 'cancelling')",
        [lab]
    )
    .fetch_one(&mut *connection)
    .await?;
    if let Some(most) = limit.filter(|limit| own >= *limit) {
        return Err(StoreError::QueueFull { whose: "of this lab ", jobs: own, most });
    }
    if all < most {
        return Ok(());
    }
    let labs = "SELECT count(DISTINCT lab) FROM jobs_by_state
                WHERE state IN ('queued', 'running', 'cancelling') AND jobs > 0 AND lab <> ?";
    let others: u64 = sql_as!(labs, [lab]).fetch_one(connection).await?;
    if own < most / (others + 1) {
        return Ok(());
    }
    Err(StoreError::QueueFull { whose: "", jobs: all, most })
}

/// Refuses another upload in pieces if the lab has enough that are unfinished.
/// Errors: [`StoreError::ManyPartials`].
pub async fn check_partials(connection: &mut SqliteConnection, lab: &Lab) -> Result<()> {
    let open = "SELECT count(*), coalesce(min(expires_at), 0) FROM partials
                WHERE lab = ? AND result IS NULL";
    let (uploads, expires_at): (u64, Timestamp) =
        sql_as!(open, [lab]).fetch_one(connection).await?;
    if uploads < MOST_PARTIALS {
        return Ok(());
    }
    let seconds = (expires_at.0 - Timestamp::now().0).max(0) as f64 / 1000.0;
    Err(StoreError::ManyPartials { uploads, seconds })
}

/// Refuses another check if enough of the lab wait and run.
/// Errors: [`StoreError::ManyChecks`].
pub async fn check_checks(connection: &mut SqliteConnection, lab: &Lab) -> Result<()> {
    let open = "SELECT count(*) FROM tasks
                WHERE lab = ? AND kind = 'check' AND state IN ('ready', 'running')";
    let checks: u64 = sql_as!(open, [lab]).fetch_one(&mut *connection).await?;
    if checks < MOST_CHECKS {
        return Ok(());
    }
    // The mean time of those that have ended. Before one has, the planned time of the shortest.
    let seconds: f64 = sql_as!(
        "SELECT coalesce(
             (SELECT seconds / tasks FROM totals WHERE kind = 'check' AND tasks > 0),
             (SELECT min(cost) FROM tasks
              WHERE lab = ? AND kind = 'check' AND state IN ('ready', 'running')))",
        [lab]
    )
    .fetch_one(connection)
    .await?;
    Err(StoreError::ManyChecks { checks, seconds })
}
